"""Error against time on stiff semilinear problems, for cfjax, exponax and diffrax.

For each program the number of equal steps, or the tolerance, that reaches relative errors of 1e-3,
1e-6 and 1e-9; the programs with which it is met then take turns. A program that would take too long
is left out, with the time limit. Besides, the orders that show between
two numbers of steps, what control of the steps costs and how far its errors are from the tolerance,
how the choice of M for a variable coefficient matters, and what exponax makes of dispersion.

Where exponax is not installed its rows are left out of the stored results: run
`pip install '.[peers]'` before `make benchmarks`.
"""

import importlib
import importlib.metadata
import importlib.util
import math
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import cfjax
import results
from cfjax._integrate import solve_steps
from cfjax._measure import style as _style
from cfjax._measure.work_precision import take_turns
from cfjax._solvers.solver import as_own
from cfjax._times import EqualTimes
from stiff_problems import OTHERS, PROBLEMS, Problem, heat_diagonalised

TARGETS = (1e-3, 1e-6, 1e-9)
TOLERANCES = (1e-4, 1e-6, 1e-8)
CONTROLLED = " controlled"
EQUAL = {
    name: getattr(cfjax, name)()
    for name in ("CF4", "CF43", "ETDRK4", "ETD43", "ETD54")
    if hasattr(cfjax, name)
}
ADAPTIVE = {name: EQUAL[name] for name in ("CF43", "ETD43", "ETD54") if name in EQUAL}
ORDERS = {name: EQUAL[name] for name in ("CF4", "ETDRK4", "ETD43", "ETD54") if name in EQUAL}
# Over these the others are measured.
BASES = ("CF4", "exponax", "Kvaerno5", "Tsit5")
# A dense Newton step of more unknowns takes seconds.
MOST_UNKNOWNS = 1000
MOST_STEPS = 2**17


class Run(NamedTuple):
    """The result of a setting, which is a number of steps or a tolerance."""

    setting: float
    error: float
    steps: int
    rejected: int
    seconds: float


class Program:
    """A method on a problem, compiled once for all settings."""

    def __init__(self, solve: Callable, problem: Problem, reference: np.ndarray, package: str):
        self.package, self.reference = package, reference
        self.scale = np.linalg.norm(reference + problem.lift)
        self.is_adaptive = solve.__name__ == "controlled"
        self.y0 = problem.y0
        self.executable = jax.jit(solve).lower(self.y0, self.array(1)).compile()
        self.runs: dict[float, Run] = {}
        self.has_failed = False

    def array(self, setting: float) -> Any:
        return jnp.asarray(setting, float if self.is_adaptive else jnp.int32)

    def timed(self, setting: float) -> Callable[[], Any]:
        argument = self.array(setting)
        return lambda: self.executable(self.y0, argument)

    def run(self, setting: float) -> Run:
        if setting not in self.runs:
            program, begin = self.timed(setting), time.perf_counter()
            values, steps, rejected, is_successful = jax.block_until_ready(program())
            seconds = time.perf_counter() - begin
            with np.errstate(all="ignore"):
                error = float(np.linalg.norm(np.asarray(values) - self.reference) / self.scale)
            # An overflow, or a run that failed, has an infinite error.
            error = error if is_successful and math.isfinite(error) else math.inf
            self.runs[setting] = Run(setting, error, int(steps), int(rejected), seconds)
        return self.runs[setting]

    def to(self, target: float, cap: float) -> Run | float:
        """The cheapest run with at most this error, or the seconds in which there was none."""
        search = self._tolerance if self.is_adaptive else self._count
        if self.has_failed:
            # It failed for a larger error.
            return cap
        begin = time.perf_counter()
        for setting in search(target):
            longest = max(self.runs.values(), key=lambda run: run.seconds, default=None)
            # The next run takes longer than the longest: by how much is a guess for tolerances.
            if longest is not None:
                growth = 2.0 if self.is_adaptive else setting / longest.steps
                if time.perf_counter() - begin + longest.seconds * growth > cap:
                    break
            self.run(setting)
        met = [run for run in self.runs.values() if run.error <= target]
        self.has_failed = not met
        return min(met, key=lambda run: run.steps) if met else cap

    def _count(self, target: float) -> Iterator[float]:
        """Numbers of steps: doubled until one meets the target, then between it and a miss."""
        n = 4
        while self.run(n).error > target and n < MOST_STEPS:
            n *= 2
            yield n
        if self.run(n).error > target:
            return
        while True:
            high = min(r.steps for r in self.runs.values() if r.error <= target)
            misses = [r.steps for r in self.runs.values() if r.error > target and r.steps < high]
            low = max(misses, default=1)
            if high <= max(low + 1, 1.04 * low) or self.runs[high].error > 0.85 * target:
                return
            # By the slope between both, if the larger error is in the range of convergence.
            middle = math.sqrt(low * high)
            if low in self.runs and self.runs[low].error < 0.1:
                few, many = self.runs[low].error, self.runs[high].error
                slope = math.log(high / low) / math.log(few / many)
                middle = low * (few / (0.95 * target)) ** slope
            yield min(max(math.ceil(middle), low + 1), high - 1)

    def _tolerance(self, target: float) -> Iterator[float]:
        tolerance = target
        for _ in range(6):
            yield tolerance
            error = self.run(tolerance).error
            if 0.5 * target < error <= target:
                return
            if error <= target and tolerance >= 30 * target:
                return
            factor = 0.8 * target / error if math.isfinite(error) and error > 0 else 0.1
            tolerance = results.digits(min(tolerance * min(max(factor, 0.02), 20), 30 * target))


