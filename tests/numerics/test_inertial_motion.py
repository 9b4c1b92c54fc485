"""Motion of extended poses by readings and gravity, against SciPy's exponentials in its group."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation
from xla.interpreter import run

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
ANGLES = [0.0, 1e-9, 0.5, 2.5, np.pi, 6.28, 9.4]


def from_right(w, f, g, t, r, s):
    x = np.zeros((5, 5))
    x[:3] = np.column_stack([np.cross(w, np.eye(3)).T, f, r])
    x[3, 4] = t
    return x


def from_left(w, f, g, t, r, s):
    x = np.zeros((5, 5))
    x[:3, 3], x[:3, 4], x[3, 4] = g, s, -t
    return x


@jax.vmap
def everything(w):
    motion = (w, *map(jnp.asarray, REST))
    pose, vector = map(jnp.asarray, (POSE, VECTOR))
    return (
        inertial_motion.tangent(*motion, pose, PLACES),
        inertial_motion.increment(*motion, pose, PLACES, False),
        inertial_motion.increment(*motion, vector, PLACES, False),
        inertial_motion.bracket(*motion, *map(jnp.asarray, OTHER)),
    )


def test_a_pose_moves_by_two_exponentials():
    found = run(everything, np.multiply.outer(ANGLES, AXIS))
    for k, angle in enumerate(ANGLES):
        velocity, increment, of_vector, bracket = jax.tree.map(lambda x, k=k: x[k], found)
        left, right = (f(angle * AXIS, *REST) for f in (from_left, from_right))
        end = scipy.linalg.expm(left) @ POSE @ scipy.linalg.expm(right)
        vector = VECTOR + of_vector
        turn = Rotation.from_quat(vector[3:7]).as_matrix()
        pairs = [
            (velocity, left @ POSE + POSE @ right),
            (increment, end - POSE),
            (np.column_stack([turn, vector[7:], vector[:3]]), end[:3]),
        ]
        for got, want in pairs:
            # Some roundings of numbers of up to ten.
            np.testing.assert_allclose(got, want, rtol=0, atol=3e-14)
        for generator, sign in [(from_right, 1), (from_left, -1)]:
            a, b = (generator(*motion) for motion in ((angle * AXIS, *REST), OTHER))
            want = sign * (a @ b - b @ a)
            np.testing.assert_allclose(generator(*bracket), want, rtol=0, atol=1e-14)


def test_has_dexpinv_below_a_full_turn():
    assert inertial_motion.has_dexpinv(jnp.asarray(6.28 * AXIS))
    assert not inertial_motion.has_dexpinv(jnp.asarray(6.29 * AXIS))
