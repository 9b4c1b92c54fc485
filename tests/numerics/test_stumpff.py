"""Stumpff functions: accuracy for every argument, derivatives, and what is not finite."""

import functools
import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from problems import SQUARES_OF_ANGLES
from xla.interpreter import run

from cfjax import Rotation, stumpff
from cfjax._numerics.stumpff import cotangent_excess, stumpff_1_to_3_apart

ORDERS = 3
# About zero, about the limits of formulas, x = 2 and 4, and half powers of two.
NEGATIVE = [
    *(-1e-300, -1e-30, -1e-8, -1e-3, -1.0),
    *(-((k * np.log(2)) ** 2) * (1 + d) for k in (3.5, 10.5) for d in (-1e-6, 0.0, 1e-6)),
    *(-4 * (1 + d) for d in (-1e-6, 0.0, 1e-6)),
    *(-16 * (1 + d) for d in (-1e-6, 0.0, 1e-6)),
    *(-40.0, -110.0, -1e3, -7e3),
]
ARGUMENTS = [*SQUARES_OF_ANGLES, *NEGATIVE]
DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def reference(n, s):
    """c_n and three derivatives at s: the series itself, with enough digits for its cancellation.

    The largest term is below exp(x), which costs x / log(10) digits of those carried.
    """
    with mp.workdps(40 + int(math.sqrt(abs(s)) / 2)):
        s = mp.mpf(float(s))
        sums = [mp.mpf(0)] * (ORDERS + 1)
        term = 1 / mp.factorial(n)  # s^j / (n + 2j)! with its sign
        inverse = 1 / s if s else mp.mpf(0)
        j = 0
        small = mp.mpf(10) ** (-mp.mp.dps)
        while j <= ORDERS + 1 or abs(term) > small:
            # The factor j (j-1) .. of d^k and its power of s, from the term or, at zero, directly.
            power = term
            for k in range(ORDERS + 1):
                if k <= j:
                    if s:
                        sums[k] += power
                    elif k == j:
                        sums[k] += (-1) ** j * mp.factorial(j) / mp.factorial(n + 2 * j)
                power *= (j - k) * inverse
            j += 1
            term *= -s / ((n + 2 * j) * (n + 2 * j - 1))
        return [float(x) for x in sums]


def bound(n, s, value, unit):
    """What the docstring promises, in units of rounding of x = sqrt(|s|).

    Absolute in x c_1 and x^2 c_2 for s > 0. So c_0 = 1 - x^2 c_2 has the error of x itself. From
    c_3 on the function is (1 / (n - 2)! - c_{n-2}) / s where s is large: its error is that of the
    numerator. For small s the series has a relative error, and up to c_3 for all negative s.
    """
    x = math.sqrt(abs(s))
    if s < 0 and n <= 3:
        return unit * max(1, x) * value[n]
    if n == 0:
        return unit * max(1, x)
    if n <= 2 or x * x < 15.9:
        return unit * (abs(value[n]) if x < 1 else (1 / x ** (n - 1) if n <= 2 else value[n]))
    return (unit / math.factorial(n - 2) + bound(n - 2, s, value, unit)) / (x * x)


def derivative_bound(n, k, s, value, unit):
    """The derivative is (n c_{n+2} - c_{n+1}) / 2: errors add up as absolute values."""
    if k == 0:
        return bound(n, s, value, unit)
    below = n * derivative_bound(n + 2, k - 1, s, value, unit)
    return (below + derivative_bound(n + 1, k - 1, s, value, unit)) / 2


@functools.cache
def exact(dtype):
    """All references, for the arguments rounded to a precision: `[i][n][k]`."""
    return [[reference(n, s) for n in range(12)] for s in np.array(ARGUMENTS, dtype)]


def derivatives(n):
    """The value and three derivatives, from one nest of forward modes."""

    def deeper(f):
        return lambda s: jax.jvp(f, (s,), (jnp.ones_like(s),))

    def one(s):
        nest = deeper(deeper(deeper(lambda s: stumpff(n, s))))(s)
        ((c, first), (_, second)), (_, (_, third)) = nest
        return jnp.stack([c, first, second, third])

    return jax.jit(jax.vmap(one))


@pytest.mark.representatives(1)
@DTYPES
@pytest.mark.parametrize("n", range(6))
def test_values_and_three_derivatives(n, dtype):
    arguments = np.array(ARGUMENTS, dtype)
    got = derivatives(n)(arguments)
    assert got.dtype == dtype
    # A few units: the reduced angle, a square, a polynomial and a product round once each.
    unit = 4 * np.finfo(dtype).eps
    for s, row, want in zip(arguments, np.asarray(got, np.float64), exact(dtype), strict=True):
        value = [abs(w[0]) for w in want]
        for k in range(ORDERS + 1):
            allowed = derivative_bound(n, k, float(s), value, unit)
            assert abs(row[k] - want[n][k]) <= allowed, (s, k, row[k], want[n][k])


