"""Motions of extended poses: flows, derivatives, brackets, orders, and what they refuse."""

from dataclasses import replace
from functools import partial
from typing import Any, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import cfjax
from cfjax import ExtendedMotion

EPS = 2.0**-52
ANGLES = np.array([0, 1e-160, 1e-9, 1e-4, 0.5, np.pi / 2, np.pi, 6.28, 2 * np.pi, 3 * np.pi])
AXIS = np.array([2.0, -3.0, 6.0]) / 7
A, V = np.array([0.9, 0.2, -0.6]), np.array([0.4, -1.1, 0.5])
# A direction of all coordinates.
ALONG = np.array([[0.4, 0.2, -0.7], [-0.5, 0.6, 0.3], [0.2, -0.8, 0.1]])
Q = np.array([0.1, -0.5, 0.5, 0.7])
VELOCITY, PLACE = np.array([0.2, 0.7, -0.4]), np.array([1.5, -0.3, 0.8])
VECTOR = np.concatenate([Q, VELOCITY, PLACE])
CASES = [(frame, kind) for frame in ("body", "fixed") for kind in ("vector", "matrix")]
cases = pytest.mark.parametrize(("frame", "kind"), CASES)


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def hat(w):
    x, y, z = w
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def generator(w, a, v):
    x = np.zeros((5, 5))
    x[:3] = np.column_stack([hat(w), a, v])
    return x


def product(w, frame):
    """The matrix of the product of a quaternion with half of w."""
    sign = 1 if frame == "fixed" else -1
    m = np.zeros((4, 4))
    m[0, 1:], m[1:, 0], m[1:, 1:] = -w, w, sign * hat(w)
    return m / 2


def to_matrix(pose):
    w, x, y, z, *rest = pose
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    vectors = [[rest[k], rest[3 + k]] for k in range(3)]
    upper = jnp.array([[*r, *b] for r, b in zip(rotation, vectors, strict=True)])
    return jnp.concatenate([upper, jnp.eye(5, dtype=upper.dtype)[3:]])


MATRIX = np.asarray(to_matrix(VECTOR))
START = {"vector": jnp.asarray(VECTOR), "matrix": jnp.asarray(MATRIX)}


def motion(w, a, v, frame: Any, layout: Any = "wxyz_v_p"):
    return ExtendedMotion(omega=w, a=a, v=v, frame=frame, layout=layout)


def exact(w, frame, kind):
    """The end of the flow, and its derivative along `ALONG`, by SciPy."""
    ends = np.stack(scipy.linalg.expm_frechet(generator(w, A, V), generator(*ALONG)))
    ends = MATRIX @ ends if frame == "body" else ends @ MATRIX
    if kind == "matrix":
        return ends
    turns = scipy.linalg.expm_frechet(product(w, frame), product(ALONG[0], frame))
    return np.stack([np.r_[m @ Q, e[:3, 3], e[:3, 4]] for m, e in zip(turns, ends, strict=True)])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_flow_and_derivatives(dtype):
    weights = {kind: normal(*x.shape, seed=1).astype(dtype) for kind, x in START.items()}
    a, v, *along = (jnp.asarray(x, dtype) for x in (A, V, *ALONG))

    def flow(frame, kind, *coordinates):
        return motion(*coordinates, frame).flow(START[kind].astype(dtype))

    @jax.jit
    @jax.vmap
    def run(w):
        found = []
        for frame, kind in CASES:
            fun = partial(flow, frame, kind)
            end, forward = jax.jvp(fun, (w, a, v), tuple(along))
            slopes = jax.vjp(fun, w, a, v)[1](weights[kind])
            reverse = sum(jnp.sum(x * d) for x, d in zip(slopes, along, strict=True))
            found.append((end, forward, reverse))
        return found

    for (frame, kind), (ends, forwards, reverses) in zip(
        CASES, run((ANGLES[:, None] * AXIS).astype(dtype)), strict=True
    ):
        assert ends.dtype == dtype
        for k, angle in enumerate(ANGLES):
            end, slope = exact(angle * AXIS, frame, kind)
            # The angle is known to a unit of rounding of itself, and so is all that turns with it.
            # Entries are sums of some ten terms of size 2, derivatives of some thirty.
            atol = 10 * np.finfo(dtype).eps * (1 + angle)
            where = f"{frame} {kind} at {angle}"
            np.testing.assert_allclose(ends[k], end, rtol=0, atol=atol, err_msg=where)
            np.testing.assert_allclose(forwards[k], slope, rtol=0, atol=4 * atol, err_msg=where)
            paired = np.sum(np.asarray(weights[kind], float) * slope)
            np.testing.assert_allclose(reverses[k], paired, 0, atol=100 * atol, err_msg=where)


