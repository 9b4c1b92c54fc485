"""Motion of points and poses in space by the exponential of a screw.

With a the matrix of the cross product with w, and Stumpff functions c_n of |w|^2,

    exp([[a, v], [0, 0]]) = [[R, V v], [0, 1]],  R = I + c_1 a + c_2 a^2,  V = I + c_2 a + c_3 a^2.

`increments` takes several velocities too, for as many positions that turn together: see
`extended_motion`.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
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
    return increments(entries(w), [entries(v)], x, frame, indices)


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
    return increments(ws, [entries(v)], x, frame, indices, *exponential(ws, x, leads_back))


@jax.jit
def bracket(
    w1: Float[Array, "3"], v1: Float[Array, "3"], w2: Float[Array, "3"], v2: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """`ab - ba` for the matrices a and b of two motions."""
    a, b = map(entries, (w1, w2))
    v = [x - y for x, y in zip(cross(a, entries(v2)), cross(b, entries(v1)), strict=True)]
    return pack(cross(a, b)), pack(v)


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


# A quaternion and its velocity to its increment.
Turn = Callable[[Vector, Vector], Vector]


def exponential(w: Vector, x: Array, leads_back: bool) -> tuple[Exponential, Turn]:
    """The exponential of w, and what turns the quaternion of a pose `x` in one vector."""
    if x.ndim != 1 or x.shape == (3,):
        return stumpff_1_to_3_apart(dot(w, w)), _velocity
    s, of_half = half_exponential(w)
    return doubled(s, of_half), turn_by(s, of_half, leads_back)


def half_exponential(w: Vector) -> tuple[Array, Exponential]:
    """The exponential of half of w, by which a quaternion turns, after the square of its angle."""
    s = dot(half(w), half(w))
    return s, stumpff_1_to_3_apart(s)


def turn_by(s: Array, of_half: Exponential, leads_back: bool) -> Turn:
    return lambda q, velocity: of_half.turned(s, q, velocity, leads_back)


def _velocity(q: Vector, velocity: Vector) -> Vector:
    return velocity


def increments(
    w: Vector,
    vs: Sequence[Vector],
    x: Array,
    frame: str,
    indices: tuple[int, ...],
    exponential: Exponential | None = None,
    turn: Turn = _velocity,
) -> Array:
    """The increment of `x` in unit time, or its velocity if there is no exponential.

    A pose has one position for each of the velocities `vs`: shape `(3 + k, 3 + k)` or
    `(4 + 3 k,)`, in which the entries of the quaternion and of the positions are at `indices`.
    """
    if x.shape == (3,):
        return pack(_along_screw(exponential, w, vs, entries(x), [1]))
    if x.ndim == 1:
        q, *positions = pose_parts(x, indices)
        if frame == "fixed":
            pairs = zip(vs, positions, strict=True)
            displacements = [_along_screw(exponential, w, [v], y, [1]) for v, y in pairs]
        else:
            displacements = [rotated(q, of_origin(exponential, w, v)) for v in vs]
        rotation = turn(q, product(half(w), q, frame))
        return pose([rotation, *displacements], indices)
    if frame == "fixed":
        rows = entries(x)
        displacement = _along_screw(exponential, w, vs, rows[:3], rows[3:])
        return pack([*displacement, *(jnp.zeros_like(row) for row in rows[3:])])
    columns = entries(x.T)[:3]
    rotation = of_columns(exponential, w, columns)
    positions = [dot(columns, of_origin(exponential, w, v)) for v in vs]
    return pack([*rotation, *positions], axis=1)


def pose_parts(x: Array, indices: tuple[int, ...]) -> list[Vector]:
    """The quaternion and the positions of a pose in one vector."""
    ends = [0, *range(4, len(indices) + 1, 3)]
    return [[x[k] for k in indices[i:j]] for i, j in itertools.pairwise(ends)]


def pose(parts: Sequence[Vector], indices: tuple[int, ...]) -> Array:
    """The inverse of `pose_parts`."""
    return pack(placed([a for part in parts for a in part], indices))


def of_columns(exponential: Exponential | None, w: Vector, columns: Vector) -> Vector:
    """The increment of the columns of a rotation R to `R exp(a)`."""
    rotation = cross(columns, w)
    return rotation if exponential is None else exponential.increment(rotation, cross(rotation, w))


def doubled(s: Array, exponential: Exponential) -> Exponential:
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
    exponential: Exponential | None,
    w: Vector,
    vs: Sequence[Vector],
    x: Vector,
    weights: Sequence[Any],
) -> Vector:
    """The increment of a point in homogeneous coordinates, which end with the weights of `vs`.

    With the velocity u of the point it is `c_1 u + c_2 a u + c_3 (w . v) w`, where v is the sum of
    the weighted `vs`.
    """
    pairs = list(zip(vs, weights, strict=True))
    velocity = functools.reduce(plus, ([m * b for b in v] for v, m in pairs), cross(w, x))
    if exponential is None:
        return velocity
    displacement = exponential.increment(velocity, cross(w, velocity))
    for v, weight in pairs:
        pitch = (exponential.c3 * dot(w, v)) * weight
        displacement = plus(displacement, [pitch * b for b in w])
    return displacement


def of_origin(exponential: Exponential | None, w: Vector, v: Vector) -> Vector:
    """`V v`, the increment of the origin."""
    if exponential is None:
        return v
    near, _, d2, c3 = exponential
    c2 = near / 2 + d2
    bent = plus([c2 * a for a in v], [c3 * b for b in cross(w, v)])
    return plus(v, cross(w, bent))


def rotated(q: Vector, y: Vector) -> Vector:
    """The vector `q y q*`."""
    p, *x = q
    along, across = 2 * dot(x, y), cross(x, y)
    shrink = p * p - dot(x, x)
    return [shrink * a + (along * b + (2 * p) * d) for a, b, d in zip(y, x, across, strict=True)]
