"""Rigid motions of space and plane: by hand, layouts, drift, and what they refuse."""

from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax import PlanarMotion, RigidMotion

EPS = 2.0**-52
AXIS = np.array([2.0, -3.0, 6.0]) / 7


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def unit(*shape, seed=0):
    x = normal(*shape, seed=seed)
    return x / jnp.linalg.norm(x, axis=-1, keepdims=True)


def to_matrix(pose):
    """The homogeneous matrix of a pose that is one vector."""
    if len(pose) == 4:
        (c, s), place = pose[:2], pose[2:]
        rotation = jnp.array([[c, -s], [s, c]])
    else:
        (w, x, y, z), place = pose[:4], pose[4:]
        rotation = jnp.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    upper = jnp.concatenate([rotation, place[:, None]], axis=1)
    return jnp.concatenate([upper, jnp.eye(len(upper) + 1, dtype=upper.dtype)[-1:]])


POSES = {n: jnp.append(unit(size), normal(n)) for n, size in {3: 4, 2: 2}.items()}
MATRICES = {n: to_matrix(pose) for n, pose in POSES.items()}


def motion(w, v, frame):
    if v.shape[-1] == 3:
        return RigidMotion(omega=w, v=v, frame=frame, layout="wxyz_xyz")
    return PlanarMotion(omega=w, v=v, frame=frame, layout="unit_complex_xy")


def test_quarter_turns_by_hand():
    """About the third axis."""
    half, quarter = np.sqrt(0.5), np.pi / 2
    w, v = np.array([0, 0, quarter]), np.array([quarter, 0, 2.0])
    # A pose of space looks along the second axis, and stands on the first, in the plane the other
    # way round. It moves to its left around the origin, and around (0, 1), whose velocity is zero.
    for start, field, frame, want in [
        ([half, 0, 0, half, 1.0, 0, 0], (w, v), "body", [0, 0, 0, 1, 0, 1, 2]),
        ([half, 0, 0, half, 1.0, 0, 0], (w, v), "fixed", [0, 0, 0, 1, 1, 2, 2]),
        ([0, 1.0, 1, 0], (quarter, v[:2]), "body", [-1, 0, 0, 1]),
        ([0, 1.0, 1, 0], (quarter, v[:2]), "fixed", [-1, 0, 1, 2]),
    ]:
        end = motion(*field, frame).flow(jnp.array(start))
        np.testing.assert_allclose(end, want, rtol=0, atol=8 * EPS)
    # A pose of ROS, at (0, 1, 0): the first axis of the body is the second one of space.
    pose = jnp.array([0, 1.0, 0, 0, 0, half, half])
    field = RigidMotion(omega=np.zeros(3), v=np.eye(3)[0], frame="body", layout="xyz_xyzw")
    np.testing.assert_allclose(field.flow(pose), [0, 2, 0, 0, 0, half, half], 0, atol=4 * EPS)
    # The numbers are a pose in jaxlie's layout too, so no check could tell.
    off, _ = cast(Any, replace(field, layout="wxyz_xyz").defect(pose))
    assert off < 4 * EPS


# Where each has what the first has: the quaternion by its letters, then the position.
LAYOUTS = {
    "wxyz_xyz": [0, 1, 2, 3, 4, 5, 6],
    "xyzw_xyz": [3, 0, 1, 2, 4, 5, 6],
    "xyz_wxyz": [3, 4, 5, 6, 0, 1, 2],
    "xyz_xyzw": [6, 3, 4, 5, 0, 1, 2],
    "unit_complex_xy": [0, 1, 2, 3],
    "xy_unit_complex": [2, 3, 0, 1],
}


