"""Time to an error for attitudes: a spacecraft, and the heavy top as a pose.

The problems are a quaternion and momentum to t = 10, and the heavy top to t = 0.2, in equal steps:
as many as a method needs for an error, for one system, in a batch, and with the gradient with
respect to the start. `cfjax.integrate` runs cfjax's methods, and `diffrax.diffeqsolve` runs
diffrax's methods on the same numbers in plain space, where the quaternion's length drifts. All
programs take turns.
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
from cfjax.scenes import heavy_top, spacecraft

BATCH = 10_000
TARGETS = (1e-8, 1e-11)
REPEATS = 20  # of a program for one system in one turn
CRAFT = spacecraft.Craft()


def craft(t: Any, y: Any, args: Any) -> dict[str, Any]:
    """Without torque. The momentum as an array: its velocity, and no rotation, is of high order."""
    omega = y["m"] / spacecraft.inertia
    attitude = cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")
    return {"q": attitude, "m": jnp.cross(y["m"], omega)}


class Scene(NamedTuple):
    module: Any
    t1: float
    field: Callable[[Any, Any, Any], Any]
    velocity: Callable[[Any, Any, Any], Any]


SCENES = {
    "spacecraft": Scene(
        spacecraft, 10.0, craft, lambda t, y, args: spacecraft.velocity(t, y, CRAFT)
    ),
    "heavy top": Scene(
        heavy_top,
        0.2,
        lambda t, y, args: heavy_top.field(t, y, heavy_top.benchmark),
        lambda t, y, args: heavy_top.velocity(t, y, heavy_top.benchmark),
    ),
}
METHODS: dict[str, tuple[diffrax.AbstractSolver, int]] = {
    "diffrax, Tsit5": (diffrax.Tsit5(), 5),
    "diffrax, Dopri8": (diffrax.Dopri8(), 8),
    "CF54": (cfjax.CF54(), 5),
    "RKMK(Dopri5)": (cfjax.RKMK(diffrax.Dopri5.tableau), 5),
    "RKMK(Tsit5)": (cfjax.RKMK(diffrax.Tsit5.tableau), 5),
    "RKMK(Dopri8)": (cfjax.RKMK(diffrax.Dopri8.tableau), 8),
}


def solve(scene: Scene, name: str, y0: Any, num_steps: Any) -> Any:
    """The final state. If `num_steps` is traced, diffrax solves for every method."""
    solver, _ = METHODS[name]
    in_space, is_static = name.startswith("diffrax"), isinstance(num_steps, int)
    term = diffrax.ODETerm(scene.velocity) if in_space else cfjax.LieTerm(scene.field)
    if in_space or not is_static:
        # Rounding of the times may make a step more.
        max_steps = num_steps + 1 if is_static else None
        step = scene.t1 / num_steps
        sol = diffrax.diffeqsolve(term, solver, 0.0, scene.t1, step, y0, max_steps=max_steps)
    else:
        sol = cfjax.integrate(term, solver, 0.0, scene.t1, y0, num_steps=num_steps)
    return jax.tree.map(lambda y: y[-1], sol.ys)


def steps_to(scene: Scene, name: str, y0: Any) -> dict[float, tuple[int, float]]:
    """For each target the fewest equal steps, to within a twelfth, and their error."""
    exact = scene.module.reference(scene.t1)
    # One program for all numbers of steps.
    program = jax.jit(lambda y0, n: solve(scene, name, y0, n))
    fewest = {}
    n = 4
    for target in TARGETS:
        tried: dict[int, float] = {}
        while n not in tried and len(tried) < 12:
            tried[n] = scene.module.error(program(y0, jnp.asarray(n)), exact)
            # Far too few steps may overflow in plain space.
            ratio = tried[n] / target if np.isfinite(tried[n]) else np.inf
            factor = ratio ** (1 / METHODS[name][1])
            n = max(n + (factor > 1), round(n * min(max(1.02 * factor, 0.5), 4)))
            if 1 / 1.08 < factor <= 1:
                break
        n = min(n for n, error in tried.items() if error <= target)
        fewest[target] = n, tried[n]
    return fewest


def measure(quick: bool) -> Iterator[results.Row]:
    for label, scene in SCENES.items():
        y0 = jax.tree.map(jnp.asarray, scene.module.y0())
        fewest = {name: steps_to(scene, name, y0) for name in METHODS}
        many = jax.tree.map(lambda y: jnp.broadcast_to(y, (BATCH, *y.shape)), y0)
        for target in TARGETS:
            kinds = ["solve", "gradient"]
            runs: dict[tuple[str, int], list[Any]] = {}
            for name in METHODS:
                n, _ = fewest[name][target]

                def final_state(y: Any, name=name, n=n, scene=scene) -> Any:
                    return solve(scene, name, y, n)

                def value(y: Any, final_state=final_state) -> Any:
                    return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(final_state(y)))

                programs = [final_state, jax.grad(value)][: 2 if target == TARGETS[0] else 1]
                runs[name, 1] = [results.compiled(f, y0, repeats=REPEATS) for f in programs]
                runs[name, BATCH] = [results.compiled(jax.vmap(final_state), many)]
            for systems in (1, BATCH):
                programs = [run for name in METHODS for run in runs[name, systems]]
                rounds = (3 if quick else 25) if systems == 1 else (1 if quick else 7)
                seconds = take_turns(programs, repeats=rounds)
                seconds = seconds.reshape(len(METHODS), -1, rounds)
                seconds = seconds / (REPEATS if systems == 1 else systems)
                best = int(np.argmin(np.median(seconds[:2, 0], axis=-1)))
                for name, times in zip(METHODS, seconds, strict=True):
                    num_steps, error = fewest[name][target]
                    row = {
                        "scene": label,
                        "systems": systems,
                        "to": target,
                        "method": name,
                        "steps": num_steps,
                        "error": results.digits(error),
                    }
                    for kind, spent in zip(kinds, times, strict=False):
                        row[f"seconds, {kind}"] = results.spread(spent)
                    row["over the better in plain space"] = results.ratios(
                        times[0], seconds[best, 0]
                    )
                    if len(times) > 1:
                        row["gradient over solve"] = results.ratios(times[1], times[0])
                    yield row


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
