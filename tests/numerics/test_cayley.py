"""Cayley's transform: small systems, determinants, and where half a turn begins."""

from functools import partial

import jax
import jax.numpy as jnp
import matrices
import mpmath
import numpy as np
import pytest
from scipy.linalg import expm, logm
from xla.interpreter import run

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

UNIT = {"float32": 6e-8, "complex64": 6e-8, "float64": 1.1e-16, "complex128": 1.1e-16}


@jax.jit
def systems(m, z):
    """By columns, by a column and by rows. All tests of a size and dtype share the program."""
    return solve(m, z), solve(m, z[:, 0]), solve_from_right(z, m)


in_batches = jax.jit(jax.vmap(lambda m, z: (solve(m, z), solve_from_right(z.T, m)), (0, None)))


def cay(u):
    one = np.eye(len(u))
    return np.linalg.solve(one - u / 2, one + u / 2)


def skew(n, angle=1.0, is_complex=False):
    """With a turn by this angle at most."""
    a = matrices.random((n, n), 3, np.complex128 if is_complex else np.float64)
    a = a - a.conj().T
    return angle * a / np.linalg.norm(a, 2)


def assert_solved(m, z, factor):
    """Some roundings, this factor of them, times the condition."""
    wide = np.complex128 if np.iscomplexobj(m) else np.float64
    inverse = np.linalg.inv(m.astype(wide))
    atol = factor * UNIT[np.dtype(m.dtype).name] * np.linalg.cond(m)
    wants = inverse @ z, inverse @ z[:, 0], z @ inverse
    for found, want in zip(run(systems, m, z), wants, strict=True):
        assert found.dtype == m.dtype
        np.testing.assert_allclose(found, want, rtol=0, atol=atol)


def test_systems_against_numpy(subtests):
    real, other = ((n, np.float64) for n in (1, 3, 5, 17)), ((n, complex) for n in (2, 4, 17))
    for n, dtype in ((4, np.float32), (5, np.complex64), *real, *other):
        m = (np.eye(n) - 0.4 * matrices.random((n, n), 1)).astype(dtype)
        m = m + (0.2 * matrices.random((n, n), 2, dtype)).astype(dtype)
        with subtests.test(case=f"{n} {np.dtype(dtype).name}"):
            factor = 20 * max(1, np.abs(np.linalg.inv(m)).max())
            assert_solved(m, matrices.random((n, n), 3, dtype), factor)


def test_systems_from_both_sides(subtests):
    @jax.jit
    def both(m, z, right):
        return solve_from_both(m, z, right), congruence_by_inverse(m, z)

    for n, is_complex in ((4, False), (6, False), (6, True), (17, True)):
        dtype = np.complex128 if is_complex else np.float64
        m, z = np.eye(n) - skew(n, 1.0, is_complex), matrices.random((n, n), 3, dtype)
        right = np.eye(n) - 0.1 * matrices.random((n, n), 4, dtype)
        left = np.linalg.solve(m, z)
        with subtests.test(case=f"{n} {dtype}"):
            for other in (m.conj().T, right):
                found, congruent = run(both, m, z, other)
                # Some roundings of entries of some units.
                np.testing.assert_allclose(found, left @ np.linalg.inv(other), rtol=0, atol=1e-14)
            want = left @ np.linalg.inv(m.conj().T)
            np.testing.assert_allclose(congruent, want, rtol=0, atol=1e-14)


def test_units_scale_rounding():
    """Entries of any size by a change of units, as of kilometres and seconds."""
    for n in (2, 3, 4):
        m, d = np.eye(n) - 0.3 * matrices.random((n, n), 1), 1e5 ** np.arange(n)
        scaled = d[:, None] * m / d
        found = run(systems, scaled, np.eye(n))[0] / d[:, None] * d
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


def test_no_matrix_gives_a_silently_wrong_number(subtests):
    """Also in a batch with one for which a sweep without pivots would do."""
    z = matrices.random((6, 3), 5)
    for kind in KINDS:
        m = np.eye(6) - far_from_the_identity(kind)
        for given in (m[None], np.stack([m, np.eye(6) - skew(6)])):
            for m, right, left in zip(given, *in_batches(given, z), strict=True):
                inverse = np.linalg.inv(m)
                # Some roundings, times the condition, of the largest.
                atol = 100 * UNIT["float64"] * np.linalg.cond(m) * np.abs(inverse).max()
                with subtests.test(case=f"{kind}, {len(given)}"):
                    np.testing.assert_allclose(right, inverse @ z, rtol=0, atol=atol)
                    np.testing.assert_allclose(left, z.T @ inverse, rtol=0, atol=atol)