def test_zero_is_the_identity_exactly():
    for frame, kind in CASES:
        x, still = START[kind], motion(*np.zeros((3, 3)), frame)
        no_step = cfjax.combine((0.0,), [motion(AXIS, A, V, frame)])
        for field in (still, no_step):
            np.testing.assert_array_equal(field.flow(x), x)
            np.testing.assert_array_equal(field.increment(x), np.zeros(x.shape))
            np.testing.assert_array_equal(field.tangent(x), np.zeros(x.shape))


@pytest.mark.representatives(2)
@pytest.mark.parametrize("axes", [(), (2, 3)])
@cases
def test_promises(frame, kind, axes):
    """Among them that the tangent is the derivative of the flow, and the sign of the bracket."""
    x = jnp.broadcast_to(START[kind], (*axes, *START[kind].shape))
    fields = [motion(*normal(3, *axes, 3, seed=k), frame) for k in range(3)]
    cfjax.check_field(fields, x)


@pytest.mark.parametrize("frame", ["body", "fixed"])
def test_brackets_are_commutators(frame):
    first, second = (normal(3, 3, seed=k) for k in range(2))
    found = cfjax.bracket(motion(*first, frame), motion(*second, frame))
    a, b = generator(*first), generator(*second)
    expected = a @ b - b @ a if frame == "fixed" else b @ a - a @ b
    found = generator(found.omega, found.a, found.v)
    np.testing.assert_allclose(found, expected, rtol=0, atol=20 * EPS)


@pytest.mark.parametrize("frame", ["body", "fixed"])
def test_dexpinv_is_its_series(frame):
    first, second = (0.3 * normal(3, 3, seed=k) for k in range(2))
    a, b = (motion(*x, frame) for x in (first, second))
    series = cfjax.AbstractAlgebraElement.dexpinv(a, b, 30)
    # Its terms fall by the angle over a full turn, 0.1, from one to the next but one.
    for name in ("omega", "a", "v"):
        got, want = (getattr(x, name) for x in (a.dexpinv(b, 0), series))
        np.testing.assert_allclose(got, want, rtol=0, atol=20 * EPS)
    assert a.has_dexpinv() and not cfjax.combine((50.0,), [a]).has_dexpinv()


def coupled(frame, t, x, args):
    """A field of time and state: of all that there is in the pose."""
    q, velocity, place = x[:4], x[4:7], x[7:]
    w = jnp.sin(velocity + t) + 0.3 * q[1:]
    return motion(w, jnp.cos(place) - 0.2 * velocity, velocity * q[0] + jnp.sin(t), frame)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("frame", ["body", "fixed"])
def test_orders(frame):
    """Two-sided, against RKMK8 in steps whose error is rounding, which agrees with CF4."""
    term = cfjax.LieTerm(partial(coupled, frame))

    @partial(jax.jit, static_argnums=(0, 1))
    def end(solver, n):
        ys = cfjax.integrate(term, solver, 0.0, 1.0, jnp.asarray(VECTOR), num_steps=n).ys
        return ys[-1]

    answer = end(cfjax.RKMK8(), 60)
    for solver, order in [(cfjax.CF4(), 4), (cfjax.RKMK5(), 5), (cfjax.RKMK8(), 8)]:
        ns = (4, 8) if order == 8 else (20, 40)
        errors = [np.max(np.abs(end(solver, n) - answer)) for n in ns]
        # Above rounding. Four steps are few for a slope.
        assert errors[1] > 5e-14
        assert abs(np.log2(errors[0] / errors[1]) - order) < (0.8 if order == 8 else 0.35)


def test_leading_axes_vmap_and_jit():
    x = jnp.stack([jnp.asarray(VECTOR), jnp.asarray(np.roll(VECTOR, 5))])
    x = x / jnp.linalg.norm(x[:, :4], axis=1, keepdims=True)
    arrays = normal(3, 2, 3)
    alone = jnp.stack([motion(*arrays[:, k], "body").flow(x[k]) for k in range(2)])
    for flow in (
        motion(*arrays, "body").flow(x),
        jax.jit(jax.vmap(lambda w, a, v, x: motion(w, a, v, "body").flow(x)))(*arrays, x),
    ):
        np.testing.assert_allclose(flow, alone, rtol=0, atol=20 * EPS)
    # One motion for all of them.
    field = motion(*arrays[:, :1], "body")
    full = motion(*jnp.broadcast_to(arrays[:, :1], (3, 2, 3)), "body")
    np.testing.assert_allclose(field.flow(x), full.flow(x), rtol=0, atol=20 * EPS)


