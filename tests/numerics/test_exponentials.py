"""What fields use of exponentials of small dense matrices: their polynomials, the rest of exp(a)
beside I + a, exp(a) and exp(-a) together, and what a constant source adds to a congruence."""

import math
from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import (
    DTYPES,
    POSE,
    THETA,
    backward_error,
    coefficients,
    exact_expm,
    of_norm,
    random,
    small,
    to_numpy,
)

from cfjax._numerics import cayley_hamilton, expm_both
from cfjax._numerics.expm import (
    _DEGREE_15,
    _DEGREE_15_DOUBLE,
    _DEGREE_21,
    TAYLOR_SCHEMES,
    expm_parts,
)
from cfjax._numerics.expm_both import expm_both_parts
from cfjax._numerics.expm_source import _SMALLER, expm_parts_with_source

# Polynomials

SCHEMES = pytest.mark.parametrize(
    ("scheme", "degree", "unit"),
    [
        (_DEGREE_15, 15, 2.0**-24),
        (_DEGREE_15_DOUBLE, 15, 2.0**-53),
        (_DEGREE_21, 21, 2.0**-53),
    ],
)


@SCHEMES
def test_polynomial_is_the_taylor_polynomial(scheme, degree, unit):
    del unit
    got = coefficients(scheme)
    assert got[0] == got[1] == 1
    for k in range(2, degree + 1):
        # Rounding the weights to double moves a coefficient by at most 2.8e-16 (computed here).
        assert abs(float(got[k] * math.factorial(k) - 1)) < 4e-16
    # The degrees above are not Taylor's, or the name of the scheme would be wrong.
    assert all(
        abs(float(got[k] * math.factorial(k) - 1)) > 0.1 for k in range(degree + 1, len(got))
    )


@pytest.mark.parametrize("scheme", [_DEGREE_15, _DEGREE_21])
def test_the_first_coefficients_have_no_bias(scheme):
    """What they are off by is the same in every step, and drift grows with the number of steps."""
    got = coefficients(scheme)
    for k in range(2, 7):
        assert abs(float(got[k] - Fraction(1, math.factorial(k)))) < 1e-17


@SCHEMES
def test_theta_is_where_the_backward_error_reaches_the_unit_roundoff(scheme, degree, unit):
    log = backward_error(coefficients(scheme), degree)

    def backward(x):
        return sum(c * x ** (k - 1) for k, c in enumerate(log) if k > degree)

    assert backward(scheme.theta) <= unit < backward(scheme.theta * 1.001)


def test_the_norms_are_those_that_the_other_tests_know():
    for precision, thetas in THETA.items():
        assert tuple(scheme.theta for scheme in TAYLOR_SCHEMES[precision]) == thetas


@pytest.mark.parametrize(("precision", "norm"), [("float32", 1.7), ("float64", 1.8)])
def test_degrees_of_sizes_2_and_3_are_enough(precision, norm):
    degree = cayley_hamilton._DEGREE[precision]
    log = backward_error([0] * (degree + 1), degree)
    unit = 2.0**-24 if precision == "float32" else 2.0**-53
    assert sum(c * norm ** (k - 1) for k, c in enumerate(log)) <= unit


# The rest of exp(a)


@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
@pytest.mark.parametrize("n", [2, 3])
def test_the_rounding_of_the_rest_is_as_small_as_it_is(n, dtype):
    cases = [(kind, norm) for kind in ("skew", "meet", "general") for norm in (1e-6, 1e-3, 0.5)]
    a = np.stack([small(kind, n, norm, 0, dtype) for kind, norm in cases])
    weights, found = jax.jit(jax.vmap(expm_parts))(a)
    assert (np.asarray(weights) == 1).all()
    for x, rest in zip(a, np.asarray(found), strict=True):
        with mpmath.workdps(60):
            m = mpmath.matrix(x.tolist())
            exact = to_numpy(exact_expm(x) - mpmath.eye(n) - m)
        # Those of c, and of one product, relative to the square of a, which for real skew matrices
        # of size 2 is no smaller than the norm squared.
        atol = 8 * np.finfo(dtype).eps * np.linalg.norm(x) ** 2
        np.testing.assert_allclose(rest, exact, rtol=0, atol=atol)