def with_equal_steps(problem: Problem, solver: Any) -> Callable:
    term, solver = cfjax.LieTerm(problem.field), as_own(solver).without_estimate()
    t0, t1 = jnp.asarray(0.0), jnp.asarray(problem.t1)

    def solve(y0: Any, num_steps: Any) -> tuple:
        sol, _ = solve_steps(term, solver, EqualTimes(t0, t1, num_steps), y0, None)
        assert sol.ys is not None
        return problem.values(sol.ys[-1]), num_steps, 0, True

    return solve


def with_control(problem: Problem, term: Any, solver: Any, values: Any, max_steps: int) -> Callable:
    """The tolerance is relative to the root mean square of the start."""

    def controlled(y0: Any, tolerance: Any) -> tuple:
        y = values(y0)
        size = jnp.sqrt(jnp.mean(jnp.abs(y) ** 2))
        # For a start of zeros: the solution of that problem is about one.
        size = jnp.where(size > 0, size, 1.0)
        control = diffrax.PIDController(rtol=tolerance, atol=tolerance * size)
        sol = diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            problem.t1,
            problem.t1 / 1000,
            y,
            stepsize_controller=control,
            max_steps=max_steps,
            throw=False,
        )
        assert sol.ys is not None
        y1 = sol.ys[-1]
        is_successful = sol.result == diffrax.RESULTS.successful
        stats = sol.stats
        final_values = problem.values(y1) if jnp.iscomplexobj(y1) or values is _identity else y1
        return final_values, stats["num_steps"], stats["num_rejected_steps"], is_successful

    return controlled


def _identity(y: Any) -> Any:
    return y


def with_exponax(problem: Problem) -> Callable:
    # An import statement would be an error to pyright, where the peers are not installed.
    package, make = importlib.import_module("exponax"), problem.exponax
    assert make is not None

    def solve(y0: Any, num_steps: Any) -> tuple:
        # The coefficients of a step, before the loop.
        stepper = make(package, problem.t1 / num_steps)
        has_species = y0.ndim > 2
        c = y0 if has_species else y0[None]
        c1 = jax.lax.fori_loop(0, num_steps, lambda _, c: stepper.step_fourier(c), c)
        return problem.values(c1 if has_species else c1[0]), num_steps, 0, True

    return solve


def programs(problem: Problem, reference: np.ndarray) -> dict[str, Program]:
    """In the order of the tables."""
    term, space = cfjax.LieTerm(problem.field), diffrax.ODETerm(problem.velocity)
    solves = {name: ("cfjax", with_equal_steps(problem, s)) for name, s in EQUAL.items()}
    for name, solver in ADAPTIVE.items():
        solve = with_control(problem, term, solver, _identity, 100_000)
        solves[name + CONTROLLED] = ("cfjax", solve)
    if problem.exponax and importlib.util.find_spec("exponax"):
        solves["exponax"] = ("exponax", with_exponax(problem))
    if (unknowns := reference.size) <= MOST_UNKNOWNS:
        # A first run with all of these steps takes a minute at most.
        max_steps = 4000 if unknowns < 150 else 400
        solve = with_control(problem, space, diffrax.Kvaerno5(), problem.values, max_steps)
        solves["Kvaerno5"] = ("diffrax", solve)
    solve = with_control(problem, space, diffrax.Tsit5(), problem.values, 200_000)
    solves["Tsit5"] = ("diffrax", solve)
    return {
        n: Program(solve, problem, reference, package) for n, (package, solve) in solves.items()
    }


