"""The damped qubit: its steady state, Bloch's equations, order, and positive steps."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
from scipy.linalg import expm

import cfjax
from cfjax.scenes import damped_qubit
from cfjax.scenes.damped_qubit import Qubit

TERM = cfjax.LieTerm(damped_qubit.field)
QUBIT = Qubit()


def end(solver, num_steps, t0=0.0, t1=5.0, y0=None):
    y0 = damped_qubit.y0() if y0 is None else y0
    return np.asarray(cfjax.integrate(TERM, solver, t0, t1, y0, QUBIT, num_steps=num_steps).ys[-1])


def test_the_reference_against_an_exponential():
    """With a drive that is on at once nothing depends on time: one exponential of size 4."""
    args = Qubit(rabi=1.5, detuning=-0.7, decay=0.4, rise=1e-4)
    h = np.array([[0, args.rabi], [args.rabi, 2 * args.detuning]]) / 2
    lower, one = np.array([[0.0, 1.0], [0.0, 0.0]]), np.eye(2)
    loss = args.decay * lower.T @ lower / 2
    generator = -1j * (np.kron(h, one) - np.kron(one, h.T)) + args.decay * np.kron(lower, lower)
    generator = generator - np.kron(loss, one) - np.kron(one, loss.T)
    start = damped_qubit.density(np.array([0.6, -0.3, 0.2]))
    want = (expm(3 * generator) @ start.ravel()).reshape(2, 2)
    # The drive is late by 1e-4 and has an angle of 1.5e-4 less.
    np.testing.assert_allclose(damped_qubit.reference(3.0, args, start), want, rtol=0, atol=2e-4)


def test_the_steady_state():
    args = Qubit(rabi=1.1, detuning=-0.4, decay=0.5)
    rest = damped_qubit.steady(args)
    population = args.rabi**2 / 4 / (args.detuning**2 + args.decay**2 / 4 + args.rabi**2 / 2)
    np.testing.assert_allclose(rest[1, 1], population, rtol=1e-15)
    late = jax.jit(damped_qubit.velocity)(200.0, rest, args)
    np.testing.assert_allclose(late, 0, atol=1e-15)
    # The slowest part falls like exp(-t / 4).
    np.testing.assert_allclose(damped_qubit.reference(150.0, args), rest, rtol=0, atol=1e-12)


def test_bloch_vectors():
    vectors = np.array([[0.6, -0.3, 0.2], [0.0, 0.0, 1.0]])
    densities = np.stack([damped_qubit.density(v) for v in vectors])
    np.testing.assert_allclose(damped_qubit.bloch(densities), vectors, atol=1e-16)
    np.testing.assert_array_equal(densities[1], damped_qubit.y0())


def test_order():
    """In steps of 1/16 and 1/32, where the error is far above rounding, by one program."""
    exact = damped_qubit.reference(5.0, QUBIT)
    halves = end(cfjax.Magnus4(), 80, t1=2.5)
    ends = end(cfjax.Magnus4(), 80), end(cfjax.Magnus4(), 80, t0=2.5, y0=halves)
    errors = [np.abs(y - exact).max() for y in ends]
    assert 0.7 * 2**4 < errors[0] / errors[1] < 1.4 * 2**4
    assert errors[1] < 1e-5


def least(term, solver, steps):
    """The smallest eigenvalue of Choi's matrix of the first step, for some lengths."""

    def step(t, rho, h):
        return problems.first_step(solver, term, t, t + h, rho, QUBIT)[0]

    matrices = jax.jit(lambda h: damped_qubit.choi(step, jnp.zeros(()), h))
    return np.asarray([np.linalg.eigvalsh(matrices(h))[0] for h in steps])


def test_steps_are_completely_positive_where_plain_space_is_not():
    steps = [1 / 16, 1 / 4, 2.0]
    # Rounding of an eigenvalue that is zero in a matrix of norm 2.
    assert np.all(least(TERM, cfjax.Magnus4(), steps) > -1e-14)
    # RK4: its error, of order five, is negative.
    low = least(cfjax.LieTerm(damped_qubit.velocity), cfjax.CF4(), steps)
    assert np.all(low < [-1e-9, -1e-7, -1.0])


def test_choi_of_a_known_map():
    """Depolarising by p has the eigenvalue 2 - 3 p / 2 once and p / 2 three times."""

    def depolarise(t, rho, p):
        return (1 - p) * rho + p * jnp.trace(rho) * np.eye(2, dtype=complex) / 2

    found = np.linalg.eigvalsh(damped_qubit.choi(depolarise, jnp.zeros(3), 0.3))
    np.testing.assert_allclose(found, np.tile([0.15, 0.15, 0.15, 1.55], (3, 1)), rtol=1e-13)
    # A transpose is positive, but not completely.
    turned = damped_qubit.choi(lambda t, rho, _: rho.T, jnp.zeros(()), None)
    np.testing.assert_allclose(np.linalg.eigvalsh(turned), [-1, 1, 1, 1], atol=1e-15)
