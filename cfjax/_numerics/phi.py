"""The function phi_1 of exponential integrators, smooth at zero and everywhere."""

import functools
from math import factorial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from .polynomial import polynomial


def phi_1(z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    """The function `phi_1(z) = (exp(z) - 1) / z`, with `phi_1(0) = 1`, entry by entry.

    The error is a few units of rounding for every real or complex `z`, small or large, and so is
    that of its derivatives of every order, at zero too. (Near its zeros `2 pi i k` the error is
    relative to `1 / |z|`.) Works in float32, float64, complex64 and complex128. Costs about
    two exponentials.
    """
    return _moment(0, z)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _moment(m: int, z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    """The integral of `s^m exp(s z)` over s from 0 to 1: the m-th derivative of phi_1."""
    # A large polynomial keeps XLA:CPU from using vector instructions, so there is none in the
    # value. The small one is for loops, which may lose the rule of the derivative below.
    radius = float(max(2**-10, m))
    small = jnp.abs(z) < radius
    inner, outer = jnp.where(small, z, 0), jnp.where(small, 1, z)
    series = polynomial([1 / (factorial(j) * (m + j + 1)) for j in range(_terms(radius))], inner)
    if m == 0:
        return jnp.where(small, series, jnp.expm1(z) / outer)
    # Kummer's transformation: for Re z < 0 the terms of this one do not cancel.
    weights = [factorial(m) / factorial(m + j + 1) for j in range(_terms(radius))]
    reflected = jnp.exp(inner) * polynomial(weights, -inner)
    series = jnp.where(inner.real < 0, reflected, series)
    # The recursion loses digits to cancellation for small z, the series for large z.
    return jnp.where(small, series, (jnp.exp(z) - m * _moment(m - 1, z)) / outer)


@_moment.defjvp
def _(m, primals, tangents):
    (z,), (z_dot,) = primals, tangents
    return _moment(m, z), _moment(m + 1, z) * z_dot


def _terms(radius: float) -> int:
    """So many that the first one left out is below rounding, for z up to the radius."""
    j = 1
    while radius**j / factorial(j) > 2.0**-54:
        j += 1
    return j
