"""The Kuramoto-Sivashinsky equation: its waves, what they keep, and how fast solutions part."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import kuramoto_sivashinsky as ks

TERM = cfjax.LieTerm(ks.field)
N, PERIOD = 32, 20.0


def some(n=N, seed=0):
    """Coefficients of the waves that take part, those with 3 k < n, with a mean."""
    rng, m = np.random.default_rng(seed), n // 2 + 1
    c = np.where(3 * np.arange(m) < n, rng.normal(size=m) + 1j * rng.normal(size=m), 0) / 4
    c[0] = 0.3
    return c


def moved(c, distance):
    """The same waves, further along."""
    return c * np.exp(-2j * np.pi / PERIOD * np.arange(len(c)) * distance)


def test_the_field_is_the_equation():
    c = some()
    # u u_x wave by wave, without a grid.
    both = np.concatenate([c[:0:-1].conj(), c])
    k = 2 * np.pi / PERIOD * np.arange(-N // 2, N // 2 + 1)
    product = np.convolve(both, 1j * k * both)[N : N + N // 2 + 1]
    k = k[N // 2 :]
    want = np.where(3 * np.arange(len(c)) < N, -product, 0) + (k**2 - k**4) * c
    # Sums of 21 products, and rates up to 600.
    found = jax.jit(ks.velocity)(0.0, c, PERIOD)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-13)


def test_the_start():
    x = np.arange(128) * ks.PERIOD / 128
    want = np.cos(x / 16) * (1 + np.sin(x / 16))
    np.testing.assert_allclose(ks.to_grid(jnp.asarray(ks.y0())), want, rtol=0, atol=1e-15)
    assert type(ks.y0()) is np.ndarray


def test_the_balance_of_energy():
    c = some()
    _, rate = jax.jit(lambda c: jax.jvp(ks.energy, (c,), (ks.velocity(0.0, c, PERIOD),)))(c)
    # By Parseval, each wave and its conjugate.
    k = 2 * np.pi / PERIOD * np.arange(len(c))
    want = 2 * np.sum((k**2 - k**4) * np.abs(c) ** 2)
    assert rate == pytest.approx(want, rel=1e-13)


def test_the_reference():
    # Of small waves, whose product is of size 1e-12.
    c = 1e-6 * some()
    c[0] = 0
    k = 2 * np.pi / PERIOD * np.arange(len(c))
    want = np.exp(2.0 * (k**2 - k**4)) * c
    np.testing.assert_allclose(ks.reference(2.0, c, PERIOD), want, rtol=0, atol=1e-12)
    # In a frame that moves the equation keeps its form: a mean carries the same waves along.
    slow, fast = some(), some()
    slow[0], fast[0] = 0.0, 0.7
    want = moved(ks.reference(2.0, slow, PERIOD), 0.7 * 2.0)
    want[0] = 0.7
    # A tolerance of 1e-13 in a few dozen steps.
    found = ks.reference(2.0, fast, PERIOD)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-12)


def test_order_and_what_is_kept():
    # Smooth, so that steps resolve all of it.
    start = some() * np.exp(-0.3 * np.arange(N // 2 + 1))
    want = ks.reference(5.0, start, PERIOD)
    errors = []
    # 400 and 800 steps by one program.
    for times in ((0.0, 5.0), (0.0, 2.5, 5.0)):
        y = start
        for t0, t1 in pairwise(times):
            y = cfjax.integrate(TERM, cfjax.CF4(), t0, t1, y, PERIOD, num_steps=400).ys[-1]
        errors.append(np.linalg.norm(y - want))
        # Nothing acts on the mean, nor on the waves that do not take part.
        assert y[0] == start[0]
        np.testing.assert_array_equal(y[3 * np.arange(len(y)) >= N], 0)
    assert 12 < errors[0] / errors[1] < 20
    # Far above the error of the reference.
    assert errors[1] > 1e-10


@pytest.mark.slow
def test_the_error_of_the_reference():
    given = ks.problem()
    answer = ks.reference(ks.t1, given["y0"])
    # With half as many steps the error is 5e-12, and the order is 5.
    found = cfjax.integrate(solver=cfjax.ETD54(), **given, num_steps=1280).ys[-1]
    assert np.linalg.norm(found - answer) < 1e-12


@pytest.mark.slow
def test_the_lyapunov_time():
    """Along an orbit of 2000 units, after 300 that lead to it. It takes 11 units."""

    @jax.jit
    def part(y, off):
        ends = [
            cfjax.integrate(TERM, cfjax.CF4(), 0.0, 25.0, c, ks.PERIOD, num_steps=250).ys[-1]
            for c in (y, y + 1e-7 * off)
        ]
        off = (ends[1] - ends[0]) / 1e-7
        growth = jnp.linalg.norm(off)
        return ends[0], off / growth.astype(off.dtype), jnp.log(growth) / 25

    # Without the symmetry of the start.
    y = jnp.asarray(ks.y0()).at[1].add(0.01j)
    off, rates = y, []
    for _ in range(92):
        y, off, rate = part(y, off)
        rates.append(float(rate))
    # The rates of 25 units scatter by some 0.04.
    assert np.mean(rates[12:]) == pytest.approx(1 / 11, abs=0.015)
