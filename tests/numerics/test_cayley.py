"""Cayley's transform: small systems, determinants, and where half a turn begins."""

import jax
import jax.numpy as jnp
import matrices
import mpmath
import numpy as np
import pytest
from scipy.linalg import expm, logm

from cfjax._numerics.cayley import (
    TangentCoordinates,
    dcayinv,
    is_within_half_a_turn,
    log_determinant,
    solve,
    solve_from_right,
)

solve, solve_from_right = jax.jit(solve), jax.jit(solve_from_right)
UNIT = {"float32": 6e-8, "complex64": 6e-8, "float64": 1.1e-16, "complex128": 1.1e-16}


def cay(u):
    one = np.eye(len(u))
    return np.linalg.solve(one - u / 2, one + u / 2)


def skew(n, angle=1.0, is_complex=False):
    """With a turn by this angle at most."""
    a = matrices.random((n, n), 3, np.complex128 if is_complex else np.float64)
    a = a - a.conj().T
    return angle * a / np.linalg.norm(a, 2)


@pytest.mark.parametrize("dtype", matrices.DTYPES)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_systems_against_numpy(n, dtype):
    m = (np.eye(n) - 0.4 * matrices.random((n, n), 1)).astype(dtype)
    m = m + (0.2 * matrices.random((n, n), 2, dtype)).astype(dtype)
    right, left = matrices.random((n, 2), 3, dtype), matrices.random((2, n), 4, dtype)
    wide = np.complex128 if np.iscomplexobj(m) else np.float64
    inverse = np.linalg.inv(m.astype(wide))
    # Some roundings, times the condition.
    atol = 20 * UNIT[np.dtype(dtype).name] * np.linalg.cond(m) * max(1, np.abs(inverse).max())
    pairs = [(solve(m, right), inverse @ right), (solve_from_right(left, m), left @ inverse)]
    pairs += [(solve(m, right[:, 0]), inverse @ right[:, 0])]
    for found, expected in pairs:
        assert found.dtype == dtype
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_units_scale_rounding(n):
    """Entries of any size by a change of units, as of kilometres and seconds."""
    m, d = np.eye(n) - 0.3 * matrices.random((n, n), 1), 1e5 ** np.arange(n)
    scaled = d[:, None] * m / d
    found = np.asarray(solve(scaled, np.eye(n))) / d[:, None] * d
    np.testing.assert_allclose(found, np.linalg.inv(m), rtol=0, atol=1e-14)


@pytest.mark.parametrize("is_complex", [False, True])
def test_the_derivative_of_the_transform(is_complex):
    """`cay(u)' = a cay(u)` from a difference quotient along the result."""
    u, a = skew(4, 1.5, is_complex), matrices.random((4, 4), 6, np.complex128) / 3
    a = a if is_complex else a.real
    v, h = np.asarray(dcayinv(jnp.asarray(u), jnp.asarray(a))), 1e-3
    quotient = [(cay(u + k * h * v) - cay(u - k * h * v)) / (2 * k * h) for k in (1, 2)]
    # Of fourth order, and rounding over the step.
    np.testing.assert_allclose((4 * quotient[0] - quotient[1]) / 3, a @ cay(u), rtol=0, atol=2e-11)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0])
@pytest.mark.parametrize("kind", ["skew", "any"])
def test_logarithms_of_determinants(kind, size):
    u = size * (skew(3, 1.0, True) if kind == "skew" else matrices.random((3, 3), 5, complex) / 4)
    with mpmath.workdps(40):
        x, one = mpmath.matrix((u / 2).tolist()), mpmath.eye(3)
        expected = complex(mpmath.log(mpmath.det(one + x) / mpmath.det(one - x)))
    found = complex(jax.jit(log_determinant)(u))
    # As small as the sizes that it is a sum of.
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-16 * size)


@pytest.mark.parametrize("n", [2, 3, 8, 20, 100])
def test_no_turn_by_less_than_one_is_nearly_half_a_turn(n):
    """But pairs of angles above 2.75 are, and these add up."""
    for angle in (0.1, 1.0):
        u = np.kron(np.eye(n // 2), [[0, -1], [1, 0]]) * 2 * np.tan(angle / 2)
        assert is_within_half_a_turn(jnp.asarray(u))
    one = np.zeros((n, n))
    one[1, 0], one[0, 1] = 1, -1
    for angle in (2.75, 3.0, 3.14):
        assert not is_within_half_a_turn(jnp.asarray(one * 2 * np.tan(angle / 2)))
    assert not is_within_half_a_turn(jnp.full((n, n), jnp.nan))


def test_units_and_translations_are_no_turn():
    small = np.array([[0.0, 1e6], [-1e-6, 0.0]])
    assert is_within_half_a_turn(jnp.asarray(small))
    assert not is_within_half_a_turn(jnp.asarray(100 * small))
    assert is_within_half_a_turn(jnp.asarray(matrices.POSE))


@pytest.mark.parametrize("shape", [(7, 2), (5, 1), (6, 3)])
def test_tangent_vectors_as_coordinates(shape):
    """The point against full matrices, and the rate against a difference quotient."""
    n, p = shape
    q = np.linalg.qr(matrices.random(shape, 1))[0]

    def tangent(seed, y):
        x = matrices.random((n, n), seed) / 3
        return (x - x.T) @ y

    def point(v):
        g = v - q @ (q.T @ v) / 2
        return cay(g @ q.T - q @ g.T) @ q

    def found(v):
        return TangentCoordinates(jnp.asarray(q), jnp.asarray(v))

    v = tangent(2, q)
    y = point(v)
    np.testing.assert_allclose(q + found(v).increment, y, rtol=0, atol=1e-15 * 10)
    np.testing.assert_allclose(y.T @ y, np.eye(p), rtol=0, atol=1e-15 * 10)
    velocity, h = tangent(3, y), 1e-3
    rate = np.asarray(found(v).rate(jnp.asarray(velocity)))
    quotient = [(point(v + k * h * rate) - point(v - k * h * rate)) / (2 * k * h) for k in (1, 2)]
    np.testing.assert_allclose((4 * quotient[0] - quotient[1]) / 3, velocity, rtol=0, atol=2e-11)
    # Its size is that of the matrix.
    g = v - q @ (q.T @ v) / 2
    size = np.sum((g @ q.T - q @ g.T) ** 2)
    bound = np.sqrt((72 + 1.2 * min(n, 2 * p)) / size)
    assert found((1 - 1e-9) * bound * v).is_within_half_a_turn()
    assert not found((1 + 1e-9) * bound * v).is_within_half_a_turn()


def test_half_a_turn_is_where_the_coordinates_end():
    """The transform of what the logarithm of a turn says."""
    a = skew(5, 3.0)
    y = expm(a)
    u = 2 * (y - np.eye(5)) @ np.linalg.inv(y + np.eye(5))
    np.testing.assert_allclose(cay(u), y, rtol=0, atol=1e-13)
    np.testing.assert_allclose(logm(cay(u)), a, rtol=0, atol=1e-12)
    assert not is_within_half_a_turn(jnp.asarray(u))
