"""Motion of an extended pose by constant readings of an inertial measurement unit.

A pose is a rotation R with a velocity V and a position P. A motion has an angular velocity w and a
specific force f, which turn with R; a gravity g; a time t, the rate at which P moves with V; and
two velocities of P alone, r, which turns with R, and s:

    R' = R a,  V' = R f + g,  P' = t V + R r + s     (a: the cross product with w).

In the Galilean group this is `X' = G X + X Y` for

    X = [[R, V, P], [0, 1, 0], [0, 0, 1]],  Y = [[a, f, r], [0, 0, t], [0, 0, 0]],
    G = [[0, g, s], [0, 0, -t], [0, 0, 0]],

and products from the left and from the right commute: X goes to `exp(G) X exp(Y)`,

    R E,  V + g + R V_1 f,  P + t V + t g / 2 + s + R (V_1 r + t V_2 f),

with Stumpff functions c_n of |w|^2 and

    E = I + c_1 a + c_2 a^2,  V_1 = I + c_2 a + c_3 a^2,  V_2 = I / 2 + c_3 a + c_4 a^2.

(Barrau & Bonnabel, The geometry of navigation problems, IEEE Trans. Autom. Control 68 (2023).)
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from . import rigid_motion, rotate
from .matmul import matmul
from .quaternion import half, product
from .rigid_motion import (
    Turn,
    doubled,
    half_exponential,
    of_columns,
    of_origin,
    pose,
    pose_parts,
    rotated,
    turn_by,
)
from .stumpff import Exponential
from .vectors import Vector, cross, dot, entries, pack, plus

Coordinates = tuple[
    Float[Array, "3"],
    Float[Array, "3"],
    Float[Array, "3"],
    Float[Array, ""],
    Float[Array, "3"],
    Float[Array, "3"],
]


@functools.partial(jax.jit, static_argnames=("indices",))
def tangent(
    w: Float[Array, "3"],
    f: Float[Array, "3"],
    g: Float[Array, "3"],
    t: Float[Array, ""],
    r: Float[Array, "3"],
    s: Float[Array, "3"],
    x: Float[Array, "..."],
    indices: tuple[int, ...],
) -> Float[Array, "..."]:
    """The velocity of an extended pose `x`, shape `(5, 5)` or `(10,)`.

    One in one vector has w, x, y, z of its quaternion and x, y, z of its velocity and of its
    position at `indices`.
    """
    return _increment(entries(w), entries(f), entries(r), g, t, s, x, indices)


@functools.partial(jax.jit, static_argnames=("indices", "leads_back"))
def increment(
    w: Float[Array, "3"],
    f: Float[Array, "3"],
    g: Float[Array, "3"],
    t: Float[Array, ""],
    r: Float[Array, "3"],
    s: Float[Array, "3"],
    x: Float[Array, "..."],
    indices: tuple[int, ...],
    leads_back: bool,
) -> Float[Array, "..."]:
    """The increment of `x` in unit time, with a rounding error as small as it is.

    If `leads_back`, it also corrects the length of a quaternion towards 1.
    """
    ws, fs = entries(w), entries(f)
    square, of_half = half_exponential(ws)
    exponential = doubled(square, of_half)
    c2, c3 = exponential.near / 2 + exponential.d2, exponential.c3
    # By `c_4(4s) = (1 + c_1) c_3 / 8`.
    c4 = (1 + (of_half.near + of_half.d1)) * (of_half.c3 / 8)
    pairs = list(zip(fs, entries(r), strict=True))
    bent = [c2 * b + (t * c3) * a for a, b in pairs]
    bent = plus(bent, cross(ws, [c3 * b + (t * c4) * a for a, b in pairs]))
    turned = plus([b + (t / 2) * a for a, b in pairs], cross(ws, bent))
    by_force = of_origin(exponential, ws, fs)
    turn = turn_by(square, of_half, leads_back)
    # V moves on in half of the time on average.
    fixed = s + (t / 2) * g
    return _increment(ws, by_force, turned, g, t, fixed, x, indices, exponential, turn)


@functools.partial(jax.jit, static_argnames=("indices",))
def in_body(
    w: Float[Array, "3"],
    f: Float[Array, "3"],
    g: Float[Array, "3"],
    t: Float[Array, ""],
    r: Float[Array, "3"],
    s: Float[Array, "3"],
    x: Float[Array, "..."],
    indices: tuple[int, ...],
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """w, and the velocities of V and P in the coordinates of the body: `f + R^T g` and so on."""
    if x.ndim == 1:
        q, velocity, _ = pose_parts(x, indices)
        back = [q[0], *(-b for b in q[1:])]
        turned = lambda v: pack(rotated(back, entries(v)))  # noqa: E731
        velocity = pack(velocity)
    else:
        turned = lambda v: matmul(x[:3, :3].T, v)  # noqa: E731
        velocity = x[:3, 3]
    return w, f + turned(g), r + turned(t * velocity + s)


@jax.jit
def bracket(
    w1: Float[Array, "3"],
    f1: Float[Array, "3"],
    g1: Float[Array, "3"],
    t1: Float[Array, ""],
    r1: Float[Array, "3"],
    s1: Float[Array, "3"],
    w2: Float[Array, "3"],
    f2: Float[Array, "3"],
    g2: Float[Array, "3"],
    t2: Float[Array, ""],
    r2: Float[Array, "3"],
    s2: Float[Array, "3"],
) -> Coordinates:
    """`xy - yx` for the matrices Y of two motions, and `yx - xy` for their matrices G."""
    w, r = rigid_motion.bracket(w1, r1, w2, r2)
    _, f = rigid_motion.bracket(w1, f1, w2, f2)
    r = r + (t2 * f1 - t1 * f2)
    return w, f, jnp.zeros_like(g2), jnp.zeros_like(t2), r, t2 * g1 - t1 * g2


# Where an inverse derivative of the exponential has a value: it depends on w alone.
has_dexpinv = rotate.has_dexpinv


def _increment(
    w: Vector,
    by_force: Vector,
    turned: Vector,
    g: Array,
    t: Array,
    fixed: Array,
    x: Array,
    indices: tuple[int, ...],
    exponential: Exponential | None = None,
    turn: Turn = lambda q, velocity: velocity,
) -> Array:
    """The increment of `x`, or its velocity if there is no exponential.

    `by_force` and `turned` are increments of V and P that turn with the rotation at the start, g
    and `fixed` those that do not.
    """
    if x.ndim == 1:
        q, velocity, _ = pose_parts(x, indices)
        rotation = turn(q, product(half(w), q, "body"))
        by_force, turned = rotated(q, by_force), rotated(q, turned)
        displacement = plus(plus(turned, [t * b for b in velocity]), entries(fixed))
        return pose([rotation, plus(by_force, entries(g)), displacement], indices)
    *columns, velocity, _ = entries(x[:3].T)
    rotation = of_columns(exponential, w, columns)
    displacement = dot(columns, turned) + (t * velocity + fixed)
    upper = pack([*rotation, dot(columns, by_force) + g, displacement], axis=1)
    return jnp.concatenate([upper, jnp.zeros_like(x[3:])])