def test_layouts():
    """The same motion and the same check of the start, with the entries in other places."""

    @jax.jit
    def run():
        found = {}
        for layout, places in LAYOUTS.items():
            n = 3 if len(places) == 7 else 2
            w, v = (normal(3) if n == 3 else jnp.asarray(0.7)), normal(n, seed=1)
            x = jnp.zeros_like(POSES[n]).at[np.array(places)].set(POSES[n])
            for frame in ("body", "fixed"):
                field: Any = replace(motion(w, v, frame), layout=layout)
                framed = cfjax.tangent(field.framed(x), x)
                ends = field.flow(x), field.increment(x), field.tangent(x), framed
                off, _ = field.defect(x.at[places[0]].add(0.1))
                found[layout, frame] = [end[np.array(places)] for end in ends], off
        return found

    found = run()
    for (layout, frame), (ends, off) in found.items():
        first = "wxyz_xyz" if len(LAYOUTS[layout]) == 7 else "unit_complex_xy"
        # The same operations, which the compiler may join otherwise, on numbers of size 3.
        for got, want in zip(ends, found[first, frame][0], strict=True):
            np.testing.assert_allclose(got, want, rtol=0, atol=10 * EPS)
        np.testing.assert_allclose(ends[3], ends[2], rtol=0, atol=10 * EPS)
        # The defect is (q_0 + 0.1)^2 - q_0^2, to rounding.
        want = abs(0.2 * POSES[3 if len(LAYOUTS[layout]) == 7 else 2][0] + 0.01)
        np.testing.assert_allclose(off, want, rtol=0, atol=10 * EPS)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [(), (2, 3)])
@pytest.mark.parametrize(("n", "frame"), [(3, "body"), (2, "fixed")])
def test_promises(n, frame, axes):
    core = (3,) if n == 3 else ()
    x = jnp.concatenate([unit(*axes, len(POSES[n]) - n), normal(*axes, n)], axis=-1)
    fields = [
        motion(normal(*axes, *core, seed=k), normal(*axes, n, seed=10 + k), frame) for k in range(3)
    ]
    cfjax.check_field(fields, x)


def test_no_drift_in_many_steps():
    """With a field that does not vary every step has the same rounding: the worst case."""

    def end(fields, y0):
        term = cfjax.LieTerm(lambda t, y, args: args)
        return cfjax.integrate(
            term, cfjax.LieEuler(), 0.0, 10_000.0, y0, fields, num_steps=10_000
        ).ys

    def drift(angle, starts):
        ws = {3: jnp.asarray(angle * AXIS), 2: jnp.asarray(angle)}
        fields = {n: motion(w, normal(n), "body") for n, w in ws.items()}
        ends = end(fields, starts)
        return [cast(Any, fields[n].defect(ends[n][-1]))[0] for n in fields]

    # A c_1 near one would be rounded by a quarter of a unit on average. The length of a unit number
    # that turns by h would change by 2 h^2 of that: in all by 300 units where h = 0.25, and 5000
    # where it is 0.5. What c_1 differs by from one is rounded by at most h^2 / 12 of a unit.
    of_quaternion, of_complex = drift(0.5, POSES)
    assert of_quaternion < 60 * EPS
    assert of_complex < 500 * EPS
    # The same with h = 0.1: 50 units.
    assert max(drift(0.1, MATRICES)) < 20 * EPS


# What is refused, at trace time


def rigid(frame="body", w=(3,), v=(3,), dtypes=(np.float64, np.float64), layout: Any = "wxyz_xyz"):
    w, v = jnp.ones(w, dtypes[0]), jnp.ones(v, dtypes[1])
    return RigidMotion(omega=w, v=v, frame=frame, layout=layout)


def planar(frame="body", w=(), v=(2,), layout: Any = "unit_complex_xy"):
    return PlanarMotion(omega=jnp.ones(w), v=jnp.ones(v), frame=frame, layout=layout)


NO_LAYOUT = (
    r'RigidMotion needs a layout for poses of shape \(7,\): layout="wxyz_xyz" .* as in jaxlie\.SE3'
    r'\), layout="xyz_xyzw" .* as in ROS geometry_msgs/Pose\), "xyzw_xyz" or "xyz_wxyz"\. There is '
    "no default, as a wrong guess would go unnoticed"
)


