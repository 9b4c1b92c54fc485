"""Quantum systems: time to an error, compared with diffrax in plain space, dynamiqs and QuTiP.

- transmon: propagators of four levels under pulses of 8 ns, with a carrier of 5 GHz, as in
  `cfjax.scenes.transmon`; one pulse, and a batch.
- two transmons: the propagator of three levels each, at 6 and 5 GHz with anharmonicities of -300
  MHz and a coupling `g (a + a^T) (b + b^T)` of g = 20 MHz, nothing averaged. A flux pulse of 40 ns
  lowers the first by 700 MHz and back, as sin^2: a controlled phase. The constant part is large and
  the drive slow. Energies are counted from the middle, for the sake of methods in plain space.
- annealing: the state of 12 spins, as in `cfjax.scenes.annealing`. No part is constant.

Each method takes the steps, or the tolerance, for which its error at the end is the goal: the root
mean square, over a batch, of the largest entry of a propagator, or of the length of a state. These
numbers were found by trial, for the transmon on a batch, and the error is measured again. If an
error goes up and down with the number of steps, as it does if the steps are in time with the beat
of two levels, it is below the goal for all larger numbers too. `frame` is the frame in which the
levels of the constant part rest, put in by hand; Magnus methods take more steps in this frame, and
are not run in it. The reference is Magnus10 with many steps; a row has the distance of SciPy's
DOP853 from it. All programs take turns. QuTiP takes one system at a time. Left out are packages
that are not installed; Dopri5 and implicit methods of dynamiqs, its Tsit5 on annealing, and all
methods of QuTiP but vern9, which was the fastest; and, in the large batch and for the smaller
error, methods that take over three times as long as the best of their package.
"""

import functools
import importlib
import importlib.metadata
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sparse
from jaxtyping import Array, Complex, Float

import cfjax
import on_host
import results
from cfjax.scenes import annealing, transmon

LEVELS, SPINS = 4, 12
GOALS = (1e-6, 1e-9)
# Modules of the optional packages.
PEERS = {"dynamiqs": "dynamiqs", "QuTiP": "qutip"}
# Methods that run in a batch, and the goals for which they do not.
BATCHED = {
    "cfjax, Magnus4": (1e-9,),
    "cfjax, Magnus6": (),
    "cfjax, Magnus8": (),
    "diffrax, Dopri8": (1e-9,),
    "diffrax, Tsit5, frame": (),
    "diffrax, Dopri8, frame": (),
    "dynamiqs, Dopri8": (),
    "dynamiqs, Dopri8, frame": (),
}

# The end of one system: of its numbers, and of how fine.
Program = Callable[[Any, Any], Any]
Matrix = Complex[Array | np.ndarray, "n n"]


class Problem(NamedTuple):
    """`i y' = (sum_k coefficients(t, args, np)[k] parts()[k]) y` from 0 to t1.

    `coefficients` takes numpy or jax.numpy; one that is an `int` is constant. `systems` makes the
    `args` of so many systems, which take turns `repeats` times, or `quick`. `best` is how many
    steps the reference takes, and `sizes` has steps or tolerances for the goals. Elsewhere, as in a
    frame, the Hamiltonian is `matrix(t, args)`, and `leave` brings the end back.
    """

    t1: float
    y0: Complex[np.ndarray, "n *columns"]
    operators: Callable[[], list[Any]]
    coefficients: Callable[[Any, Any, Any], list[Any]]
    field: Callable[[Any, Any, Any], Any]
    velocity: Callable[[Any, Any, Any], Any]
    systems: Callable[[int], Float[np.ndarray, "systems k"]]
    repeats: dict[int, int]
    quick: dict[int, int]
    best: int
    sizes: dict[str, tuple[Any, ...]]
    matrix: Callable[[Any, Any], Matrix] | None = None
    leave: Callable[[Any], Any] = lambda y: y


def pulses(number: int) -> Float[np.ndarray, "systems 2"]:
    """Stronger and weaker ones, with quadratures of both signs."""
    best = transmon.corrected()
    factor = np.random.default_rng(0).uniform([0.7, -1.0], [1.3, 1.0], size=(number, 2))
    return factor * np.concatenate([best.in_phase, best.quadrature])


def levels() -> list[Matrix]:
    n, pulse = np.arange(LEVELS), transmon.plain()
    energies = pulse.frequency * n + pulse.anharmonicity * n * (n - 1) / 2
    lower = np.diag(np.sqrt(n[1:]), 1)
    return [np.diag(energies) + 0j, lower + lower.T + 0j]


