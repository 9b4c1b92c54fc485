"""The cost of error control: error against tolerance and against flows, and time to an error.

The problem is the rigid body to t = 10, and every method runs with
`diffrax.PIDController(rtol=0, atol=tolerance)`. It measures steps, errors and times at equal
tolerance and at equal error, compared with diffrax's solvers in plain space, in turns in one run,
so that the ratios mean something on a busy machine. The picture shows every embedded pair.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure

import cfjax
import on_host
import results
from cfjax._measure import style as _style
from cfjax._measure.cost import Problem, calls_of_steps
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import rigid_body

END = 10.0
TOLERANCES = np.logspace(-4, -10, 7)
PAIRS = ["CF3", "CF4", "CF43", "CF54", "CG3", "BWRRK53", "CK34", "Luscher3"]

TARGETS = (1e-6, 1e-9)
BATCH = 1000
LIE = cfjax.LieTerm(rigid_body.field)
SPACE = diffrax.ODETerm(lambda t, y, inertia: jnp.cross(y, y / inertia))
METHODS: dict[str, tuple[Any, diffrax.AbstractSolver]] = {
    "diffrax, Tsit5, in plain space": (SPACE, diffrax.Tsit5()),
    "diffrax, Dopri8, in plain space": (SPACE, diffrax.Dopri8()),
    "Projected(Tsit5)": (LIE, cfjax.Projected(diffrax.Tsit5())),
    "Projected(Dopri8)": (LIE, cfjax.Projected(diffrax.Dopri8())),
    "CF4": (LIE, cfjax.CF4()),
    "CF43": (LIE, cfjax.CF43()),
    "CF54": (LIE, cfjax.CF54()),
    "Richardson(CF4)": (LIE, cfjax.Richardson(cfjax.CF4(estimate=None))),
}
# In the picture.
NAMES = [*PAIRS, "Richardson(CF4)"]


def measure(quick: bool) -> Iterator[results.Row]:
    yield from _curves()
    for y0 in (np.asarray(rigid_body.y0), _batch()):
        programs = {name: Program(*method, y0) for name, method in METHODS.items()}
        for target in TARGETS:
            yield from _rows(programs, target, rounds=3 if quick else 25)


def _curves() -> Iterator[results.Row]:
    for name in NAMES:
        solver = METHODS[name][1] if name in METHODS else getattr(cfjax, name)()
        program = Program(LIE, solver, np.asarray(rigid_body.y0))
        for tolerance in TOLERANCES:
            run = program.run(tolerance)
            yield {
                "method": name,
                "tolerance": tolerance,
                "error": results.digits(run.error),
                "flows": _flows(solver) * run.num_steps,
            }


class Program:
    """A method for one system or a batch, compiled once for all tolerances."""

    def __init__(self, term: Any, solver: diffrax.AbstractSolver, y0: np.ndarray):
        def solve(y0: Array, tolerance: Array) -> tuple[Array, Array]:
            sol = diffrax.diffeqsolve(
                term,
                solver,
                0.0,
                END,
                0.01,
                y0,
                jnp.asarray(rigid_body.inertia),
                stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
                max_steps=None,
            )
            assert sol.ys is not None
            return sol.ys[-1], sol.stats["num_steps"]

        if y0.ndim == 2:
            solve = jax.vmap(solve, in_axes=(0, None))
        self.y0, self.exact = jnp.asarray(y0), _reference(y0)
        self.solve = jax.jit(solve).lower(self.y0, jnp.asarray(1.0)).compile()

    def run(self, tolerance: float) -> "Run":
        y, num_steps = self.solve(self.y0, jnp.asarray(tolerance))
        errors = np.linalg.norm(y - self.exact, axis=-1)
        # A batch has the root mean square of the errors, and the steps of the median member.
        return Run(tolerance, float(np.sqrt(np.mean(errors**2))), int(np.median(num_steps)))

    def to_error(self, target: float) -> "Run":
        """At the tolerance that leads to an error of about `target`."""
        run = self.run(target)
        for _ in range(10):
            if 0.9 < run.error / target < 1.1:
                break
            run = self.run(run.tolerance * target / run.error)
        return run

    def timed(self, tolerance: float) -> Callable[[], object]:
        atol = jnp.asarray(tolerance)
        return lambda: self.solve(self.y0, atol)


class Run(NamedTuple):
    tolerance: float
    error: float
    num_steps: int


def _rows(programs: dict[str, Program], target: float, rounds: int) -> Iterator[results.Row]:
    """Each program at the tolerance `target` and at that error, over the first."""
    runs = [[p.run(target) for p in programs.values()]]
    runs.append([p.to_error(target) for p in programs.values()])
    # One kind after the other, so that no program follows itself and finds its own caches.
    timed = [
        p.timed(run.tolerance)
        for row in runs
        for p, run in zip(programs.values(), row, strict=True)
    ]
    systems = next(iter(programs.values())).exact.size // 3
    # A single system takes a tenth of a millisecond, a batch a tenth of a second.
    repeats = rounds if systems > 1 else 20 * rounds
    seconds = take_turns(timed, repeats=repeats).reshape(2, len(programs), -1)
    for same, row, measured in zip(("tolerance", "error"), runs, seconds, strict=True):
        for name, run, times in zip(programs, row, measured, strict=True):
            yield {
                "method": name,
                "systems": systems,
                "equal": same,
                "to": target,
                "error": results.digits(run.error),
                "steps": run.num_steps,
                "seconds": results.spread(times / systems),
                "over Tsit5": results.ratios(times, measured[0]),
            }


def _batch() -> np.ndarray:
    y0 = np.random.default_rng(0).normal(size=(BATCH, 3))
    return y0 / np.linalg.norm(y0, axis=1, keepdims=True)


def _reference(y0: np.ndarray) -> np.ndarray:
    return on_host.solve(lambda t, y: np.cross(y, y / rigid_body.inertia), END, y0, atol=1e-15)


def draw() -> dict[str, Figure]:
    rows = results.load("tolerances")["rows"]
    curves = {name: [r for r in results.pick(rows, method=name) if "flows" in r] for name in NAMES}
    figure = _style.new_figure((10, 4))
    by_tolerance, by_flows = figure.subplots(1, 2, sharey=True)
    for name, curve in curves.items():
        tolerances, errors, flows = (
            [row[k] for row in curve] for k in ("tolerance", "error", "flows")
        )
        by_tolerance.loglog(tolerances, errors, "o-", markersize=3, label=name)
        by_flows.loglog(flows, errors, "o-", markersize=3)
    by_tolerance.loglog(TOLERANCES, TOLERANCES, "k:", label="error = tolerance")
    by_tolerance.set(xlabel="tolerance", ylabel=f"error at t = {END:g}")
    by_flows.set(xlabel="flows")
    _style.finish(figure, columns=5)
    return {"tolerances": figure}


def _flows(solver: Any) -> float:
    """Flows in a step, with those of the estimate."""
    y0, inertia = np.asarray(rigid_body.y0), np.asarray(rigid_body.inertia)
    t0, t1, h = (jnp.asarray(t) for t in (0.0, END, 0.1))
    return calls_of_steps(Problem(LIE, solver, t0, t1, h, y0, inertia))[1].flows


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