ERRORS = [
    (
        lambda: RigidMotion(omega=np.ones(3), v=np.ones(3)),  # pyright: ignore[reportCallIssue]
        TypeError,
        "missing 1 required keyword-only argument: 'frame'",
    ),
    (lambda: rigid("space"), ValueError, 'frame must be "body" or "fixed", got \'space\''),
    (lambda: rigid(w=(4,)), ValueError, r"omega must have shape \(3,\) where v has \(3,\), got"),
    (lambda: rigid(w=(3,), v=(5, 3)), ValueError, r"shape \(5, 3\) where v has \(5, 3\), got"),
    (lambda: rigid(v=(2,)), ValueError, r"v must have shape \(3,\) or \(\*batch, 3\), got \(2,\)"),
    (lambda: rigid(v=()), ValueError, r"v must have shape \(3,\) or \(\*batch, 3\), got \(\)"),
    (lambda: planar(w=(2,)), ValueError, r"omega must have shape \(\) where v has \(2,\), got"),
    (lambda: planar(v=(3,)), ValueError, r"v must have shape \(2,\) or \(\*batch, 2\), got \(3,\)"),
    (
        lambda: rigid(dtypes=(np.int32, np.float64)),
        TypeError,
        "omega must be float32 or float64, got int32",
    ),
    (
        lambda: rigid(dtypes=(np.float64, np.complex128)),
        TypeError,
        "v must be float32 or float64, got complex128",
    ),
    (
        lambda: rigid(dtypes=(np.float32, np.float64)),
        TypeError,
        "omega and v must have one dtype, got float32 and float64",
    ),
    (
        lambda: rigid().flow(jnp.ones(3)),
        ValueError,
        r'RigidMotion with frame="body" moves poses, shapes \(4, 4\) and \(7,\): a point has '
        r'no frame of its own, got shape \(3,\). Use frame="fixed"',
    ),
    (
        lambda: planar(w=(5,), v=(5, 2)).tangent(jnp.ones((5, 2))),
        ValueError,
        r'PlanarMotion with frame="body" moves poses, shapes \(3, 3\) and \(4,\)',
    ),
    (
        lambda: rigid("fixed").flow(jnp.ones(6)),
        ValueError,
        r"acts on shapes \(4, 4\) and \(7,\) and \(3,\), got \(6,\)",
    ),
    (
        lambda: rigid().tangent(jnp.ones((100, 7))),
        ValueError,
        r"acts on shapes \(4, 4\) and \(7,\), got \(100, 7\). For one motion of each point "
        r"give the coordinates leading axes: v of shape \(100, 3\)",
    ),
    (
        lambda: rigid().increment(jnp.ones(7, np.float32)),
        TypeError,
        "RigidMotion with v in float64 acts on points in float64, got float32",
    ),
    (
        lambda: cfjax.combine((1.0, 1.0), [rigid("body"), rigid("fixed")]),
        TypeError,
        r"must agree in all but arrays, got RigidMotion\(omega=f64\[3\], v=f64\[3\], "
        r"frame='body', layout='wxyz_xyz'\) and RigidMotion\(.*frame='fixed', ",
    ),
    (
        lambda: cfjax.combine((1.0, 1.0), [rigid(), planar()]),
        TypeError,
        "Only fields of one kind can be added, got RigidMotion and PlanarMotion",
    ),
    (
        lambda: cfjax.bracket(rigid("body"), rigid("fixed")),
        ValueError,
        "both must have the same frame and layout, got frame='body', "
        "layout='wxyz_xyz' and frame='fixed', layout='wxyz_xyz'",
    ),
    (
        lambda: cfjax.bracket(rigid(), rigid(layout="xyz_xyzw")),
        ValueError,
        "layout='wxyz_xyz' and frame='body', layout='xyz_xyzw'",
    ),
    (
        lambda: cfjax.combine((1.0, 1.0), [rigid(), rigid(layout=None)]),
        TypeError,
        r"must agree in all but arrays, got .*layout='wxyz_xyz'\) and .*frame='body'\)",
    ),
    (
        lambda: rigid(layout="xyzw"),
        ValueError,
        r"layout must be one of \('wxyz_xyz', 'xyz_xyzw', 'xyzw_xyz', 'xyz_wxyz'\), got 'xyzw'",
    ),
    (
        lambda: planar(layout="wxyz_xyz"),
        ValueError,
        r"layout must be one of \('unit_complex_xy', 'xy_unit_complex'\), got 'wxyz_xyz'",
    ),
    (lambda: rigid(layout=None).flow(jnp.ones(7)), TypeError, NO_LAYOUT),
    (lambda: rigid(layout=None).defect(jnp.ones(7)), TypeError, NO_LAYOUT),
    (
        lambda: cfjax.integrate(
            cfjax.LieTerm(lambda t, y, args: rigid("fixed", (2, 3), (2, 3), layout=None)),
            cfjax.RKMK8(),
            0.0,
            1.0,
            jnp.ones((2, 7)),
            num_steps=1,
        ),
        TypeError,
        rf"for y, where the state is f64\[2,7\]\. It does not act there: {NO_LAYOUT}",
    ),
    (
        lambda: planar(layout=None).increment(jnp.ones(4)),
        TypeError,
        r"PlanarMotion needs a layout for poses of shape \(4,\): layout=\"unit_complex_xy\" .* "
        r"as in jaxlie\.SE2\) or layout=\"xy_unit_complex\"",
    ),
    (
        lambda: planar().bracket(cfjax.Rotation(np.ones(3))),
        TypeError,
        "Cannot compute the bracket of PlanarMotion and Rotation: both must be of one class",
    ),
]


