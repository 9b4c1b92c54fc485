"""Motion of points and poses in the plane.

In complex numbers a point x moves with the velocity `i w x + v`, and the direction z of a pose with
`i w z`. In unit time each moves by its velocity times `phi_1(i w) = c_1 + i w c_2`, with Stumpff
functions c_n of w^2.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .stumpff import dexpinv_times, is_below_full_turn, stumpff_1_to_3_apart
from .vectors import Vector, entries, pack, placed, plus


@functools.partial(jax.jit, static_argnames=("frame", "indices"))
def tangent(
    w: Float[Array, ""],
    v: Float[Array, "2"],
    x: Float[Array, "..."],
    frame: str,
    indices: tuple[int, ...],
) -> Float[Array, "..."]:
    """The velocity of `x`: a point, shape `(2,)`, or a pose, shape `(3, 3)` or `(4,)`.

    A pose in one vector has cosine and sine and x, y of its position at `indices`.
    """
    return _increment(lambda w, u: u, _times_i, w, v, x, frame, indices)


@functools.partial(jax.jit, static_argnames=("frame", "indices", "leads_back"))
def increment(
    w: Float[Array, ""],
    v: Float[Array, "2"],
    x: Float[Array, "..."],
    frame: str,
    indices: tuple[int, ...],
    leads_back: bool,
) -> Float[Array, "..."]:
    """The increment of `x` in unit time, with a rounding error as small as it is.

    If `leads_back`, it also corrects the length of a direction towards 1.
    """
    exponential = stumpff_1_to_3_apart(w * w)

    def displacement(w: Array, u: Vector) -> Vector:
        return exponential.increment(u, _times_i(w, u))

    def turn(w: Array, z: Vector) -> Vector:
        return exponential.turned(w * w, z, _times_i(w, z), leads_back)

    return _increment(displacement, turn, w, v, x, frame, indices)


@jax.jit
def bracket(
    w1: Float[Array, ""], v1: Float[Array, "2"], w2: Float[Array, ""], v2: Float[Array, "2"]
) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """`ab - ba` for the matrices a and b of two motions."""
    return jnp.zeros_like(w1), pack(_bracket(w1, v1, w2, v2))


@jax.jit
def dexpinv(
    w1: Float[Array, ""], v1: Float[Array, "2"], w2: Float[Array, ""], v2: Float[Array, "2"]
) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """The inverse derivative of the exponential at the first motion, of the second."""
    # The bracket of two motions of the plane is a translation, u.
    u = _bracket(w1, v1, w2, v2)
    return w2, pack(dexpinv_times(w1 * w1, entries(v2), u, _times_i(w1, u)))


def has_dexpinv(w: Float[Array, "*batch"]) -> Bool[Array, ""]:
    """Whether `dexpinv` has a value at all of these, which does not depend on v."""
    return is_below_full_turn(w * w)


def _increment(
    displacement: Callable[[Array, Vector], Vector],
    turn: Callable[[Array, Vector], Vector],
    w: Array,
    v: Array,
    x: Array,
    frame: str,
    indices: tuple[int, ...],
) -> Array:
    """The increment of `x`.

    `displacement` takes w and a velocity that turns with w to the increment of a point, and `turn`
    takes w and the direction of a pose in one vector to its increment.
    """
    vs = entries(v)
    if x.ndim == 2 and frame == "body":
        # A row of the matrix turns with -w.
        r0, r1 = x[:, 0], x[:, 1]
        v0, v1 = displacement(w, vs)
        rotation = displacement(-w, _times_i(-w, [r0, r1]))
        return pack([*rotation, r0 * v0 + r1 * v1], axis=1)
    if x.ndim == 2:
        *rows, last = entries(x)
        u = plus(_times_i(w, rows), [last * a for a in vs])
        return pack([*displacement(w, u), jnp.zeros_like(last)])
    if x.shape == (2,):
        return pack(displacement(w, plus(_times_i(w, entries(x)), vs)))
    z, position = [x[k] for k in indices[:2]], [x[k] for k in indices[2:]]
    if frame == "fixed":
        u = plus(_times_i(w, position), vs)
    else:
        u = plus([z[0] * a for a in vs], _times_i(z[1], vs))
    return pack(placed([*turn(w, z), *displacement(w, u)], indices))


def _times_i(w: Any, x: Vector) -> Vector:
    """`i w x`."""
    return [-(w * x[1]), w * x[0]]


def _bracket(w1: Array, v1: Array, w2: Array, v2: Array) -> Vector:
    return plus(_times_i(w1, entries(v2)), _times_i(-w2, entries(v1)))
