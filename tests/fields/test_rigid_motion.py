"""Rigid motions of space and plane: flows, derivatives, drift, and what they refuse."""

from dataclasses import replace
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import cfjax
from cfjax import PlanarMotion, RigidMotion

EPS = 2.0**-52
ANGLES = np.array([0, 1e-160, 1e-12, 1e-4, 0.1, 1, np.pi, 2 * np.pi, 10, 1e4])
AXIS = np.array([2.0, -3.0, 6.0]) / 7


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def unit(*shape, seed=0):
    x = normal(*shape, seed=seed)
    return x / jnp.linalg.norm(x, axis=-1, keepdims=True)


# Matrices and products as written in books, in NumPy's or JAX's numbers.


def hat(w):
    """The matrix of the angular velocity."""
    if np.ndim(w) == 0:
        return [[0, -w], [w, 0]]
    x, y, z = w
    return [[0, -z, y], [z, 0, -x], [-y, x, 0]]


def screw(w, v):
    return [[*row, b] for row, b in zip(hat(w), v, strict=True)] + [[0] * (len(v) + 1)]


def product(w, frame):
    """The matrix of the product of a unit number with half of w, or with i w in the plane."""
    if np.ndim(w) == 0:
        return hat(w)
    x, y, z = (a / 2 for a in w)
    s = 1 if frame == "fixed" else -1
    return [[0, -x, -y, -z], [x, 0, -s * z, s * y], [y, s * z, 0, -s * x], [z, -s * y, s * x, 0]]


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
# The class by its dimension, the frame, and what is moved.
CASES = [
    (n, frame, kind)
    for n in (3, 2)
    for frame, kinds in {"body": ["array", "matrix"], "fixed": ["array", "matrix", "point"]}.items()
    for kind in kinds
]


def start(n, kind):
    return {"array": POSES[n], "matrix": MATRICES[n], "point": POSES[n][-n:]}[kind]


def motion(w, v, frame):
    if v.shape[-1] == 3:
        return RigidMotion(omega=w, v=v, frame=frame, layout="wxyz_xyz")
    return PlanarMotion(omega=w, v=v, frame=frame, layout="unit_complex_xy")


def coordinates(n):
    """Angular velocities of all angles, a velocity, and directions of both."""
    w = ANGLES[:, None] * AXIS if n == 3 else ANGLES
    direction = np.array([0.4, 0.2, -0.7]), np.array([-0.5, 0.6, 0.3])
    return w, np.array([0.8, -0.4, 0.5])[:n], (direction[0] if n == 3 else 0.7, direction[1][:n])


def exact(generator, generator_along):
    """exp(A + t B) and its two derivatives by t at zero, in 50 digits.

    exp of the matrix with A on the diagonal and B above it has them, the second halved.
    """
    with mpmath.workdps(50):
        a, b = (mpmath.matrix(m) for m in (generator, generator_along))
        n = a.rows
        big = mpmath.zeros(3 * n, 3 * n)
        for k in range(3):
            big[k * n : (k + 1) * n, k * n : (k + 1) * n] = a
            if k:
                big[(k - 1) * n : k * n, k * n : (k + 1) * n] = b
        found = np.array(mpmath.expm(big)[:n, :].tolist(), dtype=np.float64)
    return found.reshape(n, 3, n).swapaxes(0, 1) * np.array([1.0, 1.0, 2.0])[:, None, None]


@pytest.fixture(scope="module")
def expected():
    """Where every start goes, with two derivatives: `[case][angle, order]`."""
    found = {case: [] for case in CASES}
    for n in (3, 2):
        ws, v, (dw, dv) = coordinates(n)
        matrix, pose = np.asarray(MATRICES[n]), np.asarray(POSES[n])
        for w in ws:
            moved = exact(screw(w, v), screw(dw, dv))
            after = {"fixed": moved @ matrix, "body": matrix @ moved}
            for frame, matrices in after.items():
                number = exact(product(w, frame), product(dw, frame)) @ pose[:-n]
                array = np.concatenate([number, matrices[:, :n, n]], axis=1)
                found[n, frame, "matrix"].append(matrices)
                found[n, frame, "array"].append(array)
            found[n, "fixed", "point"].append(moved[:, :n, :n] @ pose[-n:] + moved[:, :n, n])
    return {case: np.stack(rows) for case, rows in found.items()}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("n", [3, 2])
