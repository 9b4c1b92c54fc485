"""What fields use of loops, products with vectors and the sines of small angles, and no public name
shows alone: loops of a length found at run time, exponentials by products, Stumpff functions."""

import functools
import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.linalg
from problems import SQUARES_OF_ANGLES

import cfjax
from cfjax._numerics.expm_action import _polynomials, phi_1_action
from cfjax._numerics.expm_multiply import (
    _ROOT_OF_LONGEST,
    FIRST_DEGREE,
    LONGEST,
    _chebyshev,
    expm_minus_one_multiply,
    row_norm,
)
from cfjax._numerics.loop import loop
from cfjax._numerics.stumpff import cotangent_excess, stumpff_1_to_3_apart

dtypes = pytest.mark.parametrize("dtype", [np.float32, np.float64])

# A loop of a length found at run time


def power(a, x, n, mostly=0):
    """`a^n x / n!`, with what is closed over and the number of the step."""
    step = lambda k, x: a * x / (k + 1).astype(x.dtype)  # noqa: E731
    return loop(step, jnp.asarray(x), n, root=4, mostly=mostly)


@functools.partial(jax.jit, static_argnums=3)
def everything(a, x, n, mostly):
    f = lambda a, x: power(a, x, n, mostly)  # noqa: E731
    forward = jax.jvp(lambda a: f(a, x), (a,), (1.0,))[1]
    return f(a, x), forward, jax.grad(f)(a, x), jax.grad(jax.grad(f))(a, x)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("mostly", [0, 1, 3])
@pytest.mark.parametrize("n", [0, 1, 3, 4, 5, 16])
def test_powers_and_their_derivatives(n, mostly):
    a, x = 1.5, 0.7
    found = everything(a, x, jnp.asarray(n, jnp.int32), mostly)
    c = x / float(np.prod(np.arange(1, n + 1.0)))
    first, second = n * c * a ** (n - 1), n * (n - 1) * c * a ** (n - 2)
    # Some roundings for each step.
    np.testing.assert_allclose(found, [c * a**n, first, first, second], rtol=1e-14)


def test_a_batch_of_loops():
    a = jnp.asarray([0.5, 1.0, 2.0])
    found = jax.jit(jax.vmap(lambda a: jax.grad(power)(a, 1.0, jnp.asarray(3, jnp.int32))))(a)
    np.testing.assert_allclose(found, a**2 / 2, rtol=1e-15)


def test_reverse_mode_keeps_as_much_however_long_the_loop_is():
    n, size = 5, 1000

    def pulled(x, length):
        return jax.vjp(lambda x: loop(lambda k, x: jnp.sin(x), x, length, root=n), x)[1]

    kept = jax.eval_shape(pulled, jnp.ones(size), jnp.asarray(3, jnp.int32))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(kept))
    # Of n^2 = 25 steps n carries, and a few numbers.
    assert numbers <= (n + 1) * size


# exp(A) x by products with A alone

N = 12
UNIT = {"float32": 2.0**-24, "float64": 2.0**-53}
either = pytest.mark.parametrize("is_skew", [False, True])