def test_the_rest_of_a_pose_far_away():
    weight, rest = expm_parts(jnp.asarray(POSE))
    assert weight == 1
    assert np.array_equal(rest[2], np.zeros(3))


# exp(a) and exp(-a) together


def both(a):
    weight, plus, minus = expm_both_parts(a)
    one = jnp.eye(a.shape[0], dtype=a.dtype)
    return weight * (one + a) + plus, weight * (one - a) + minus


mapped = jax.jit(jax.vmap(both))


def of_rows(rows):
    """In powers of Z, without rounding."""

    def combine(weights):
        z, z2, shared = weights
        c3, c4 = expm_both._SHARED
        return [0, z, z2, Fraction(shared) * Fraction(c3), Fraction(shared) * Fraction(c4)]

    left, right, rest = ([Fraction(x) for x in combine(row)] for row in rows)
    out = [*rest, *[Fraction(0)] * 4]
    for i, x in enumerate(left):
        for j, y in enumerate(right):
            out[i + j] += x * y
    return out


def test_polynomials_are_those_of_cosh_and_sinh():
    for odd, rows in [(0, expm_both._EVEN), (1, expm_both._ODD)]:
        got = of_rows(rows)
        for k in range(1, 8):
            # Rounding the weights to double moves a coefficient by 1.5e-16 at most (found here).
            assert abs(float(got[k] * math.factorial(2 * k + odd) - 1)) < 3e-16
            if k < 4:  # An error of these would be the same in every step.
                assert abs(float(got[k] - Fraction(1, math.factorial(2 * k + odd)))) < 1e-17
        last = 1 if odd == 0 else 17 / 15
        assert float(got[8] * math.factorial(16 + odd)) == pytest.approx(last, rel=1e-15)


def test_nothing_cancels():
    assert min(w for rows in (expm_both._EVEN, expm_both._ODD) for row in rows for w in row) >= 0


@pytest.mark.parametrize(("precision", "unit"), [("float32", 2.0**-24), ("float64", 2.0**-53)])
def test_theta_of_both_is_where_the_backward_error_reaches_the_unit_roundoff(precision, unit):
    even, odd = of_rows(expm_both._EVEN), of_rows(expm_both._ODD)
    polynomial = [x for pair in zip(even, odd, strict=True) for x in pair]
    # Those that are rounded count as exact: they are tested above.
    c = backward_error(polynomial, 15)
    # Of 1/16! as well.
    assert c[16] < 1e-28

    def size(x):
        return sum(y * x ** (k - 1) for k, y in enumerate(c) if k > 16)

    theta = expm_both._THETA[precision]
    assert size(theta) <= unit < size(theta * 1.001)


OF_BOTH = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.86, 1.0, 10.0, 100.0, 1e4)),
    *(("general", norm) for norm in (0.1, 0.87, 2.7)),
    *((kind, norm) for kind in ("negative", "nilpotent", "double") for norm in (0.5, 10.0)),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [5, 3, 1, 8])
def test_accuracy_of_both(n, dtype):
    batch = np.stack([of_norm(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(OF_BOTH)])
    found = mapped(batch)
    for case, a, *got in zip(OF_BOTH, batch, *map(np.asarray, found), strict=True):
        wide = a.astype(np.promote_types(dtype, np.float64))
        # For one number cosh - sinh cancels, up to theta; in a matrix, the largest entries count.
        condition = np.exp(2 * expm_both._THETA[np.finfo(dtype).dtype.name]) if n == 1 else 1.0
        if case[0] not in ("skew", "negative") and n > 1:
            condition = max(scipy.linalg.expm_cond(sign * wide) for sign in (1, -1))
        # Squarings double the relative error of normal matrices, and add n units: 2 n norm in all,
        # as the scaled norm is at least a half of theta. One for the polynomials. Others can lose
        # their condition number.
        bound = (1 + 3 * n) * np.finfo(dtype).eps * max(1.0, case[1], condition)
        for sign, x in zip((1, -1), got, strict=True):
            assert x.dtype == dtype
            # SciPy's double precision is exact enough for single.
            is_double = np.finfo(dtype).bits == 64
            exact = to_numpy(exact_expm(sign * a)) if is_double else scipy.linalg.expm(sign * wide)
            assert np.linalg.norm(x - exact, 2) <= bound * np.linalg.norm(exact, 2), (case, sign)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [2, 3])
