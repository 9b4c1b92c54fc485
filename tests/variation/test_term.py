"""Variations of solutions against exact answers: closed forms, or derivatives of other programs."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.integrate
import scipy.linalg

import cfjax
from cfjax import (
    CF4,
    RKMK8,
    LieTerm,
    PlanarMotion,
    QuaternionRotation,
    RigidMotion,
    Rotation,
    Variation,
    VariationTerm,
    algebra_basis,
)

Q0 = np.array([0.5, 0.1, -0.7, 0.5])
Q0 /= np.linalg.norm(Q0)
POSE = np.concatenate([Q0, [0.3, -0.2, 0.5]])
TWIST = np.array([0.4, -0.3, 0.8, 1.0, 0.5, -0.7])
INERTIA = np.array([1.0, 2.0, 3.5])


@pytest.fixture(autouse=True, scope="module")
def as_traced():
    """Most of these programs run once, and compile faster as they are."""
    with cfjax.rewriting(False):
        yield


def end(term, solver, y0, args=None, t1=1.0, num_steps=20, t0=0.0) -> Any:
    ys = cfjax.integrate(term, solver, t0, t1, y0, args, num_steps=num_steps).ys
    return jax.tree.map(lambda x: x[-1], ys)


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def adjoint(twist):
    """The matrix of the commutator of se(3), in the order omega, v."""
    w, v = hat(twist[:3]), hat(twist[3:])
    return np.block([[w, np.zeros((3, 3))], [v, w]])


def van_loan(a, q, p0, time):
    """Phi and P of `P' = A P + P A^T + Q`, by the block exponential."""
    n = len(a)
    block = scipy.linalg.expm(time * np.block([[-a, q], [np.zeros((n, n)), a.T]]))
    phi = block[n:, n:].T
    return phi, phi @ p0 @ phi.T + phi @ block[:n, n:]


def twist_field(frame):
    def field(t, y, args):
        return RigidMotion(omega=args[:3], v=args[3:], frame=frame, layout="wxyz_xyz")

    return field


def twist_noise(g, frame):
    def noise(t, y, args, dw):
        return twist_field(frame)(t, y, g @ dw)

    return noise


def attitude(t, q, args):
    """A field that depends on time, state and parameters, in the frame of the body."""
    omega = args["rate"] + jnp.stack([jnp.sin(t), jnp.cos(2 * t), t]) + args["gain"] * q[1:]
    return QuaternionRotation(omega, frame="body", layout="wxyz")


ARGS = {"rate": jnp.asarray([0.3, -0.5, 0.8]), "gain": jnp.asarray(0.7)}
# Unequal and not diagonal, which isotropic noise would hide.
GAIN = np.array([[0.3, 0.1], [-0.2, 0.2], [0.05, 0.4]])


def shaking(t, q, args, dw):
    return QuaternionRotation(jnp.asarray(GAIN) @ dw, frame="body", layout="wxyz")


def attitude_term(**kwargs):
    return VariationTerm(
        LieTerm(attitude),
        noise=shaking,
        channels=2,
        parameters=lambda a: (a["rate"], a["gain"]),
        **kwargs,
    )


def attitude_start(term=None, **kwargs):
    carried = dict(
        transition=True, covariance=jnp.diag(jnp.asarray([0.1, 0.2, 0.3])), sensitivity=True
    )
    return (term or attitude_term()).start(
        0.0, Q0, ARGS, **(kwargs or {**carried, "log_density": 0.5})
    )


def moved(q, eta):
    return QuaternionRotation(eta, frame="body", layout="wxyz").flow(q)


def coordinates_of(q, dq):
    """The coordinates in the body's frame of velocities dq at q, column by column."""
    frame = np.asarray(jax.jacfwd(lambda eta: moved(q, eta))(jnp.zeros(3)))
    return np.linalg.lstsq(frame, np.asarray(dq), rcond=None)[0]


@pytest.fixture(scope="module")
def derivatives():
    """Phi and S of the attitude by differentiating an accurate solve."""

    def solve(eta, args):
        return end(LieTerm(attitude), RKMK8(), moved(jnp.asarray(Q0), eta), args, 2.0, 20)

    q = solve(jnp.zeros(3), ARGS)
    by_eta, by_args = jax.jit(jax.jacfwd(solve, (0, 1)))(jnp.zeros(3), ARGS)
    by_theta = np.concatenate([by_args["rate"], by_args["gain"][:, None]], axis=1)
    return q, coordinates_of(q, by_eta), coordinates_of(q, by_theta)


# Exact answers


@pytest.mark.representatives(2)
@pytest.mark.parametrize("frame", ["body", "fixed"])
@pytest.mark.parametrize("solver, steps, tol", [(RKMK8(), 20, 1e-13), (CF4(), 40, 2e-6)])
def test_constant_twist(frame, solver, steps, tol):
    g = np.random.default_rng(3).normal(size=(6, 2))
    p0 = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    term = VariationTerm(
        LieTerm(twist_field(frame)), noise=twist_noise(jnp.asarray(g), frame), channels=2
    )
    y0 = term.start(0.0, POSE, jnp.asarray(TWIST), transition=True, covariance=p0)
    found = end(term, solver, y0, jnp.asarray(TWIST), 2.0, steps)
    a = -adjoint(TWIST) if frame == "body" else adjoint(TWIST)
    phi, p = van_loan(a, g @ g.T, p0, 2.0)
    np.testing.assert_allclose(found.transition, phi, atol=tol * np.abs(phi).max())
    np.testing.assert_allclose(found.covariance, p, atol=tol * np.abs(p).max())


