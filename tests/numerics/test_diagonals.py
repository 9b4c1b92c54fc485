"""Matrices of few diagonals: what is stored of them, and their products."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matrices import DTYPES, random
from xla.interpreter import run

from cfjax._numerics.diagonals import Diagonals, adjoint, compact, dense, gram, times, times_adjoint

N = 6


def of_diagonals(*offsets, dtype=complex):
    a = random((N, N), len(offsets), dtype)
    kept = np.isin(np.subtract.outer(np.arange(N), np.arange(N)), [-k for k in offsets])
    return np.where(kept, a, 0)


KINDS = {
    "upper": of_diagonals(1),
    "lower": of_diagonals(-2),
    "corner": of_diagonals(N - 1),
    "other corner": of_diagonals(1 - N),
    "main": of_diagonals(0),
    "three": of_diagonals(-3, 0, 2),
    "zero": np.zeros((N, N)),
    "dense": random((N, N), 1, complex),
}


def products(stored, x):
    return times(stored, x), times_adjoint(x, stored), gram(stored), gram(adjoint(stored))


def test_products_are_those_of_the_dense_matrix(subtests):
    for kind, a in KINDS.items():
        stored = compact(a)
        # Entries that are arguments of a program are not known in it, and their places are.
        for dtype in (float, complex):
            x = random((N, N), 2, dtype)
            wants = a @ x, x @ a.conj().T, a.conj().T @ a, a @ a.conj().T
            for found in (run(products, stored, x), run(partial(products, stored), x)):
                with subtests.test(case=f"{kind} {dtype}"):
                    for got, want in zip(found, wants, strict=True):
                        # Sums of six products of numbers of size 1 to 10.
                        np.testing.assert_allclose(got, want, 0, 1e-14)
        with subtests.test(case=f"{kind}, stored"):
            assert isinstance(stored, Diagonals) == (kind != "dense")
            np.testing.assert_array_equal(dense(stored), a)
            np.testing.assert_array_equal(dense(adjoint(stored)), a.conj().T)
            assert stored.shape == a.shape and stored.dtype == a.dtype


def test_the_precision_of_a_product():
    for dtype in DTYPES:
        a = compact(of_diagonals(1, -1, dtype=dtype))
        wide = np.result_type(dtype, np.complex64)
        for other in (dtype, wide):
            x = jax.ShapeDtypeStruct((N, N), other)
            assert jax.eval_shape(lambda x, a=a: times(a, x), x).dtype == other
        assert gram(a).dtype == dtype


def test_a_matrix_of_other_columns():
    a, x = of_diagonals(1, -2), random((N, 3), 1)
    np.testing.assert_allclose(run(partial(times, compact(a)), x), a @ x, rtol=0, atol=1e-14)


def test_what_is_not_known_or_small_or_has_many_diagonals_stays_dense():
    assert isinstance(compact(of_diagonals(0, 1, 2, 3)), np.ndarray)
    assert isinstance(compact(np.eye(3)), np.ndarray)
    # Known, wherever it is: NumPy's.
    assert isinstance(compact(jnp.ones((N, N))), np.ndarray)

    @jax.jit
    def traced(a):
        assert compact(a) is a
        return a

    traced(jnp.eye(N))
    assert isinstance(compact(np.zeros((2, N, N))), jax.Array)


def test_a_product_has_no_product_of_matrices():
    a = compact(of_diagonals(1, -1))
    text = str(jax.make_jaxpr(lambda x: times_adjoint(times(a, x), a))(jnp.eye(N)))
    assert "dot_general" not in text


def test_derivatives_of_products_by_diagonals():
    a, x, d = of_diagonals(1, -2), random((N, N), 1, complex), random((N, N), 2, complex)
    stored: Any = compact(a)
    both = lambda x: times_adjoint(times(stored, x), stored)  # noqa: E731
    found = run(lambda x, d: jax.jvp(both, (x,), (d,))[1], x, d)
    np.testing.assert_allclose(found, a @ d @ a.conj().T, rtol=0, atol=1e-13)

    def of_entries(entries):
        return times(Diagonals(entries, stored.offsets), jnp.asarray(x))

    way = 1j * stored.entries
    found = run(lambda x, d: jax.jvp(of_entries, (x,), (d,))[1], stored.entries, way)
    np.testing.assert_allclose(found, 1j * a @ x, rtol=0, atol=1e-13)


def test_leading_axes_of_entries_by_vmap():
    stored = compact(of_diagonals(1, -2))
    many = jax.vmap(lambda s: jax.tree.map(lambda e: s * e, stored))(np.arange(3) + 0j)
    assert many.shape == (3, N, N)
