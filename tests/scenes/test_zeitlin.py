"""Euler's equations on the sphere as a matrix: exact solutions, harmonics, and what is kept."""

import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.special import gammaln, lpmv

import cfjax
from cfjax.scenes import zeitlin

TERM = cfjax.LieTerm(zeitlin.field)
N = 12
INVERSE = jnp.asarray(zeitlin.inverse_laplacian(N))
START = zeitlin.y0(N, degree=3)
# Latitudes and longitudes.
PLACES = np.linspace(-1.5, 1.4, 7), np.linspace(-3, 3, 5)


def end(solver, pieces, start=START, term=TERM):
    """After as many times 20 steps."""
    return np.asarray(problems.in_pieces(term, solver, 0.0, 2.0, start, INVERSE, 20, pieces))


def commutator(a, b):
    return a @ b - b @ a


def test_the_spin_matrices():
    s = zeitlin.spins(N)
    for k in range(3):
        np.testing.assert_allclose(commutator(s[k - 2], s[k - 1]), 1j * s[k], rtol=0, atol=1e-13)
    total = (N**2 - 1) / 4 * np.eye(N)
    np.testing.assert_allclose(sum(x @ x for x in s), total, rtol=0, atol=1e-13)


def test_the_stream_function_has_the_vorticity_as_its_laplacian():
    rng = np.random.default_rng(1)
    y = rng.normal(size=(N, N)) + 1j * rng.normal(size=(N, N))
    p = np.asarray(zeitlin.stream_function(y, INVERSE))
    found = -sum(commutator(s, commutator(s, p)) for s in zeitlin.spins(N))
    # Not the constant, whose stream function is none. Entries of the Laplacian up to 132.
    want = y - np.trace(y) / N * np.eye(N)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-12)
    assert abs(np.trace(p)) < 1e-13


@pytest.mark.parametrize("n", [12, 64])
def test_the_harmonics(n):
    # The first elements of a matrix of 64, which are positive, go down to 1e-18.
    rng = np.random.default_rng(2)
    coefficients = np.triu(rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n)))
    coefficients[0] = coefficients[0].real
    y = zeitlin.from_harmonics(coefficients)
    np.testing.assert_allclose(y, y.conj().T, rtol=0, atol=0)
    np.testing.assert_allclose(zeitlin.to_harmonics(y), coefficients, rtol=0, atol=1e-12)
    latitude, longitude = PLACES

    def harmonic(order, degree):
        ratio = np.exp((gammaln(degree - order + 1) - gammaln(degree + order + 1)) / 2)
        factor = (-1) ** order * np.sqrt((2 * degree + 1) / (4 * np.pi)) * ratio
        column = factor * lpmv(order, degree, np.sin(latitude))
        return np.multiply.outer(column, np.exp(1j * order * longitude))

    want = sum(
        (1 + (order > 0)) * np.real(coefficients[order, degree] * harmonic(order, degree))
        for degree in range(n)
        for order in range(degree + 1)
    )
    # Thousands of terms of size one.
    np.testing.assert_allclose(zeitlin.on_sphere(y, latitude, longitude), want, rtol=0, atol=1e-10)


def test_harmonics_are_related_by_the_spin_matrices():
    # As those on the sphere are by turns of it. So their signs agree, also where the first elements
    # are less than rounding.
    n = 64
    raising = zeitlin.spins(n)[0] + 1j * zeitlin.spins(n)[1]

    def harmonic(order, degree):
        coefficients = np.zeros((n, n), complex)
        coefficients[order, degree] = 1.0
        return np.triu(zeitlin.from_harmonics(coefficients))

    for order, degree in [(0, 1), (0, 2), (3, 17), (0, 40), (21, 40), (0, 63), (30, 63), (62, 63)]:
        # Without the phase of Condon and Shortley there is a minus.
        want = -np.sqrt((degree - order) * (degree + order + 1)) * harmonic(order + 1, degree)
        found = commutator(raising, harmonic(order, degree))
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-10)


