"""Hermitian matrices as real vectors: the basis, and the matrices of commutators and jumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrices import DTYPES, random

from cfjax._numerics.hermitian import basis, commutators, coordinates, dissipator, matrix

SIZES = pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
EPS = 2.0**-52


def hermitian(n, seed=0, dtype=complex):
    x = random((n, n), seed, dtype)
    return (x + x.conj().T) / 2


@SIZES
def test_the_basis_is_orthonormal_and_hermitian_and_the_identity_is_first(n):
    b = basis(n)
    np.testing.assert_array_equal(b, b.conj().swapaxes(1, 2))
    np.testing.assert_allclose(np.einsum("aij,bji->ab", b, b), np.eye(n * n), rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(b[0], np.eye(n) / np.sqrt(n), rtol=0, atol=EPS)
    # The others have no trace.
    np.testing.assert_allclose(np.trace(b[1:], axis1=1, axis2=2), 0, rtol=0, atol=n * EPS)


@SIZES
def test_coordinates_and_matrix_are_inverse(n):
    x = hermitian(n)
    r = coordinates(jnp.asarray(x))
    np.testing.assert_allclose(r, np.einsum("aij,ji->a", basis(n), x).real, rtol=0, atol=8 * EPS)
    assert r[0] == pytest.approx(np.trace(x).real / np.sqrt(n), abs=4 * EPS)
    y = matrix(r)
    np.testing.assert_allclose(y, x, rtol=0, atol=8 * EPS)
    np.testing.assert_array_equal(y, y.conj().T)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_precision_of_coordinates(dtype):
    x = jnp.asarray(hermitian(3, dtype=dtype))
    assert coordinates(x).dtype == np.finfo(dtype).dtype
    assert matrix(coordinates(x)).dtype == np.result_type(dtype, np.complex64)
    a = random((3, 3), 1, dtype)
    assert np.finfo(dissipator(a).dtype).dtype == np.finfo(dtype).dtype
    assert jax.jit(dissipator)(a).dtype == np.finfo(dtype).dtype


def test_coordinates_are_those_of_the_hermitian_part():
    x = random((4, 4), 1, complex)
    part = (x + x.conj().T) / 2
    np.testing.assert_allclose(
        coordinates(jnp.asarray(x)), coordinates(jnp.asarray(part)), rtol=0, atol=4 * EPS
    )


@SIZES
def test_commutators(n):
    h, x = hermitian(n, 1), hermitian(n, 2)
    a = np.tensordot(coordinates(jnp.asarray(h)), commutators(n), 1)
    expected = -1j * (h @ x - x @ h)
    found = matrix(jnp.asarray(a @ coordinates(jnp.asarray(x))))
    np.testing.assert_allclose(found, expected, rtol=0, atol=20 * n * EPS)
    # A unitary motion.
    np.testing.assert_allclose(a, -a.T, rtol=0, atol=8 * EPS)


@SIZES
@pytest.mark.parametrize("dtype", [float, complex])
def test_dissipator(n, dtype):
    a, x = random((n, n), 1, dtype), hermitian(n, 2)
    loss = a.conj().T @ a / 2
    expected = a @ x @ a.conj().T - loss @ x - x @ loss
    for made in (dissipator(a), jax.jit(dissipator)(a)):
        found = matrix(jnp.asarray(made @ coordinates(jnp.asarray(x))))
        np.testing.assert_allclose(found, expected, rtol=0, atol=40 * n * n * EPS)


def test_a_known_jump_has_a_known_matrix():
    """It is made when the program is traced."""

    @jax.jit
    def f(x):
        assert isinstance(dissipator(np.eye(2)), np.ndarray)
        return x

    f(1.0)
