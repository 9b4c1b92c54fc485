"""Flows of matrix fields on few columns: accuracy at every norm, derivatives, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import random

from cfjax import LeftMatrix, RightMatrix

N = 16
BOTH = pytest.mark.parametrize("cls", [RightMatrix, LeftMatrix])
# One on each side of every bound, far beyond them, and zero.
NORMS = [0.0, 1e-9, 1e-3, 0.1, 0.15, 0.29, 0.31, 0.7, 0.8, 0.99, 1.0, 1.4, 1.5, 2.2, 2.4, 2.5, 30.0]


def matrix(kind, norm, dtype: type = np.float64):
    """A matrix of the given norm, as the field takes it."""
    a = random((N, N), 0, dtype)
    if kind == "skew":
        a = a - a.conj().T
    if kind == "one sided":
        a = np.triu(a, 1)
    size = np.abs(a.real) + np.abs(a.imag)
    return (a / size.sum(axis=0).max() * norm).astype(dtype)


def act(cls, matrix, point):
    return matrix @ point if cls is LeftMatrix else point @ matrix


@jax.jit
def flow(field, point):
    return field.flow(point)


@jax.jit
def both(field, point):
    return field.flow(point), field.increment(point)


def test_which_points_are_thin():
    """Products with the matrix move thin points. The dense exponential is two parts, and only these
    are multiplied with a point that is not thin.
    """

    def is_thin(n, *columns):
        program = jax.make_jaxpr(lambda a, y: LeftMatrix(a).flow(y))
        text = str(program(jnp.zeros((n, n)), jnp.zeros((n, *columns))))
        shape = ",".join(map(str, (n, *columns)))
        number = text.count(f":f64[{shape}] = dot_general")
        assert number >= 2
        return number > 2

    assert is_thin(N) and not is_thin(N, 2)
    assert not is_thin(N - 1)


@pytest.mark.representatives(1)
@BOTH
@pytest.mark.parametrize(
    ("kind", "dtype", "point_dtype"),
    [
        ("skew", np.complex128, np.complex128),
        ("any", np.float32, np.float32),
        ("one sided", np.float64, np.float64),
        ("skew", np.float64, np.complex128),
    ],
)
def test_every_norm(cls, kind, dtype, point_dtype):
    point = random((N,), 1, point_dtype)
    wide = np.promote_types(dtype, np.float64)
    eps = np.finfo(dtype).eps
    for norm in NORMS:
        a = matrix(kind, norm, dtype)
        e = scipy.linalg.expm(a.astype(wide))
        got, change = both(cls(a), point)
        assert got.dtype == point_dtype and got.shape == point.shape
        # Backward errors of a few units; beyond the bounds each of four squarings doubles them.
        growth = np.exp(np.linalg.norm((a + a.conj().T) / 2, 2))
        scale = eps * growth * np.linalg.norm(point)
        tolerance = (8 if norm < 2.45 else 100) * (1 + norm) * scale
        np.testing.assert_allclose(got, act(cls, e, point), rtol=0, atol=tolerance)
        if norm < 2.2:
            # What is added is as accurate as it is small.
            change = np.asarray(change)
            exact = act(cls, e - np.eye(N), point) if norm > 1e-2 else act(cls, a, point)
            atol = 8 * norm * scale + (norm**2 * np.linalg.norm(point) if norm <= 1e-2 else 0)
            np.testing.assert_allclose(change, exact, rtol=0, atol=atol)


def test_rounding_of_lengths_is_that_of_one_sum():
    """After 1000 steps of norm 0.1 the length is off by a random walk of units of rounding."""
    field, y = LeftMatrix(matrix("skew", 0.1)), random((N,), 1)
    end = y
    for _ in range(1000):
        end = flow(field, end)
    assert abs(np.linalg.norm(end) / np.linalg.norm(y) - 1) < 1e-14


@pytest.mark.representatives(1)
@BOTH
def test_derivatives(cls):
    direction, point, weight = random((N, N), 2), random((N,), 3), random((N,), 4)

    @jax.jit
    def found(a, point):
        end, push = jax.linearize(lambda a, point: cls(a).flow(point), a, point)
        return end, push(direction, jnp.zeros(N)), *jax.linear_transpose(push, a, point)(weight)

    # Where `a y = 0` all terms vanish, and not their derivatives.
    still = matrix("skew", 1.0)
    still[:, 0] = still[0, :] = 0
    cases = [(matrix("skew", norm), norm, point) for norm in (0.0, 0.5, 2.0, 30.0)]
    for a, norm, at in [*cases, (still, 1.0, np.eye(N)[0])]:
        exact, frechet = scipy.linalg.expm_frechet(a, direction)
        # A skew matrix keeps norms, so nothing grows: units of rounding of sums of N^2 products of
        # size 1, doubled by five squarings beyond the bounds.
        atol = 1e-13 * (1 + norm) * (2**5 if norm > 2.4 else 1)
        end, forward, in_a, in_point = found(a, at)
        np.testing.assert_allclose(end, act(cls, exact, at), rtol=0, atol=atol)
        want = act(cls, frechet, at)
        np.testing.assert_allclose(forward, want, rtol=0, atol=atol)
        assert np.vdot(in_a, direction) == pytest.approx(np.vdot(weight, want), abs=atol)
        other = RightMatrix if cls is LeftMatrix else LeftMatrix
        np.testing.assert_allclose(in_point, act(other, exact, weight), rtol=0, atol=atol)


@pytest.mark.slow
def test_the_second_derivative_at_zero():
    # The term of second order of exp is d d / 2, so its second derivative along d is d d.
    d, point = random((N, N), 2), jnp.asarray(random((N,), 3))
    got = jax.jit(jax.jacfwd(jax.jacrev(lambda t: LeftMatrix(t * d).flow(point))))(0.0)
    np.testing.assert_allclose(got, d @ d @ point, rtol=0, atol=1e-12)


def test_a_batch_with_one_that_is_not_skew():
    # So large and symmetric that the series for skew ones, 40 products, would be off by 0.03.
    norm, n = 12.0, 32
    skew = np.kron(matrix("skew", norm), np.eye(n // N))
    batch = np.stack([skew, np.full((n, n), norm / n)])
    point = random((n,), 1)
    got = jax.jit(jax.vmap(lambda a: LeftMatrix(a).flow(jnp.asarray(point))))(batch)
    want = [scipy.linalg.expm(a) @ point for a in batch]
    # As for one, with a growth of at most exp(12).
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-14 * (1 + norm) * np.exp(norm))


def test_what_is_not_finite_stays_so():
    point = random((N,), 1)
    for bad in (np.nan, np.inf):
        a = matrix("any", 1.0)
        a[3, 5] = bad
        assert not np.isfinite(flow(LeftMatrix(a), point)).any()
    # Beyond the largest float no exponential is right.
    assert not np.isfinite(flow(LeftMatrix(matrix("skew", 1e300)), point)).any()
