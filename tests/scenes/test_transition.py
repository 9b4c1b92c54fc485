"""Transition matrices of a spacecraft: two references, Jacobi's integral, order, and growth."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax
from cfjax.scenes import transition
from cfjax.scenes.transition import Craft

TURNED = {
    "q": np.array([0.8, 0.4, -0.4, 0.2]),
    "w": np.array([0.3, -0.5, 1.2]),
}


def test_the_reference_at_rest_is_an_exponential():
    for inertia in ((1.0, 2.0, 2.4), (2.0, 1.0, 2.4)):
        args = Craft(inertia)
        found = transition.reference(3.0, args, transition.y0(0.0))
        want = transition.at_rest(3.0, args)
        # A tolerance of 1e-13 over some hundred steps, where errors grow a hundredfold.
        np.testing.assert_allclose(found.transition, want, rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.state["w"], [0, 0, 1], rtol=0, atol=1e-11)


def test_the_reference_away_from_rest_has_the_derivative_of_its_state():
    @jax.jit
    def turned(eta):
        turn = cfjax.QuaternionRotation(eta, frame="body", layout="wxyz")
        return turn.flow(jnp.asarray(TURNED["q"]))

    args, h = Craft(), 1e-4
    phi = transition.reference(1.5, args, TURNED).transition
    for k in (0, 2, 4):
        ends = []
        for sign in (1, -1):
            eta = sign * h * np.eye(6)[k]
            start = {"q": np.asarray(turned(eta[:3])), "w": TURNED["w"] + eta[3:]}
            ends.append(transition.reference(1.5, args, start).state)
        # Half of 2 (q* q') is the angle between two attitudes, to second order.
        w, *v = ends[1]["q"]
        inverse, other = np.r_[w, np.negative(v)], ends[0]["q"]
        vector = inverse[0] * other[1:] + other[0] * inverse[1:]
        vector += np.cross(inverse[1:], other[1:])
        found = np.r_[2 * vector, ends[0]["w"] - ends[1]["w"]] / (2 * h)
        # Central differences: the square of h times a third derivative of some tens.
        np.testing.assert_allclose(found, phi[:, k], rtol=0, atol=1e-6)


def test_jacobis_integral_and_the_determinant():
    args, energy = Craft(), jax.jit(transition.energy)
    for t in (1.0, 2.5):
        end = transition.reference(t, args, TURNED)
        energies = [energy(s, y, args) for s, y in ((0.0, TURNED), (t, end.state))]
        np.testing.assert_allclose(*energies, rtol=0, atol=1e-11)
        # A flow of Hamilton's, in coordinates of constant volume.
        np.testing.assert_allclose(np.linalg.det(end.transition), 1.0, rtol=0, atol=1e-10)


def test_order():
    args, t1 = Craft(), 3.0
    exact, errors = transition.reference(t1, args, TURNED), []
    start = jax.jit(lambda y: transition.term.start(0.0, y, args, transition=True))(TURNED)
    for pieces in (1, 2):
        given = transition.term, cfjax.CF2(), 0.0, t1, start, args
        end = problems.in_pieces(*given, 80, pieces)
        errors.append(transition.error(jax.tree.map(np.asarray, end), exact))
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.2
    # Above the error of the reference.
    assert errors[1] > 1e-11


@pytest.mark.slow
def test_errors_grow_as_those_at_rest():
    args = Craft((2.0, 1.0, 2.4))
    times, sizes = transition.growth(args, transition.y0(0.0), num_steps=100)
    want = np.linalg.norm(transition.at_rest(times[-1], args), axis=0)
    np.testing.assert_allclose(sizes[-1], want, rtol=1e-6)
    # About the axis across the orbit by the rate of the module's docstring.
    rate = np.log(sizes[-1, 2] / sizes[50, 2]) / (times[-1] - times[50])
    np.testing.assert_allclose(rate, np.sqrt(3 * (2.0 - 1.0) / 2.4), rtol=1e-3)