def test_both_of_sizes_2_and_3(n):
    norms = [0.0, 1e-3, 0.7, 1.3, 20.0]
    a = np.stack([small("skew", n, norm, k) for k, norm in enumerate(norms)])
    weights, plus, minus = map(np.asarray, jax.jit(jax.vmap(expm_both_parts))(a))
    eye = np.eye(n)
    for norm, x, w, p, m in zip(norms, a, weights, plus, minus, strict=True):
        for sign, rest in ((1, p), (-1, m)):
            # As in test_accuracy_of_both.
            atol = 4 * n * 2.0**-52 * max(1.0, norm)
            exact = to_numpy(exact_expm(sign * x))
            np.testing.assert_allclose(w * (eye + sign * x) + rest, exact, rtol=0, atol=atol)


def test_both_are_exact_at_zero():
    a, direction = np.zeros((3, 3)), random((3, 3))
    (weight, *rest), tangents = jax.jvp(jax.jit(expm_both_parts), (a,), (direction,))
    assert weight == 1
    # The tangents are those of I + a and I - a.
    np.testing.assert_array_equal(rest, np.zeros((2, 3, 3)))
    np.testing.assert_array_equal(tangents[1:], np.zeros((2, 3, 3)))


def test_the_rest_of_both_is_as_small_as_the_square():
    a = of_norm("general", 3, 1e-6)
    _, *rest = jax.jit(expm_both_parts)(a)
    for sign, x in zip((1, -1), rest, strict=True):
        with mpmath.workdps(60):
            exact = exact_expm(sign * a) - mpmath.matrix(a.tolist()) * sign - mpmath.eye(3)
        # Relative to a^2: a product and a sum.
        atol = 4 * 2.0**-52 * np.linalg.norm(a) ** 2
        np.testing.assert_allclose(x, to_numpy(exact), rtol=0, atol=atol)


@cache
def derivatives_of_both():
    """Of both along a direction: forward, and by reverse mode of a product."""

    @jax.jit
    @jax.vmap
    def of(a, d, weight):
        pushed = jax.jvp(both, (a,), (d,))[1]
        pulled = jax.vjp(both, a)[1]((weight, weight))[0]
        # Of sum(weight * both(t a)) twice by t, reverse over reverse.
        value = lambda t: jnp.sum(weight * (sum(both(t * a))))  # noqa: E731
        return pushed, pulled, jax.grad(jax.grad(value))(1.0)

    return of


@pytest.mark.slow
def test_derivatives_of_both():
    cases = [("skew", x) for x in (0.0, 1e-12, 0.5, 3.0, 100.0)] + [("general", 1.0)]
    a = np.stack([of_norm(kind, 3, norm) for kind, norm in cases])
    d, w = random((2, len(cases), 3, 3), 1)
    pushed, pulled, second = derivatives_of_both()(a, d, w)
    for k, (kind, norm) in enumerate(cases):
        # The derivatives are products of two factors exp, each with the error in the test of
        # accuracy, and of norm e^2 at most for the general one.
        growth = 1 if kind == "skew" else np.exp(2)
        bound = 2 * 10 * 2.0**-52 * max(1, norm) * growth * 3
        exact = [scipy.linalg.expm_frechet(s * a[k], s * d[k], compute_expm=False) for s in (1, -1)]
        for got, x in zip((pushed[0][k], pushed[1][k]), exact, strict=True):
            np.testing.assert_allclose(got, x, rtol=0, atol=bound)
        # The transpose of L(a, .) is L(a^T, .).
        exact = [
            s * scipy.linalg.expm_frechet(s * a[k].T, w[k], compute_expm=False) for s in (1, -1)
        ]
        np.testing.assert_allclose(pulled[k], sum(exact), rtol=0, atol=2 * bound)
        twice = a[k] @ a[k] @ (scipy.linalg.expm(a[k]) + scipy.linalg.expm(-a[k]))
        # Of size norm^2, nine entries.
        atol = 9 * bound * max(1, norm) ** 2
        np.testing.assert_allclose(second[k], np.sum(w[k] * twice), rtol=0, atol=atol)


