"""LinearAffine: the flow for every matrix, lengths in many steps, and what it refuses."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from matrices import exact_expm, of_norm, random, to_numpy

import cfjax
from cfjax import LinearAffine

EPS = 2.0**-52
CASES = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.1, 1.0, 10.0, 100.0)),
    *((kind, norm) for kind in ("general", "double", "nilpotent") for norm in (0.1, 3.0)),
    ("negative", 1000.0),
]


@jax.jit
def both(field, point):
    return field.flow(point), field.increment(point)


def exact_increment(a, b, x):
    """exp([[a, b], [0, 0]]) (x, 1) - (x, 1) in 60 digits."""
    n = len(x)
    with mpmath.workdps(60):
        z = mpmath.matrix([*x.tolist(), 1])
        e = exact_expm(np.block([[a, b[:, None]], [np.zeros((1, n + 1))]]))
        return to_numpy((e * z - z)[:n])[:, 0]


def test_flow_and_increment():
    """Of complex points along real matrices of every norm."""
    n = 3
    a = np.stack([of_norm(kind, n, norm, k) for k, (kind, norm) in enumerate(CASES)])
    b, x = random((len(CASES), n), 1), random((len(CASES), n), 2, complex)
    got, moved = both(LinearAffine(a, b), x)
    assert got.dtype == moved.dtype == complex
    for k, (kind, norm) in enumerate(CASES):
        want = exact_increment(a[k], b[k], x[k])
        if norm == 0:
            np.testing.assert_array_equal(moved[k], b[k])
            np.testing.assert_array_equal(got[k], x[k] + b[k])
        # The velocity, of size |a| |x| + |b|, has the rounding of a product; then that of phi_1,
        # below one for skew matrices of large norm, is as in test_phi_1_times. For decay, of size
        # 1 / |a|, the velocity of a fast direction may be off by |a| |x|, times phi_1.
        growth = 1.0 if kind in ("skew", "negative") else np.exp(2 * norm)
        size = norm * np.linalg.norm(x[k]) + np.linalg.norm(b[k])
        atol = 2 * (n + 2) * EPS * growth * size
        np.testing.assert_allclose(moved[k], want, rtol=0, atol=atol, err_msg=f"{kind} {norm}")
        atol += EPS * np.linalg.norm(x[k])
        np.testing.assert_allclose(got[k], x[k] + want, rtol=0, atol=atol, err_msg=f"{kind} {norm}")


@pytest.mark.slow
def test_lengths_do_not_drift():
    """With a skew matrix: 10^4 steps about a centre that is not the origin."""
    a, centre = of_norm("skew", 3, 0.1), random((3,), 1)
    b = -a @ centre
    term = cfjax.LieTerm(lambda t, y, args: LinearAffine(a, b))
    x = random((3,), 2)
    sol = cfjax.integrate(term, cfjax.CF2(), 0.0, 1e4, x, num_steps=10_000)
    lengths = [np.linalg.norm(y - centre) for y in (x, np.asarray(sol.ys[-1]))]
    # b itself is rounded, which moves the centre by 10 units; then 0.1 of a unit in each step, the
    # same in all steps where it comes from exp: 0.01 of a unit, times 10^4.
    assert abs(lengths[1] - lengths[0]) <= 100 * EPS


def test_refuses(subtests, no_shape_hook):
    eye, one = np.eye(3), np.ones(3)
    term = cfjax.LieTerm(lambda t, y, args: LinearAffine(eye, 1j * one))
    refused = {
        ValueError: [
            (
                lambda: LinearAffine(one, one),
                r"a must have shape \(n, n\) or \(\*batch, n, n\), got \(3,\)",
            ),
            (
                lambda: LinearAffine(eye, np.ones((3, 1))),
                r"b must have shape \(3,\) with a of shape \(3, 3\), up to .*, got \(3, 1\)",
            ),
            (
                lambda: LinearAffine(np.ones((7, 3, 3)), np.ones((6, 3))),
                r"b must have shape \(7, 3\) with a of shape \(7, 3, 3\), up to leading axes of 1, "
                r"got \(6, 3\)",
            ),
            (
                lambda: LinearAffine(eye, one).flow(jnp.ones(4)),
                r"LinearAffine with a of shape \(3, 3\) acts on shapes \(3,\), got \(4,\)",
            ),
            (
                lambda: LinearAffine(eye, one).tangent(jnp.ones((7, 3))),
                r"give the coordinates leading axes: a of shape \(7, 3, 3\)",
            ),
            (
                lambda: LinearAffine(eye[None], np.ones((5, 3))).flow(jnp.ones((7, 3))),
                r"LinearAffine with b of shape \(5, 3\) acts on shapes \(5, 3\), got \(7, 3\)",
            ),
            (
                lambda: cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, one, num_steps=1),
                "make y0 complex",
            ),
        ],
        TypeError: [
            (
                lambda: LinearAffine(eye.astype(int), one),
                "a must be float32, float64, complex64 or complex128, got int64",
            ),
            (
                lambda: LinearAffine(eye, one.astype(np.float32)),
                "b must be real or complex of the precision of a, float64, got float32",
            ),
            (
                lambda: LinearAffine(eye, one).bracket(cfjax.LeftMatrix(eye)),
                "Cannot compute the bracket of LinearAffine and LeftMatrix: both must be of one "
                "class",
            ),
        ],
    }
    for error, cases in refused.items():
        for make, text in cases:
            with subtests.test(text=text), pytest.raises(error, match=text):
                make()
