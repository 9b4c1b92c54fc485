"""QuaternionRotation: the flow and its derivatives, what frame and layout mean, lengths, errors."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg

import cfjax
from cfjax import QuaternionRotation

EPS = 2.0**-52
ANGLES = np.array([0, 1e-160, 1e-12, 1e-4, 0.1, 1, np.pi, 2 * np.pi, 4 * np.pi, 10, 1e4])
AXIS = np.array([2.0, -3.0, 6.0]) / 7
OMEGAS = ANGLES[:, None] * AXIS
Q = np.array([1.0, -3.0, 5.0, 1.0]) / 6
KINDS = [(frame, layout) for frame in ("body", "fixed") for layout in ("wxyz", "xyzw")]


def hamilton(p, q):
    """The product of quaternions whose scalar part comes first, by i j = k and so on."""
    product = np.zeros(4)
    table = [[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]]
    signs = [[1, 1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1]]
    for i in range(4):
        for j in range(4):
            product[table[i][j]] += signs[i][j] * p[i] * q[j]
    return product


def generators(frame, layout):
    """The matrices of q -> (0, e) q / 2, or q (0, e) / 2, for the three unit vectors e."""
    one = np.eye(4)
    sides = (lambda e, q: hamilton(e, q)) if frame == "fixed" else (lambda e, q: hamilton(q, e))
    place = [0, 1, 2, 3] if layout == "wxyz" else [1, 2, 3, 0]
    matrices = [np.stack([sides(e, q) / 2 for q in one], axis=1) for e in one[1:]]
    return np.stack([m[place][:, place] for m in matrices])


def exact(omega, a, digits=400):
    """exp(A) for A = omega . a, and its derivatives by omega, from A^2 = -angle^2 / 4."""
    with mpmath.workdps(digits):
        w = [mpmath.mpf(float(x)) if isinstance(x, np.floating) else mpmath.mpf(x) for x in omega]
        a = [mpmath.matrix(m.tolist()) for m in a]
        angle = mpmath.sqrt(sum(x * x for x in w))
        total = sum((x * m for x, m in zip(w, a, strict=True)), mpmath.zeros(4))
        if angle == 0:
            return mpmath.eye(4), a
        c, s = mpmath.cos(angle / 2), mpmath.sin(angle / 2)
        flow = c * mpmath.eye(4) + (2 * s / angle) * total
        slopes = [
            (x / angle) * (-s / 2 * mpmath.eye(4) + (c / angle - 2 * s / angle**2) * total)
            + (2 * s / angle) * m
            for x, m in zip(w, a, strict=True)
        ]
        return flow, slopes


def to_numpy(m):
    return np.array(m.tolist(), dtype=np.float64).reshape(m.rows, m.cols)


def jacobian(omega, a, q, digits=400):
    with mpmath.workdps(digits):
        columns = [m * mpmath.matrix(q.tolist()) for m in exact(omega, a, digits)[1]]
        return mpmath.matrix([[column[i] for column in columns] for i in range(4)])


def hessian(omega, a, q):
    """The derivative of `jacobian` by central differences in 120 digits: an error of 1e-40."""
    with mpmath.workdps(120):
        h = mpmath.mpf(10) ** -20
        slices = []
        for k in range(3):
            ends = [
                [mpmath.mpf(x) + s * h * (i == k) for i, x in enumerate(omega.tolist())]
                for s in (1, -1)
            ]
            right, left = (jacobian(end, a, q, 120) for end in ends)
            slices.append(to_numpy((right - left) / (2 * h)))
    return np.stack(slices, axis=-1)


def stored(q, layout):
    """A quaternion whose scalar part comes first, in a layout."""
    return q if layout == "wxyz" else np.roll(q, -1, axis=-1)


def flow(omega, q, frame, layout):
    return QuaternionRotation(omega, frame=frame, layout=layout).flow(q)


@jax.jit
def flows(omegas, q):
    return [
        jax.vmap(partial(flow, frame=frame, layout=layout), in_axes=(0, None))(omegas, q)
        for frame, layout in KINDS
    ]


def test_flow_against_the_closed_form():
    for (frame, layout), ends in zip(KINDS, flows(OMEGAS, Q), strict=True):
        a = generators(frame, layout)
        for angle, omega, y in zip(ANGLES, OMEGAS, ends, strict=True):
            want = to_numpy(exact(omega, a)[0]) @ Q
            # Half the angle is known to a unit of rounding of itself; the formula adds a few.
            np.testing.assert_allclose(y, want, rtol=0, atol=4 * EPS * (1 + angle / 2))


def test_flow_in_float32():
    omegas, q = OMEGAS.astype(np.float32), Q.astype(np.float32)
    for (frame, layout), ends in zip(KINDS, flows(omegas, q), strict=True):
        assert ends.dtype == np.float32
        a = generators(frame, layout)
        for omega, y in zip(omegas, ends, strict=True):
            angle = float(np.linalg.norm(omega.astype(float)))
            # The reference gets the rounded inputs, so the angle's rounding counts once.
            want = to_numpy(exact(omega, a)[0]) @ q.astype(float)
            np.testing.assert_allclose(y, want, rtol=0, atol=4 * 2.0**-23 * (1 + angle / 2))


def test_flow_against_scipy():
    for (frame, layout), ends in zip(KINDS, flows(OMEGAS, Q), strict=True):
        matrices = np.tensordot(OMEGAS, generators(frame, layout), 1)
        for angle, matrix, y in zip(ANGLES, matrices, ends, strict=True):
            # scipy scales and squares: a unit of rounding for every unit of the norm, and more.
            atol = 40 * EPS * (1 + angle)
            np.testing.assert_allclose(y, scipy.linalg.expm(matrix) @ Q, rtol=0, atol=atol)


@jax.jit
@jax.vmap
def first_derivatives(omega):
    ends = partial(flow, frame="fixed", layout="wxyz"), partial(flow, frame="body", layout="xyzw")
    modes = jax.jacfwd, jax.jacrev
    return [mode(end, argnums=(0, 1))(omega, Q) for mode, end in zip(modes, ends, strict=True)]


def test_first_derivatives():
    found = first_derivatives(OMEGAS)
    for kind, (by_omega, by_point) in zip([KINDS[2], KINDS[1]], found, strict=True):
        a = generators(*kind)
        for angle, omega, v, w in zip(ANGLES, OMEGAS, by_omega, by_point, strict=True):
            # Each entry is a sum of few terms of at most size one, with the errors of the flow.
            atol = 10 * EPS * (1 + angle / 2)
            np.testing.assert_allclose(v, to_numpy(jacobian(omega, a, Q)), rtol=0, atol=atol)
            np.testing.assert_allclose(w, to_numpy(exact(omega, a)[0]), rtol=0, atol=atol)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
def test_second_derivatives(outer):
    angles = np.array([0.0, 1e-8, 1.0, np.pi, 2 * np.pi, 50.0])
    omegas = np.outer(angles, AXIS)
    end = partial(flow, q=jnp.asarray(Q), frame="body", layout="wxyz")
    found = jax.jit(jax.vmap(outer(jax.jacrev(end))))(omegas)
    a = generators("body", "wxyz")
    for angle, omega, second in zip(angles, omegas, found, strict=True):
        # As for the first, with some more terms.
        atol = 30 * EPS * (1 + angle / 2)
        np.testing.assert_allclose(second, hessian(omega, a, Q), rtol=0, atol=atol)
    # At zero the term of second order of the series.
    want = -np.einsum("i,jk->ijk", Q, np.eye(3)) / 4
    np.testing.assert_allclose(found[0], want, rtol=0, atol=4 * EPS)


def test_the_zero_field_is_the_identity_exactly():
    for ends in flows(OMEGAS, Q):
        np.testing.assert_array_equal(ends[0], Q)
    field = QuaternionRotation(np.zeros(3), frame="body", layout="wxyz")
    np.testing.assert_array_equal(field.increment(jnp.asarray(Q)), np.zeros(4))
    np.testing.assert_array_equal(field.tangent(jnp.asarray(Q)), np.zeros(4))


# What frame and layout mean


def hat(w):
    x, y, z = w
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@jax.jit
def attitudes(omega):
    """An end in each way of storing it, as a matrix, and back from there; and as matrices move."""
    found = []
    for frame, layout in KINDS:
        q = jnp.asarray(stored(Q, layout))
        end = flow(omega, q, frame, layout)
        before, after = (cfjax.quaternion_to_matrix(p, layout=layout) for p in (q, end))
        a = jnp.cross(jnp.eye(3), omega[None])
        along = cfjax.Rotation(omega) if frame == "fixed" else cfjax.RightMatrix(a)
        back = cfjax.quaternion_from_matrix(after, layout=layout)
        found.append((end, back, after, along.flow(before)))
    return found


def test_attitude_matrices_move_alike():
    found = attitudes(2.5 * AXIS)
    for (_, layout), (end, back, after, alike) in zip(KINDS, found, strict=True):
        # Entries of at most 1, each a sum of a few terms.
        np.testing.assert_allclose(after, alike, rtol=0, atol=20 * EPS)
        sign = np.sign(end[0 if layout == "wxyz" else 3])
        np.testing.assert_allclose(back, sign * end, rtol=0, atol=10 * EPS)
    (body, *_), (body_last, *_), (fixed, *_), (fixed_last, *_) = found
    np.testing.assert_array_equal(stored(body, "xyzw"), body_last)
    np.testing.assert_array_equal(stored(fixed, "xyzw"), fixed_last)
    assert np.abs(body - fixed).max() > 0.1


def test_group():
    w = 2.5 * AXIS
    for k, frame in enumerate(("body", "fixed")):
        # The program of the other tests.
        move = lambda w, q, k=k: flows(np.tile(w, (len(OMEGAS), 1)), q)[2 * k][0]  # noqa: E731
        end = move(w, Q)
        full_turn_less = w * (1 - 2 * np.pi / 2.5)
        # A dozen units of rounding of numbers of at most 1.
        for same in (move(0.3 * w, move(0.7 * w, Q)), -move(full_turn_less, Q)):
            np.testing.assert_allclose(same, end, rtol=0, atol=12 * EPS, err_msg=frame)
        np.testing.assert_allclose(move(-w, end), Q, rtol=0, atol=12 * EPS, err_msg=frame)


@pytest.mark.parametrize("frame", ["body", "fixed"])
def test_bracket(frame):
    rng = np.random.default_rng(0)
    v, w = rng.normal(size=(2, 3))
    make = partial(QuaternionRotation, frame=frame, layout="xyzw")
    found = make(v).bracket(make(w))
    assert (found.frame, found.layout) == (frame, "xyzw")
    a, b, c = (np.tensordot(x, generators(frame, "xyzw"), 1) for x in (v, w, found.omega))
    # Linear fields, so DX_a X_b - DX_b X_a is a product of matrices; sums of few terms.
    np.testing.assert_allclose(c, a @ b - b @ a, rtol=0, atol=10 * EPS)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("frame", "layout", "batch"),
    [
        pytest.param("body", "wxyz", (), marks=pytest.mark.slow),
        ("fixed", "xyzw", ()),
        ("body", "wxyz", (2, 3)),
    ],
)
def test_fields_keep_their_promises(frame, layout, batch):
    rng = np.random.default_rng(1)
    q = rng.normal(size=(*batch, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    omegas = rng.normal(size=(3, *batch, 3))
    fields = [QuaternionRotation(omega, frame=frame, layout=layout) for omega in omegas]
    cfjax.check_field(fields, q)


# Leading axes


NAMES = ("flow", "increment", "tangent")


@jax.jit
def on_axes(omega, q):
    field = QuaternionRotation(omega, frame="body", layout="wxyz")
    other = QuaternionRotation(q[..., 1:], frame="body", layout="wxyz")
    return field.bracket(other).omega, *(getattr(field, name)(q) for name in NAMES)


def test_leading_axes():
    rng = np.random.default_rng(2)
    q = jnp.asarray(rng.normal(size=(3, 4, 4)))
    for sides in [(3, 4), (1, 4), (3, 1)]:
        omega = np.asarray(rng.normal(size=(*sides, 3)))
        bracket, *found = on_axes(omega, q)
        full = np.broadcast_to(omega, (3, 4, 3))
        # The same operations in another order, on numbers of size one.
        np.testing.assert_allclose(bracket, np.cross(q[..., 1:], full), rtol=0, atol=8 * EPS)
        for all_of_them, alone in zip(found, on_axes(full[2, 1], q[2, 1])[1:], strict=True):
            np.testing.assert_allclose(all_of_them[2, 1], alone, rtol=0, atol=20 * EPS)


@pytest.mark.slow
def test_every_element_moves_as_it_does_alone():
    q = jnp.asarray(np.random.default_rng(3).normal(size=(3, 4)))
    q /= jnp.linalg.norm(q, axis=-1, keepdims=True)

    def field(t, q, args):
        return QuaternionRotation(jnp.sin(2 * q[..., 1:] + t), frame="fixed", layout="wxyz")

    def end(q):
        term = cfjax.LieTerm(field)
        return cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, q, num_steps=10).ys[-1]

    # Some roundings in each of ten steps.
    np.testing.assert_allclose(end(q)[1], end(q[1]), rtol=0, atol=1e-14)


# Lengths


@jax.jit
@jax.vmap
def back(omega, q):
    """What an increment has more than the flow, and its derivative."""

    def more(q):
        field = QuaternionRotation(omega, frame="fixed", layout="wxyz")
        return field.increment(q) - (field.flow(q) - q)

    return more(q), jax.jacfwd(more)(q)


def test_an_increment_leads_back_to_length_one():
    angles, off = np.array([0.0, 1e-3, 1.0, 5.0, 9.0]), 1e-9
    found, slope = back(np.outer(angles, AXIS), np.tile((1 + off) * Q, (5, 1)))
    # All of it from an angle of 2 pi on, where q is -q.
    part = np.where(angles < 2 * np.pi, 1 - np.cos(angles / 2), 1)
    ends = [to_numpy(exact(x * AXIS, generators("fixed", "wxyz"))[0]) @ Q for x in angles]
    # Along the turned quaternion: along the old one the length of a fast spin would run away.
    want = -off * part[:, None] * np.stack(ends)
    # Squares of `off`, and roundings.
    np.testing.assert_allclose(found, want, rtol=0, atol=4 * EPS)
    np.testing.assert_array_less(np.abs(slope), 2 * off + 4 * EPS)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("h", [0.01, 1.0])
def test_the_length_is_kept_over_many_steps(h, dtype):
    omega = jnp.asarray([0.3, 0.7, 1.1], dtype)

    def field(t, q, args):
        return QuaternionRotation(omega * jnp.sin(3 * q[1:] + t), frame="body", layout="wxyz")

    n = 100_000
    term, q = cfjax.LieTerm(field), jnp.asarray(Q, dtype)
    ys = cfjax.integrate(term, cfjax.CF4(), 0.0, n * h, q, num_steps=n, save_every=n // 100).ys
    length = np.linalg.norm(np.asarray(ys, np.longdouble), axis=-1)
    # Without the way back 1e-13 and 1e-4 add up in steps of 1. A flow by an angle a adds a unit of
    # rounding of a / 2 by chance, and takes off a^2 / 8 of what there is: so a unit is left over.
    np.testing.assert_allclose(length, np.ones(100), rtol=0, atol=4 * float(jnp.finfo(dtype).eps))


# Within steps


def test_a_step_with_a_check_of_its_quaternion_is_taken_apart(rewritten):
    def field(t, y, args):
        down = cfjax.quaternion_rotate(y["q"], jnp.array([0.0, 0.0, -1.0]), layout="wxyz")
        rotation = QuaternionRotation(y["m"], frame="body", layout="wxyz")
        return {"q": rotation, "m": cfjax.quaternion_to_matrix(y["q"], layout="wxyz") @ down}

    def end(y0):
        term = cfjax.LieTerm(field)
        return cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=2).ys

    program = str(jax.make_jaxpr(end)({"q": jnp.asarray(Q), "m": jnp.zeros(3)}))
    assert "cfjax_step" in program


# What is refused


@pytest.mark.parametrize(
    ("kinds", "text"),
    [
        ({}, "missing 2 required keyword-only arguments: 'frame' and 'layout'"),
        ({"frame": "body"}, "missing 1 required keyword-only argument: 'layout'"),
        ({"layout": "wxyz"}, "missing 1 required keyword-only argument: 'frame'"),
    ],
)
def test_frame_and_order_have_no_default(kinds, text, no_shape_hook):
    with pytest.raises(TypeError, match=text):
        QuaternionRotation(np.ones(3), **kinds)


@pytest.mark.parametrize(
    ("frame", "layout", "text"),
    [
        ("left", "wxyz", "frame must be 'body' or 'fixed', got 'left'"),
        ("body", "wxzy", "layout must be 'wxyz' or 'xyzw', got 'wxzy'"),
        ("body", None, "layout must be 'wxyz' or 'xyzw', got None"),
    ],
)
def test_wrong_frame_and_order(frame, layout, text, no_shape_hook):
    with pytest.raises(ValueError, match=text):
        QuaternionRotation(np.ones(3), frame=frame, layout=layout)


@pytest.mark.parametrize("shape", [(4,), (3, 1), (), (0,)])
def test_wrong_shape(shape):
    with pytest.raises(ValueError, match=r"omega must have shape \(3,\) or \(\*batch, 3\), got"):
        QuaternionRotation(np.ones(shape), frame="body", layout="wxyz")


@pytest.mark.parametrize("dtype", [np.int32, np.float16, np.complex128])
def test_wrong_dtype(dtype):
    with pytest.raises(TypeError, match="omega must be float32 or float64, got"):
        QuaternionRotation(jnp.ones(3, dtype), frame="body", layout="wxyz")


def test_wrong_point(no_shape_hook):
    field = QuaternionRotation(np.ones(3), frame="body", layout="wxyz")
    for name in ("flow", "increment", "tangent"):
        with pytest.raises(ValueError, match=r"acts on shapes \(4,\), got \(3,\)"):
            getattr(field, name)(jnp.ones(3))
        with pytest.raises(
            ValueError,
            match=r"axes: omega of shape \(5, 3\), or \(1, 3",
        ):
            getattr(field, name)(jnp.ones((5, 4)))
        with pytest.raises(TypeError, match="acts on real arrays, got complex128"):
            getattr(field, name)(jnp.ones(4, complex))


def test_kinds_are_not_mixed():
    fields = [QuaternionRotation(np.ones(3), frame=f, layout=o) for f, o in KINDS]
    text = "must agree in all but arrays, got QuaternionRotation.*'body'.* and Quaternion.*'fixed'"
    with pytest.raises(TypeError, match=text):
        cfjax.combine((1.0, 1.0), (fields[0], fields[2]))
    with pytest.raises(TypeError, match=r"got .*layout='wxyz'\) and .*layout='xyzw'\)"):
        cfjax.combine((1.0, 1.0), (fields[0], fields[1]))
    terms = diffrax.MultiTerm(*(cfjax.LieTerm(lambda t, y, a, f=f: f) for f in fields[:2]))
    with pytest.raises(TypeError, match="must agree in all but arrays"):
        cfjax.integrate(terms, cfjax.CF4(), 0.0, 1.0, Q, num_steps=1)
    for other in (fields[1], fields[2], cfjax.Rotation(np.ones(3))):
        with pytest.raises(
            TypeError, match="must be a QuaternionRotation of the same frame and layout"
        ):
            cfjax.bracket(fields[0], other)


def test_a_field_that_changes_its_frame_is_refused():
    kinds = iter(["body", "body"] + 20 * ["fixed"])

    def changes(t, q, args):
        return QuaternionRotation(q[..., 1:], frame=next(kinds), layout="wxyz")

    # Many, so that the stages are a loop.
    q = np.broadcast_to(Q, (30, 4))
    with pytest.raises(TypeError, match="must agree in all but arrays"):
        cfjax.integrate(cfjax.LieTerm(changes), cfjax.CF4(), 0.0, 1.0, q, num_steps=1)


def along(t, q, args):
    return QuaternionRotation(q[..., 1:], frame="fixed", layout="wxyz")


@pytest.mark.parametrize(
    ("q", "text"),
    [
        (np.zeros((2, 4)), r"y0 must have length 1 \(in y0 @ y0\), and is off by more than 0.1"),
        (np.stack([Q, 1.01 * Q]), "off by more than 0.01"),
        (np.stack([(1 - 1e-7) * Q, Q]), "off by more than 1e-07"),
    ],
)
def test_a_start_of_another_length_is_refused(q, text):
    with pytest.raises(RuntimeError, match=text):
        cfjax.integrate(cfjax.LieTerm(along), cfjax.CF4(), 0.0, 1.0, q, num_steps=1)
