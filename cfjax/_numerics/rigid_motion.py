"""Motion of points and poses in space by the exponential of a screw.

With a the matrix of the cross product with w, and Stumpff functions c_n of |w|^2,

    exp([[a, v], [0, 0]]) = [[R, V v], [0, 1]],  R = I + c_1 a + c_2 a^2,  V = I + c_2 a + c_3 a^2.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import rotate
from .quaternion import half, product
from .stumpff import Exponential, stumpff_1_to_3_apart
from .vectors import Vector, cross, dot, entries, pack, placed, plus


@functools.partial(jax.jit, static_argnames=("frame", "indices"))
def tangent(
    w: Float[Array, "3"],
    v: Float[Array, "3"],
    x: Float[Array, "..."],
    frame: str,
    indices: tuple[int, ...],
) -> Float[Array, "..."]:
    """The velocity of `x`: a point, shape `(3,)`, or a pose, shape `(4, 4)` or `(7,)`.

    A pose in one vector has w, x, y, z of its quaternion and x, y, z of its position at `indices`.
    """
    return _increment(entries(w), entries(v), x, frame, indices)


@functools.partial(jax.jit, static_argnames=("frame", "indices", "leads_back"))
def increment(
    w: Float[Array, "3"],
    v: Float[Array, "3"],
    x: Float[Array, "..."],
    frame: str,
    indices: tuple[int, ...],
    leads_back: bool,
) -> Float[Array, "..."]:
    """The increment of `x` in unit time, with a rounding error as small as it is.

    If `leads_back`, it also corrects the length of a quaternion towards 1.
    """
    ws = entries(w)
    if x.shape != (7,):
        exponential = stumpff_1_to_3_apart(dot(ws, ws))
        return _increment(ws, entries(v), x, frame, indices, exponential)
    # A quaternion turns by half of the angle.
    s = dot(half(ws), half(ws))
    of_half = stumpff_1_to_3_apart(s)

    def turn(q: Vector, velocity: Vector) -> Vector:
        return of_half.turned(s, q, velocity, leads_back)

    return _increment(ws, entries(v), x, frame, indices, _doubled(s, of_half), turn)


@jax.jit
def bracket(
    w1: Float[Array, "3"], v1: Float[Array, "3"], w2: Float[Array, "3"], v2: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """`ab - ba` for the matrices a and b of two motions."""
    a, b = map(entries, (w1, w2))
    v = [x - y for x, y in zip(cross(a, entries(v2)), cross(b, entries(v1)), strict=True)]
    return pack(cross(a, b), sums=True), pack(v, sums=True)


@jax.jit
def dexpinv(
    w1: Float[Array, "3"], v1: Float[Array, "3"], w2: Float[Array, "3"], v2: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """The inverse derivative of the exponential at the first motion, of the second.

    se(3) is the tangent bundle of so(3): (w, v) is the point w with the tangent vector v. So every
    natural map of se(3) is that of so(3) together with its derivative.
    """
    return jax.jvp(rotate.dexpinv, (w1, w2), (v1, v2))


# It does not depend on v.
has_dexpinv = rotate.has_dexpinv


def _increment(
    w: Vector,
    v: Vector,
    x: Array,
    frame: str,
    indices: tuple[int, ...],
    exponential: Exponential | None = None,
    turn: Callable[[Vector, Vector], Vector] = lambda q, velocity: velocity,
) -> Array:
    """The increment of `x` in unit time, or its velocity if there is no exponential.

    `turn` takes a quaternion and its velocity to its increment.
    """
    if x.shape == (3,):
        return pack(_along_screw(exponential, w, v, entries(x), 1), sums=True)
    if x.ndim == 1:
        q, position = [x[k] for k in indices[:4]], [x[k] for k in indices[4:]]
        if frame == "fixed":
            displacement = _along_screw(exponential, w, v, position, 1)
        else:
            displacement = _rotated(q, _of_origin(exponential, w, v))
        rotation = turn(q, product(half(w), q, frame))
        return pack(placed([*rotation, *displacement], indices), sums=True)
    if frame == "fixed":
        *rows, last = entries(x)
        displacement = _along_screw(exponential, w, v, rows, last)
        return pack([*displacement, jnp.zeros_like(last)], sums=True)
    *columns, _ = entries(x.T)
    rotation = cross(columns, w)
    if exponential is not None:
        rotation = exponential.increment(rotation, cross(rotation, w))
    position = dot(columns, _of_origin(exponential, w, v))
    return pack([*rotation, position], axis=1, sums=True)


def _doubled(s: Array, exponential: Exponential) -> Exponential:
    """The exponential of twice the angle, where s is the square of the angle.

    By `c_1(4s) = c_0 c_1`, `c_2(4s) = c_1^2 / 2` and `c_3(4s) = (c_2 + c_0 c_3) / 4`.
    """
    near, d1, d2, c3 = exponential
    c1, c2 = near + d1, near / 2 + d2
    versine = s * c2
    return Exponential(
        near, d1 - versine * c1, d1 * (near + d1 / 2), (c2 + (c3 - versine * c3)) / 4
    )


def _along_screw(
    exponential: Exponential | None, w: Vector, v: Vector, x: Vector, weight: Any
) -> Vector:
    """The increment of a point in homogeneous coordinates, the last of which is the weight.

    With the velocity u of the point it is `c_1 u + c_2 a u + c_3 (w . v) w`.
    """
    velocity = plus(cross(w, x), [weight * b for b in v])
    if exponential is None:
        return velocity
    displacement = exponential.increment(velocity, cross(w, velocity))
    pitch = (exponential.c3 * dot(w, v)) * weight
    return plus(displacement, [pitch * b for b in w])


def _of_origin(exponential: Exponential | None, w: Vector, v: Vector) -> Vector:
    """`V v`, the increment of the origin."""
    if exponential is None:
        return v
    near, _, d2, c3 = exponential
    c2 = near / 2 + d2
    bent = plus([c2 * a for a in v], [c3 * b for b in cross(w, v)])
    return plus(v, cross(w, bent))


def _rotated(q: Vector, y: Vector) -> Vector:
    """The vector `q y q*`."""
    p, *x = q
    along, across = 2 * dot(x, y), cross(x, y)
    shrink = p * p - dot(x, x)
    return [shrink * a + (along * b + (2 * p) * d) for a, b, d in zip(y, x, across, strict=True)]