def test_definite_is_exact_for_a_constant_twist():
    g = np.random.default_rng(3).normal(size=(6, 2))
    term = VariationTerm(
        LieTerm(twist_field("body")),
        noise=twist_noise(jnp.asarray(g), "body"),
        channels=2,
        definite=True,
    )
    y0 = term.start(0.0, POSE, jnp.asarray(TWIST), transition=True, covariance=np.zeros((6, 6)))
    found = end(term, CF4(), y0, jnp.asarray(TWIST), 2.0, 1)
    phi, p = van_loan(-adjoint(TWIST), g @ g.T, np.zeros((6, 6)), 2.0)
    np.testing.assert_allclose(found.transition, phi, atol=1e-13)
    np.testing.assert_allclose(found.covariance, p, atol=1e-13 * np.abs(p).max())


def test_transition_of_a_symmetric_top():
    """R(t) = R0 exp(t L / I1) exp(t (1 - I3/I1) w3 e3), with L in the frame of the body."""
    i1, i3 = 2.0, 3.1

    def field(t, y, args):
        w = y["w"]
        torque_free = jnp.stack([(i1 - i3) * w[1] * w[2], (i3 - i1) * w[2] * w[0], 0 * w[0]]) / i1
        return {"q": QuaternionRotation(w, frame="body", layout="wxyz"), "w": torque_free}

    def exact(q, w, t):
        momentum = jnp.stack([i1 * w[0], i1 * w[1], i3 * w[2]])
        rate = (1 - i3 / i1) * w[2]
        q = moved(moved(q, t * momentum / i1), t * rate * jnp.eye(3)[2])
        turn = jnp.asarray(t) * rate
        # w turns about e3, against the second factor.
        c, s = jnp.cos(turn), jnp.sin(turn)
        return q, jnp.stack([c * w[0] + s * w[1], -s * w[0] + c * w[1], w[2]])

    q0, w0, t = jnp.asarray(Q0), jnp.asarray([0.7, -0.4, 1.1]), 3.0
    term = VariationTerm(LieTerm(field))
    y0 = term.start(0.0, {"q": q0, "w": w0}, transition=True)
    found = end(term, RKMK8(), y0, None, t, 30)
    q1, w1 = exact(q0, w0, t)
    np.testing.assert_allclose(found.state["q"], q1, atol=1e-10)
    np.testing.assert_allclose(found.state["w"], w1, atol=1e-10)
    dq, dw = jax.jacfwd(lambda x: exact(moved(q0, x[:3]), w0 + x[3:], t))(jnp.zeros(6))
    expected = np.concatenate([coordinates_of(q1, dq), dw])
    np.testing.assert_allclose(found.transition, expected, atol=1e-9)
    assert np.abs(expected).max() > 2


def test_isotropic_noise_of_an_attitude_stays_isotropic():
    def noise(t, q, args, dw):
        return QuaternionRotation(0.2 * dw, frame="body", layout="wxyz")

    def field(t, q, args):
        return QuaternionRotation(
            jnp.stack([jnp.sin(t), jnp.cos(2 * t), t]), frame="body", layout="wxyz"
        )

    term = VariationTerm(LieTerm(field), noise=noise, channels=3)
    found = end(term, CF4(), term.start(0.0, Q0, covariance=np.zeros((3, 3))), t1=2.0)
    np.testing.assert_allclose(found.covariance, 0.04 * 2.0 * np.eye(3), atol=1e-15)


def plane(t, y, args):
    speed, turn = args
    return PlanarMotion(
        omega=turn, v=jnp.stack([speed, 0 * speed]), frame="body", layout="unit_complex_xy"
    )


def plane_noise(t, y, args, dw):
    return PlanarMotion(
        omega=0.3 * dw[0],
        v=jnp.stack([0.1 * dw[1], 0.2 * dw[0]]),
        frame="body",
        layout="unit_complex_xy",
    )


def test_moments_of_a_vehicle_in_the_plane():
    """The covariance of the position that the linearised moments have, by a block exponential.

    Second moments of the pose matrix X in `X' = X (K + noise)`: those of `X kron X`; their
    derivative by the strength of the noise, at zero.
    """
    speed, turn, t = 1.3, 0.9, 2.0
    k = np.array([[0, -turn, speed], [turn, 0, 0], [0, 0, 0]])
    g = np.zeros((2, 3, 3))
    g[0] = [[0, -0.3, 0], [0.3, 0, 0.2], [0, 0, 0]]
    g[1] = [[0, 0, 0.1], [0, 0, 0], [0, 0, 0]]
    # Of X less its mean, E[dX kron dX]: rows of X multiply from the left.
    eye = np.eye(3)
    drift = np.kron(k, eye) + np.kron(eye, k)
    source = sum(np.kron(x, x) for x in g)
    block = np.block([[drift, source], [np.zeros((9, 9)), drift]])
    second = scipy.linalg.expm(t * block)[:9, 9:]  # of X0 = 1
    # dX = X1 hat(eta), so hat(eta) = X1^-1 dX.
    x1 = scipy.linalg.expm(t * k)
    inverse = np.linalg.inv(x1)
    moments = (np.kron(inverse, inverse) @ second).reshape(3, 3, 3, 3)  # [i, k, j, l]
    place = [(1, 0), (0, 2), (1, 2)]
    expected = np.array([[moments[i, m, j, n] for m, n in place] for i, j in place])
    args = (jnp.asarray(speed), jnp.asarray(turn))
    term = VariationTerm(LieTerm(plane), noise=plane_noise, channels=2)
    y0 = term.start(0.0, np.array([1.0, 0, 0, 0]), args, covariance=np.zeros((3, 3)))
    found = end(term, RKMK8(), y0, args, t)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-13)
    assert np.abs(expected - np.diag(np.diag(expected))).max() > 0.1


