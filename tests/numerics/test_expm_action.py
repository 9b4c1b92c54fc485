"""`phi_1(A) b` for a skew A by products with A alone: its polynomials, every norm, derivatives."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.linalg
from xla.interpreter import run

from cfjax._numerics.expm_action import _polynomials, phi_1_action

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


def test_polynomials_are_exp_to_half_a_unit_on_their_interval_and_use_few_terms(subtests):
    """No more than two terms more than what bounds every polynomial of that degree from below."""
    for eps in EPS.values():
        intervals, table = _polynomials(eps)
        assert np.all(np.diff(intervals) > 0) and intervals[-1] > 2
        for length, row in zip(intervals, table, strict=True):
            with subtests.test(case=f"{eps} {length}"), mp.workdps(40):
                for y in np.linspace(0, length, 25):
                    z = mp.mpc(0, y)
                    p = 1 + z + sum(mp.mpf(c) * z ** (k + 2) for k, c in enumerate(row))
                    # Half a unit, and the rounding of each coefficient in float64.
                    rounding = 2.0**-53 * (np.cosh(y) - 1)
                    assert abs(p - mp.exp(z)) <= eps / 2 * 1.05 + rounding
                degree = np.count_nonzero(row) + 1
                # The best error on an interval is about the first Chebyshev coefficient left out.
                assert 2 * mp.besselj(degree - 1, length) > eps / 2


@pytest.mark.parametrize("dtype", EPS)
def test_phi_1_action_at_every_norm(dtype, subtests):
    b = np.random.default_rng(1).standard_normal((6, 2)).astype(dtype)
    for norm in (0.0, 1e-3, 0.1, 0.5, 1.0, 2.0, 2.3, 2.6, 7.0, 300.0):
        a = skew(6, norm).astype(dtype)
        # The 2-norm with what rounding may add.
        got = action(a, b, dtype(norm * (1 + 1e-6)))
        # Ten units for sums of products, cosh(2.5) = 6 where powers cancel, and the norm for the
        # condition of exp, doubled by squarings.
        atol = 60 * EPS[dtype] * (1 + norm)
        with subtests.test(norm=str(norm)):
            assert got.dtype == dtype
            want = exact(a.astype(float), b.astype(float))
            np.testing.assert_allclose(got, want, rtol=0, atol=atol)


def test_phi_1_action_with_scales_at_a_large_norm():
    """An operator that is skew only in units of 1e6: without them the squarings would lose it."""
    scale = np.array([1.0, 1e6] * 3)
    a, b = skew(6, 20.0), np.random.default_rng(1).standard_normal((6, 2))
    similar = scale[:, None] * a / scale

    @jax.jit
    def scaled(a, b):
        return phi_1_action(lambda x: a @ x, b, jnp.asarray(20.1), lambda: (a, jnp.asarray(scale)))

    got = run(scaled, similar, scale[:, None] * b) / scale[:, None]
    np.testing.assert_allclose(got, exact(a, b), rtol=0, atol=2e-12)


def test_infinite_and_nan_give_nan():
    b = np.ones((6, 2))
    for bad in (np.nan, np.inf):
        a = skew(6, 1.0)
        a[0, 1] = bad
        assert np.all(np.isnan(action(a, b, bad)))


def test_derivatives_of_phi_1_action():
    """Against the exponential of the block matrix `[[a, d], [0, a]]`, and between the modes."""
    b, w, d = *(np.random.default_rng(s).standard_normal((4, 4)) for s in (1, 3)), skew(4, 1.0, 5)

    @jax.jit
    def both_modes(a, bound):
        pushed = jax.jvp(lambda a: action(a, b, bound), (a,), (d,))[1]
        return pushed, jax.grad(lambda a: jnp.vdot(w, action(a, b, bound)))(a)

    # exp(a) z = z + phi_1(a) a z, so the derivative of phi_1(a) b follows from that of exp.
    full = lambda a: np.block([[a, b], [np.zeros((4, 8))]])  # noqa: E731
    for norm in (0.0, 0.3, 2.0, 12.0):
        a = skew(4, norm)
        found, gradient = run(both_modes, a, norm * 1.0001)
        expected = scipy.linalg.expm_frechet(full(a), full(d) - full(0 * a))[1][:4, 4:]
        # 100 units, doubled by four squarings for the largest.
        atol = 2e-14 * (1 + norm)
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
        paired = np.vdot(gradient, d)
        np.testing.assert_allclose(paired, np.vdot(w, expected), rtol=0, atol=10 * atol)


def test_a_batch_of_phi_1_action_of_all_norms():
    norms = np.array([0.0, 0.01, 1.0, 30.0])
    a = np.stack([skew(4, norm, seed=s) for s, norm in enumerate(norms)])
    b = np.random.default_rng(9).standard_normal((4, 4, 2))
    got = run(jax.vmap(action), a, b, norms * 1.0001)
    for x, m, v in zip(got, a, b, strict=True):
        np.testing.assert_allclose(x, exact(m, v), rtol=0, atol=2e-13)
