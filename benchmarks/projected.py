"""Munthe-Kaas methods with stages in plain space: time to an error, relative to Tsit5's.

The problems are orthogonal matrices, Toda's flow and Oja's flow, whose solutions are known in
closed form. Methods take equal steps, as few as reach an error in the largest entry: a number of
steps between two that were tried is interpolated. Times are of the processor, for a step of that
length, and methods take turns.
"""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import cfjax
import results
from cfjax.scenes import toda

TARGETS = (1e-4, 1e-7, 1e-10)
LIE = {
    "CF4": cfjax.CF4(estimate=None),
    "CF54": cfjax.CF54(estimate=None),
    "RKMK5, projected": cfjax.RKMK5(coordinates="projected", estimate=None),
    "RKMK8, projected": cfjax.RKMK8(coordinates="projected", estimate=None),
}
SPACE = {"Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}
STEPS = 60  # of a timed run


class Problem(NamedTuple):
    field: Callable[[Any, Any, Any], Any]
    y0: np.ndarray
    args: Any
    end: float
    exact: np.ndarray
    # What of the end is known.
    of: Callable[[np.ndarray], np.ndarray] = lambda end: end


def orthogonal(n: int) -> Problem:
    """`y' = b y + y c`."""
    rng = np.random.default_rng(0)
    b, c = (_skew(rng.normal(size=(n, n))) for _ in range(2))
    field = lambda t, y, args: cfjax.LeftMatrix(args[0] + y @ args[1] @ y.T)  # noqa: E731
    exact = scipy.linalg.expm(1.5 * b) @ scipy.linalg.expm(1.5 * c)
    return Problem(field, np.eye(n), (jnp.asarray(b), jnp.asarray(c)), 1.5, exact)


def _skew(a: np.ndarray) -> np.ndarray:
    """The skew part, with a 2-norm of 2."""
    return 2 * (a - a.T) / np.linalg.norm(a - a.T, 2)


def isospectral(n: int) -> Problem:
    """Toda's flow of a full matrix."""
    a = np.random.default_rng(0).normal(size=(n, n))
    y0 = (a + a.T) / np.linalg.norm(a + a.T, 2)
    field = lambda t, y, args: cfjax.Conjugation(jnp.triu(y, 1) - jnp.tril(y, -1))  # noqa: E731
    return Problem(field, y0, None, 3.0, np.asarray(toda.reference(3.0, y0)))


def oja(n: int, p: int) -> Problem:
    """Oja's flow, up to the basis of the columns."""
    y0 = np.linalg.qr(np.random.default_rng(0).normal(size=(n, p)))[0]
    weights = np.linspace(0, 3, n)
    end = np.linalg.qr(np.exp(2 * weights)[:, None] * y0)[0]
    field = lambda t, y, args: cfjax.LowRankSkew(args[:, None] * y)  # noqa: E731
    return Problem(field, y0, jnp.asarray(weights), 2.0, end @ end.T, lambda y: y @ y.T)


PROBLEMS = {
    "orthogonal, n = 8": lambda: orthogonal(8),
    "orthogonal, n = 32": lambda: orthogonal(32),
    "Toda, n = 8": lambda: isospectral(8),
    "Toda, n = 32": lambda: isospectral(32),
    "Oja, 200 x 5": lambda: oja(200, 5),
}


def measure(quick: bool) -> Iterator[results.Row]:
    for name, make in PROBLEMS.items():
        problem = make()
        runs = {method: compiled(problem, method) for method in LIE | SPACE}
        steps = {method: steps_for(problem, run) for method, run in runs.items()}
        for target in TARGETS:
            lengths = {method: problem.end / steps[method][target] for method in runs}
            turns = [
                {method: seconds(run, lengths[method]) for method, run in runs.items()}
                for _ in range(2 if quick else 9)
            ]
            for method in runs:
                times = [turn[method] * steps[method][target] for turn in turns]
                base = [turn["Tsit5"] * steps["Tsit5"][target] for turn in turns]
                yield {
                    "problem": name,
                    "method": method,
                    "to": target,
                    "steps": results.digits(steps[method][target]),
                    "CPU seconds": results.spread(times),
                    "over Tsit5": results.ratios(times, base),
                }


Run = Callable[[int, float], np.ndarray]


def compiled(problem: Problem, method: str) -> Run:
    """The end of some steps of a length, in one program for any number of them."""
    field, args = problem.field, problem.args
    space = diffrax.ODETerm(lambda t, y, args: cfjax.tangent(field(t, y, args), y))
    term: Any = cfjax.LieTerm(field) if method in LIE else space
    solver: Any = (LIE | SPACE)[method]

    @jax.jit
    def run(y0: Any, num_steps: Any, length: Any) -> Any:
        def step(k: Any, carry: Any) -> Any:
            y, state = carry
            t = k * length
            y, _, _, state, _ = solver.step(term, t, t + length, y, args, state, made_jump=False)
            return y, state

        first = solver.init(term, jnp.zeros(()), length, y0, args)
        return jax.lax.fori_loop(0, num_steps, step, (y0, first))[0]

    y0 = jnp.asarray(problem.y0)
    return lambda num_steps, length: np.asarray(run(y0, num_steps, length))


def steps_for(problem: Problem, run: Run) -> dict[float, float]:
    """The number of steps to each error, between two that were tried."""
    found: dict[float, float] = {}
    tried: list[tuple[int, float]] = []
    num_steps = 1
    while len(found) < len(TARGETS):
        end = problem.of(run(num_steps, problem.end / num_steps))
        error = float(np.abs(end - problem.exact).max())
        for target in TARGETS:
            if target not in found and error <= target:
                found[target] = _between(tried[-1:], (num_steps, error), target)
        if math.isfinite(error):
            tried.append((num_steps, error))
        num_steps = max(num_steps + 1, int(num_steps * 1.4))
    return found


def _between(before: list[tuple[int, float]], at: tuple[int, float], target: float) -> float:
    """Where a power of the number of steps through both points is at the target."""
    if not before:
        return float(at[0])
    ((n, error),) = before
    part = math.log(error / target) / math.log(error / at[1])
    return n * (at[0] / n) ** part


def seconds(run: Run, length: float) -> float:
    """Seconds of the processor for a step."""
    begin, count = time.process_time(), 0
    while time.process_time() - begin < 0.02:
        run(STEPS, length)
        count += 1
    return (time.process_time() - begin) / count / STEPS


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
