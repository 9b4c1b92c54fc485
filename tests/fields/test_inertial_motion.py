"""Motions by inertial readings: exact in one step, orders on a known window, and what is refused.

Reference flows are SciPy's exponentials from the left and from the right: `exp(G) X exp(Y)`.
"""

from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation

import cfjax
from cfjax import InertialMotion

EPS = 2.0**-52
ANGLES = np.array([0, 1e-160, 1e-9, 1e-4, 0.5, np.pi / 2, np.pi, 6.28, 2 * np.pi, 3 * np.pi])
AXIS = np.array([2.0, -3.0, 6.0]) / 7
NAMES = InertialMotion.coordinates
FORCE, GRAVITY = np.array([0.9, 0.2, -0.6]), np.array([0.4, -1.1, 0.5])
# What follows omega: force, gravity, time, and the two shifts; and directions of all coordinates.
REST = (FORCE, GRAVITY, np.array(0.7), np.array([-0.3, 0.8, 0.1]), np.array([0.2, -0.5, -0.9]))
ALONG = (np.array([0.4, 0.2, -0.7]), *(np.roll(x, 1) if x.ndim else x - 2 for x in REST))
Q = np.array([0.1, -0.5, 0.5, 0.7])
VECTOR = np.concatenate([Q, [0.2, 0.7, -0.4], [1.5, -0.3, 0.8]])


def to_matrix(x):
    m = np.eye(5)
    turn = Rotation.from_quat(np.roll(x[:4], -1)).as_matrix()
    m[:3] = np.column_stack([turn, x[4:7], x[7:]])
    return m


MATRIX = to_matrix(VECTOR)
START = {"vector": jnp.asarray(VECTOR), "matrix": jnp.asarray(MATRIX)}


def hat(w):
    x, y, z = w
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def from_right(w, f, g, t, r, s):
    m = np.zeros((5, 5))
    m[:3] = np.column_stack([hat(w), f, r])
    m[3, 4] = t
    return m


def from_left(w, f, g, t, r, s):
    m = np.zeros((5, 5))
    m[:3, 3], m[:3, 4], m[3, 4] = g, s, -t
    return m


def motion(*coordinates):
    return InertialMotion(**dict(zip(NAMES, coordinates, strict=True)), layout="wxyz_v_p")


def imu(omega, force, gravity=GRAVITY, time=1.0):
    return InertialMotion(omega=omega, force=force, gravity=gravity, time=time, layout="wxyz_v_p")


def exact(coordinates, along, kind):
    """The end of the flow, and its derivative, by SciPy."""
    (left, dl), (right, dr) = (
        scipy.linalg.expm_frechet(part(*coordinates), part(*along))
        for part in (from_left, from_right)
    )
    end, slope = left @ MATRIX @ right, dl @ MATRIX @ right + left @ MATRIX @ dr
    if kind == "matrix":
        return end, slope
    turns = []
    for w in (coordinates[0], along[0]):
        m = np.zeros((4, 4))
        m[0, 1:], m[1:, 0], m[1:, 1:] = -w, w, -hat(w)
        turns.append(m / 2)
    pairs = zip(scipy.linalg.expm_frechet(*turns), (end, slope), strict=True)
    return tuple(np.r_[m @ Q, x[:3, 3], x[:3, 4]] for m, x in pairs)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_flow_and_derivatives(dtype):
    rng = np.random.default_rng(1)
    weights = {kind: jnp.asarray(rng.normal(size=x.shape), dtype) for kind, x in START.items()}
    rest, along = (tuple(jnp.asarray(x, dtype) for x in xs) for xs in (REST, ALONG))

    @jax.jit
    @jax.vmap
    def run(w):
        found = {}
        for kind, x in START.items():
            flow = lambda *c, x=x: motion(*c).flow(x.astype(dtype))  # noqa: E731
            end, forward = jax.jvp(flow, (w, *rest), along)
            slopes = jax.vjp(flow, w, *rest)[1](weights[kind])
            reverse = sum(jnp.sum(a * b) for a, b in zip(slopes, along, strict=True))
            found[kind] = end, forward, reverse
        return found

    for kind, found in run((ANGLES[:, None] * AXIS).astype(dtype)).items():
        assert found[0].dtype == dtype
        for k, angle in enumerate(ANGLES):
            end, slope = exact((angle * AXIS, *REST), ALONG, kind)
            got = [x[k] for x in found]
            # The angle is known to a unit of rounding of itself, and so is all that turns with it.
            # Entries are sums of some twenty terms of size 2, derivatives of some fifty.
            atol = 20 * np.finfo(dtype).eps * (1 + angle)
            where = f"{kind} at {angle}"
            np.testing.assert_allclose(got[0], end, rtol=0, atol=atol, err_msg=where)
            np.testing.assert_allclose(got[1], slope, rtol=0, atol=4 * atol, err_msg=where)
            paired = np.sum(np.asarray(weights[kind], float) * slope)
            np.testing.assert_allclose(got[2], paired, rtol=0, atol=50 * atol, err_msg=where)


