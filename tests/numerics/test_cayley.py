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
    congruence_by_inverse,
    dcayinv,
    is_within_half_a_turn,
    log_determinant,
    solve,
    solve_from_both,
    solve_from_right,
    without_turns,
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
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 17])
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


@pytest.mark.parametrize("is_complex", [False, True])
@pytest.mark.parametrize("n", [4, 6, 17])
def test_systems_from_both_sides(n, is_complex):
    dtype = np.complex128 if is_complex else np.float64
    m, z = np.eye(n) - skew(n, 1.0, is_complex), matrices.random((n, n), 3, dtype)
    for right in (m.conj().T, np.eye(n) - 0.1 * matrices.random((n, n), 4, dtype)):
        # Some roundings of entries of some units.
        expected = np.linalg.solve(m, z) @ np.linalg.inv(right)
        found = jax.jit(solve_from_both)(m, z, right)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    found = jax.jit(congruence_by_inverse)(m, z)
    expected = np.linalg.solve(m, z) @ np.linalg.inv(m.conj().T)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_units_scale_rounding(n):
    """Entries of any size by a change of units, as of kilometres and seconds."""
    m, d = np.eye(n) - 0.3 * matrices.random((n, n), 1), 1e5 ** np.arange(n)
    scaled = d[:, None] * m / d
    found = np.asarray(solve(scaled, np.eye(n))) / d[:, None] * d
    np.testing.assert_allclose(found, np.linalg.inv(m), rtol=0, atol=1e-14)