def test_flows(n, dtype, expected):
    ws, v, _ = coordinates(n)
    cases = [case for case in CASES if case[0] == n]
    starts = {case: start(n, case[2]).astype(dtype) for case in cases}

    @jax.jit
    @jax.vmap
    def flows(w):
        return {case: motion(w, v.astype(dtype), case[1]).flow(x) for case, x in starts.items()}

    for case, found in flows(ws.astype(dtype)).items():
        assert found.dtype == dtype
        for angle, got, want in zip(ANGLES, found, expected[case][:, 0], strict=True):
            # The angle is known to a unit of rounding of itself, and so is all that turns with it.
            # Entries are sums of some ten terms of size 2.
            atol = 10 * np.finfo(dtype).eps * (1 + angle)
            np.testing.assert_allclose(got, want, rtol=0, atol=atol, err_msg=f"{case}, {angle}")


@pytest.mark.representatives(1)
@pytest.mark.parametrize(("n", "frame", "kind"), CASES)
def test_two_derivatives(n, frame, kind, expected):
    ws, v, (dw, dv) = coordinates(n)
    x = start(n, kind)
    weights = normal(*x.shape, seed=1)

    def along(t, w):
        return motion(w + t * dw, v + t * dv, frame).flow(x)

    def loss(w, v):
        return jnp.sum(weights * motion(w, v, frame).flow(x))

    def slope(w, v):
        by_w, by_v = jax.grad(loss, argnums=(0, 1))(w, v)
        return jnp.sum(by_w * dw) + jnp.sum(by_v * dv)

    @jax.jit
    @jax.vmap
    def run(w):
        first = lambda t: jax.jvp(partial(along, w=w), (t,), (1.0,))[1]  # noqa: E731
        value, (by_w, by_v) = jax.value_and_grad(slope, argnums=(0, 1))(w, v)
        reverse = value, jnp.sum(by_w * dw) + jnp.sum(by_v * dv)
        return jax.jvp(first, (0.0,), (1.0,)), reverse

    forward, reverse = run(ws)
    for k in range(2):
        wants = expected[n, frame, kind][:, 1 + k]
        for angle, got, want, summed in zip(ANGLES, forward[k], wants, reverse[k], strict=True):
            # Some twenty terms, whose rounding is that of the angle. The second derivative of c_2
            # is a difference of terms that are larger by the square of the angle.
            atol = EPS * (20 * (1 + angle) + k * (20 + angle**2))
            np.testing.assert_allclose(got, want, rtol=0, atol=atol, err_msg=f"{angle}, {k}")
            # Sums of 16 such entries at most, times weights of up to 2.
            np.testing.assert_allclose(summed, np.sum(want * weights), rtol=0, atol=32 * atol)


def test_zero_is_the_identity_exactly():
    zeros = {3: (jnp.zeros(3), jnp.zeros(3)), 2: (jnp.zeros(()), jnp.zeros(2))}

    @jax.jit
    def run(zeros):
        fields = [(start(n, kind), motion(*zeros[n], frame)) for n, frame, kind in CASES]
        return [(x, field.flow(x), field.increment(x), field.tangent(x)) for x, field in fields]

    for x, end, increment, tangent in run(zeros):
        np.testing.assert_array_equal(end, x)
        np.testing.assert_array_equal(increment, np.zeros(x.shape))
        np.testing.assert_array_equal(tangent, np.zeros(x.shape))


@pytest.mark.representatives(2)
@pytest.mark.parametrize("n", [3, 2])
@pytest.mark.parametrize("frame", ["fixed", "body"])
def test_vectors_and_matrices_move_alike_as_functions_of_the_start(n, frame):
    """Derivatives along the manifold, where both say what a pose is."""
    pose = POSES[n]
    w = jnp.asarray(2.5 * AXIS if n == 3 else 2.5)
    field = motion(w, normal(n, seed=1), frame)
    along = np.array(product(normal(3, seed=2) if n == 3 else 0.6, "body")) @ pose[:-n]
    direction = jnp.append(along, normal(n, seed=3))
    ends = [lambda x: to_matrix(field.flow(x)), lambda x: field.flow(to_matrix(x))]
    got, want = jax.jit(lambda: [jax.jvp(end, (pose,), (direction,)) for end in ends])()
    # Some tens of operations on numbers of size 3.
    jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=50 * EPS), got, want)


