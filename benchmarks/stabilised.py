"""Stabilised methods beside others, on diffusion and relaxation: evaluations and time for an error.

All programs control their steps. For each the tolerance that reaches a relative error at the end
with the fewest evaluations of the field is looked for; evaluations are counted while a program
runs, and a derivative of the field in one direction counts as one more. Then the programs take
turns. A program that does not reach an error has no row with a tolerance for it.

Besides, how long a step of Landau, Lifshitz and Gilbert's equation may be, over its damping.

The problems, the first five in plain space:

- heat: `u' = div(k grad u)` on the unit square or cube without flow through its walls, to t = 0.05.
  The conductivity k is 1 - 0.9 to 1 + 0.9.
- porous medium: `cfjax.scenes.porous_medium`.
- p-Laplacian: `u' = div(|grad u| grad u)`, periodic.
- heat and reaction: `u' = laplacian u + 50 (u - u^3)`, periodic, which a transform diagonalises.
- spins: `cfjax.scenes.harmonic_maps` with 32 x 32 spins, to t = 50.
- Wilson flow: `cfjax.scenes.wilson_flow`, to t = 4.
"""

import functools
import importlib.metadata
import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.sparse import diags, eye, kron
from scipy.sparse.linalg import expm_multiply

import cfjax
import on_host
import results
from cfjax._measure import style as _style
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import harmonic_maps, porous_medium, wilson_flow