def drive(t: Any, args: Any, xp: Any) -> list[Any]:
    pulse = transmon.plain()
    angle, phase = 2 * np.pi / pulse.duration * t, pulse.frequency * t
    i_amplitude, q_amplitude = args[0] * (1 - xp.cos(angle)), args[1] * xp.sin(angle)
    return [1, i_amplitude * xp.cos(phase) + q_amplitude * xp.sin(phase)]


@functools.cache
def pair() -> list[Matrix]:
    """The constant part of two transmons, and the number operator of the first; rad/ns."""
    n = np.arange(3)
    hop = np.diag(np.sqrt(n[1:]), 1) + np.diag(np.sqrt(n[1:]), -1)
    energies_of_each = (2 * np.pi * (f * n - 0.3 * n * (n - 1) / 2) for f in (6.0, 5.0))
    energies = np.add.outer(*energies_of_each).ravel()
    energies = energies - (energies.max() + energies.min()) / 2
    constant = np.diag(energies) + 2 * np.pi * 0.02 * np.kron(hop, hop)
    return [constant + 0j, np.kron(np.diag(n), np.eye(3)) + 0j]


def flux(t: Any, args: Any, xp: Any) -> list[Any]:
    return [1, -args[0] * xp.sin(np.pi * t / 40) ** 2]


def pair_hamiltonian(t: Any, args: Any) -> Matrix:
    constant, number = pair()
    return constant + flux(t, args, jnp)[1] * number


def spins() -> list[Any]:
    flip = sparse.csr_array([[0.0, 1.0], [1.0, 0.0]])
    sides = [(sparse.eye_array(2**j), sparse.eye_array(2 ** (SPINS - 1 - j))) for j in range(SPINS)]
    flips = sum(sparse.kron(sparse.kron(left, flip), right) for left, right in sides)
    diagonal = sparse.diags_array(annealing.couplings(SPINS))
    return [sparse.csr_array(-part + 0j) for part in (flips, diagonal)]


def ramp(t: Any, args: Any, xp: Any) -> list[Any]:
    s = xp.sin(np.pi / 2 * t / args[0]) ** 2
    return [1 - s, s]


PROBLEMS = {
    "transmon": Problem(
        t1=transmon.plain().duration,
        y0=transmon.y0(LEVELS),
        operators=levels,
        coefficients=drive,
        field=lambda t, y, args: transmon.field(t, y, transmon.Pulse(args[:1], args[1:])),
        velocity=lambda t, y, args: transmon.velocity(t, y, transmon.Pulse(args[:1], args[1:])),
        systems=pulses,
        repeats={1: 9, 1000: 2},
        quick={1: 2, 100: 1},
        best=1600,
        sizes={
            "cfjax, CF4": (2000, None),
            "cfjax, Magnus4": (600, 3400),
            "cfjax, Magnus6": (160, 600),
            "cfjax, Magnus8": (170, 407),
            "diffrax, Tsit5": (5800, None),
            "diffrax, Dopri8": (1010, 2190),
            "diffrax, Tsit5, frame": (545, 1740),
            "diffrax, Dopri8, frame": (220, 490),
            "dynamiqs, Tsit5": (2e-9, None),
            "dynamiqs, Dopri8": (4e-9, 8.9e-12),
            "dynamiqs, Dopri8, frame": (8.9e-8, 1.6e-10),
            "QuTiP, vern9": (1.9e-8, 1.8e-11),
        },
    ),
    "two transmons": Problem(
        t1=40.0,
        y0=np.eye(9, dtype=complex),
        operators=pair,
        coefficients=flux,
        field=lambda t, y, args: cfjax.LeftMatrix(-1j * pair_hamiltonian(t, args)),
        velocity=lambda t, y, args: -1j * (pair_hamiltonian(t, args) @ y),
        systems=lambda number: np.linspace(2 * np.pi * 0.7, 2 * np.pi * 0.5, number)[:, None],
        repeats={1: 7},
        quick={1: 2},
        best=4000,
        sizes={
            "cfjax, CF4": (465, 620),
            "cfjax, Magnus4": (445, 490),
            "cfjax, Magnus6": (230, 470),
            "cfjax, Magnus8": (230, 470),
            "diffrax, Tsit5": (28900, None),
            "diffrax, Dopri8": (4500, 9800),
            "diffrax, Tsit5, frame": (3062, 9950),
            "diffrax, Dopri8, frame": (1210, 2800),
            "dynamiqs, Tsit5": (3.3e-10, None),
            "dynamiqs, Dopri8": (6.4e-10, 1.2e-12),
            "dynamiqs, Dopri8, frame": (1.6e-8, 1.6e-11),
            "QuTiP, vern9": (2.5e-9, 2e-12),
        },
    ),
    "annealing": Problem(
        t1=annealing.t1,
        y0=annealing.y0(SPINS),
        operators=spins,
        coefficients=ramp,
        field=lambda t, y, args: annealing.field(t, y, args[0]),
        velocity=lambda t, y, args: annealing.velocity(t, y, args[0]),
        systems=lambda number: np.full((number, 1), annealing.t1),
        repeats={1: 4},
        quick={1: 1},
        best=200,
        sizes={
            "cfjax, CF4": (112, None),
            "cfjax, Magnus4": (72, 414),
            "cfjax, Magnus6": (23, 67),
            "cfjax, Magnus8": (21, 44),
            "diffrax, Tsit5": (1450, None),
            "diffrax, Dopri8": (289, 620),
            "dynamiqs, Dopri8": (7.8e-10, 1.8e-12),
            "QuTiP, vern9": (5e-9, 5e-12),
        },
    ),
}


