"""Coordinates of a step on matrices: time over that of diffrax's Tsit5 in plain space.

`Projected`, and `RKMK5` and `RKMK8` in Cayley's coordinates, beside `CF4`, `CF54` and diffrax's
methods in plain space, for equal errors in the largest entry. All in turns, without error control
in equal steps, and in adaptive steps with `diffrax.PIDController(rtol=0)`. In equal steps the
number of steps for an error is interpolated between whole numbers, and the time of a step is that
of 60 of this length. Besides, the time to compile equal steps, the length of their programs, and
the time of a gradient over that of the solve.

The problems:

- SO(n), SU(n): `y' = (b + y c y^H) y` with random b and c, from the identity; many at once too.
- Sp(4): an orbit of Henon and Heiles, and the derivative of the flow as a symplectic matrix.
- Toda's flow of random symmetric matrices; Oja's of 5 columns of length 200.
- Vorticity on the sphere, as a matrix; the Wilson flow of the links of a lattice.
"""

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

import cfjax
import on_host
import results
from cfjax._integrate import solve_steps
from cfjax._measure.work_precision import take_turns
from cfjax._solvers.solver import as_own
from cfjax._times import EqualTimes
from cfjax.scenes import toda, wilson_flow, zeitlin

TARGETS = (1e-4, 1e-7, 1e-10)
# Steps that are timed, and most that are tried.
TIMED, MOST = 60, 1500
LIE = {
    "CF4": cfjax.CF4(),
    "CF54": cfjax.CF54(),
    "Projected, Tsit5": cfjax.Projected(diffrax.Tsit5()),
    "Projected, Dopri8": cfjax.Projected(diffrax.Dopri8()),
    "RKMK5, Cayley": cfjax.RKMK5(coordinates="cayley"),
    "RKMK8, Cayley": cfjax.RKMK8(coordinates="cayley"),
}
PLAIN = {"Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}
METHODS = tuple(PLAIN | LIE)
PROJECTED = ("Projected, Tsit5", "Projected, Dopri8")


class Problem(NamedTuple):
    field: Callable[[Any, Any, Any], Any]
    y0: Any
    args: Any
    t1: float
    exact: Any
    # Of a state, what is compared.
    of: Callable[[Any], np.ndarray] = np.asarray
    without: tuple[str, ...] = ()
    # Equal steps only, without a gradient.
    is_short: bool = False

    def error(self, y: Any) -> float:
        return float(np.abs(self.of(y) - self.exact).max())


# The problems.


def group(n: int, is_complex: bool = False, many: int = 0) -> Problem:
    rng = np.random.default_rng(n)

    def skew() -> np.ndarray:
        parts = rng.normal(size=(2, many or 1, n, n))
        a = parts[0] + 1j * parts[1] if is_complex else parts[0]
        a = a - np.swapaxes(a, -1, -2).conj()
        a = a - np.trace(a, axis1=1, axis2=2)[:, None, None] / n * np.eye(n)
        return 2 * a / np.linalg.norm(a, 2, (-2, -1))[:, None, None]

    def field(t: Any, y: Any, args: Any) -> Any:
        b, c = args
        return cfjax.LeftMatrix(b + y @ c @ jnp.conj(jnp.swapaxes(y, -1, -2)))

    b, c, t1 = skew(), skew(), 1.5
    exact, y0 = expm(t1 * b) @ expm(t1 * c), np.broadcast_to(np.eye(n, dtype=b.dtype), b.shape)
    if not many:
        b, c, exact, y0 = b[0], c[0], exact[0], y0[0]
    args = jnp.asarray(b), jnp.asarray(c)
    without = ("CF4",) if many else ()
    return Problem(field, y0, args, t1, exact, without=without, is_short=bool(many))


def henon_heiles() -> Problem:
    def velocity(xp: Any, x: Any) -> tuple[Any, Any]:
        q, p, one = x[:2], x[2:], np.eye(2)
        force = xp.stack([-q[0] - 2 * q[0] * q[1], -q[1] - q[0] ** 2 + q[1] ** 2])
        slopes = xp.stack([-1 - 2 * q[1], -2 * q[0], -2 * q[0], -1 + 2 * q[1]]).reshape(2, 2)
        rows = [xp.concatenate([0 * one, one], 1), xp.concatenate([slopes, 0 * one], 1)]
        return xp.concatenate([p, force]), xp.concatenate(rows)

    def field(t: Any, y: Any, args: Any) -> Any:
        rate, matrix = velocity(jnp, y["orbit"])
        return {"orbit": rate, "derivative": cfjax.LeftMatrix(matrix)}

    def plain(t: float, x: np.ndarray) -> np.ndarray:
        rate, matrix = velocity(np, x[:4])
        return np.concatenate([rate, (matrix @ x[4:].reshape(4, 4)).ravel()])

    def of(y: Any) -> np.ndarray:
        return np.concatenate([np.ravel(y["orbit"]), np.ravel(y["derivative"])])

    y0, t1 = {"orbit": np.array([0.1, 0.2, 0.3, -0.1]), "derivative": np.eye(4)}, 10.0
    exact = on_host.solve(plain, t1, of(y0))
    return Problem(field, y0, None, t1, exact, of, without=PROJECTED)


def lattice(n: int, many: int = 0) -> Problem:
    a = np.random.default_rng(n).normal(size=(many or 1, n, n))
    y0 = a + np.swapaxes(a, 1, 2)
    y0, t1 = y0 / np.linalg.norm(y0, 2, (1, 2))[:, None, None], 3.0
    exact = np.stack([toda.reference(t1, y) for y in y0])
    if not many:
        y0, exact = y0[0], exact[0]
    return Problem(
        lambda t, y, args: cfjax.Conjugation(jnp.triu(y, 1) - jnp.tril(y, -1)),
        *(y0, None, t1, exact),
        without=("CF4",) if many else (),
        is_short=bool(many),
    )


def oja(n: int = 200, p: int = 5) -> Problem:
    y0 = np.linalg.qr(np.random.default_rng(n).normal(size=(n, p)))[0]
    rates, t1 = np.linspace(0, 3, n), 2.0
    z = np.linalg.qr(np.exp(t1 * rates)[:, None] * y0)[0]
    return Problem(
        lambda t, y, rates: cfjax.LowRankSkew(rates[:, None] * y),
        *(y0, jnp.asarray(rates), t1, z @ z.T),
        of=lambda y: np.asarray(y) @ np.asarray(y).T,
    )


def fluid() -> Problem:
    given = zeitlin.problem()
    y0, t1, args = given["y0"], given["t1"], jnp.asarray(given["args"])
    return Problem(zeitlin.field, y0, args, t1, zeitlin.reference(t1, y0))


def links() -> Problem:
    y0, t1 = wilson_flow.y0(), wilson_flow.t1
    exact = wilson_flow.reference(t1, y0)
    # Their exponentials of so many take minutes to compile.
    return Problem(wilson_flow.field, y0, None, t1, exact, without=("CF4", "CF54"))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "SO(3)": lambda: group(3),
    "SU(3)": lambda: group(3, is_complex=True),
    "Sp(4)": henon_heiles,
    "SU(4)": lambda: group(4, is_complex=True),
    "SO(5)": lambda: group(5),
    "SO(8)": lambda: group(8),
    "SO(32)": lambda: group(32),
    "Toda, n = 8": lambda: lattice(8),
    "Toda, n = 32": lambda: lattice(32),
    "Oja, 200 x 5": oja,
    "fluid, N = 32": fluid,
    "links, 1024 of SU(3)": links,
    "SO(3), 1000 at once": lambda: group(3, many=1000),
    "SU(3), 1000 at once": lambda: group(3, is_complex=True, many=1000),
    "SO(8), 1000 at once": lambda: group(8, many=1000),
    "Toda, n = 8, 1000 at once": lambda: lattice(8, many=1000),
}
# Of others the programs take long to compile for what they show.
WITH_GRADIENT = ("SO(3)", "SU(4)", "SO(8)")