def test_the_plane_in_space():
    w, v = jnp.asarray(2.5), jnp.array([0.8, -0.4])
    for frame in ("fixed", "body"):
        c, s, *place = POSES[2]
        flat = motion(w, v, frame).flow(POSES[2])
        half = jnp.arctan2(s, c) / 2
        pose = jnp.array([jnp.cos(half), 0, 0, jnp.sin(half), *place, 0.3])
        thick = motion(jnp.array([0, 0, w]), jnp.append(v, 0.0), frame)
        got = to_matrix(thick.flow(pose))[np.ix_([0, 1, 3], [0, 1, 3])]
        np.testing.assert_allclose(got, to_matrix(flat), rtol=0, atol=20 * EPS)


def test_a_quarter_turn():
    """About the third axis, by hand."""
    half, quarter = np.sqrt(0.5), np.pi / 2
    # It looks along the second axis, and stands on the first.
    pose = jnp.array([half, 0, 0, half, 1.0, 0, 0])
    w, v = np.array([0, 0, quarter]), np.array([quarter, 0, 2.0])
    # To its left around the origin; and around (0, 1), whose velocity is zero.
    for frame, want in {"body": [0, 0, 0, 1, 0, 1, 2], "fixed": [0, 0, 0, 1, 1, 2, 2]}.items():
        got = motion(w, v, frame).flow(pose)
        np.testing.assert_allclose(got, want, rtol=0, atol=8 * EPS)
    pose = jnp.array([0, 1.0, 1, 0])
    for frame, want in {"body": [-1, 0, 0, 1], "fixed": [-1, 0, 1, 2]}.items():
        got = motion(quarter, v[:2], frame).flow(pose)
        np.testing.assert_allclose(got, want, rtol=0, atol=8 * EPS)


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
                ends = field.flow(x), field.increment(x), field.tangent(x)
                off, _ = field.defect(x.at[places[0]].add(0.1))
                found[layout, frame] = [end[np.array(places)] for end in ends], off
        return found

    found = run()
    for (layout, frame), (ends, off) in found.items():
        first = "wxyz_xyz" if len(LAYOUTS[layout]) == 7 else "unit_complex_xy"
        # The same operations, which the compiler may join otherwise, on numbers of size 3.
        for got, want in zip(ends, found[first, frame][0], strict=True):
            np.testing.assert_allclose(got, want, rtol=0, atol=10 * EPS)
        # The defect is (q_0 + 0.1)^2 - q_0^2, to rounding.
        want = abs(0.2 * POSES[3 if len(LAYOUTS[layout]) == 7 else 2][0] + 0.01)
        np.testing.assert_allclose(off, want, rtol=0, atol=10 * EPS)


def test_a_pose_of_ros():
    """By hand: a quarter turn about the third axis, at (0, 1, 0)."""
    half = np.sqrt(0.5)
    pose = jnp.array([0, 1.0, 0, 0, 0, half, half])
    field = RigidMotion(omega=np.zeros(3), v=np.eye(3)[0], frame="body", layout="xyz_xyzw")
    # The first axis of the body is the second one of space.
    want = [0, 2, 0, 0, 0, half, half]
    np.testing.assert_allclose(field.flow(pose), want, rtol=0, atol=4 * EPS)
    # The numbers are a pose in jaxlie's layout too, so no check could tell.
    off, _ = cast(Any, replace(field, layout="wxyz_xyz").defect(pose))
    assert off < 4 * EPS