def test_skew_systems_of_any_angle(subtests):
    """They take no pivots up to entries of 4, and lose no digits by that."""
    for n, dtype in [(5, dtype) for dtype in matrices.DTYPES] + [(8, np.complex128)]:
        for size in (1e-8, 0.1, 1.0, 3.0, 30.0, 1e4):
            turned = skew(n, 1.0, np.issubdtype(dtype, np.complexfloating))
            m = (np.eye(n) - size * turned).astype(dtype)
            with subtests.test(case=f"{n} {np.dtype(dtype).name} {size}"):
                assert_solved(m, np.eye(n, dtype=dtype), 20)


def test_a_member_that_is_not_finite_spoils_no_other():
    good = np.eye(6) - skew(6)
    for bad in (np.nan, np.inf):
        m = np.stack([good, np.full((6, 6), bad)])
        found = np.asarray(in_batches(m, good[:, :3])[0])
        assert not np.isfinite(found[1]).any()
        np.testing.assert_allclose(found[0], np.eye(6, 3), rtol=0, atol=1e-15 * 5)


@pytest.mark.parametrize("n", [2, 3, 6])
def test_derivatives_of_systems(n):
    """`W = m^-1` has the derivative `-W m' W`, and that the next one."""
    z, dm = (jnp.asarray(matrices.random((n, n), k)) for k in (6, 7))

    @jax.jit
    def derivatives(m):
        out = []
        for fun in (lambda m: solve(m, z), lambda m: solve_from_right(z, m)):
            slope = lambda m, fun=fun: jax.jvp(fun, (m,), (dm,))[1]  # noqa: E731
            gradient = jax.grad(lambda m, fun=fun: jnp.sum(z * fun(m)))(m)
            out.append((*jax.jvp(slope, (m,), (dm,)), gradient))
        return out

    for x in (skew(n), far_from_the_identity("Lorentz", n)):
        m = np.eye(n) - x
        w = np.linalg.inv(m)
        exact = [
            (w @ dm @ w @ z, 2 * w @ dm @ w @ dm @ w @ z),
            (z @ w @ dm @ w, 2 * z @ w @ dm @ w @ dm @ w),
        ]
        for (value, twice, gradient), (first, second) in zip(
            run(derivatives, m), exact, strict=True
        ):
            # Roundings of products of matrices as large as these.
            atol = 1e-14 * np.abs(w).max() ** 2 * n**2
            np.testing.assert_allclose(value, -first, rtol=0, atol=atol)
            np.testing.assert_allclose(twice, second, rtol=1e-12, atol=10 * atol)
            paired = np.sum(gradient * dm)
            np.testing.assert_allclose(paired, -np.sum(z * first), rtol=1e-12, atol=atol)


def test_the_derivative_of_the_transform():
    """`cay(u)' = a cay(u)` from a difference quotient along the result."""
    for is_complex in (False, True):
        u, a = skew(4, 1.5, is_complex), matrices.random((4, 4), 6, np.complex128) / 3
        a = a if is_complex else a.real
        v, h = run(dcayinv, u, a), 1e-3
        rates = [(cay(u + k * h * v) - cay(u - k * h * v)) / (2 * k * h) for k in (1, 2)]
        # Of fourth order, and rounding over the step.
        np.testing.assert_allclose((4 * rates[0] - rates[1]) / 3, a @ cay(u), rtol=0, atol=2e-11)


