"""Hermitian matrices as real vectors: the basis, and the matrices of commutators and jumps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrices import DTYPES, random
from xla.interpreter import run

from cfjax._numerics.hermitian import basis, commutators, coordinates, dissipator, matrix

SIZES = pytest.mark.parametrize("n", [1, 2, 5])
EPS = 2.0**-52


def hermitian(n, seed=0, dtype=complex):
    x = random((n, n), seed, dtype)
    return (x + x.conj().T) / 2


def test_the_basis_is_orthonormal_and_hermitian_and_the_identity_is_first():
    for n in (1, 2, 3, 5, 8):
        b = basis(n)
        np.testing.assert_array_equal(b, b.conj().swapaxes(1, 2))
        products = np.einsum("aij,bji->ab", b, b)
        np.testing.assert_allclose(products, np.eye(n * n), rtol=0, atol=4 * EPS)
        np.testing.assert_allclose(b[0], np.eye(n) / np.sqrt(n), rtol=0, atol=EPS)
        # The others have no trace.
        np.testing.assert_allclose(np.trace(b[1:], axis1=1, axis2=2), 0, rtol=0, atol=n * EPS)


@SIZES
def test_matrices_as_vectors_and_what_acts_on_them(n):
    h, x, z = hermitian(n, 1), hermitian(n, 2), random((n, n), 1, complex)
    jumps = [random((n, n), 1, dtype) for dtype in (float, complex)]

    known = [jnp.asarray(dissipator(jump)) for jump in jumps]

    def everything(h, x, z, jumps):
        r = coordinates(x)
        a = jnp.tensordot(coordinates(h), commutators(n), 1)
        moved = [matrix(d @ r) for d in (a, *map(dissipator, jumps), *known)]
        return r, matrix(r), coordinates(z), coordinates((z + z.conj().T) / 2), a, moved

    r, y, of_any, of_part, a, (turned, *moved) = run(everything, h, x, z, jumps)
    np.testing.assert_allclose(r, np.einsum("aij,ji->a", basis(n), x).real, rtol=0, atol=8 * EPS)
    assert r[0] == pytest.approx(np.trace(x).real / np.sqrt(n), abs=4 * EPS)
    np.testing.assert_allclose(y, x, rtol=0, atol=8 * EPS)
    np.testing.assert_array_equal(y, y.conj().T)
    # Coordinates are those of the Hermitian part.
    np.testing.assert_allclose(of_any, of_part, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(turned, -1j * (h @ x - x @ h), rtol=0, atol=20 * n * EPS)
    # A unitary motion.
    np.testing.assert_allclose(a, -a.T, rtol=0, atol=8 * EPS)
    for jump, found in zip(2 * jumps, moved, strict=True):
        loss = jump.conj().T @ jump / 2
        expected = jump @ x @ jump.conj().T - loss @ x - x @ loss
        np.testing.assert_allclose(found, expected, rtol=0, atol=40 * n * n * EPS)


def test_the_precision_of_coordinates():
    for dtype in DTYPES:
        x, a = jnp.asarray(hermitian(3, dtype=dtype)), random((3, 3), 1, dtype)
        r, y, made = jax.eval_shape(
            lambda x, a: (coordinates(x), matrix(coordinates(x)), dissipator(a)), x, a
        )
        assert r.dtype == made.dtype == dissipator(a).dtype == np.finfo(dtype).dtype
        assert y.dtype == np.result_type(dtype, np.complex64)


def test_a_known_jump_has_a_known_matrix():
    """It is made when the program is traced."""

    @jax.jit
    def f(x):
        assert isinstance(dissipator(np.eye(2)), np.ndarray)
        return x

    f(1.0)
