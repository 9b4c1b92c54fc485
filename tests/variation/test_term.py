"""Variations of solutions against exact answers: closed forms, or derivatives of other programs.

Rates are checked to rounding at single states, which are small programs, and solves are few.
"""

import functools
from itertools import pairwise
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from problems import hat

import cfjax
from cfjax import (
    CF2,
    CF3,
    CF4,
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


@pytest.fixture(autouse=True, scope="module")
def as_traced():
    """Most of these programs run once, and compile faster as they are."""
    with cfjax.rewriting(False):
        yield


def end(term, solver, y0, args=None, t1=1.0, num_steps=20, t0=0.0) -> Any:
    ys = cfjax.integrate(term, solver, t0, t1, y0, args, num_steps=num_steps).ys
    return jax.tree.map(lambda x: x[-1], ys)


def rates(term, y, args=None) -> Any:
    """The velocity of the state and of what is carried, at time zero."""
    return jax.jit(lambda y, args: term.vf_prod(0.0, y, args, 1.0))(*problems.arrays((y, args)))


def van_loan(a, q, p0, time):
    """Phi and P of `P' = A P + P A^T + Q`, by the block exponential."""
    n = len(a)
    block = scipy.linalg.expm(time * np.block([[-a, q], [np.zeros((n, n)), a.T]]))
    phi = block[n:, n:].T
    return phi, phi @ p0 @ phi.T + phi @ block[:n, n:]


# A driven attitude, against the same equations for the four numbers of a quaternion


def attitude(t, q, args):
    """A field that depends on time, state and parameters, in the frame of the body."""
    omega = args["rate"] + jnp.stack([jnp.sin(t), jnp.cos(2 * t), t]) + args["gain"] * q[1:]
    return QuaternionRotation(omega, frame="body", layout="wxyz")


ARGS = {"rate": jnp.asarray([0.3, -0.5, 0.8]), "gain": jnp.asarray(0.7)}
# Unequal and not diagonal, which isotropic noise would hide.
GAIN = np.array([[0.3, 0.1], [-0.2, 0.2], [0.05, 0.4]])
P0 = np.diag([0.1, 0.2, 0.3])


def shaking(t, q, args, dw):
    return QuaternionRotation(jnp.asarray(GAIN) @ dw, frame="body", layout="wxyz")


# Terms of the same functions share their programs.
SHAKEN: Any = dict(noise=shaking, channels=2, parameters=lambda args: (args["rate"], args["gain"]))
TERM = VariationTerm(LieTerm(attitude), **SHAKEN)
CARRIED = "transition", "covariance", "sensitivity", "log_density"


@functools.cache
def with_everything():
    return TERM.start(
        0.0, Q0, ARGS, transition=True, covariance=P0, sensitivity=True, log_density=0.5
    )


@functools.cache
def with_covariance():
    return TERM.start(0.0, Q0, ARGS, covariance=np.eye(3))


def through(y, *times):
    """20 steps of CF4 from each time to the next one, which are one program."""
    for t0, t1 in pairwise(times):
        y = end(TERM, CF4(), y, ARGS, t1, t0=t0)
    return y


def velocities(q):
    """Those at q of unit rates in the frame of the body, as columns."""
    return np.vstack([-q[1:], q[0] * np.eye(3) + hat(q[1:])]) / 2


@functools.cache
def reference(t1):
    rate, gain = np.asarray(ARGS["rate"]), float(ARGS["gain"])

    def ode(t, y):
        q, d, s, c = y[:4], y[4:16].reshape(4, 3), y[16:32].reshape(4, 4), y[32:].reshape(4, 4)
        e = velocities(q)
        omega = rate + np.array([np.sin(t), np.cos(2 * t), t]) + gain * q[1:]
        jacobian = np.stack([velocities(x) @ omega for x in np.eye(4)], axis=1)
        jacobian[:, 1:] += gain * e
        moved, noise = jacobian @ c, e @ GAIN
        by_parameters = jacobian @ s + np.column_stack([e, e @ q[1:]])
        changes = jacobian @ d, by_parameters, moved + moved.T + noise @ noise.T
        return np.concatenate([e @ omega, *map(np.ravel, changes)])

    e = velocities(Q0)
    y0 = np.concatenate([Q0, e.ravel(), np.zeros(16), (e @ P0 @ e.T).ravel()])
    y = problems.reference(ode, 0.0, t1, y0)
    # The columns are orthogonal, of length 1/2.
    inverse = 4 * velocities(y[:4]).T
    phi, s = inverse @ y[4:16].reshape(4, 3), inverse @ y[16:32].reshape(4, 4)
    p = inverse @ y[32:].reshape(4, 4) @ inverse.T
    return Variation(y[:4], phi, p, s, 0.5 - np.linalg.slogdet(phi)[1])


def test_order_of_cf4_and_there_and_back():
    want, errors = reference(2.0), []
    for times in ((0.0, 2.0), (0.0, 1.0, 2.0)):
        found = through(with_everything(), *times)
        errors.append([np.abs(getattr(found, x) - getattr(want, x)).max() for x in CARRIED])
    slopes = np.log2(np.divide(*errors))
    assert np.all((slopes[:3] > 3.5) & (slopes[:3] < 4.5)), slopes
    # An integral along the solution, whose first error happens to be small.
    assert slopes[3] > 3.5, slopes
    back = through(with_everything(), 0.0, 0.5, 1.0, 0.5, 0.0)
    np.testing.assert_allclose(back.log_density, 0.5, atol=1e-6)
    np.testing.assert_allclose(back.transition, np.eye(3), atol=1e-6)


def test_rates_are_the_same_however_they_are_computed():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(3, 3))
    y = Variation(Q0, rng.normal(size=(3, 3)), p + p.T, rng.normal(size=(3, 4)), 0.2)
    density = Variation(Q0, log_density=0.2)
    by_rows = TERM.start(0.0, Q0, ARGS, sensitivity=y.sensitivity)
    signs = np.array([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], float)
    probing = VariationTerm(LieTerm(attitude), **SHAKEN, probes=signs)
    half = LieTerm(lambda t, q, args: cfjax.combine((0.5,), (attitude(t, q, args),)))
    want = rates(TERM, y, ARGS)
    for term, state in (
        (VariationTerm(LieTerm(attitude), **SHAKEN, definite=True), y),
        (VariationTerm(diffrax.MultiTerm(half, half), **SHAKEN), y),
        # The mean over all signs is the trace.
        (probing, y),
        (probing, density),
        (TERM, density),
        (TERM, by_rows),
    ):
        found = rates(term, state, ARGS)
        for name in CARRIED:
            if getattr(state, name) is not None:
                # A few units of rounding of entries of size 1.
                np.testing.assert_allclose(
                    getattr(found, name), getattr(want, name), rtol=0, atol=4e-15, err_msg=name
                )