HEAT_TARGETS, TARGETS = (2e-3, 1.5e-4, 1.5e-6), (1e-2, 1e-3, 1e-4)
# Over these the others are measured.
BASES = ("CF43", "Tsit5", "Kvaerno5", "Luscher3", "ETD54")
LARGEST, FEWEST = 0.1, 1e-9
DAMPINGS = (0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
FRAMES = ("with a part along the spin", "horizontal")


class Problem(NamedTuple):
    t0: float
    t1: float
    y0: Any
    field: Callable[[Any, Any, Any], Any]
    # The spectral radius, a bound on it, or a function.
    radius: Any
    reference: Callable[[], np.ndarray]
    targets: tuple[float, ...]
    # Beside the stabilised methods.
    peers: tuple[str, ...]
    # The same field in plain space, and one with the linear part apart.
    velocity: Callable[[Any, Any, Any], Any] | None = None
    semilinear: Callable[[Any, Any, Any], Any] | None = None


# The problems.


def conductivities(shape: tuple[int, ...]) -> list[np.ndarray]:
    """Of the walls between neighbours, along each axis: a chessboard of smooth spots."""

    def at(*places: np.ndarray) -> np.ndarray:
        waves = np.meshgrid(*(np.sin(2 * np.pi * x) for x in places), indexing="ij")
        return 1 + 0.9 * np.prod(waves, axis=0)

    def centres(n: int) -> np.ndarray:
        return (np.arange(n) + 0.5) / n

    return [
        at(*(np.arange(1, n) / n if k == axis else centres(n) for k, n in enumerate(shape)))
        for axis in range(len(shape))
    ]


def heat(*shape: int, peers: tuple[str, ...], targets: tuple[float, ...] = HEAT_TARGETS) -> Problem:
    walls, t1 = conductivities(shape), 0.05
    n, d = shape[0], len(shape)

    def field(t: Any, u: Any, args: Any) -> Any:
        out = jnp.zeros_like(u)
        for axis, k in enumerate(walls):
            flow = jnp.asarray(k) * jnp.diff(u, axis=axis)
            pads = [(1, 1) if j == axis else (0, 0) for j in range(d)]
            out = out + jnp.diff(jnp.pad(flow, pads), axis=axis)
        return out * n**2

    x = np.meshgrid(*((np.arange(m) + 0.5) / m for m in shape), indexing="ij")
    u0 = np.exp(-20 * sum((z - c) ** 2 for z, c in zip(x, (0.35, 0.4, 0.45), strict=False)))

    def reference() -> np.ndarray:
        """By SciPy's exponential of a sparse matrix, made from differences along each axis."""
        matrix: Any = 0
        for axis, k in enumerate(walls):
            offsets: Any = [0, 1]
            step = diags([-np.ones(n - 1), np.ones(n - 1)], offsets, shape=(n - 1, n))
            parts = [step if j == axis else eye(m) for j, m in enumerate(shape)]
            gradient = functools.reduce(kron, parts).tocsr()
            matrix = matrix - gradient.T @ diags(k.ravel()) @ gradient * n**2
        return expm_multiply(t1 * matrix, u0.ravel()).reshape(shape)

    # Gershgorin: twice the largest sum of the conductivities around a cell.
    sums = sum(
        np.pad(k, [(1, 0) if j == axis else (0, 0) for j in range(d)])
        for axis, k in enumerate(walls)
    )
    sums = sums + sum(
        np.pad(k, [(0, 1) if j == axis else (0, 0) for j in range(d)])
        for axis, k in enumerate(walls)
    )
    radius = 2 * float(np.max(sums)) * n**2
    return Problem(0.0, t1, jnp.asarray(u0), field, radius, reference, targets, peers, field)


def porous() -> Problem:
    given = porous_medium.problem()

    def field(t: Any, u: Any, args: Any) -> Any:
        return porous_medium.field(t, u, porous_medium.SIDE)

    def radius(t: Any, u: Any, args: Any) -> Any:
        return 16 * jnp.max(jnp.abs(u)) * (len(u) / porous_medium.SIDE) ** 2

    start, t1 = jnp.asarray(given["y0"]), given["t1"]
    peers = ("CF43", "Tsit5")
    reference = functools.partial(porous_medium.reference, t1)
    return Problem(given["t0"], t1, start, field, radius, reference, TARGETS, peers, field)


def p_laplacian(n: int = 64) -> Problem:
    """With p = 3; gradients of a cell from differences forwards, and the flow of its energy."""

    def rate(u: Any, numpy: Any) -> Any:
        slopes = [numpy.roll(u, -1, k) - u for k in (0, 1)]
        # The root has no derivative at zero.
        size = numpy.sqrt(slopes[0] ** 2 + slopes[1] ** 2 + 1e-30)
        flows = [size * slope for slope in slopes]
        return sum(flow - numpy.roll(flow, 1, k) for k, flow in enumerate(flows)) * n**3

    def field(t: Any, u: Any, args: Any) -> Any:
        return rate(u, jnp)

    def radius(t: Any, u: Any, args: Any) -> Any:
        # Diffusivities of 2 |grad u| along it, and half as much across.
        slopes = [jnp.abs(jnp.roll(u, -1, k) - u) for k in (0, 1)]
        return 16 * jnp.max(jnp.sqrt(slopes[0] ** 2 + slopes[1] ** 2)) * n**3

    x = (np.arange(n) + 0.5) / n
    u0 = np.sin(2 * np.pi * x)[:, None] * np.cos(2 * np.pi * x) + 0.3 * np.cos(4 * np.pi * x)
    t1 = 0.02

    def reference() -> np.ndarray:
        return on_host.solve(lambda t, u: rate(u, np), t1, u0)

    peers = ("CF43", "Tsit5")
    return Problem(0.0, t1, jnp.asarray(u0), field, radius, reference, TARGETS, peers, field)


def heat_and_reaction(n: int = 64) -> Problem:
    t1 = 0.05
    transform = cfjax.TensorTransform((cfjax.FourierTransform(), cfjax.RealFourierTransform(n)))
    along = (
        cfjax.FourierTransform().second_difference(n),
        cfjax.RealFourierTransform(n).second_difference(n),
    )
    spectrum = jnp.asarray(n**2 * np.add.outer(*along))

    def velocity(t: Any, u: Any, args: Any, numpy: Any = jnp) -> Any:
        around = sum(numpy.roll(u, s, k) for s in (1, -1) for k in (0, 1))
        return (around - 4 * u) * n**2 + 50 * (u - u**3)

    def semilinear(t: Any, u: Any, args: Any) -> cfjax.Affine:
        return cfjax.Affine(50 * (u - u**3), spectrum, transform)

    x = 2 * np.pi * np.arange(n) / n
    u0 = 0.5 * np.sin(x)[:, None] * np.cos(x) + 0.3 * np.cos(2 * x + 1)

    def reference() -> np.ndarray:
        return on_host.solve(functools.partial(velocity, args=None, numpy=np), t1, u0)

    radius, peers = 8.0 * n**2 + 100, ("Tsit5", "ETD54")
    start = jnp.asarray(u0)
    return Problem(
        0.0, t1, start, velocity, radius, reference, TARGETS, peers, velocity, semilinear
    )


def spins() -> Problem:
    start = harmonic_maps.y0(32)
    return Problem(
        0.0,
        50.0,
        jnp.asarray(start),
        harmonic_maps.field,
        harmonic_maps.RADIUS,
        functools.partial(harmonic_maps.reference, 50.0, start),
        TARGETS,
        ("CF43", "Tsit5", "Luscher3"),
        harmonic_maps.velocity,
    )


def links() -> Problem:
    start = wilson_flow.y0()
    return Problem(
        0.0,
        4.0,
        jnp.asarray(start),
        wilson_flow.field,
        16.0,
        functools.partial(wilson_flow.reference, 4.0, start),
        TARGETS,
        ("CF43", "Luscher3"),
    )


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "heat, 24 x 24": lambda: heat(24, 24, peers=("CF43", "Tsit5", "Kvaerno5")),
    "heat, 64 x 64": lambda: heat(64, 64, peers=("CF43", "Tsit5")),
    "heat, 128 x 128": lambda: heat(128, 128, peers=("Tsit5",), targets=HEAT_TARGETS[:2]),
    "heat, 32 x 32 x 32": lambda: heat(32, 32, 32, peers=("Tsit5",), targets=HEAT_TARGETS[:2]),
    "porous medium": porous,
    "p-Laplacian": p_laplacian,
    "spins, 32 x 32": spins,
    "Wilson flow": links,
    "heat and reaction": heat_and_reaction,
}