def test_layouts():
    """By hand, with the letters of each part in its place."""
    parts = {"wxyz": Q, "xyzw": np.roll(Q, -1), "v": VELOCITY, "p": PLACE}
    field = motion(AXIS, A, V, "body")
    end = field.flow(START["vector"])
    moved = {"wxyz": end[:4], "xyzw": np.roll(end[:4], -1), "v": end[4:7], "p": end[7:]}
    layouts = get_args(ExtendedMotion.__annotations__["layout"].__args__[0])
    assert len(layouts) == 8
    for layout in layouts:
        names = layout.split("_")
        x, want = (jnp.concatenate([d[name] for name in names]) for d in (parts, moved))
        other = replace(field, layout=layout)
        np.testing.assert_allclose(other.flow(x), want, rtol=0, atol=8 * EPS)
        off, _ = cast(Any, other.defect(x))
        assert off < 4 * EPS


@pytest.mark.representatives(1)
@pytest.mark.parametrize("kind", START)
def test_rewriting_changes_rounding_only(kind):
    term = cfjax.LieTerm(lambda t, x, args: coupled("fixed", t, jnp.ravel(x)[:10], args))

    def end():
        sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, START[kind], num_steps=5)
        return sol.ys[-1]

    ends = []
    for on in (True, False):
        with cfjax.rewriting(on):
            ends.append(jax.jit(lambda: end())())
    np.testing.assert_allclose(*ends, rtol=0, atol=200 * EPS)


# What is refused, at trace time


def extended(frame: Any = "body", layout: Any = "wxyz_v_p", dtype=np.float64, **shapes):
    arrays = {name: jnp.ones(shapes.get(name, (3,)), dtype) for name in ("omega", "a", "v")}
    return ExtendedMotion(**arrays, frame=frame, layout=layout)


@pytest.mark.parametrize(
    ("make", "kind", "text"),
    [
        (lambda: extended("space"), ValueError, 'frame must be "body" or "fixed", got \'space\''),
        (
            lambda: extended(v=(2,)),
            ValueError,
            r"v must have shape \(3,\) or \(\*batch, 3\), got \(2,\)",
        ),
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
            lambda: ExtendedMotion(
                omega=jnp.ones(3), a=jnp.ones(3, np.float32), v=jnp.ones(3), frame="body"
            ),
            TypeError,
            "omega, a and v must have one dtype, got float64 and float32",
        ),
        (
            lambda: extended(dtype=np.int32),
            TypeError,
            "omega must be float32 or float64, got int32",
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
            lambda: extended().flow(jnp.ones((100, 10))),
            ValueError,
            r"give the coordinates leading axes: v of shape \(100, 3\)",
        ),
        (
            lambda: extended().flow(jnp.ones(10, np.float32)),
            TypeError,
            "ExtendedMotion with v in float64 acts on points in float64, got float32",
        ),
        (
            lambda: cfjax.bracket(extended(), extended("fixed")),
            ValueError,
            "two ExtendedMotions: both must have the same frame and layout, got frame='body', "
            "layout='wxyz_v_p' and frame='fixed', layout='wxyz_v_p'",
        ),
        (
            lambda: extended().bracket(cfjax.Rotation(np.ones(3))),
            TypeError,
            "Cannot compute the bracket of ExtendedMotion and Rotation: both must be of one class",
        ),
    ],
)
def test_errors(make, kind, text, no_shape_hook):
    with pytest.raises(kind, match=text):
        make()


def test_starts_off_the_manifold():
    rotation = (
        r"a rotation, of determinant 1, before its last 2 columns and rows \(0, 0, 0, 1, 0\) and "
        r"\(0, 0, 0, 0, 1\)"
    )
    for layout, y0, text in [
        ("wxyz_v_p", MATRIX * np.array([-1, 1, 1, 1, 1])[:, None], rotation),
        ("wxyz_v_p", MATRIX + np.eye(5, k=1) * np.array([0, 0, 0, 1e-3, 0])[:, None], rotation),
        ("wxyz_p_v", VECTOR + 0.1, "a unit quaternion in its first 4 entries"),
        ("p_v_xyzw", VECTOR, "a unit quaternion in its last 4 entries"),
        ("p_xyzw_v", VECTOR, r"a unit quaternion in its entries \[3:7\]"),
    ]:
        term = cfjax.LieTerm(lambda t, y, args, layout=layout: extended(layout=layout))
        with pytest.raises(RuntimeError, match=f"y0 must have {text}"):
            cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, jnp.asarray(y0), num_steps=1)
    for x in START.values():
        off, _ = cast(Any, extended().defect(jnp.asarray(x)))
        assert off < 8 * EPS