def test_small_states_by_rows_rewritten_and_in_a_batch():
    y0 = with_covariance()
    assert len(jax.tree.leaves(y0)) == 4  # the state, and the rows of the upper half

    def solve(gain):
        args = {**ARGS, "gain": gain}
        # Not by rows.
        y0 = Variation(jnp.asarray(Q0), covariance=jnp.eye(3))
        return end(TERM, CF2(), y0, args).covariance

    gains = jnp.linspace(0.0, 1.0, 10)
    many = cfjax.map_batch(solve, gains, chunk_size=4, progress=False).values
    with cfjax.rewriting(True):
        found = end(TERM, CF2(), y0, {**ARGS, "gain": gains[3]}).covariance
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(found, many[3], atol=1e-14)


def test_float32():
    def in_float32(t, q, args, dw):
        return QuaternionRotation(jnp.asarray(GAIN, jnp.float32) @ dw, frame="body", layout="wxyz")

    args = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), ARGS)
    term = VariationTerm(LieTerm(attitude), noise=in_float32, channels=2)

    @jax.jit
    def solve(q):
        y0 = term.start(0.0, q, args, covariance=P0, log_density=0.0)
        return end(term, CF2(), y0, args, num_steps=500)

    found = solve(Q0.astype(np.float32))
    assert found.covariance.dtype == found.log_density.dtype == jnp.float32
    # The method's error is a tenth of this.
    want = reference(1.0)
    np.testing.assert_allclose(found.covariance, want.covariance, atol=1e-5)
    np.testing.assert_allclose(found.log_density, want.log_density - 0.5, atol=1e-5)


