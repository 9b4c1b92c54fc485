"""Attitudes as quaternions and as matrices: values, derivatives, and what is refused."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

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
to_matrix = eqx.filter_jit(partial(quaternion_to_matrix, layout="wxyz"))
from_matrix = eqx.filter_jit(partial(quaternion_from_matrix, layout="wxyz"))


def test_matrices():
    # Sums of few products of at most 1, and a length that is rounded.
    np.testing.assert_allclose(to_matrix(QS), MATRICES, rtol=0, atol=4 * EPS)
    np.testing.assert_array_equal(to_matrix(-QS), to_matrix(QS))
    last = quaternion_to_matrix(jnp.asarray(np.roll(QS[7], -1)), layout="xyzw")
    np.testing.assert_array_equal(last, to_matrix(QS)[7])


def test_from_matrices():
    found = np.asarray(from_matrix(MATRICES))
    # The length of what is divided by is 2 at least, each entry a sum of four that are rounded.
    np.testing.assert_allclose(found, QS, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), np.ones(len(QS)), rtol=0, atol=EPS)
    last = quaternion_from_matrix(jnp.asarray(MATRICES[7]), layout="xyzw")
    np.testing.assert_array_equal(last, np.roll(found[7], -1))


def test_from_matrices_in_float32():
    found = from_matrix(MATRICES.astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, QS, rtol=0, atol=4 * 2.0**-23)


def test_half_turns():
    matrices = np.array([exact_matrix(q) for q in HALF_TURNS.tolist()], dtype=float)
    found = np.asarray(from_matrix(matrices))
    assert np.all(found[:, 0] >= 0)
    sign = np.sign(np.sum(found * HALF_TURNS, axis=-1, keepdims=True))
    np.testing.assert_allclose(found, sign * HALF_TURNS, rtol=0, atol=4 * EPS)
    weights = jnp.array([0.3, -0.2, 0.5, 0.1])
    slope = jax.jit(jax.vmap(jax.grad(lambda m: from_matrix(m) @ weights)))(matrices)
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
    value, first, second = jax.jit(jax.vmap(partial(of_turned, jnp.asarray(v))))(MATRICES)
    # q' = (0, v) q / 2, and so q'' = -|v|^2 q / 4. Quotients by 2 and 8 at least, of few terms.
    scalar, vector = QS[:, :1], QS[:, 1:]
    product = np.concatenate([-(vector @ v)[:, None], scalar * v + np.cross(v, vector)], axis=-1)
    np.testing.assert_allclose(value, QS, rtol=0, atol=6 * EPS)
    np.testing.assert_allclose(first, product / 2, rtol=0, atol=10 * EPS)
    np.testing.assert_allclose(second, -(v @ v) * QS / 4, rtol=0, atol=20 * EPS)


def test_gradients_of_all_three():
    q, x = jnp.asarray(RANDOM[0]), jnp.asarray(RNG.normal(size=3))
    weights = jnp.asarray(RNG.normal(size=3))

    def by_matrix(q, x):
        return weights @ (quaternion_to_matrix(q, layout="wxyz") @ x)

    def by_rotate(q, x):
        return weights @ quaternion_rotate(q, x, layout="wxyz")

    @jax.jit
    def gradients(q, x):
        return [jax.grad(f, argnums=(0, 1))(q, x) for f in (by_matrix, by_rotate)]

    ones, others = gradients(q, x)
    # One polynomial in two ways.
    for a, b in zip(ones, others, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=40 * EPS)


@pytest.mark.parametrize("layout", ["wxyz", "xyzw"])
def test_rotate(layout):
    q = jnp.asarray(QS if layout == "wxyz" else np.roll(QS, -1, axis=-1))
    x = jnp.asarray(RNG.normal(size=(len(QS), 3)))
    rotate = jax.jit(partial(quaternion_rotate, layout=layout))
    # Few terms of size three.
    for a, b in [(q, x), (q[3:4], x), (q, x[5:6])]:
        matrices = MATRICES if len(a) > 1 else MATRICES[3:4]
        want = np.sum(matrices * np.asarray(b)[:, None, :], axis=-1)
        np.testing.assert_allclose(rotate(a, b), want, rtol=0, atol=30 * EPS)


def test_leading_axes():
    q = jnp.asarray(QS[:6]).reshape(2, 3, 4)
    matrices = to_matrix(q)
    assert matrices.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(matrices.reshape(6, 3, 3), to_matrix(QS)[:6])
    np.testing.assert_allclose(from_matrix(matrices), q, rtol=0, atol=4 * EPS)


# Lengths other than 1, as solvers of linear spaces make them


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("length", [0.96, 1 - 1e-3, 1 + 1e-3, 1.04])
def test_the_length_of_a_quaternion_does_not_count(dtype, length):
    eps = np.finfo(dtype).eps
    q, x = (length * QS).astype(dtype), np.ones((len(QS), 3), dtype)
    matrices, turned = to_matrix(q), quaternion_rotate(jnp.asarray(q), x, layout="wxyz")
    # The entries of q are rounded, and then as in the tests of those of length 1.
    np.testing.assert_allclose(matrices, MATRICES, rtol=0, atol=6 * eps)
    np.testing.assert_allclose(turned, MATRICES.sum(axis=-1), rtol=0, atol=12 * eps)
    # So lengths of vectors stay: 3 here.
    np.testing.assert_allclose(np.sum(np.asarray(turned) ** 2, axis=-1), 3, rtol=0, atol=20 * eps)


def test_the_derivative_along_a_quaternion_is_zero_and_that_across_is_of_its_direction():
    q = jnp.asarray(1.001 * RANDOM[0])
    x, weights = jnp.asarray(RNG.normal(size=3)), jnp.asarray(RNG.normal(size=3))

    def fun(q):
        return weights @ quaternion_rotate(q, x, layout="wxyz")

    def of_direction(q):
        return weights @ (quaternion_to_matrix(q / jnp.linalg.norm(q), layout="wxyz") @ x)

    found, expected = jax.grad(fun)(q), jax.grad(of_direction)(q)
    # Some 40 products of numbers below 3.
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * EPS)
    assert abs(found @ q) < 100 * EPS
    assert np.abs(found).max() > 0.1
    matrices = jax.jvp(partial(quaternion_to_matrix, layout="wxyz"), (q,), (q,))[1]
    np.testing.assert_allclose(matrices, np.zeros((3, 3)), rtol=0, atol=20 * EPS)


@pytest.mark.parametrize("length", [0.0, 0.94, 1.06, 30.0, np.nan])
def test_a_quaternion_of_quite_another_length_is_no_attitude(length):
    text = r"q must have length 1, and is off by more than 0.1 in q @ q\. Divide it"
    q = jnp.asarray(length * RANDOM[:2])
    with pytest.raises(RuntimeError, match=text):
        quaternion_to_matrix(q, layout="wxyz")
    with pytest.raises(RuntimeError, match=text):
        quaternion_rotate(q, jnp.ones((2, 3)), layout="wxyz")
    assert np.isnan(to_matrix(q)).any(axis=(1, 2)).all()


def spiral(rewrite, rate):
    """A quaternion whose length grows at this rate while it turns, and a vector that it moves."""

    def field(t, y, args):
        q = y["q"]
        grows = rate * q + jnp.stack([-q[1], q[0], -q[3], q[2]]) / 2
        return {"q": grows, "x": quaternion_rotate(q, jnp.array([0.0, 1.0, 0.0]), layout="wxyz")}

    y0 = {"q": jnp.asarray([1.0, 0.0, 0.0, 0.0]), "x": jnp.zeros(3)}
    with cfjax.rewriting(rewrite):
        return cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0.0, 2.0, y0, num_steps=50).ys


@pytest.mark.parametrize("rewrite", [True, False])
def test_an_attitude_that_a_solver_of_linear_spaces_lets_drift(rewrite):
    """In a step that is rewritten as in one that is not."""
    ys = spiral(rewrite, 0.01)
    assert np.linalg.norm(ys["q"][-1]) == pytest.approx(np.exp(0.02), rel=1e-8)
    # The vector turns about the first axis with angular velocity 1. The error is h^4 / 120 at most.
    np.testing.assert_allclose(ys["x"][-1], [0, np.sin(2.0), 1 - np.cos(2.0)], rtol=0, atol=1e-7)
    with pytest.raises(RuntimeError, match="Nonfinite"):
        jax.block_until_ready(spiral(rewrite, 0.1))


@pytest.mark.parametrize("rewrite", [True, False])
def test_a_wrong_matrix_within_a_field(rewrite):
    """It gives NaN, which ends a solve."""

    def vector_field(t, y, matrix):
        return cfjax.Rotation(quaternion_from_matrix(matrix, layout="wxyz")[1:] + y)

    def end(matrix):
        with cfjax.rewriting(rewrite):
            return cfjax.integrate(
                cfjax.LieTerm(vector_field),
                cfjax.CF4(),
                0.0,
                1.0,
                jnp.array([0.0, 0.6, 0.8]),
                matrix,
                num_steps=20,
            ).ys

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


def test_wrong_shapes_types_and_layouts(no_shape_hook):
    q, x, m = np.array([1.0, 0, 0, 0]), np.ones(3), np.eye(3)
    with pytest.raises(ValueError, match=r"q must have shape \(4,\) or \(\*batch, 4\), got \(3,\)"):
        quaternion_to_matrix(x, layout="wxyz")
    with pytest.raises(ValueError, match=r"x must have shape \(3,\) or \(\*batch, 3\), got \(4,\)"):
        quaternion_rotate(q, q, layout="wxyz")
    with pytest.raises(ValueError, match=r"matrix must have shape \(3, 3\) or .* got \(3,\)"):
        quaternion_from_matrix(x, layout="wxyz")
    with pytest.raises(ValueError, match=r"must agree or be 1, got q \(4,\) and x \(5, 3\)"):
        quaternion_rotate(q, np.ones((5, 3)), layout="wxyz")
    with pytest.raises(ValueError, match=r"must agree or be 1, got q \(2, 4\) and x \(5, 3\)"):
        quaternion_rotate(np.stack([q, q]), np.ones((5, 3)), layout="wxyz")
    with pytest.raises(TypeError, match="q must be float32 or float64, got complex128"):
        quaternion_to_matrix(q + 0j, layout="wxyz")
    with pytest.raises(TypeError, match="matrix must be float32 or float64, got int64"):
        quaternion_from_matrix(m.astype(int), layout="wxyz")
    with pytest.raises(TypeError, match="x must have the dtype of q, float64, got float32"):
        quaternion_rotate(q, x.astype(np.float32), layout="wxyz")
    functions = [quaternion_to_matrix, quaternion_from_matrix, partial(quaternion_rotate, x=x)]
    for function, argument in zip(functions, (q, m, q), strict=True):
        with pytest.raises(TypeError, match="'layout'"):
            function(argument)
        with pytest.raises(ValueError, match="layout must be 'wxyz' or 'xyzw', got 'zyxw'"):
            function(argument, layout="zyxw")
