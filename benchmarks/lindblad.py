"""Density matrices: time to an error, compared with diffrax in plain space and dynamiqs.

- qubit: driven at its frequency, with decay and dephasing.
- thermal oscillator: 24 levels, driven, in a bath.
- transmon and cavity: 3 and 10 levels in the laboratory frame, whose energies are large, a slow
  pulse that brings the first nearer to the second, and losses of both.
- photons in threes: 32 levels that lose three photons at a time, `a^3 - 1.2^3`, and single ones.
- Dicke ladder: 33 levels of 32 atoms that decay together while they are driven.

Each method takes equal steps, those of dynamiqs a tolerance, found by trial: the largest for which
the error at the end, the largest entry of the difference from a reference, is below the goal. The
reference is diffrax's Dopri8 with a tolerance of 1e-13, and a row has the distance of Kraus4 with
many steps from it. All programs of a problem take turns. A row also has the smallest eigenvalue of
the end and how far its trace is from one.

dynamiqs stores operators by diagonals (`dia`) where there are more than 4 levels, and its matrices
densely otherwise. In plain space the right-hand side is `Y + Y^H`, and jumps are dense.
"""

import functools
import importlib
import importlib.metadata
import importlib.util
import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

import cfjax
import results

GOALS = (1e-5, 1e-6)
# A method that takes longer, in seconds, is left out.
LONGEST = 20.0


class Problem(NamedTuple):
    """`constant + drive(t) driven` is the Hamiltonian, and `finest` has many steps of Kraus4."""

    t1: float
    rho0: Complex[np.ndarray, "n n"]
    constant: Complex[np.ndarray, "n n"]
    driven: Complex[np.ndarray, "n n"]
    drive: Callable[[Any], Any]
    jumps: list[Float[np.ndarray, "n n"]]
    rates: list[float]
    finest: int
    # The methods of cfjax, with a first guess of the steps.
    methods: dict[str, int]
    goals: tuple[float, ...] = GOALS


def lowering(n: int) -> Float[np.ndarray, "n n"]:
    return np.diag(np.sqrt(np.arange(1.0, n)), 1)


def pure(n: int, level: int) -> Complex[np.ndarray, "n n"]:
    rho = np.zeros((n, n), complex)
    rho[level, level] = 1
    return rho


def coherent(n: int, alpha: float) -> Complex[np.ndarray, "n n"]:
    k = np.arange(n)
    psi = alpha**k / np.sqrt([float(math.factorial(j)) for j in k])
    psi = psi / np.linalg.norm(psi)
    return np.outer(psi, psi).astype(complex)


def qubit() -> Problem:
    a = lowering(2)
    return Problem(
        t1=10.0,
        rho0=pure(2, 0),
        constant=np.diag([0.0, 5.0]) + 0j,
        driven=a + a.T + 0j,
        drive=lambda t: 0.5 * jnp.cos(5.0 * t),
        jumps=[a, np.diag([1.0, -1.0])],
        rates=[0.1, 0.05],
        finest=4000,
        methods={"Magnus4": 100, "Magnus6": 50, "CF4": 100, "Kraus4": 100},
    )


def thermal() -> Problem:
    n, loss, bath = 24, 0.3, 0.5
    a = lowering(n)
    return Problem(
        t1=6.0,
        rho0=coherent(n, 1.0),
        constant=a.T @ a + 0j,
        driven=a + a.T + 0j,
        drive=lambda t: 0.5 * jnp.cos(t),
        jumps=[a, a.T],
        rates=[loss * (bath + 1), loss * bath],
        finest=2000,
        methods={"Magnus4": 20, "CF4": 30, "Kraus4": 50},
    )


def transmon() -> Problem:
    levels, photons = 3, 10
    a, b = lowering(photons), lowering(levels)
    a, b = np.kron(np.eye(levels), a), np.kron(b, np.eye(photons))
    unit = 2 * np.pi  # GHz to radians per nanosecond
    anharmonicity = -0.3 * unit / 2 * b.T @ b.T @ b @ b
    coupling = 0.05 * unit * (a + a.T) @ (b + b.T)
    constant = 5.0 * unit * b.T @ b + 4.5 * unit * a.T @ a + anharmonicity + coupling
    t1 = 20.0
    start = np.kron(pure(levels, 1), coherent(photons, 1.0))
    return Problem(
        t1=t1,
        rho0=start,
        constant=constant + 0j,
        driven=-0.4 * unit * b.T @ b + 0j,
        drive=lambda t: jnp.sin(np.pi * t / t1) ** 2,
        jumps=[a, b],
        rates=[0.01, 0.02],
        finest=3000,
        methods={"Magnus4": 100, "CF4": 100, "Kraus4": 200},
    )