def test_logarithms_of_determinants():
    """Also of -1, for which `1 + m` is zero; the phases of three eigenvalues go round twice."""
    sizes = np.array([1e-9, 1e-3, 1.0])
    kinds = skew(3, 1.0, True), matrices.random((3, 3), 5, complex) / 4
    few = np.concatenate([np.multiply.outer(sizes, u) for u in kinds])
    angles = np.linspace(-2.4, 2.4, 13)[:, None] + np.array([[0.1, 0.2, -0.4]])
    many = [1j * np.diag(x) for x in (*(2 * np.tan(angles / 2)), np.array([2.0, 2.0, 0.0]))]
    v = np.linalg.qr(matrices.random((3, 3), 4, complex))[0]
    many = np.stack([*many, *(v @ x @ v.conj().T for x in many)])
    found = run(jax.vmap(log_determinant), np.concatenate([few, many]))
    for value, u, size in zip(found, few, np.tile(sizes, 2), strict=False):
        with mpmath.workdps(40):
            x, one = mpmath.matrix((u / 2).tolist()), mpmath.eye(3)
            expected = complex(mpmath.log(mpmath.det(one + x) / mpmath.det(one - x)))
        # As small as the sizes that it is a sum of.
        np.testing.assert_allclose(value, expected, rtol=0, atol=4e-16 * size)
    assert np.abs(np.imag(found)).max() <= np.pi
    expected = [np.linalg.det(cay(x)) for x in many]
    # Some roundings of products of entries up to 5.
    np.testing.assert_allclose(np.exp(found[len(few) :]), expected, rtol=0, atol=1e-14)


def test_whole_turns_are_left_out():
    turns, angles = np.arange(-3, 4)[:, None], np.array([-3.14, -1.0, 0.0, 2.0, 3.14])
    given = 0.5 + 1j * (angles + 2 * np.pi * turns)
    along = lambda z: jax.jvp(without_turns, (z,), (jnp.full_like(z, 1 - 2j),))  # noqa: E731
    found, slopes = run(along, given)
    # A rounding of three turns.
    expected = np.broadcast_to(0.5 + 1j * angles, given.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-15)
    np.testing.assert_array_equal(slopes, 1 - 2j)
    assert run(without_turns, np.asarray(1e-20j)) == 1e-20j


def test_no_turn_by_less_than_one_is_nearly_half_a_turn():
    """But pairs of angles above 2.75 are, and these add up."""
    is_within = partial(run, is_within_half_a_turn)
    for n in (2, 3, 20, 100):
        for angle in (0.1, 1.0):
            u = np.kron(np.eye(n // 2), [[0, -1], [1, 0]]) * 2 * np.tan(angle / 2)
            assert is_within(np.pad(u, (0, n % 2)))
        one = np.zeros((n, n))
        one[1, 0], one[0, 1] = 1, -1
        for angle in (2.75, 3.0, 3.14):
            assert not is_within(one * 2 * np.tan(angle / 2)), (n, angle)
        assert not is_within(np.full((n, n), np.nan))
    # Units and translations are no turn.
    small = np.array([[0.0, 1e6], [-1e-6, 0.0]])
    assert is_within(small) and not is_within(100 * small) and is_within(matrices.POSE)


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

    @jax.jit
    def found(v, velocity):
        made = TangentCoordinates(jnp.asarray(q), v)
        return made.increment, made.rate(velocity), made.is_within_half_a_turn()

    v = tangent(2, q)
    y = point(v)
    velocity, h = tangent(3, y), 1e-3
    increment, rate, _ = run(found, v, velocity)
    np.testing.assert_allclose(q + increment, y, rtol=0, atol=1e-15 * 10)
    np.testing.assert_allclose(y.T @ y, np.eye(p), rtol=0, atol=1e-15 * 10)
    quotient = [(point(v + k * h * rate) - point(v - k * h * rate)) / (2 * k * h) for k in (1, 2)]
    np.testing.assert_allclose((4 * quotient[0] - quotient[1]) / 3, velocity, rtol=0, atol=2e-11)
    # Its size is that of the matrix.
    g = v - q @ (q.T @ v) / 2
    size = np.sum((g @ q.T - q @ g.T) ** 2)
    bound = np.sqrt((72 + 1.2 * min(n, 2 * p)) / size)
    assert run(found, (1 - 1e-9) * bound * v, velocity)[2]
    assert not run(found, (1 + 1e-9) * bound * v, velocity)[2]


def test_half_a_turn_is_where_the_coordinates_end():
    """The transform of what the logarithm of a turn says."""
    a = skew(5, 3.0)
    y = expm(a)
    u = 2 * (y - np.eye(5)) @ np.linalg.inv(y + np.eye(5))
    np.testing.assert_allclose(cay(u), y, rtol=0, atol=1e-13)
    np.testing.assert_allclose(logm(cay(u)), a, rtol=0, atol=1e-12)
    assert not run(is_within_half_a_turn, u)