@pytest.mark.slow
def test_diffeqsolve_with_control_output_and_event():
    steps = diffrax.SubSaveAt(steps=True)

    def solve(term, y0, norm, saveat, event=None) -> Any:
        return diffrax.diffeqsolve(
            term,
            cfjax.RKMK5(),
            0.0,
            2.0,
            0.1,
            y0,
            ARGS,
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8, norm=norm),
            saveat=saveat,
            event=event,
        )

    y0 = TERM.start(0.0, Q0, ARGS, transition=True, covariance=P0)
    stop = 1.05  # Where the time is 1.1.
    sol = solve(
        TERM,
        y0,
        lambda e: jnp.max(jnp.abs(e.state)),
        diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=[1.0]), steps]),
        diffrax.Event(lambda t, y, args, **kwargs: jnp.trace(y.covariance) > stop),
    )
    (_, ts), (within, ys) = sol.ts, sol.ys
    # Between steps of a tenth, with rates of 1, of which the norm sees the state alone.
    np.testing.assert_allclose(within.transition[0], reference(1.0).transition, atol=1e-5)
    np.testing.assert_allclose(within.covariance[0], reference(1.0).covariance, atol=1e-5)
    num_steps = int(sol.stats["num_accepted_steps"])
    traces = np.trace(ys.covariance[:num_steps], axis1=1, axis2=2)
    assert 1 < ts[num_steps - 1] < 2 and traces[-1] > stop >= traces[-2]
    last = reference(float(ts[num_steps - 1])).transition
    np.testing.assert_allclose(ys.transition[num_steps - 1], last, atol=3e-6)
    # The steps of the state alone.
    alone = solve(
        LieTerm(attitude),
        jnp.asarray(Q0),
        lambda e: jnp.max(jnp.abs(e)),
        diffrax.SaveAt(steps=True),
    )
    np.testing.assert_allclose(ts[:num_steps], alone.ts[:num_steps], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "adjoint",
    [diffrax.RecursiveCheckpointAdjoint(), diffrax.BacksolveAdjoint(), diffrax.DirectAdjoint()],
    ids=lambda a: type(a).__name__,
)
def test_adjoints_of_diffrax(adjoint):
    def loss(gain, solve):
        args = ARGS | {"gain": gain}
        y0 = TERM.start(0.0, Q0, args, covariance=np.eye(3), log_density=0.0)
        y = solve(y0, args)
        return jnp.trace(y.covariance) + y.log_density

    def by_diffrax(y0, args):
        options = dict(adjoint=adjoint, max_steps=32)
        ys = diffrax.diffeqsolve(TERM, CF4(), 0.0, 1.0, 0.05, y0, args, **options).ys
        return jax.tree.map(lambda x: x[-1], ys)

    with jax.numpy_dtype_promotion("standard"):
        found = jax.jit(jax.grad(lambda gain: loss(gain, by_diffrax)))(ARGS["gain"])
    equal = jax.jit(lambda gain: loss(gain, lambda y0, args: end(TERM, CF4(), y0, args)))
    expected = problems.central_difference(equal, ARGS["gain"], jnp.asarray(1.0), 1e-3)
    # The steps back of `BacksolveAdjoint` are others.
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_solvers(subtests):
    y0 = TERM.start(0.0, Q0, ARGS, transition=True, log_density=0.0)
    for solver, tol in (
        (CF2(), 2e-2),
        (cfjax.CG3(), 5e-3),
        (cfjax.ImplicitMidpoint(), 2e-2),
        (cfjax.CFEES25(), 1e-2),
        (cfjax.CF54(), 1e-5),
        (cfjax.RKMK5(), 1e-5),
    ):
        with subtests.test(solver=type(solver).__name__):
            found = end(TERM, solver, y0, ARGS, 2.0, 40)
            np.testing.assert_allclose(found.transition, reference(2.0).transition, atol=tol)


