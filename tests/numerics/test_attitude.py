"""Attitudes as quaternions and as matrices: values, derivatives, and what is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from xla.interpreter import run

import cfjax
from cfjax import quaternion_from_matrix, quaternion_rotate, quaternion_to_matrix

EPS = 2.0**-52
RNG = np.random.default_rng(0)


def normalized(q):
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def about(angles):
    """Rotations about four axes by small and large angles, scalar part first and not negative."""
    axes = normalized(np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, -2, 3]]))
    angles = np.asarray(angles)[:, None, None]
    scalar = np.broadcast_to(np.cos(angles / 2), (len(angles), 4, 1))
    return np.concatenate([scalar, np.sin(angles / 2) * axes], axis=-1).reshape(-1, 4)


RANDOM = normalized(RNG.normal(size=(40, 4)))
RANDOM *= np.sign(RANDOM[:, :1])
# In between each two of the four branches there are ties.
TIES = np.array([[1.0, 1, 1, 1], [1, -1, 1, -1], [1, 1, 0, 0], [1, 0, -1, 0]])
QS = np.concatenate([about([0, 1e-160, 1e-12, 1e-4, 0.1, 2.0, 3.14]), normalized(TIES), RANDOM])
HALF_TURNS = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, 0, -0.8]])


def exact_matrix(q):
    """In many digits, and for the direction of q: its own length is rounded."""
    with mpmath.workdps(50):
        w, x, y, z = map(mpmath.mpf, q)
        n = w * w + x * x + y * y + z * z
        return (
            np.array(
                [
                    [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
                ]
            )
            / n
        )


MATRICES = np.array([exact_matrix(q) for q in QS.tolist()], dtype=float)
# By NumPy, as programs without the checks of what is known.
to_matrix = partial(run, partial(quaternion_to_matrix, layout="wxyz"))
from_matrix = partial(run, partial(quaternion_from_matrix, layout="wxyz"))


def test_matrices_and_back():
    matrices, found = to_matrix(QS), np.asarray(from_matrix(MATRICES))
    # Sums of few products of at most 1, and a length that is rounded.
    np.testing.assert_allclose(matrices, MATRICES, rtol=0, atol=4 * EPS)
    np.testing.assert_array_equal(to_matrix(-QS), matrices)
    # The length of what is divided by is 2 at least, each entry a sum of four that are rounded.
    np.testing.assert_allclose(found, QS, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), np.ones(len(QS)), rtol=0, atol=EPS)
    last = run(partial(quaternion_to_matrix, layout="xyzw"), np.roll(QS[7], -1))
    np.testing.assert_array_equal(last, matrices[7])
    last = run(partial(quaternion_from_matrix, layout="xyzw"), MATRICES[7])
    np.testing.assert_array_equal(last, np.roll(found[7], -1))
    single = from_matrix(MATRICES.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, QS, rtol=0, atol=4 * 2.0**-23)
    # Leading axes.
    q = QS[:6].reshape(2, 3, 4)
    some = to_matrix(q)
    np.testing.assert_array_equal(some.reshape(6, 3, 3), matrices[:6])
    np.testing.assert_allclose(from_matrix(some), q, rtol=0, atol=4 * EPS)


def test_half_turns():
    matrices = np.array([exact_matrix(q) for q in HALF_TURNS.tolist()], dtype=float)
    found = np.asarray(from_matrix(matrices))
    assert np.all(found[:, 0] >= 0)
    sign = np.sign(np.sum(found * HALF_TURNS, axis=-1, keepdims=True))
    np.testing.assert_allclose(found, sign * HALF_TURNS, rtol=0, atol=4 * EPS)
    weights = jnp.array([0.3, -0.2, 0.5, 0.1])
    entry = lambda m: quaternion_from_matrix(m, layout="wxyz") @ weights  # noqa: E731
    slope = run(jax.vmap(jax.grad(entry)), matrices)
    # A one-sided derivative: the row of q q^T that is taken, divided by at least 2.
    assert np.all(np.abs(slope) < 1)


def of_turned(velocity, matrix):
    """The quaternion of a matrix that turns, and its first and second derivative by time."""

    def at(t):
        turned = cfjax.Rotation(t * velocity).flow(matrix)
        return quaternion_from_matrix(turned, layout="wxyz")

    def slope(t):
        return jax.jvp(at, (t,), (jnp.ones_like(t),))

    (value, first), (_, second) = jax.jvp(slope, (0.0,), (1.0,))
    return value, first, second


def test_derivatives_along_rotations():
    v = np.array([0.7, -0.4, 0.2])
    value, first, second = run(jax.vmap(partial(of_turned, jnp.asarray(v))), MATRICES)
    # q' = (0, v) q / 2, and so q'' = -|v|^2 q / 4. Quotients by 2 and 8 at least, of few terms.
    scalar, vector = QS[:, :1], QS[:, 1:]
    product = np.concatenate([-(vector @ v)[:, None], scalar * v + np.cross(v, vector)], axis=-1)
    np.testing.assert_allclose(value, QS, rtol=0, atol=6 * EPS)
    np.testing.assert_allclose(first, product / 2, rtol=0, atol=10 * EPS)
    np.testing.assert_allclose(second, -(v @ v) * QS / 4, rtol=0, atol=20 * EPS)


def test_rotate():
    x = jnp.asarray(RNG.normal(size=(len(QS), 3)))
    for layout in ("wxyz", "xyzw"):
        q = jnp.asarray(QS if layout == "wxyz" else np.roll(QS, -1, axis=-1))
        rotate = partial(run, partial(quaternion_rotate, layout=layout))
        for a, b in [(q, x), (q[3:4], x), (q, x[5:6])]:
            matrices = MATRICES if len(a) > 1 else MATRICES[3:4]
            want = np.sum(matrices * np.asarray(b)[:, None, :], axis=-1)
            # Few terms of size three.
            np.testing.assert_allclose(rotate(a, b), want, rtol=0, atol=30 * EPS)


# Lengths other than 1, as solvers of linear spaces make them


def test_the_length_of_a_quaternion_does_not_count():
    lengths = np.repeat([0.96, 1 - 1e-3, 1 + 1e-3, 1.04], len(QS))[:, None]
    want = np.concatenate([MATRICES] * 4)
    for dtype in (np.float32, np.float64):
        eps, q = np.finfo(dtype).eps, (lengths * np.concatenate([QS] * 4)).astype(dtype)
        rotate = partial(quaternion_rotate, layout="wxyz")
        turned = run(rotate, q, np.ones((len(q), 3), dtype))
        # The entries of q are rounded, and then as in the tests of those of length 1.
        np.testing.assert_allclose(to_matrix(q), want, rtol=0, atol=6 * eps)
        np.testing.assert_allclose(turned, want.sum(axis=-1), rtol=0, atol=12 * eps)
        # So lengths of vectors stay: 3 here.
        squares = np.sum(np.asarray(turned) ** 2, axis=-1)
        np.testing.assert_allclose(squares, 3, rtol=0, atol=20 * eps)


def test_the_derivative_along_a_quaternion_is_zero_and_that_across_is_of_its_direction():
    """By the matrix, by the rotation, and by the matrix of the direction."""
    q = jnp.asarray(1.001 * RANDOM[0])
    x, weights = jnp.asarray(RNG.normal(size=3)), jnp.asarray(RNG.normal(size=3))
    matrix = partial(quaternion_to_matrix, layout="wxyz")

    def derivatives(q, x):
        functions = (
            lambda q, x: weights @ (matrix(q / jnp.linalg.norm(q)) @ x),
            lambda q, x: weights @ (matrix(q) @ x),
            lambda q, x: weights @ quaternion_rotate(q, x, layout="wxyz"),
        )
        gradients = [jax.grad(f, argnums=(0, 1))(q, x) for f in functions]
        return gradients, jax.jvp(matrix, (q,), (q,))[1]

    (expected, *others), along = run(derivatives, q, x)
    for found in others:
        for a, b in zip(found, expected, strict=True):
            # Some 40 products of numbers below 3.
            np.testing.assert_allclose(a, b, rtol=0, atol=100 * EPS)
        assert abs(found[0] @ q) < 100 * EPS
    for a, b in zip(*others, strict=True):
        # One polynomial in two ways.
        np.testing.assert_allclose(a, b, rtol=0, atol=40 * EPS)
    assert np.abs(expected[0]).max() > 0.1
    np.testing.assert_allclose(along, np.zeros((3, 3)), rtol=0, atol=20 * EPS)


def test_a_quaternion_of_quite_another_length_is_no_attitude(subtests):
    text = r"q must have length 1, and is off by more than 0.1 in q @ q\. Divide it"
    for length in (0.0, 0.94, 1.06, 30.0, np.nan):
        q = jnp.asarray(length * RANDOM[:2])
        with subtests.test(length=str(length)):
            with pytest.raises(RuntimeError, match=text):
                quaternion_to_matrix(q, layout="wxyz")
            with pytest.raises(RuntimeError, match=text):
                quaternion_rotate(q, jnp.ones((2, 3)), layout="wxyz")
            assert np.isnan(to_matrix(q)).any(axis=(1, 2)).all()


def spiral(rewrite, rate):
    """A quaternion whose length grows at this rate while it turns, and a vector that it moves."""

    def field(t, y, rate):
        q = y["q"]
        grows = rate * q + jnp.stack([-q[1], q[0], -q[3], q[2]]) / 2
        return {"q": grows, "x": quaternion_rotate(q, jnp.array([0.0, 1.0, 0.0]), layout="wxyz")}

    y0 = {"q": jnp.asarray([1.0, 0.0, 0.0, 0.0]), "x": jnp.zeros(3)}
    with cfjax.rewriting(rewrite):
        term, rate = cfjax.LieTerm(field), jnp.asarray(rate)
        return cfjax.integrate(term, cfjax.CF4(), 0.0, 2.0, y0, rate, num_steps=50).ys


@pytest.mark.representatives(1)
@pytest.mark.parametrize("rewrite", [True, False])
def test_an_attitude_that_a_solver_of_linear_spaces_lets_drift(rewrite):
    """In a step that is rewritten as in one that is not."""
    ys = spiral(rewrite, 0.01)
    assert np.linalg.norm(ys["q"][-1]) == pytest.approx(np.exp(0.02), rel=1e-8)
    # The vector turns about the first axis with angular velocity 1. The error is h^4 / 120 at most.
    np.testing.assert_allclose(ys["x"][-1], [0, np.sin(2.0), 1 - np.cos(2.0)], rtol=0, atol=1e-7)
    with pytest.raises(RuntimeError, match="Nonfinite"):
        jax.block_until_ready(spiral(rewrite, 0.1))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("rewrite", [True, False])
def test_a_wrong_matrix_within_a_field(rewrite):
    """It gives NaN, which ends a solve."""

    def vector_field(t, y, matrix):
        return cfjax.Rotation(quaternion_from_matrix(matrix, layout="wxyz")[1:] + y)

    def end(matrix):
        given = cfjax.LieTerm(vector_field), cfjax.CF2(), 0.0, 1.0, jnp.array([0.0, 0.6, 0.8])
        with cfjax.rewriting(rewrite):
            return cfjax.integrate(*given, matrix, num_steps=20).ys

    assert np.isfinite(end(jnp.asarray(MATRICES[0]))).all()
    with pytest.raises(RuntimeError, match="Nonfinite"):
        jax.block_until_ready(end(2 * jnp.asarray(MATRICES[0])))


# What is refused


def test_matrices_that_are_no_rotations():
    far = MATRICES[:2].copy()
    far[1, 0] *= 1 + 1e-6
    near = MATRICES[:2].copy()
    near[1, 0] *= 1 + 4e-7
    assert np.abs(from_matrix(near) - QS[:2]).max() < 1e-6
    for bad, message in (
        (far, r"matrix must be orthogonal, .* off by more than 1e-06"),
        (-MATRICES[:2], r"matrix must be a rotation, .* of determinant -1"),
        (0 * MATRICES[:2], "matrix must be orthogonal"),
        (np.nan * MATRICES[:2], "matrix must be orthogonal"),
    ):
        with pytest.raises(RuntimeError, match=message):
            quaternion_from_matrix(jnp.asarray(bad), layout="wxyz")
        # Nothing is wrong with the first matrix of `far`.
        assert np.isnan(from_matrix(bad)).all(axis=1).tolist() == [bad is not far, True]
    # The way out that the message names.
    u, _, vh = jnp.linalg.svd(jnp.asarray(far))
    # It is as far from the rotation as the matrix is.
    np.testing.assert_allclose(from_matrix(u @ vh), QS[:2], rtol=0, atol=1e-6)


def test_wrong_shapes_types_and_layouts(no_shape_hook, subtests):
    q, x, m, five = np.array([1.0, 0, 0, 0]), np.ones(3), np.eye(3), np.ones((5, 3))
    plain = quaternion_to_matrix, quaternion_from_matrix, quaternion_rotate
    to, of, rotate = (partial(f, layout="wxyz") for f in plain)
    fit = "must agree or be 1, got q"
    values = [
        (lambda: to(x), r"q must have shape \(4,\) or \(\*batch, 4\), got \(3,\)"),
        (lambda: rotate(q, q), r"x must have shape \(3,\) or \(\*batch, 3\), got \(4,\)"),
        (lambda: of(x), r"matrix must have shape \(3, 3\) or .* got \(3,\)"),
        (lambda: rotate(q, five), rf"{fit} \(4,\) and x \(5, 3\)"),
        (lambda: rotate(np.stack([q, q]), five), rf"{fit} \(2, 4\) and x \(5, 3\)"),
    ]
    types = [
        (lambda: to(q + 0j), "q must be float32 or float64, got complex128"),
        (lambda: of(m.astype(int)), "matrix must be float32 or float64, got int64"),
        (lambda: rotate(q, np.float32(x)), "x must have the dtype of q, float64, got float32"),
    ]
    for f, given in zip(plain, ((q,), (m,), (q, x)), strict=True):
        types.append((lambda f=f, given=given: f(*given), "'layout'"))
        text = "layout must be 'wxyz' or 'xyzw', got 'zyxw'"
        values.append((lambda f=f, given=given: f(*given, layout="zyxw"), text))
    for error, cases in ((ValueError, values), (TypeError, types)):
        for call, text in cases:
            with subtests.test(case=text), pytest.raises(error, match=text):
                call()
