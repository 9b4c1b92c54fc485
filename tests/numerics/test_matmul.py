"""Products of matrices in the precision of their dtype, against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from matrices import DTYPES, random

from cfjax._numerics.matmul import by_columns, plus_identity, promoted, small_product

EPS = 2.0**-52


@pytest.mark.parametrize(
    "a, b, expected",
    [
        (np.float32, np.complex64, np.complex64),
        (np.complex128, np.float64, np.complex128),
        (np.float64, np.float64, np.float64),
    ],
)
def test_a_real_and_a_complex_array_in_one_dtype(a, b, expected):
    found = promoted(jnp.ones(2, a), jnp.ones((2, 2), b))
    assert [x.dtype for x in found] == [expected] * 2


def test_two_precisions_are_not_promoted():
    found = promoted(jnp.ones(2, np.float32), jnp.ones(2))
    assert [x.dtype for x in found] == [np.float32, np.float64]


@pytest.mark.parametrize("a_dtype", [float, complex])
@pytest.mark.parametrize("x_dtype", [float, complex])
@pytest.mark.parametrize("columns", [(), (2,)])
def test_products_with_few_columns(a_dtype, x_dtype, columns):
    a, x = random((5, 5), 0, a_dtype), random((5, *columns), 1, x_dtype)
    found = by_columns(jnp.asarray(a))(jnp.asarray(x))
    assert found.dtype == (a @ x).dtype
    # Sums of five products, of real and of imaginary parts.
    np.testing.assert_allclose(found, a @ x, rtol=0, atol=40 * EPS)


@pytest.mark.parametrize("dtype", [float, complex])
@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_small_products(n, dtype):
    a, b, x = random((n, n), 0, dtype), random((n, n), 1, dtype), random((n,), 2, dtype)
    for left, right in [(a, b), (a, x), (x, b)]:
        found = small_product(jnp.asarray(left), jnp.asarray(right))
        np.testing.assert_allclose(found, left @ right, rtol=0, atol=8 * n * EPS)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_identity_is_added_in_the_dtype(dtype):
    found = plus_identity(jnp.zeros((3, 3), dtype))
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, np.eye(3))
