"""States with leading axes: a step of CF4 for each element, and as many solves under `jax.vmap`.

Then it compares a ferromagnet, whose spins need their neighbours, with the same spins without
neighbours, and with diffrax's Dopri5 in plain space, which normalises every spin after each step.
All programs take turns. The errors are root mean squares at the end, with CF54 in a fifth of the
step as the reference.
"""

from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax.scenes import spins

STEP, STEPS = 0.05, 20
MEMBERS, SIDE = 10_000, 316
WEIGHTS = np.array([1.0, 0.5, 0.3])


def units(*shape: int) -> np.ndarray:
    x = np.random.default_rng(0).normal(size=shape)
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def quaternion(t: Any, y: Any, args: Any) -> Any:
    return cfjax.QuaternionRotation(y[..., 1:] * WEIGHTS + 0.2, frame="body", layout="wxyz")


def attitude(t: Any, y: Any, args: Any) -> Any:
    w = y["m"] / WEIGHTS
    rotation = cfjax.QuaternionRotation(w, frame="body", layout="wxyz")
    return {"q": rotation, "m": cfjax.Rotation(-w)}


def pose(t: Any, y: Any, args: Any) -> Any:
    w, v = y[..., 1:4] * WEIGHTS, y[..., 4:]
    return cfjax.RigidMotion(omega=w, v=v, frame="body", layout="wxyz_xyz")


def single_spin(t: Any, s: Any, args: Any) -> Any:
    """The field of `spins` for spins without neighbours."""
    b = args.anisotropy * s * np.array([0.0, 0.0, 1.0]) + jnp.array(args.applied)
    return cfjax.Rotation((b + args.damping * jnp.cross(s, b)) / (1 + args.damping**2))


def solve(field: Any, solver: Any = None, num_steps: int = STEPS) -> Callable[[Any], Any]:
    def run(y: Any) -> Any:
        solution = cfjax.integrate(
            cfjax.LieTerm(field),
            solver or cfjax.CF4(),
            0.0,
            STEPS * STEP,
            y,
            spins.Magnet(),
            num_steps=num_steps,
        )
        return jax.tree.map(lambda x: x[-1], solution.ys)

    return run


def normalised(y: Any) -> Any:
    """Dopri5 in plain space, with one evaluation more a step, as normalising changes the start."""
    term, solver = diffrax.ODETerm(spins.velocity), diffrax.Dopri5()
    args = spins.Magnet()

    def step(y: Any, t: Any) -> Any:
        state = solver.init(term, t, t + STEP, y, args)
        y = solver.step(term, t, t + STEP, y, args, state, False)[0]
        return y / jnp.linalg.norm(y, axis=-1, keepdims=True), None

    return jax.lax.scan(step, y, STEP * jnp.arange(STEPS, dtype=y.dtype))[0]


def rows(programs: dict[str, Any], y: Any, turns: int, **about: Any) -> Iterator[results.Row]:
    leaf = jax.tree.leaves(y)[0]
    members = leaf.size // leaf.shape[-1]
    compiled = {name: results.compiled(run, y) for name, run in programs.items()}
    times = results.in_turns(compiled, repeats=turns)
    base = [*times.values()][-1]
    for name, seconds in times.items():
        yield {
            **about,
            "way": name,
            "members": members,
            # One step of one member.
            "seconds": results.spread(seconds / (STEPS * members)),
            "ratio": results.ratios(seconds, base),
        }


def measure(quick: bool) -> Iterator[results.Row]:
    turns = 3 if quick else 11
    states = {
        "quaternion": (quaternion, units(MEMBERS, 4)),
        "attitude and momentum": (attitude, {"q": units(MEMBERS, 4), "m": units(MEMBERS, 3)}),
        "pose": (pose, np.concatenate([units(MEMBERS, 4), units(MEMBERS, 3)], axis=-1)),
        "spin without neighbours": (single_spin, units(MEMBERS, 3)),
    }
    for name, (field, y) in states.items():
        programs = {"leading axes": solve(field), "vmap": jax.vmap(solve(field))}
        yield from rows(programs, jax.tree.map(jnp.asarray, y), turns, state=name)
    y = jnp.asarray(units(SIDE, SIDE, 3))
    programs = {
        "CF4": solve(spins.field),
        "CF54": solve(spins.field, cfjax.CF54()),
        "Dopri5 with normalisation": normalised,
        "CF4, without neighbours, vmap": jax.vmap(jax.vmap(solve(single_spin))),
    }
    exact = jax.jit(solve(spins.field, cfjax.CF54(), 5 * STEPS))(y)
    for row in rows(programs, y, turns, state="ferromagnet"):
        if "without" in row["way"]:
            yield row
        else:
            error = jnp.sqrt(jnp.mean((jax.jit(programs[row["way"]])(y) - exact) ** 2))
            yield {**row, "error": float(error)}


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
