"""Rotation of vectors in space by the exponential of a cross product."""

import jax
from jaxtyping import Array, Bool, Float

from .stumpff import dexpinv_times, is_below_full_turn, stumpff_1_to_3_apart
from .vectors import cross, dot, entries, pack


def cross_product(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """The cross product of `a` with a vector, or with every column of a matrix."""
    return pack(cross(entries(a), entries(x)))


@jax.jit  # One trace for the many rotations of a step.
def rotate(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """Rotates a vector, or every column of a matrix, about `a` by the angle `|a|`.

    Rodrigues' formula `x + c_1 a*x + c_2 a*(a*x)` with cross products and Stumpff functions
    of `|a|^2`.
    """
    return x + increment(a, x)


@jax.jit
def increment(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """`rotate(a, x) - x`, with a rounding error as small as it is."""
    axis = entries(a)
    velocity = cross(axis, entries(x))
    exponential = stumpff_1_to_3_apart(dot(axis, axis))
    return pack(exponential.increment(velocity, cross(axis, velocity)))


@jax.jit
def mean(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """The mean of `rotate(s a, x)` over s from 0 to 1, `x + c_2 a*x + c_3 a*(a*x)`."""
    axis, xs = entries(a), entries(x)
    velocity = cross(axis, xs)
    near, _, d2, c3 = stumpff_1_to_3_apart(dot(axis, axis))
    c2 = near / 2 + d2
    terms = zip(xs, velocity, cross(axis, velocity), strict=True)
    return pack([x + (c2 * v + c3 * w) for x, v, w in terms])


@jax.jit
def dexpinv(a: Float[Array, "3"], x: Float[Array, "3"]) -> Float[Array, "3"]:
    """The inverse derivative of the exponential at `a`, `x - a*x/2 + a*(a*x)/12 - ...`."""
    axis, xs = entries(a), entries(x)
    velocity = cross(axis, xs)
    return pack(dexpinv_times(dot(axis, axis), xs, velocity, cross(axis, velocity)))


def has_dexpinv(a: Float[Array, "*batch 3"]) -> Bool[Array, ""]:
    """Whether `dexpinv` has a value at all of these."""
    axis = [a[..., k] for k in range(3)]
    return is_below_full_turn(dot(axis, axis))