def measure(quick: bool) -> Iterator[results.Row]:
    # diffrax warns of complex coefficients: the errors of all runs are in the rows.
    warnings.filterwarnings("ignore", "Complex dtype support")
    for name, make in PROBLEMS.items():
        problem = make()
        reference = problem.reference()
        compiled = programs(problem, reference)
        for target in TARGETS[: 2 if quick else 3]:
            yield from _to_target(name, compiled, target, quick)
        yield from _orders(name, problem, compiled)
        yield from _tolerances(name, compiled)
        yield from _diffusivities(name, compiled)
        if name == "Korteweg-de Vries":
            yield from _dispersion(name, compiled)
    for name, make in OTHERS.items():
        problem = make()
        reference = problem.reference()
        compiled = {
            n: Program(with_equal_steps(problem, s), problem, reference, "cfjax")
            for n, s in ORDERS.items()
        }
        yield from _orders(name, problem, compiled)
        yield from _diffusivities(name, compiled)
    yield from _whole_operator()


def _to_target(
    name: str, compiled: dict[str, Program], target: float, quick: bool
) -> Iterator[results.Row]:
    cap, budget = (5.0, 1.0) if quick else (20.0, 4.0)
    chosen = {program: p.to(target, cap) for program, p in compiled.items()}
    met = {program: run for program, run in chosen.items() if isinstance(run, Run)}
    # In the turns of a slow one the others would have few: it has some of its own, beside a few.
    slow = [n for n, run in met.items() if run.seconds > 0.5 and n not in ORDERS]
    turns = [[n for n in met if n not in slow]]
    turns += [[*(m for m in ORDERS if m in met), n] for n in slow]
    times: dict[str, np.ndarray] = {}
    # None where there is none, so that all rows have the same entries.
    keys = [*(f"over {base}" for base in BASES), "step over an equal one"]
    over: dict[str, dict[str, Any]] = {n: dict.fromkeys(keys) for n in met}
    for names in turns:
        timed = [compiled[n].timed(met[n].setting) for n in names]
        # The first of a turn would pay for cold caches, after a slow one: it runs before.
        seconds = take_turns([timed[0], *timed], repeats=200, budget=budget)[1:]
        spent = dict(zip(names, seconds, strict=True))
        for n in names:
            for base in BASES:
                if base in spent and base != n and over[n][f"over {base}"] is None:
                    over[n][f"over {base}"] = results.ratios(spent[n], spent[base])
            equal = n.removesuffix(CONTROLLED)
            if equal != n and equal in spent:
                a_step, of_equal = (spent[m] / met[m].steps for m in (n, equal))
                over[n]["step over an equal one"] = results.ratios(a_step, of_equal)
            times.setdefault(n, spent[n])
    for program, p in compiled.items():
        version = importlib.metadata.version(p.package)
        row = {"problem": name, "program": program, "package": f"{p.package} {version}"}
        if program not in times:
            yield row | {"to": target, "not in seconds": cap}
            continue
        run = met[program]
        yield row | {
            "to": target,
            "tolerance": run.setting if p.is_adaptive else None,
            "steps": run.steps,
            "error": results.digits(run.error),
            "seconds": results.spread(times[program]),
            **over[program],
        }


def _orders(name: str, problem: Problem, compiled: dict[str, Program]) -> Iterator[results.Row]:
    few, many = problem.counts
    for program in ORDERS:
        errors = [compiled[program].run(n).error for n in (few, many)]
        finite = all(map(math.isfinite, errors))
        slope = math.log(errors[0] / errors[1]) / math.log(many / few) if finite else math.inf
        yield {
            "problem": name,
            "program": program,
            "few": few,
            "many": many,
            "error with few": results.digits(errors[0]),
            "error with many": results.digits(errors[1]),
            "slope": results.digits(slope),
        }


