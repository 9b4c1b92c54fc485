"""The transmon under a pulse: the reference, order, unitarity, the mean fidelity and its slope."""

import diffrax
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import transmon

TERM = cfjax.LieTerm(transmon.field)
# Two parts of each kind, so that every index matters.
PULSE = transmon.Pulse(np.array([0.3, -0.1]), np.array([0.05, 0.02]), 2.0)


def after(pieces, args):
    """The propagator after as many times 100 steps, by one program."""
    given = TERM, transmon.solver, 0.0, args.duration, transmon.y0(), args
    return np.asarray(problems.in_pieces(*given, 100, pieces))


def test_the_reference_against_the_laboratory_frame():
    """The one has the levels at rest; this one has the Hamiltonian as it is written down."""
    n, (x1, x2), (y1, y2) = np.arange(4), PULSE.in_phase, PULSE.quadrature
    w, alpha = PULSE.frequency, PULSE.anharmonicity
    bare = np.diag([0, w, 2 * w + alpha, 3 * w + 3 * alpha])
    coupling = np.diag(np.sqrt(n[1:]), 1) + np.diag(np.sqrt(n[1:]), -1)

    def rate(t, y):
        s = 2 * np.pi * t / PULSE.duration
        first = x1 * (1 - np.cos(s)) + x2 * (1 - np.cos(2 * s))
        second = y1 * np.sin(s) + y2 * np.sin(2 * s)
        h = bare + (first * np.cos(w * t) + second * np.sin(w * t)) * coupling
        return (-1j * h @ y.reshape(4, 4)).ravel()

    start, times = np.eye(4, dtype=complex).ravel(), (0.0, PULSE.duration)
    found = solve_ivp(rate, times, start, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    # Some thousand steps of that tolerance, whose errors add up.
    np.testing.assert_allclose(transmon.reference(PULSE), found.reshape(4, 4), rtol=0, atol=1e-9)


# Ten to twenty periods of the fastest level, so steps in which the error is small but not rounding.
def test_order_and_unitarity():
    exact = transmon.reference(PULSE)
    ends = [after(pieces, PULSE) for pieces in (1, 2)]
    errors = [np.abs(y - exact).max() for y in ends]
    assert 0.7 * 2**6 < errors[0] / errors[1] < 1.4 * 2**6
    assert errors[1] < 1e-4
    # A hundred steps, of a few roundings each.
    assert np.abs(ends[0].conj().T @ ends[0] - np.eye(4)).max() < 1e-13


def test_the_norm_is_lost_in_plain_space():
    problem = transmon.problem() | dict(y0=transmon.y0()[:, 0], args=PULSE, t1=PULSE.duration)
    problem["term"] = diffrax.ODETerm(transmon.velocity)
    y = cfjax.integrate(**problem, solver=diffrax.Tsit5(), num_steps=100).ys[-1]
    assert abs(np.linalg.norm(y) - 1) > 1e-7


def test_infidelity_is_a_mean_over_states():
    """Six states, two along each axis of the sphere, have the mean of all."""
    y = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4)) + 1j * np.eye(4))[0]
    y[:2, :2] += np.array([[0.0, 1.0], [1.0, 0.0]])
    y = np.linalg.qr(y)[0]
    turn = np.diag(np.exp(1j * PULSE.frequency * PULSE.duration * np.arange(2)))
    root = np.sqrt(0.5)
    states = [(1, 0), (0, 1), (root, root), (root, -root), (root, root * 1j), (root, -root * 1j)]
    losses = [
        1 - abs(np.vdot(np.array([b, a]), turn @ y[:2, :2] @ np.array([a, b]))) ** 2
        for a, b in states
    ]
    np.testing.assert_allclose(transmon.infidelity(y, PULSE), np.mean(losses), rtol=1e-13)


@pytest.mark.slow
def test_two_levels_under_a_long_pulse_are_swapped():
    args = transmon.plain(40.0)

    def end(levels):
        given = TERM, cfjax.Magnus6(), 0.0, args.duration, transmon.y0(levels), args
        return cfjax.integrate(*given, num_steps=1200).ys[-1]

    # The counter-rotating part shifts the levels by the square of the drive, 0.08 rad/ns, over four
    # times the frequency: some 2e-3 rad in all, and squared in the infidelity.
    assert transmon.infidelity(end(2), args) < 1e-5
    # A third level is shifted into the way by far more.
    assert transmon.infidelity(end(3), args) > 1e-4


def test_the_quadrature_mends_most():
    # Only the sizes matter. With the program of the order.
    losses = []
    for args in (transmon.plain(), transmon.corrected()):
        padded = args._replace(
            in_phase=np.append(args.in_phase, 0.0), quadrature=np.append(args.quadrature, 0.0)
        )
        losses.append(float(transmon.infidelity(after(4, padded), args)))
    assert losses[1] < losses[0] / 10
