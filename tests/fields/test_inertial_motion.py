"""Motions by inertial readings: exact in one step, orders on a known window, and what is refused.

Reference flows are SciPy's exponentials from the left and from the right: `exp(G) X exp(Y)`.
"""

import re
from typing import Any, cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.polynomial import Polynomial
from problems import hat
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


def exact(coordinates, along):
    """The end of the flow of the vector, and its derivative, by SciPy."""
    (left, dl), (right, dr) = (
        scipy.linalg.expm_frechet(part(*coordinates), part(*along))
        for part in (from_left, from_right)
    )
    end, slope = left @ MATRIX @ right, dl @ MATRIX @ right + left @ MATRIX @ dr
    turns = []
    for w in (coordinates[0], along[0]):
        m = np.zeros((4, 4))
        m[0, 1:], m[1:, 0], m[1:, 1:] = -w, w, -hat(w)
        turns.append(m / 2)
    pairs = zip(scipy.linalg.expm_frechet(*turns), (end, slope), strict=True)
    return tuple(np.r_[m @ Q, x[:3, 3], x[:3, 4]] for m, x in pairs)


def test_flow_and_derivatives_of_a_vector():
    weights = np.random.default_rng(1).normal(size=10)

    def of(dtype):
        x, *arrays = (jnp.asarray(a, dtype) for a in (VECTOR, weights, *REST, *ALONG))
        w, rest, along = arrays[0], tuple(arrays[1:6]), tuple(arrays[6:])
        flow = lambda *c: motion(*c).flow(x)  # noqa: E731

        def derivatives(omega):
            end, forward = jax.jvp(flow, (omega, *rest), along)
            slopes = zip(jax.vjp(flow, omega, *rest)[1](w), along, strict=True)
            return end, forward, sum(jnp.sum(a * b) for a, b in slopes)

        return jax.vmap(derivatives)((ANGLES[:, None] * AXIS).astype(dtype))

    dtypes = (np.float64, np.float32)
    run = jax.jit(lambda: [of(dtype) for dtype in dtypes])
    for dtype, found in zip(dtypes, run(), strict=True):
        assert found[0].dtype == dtype
        for k, angle in enumerate(ANGLES):
            end, slope = exact((angle * AXIS, *REST), ALONG)
            # The angle is known to a unit of rounding of itself, and so is all that turns with it.
            # Entries are sums of some twenty terms of size 2, derivatives of some fifty.
            atol = 20 * np.finfo(dtype).eps * (1 + angle)
            wants = (end, atol), (slope, 4 * atol), (np.sum(weights * slope), 50 * atol)
            for x, (want, atol) in zip(found, wants, strict=True):
                np.testing.assert_allclose(x[k], want, rtol=0, atol=atol, err_msg=str(angle))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "axes"), [("vector", (2, 3)), ("matrix", ())])
def test_promises(kind, axes):
    """Among them that the tangent is the derivative of the flow, and the sign of the bracket."""
    rng = np.random.default_rng(2)
    x = jnp.broadcast_to(START[kind], (*axes, *START[kind].shape))
    fields = [motion(*(rng.normal(size=axes + a.shape) for a in ALONG)) for _ in range(3)]
    cfjax.check_field(fields, x)


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


def test_constant_readings_are_exact_in_one_step():
    """Seven seconds; of a turn of 6.2 radians for the method that must invert the exponential."""
    y0 = START["vector"]
    for solver, rate in [(cfjax.CF4(), 2.0), (cfjax.Magnus4(), 2.0), (cfjax.RKMK5(), 0.88)]:
        term = cfjax.LieTerm(lambda t, x, rate: imu(rate * AXIS, FORCE))
        sol = cfjax.integrate(term, solver, 0.0, 7.0, y0, jnp.asarray(rate), num_steps=1)
        coordinates = (rate * AXIS, FORCE, GRAVITY, 1.0, np.zeros(3), np.zeros(3))
        ends = [scipy.linalg.expm(7 * part(*coordinates)) for part in (from_left, from_right)]
        want, found = ends[0] @ MATRIX @ ends[1], to_matrix(np.asarray(sol.ys[-1]))
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
    ("solver", "order", "num_steps"), [(cfjax.CF4(), 4, 20), (cfjax.Magnus6(), 6, 8)]
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


def test_one_gravity_and_one_time_for_all_leading_axes():
    rng = np.random.default_rng(3)
    omega, force = (jnp.asarray(rng.normal(size=(2, 3))) for _ in range(2))
    other = np.concatenate([np.roll(Rotation.from_rotvec(0.3 * AXIS).as_quat(), 1), VECTOR[4:]])
    x = jnp.stack([VECTOR, other])
    together = imu(omega, force)
    assert together.gravity.shape == (2, 3) and together.time.shape == (2,)
    alone = jax.jit(jax.vmap(lambda w, f, x: imu(w, f).flow(x)))(omega, force, x)
    np.testing.assert_allclose(together.flow(x), alone, rtol=0, atol=20 * EPS)
    # In the frame of the body it has the same velocity.
    for field, point in [(together, x), (imu(omega[0], force[0]), START["matrix"])]:
        velocity = cfjax.tangent(field.framed(point), point)
        np.testing.assert_allclose(velocity, field.tangent(point), rtol=0, atol=20 * EPS)


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


def ones(layout: Any = "wxyz_v_p", **shapes):
    cores = dict.fromkeys(NAMES, (3,)) | {"time": ()} | shapes
    arrays = {name: jnp.ones(shape) for name, shape in cores.items()}
    return InertialMotion(**arrays, layout=layout)


def test_errors(no_shape_hook, subtests):
    """What is not that of all motions, which test_rigid_motion.py has."""
    for make, kind, text in [
        *(
            (
                lambda shape=shape: ones(omega=shape),
                ValueError,
                r"omega must have shape \(3,\) or \(\*batch, 3\), got " + re.escape(str(shape)),
            )
            for shape in [(2,), ()]
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
            lambda: ones().flow(jnp.ones((8, 5, 5))),
            ValueError,
            r"InertialMotion with omega of shape \(3,\) acts on shapes \(5, 5\) and \(10,\), got "
            r"\(8, 5, 5\).*give the coordinates leading axes: omega of shape \(8, 3\)",
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
    ]:
        with subtests.test(case=text), pytest.raises(kind, match=text):
            make()


def test_starts_off_the_manifold():
    field = ones()
    for y0, text in [
        (START["vector"] + 0.1, "a unit quaternion in its first 4 entries"),
        (START["matrix"].at[3, 4].set(1e-3), "a rotation, of determinant 1, before its"),
    ]:
        off, found = cast(Any, field.defect(y0))
        assert off > 0.9e-3 and found.startswith(text)
