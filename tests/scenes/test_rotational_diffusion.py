"""Rotational diffusion: the decay of Legendre polynomials."""

import numpy as np
from scipy.special import eval_legendre

from cfjax.scenes import rotational_diffusion

TIMES = np.linspace(0.0, rotational_diffusion.t1, 61)[1:]


def test_the_polynomials():
    z = np.linspace(-1, 1, 5)
    y = np.stack([np.sqrt(1 - z**2), 0 * z, z], axis=-1)
    exact = np.stack([eval_legendre(degree, z) for degree in (1, 2, 3)], axis=-1)
    np.testing.assert_allclose(rotational_diffusion.legendre(y), exact, rtol=0, atol=1e-15)


def test_means_of_samples():
    # The faster, the larger the steps.
    for diffusion in (1.0, 0.3):
        ys = np.asarray(rotational_diffusion.samples(4000, diffusion))
        found = np.asarray(rotational_diffusion.legendre(ys))
        exact = rotational_diffusion.reference(TIMES, diffusion)
        error = found.std(axis=0) / np.sqrt(len(ys))
        # With steps four times as long, means of 1 200 000 samples are off by 8e-4: order 2.
        step_error = 1e-4 * diffusion**2
        assert np.all(np.abs(found.mean(axis=0) - exact) < 4 * error + step_error)
        # Around the start all sides are alike.
        sides = np.stack([ys[:, -1, 0], ys[:, -1, 1], ys[:, -1, 0] * ys[:, -1, 1]])
        assert np.all(np.abs(sides.mean(axis=1)) < 4 * sides.std(axis=1) / np.sqrt(len(ys)))
        # A unit of rounding at each of a few places, as sums over the steps are compensated.
        np.testing.assert_allclose(np.linalg.norm(ys, axis=-1), 1, rtol=0, atol=1e-15)
