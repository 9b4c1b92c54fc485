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


@functools.partial(jax.jit, static_argnames=("frame", "places"))
def tangent(
    w: Float[Array, "3"],
    v: Float[Array, "3"],
    x: Float[Array, "..."],
    frame: str,
    places: tuple[int, ...],
) -> Float[Array, "..."]:
    """The velocity of `x`: a point, shape `(3,)`, or a pose, shape `(4, 4)` or `(7,)`.

    A pose in one vector has w, x, y, z of its quaternion and x, y, z of its position at `places`.
    """
    return _moved(entries(w), entries(v), x, frame, places)


@functools.partial(jax.jit, static_argnames=("frame", "places", "leads_back"))
def increment(
    w: Float[Array, "3"],
    v: Float[Array, "3"],
    x: Float[Array, "..."],
    frame: str,
    places: tuple[int, ...],
    leads_back: bool,
) -> Float[Array, "..."]:
    """What `x` moves by in unit time, with a rounding as small as it is.

    It may lead the length of a quaternion back to 1.
    """
    ws = entries(w)
    if x.shape != (7,):
        exponential = stumpff_1_to_3_apart(dot(ws, ws))
        return _moved(ws, entries(v), x, frame, places, exponential)
    # A quaternion turns by half of the angle.
    s = dot(half(ws), half(ws))
    of_half = stumpff_1_to_3_apart(s)

    def turned(q: Vector, once: Vector) -> Vector:
        return of_half.turned(s, q, once, leads_back)

    return _moved(ws, entries(v), x, frame, places, _doubled(s, of_half), turned)


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


# Whatever the velocity is.
has_dexpinv = rotate.has_dexpinv


def _moved(
    w: Vector,
    v: Vector,
    x: Array,
    frame: str,
    places: tuple[int, ...],
    exponential: Exponential | None = None,
    turned: Callable[[Vector, Vector], Vector] = lambda q, once: once,
) -> Array:
    """What `x` moves by in unit time, or its velocity if there is no exponential.

    `turned` is what a quaternion turns by, from itself and its velocity.
    """
    if x.shape == (3,):
        return pack(_along_screw(exponential, w, v, entries(x), 1), sums=True)
    if x.ndim == 1:
        q, place = [x[k] for k in places[:4]], [x[k] for k in places[4:]]
        if frame == "fixed":
            moved = _along_screw(exponential, w, v, place, 1)
        else:
            moved = _rotated(q, _way(exponential, w, v))
        turned_q = turned(q, product(half(w), q, frame))
        return pack(placed([*turned_q, *moved], places), sums=True)
    if frame == "fixed":
        *rows, last = entries(x)
        moved = _along_screw(exponential, w, v, rows, last)
        return pack([*moved, jnp.zeros_like(last)], sums=True)
    *columns, _ = entries(x.T)
    once = cross(columns, w)
    if exponential is not None:
        once = exponential.increment(once, cross(once, w))
    return pack([*once, dot(columns, _way(exponential, w, v))], axis=1, sums=True)


def _doubled(s: Array, exponential: Exponential) -> Exponential:
    """That at twice the angle, whose square is s.

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
    """What a point in homogeneous coordinates, the last of which is the weight, moves by.

    With its velocity u it is `c_1 u + c_2 a u + c_3 (w . v) w`.
    """
    once = plus(cross(w, x), [weight * b for b in v])
    if exponential is None:
        return once
    turned = exponential.increment(once, cross(w, once))
    pitch = (exponential.c3 * dot(w, v)) * weight
    return plus(turned, [pitch * b for b in w])


def _way(exponential: Exponential | None, w: Vector, v: Vector) -> Vector:
    """`V v`, the way of the origin."""
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
