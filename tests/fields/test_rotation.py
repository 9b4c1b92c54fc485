"""Rotation: the flow and two derivatives at every angle, and what it refuses."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from matrices import to_numpy
from problems import hat

import cfjax
from cfjax import Rotation

EPS = 2.0**-52
SMALL = [0, 1e-160, 1e-12, 1e-8, 1e-4, 0.1, 1]
ANGLES = np.array([*SMALL, np.pi - 1e-9, np.pi, np.pi + 1e-9, 6, 2 * np.pi, 10, 50, 100, 1e4])
AXIS = np.array([2.0, -3.0, 6.0]) / 7
OMEGAS = ANGLES[:, None] * AXIS
POINT = np.array([0.3, -1.1, 0.7])


def exact(w, digits):
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


def end(w, p, digits=400):
    return exact(w, digits)[0] * mpmath.matrix(p.tolist())


def jacobian(w, p, digits=400):
    """d/dw of exp(hat(w)) p: a change `d` moves the end point y by dexp(d) x y."""
    with mpmath.workdps(digits):
        flow, dexp = exact(w, digits)
        return -mpmath.matrix(hat(flow * mpmath.matrix(p.tolist()))) * dexp


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


def test_the_flow_and_two_derivatives_at_every_angle():
    """Whose rounding is that of the angle, and of sums of some terms."""

    def flow(omega, point):
        return Rotation(omega).flow(point)

    @jax.jit
    def everything(omegas, singles):
        def of_one(omega):
            both = (0, 1)
            forward = jax.jacfwd(flow, both)(omega, POINT)
            reverse = jax.jacrev(flow, both)
            second = jax.jacfwd(lambda w: reverse(w, POINT)[0])(omega)
            return flow(omega, jnp.asarray(POINT)), forward, reverse(omega, POINT), second

        of_singles = jax.vmap(lambda w: flow(w, jnp.asarray(POINT, np.float32)))(singles)
        return jax.vmap(of_one)(omegas), of_singles

    omegas = OMEGAS.astype(np.float32)
    (ends, forward, reverse, seconds), singles = everything(OMEGAS, omegas)
    assert singles.dtype == np.float32
    for k, (angle, w) in enumerate(zip(ANGLES, OMEGAS, strict=True)):
        unit, where = EPS * (1 + angle), str(angle)
        want = np.ravel(to_numpy(end(w, POINT)))
        np.testing.assert_allclose(ends[k], want, 0, 4 * unit, err_msg=where)
        # Each entry is a sum of terms of at most |w|^2 c_n with the errors of the flow itself.
        wants = to_numpy(jacobian(w, POINT)), to_numpy(exact(w, 400)[0])
        for got in (forward, reverse):
            for found, want in zip(got, wants, strict=True):
                np.testing.assert_allclose(found[k], want, 0, 10 * unit, err_msg=where)
        if angle in (0.0, 1e-8, 1.0, np.pi, 2 * np.pi, 50.0):
            np.testing.assert_allclose(seconds[k], hessian(w, POINT), 0, 30 * unit, err_msg=where)
        # The reference gets the rounded inputs, so the angle's rounding counts once.
        want = np.ravel(to_numpy(end(omegas[k].astype(float), POINT.astype(np.float32), 200)))
        np.testing.assert_allclose(singles[k], want, 0, 4 * 2.0**-23 * (1 + angle), err_msg=where)
    # At zero the term of second order of the series, symmetrised.
    e = np.eye(3)
    twice = np.cross(e[:, None], np.cross(e, POINT)[None])
    want = (twice + twice.transpose(1, 0, 2)) / 2
    np.testing.assert_allclose(seconds[0], want.transpose(2, 0, 1), rtol=0, atol=4 * EPS)


def test_refuses(no_shape_hook, subtests):
    one = Rotation(np.ones(3))
    shapes = r"acts on shapes \(3,\) and \(3, k\), got"
    cases = [
        *(
            (lambda x=x: Rotation(x), ValueError, r"must have shape \(3,\) or \(\*batch, 3\), got")
            for x in (np.ones(4), np.ones((3, 1)), np.ones(()), np.ones((0,)))
        ),
        *(
            (lambda t=t: Rotation(jnp.ones(3, t)), TypeError, "omega must be float32 or float64, g")
            for t in (np.int32, np.float16, jnp.bfloat16, np.complex128, np.bool_)
        ),
        *(
            (lambda f=f, x=x: f(jnp.ones(x)), ValueError, f"Rotation .* {shapes}")
            for f in (one.flow, one.increment, one.mean, one.tangent)
            for x in [(), (2,), (4,), (2, 3), (3, 2, 2)]
        ),
        (
            lambda: one.flow(jnp.ones(3, complex)),
            TypeError,
            "Rotation acts on real arrays, got complex128",
        ),
        (
            lambda: one.bracket(cfjax.LeftMatrix(np.eye(3))),
            TypeError,
            "Cannot compute the bracket of Rotation and LeftMatrix: both must be of one class",
        ),
    ]
    for k, (call, error, text) in enumerate(cases):
        with subtests.test(case=f"{k}: {text}"), pytest.raises(error, match=text):
            call()
