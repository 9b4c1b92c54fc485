"""Columns brought back to given products, against SciPy's polar decomposition."""

from functools import partial

import jax
import jax.numpy as jnp
import matrices
import mpmath
import numpy as np
import scipy.linalg
from xla.interpreter import run

from cfjax._numerics.polar import Products, polar_correction

SIZES = [1e-12, 1e-9, 1e-6, 1e-3, 0.03]


compiled = jax.jit(polar_correction, static_argnums=2)


def correct(y, v, are_orthonormal):
    return run(lambda y, v: compiled(y, v, are_orthonormal), y, v)


def orthonormal(n, k, dtype=np.float64):
    return np.linalg.qr(matrices.random((n, k), 1, dtype))[0]


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def corrected(y, step):
    return polar_correction(y, step, False)


def test_columns_become_the_nearest_ones_or_keep_their_products(subtests):
    for dtype in (np.float64, np.complex128):
        for shape in [(5, 5), (7, 3), (4, 1)]:
            y, direction = orthonormal(*shape, dtype), matrices.random(shape, 2, dtype)
            steps = np.multiply.outer(SIZES, direction)
            founds, are_there = run(corrected, y, steps)
            with subtests.test(case=f"{shape} {dtype}"):
                assert np.all(are_there)
                for step, found in zip(steps, founds, strict=True):
                    nearest, _ = scipy.linalg.polar(y + step)
                    # The distance itself is as small as the step, up to the products of y, which
                    # rounding has left off the identity.
                    np.testing.assert_allclose(y + found, nearest, rtol=0, atol=3e-15)
        y, direction = matrices.random((7, 3), 1, dtype), matrices.random((7, 3), 2, dtype)
        steps = np.multiply.outer(SIZES, direction)
        founds, are_there = run(corrected, y, steps)
        with subtests.test(case=f"other columns, {dtype}"):
            assert np.all(are_there)
            for step, found in zip(steps, np.asarray(founds), strict=True):
                products = (y + found).conj().T @ (y + found)
                np.testing.assert_allclose(products, y.conj().T @ y, rtol=0, atol=2e-14)
                # No further than the step itself is off.
                assert np.linalg.norm(found - step) < 2 * np.linalg.norm(step)


def test_products_of_before_are_restored():
    """The start is off them by what rounding may add up to, and so is the end without them."""
    start, direction = matrices.random((7, 3), 1), 1e-3 * matrices.random((7, 3), 2)
    products = Products.of(jnp.asarray(start))
    y = start + 1e-9 * matrices.random((7, 3), 3)
    for kept, error in [(products, 0.0), (None, 1e-9)]:
        found, is_there = polar_correction(jnp.asarray(y), jnp.asarray(direction), False, kept)
        off = np.abs((y + found).T @ (y + found) - products.products).max()
        assert is_there
        # Some roundings of products up to 20.
        assert error <= off < 20 * error + 2e-14


def test_rounding_is_as_small_as_the_step():
    """Over many steps what is left adds up, so it must be below the rounding of the products."""
    y = matrices.random((6, 3), 1)
    for size in (1e-9, 1e-8):
        v, _ = correct(y, size * matrices.random((6, 3), 2), False)
        with mpmath.workdps(40):
            a, b = mpmath.matrix(y.tolist()), mpmath.matrix(np.asarray(v).tolist())
            e = a.T * b + b.T * a + b.T * b
        # Some tens of roundings of numbers as large as v, and a square of 1.5e-10.
        assert np.abs(matrices.to_numpy(e)).max() < 20 * 2e-16 * size + 1e-19


def test_columns_that_are_nearly_orthonormal_become_so():
    y = orthonormal(6, 3) * (1 + 1e-9)
    v, is_there = correct(y, 1e-4 * matrices.random((6, 3), 2), True)
    end = y + np.asarray(v)
    assert is_there
    np.testing.assert_allclose(end.T @ end, np.eye(3), rtol=0, atol=1e-15)


def test_columns_too_far_off_or_without_full_rank_are_reported():
    for are_orthonormal in (False, True):
        for size in (1.0, 5.0, np.inf, np.nan):
            v = np.full((4, 2), size)
            assert not correct(orthonormal(4, 2), v, are_orthonormal)[1]
    # And whatever is reported to be there is.
    for factor in np.linspace(0.05, 1.0, 20):
        v, is_there = correct(orthonormal(4, 2), factor * matrices.random((4, 2), 2), True)
        end = orthonormal(4, 2) + np.asarray(v)
        assert not is_there or np.abs(end.T @ end - np.eye(2)).max() < 1e-15
    assert not correct(np.zeros((3, 1)), np.full((3, 1), 0.1), False)[1]


def test_members_of_a_batch_are_corrected_as_they_need():
    y, v = orthonormal(5, 2), matrices.random((5, 2), 2)
    vs = np.stack([size * v for size in (1e-12, 0.03, 5.0)])
    found, is_there = run(corrected, y, vs)
    np.testing.assert_array_equal(is_there, [True, True, False])
    for k in range(2):
        nearest, _ = scipy.linalg.polar(y + vs[k])
        np.testing.assert_allclose(y + np.asarray(found[k]), nearest, rtol=0, atol=3e-15)


def test_the_derivative_is_that_of_difference_quotients():
    y, v, w = (jnp.asarray(matrices.random((4, 2), k)) for k in (1, 2, 3))

    def value(s):
        return jnp.sum(w * jnp.sin(polar_correction(y, s * v, False)[0]))

    s, h = 0.01, 1e-4
    expected = (run(value, s + h) - run(value, s - h)) / (2 * h)
    for found in run(lambda s: (jax.grad(value)(s), jax.jacfwd(value)(s)), s):
        # The quotient is off by h^2 times a third derivative of some hundred.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_known_products_have_the_same_derivative():
    """Their inverse is known, and its derivative is not zero. In a batch too, of whose members the
    products are known together.
    """
    y, v, w = (jnp.asarray(matrices.random((4, 2), k)) for k in (1, 2, 3))

    def value(s, find):
        point = y + s * jnp.cos(y)
        return jnp.sum(w * jnp.sin(polar_correction(point, 0.01 * v, False, find(point))[0]))

    points = jnp.asarray([0.01, 0.02])
    derivatives = run(jax.vmap(jax.grad(lambda s: value(s, lambda _: None))), points)
    known = lambda s: value(s, lambda y: Products.of(jax.lax.stop_gradient(y)))  # noqa: E731
    # Some hundred roundings.
    np.testing.assert_allclose(run(jax.vmap(jax.grad(known)), points), derivatives, rtol=1e-12)
    shared = lambda s: value(s, lambda _: Products.of(y))  # noqa: E731
    expected = [run(jax.grad(shared), s) for s in points]
    # With `jit` within the batch JAX 0.12 has a wrong derivative of a value that is of one.
    of_batch = jax.grad(lambda points: jnp.sum(jax.vmap(jax.jit(shared))(points)))
    np.testing.assert_allclose(run(of_batch, points), expected, rtol=1e-12)
