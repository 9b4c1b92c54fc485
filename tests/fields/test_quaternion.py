"""QuaternionRotation: what frame and layout mean, lengths, errors."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import cfjax
from cfjax import QuaternionRotation

EPS = 2.0**-52
AXIS = np.array([2.0, -3.0, 6.0]) / 7
Q = np.array([1.0, -3.0, 5.0, 1.0]) / 6
KINDS = [(frame, layout) for frame in ("body", "fixed") for layout in ("wxyz", "xyzw")]


def stored(q, layout):
    """A quaternion whose scalar part comes first, in a layout."""
    return q if layout == "wxyz" else np.roll(q, -1, axis=-1)


def flow(omega, q, frame, layout):
    return QuaternionRotation(omega, frame=frame, layout=layout).flow(q)


# What frame and layout mean


def test_attitude_matrices_move_alike():
    @jax.jit
    def attitudes(omega):
        ends = [
            flow(omega, jnp.asarray(stored(Q, layout)), frame, layout) for frame, layout in KINDS
        ]
        pairs = zip(ends, KINDS, strict=True)
        return ends, [cfjax.quaternion_to_matrix(end, layout=kind[1]) for end, kind in pairs]

    ends, matrices = attitudes(2.5 * AXIS)
    before, turn = Rotation.from_quat(np.roll(Q, -1)), Rotation.from_rotvec(2.5 * AXIS)
    for (frame, _), matrix in zip(KINDS, matrices, strict=True):
        want = before * turn if frame == "body" else turn * before
        # Entries of at most 1, each a sum of a few terms.
        np.testing.assert_allclose(matrix, want.as_matrix(), rtol=0, atol=20 * EPS)
    for first, last in (ends[:2], ends[2:]):
        np.testing.assert_array_equal(stored(first, "xyzw"), last)


def test_each_element_gets_a_frame_of_its_own():
    kinds = dict(zip(("frame", "layout"), KINDS[1], strict=True))
    framed = QuaternionRotation(AXIS[None], **kinds).framed(jnp.asarray(np.tile(Q, (5, 1))))
    assert (framed.frame, framed.layout) == KINDS[1]
    np.testing.assert_array_equal(framed.omega, np.tile(AXIS, (5, 1)))


# Lengths


@jax.jit
@jax.vmap
def back(omega, q):
    """What an increment has more than the flow, its derivative, and the flow."""
    field = QuaternionRotation(omega, frame="fixed", layout="wxyz")
    more = lambda q: field.increment(q) - (field.flow(q) - q)  # noqa: E731
    return more(q), jax.jacfwd(more)(q), field.flow(q)


def test_an_increment_leads_back_to_length_one():
    angles, off = np.array([0.0, 1e-3, 1.0, 5.0, 9.0]), 1e-9
    found, slope, ends = back(np.outer(angles, AXIS), np.tile((1 + off) * Q, (5, 1)))
    # All of it from an angle of 2 pi on, where q is -q.
    part = np.where(angles < 2 * np.pi, 1 - np.cos(angles / 2), 1)
    # Along the turned quaternion: along the old one the length of a fast spin would run away.
    want = -off * part[:, None] * ends
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


def test_wrong_arguments(subtests, no_shape_hook):
    kind = {"frame": "body", "layout": "wxyz"}
    cases = [
        (3, {}, TypeError, "missing 2 required keyword-only arguments: 'frame' and 'layout'"),
        (3, {"frame": "body"}, TypeError, "missing 1 required keyword-only argument: 'layout'"),
        (3, {"layout": "wxyz"}, TypeError, "missing 1 required keyword-only argument: 'frame'"),
        (3, kind | {"frame": "left"}, ValueError, "frame must be 'body' or 'fixed', got 'left'"),
        (3, kind | {"layout": "wxzy"}, ValueError, "layout must be 'wxyz' or .* got 'wxzy'"),
        (3, kind | {"layout": None}, ValueError, "layout must be 'wxyz' or 'xyzw', got None"),
    ]
    text = r"omega must have shape \(3,\) or \(\*batch, 3\), got"
    cases += [(shape, kind, ValueError, text) for shape in [(4,), (3, 1), (), (0,)]]
    for shape, keywords, error, text in cases:
        with subtests.test(shape=str(shape), text=text), pytest.raises(error, match=text):
            QuaternionRotation(np.ones(shape), **keywords)
    for dtype in (np.int32, np.float16, np.complex128):
        with pytest.raises(TypeError, match="omega must be float32 or float64, got"):
            QuaternionRotation(jnp.ones(3, dtype), frame="body", layout="wxyz")


def test_wrong_point(no_shape_hook):
    field = QuaternionRotation(np.ones(3), frame="body", layout="wxyz")
    for name in ("flow", "increment", "tangent"):
        with pytest.raises(ValueError, match=r"acts on shapes \(4,\), got \(3,\)"):
            getattr(field, name)(jnp.ones(3))
        with pytest.raises(ValueError, match=r"axes: omega of shape \(5, 3\), or \(1, 3"):
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
    kinds = iter(["body", "body"] + 20 * ["fixed"])

    def changes(t, q, args):
        return QuaternionRotation(q[..., 1:], frame=next(kinds), layout="wxyz")

    # Many, so that the stages are a loop.
    q = np.broadcast_to(Q, (30, 4))
    with pytest.raises(TypeError, match="must agree in all but arrays"):
        cfjax.integrate(cfjax.LieTerm(changes), cfjax.CF4(), 0.0, 1.0, q, num_steps=1)


def test_a_start_of_another_length_is_refused(subtests):
    term = cfjax.LieTerm(
        lambda t, q, args: QuaternionRotation(q[..., 1:], frame="fixed", layout="wxyz")
    )
    for q, text in [
        (np.zeros((2, 4)), r"y0 must have length 1 \(in y0 @ y0\), and is off by more than 0.1"),
        (np.stack([Q, 1.01 * Q]), "off by more than 0.01"),
        (np.stack([(1 - 1e-7) * Q, Q]), "off by more than 1e-07"),
    ]:
        with subtests.test(text=text), pytest.raises(RuntimeError, match=text):
            cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, q, num_steps=1)
