"""The nearest vector of given length."""

import functools
import operator

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Real

from .inverses import inverse_root, reciprocal
from .vectors import Vector, entries, pack, smooth


@smooth
def length_correction(
    y: Vector, v: Vector, is_unit: bool, kept: Real[Array, ""] | None = None
) -> tuple[Vector, Bool[Array, ""]]:
    """v so corrected that `y + v` has the length of y, and whether there is such a vector.

    There is none where `y + v` is off by more than half of its own length. With `is_unit` the
    length is 1, which that of y must be but for a small error. With `kept` it is the root of that,
    from which the length of y differs by rounding, whose derivative is not taken. Vectors are given
    by their entries. The correction is as small as what it corrects, and so is its rounding.
    """
    square = _sum([a * a for a in y])
    e = _sum([(a + a + b) * b for a, b in zip(y, v, strict=True)])
    if is_unit:
        e = e + (square - 1)
    else:
        if kept is not None:
            off = lax.stop_gradient(square - kept)
            e, square = e + off, square - off
        # A vector of length zero does not move.
        e = e / jnp.where(square == 0, 1, square)
    ratio = lax.stop_gradient(1 + e)
    is_there = (ratio >= 4 / 9) & (ratio <= 4)
    e = jnp.where(is_there, e, 0)
    inverse = inverse_root(1 + e)
    factor = -e * inverse * reciprocal(1 + (1 + e) * inverse)
    return [b + factor * (a + b) for a, b in zip(y, v, strict=True)], is_there


def vector_of_length(
    y: Real[Array, " n"],
    v: Real[Array, " n"],
    is_unit: bool,
    kept: Real[Array, ""] | None = None,
) -> tuple[Real[Array, " n"], Bool[Array, ""]]:
    """The same for arrays."""
    if len(y) <= 4:
        corrected, is_there = length_correction(entries(y), entries(v), is_unit, kept)
        return pack(corrected), is_there
    (corrected,), is_there = length_correction([y], [v], is_unit, kept)
    return corrected, is_there


def _sum(terms: Vector) -> Array:
    return jnp.sum(functools.reduce(operator.add, terms))