@pytest.mark.parametrize("dtype", [float, complex])
def test_not_finite_both_stay_with_their_member(dtype):
    batch = np.stack([of_norm("general", 3, 1.0, k, dtype) for k in range(4)])
    batch[0, 0, 1], batch[1, 2, 2] = np.nan, np.inf
    batch[2] *= 1e300
    for x in map(np.asarray, jax.jit(jax.vmap(expm_both_parts))(batch)[1:]):
        assert np.isnan(x[:3]).all()
        assert np.isfinite(x[3]).all()


def test_branches_stay_branches_in_a_batch():
    def conditions(f, *args):
        return str(jax.make_jaxpr(f)(*args)).count(" cond[")

    a = np.stack([of_norm("skew", 6, norm) for norm in (0.1, 50.0)])
    assert conditions(jax.vmap(both), a) == conditions(both, a[0]) > 0


# With a source


def with_source(a, q):
    weight, rest, g = expm_parts_with_source(a, q)
    return weight * (jnp.eye(a.shape[0], dtype=a.dtype) + a) + rest, g


mapped_with_source = jax.jit(jax.vmap(with_source))


def block(a, q):
    """Van Loan's."""
    b = np.block([[a, q], [np.zeros(a.shape), -a.conj().T]])
    return mpmath.matrix(b.tolist())


def exact_source(m, n):
    """Its entries. The block loses exp(2 |a|): 60 digits are enough up to a norm of 50."""
    with mpmath.workdps(60):
        e = exact_expm(m)
        return list(e[:n, n:] * e[:n, :n].H)


def test_norms_are_where_the_error_in_the_source_reaches_the_unit_roundoff():
    for precision, unit in [("float32", 2.0**-24), ("float64", 2.0**-53)]:
        for scheme in TAYLOR_SCHEMES[precision]:
            degree = 15 if scheme.powers == 2 else 21
            c = backward_error(coefficients(scheme), degree)
            theta = _SMALLER * scheme.theta
            # The derivative of a^k has k terms. A tenth: the factor suits the worst scheme.
            assert 0.1 * unit < sum(k * y * theta ** (k - 1) for k, y in enumerate(c) if y) <= unit


WITH_SOURCE = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.1, 0.55, 0.57, 1.3, 1.5, 10.0, 40.0)),
    *((kind, 2.0) for kind in ("general", "nilpotent", "double")),
    *(("negative", norm) for norm in (0.5, 30.0)),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [3, 6, 1])