# Log-densities


def su_flow(t, u, args):
    """On SU(2), the gradient of the real trace: towards the identity."""
    a = -(u - u.conj().T) / 2
    return cfjax.LeftMatrix(args * (a - jnp.trace(a) / len(u) * jnp.eye(len(u), dtype=u.dtype)))


def unitary(phases, seed=0):
    rng = np.random.default_rng(seed)
    n = len(phases)
    v = np.linalg.qr(rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n)))[0]
    return (v * np.exp(1j * np.asarray(phases))) @ v.conj().T


def weyl(phases):
    x = np.asarray(phases)
    return sum(np.log(np.sin((x[i] - x[j]) / 2) ** 2) for i in range(len(x)) for j in range(i))


def test_log_density_on_u3():
    """Phases x decouple: x' = -sin x; the density of phases has Weyl's weight."""
    x0, t = np.array([0.4, -1.1, 2.0]), 1.0
    x1 = 2 * np.arctan(np.exp(-t) * np.tan(x0 / 2))

    def field(t, u, args):
        return cfjax.LeftMatrix(-(u - u.conj().T) / 2)

    term = VariationTerm(LieTerm(field), basis=algebra_basis("u", 3))
    y0 = term.start(0.0, unitary(x0), log_density=0.0)
    found = end(term, RKMK8(), y0, None, t, 20)
    expected = -np.sum(np.log(np.sin(x1) / np.sin(x0))) - (weyl(x1) - weyl(x0))
    np.testing.assert_allclose(found.log_density, expected, atol=1e-9)
    with_matrix = term.start(0.0, unitary(x0), log_density=0.0, transition=True)
    found = end(term, RKMK8(), with_matrix, None, t, 20)
    np.testing.assert_allclose(found.log_density, expected, atol=1e-9)
    np.testing.assert_allclose(np.linalg.slogdet(found.transition)[1], -expected, atol=1e-9)


def test_log_density_on_su3():
    """From phases (x, -x, 0): x' = -sin x, and to first order beside it rates cos x and
    (cos x + 2) / 3 of the two kinds of phases."""
    x0, t = 1.3, 1.0
    x1 = 2 * np.arctan(np.exp(-t) * np.tan(x0 / 2))
    s = np.linspace(0, t, 2001)
    x = 2 * np.arctan(np.exp(-s) * np.tan(x0 / 2))
    of_phases = -scipy.integrate.simpson(np.cos(x) + (np.cos(x) + 2) / 3, x=s)
    expected = -of_phases - (weyl([x1, -x1, 0]) - weyl([x0, -x0, 0]))
    term = VariationTerm(LieTerm(su_flow), basis=algebra_basis("su", 3))
    y0 = term.start(0.0, unitary([x0, -x0, 0.0]), 1.0, log_density=0.0)
    found = end(term, RKMK8(), y0, 1.0, t, 20)
    np.testing.assert_allclose(found.log_density, expected, atol=1e-9)


def log_density_of_su2(k, solver=None, num_steps=20):
    u0 = unitary([0.9, -0.9], 1)
    term = VariationTerm(LieTerm(su_flow), basis=algebra_basis("su", 2))
    y0 = term.start(0.0, u0, k, log_density=0.0)
    return end(term, solver or CF4(), y0, k, 1.0, num_steps).log_density


def test_log_density_on_su2_and_its_gradient():
    """The phase is a distance from the identity: x' = -k sin x, of density sin(x)^2 d x."""

    def exact(k):
        x0 = 0.9
        x1 = 2 * jnp.arctan(jnp.exp(-k) * jnp.tan(x0 / 2))
        return -3 * jnp.log(jnp.sin(x1) / jnp.sin(x0))

    k = jnp.asarray(0.8)
    np.testing.assert_allclose(log_density_of_su2(k, RKMK8()), exact(k), atol=1e-11)
    slope = jax.grad(exact)(k)
    reverse = jax.jit(jax.grad(log_density_of_su2))(k)
    np.testing.assert_allclose(reverse, slope, atol=1e-6)
    forward = jax.jit(jax.jacfwd(log_density_of_su2))(k)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)


def towards_identity(t, r, k):
    m = k / 2 * (r - r.T)
    return Rotation(-jnp.stack([m[2, 1], m[0, 2], m[1, 0]]))


def test_log_density_on_so3_in_both_frames():
    """omega = -k vee(R - R^T) / 2: tan(th/2) falls as e^(-kt); weight sin^2(th/2)."""
    axis, angle, k = np.array([2.0, -1.0, 2.0]) / 3, 1.2, 0.8
    r0 = scipy.linalg.expm(angle * hat(axis))
    later = 2 * np.arctan(np.exp(-k) * np.tan(angle / 2))
    expected = -np.log(np.sin(later) / np.sin(angle)) - 2 * np.log(
        np.sin(later / 2) / np.sin(angle / 2)
    )

    def from_the_right(t, r, k):
        w = towards_identity(t, r, k).omega
        return cfjax.RightMatrix(jnp.cross(jnp.eye(3), w))

    for field, basis in ((towards_identity, None), (from_the_right, algebra_basis("so", 3))):
        term = VariationTerm(LieTerm(field), basis=basis)
        y0 = term.start(0.0, r0, k, log_density=0.0)
        found = end(term, RKMK8(), y0, k)
        np.testing.assert_allclose(found.log_density, expected, atol=1e-11)