# What is measured.


class Program:
    """A method for a problem, compiled for any number of equal steps to any time."""

    def __init__(self, given: Problem, name: str):
        term, solver = method(given, name)
        solver = as_own(solver).without_estimate()

        def solve(y0: Any, args: Any, num_steps: Any, t1: Any) -> Any:
            times = EqualTimes(jnp.asarray(0.0), t1, num_steps)
            solution, _ = solve_steps(term, solver, times, y0, args)
            return jax.tree_util.tree_map(lambda y: y[-1], solution.ys)

        self.given, self.start = given, jax.tree_util.tree_map(jnp.asarray, given.y0)
        begin = time.perf_counter()
        self.run = jax.jit(solve).lower(*self._arguments(2, given.t1)).compile()
        self.seconds = time.perf_counter() - begin

    def at(self, num_steps: int, t1: float) -> Callable[[], Any]:
        arguments = self._arguments(num_steps, t1)
        return lambda: self.run(*arguments)

    def _arguments(self, num_steps: int, t1: float) -> tuple:
        return self.start, self.given.args, jnp.asarray(num_steps), jnp.asarray(t1)

    def steps_to(self) -> list[float]:
        """How many steps lead to each error, between whole numbers; NaN if there is none."""
        curve, n = [], 1
        while n <= MOST and (not curve or not curve[-1][1] < min(TARGETS) / 4):
            curve.append((n, self.given.error(self.at(n, self.given.t1)())))
            n = max(n + 1, int(1.4 * n))
        return [_steps_to(curve, target) for target in TARGETS]


