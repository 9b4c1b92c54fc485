"""Motion of points and poses in the plane, against SciPy's exponential of 3 x 3 matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from matrices import inverse_derivative_of_exp, motions
from xla.interpreter import run

from cfjax._numerics import planar_motion

V, POINT = np.array([0.4, -1.1]), np.array([0.7, 0.2])
POSE = np.array([[0.6, -0.8, 1.5], [0.8, 0.6, -0.3], [0.0, 0.0, 1.0]])
# Cosine and sine of the direction after the position.
PLACES, VECTOR = (2, 3, 0, 1), np.array([1.5, -0.3, 0.6, 0.8])
OTHER = 0.9, np.array([0.3, -0.6])
ANGLES = [0.0, 1e-9, 0.5, 2.0, 6.0]
STATES = [(x, f) for f in ("body", "fixed") for x in (POSE, VECTOR)] + [(POINT, "fixed")]
everything = motions(planar_motion, V, STATES, PLACES, OTHER)


def screw(w, v):
    return np.array([[0.0, -w, v[0]], [w, 0.0, v[1]], [0.0, 0.0, 0.0]])


def as_vector(pose):
    return np.array([*pose[:2, 2], *pose[:2, 0]])


def test_motions_are_those_of_the_exponential():
    found = run(everything, np.array(ANGLES))
    basis = [screw(1.0, np.zeros(2)), screw(0.0, [1.0, 0.0]), screw(0.0, [0.0, 1.0])]
    point = np.array([*POINT, 1.0])
    for k, angle in enumerate(ANGLES):
        a, b = screw(angle, V), screw(*OTHER)
        moved, bracket, inverse = jax.tree.map(lambda x, k=k: x[k], found)
        for which, m in enumerate([a, scipy.linalg.expm(a) - np.eye(3)]):
            poses = [POSE @ m, m @ POSE]
            wants = [y for pose in poses for y in (pose, as_vector(pose))] + [(m @ point)[:2]]
            for got, want in zip(moved, wants, strict=True):
                # Some roundings of numbers below ten.
                np.testing.assert_allclose(got[which], want, rtol=0, atol=1e-14)
        np.testing.assert_allclose(screw(*bracket), a @ b - b @ a, rtol=0, atol=1e-14)
        # Near a full turn, where it is singular, SciPy's rounding grows.
        want = inverse_derivative_of_exp(a, basis, b)
        np.testing.assert_allclose(np.hstack(inverse), want, rtol=0, atol=1e-12)


def test_where_the_inverse_derivative_exists():
    below, above = 2 * np.pi * (1 - 1e-12), 2 * np.pi * (1 + 1e-12)
    assert planar_motion.has_dexpinv(jnp.asarray([0.0, below]))
    assert not planar_motion.has_dexpinv(jnp.asarray([0.0, above]))