@pytest.mark.parametrize("d", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_log_density_on_spheres(d):
    """y' = k (e - (e.y) y): log p grows by d log(cosh kt + z0 sinh kt)."""
    k, t = 0.7, 1.0
    y0 = np.random.default_rng(1).normal(size=d + 1)
    y0 /= np.linalg.norm(y0)
    pole = jnp.eye(d + 1)[0]
    term = VariationTerm(LieTerm(lambda t, y, k: cfjax.SphereRotation(k * pole)))
    start = term.start(0.0, y0, k, log_density=0.0)
    found = end(term, CF4(), start, k, t, 40)
    expected = d * np.log(np.cosh(k * t) + y0[0] * np.sinh(k * t))
    np.testing.assert_allclose(found.log_density, expected, atol=1e-7)


def test_log_density_of_angles():
    """x' = sin x: the volume grows by sin x(t) / sin x(0)."""
    x0 = np.array([0.4, 1.3, 2.5])
    term = VariationTerm(LieTerm(lambda t, x, args: jnp.sin(x)))
    found = end(term, CF4(), term.start(0.0, x0, log_density=0.3, transition=True))
    growth = np.sin(np.asarray(found.state)) / np.sin(x0)
    np.testing.assert_allclose(found.log_density, 0.3 - np.log(growth).sum(), atol=1e-6)
    np.testing.assert_allclose(found.transition, np.diag(growth), atol=1e-6)


def test_the_density_takes_no_part_of_the_bracket():
    """Affine maps of a line, whose tr ad is not 0. Motions from the left keep Haar's measure."""
    basis = np.array([[[1.0, 0], [0, 0]], [[0, 1.0], [0, 0]]])
    a = np.tensordot([0.7, -0.4], basis, 1)
    term = VariationTerm(LieTerm(lambda t, x, args: cfjax.LeftMatrix(args)), basis=basis)
    x0 = np.array([[2.0, 0.3], [0, 1]])
    y0 = term.start(0.0, x0, jnp.asarray(a), log_density=0.2, transition=True)
    found = end(term, CF4(), y0, jnp.asarray(a))
    np.testing.assert_allclose(found.log_density, 0.2, atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(found.transition), np.exp(0.7), rtol=1e-6)


# Orders


def test_order_of_cf4(derivatives):
    _, phi, s = derivatives
    term = attitude_term()
    y0 = attitude_start(term)
    fine = end(term, RKMK8(), y0, ARGS, 2.0, 40)
    errors = []
    for num_steps in (20, 40):
        y = end(term, CF4(), y0, ARGS, 2.0, num_steps)
        errors.append(
            [
                np.abs(y.transition - phi).max(),
                np.abs(y.sensitivity - s).max(),
                np.abs(y.covariance - fine.covariance).max(),
                np.abs(y.log_density - fine.log_density),
            ]
        )
    slopes = np.log2(np.divide(*errors))
    assert np.all((slopes[:3] > 3.5) & (slopes[:3] < 4.5)), slopes
    # An integral along the solution, whose first error happens to be small.
    assert slopes[3] > 3.5, slopes
    np.testing.assert_allclose(fine.transition, phi, atol=1e-11)
    np.testing.assert_allclose(fine.sensitivity, s, atol=1e-11)


# Properties


def test_density_is_that_of_the_determinant(derivatives):
    _, phi, _ = derivatives
    found = end(attitude_term(), RKMK8(), attitude_start(), ARGS, 2.0, 20)
    np.testing.assert_allclose(found.log_density, 0.5 - np.linalg.slogdet(phi)[1], atol=1e-11)


def test_covariance_is_symmetric_to_the_last_bit_where_small():
    found = end(attitude_term(), CF4(), attitude_start(covariance=np.eye(3)), ARGS)
    np.testing.assert_array_equal(found.covariance, found.covariance.T)


def test_small_states_are_rewritten_without_a_change():
    term, y0 = attitude_term(), attitude_start(covariance=np.eye(3))
    assert len(jax.tree.leaves(y0)) == 4  # the state, and the rows of the upper half
    expected = end(term, CF4(), y0, ARGS)
    with cfjax.rewriting(True):
        found = end(term, CF4(), y0, ARGS)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-14)
    whole = Variation(y0.state, covariance=y0.covariance)
    np.testing.assert_allclose(
        end(term, CF4(), whole, ARGS).covariance, expected.covariance, atol=1e-14
    )


def test_there_and_back():
    there = end(attitude_term(), CF4(), attitude_start(), ARGS, num_steps=40)
    back = end(attitude_term(), CF4(), there, ARGS, 0.0, 40, t0=1.0)
    np.testing.assert_allclose(back.log_density, 0.5, atol=1e-6)
    np.testing.assert_allclose(back.transition, np.eye(3), atol=1e-6)


def test_a_sensitivity_alone_is_that_beside_the_transition(derivatives):
    alone = end(attitude_term(), CF4(), attitude_start(sensitivity=True), ARGS, 2.0, 40)
    beside = end(attitude_term(), CF4(), attitude_start(), ARGS, 2.0, 40)
    np.testing.assert_allclose(alone.sensitivity, beside.sensitivity, atol=1e-14)
    np.testing.assert_allclose(alone.sensitivity, derivatives[2], atol=1e-4)


def test_the_mean_over_all_sign_probes_is_the_trace():
    signs = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], float)
    estimated = end(attitude_term(probes=signs), CF4(), attitude_start(log_density=0.5), ARGS)
    exact = end(attitude_term(), CF4(), attitude_start(log_density=0.5), ARGS)
    np.testing.assert_allclose(estimated.log_density, exact.log_density, atol=1e-14)


def test_definite_agrees_with_arrays():
    term = attitude_term(definite=True)
    found = end(term, CF4(), attitude_start(term), ARGS, num_steps=40)
    expected = end(attitude_term(), CF4(), attitude_start(), ARGS, num_steps=40)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-7)
    np.testing.assert_allclose(found.transition, expected.transition, atol=1e-7)