def test_coordinates_are_what_they_are_on_the_sphere():
    latitude, longitude = PLACES
    ring = np.cos(latitude)[:, None]
    height = np.broadcast_to(np.sin(latitude)[:, None], (7, 5))
    want = ring * np.cos(longitude), ring * np.sin(longitude), height
    for s, x in zip(zeitlin.spins(N), want, strict=True):
        found = zeitlin.on_sphere(2 / np.sqrt(N**2 - 1) * s, latitude, longitude)
        np.testing.assert_allclose(found, x, rtol=0, atol=1e-13)


def test_a_rossby_haurwitz_wave():
    start = zeitlin.rossby_haurwitz(0.0, N, degree=3, rotation=0.7)
    want = zeitlin.rossby_haurwitz(2.0, N, degree=3, rotation=0.7)
    errors = [np.abs(end(cfjax.CF4(), n, start) - want).max() for n in (1, 2)]
    assert 13 < errors[0] / errors[1] < 19
    # A pattern of one degree alone stays where it is.
    start = zeitlin.rossby_haurwitz(0.0, N, degree=3, rotation=0.0)
    np.testing.assert_allclose(end(cfjax.CF4(), 1, start), start, rtol=0, atol=1e-14)
    # For degree 3 the pattern lags behind by a sixth (Rossby and Haurwitz).
    latitude, longitude, angle = *PLACES, 0.7 * 2.0 * 5 / 6
    before = zeitlin.rossby_haurwitz(0.0, N, degree=3, rotation=0.7)
    np.testing.assert_allclose(
        zeitlin.on_sphere(want, latitude, longitude),
        zeitlin.on_sphere(before, latitude, longitude - angle),
        rtol=0,
        atol=1e-13,
    )
    found = zeitlin.reference(2.0, zeitlin.rossby_haurwitz(0.0, N))
    # Some ten steps, of a tolerance of 1e-13 in 288 numbers.
    np.testing.assert_allclose(found, zeitlin.rossby_haurwitz(2.0, N), rtol=0, atol=1e-11)


def test_order_and_what_is_kept():
    want = zeitlin.reference(2.0, START)
    ends = [end(cfjax.CF4(), n) for n in (1, 2)]
    errors = [np.abs(y - want).max() for y in ends]
    assert 13 < errors[0] / errors[1] < 20
    energy = zeitlin.energy(START, INVERSE)
    momentum = zeitlin.angular_momentum(START)
    for y, error in zip(ends, errors, strict=True):
        # To rounding of entries up to three, whatever the steps, and symmetric to the last bit.
        np.testing.assert_allclose(
            np.linalg.eigvalsh(y), np.linalg.eigvalsh(START), rtol=0, atol=1e-14
        )
        np.testing.assert_array_equal(y, y.conj().T)
        # By the method's error, which is in the small harmonics mostly.
        np.testing.assert_allclose(zeitlin.energy(y, INVERSE), energy, rtol=0, atol=error)
        np.testing.assert_allclose(zeitlin.angular_momentum(y), momentum, rtol=0, atol=error)
    assert np.abs(zeitlin.angular_momentum(want) - momentum).max() < 1e-12
    assert abs(zeitlin.energy(want, INVERSE) - energy) < 1e-12


def test_energy_and_momentum_on_the_sphere():
    # A fluid that turns as a whole, with w = 2 z: its velocity is the distance from the axis, of
    # mean square 2 / 3, and the mean of z^2 is 1 / 3.
    whole = 4 / np.sqrt(N**2 - 1) * zeitlin.spins(N)[2]
    np.testing.assert_allclose(zeitlin.energy(whole, INVERSE), 1 / 3, rtol=1e-14)
    momentum = zeitlin.angular_momentum(whole)
    np.testing.assert_allclose(momentum, [0, 0, 2 / 3], rtol=0, atol=1e-15)


def test_the_start_is_one_for_all_sizes():
    first, second = (zeitlin.to_harmonics(zeitlin.y0(n, degree=3))[:4, :4] for n in (N, 32))
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-14)
