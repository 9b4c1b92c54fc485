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
    relative to `1 / |z|`.) Works in float32, float64, complex64 and complex128. Costs one
    exponential, one division and a polynomial of degree 17.
    """
    return _moment(0, z)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _moment(m: int, z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    """The integral of `s^m exp(s z)` over s from 0 to 1: the m-th derivative of phi_1."""
    # The recursion `z I_m = exp(z) - m I_{m-1}` loses digits to cancellation for small z, the
    # series for large z.
    radius = max(1, m)
    small = jnp.abs(z) < radius
    inner = jnp.where(small, z, 0)
    forward = _series(m, radius, inner)
    if m == 0:
        series, rest = forward, 1
    else:
        # Kummer's transformation: for Re z < 0 the terms of this one do not cancel.
        reflected = jnp.exp(inner) * _reflected_series(m, radius, -inner)
        series, rest = jnp.where(inner.real < 0, reflected, forward), m * _moment(m - 1, z)
    return jnp.where(small, series, (jnp.exp(z) - rest) / jnp.where(small, 1, z))


@_moment.defjvp
def _(m, primals, tangents):
    (z,), (z_dot,) = primals, tangents
    return _moment(m, z), _moment(m + 1, z) * z_dot


def _series(m: int, radius: int, z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    return polynomial([1 / (factorial(j) * (m + j + 1)) for j in range(_terms(radius))], z)


def _reflected_series(m: int, radius: int, z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    return polynomial([factorial(m) / factorial(m + j + 1) for j in range(_terms(radius))], z)


def _terms(radius: int) -> int:
    """So many that the first one left out is below rounding, for z up to the radius."""
    j = 1
    while radius**j / factorial(j) > 2.0**-54:
        j += 1
    return j
