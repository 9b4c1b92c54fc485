"""The heat flow of spins: exact sublattices, the energy, and the degree."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import harmonic_maps

TERM = cfjax.LieTerm(harmonic_maps.field)


def end(start, t, num_steps, solver=None):
    solver = solver or cfjax.RKL2(spectral_radius=harmonic_maps.RADIUS)
    found = cfjax.integrate(TERM, solver, 0.0, t, jnp.asarray(start), num_steps=num_steps)
    return np.asarray(found.ys[-1])


def lump(side, radius):
    """A map of the square that covers the sphere once: the stereographic projection."""
    x = (np.arange(side) + 0.5) - side / 2
    x, y = np.meshgrid(x, x, indexing="ij")
    square = (x**2 + y**2) / radius**2
    return np.stack([2 * x / radius, 2 * y / radius, square - 1], axis=-1) / (1 + square)[..., None]


def test_the_sublattices_against_their_closed_form():
    start = harmonic_maps.sublattices(0.0, 2.8, 4)
    np.testing.assert_allclose(np.linalg.norm(start, axis=-1), 1, rtol=0, atol=1e-15)
    a, b = start[0, 0], start[0, 1]
    assert np.arccos(a @ b) == pytest.approx(2.8, rel=1e-14)
    want = harmonic_maps.sublattices(0.5, 2.8, 4)
    errors = [np.abs(end(start, 0.5, n) - want).max() for n in (20, 40)]
    assert 3.4 < errors[0] / errors[1] < 5
    assert errors[1] < 1e-3
    np.testing.assert_allclose(harmonic_maps.reference(0.5, start), want, rtol=0, atol=1e-11)


def test_the_lattice_against_dop853():
    start = harmonic_maps.y0(6)
    want = harmonic_maps.reference(2.0, start)
    for solver, low, high in (
        (cfjax.RKL2(spectral_radius=8.0), 3, 5.5),
        (cfjax.RKL3(spectral_radius=8.0), 6, 12),
    ):
        errors = [harmonic_maps.error(end(start, 2.0, n, solver), want) for n in (20, 40)]
        assert low < errors[0] / errors[1] < high
        assert errors[1] < 1e-2


def test_lengths_are_kept_and_energy_falls_however_long_a_step_is():
    start = jnp.asarray(harmonic_maps.y0(8, 1))
    ys = cfjax.integrate(TERM, cfjax.RKL2(), 0.0, 40.0, start, num_steps=20, save_every=1).ys
    np.testing.assert_allclose(np.linalg.norm(ys, axis=-1), 1, rtol=0, atol=8e-16)
    energies = jax.vmap(harmonic_maps.energy)(ys)
    assert np.all(np.diff(energies) < 0)


def test_the_field_descends_the_energy():
    for shape in ((5, 3), (3, 4, 3), (3, 3, 4, 3)):
        y = np.random.default_rng(0).normal(size=shape)
        y = jnp.asarray(y / np.linalg.norm(y, axis=-1, keepdims=True))
        slope = jax.grad(harmonic_maps.energy)(y)
        want = -slope + jnp.sum(slope * y, axis=-1, keepdims=True) * y
        np.testing.assert_allclose(harmonic_maps.velocity(0.0, y), want, rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            cfjax.tangent(harmonic_maps.field(0.0, y), y), want, rtol=0, atol=1e-14
        )


def test_the_radius_is_bounded():
    y = jnp.asarray(harmonic_maps.y0(8))
    radii = [float(cfjax.spectral_radius(TERM, 0.0, x)) for x in (y, jnp.asarray(end(y, 5.0, 50)))]
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


@pytest.mark.slow
def test_the_picture_has_spins_energies_and_a_curve():
    assert len(harmonic_maps.picture(side=8).axes) == 9
