"""The spot in a porous medium: its exact solutions, its mass, and the steps that grow."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import porous_medium

TERM = cfjax.LieTerm(porous_medium.field)
N = 16


def end(start, t, tolerance, solver=None, side=porous_medium.SIDE):
    sol = diffrax.diffeqsolve(
        TERM,
        solver or cfjax.RKL2(),
        1.0,
        t,
        0.01,
        jnp.asarray(start),
        side,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
    )
    return np.asarray(sol.ys[-1])


def test_barenblatt_solves_the_equation():
    n, side, t, h = 700, 1.4, 3.0, 1e-5
    u = porous_medium.barenblatt(t, n, side)
    # All of the square is within the edge, at 3^(1/4), where u^2 has no derivatives above 4.
    assert u.min() > 0
    before, after = (porous_medium.barenblatt(t + s * h, n, side) for s in (-1, 1))
    square = u**2
    middle = square[1:-1, 1:-1]
    around = square[2:, 1:-1] + square[:-2, 1:-1] + square[1:-1, 2:] + square[1:-1, :-2]
    want = (around - 4 * middle) * (n / side) ** 2
    slope = (after - before)[1:-1, 1:-1] / (2 * h)
    # Fourth derivatives of 24 / (16 t)^2 times a sixth of the square of a cell, and rounding.
    np.testing.assert_allclose(slope, want, rtol=0, atol=1e-7)


def test_the_field_is_the_equation_of_the_reference():
    u = np.random.default_rng(0).normal(size=(N, N))
    padded = np.pad(u * np.abs(u), 1, mode="edge")
    around = padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2]
    want = (around - 4 * padded[1:-1, 1:-1]) * (N / 3) ** 2
    found = porous_medium.field(0.0, jnp.asarray(u), 3.0)
    # Sums of entries of up to 300.
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-12)


def test_a_cosine_of_squares_grows_and_falls_by_its_eigenvalue():
    """A square that is 1 + e cos(k x) changes by minus the eigenvalue of the cells."""
    x, e = (np.arange(N) + 0.5) / N, 1e-3
    wave = np.cos(2 * np.pi * x)[:, None] * np.cos(np.pi * x)
    u = np.sqrt(1 + e * wave)
    eigenvalue = sum(4 * N**2 * np.sin(k * np.pi / (2 * N)) ** 2 for k in (2, 1))
    found = porous_medium.field(0.0, jnp.asarray(u), 1.0)
    np.testing.assert_allclose(found, -e * eigenvalue * wave, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_radius_is_near_the_bound():
    y = jnp.asarray(porous_medium.y0())
    found = cfjax.spectral_radius(TERM, 1.0, y, porous_medium.SIDE)
    bound = 16 * float(y.max()) * (64 / porous_medium.SIDE) ** 2
    assert 0.8 * bound < float(found) < bound


def test_the_spot_against_dop853_and_barenblatt():
    start = porous_medium.y0(N)
    want = porous_medium.reference(10.0, start)
    assert want.sum() == pytest.approx(start.sum(), rel=1e-12)
    found = [end(start, 10.0, 10.0**-k) for k in (5, 7)]
    errors = [porous_medium.error(y, want) for y in found]
    # The values are 2e-2, in some twenty steps.
    assert errors[0] < 3e-3 and errors[1] < 2e-4 and errors[1] < errors[0] / 4
    for y in found:
        assert y.sum() == pytest.approx(start.sum(), rel=1e-13)
    # Cells of nearly half a unit against an edge at radius 1.8.
    assert porous_medium.error(want, porous_medium.barenblatt(10.0, N)) < 0.04


@pytest.mark.slow
def test_the_error_of_the_reference():
    start = porous_medium.y0()
    want = porous_medium.reference(4.0, start)
    assert porous_medium.error(end(start, 4.0, 1e-9, cfjax.RKL3()), want) < 1e-6
    apart = porous_medium.error(want, porous_medium.barenblatt(4.0))
    assert apart == pytest.approx(0.007, abs=0.0005)


@pytest.mark.slow
def test_steps_grow():
    sol = diffrax.diffeqsolve(
        TERM,
        cfjax.RKL2(),
        1.0,
        100.0,
        0.01,
        jnp.asarray(porous_medium.y0()),
        porous_medium.SIDE,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-5),
        saveat=diffrax.SaveAt(steps=True),
    )
    times = np.asarray(sol.ts)
    times = times[np.isfinite(times)]
    assert len(times) < 60
    # In proportion to t, but for the first and the last one.
    ratios = np.diff(times)[2:-1] / times[3:-1]
    assert ratios.max() / ratios.min() < 2
    peaks = jax.vmap(jnp.max)(sol.ys[: len(times)])
    assert np.all(np.diff(peaks) < 0)