def imu(t, y, bias):
    rate = jnp.stack([jnp.sin(3 * t), jnp.cos(2 * t), 0.5 + 0 * t]) - bias[:3]
    force = jnp.stack([jnp.cos(t), jnp.sin(2 * t), 9.81 + 0 * t]) - bias[3:]
    down = jnp.asarray([0.0, 0, -9.81])
    return {
        "q": QuaternionRotation(rate, frame="body", layout="wxyz"),
        "v": cfjax.quaternion_rotate(y["q"], force, layout="wxyz") + down,
        "x": y["v"],
    }


def gyro_noise(t, y, bias, dw):
    return {"q": QuaternionRotation(0.02 * dw, frame="body", layout="wxyz"), "v": None, "x": None}


IMU_START = {"q": Q0, "v": np.array([0.1, 0.2, 0.3]), "x": np.zeros(3)}
BIAS = jnp.asarray([0.01, -0.02, 0.03, 0.1, -0.1, 0.2])


def scaled_eigenvalue(p):
    d = np.sqrt(np.abs(np.diag(p)))
    d = np.where(d > 0, d, 1)
    return np.linalg.eigvalsh(p / np.outer(d, d))[0]


def test_definite_stays_so_where_arrays_do_not():
    """Gyro noise alone, from P = 0: it reaches positions through attitude and velocity."""
    values = {}
    for definite in (False, True):
        term = VariationTerm(LieTerm(imu), noise=gyro_noise, channels=3, definite=definite)
        y0 = term.start(0.0, IMU_START, BIAS, covariance=np.zeros((9, 9)))
        p = end(term, CF4(), y0, BIAS, 0.01, 1).covariance
        np.testing.assert_allclose(p, p.T, atol=1e-16 * 9)
        values[definite] = scaled_eigenvalue(np.asarray(p))
    # Entries of position with attitude, and no variance of the position.
    assert values[False] < -1e-6
    assert values[True] > -1e-12


def test_a_bias_in_the_state_adds_its_share():
    """P with the bias in the state is P + J P_b J^T without, with the Jacobian J by the bias."""

    def with_bias(t, y, args):
        return {**imu(t, y, y["bias"]), "bias": None}

    def noise(t, y, args, dw):
        return {**gyro_noise(t, y, None, dw), "bias": None}

    p_bias = np.diag([1e-4, 2e-4, 3e-4, 1e-2, 2e-2, 3e-2])
    big = VariationTerm(LieTerm(with_bias), noise=noise, channels=3)
    state = {**IMU_START, "bias": BIAS}
    # The keys of a dict are sorted.
    assert big.slices(0.0, state)["bias"] == slice(0, 6)
    p0 = scipy.linalg.block_diag(p_bias, np.zeros((9, 9)))
    found = end(big, CF4(), big.start(0.0, state, covariance=p0)).covariance[6:, 6:]
    small = VariationTerm(LieTerm(imu), noise=gyro_noise, channels=3, parameters=lambda b: b)
    y0 = small.start(0.0, IMU_START, BIAS, covariance=np.zeros((9, 9)), sensitivity=True)
    y = end(small, CF4(), y0, BIAS)
    expected = y.covariance + y.sensitivity @ p_bias @ y.sensitivity.T
    # Both are of order 4, and not the same discrete solution.
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_samples_agree_with_the_covariance():
    """Of the same function of noise, so small that first order is exact to the sampling error."""
    small = lambda t, q, args, dw: shaking(t, q, args, 0.1 * dw)  # noqa: E731
    term = VariationTerm(LieTerm(attitude), noise=small, channels=2)
    y = end(term, CF4(), term.start(0.0, Q0, ARGS, covariance=np.zeros((3, 3))), ARGS, 1.0, 20)
    count = 2000

    @jax.jit
    @jax.vmap
    def sample(key):
        path = diffrax.UnsafeBrownianPath((2,), key)
        terms = diffrax.MultiTerm(LieTerm(attitude), cfjax.LieControlTerm(small, path))
        return end(terms, cfjax.CF2(), jnp.asarray(Q0), ARGS, 1.0, 20)

    qs = np.asarray(sample(jax.random.split(jax.random.key(5), count)))
    q = np.asarray(y.state)
    eta = coordinates_of(y.state, (qs - q).T)  # to first order
    p = np.asarray(y.covariance)
    found = eta @ eta.T / count
    variance = (np.outer(np.diag(p), np.diag(p)) + p**2) / count
    assert np.all(np.abs(found - p) < 4.5 * np.sqrt(variance) + 0.02 * np.abs(p).max())


# Where it works


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    "solver, tol",
    [
        (cfjax.CF2(), 2e-2),
        (cfjax.CG3(), 5e-3),
        (cfjax.ImplicitMidpoint(), 2e-2),
        (cfjax.CFEES25(), 1e-2),
        (cfjax.CF54(), 1e-5),
        (cfjax.RKMK5(), 1e-5),
    ],
    ids=lambda s: type(s).__name__,
)
def test_solvers(solver, tol, derivatives):
    y0 = attitude_start(transition=True, log_density=0.0)
    found = end(attitude_term(), solver, y0, ARGS, 2.0, 40)
    np.testing.assert_allclose(found.transition, derivatives[1], atol=tol)