def skew_hermitian(norm, seed=0):
    """Skew-Hermitian, with this 2-norm."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N, N)) + 1j * rng.normal(size=(N, N))
    a = a - a.conj().T
    return a / np.linalg.norm(a, 2) * norm


def vector(seed=1):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=N) + 1j * rng.normal(size=N)
    return x / np.linalg.norm(x)


@functools.partial(jax.jit, static_argnames="is_skew")
def moved(a, x, norm, is_skew):
    return expm_minus_one_multiply(lambda x: a @ x, x, norm, is_skew=is_skew)


@pytest.mark.parametrize("precision", UNIT)
def test_the_bounds_are_where_the_backward_error_reaches_the_unit_roundoff(precision):
    """With `log(exp(-x) T(x)) = sum_k c_k x^k` it is `sum_k |c_k| theta^(k-1)`."""
    for degree, theta in enumerate(LONGEST[precision], FIRST_DEGREE[precision]):
        length = degree + 20  # Beyond, less than 1e-12 of the first term.
        with mp.workdps(40):
            one = [mp.mpf(1) / math.factorial(k) for k in range(length)]
            # exp(-x) T(x) = 1 - exp(-x) (the rest of the series).
            q = [
                -sum(one[i] * (-1) ** (k - i) * one[k - i] for i in range(degree + 1, k + 1))
                for k in range(length)
            ]
            c = [mp.mpf(0)] * length
            for k in range(degree + 1, length):
                c[k] = q[k] - sum(i * c[i] * q[k - i] for i in range(degree + 1, k)) / k

        def backward(x, c=c):
            return sum(abs(float(a)) * x ** (k - 1) for k, a in enumerate(c) if a)

        assert backward(theta) <= UNIT[precision] < backward(theta * 1.004)


@pytest.mark.parametrize("precision", UNIT)
def test_chebyshev_series_are_exp_on_their_interval(precision):
    series = _chebyshev(precision)
    assert np.all(np.diff(series.lengths) > 0) and np.all(np.diff(series.counts) >= 0)
    assert series.counts[-1] <= _ROOT_OF_LONGEST**2
    for n in range(0, len(series.lengths), 6):
        length, count = series.lengths[n], series.counts[n]
        with mp.workdps(30):
            for y in np.linspace(-length, length, 9):
                z = mp.mpc(0, y)
                before, last, total = mp.mpf(0), mp.mpf(1), mp.mpf(series.weights[n, 0])
                for k in range(count):
                    last, before = last * z / series.divisors[n, k] + before, last
                    total += last * series.weights[n, k + 1]
                # What is left out, and a rounding of each weight.
                rounding = 2.0**-54 * np.abs(series.weights[n]).sum()
                assert abs(total - mp.expm1(z)) <= UNIT[precision] / 8 * min(1, length) + rounding


@either
def test_exponentials_of_every_norm(is_skew):
    values, vectors = np.linalg.eigh(1j * skew_hermitian(1.0))
    x = vector()
    for norm in (0.0, 1e-9, 1e-3, 0.1, 0.5, 2.4, 2.5, 28.0, 29.0, 1000.0):
        a = skew_hermitian(norm)
        found = moved(a, x, norm * (1 + 1e-12), is_skew)
        expected = vectors @ (np.expm1(-1j * values * norm) * (vectors.conj().T @ x))
        # Units for the norm, of A in `eigh` and of each piece; nothing grows. At zero
        # what is left out of the series.
        np.testing.assert_allclose(found, expected, rtol=0, atol=16 * 2.0**-53 * norm + 1e-18)


@pytest.mark.representatives(1)
@either
def test_derivatives_of_exponentials(is_skew):
    direction, x, w = skew_hermitian(1.0, seed=2), vector(), vector(3)

    @functools.partial(jax.jit, static_argnums=1)
    def both_modes(a, norm):
        f = lambda a: moved(a, x, norm, is_skew)  # noqa: E731
        forward = jax.jvp(f, (a,), (direction,))[1]
        return forward, jax.vjp(f, a)[1](w.astype(complex))[0]

    for norm in (0.0, 40.0):
        a = skew_hermitian(norm)
        forward, pulled = both_modes(a, norm * (1 + 1e-12))
        expected = scipy.linalg.expm_frechet(a, direction, compute_expm=False) @ x
        # As above; SciPy's own error grows with the norm.
        atol = 64 * 2.0**-53 * (1 + norm)
        np.testing.assert_allclose(forward, expected, rtol=0, atol=atol)
        np.testing.assert_allclose(np.sum(pulled * direction), np.sum(w * expected), 0, 8 * atol)


@pytest.mark.slow
@either
def test_a_gradient_of_a_gradient(is_skew):
    """The term of second order of exp is d d / 2, so its second derivative at zero is d d."""
    d, x, w = skew_hermitian(1.0, seed=2), vector(), vector(3)
    value = lambda t: jnp.sum(w * moved(t.astype(complex) * d, x, 1.0, is_skew)).real  # noqa: E731
    found = jax.jit(jax.grad(jax.grad(value)))(0.0)
    assert found == pytest.approx(np.sum(w * (d @ d @ x)).real, abs=1e-13)


def test_a_batch_of_exponentials_of_all_norms():
    norms, x = np.array([0.0, 1.0, 50.0]), vector()
    a = np.stack([skew_hermitian(norm) for norm in norms])
    found = jax.jit(jax.vmap(lambda a, norm: moved(a, x, norm, True)))(a, norms)
    for y, b in zip(found, a, strict=True):
        # SciPy squares up to six times.
        np.testing.assert_allclose(y, scipy.linalg.expm(b) @ x - x, rtol=0, atol=1e-13)


def test_what_is_not_possible_is_nan():
    x = vector()
    for norm in (np.nan, np.inf, 2e5):
        assert np.isnan(moved(skew_hermitian(1.0), x, norm, True)).all()


def test_the_norm_of_rows():
    a = np.array([[3 + 4j, 0], [1, -1j]])
    assert row_norm(jnp.asarray(a)) == 5
    assert row_norm(jnp.asarray(a[0])) == 5
    assert row_norm(jnp.asarray(np.real(a))) == 3


def test_reverse_mode_keeps_few_vectors():
    x = jnp.ones(1000)
    kept = jax.eval_shape(
        lambda c, x: jax.vjp(lambda c: expm_minus_one_multiply(lambda x: c * x, x, c), c)[1],
        1e3,
        x,
    )
    # Two for each of 32 parts of the norm; those of the products within one part come and go.
    assert sum(leaf.size for leaf in jax.tree.leaves(kept)) <= 70 * x.size


# phi_1(A) b for a skew A

EPS = {np.float32: 2.0**-23, np.float64: 2.0**-52}


def skew(m, norm, seed=0):
    a = np.random.default_rng(seed).standard_normal((m, m))
    return (a - a.T) / np.linalg.norm(a - a.T, 2) * norm


@jax.jit
def action(a, b, bound):
    return phi_1_action(lambda x: a @ x, b, bound, lambda: (a, jnp.ones(len(a), a.dtype)))


def exact(a, b):
    m, k = b.shape
    return scipy.linalg.expm(np.block([[a, b], [np.zeros((k, m + k))]]))[:m, m:]


@pytest.mark.parametrize("eps", EPS.values())
def test_polynomials_are_exp_to_half_a_unit_on_their_interval(eps):
    intervals, table = _polynomials(eps)
    assert np.all(np.diff(intervals) > 0) and intervals[-1] > 2
    with mp.workdps(40):
        for length, row in zip(intervals, table, strict=True):
            for y in np.linspace(0, length, 25):
                z = mp.mpc(0, y)
                p = 1 + z + sum(mp.mpf(c) * z ** (k + 2) for k, c in enumerate(row))
                # Half a unit, and the rounding of each coefficient in float64.
                rounding = 2.0**-53 * (np.cosh(y) - 1)
                assert abs(p - mp.exp(z)) <= eps / 2 * 1.05 + rounding


@pytest.mark.parametrize("eps", EPS.values())
def test_polynomials_use_few_terms(eps):
    """No more than two terms more than what bounds every polynomial of that degree from below."""
    intervals, table = _polynomials(eps)
    for length, row in zip(intervals, table, strict=True):
        degree = np.count_nonzero(row) + 1
        # The best error on an interval is about the first Chebyshev coefficient left out.
        fewer = 2 * mp.besselj(degree - 1, length)
        assert fewer > eps / 2


@pytest.mark.representatives(6)
@dtypes
@pytest.mark.parametrize("norm", [0.0, 1e-3, 0.1, 0.5, 1.0, 2.0, 2.3, 2.6, 7.0, 300.0])
def test_actions_of_every_norm(dtype, norm):
    a, b = skew(6, norm).astype(dtype), np.random.default_rng(1).standard_normal((6, 2))
    b = b.astype(dtype)
    # The 2-norm with what rounding may add.
    got = action(a, b, dtype(norm * (1 + 1e-6)))
    assert got.dtype == dtype
    # Ten units for sums of products, cosh(2.5) = 6 where powers cancel, and the norm for the
    # condition of exp, doubled by squarings.
    atol = 60 * EPS[dtype] * (1 + norm)
    np.testing.assert_allclose(got, exact(a.astype(float), b.astype(float)), rtol=0, atol=atol)


def test_scales_serve_large_norms():
    """An operator that is skew only in units of 1e6: without them the squarings would lose it."""
    scale = np.array([1.0, 1e6] * 3)
    a, b = skew(6, 20.0), np.random.default_rng(1).standard_normal((6, 2))
    similar = scale[:, None] * a / scale

    @jax.jit
    def scaled(a, b):
        return phi_1_action(lambda x: a @ x, b, jnp.asarray(20.1), lambda: (a, jnp.asarray(scale)))

    got = scaled(similar, scale[:, None] * b) / scale[:, None]
    np.testing.assert_allclose(got, exact(a, b), rtol=0, atol=2e-12)


def test_infinite_and_nan_give_nan():
    b = np.ones((6, 2))
    for bad in (np.nan, np.inf):
        a = skew(6, 1.0)
        a[0, 1] = bad
        assert np.all(np.isnan(action(a, b, bad)))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("norm", [0.0, 0.3, 2.0, 12.0])
def test_derivatives_of_actions(norm):
    """Against the exponential of the block matrix `[[a, d], [0, a]]`, and between the modes."""
    a, b, d, w = (np.random.default_rng(s).standard_normal((4, 4)) for s in range(4))
    a, d = skew(4, norm), skew(4, 1.0, seed=5)
    bound = norm * 1.0001
    # exp(a) z = z + phi_1(a) a z, so the derivative of phi_1(a) b follows from that of exp.
    full = lambda a: np.block([[a, b], [np.zeros((4, 8))]])  # noqa: E731
    expected = scipy.linalg.expm_frechet(full(a), full(d) - full(0 * a))[1][:4, 4:]
    found = jax.jvp(lambda a: action(a, b, bound), (a,), (d,))[1]
    # 100 units, doubled by four squarings for the largest.
    atol = 2e-14 * (1 + norm)
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
    gradient = jax.grad(lambda a: jnp.vdot(w, action(a, b, bound)))(a)
    np.testing.assert_allclose(np.vdot(gradient, d), np.vdot(w, expected), rtol=0, atol=10 * atol)


def test_a_batch_of_actions_of_all_norms():
    norms = np.array([0.0, 0.01, 1.0, 30.0])
    a = np.stack([skew(4, norm, seed=s) for s, norm in enumerate(norms)])
    b = np.random.default_rng(9).standard_normal((4, 4, 2))
    got = jax.jit(jax.vmap(action))(a, b, norms * 1.0001)
    for x, m, v in zip(got, a, b, strict=True):
        np.testing.assert_allclose(x, exact(m, v), rtol=0, atol=2e-13)


# Stumpff functions together, and the cotangent of the inverse derivative of exp


def three(s):
    near, d1, d2, c3 = stumpff_1_to_3_apart(s)
    return near + d1, near / 2 + d2, c3


@pytest.mark.representatives(1)
@dtypes
def test_several_together(dtype):
    s = jnp.asarray(SQUARES_OF_ANGLES, dtype)
    ones = jnp.ones_like(s)
    for n, (got, slope) in enumerate(
        zip(*jax.jit(lambda s: jax.jvp(three, (s,), (ones,)))(s), strict=True), start=1
    ):
        want, want_slope = jax.jvp(lambda s, n=n: cfjax.stumpff(n, s), (s,), (ones,))
        # The same formulas, but XLA may round them in another order: the bound of either, twice.
        eps = 8 * np.finfo(dtype).eps
        np.testing.assert_allclose(got, want, rtol=eps, atol=eps)
        np.testing.assert_allclose(slope, want_slope, rtol=eps, atol=eps)


@dtypes
def test_the_excess_of_the_cotangent(dtype):
    """Against `(1 - x/2 cot(x/2)) / x^2` itself, with 60 digits for what cancels, and its slopes.

    By differences of 60 digits, which leave 20.
    """
    x = np.array([0.0, 1e-20, 1e-4, 0.1, 1.0, np.pi, 4.5, 6.0, 6.2])
    s = jnp.asarray(x * x, dtype)
    first = jax.grad(cotangent_excess)
    functions = cotangent_excess, first, jax.grad(first)
    found = [jax.jit(jax.vmap(f))(s) for f in functions]

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
@dtypes
def test_beyond_a_full_turn_the_excess_of_the_cotangent_is_finite(dtype):
    s = jnp.asarray([4 * math.pi**2 * 1.0001, 100.0, np.finfo(dtype).max, np.inf], dtype)
    got, slope = jax.vmap(jax.value_and_grad(cotangent_excess))(s)
    np.testing.assert_allclose(got, 1 / 12, rtol=4 * np.finfo(dtype).eps)
    np.testing.assert_array_equal(slope, 0)