@pytest.mark.slow
def test_samples_agree_with_the_covariance():
    """Of the same function of noise, so small that first order is exact to the sampling error."""
    small = lambda t, q, args, dw: shaking(t, q, args, 0.1 * dw)  # noqa: E731
    term = VariationTerm(LieTerm(attitude), noise=small, channels=2)
    y = end(term, CF4(), term.start(0.0, Q0, ARGS, covariance=np.zeros((3, 3))), ARGS)
    count = 2000

    @jax.jit
    @jax.vmap
    def sample(key):
        path = diffrax.UnsafeBrownianPath((2,), key)
        terms = diffrax.MultiTerm(LieTerm(attitude), cfjax.LieControlTerm(small, path))
        return end(terms, CF2(), jnp.asarray(Q0), ARGS)

    qs = np.asarray(sample(jax.random.split(jax.random.key(5), count)))
    q, p = np.asarray(y.state), np.asarray(y.covariance)
    eta = 4 * velocities(q).T @ (qs - q).T  # to first order
    found = eta @ eta.T / count
    variance = (np.outer(np.diag(p), np.diag(p)) + p**2) / count
    assert np.all(np.abs(found - p) < 4.5 * np.sqrt(variance) + 0.02 * np.abs(p).max())


# Frames: of motions, with and without an axis in front, and of products


def adjoint(twist):
    """The matrix of the commutator of se(3), in the order omega, v."""
    w, v = hat(twist[:3]), hat(twist[3:])
    return np.block([[w, np.zeros((3, 3))], [v, w]])


TWIST = np.array([0.4, -0.3, 0.8, 1.0, 0.5, -0.7])
SPEED, TURN = 1.3, 0.9
MOTIONS = {
    "body": np.concatenate([Q0, [0.3, -0.2, 0.5]]),
    "fixed": np.concatenate([Q0[::-1], [0.1, 0.2, -0.7]]),
    "plane": np.array([1.0, 0, 0, 0]),
}


def motions(twist, plane):
    pose = dict(omega=twist[:3], v=twist[3:], layout="wxyz_xyz")
    return {
        "body": RigidMotion(**pose, frame="body"),
        "fixed": RigidMotion(**pose, frame="fixed"),
        "plane": PlanarMotion(omega=plane[0], v=plane[1:], frame="body", layout="unit_complex_xy"),
    }


def test_motions_of_constant_velocity():
    """Three motions with the same noise, whose exact covariance is an exponential."""
    rng = np.random.default_rng(3)
    gain, gain_of_plane = rng.normal(size=(6, 2)), np.array([[0.3, 0], [0, 0.1], [0.2, 0]])
    p0 = np.diag(np.linspace(0.1, 0.6, 15))
    velocity = jnp.asarray(TWIST), jnp.asarray([TURN, SPEED, 0.0])
    # A motion of the plane is one of space that turns about the third axis.
    of_plane = adjoint(np.array([0, 0, TURN, SPEED, 0, 0]))[2:5, 2:5]
    a = np.asarray(scipy.linalg.block_diag(-adjoint(TWIST), adjoint(TWIST), -of_plane))
    g = np.vstack([gain, gain, gain_of_plane])
    options: Any = dict(
        noise=lambda t, y, args, dw: motions(
            jnp.asarray(gain) @ dw, jnp.asarray(gain_of_plane) @ dw
        ),
        channels=2,
    )
    term = LieTerm(lambda t, y, args: motions(*args))
    rate = rates(VariationTerm(term, **options), Variation(MOTIONS, np.eye(15), p0), velocity)
    # A few units of rounding of entries of up to 4.
    np.testing.assert_allclose(rate.transition, a, rtol=0, atol=1e-15)
    np.testing.assert_allclose(rate.covariance, a @ p0 + p0 @ a.T + g @ g.T, rtol=0, atol=4e-15)
    # In one step of any method, as A is constant.
    definite = VariationTerm(term, **options, definite=True)
    y0 = Variation(MOTIONS, np.eye(15), p0)
    found = end(definite, cfjax.LieEuler(), problems.arrays(y0), velocity, 2.0, 1)
    phi, p = van_loan(a, g @ g.T, p0, 2.0)
    np.testing.assert_allclose(found.transition, phi, atol=1e-13 * np.abs(phi).max())
    np.testing.assert_allclose(found.covariance, p, atol=1e-13 * np.abs(p).max())


def test_leading_axes():
    """Two attitudes in one state have two frames; an axis of 1 in the field is broadcast."""
    omega, q0 = jnp.asarray([0.4, -0.3, 0.8]), np.stack([Q0, Q0[::-1]])
    term = VariationTerm(
        LieTerm(lambda t, q, args: QuaternionRotation(omega[None], frame="body", layout="wxyz"))
    )
    assert term.size(0.0, q0) == 6
    found = rates(term, term.start(0.0, q0, transition=True)).transition
    np.testing.assert_allclose(found, np.kron(np.eye(2), -hat(omega)), rtol=0, atol=1e-15)


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