def far_from_the_identity(kind, n=6):
    """Matrices x for which elimination of `I - x` needs pivots, or loses digits without them."""
    a = matrices.random((n, n), 3)
    if kind == "no first pivot":
        return a - np.diag(np.diag(a)) + np.diag([1.0] + [0.5] * (n - 1))
    if kind == "nearly none":
        return a - np.diag(np.diag(a)) + np.diag([1 + 1e-13] + [0.5] * (n - 1))
    if kind == "no second pivot":
        # The first part of two is singular, and the first pivot is not.
        a[:2, :2] = [[0, -1], [-1, 0]]
        return a
    if kind == "large":
        return 30 * a
    if kind == "near a pole":
        a = (a - a.T) / np.linalg.norm(a - a.T, 2)
        return (1 - 1e-6) * np.eye(n) + a * (1 - np.eye(n))
    if kind == "not normal":
        return np.triu(50 * a, 1) + 0.3 * a
    form = np.kron([[0, 1], [-1, 0]], np.eye(n // 2))
    if kind == "symplectic":
        return 20 * form @ (a + a.T)
    form = np.diag([-1.0] + [1.0] * (n - 1))
    return 3 * form @ (a - a.T)


KINDS = [
    *("no first pivot", "nearly none", "no second pivot", "large", "near a pole", "not normal"),
    *("symplectic", "Lorentz"),
]


@pytest.mark.parametrize("in_batch", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_no_matrix_gives_a_silently_wrong_number(kind, in_batch):
    """Also in a batch with one for which a sweep without pivots would do."""
    x, z = far_from_the_identity(kind), matrices.random((6, 3), 5)
    m = np.eye(6) - x
    given = np.stack([m, np.eye(6) - skew(6)]) if in_batch else m[None]
    found = jax.jit(jax.vmap(lambda m: (solve(m, z), solve_from_right(z.T, m))))(jnp.asarray(given))
    for m, right, left in zip(given, *found, strict=True):
        inverse = np.linalg.inv(m)
        # Some roundings, times the condition, of the largest.
        atol = 100 * UNIT["float64"] * np.linalg.cond(m) * np.abs(inverse).max()
        np.testing.assert_allclose(right, inverse @ z, rtol=0, atol=atol)
        np.testing.assert_allclose(left, z.T @ inverse, rtol=0, atol=atol)


@pytest.mark.parametrize("dtype", matrices.DTYPES)
@pytest.mark.parametrize("n", [5, 8])
def test_skew_systems_of_any_angle(n, dtype):
    """They take no pivots up to entries of 4, and lose no digits by that."""
    for size in (1e-8, 0.1, 1.0, 3.0, 30.0, 1e4):
        m = (np.eye(n) - size * skew(n, 1.0, np.issubdtype(dtype, np.complexfloating))).astype(
            dtype
        )
        wide = np.complex128 if np.iscomplexobj(m) else np.float64
        expected = np.linalg.inv(m.astype(wide))
        # Some roundings, times the condition.
        atol = 20 * UNIT[np.dtype(dtype).name] * np.linalg.cond(m)
        np.testing.assert_allclose(solve(m, np.eye(n, dtype=dtype)), expected, rtol=0, atol=atol)


def test_a_member_that_is_not_finite_spoils_no_other():
    good = np.eye(5) - skew(5)
    for bad in (np.nan, np.inf):
        m = np.stack([good, np.full((5, 5), bad)])
        found = np.asarray(jax.vmap(solve)(jnp.asarray(m), jnp.asarray(m)))
        assert not np.isfinite(found[1]).any()
        np.testing.assert_allclose(found[0], np.eye(5), rtol=0, atol=1e-15 * 5)


@pytest.mark.parametrize("is_far", [False, True])
@pytest.mark.parametrize("n", [3, 4, 6])
def test_derivatives_of_systems(n, is_far):
    """`W = m^-1` has the derivative `-W m' W`, and that the next one."""
    x = far_from_the_identity("Lorentz", n) if is_far else skew(n)
    m, z, dm = (
        jnp.asarray(x) for x in (np.eye(n) - x, *(matrices.random((n, n), k) for k in (6, 7)))
    )
    w = jnp.linalg.inv(m)
    for fun, first, second in [
        (lambda m: solve(m, z), w @ dm @ w @ z, 2 * w @ dm @ w @ dm @ w @ z),
        (lambda m: solve_from_right(z, m), z @ w @ dm @ w, 2 * z @ w @ dm @ w @ dm @ w),
    ]:

        def slope(m, fun=fun):
            return jax.jvp(fun, (m,), (dm,))[1]

        value, twice = jax.jvp(slope, (m,), (dm,))
        # Roundings of products of matrices as large as these.
        atol = 1e-14 * float(jnp.abs(w).max()) ** 2 * n**2
        np.testing.assert_allclose(value, -first, rtol=0, atol=atol)
        np.testing.assert_allclose(twice, second, rtol=1e-12, atol=10 * atol)
        gradient = jax.grad(lambda m, fun=fun: jnp.sum(z * fun(m)))(m)
        np.testing.assert_allclose(
            jnp.sum(gradient * dm), -jnp.sum(z * first), rtol=1e-12, atol=atol
        )


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


def test_logarithms_of_determinants_of_any_phase():
    """Also of -1, for which `1 + m` is zero; the phases of three eigenvalues go round twice."""
    angles = np.linspace(-2.4, 2.4, 13)[:, None] + np.array([[0.1, 0.2, -0.4]])
    u = [1j * np.diag(x) for x in (*(2 * np.tan(angles / 2)), np.array([2.0, 2.0, 0.0]))]
    v = np.linalg.qr(matrices.random((3, 3), 4, complex))[0]
    u = np.stack([*u, *(v @ x @ v.conj().T for x in u)])
    found = np.asarray(jax.jit(jax.vmap(log_determinant))(u))
    assert np.abs(np.imag(found)).max() <= np.pi
    expected = [np.linalg.det(cay(x)) for x in u]
    # Some roundings of products of entries up to 5.
    np.testing.assert_allclose(np.exp(found), expected, rtol=0, atol=1e-14)


def test_whole_turns_are_left_out():
    turns, angles = np.arange(-3, 4)[:, None], np.array([-3.14, -1.0, 0.0, 2.0, 3.14])
    given = 0.5 + 1j * (angles + 2 * np.pi * turns)
    found, slopes = jax.jvp(jax.jit(without_turns), (given,), (np.full_like(given, 1 - 2j),))
    # A rounding of three turns.
    expected = np.broadcast_to(0.5 + 1j * angles, given.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-15)
    np.testing.assert_array_equal(slopes, 1 - 2j)
    assert without_turns(jnp.asarray(1e-20j)) == 1e-20j


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
