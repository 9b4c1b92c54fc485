"""Linear operators, arrays and those of lineax: what they make of vectors, and their norms."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from matrices import of_norm, random
from xla.interpreter import run

from cfjax._numerics.operators import added, applied, dtype_of, entries_of, shape_of, two_norm

A, D = random((3, 3)), random((3,), 1)


def without_entries(a):
    """An operator of which only the products are known."""
    return lx.FunctionLinearOperator(lambda x: a @ x, jax.ShapeDtypeStruct((len(a),), a.dtype))


OPERATORS = {
    "array": (A, A),
    "diagonal": (D, np.diag(D)),
    "MatrixLinearOperator": (lx.MatrixLinearOperator(jnp.asarray(A)), A),
    "DiagonalLinearOperator": (lx.DiagonalLinearOperator(jnp.asarray(D)), np.diag(D)),
    "FunctionLinearOperator": (without_entries(jnp.asarray(A)), A),
}


def test_an_operator_applied(subtests):
    for name, (operator, matrix) in OPERATORS.items():
        for dtype, columns in itertools.product((float, complex), ((), (2,))):
            x = random((3, *columns), 2, dtype)
            found = run(partial(applied, operator), x)
            with subtests.test(case=f"{name} {dtype} {columns}"):
                assert found.dtype == dtype
                np.testing.assert_allclose(found, matrix @ x, rtol=0, atol=1e-15 * 10)


def test_shape_dtype_and_entries_of_an_operator():
    for name, (operator, matrix) in OPERATORS.items():
        assert shape_of(operator) == ((3,) if name == "diagonal" else (3, 3)), name
        assert dtype_of(operator) == np.float64
        entries = entries_of(operator)
        if name == "FunctionLinearOperator":
            assert entries is None
        else:
            whole = entries if np.ndim(entries) == 2 else np.diag(entries)
            np.testing.assert_array_equal(whole, matrix, name)


def test_a_sum_of_real_and_complex_arrays():
    found = run(added, [jnp.ones(2), jnp.asarray([1j, 1j]), jnp.asarray([1.0, -1.0])])
    np.testing.assert_array_equal(found, [2 + 1j, 1j])


def test_the_2_norm_is_that_of_numpy_or_a_little_more():
    kinds, dtypes = ("general", "skew", "negative"), (np.float32, np.float64, np.complex128)
    for kind, dtype in itertools.product(kinds, dtypes):
        a = of_norm(kind, 5, 3.0, 0, dtype)
        exact = np.linalg.norm(a.astype(np.result_type(dtype, np.float64)), 2)
        norm = two_norm(a)
        assert norm is not None and exact < norm < exact * (1 + 2e-6), (kind, dtype)


def test_the_2_norm_of_a_diagonal_and_of_what_is_not_finite():
    assert two_norm(np.array([1.0, -3.0, 2.0])) == pytest.approx(3.0, rel=2e-6)
    assert np.isnan(two_norm(np.array([[1.0, np.nan], [0.0, 1.0]])))


def test_no_norm_of_what_is_traced_or_large():
    norms = []
    jax.eval_shape(lambda a: norms.append(two_norm(a)), jnp.ones((2, 2)))
    assert norms == [None]
    assert two_norm(np.ones((129, 129))) is None
