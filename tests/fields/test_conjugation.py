"""Conjugation and Congruence: flows, sources, derivatives, what they keep, what they refuse."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import exact_expm, of_norm, random, to_numpy

import cfjax
from cfjax import Congruence, Conjugation

EPS = 2.0**-52
CASES = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.1, 1.0, 10.0, 100.0)),
    *((kind, norm) for kind in ("general", "double", "nilpotent") for norm in (0.1, 3.0)),
]


@jax.jit
def flow(field, point):
    return field.flow(point)


@jax.jit
def both(field, point):
    return field.flow(point), field.increment(point)


def exact(field, point, minus_point=False):
    """Where the point moves, by exponentials in 60 digits."""
    n = len(point)
    with mpmath.workdps(60):
        a, x = mpmath.matrix(field.a.tolist()), mpmath.matrix(point.tolist())
        e = exact_expm(a)
        if isinstance(field, Conjugation):
            out = e * x * exact_expm(-a)
        else:
            out = e * x * e.H
            if field.q is not None:
                q = np.asarray(field.q)
                block = np.block([[field.a, q], [np.zeros((n, n)), -np.asarray(field.a).conj().T]])
                block = exact_expm(block)
                out += block[:n, n:] * block[:n, :n].H
        return to_numpy(out - x if minus_point else out)


def of(name, a, q=None):
    return Conjugation(a) if name == "Conjugation" else Congruence(a, q)


NAMES = ["Congruence with a source", "Conjugation", "Congruence"]
EACH = pytest.mark.parametrize("name", NAMES)


def fields(name, dtype, n=3):
    a = np.stack([of_norm(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(CASES)])
    q = random(a.shape, 8, dtype)
    return of(name, a, q if "source" in name else None)


@pytest.mark.representatives(2)
@EACH
@pytest.mark.parametrize(
    ("dtype", "point_dtype", "n"),
    [
        (np.float64, np.float64, 3),
        (np.complex64, np.complex64, 5),
        (np.float64, np.complex128, 5),
        (np.float64, np.float64, 1),
    ],
)
def test_flow_and_increment(name, dtype, point_dtype, n):
    field, point = fields(name, dtype, n), random((len(CASES), n, n), 9, point_dtype)
    got, moved = both(field, point)
    assert got.dtype == moved.dtype == point_dtype
    eps = np.finfo(dtype).eps
    for k, (kind, norm) in enumerate(CASES):
        one = jax.tree.map(lambda x, k=k: x[k], field)
        if norm == 0:
            shift = np.asarray(one.q) if "source" in name else np.zeros((n, n))
            np.testing.assert_array_equal(moved[k], shift)
            np.testing.assert_array_equal(got[k], point[k] + shift)
        # Each exponential is off by some n units, doubled in each squaring, and what is not normal
        # may lose its growth, twice for each of the two factors.
        growth = 1.0 if kind == "skew" else np.exp(4 * norm)
        size = np.linalg.norm(point[k]) + (10 if "source" in name else 0)
        atol = 2 * (n + 2) * eps * max(1.0, norm) * growth * size
        want = exact(one, point[k])
        np.testing.assert_allclose(got[k], want, rtol=0, atol=atol, err_msg=f"{kind} {norm}")
        want = exact(one, point[k], minus_point=True)
        if norm < 1:  # Then the rounding is as small as the increment.
            atol *= norm if "source" not in name else 1
        np.testing.assert_allclose(moved[k], want, rtol=0, atol=atol, err_msg=f"{kind} {norm}")


def test_a_multiple_of_the_identity_has_no_effect():
    a, x = of_norm("general", 3, 1.0, 1, complex), random((3, 3), 2, complex)
    one = np.eye(3)
    # It rounds the entries of a by 1000 units, and exp(a) grows by e^1 on both sides.
    atol = 1000 * EPS * 10 * np.exp(2)
    want = flow(Conjugation(a), x)
    np.testing.assert_allclose(flow(Conjugation(a + (1e3 + 2e3j) * one), x), want, atol=atol)
    want = flow(Congruence(a), x)
    np.testing.assert_allclose(flow(Congruence(a + 1e3j * one), x), want, atol=atol)
    # With a skew-Hermitian matrix they are the same.
    a = of_norm("skew", 3, 2.0, 1, complex)
    want = flow(Conjugation(a), x)
    np.testing.assert_allclose(flow(Congruence(a), x), want, rtol=0, atol=100 * EPS)


def test_stationary_covariance():
    a = of_norm("negative", 4, 3.0) + of_norm("skew", 4, 2.0, 1)
    a = a - 0.1 * np.eye(4)
    q = random((4, 4), 2)
    q = q @ q.T
    x = scipy.linalg.solve_continuous_lyapunov(a, -q)
    # SciPy's is as far off as the condition, |a| over the slowest rate 0.1.
    atol = 100 * EPS * 5 / 0.1 * np.linalg.norm(x)
    np.testing.assert_allclose(flow(Congruence(a, q), x), x, rtol=0, atol=atol)
    # It is reached from everywhere: the slowest rate is 0.1 at least, twice.
    np.testing.assert_allclose(flow(Congruence(300 * a, 300 * q), 0 * x), x, rtol=0, atol=atol)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.float64, np.complex64])
def test_hermitian_stays_hermitian_to_the_last_bit(dtype):
    def hermitian(seed):
        x = random((3, 5, 5), seed, dtype)
        return x + x.conj().swapaxes(1, 2)

    a, x, q = random((3, 5, 5), 1, dtype), hermitian(2), hermitian(3)
    for field in (Congruence(a), Congruence(a, q)):
        for y in both(field, x):
            assert np.linalg.norm(y) > 1
            np.testing.assert_array_equal(y, y.conj().swapaxes(1, 2))
    # And not otherwise.
    x[:, 0, 1] += 1
    y, _ = both(Congruence(a), x)
    assert np.linalg.norm(y - y.conj().swapaxes(1, 2)) > 0.1

    def toward(t, y, args):
        return Congruence(jnp.cos(2 * t).astype(dtype) * args[0] @ y, args[1])

    y0 = hermitian(4)[0]
    args = np.asarray(0.1, dtype) * a[0], q[0]
    y = cfjax.integrate(cfjax.LieTerm(toward), cfjax.CF2(), 0.0, 0.3, y0, args, num_steps=5).ys[-1]
    np.testing.assert_array_equal(y, y.conj().T)


def test_definite_stays_definite():
    """Through 1000 steps of a covariance with noise in one direction only."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -3.0, -2.0]])
    q = np.diag([0.0, 0.0, 1.0])
    term = cfjax.LieTerm(lambda t, y, args: Congruence((1 + 0.3 * jnp.sin(t)) * args, q))
    sol = cfjax.integrate(
        term, cfjax.CF4(), 0.0, 50.0, jnp.zeros((3, 3)), a, num_steps=1000, save_every=1
    )
    y = np.asarray(sol.ys)
    np.testing.assert_array_equal(y, y.swapaxes(1, 2))
    least = np.linalg.eigvalsh(y[1:])[:, 0]
    # From zero they grow like t, t^3 / 12, t^5 / 720: 2e-10 after the first step, h = 0.05.
    assert least[0] > 1e-10 and (least > 0).all()