# Programs.


class Run(NamedTuple):
    tolerance: float
    error: float
    steps: int
    rejected: int
    evaluations: int
    seconds: float


class Program:
    """A method on a problem with control of its steps, compiled once for all tolerances."""

    def __init__(self, problem: Problem, term: Any, solver: Any, reference: np.ndarray):
        self.problem, self.term, self.solver, self.reference = problem, term, solver, reference
        self.counts: Counter[str] = Counter()
        self.runs: dict[float, Run] = {}
        self.counting = self._compiled(counts=True)
        self.executable: Any = None
        self.estimates = getattr(solver, "spectral_radius", 1.0) is None

    def _compiled(self, counts: bool) -> Any:
        problem, term = self.problem, self.term
        if counts:
            vector_field = self.term.vf

            def counted(t: Any, y: Any, args: Any) -> Any:
                jax.debug.callback(lambda: self.counts.update(["field"]))
                return vector_field(t, y, args)

            kind = diffrax.ODETerm if isinstance(term, diffrax.ODETerm) else cfjax.LieTerm
            term = kind(counted)
        size = float(np.sqrt(np.mean(np.abs(np.asarray(problem.y0)) ** 2)))

        def solve(y0: Any, tolerance: Any) -> tuple:
            sol = diffrax.diffeqsolve(
                term,
                self.solver,
                problem.t0,
                problem.t1,
                (problem.t1 - problem.t0) / 1e4,
                y0,
                stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance * size),
                max_steps=200_000,
                throw=False,
            )
            assert sol.ys is not None
            is_successful = sol.result == diffrax.RESULTS.successful
            stats = sol.stats
            return sol.ys[-1], stats["num_steps"], stats["num_rejected_steps"], is_successful

        return jax.jit(solve).lower(problem.y0, jnp.asarray(0.1)).compile()

    def run(self, tolerance: float) -> Run:
        if tolerance not in self.runs:
            self.counts.clear()
            begin = time.perf_counter()
            y, steps, rejected, is_successful = self.counting(
                self.problem.y0, jnp.asarray(tolerance)
            )
            jax.block_until_ready(y)
            jax.effects_barrier()
            seconds = time.perf_counter() - begin
            with np.errstate(all="ignore"):
                error = np.linalg.norm(np.asarray(y) - self.reference)
            error = float(error / np.linalg.norm(self.reference))
            error = error if is_successful and math.isfinite(error) else math.inf
            # Of power iterations the derivative counts too.
            count = self.counts["field"] + (30 + int(steps)) * self.estimates
            self.runs[tolerance] = Run(tolerance, error, int(steps), int(rejected), count, seconds)
        return self.runs[tolerance]

    def to(self, target: float, cap: float) -> Run | None:
        """The run with at most this error and the fewest evaluations, if there is one."""
        tolerances = [LARGEST * 10 ** (-k / 2) for k in range(17)]
        begin = time.perf_counter()
        for tolerance in tolerances:
            if any(run.error <= target / 4 for run in self.runs.values()):
                break
            if time.perf_counter() - begin > cap:
                break
            self.run(results.digits(tolerance))
        for _ in range(3):
            met = [run for run in self.runs.values() if run.error <= target]
            if not met:
                return None
            best = min(met, key=lambda run: run.evaluations)
            looser = [t for t, run in self.runs.items() if t > best.tolerance]
            if best.error > 0.85 * target or not looser:
                break
            self.run(results.digits(math.sqrt(best.tolerance * min(looser))))
        met = [run for run in self.runs.values() if run.error <= target]
        return min(met, key=lambda run: run.evaluations)

    def timed(self, tolerance: float) -> Callable[[], Any]:
        if self.executable is None:
            self.executable = self._compiled(counts=False)
        argument = jnp.asarray(tolerance)
        return lambda: self.executable(self.problem.y0, argument)