def three_photons(n: int = 32) -> Problem:
    a = lowering(n)
    return Problem(
        t1=1.0,
        rho0=pure(n, 0),
        constant=0j * a,
        driven=a + a.T + 0j,
        drive=lambda t: 0.5 * jnp.cos(2 * t),
        jumps=[a @ a @ a - 1.2**3 * np.eye(n), a],
        rates=[1.0, 0.1],
        finest=3000,
        methods={"Kraus4": 50},
        goals=(1e-4, *GOALS),
    )


def dicke(atoms: int = 32) -> Problem:
    spin = atoms / 2
    m = spin - np.arange(atoms + 1)
    lower = np.diag(np.sqrt(spin * (spin + 1) - m[:-1] * (m[:-1] - 1)), -1)
    return Problem(
        t1=1.0,
        rho0=pure(atoms + 1, 0),
        constant=np.diag(m) + 0j,
        driven=(lower + lower.T) / 2 + 0j,
        drive=lambda t: 2.0 * jnp.cos(t),
        jumps=[lower],
        rates=[1 / spin],
        finest=3000,
        methods={"Kraus4": 50, "Magnus4": 20, "CF4": 20},
    )


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "qubit": qubit,
    "thermal oscillator": thermal,
    "transmon and cavity": transmon,
    "photons in threes": three_photons,
    "Dicke ladder": dicke,
}
OTHERS = {
    "diffrax, Tsit5": 200,
    "diffrax, Dopri8": 100,
    "dynamiqs, Tsit5": 1e-6,
    "dynamiqs, Dopri8": 1e-6,
    "dynamiqs, Rouchon3": 1e-4,
}

Program = Callable[[Any], Complex[Array, "n n"]]


def by_cfjax(problem: Problem, method: str, num_steps: int) -> Program:
    def final_state(rho0):
        def field(t, rho, args):
            h = problem.constant + problem.drive(t) * problem.driven
            return cfjax.Lindblad(h, problem.jumps, problem.rates)

        term, solver = cfjax.LieTerm(field), getattr(cfjax, method)()
        sol = cfjax.integrate(term, solver, 0.0, problem.t1, rho0, num_steps=num_steps)
        return jnp.asarray(sol.ys)[-1]

    return final_state


def velocity(problem: Problem, t: Any, rho: Any) -> Any:
    losses = sum(
        rate * a.conj().T @ a for rate, a in zip(problem.rates, problem.jumps, strict=True)
    )
    h = problem.constant + problem.drive(t) * problem.driven
    y = (-1j * h - losses / 2) @ rho
    for rate, a in zip(problem.rates, problem.jumps, strict=True):
        y += rate / 2 * a @ rho @ a.conj().T
    return y + y.conj().T


def by_diffrax(problem: Problem, method: str, num_steps: int) -> Program:
    def final_state(rho0):
        term = diffrax.ODETerm(lambda t, rho, args: velocity(problem, t, rho))
        solver, step = getattr(diffrax, method)(), problem.t1 / num_steps
        sol = diffrax.diffeqsolve(term, solver, 0.0, problem.t1, step, rho0, max_steps=None)
        return jnp.asarray(sol.ys)[-1]

    return final_state


def by_dynamiqs(problem: Problem, method: str, tolerance: float) -> Program:
    dq = importlib.import_module("dynamiqs")
    dq.set_precision("double")
    dq.set_progress_meter(False)
    layout = dq.dense if len(problem.rho0) <= 4 else dq.dia
    constant, driven = (dq.asqarray(x, layout=layout) for x in (problem.constant, problem.driven))
    jumps = [
        dq.asqarray(np.sqrt(rate) * a, layout=layout)
        for rate, a in zip(problem.rates, problem.jumps, strict=True)
    ]

    def final_state(rho0):
        h = constant + dq.modulated(problem.drive, driven)
        solver = getattr(dq.method, method)(rtol=tolerance, atol=tolerance, max_steps=1_000_000)
        times = jnp.array([0.0, problem.t1])
        return dq.mesolve(h, jumps, dq.asqarray(rho0), times, method=solver).final_state.to_jax()

    return final_state


PACKAGES = {"cfjax": by_cfjax, "diffrax": by_diffrax, "dynamiqs": by_dynamiqs}


