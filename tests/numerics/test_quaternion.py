"""Products of quaternions with vectors and their exponentials, against SciPy's rotations."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfjax._numerics import quaternion

OMEGA, Q = np.array([0.7, -1.1, 0.4]), np.array([0.1, 0.5, -0.5, 0.7])
both = pytest.mark.parametrize("frame, layout", [("body", "wxyz"), ("fixed", "xyzw")])


def product(p, q):
    """Hamilton's, with the scalar part first."""
    (a, *u), (b, *v) = p, q
    return np.array([a * b - np.dot(u, v), *(a * np.array(v) + b * np.array(u) + np.cross(u, v))])


def in_layout(q, layout):
    return q if layout == "wxyz" else np.roll(q, -1)


@pytest.mark.parametrize("layout", ["wxyz", "xyzw"])
def test_parts_of_a_quaternion(layout):
    parts = quaternion.parts(jnp.asarray(in_layout(Q, layout)), layout)
    np.testing.assert_array_equal(parts, Q)
    np.testing.assert_array_equal(quaternion.from_parts(parts, layout), in_layout(Q, layout))


@both
def test_the_product_with_half_a_vector(frame, layout):
    half = np.array([0.0, *OMEGA / 2])
    expected = product(half, Q) if frame == "fixed" else product(Q, half)
    q = jnp.asarray(in_layout(Q, layout))
    found = quaternion.times(jnp.asarray(OMEGA), q, frame, layout)
    np.testing.assert_allclose(found, in_layout(expected, layout), rtol=0, atol=1e-15)


@both
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 3.0, 7.0])
def test_the_increment_along_a_rotation(frame, layout, angle):
    omega = angle * OMEGA / np.linalg.norm(OMEGA)
    x, y, z, w = Rotation.from_rotvec(omega).as_quat()
    turn = np.array([w, x, y, z])
    # SciPy's has one sign of the two; the exponential that of cos(angle / 2).
    turn = turn if w * np.cos(angle / 2) > 0 else -turn
    expected = product(turn, Q) if frame == "fixed" else product(Q, turn)
    q = jnp.asarray(in_layout(Q, layout))
    found = quaternion.increment(jnp.asarray(omega), q, frame, layout, leads_back=False)
    np.testing.assert_allclose(found, in_layout(expected - Q, layout), rtol=0, atol=2e-15)


def test_an_increment_leads_the_length_back():
    """What it is off by falls by the cosine of half the angle."""
    factor = np.cos(np.linalg.norm(OMEGA) / 2)
    q = Q / np.linalg.norm(Q) * (1 + 1e-8)
    for leads_back in (True, False):
        found = q + quaternion.increment(
            jnp.asarray(OMEGA), jnp.asarray(q), "body", "wxyz", leads_back=leads_back
        )
        expected = 1e-8 * (factor if leads_back else 1)
        assert np.linalg.norm(found) - 1 == pytest.approx(expected, rel=1e-6)


def test_choices_of_frame_and_layout():
    quaternion.check_choice("frame", "body")
    with pytest.raises(ValueError, match="frame must be 'body' or 'fixed', got 'space'"):
        quaternion.check_choice("frame", "space")
    with pytest.raises(ValueError, match="layout must be 'wxyz' or 'xyzw', got 'zyxw'"):
        quaternion.check_choice("layout", "zyxw")