def test_zero_is_the_identity_exactly():
    for x in START.values():
        still = motion(*(np.zeros_like(a) for a in ALONG))
        for field in (still, cfjax.combine((0.0,), [motion(AXIS, *REST)])):
            np.testing.assert_array_equal(field.flow(x), x)
            np.testing.assert_array_equal(field.tangent(x), np.zeros(x.shape))


@pytest.mark.parametrize(("kind", "axes"), [("vector", (2, 3)), ("matrix", ())])
def test_promises(kind, axes):
    """Among them that the tangent is the derivative of the flow, and the sign of the bracket."""
    rng = np.random.default_rng(2)
    x = jnp.broadcast_to(START[kind], (*axes, *START[kind].shape))
    fields = [motion(*(rng.normal(size=axes + a.shape) for a in ALONG)) for _ in range(3)]
    cfjax.check_field(fields, x)


def test_brackets_are_commutators():
    """As of both matrices; the bracket of two plain motions has shifts, and no gravity or time."""
    a, b = (0.3 * AXIS, FORCE, GRAVITY, 1.0), (-FORCE, AXIS, FORCE, 0.25)
    found = imu(*a).bracket(imu(*b))
    a, b = ((*x, np.zeros(3), np.zeros(3)) for x in (a, b))
    coordinates = [np.asarray(getattr(found, name)) for name in NAMES]
    for part, sign in [(from_left, 1), (from_right, -1)]:
        commutator = part(*a) @ part(*b) - part(*b) @ part(*a)
        np.testing.assert_allclose(part(*coordinates), sign * commutator, rtol=0, atol=4 * EPS)
    np.testing.assert_array_equal(found.gravity, np.zeros(3))
    assert found.time == 0
    assert min(np.max(np.abs(found.body_shift)), np.max(np.abs(found.fixed_shift))) > 0.1


def test_dexpinv_is_its_series_and_inverts_below_a_full_turn():
    a, b = motion(0.6 * AXIS, *REST), motion(*ALONG)
    u, v = (np.concatenate([np.ravel(getattr(x, name)) for name in NAMES]) for x in (a, b))
    ends = np.cumsum([x.size for x in ALONG])

    def split(x):
        parts = np.split(x, ends[:-1])
        return motion(*(p.reshape(c.shape) for p, c in zip(parts, ALONG, strict=True)))

    brackets = [a.bracket(split(e)) for e in np.eye(u.size)]
    ad = np.stack(
        [np.concatenate([np.ravel(getattr(x, name)) for name in NAMES]) for x in brackets], axis=1
    )
    # phi_1 of ad, in the corner of an exponential.
    n = u.size
    big = np.zeros((2 * n, 2 * n))
    big[:n, :n], big[:n, n:] = ad, np.eye(n)
    want = np.linalg.solve(scipy.linalg.expm(big)[:n, n:], v)
    found = a.dexpinv(b, 20)
    got = np.concatenate([np.ravel(getattr(found, name)) for name in NAMES])
    np.testing.assert_allclose(got, want, rtol=0, atol=40 * EPS)
    assert a.has_dexpinv() and not cfjax.combine((11.0,), [a]).has_dexpinv()