class Plain(Conjugation):
    """Without increments."""

    def increment(self, point):  # pyright: ignore[reportIncompatibleMethodOverride]
        return None


def drift(cls, a, x):
    """The relative drift of the spectrum over 10^4 steps, for each of a batch."""
    term = cfjax.LieTerm(lambda t, y, args: cls((1 + 0.3 * jnp.sin(t)) * args))
    sol = cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1e4, x, a, num_steps=10_000)
    ends = [np.sort(np.real(np.linalg.eigvals(y)), axis=1) for y in (x, np.asarray(sol.ys[-1]))]
    return np.linalg.norm(ends[1] - ends[0], axis=1) / np.linalg.norm(ends[0], axis=1)


def test_the_spectrum_does_not_drift():
    s = np.eye(3) + 0.1 * random((8, 3, 3), 1)
    a = s @ np.stack([of_norm("skew", 3, 0.01, k) for k in range(8)]) @ np.linalg.inv(s)
    x = random((8, 3, 3), 2)
    x = x + x.swapaxes(1, 2)
    # Each step adds the rounding of an increment, at random: 0.01 sqrt(10^4) units. The sums over
    # the steps are compensated, and add nothing.
    found = drift(Conjugation, a, x)
    assert found.max() <= 8 * EPS
    # Otherwise each step adds the rounding of x, of which most averages out.
    assert np.linalg.norm(drift(Plain, a, x)) > 3 * np.linalg.norm(found)


