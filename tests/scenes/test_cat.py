"""The cat: its Wigner function, the state in which it ends, the reference and the fringes."""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import cat
from cfjax.scenes.cat import Oscillator

TERM = cfjax.LieTerm(cat.field)
SMALL = Oscillator(size=1.2, loss=0.3)


def end(y, *times):
    """40 steps of Kraus4 from each time to the next one, which are one program."""
    for t0, t1 in pairwise(times):
        y = cfjax.integrate(TERM, cfjax.Kraus4(), t0, t1, y, SMALL, num_steps=40).ys[-1]
    return np.asarray(y)


def test_the_reference_against_matrices():
    """The one goes by elements, and this one by products with one jump `a^2 - x`."""
    n, start = 10, cat.coherent(0.5 + 0.3j, 10)
    lower = np.diag(np.sqrt(np.arange(1.0, n)), 1)

    def dissipator(jump, rho):
        loss = jump.conj().T @ jump / 2
        return jump @ rho @ jump.conj().T - loss @ rho - rho @ loss

    def rate(t, flat):
        rho = flat.reshape(n, n)
        x = SMALL.size**2 * (1 - np.exp(-t / SMALL.rise))
        jump = lower @ lower - x * np.eye(n)
        change = SMALL.pairs * dissipator(jump, rho) + SMALL.loss * dissipator(lower, rho)
        return change.ravel()

    solution = solve_ivp(rate, (0.0, 0.5), start.ravel(), "DOP853", rtol=1e-12, atol=1e-12)
    want = solution.y[:, -1].reshape(n, n)
    # Some hundred steps of that tolerance.
    np.testing.assert_allclose(cat.reference(0.5, SMALL, start), want, rtol=0, atol=1e-10)


def test_it_ends_in_an_even_superposition():
    args = Oscillator(size=1.2)
    late = cat.reference(12.0, args, cat.y0(20))
    # What is left falls by a factor of 36 in two units.
    np.testing.assert_allclose(late, cat.superposition(1.2, 20), rtol=0, atol=1e-8)
    np.testing.assert_allclose(cat.parity(late), 1, rtol=0, atol=1e-12)


def test_the_wigner_function_of_known_states():
    points = np.linspace(-2.5, 2.5, 21)
    points = points + 1j * points[:, None]
    field, amplitude = cat.coherent(0.8 + 0.5j), 0.8 + 0.5j
    want = 2 / np.pi * np.exp(-2 * np.abs(points - amplitude) ** 2)
    # With 24 levels the field has lost 1e-12.
    np.testing.assert_allclose(cat.wigner(field, points), want, rtol=0, atol=1e-11)
    # Two fields, and fringes with the phase 4 size times the imaginary part.
    size, both = 1.3, 0.0
    for sign in (1, -1):
        both = both + np.exp(-2 * np.abs(points - sign * size) ** 2)
    fringes = 2 * np.exp(-2 * np.abs(points) ** 2) * np.cos(4 * size * points.imag)
    want = 2 / np.pi * (both + fringes) / (2 + 2 * np.exp(-2 * size**2))
    np.testing.assert_allclose(cat.wigner(cat.superposition(1.3), points), want, atol=1e-9)


def test_negativity():
    assert cat.negativity(cat.coherent(1.0)) < 1e-12
    # A single photon: 2 exp(-1/2) - 1, over a grid of 2/15.
    photon = np.zeros((24, 24), complex)
    photon[1, 1] = 1
    np.testing.assert_allclose(cat.negativity(photon), 2 * np.exp(-0.5) - 1, rtol=0, atol=2e-3)


def test_order_and_positive():
    # A step over which damping is strong: 1/80 times the rate of 90.
    start, exact = cat.y0(10), cat.reference(0.5, SMALL, cat.y0(10))
    errors = [np.abs(end(start, *times) - exact).max() for times in ((0, 0.5), (0, 0.25, 0.5))]
    # Stiffness takes some of the order of Kraus4 in steps as long as these.
    assert 6 < errors[0] / errors[1] < 1.4 * 2**4
    assert errors[1] < 1e-4
    # In steps of a tenth a few roundings, of eigenvalues that are zero.
    y = end(start, 0.0, 4.0)
    assert np.linalg.eigvalsh(y)[0] > -1e-14
    np.testing.assert_allclose(np.trace(y), 1, rtol=0, atol=1e-14)


def test_loss_washes_the_fringes_out():
    kept, lost = (
        cat.negativity(cat.reference(1.0, Oscillator(size=1.2, loss=loss), cat.y0(16)))
        for loss in (0.0, 0.5)
    )
    assert kept > 2 * lost > 1e-3


def test_an_unstable_solve_has_no_error():
    one, other = cat.y0(4), cat.y0(4)[::-1, ::-1]
    np.testing.assert_allclose(cat.error(one, other), 2**0.5, rtol=1e-15)
    assert np.isnan(cat.error(1e100 * one, other))