@pytest.mark.representatives(1)
@pytest.mark.parametrize("kind", START)
def test_constant_readings_are_exact_in_one_step(kind):
    """Seven seconds; of a turn of 6.2 radians for the method that must invert the exponential."""
    for solver, rate in [(cfjax.CF4(), 2.0), (cfjax.Magnus4(), 2.0), (cfjax.RKMK5(), 0.88)]:
        term = cfjax.LieTerm(lambda t, x, rate: imu(rate * AXIS, FORCE))
        sol = cfjax.integrate(term, solver, 0.0, 7.0, START[kind], jnp.asarray(rate), num_steps=1)
        coordinates = (rate * AXIS, FORCE, GRAVITY, 1.0, np.zeros(3), np.zeros(3))
        ends = [scipy.linalg.expm(7 * part(*coordinates)) for part in (from_left, from_right)]
        want, found = ends[0] @ MATRIX @ ends[1], sol.ys[-1]
        found = to_matrix(np.asarray(found)) if kind == "vector" else found
        # The numbers are 40, with an angle of 14.
        np.testing.assert_allclose(found, want, rtol=0, atol=40 * 40 * EPS)


# A window with the attitude exp(alpha e1) exp(beta e3) and a force that is a polynomial.

ALPHA, BETA = Polynomial([0.0, 0.7, 0.4, -0.5]), Polynomial([0.2, -0.9, 0.3, 0.8])
FORCES = [Polynomial([0.3, 1.0, -2.0]), Polynomial([-1.0, 0.5, 1.0]), Polynomial([9.0, -1.0, 0.7])]


def window(t, x, args):
    def value(p):
        return jnp.polyval(jnp.asarray(p.coef[::-1]), t)

    b, da, db = map(value, (BETA, ALPHA.deriv(), BETA.deriv()))
    omega = jnp.stack([da * jnp.cos(b), -da * jnp.sin(b), db])
    force = jnp.stack([value(p) for p in FORCES])
    return imu(omega, force)


def attitude(t):
    turns = Rotation.from_rotvec(np.outer(ALPHA(t), [1, 0, 0]))
    return turns * Rotation.from_rotvec(np.outer(BETA(t), [0, 0, 1]))


