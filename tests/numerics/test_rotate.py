"""Rotations of vectors in space, against SciPy's rotations and exponentials."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from matrices import inverse_derivative_of_exp
from problems import hat
from scipy.spatial.transform import Rotation
from xla.interpreter import run

from cfjax._numerics import rotate

AXIS = np.array([2.0, -3.0, 6.0]) / 7
ANGLES = [0.0, 1e-9, 0.3, 2.0, 3.2, 6.0]
X = np.random.default_rng(0).normal(size=(3, 4))


@jax.vmap
def everything(a):
    x = jnp.asarray(X)
    one = x[:, 0]
    moved = [f(a, y) for f in (rotate.rotate, rotate.increment) for y in (x, one)]
    return *moved, rotate.mean(a, x), rotate.dexpinv(a, one)


def test_rotations_by_every_angle():
    found = run(everything, np.multiply.outer(ANGLES, AXIS))
    for angle, moved, moved_one, by, by_one, mean, inverse in zip(ANGLES, *found, strict=True):
        turn = Rotation.from_rotvec(angle * AXIS).as_matrix()
        # Some roundings of entries below 3.
        for got, want in ((moved, turn @ X), (by, turn @ X - X)):
            np.testing.assert_allclose(got, want, rtol=0, atol=4e-15)
        for got, want in ((moved_one, moved[:, 0]), (by_one, by[:, 0])):
            np.testing.assert_allclose(got, want, rtol=0, atol=4e-15)
        # In the corner of the exponential of [[a, x], [0, 0]].
        block = np.block([[angle * hat(AXIS), X], [np.zeros((4, 7))]])
        np.testing.assert_allclose(mean, scipy.linalg.expm(block)[:3, 3:], rtol=0, atol=1e-14)
        basis = [hat(e) for e in np.eye(3)]
        want = inverse_derivative_of_exp(hat(angle * AXIS), basis, hat(X[:, 0]))
        # Near a full turn, where it is singular, SciPy's rounding grows.
        np.testing.assert_allclose(inverse, want, rtol=0, atol=1e-12)


def test_the_cross_product_with_columns():
    found = run(rotate.cross_product, AXIS, X)
    np.testing.assert_allclose(found, np.cross(AXIS, X, axis=0), rtol=0, atol=1e-15)


def test_where_the_inverse_derivative_exists():
    below, above = (2 * np.pi * (1 + d) * AXIS for d in (-1e-12, 1e-12))
    assert rotate.has_dexpinv(jnp.asarray(below))
    assert not rotate.has_dexpinv(jnp.asarray(above))
    assert not rotate.has_dexpinv(jnp.asarray([below, above]))