every = jax.jit(lambda s: [stumpff(n, s) for n in range(6)])


@pytest.mark.representatives(1)
@DTYPES
def test_many_turns(dtype):
    # x = 1e4 and its neighbourhood: a unit of rounding of x is all that can be asked of a sine.
    s = np.array(1e8, dtype)
    with mp.workdps(40):
        exact = mp.mpf(float(s))
        x = mp.sqrt(exact)
        value = [mp.cos(x), mp.sin(x) / x, (1 - mp.cos(x)) / exact]
        for n in range(3, 6):
            value.append((1 / mp.factorial(n - 2) - value[n - 2]) / exact)
    for n, found in enumerate(run(every, s)):
        allowed = bound(n, float(s), [abs(float(v)) for v in value], 4 * np.finfo(dtype).eps)
        assert abs(float(found) - float(value[n])) <= allowed, n


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", range(6))
def test_taylor_coefficients_at_zero(n):
    # d^k c_n(0) = (-1)^k k! / (n + 2k)!, in reverse mode. One rounding for each of two operations
    # an order.
    functions = [lambda s: stumpff(n, s)]
    for _ in range(ORDERS):
        functions.append(jax.grad(functions[-1]))
    found = run(lambda s: [f(s) for f in functions], np.zeros(()))
    for k, value in enumerate(found):
        want = (-1) ** k * math.factorial(k) / math.factorial(n + 2 * k)
        assert float(value) == pytest.approx(want, rel=(2 * k + 1) * 2.0**-52)


def test_shapes():
    for shape in ((), (0,), (2, 3)):
        found = jax.eval_shape(every, jax.ShapeDtypeStruct(shape, float))
        assert [x.shape for x in found] == [shape] * 6


@DTYPES
def test_an_angle_without_digits_is_nan(dtype):
    info = np.finfo(dtype)
    limit = np.array(2.0 ** (2 * (info.nmant - 7)), dtype)
    rng = np.random.default_rng(1)
    s = limit * np.array([1.0, *rng.uniform(0.1, 1.0, 100)], dtype)
    large = np.array([1.01 * limit, info.max / 2, np.inf, np.nan, 1.0], dtype)
    found = every(np.concatenate([s, large]))
    sine, versine, s = (np.asarray(x, float) for x in (found[1][:101], found[2][:101], s))
    # sin^2 + cos^2 = 1 holds as for small angles, so lengths stay: a few units of rounding.
    circle = sine**2 * s + (1 - versine * s) ** 2
    np.testing.assert_allclose(circle, 1.0, rtol=0, atol=16 * info.eps)
    # And what is not a number stays with its member.
    for values in found:
        np.testing.assert_array_equal(np.isnan(values[101:]), [True] * 4 + [False])


def test_a_derivative_computes_each_function_once():
    """In what is traced already: compilers find what is computed twice, after a while."""
    x = jnp.asarray([0.3, 0.2, 0.1])

    def turned(a, v):
        return Rotation(a).flow(v)

    def tangent(a, v):
        return jax.jvp(turned, (a, v), (v, a))[1]

    def cotangents(a, v):
        return jax.vjp(turned, a, v)[1](a)

    for derivative in (turned, tangent, cotangents):
        # The length of an angle goes to its bits and back.
        assert str(jax.make_jaxpr(derivative)(x, x)).count("bitcast_convert_type") == 2


# As it is exported


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [0, 1, 3])
def test_stumpff_takes_arrays_of_numpy(n):
    s = np.array([[0.0, 0.25], [1.0, 4.0]], np.float32)
    x = np.sqrt(s.astype(float))
    expected = {0: np.cos(x), 1: np.sinc(x / np.pi), 3: None}[n]
    if expected is None:
        expected = np.where(x > 0, (x - np.sin(x)) / np.where(x > 0, x, 1) ** 3, 1 / 6)
    found = run(lambda: stumpff(n, s))
    assert found.dtype == s.dtype
    # Some units of rounding of numbers of order one.
    np.testing.assert_allclose(found, expected, rtol=0, atol=8 * 2.0**-24)


