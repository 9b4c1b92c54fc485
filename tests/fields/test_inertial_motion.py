"""Motions by inertial readings: exact in one step, orders on a known window, and what is refused.

Reference flows are SciPy's exponentials from the left and from the right: `exp(G) X exp(Y)`.
"""

import re
from itertools import pairwise
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
    """Seven seconds, of a turn of 6.2 radians: the method must invert the exponential."""
    rate, solver = 0.88, cfjax.RKMK(diffrax.Bosh3.tableau)
    term = cfjax.LieTerm(lambda t, x, rate: imu(rate * AXIS, FORCE))
    sol = cfjax.integrate(term, solver, 0.0, 7.0, START["vector"], jnp.asarray(rate), num_steps=1)
    coordinates = (rate * AXIS, FORCE, GRAVITY, 1.0, np.zeros(3), np.zeros(3))
    ends = [scipy.linalg.expm(7 * part(*coordinates)) for part in (from_left, from_right)]
    want, found = ends[0] @ MATRIX @ ends[1], to_matrix(np.asarray(sol.ys[-1]))
    # The numbers are 40, with an angle of 6.
    np.testing.assert_allclose(found, want, rtol=0, atol=40 * 20 * EPS)


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


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("solver", "order", "num_steps"), [(cfjax.CF4(), 4, 20), (cfjax.Magnus6(), 6, 8)]
)
def test_order_on_a_window(solver, order, num_steps):
    y0, want = map(jnp.asarray, after_window())
    errors = []
    for times in ([0.0, 1.0], [0.0, 0.5, 1.0]):
        y = y0
        # Steps of two sizes by one program.
        for t0, t1 in pairwise(times):
            term = cfjax.LieTerm(window)
            y = cfjax.integrate(term, solver, t0, t1, y, num_steps=num_steps).ys[-1]
        # Both signs of a quaternion are one attitude.
        y = y.at[:4].multiply(jnp.sign(y[:4] @ want[:4]))
        errors.append(np.max(np.abs(y - want)))
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

    @jax.jit
    def motions(omega, force, x, matrix):
        alone = jax.vmap(lambda w, f, x: imu(w, f).flow(x))(omega, force, x)
        pairs = []
        # In the frame of the body it has the same velocity.
        for field, point in [(imu(omega, force), x), (imu(omega[0], force[0]), matrix)]:
            pairs.append((cfjax.tangent(field.framed(point), point), field.tangent(point)))
        return [(imu(omega, force).flow(x), alone), *pairs]

    for found, want in motions(omega, force, x, START["matrix"]):
        np.testing.assert_allclose(found, want, rtol=0, atol=20 * EPS)


def test_a_path_that_drives_the_readings():
    """Noise has neither time nor gravity. Along a straight path it adds to constant readings."""

    def noise(t, x, args, dw):
        return imu(0.2 * dw[:3], 0.5 * dw[3:], gravity=jnp.zeros(3), time=0.0)

    rates = jnp.asarray([0.3, -1.0, 2.0, 0.4, 0.7, -0.2])
    path = diffrax.LinearInterpolation(jnp.array([0.0, 3.0]), jnp.stack([0 * rates, 3 * rates]))
    drift = cfjax.LieTerm(lambda t, x, args: imu(AXIS, FORCE))
    terms = diffrax.MultiTerm(drift, cfjax.LieControlTerm(noise, path))
    found = cfjax.integrate(terms, cfjax.CF2(), 0.0, 3.0, START["vector"], num_steps=1).ys[-1]
    both = cfjax.combine((3.0,), [imu(AXIS + 0.2 * rates[:3], FORCE + 0.5 * rates[3:])])
    np.testing.assert_allclose(found, both.flow(START["vector"]), rtol=0, atol=100 * EPS)


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
    @jax.jit
    def defects():
        found = []
        for y0, text in [
            (START["vector"] + 0.1, "a unit quaternion in its first 4 entries"),
            (START["matrix"].at[3, 4].set(1e-3), "a rotation, of determinant 1, before its"),
        ]:
            off, expected = cast(Any, ones().defect(y0))
            assert expected.startswith(text)
            found.append(off)
        return found

    assert min(defects()) > 0.9e-3