def in_frame(problem: Problem) -> Problem:
    """The problem in the frame where the levels of the constant part are at rest."""
    constant, *driven = problem.operators()
    energies = np.real(np.diag(constant))
    coupling = constant - np.diag(energies)

    def matrix(t: Any, args: Any) -> Matrix:
        _, *coefficients = problem.coefficients(t, args, jnp)
        h = sum((c * part for c, part in zip(coefficients, driven, strict=True)), coupling)
        turn = jnp.exp(1j * t * energies)
        return turn[:, None] * h * turn.conj()

    return problem._replace(
        matrix=matrix,
        velocity=lambda t, y, args: -1j * (matrix(t, args) @ y),
        leave=lambda y: np.exp(-1j * problem.t1 * energies)[:, None] * y,
    )


def by_cfjax(problem: Problem, method: str) -> Program:
    def final_state(args, num_steps):
        term, solver = cfjax.LieTerm(problem.field), getattr(cfjax, method)()
        t1, y0 = problem.t1, problem.y0
        sol = cfjax.integrate(term, solver, 0.0, t1, y0, args, num_steps=num_steps)
        return jax.tree.map(lambda y: y[-1], sol.ys)

    return final_state


def by_diffrax(problem: Problem, method: str) -> Program:
    def final_state(args, num_steps):
        term, solver = diffrax.ODETerm(problem.velocity), getattr(diffrax, method)()
        t1, step, y0 = problem.t1, problem.t1 / num_steps, jnp.asarray(problem.y0)
        sol = diffrax.diffeqsolve(term, solver, 0.0, t1, step, y0, args, max_steps=None)
        return problem.leave(jax.tree.map(lambda y: y[-1], sol.ys))

    return final_state


def by_dynamiqs(problem: Problem, method: str) -> Program:
    """Operators are dense if they are of four levels, otherwise diagonals: whichever is faster."""
    dq = importlib.import_module("dynamiqs")
    dq.set_precision("double")
    dq.set_progress_meter(False)
    layout = dq.dense if len(problem.y0) == LEVELS else dq.dia
    hamiltonians = [h.toarray() if sparse.issparse(h) else h for h in problem.operators()]
    hamiltonians = [dq.asqarray(h, layout=layout) for h in hamiltonians]
    times = jnp.array([0.0, problem.t1])

    def hamiltonian(args: Any) -> Any:
        matrix = problem.matrix
        if matrix is not None:
            return dq.timecallable(lambda t: dq.asqarray(matrix(t, args)))

        def modulated(k: int, h: Any) -> Any:
            if isinstance(problem.coefficients(0.0, args, jnp)[k], int):
                return dq.constant(h)
            return dq.modulated(lambda t: problem.coefficients(t, args, jnp)[k], h)

        constant, *driven = (modulated(k, h) for k, h in enumerate(hamiltonians))
        return sum(driven, constant)

    def final_state(args, tolerance):
        h = hamiltonian(args)
        solver = getattr(dq.method, method)(rtol=tolerance, atol=tolerance, max_steps=1_000_000)
        if problem.y0.ndim == 1:
            psi0 = jnp.asarray(problem.y0)[:, None]
            return dq.sesolve(h, psi0, times, method=solver).final_state.to_jax()[:, 0]
        return problem.leave(dq.sepropagator(h, times, method=solver).final_propagator.to_jax())

    return final_state


