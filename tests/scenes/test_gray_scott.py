"""Gray and Scott's reaction: diffusion, the stirred tank, the balance of mass, and spots."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import gray_scott

TERM = cfjax.LieTerm(gray_scott.field)
REACTOR = gray_scott.Reactor()
N = 16
# Four times as small, so that 16 points along a side are as close.
SMALL = gray_scott.Reactor(side=REACTOR.side / 4)


velocity = jax.jit(gray_scott.velocity)


def some(seed=0):
    rng = np.random.default_rng(seed)
    return {"u": jnp.asarray(rng.random((N, N))), "v": jnp.asarray(rng.random((N, N)) / 2)}


def end(start, t, num_steps=50, args=SMALL):
    # In arrays, so that one program serves all times and reactors.
    start, args = problems.arrays(start), problems.arrays(args)
    found = cfjax.integrate(TERM, cfjax.CF4(), 0.0, t, start, args, num_steps=num_steps).ys
    return jax.tree.map(lambda y: np.asarray(y[-1]), found)


def distance(a, b):
    return max(np.abs(a[key] - b[key]).max() for key in "uv")


def test_the_field_is_the_equation():
    x = np.arange(N) * SMALL.side / N
    k, m = 2 * np.pi * np.array([[2, -3], [1, 0]]) / SMALL.side
    waves = [np.cos(p[0] * x[:, None] + p[1] * x + 0.4) for p in (k, m)]
    u, v = 0.6 + 0.2 * waves[0], 0.2 + 0.1 * waves[1]
    found = velocity(0.0, {"u": jnp.asarray(u), "v": jnp.asarray(v)}, SMALL)
    made, feed, kill = u * v**2, 0.03, 0.062
    want = {
        "u": -2e-5 * np.sum(k**2) * 0.2 * waves[0] - made + feed * (1 - u),
        "v": -1e-5 * np.sum(m**2) * 0.1 * waves[1] + made - (feed + kill) * v,
    }
    assert distance(found, want) < 1e-14


def test_the_balance_of_mass():
    y = some()
    rates = jax.tree.map(np.asarray, velocity(0.0, y, SMALL))
    u, v = (np.mean(np.asarray(y[key])) for key in "uv")
    want = 0.03 * (1 - u) - (0.03 + 0.062) * v
    assert np.mean(rates["u"] + rates["v"]) == pytest.approx(want, abs=1e-15)
    # A closed square, from which nothing flows off, keeps its mass.
    closed = SMALL._replace(feed=0.0, kill=0.0)
    after = end(y, 20.0, args=closed)
    assert distance(after, y) > 0.1
    assert np.mean(after["u"] + after["v"]) == pytest.approx(u + v, abs=1e-14)


def test_a_uniform_state_is_a_stirred_tank():
    def rate(t, y):
        u, v = y
        return [0.03 * (1 - u) - u * v**2, u * v**2 - (0.03 + 0.062) * v]

    want = solve_ivp(rate, (0, 10), [0.5, 0.6], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    start = {"u": np.full((N, N), 0.5), "v": np.full((N, N), 0.6)}
    found = end(start, 10.0)
    for key, value in zip("uv", want, strict=True):
        assert np.ptp(found[key]) < 1e-14
        # Steps of 0.2 times rates of 0.4, to the fourth power, and a constant below one thousandth.
        np.testing.assert_allclose(found[key], value, rtol=0, atol=4e-8)


def test_order():
    start = gray_scott.y0(N)
    want = gray_scott.reference(50.0, start, SMALL)
    ends = end(start, 50.0), end(end(start, 25.0), 25.0)
    errors = [distance(y, want) for y in ends]
    assert 13 < errors[0] / errors[1] < 20
    # Far above the error of the reference.
    assert errors[1] > 1e-9


@pytest.mark.slow
def test_the_error_of_the_reference():
    given = gray_scott.problem()
    answer = gray_scott.reference(gray_scott.t1, given["y0"], given["args"])
    coarse, fine = (end(given["y0"], gray_scott.t1, n, REACTOR) for n in (1280, 2560))
    best = {key: fine[key] + (fine[key] - coarse[key]) / 15 for key in fine}
    assert distance(best, answer) < 3e-13


@pytest.mark.slow
def test_spots_divide_until_they_fill_the_square():
    # Three spots cover a twentieth.
    assert 0.03 < np.mean(end(gray_scott.y0(), 50.0, args=REACTOR)["v"] > 0.15) < 0.07
    v = end(gray_scott.y0(), 6000.0, 1200, REACTOR)["v"]
    assert 0.2 < np.mean(v > 0.15) < 0.4
    shifts = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    is_peak = v == np.max([np.roll(v, shift, (0, 1)) for shift in shifts], axis=0)
    assert 15 < np.sum(is_peak & (v > 0.1)) < 25
