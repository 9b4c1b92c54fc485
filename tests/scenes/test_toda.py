"""The Toda lattice: particles, the closed form, and eigenvalues that stay."""

import diffrax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import toda

TERM = cfjax.LieTerm(toda.field)


def end(solver, t, num_steps, start=None, term=TERM):
    start = toda.y0() if start is None else start
    return np.asarray(cfjax.integrate(term, solver, 0.0, t, start, num_steps=num_steps).ys[-1])


def by_mpmath(t, start):
    """The factors of the whole exponential, in 60 digits."""
    with mpmath.workdps(60):
        a = mpmath.matrix(start.tolist())
        # Its own `expm` may lose digits where `a` is long.
        values, vectors = mpmath.eigsy(a)
        exponential = vectors * mpmath.diag([mpmath.exp(t * x) for x in values]) * vectors.T
        q, r = mpmath.qr(exponential)
        q = q * mpmath.diag([mpmath.sign(r[k, k]) for k in range(len(start))])
        return np.array((q.T * a * q).tolist(), dtype=float)


def test_the_reference_against_mpmath():
    full = np.random.default_rng(0).normal(size=(4, 4))
    for start in (toda.y0(), full + full.T):
        for t in (0.0, 3.0, -2.0):
            found, want = toda.reference(t, start), by_mpmath(t, start)
            # Some pieces, of a few roundings of entries up to 5 each.
            np.testing.assert_allclose(found, want, rtol=0, atol=2e-14)


def test_the_reference_against_the_particles():
    n, t = len(toda.positions), toda.t1

    def rate(t, y):
        push = np.exp(y[: n - 1] - y[1:n])
        return np.concatenate([y[n:], np.append(0, push) - np.append(push, 0)])

    start = np.concatenate([toda.positions, toda.momenta])
    y = solve_ivp(rate, (0.0, t), start, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    found = toda.reference(t)
    # A few hundred steps of that tolerance.
    np.testing.assert_allclose(found, toda.matrix(y[:n], y[n:]), rtol=0, atol=1e-11)
    center = toda.positions.mean() + toda.momenta.mean() * t
    # Distances are logarithms of entries of some hundredths.
    np.testing.assert_allclose(toda.particles(found, center), y[:n], rtol=0, atol=1e-9)


def test_order_of_the_lattice_and_of_a_full_symmetric_matrix():
    full = np.random.default_rng(1).normal(size=(5, 5))
    lattice, matrix = (toda.y0(), toda.t1, (80, 160), 21.6), (full + full.T, 1.0, (60, 120), 21)
    for start, t, steps, most in (lattice, matrix):
        want = toda.reference(t, start).ravel()
        errors = problems.errors(toda.field, cfjax.CF4(), t, start, None, want, steps)
        assert 12 < errors[0] / errors[1] < most


def test_eigenvalues_stay_where_plain_space_loses_them():
    values = np.linalg.eigvalsh(toda.y0())
    plain = diffrax.ODETerm(toda.velocity)
    y = end(cfjax.CF4(), 40.0, 300)
    off = end(diffrax.Tsit5(), 40.0, 300, term=plain)
    # Sums over the steps are compensated: some roundings of entries up to one.
    np.testing.assert_allclose(np.linalg.eigvalsh(y), values, rtol=0, atol=4e-15)
    np.testing.assert_allclose(y, y.T, rtol=0, atol=4e-15)
    assert np.abs(np.linalg.eigvalsh(off) - values).max() > 1e-9
    np.testing.assert_allclose(toda.energy(y), toda.energy(toda.y0()), rtol=1e-14)
    # Sorted, to what is left beside the diagonal: e to the power of minus a distance of 40 / 2,
    # squared over a gap; and the method's error, which remains there.
    np.testing.assert_allclose(np.diag(y), values[::-1], rtol=0, atol=1e-4)


def test_the_energy_is_that_of_the_particles():
    push = np.exp(-np.diff(toda.positions)).sum()
    want = (toda.momenta**2).sum() / 2 + push
    np.testing.assert_allclose(toda.energy(toda.y0()), want, rtol=1e-15)


def test_the_velocity_is_that_of_the_lattice():
    q, p = toda.positions / 4, toda.momenta
    y = jnp.asarray(toda.matrix(q, p))
    push = np.exp(-np.diff(q))
    force = np.append(0, push) - np.append(push, 0)
    beside = -np.diff(p) / 2 * np.sqrt(push) / 2
    want = np.diag(-force / 2) + np.diag(beside, 1) + np.diag(beside, -1)
    np.testing.assert_allclose(toda.velocity(0.0, y), want, rtol=0, atol=1e-15)