def programs(problem: Problem) -> dict[str, Program]:
    """In the order of the tables."""
    reference, term = problem.reference(), cfjax.LieTerm(problem.field)
    radius = problem.radius
    pairs: dict[str, tuple[Any, Any]] = {
        "RKL2": (term, cfjax.RKL2(spectral_radius=radius)),
        "RKL2, radius estimated": (term, cfjax.RKL2()),
        "RKL3": (term, cfjax.RKL3(spectral_radius=radius)),
    }
    space = diffrax.ODETerm(problem.velocity) if problem.velocity else None
    peers: dict[str, tuple[Any, Any]] = {
        "CF43": (term, cfjax.CF43()),
        "Luscher3": (term, cfjax.Luscher3()),
        "Tsit5": (space, diffrax.Tsit5()),
        "Kvaerno5": (space, diffrax.Kvaerno5()),
    }
    if problem.semilinear:
        peers["ETD54"] = (cfjax.LieTerm(problem.semilinear), cfjax.ETD54())
    pairs |= {name: peers[name] for name in problem.peers}
    return {name: Program(problem, *pair, reference) for name, pair in pairs.items()}


# Measurements.


def measure(quick: bool) -> Iterator[results.Row]:
    yield from stability(quick)
    for name, make in PROBLEMS.items():
        if not quick or name == "heat, 24 x 24":
            yield from of_problem(name, make(), *(5.0, 1.0) if quick else (60.0, 4.0))
            jax.clear_caches()


def of_problem(name: str, problem: Problem, cap: float, budget: float) -> Iterator[results.Row]:
    """Searches of up to `cap` seconds, and times in `budget` seconds for each error, if any."""
    compiled = programs(problem)
    # First of all, as a run for a small error may be the best for a larger one.
    for target, program in itertools.product(problem.targets, compiled.values()):
        program.to(target, cap)
    for target in problem.targets:
        yield from _to_target(name, compiled, target, cap, budget)