def test_toda():
    """A tridiagonal matrix that is symmetric flows to the diagonal of its eigenvalues."""

    def field(t, y, args):
        return Conjugation(jnp.tril(y, -1).T - jnp.tril(y, -1))

    y0 = np.diag([1.0, 2.0, 4.0, 7.0]) + np.diag([1.0] * 3, 1) + np.diag([1.0] * 3, -1)
    y = cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0.0, 40.0, y0, num_steps=400).ys[-1]
    want = np.sort(np.linalg.eigvalsh(y0))[::-1]
    # The gaps of the spectrum are above 1: what is off the diagonal is below exp(-40).
    np.testing.assert_allclose(np.sort(np.diag(y))[::-1], want, rtol=0, atol=20 * EPS * 10)
    np.testing.assert_allclose(y - np.diag(np.diag(y)), np.zeros((4, 4)), atol=1e-13)


def test_derivatives():
    """Of Congruence along a + t d, q + t r, x + t u, at a = 0 and elsewhere."""
    d, r, u, w, q, x = random((6, 3, 3), 1)

    @jax.jit
    @jax.vmap
    def found(a):
        def value(a, q, x):
            return jnp.sum(w * Congruence(a, q).flow(x))

        at = a, jnp.asarray(q), jnp.asarray(x)
        return jax.jvp(value, at, (d, r, u))[1], *jax.grad(value, argnums=(0, 1, 2))(*at)

    norms = [0.0, 1e-12, 0.5, 3.0]
    a = np.stack([of_norm("general", 3, norm, 2) for norm in norms])
    h = mpmath.mpf(10) ** -15

    def exact_value(a, q, x):
        block = mpmath.zeros(6)
        block[:3, :3], block[:3, 3:], block[3:, 3:] = a, q, -a.T
        block = exact_expm(block)
        e = block[:3, :3]
        return sum(s * t for s, t in zip((e * x + block[:3, 3:]) * e.T, np.ravel(w), strict=True))

    for norm, a1, forward, *pulled in zip(norms, a, *found(a), strict=True):
        with mpmath.workdps(60):
            start, way = ([mpmath.matrix(m.tolist()) for m in ms] for ms in ((a1, q, x), (d, r, u)))
            # Differences in 60 digits: an error of 1e-30.
            ends = [
                exact_value(*(m + t * v for m, v in zip(start, way, strict=True))) for t in (-h, h)
            ]
            want = float((ends[1] - ends[0]) / (2 * h))
        # Some ten units for each of four factors exp, of norm exp(norm), with sums of 81 terms.
        atol = 40 * EPS * np.exp(4 * norm) * 81
        reverse = sum(np.vdot(g, v) for g, v in zip(pulled, (d, r, u), strict=True))
        assert abs(forward - want) <= atol and abs(reverse - want) <= atol


def test_the_mean_of_a_flow():
    a, q, x = random((3, 3, 3), 1, complex) / 3
    given = Conjugation(a), Congruence(a), Congruence(a, q)
    found = jax.jit(lambda x: [field.mean(x) for field in given])(x)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    for field, mean in zip(given, found, strict=True):
        parts = (cfjax.combine((t,), (field,)) for t in (nodes + 1) / 2)
        want = sum(w / 2 * exact(part, x) for w, part in zip(weights, parts, strict=True))
        # The rule is exact to rounding, which is some ten units of numbers of some ten.
        np.testing.assert_allclose(mean, want, rtol=0, atol=200 * EPS)


def test_derivative_in_a_direction_that_is_not_hermitian():
    """At a Hermitian point, where the value has no skew part."""
    a, d, x = of_norm("general", 3, 1.0), random((3, 3), 1), random((3, 3), 2)
    x = x + x.T
    got = jax.jit(lambda x, d: jax.jvp(Congruence(a).flow, (x,), (d,))[1])(x, d)
    e = scipy.linalg.expm(a)
    np.testing.assert_allclose(got, e @ d @ e.T, rtol=0, atol=1e-13)


