"""Motion of points and poses in space, against SciPy's exponential of 4 x 4 matrices."""

import jax
import numpy as np
import scipy.linalg
from matrices import inverse_derivative_of_exp, motions
from scipy.spatial.transform import Rotation
from xla.interpreter import run

from cfjax._numerics import rigid_motion

AXIS = np.array([2.0, -3.0, 6.0]) / 7
V, POINT = np.array([0.4, -1.1, 0.5]), np.array([0.7, 0.2, -0.9])
TURN = Rotation.from_rotvec([0.3, 0.8, -0.5])
POSE = np.eye(4)
POSE[:3] = np.column_stack([TURN.as_matrix(), [1.5, -0.3, 0.8]])
# The position, and then the quaternion with its scalar part last.
PLACES, VECTOR = (6, 3, 4, 5, 0, 1, 2), np.concatenate([POSE[:3, 3], TURN.as_quat()])
OTHER = np.array([0.9, 0.1, -0.4]), np.array([0.3, -0.6, 0.2])
ANGLES = [0.0, 1e-9, 0.5, 2.0, 6.0]
STATES = [(x, f) for f in ("body", "fixed") for x in (POSE, VECTOR)] + [(POINT, "fixed")]
everything = motions(rigid_motion, V, STATES, PLACES, OTHER)


def screw(w, v):
    a = np.zeros((4, 4))
    a[:3] = np.column_stack([np.cross(w, np.eye(3)).T, v])
    return a


def as_pose(vector):
    pose = np.eye(4)
    pose[:3] = np.column_stack([Rotation.from_quat(vector[3:]).as_matrix(), vector[:3]])
    return pose


def test_motions_are_those_of_the_exponential():
    found = run(everything, np.multiply.outer(ANGLES, AXIS))
    basis, point = [screw(*np.split(e, 2)) for e in np.eye(6)], np.array([*POINT, 1.0])
    for k, angle in enumerate(ANGLES):
        a, b = screw(angle * AXIS, V), screw(*OTHER)
        e = scipy.linalg.expm(a)
        moved, bracket, inverse = jax.tree.map(lambda x, k=k: x[k], found)
        body, body_vector, fixed, fixed_vector, of_point = moved
        pairs = [
            *zip(body, (POSE @ a, POSE @ e - POSE), strict=True),
            *zip(fixed, (a @ POSE, e @ POSE - POSE), strict=True),
            *zip(of_point, ((a @ point)[:3], (e @ point)[:3] - POINT), strict=True),
            (as_pose(VECTOR + body_vector[1]), POSE @ e),
            (as_pose(VECTOR + fixed_vector[1]), e @ POSE),
            (screw(*bracket), a @ b - b @ a),
        ]
        for got, want in pairs:
            # Some roundings of numbers below ten.
            np.testing.assert_allclose(got, want, rtol=0, atol=1e-14)
        # Near a full turn, where it is singular, SciPy's rounding grows.
        want = inverse_derivative_of_exp(a, basis, b)
        np.testing.assert_allclose(np.concatenate(inverse), want, rtol=0, atol=1e-11)
