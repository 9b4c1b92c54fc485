"""Stumpff functions: accuracy for every argument, derivatives, and what is not finite."""

import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from problems import SQUARES_OF_ANGLES

from cfjax import Rotation, stumpff

ORDERS = 3
DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def reference(n, s):
    """c_n and three derivatives at s: the series itself, with enough digits for its cancellation.

    The largest term is below exp(x), which costs x / log(10) digits of those carried.
    """
    with mpmath.workdps(40 + int(math.sqrt(s) / 2)):
        s = mpmath.mpf(float(s))
        sums = [mpmath.mpf(0)] * (ORDERS + 1)
        term = 1 / mpmath.factorial(n)  # s^j / (n + 2j)! with its sign
        inverse = 1 / s if s else mpmath.mpf(0)
        j = 0
        small = mpmath.mpf(10) ** (-mpmath.mp.dps)
        while j <= ORDERS + 1 or abs(term) > small:
            # The factor j (j-1) .. of d^k and its power of s, from the term or, at zero, directly.
            power = term
            for k in range(ORDERS + 1):
                if k <= j:
                    if s:
                        sums[k] += power
                    elif k == j:
                        sums[k] += (-1) ** j * mpmath.factorial(j) / mpmath.factorial(n + 2 * j)
                power *= (j - k) * inverse
            j += 1
            term *= -s / ((n + 2 * j) * (n + 2 * j - 1))
        return [float(x) for x in sums]


def bound(n, s, value, unit):
    """What the docstring promises, in units of rounding of x = sqrt(s).

    Absolute in x c_1 and x^2 c_2. So c_0 = 1 - x^2 c_2 has the error of x itself. From c_3 on the
    function is (1 / (n - 2)! - c_{n-2}) / s where s is large: its error is that of the numerator.
    For small s the series has a relative error.
    """
    x = math.sqrt(s)
    if n == 0:
        return unit * max(1, x)
    if n <= 2 or s < 15.9:
        return unit * (abs(value[n]) if s < 1 else (1 / x ** (n - 1) if n <= 2 else value[n]))
    return (unit / math.factorial(n - 2) + bound(n - 2, s, value, unit)) / s


def derivative_bound(n, k, s, value, unit):
    """The derivative is (n c_{n+2} - c_{n+1}) / 2: errors add up as absolute values."""
    if k == 0:
        return bound(n, s, value, unit)
    below = n * derivative_bound(n + 2, k - 1, s, value, unit)
    return (below + derivative_bound(n + 1, k - 1, s, value, unit)) / 2


@pytest.fixture(scope="module")
def exact():
    """All references, for the arguments rounded to each precision: `[dtype][i][n][k]`."""
    return {
        dtype: [[reference(n, s) for n in range(12)] for s in np.array(SQUARES_OF_ANGLES, dtype)]
        for dtype in (np.float32, np.float64)
    }


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
def test_values_and_three_derivatives(n, dtype, exact):
    arguments = np.array(SQUARES_OF_ANGLES, dtype)
    got = derivatives(n)(arguments)
    assert got.dtype == dtype
    # A few units: the reduced angle, a square, a polynomial and a product round once each.
    unit = 4 * np.finfo(dtype).eps
    for s, row, want in zip(arguments, np.asarray(got, np.float64), exact[dtype], strict=True):
        value = [abs(w[0]) for w in want]
        for k in range(ORDERS + 1):
            allowed = derivative_bound(n, k, float(s), value, unit)
            assert abs(row[k] - want[n][k]) <= allowed, (s, k, row[k], want[n][k])


@pytest.mark.representatives(1)
@DTYPES
def test_many_turns(dtype):
    # x = 1e4 and its neighbourhood: a unit of rounding of x is all that can be asked of a sine.
    s = np.array(1e8, dtype)
    with mpmath.workdps(40):
        exact = mpmath.mpf(float(s))
        x = mpmath.sqrt(exact)
        value = [mpmath.cos(x), mpmath.sin(x) / x, (1 - mpmath.cos(x)) / exact]
        for n in range(3, 6):
            value.append((1 / mpmath.factorial(n - 2) - value[n - 2]) / exact)
    for n in range(6):
        allowed = bound(n, float(s), [abs(float(v)) for v in value], 4 * np.finfo(dtype).eps)
        assert abs(float(stumpff(n, jnp.asarray(s))) - float(value[n])) <= allowed, n


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", range(6))
def test_taylor_coefficients_at_zero(n):
    # d^k c_n(0) = (-1)^k k! / (n + 2k)!, in reverse mode. One rounding for each of two operations
    # an order.
    def f(s):
        return stumpff(n, s)

    for k in range(ORDERS + 1):
        want = (-1) ** k * math.factorial(k) / math.factorial(n + 2 * k)
        assert float(f(jnp.zeros(()))) == pytest.approx(want, rel=(2 * k + 1) * 2.0**-52)
        f = jax.grad(f)


@pytest.mark.representatives(1)
@DTYPES
@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_what_is_not_finite_gives_nan(bad, dtype):
    for n in range(6):
        got = jax.vmap(lambda s, n=n: stumpff(n, s))(jnp.asarray([bad, 1.0], dtype))
        assert np.isnan(got[0]), n
        assert np.isfinite(got[1]), n


@pytest.mark.parametrize("shape", [(), (0,), (2, 3)])
def test_shapes(shape):
    s = jnp.linspace(0.0, 30.0, math.prod(shape)).reshape(shape)
    for n in range(6):
        got = stumpff(n, s)
        assert got.shape == shape
        one_by_one = [float(stumpff(n, x)) for x in s.reshape(-1)]
        # Fused or not, and on vectors or scalars, the same operations: a rounding or two.
        np.testing.assert_allclose(got.reshape(-1), one_by_one, rtol=1e-15, atol=1e-15)


@DTYPES
def test_an_angle_without_digits_is_nan(dtype):
    info = np.finfo(dtype)
    limit = np.array(2.0 ** (2 * (info.nmant - 7)), dtype)
    rng = np.random.default_rng(1)
    s = jnp.asarray(limit * np.array([1.0, *rng.uniform(0.1, 1.0, 100)], dtype))
    sine, versine, s = (np.asarray(x, float) for x in (stumpff(1, s), stumpff(2, s), s))
    # sin^2 + cos^2 = 1 holds as for small angles, so lengths stay: a few units of rounding.
    circle = sine**2 * s + (1 - versine * s) ** 2
    np.testing.assert_allclose(circle, 1.0, rtol=0, atol=16 * info.eps)
    for big in (1.01 * limit, info.max / 2, np.inf, np.nan):
        for n in range(5):
            assert np.isnan(stumpff(n, jnp.asarray(big, dtype))), (n, big)


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
