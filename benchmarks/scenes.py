"""Adaptive steps on every scene: error and time at a tolerance, against Tsit5 in plain space.

On each scene the methods that are recommended for such fields run with
`diffrax.PIDController(rtol=0, atol=tolerance)`, at tolerances from 1e-4 to 1e-11, and Tsit5 on the
velocities in plain space at the tolerance that leads to the same error, in turns. An error is the
root of the mean square over the numbers of the state, which is how diffrax measures that of a step.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import (
    annealing,
    covariance,
    heat,
    heavy_top,
    landau_zener,
    rigid_body,
    spacecraft,
    spins,
    stiefel,
    toda,
    transmon,
    wilson_flow,
    zeitlin,
)
from cfjax.scenes._scene import PROJECTED, by_name

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-11)
# At these tolerances times are taken as well.
TIMED = (1e-6, 1e-8, 1e-11)


# Of fields of matrices, columns and spins: with exponentials, and with stages in plain space.
WITH_CF54 = cfjax.CF54(), *PROJECTED


class Scene(NamedTuple):
    solvers: tuple[diffrax.AbstractSolver, ...]
    problem: dict[str, Any]
    # The exact final state, and a bound of its error.
    reference: Callable[[], Any]
    reference_error: float = 1e-13
    velocity: Callable[[Any, Any, Any], Any] | None = None


def scenes() -> dict[str, Scene]:
    attitude, magnus = (cfjax.RKMK8(), *PROJECTED), (cfjax.Magnus6(),)
    track, turning, flowing = covariance.problem(), spins.problem(), wilson_flow.problem()
    rod, fluid, tilted = heat.problem(), zeitlin.problem(), heavy_top.problem()
    return {
        "rigid body": Scene(
            attitude, rigid_body.problem() | {"t1": 10.0}, lambda: rigid_body.reference(10.0)
        ),
        "spacecraft": Scene(
            attitude, spacecraft.problem(), lambda: spacecraft.reference(spacecraft.t1)
        ),
        "heavy top": Scene(
            attitude,
            tilted | {"t1": 0.2},
            lambda: heavy_top.reference(0.2),
            1e-12,
            heavy_top.velocity,
        ),
        "spins": Scene(
            WITH_CF54,
            turning,
            lambda: spins.reference(spins.t1, turning["y0"], turning["args"]),
            1e-12,
            spins.velocity,
        ),
        "Wilson flow": Scene(
            WITH_CF54,
            flowing,
            lambda: wilson_flow.reference(wilson_flow.t1, flowing["y0"]),
            1e-12,
            wilson_flow.velocity,
        ),
        "Stiefel, first": Scene(
            WITH_CF54, stiefel.problem("first"), lambda: stiefel.reference("first", 100)
        ),
        "Stiefel, second": Scene(
            WITH_CF54, stiefel.problem("second"), lambda: stiefel.reference("second", 100)
        ),
        "Toda": Scene(WITH_CF54, toda.problem(), lambda: toda.reference(toda.t1)),
        "Zeitlin": Scene(
            WITH_CF54,
            fluid,
            lambda: zeitlin.reference(zeitlin.t1, fluid["y0"]),
            1e-11,
            zeitlin.velocity,
        ),
        "covariance": Scene(
            (cfjax.CF4(),),
            track,
            lambda: covariance.reference(covariance.t1, track["y0"], track["args"]),
            1e-13,
            covariance.velocity,
        ),
        "heat": Scene(
            (cfjax.CF43(),),
            rod,
            lambda: np.asarray(
                heat.from_grid(jnp.asarray(heat.reference(heat.t1, rod["args"].mu)))
            ),
        ),
        "Landau-Zener": Scene(
            magnus,
            landau_zener.problem(),
            lambda: landau_zener.reference(landau_zener.t1),
            1e-13,
            landau_zener.velocity,
        ),
        "transmon": Scene(
            magnus,
            transmon.problem(),
            lambda: transmon.reference(transmon.corrected()),
            1e-12,
            transmon.velocity,
        ),
        "annealing": Scene(
            magnus,
            annealing.problem(),
            lambda: annealing.reference(annealing.t1),
            1e-11,
            annealing.velocity,
        ),
    }


class Run(NamedTuple):
    tolerance: float
    error: float
    num_steps: int


class Program:
    """A method on a scene, compiled once for all tolerances."""

    def __init__(self, scene: Scene, solver: diffrax.AbstractSolver | None, exact: Any):
        """Without a solver that of Tsit5 in plain space."""
        problem, self.exact = scene.problem, exact
        field = problem["term"].field
        velocity = scene.velocity or (lambda t, y, args: cfjax.tangent(field(t, y, args), y))
        term = diffrax.ODETerm(velocity) if solver is None else problem["term"]
        solver = solver or diffrax.Tsit5()

        def solve(y0: Any, args: Any, dt0: Any, tolerance: Any) -> tuple[Any, Any]:
            sol = diffrax.diffeqsolve(
                term,
                solver,
                problem["t0"],
                problem["t1"],
                dt0,
                y0,
                args,
                stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
                max_steps=None,
            )
            return jax.tree.map(lambda y: y[-1], sol.ys), sol.stats["num_steps"]

        y0 = jax.tree.map(jnp.asarray, problem["y0"])
        args = jax.tree.map(jnp.asarray, problem.get("args"))
        self.start = y0, args, jnp.asarray((problem["t1"] - problem["t0"]) / 1000)
        self.solve = jax.jit(solve).lower(*self.start, jnp.asarray(1.0)).compile()

    def run(self, tolerance: float) -> Run:
        y, num_steps = self.solve(*self.start, jnp.asarray(tolerance))
        return Run(tolerance, _distance(y, self.exact), int(num_steps))

    def to_error(self, error: float, tolerance: float) -> Run:
        """At a tolerance that leads to about this error, if there is one."""
        run = self.run(tolerance)
        for _ in range(8):
            if 0.8 < run.error / error < 1.25:
                break
            # Rounding allows no smaller tolerance.
            run = self.run(max(run.tolerance * error / run.error, 1e-14))
        return run

    def timed(self, tolerance: float) -> Callable[[], object]:
        atol = jnp.asarray(tolerance)
        return lambda: jax.block_until_ready(self.solve(*self.start, atol))


def _distance(y: Any, exact: Any) -> float:
    if isinstance(exact, dict) and "q" in exact:
        # q and -q are the same attitude.
        exact = exact | {"q": exact["q"] * np.sign(np.vdot(y["q"], exact["q"]))}
    pairs = zip(jax.tree.leaves(y), jax.tree.leaves(exact), strict=True)
    differences = [np.abs(np.asarray(a) - np.asarray(b)).ravel() for a, b in pairs]
    return float(np.sqrt(np.mean(np.concatenate(differences) ** 2)))


def measure(quick: bool, only: tuple[str, ...] = ()) -> Iterator[results.Row]:
    for name, scene in scenes().items():
        if only and name not in only:
            continue
        exact = scene.reference()
        theirs = Program(scene, None, exact)
        for method, solver in by_name(*scene.solvers).items():
            ours = Program(scene, solver, exact)
            for row in _rows(scene, ours, theirs, repeats=3 if quick else 11):
                yield {"scene": name, "method": method} | row


def _rows(scene: Scene, ours: Program, theirs: Program, repeats: int) -> Iterator[results.Row]:
    for tolerance in TOLERANCES:
        run = ours.run(tolerance)
        row: results.Row = {
            "tolerance": tolerance,
            "error": results.digits(run.error),
            "steps": run.num_steps,
        }
        # Below it the error is that of the reference.
        if run.error > 10 * scene.reference_error:
            same = theirs.to_error(run.error, tolerance)
            row |= {"Tsit5's error": results.digits(same.error), "Tsit5's steps": same.num_steps}
            if tolerance in TIMED:
                timed = [ours.timed(run.tolerance), theirs.timed(same.tolerance)]
                row["over Tsit5"] = results.ratios(*take_turns(timed, repeats=repeats))
        yield row


if __name__ == "__main__":
    results.run(__file__, __doc__, measure, scenes(), key="scene")
