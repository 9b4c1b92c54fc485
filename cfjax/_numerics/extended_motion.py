"""Motion of extended poses, a rotation R with a velocity and a position that turn with it.

It is that of `rigid_motion` with two positions, the exponential of

    [[w x, a, v], [0, 0, 0], [0, 0, 0]]  times, or of times it,  [[R, velocity, position], [0, I]].

The algebra is so(3) with two tangent vectors, which do not see each other.
"""

import functools

import jax
from jaxtyping import Array, Float

from . import rigid_motion, rotate
from .vectors import entries


@functools.partial(jax.jit, static_argnames=("frame", "indices"))
def tangent(
    w: Float[Array, "3"],
    a: Float[Array, "3"],
    v: Float[Array, "3"],
    x: Float[Array, "..."],
    frame: str,
    indices: tuple[int, ...],
) -> Float[Array, "..."]:
    """The velocity of an extended pose `x`, shape `(5, 5)` or `(10,)`.

    One in one vector has w, x, y, z of its quaternion and x, y, z of its velocity and of its
    position at `indices`.
    """
    return rigid_motion.increments(entries(w), [entries(a), entries(v)], x, frame, indices)


@functools.partial(jax.jit, static_argnames=("frame", "indices", "leads_back"))
def increment(
    w: Float[Array, "3"],
    a: Float[Array, "3"],
    v: Float[Array, "3"],
    x: Float[Array, "..."],
    frame: str,
    indices: tuple[int, ...],
    leads_back: bool,
) -> Float[Array, "..."]:
    """The increment of `x` in unit time, with a rounding error as small as it is.

    If `leads_back`, it also corrects the length of a quaternion towards 1.
    """
    ws, vs = entries(w), [entries(a), entries(v)]
    exponential = rigid_motion.exponential(ws, x, leads_back)
    return rigid_motion.increments(ws, vs, x, frame, indices, *exponential)


@jax.jit
def bracket(
    w1: Float[Array, "3"],
    a1: Float[Array, "3"],
    v1: Float[Array, "3"],
    w2: Float[Array, "3"],
    a2: Float[Array, "3"],
    v2: Float[Array, "3"],
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """`xy - yx` for the matrices x and y of two motions."""
    w, v = rigid_motion.bracket(w1, v1, w2, v2)
    return w, rigid_motion.bracket(w1, a1, w2, a2)[1], v


@jax.jit
def dexpinv(
    w1: Float[Array, "3"],
    a1: Float[Array, "3"],
    v1: Float[Array, "3"],
    w2: Float[Array, "3"],
    a2: Float[Array, "3"],
    v2: Float[Array, "3"],
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """The inverse derivative of the exponential at the first motion, of the second."""
    _, a = jax.jvp(rotate.dexpinv, (w1, w2), (a1, a2))
    w, v = jax.jvp(rotate.dexpinv, (w1, w2), (v1, v2))
    return w, a, v


# It depends on neither a nor v.
has_dexpinv = rotate.has_dexpinv
