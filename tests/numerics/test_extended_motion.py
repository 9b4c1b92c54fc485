"""Motion of extended poses, against SciPy's exponential of 5 x 5 matrices."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import inverse_derivative_of_exp
from scipy.spatial.transform import Rotation

from cfjax._numerics import extended_motion

AXIS = np.array([2.0, -3.0, 6.0]) / 7
A, V = np.array([0.9, 0.2, -0.6]), np.array([0.4, -1.1, 0.5])
TURN = Rotation.from_rotvec([0.3, 0.8, -0.5])
POSE = np.eye(5)
POSE[:3] = np.column_stack([TURN.as_matrix(), [0.2, 0.7, -0.4], [1.5, -0.3, 0.8]])
# The position, the quaternion with its scalar part last, and the velocity.
PLACES = (6, 3, 4, 5, 7, 8, 9, 0, 1, 2)
VECTOR = np.concatenate([POSE[:3, 4], TURN.as_quat(), POSE[:3, 3]])
angles = pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, np.pi, 6.28, 9.4])
frames = pytest.mark.parametrize("frame", ["body", "fixed"])


def generator(w, a, v):
    x = np.zeros((5, 5))
    x[:3] = np.column_stack([np.cross(w, np.eye(3)).T, a, v])
    return x


def moved(fun, w, x, frame, *options):
    return fun(*map(jnp.asarray, (w, A, V, x)), frame, PLACES, *options)


@angles
@frames
def test_a_pose_moves_by_the_exponential(angle, frame):
    x = generator(angle * AXIS, A, V)
    for fun, options, b in [
        (extended_motion.tangent, (), x),
        (extended_motion.increment, (False,), scipy.linalg.expm(x) - np.eye(5)),
    ]:
        expected = POSE @ b if frame == "body" else b @ POSE
        found = moved(fun, angle * AXIS, POSE, frame, *options)
        # Some roundings of numbers of up to ten.
        np.testing.assert_allclose(found, expected, rtol=0, atol=3e-14)


@angles
@frames
def test_a_pose_in_one_vector_moves_as_its_matrix(angle, frame):
    e = scipy.linalg.expm(generator(angle * AXIS, A, V))
    expected = POSE @ e if frame == "body" else e @ POSE
    found = VECTOR + moved(extended_motion.increment, angle * AXIS, VECTOR, frame, False)
    turn = Rotation.from_quat(found[3:7]).as_matrix()
    found = np.column_stack([turn, found[7:], found[:3]])
    np.testing.assert_allclose(found, expected[:3], rtol=0, atol=3e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 2.0, 6.0])
def test_bracket_and_inverse_derivative_of_the_exponential(angle):
    other = np.array([0.9, 0.1, -0.4]), np.array([-0.7, 0.5, 0.8]), np.array([0.3, -0.6, 0.2])
    motions = [*map(jnp.asarray, (angle * AXIS, A, V, *other))]
    x, y = generator(angle * AXIS, A, V), generator(*other)
    found = generator(*extended_motion.bracket(*motions))
    np.testing.assert_allclose(found, x @ y - y @ x, rtol=0, atol=1e-14)
    basis = [generator(*np.split(e, 3)) for e in np.eye(9)]
    found = np.concatenate(extended_motion.dexpinv(*motions))
    # Near a full turn, where it is singular, SciPy's rounding grows.
    np.testing.assert_allclose(found, inverse_derivative_of_exp(x, basis, y), rtol=0, atol=1e-11)
    assert extended_motion.has_dexpinv(motions[0])
