"""Motions of extended poses: layouts, and what they refuse."""

import re
from dataclasses import replace
from typing import Any, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cfjax
from cfjax import ExtendedMotion

EPS = 2.0**-52
AXIS = np.array([2.0, -3.0, 6.0]) / 7
A, V = np.array([0.9, 0.2, -0.6]), np.array([0.4, -1.1, 0.5])
Q = np.array([0.1, -0.5, 0.5, 0.7])
VELOCITY, PLACE = np.array([0.2, 0.7, -0.4]), np.array([1.5, -0.3, 0.8])
VECTOR = np.concatenate([Q, VELOCITY, PLACE])
MATRIX = np.eye(5)
MATRIX[:3] = np.column_stack([Rotation.from_quat(np.roll(Q, -1)).as_matrix(), VELOCITY, PLACE])
START = {"vector": jnp.asarray(VECTOR), "matrix": jnp.asarray(MATRIX)}


def motion(w, a, v, frame: Any, layout: Any = "wxyz_v_p"):
    return ExtendedMotion(omega=w, a=a, v=v, frame=frame, layout=layout)


def test_layouts():
    """By hand, with the letters of each part in its place."""
    parts = {"wxyz": Q, "xyzw": np.roll(Q, -1), "v": VELOCITY, "p": PLACE}
    field = motion(AXIS, A, V, "body")
    assert field.has_dexpinv() and not cfjax.combine((7.0,), [field]).has_dexpinv()
    layouts = get_args(ExtendedMotion.__annotations__["layout"].__args__[0])
    assert len(layouts) == 8

    @jax.jit
    def run():
        found = {}
        for layout in layouts:
            x = jnp.concatenate([parts[name] for name in layout.split("_")])
            other = replace(field, layout=layout)
            found[layout] = other.tangent(x), cast(Any, other.defect(x))[0]
        return found

    found = run()
    # test_contract.py has its value.
    first = found["wxyz_v_p"][0]
    moved = {"wxyz": first[:4], "xyzw": np.roll(first[:4], -1), "v": first[4:7], "p": first[7:]}
    for layout, (velocity, off) in found.items():
        want = np.concatenate([moved[name] for name in layout.split("_")])
        np.testing.assert_allclose(velocity, want, rtol=0, atol=8 * EPS)
        assert off < 4 * EPS


# What is refused, at trace time


def extended(frame: Any = "body", layout: Any = "wxyz_v_p", **shapes):
    arrays = {name: jnp.ones(shapes.get(name, (3,))) for name in ("omega", "a", "v")}
    return ExtendedMotion(**arrays, frame=frame, layout=layout)


def test_errors(no_shape_hook, subtests):
    """What is not that of all motions, which test_rigid_motion.py has."""
    for make, kind, text in [
        (
            lambda: extended(a=(5, 3)),
            ValueError,
            r"a must have shape \(3,\) where v has \(3,\), got \(5, 3\)",
        ),
        (
            lambda: extended(omega=()),
            ValueError,
            r"omega must have shape \(3,\) where v has \(3,\), got \(\)",
        ),
        (
            lambda: replace(extended(), a=jnp.ones(3, np.float32)),
            TypeError,
            "omega, a and v must have one dtype, got float64 and float32",
        ),
        (
            lambda: extended(layout="wxyz_xyz"),
            ValueError,
            r"layout must be one of \('wxyz_v_p', .*'p_v_xyzw'\), got 'wxyz_xyz'",
        ),
        (
            lambda: extended(layout=None).flow(jnp.ones(10)),
            TypeError,
            r"ExtendedMotion needs a layout for poses of shape \(10,\): layout=\"wxyz_v_p\" \(a "
            r"quaternion, then a velocity and a position\), \"p_xyzw_v\" \(as in manif::SE_2_3\), "
            r"\"xyzw_v_p\", .*\. There is no default, as a wrong guess would go unnoticed",
        ),
        (
            lambda: extended("fixed").flow(jnp.ones(3)),
            ValueError,
            r"ExtendedMotion with v of shape \(3,\) acts on shapes \(5, 5\) and \(10,\), got \(3,",
        ),
        (
            lambda: cfjax.bracket(extended(), extended("fixed")),
            ValueError,
            "two ExtendedMotions: both must have the same frame and layout, got frame='body', "
            "layout='wxyz_v_p' and frame='fixed', layout='wxyz_v_p'",
        ),
    ]:
        with subtests.test(case=text), pytest.raises(kind, match=text):
            make()


def test_starts_off_the_manifold():
    rotation = (
        r"a rotation, of determinant 1, before its last 2 columns and rows \(0, 0, 0, 1, 0\) and "
        r"\(0, 0, 0, 0, 1\)"
    )
    cases = [
        ("wxyz_v_p", MATRIX * np.array([-1, 1, 1, 1, 1])[:, None], rotation),
        ("wxyz_v_p", MATRIX + np.eye(5, k=1) * np.array([0, 0, 0, 1e-3, 0])[:, None], rotation),
        ("wxyz_p_v", VECTOR + 0.1, "a unit quaternion in its first 4 entries"),
        ("p_v_xyzw", VECTOR, "a unit quaternion in its last 4 entries"),
        ("p_xyzw_v", VECTOR, r"a unit quaternion in its entries \[3:7\]"),
    ]

    @jax.jit
    def defects():
        far = []
        for layout, y0, text in cases:
            off, found = cast(Any, extended(layout=layout).defect(jnp.asarray(y0)))
            assert re.fullmatch(text, found)
            far.append(off)
        return far, [cast(Any, extended().defect(x))[0] for x in START.values()]

    far, on = defects()
    assert min(far) > 0.9e-3 and max(on) < 8 * EPS
