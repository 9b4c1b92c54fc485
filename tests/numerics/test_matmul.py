"""Products of matrices in the precision of their dtype, against NumPy."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from matrices import DTYPES, random
from xla.interpreter import run

from cfjax._numerics.matmul import by_columns, plus_identity, promoted, small_product

EPS = 2.0**-52
BOTH: tuple[type, ...] = (float, complex)


def test_a_real_and_a_complex_array_in_one_dtype():
    for a, b, expected in (
        (np.float32, np.complex64, [np.complex64] * 2),
        (np.complex128, np.float64, [np.complex128] * 2),
        (np.float64, np.float64, [np.float64] * 2),
        # Two precisions are not promoted.
        (np.float32, np.float64, [np.float32, np.float64]),
    ):
        found = jax.eval_shape(promoted, jnp.ones(2, a), jnp.ones((2, 2), b))
        assert [x.dtype for x in found] == expected


def test_products_with_few_columns(subtests):
    for a_dtype, x_dtype, columns in itertools.product(BOTH, BOTH, ((), (2,))):
        a, x = random((5, 5), 0, a_dtype), random((5, *columns), 1, x_dtype)
        found = run(lambda a, x: by_columns(a)(x), a, x)
        with subtests.test(case=f"{a_dtype} {x_dtype} {columns}"):
            assert found.dtype == (a @ x).dtype
            # Sums of five products, of real and of imaginary parts.
            np.testing.assert_allclose(found, a @ x, rtol=0, atol=40 * EPS)


def test_small_products(subtests):
    for dtype, n in itertools.product(BOTH, (2, 3, 4, 5)):
        a, b, x = random((n, n), 0, dtype), random((n, n), 1, dtype), random((n,), 2, dtype)
        for left, right in [(a, b), (a, x), (x, b)]:
            found = run(small_product, left, right)
            with subtests.test(case=f"{dtype} {left.shape} {right.shape}"):
                np.testing.assert_allclose(found, left @ right, rtol=0, atol=8 * n * EPS)


def test_the_identity_is_added_in_the_dtype():
    for dtype in DTYPES:
        found = run(plus_identity, np.zeros((3, 3), dtype))
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, np.eye(3))
