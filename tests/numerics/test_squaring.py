"""Squarings of what was scaled down by a power of two: exponents, batches, derivatives."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrices import random
from xla.interpreter import run

from cfjax._numerics.squaring import exponent, magnitude, max_over_batch, squared, squarings

SIZES = [1e-300, 0.3, np.nextafter(0.5, 0), 0.5, 0.75, 1.0, np.nextafter(1.0, 2), 3.0, 4.0, 1e300]


def test_the_exponent_is_that_of_frexp(subtests):
    for size in SIZES:
        with subtests.test(size=str(size)):
            assert run(exponent, np.asarray(size)) == math.frexp(size)[1]


def test_exponents_and_powers_at_the_ends_of_a_precision():
    for dtype, integer in ((np.float32, np.int32), (np.float64, np.int64)):
        info = jnp.finfo(dtype)
        assert run(exponent, np.asarray(info.max, dtype)) == info.maxexp
        assert run(exponent, np.zeros((), dtype)) < -100
        for bad in (np.inf, np.nan):
            assert run(exponent, np.asarray(bad, dtype)) > info.maxexp
        of_dtype = partial(squarings, dtype=jnp.dtype(dtype))
        # Integers as `exponent` gives them.
        for s in (0, 1, 7, info.nmant):
            number, power = run(of_dtype, np.asarray(s, integer))
            assert (number, power) == (s, 2.0**-s)
            assert power.dtype == dtype
        # No digit would be left.
        number, power = run(of_dtype, np.asarray(info.nmant + 1, integer))
        assert number == 0 and np.isnan(power)


def test_the_magnitude_of_a_complex_number():
    np.testing.assert_array_equal(run(magnitude, np.asarray([3 - 4j, -1j])), [7, 1])
    np.testing.assert_array_equal(run(magnitude, np.asarray([-2.0, 1.0])), [2, 1])


def test_the_maximum_over_a_batch_without_what_is_not_a_number():
    found = run(jax.vmap(max_over_batch), np.asarray([1.0, np.nan, 3.0]))
    np.testing.assert_array_equal(found, [3, 3, 3])
    assert max_over_batch(jnp.asarray(2.0)) == 2


def powers(a, s):
    return squared(a, lambda x: x, s)


# Sizes whose products fuse, and one with a loop.
@pytest.mark.parametrize("n", [3, 6])
def test_each_member_of_a_batch_is_squared_as_often_as_it_needs(n):
    a, s = random((5, n, n)), np.array([0, 1, 2, 5, 7])
    a = a / np.linalg.norm(a, 2, axis=(1, 2))[:, None, None]
    found = run(jax.vmap(powers), a, np.asarray(s, np.int32))
    for x, b, k in zip(found, a, s, strict=True):
        # A few roundings of entries below 1 in each product, doubled by every other.
        expected = np.linalg.matrix_power(b, 2**k)
        np.testing.assert_allclose(x, expected, rtol=0, atol=2**k * n * 2.0**-52)


def test_none_are_started_where_there_is_no_squaring():
    a = jnp.asarray(random((3, 3)))
    fun = lambda a, s: squared(a, lambda x: x + jnp.eye(3), s)  # noqa: E731
    found = [run(fun, a, np.asarray(s, np.int32)) for s in (0, 1)]
    np.testing.assert_array_equal(found[0], a)
    with_start = np.linalg.matrix_power(np.asarray(a) + np.eye(3), 2)
    np.testing.assert_allclose(found[1], with_start, rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [3, 6])
def test_derivatives_of_powers(n):
    """The trace of (t a)^m has the derivative m times itself at t = 1, m = 2^s, in both modes."""
    a = random((n, n))
    a = jnp.asarray(a / np.linalg.norm(a, 2))

    @jax.jit
    def both_modes(s):
        trace = lambda t: jnp.trace(powers(t * a, s))  # noqa: E731
        return jax.grad(trace)(1.0), jax.jvp(trace, (1.0,), (1.0,))[1]

    for s in (0, 3, 6):
        m = 2**s
        expected = m * np.trace(np.linalg.matrix_power(np.asarray(a), m))
        for found in run(both_modes, np.asarray(s, np.int32)):
            np.testing.assert_allclose(found, expected, rtol=0, atol=m * m * n * 2.0**-52)
