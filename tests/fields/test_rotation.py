"""Rotation: the flow, its derivatives at every angle, the bracket, and what it refuses."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg

import cfjax
from cfjax import Rotation

EPS = 2.0**-52
SMALL = [0, 1e-160, 1e-12, 1e-4, 0.1, 1]
ANGLES = np.array([*SMALL, np.pi - 1e-9, np.pi, np.pi + 1e-9, 6, 2 * np.pi, 10, 50, 100, 1e4])
AXIS = np.array([2.0, -3.0, 6.0]) / 7
OMEGAS = ANGLES[:, None] * AXIS
POINT = np.array([0.3, -1.1, 0.7])


def hat(w):
    x, y, z = w
    return [[0, -z, y], [z, 0, -x], [-y, x, 0]]


def exact(w, digits=60):
    """exp(hat(w)) and the left derivative of exp, from closed forms in many digits.

    dexp = I + (1 - cos)/angle^2 hat + (angle - sin)/angle^3 hat^2. The digits are enough for the
    cancellation in both at the smallest angle used.
    """
    with mpmath.workdps(digits):
        a = mpmath.matrix(hat([mpmath.mpf(x) for x in w]))
        angle = mpmath.sqrt(sum(mpmath.mpf(x) ** 2 for x in w))
        eye = mpmath.eye(3)
        if angle == 0:
            return eye, eye
        c2 = 2 * (mpmath.sin(angle / 2) / angle) ** 2
        flow = eye + mpmath.sin(angle) / angle * a + c2 * a * a
        return flow, eye + c2 * a + (angle - mpmath.sin(angle)) / angle**3 * a * a


def to_numpy(m):
    return np.array(m.tolist(), dtype=np.float64).reshape(m.rows, m.cols)


def jacobian(w, p, digits=60):
    """d/dw of exp(hat(w)) p: a change `d` moves the end point y by dexp(d) x y."""
    with mpmath.workdps(digits):
        flow, dexp = exact(w, digits)
        y = flow * mpmath.matrix(p)
        return -mpmath.matrix(hat(y)) * dexp


def hessian(w, p):
    """The derivative of `jacobian` by central differences in 120 digits: an error of 1e-40."""
    with mpmath.workdps(120):
        h = mpmath.mpf(10) ** -20
        slices = []
        for k in range(3):
            ends = [[mpmath.mpf(x) + s * h * (i == k) for i, x in enumerate(w)] for s in (1, -1)]
            right, left = (jacobian(end, p, 120) for end in ends)
            slices.append(to_numpy((right - left) / (2 * h)))
    return np.stack(slices, axis=-1)


@jax.jit
def flow(omega, point):
    return Rotation(omega).flow(point)


flows = jax.jit(jax.vmap(flow, in_axes=(0, None)))


def test_flow_against_the_closed_form():
    got = flows(OMEGAS, POINT)
    for angle, w, y in zip(ANGLES, OMEGAS, got, strict=True):
        want = np.ravel(to_numpy(exact(w, 400)[0] * mpmath.matrix(POINT)))
        # The angle is known to a unit of rounding of itself, and the formula adds a few units.
        np.testing.assert_allclose(y, want, rtol=0, atol=4 * EPS * (1 + angle), err_msg=str(angle))


def test_flow_against_scipy():
    for angle, w, y in zip(ANGLES, OMEGAS, flows(OMEGAS, POINT), strict=True):
        # scipy scales and squares: a unit of rounding for every unit of the norm, times its steps.
        want = scipy.linalg.expm(np.array(hat(w))) @ POINT
        np.testing.assert_allclose(y, want, rtol=0, atol=40 * EPS * (1 + angle))


def test_flow_in_float32():
    eps = 2.0**-23
    got = flows(OMEGAS.astype(np.float32), POINT.astype(np.float32))
    assert got.dtype == np.float32
    for w, y in zip(OMEGAS.astype(np.float32), got, strict=True):
        # The reference gets the rounded inputs, so the angle's rounding counts once.
        angle = float(np.linalg.norm(w.astype(float)))
        point = mpmath.matrix(POINT.astype(np.float32).tolist())
        want = np.ravel(to_numpy(exact(w.tolist(), 200)[0] * point))
        np.testing.assert_allclose(y, want, rtol=0, atol=4 * eps * (1 + angle))


def test_zero_is_the_identity_exactly():
    np.testing.assert_array_equal(flow(np.zeros(3), POINT), POINT)


@pytest.mark.parametrize("shape", [(3,), (3, 1), (3, 3), (3, 5)])
def test_columns_inverse_group_and_orthogonality(shape):
    rng = np.random.default_rng(0)
    x = rng.normal(size=shape)
    x /= np.linalg.norm(x, axis=0)
    w = 2.5 * AXIS
    y = flow(w, x)
    assert y.shape == shape
    # Entries of at most 1, angles of at most 5: a dozen units of rounding.
    atol = 12 * EPS
    want = to_numpy(exact(w)[0]) @ x
    np.testing.assert_allclose(y, want, rtol=0, atol=atol)
    np.testing.assert_allclose(flow(-w, y), x, rtol=0, atol=atol)
    np.testing.assert_allclose(flow(0.3 * w, flow(0.7 * w, x)), y, rtol=0, atol=atol)
    np.testing.assert_allclose(flow(w, y), flow(2 * w, x), rtol=0, atol=atol)
    np.testing.assert_allclose(y.T @ y, x.T @ x, rtol=0, atol=atol)
    if shape == (3, 3):
        attitude = flow(w, np.eye(3))
        np.testing.assert_allclose(attitude.T @ attitude, np.eye(3), rtol=0, atol=atol)
        assert np.linalg.det(attitude) == pytest.approx(1, abs=atol)


@jax.jit
@jax.vmap
def first_derivatives(omega):
    forward = jax.jacfwd(flow, argnums=(0, 1))(omega, POINT)
    return forward, jax.jacrev(flow, argnums=(0, 1))(omega, POINT)


@pytest.mark.parametrize("which", ["forward", "reverse"])
def test_gradients(which):
    by_omega, by_point = first_derivatives(OMEGAS)[which == "reverse"]
    for angle, w, a, b in zip(ANGLES, OMEGAS, by_omega, by_point, strict=True):
        # Each entry is a sum of terms of at most |w|^2 c_n with the errors of the flow itself.
        atol = 10 * EPS * (1 + angle)
        np.testing.assert_allclose(a, to_numpy(jacobian(w, POINT, 400)), rtol=0, atol=atol)
        np.testing.assert_allclose(b, to_numpy(exact(w, 400)[0]), rtol=0, atol=atol)


def test_gradient_against_finite_differences():
    # The third derivative of the flow is at most |p| = 1.4, so h = 1e-5 leaves h^2/6 * 1.4 = 2e-11
    # of truncation, and rounding adds eps (1 + angle) / h = 2e-10 at angle 6.
    w, h = 6 * AXIS, 1e-5
    got = jax.jacfwd(flow)(w, POINT)
    steps = h * np.eye(3)
    want = (flows(w + steps, POINT) - flows(w - steps, POINT)).T / (2 * h)
    np.testing.assert_allclose(got, want, rtol=0, atol=5e-10)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("mode", ["forward over reverse", "reverse over reverse"])
def test_second_derivatives(mode):
    outer = jax.jacfwd if mode == "forward over reverse" else jax.jacrev
    angles = [0.0, 1e-8, 1.0, np.pi, 2 * np.pi, 50.0]
    omegas = np.outer(angles, AXIS)
    got = jax.jit(jax.vmap(outer(jax.jacrev(lambda w: flow(w, POINT)))))(omegas)
    for angle, w, second in zip(angles, omegas, got, strict=True):
        np.testing.assert_allclose(second, hessian(w, POINT), rtol=0, atol=30 * EPS * (1 + angle))
    # At zero the term of second order of the series, symmetrised.
    e = np.eye(3)
    twice = np.cross(e[:, None], np.cross(e, POINT)[None])
    want = (twice + twice.transpose(1, 0, 2)) / 2
    np.testing.assert_allclose(got[0], want.transpose(2, 0, 1), rtol=0, atol=4 * EPS)


def test_mixed_second_derivative():
    # d/dp d/dw of q . exp(w) p, as the jvp of a gradient, is linear in p: it is the gradient at dp.
    q, dp = np.array([0.4, 0.2, -0.9]), np.array([-0.5, 1.0, 0.25])
    gradient = jax.grad(lambda w, p: jnp.vdot(q, flow(w, p)))
    for w in (np.zeros(3), 4 * AXIS):
        mixed = jax.jvp(lambda p, w=w: gradient(w, p), (POINT,), (dp,))[1]
        want = to_numpy(jacobian(w, dp.tolist())).T @ q
        np.testing.assert_allclose(mixed, want, rtol=0, atol=50 * EPS)


def test_tangent_is_the_velocity_of_the_flow():
    for x in (POINT, np.linspace(-1, 1, 15).reshape(3, 5)):
        x = jnp.asarray(x)
        field = Rotation(3 * AXIS)
        velocity = jax.jvp(lambda t, x=x: flow(t * 3 * AXIS, x), (0.0,), (1.0,))[1]
        want = np.array(hat(3 * AXIS)) @ x
        np.testing.assert_allclose(field.tangent(x), want, rtol=0, atol=8 * EPS)
        np.testing.assert_allclose(velocity, want, rtol=0, atol=8 * EPS)


def test_bracket():
    rng = np.random.default_rng(1)
    a, b, c = (Rotation(w) for w in rng.normal(size=(3, 3)))
    x = jnp.asarray(POINT)
    # For y = exp(u) p with u' = v - [u, v]/2 + .. the bracket is the commutator of the fields.
    commutator = (
        jax.jvp(a.tangent, (x,), (b.tangent(x),))[1] - jax.jvp(b.tangent, (x,), (a.tangent(x),))[1]
    )
    np.testing.assert_allclose(a.bracket(b).tangent(x), commutator, rtol=0, atol=20 * EPS)
    matrix = np.array(hat(a.omega)) @ hat(b.omega) - np.array(hat(b.omega)) @ hat(a.omega)
    np.testing.assert_allclose(hat(a.bracket(b).omega), matrix, rtol=0, atol=20 * EPS)
    np.testing.assert_array_equal(a.bracket(b).omega, -b.bracket(a).omega)
    jacobi = [p.bracket(q.bracket(r)).omega for p, q, r in [(a, b, c), (b, c, a), (c, a, b)]]
    np.testing.assert_allclose(sum(jacobi), np.zeros(3), rtol=0, atol=40 * EPS)


@pytest.mark.parametrize("omega", [np.ones(4), np.ones((3, 1)), np.ones(()), np.ones((0,))])
def test_wrong_shape(omega):
    with pytest.raises(ValueError, match=r"omega must have shape \(3,\) or \(\*batch, 3\), got"):
        Rotation(omega)


@pytest.mark.parametrize("dtype", [np.int32, np.float16, jnp.bfloat16, np.complex128, np.bool_])
def test_wrong_dtype(dtype):
    with pytest.raises(TypeError, match="omega must be float32 or float64, got"):
        Rotation(jnp.ones(3, dtype))


@pytest.mark.parametrize("shape", [(), (2,), (4,), (2, 3)])
def test_wrong_point(shape):
    # The text comes from the class, or from the check of its annotation in this test run.
    field = Rotation(np.ones(3))
    for method in (field.flow, field.increment, field.mean, field.tangent):
        with pytest.raises((TypeError, ValueError), match="Rotation"):
            method(jnp.ones(shape))


def test_bracket_with_another_class():
    text = "Cannot compute the bracket of Rotation and LeftMatrix: both must be of one class"
    with pytest.raises(TypeError, match=text):
        Rotation(np.ones(3)).bracket(cfjax.LeftMatrix(np.eye(3)))


def test_tangent_names_the_shapes():
    with pytest.raises(ValueError, match=r"\(3,\) and \(3, k\), got \(3, 2, 2\)"):
        Rotation(np.ones(3)).tangent(jnp.ones((3, 2, 2)))
