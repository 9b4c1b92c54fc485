"""LinearAffine: the flow for every matrix, derivatives, the bracket, and what it refuses."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
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


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("dtype", "point_dtype", "n"),
    [
        (np.float64, np.float64, 3),
        (np.complex64, np.complex64, 5),
        (np.float32, np.complex64, 2),
        (np.complex128, np.complex128, 1),
        (np.float64, np.complex128, 3),
        (np.float32, np.float32, 9),
        (np.complex128, np.complex128, 4),
    ],
)
def test_flow_and_increment(dtype, point_dtype, n):
    a = np.stack([of_norm(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(CASES)])
    b, x = random((len(CASES), n), 1, dtype), random((len(CASES), n), 2, point_dtype)
    got, moved = both(LinearAffine(a, b), x)
    assert got.dtype == moved.dtype == point_dtype
    for k, (kind, norm) in enumerate(CASES):
        want = exact_increment(a[k], b[k], x[k])
        # The velocity, of size |a| |x| + |b|, has the rounding of a product; then that of phi_1,
        # below one for skew matrices of large norm, is as in test_phi_1_times. For decay, of size
        # 1 / |a|, the velocity of a fast direction may be off by |a| |x|, times phi_1.
        growth = 1.0 if kind in ("skew", "negative") else np.exp(2 * norm)
        size = norm * np.linalg.norm(x[k]) + np.linalg.norm(b[k])
        atol = 2 * (n + 2) * np.finfo(dtype).eps * growth * size
        np.testing.assert_allclose(moved[k], want, rtol=0, atol=atol, err_msg=f"{kind} {norm}")
        atol += np.finfo(dtype).eps * np.linalg.norm(x[k])
        np.testing.assert_allclose(got[k], x[k] + want, rtol=0, atol=atol, err_msg=f"{kind} {norm}")


def test_zero_is_a_translation_exactly():
    x, b = random((2, 3), 1)
    got, moved = both(LinearAffine(np.zeros((3, 3)), b), x)
    np.testing.assert_array_equal(got, x + b)
    np.testing.assert_array_equal(moved, b)


def test_a_stationary_point():
    a = of_norm("negative", 3, 2.0) - 0.5 * np.eye(3) + of_norm("skew", 3, 5.0)
    b = random((3,), 1)
    rest = -np.linalg.solve(a, b)
    # As far off as NumPy's, |a| / 0.5 units; and all others get there, at a rate of 0.5 at least.
    atol = 20 * EPS * 10 * np.linalg.norm(rest)
    got = both(LinearAffine(np.stack([a, 200 * a]), np.stack([b, 200 * b])), np.stack([rest, b]))
    np.testing.assert_allclose(got[0], [rest, rest], rtol=0, atol=atol)


def test_bloch():
    """Relaxation while the magnetisation precesses, in closed form."""
    rate, slow, fast, equilibrium, t = 7.0, 0.4, 1.1, 0.8, 2.0
    a = np.array([[-fast, rate, 0], [-rate, -fast, 0], [0, 0, -slow]])
    x = np.array([0.6, -0.3, 0.2])
    got, _ = both(LinearAffine(t * a, t * np.array([0, 0, slow * equilibrium])), x)
    plane = (x[0] + 1j * x[1]) * np.exp((-1j * rate - fast) * t)
    along = equilibrium + (x[2] - equilibrium) * np.exp(-slow * t)
    # The angle, 14, has a rounding of as many units.
    np.testing.assert_allclose(got, [plane.real, plane.imag, along], rtol=0, atol=40 * EPS)


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


def test_derivatives():
    """By time along a + t d, b + t r, x + t u, at a = 0 and elsewhere."""
    d = random((3, 3), 1)
    r, u, w, b, x = random((5, 3), 2)

    @jax.jit
    @jax.vmap
    def found(a):
        def value(a, b, x):
            return jnp.sum(w * LinearAffine(a, b).flow(x))

        slope = lambda t: jax.jvp(  # noqa: E731
            lambda t: value(a + t * d, b + t * r, x + t * u), (t,), (1.0,)
        )[1]
        pulled = jax.grad(value, argnums=(0, 1, 2))(a, jnp.asarray(b), jnp.asarray(x))
        return *jax.jvp(slope, (0.0,), (1.0,)), *pulled

    norms = [0.0, 1e-12, 0.5, 3.0]
    a = np.stack([of_norm("general", 3, norm, 2) for norm in norms])
    h = mpmath.mpf(10) ** -15

    def block(a, b):
        return mpmath.matrix(np.block([[a, b[:, None]], [np.zeros((1, 4))]]).tolist())

    for norm, a1, first, second, *pulled in zip(norms, a, *found(a), strict=True):
        with mpmath.workdps(60):
            # Differences in 60 digits: an error of 1e-30.
            ends = []
            for t in (-h, 0, h):
                z = mpmath.matrix([*x.tolist(), 1]) + t * mpmath.matrix([*u.tolist(), 0])
                y = exact_expm(block(a1, b) + t * block(d, r)) * z
                ends.append(sum(p * q for p, q in zip(w, y, strict=False)))
            want = (ends[2] - ends[0]) / (2 * h), (ends[2] - 2 * ends[1] + ends[0]) / h**2
        # Some ten units for each of three factors exp, of norm exp(norm), with sums of 27 terms.
        atol = 30 * EPS * np.exp(3 * norm) * 27
        assert abs(first - float(want[0])) <= atol
        assert abs(second - float(want[1])) <= 10 * atol
        slope = sum(np.vdot(g, v) for g, v in zip(pulled, (d, r, u), strict=True))
        assert abs(slope - float(want[0])) <= atol


def test_bracket():
    (a, c), (b, e) = random((2, 3, 3), 1), random((2, 3), 2)
    x, y = LinearAffine(a, b), LinearAffine(c, e)
    found = x.bracket(y)
    np.testing.assert_allclose(found.a, a @ c - c @ a, rtol=0, atol=20 * EPS)
    np.testing.assert_allclose(found.b, a @ e - c @ b, rtol=0, atol=20 * EPS)
    jax.tree.map(lambda s, t: np.testing.assert_array_equal(s, -t), found, y.bracket(x))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("axes", [(2, 4), ()])
def test_promises(axes):
    coordinates = [(random((*axes, 3, 3), k), random((*axes, 3), 5 + k)) for k in range(2)]
    cfjax.check_field([LinearAffine(a, b) for a, b in coordinates], random((*axes, 3), 3))


def test_leading_axes_of_one_are_broadcast():
    a, b, x = random((3, 3), 1), random((5, 3), 2), random((5, 3), 3)
    got, _ = both(LinearAffine(a[None], b), x)
    e = scipy.linalg.expm(a)
    want = x @ e.T + b @ np.linalg.solve(a, e - np.eye(3)).T
    # The condition of a is below 100.
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


@pytest.mark.usefixtures("no_shape_hook")
@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (
            lambda: LinearAffine(np.ones(3), np.ones(3)),
            ValueError,
            r"a must have shape \(n, n\) or \(\*batch, n, n\), got \(3,\)",
        ),
        (
            lambda: LinearAffine(np.ones((3, 3), int), np.ones(3)),
            TypeError,
            "a must be float32, float64, complex64 or complex128, got int64",
        ),
        (
            lambda: LinearAffine(np.ones((3, 3)), np.ones((3, 1))),
            ValueError,
            r"b must have shape \(3,\) with a of shape \(3, 3\), up to .*, got \(3, 1\)",
        ),
        (
            lambda: LinearAffine(np.ones((7, 3, 3)), np.ones((6, 3))),
            ValueError,
            r"b must have shape \(7, 3\) with a of shape \(7, 3, 3\), up to leading axes of 1, got "
            r"\(6, 3\)",
        ),
        (
            lambda: LinearAffine(np.ones((3, 3)), np.ones(3, np.float32)),
            TypeError,
            "b must be real or complex of the precision of a, float64, got float32",
        ),
        (
            lambda: LinearAffine(np.eye(3), np.ones(3)).flow(jnp.ones(4)),
            ValueError,
            r"LinearAffine with a of shape \(3, 3\) acts on shapes \(3,\), got \(4,\)",
        ),
        (
            lambda: LinearAffine(np.eye(3), np.ones(3)).tangent(jnp.ones((7, 3))),
            ValueError,
            r"give the coordinates leading axes: a of shape \(7, 3, 3\)",
        ),
        (
            lambda: LinearAffine(np.ones((1, 3, 3)), np.ones((5, 3))).flow(jnp.ones((7, 3))),
            ValueError,
            r"LinearAffine with b of shape \(5, 3\) acts on shapes \(5, 3\), got \(7, 3\)",
        ),
        (
            lambda: LinearAffine(np.eye(3), np.ones(3)).bracket(cfjax.LeftMatrix(np.eye(3))),
            TypeError,
            "Cannot compute the bracket of LinearAffine and LeftMatrix: both must be of one class",
        ),
    ],
)
def test_refuses(make, error, text):
    with pytest.raises(error, match=text):
        make()


def test_a_complex_field_needs_a_complex_state():
    term = cfjax.LieTerm(lambda t, y, args: LinearAffine(np.eye(2), 1j * np.ones(2)))
    with pytest.raises(ValueError, match="make y0 complex"):
        cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, np.ones(2), num_steps=1)
