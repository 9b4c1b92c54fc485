"""Gradients of a covariance and of a log-density by the weights of a network.

The reference is of another kind: it knows quaternions as four numbers, their velocity and its
Jacobian matrix, and no frame, bracket or trace. It takes differences of its solves.
"""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

Q0 = np.array([0.5, 0.1, -0.7, 0.5])
P0 = np.diag([0.1, 0.2, 0.3])
# Unequal and not diagonal.
GAIN = np.array([[0.3, 0.1], [-0.2, 0.2], [0.05, 0.4]])
# Of the network omega = second tanh(first q + bias) + (sin t, 0.5, 0).
SHAPES = {"first": (3, 4), "bias": (3,), "second": (3, 3)}
SIZE = sum(map(np.prod, SHAPES.values()))
WEIGHTS, DIRECTION = np.random.default_rng(7).normal(size=(2, SIZE))

# The velocity of a quaternion (w, x, y, z) is E(q) omega in the frame of the body, with
# E(q) = (FRAME[0] q, FRAME[1] q, FRAME[2] q): half of q times i, j and k.
FRAME = np.array(
    [
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ]
)


def parts(weights):
    ends = np.cumsum([np.prod(shape) for shape in SHAPES.values()])
    pieces = np.split(weights, ends[:-1]) if isinstance(weights, np.ndarray) else []
    pieces = pieces or jnp.split(weights, ends[:-1])
    return [x.reshape(shape) for x, shape in zip(pieces, SHAPES.values(), strict=True)]


# By a Runge-Kutta method of order 8


def frame(q):
    return np.stack([matrix @ q for matrix in FRAME], axis=1) / 2


def rates(t, y, weights):
    """Of a quaternion q, its covariance (4, 4), and the changes (4, 3) that angles cause."""
    first, bias, second = parts(weights)
    q, covariance, changes = y[:4], y[4:20].reshape(4, 4), y[20:].reshape(4, 3)
    layer = np.tanh(first @ q + bias)
    omega, e = second @ layer + np.array([np.sin(t), 0.5, 0]), frame(q)
    jacobian = np.tensordot(omega, FRAME, 1) / 2 + e @ (second * (1 - layer**2)) @ first
    noise, moved = e @ GAIN, jacobian @ covariance
    rate = moved + moved.T + noise @ noise.T
    return np.concatenate([e @ omega, rate.ravel(), (jacobian @ changes).ravel()])


def end(weights):
    """The trace of P and the log-density after unit time."""
    q = Q0 / np.linalg.norm(Q0)
    e = frame(q)
    y = np.concatenate([q, (e @ P0 @ e.T).ravel(), e.ravel()])
    y = problems.reference(lambda t, y: rates(t, y, weights), 0.0, 1.0, y)
    # The columns of E are orthogonal, of length 1/2.
    inverse = 4 * frame(y[:4]).T
    p = inverse @ y[4:20].reshape(4, 4) @ inverse.T
    return np.array([np.trace(p), -np.linalg.slogdet(inverse @ y[20:].reshape(4, 3))[1]])


# Of a method of order 4 with steps of 1/200, and rates of up to 4: the fourth power of 1/50.
TOLERANCE = 1.6e-7


@pytest.fixture(scope="module")
def slopes():
    """The derivatives of both along the direction, to 1e-9."""
    return problems.central_difference(end, WEIGHTS, DIRECTION, 1e-3)


# By cfjax


def field(t, q, weights):
    first, bias, second = parts(weights)
    omega = second @ jnp.tanh(first @ q + bias) + jnp.stack([jnp.sin(t), 0.5, 0.0])
    return cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")


def noise(t, q, weights, dw):
    return cfjax.QuaternionRotation(jnp.asarray(GAIN) @ dw, frame="body", layout="wxyz")


def both(weights):
    term = cfjax.VariationTerm(cfjax.LieTerm(field), noise=noise, channels=2)
    q0 = jnp.asarray(Q0 / np.linalg.norm(Q0))
    y0 = cfjax.Variation(q0, covariance=jnp.asarray(P0), log_density=jnp.asarray(0.0))
    ys = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, weights, num_steps=200).ys
    return jnp.stack([jnp.trace(ys.covariance[-1]), ys.log_density[-1]])


def test_forward_mode_by_the_weights_of_a_network(slopes):
    weights, direction = jnp.asarray(WEIGHTS), jnp.asarray(DIRECTION)
    with cfjax.rewriting(False):
        found = jax.jit(lambda w, v: jax.jvp(both, (w,), (v,))[1])(weights, direction)
    np.testing.assert_allclose(found, slopes, rtol=0, atol=TOLERANCE)
    assert np.abs(slopes).min() > 0.1


@pytest.mark.slow
def test_reverse_mode_by_the_weights_of_a_network(slopes):
    # A sum of both, with different weights, is one program.
    share = np.array([1.0, 0.3])
    with cfjax.rewriting(False):
        found = jax.jit(jax.grad(lambda weights: share @ both(weights)))(jnp.asarray(WEIGHTS))
    np.testing.assert_allclose(DIRECTION @ found, slopes @ share, rtol=0, atol=TOLERANCE)