@DTYPES
def test_what_overflows_does_not_spread(dtype):
    """In reverse mode: what one sign makes of the arguments of the other is nowhere."""
    large = np.sqrt(np.finfo(dtype).max).astype(dtype)
    s = jnp.asarray([0.0, -0.0, large, 2.0**32, -7e3, -4.9e5, -large], dtype)
    values, slopes = run(jax.vmap(jax.value_and_grad(lambda s: stumpff(1, s))), s)
    np.testing.assert_allclose(slopes[:2], -1 / 6, rtol=4 * np.finfo(dtype).eps)
    is_known = np.array([True, True, False, True, True, dtype == np.float64, False])
    np.testing.assert_array_equal(is_known, np.isfinite(slopes))
    np.testing.assert_array_equal(is_known, np.isfinite(values))


def test_stumpff_refuses(no_shape_hook, subtests):
    for n, s, error, message in (
        (1.0, np.ones(2), TypeError, "n must be an int, got 1.0 of type float"),
        (True, np.ones(2), TypeError, "n must be an int, got True of type bool"),
        (-1, np.ones(2), ValueError, "n must be at least 0, got -1"),
        (1, np.ones(2, int), TypeError, "s must be float32 or float64, got int64"),
        (1, np.ones(2, complex), TypeError, "s must be float32 or float64, got complex128"),
    ):
        with subtests.test(case=message), pytest.raises(error, match=message):
            stumpff(n, s)


# Stumpff functions together, and the cotangent of the inverse derivative of exp


def three(s):
    near, d1, d2, c3 = stumpff_1_to_3_apart(s)
    return near + d1, near / 2 + d2, c3


@pytest.mark.representatives(1)
@DTYPES
def test_stumpff_functions_1_to_3_together(dtype):
    s = np.asarray(SQUARES_OF_ANGLES, dtype)

    def along(fun):
        return zip(*run(lambda s: jax.jvp(fun, (s,), (jnp.ones_like(s),)), s), strict=True)

    apart = along(lambda s: tuple(stumpff(n, s) for n in (1, 2, 3)))
    for (got, slope), (want, want_slope) in zip(along(three), apart, strict=True):
        # The same formulas, perhaps rounded in another order: the bound of either, twice.
        eps = 8 * np.finfo(dtype).eps
        np.testing.assert_allclose(got, want, rtol=eps, atol=eps)
        np.testing.assert_allclose(slope, want_slope, rtol=eps, atol=eps)


@DTYPES
def test_cotangent_excess(dtype):
    """Against `(1 - x/2 cot(x/2)) / x^2` itself, with 60 digits for what cancels, and its slopes.

    By differences of 60 digits, which leave 20.
    """
    x = np.array([0.0, 1e-20, 1e-4, 0.1, 1.0, np.pi, 4.5, 6.0, 6.2])
    s = jnp.asarray(x * x, dtype)
    first = jax.grad(cotangent_excess)
    functions = cotangent_excess, first, jax.grad(first)
    found = run(jax.vmap(lambda s: [f(s) for f in functions]), s)

    def at_angle(s):
        x = mp.sqrt(s)
        return (1 - x / 2 * mp.cot(x / 2)) / s

    with mp.workdps(60):
        for k, at in enumerate(s):
            at = mp.mpf(float(at))
            h = mp.mpf(10) ** -12
            # The series about zero, of which the first term that is left out is below 1e-40.
            f = at_angle if at > 1e-10 else lambda s: 1 / mp.mpf(12) + s / 720 + s**2 / 30240
            values = [f(at + j * h) for j in (-1, 0, 1)]
            wants = (
                values[1],
                (values[2] - values[0]) / (2 * h),
                (values[2] - 2 * values[1] + values[0]) / h**2,
            )
            # One unit of s moves the pole by that much, each derivative once more; and a
            # derivative of the polynomial is ten times as far off as that is.
            near = float(4 * mp.pi**2 / (4 * mp.pi**2 - at))
            for n, (got, want) in enumerate(zip(found, wants, strict=True)):
                rtol = 8 * 10**n * (n + 1) * near * np.finfo(dtype).eps
                # Markov's inequality: what a rounding of the polynomial, of degree 13 on an
                # interval of length 4 pi^2, can be in its derivatives at an end.
                atol = np.finfo(dtype).eps / 12 * (2 * 13**2 / (4 * np.pi**2)) ** n
                np.testing.assert_allclose(
                    float(got[k]), float(want), rtol, atol, err_msg=f"{n} at {at}"
                )


@pytest.mark.representatives(1)
@DTYPES
def test_cotangent_excess_is_finite_beyond_a_full_turn(dtype):
    s = jnp.asarray([4 * math.pi**2 * 1.0001, 100.0, np.finfo(dtype).max, np.inf], dtype)
    got, slope = run(jax.vmap(jax.value_and_grad(cotangent_excess)), s)
    np.testing.assert_allclose(got, 1 / 12, rtol=4 * np.finfo(dtype).eps)
    np.testing.assert_array_equal(slope, 0)
