"""The transmon under a pulse: the reference, order, unitarity, the mean fidelity and its slope."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import transmon

TERM = cfjax.LieTerm(transmon.field)
# Two parts of each kind, so that every index matters.
PULSE = transmon.Pulse(np.array([0.3, -0.1]), np.array([0.05, 0.02]), 2.0)


def end(solver, num_steps, args=PULSE, y0=None):
    y0 = transmon.y0() if y0 is None else y0
    sol = cfjax.integrate(TERM, solver, 0.0, args.duration, y0, args, num_steps=num_steps)
    return sol.ys[-1]


def after(pieces, args, solver=transmon.solver, num_steps=100):
    """The propagator after as many times so many steps, by one program."""
    given = TERM, solver, 0.0, args.duration, transmon.y0(), args
    return np.asarray(problems.in_pieces(*given, num_steps, pieces))


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
@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("solver", "num_steps", "order"), [(transmon.solver, 100, 6), (cfjax.CF4(), 200, 4)]
)
def test_order_and_unitarity(solver, num_steps, order):
    exact = transmon.reference(PULSE)
    ends = [after(pieces, PULSE, solver, num_steps) for pieces in (1, 2)]
    errors = [np.abs(y - exact).max() for y in ends]
    assert 0.7 * 2**order < errors[0] / errors[1] < 1.4 * 2**order
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
    y = end(cfjax.Magnus6(), 1200, args, transmon.y0(2))
    # The counter-rotating part shifts the levels by the square of the drive, 0.08 rad/ns, over four
    # times the frequency: some 2e-3 rad in all, and squared in the infidelity.
    assert transmon.infidelity(y, args) < 1e-5
    # A third level is shifted into the way by far more.
    y = end(cfjax.Magnus6(), 1200, args, transmon.y0(3))
    assert transmon.infidelity(y, args) > 1e-4


def test_the_quadrature_mends_most():
    # Only the sizes matter. With the program of the order.
    losses = []
    for args in (transmon.plain(), transmon.corrected()):
        padded = args._replace(
            in_phase=np.append(args.in_phase, 0.0), quadrature=np.append(args.quadrature, 0.0)
        )
        losses.append(float(transmon.infidelity(after(4, padded), args)))
    assert losses[1] < losses[0] / 10


@pytest.mark.slow
def test_gradient_of_the_infidelity():
    def loss(parts):
        args = PULSE._replace(in_phase=parts[0], quadrature=parts[1])
        return transmon.infidelity(end(cfjax.Magnus6(), 100, args), args)

    at = jnp.stack([PULSE.in_phase, PULSE.quadrature])
    slope, value = jax.grad(loss)(at), jax.jit(jax.vmap(loss))
    way = np.array([[0.6, -0.3], [0.5, 0.7]])
    # The error of the quotient is that of its fourth power, 1e-12, and of rounding over it, 1e-13.
    h = 1e-3
    points = np.array([-2, -1, 1, 2])[:, None, None] * h * way
    quotient = np.dot([1, -8, 8, -1], value(at[None] + points)) / (12 * h)
    np.testing.assert_allclose(np.sum(slope * way), quotient, rtol=1e-9)
