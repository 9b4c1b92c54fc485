"""Motion of points and poses in space, against SciPy's exponential of 4 x 4 matrices."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import inverse_derivative_of_exp
from scipy.spatial.transform import Rotation

from cfjax._numerics import rigid_motion

AXIS = np.array([2.0, -3.0, 6.0]) / 7
V, POINT = np.array([0.4, -1.1, 0.5]), np.array([0.7, 0.2, -0.9])
TURN = Rotation.from_rotvec([0.3, 0.8, -0.5])
POSE = np.eye(4)
POSE[:3] = np.column_stack([TURN.as_matrix(), [1.5, -0.3, 0.8]])
# The position, and then the quaternion with its scalar part last.
PLACES, VECTOR = (6, 3, 4, 5, 0, 1, 2), np.concatenate([POSE[:3, 3], TURN.as_quat()])
angles = pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 2.0, 6.0])
frames = pytest.mark.parametrize("frame", ["body", "fixed"])


def screw(w, v):
    a = np.zeros((4, 4))
    a[:3] = np.column_stack([np.cross(w, np.eye(3)).T, v])
    return a


def moved(fun, w, x, frame, *options):
    return fun(jnp.asarray(w), jnp.asarray(V), jnp.asarray(x), frame, PLACES, *options)


@angles
@frames
def test_a_pose_moves_by_the_exponential(angle, frame):
    a = screw(angle * AXIS, V)
    for fun, options, b in [
        (rigid_motion.tangent, (), a),
        (rigid_motion.increment, (False,), scipy.linalg.expm(a) - np.eye(4)),
    ]:
        expected = POSE @ b if frame == "body" else b @ POSE
        found = moved(fun, angle * AXIS, POSE, frame, *options)
        # Some roundings of numbers below ten.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


@angles
@frames
def test_a_pose_in_one_vector_moves_as_its_matrix(angle, frame):
    e = scipy.linalg.expm(screw(angle * AXIS, V))
    expected = POSE @ e if frame == "body" else e @ POSE
    found = VECTOR + moved(rigid_motion.increment, angle * AXIS, VECTOR, frame, False)
    turn = Rotation.from_quat(found[3:]).as_matrix()
    np.testing.assert_allclose(found[:3], expected[:3, 3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(turn, expected[:3, :3], rtol=0, atol=1e-14)


@angles
def test_a_point_moves_by_the_exponential(angle):
    point = np.array([*POINT, 1.0])
    a = screw(angle * AXIS, V)
    found = moved(rigid_motion.tangent, angle * AXIS, POINT, "fixed")
    np.testing.assert_allclose(found, (a @ point)[:3], rtol=0, atol=1e-14)
    found = moved(rigid_motion.increment, angle * AXIS, POINT, "fixed", False)
    np.testing.assert_allclose(found, (scipy.linalg.expm(a) @ point)[:3] - POINT, 0, 1e-14)


@angles
def test_bracket_and_inverse_derivative_of_the_exponential(angle):
    w2, v2 = np.array([0.9, 0.1, -0.4]), np.array([0.3, -0.6, 0.2])
    motions = [*map(jnp.asarray, (angle * AXIS, V, w2, v2))]
    a, b = screw(angle * AXIS, V), screw(w2, v2)
    np.testing.assert_allclose(
        screw(*rigid_motion.bracket(*motions)), a @ b - b @ a, rtol=0, atol=1e-14
    )
    basis = [screw(*np.split(e, 2)) for e in np.eye(6)]
    found = np.concatenate(rigid_motion.dexpinv(*motions))
    # Near a full turn, where it is singular, SciPy's rounding grows.
    np.testing.assert_allclose(found, inverse_derivative_of_exp(a, basis, b), rtol=0, atol=1e-11)