def _to_target(
    name: str, compiled: dict[str, Program], target: float, cap: float, budget: float
) -> Iterator[results.Row]:
    chosen = {program: p.to(target, cap) for program, p in compiled.items()}
    met = {program: run for program, run in chosen.items() if run is not None}
    seconds, over = _timed(compiled, met, budget) if budget else ({}, {})
    for program in compiled:
        package = "diffrax" if program in ("Tsit5", "Kvaerno5") else "cfjax"
        version = importlib.metadata.version(package)
        row = {"problem": name, "program": program, "package": f"{package} {version}", "to": target}
        if program not in met:
            yield row
            continue
        run = met[program]
        # None where there is none, so that all rows have the same entries.
        evaluations: dict[str, Any] = {f"evaluations over {base}": None for base in BASES}
        for base in (b for b in BASES if b in met and b not in (program, "Kvaerno5")):
            ratio = run.evaluations / met[base].evaluations
            evaluations[f"evaluations over {base}"] = results.digits(ratio)
        yield row | {
            "tolerance": run.tolerance,
            "error": results.digits(run.error),
            "steps": run.steps,
            "rejected": run.rejected,
            # Those of an implicit method are not all of its work.
            "evaluations": None if program == "Kvaerno5" else run.evaluations,
            "seconds": results.spread(seconds[program]) if program in seconds else None,
            **evaluations,
            **{f"over {base}": over.get((program, base)) for base in BASES},
        }


def _timed(
    compiled: dict[str, Program], met: dict[str, Run], budget: float
) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], list[float]]]:
    """The times of each program, and the ratios of one over another, of those in the same turns."""
    # In the turns of a slow one the others would have few: it has some of its own, beside ours.
    slow = [name for name, run in met.items() if name == "Kvaerno5" or run.evaluations > 10_000]
    turns = [[name for name in met if name not in slow]]
    turns += [[*(name for name in ("RKL2", "RKL3") if name in met), name] for name in slow]
    seconds: dict[str, np.ndarray] = {}
    over: dict[tuple[str, str], list[float]] = {}
    for names in turns:
        timed = [compiled[name].timed(met[name].tolerance) for name in names]
        # The first of a turn would pay for cold caches: it runs before.
        spent = take_turns([timed[0], *timed], repeats=200, budget=budget)[1:]
        both = dict(zip(names, spent, strict=True))
        for name, base in itertools.permutations(names, 2):
            over.setdefault((name, base), results.ratios(both[name], both[base]))
        seconds = both | seconds
    return seconds, over


def stability(quick: bool) -> Iterator[results.Row]:
    """The longest stable step times the radius, of a lattice of 8 x 8 spins that is nearly aligned.

    A step is stable if 30 of it leave the distance from a uniform state below three times what it
    was. The result is the last of the steps before the first that is not.
    """
    up = np.zeros((8, 8, 3)) + np.array([0.0, 0.0, 1.0])
    start = up + 1e-4 * np.random.default_rng(0).normal(size=up.shape)
    start = jnp.asarray(start / np.linalg.norm(start, axis=-1, keepdims=True))
    lengths = np.geomspace(1, 100, 31 if quick else 121)

    def spread(s: Any) -> Any:
        return jnp.linalg.norm(s - jnp.mean(s, axis=(0, 1)))

    for frame in FRAMES:

        def field(t: Any, s: Any, damping: Any, frame: str = frame) -> cfjax.Rotation:
            b = sum(jnp.roll(s, shift, axis) for shift in (1, -1) for axis in (0, 1))
            omega = (b + damping * jnp.cross(s, b)) / (1 + damping**2)
            if frame == "horizontal":
                omega = jnp.cross(s, jnp.cross(omega, s))
            return cfjax.Rotation(omega)

        for method in (cfjax.RKL2, cfjax.RKG2, cfjax.RKL3):

            def growth(z: Any, damping: Any, method: Any = method, field: Any = field) -> Any:
                # Rates (damping + i) / (1 + damping^2) times up to 8.
                radius = 8 / jnp.sqrt(1 + damping**2)
                # With the safety that an estimated radius has.
                solver, t1 = method(spectral_radius=1.1 * radius), 30 * z / radius
                term = cfjax.LieTerm(field)
                y = cfjax.integrate(term, solver, 0.0, t1, start, damping, num_steps=30).ys
                assert y is not None
                return spread(y[-1]) / spread(start)

            program = jax.jit(jax.vmap(growth, in_axes=(0, None)))
            for damping in DAMPINGS[:: 4 if quick else 1]:
                grown = np.asarray(program(jnp.asarray(lengths), jnp.asarray(damping)))
                is_stable = grown < 3
                first = np.argmin(is_stable) if not is_stable.all() else len(lengths)
                yield {
                    "frame": frame,
                    "method": method.__name__,
                    "damping": damping,
                    "stable to": results.digits(lengths[first - 1]) if first else None,
                }