def test_brackets():
    a, b, q, r = random((4, 3, 3), 1)
    for x, y in [
        (Conjugation(a), Conjugation(b)),
        (Congruence(a), Congruence(b)),
        (Congruence(a, q), Congruence(b, r)),
    ]:
        xy, yx = x.bracket(y), y.bracket(x)
        assert type(xy) is type(x)
        np.testing.assert_allclose(xy.a, a @ b - b @ a, rtol=0, atol=20 * EPS)
        jax.tree.map(lambda s, t: np.testing.assert_array_equal(s, -t), xy, yx)
    want = a @ r + r @ a.T - b @ q - q @ b.T
    np.testing.assert_allclose(xy.q, want, rtol=0, atol=40 * EPS)
    assert len(jax.tree.leaves(Congruence(a).bracket(Congruence(b)))) == 1


def test_no_source_counts_as_zero():
    a, b, q, x = random((4, 3, 3), 2)
    without, source = Congruence(a), Congruence(b, q)
    zero = Congruence(a, np.zeros((3, 3)))
    for found, want in [
        (cfjax.combine((2.0, 3.0), (without, source)), Congruence(2 * a + 3 * b, 3 * q)),
        (cfjax.combine((3.0, 2.0), (source, without)), Congruence(2 * a + 3 * b, 3 * q)),
        (without.bracket(source), zero.bracket(source)),
        (source.bracket(without), source.bracket(zero)),
    ]:
        jax.tree.map(np.testing.assert_array_equal, found, want)
    assert cfjax.combine((2.0, 3.0), (without, without)).q is None
    # Entries of up to 100.
    np.testing.assert_allclose(flow(zero, x), flow(without, x), rtol=0, atol=1e-12)


def test_refuses(subtests, no_shape_hook):
    one, two, three = np.eye(3), np.ones((2, 2)), np.ones((3, 3))
    five, seven = np.ones((5, 3, 3)), jnp.ones((7, 3, 3))

    def solve(field):
        term = cfjax.LieTerm(lambda t, y, args: field)
        cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, one, num_steps=1)

    refused = {
        ValueError: [
            (lambda: Conjugation(np.ones(3)), r"a must have shape \(n, n\) or"),
            (lambda: Congruence(np.ones((2, 3))), r"\(\*batch, n, n\), got \(2, 3\)"),
            (lambda: Congruence(np.ones(3), np.ones(3)), r"a must have shape \(n, n\)"),
            (
                lambda: Congruence(three, two),
                r"q must have shape \(3, 3\) with a of shape \(3, 3\), .* got \(2, 2\)",
            ),
            (
                lambda: Congruence(five, five[:4]),
                r"q must have shape \(5, 3, 3\) with a of shape \(5, 3, 3\), up to leading axes of "
                r"1, got \(4, 3, 3\)",
            ),
            (lambda: Congruence(three, five), r"q must have shape \(3, 3\) .* got \(5, 3, 3\)"),
            (
                lambda: Conjugation(one).flow(jnp.ones((3, 2))),
                r"Conjugation with a of shape \(3, 3\) acts on shapes \(3, 3\), got \(3, 2\)",
            ),
            (
                lambda: Congruence(one).tangent(seven),
                r"give the coordinates leading axes: a of shape \(7, 3, 3\)",
            ),
            (
                lambda: Congruence(one[None], five).flow(seven),
                r"Congruence with q of shape \(5, 3, 3\) acts on shapes \(5, 3, 3\), got "
                r"\(7, 3, 3\)",
            ),
            (lambda: solve(Conjugation(1j * one)), "make y0 complex"),
            (lambda: solve(Congruence(1j * one)), "make y0 complex"),
            (lambda: solve(Congruence(one, 1j * one)), "make y0 complex"),
        ],
        TypeError: [
            (lambda: Conjugation(two.astype(int)), "a must be float32, .* got int64"),
            (
                lambda: Congruence(three, three.astype(np.float32)),
                "q must be real or complex of the precision of a, float64, got float32",
            ),
            (
                lambda: Congruence(three, three.astype(int)),
                "q must be real or complex .* got int64",
            ),
            (
                lambda: Conjugation(one).bracket(Congruence(one)),
                "Cannot compute the bracket of Conjugation and Congruence: both must be of one "
                "class",
            ),
            (
                lambda: cfjax.combine((1.0, 1.0), (Conjugation(one), Congruence(one))),
                "Only fields of one kind can be added, got Conjugation and Congruence",
            ),
        ],
    }
    for error, cases in refused.items():
        for k, (make, text) in enumerate(cases):
            with subtests.test(case=str(k), text=text), pytest.raises(error, match=text):
                make()
