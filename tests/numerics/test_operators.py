"""Linear operators, arrays and those of lineax: what they make of vectors, and their norms."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from matrices import of_norm, random

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


@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("dtype", [float, complex])
@pytest.mark.parametrize("columns", [(), (2,)])
def test_an_operator_applied(name, dtype, columns):
    operator, matrix = OPERATORS[name]
    x = random((3, *columns), 2, dtype)
    found = applied(operator, jnp.asarray(x))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, matrix @ x, rtol=0, atol=1e-15 * 10)


@pytest.mark.parametrize("name", OPERATORS)
def test_shape_dtype_and_entries_of_an_operator(name):
    operator, matrix = OPERATORS[name]
    assert shape_of(operator) == ((3,) if name == "diagonal" else (3, 3))
    assert dtype_of(operator) == np.float64
    entries = entries_of(operator)
    if name == "FunctionLinearOperator":
        assert entries is None
    else:
        np.testing.assert_array_equal(
            entries if np.ndim(entries) == 2 else np.diag(entries), matrix
        )


def test_a_sum_of_real_and_complex_arrays():
    found = added([jnp.ones(2), jnp.asarray([1j, 1j]), jnp.asarray([1.0, -1.0])])
    np.testing.assert_array_equal(found, [2 + 1j, 1j])


@pytest.mark.parametrize("kind", ["general", "skew", "negative"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.complex128])
def test_the_2_norm_is_that_of_numpy_or_a_little_more(kind, dtype):
    a = of_norm(kind, 5, 3.0, 0, dtype)
    exact = np.linalg.norm(a.astype(np.result_type(dtype, np.float64)), 2)
    norm = two_norm(a)
    assert norm is not None and exact < norm < exact * (1 + 2e-6)


def test_the_2_norm_of_a_diagonal_and_of_what_is_not_finite():
    assert two_norm(np.array([1.0, -3.0, 2.0])) == pytest.approx(3.0, rel=2e-6)
    assert np.isnan(two_norm(np.array([[1.0, np.nan], [0.0, 1.0]])))


def test_no_norm_of_what_is_traced_or_large():
    norms = []
    jax.eval_shape(lambda a: norms.append(two_norm(a)), jnp.ones((2, 2)))
    assert norms == [None]
    assert two_norm(np.ones((129, 129))) is None
