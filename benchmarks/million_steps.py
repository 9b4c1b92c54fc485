"""A unit quaternion after up to a million steps in float32: its length and its angle, by program.

The body turns with a periodic angular velocity, given a thousand times in a period, as a gyroscope
would: programs that take readings use the one in the middle of a step. The phase of the period is
a part of the state of the others, as times of float32 would round the angular velocity. The exact
attitude is from float64.
"""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

import cfjax
import results

STEP, PERIOD = 0.01, 1000
COUNTS = (1000, 1_000_000)
START = np.array([1.0, 0.0, 0.0, 0.0])
RATE = 2 * np.pi / (PERIOD * STEP)


def angular_velocity(phase: Array) -> Array:
    """In the frame of the body, for a vector of any length that turns once in a period."""
    c, s = jnp.moveaxis(phase / jnp.linalg.norm(phase, axis=-1, keepdims=True), -1, 0)[:2]
    return jnp.stack([0.8 * s, 0.5 * c, 1.0 + 0.3 * (c**2 - s**2)], axis=-1)


def velocity(q: Array, w: Array) -> Array:
    """`q (0, w) / 2`, for a scalar part in front."""
    scalar, vector = q[0], q[1:]
    parts = -vector @ w, scalar * w + jnp.cross(vector, w)
    return jnp.concatenate([parts[0][None], parts[1]]) / 2


def euler(q: Array, w: Array) -> Array:
    return q + STEP * velocity(q, w)


def exponential(q: Array, w: Array) -> Array:
    half = jnp.linalg.norm(w) * STEP / 2
    turned = jnp.cos(half) * q
    return turned + jnp.sin(half) / jnp.linalg.norm(w) * 2 * velocity(q, w)


def flow(q: Array, w: Array) -> Array:
    return cfjax.flow(cfjax.QuaternionRotation(STEP * w, frame="body", layout="wxyz"), q)


def normalised(step: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Array]:
    def of(q: Array, w: Array) -> Array:
        q = step(q, w)
        return q / jnp.linalg.norm(q)

    return of


READINGS = {
    "Euler": euler,
    "Euler, normalised": normalised(euler),
    "exponential": exponential,
    "exponential, normalised": normalised(exponential),
    "cfjax.flow": flow,
}


def by_readings(step: Callable[[Array, Array], Array], count: int) -> Array:
    @jax.jit
    def run() -> Array:
        return lax.fori_loop(0, count, body, jnp.asarray(START, jnp.float32))

    angle = 2 * np.pi * (np.arange(PERIOD) + 0.5) / PERIOD
    table = angular_velocity(jnp.stack([np.cos(angle), np.sin(angle)], axis=1))
    table = table.astype(jnp.float32)

    def body(k: int, q: Array) -> Array:
        return step(q, table[k % PERIOD])

    return run()


def field(t: Array, y: dict[str, Array], args: None) -> dict[str, cfjax.AbstractFrozenField]:
    turn = jnp.array([0.0, 0.0, RATE], y["q"].dtype)
    w = angular_velocity(y["phase"])
    return {
        "q": cfjax.QuaternionRotation(w, frame="body", layout="wxyz"),
        "phase": cfjax.Rotation(turn),
    }


def in_plain_space(y: dict[str, Array]) -> dict[str, Array]:
    c, s, _ = y["phase"]
    return {
        "q": velocity(y["q"], angular_velocity(y["phase"])),
        "phase": RATE * jnp.stack([-s, c, 0 * c]),
    }


def start(dtype: DTypeLike) -> dict[str, Array]:
    return {"q": jnp.asarray(START, dtype), "phase": jnp.asarray([1.0, 0.0, 0.0], dtype)}


def by_solver(solver: cfjax.AbstractSolver, count: int, dtype: DTypeLike = jnp.float32) -> Array:
    t1 = jnp.asarray(STEP * count, dtype)
    sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0 * t1, t1, start(dtype), num_steps=count)
    assert sol.ys is not None
    return sol.ys["q"][-1]


def by_runge_kutta(count: int, is_normalised: bool) -> Array:
    """The classical method, without compensated sums."""

    def add(y: dict[str, Array], factor: float, k: dict[str, Array]) -> dict[str, Array]:
        return jax.tree.map(lambda a, b: a + factor * b, y, k)

    def body(_: int, y: dict[str, Array]) -> dict[str, Array]:
        k1 = in_plain_space(y)
        k2 = in_plain_space(add(y, STEP / 2, k1))
        k3 = in_plain_space(add(y, STEP / 2, k2))
        k4 = in_plain_space(add(y, STEP, k3))
        mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
        y = add(y, STEP, mean)
        return jax.tree.map(lambda x: x / jnp.linalg.norm(x), y) if is_normalised else y

    return jax.jit(lambda y: lax.fori_loop(0, count, body, y))(start(jnp.float32))["q"]


def measure(quick: bool) -> Iterator[results.Row]:
    counts = (1000, 10_000) if quick else COUNTS
    programs: dict[str, Callable[[int], Array]] = {
        name: lambda n, step=step: by_readings(step, n) for name, step in READINGS.items()
    }
    programs |= {
        "classical Runge-Kutta": lambda n: by_runge_kutta(n, False),
        "classical Runge-Kutta, normalised": lambda n: by_runge_kutta(n, True),
        "CF4": lambda n: by_solver(cfjax.CF4(), n),
        "RKMK5": lambda n: by_solver(cfjax.RKMK5(), n),
    }
    exact = {n: np.asarray(by_solver(cfjax.RKMK8(), n, jnp.float64)) for n in counts}
    for name, program in programs.items():
        for count in counts:
            q = np.asarray(program(count), np.float64)
            length = np.linalg.norm(q)
            cosine = min(1.0, abs(q @ exact[count]) / length)
            # Of the sine too: the arc cosine is inaccurate near one.
            across = np.linalg.norm(q / length - np.sign(q @ exact[count]) * exact[count])
            angle = 2 * np.arccos(cosine) if cosine < 0.9 else 4 * np.arcsin(across / 2)
            yield {
                "program": name,
                "steps": count,
                "length less one": results.digits(length - 1),
                "angle": results.digits(angle),
            }


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