# Pictures.

STYLES: dict[str, tuple[str, str]] = {
    "RKL2": ("#0072B2", "o"),
    "RKL2, radius estimated": ("#56B4E9", "s"),
    "RKL3": ("#D55E00", "^"),
    "CF43": ("#999999", "D"),
    "Luscher3": ("#CC79A7", "v"),
    "ETD54": ("#E69F00", "P"),
    "Kvaerno5": ("#009E73", "X"),
    "Tsit5": ("#000000", "+"),
}
NAMES = {"Tsit5": "diffrax, Tsit5", "Kvaerno5": "diffrax, Kvaerno5"}


def draw() -> dict[str, Figure]:
    rows = results.load("stabilised")["rows"]
    return {"stabilised": _work(rows), "stabilised_frames": _frames(rows)}


def _work(rows: list[results.Row]) -> Figure:
    rows = [row for row in rows if row.get("evaluations")]
    named: set[str] = set()
    problems = [name for name in PROBLEMS if results.pick(rows, problem=name)]
    num_rows = -(-len(problems) // 3)
    figure = _style.new_figure((12, 3.2 * num_rows))
    panels = dict(zip(problems, figure.subplots(num_rows, 3).flat, strict=False))
    for axes in figure.axes[len(problems) :]:
        axes.remove()
    for problem, axes in panels.items():
        for program, (color, marker) in STYLES.items():
            curve = results.pick(rows, problem=problem, program=program)
            is_first = program not in named
            if curve:
                named.add(program)
                axes.plot(
                    [row["evaluations"] for row in curve],
                    [row["error"] for row in curve],
                    color=color,
                    marker=marker,
                    markersize=5,
                    linewidth=1,
                    label=NAMES.get(program, program) if is_first else None,
                )
        axes.set(title=problem, yscale="log")
        _style.logarithmic(axes, "evaluations of the field")
        axes.title.set_fontsize(10)
    for axes in figure.axes[::3]:
        axes.set(ylabel="relative error at the end")
    _style.finish(figure, columns=4)
    return figure


def _frames(rows: list[results.Row]) -> Figure:
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    for axes, frame in zip(figure.subplots(1, 2, sharey=True), FRAMES, strict=True):
        _frame(axes, frame, rows)
    figure.axes[0].set(ylabel="longest stable step, times the spectral radius")
    return figure


def _frame(axes: Axes, frame: str, rows: list[results.Row]) -> None:
    for method, color in (("RKL2", "#0072B2"), ("RKG2", "#009E73"), ("RKL3", "#D55E00")):
        curve = results.pick(rows, frame=frame, method=method)
        x, y = [row["damping"] for row in curve], [row["stable to"] for row in curve]
        axes.loglog(x, y, "o-", color=color, markersize=4, linewidth=1, label=method)
    title = "the field of docs/state/spins.md" if frame == FRAMES[0] else "its part across the spin"
    axes.set(title=title, xlabel="damping", ylim=(0.9, 110))
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8)


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