@pytest.mark.parametrize("coordinates", ["projected", "cayley"])
def test_coordinates_of_a_step(coordinates):
    """`y' = k b y + y c`, whose flow is linear in the start, with each kind of coordinates."""
    b, c = hat([0.3, -0.5, 0.8]), np.array([[0.0, 0.7], [-0.7, 0.0]])
    gain, p0 = np.array([[0.3, 0.1], [-0.2, 0.2], [0.05, 0.4]]), np.diag([0.1, 0.2, 0.3])
    basis = np.stack([hat(x) for x in np.eye(3)])

    def field(t, y, k):
        r, q, x = y["r"], y["columns"], y["x"]
        return {
            "r": cfjax.LeftMatrix(k * b + r @ b.T @ r.T),
            "columns": cfjax.LowRankSkew(k * b @ q + q @ (c - k * (q.T @ b @ q)) / 2),
            # Which commutes with its square.
            "x": cfjax.Conjugation(k * b + x @ x),
        }

    def noise(t, y, args, dw):
        turn = cfjax.LeftMatrix(jnp.tensordot(gain @ dw, basis, 1))
        return {"r": turn, "columns": None, "x": None}

    rng = np.random.default_rng(4)
    y0 = {
        "r": scipy.linalg.expm(hat([0.2, 0.1, -0.4])),
        "columns": np.linalg.qr(rng.normal(size=(3, 2)))[0],
        "x": rng.normal(size=(3, 3)) / 3,
    }
    k, t = 1.2, 1.0
    term = VariationTerm(
        LieTerm(field), noise=noise, channels=2, parameters=lambda k: k, basis=basis
    )
    slices = term.slices(0.0, y0, k)
    covariance = np.zeros((18, 18))
    covariance[slices["r"], slices["r"]] = p0
    start = term.start(0.0, y0, k, transition=True, covariance=covariance, sensitivity=True)
    found = end(term, RKMK8(coordinates=coordinates), start, k, t, 10)
    turn, other = scipy.linalg.expm(t * k * b), scipy.linalg.expm(t * c)
    phi, p = van_loan(k * b, gain @ gain.T, p0, t)
    of_x = np.kron(turn, turn)
    # The error of order 8 of steps by a tenth of a radian.
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=2e-11)
    transition = {name: found.transition[at, at] for name, at in slices.items()}
    close(transition["r"], phi)
    close(transition["x"], of_x)
    # Of changes along the manifold: turns of the columns.
    changes = np.stack([(x @ y0["columns"]).ravel() for x in basis], axis=1)
    close(transition["columns"] @ changes, np.kron(turn, other.T) @ changes)
    close(found.covariance[slices["r"], slices["r"]], p)
    velocities = {
        "r": t * np.array([0.3, -0.5, 0.8]),
        "columns": t * b @ turn @ y0["columns"] @ other,
        "x": t * (b @ found.state["x"] - found.state["x"] @ b),
    }
    for name, v in velocities.items():
        close(found.sensitivity[slices[name], 0], v.ravel())


def test_solvers_of_time_alone_say_why_not():
    with pytest.raises((TypeError, ValueError), match="depend"):
        end(attitude_term(), cfjax.Magnus4(), attitude_start(), ARGS)


def test_diffeqsolve_with_control_output_and_event(derivatives):
    y0 = attitude_start(transition=True, covariance=np.eye(3))
    norm = lambda e: jnp.max(jnp.abs(e.state))  # noqa: E731
    solutions = {}
    for name, kwargs in {"all": {}, "state": {"norm": norm}}.items():
        solutions[name] = diffrax.diffeqsolve(
            attitude_term(),
            cfjax.RKMK5(),
            0.0,
            2.0,
            0.1,
            y0,
            ARGS,
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8, **kwargs),
            saveat=diffrax.SaveAt(ts=[1.0, 2.0]),
        )
        np.testing.assert_allclose(solutions[name].ys.transition[-1], derivatives[1], atol=3e-6)
    alone = diffrax.diffeqsolve(
        LieTerm(attitude),
        cfjax.RKMK5(),
        0.0,
        2.0,
        0.1,
        jnp.asarray(Q0),
        ARGS,
        stepsize_controller=diffrax.PIDController(
            rtol=1e-8, atol=1e-8, norm=lambda e: jnp.max(jnp.abs(e))
        ),
    )
    # The steps of the state alone.
    assert solutions["state"].stats["num_steps"] == alone.stats["num_steps"]
    stopped = diffrax.diffeqsolve(
        attitude_term(),
        CF4(),
        0.0,
        2.0,
        0.1,
        y0,
        ARGS,
        event=diffrax.Event(lambda t, y, args, **kwargs: jnp.trace(y.covariance) > 3.2),
    )
    assert 0 < stopped.ts[-1] < 2 and jnp.trace(stopped.ys.covariance[-1]) > 3.2


@pytest.mark.parametrize(
    "adjoint",
    [diffrax.RecursiveCheckpointAdjoint(), diffrax.BacksolveAdjoint(), diffrax.DirectAdjoint()],
    ids=lambda a: type(a).__name__,
)
@pytest.mark.representatives(1)
def test_adjoints(adjoint):
    def loss(gain, solve):
        args = {**ARGS, "gain": gain}
        y0 = attitude_term().start(0.0, Q0, args, covariance=np.eye(3), log_density=0.0)
        y = solve(y0, args)
        return jnp.trace(y.covariance) + y.log_density

    def by_diffrax(y0, args):
        ys = diffrax.diffeqsolve(
            attitude_term(), CF4(), 0.0, 1.0, 0.05, y0, args, adjoint=adjoint, max_steps=32
        ).ys
        return jax.tree.map(lambda x: x[-1], ys)

    with jax.numpy_dtype_promotion("standard"):
        found = jax.jit(jax.grad(lambda g: loss(g, by_diffrax)))(ARGS["gain"])
    own = lambda y0, args: end(attitude_term(), CF4(), y0, args)  # noqa: E731
    expected = problems.central_difference(
        jax.jit(lambda g: loss(g, own)), ARGS["gain"], jnp.asarray(1.0), 1e-3
    )
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_gradients_of_the_covariance():
    """d tr P / d rate in reverse and forward mode, and by differences."""

    def loss(rate):
        args = {**ARGS, "rate": rate}
        y0 = attitude_start(covariance=jnp.diag(jnp.asarray([0.1, 0.2, 0.3])))
        p = end(attitude_term(), CF4(), y0, args, 1.0, 10).covariance
        return jnp.sum(p * jnp.asarray([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]]))

    loss = jax.jit(loss)
    direction = jnp.asarray([0.5, -1.0, 0.8])
    reverse = jax.jit(jax.grad(loss))(ARGS["rate"]) @ direction
    forward = jax.jit(lambda x, v: jax.jvp(loss, (x,), (v,))[1])(ARGS["rate"], direction)
    expected = problems.central_difference(loss, ARGS["rate"], direction, 1e-3)
    np.testing.assert_allclose(reverse, expected, atol=1e-9)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    assert abs(expected) > 1e-2


