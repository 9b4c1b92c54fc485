"""Rotations of vectors in space, against SciPy's rotations and exponentials."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import inverse_derivative_of_exp
from scipy.spatial.transform import Rotation

from cfjax._numerics import rotate

AXIS = np.array([2.0, -3.0, 6.0]) / 7
ANGLES = [0.0, 1e-9, 0.3, 2.0, 3.2, 6.0]
angles = pytest.mark.parametrize("angle", ANGLES)
X = np.random.default_rng(0).normal(size=(3, 4))


def hat(w):
    return np.cross(w, np.eye(3)).T


def test_the_cross_product_with_columns():
    found = rotate.cross_product(jnp.asarray(AXIS), jnp.asarray(X))
    np.testing.assert_allclose(found, np.cross(AXIS, X, axis=0), rtol=0, atol=1e-15)


@angles
@pytest.mark.parametrize("columns", [(), (4,)])
def test_rotated_vectors(angle, columns):
    x = X if columns else X[:, 0]
    a, turn = jnp.asarray(angle * AXIS), Rotation.from_rotvec(angle * AXIS).as_matrix()
    # Some roundings of entries below 3.
    np.testing.assert_allclose(rotate.rotate(a, jnp.asarray(x)), turn @ x, rtol=0, atol=4e-15)
    np.testing.assert_allclose(rotate.increment(a, jnp.asarray(x)), turn @ x - x, 0, 4e-15)


@angles
def test_the_mean_along_a_rotation(angle):
    """In the corner of the exponential of [[a, x], [0, 0]]."""
    block = np.block([[angle * hat(AXIS), X], [np.zeros((4, 7))]])
    found = rotate.mean(jnp.asarray(angle * AXIS), jnp.asarray(X))
    np.testing.assert_allclose(found, scipy.linalg.expm(block)[:3, 3:], rtol=0, atol=1e-14)


@angles
def test_the_inverse_derivative_of_the_exponential(angle):
    x = X[:, 0]
    expected = inverse_derivative_of_exp(hat(angle * AXIS), [hat(e) for e in np.eye(3)], hat(x))
    found = rotate.dexpinv(jnp.asarray(angle * AXIS), jnp.asarray(x))
    # Near a full turn, where it is singular, SciPy's rounding grows.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_where_the_inverse_derivative_exists():
    below, above = (2 * np.pi * (1 + d) * AXIS for d in (-1e-12, 1e-12))
    assert rotate.has_dexpinv(jnp.asarray(below))
    assert not rotate.has_dexpinv(jnp.asarray(above))
    assert not rotate.has_dexpinv(jnp.asarray([below, above]))
