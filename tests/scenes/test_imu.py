"""Dead reckoning: exact means and covariances, and those of samples."""

import numpy as np

from cfjax.scenes import imu

ARGS = imu.Readings()
TIMES = np.linspace(0.0, imu.t1, 61)[1:]


def test_the_exact_moments_against_integrals_of_the_heading():
    # The heading is a Brownian motion with drift, so e^(i heading) has the mean e^(rate t),
    # and the moments of the position follow by integrals over one time and over two.
    args = ARGS._replace(slip=0.2)
    rate, t = 1j * args.turn - args.turn_noise**2 / 2, TIMES
    turn, place = np.exp(rate * t), args.speed * (np.exp(rate * t) - 1) / rate
    exact = np.stack([turn.real, turn.imag, place.real, place.imag], axis=-1)
    # Positions are up to 60, and exponentials of matrices of that size lose a few digits.
    np.testing.assert_allclose(imu.reference(t, args), exact, rtol=0, atol=1e-11)
    square = (args.speed_noise**2 + args.slip**2) * t
    square += 2 * args.speed**2 * ((np.exp(rate * t) - 1 - rate * t) / rate**2).real
    found = np.trace(imu.covariance(t, args), axis1=1, axis2=2) + np.abs(place) ** 2
    np.testing.assert_allclose(found, square, rtol=1e-11)


def test_the_means_and_covariances_of_samples():
    ys = np.asarray(imu.samples(4000, ARGS))
    error = ys.std(axis=0) / np.sqrt(len(ys))
    # With steps twice as long, means of 800 000 samples are off by less than 3 cm: order 2.
    assert np.all(np.abs(ys.mean(axis=0) - imu.reference(TIMES, ARGS)) < 4 * error + 0.01)
    off = ys[..., 2:] - imu.reference(TIMES, ARGS)[:, 2:]
    products = off[..., :, None] * off[..., None, :]
    error = products.std(axis=0) / np.sqrt(len(ys))
    # And these by less than 0.2 square metres, or less than two standard errors.
    assert np.all(np.abs(products.mean(axis=0) - imu.covariance(TIMES, ARGS)) < 5 * error + 0.05)
    # A unit of rounding at each of a few places, as sums over the steps are compensated.
    np.testing.assert_allclose(np.hypot(ys[..., 0], ys[..., 1]), 1, rtol=0, atol=1e-15)


def test_without_noise_the_vehicle_drives_in_a_circle():
    args = ARGS._replace(turn_noise=0.0, speed_noise=0.0, slip=0.0)
    radius, angle = args.speed / args.turn, args.turn * TIMES
    x, y = radius * np.sin(angle), radius * (1 - np.cos(angle))
    exact = np.stack([np.cos(angle), np.sin(angle), x, y], axis=-1)
    # Some sixty steps of a few roundings each, on lengths of 60.
    np.testing.assert_allclose(imu.samples(4000, args)[0], exact, rtol=0, atol=1e-12)
    np.testing.assert_allclose(imu.reference(TIMES, args), exact, rtol=0, atol=1e-11)
