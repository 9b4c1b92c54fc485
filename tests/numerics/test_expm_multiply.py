"""`exp(A) x - x` by products with A alone: its series, every norm, derivatives, memory."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.linalg

from cfjax._numerics.expm_multiply import (
    _ROOT_OF_LONGEST,
    _chebyshev,
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


@pytest.mark.parametrize("precision", UNIT)
def test_chebyshev_series_are_exp_on_their_interval(precision):
    series = _chebyshev(precision)
    assert np.all(np.diff(series.lengths) > 0) and np.all(np.diff(series.degrees) >= 0)
    assert series.degrees[-1] <= _ROOT_OF_LONGEST**2
    for n in range(0, len(series.lengths), 6):
        length, degree = series.lengths[n], series.degrees[n]
        with mp.workdps(30):
            for y in np.linspace(-length, length, 9):
                z = mp.mpc(0, y)
                before, last, total = mp.mpf(0), mp.mpf(1), mp.mpf(series.weights[n, 0])
                for k in range(degree):
                    last, before = last * z / series.divisors[n, k] + before, last
                    total += last * series.weights[n, k + 1]
                # What is left out, and a rounding of each weight.
                rounding = 2.0**-54 * np.abs(series.weights[n]).sum()
                assert abs(total - mp.expm1(z)) <= UNIT[precision] / 8 * min(1, length) + rounding


@either
def test_expm_multiply_at_every_norm(is_skew):
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
def test_derivatives_of_expm_multiply(is_skew):
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


def test_a_batch_of_expm_multiply_of_all_norms():
    norms, x = np.array([0.0, 1.0, 50.0]), vector()
    a = np.stack([skew_hermitian(norm) for norm in norms])
    found = jax.jit(jax.vmap(lambda a, norm: moved(a, x, norm, True)))(a, norms)
    for y, b in zip(found, a, strict=True):
        # SciPy squares up to six times.
        np.testing.assert_allclose(y, scipy.linalg.expm(b) @ x - x, rtol=0, atol=1e-13)


def test_a_norm_that_is_too_large_or_not_finite_gives_nan():
    x = vector()
    for norm in (np.nan, np.inf, 2e5):
        assert np.isnan(moved(skew_hermitian(1.0), x, norm, True)).all()


def test_row_norm():
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