def _steps_to(curve: list[tuple[int, float]], target: float) -> float:
    for (m, larger), (n, smaller) in zip([(0, np.nan), *curve], curve, strict=False):
        if smaller <= target:
            if not np.isfinite(larger):
                # One step, or the first that did not fail.
                return float(n)
            part = np.log(larger / target) / np.log(larger / smaller)
            return float(m * (n / m) ** part)
    return float("nan")


def method(given: Problem, name: str) -> tuple[Any, Any]:
    if name in PLAIN:

        def velocity(t: Any, y: Any, args: Any) -> Any:
            return cfjax.tangent(given.field(t, y, args), y)

        return diffrax.ODETerm(velocity), PLAIN[name]
    return cfjax.LieTerm(given.field), LIE[name]


def measure(quick: bool, only: tuple[str, ...] = ()) -> Iterator[results.Row]:
    rounds = 3 if quick else 9
    for problem, make in PROBLEMS.items():
        if only and problem not in only:
            continue
        given = make()
        names = [name for name in METHODS if name not in given.without]
        yield from _equal(problem, given, names, rounds)
        if not given.is_short:
            yield from _adaptive(problem, given, names, rounds)
        if problem in WITH_GRADIENT:
            yield from _gradients(problem, given, names, rounds)


def _rows(
    names: list[str],
    programs: dict[str, Callable[[], Any]],
    factors: dict[str, float],
    rounds: int,
    where: results.Row,
) -> Iterator[results.Row]:
    """Each program's time, times a factor, over that of Tsit5 in the same turn."""
    names = [name for name in names if name in programs]
    if "Tsit5" not in names:
        return
    seconds = dict(zip(names, _in_turns([programs[x] for x in names], rounds), strict=True))
    base = factors["Tsit5"] * seconds["Tsit5"]
    for name in names:
        own = factors[name] * seconds[name]
        yield where | {
            "method": name,
            "seconds": results.spread(own),
            "over Tsit5": results.ratios(own, base),
        }


