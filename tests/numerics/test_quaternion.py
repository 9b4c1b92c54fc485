"""Products of quaternions with vectors and their exponentials, against SciPy's rotations."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from xla.interpreter import run

from cfjax._numerics import quaternion

OMEGA, Q = np.array([0.7, -1.1, 0.4]), np.array([0.1, 0.5, -0.5, 0.7])
BOTH = (("body", "wxyz"), ("fixed", "xyzw"))
ANGLES = [0.0, 1e-9, 1.0, 3.0, 7.0]


def product(p, q):
    """Hamilton's, with the scalar part first."""
    (a, *u), (b, *v) = p, q
    return np.array([a * b - np.dot(u, v), *(a * np.array(v) + b * np.array(u) + np.cross(u, v))])


def in_layout(q, layout):
    return q if layout == "wxyz" else np.roll(q, -1)


def test_parts_of_a_quaternion():
    for layout in ("wxyz", "xyzw"):
        parts = quaternion.parts(jnp.asarray(in_layout(Q, layout)), layout)
        np.testing.assert_array_equal(parts, Q)
        np.testing.assert_array_equal(quaternion.from_parts(parts, layout), in_layout(Q, layout))


def test_the_velocity_and_the_increment_along_a_rotation():
    @jax.vmap
    def everything(omega):
        given = [(jnp.asarray(in_layout(Q, layout)), frame, layout) for frame, layout in BOTH]
        return [
            (quaternion.times(omega, *x), quaternion.increment(omega, *x, leads_back=False))
            for x in given
        ]

    omegas = np.multiply.outer(ANGLES, OMEGA / np.linalg.norm(OMEGA))
    found = run(everything, omegas)
    for k, (angle, omega) in enumerate(zip(ANGLES, omegas, strict=True)):
        half = np.array([0.0, *omega / 2])
        x, y, z, w = Rotation.from_rotvec(omega).as_quat()
        turn = np.array([w, x, y, z])
        # SciPy's has one sign of the two; the exponential that of cos(angle / 2).
        turn = turn if w * np.cos(angle / 2) > 0 else -turn
        for (frame, layout), (velocity, increment) in zip(BOTH, found, strict=True):
            by = (lambda p: product(p, Q)) if frame == "fixed" else (lambda p: product(Q, p))
            # Some roundings of numbers up to four.
            np.testing.assert_allclose(velocity[k], in_layout(by(half), layout), 0, 2e-15)
            np.testing.assert_allclose(increment[k], in_layout(by(turn) - Q, layout), 0, 2e-15)


def test_an_increment_leads_the_length_back():
    """What it is off by falls by the cosine of half the angle."""
    factor = np.cos(np.linalg.norm(OMEGA) / 2)
    q = Q / np.linalg.norm(Q) * (1 + 1e-8)
    for leads_back in (True, False):
        increment = partial(
            quaternion.increment, frame="body", layout="wxyz", leads_back=leads_back
        )
        found = q + run(increment, OMEGA, q)
        expected = 1e-8 * (factor if leads_back else 1)
        assert np.linalg.norm(found) - 1 == pytest.approx(expected, rel=1e-6)


def test_choices_of_frame_and_layout():
    quaternion.check_choice("frame", "body")
    with pytest.raises(ValueError, match="frame must be 'body' or 'fixed', got 'space'"):
        quaternion.check_choice("frame", "space")
    with pytest.raises(ValueError, match="layout must be 'wxyz' or 'xyzw', got 'zyxw'"):
        quaternion.check_choice("layout", "zyxw")
