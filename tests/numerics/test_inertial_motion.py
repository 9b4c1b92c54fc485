"""Motion of extended poses by readings and gravity, against SciPy's exponentials in its group."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from cfjax._numerics import inertial_motion

AXIS = np.array([2.0, -3.0, 6.0]) / 7
# Force, gravity, time, and what only brackets make.
REST = (
    *(np.array([0.9, 0.2, -0.6]), np.array([0.4, -1.1, 0.5]), np.array(0.7)),
    *(np.array([-0.3, 0.8, 0.1]), np.array([0.2, -0.5, -0.9])),
)
OTHER = (np.array([0.9, 0.1, -0.4]), *(np.roll(x, 1) if x.ndim else x - 2 for x in REST))
TURN = Rotation.from_rotvec([0.3, 0.8, -0.5])
POSE = np.eye(5)
POSE[:3] = np.column_stack([TURN.as_matrix(), [0.2, 0.7, -0.4], [1.5, -0.3, 0.8]])
# The position, the quaternion with its scalar part last, and the velocity.
PLACES = (6, 3, 4, 5, 7, 8, 9, 0, 1, 2)
VECTOR = np.concatenate([POSE[:3, 4], TURN.as_quat(), POSE[:3, 3]])
angles = pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, np.pi, 6.28, 9.4])


def from_right(w, f, g, t, r, s):
    x = np.zeros((5, 5))
    x[:3] = np.column_stack([np.cross(w, np.eye(3)).T, f, r])
    x[3, 4] = t
    return x


def from_left(w, f, g, t, r, s):
    x = np.zeros((5, 5))
    x[:3, 3], x[:3, 4], x[3, 4] = g, s, -t
    return x


def moved(fun, w, x, *options):
    return fun(*map(jnp.asarray, (w, *REST, x)), PLACES, *options)


def end(angle):
    left, right = (f(angle * AXIS, *REST) for f in (from_left, from_right))
    return scipy.linalg.expm(left) @ POSE @ scipy.linalg.expm(right)


@angles
def test_a_pose_moves_by_two_exponentials(angle):
    w = angle * AXIS
    velocity = from_left(w, *REST) @ POSE + POSE @ from_right(w, *REST)
    # Some roundings of numbers of up to ten.
    found = moved(inertial_motion.tangent, w, POSE)
    np.testing.assert_allclose(found, velocity, rtol=0, atol=3e-14)
    found = moved(inertial_motion.increment, w, POSE, False)
    np.testing.assert_allclose(found, end(angle) - POSE, rtol=0, atol=3e-14)


@angles
def test_a_pose_in_one_vector_moves_as_its_matrix(angle):
    found = VECTOR + moved(inertial_motion.increment, angle * AXIS, VECTOR, False)
    turn = Rotation.from_quat(found[3:7]).as_matrix()
    found = np.column_stack([turn, found[7:], found[:3]])
    np.testing.assert_allclose(found, end(angle)[:3], rtol=0, atol=3e-14)


def test_bracket():
    motions = (2.5 * AXIS, *REST), OTHER
    found = inertial_motion.bracket(*map(jnp.asarray, (*motions[0], *motions[1])))
    for generator, sign in [(from_right, 1), (from_left, -1)]:
        a, b = (generator(*motion) for motion in motions)
        expected = sign * (a @ b - b @ a)
        np.testing.assert_allclose(generator(*found), expected, rtol=0, atol=1e-14)


def test_has_dexpinv_below_a_full_turn():
    assert inertial_motion.has_dexpinv(jnp.asarray(6.28 * AXIS))
    assert not inertial_motion.has_dexpinv(jnp.asarray(6.29 * AXIS))
