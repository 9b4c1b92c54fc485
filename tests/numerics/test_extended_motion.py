"""Motion of extended poses, against SciPy's exponential of 5 x 5 matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from matrices import inverse_derivative_of_exp
from scipy.spatial.transform import Rotation
from xla.interpreter import run

from cfjax._numerics import extended_motion

AXIS = np.array([2.0, -3.0, 6.0]) / 7
A, V = np.array([0.9, 0.2, -0.6]), np.array([0.4, -1.1, 0.5])
TURN = Rotation.from_rotvec([0.3, 0.8, -0.5])
POSE = np.eye(5)
POSE[:3] = np.column_stack([TURN.as_matrix(), [0.2, 0.7, -0.4], [1.5, -0.3, 0.8]])
# The position, the quaternion with its scalar part last, and the velocity.
PLACES = (6, 3, 4, 5, 7, 8, 9, 0, 1, 2)
VECTOR = np.concatenate([POSE[:3, 4], TURN.as_quat(), POSE[:3, 3]])
OTHER = np.array([0.9, 0.1, -0.4]), np.array([-0.7, 0.5, 0.8]), np.array([0.3, -0.6, 0.2])
ANGLES = [0.0, 1e-9, 0.5, 2.0, np.pi, 6.0, 6.28, 9.4]


def generator(w, a, v):
    x = np.zeros((5, 5))
    x[:3] = np.column_stack([np.cross(w, np.eye(3)).T, a, v])
    return x


@jax.vmap
def everything(w):
    """Velocity and increment of a matrix and of a vector in each frame, and the brackets."""
    rest, found = tuple(map(jnp.asarray, (A, V))), []
    for x, frame in [(x, f) for f in ("body", "fixed") for x in (POSE, VECTOR)]:
        x = jnp.asarray(x)
        velocity = extended_motion.tangent(w, *rest, x, frame, PLACES)
        found.append((velocity, extended_motion.increment(w, *rest, x, frame, PLACES, False)))
    motions = w, *rest, *map(jnp.asarray, OTHER)
    return found, extended_motion.bracket(*motions), extended_motion.dexpinv(*motions)


def as_pose(vector):
    turn = Rotation.from_quat(vector[3:7]).as_matrix()
    return np.column_stack([turn, vector[7:], vector[:3]])


def test_motions_are_those_of_the_exponential():
    found = run(everything, np.multiply.outer(ANGLES, AXIS))
    basis = [generator(*np.split(e, 3)) for e in np.eye(9)]
    for k, angle in enumerate(ANGLES):
        x, y = generator(angle * AXIS, A, V), generator(*OTHER)
        e = scipy.linalg.expm(x)
        moved, bracket, inverse = jax.tree.map(lambda x, k=k: x[k], found)
        body, body_vector, fixed, fixed_vector = moved
        pairs = [
            *zip(body, (POSE @ x, POSE @ e - POSE), strict=True),
            *zip(fixed, (x @ POSE, e @ POSE - POSE), strict=True),
            (as_pose(VECTOR + body_vector[1]), (POSE @ e)[:3]),
            (as_pose(VECTOR + fixed_vector[1]), (e @ POSE)[:3]),
        ]
        for got, want in pairs:
            # Some roundings of numbers of up to ten.
            np.testing.assert_allclose(got, want, rtol=0, atol=3e-14)
        np.testing.assert_allclose(generator(*bracket), x @ y - y @ x, rtol=0, atol=1e-14)
        if angle <= 6:
            # Near a full turn, where it is singular, SciPy's rounding grows.
            want = inverse_derivative_of_exp(x, basis, y)
            np.testing.assert_allclose(np.concatenate(inverse), want, rtol=0, atol=1e-11)
        assert extended_motion.has_dexpinv(jnp.asarray(angle * AXIS)) == (angle < 2 * np.pi)