@functools.cache
def reference(name: str) -> tuple[np.ndarray, float]:
    """The end, by Dopri8 in control, and how far that of Kraus4 with many steps is from it."""
    problem = PROBLEMS[name]()
    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, rho, args: velocity(problem, t, rho)),
        diffrax.Dopri8(),
        0.0,
        problem.t1,
        None,
        jnp.asarray(problem.rho0),
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-13),
        max_steps=None,
    )
    exact = np.asarray(sol.ys)[-1]
    other = jax.jit(by_cfjax(problem, "Kraus4", problem.finest))(jnp.asarray(problem.rho0))
    return exact, float(np.abs(np.asarray(other) - exact).max())


class Run(NamedTuple):
    program: Callable[[], Any]
    setting: float
    error: float
    end: np.ndarray


def fitted(name: str, method: str, guess: float, goal: float) -> Run | None:
    """The cheapest run below the goal; None if it has none, or takes too long."""
    problem, (exact, _) = PROBLEMS[name](), reference(name)
    package, kind = method.split(", ")
    is_tolerance = package == "dynamiqs"

    def run(setting: float) -> Run:
        program = PACKAGES[package](problem, kind, setting)
        compiled = results.compiled(program, jnp.asarray(problem.rho0))
        begin = time.perf_counter()
        end = np.asarray(compiled())
        if time.perf_counter() - begin > LONGEST:
            raise TimeoutError
        error = float(np.nan_to_num(np.abs(end - exact).max(), nan=np.inf))
        return Run(compiled, setting, error, end)

    # The error is some power of the setting; the slope follows from two runs.
    runs = [run(guess)]
    slope = 1.0 if is_tolerance else -4.0
    for _ in range(6):
        met = [r for r in runs if r.error <= goal]
        if met and max(r.error for r in met) > 0.6 * goal:
            break
        last = min(runs, key=lambda r: abs(math.log(max(r.error, 1e-300) / goal)))
        if len(runs) > 1 and all(math.isfinite(r.error) for r in runs[-2:]):
            a, b = runs[-2:]
            if a.setting != b.setting and a.error != b.error:
                new = math.log(a.error / b.error) / math.log(a.setting / b.setting)
                slope = new if 0.2 < abs(new) < 12 and new * slope > 0 else slope
        factor = (0.8 * goal / last.error) ** (1 / slope) if math.isfinite(last.error) else 3.0
        bounds = (1 / 30, 30.0) if is_tolerance else (1 / 6, 6.0)
        setting = last.setting * min(max(factor, bounds[0]), bounds[1])
        setting = float(f"{setting:.2g}") if is_tolerance else math.ceil(setting)
        if (setting < 1 and not is_tolerance) or setting in [r.setting for r in runs]:
            break
        if is_tolerance and not 1e-14 < setting < 1:
            break
        runs.append(run(setting))
    met = [r for r in runs if r.error <= goal]
    if not met:
        return None
    return max(met, key=lambda r: r.setting if is_tolerance else -r.setting)


def measure(quick: bool) -> Iterator[results.Row]:
    has_dynamiqs = importlib.util.find_spec("dynamiqs") is not None
    names = ["diffrax", *["dynamiqs"] * has_dynamiqs]
    versions = (f"{name} {importlib.metadata.version(name)}" for name in names)
    yield {"others": ", ".join(versions)}
    for name, make in [*PROBLEMS.items()][: 1 if quick else None]:
        problem = make()
        yield {"problem": name, "Kraus4 less Dopri8": results.digits(reference(name)[1])}
        guesses: dict[str, float] = {f"cfjax, {k}": n for k, n in problem.methods.items()}
        guesses |= {k: x for k, x in OTHERS.items() if has_dynamiqs or "dynamiqs" not in k}
        for goal in problem.goals:
            runs: dict[str, Run] = {}
            for method, guess in guesses.items():
                try:
                    found = fitted(name, method, guess, goal)
                except TimeoutError:
                    continue
                if found is not None:
                    runs[method], guesses[method] = found, found.setting
            programs = {method: r.program for method, r in runs.items()}
            times = results.in_turns(programs, repeats=5 if quick else 9, budget=30)
            others = [m for m in runs if not m.startswith("cfjax") and "Rouchon" not in m]
            best = min(others, key=lambda m: np.median(times[m]))
            for method, r in runs.items():
                yield {
                    "problem": name,
                    "goal": goal,
                    "method": method,
                    "steps or tolerance": r.setting,
                    "error": results.digits(r.error),
                    "least eigenvalue": results.digits(np.linalg.eigvalsh(r.end).min()),
                    "trace less one": results.digits(abs(np.trace(r.end) - 1)),
                    "seconds": results.spread(times[method]),
                    "over best of others": results.spread(times[method] / times[best]),
                    "over Rouchon3": results.spread(times[method] / times["dynamiqs, Rouchon3"])
                    if "dynamiqs, Rouchon3" in times
                    else None,
                }


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
