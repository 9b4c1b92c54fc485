"""The heat flow of spins: exact sublattices, the energy, and the degree."""

from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import harmonic_maps

TERM = cfjax.LieTerm(harmonic_maps.field)


def steps(start, *times):
    """20 steps of RKL2 from each time to the next one, which are one program."""
    solver, y, ys = cfjax.RKL2(spectral_radius=harmonic_maps.RADIUS), jnp.asarray(start), None
    for t0, t1 in pairwise(times):
        ys = cfjax.integrate(TERM, solver, t0, t1, y, num_steps=20, save_every=1).ys
        y = ys[-1]
    return np.asarray(ys)


def end(start, *times):
    return steps(start, *times)[-1]


def lump(side, radius):
    """A map of the square that covers the sphere once: the stereographic projection."""
    x = (np.arange(side) + 0.5) - side / 2
    x, y = np.meshgrid(x, x, indexing="ij")
    square = (x**2 + y**2) / radius**2
    return np.stack([2 * x / radius, 2 * y / radius, square - 1], axis=-1) / (1 + square)[..., None]


def test_orders_on_the_closed_form_and_on_a_lattice():
    start = harmonic_maps.sublattices(0.0, 2.8, 6)
    np.testing.assert_allclose(np.linalg.norm(start, axis=-1), 1, rtol=0, atol=1e-15)
    a, b = start[0, 0], start[0, 1]
    assert np.arccos(a @ b) == pytest.approx(2.8, rel=1e-14)
    want = harmonic_maps.sublattices(0.5, 2.8, 6)
    np.testing.assert_allclose(harmonic_maps.reference(0.5, start), want, rtol=0, atol=1e-11)
    errors = [np.abs(end(start, *ts) - want).max() for ts in ((0, 0.5), (0, 0.25, 0.5))]
    assert 3.4 < errors[0] / errors[1] < 5
    assert errors[1] < 1e-3
    # Against DOP853.
    start = harmonic_maps.y0(6)
    want = harmonic_maps.reference(2.0, start)
    errors = [harmonic_maps.error(end(start, *ts), want) for ts in ((0, 2), (0, 1, 2))]
    assert 3 < errors[0] / errors[1] < 5.5
    assert errors[1] < 1e-2


def test_lengths_are_kept_and_energy_falls_however_long_a_step_is():
    ys = steps(harmonic_maps.y0(6, 1), 0, 40)
    np.testing.assert_allclose(np.linalg.norm(ys, axis=-1), 1, rtol=0, atol=8e-16)
    energies = jax.jit(jax.vmap(harmonic_maps.energy))(ys)
    assert np.all(np.diff(energies) < 0)


def test_the_field_descends_the_energy():
    @jax.jit
    def parts(y):
        field = harmonic_maps.field(0.0, y)
        slope = jax.grad(harmonic_maps.energy)(y)
        return slope, harmonic_maps.velocity(0.0, y), field.tangent(y)

    for shape in ((5, 3), (3, 3, 4, 3)):
        y = np.random.default_rng(0).normal(size=shape)
        y = jnp.asarray(y / np.linalg.norm(y, axis=-1, keepdims=True))
        slope, velocity, tangent = parts(y)
        y, slope = np.asarray(y), np.asarray(slope)
        want = -slope + np.sum(slope * y, axis=-1, keepdims=True) * y
        np.testing.assert_allclose(velocity, want, rtol=0, atol=1e-14)
        np.testing.assert_allclose(tangent, want, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_the_radius_is_bounded():
    y = jnp.asarray(harmonic_maps.y0(6))
    later = jnp.asarray(end(y, 0.0, 2.5, 5.0))
    radii = [float(cfjax.spectral_radius(TERM, 0.0, x)) for x in (y, later)]
    assert all(2 < radius < harmonic_maps.RADIUS for radius in radii)
    # Nearly reached by spins that are aligned.
    assert radii[1] > 7


def test_the_degree_and_the_energy_of_a_lump():
    for seed in range(3):
        total = np.sum(harmonic_maps.degree(harmonic_maps.y0(6, seed)))
        assert total == pytest.approx(round(total), abs=1e-13)
    # Nearly uniform at the rim, where the square closes.
    y = lump(64, 4.0)
    assert np.abs(np.sum(harmonic_maps.degree(y))) == pytest.approx(1, abs=1e-12)
    mirrored = np.sum(harmonic_maps.degree(y[::-1]))
    assert mirrored == pytest.approx(-np.sum(harmonic_maps.degree(y)), abs=1e-12)
    # Outside of the rim is the square of 4 / 32; errors of a cell are squares of 1 / 4.
    inside = harmonic_maps.density(jnp.asarray(y))[1:-1, 1:-1]
    assert float(jnp.sum(inside)) == pytest.approx(4 * np.pi, rel=0.05)


@pytest.mark.slow
def test_a_lump_shrinks_and_falls_through_the_lattice():
    start, few = lump(16, 2.0), 4 * np.pi
    sol = diffrax.diffeqsolve(
        TERM,
        cfjax.RKL2(),
        0.0,
        60.0,
        0.05,
        jnp.asarray(start),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-4),
        saveat=diffrax.SaveAt(ts=np.linspace(0.0, 60.0, 13)),
    )
    degrees = np.abs([np.sum(harmonic_maps.degree(np.asarray(y))) for y in sol.ys])
    energies = np.asarray(jax.vmap(harmonic_maps.energy)(sol.ys))
    assert degrees[0] == pytest.approx(1) and degrees[-1] == pytest.approx(0, abs=1e-12)
    assert energies[0] > 0.8 * few and energies[-1] < 0.2 * few