def test_definite_stays_so_where_arrays_do_not():
    """Noise in the first of three, from P = 0, reaches the third one through the second."""

    def scaled_eigenvalue(p):
        d = np.sqrt(np.abs(np.diag(p)))
        d = np.where(d > 0, d, 1)
        return np.linalg.eigvalsh(p / np.outer(d, d))[0]

    def field(t, x, args):
        return jnp.stack([0 * x[0], (1 + t) * x[0], x[1]])

    def noise(t, x, args, dw):
        return jnp.stack([dw[0], 0 * dw[0], 0 * dw[0]])

    values = {}
    for definite in (False, True):
        term = VariationTerm(LieTerm(field), noise=noise, channels=1, definite=definite)
        y0 = Variation(jnp.ones(3), covariance=jnp.zeros((3, 3)))
        p = end(term, CF3(), y0, None, 1.0, 1).covariance
        np.testing.assert_allclose(p, p.T, atol=1e-16 * 9)
        values[definite] = scaled_eigenvalue(np.asarray(p))
    # Entries of the third with the first, and no variance of the third.
    assert values[False] < -1e-6
    assert values[True] > -1e-12


def test_a_bias_in_the_state_adds_its_share():
    """With the bias in the state, P is P + J P_b J^T, and J P_b with the bias.

    So are their rates, with the Jacobian J by the bias.
    """

    def with_bias(t, y, args):
        return {**imu(t, y, y["bias"]), "bias": None}

    def noise(t, y, args, dw):
        return {**gyro_noise(t, y, None, dw), "bias": None}

    rng = np.random.default_rng(2)
    p_bias, p, j = np.diag(np.arange(1.0, 7)), np.diag(np.arange(1.0, 10)), rng.normal(size=(9, 6))
    big = VariationTerm(LieTerm(with_bias), noise=noise, channels=3)
    state = {**IMU_START, "bias": np.asarray(BIAS)}
    # The keys of a dict are sorted.
    assert big.slices(0.0, state)["bias"] == slice(0, 6)
    joint = np.block([[p_bias, p_bias @ j.T], [j @ p_bias, p + j @ p_bias @ j.T]])
    found = rates(big, Variation(state, covariance=joint)).covariance
    small = VariationTerm(LieTerm(imu), noise=gyro_noise, channels=3, parameters=lambda b: b)
    rate = rates(small, Variation(IMU_START, covariance=p, sensitivity=j), BIAS)
    share = np.asarray(rate.sensitivity) @ p_bias
    want = rate.covariance + share @ j.T + j @ share.T
    # Sums of a dozen products of up to 10, 10 and 10.
    np.testing.assert_allclose(found[6:, 6:], want, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[6:, :6], share, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found[:6, :6], 0)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver",
    [
        cfjax.Projected(diffrax.Bosh3()),
        cfjax.RKMK(diffrax.Bosh3.tableau, coordinates="cayley"),
    ],
    ids=["projected", "cayley"],
)
def test_coordinates_of_a_step(solver):
    """`y' = k b y + y c`, whose flow is linear in the start, with each kind of coordinates."""
    b, c = hat([0.3, -0.5, 0.8]), np.array([[0.0, 0.7], [-0.7, 0.0]])
    basis = np.stack([hat(x) for x in np.eye(3)])

    def field(t, y, k):
        r, q = y["r"], y["columns"]
        return {
            "r": cfjax.LeftMatrix(k * b + r @ b.T @ r.T),
            "columns": cfjax.LowRankSkew(k * b @ q + q @ (c - k * (q.T @ b @ q)) / 2),
        }

    def noise(t, y, args, dw):
        turn = cfjax.LeftMatrix(jnp.tensordot(GAIN @ dw, basis, 1))
        return {"r": turn, "columns": None}

    rng = np.random.default_rng(4)
    y0 = {
        "r": scipy.linalg.expm(hat([0.2, 0.1, -0.4])),
        "columns": np.linalg.qr(rng.normal(size=(3, 2)))[0],
    }
    k, t = 1.2, 1.0
    term = VariationTerm(
        LieTerm(field), noise=noise, channels=2, parameters=lambda k: k, basis=basis
    )
    slices = term.slices(0.0, y0, k)
    covariance = np.zeros((9, 9))
    covariance[slices["r"], slices["r"]] = P0
    start = problems.arrays(Variation(y0, np.eye(9), covariance, np.zeros((9, 1))))
    # From steps of two sizes, by one program, to order 4.
    coarse, fine = (
        problems.in_pieces(term, solver, 0.0, t, start, k, num_steps=1000, pieces=n) for n in (1, 2)
    )
    found = jax.tree.map(lambda a, b: b + (b - a) / 7, coarse, fine)
    turn, other = scipy.linalg.expm(t * k * b), scipy.linalg.expm(t * c)
    phi, p = van_loan(k * b, GAIN @ GAIN.T, P0, t)
    # Of steps by a thousandth of a radian.
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=2e-11)
    transition = {name: found.transition[at, at] for name, at in slices.items()}
    close(transition["r"], phi)
    # Of changes along the manifold: turns of the columns.
    changes = np.stack([(x @ y0["columns"]).ravel() for x in basis], axis=1)
    close(transition["columns"] @ changes, np.kron(turn, other.T) @ changes)
    close(found.covariance[slices["r"], slices["r"]], p)
    velocities = {
        "r": t * np.array([0.3, -0.5, 0.8]),
        "columns": t * b @ turn @ y0["columns"] @ other,
    }
    for name, v in velocities.items():
        close(found.sensitivity[slices[name], 0], v.ravel())


