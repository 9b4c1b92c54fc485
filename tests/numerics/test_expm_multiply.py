"""`exp(A) x - x` by products with A alone: its series, every norm, derivatives, memory."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.linalg
from xla.interpreter import run

from cfjax._numerics.expm_multiply import (
    _DECAY,
    _GROWTH,
    _ROOT_OF_LONGEST,
    Strip,
    _chebyshev,
    _on_strip,
    _steps,
    _steps_on_strip,
    expm_minus_one_multiply,
    row_norm,
)

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


def partial_sums(series, n, z):
    """The series of one interval at z, and its largest term."""
    before, last, total = mp.mpf(0), mp.mpf(1), mp.mpf(series.weights[n, 0])
    largest = abs(series.weights[n, 0])
    for k in range(series.degrees[n]):
        last, before = last * z / series.divisors[n, k] + before, last
        total += last * series.weights[n, k + 1]
        largest = max(largest, abs(last * series.weights[n, k + 1]))
    return total, largest


def assert_ordered(series):
    assert np.all(np.diff(series.lengths) > 0) and np.all(np.diff(series.degrees) >= 0)
    assert series.degrees[-1] <= _ROOT_OF_LONGEST**2


@pytest.mark.parametrize("precision", UNIT)
def test_chebyshev_series_are_exp_on_their_interval(precision):
    series = _chebyshev(precision)
    assert_ordered(series)
    for n in range(0, len(series.lengths), 6):
        length = series.lengths[n]
        with mp.workdps(30):
            for y in np.linspace(-length, length, 9):
                z = mp.mpc(0, y)
                total, _ = partial_sums(series, n, z)
                # What is left out, and a rounding of each weight.
                rounding = 2.0**-54 * np.abs(series.weights[n]).sum()
                assert abs(total - mp.expm1(z)) <= UNIT[precision] / 8 * min(1, length) + rounding


@either
def test_expm_multiply_at_every_norm(is_skew):
    """And NaN where it is too large or not finite."""
    values, vectors = np.linalg.eigh(1j * skew_hermitian(1.0))
    x = vector()
    for norm in (0.0, 1e-9, 1e-3, 0.1, 0.5, 2.4, 2.5, 28.0, 29.0, 1000.0):
        a = skew_hermitian(norm)
        found = moved(a, x, norm * (1 + 1e-12), is_skew)
        expected = vectors @ (np.expm1(-1j * values * norm) * (vectors.conj().T @ x))
        # Units for the norm, of A in `eigh` and of each piece; nothing grows. At zero
        # what is left out of the series.
        np.testing.assert_allclose(found, expected, rtol=0, atol=16 * 2.0**-53 * norm + 1e-18)
    for norm in (np.nan, np.inf, 2e5):
        assert np.isnan(moved(skew_hermitian(1.0), x, norm, is_skew)).all()


# Operators that are nearly skew, on a strip. From the study: degrees for half lengths.
DEGREES = {
    "float64": {1: 19, 2: 22, 4: 27, 6: 32, 8: 36, 12: 43, 16: 50, 20: 56, 24: 62, 28: 68},
    "float32": {1: 11, 2: 14, 4: 18, 6: 21, 8: 25, 12: 31, 16: 36, 20: 42, 24: 47, 28: 52},
}


def number_of_products(steps):
    return int(steps.number * steps.degree)


@pytest.mark.parametrize("precision", UNIT)
def test_series_on_a_strip_are_exp_on_their_rectangle(precision):
    series = _on_strip(precision)
    assert_ordered(series)
    for n in range(0, len(series.lengths), 5):
        length = series.lengths[n]
        edge = [complex(x, y) for x in (-_DECAY, 0.0, _GROWTH) for y in (-length, 0.3, length)]
        with mp.workdps(30):
            for z in map(mp.mpmathify, edge):
                total, largest = partial_sums(series, n, z)
                # What is left out, and a rounding of each weight.
                rounding = 2.0**-53 * series.degrees[n] * largest
                assert abs(total - mp.expm1(z)) <= 2 * UNIT[precision] / 8 + rounding
    for length, degree in DEGREES[precision].items():
        x = jnp.asarray(length, precision)
        steps = _steps_on_strip(x, Strip(x, jnp.full_like(x, _DECAY), jnp.full_like(x, _GROWTH)))
        # The study's intervals are those lengths themselves, ours of few bits: up to 15% longer.
        assert int(steps.number) == 1
        assert int(steps.degree) <= degree * 1.12 + 1


def normal_matrix(values, seed=0):
    q = np.linalg.qr(skew_hermitian(1.0, seed) + np.eye(N))[0]
    return q @ np.diag(values) @ q.conj().T, q


@jax.jit
def moved_on_strip(a, x, norm, strip):
    return expm_minus_one_multiply(lambda x: a @ x, x, norm, strip=strip)


def strip_of(values, margin=1 + 1e-12):
    real, imaginary = np.real(values), np.imag(values)
    bounds = np.abs(imaginary).max(), -real.min(), max(real.max(), 0.0)
    return Strip(*(jnp.asarray(margin * b) for b in bounds))


def test_accuracy_on_a_strip(subtests):
    """Normal matrices with eigenvalues all over the rectangle, in its corners too."""
    x = vector()
    # Lengths in one piece, in a few, and in many; and widths of one, of many.
    for length, width in itertools.product((0.5, 3.0, 20.0, 100.0, 1000.0), (0.1, 1.0, 10.0)):
        rng = np.random.default_rng(5)
        inside = rng.uniform(-0.5, 0.125, N - 4)
        real = width * np.concatenate([[-_DECAY] * 2, [_GROWTH] * 2, inside])
        imaginary = length * np.concatenate([[-1, 1, -1, 1], rng.uniform(-1, 1, N - 4)])
        values = real + 1j * imaginary
        a, q = normal_matrix(values)
        norm = np.abs(values).max() * (1 + 1e-12)
        found = moved_on_strip(a, x, norm, strip_of(values))
        expected = q @ (np.expm1(values) * (q.conj().T @ x))
        # Units for the norm, of which some are those of A itself; what grows is as large as this.
        atol = 16 * 2.0**-53 * (1 + norm) * np.exp(max(real.max(), 0))
        with subtests.test(case=f"{length} {width}"):
            np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def test_accuracy_on_a_strip_without_growth():
    """Then the decay alone says how many pieces there are."""
    values = np.linspace(-4, 0, N) + 60j * np.cos(np.arange(N))
    a, q = normal_matrix(values)
    x, norm = vector(), np.abs(values).max() * (1 + 1e-12)
    found = moved_on_strip(a, x, norm, strip_of(values))
    expected = q @ (np.expm1(values) * (q.conj().T @ x))
    np.testing.assert_allclose(found, expected, rtol=0, atol=16 * 2.0**-53 * norm)
    # Not by Taylor's series.
    steps = _steps_on_strip(jnp.asarray(norm), strip_of(values))
    assert number_of_products(steps) < number_of_products(_steps(jnp.asarray(norm), False))


def test_a_strip_takes_fewer_products_than_taylor_where_damping_is_weak():
    for norm in (4.0, 20.0, 100.0):
        x = jnp.asarray(norm)
        weak = Strip(x, jnp.asarray(0.4), jnp.asarray(0.1))
        taylor, strip = (
            number_of_products(s) for s in (_steps(x, False), _steps_on_strip(x, weak))
        )
        assert strip < (0.8 if norm < 10 else 0.4) * taylor
        # And more where it is strong: then Taylor's is taken.
        strong = Strip(x, x, x / 4)
        assert number_of_products(_steps_on_strip(x, strong)) > taylor


def test_the_cheaper_series_is_taken():
    products = 0

    def count(a):
        nonlocal products
        products += 1

    norm = 20.0
    a = skew_hermitian(norm)

    def product(x):
        jax.debug.callback(count, x[0])
        return a @ x

    @jax.jit
    def end(strip):
        return expm_minus_one_multiply(
            product, jnp.asarray(vector()), jnp.asarray(norm), strip=strip
        )

    def number(strip):
        nonlocal products
        products = 0
        jax.block_until_ready(end(strip))
        jax.effects_barrier()
        return products

    weak, strong = (Strip(*map(jnp.asarray, (norm, d, d / 4))) for d in (0.4, 20.0))
    without = number(None)
    assert number(weak) < without / 3
    assert number(strong) == without


def test_derivatives_on_a_strip():
    """In both modes, by the operator and by the vector."""
    values = np.linspace(-0.4, 0.1, N) + 1j * np.linspace(-20, 20, N)
    a, _ = normal_matrix(values)
    direction, x, w = skew_hermitian(1.0, seed=2), vector(), vector(3)

    def both_modes(a):
        f = lambda a: moved_on_strip(a, x, 20.1, strip_of(values))  # noqa: E731
        return jax.jvp(f, (a,), (direction,))[1], jax.vjp(f, a)[1](w.astype(complex))[0]

    forward, pulled = run(both_modes, a)
    expected = scipy.linalg.expm_frechet(a, direction, compute_expm=False) @ x
    np.testing.assert_allclose(forward, expected, rtol=0, atol=64 * 2.0**-53 * 21)
    np.testing.assert_allclose(np.sum(pulled * direction), np.sum(w * expected), 0, 1e-12)


def test_a_strip_with_bounds_that_are_nan_or_infinite():
    x, bad = jnp.asarray(vector()), [jnp.asarray(b) for b in (jnp.nan, jnp.inf)]
    for b in bad:
        # Taylor's series is left, which needs the norm alone.
        found = moved_on_strip(skew_hermitian(1.0), x, jnp.asarray(1.0), Strip(b, b, b))
        np.testing.assert_allclose(found, moved(skew_hermitian(1.0), x, 1.0, False), atol=1e-15)
        assert np.isnan(moved_on_strip(skew_hermitian(1.0), x, b, Strip(b, b, b))).all()


def test_a_batch_of_expm_multiply_of_all_norms():
    norms, x = np.array([0.0, 1.0, 50.0]), vector()
    a = np.stack([skew_hermitian(norm) for norm in norms])
    found = run(jax.vmap(lambda a, norm: moved(a, x, norm, True)), a, norms)
    for y, b in zip(found, a, strict=True):
        # SciPy squares up to six times.
        np.testing.assert_allclose(y, scipy.linalg.expm(b) @ x - x, rtol=0, atol=1e-13)


def test_row_norm():
    a = np.array([[3 + 4j, 0], [1, -1j]])
    assert run(row_norm, a) == run(row_norm, a[0]) == 5
    assert run(row_norm, np.real(a)) == 3


def test_reverse_mode_keeps_few_vectors():
    x = jnp.ones(1000)
    kept = jax.eval_shape(
        lambda c, x: jax.vjp(lambda c: expm_minus_one_multiply(lambda x: c * x, x, c), c)[1],
        1e3,
        x,
    )
    # Two for each of 32 parts of the norm; those of the products within one part come and go.
    assert sum(leaf.size for leaf in jax.tree.leaves(kept)) <= 70 * x.size
