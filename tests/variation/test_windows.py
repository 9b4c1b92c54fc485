"""Covariance, bias Jacobian and transition matrix of windows of an inertial measurement unit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from problems import arrays, hat
from scipy.spatial.transform import Rotation as SciPyRotation

import cfjax
from cfjax import CF2, InertialMotion, LieTerm, Variation, VariationTerm

Q0 = np.array([0.5, 0.1, -0.7, 0.5])
X0 = np.concatenate([Q0, [0.3, -0.2, 0.5], [1.5, 0.7, -0.4]])
X0[:4] /= np.linalg.norm(Q0)
OTHER = np.concatenate([X0[[1, 0, 3, 2]], [-4.0, 3.0, 0.1], [0.4, -8.0, 2.0]])
GRAVITY = np.array([0.4, -1.1, -9.6])
P0 = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
# Unequal and not diagonal.
GAIN = np.random.default_rng(4).normal(size=(6, 6)) * np.repeat([0.1, 0.4], 3)[:, None]


@pytest.fixture(autouse=True, scope="module")
def as_traced():
    """Most of these programs run once, and compile faster as they are."""
    with cfjax.rewriting(False):
        yield


def imu(omega, force, gravity=GRAVITY, time=1.0):
    return InertialMotion(omega=omega, force=force, gravity=gravity, time=time, layout="wxyz_v_p")


def noise(t, x, args, dw):
    dw = jnp.asarray(GAIN) @ dw
    return imu(dw[:3], dw[3:], gravity=0 * dw[:3], time=0.0)


def matrix_of(omega, force):
    """A of `eta' = A eta`, in which neither the state nor gravity is."""
    a = np.kron(np.eye(3), -hat(omega))
    a[3:6, :3] = -hat(force)
    a[6:, 3:6] = np.eye(3)
    return a


# A window with the attitude R0 exp(alpha e1) exp(beta e3) and a force that is a polynomial.

ALPHA, BETA = Polynomial([0.0, 0.7, 0.4, -0.5]), Polynomial([0.0, -0.9, 0.3, 0.8])
FORCES = [Polynomial([0.3, 1.0, -2.0]), Polynomial([-1.0, 0.5, 1.0]), Polynomial([9.0, -1.0, 0.7])]


def window(t, x, bias):
    def value(p):
        return jnp.polyval(jnp.asarray(p.coef[::-1]), t)

    b, da, db = map(value, (BETA, ALPHA.deriv(), BETA.deriv()))
    omega = jnp.stack([da * jnp.cos(b), -da * jnp.sin(b), db])
    return imu(omega - bias[:3], jnp.stack([value(p) for p in FORCES]) - bias[3:])


NO_BIAS = jnp.zeros(6)
TERM = VariationTerm(LieTerm(window), noise=noise, channels=6, parameters=lambda bias: bias)


def start(x0=X0):
    return arrays(Variation(x0, np.eye(9), P0, np.zeros((9, 6))))


def end(y0, t0=0.0, t1=1.0):
    ys = cfjax.integrate(TERM, CF2(), t0, t1, y0, NO_BIAS, num_steps=100).ys
    return jax.tree.map(lambda x: x[-1], ys)


def attitude(t):
    turns = SciPyRotation.from_rotvec(np.multiply.outer(ALPHA(t), [1.0, 0, 0]))
    return (turns * SciPyRotation.from_rotvec(np.multiply.outer(BETA(t), [0, 0, 1.0]))).as_matrix()


@functools.cache
def nodes(n):
    """Gauss's rule on [0, 1]."""
    x, weights = np.polynomial.legendre.leggauss(n)
    return (1 + x) / 2, weights / 2


def propagator(t, n):
    """The matrix that takes errors in the coordinates of the start from 0 to t, and R there.

    With R the attitude, R times an error of the attitude is constant; R times that of the velocity
    falls by the cross product of the velocity that the force has made with it; R times that of the
    position grows by that of the velocity.
    """
    s, weights = nodes(n)
    forces = np.stack([p(t * s) for p in FORCES], axis=1)
    turned = np.einsum("nij,nj->ni", attitude(t * s), forces)
    velocity, position = t * weights @ turned, t**2 * (weights * (1 - s)) @ turned
    m = np.eye(9)
    m[3:6, :3], m[6:, :3], m[6:, 3:6] = -hat(velocity), -hat(position), t * np.eye(3)
    return m, np.kron(np.eye(3), attitude(t))