# Log-densities


def su_flow(t, u, args):
    """On SU(n), the gradient of the real trace: towards the identity."""
    a = -(u - u.conj().T) / 2
    return cfjax.LeftMatrix(args * (a - jnp.trace(a) / len(u) * jnp.eye(len(u), dtype=u.dtype)))


def unitary(phases, seed=0):
    rng = np.random.default_rng(seed)
    n = len(phases)
    v = np.linalg.qr(rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n)))[0]
    return (v * np.exp(1j * np.asarray(phases))) @ v.conj().T


def growth_of_weight(phases, rates):
    """That of the logarithm of Weyl's weight, the product of sin((x_j - x_k) / 2)^2."""
    pairs = [(j, k) for j in range(len(phases)) for k in range(j)]
    return sum((rates[j] - rates[k]) / np.tan((phases[j] - phases[k]) / 2) for j, k in pairs)


def towards_identity(t, r, k):
    m = k / 2 * (r - r.T)
    return Rotation(-jnp.stack([m[2, 1], m[0, 2], m[1, 0]]))


def from_the_right(t, r, k):
    return cfjax.RightMatrix(jnp.cross(jnp.eye(3), towards_identity(t, r, k).omega))


def test_rates_of_log_densities(subtests):
    x, k, angle = np.array([0.4, -1.1, 2.0]), 0.8, 1.2
    axis = np.array([2.0, -1.0, 2.0]) / 3
    r, pole = scipy.linalg.expm(angle * hat(axis)), jnp.eye(5)[0]
    y = np.random.default_rng(1).normal(size=5)
    y /= np.linalg.norm(y)
    affine = np.array([[[1.0, 0], [0, 0]], [[0, 1.0], [0, 0]]])
    cases = {
        # Phases decouple, x' = -sin x, and are distributed with Weyl's weight.
        "U(3)": (
            lambda t, u, args: cfjax.LeftMatrix(-(u - u.conj().T) / 2),
            algebra_basis("u", 3),
            unitary(x),
            np.cos(x).sum() - growth_of_weight(x, -np.sin(x)),
        ),
        # From phases (x, -x, 0): x' = -sin x, and to first order beside it rates cos x and
        # (cos x + 2) / 3 of the two kinds of phases.
        "SU(3)": (
            su_flow,
            algebra_basis("su", 3),
            unitary([angle, -angle, 0.0]),
            k * (np.cos(angle) + (np.cos(angle) + 2) / 3)
            - k * growth_of_weight([angle, -angle, 0.0], np.sin([-angle, angle, 0.0])),
        ),
        # The angle falls as -k sin(angle), with the weight sin(angle / 2)^2.
        "SO(3)": (towards_identity, None, r, k * (1 + 2 * np.cos(angle))),
        "SO(3) from the right": (
            from_the_right,
            algebra_basis("so", 3),
            r,
            k * (1 + 2 * np.cos(angle)),
        ),
        # y' = k (e - (e.y) y) has the divergence -4 k e.y.
        "a sphere": (lambda t, y, k: cfjax.SphereRotation(k * pole), None, y, 4 * k * y[0]),
        # Affine maps of a line, whose tr ad is not 0. Motions from the left keep Haar's measure.
        "affine maps": (
            lambda t, y, k: cfjax.LeftMatrix(jnp.tensordot(jnp.stack([k, -k]), affine, 1)),
            affine,
            np.array([[2.0, 0.3], [0, 1]]),
            0.0,
        ),
    }
    for name, (field, basis, point, expected) in cases.items():
        with subtests.test(case=name):
            term = VariationTerm(LieTerm(field), basis=basis)
            n = term.size(0.0, point, k)
            beside = rates(term, Variation(point, np.eye(n), log_density=0.0), k)
            # Some ten units of rounding.
            np.testing.assert_allclose(beside.log_density, expected, rtol=0, atol=4e-15)
            # Of the bracket only the transition has the trace.
            trace = k if name == "affine maps" else -expected
            if name != "a sphere":
                np.testing.assert_allclose(jnp.trace(beside.transition), trace, rtol=0, atol=1e-14)


