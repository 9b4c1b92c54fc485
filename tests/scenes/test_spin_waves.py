"""Spin waves: frequencies of small ones, an exact large one, and the energy."""

import numpy as np

import cfjax
from cfjax.scenes import spin_waves, spins

SIDE = 8
STRANG = cfjax.Strang()


def test_a_single_wave_obeys_the_equation():
    h = 1e-5
    slope = (spin_waves.wave(0.3 + h) - spin_waves.wave(0.3 - h)) / (2 * h)
    s = spin_waves.wave(0.3)
    b = sum(np.roll(s, shift, axis) for shift in (1, -1) for axis in (0, 1))
    # Truncation of h^2 / 6 times a rate to the third power, rounding of 1e-16 / h.
    np.testing.assert_allclose(slope, np.cross(b, s), rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(s, axis=-1), 1, rtol=0, atol=1e-15)


def end_of(start, t0, t1):
    # One program for all times.
    args = spin_waves.MAGNET
    return cfjax.integrate(spin_waves.term, STRANG, t0, t1, start, args, num_steps=40).ys[-1]


def test_the_order_of_two_colours():
    start, exact = spin_waves.wave(0.0), spin_waves.wave(4.0)
    ends = end_of(start, 0.0, 4.0), end_of(end_of(start, 0.0, 2.0), 2.0, 4.0)
    first, second = (np.max(np.abs(end - exact)) for end in ends)
    assert 1.9 < np.log2(first / second) < 2.1


def test_the_energy_stays_at_every_step_size():
    """Spins in all directions, with steps up to a quarter of a turn."""
    start = spins.y0(SIDE, SIDE)
    for step in (0.5, 1.0):
        end = end_of(start, 0.0, 40 * step)
        assert np.max(np.abs(end - start)) > 1
        # Two bonds for each of 64 spins, which 40 steps round.
        change = spins.energy(end, spin_waves.MAGNET) - spins.energy(start, spin_waves.MAGNET)
        assert abs(change) < 128 * 40 * 1e-16
        np.testing.assert_allclose(np.linalg.norm(end, axis=-1), 1, rtol=0, atol=40 * 2e-16)


def test_the_frequencies():
    n = 800
    turns = np.stack(np.meshgrid(*[np.arange(SIDE)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    kx, ky = 2 * np.pi * turns.T / SIDE
    exact = spin_waves.frequency(kx, ky)
    for step in (0.1, 0.5):
        signal, energies = spin_waves.run(spin_waves.y0(SIDE), turns, step, n, STRANG)
        frequencies, power = spin_waves.spectrum(np.asarray(signal), step)
        found = frequencies[np.argmax(power, axis=0)]
        one = 2 * np.pi / (step * n)
        # Waves of this size change each other's frequencies by some thousandths.
        own = spin_waves.frequency_of_strang(kx, ky, step)
        assert np.max(np.abs(found - own)) < one < 0.08
        # Short steps are off by their square, long ones by twenty times what can be told apart.
        off = np.max(np.abs(found - exact))
        assert off < one if step == 0.1 else 0.2 < off < 0.5
        # Energies are about -2, and 800 steps of rounding are a random walk.
        assert np.ptp(energies) < 1e-14


def test_the_amplitudes_are_those_of_the_waves_in_it():
    y = spin_waves.wave(0.7, SIDE, (1, 2), tilt=0.3)
    a = spin_waves.amplitudes(y, np.array([[1, 2], [2, 1], [0, 0]]))
    kx, ky = 2 * np.pi * np.array([1, 2]) / SIDE
    phase = np.cos(0.3) * (4 - 2 * np.cos(kx) - 2 * np.cos(ky)) * 0.7
    np.testing.assert_allclose(a, [np.sin(0.3) * np.exp(1j * phase), 0, 0], rtol=0, atol=1e-15)
