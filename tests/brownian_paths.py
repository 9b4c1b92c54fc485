"""Brownian motions whose increments a test knows, and loops of steps along many of them."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import cfjax


class GivenStep(diffrax.AbstractBrownianPath):
    """One increment W with its space-time Lévy area H, whatever the times."""

    w: Any
    h: Any
    levy_area: Any = eqx.field(static=True, default=diffrax.SpaceTimeLevyArea)

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        assert t1 is not None
        dt = jnp.asarray(t1 - t0)
        return diffrax.SpaceTimeLevyArea(dt=dt, W=self.w, H=self.h) if use_levy else self.w


class FinePath(diffrax.AbstractBrownianPath):
    """A Brownian motion on a fine grid of [0, 1], for steps between points of the grid.

    `values` and `integrals` are those of W and of its integral from 0, both exact in law. So steps
    of all lengths see one Brownian motion, and the area `integral of (W_s - W_t0) / h - W / 2`.
    """

    values: Any
    integrals: Any
    levy_area: Any = eqx.field(static=True, default=diffrax.SpaceTimeLevyArea)

    @classmethod
    def drawn(cls, key: Any, shape: tuple[int, ...], num_steps: int) -> "FinePath":
        d = 1.0 / num_steps
        w, h = jax.random.normal(key, (2, num_steps, *shape), float)
        w, h = w * np.sqrt(d), h * np.sqrt(d / 12)
        start = jnp.zeros((1, *shape))
        values = jnp.concatenate([start, jnp.cumsum(w, 0)])
        parts = d * (values[:-1] + w / 2 + h)
        return cls(values, jnp.concatenate([start, jnp.cumsum(parts, 0)]))

    @property
    def t0(self):
        return 0.0

    @property
    def t1(self):
        return 1.0

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        assert t1 is not None
        size = self.values.shape[0] - 1
        start, end = (jnp.round(t * size).astype(int) for t in (t0, t1))
        w = self.values[end] - self.values[start]
        if not use_levy:
            return w
        dt = jnp.asarray(t1 - t0)
        mean = (self.integrals[end] - self.integrals[start]) / dt - self.values[start]
        return diffrax.SpaceTimeLevyArea(dt=dt, W=w, H=mean - w / 2)


def drawn(seed: int, number: int, shape: tuple[int, ...], num_steps: int) -> FinePath:
    """Many of them, along the first axis."""
    keys = jax.random.split(jax.random.key(seed), number)
    return jax.jit(jax.vmap(lambda key: FinePath.drawn(key, shape, num_steps)))(keys)


@eqx.filter_jit
def ends(
    terms: Callable[[Any], Any], solver: Any, path: Any, y0: Any, num_steps: Array, t1: float = 1.0
) -> Any:
    """Where `num_steps` equal steps to `t1` lead from `y0` along each of many paths.

    `terms(path)` are the terms. The number of steps is traced, so one program serves all.
    """

    def end(path):
        term = terms(path)
        h = t1 / num_steps

        def step(n, carry):
            y, state = carry
            y, _, _, state, _ = solver.step(term, n * h, (n + 1) * h, y, None, state, False)
            return y, state

        carry = y0, solver.init(term, 0.0 * h, h, y0, None)
        return lax.fori_loop(0, num_steps, step, carry)[0]

    return jax.vmap(end)(path)


def rms(a: Any, b: Any) -> float:
    """The root mean square distance of points along the first axis."""
    squares = [jnp.mean(jnp.sum((a[k] - b[k]) ** 2, -1)) for k in a]
    return float(jnp.sqrt(sum(squares)))


def strong_errors(
    terms: Any, solver: Any, path: Any, y0: Any, steps: Sequence[int], reference: Any
) -> np.ndarray:
    """Root mean square distances of the ends from those of the reference."""
    found = [ends(terms, solver, path, y0, jnp.asarray(n)) for n in steps]
    return np.array([rms(end, reference) for end in found])


# Fields on the sphere that depend on the state, and commute neither with each other nor with the
# drift.


def drift_of(y):
    return jnp.stack([0.5 * y[1], 0.7 - 0.3 * y[0] ** 2, -0.4 + 0.6 * y[2]])


def noise_of(y, dw):
    """The angular velocity that an increment of one or two channels causes."""
    first = jnp.stack([0.6 + 0.3 * y[2], 0.2 * y[0], 0.1 + 0.6 * y[1] ** 2])
    second = jnp.stack([-0.6 * y[1], 1.2 - 0.7 * y[0], 0.5 * y[2]])
    return sum(
        (w * v for w, v in zip(dw, (first, second), strict=False)), start=jnp.zeros_like(first)
    )


def drift(t, y, args):
    return {"y": cfjax.Rotation(drift_of(y["y"]))}


def noise(t, y, args, dw):
    return {"y": cfjax.Rotation(noise_of(y["y"], dw))}


def terms(path):
    return diffrax.MultiTerm(cfjax.LieTerm(drift), cfjax.LieControlTerm(noise, path))


SPHERE_START = {"y": jnp.asarray([0.6, 0.0, 0.8])}