def test_arrays_alone_take_any_solver_of_diffrax():
    """x' = sin x: the volume grows by sin x(t) / sin x(0)."""
    x0 = np.array([0.4, 1.3, 2.5])
    term = VariationTerm(diffrax.ODETerm(lambda t, x, args: jnp.sin(x)))
    y0 = term.start(0.0, x0, transition=True, log_density=0.3)
    y = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.02, y0).ys
    growth = np.sin(np.asarray(y.state[-1])) / np.sin(x0)
    np.testing.assert_allclose(y.transition[-1], np.diag(growth), atol=1e-8)
    np.testing.assert_allclose(y.log_density[-1], 0.3 - np.log(growth).sum(), atol=1e-8)


# Bases


def test_bases():
    for kind, n in [("so", 3), ("so", 4), ("su", 2), ("su", 3), ("u", 2), ("gl", 2)]:
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


def test_terms_of_equal_bases_share_a_program():
    so3 = algebra_basis("so", 3)
    term, same, other = (VariationTerm(LieTerm(attitude), basis=x) for x in (so3, so3 + 0, -so3))
    structure, of_same, of_other = map(jax.tree.structure, (term, same, other))
    assert structure == of_same != of_other
    assert hash(structure) == hash(of_same)


# Errors


def term_of(**kwargs):
    return VariationTerm(LieTerm(attitude), **kwargs)


def start(options: Any = None, y0: Any = Q0, args: Any = ARGS, **carried):
    return term_of(**(options or {})).start(0.0, y0, args, **carried)


def start_of_matrix(field, basis):
    return VariationTerm(LieTerm(field), basis=basis).start(
        0.0, np.eye(2, dtype=complex), transition=True
    )


def complex_field(t, u, args):
    return cfjax.LeftMatrix(u - u.conj().T)


def noise(frame, shift):
    def fun(t, q, args, dw):
        return QuaternionRotation(shift + dw, frame=frame, layout="wxyz")

    return dict(noise=fun, channels=3)


def short_of_noise(t, q, args, dw):
    return shaking(t, q, args, jnp.stack([dw[0], dw[2]]))


