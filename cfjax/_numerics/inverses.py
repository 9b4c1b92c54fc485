"""Inverses and inverse roots of positive numbers, by products alone.

XLA materialises every division and square root, which in a loop of small steps costs more than the
arithmetic, and cuts the program where several results need one. A first guess comes from the
exponent bits. Other precisions than float32 and float64 take the functions of JAX.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .polynomial import polynomial


@jax.custom_jvp
def reciprocal(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """`1 / x` for a positive x."""
    constants = _constants(x)
    if constants is None:
        return 1 / x
    bits = lax.bitcast_convert_type(x, constants.bits)
    # Off by 5.1 % at most.
    guess = lax.bitcast_convert_type(constants.reciprocal_seed - bits, x.dtype)
    e = 1 - x * guess
    square = e * e
    guess = guess * (1 + e) * (1 + square) * (1 + square * square)
    return guess + guess * (1 - x * guess)


@reciprocal.defjvp
def _(primals, tangents):
    y = reciprocal(*primals)
    return y, -(y * y) * tangents[0]


@jax.custom_jvp
def inverse_root(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """`1 / sqrt(x)` for a positive x, to two units of rounding."""
    guess, correction = factors_of_inverse_root(x)
    return guess * correction


@inverse_root.defjvp
def _(primals, tangents):
    y = inverse_root(*primals)
    return y, -0.5 * (y * (y * y)) * tangents[0]


def factors_of_inverse_root(
    x: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """A guess, and what makes the inverse root of it: finite at zero, too."""
    constants = _constants(x)
    if constants is None:
        return lax.rsqrt(x), jnp.ones_like(x)
    bits = lax.bitcast_convert_type(x, constants.bits)
    guess = lax.bitcast_convert_type(constants.root_seed - (bits >> 1), x.dtype)
    return guess, polynomial(constants.root, 1 - (x * guess) * guess)


class _Constants(NamedTuple):
    root: Sequence[float]  # 1 / sqrt(1 - e) for |e| <= 0.0682, interpolated at Chebyshev nodes
    root_seed: int
    reciprocal_seed: int
    bits: Any


def _constants(x: Array) -> _Constants | None:
    return _OF_PRECISION.get(x.dtype.name)


_OF_PRECISION = {
    "float64": _Constants(
        root=(
            *(1.0, 0.500000000000004, 0.37500000000000383, 0.3124999999828909),
            *(0.2734374999836026, 0.2460937705876731, 0.22558595723120636, 0.20946255027202312),
            *(0.19637092974129178, 0.18763809600293596, 0.17827435092178798),
        ),
        root_seed=0x5FE6E8EABEAD1636,
        reciprocal_seed=0x7FDE623822FC16E6,
        bits=jnp.int64,
    ),
    "float32": _Constants(
        root=(1.0, 0.49999833, 0.37499848, 0.3139365, 0.2747544),
        root_seed=0x5F374755,
        reciprocal_seed=0x7EF311C7,
        bits=jnp.int32,
    ),
}
