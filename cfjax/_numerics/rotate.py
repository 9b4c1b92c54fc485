"""Rotation of vectors in space by the exponential of a cross product."""

import jax
from jaxtyping import Array, Float

from .stumpff import cotangent_excess, stumpff_1_2_apart
from .vectors import cross, dot, entries, pack


def cross_product(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """The cross product of `a` with a vector, or with every column of a matrix."""
    return pack(cross(entries(a), entries(x)), sums=True)


@jax.jit  # One trace for the many rotations of a step.
def rotate(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """Rotates a vector, or every column of a matrix, about `a` by the angle `|a|`.

    Rodrigues' formula `x + c_1 a*x + c_2 a*(a*x)` with cross products and Stumpff functions
    of `|a|^2`.
    """
    return x + increment(a, x)


@jax.jit
def increment(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """`rotate(a, x) - x`, with a rounding as small as it is.

    The rounding of c_1 and c_2 is the same in every step of equal angle, so lengths would drift
    in proportion to the number of steps. What c_1 and c_2 are at zero is exact, and is kept apart:
    then the roundings are smaller by the square of the angle.
    """
    axis = entries(a)
    near, d1, d2 = stumpff_1_2_apart(dot(axis, axis))
    once = cross(axis, entries(x))
    twice = cross(axis, once)
    return pack(
        [near * (once[i] + twice[i] / 2) + (d1 * once[i] + d2 * twice[i]) for i in range(3)],
        sums=True,
    )


@jax.jit
def dexpinv(a: Float[Array, "3"], x: Float[Array, "3"]) -> Float[Array, "3"]:
    """The inverse derivative of the exponential at `a`, `x - a*x/2 + a*(a*x)/12 - ...`."""
    axis = entries(a)
    excess = cotangent_excess(dot(axis, axis))
    once = cross(axis, entries(x))
    twice = cross(axis, once)
    return pack([x[i] + (excess * twice[i] - once[i] / 2) for i in range(3)], sums=True)
