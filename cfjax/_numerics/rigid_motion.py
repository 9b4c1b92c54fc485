"""Motion of points and poses in space by the exponential of a screw.

With a the matrix of the cross product with w, and Stumpff functions c_n of |w|^2,

    exp([[a, v], [0, 0]]) = [[R, V v], [0, 1]],  R = I + c_1 a + c_2 a^2,  V = I + c_2 a + c_3 a^2.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import rotate
from .stumpff import stumpff_1_to_3_apart
from .vectors import Vector, cross, dot, entries, pack


@functools.partial(jax.jit, static_argnames="frame")
def tangent(
    w: Float[Array, "3"], v: Float[Array, "3"], x: Float[Array, "..."], frame: str
) -> Float[Array, "..."]:
    """The velocity of `x`: a point, shape `(3,)`, or a pose, shape `(4, 4)` or `(7,)`."""
    ws, vs, xs = map(entries, (w, v, x))
    if x.shape == (3,):
        return pack(_velocity(ws, vs, xs, 1), sums=True)
    if x.ndim == 2 and frame == "fixed":
        *rows, last = xs
        return pack([*_velocity(ws, vs, rows, last), jnp.zeros_like(last)], sums=True)
    if x.ndim == 2:
        *columns, _ = entries(x.T)
        return pack([*cross(columns, ws), dot(columns, vs)], axis=1, sums=True)
    q, place = xs[:4], xs[4:]
    velocity = _velocity(ws, vs, place, 1) if frame == "fixed" else _rotated(q, vs)
    return pack([*_product(q, _half(ws), frame), *velocity], sums=True)


@functools.partial(jax.jit, static_argnames="frame")
def increment(
    w: Float[Array, "3"], v: Float[Array, "3"], x: Float[Array, "..."], frame: str
) -> Float[Array, "..."]:
    """What `x` moves by in unit time, with a rounding as small as it is."""
    ws, vs, xs = map(entries, (w, v, x))
    if x.shape == (7,):
        return _increment_of_quaternion(ws, vs, xs, frame)
    c = _Coefficients(*stumpff_1_to_3_apart(dot(ws, ws)))
    if x.ndim == 1:
        return pack(_along_screw(c, ws, vs, xs, 1), sums=True)
    if frame == "fixed":
        *rows, last = xs
        return pack([*_along_screw(c, ws, vs, rows, last), jnp.zeros_like(last)], sums=True)
    *columns, _ = entries(x.T)
    once = cross(columns, ws)
    turned = _turned(c, once, cross(once, ws))
    return pack([*turned, dot(columns, _way(c, ws, vs))], axis=1, sums=True)


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

    The algebra of rigid motions is the tangent bundle of that of rotations: (w, v) is the point w
    and its rate v, and so every natural map of the one is that of the other with its derivative.
    """
    return jax.jvp(rotate.dexpinv, (w1, w2), (v1, v2))


def _increment_of_quaternion(w: Vector, v: Vector, x: Vector, frame: str) -> Array:
    q, x = x[:4], x[4:]
    half = _half(w)
    s = dot(half, half)
    c = _Coefficients(*stumpff_1_to_3_apart(s))
    once = _product(q, half, frame)
    turned = _turned(c, once, _product(once, half, frame))
    c = _doubled(s, c)
    moved = _along_screw(c, w, v, x, 1) if frame == "fixed" else _rotated(q, _way(c, w, v))
    return pack([*turned, *moved], sums=True)


class _Coefficients(NamedTuple):
    """`c_1 = near + d1`, `c_2 = near / 2 + d2` and `c_3`.

    What c_1 and c_2 are at zero is apart for the reason that `rotate.increment` gives.
    """

    near: Array
    d1: Array
    d2: Array
    c3: Array


def _doubled(s: Array, c: _Coefficients) -> _Coefficients:
    """The coefficients at the angle twice that of c, which has the square s.

    By `c_1(4s) = c_0 c_1`, `c_2(4s) = c_1^2 / 2` and `c_3(4s) = (c_2 + c_0 c_3) / 4`.
    """
    near, d1, d2, c3 = c
    c1, c2 = near + d1, near / 2 + d2
    versine = s * c2
    return _Coefficients(
        near, d1 - versine * c1, d1 * (near + d1 / 2), (c2 + (c3 - versine * c3)) / 4
    )


def _turned(c: _Coefficients, once: Vector, twice: Vector) -> Vector:
    """`c_1 A x + c_2 A^2 x` from `A x` and `A^2 x`."""
    return [c.near * (a + b / 2) + (c.d1 * a + c.d2 * b) for a, b in zip(once, twice, strict=True)]


def _velocity(w: Vector, v: Vector, x: Vector, weight: Any) -> Vector:
    """Of a point in homogeneous coordinates, the last of which is the weight."""
    return [a + weight * b for a, b in zip(cross(w, x), v, strict=True)]


def _along_screw(c: _Coefficients, w: Vector, v: Vector, x: Vector, weight: Any) -> Vector:
    """What such a point moves by: with its velocity u, `c_1 u + c_2 a u + c_3 (w . v) w`."""
    once = _velocity(w, v, x, weight)
    turned = _turned(c, once, cross(w, once))
    pitch = (c.c3 * dot(w, v)) * weight
    return [a + pitch * b for a, b in zip(turned, w, strict=True)]


def _way(c: _Coefficients, w: Vector, v: Vector) -> Vector:
    """`V v`, the way of the origin."""
    c2 = c.near / 2 + c.d2
    once = cross(w, v)
    bend = cross(w, [c2 * a + c.c3 * b for a, b in zip(v, once, strict=True)])
    return [a + b for a, b in zip(v, bend, strict=True)]


def _product(q: Vector, w: Vector, frame: str) -> Vector:
    """The quaternion `w q` in the fixed frame or `q w` in the body's, for a vector w."""
    p, *x = q
    across = cross(w, x) if frame == "fixed" else cross(x, w)
    return [-dot(x, w), *(p * a + b for a, b in zip(w, across, strict=True))]


def _rotated(q: Vector, y: Vector) -> Vector:
    """The vector `q y q*`."""
    p, *x = q
    along, across = 2 * dot(x, y), cross(x, y)
    shrink = p * p - dot(x, x)
    return [shrink * a + (along * b + (2 * p) * d) for a, b, d in zip(y, x, across, strict=True)]


def _half(w: Vector) -> Vector:
    return [a / 2 for a in w]
