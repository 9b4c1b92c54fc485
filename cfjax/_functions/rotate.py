"""Rotation of vectors in space by the exponential of a cross product."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .stumpff import stumpff_1_2


def cross(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """The cross product of `a` with a vector, or with every column of a matrix."""
    return _vector(_cross((a[0], a[1], a[2]), (x[0], x[1], x[2])))


@jax.jit  # One trace for the many rotations of a step.
def rotate(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """Rotates a vector, or every column of a matrix, about `a` by the angle `|a|`.

    Rodrigues' formula `x + c_1 a*x + c_2 a*(a*x)` with cross products and Stumpff functions
    of `|a|^2`.
    """
    return x + displacement(a, x)


@jax.jit
def displacement(a: Float[Array, "3"], x: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
    """`rotate(a, x) - x`, with a rounding as small as it is."""
    a0, a1, a2 = a[0], a[1], a[2]
    s = a0 * a0 + a1 * a1 + a2 * a2
    c1, c2 = stumpff_1_2(s)
    once = _cross((a0, a1, a2), (x[0], x[1], x[2]))
    twice = _cross((a0, a1, a2), once)
    return _vector(
        tuple(c1 * once[i] + c2 * twice[i] for i in range(3)),
    )


def _cross(a, x):
    return (
        a[1] * x[2] - a[2] * x[1],
        a[2] * x[0] - a[0] * x[2],
        a[0] * x[1] - a[1] * x[0],
    )


def _vector(components):
    # Not `jnp.stack`: in a batch XLA computes what is stacked once for every component. Not `pack`:
    # the sums in the derivative of this form stop XLA from computing columns anew for every use.
    shape = (3, *components[0].shape)
    row = [np.arange(3).reshape(3, *(1,) * (len(shape) - 1)) == k for k in range(2)]
    rest = jnp.broadcast_to(components[2], shape)
    for is_row, component in zip(row, components, strict=False):
        rest = jnp.where(np.broadcast_to(is_row, shape), jnp.broadcast_to(component, shape), rest)
    return rest