def test_accuracy_with_a_source(n, dtype):
    a = np.stack([of_norm(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(WITH_SOURCE)])
    q = random((len(WITH_SOURCE), n, n), 7, dtype)
    found = map(np.asarray, mapped_with_source(a, q))
    wide = np.promote_types(dtype, np.float64)
    for case, a1, q1, e, g in zip(WITH_SOURCE, a, q, *found, strict=True):
        kind, norm = case
        growth = 1.0 if kind in ("skew", "negative") else np.exp(2 * norm)
        # As for expm: n units of rounding, doubled by each squaring, and what is not normal may
        # lose its growth. Of one number exp(-theta) cancels.
        bound = 2 * (n + 3) * np.finfo(dtype).eps * max(1.0, norm) * growth
        a1, q1 = a1.astype(wide), q1.astype(wide)
        assert g.dtype == dtype
        np.testing.assert_allclose(e, scipy.linalg.expm(a1), rtol=0, atol=bound, err_msg=str(case))
        exact = np.array(exact_source(block(a1, q1), n), complex).reshape(n, n)
        atol = bound * np.linalg.norm(q1)
        np.testing.assert_allclose(g, exact, rtol=0, atol=atol, err_msg=str(case))


def test_exact_at_zero_with_a_source():
    a, d = np.zeros((3, 3), complex), random((3, 3), 1, complex)
    q = random((3, 3), 2, complex)
    (weight, rest, g), tangents = jax.jvp(jax.jit(expm_parts_with_source), (a, q), (d, q))
    assert weight == 1
    np.testing.assert_array_equal(rest, np.zeros((3, 3)))
    np.testing.assert_array_equal(g, q)
    # d/da of the integral at zero, a unit of rounding of each of four terms.
    want = (d @ q + q @ d.conj().T) / 2 + q
    np.testing.assert_allclose(tangents[2], want, rtol=0, atol=4 * 2.0**-52 * 10)


def test_semidefinite_stays_semidefinite():
    """A source of rank one, so that three eigenvalues of the integral are small or zero."""
    norms = [0.0, 1e-6, 0.1, 1.0, 5.0, 30.0]
    a = np.stack([of_norm("general" if norm < 3 else "negative", 4, norm) for norm in norms])
    v = random((4, 1), 3)
    q = np.broadcast_to(v @ v.T, a.shape)
    for g in np.asarray(mapped_with_source(a, q)[1]):
        least = np.linalg.eigvalsh((g + g.T) / 2).min()
        # 20 units of rounding of the whole.
        assert least >= -20 * 2.0**-52 * max(np.linalg.norm(g), np.linalg.norm(q[0]))


@pytest.mark.slow
def test_derivatives_with_a_source():
    w, d, r = random((3, 3, 3), 4)

    @jax.jit
    @jax.vmap
    def found(a, q):
        def value(t):
            return jnp.sum(w * expm_parts_with_source(a + t * d, q + t * r)[2])

        slope = lambda t: jax.jvp(value, (t,), (1.0,))[1]  # noqa: E731
        return jax.grad(value)(0.0), *jax.jvp(slope, (0.0,), (1.0,))

    norms = [0.0, 1e-12, 0.5, 3.0]
    a = np.stack([of_norm("general", 3, norm) for norm in norms])
    q = random((4, 3, 3), 5)
    h = mpmath.mpf(10) ** -15
    for norm, a1, q1, *got in zip(norms, a, q, *found(a, q), strict=True):

        def value(t, a1=a1, q1=q1):
            m = block(a1, q1) + t * block(d, r)
            return sum(x * y for x, y in zip(exact_source(m, 3), np.ravel(w), strict=True))

        # Differences in 60 digits: an error of 1e-30.
        with mpmath.workdps(60):
            ends = value(h), value(0), value(-h)
            first, second = (ends[0] - ends[2]) / (2 * h), (ends[0] - 2 * ends[1] + ends[2]) / h**2
        # Some ten units for each of three factors exp, of norm exp(norm) at most.
        atol = 30 * 2.0**-52 * np.exp(3 * norm) * 30
        assert abs(got[0] - float(first)) <= atol
        assert abs(got[1] - float(first)) <= atol
        assert abs(got[2] - float(second)) <= 10 * atol


def test_a_source_that_is_not_finite_stays_with_its_member():
    a, q = random((2, 3, 3, 3), 6)
    a[0, 0, 1], q[1, 1, 1] = np.nan, np.inf
    g = np.asarray(mapped_with_source(a, q)[1])
    assert np.isnan(g[0]).all() and not np.isfinite(g[1]).all() and np.isfinite(g[2]).all()