@functools.cache
def exact(n=40):
    """Phi, P and the Jacobian by the biases at the end, by Gauss's rule with n nodes."""
    m1, turn1 = propagator(1.0, n)
    phi = turn1.T @ m1
    g = np.zeros((9, 6))
    g[:6] = GAIN
    b = -np.eye(9, 6)
    p, jacobian = phi @ P0 @ phi.T, np.zeros((9, 6))
    for t, weight in zip(*nodes(n), strict=True):
        m, turn = propagator(t, n)
        from_t = turn1.T @ m1 @ np.linalg.inv(m) @ turn
        p += weight * from_t @ g @ (from_t @ g).T
        jacobian += weight * from_t @ b
    return phi, p, jacobian


def test_the_reference_is_exact_to_rounding():
    for found, other in zip(exact(), exact(60), strict=True):
        # Entries of at most 60, sums of 40 and 60.
        np.testing.assert_allclose(found, other, rtol=0, atol=2e-14)
    # The window is not nearly still, nor its covariance nearly diagonal.
    assert np.abs(exact()[0]).max() > 4
    p = exact()[1]
    assert np.abs(p / np.sqrt(np.outer(np.diag(p), np.diag(p))) - np.eye(9)).max() > 0.5


def test_order_and_another_start():
    # 100 and 200 steps by one program.
    one, middle = end(start()), end(start(), t1=0.5)
    errors = []
    for y in (one, end(middle, t0=0.5)):
        found = y.transition, y.covariance, y.sensitivity
        errors.append([np.abs(a - b).max() for a, b in zip(found, exact(), strict=True)])
    slopes = np.log2(np.divide(*errors))
    assert np.all(np.abs(slopes - 2) < 0.1), slopes
    # A window does not depend on its start.
    other = end(start(OTHER))
    assert np.abs(one.state - other.state).max() > 1
    for name in ("transition", "covariance", "sensitivity"):
        a, b = getattr(one, name), getattr(other, name)
        # Ten units of rounding.
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-15 * np.abs(a).max(), err_msg=name)


def test_the_matrix_of_errors_depends_on_the_readings_alone():
    omega, force = np.array([0.4, -0.3, 0.8]), np.array([1.0, 0.5, -0.7])
    term = VariationTerm(LieTerm(lambda t, x, args: imu(omega, force)))

    @jax.jit
    def rate(x0):
        y = Variation(x0, transition=jnp.eye(9))
        return term.vf_prod(0.0, y, None, 1.0).transition

    for x0 in (X0, OTHER):
        # Velocities of 5 and a gravity of 10 cancel.
        np.testing.assert_allclose(rate(x0), matrix_of(omega, force), rtol=0, atol=4e-15)


# Log-density


def test_the_rate_of_a_log_density():
    """The angle falls as -k sin(angle), of weight sin^2(angle/2); velocities by the loss."""
    angle = 1.2
    x0 = np.r_[np.cos(angle / 2), np.sin(angle / 2) * np.array([2.0, -1, 2]) / 3, X0[4:]]

    def drag(t, x, args):
        k, loss = args
        # omega = -k sin(angle) times the axis: 2 w (x, y, z) is sin(angle) times the axis.
        omega = -2 * k * x[0] * x[1:4]
        back = x[:4] * jnp.asarray([1.0, -1, -1, -1])
        force = cfjax.quaternion_rotate(back, -loss * x[4:7] - jnp.asarray(GRAVITY), layout="wxyz")
        return imu(omega, force)

    def rate(args):
        y = Variation(jnp.asarray(x0), log_density=jnp.asarray(0.3))
        return VariationTerm(LieTerm(drag)).vf_prod(0.0, y, args, 1.0).log_density

    args, slope = jnp.asarray([0.8, 0.5]), np.array([1 + 2 * np.cos(angle), 3.0])
    found = jax.jit(jax.value_and_grad(rate))(args)
    # Some ten units of rounding, of velocities and a gravity of 10.
    np.testing.assert_allclose(found[0], args @ slope, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found[1], slope, rtol=0, atol=1e-14)
