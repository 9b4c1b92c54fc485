"""A particle at a temperature: its exact means, and means of samples."""

import jax.numpy as jnp
import numpy as np
import pytest

from cfjax.scenes import macrospin

PARTICLES = [
    macrospin.Particle(),
    # Strong damping, which changes how fast the mean decays, but not where to.
    macrospin.Particle(damping=1.5, temperature=0.5),
]
TIMES = np.linspace(0.0, macrospin.t1, 81)


def test_the_exact_mean_starts_with_its_slope_and_ends_with_langevins_function():
    args = macrospin.Particle(applied=0.7, damping=0.4, temperature=0.35)
    assert macrospin.reference(0.0, args) == 1
    # At z = 1 the field does not change z, and diffusion does by -2 z. Truncation is of order h.
    h = 1e-6
    slope = (macrospin.reference(h, args) - 1) / h
    np.testing.assert_allclose(slope, -2 * 0.4 * 0.35 / (1 + 0.4**2), rtol=1e-4)
    # A mean that has come to rest, with the stated 1e-10 of the series that is cut off.
    for temperature in (0.05, 0.5, 3.0):
        args = macrospin.Particle(temperature=temperature)
        end = macrospin.langevin(1 / temperature)
        np.testing.assert_allclose(macrospin.reference(200.0, args), end, rtol=0, atol=1e-10)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("args", PARTICLES, ids=["weak", "strong"])
def test_means_of_samples(args):
    ys = np.asarray(macrospin.samples(4000, args, num_steps=80))
    z = ys[..., 2]
    error = z.std(axis=0) / np.sqrt(len(z))
    # With steps of 1/4 the mean is off by up to 1e-3: a mean of 240 000 samples tells.
    assert np.all(np.abs(z.mean(axis=0) - macrospin.reference(TIMES[1:], args)) < 4 * error + 1e-3)
    # In equilibrium the mean square follows from the mean, and no direction across is preferred.
    end, ratio = ys[:, -1], args.temperature / args.applied
    exact = [0.0, 0.0, 1 - 2 * ratio * macrospin.langevin(1 / ratio)]
    found = np.stack([end[:, 0], end[:, 0] ** 2 - end[:, 1] ** 2, end[:, 2] ** 2])
    error = found.std(axis=1) / np.sqrt(len(z))
    assert np.all(np.abs(found.mean(axis=1) - exact) < 4 * error + 1e-3)
    # A unit of rounding at each of a few places, as sums over the steps are compensated.
    np.testing.assert_allclose(np.linalg.norm(ys, axis=-1), 1, rtol=0, atol=1e-15)


def test_the_noise_of_a_cold_particle_is_that_of_the_equation():
    # B and y are orthogonal: the angular velocity is (B + damping y x B) / (1 + damping^2).
    args, b = macrospin.Particle(damping=0.5, temperature=0.04), np.array([1.0, 0.0, 0.0])
    found = macrospin.thermal(0.0, macrospin.y0(), args, jnp.asarray(b)).omega
    np.testing.assert_allclose(found, np.array([1.0, 0.5, 0.0]) * 0.2 / 1.25, rtol=1e-15)
