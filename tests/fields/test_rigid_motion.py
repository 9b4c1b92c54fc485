"""Rigid motions of space and plane: by hand, layouts, drift, and what they refuse."""

from dataclasses import replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
    n = 2 if len(pose) == 4 else 3
    m = np.eye(n + 1)
    c, s = pose[:2]
    turn = [[c, -s], [s, c]] if n == 2 else Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
    m[:n] = np.column_stack([turn, pose[-n:]])
    return jnp.asarray(m)


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
    cases = [
        ([half, 0, 0, half, 1.0, 0, 0], (w, v), "body", [0, 0, 0, 1, 0, 1, 2]),
        ([half, 0, 0, half, 1.0, 0, 0], (w, v), "fixed", [0, 0, 0, 1, 1, 2, 2]),
        ([0, 1.0, 1, 0], (quarter, v[:2]), "body", [-1, 0, 0, 1]),
        ([0, 1.0, 1, 0], (quarter, v[:2]), "fixed", [-1, 0, 1, 2]),
    ]
    ends = jax.jit(lambda: [motion(*f, frame).flow(jnp.array(x)) for x, f, frame, _ in cases])()
    for (*_, want), end in zip(cases, ends, strict=True):
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
                off, _ = field.defect(x.at[places[0]].add(0.1))
                velocities = [v[np.array(places)] for v in (field.tangent(x), framed)]
                found[layout, frame] = velocities, off
        return found

    found = run()
    for (layout, frame), (velocities, off) in found.items():
        first = "wxyz_xyz" if len(LAYOUTS[layout]) == 7 else "unit_complex_xy"
        for velocity in velocities:
            # The same operations, which the compiler may join otherwise, on numbers of size 3.
            np.testing.assert_allclose(velocity, found[first, frame][0][0], rtol=0, atol=10 * EPS)
        # The defect is (q_0 + 0.1)^2 - q_0^2, to rounding.
        want = abs(0.2 * POSES[3 if len(LAYOUTS[layout]) == 7 else 2][0] + 0.01)
        np.testing.assert_allclose(off, want, rtol=0, atol=10 * EPS)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("kind", ["vectors", "matrices"])
def test_no_drift_in_many_steps(kind):
    """With a field that does not vary every step has the same rounding: the worst case."""
    starts, angle = (POSES, 0.5) if kind == "vectors" else (MATRICES, 0.1)
    ws = {3: jnp.asarray(angle * AXIS), 2: jnp.asarray(angle)}
    fields = {n: motion(w, normal(n), "body") for n, w in ws.items()}
    term = cfjax.LieTerm(lambda t, y, args: args)
    ends: Any = cfjax.integrate(
        term, cfjax.LieEuler(), 0.0, 10_000.0, starts, fields, num_steps=10_000
    ).ys
    drift = {n: cast(Any, fields[n].defect(ends[n][-1]))[0] for n in fields}
    # A c_1 near one would be rounded by a quarter of a unit on average. The length of a unit number
    # that turns by h would change by 2 h^2 of that: in all by 300 units where h = 0.25, and 5000
    # where it is 0.5. What c_1 differs by from one is rounded by at most h^2 / 12 of a unit. With
    # h = 0.1 it is 50 units.
    limits = {3: 60, 2: 500} if kind == "vectors" else {3: 20, 2: 20}
    for n, limit in limits.items():
        assert drift[n] < limit * EPS


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
    spatial, plane = rigid(), planar()
    # Matrices and points need no layout.
    free: Any = {3: rigid("fixed", layout=None), 2: planar("fixed", layout=None)}
    refused = [
        (spatial, MATRICES[3].at[0].multiply(-1), a_rotation),
        (plane, POSES[2].at[0].add(0.1), "a unit complex number in its first 2 entries"),
        (rigid(layout="xyz_wxyz"), POSES[3], "a unit quaternion in its last 4 entries"),
    ]

    @jax.jit
    def defects():
        far = []
        for field, y0, text in refused:
            off, found = cast(Any, field.defect(y0))
            assert found == text
            far.append(off)
        on, near = [], []
        for n, field in {3: spatial, 2: plane}.items():
            starts = [(field, POSES[n]), (field, MATRICES[n]), (free[n], MATRICES[n])]
            on += [cast(Any, field.defect(x))[0] for field, x in starts]
            for x in (
                POSES[n] * (1 + 5e-5),
                # What this adds to the determinant, and more or less to the squares of columns.
                MATRICES[n].at[0].multiply(1.0001),
                MATRICES[n].at[n, 1].set(1e-4),
            ):
                near.append(cast(Any, field.defect(x))[0])
        return far, on, near

    far, on, near = map(np.array, defects())
    assert np.all(far > 0.05) and np.all(on < 8 * EPS)
    assert np.all((0.99e-4 < near) & (near < 3e-4))
    for n, field in free.items():
        point = POSES[n][-n:]
        for x in (MATRICES[n], point):
            made = jax.eval_shape(lambda x, f=field: (f.flow(x), f.tangent(x)), x)
            assert made[0].shape == made[1].shape == x.shape
        # A point has its velocity in place of a frame.
        np.testing.assert_array_equal(field.framed(point), field.tangent(point))
        assert field.defect(point) is None
