"""Polynomials with known coefficients, against NumPy's."""

import jax.numpy as jnp
import numpy as np

from cfjax._numerics.polynomial import polynomial


def test_polynomials_of_every_length(subtests):
    for size in (2, 3, 4, 7, 8, 13):
        rng = np.random.default_rng(size)
        coefficients, x = rng.normal(size=size), rng.uniform(-1, 1, (2, 5))
        found = polynomial(coefficients.tolist(), jnp.asarray(x))
        want = np.polynomial.polynomial.polyval(x, coefficients)
        with subtests.test(size=str(size)):
            # A rounding for each term, of size 3 at most.
            np.testing.assert_allclose(found, want, rtol=0, atol=3 * size * 2.0**-52)


def test_a_polynomial_has_the_dtype_of_its_argument():
    for dtype in (np.float32, np.complex64):
        found = polynomial([1.0, -0.5, 0.25], jnp.asarray([2.0, -1.0], dtype))
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, [1.0, 1.75])
