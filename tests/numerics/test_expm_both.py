"""exp(a) and exp(-a) together: their polynomials, accuracy, derivatives, batches."""

import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import DTYPES, backward_error, exact_expm, of_norm, random, small, to_numpy
from xla.interpreter import run

from cfjax._numerics import expm_both
from cfjax._numerics.expm_both import expm_both_parts


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


def test_coefficients_are_positive_so_nothing_cancels():
    assert min(w for rows in (expm_both._EVEN, expm_both._ODD) for row in rows for w in row) >= 0


def test_theta_of_both_is_where_the_backward_error_reaches_the_unit_roundoff():
    even, odd = of_rows(expm_both._EVEN), of_rows(expm_both._ODD)
    polynomial = [x for pair in zip(even, odd, strict=True) for x in pair]
    # Rounded coefficients count as exact: they are tested above.
    c = backward_error(polynomial, 15)
    # The coefficient 1/16! is right as well.
    assert c[16] < 1e-28

    def size(x):
        return sum(y * x ** (k - 1) for k, y in enumerate(c) if k > 16)

    for precision, unit in (("float32", 2.0**-24), ("float64", 2.0**-53)):
        theta = expm_both._THETA[precision]
        assert size(theta) <= unit < size(theta * 1.001)


OF_BOTH = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.86, 1.0, 10.0, 100.0, 1e4)),
    *(("general", norm) for norm in (0.1, 0.87, 2.7)),
    *((kind, norm) for kind in ("negative", "nilpotent", "double") for norm in (0.5, 10.0)),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [5, 1])
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
    # What is not finite stays with its member.
    batch[0, 0, -1], batch[1, -1, -1], batch[2] = np.nan, np.inf, np.finfo(dtype).max / 8
    for before, after in zip(found, mapped(batch), strict=True):
        assert np.isnan(after[:2]).all() and not np.isfinite(after[2]).any()
        np.testing.assert_array_equal(after[3:], before[3:])


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [2, 3])
def test_both_of_sizes_2_and_3(n):
    norms = [0.0, 1e-3, 0.7, 1.3, 20.0]
    a = np.stack([small("skew", n, norm, k) for k, norm in enumerate(norms)])
    weights, plus, minus = run(jax.vmap(expm_both_parts), a)
    eye = np.eye(n)
    for norm, x, w, p, m in zip(norms, a, weights, plus, minus, strict=True):
        for sign, rest in ((1, p), (-1, m)):
            # As in test_accuracy_of_both.
            atol = 4 * n * 2.0**-52 * max(1.0, norm)
            exact = to_numpy(exact_expm(sign * x))
            np.testing.assert_allclose(w * (eye + sign * x) + rest, exact, rtol=0, atol=atol)


def test_both_are_exact_at_zero_and_the_rest_is_as_small_as_the_square():
    direction, near = random((3, 3)), of_norm("general", 3, 1e-6)
    with_tangents = jax.jit(lambda a: jax.jvp(expm_both_parts, (a,), (direction,)))
    (weight, *rest), tangents = run(with_tangents, np.zeros((3, 3)))
    assert weight == 1
    # The tangents are those of I + a and I - a.
    np.testing.assert_array_equal(rest, np.zeros((2, 3, 3)))
    np.testing.assert_array_equal(tangents[1:], np.zeros((2, 3, 3)))
    for sign, x in zip((1, -1), run(with_tangents, near)[0][1:], strict=True):
        with mpmath.workdps(60):
            exact = exact_expm(sign * near) - mpmath.matrix(near.tolist()) * sign - mpmath.eye(3)
        # Relative to a^2: a product and a sum.
        atol = 4 * 2.0**-52 * np.linalg.norm(near) ** 2
        np.testing.assert_allclose(x, to_numpy(exact), rtol=0, atol=atol)


@pytest.mark.slow
def test_second_derivatives_of_both():
    """Those of `sum(w * both(t a))` by t, reverse over reverse; the first are in the contract."""

    def second(a, w):
        value = lambda t: jnp.sum(w * (sum(both(t * a))))  # noqa: E731
        return jax.grad(jax.grad(value))(1.0)

    cases = [("skew", x) for x in (0.0, 1e-12, 0.5, 3.0, 100.0)] + [("general", 1.0)]
    a = np.stack([of_norm(kind, 3, norm) for kind, norm in cases])
    w = random((len(cases), 3, 3), 1)
    found = run(jax.vmap(second), a, w)
    for (kind, norm), x, weight, got in zip(cases, a, w, found, strict=True):
        # The derivatives are products of two factors exp, each with the error in the test of
        # accuracy, and of norm e^2 at most for the general one.
        growth = 1 if kind == "skew" else np.exp(2)
        bound = 2 * 10 * 2.0**-52 * max(1, norm) * growth * 3
        twice = x @ x @ (scipy.linalg.expm(x) + scipy.linalg.expm(-x))
        # Nine entries of size norm^2.
        atol = 9 * bound * max(1, norm) ** 2
        np.testing.assert_allclose(got, np.sum(weight * twice), rtol=0, atol=atol)


def test_branches_stay_branches_in_a_batch():
    def conditions(f, *args):
        return str(jax.make_jaxpr(f)(*args)).count(" cond[")

    a = np.stack([of_norm("skew", 6, norm) for norm in (0.1, 50.0)])
    assert conditions(jax.vmap(both), a) == conditions(both, a[0]) > 0