def after_window():
    """By quadrature, which is exact to rounding for functions as smooth as these."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    t, weights = (1 + nodes) / 2, weights / 2
    accelerations = attitude(t).apply(np.stack([p(t) for p in FORCES], axis=1)) + GRAVITY
    x = np.concatenate([np.roll(attitude([0.0]).as_quat()[0], 1), VECTOR[4:]])
    velocity = x[4:7] + weights @ accelerations
    position = x[7:] + x[4:7] + (weights * (1 - t)) @ accelerations
    q = np.roll(attitude([1.0]).as_quat()[0], 1)
    return x, np.concatenate([q, velocity, position])


@pytest.mark.parametrize(
    ("solver", "order", "num_steps"),
    [
        (cfjax.CF4(), 4, 20),
        (cfjax.Magnus4(), 4, 20),
        (cfjax.RKMK5(), 5, 10),
        (cfjax.Magnus6(), 6, 8),
    ],
    ids=["CF4", "Magnus4", "RKMK5", "Magnus6"],
)
def test_orders_on_a_window(solver, order, num_steps):
    y0, want = map(jnp.asarray, after_window())
    errors = []
    for n in (num_steps, 2 * num_steps):
        term = cfjax.LieTerm(window)
        end = cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=n).ys[-1]
        # Both signs of a quaternion are one attitude.
        end = end.at[:4].multiply(jnp.sign(end[:4] @ want[:4]))
        errors.append(np.max(np.abs(end - want)))
    # Above the rounding of the reference.
    assert errors[1] > 1e-13
    assert abs(np.log2(errors[0] / errors[1]) - order) < 0.3


def test_rkmk8_on_a_window():
    y0, want = map(jnp.asarray, after_window())
    end = cfjax.integrate(cfjax.LieTerm(window), cfjax.RKMK8(), 0.0, 1.0, y0, num_steps=20).ys[-1]
    end = end.at[:4].multiply(jnp.sign(end[:4] @ want[:4]))
    # Rounding of numbers of 10.
    np.testing.assert_allclose(end, want, rtol=0, atol=200 * EPS)


def test_gradients_of_a_solve():
    """By readings, gravity and time, also at zero angular velocity, against differences."""

    def field(t, x, args):
        omega, force, gravity, time = args
        return imu(jnp.cos(t) * omega, force + t * omega, gravity, time)

    @jax.jit
    def loss(args):
        sol = cfjax.integrate(
            cfjax.LieTerm(field), cfjax.CF4(), 0.0, 1.0, START["vector"], args, num_steps=3
        )
        return jnp.sum(jnp.sin(jnp.arange(10.0)) * sol.ys[-1])

    gradient = jax.jit(jax.grad(loss))
    derivative = jax.jit(lambda a, d: jax.jvp(loss, (a,), (d,))[1])
    direction = tuple(map(jnp.asarray, (FORCE, GRAVITY, AXIS, -0.4)))
    for size in (0.0, 1.0):
        args = tuple(map(jnp.asarray, (size * AXIS, FORCE, GRAVITY, 0.7)))
        pairs = zip(gradient(args), direction, strict=True)
        reverse, forward = sum(jnp.sum(a * b) for a, b in pairs), derivative(args, direction)
        values = {
            k: loss(tuple(a + k * 1e-3 * d for a, d in zip(args, direction, strict=True)))
            for k in (-2, -1, 1, 2)
        }
        differences = (values[-2] - 8 * values[-1] + 8 * values[1] - values[2]) / 12e-3
        assert abs(reverse) > 0.01
        np.testing.assert_allclose(reverse, forward, rtol=0, atol=100 * EPS)
        # 1e-12 / 30 of a fifth derivative of some ten, and rounding over the step.
        np.testing.assert_allclose(forward, differences, rtol=0, atol=1e-11)


def test_leading_axes_vmap_and_jit():
    rng = np.random.default_rng(3)
    omega, force = (jnp.asarray(rng.normal(size=(2, 3))) for _ in range(2))
    x = jnp.stack([VECTOR, to_vector(0.3 * AXIS)])
    alone = jnp.stack([imu(omega[k], force[k]).flow(x[k]) for k in range(2)])
    together = imu(omega, force)
    # One gravity and one time for all of them.
    assert together.gravity.shape == (2, 3) and together.time.shape == (2,)
    vmapped = jax.jit(jax.vmap(lambda w, f, x: imu(w, f).flow(x)))(omega, force, x)
    for found in (together.flow(x), vmapped):
        np.testing.assert_allclose(found, alone, rtol=0, atol=20 * EPS)
    one, many = imu(omega[:1], force[:1]), imu(*(jnp.stack([a[0]] * 2) for a in (omega, force)))
    np.testing.assert_allclose(one.flow(x), many.flow(x), rtol=0, atol=20 * EPS)
    matrices = jnp.stack([to_matrix(np.asarray(y)) for y in x])
    ends = jnp.stack([to_matrix(np.asarray(y)) for y in alone])
    np.testing.assert_allclose(together.flow(matrices), ends, rtol=0, atol=40 * EPS)


def to_vector(rotvec):
    q = np.roll(Rotation.from_rotvec(rotvec).as_quat(), 1)
    return np.concatenate([q, VECTOR[4:]])


def test_a_path_that_drives_the_readings():
    """Noise has neither time nor gravity. Along a straight path it adds to constant readings."""

    def noise(t, x, args, dw):
        return imu(0.2 * dw[:3], 0.5 * dw[3:], gravity=jnp.zeros(3), time=0.0)

    rates = jnp.asarray([0.3, -1.0, 2.0, 0.4, 0.7, -0.2])
    path = diffrax.LinearInterpolation(jnp.array([0.0, 3.0]), jnp.stack([0 * rates, 3 * rates]))
    drift = cfjax.LieTerm(lambda t, x, args: imu(AXIS, FORCE))
    terms = diffrax.MultiTerm(drift, cfjax.LieControlTerm(noise, path))
    found = cfjax.integrate(terms, cfjax.CF4(), 0.0, 3.0, START["vector"], num_steps=1).ys[-1]
    both = cfjax.combine((3.0,), [imu(AXIS + 0.2 * rates[:3], FORCE + 0.5 * rates[3:])])
    np.testing.assert_allclose(found, both.flow(START["vector"]), rtol=0, atol=100 * EPS)


def test_brownian_noise():
    """It moves neither the position by itself, nor the velocity by gravity."""

    def noise(t, x, args, dw):
        return imu(0.2 * dw[:3], 0 * dw[3:], gravity=0 * dw[:3], time=0.0)

    path = diffrax.VirtualBrownianTree(0.0, 1.0, 1e-3, (6,), jax.random.key(0))
    term = cfjax.LieControlTerm(noise, path)
    end = cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, START["vector"], num_steps=10).ys[-1]
    np.testing.assert_array_equal(end[4:], VECTOR[4:])
    assert np.max(np.abs(end[:4] - Q)) > 1e-3
    np.testing.assert_allclose(end[:4] @ end[:4], 1.0, rtol=0, atol=8 * EPS)


def test_rewriting_changes_rounding_only():
    def field(t, x, args):
        return imu(jnp.sin(x[4:7] + t), jnp.cos(x[7:]))

    ends = []
    for on in (True, False):
        with cfjax.rewriting(on):
            run = jax.jit(
                lambda x: cfjax.integrate(
                    cfjax.LieTerm(field), cfjax.CF4(), 0.0, 1.0, x, num_steps=5
                ).ys[-1]
            )
            ends.append(run(START["vector"]))
    np.testing.assert_allclose(*ends, rtol=0, atol=200 * EPS)


# What is refused, at trace time


def ones(layout: Any = "wxyz_v_p", dtype=np.float64, **shapes):
    cores = dict.fromkeys(NAMES, (3,)) | {"time": ()} | shapes
    arrays = {name: jnp.ones(shape, dtype) for name, shape in cores.items()}
    return InertialMotion(**arrays, layout=layout)


@pytest.mark.parametrize(
    ("make", "kind", "text"),
    [
        (
            lambda: ones(omega=(2,)),
            ValueError,
            r"omega must have shape \(3,\) or \(\*batch, 3\), got \(2,\)",
        ),
        (
            lambda: ones(omega=()),
            ValueError,
            r"omega must have shape \(3,\) or \(\*batch, 3\), got \(\)",
        ),
        (
            lambda: ones(omega=(5, 3)),
            ValueError,
            r"force must have shape \(5, 3\) where omega has \(5, 3\), got \(3,\)",
        ),
        (
            lambda: ones(omega=(5, 3), force=(5, 3), gravity=(4, 3)),
            ValueError,
            r"gravity must have shape \(3,\) or \(5, 3\) where omega has \(5, 3\), got \(4, 3\)",
        ),
        (
            lambda: ones(time=(1,)),
            ValueError,
            r"time must have shape \(\) where omega has \(3,\), got \(1,\)",
        ),
        (
            lambda: imu(jnp.ones(3), jnp.ones(3), gravity=jnp.ones(3, np.float32)),
            TypeError,
            "omega, force, gravity, time, body_shift and fixed_shift must have one dtype, got "
            "float64 and float32",
        ),
        (lambda: ones(dtype=np.int32), TypeError, "omega must be float32 or float64, got int32"),
        (
            lambda: ones(layout="wxyz"),
            ValueError,
            r"layout must be one of \('wxyz_v_p', .*'p_v_xyzw'\), got 'wxyz'",
        ),
        (
            lambda: ones(layout=None).flow(jnp.ones(10)),
            TypeError,
            r"InertialMotion needs a layout for poses of shape \(10,\): layout=\"wxyz_v_p\"",
        ),
        (
            lambda: ones().flow(jnp.ones(7)),
            ValueError,
            r"InertialMotion with omega of shape \(3,\) acts on shapes \(5, 5\) and \(10,\), got "
            r"\(7,\)",
        ),
        (
            lambda: ones().flow(jnp.ones((8, 5, 5))),
            ValueError,
            r"give the coordinates leading axes: omega of shape \(8, 3\)",
        ),
        (
            lambda: ones().flow(jnp.ones(10, np.float32)),
            TypeError,
            "InertialMotion with omega in float64 acts on points in float64, got float32",
        ),
        (
            lambda: ones().bracket(ones(layout="p_v_wxyz")),
            ValueError,
            "two InertialMotions: both must have the same layout, got layout='wxyz_v_p' and "
            "layout='p_v_wxyz'",
        ),
        (
            lambda: ones().bracket(cfjax.Rotation(np.ones(3))),
            TypeError,
            "Cannot compute the bracket of InertialMotion and Rotation: both must be of one class",
        ),
    ],
)
def test_errors(make, kind, text, no_shape_hook):
    with pytest.raises(kind, match=text):
        make()


def test_starts_off_the_manifold():
    term = cfjax.LieTerm(lambda t, x, args: imu(AXIS, FORCE))
    solve = partial(cfjax.integrate, term, cfjax.LieEuler(), 0.0, 1.0, num_steps=1)
    with pytest.raises(RuntimeError, match="y0 must have a unit quaternion in its first 4 entries"):
        solve(START["vector"] + 0.1)
    with pytest.raises(RuntimeError, match="y0 must have a rotation, of determinant 1, before its"):
        solve(START["matrix"].at[3, 4].set(1e-3))