def test_batches_and_float32():
    starts = jnp.stack([jnp.asarray(Q0), jnp.asarray(Q0[::-1].copy())])
    term = attitude_term()

    def solve(q):
        return end(term, CF4(), term.start(0.0, q, ARGS, covariance=np.eye(3)), ARGS).covariance

    many = jax.jit(jax.vmap(solve))(starts)
    np.testing.assert_allclose(many[1], solve(starts[1]), atol=1e-14)
    single = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), ARGS)

    def in_float32(t, q, args, dw):
        return QuaternionRotation(jnp.asarray(GAIN, jnp.float32) @ dw, frame="body", layout="wxyz")

    term = VariationTerm(LieTerm(attitude), noise=in_float32, channels=2)
    y0 = term.start(0.0, Q0.astype(np.float32), single, covariance=np.eye(3), log_density=0.0)
    found = end(term, CF4(), y0, single)
    assert found.covariance.dtype == found.log_density.dtype == jnp.float32
    np.testing.assert_allclose(found.covariance, many[0], atol=1e-5)


def test_map_batch():
    term = attitude_term()

    def solve(gain):
        args = {**ARGS, "gain": gain}
        y0 = Variation(jnp.asarray(Q0), covariance=jnp.eye(3))
        return end(term, CF4(), y0, args).covariance

    result = cfjax.map_batch(solve, jnp.linspace(0.0, 1.0, 10), chunk_size=4, progress=False)
    np.testing.assert_allclose(result.values[3], solve(jnp.asarray(1 / 3)), atol=1e-14)


def test_leading_axes():
    """Two attitudes in one state have two frames; an axis of 1 in the field is broadcast."""

    def field(t, q, args):
        omega = jnp.stack([jnp.sin(t), jnp.cos(2 * t), t])
        return QuaternionRotation(omega[None], frame="body", layout="wxyz")

    q0 = np.stack([Q0, Q0[::-1]])
    term = VariationTerm(LieTerm(field))
    assert term.size(0.0, q0) == 6
    phi = end(term, CF4(), term.start(0.0, q0, transition=True)).transition
    np.testing.assert_allclose(phi[:3, :3], phi[3:, 3:], atol=1e-15)
    np.testing.assert_array_equal(phi[:3, 3:], 0)
    np.testing.assert_allclose(phi[:3, :3] @ phi[:3, :3].T, np.eye(3), atol=1e-6)


def test_arrays_alone_take_any_solver_of_diffrax():
    term = VariationTerm(diffrax.ODETerm(lambda t, x, args: jnp.sin(x)))
    y0 = term.start(0.0, np.array([0.4, 1.3]), transition=True, log_density=0.0)
    y = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.02, y0).ys
    growth = np.sin(np.asarray(y.state[-1])) / np.sin([0.4, 1.3])
    np.testing.assert_allclose(y.transition[-1], np.diag(growth), atol=1e-8)


def test_a_sum_of_terms():
    half = lambda t, q, args: cfjax.combine((0.5,), (attitude(t, q, args),))  # noqa: E731
    term = VariationTerm(diffrax.MultiTerm(LieTerm(half), LieTerm(half)))
    found = end(term, CF4(), term.start(0.0, Q0, ARGS, transition=True), ARGS)
    expected = end(attitude_term(), CF4(), attitude_start(transition=True), ARGS)
    np.testing.assert_allclose(found.transition, expected.transition, atol=1e-14)


# Bases


@pytest.mark.parametrize(
    "kind, n", [("so", 3), ("so", 4), ("su", 2), ("su", 3), ("u", 2), ("gl", 2)]
)
def test_bases(kind, n):
    basis = algebra_basis(kind, n)
    flat = basis.reshape(len(basis), -1)
    gram = np.real(flat.conj() @ flat.T)
    size = {"so": 2, "su": 0.5, "u": 0.5, "gl": 1}[kind]
    np.testing.assert_allclose(gram, size * np.eye(len(basis)), atol=1e-15)
    if kind != "gl":
        np.testing.assert_allclose(basis, -basis.conj().swapaxes(1, 2))
    if kind == "su":
        np.testing.assert_allclose(np.trace(basis, axis1=1, axis2=2), 0, atol=1e-15)
    if (kind, n) in (("so", 3), ("su", 2)):
        a, b, c = basis
        np.testing.assert_allclose(a @ b - b @ a, c)


# Errors


def term_of(**kwargs):
    return VariationTerm(LieTerm(attitude), **kwargs)


def complex_field(t, u, args):
    return cfjax.LeftMatrix(u - u.conj().T)


U0 = np.eye(2, dtype=complex)