SO3, SQUARE = algebra_basis("so", 3), np.eye(3)
OF_ANOTHER = {**ARGS, "of another": np.ones(3, np.float32)}
ERRORS = [
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
    (lambda: term_of(basis=SO3[:2]), "closed under the commutator"),
    (lambda: algebra_basis("sp", 2), "kind must be"),
    (lambda: algebra_basis("su", 1), "n must be an int of at least 2"),
    (lambda: start(), "must carry something"),
    (lambda: start(sensitivity=True), "sensitivity needs parameters"),
    (lambda: start(covariance=np.eye(4)), r"shape \(3, 3\)"),
    (lambda: start(covariance=True), "got True"),
    (lambda: start(y0=Variation(Q0), transition=True), "the state alone"),
    (lambda: start(dict(probes=np.ones((2, 4))), log_density=0.0), r"must have shape \(k, 3\)"),
    (lambda: start(dict(parameters=lambda a: 3), sensitivity=True), "must be a place in args"),
    (
        lambda: start(dict(parameters=lambda a: 2 * a["rate"]), sensitivity=True),
        r"parameters must be a place in args, .* got a function that returns f64\[3\]",
    ),
    (
        lambda: start(
            dict(parameters=lambda a: a["of another"]), args=OF_ANOTHER, sensitivity=True
        ),
        r"parameters must have the precision of the state, float64, got f32\[3\]",
    ),
    (lambda: start(covariance=1j * SQUARE), "covariance must be r"),
    (lambda: start(transition=1j * SQUARE), "transition must be r"),
    (lambda: start(log_density=1j), "log_density must be real"),
    (lambda: start(log_density=True), "a number, got True"),
    (lambda: TERM.start("0", Q0, ARGS, transition=True), "t0 must be a real scalar"),
    (
        lambda: start(dict(noise=short_of_noise, channels=2), covariance=SQUARE),
        "noise: The field reads an entry that its increment does not have",
    ),
    (lambda: start_of_matrix(complex_field, None), "Name the basis"),
    (lambda: start(dict(basis=SO3), transition=True), "leave it out"),
    (
        lambda: start_of_matrix(complex_field, algebra_basis("su", 3)),
        r"basis must have matrices of shape \(2, 2\)",
    ),
    (lambda: start(noise("fixed", 0.0), covariance=SQUARE), "same frame"),
    (lambda: start(noise("body", 1.0), covariance=SQUARE), "noise: .*linear in increment"),
    (lambda: end(term_of(), CF4(), jnp.asarray(Q0), ARGS), "is a cfjax.Variation"),
    (lambda: end(TERM, cfjax.Magnus4(), with_everything(), ARGS), "depend"),
]


def test_errors_when_a_program_is_traced(no_shape_hook, subtests):
    for number, (fun, text) in enumerate(ERRORS):
        with (
            subtests.test(case=f"{number}: {text}"),
            pytest.raises((TypeError, ValueError), match=text),
        ):
            fun()


def test_errors_at_run_time(subtests):
    outside = lambda t, u, args: cfjax.LeftMatrix(1j * u)  # noqa: E731
    for fun, text in (
        (lambda: start(covariance=np.triu(np.ones((3, 3)))), "covariance must be symmetric"),
        (
            lambda: start(covariance=np.diag([1.0, -1e-3, 1.0])),
            "covariance must be positive semidefinite",
        ),
        (lambda: start_of_matrix(outside, algebra_basis("su", 2)), "must be in the span of basis"),
    ):
        # Called from Python, the message alone.
        message = rf"^[^\n]*{text}[^\n]*$"
        with subtests.test(case=text), pytest.raises(eqx.EquinoxRuntimeError, match=message):
            fun()


@pytest.mark.slow
def test_projected_attitudes_have_the_variations_of_other_methods():
    """Of order 8, so the difference is rounding of a hundred steps, and errors as small."""

    def field(t, y, k):
        w = jnp.stack([jnp.cos(t), k * y["q"][1], 0.5 - y["p"][0]])
        return {
            "q": cfjax.QuaternionRotation(w, frame="body", layout="wxyz"),
            "p": cfjax.RigidMotion(omega=w[::-1], v=w, frame="fixed", layout="xyz_wxyz"),
        }

    q = np.array([1.0, -3.0, 5.0, 1.0]) / 6
    y0 = {"q": q, "p": np.r_[0.3, 0.2, 0.1, q]}
    term = VariationTerm(LieTerm(field), parameters=lambda k: k)
    n = sum(s.stop - s.start for s in term.slices(0.0, y0, 0.7).values())
    start = problems.arrays(
        Variation(y0, np.eye(n), np.diag(np.arange(1.0, n + 1)), np.zeros((n, 1)))
    )
    ends = [
        cfjax.integrate(term, solver, 0.0, 2.0, start, 0.7, num_steps=100).ys
        for solver in (cfjax.RKMK8(), cfjax.Projected(diffrax.Dopri8()))
    ]
    a, b = (problems.flat(jax.tree.map(lambda x: np.asarray(x[-1]), end)) for end in ends)
    assert np.abs(a).max() > 1
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