def _tolerances(name: str, compiled: dict[str, Program]) -> Iterator[results.Row]:
    for program, tolerance in ((n, t) for n in ADAPTIVE for t in TOLERANCES):
        run = compiled[program + CONTROLLED].run(tolerance)
        yield {
            "problem": name,
            "program": program,
            "controlled to": tolerance,
            "steps": run.steps,
            "rejected": run.rejected,
            "error over tolerance": results.digits(run.error / tolerance),
        }


def _dispersion(name: str, compiled: dict[str, Program]) -> Iterator[results.Row]:
    """Errors of exponax, whose coefficients are real, of the same method in cfjax, and others."""
    for program in ("exponax", "ETDRK4", "CF4", "ETD54"):
        for n in (1000, 2000, 4000, 8000):
            if program in compiled:
                error = results.digits(compiled[program].run(n).error)
                yield {"problem": name, "program": program, "dispersion, steps": n, "error": error}


def _diffusivities(name: str, compiled: dict[str, Program]) -> Iterator[results.Row]:
    """Errors of the heat problem, by how much of its diffusivity is in M."""
    if not name.startswith("heat, "):
        return
    for program in ORDERS:
        for n in (50, 100, 200, 400):
            error = results.digits(compiled[program].run(n).error)
            part = name.removeprefix("heat, ").removesuffix(" in M")
            yield {"in M": part, "program": program, "steps": n, "error": error}


def _whole_operator() -> Iterator[results.Row]:
    """The heat problem with all of its operator in M, which its eigenvectors make diagonal."""
    for n in (1, 10):
        problem = heat_diagonalised()
        solve = with_equal_steps(problem, cfjax.ETD54())
        program = Program(solve, problem, problem.reference(), "cfjax")
        error = results.digits(program.run(n).error)
        seconds = results.spread(take_turns([program.timed(n)], repeats=200, budget=1.0)[0])
        yield {"whole operator, steps": n, "error": error, "seconds a solve": seconds}


STYLES: dict[str, tuple[str, str]] = {
    "CF4": ("#0072B2", "o"),
    "CF43": ("#56B4E9", "s"),
    "ETDRK4": ("#999999", "D"),
    "ETD43": ("#CC79A7", "v"),
    "ETD54": ("#D55E00", "^"),
    "ETD54 controlled": ("#D55E00", "x"),
    "exponax": ("#E69F00", "P"),
    "Kvaerno5": ("#009E73", "X"),
    "Tsit5": ("#000000", "+"),
}
NAMES = {
    "exponax": "exponax, ETDRK4",
    "Kvaerno5": "diffrax, Kvaerno5",
    "Tsit5": "diffrax, Tsit5",
    "ETD54 controlled": "ETD54, adaptive steps",
}


def draw() -> dict[str, Figure]:
    rows = [row for row in results.load("stiff")["rows"] if "seconds" in row]
    figure = _style.new_figure((15, 10.5))
    panels = dict(zip(PROBLEMS, figure.subplots(3, 4).flat, strict=True))
    for problem, axes in panels.items():
        for program in STYLES:
            curve = results.pick(rows, problem=problem, program=program)
            # The fastest run, which other programs of the machine disturb least.
            _line(axes, program, [r["seconds"][0] for r in curve], [r["error"] for r in curve])
        axes.set(title=problem, yscale="log")
        _style.logarithmic(axes, "time", unit="s")
        axes.title.set_fontsize(10)
    # The first panel has them all in the legend, with or without a curve.
    for program in (name for name in STYLES if results.pick(rows, program=name)):
        _line(figure.axes[0], program, [], [], label=NAMES.get(program, program))
    for axes in figure.axes[::4]:
        axes.set(ylabel="relative error at the end")
    _style.finish(figure, columns=5)
    return {"stiff": figure}


def _line(axes: Axes, program: str, times: list, errors: list, label: str | None = None) -> None:
    color, marker = STYLES[program]
    dashes = "--" if program.endswith(CONTROLLED) else "-"
    style: dict[str, Any] = dict(color=color, marker=marker, linestyle=dashes, label=label)
    axes.plot(times, errors, markersize=5, linewidth=1, **style)


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