def test_errors(no_shape_hook, subtests):
    for make, kind, text in ERRORS:
        with subtests.test(case=text), pytest.raises(kind, match=text):
            make()


def test_starts_off_the_manifold():
    a_rotation = "a rotation, of determinant 1, before its last column and row (0, 0, 0, 1)"
    for field, y0, text in [
        (rigid(), MATRICES[3].at[0].multiply(-1), a_rotation),
        (planar(), POSES[2].at[0].add(0.1), "a unit complex number in its first 2 entries"),
        (rigid(layout="xyz_wxyz"), POSES[3], "a unit quaternion in its last 4 entries"),
    ]:
        off, found = cast(Any, field.defect(y0))
        assert off > 0.05 and found == text
    term = cfjax.LieTerm(lambda t, y, args: planar())
    with pytest.raises(RuntimeError, match="y0 must have a unit complex number in its first 2 ent"):
        y0 = POSES[2].at[0].add(0.1)
        cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, y0, num_steps=1)
    # Matrices and points need no layout.
    for n, field in {3: rigid(layout=None), 2: planar(layout=None)}.items():
        for x in (MATRICES[n], POSES[n][-n:]):
            field = replace(field, frame="fixed")
            assert field.flow(x).shape == field.tangent(x).shape == x.shape
        # A point has its velocity in place of a frame.
        np.testing.assert_array_equal(field.framed(x), field.tangent(x))
        assert field.defect(POSES[n][-n:]) is None
        off, _ = cast(Any, field.defect(MATRICES[n]))
        assert off < 8 * EPS
    for n, field in {3: rigid(), 2: planar()}.items():
        assert field.defect(POSES[n][-n:]) is None
        for x in (POSES[n], MATRICES[n]):
            off, _ = cast(Any, field.defect(x))
            assert off < 8 * EPS
        for x, least in [
            (1.0001 * POSES[n], 2e-4),
            # What this adds to the determinant, and more or less to the squares of columns.
            (MATRICES[n].at[0].multiply(1.0001), 1e-4),
            (MATRICES[n].at[n, 1].set(1e-4), 1e-4),
        ]:
            off, _ = cast(Any, field.defect(x))
            assert 0.99 * least < off < 3 * least