def by_qutip(problem: Problem, method: str) -> Program:
    qutip = importlib.import_module("qutip")
    operators = [qutip.Qobj(h) for h in problem.operators()]

    def final_state(args, tolerance):
        def modulated(k: int, h: Any) -> Any:
            is_constant = isinstance(problem.coefficients(0.0, args, np)[k], int)
            return h if is_constant else [h, lambda t: problem.coefficients(t, args, np)[k]]

        hamiltonian = [modulated(k, h) for k, h in enumerate(operators)]
        options = dict(method=method, rtol=tolerance, atol=tolerance, nsteps=10**7)
        if problem.y0.ndim == 2:
            return qutip.propagator(hamiltonian, problem.t1, options=options).full()
        # Without this option QuTiP would normalise the state.
        options |= dict(normalize_output=False, progress_bar="")
        psi0, times = qutip.Qobj(problem.y0), [0.0, problem.t1]
        solution = qutip.sesolve(hamiltonian, psi0, times, options=options)
        return solution.final_state.full()[:, 0]

    return final_state


PACKAGES = {"cfjax": by_cfjax, "diffrax": by_diffrax, "dynamiqs": by_dynamiqs, "QuTiP": by_qutip}


class Run(NamedTuple):
    """A run of all systems; `ends` has the final states of the last call."""

    program: Callable[[], Any]
    ends: list[Any]

    def __call__(self) -> None:
        self.ends[:] = [jax.block_until_ready(self.program())]


def run_of(problem: Problem, name: str, size: Any, data: Any) -> Run:
    package, method, *frame = name.split(", ")
    final_state = PACKAGES[package](in_frame(problem) if frame else problem, method)
    if package == "QuTiP":
        return Run(lambda: np.stack([final_state(args, size) for args in data]), [])
    return Run(results.compiled(batched(lambda args: final_state(args, size)), data), [])


def batched(final_state: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A batch of one is not vectorised, which is faster."""
    return lambda data: jax.vmap(final_state)(data) if len(data) > 1 else final_state(data[0])[None]


def error(ends: Any, target: Any) -> float:
    distances = np.abs(np.asarray(ends) - target)
    errors = distances.max((1, 2)) if distances.ndim == 3 else np.linalg.norm(distances, axis=1)
    return float(np.sqrt(np.mean(errors**2)))


def off_norm(ends: Any) -> float:
    """The most by which the norm of a state changes."""
    columns = np.asarray(ends) if ends.ndim == 3 else np.asarray(ends)[..., None]
    return float(np.abs(np.linalg.svd(columns, compute_uv=False) - 1).max())


def by_scipy(problem: Problem, args: Any) -> Any:
    """By SciPy's DOP853 with a tolerance of 1e-13. The error is from 1e-11 to 1e-10."""
    operators = problem.operators()

    def rate(t, y):
        pairs = zip(problem.coefficients(t, args, np), operators, strict=True)
        return -1j * sum(c * (h @ y) for c, h in pairs)

    return on_host.solve(rate, problem.t1, problem.y0, rtol=1e-13, atol=1e-15)


def measure(quick: bool) -> Iterator[results.Row]:
    specs = {name: importlib.util.find_spec(module) for name, module in PEERS.items()}
    missing = {name for name, spec in specs.items() if spec is None}
    modules = {"diffrax": "diffrax", **PEERS}
    versions = {
        name: importlib.metadata.version(modules[name]) for name in modules if name not in missing
    }
    yield {"others": ", ".join(f"{name} {versions[name]}" for name in modules if name in versions)}
    for label, problem in PROBLEMS.items():
        reference = by_cfjax(problem, "Magnus10")
        best = jax.jit(batched(lambda args, solve=reference, n=problem.best: solve(args, n)))
        single_system = problem.systems(1)
        apart = error(best(single_system), by_scipy(problem, single_system[0])[None])
        yield {"problem": label, "DOP853 less Magnus10": results.digits(apart)}
        for number, repeats in (problem.quick if quick else problem.repeats).items():
            data = problem.systems(number)
            target = np.asarray(best(data))
            for k, goal in enumerate(GOALS):
                runs = {
                    name: run_of(problem, name, sizes[k], data)
                    for name, sizes in problem.sizes.items()
                    if sizes[k] is not None and name.partition(",")[0] not in missing
                    if number == 1 or goal not in BATCHED.get(name, GOALS)
                }
                times = results.in_turns(runs, repeats=repeats)
                peers = [name for name in runs if not name.startswith("cfjax")]
                fastest = min(peers, key=lambda name: np.median(times[name]))
                for name, seconds in times.items():
                    (ends,) = runs[name].ends
                    yield {
                        "problem": label,
                        "systems": number,
                        "goal": goal,
                        "method": name,
                        "steps or tolerance": problem.sizes[name][k],
                        "error": results.digits(error(ends, target)),
                        "off norm": results.digits(off_norm(ends)),
                        "seconds each": results.spread(seconds / number),
                        "over the fastest of others": results.ratios(seconds, times[fastest]),
                    }


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