@pytest.mark.parametrize(
    ("fun", "text"),
    [
        (lambda: VariationTerm(attitude), "term must be a diffrax term"),
        (lambda: term_of(noise=shaking), "noise needs channels"),
        (lambda: term_of(noise=shaking, channels=0), "noise needs channels"),
        (lambda: term_of(channels=3), "needs noise"),
        (lambda: term_of(noise=shaking, channels=1.5), "channels must be"),
        (lambda: term_of(noise=1.0, channels=1), "noise must be a function"),
        (lambda: term_of(definite=1), "definite must be a bool"),
        (lambda: term_of(probes=np.ones(3)), r"probes must be real and have shape \(k, n\)"),
        (lambda: term_of(basis=np.ones((2, 3))), r"basis must have shape \(d, n, n\)"),
        (lambda: term_of(basis="so"), "basis must be an array"),
        (lambda: term_of(basis=np.ones((2, 2, 2))), "linearly independent"),
        (lambda: term_of(basis=algebra_basis("so", 3)[:2]), "closed under the commutator"),
        (lambda: algebra_basis("sp", 2), "kind must be"),
        (lambda: algebra_basis("su", 1), "n must be an int of at least 2"),
        (lambda: term_of().start(0.0, Q0, ARGS), "must carry something"),
        (lambda: term_of().start(0.0, Q0, ARGS, sensitivity=True), "sensitivity needs parameters"),
        (lambda: term_of().start(0.0, Q0, ARGS, covariance=np.eye(4)), r"shape \(3, 3\)"),
        (lambda: term_of().start(0.0, Q0, ARGS, covariance=True), "got True"),
        (lambda: term_of().start(0.0, Variation(Q0), ARGS, transition=True), "the state alone"),
        (
            lambda: term_of(probes=np.ones((2, 4))).start(0.0, Q0, ARGS, log_density=0.0),
            r"probes must have shape \(k, 3\)",
        ),
        (
            lambda: term_of(parameters=lambda a: 3).start(0.0, Q0, ARGS, sensitivity=True),
            "parameters must be a place in args",
        ),
        (
            lambda: term_of(parameters=lambda a: 2 * a["rate"]).start(
                0.0, Q0, ARGS, sensitivity=True
            ),
            r"parameters must be a place in args, .* got a function that returns f64\[3\]",
        ),
        (
            lambda: term_of(parameters=lambda a: a["of another"]).start(
                0.0, Q0, {**ARGS, "of another": np.ones(3, np.float32)}, sensitivity=True
            ),
            r"parameters must have the precision of the state, float64, got f32\[3\]",
        ),
        (lambda: term_of().start(0.0, Q0, ARGS, covariance=1j * np.eye(3)), "covariance must be r"),
        (lambda: term_of().start(0.0, Q0, ARGS, transition=1j * np.eye(3)), "transition must be r"),
        (lambda: term_of().start(0.0, Q0, ARGS, log_density=1j), "log_density must be real"),
        (lambda: term_of().start(0.0, Q0, ARGS, log_density=True), "a number, got True"),
        (lambda: term_of().start("0", Q0, ARGS, transition=True), "t0 must be a real scalar"),
        (
            lambda: term_of(
                noise=lambda t, q, a, dw: shaking(t, q, a, jnp.stack([dw[0], dw[2]])), channels=2
            ).start(0.0, Q0, ARGS, covariance=np.eye(3)),
            "noise: The field reads an entry that its increment does not have",
        ),
        (
            lambda: VariationTerm(LieTerm(complex_field)).start(0.0, U0, transition=True),
            "Name the basis",
        ),
        (
            lambda: term_of(basis=algebra_basis("so", 3)).start(0.0, Q0, ARGS, transition=True),
            "leave it out",
        ),
        (
            lambda: VariationTerm(LieTerm(complex_field), basis=algebra_basis("su", 3)).start(
                0.0, U0, transition=True
            ),
            r"basis must have matrices of shape \(2, 2\)",
        ),
        (
            lambda: term_of(
                noise=lambda t, q, a, dw: QuaternionRotation(dw, frame="fixed", layout="wxyz"),
                channels=3,
            ).start(0.0, Q0, ARGS, covariance=np.eye(3)),
            "same frame",
        ),
        (
            lambda: term_of(
                noise=lambda t, q, a, dw: QuaternionRotation(1 + dw, frame="body", layout="wxyz"),
                channels=3,
            ).start(0.0, Q0, ARGS, covariance=np.eye(3)),
            "noise: .*linear in increment",
        ),
        (
            lambda: end(term_of(), CF4(), jnp.asarray(Q0), ARGS),
            "is a cfjax.Variation",
        ),
    ],
)
def test_errors_when_a_program_is_traced(fun, text, no_shape_hook):
    with pytest.raises((TypeError, ValueError), match=text):
        fun()


@pytest.mark.parametrize(
    ("fun", "text"),
    [
        (
            lambda: term_of().start(0.0, Q0, ARGS, covariance=np.triu(np.ones((3, 3)))),
            "covariance must be symmetric",
        ),
        (
            lambda: term_of().start(0.0, Q0, ARGS, covariance=np.diag([1.0, -1e-3, 1.0])),
            "covariance must be positive semidefinite",
        ),
        (
            lambda: VariationTerm(
                LieTerm(lambda t, u, args: cfjax.LeftMatrix(1j * u)), basis=algebra_basis("su", 2)
            ).start(0.0, U0, transition=True),
            "must be in the span of basis",
        ),
    ],
)
def test_errors_at_run_time(fun, text):
    # Called from Python, the message alone.
    with pytest.raises(eqx.EquinoxRuntimeError, match=rf"^[^\n]*{text}[^\n]*$"):
        fun()
