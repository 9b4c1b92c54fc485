"""Motion of points and poses in the plane, against SciPy's exponential of 3 x 3 matrices."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import inverse_derivative_of_exp

from cfjax._numerics import planar_motion

V, POINT = np.array([0.4, -1.1]), np.array([0.7, 0.2])
POSE = np.array([[0.6, -0.8, 1.5], [0.8, 0.6, -0.3], [0.0, 0.0, 1.0]])
# Cosine and sine of the direction after the position.
PLACES, VECTOR = (2, 3, 0, 1), np.array([1.5, -0.3, 0.6, 0.8])
angles = pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 2.0, 6.0])
frames = pytest.mark.parametrize("frame", ["body", "fixed"])


def screw(w, v):
    return np.array([[0.0, -w, v[0]], [w, 0.0, v[1]], [0.0, 0.0, 0.0]])


def moved(fun, w, x, frame, *options):
    return fun(jnp.asarray(w), jnp.asarray(V), jnp.asarray(x), frame, PLACES, *options)


def as_vector(pose):
    return np.array([*pose[:2, 2], *pose[:2, 0]])


@angles
@frames
def test_a_pose_moves_by_the_exponential(angle, frame):
    a = screw(angle, V)
    for fun, options, b in [
        (planar_motion.tangent, (), a),
        (planar_motion.increment, (False,), scipy.linalg.expm(a) - np.eye(3)),
    ]:
        expected = POSE @ b if frame == "body" else b @ POSE
        # Some roundings of numbers below ten.
        found = moved(fun, angle, POSE, frame, *options)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
        found = moved(fun, angle, VECTOR, frame, *options)
        np.testing.assert_allclose(found, as_vector(expected), rtol=0, atol=1e-14)


@angles
def test_a_point_moves_by_the_exponential(angle):
    point = np.array([*POINT, 1.0])
    a = screw(angle, V)
    found = moved(planar_motion.tangent, angle, POINT, "fixed")
    np.testing.assert_allclose(found, (a @ point)[:2], rtol=0, atol=1e-14)
    found = moved(planar_motion.increment, angle, POINT, "fixed", False)
    np.testing.assert_allclose(found, (scipy.linalg.expm(a) @ point)[:2] - POINT, 0, 1e-14)


@angles
def test_bracket_and_inverse_derivative_of_the_exponential(angle):
    other = np.array([0.3, -0.6]), 0.9
    motions = *map(jnp.asarray, (angle, V)), *map(jnp.asarray, (other[1], other[0]))
    a, b = screw(angle, V), screw(other[1], other[0])
    np.testing.assert_allclose(
        screw(*planar_motion.bracket(*motions)), a @ b - b @ a, rtol=0, atol=1e-14
    )
    basis = [screw(1.0, np.zeros(2)), screw(0.0, [1.0, 0.0]), screw(0.0, [0.0, 1.0])]
    w, *v = inverse_derivative_of_exp(a, basis, b)
    found = planar_motion.dexpinv(*motions)
    # Near a full turn, where it is singular, SciPy's rounding grows.
    np.testing.assert_allclose(found[0], w, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[1], v, rtol=0, atol=1e-12)


def test_where_the_inverse_derivative_exists():
    below, above = 2 * np.pi * (1 - 1e-12), 2 * np.pi * (1 + 1e-12)
    assert planar_motion.has_dexpinv(jnp.asarray([0.0, below]))
    assert not planar_motion.has_dexpinv(jnp.asarray([0.0, above]))