def _in_turns(programs: list[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Seconds of each, by runs of 10 milliseconds or more."""

    def repeated(program: Callable[[], Any]) -> Callable[[], Any]:
        jax.block_until_ready(program())
        begin = time.perf_counter()
        jax.block_until_ready(program())
        repeats = 1 + int(0.01 / (time.perf_counter() - begin))
        counts.append(repeats)
        return lambda: [jax.block_until_ready(program()) for _ in range(repeats)][-1]

    counts: list[int] = []
    seconds = take_turns([repeated(program) for program in programs], repeats=rounds)
    return seconds / np.array(counts)[:, None]


def _equal(problem: str, given: Problem, names: list[str], rounds: int) -> Iterator[results.Row]:
    programs = {name: Program(given, name) for name in names}
    steps = {name: program.steps_to() for name, program in programs.items()}
    for k, target in enumerate(TARGETS):
        needed = {name: counts[k] for name, counts in steps.items() if np.isfinite(counts[k])}
        # Two steps have no order yet.
        needed = {name: n for name, n in needed.items() if n >= 2 or name == "Tsit5"}
        runs = {x: programs[x].at(TIMED, given.t1 * TIMED / n) for x, n in needed.items()}
        where = {"problem": problem, "steps": "equal", "to": target}
        factors = {name: n / TIMED for name, n in needed.items()}
        for row in _rows(names, runs, factors, rounds, where):
            yield row | {"number": results.digits(needed[row["method"]])}
    for name, program in programs.items():
        text = program.run.as_text() or ""
        instructions = sum(" = " in line for line in text.splitlines())
        yield {
            "problem": problem,
            "method": name,
            "seconds to compile": results.digits(program.seconds),
            "instructions": instructions,
        }


def _adaptive(problem: str, given: Problem, names: list[str], rounds: int) -> Iterator[results.Row]:
    solves: dict[str, Callable[[Any], Any]] = {}
    # CF54 is the better one of both there.
    for name in (name for name in names if name != "CF4"):
        term, solver = method(given, name)

        def controlled(tolerance: Any, term: Any = term, solver: Any = solver) -> Any:
            control = diffrax.PIDController(rtol=0.0, atol=tolerance)
            y0 = jax.tree_util.tree_map(jnp.asarray, given.y0)
            solution = diffrax.diffeqsolve(
                *(term, solver, 0.0, given.t1, given.t1 / 50, y0, given.args),
                stepsize_controller=control,
                max_steps=5000,
                throw=False,
            )
            return jax.tree_util.tree_map(lambda y: y[-1], solution.ys)

        solves[name] = jax.jit(controlled)
    for target in TARGETS:
        runs, factors = {}, {}
        for name, solve in solves.items():
            tolerance, error = target, given.error(solve(target))
            for _ in range(8):
                if 0.8 < error / target < 1.25:
                    break
                tolerance *= min(max(target / error, 1e-3), 1e3)
                error = given.error(solve(tolerance))
            if 0.3 < error / target < 3:
                runs[name] = functools.partial(solve, jnp.asarray(tolerance))
                # What is left of the error, as a factor of the number of steps.
                factors[name] = (error / target) ** (1 / (8 if "8" in name else 5))
        where = {"problem": problem, "steps": "adaptive", "to": target}
        yield from _rows(names, runs, factors, rounds, where)


def _gradients(
    problem: str, given: Problem, names: list[str], rounds: int
) -> Iterator[results.Row]:
    for name in (name for name in names if name not in PLAIN):
        term, solver = method(given, name)

        def end(scale: Any, given: Any = given, term: Any = term, solver: Any = solver) -> Any:
            args = jax.tree_util.tree_map(lambda x: scale.astype(x.dtype) * x, given.args)
            y0 = jnp.asarray(given.y0)
            ys: Any = cfjax.integrate(term, solver, 0.0, given.t1, y0, args, num_steps=TIMED).ys
            return jnp.sum(jnp.real(ys[-1]))

        one = jnp.asarray(1.0)
        programs = [results.compiled(f, one) for f in (end, jax.grad(end))]
        solve, gradient = _in_turns(programs, rounds)
        over = results.ratios(gradient, solve)
        yield {"problem": problem, "method": name, "gradient over solve": over}


if __name__ == "__main__":
    results.run(__file__, __doc__, measure, PROBLEMS)