@pytest.mark.representatives(3)
@pytest.mark.parametrize("axes", [(), (2, 3)])
@pytest.mark.parametrize(("n", "frame", "kind"), CASES)
def test_promises(n, frame, kind, axes):
    """Among them the bracket, and that the flows of one field are a group."""
    x = jnp.broadcast_to(start(n, kind), (*axes, *start(n, kind).shape))
    if kind == "array":
        x = jnp.concatenate([unit(*axes, len(POSES[n]) - n), normal(*axes, n)], axis=-1)
    core = (3,) if n == 3 else ()
    fields = [
        motion(normal(*axes, *core, seed=k), normal(*axes, n, seed=10 + k), frame) for k in range(3)
    ]
    cfjax.check_field(fields, x)


@pytest.mark.parametrize("n", [3, 2])
def test_leading_axes_are_broadcast(n):
    core = (3,) if n == 3 else ()
    x = jnp.concatenate([unit(2, 3, len(POSES[n]) - n), normal(2, 3, n)], axis=-1)
    other = motion(normal(2, 3, *core, seed=1), normal(2, 3, n, seed=2), "body")
    given = normal(2, 1, *core), normal(2, 1, n)
    few, many = (
        motion(*(jnp.broadcast_to(a, (2, k, *a.shape[2:])) for a in given), "body") for k in (1, 3)
    )

    @jax.jit
    def run(few, many, other, x):
        alone = [
            [motion(w, v, "body").flow(y) for w, v, y in zip(*rows, strict=True)]
            for rows in zip(many.omega, many.v, x, strict=True)
        ]
        moved = [(field.flow(x), field.bracket(other)) for field in (few, many)]
        return moved, alone

    moved, alone = run(few, many, other, x)
    # The same operations, in another order at most, on numbers of size 3.
    jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=20 * EPS), *moved)
    np.testing.assert_allclose(moved[0][0], alone, rtol=0, atol=20 * EPS)


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


@pytest.mark.parametrize(
    ("make", "kind", "text"),
    [
        (
            lambda: RigidMotion(omega=np.ones(3), v=np.ones(3)),  # pyright: ignore[reportCallIssue]
            TypeError,
            "missing 1 required keyword-only argument: 'frame'",
        ),
        (
            lambda: rigid("space"),
            ValueError,
            'frame must be "body" or "fixed", got \'space\'',
        ),
        (
            lambda: rigid(w=(4,)),
            ValueError,
            r"omega must have shape \(3,\) where v has \(3,\), got",
        ),
        (lambda: rigid(w=(3,), v=(5, 3)), ValueError, r"shape \(5, 3\) where v has \(5, 3\), got"),
        (
            lambda: rigid(v=(2,)),
            ValueError,
            r"v must have shape \(3,\) or \(\*batch, 3\), got \(2,\)",
        ),
        (lambda: rigid(v=()), ValueError, r"v must have shape \(3,\) or \(\*batch, 3\), got \(\)"),
        (lambda: planar(w=(2,)), ValueError, r"omega must have shape \(\) where v has \(2,\), got"),
        (
            lambda: planar(v=(3,)),
            ValueError,
            r"v must have shape \(2,\) or \(\*batch, 2\), got \(3,\)",
        ),
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
    ],
)
def test_errors(make, kind, text, no_shape_hook):
    with pytest.raises(kind, match=text):
        make()


def test_starts_off_the_manifold():
    a_rotation = r"a rotation, of determinant 1, before its last column and row \(0, 0, 0, 1\)"
    for field, y0, text in [
        (rigid(), MATRICES[3].at[0].multiply(-1), a_rotation),
        (planar(), POSES[2].at[0].add(0.1), "a unit complex number in its first 2 entries"),
        (rigid(layout="xyz_wxyz"), POSES[3], "a unit quaternion in its last 4 entries"),
    ]:
        term = cfjax.LieTerm(lambda t, y, args, field=field: field)
        with pytest.raises(RuntimeError, match=f"y0 must have {text}"):
            cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, y0, num_steps=1)
    # Matrices and points need no layout.
    for n, field in {3: rigid(layout=None), 2: planar(layout=None)}.items():
        for x in (MATRICES[n], POSES[n][-n:]):
            field = replace(field, frame="fixed")
            assert field.flow(x).shape == field.tangent(x).shape == x.shape
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
