"""Conjugation and Congruence: flows, sources, means, what they keep, what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import of_norm, random

import cfjax
from cfjax import Congruence, Conjugation

EPS = 2.0**-52


@jax.jit
def flow(field, point):
    return field.flow(point)


@jax.jit
def both(field, point):
    return field.flow(point), field.increment(point)


def test_real_matrices_at_complex_points():
    """What they do to real and imaginary parts: flows of these are in test_contract.py."""
    a, (x, y) = of_norm("general", 3, 1.0), random((2, 3, 3), 1)

    @jax.jit
    def motions(x, y):
        fields = Conjugation(a), Congruence(a)
        return [[both(f, z) for z in (x, y, jax.lax.complex(x, y))] for f in fields]

    for ends, moves in (zip(*f, strict=True) for f in jax.device_get(motions(x, y))):
        for real, imag, z in (ends, moves):
            assert z.dtype == complex
            # Some units of numbers up to 3, with an exponential of norm up to e from both sides.
            np.testing.assert_allclose(z, real + 1j * imag, rtol=0, atol=20 * EPS * np.exp(2))


def test_a_multiple_of_the_identity_has_no_effect():
    a, x = of_norm("general", 3, 1.0, 1, complex), random((3, 3), 2, complex)
    one = np.eye(3)
    # It rounds the entries of a by 1000 units, and exp(a) grows by e^1 on both sides.
    atol = 1000 * EPS * 10 * np.exp(2)
    skew = of_norm("skew", 3, 2.0, 1, complex)
    conjugated, congruent = (
        flow(cls(np.stack([a, a + number * one, skew])), np.stack([x] * 3))
        for cls, number in [(Conjugation, 1e3 + 2e3j), (Congruence, 1e3j)]
    )
    np.testing.assert_allclose(conjugated[1], conjugated[0], atol=atol)
    np.testing.assert_allclose(congruent[1], congruent[0], atol=atol)
    # With a skew-Hermitian matrix they are the same.
    np.testing.assert_allclose(congruent[2], conjugated[2], rtol=0, atol=100 * EPS)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.complex64, np.float64])
def test_hermitian_stays_hermitian_to_the_last_bit(dtype):
    """In a flow: test_definite_stays_definite has it in steps."""

    def hermitian(seed):
        x = random((3, 5, 5), seed, dtype)
        return x + x.conj().swapaxes(1, 2)

    a, x, q = random((3, 5, 5), 1, dtype), hermitian(2), hermitian(3)
    motions = jax.jit(lambda x: [both(field, x) for field in (Congruence(a), Congruence(a, q))])
    for y in jax.tree.leaves(motions(x)):
        assert np.linalg.norm(y) > 1
        np.testing.assert_array_equal(y, y.conj().swapaxes(1, 2))
    # And not otherwise.
    x[:, 0, 1] += 1
    for y in jax.tree.leaves(motions(x)):
        assert np.linalg.norm(y - y.conj().swapaxes(1, 2)) > 0.1


def test_definite_stays_definite():
    """Through 1000 steps of a covariance with noise in one direction only."""
    a = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -3.0, -2.0]])
    q = np.diag([0.0, 0.0, 1.0])
    term = cfjax.LieTerm(lambda t, y, args: Congruence((1 + 0.3 * jnp.sin(t)) * args, q))
    sol = cfjax.integrate(
        term, cfjax.CF2(), 0.0, 50.0, jnp.zeros((3, 3)), a, num_steps=1000, save_every=1
    )
    y = np.asarray(sol.ys)
    np.testing.assert_array_equal(y, y.swapaxes(1, 2))
    least = np.linalg.eigvalsh(y[1:])[:, 0]
    # From zero they grow like t, t^3 / 12, t^5 / 720: 2e-10 after the first step, h = 0.05.
    assert least[0] > 1e-10 and (least > 0).all()


def test_the_spectrum_does_not_drift():
    """Over 10^4 steps, for each of a batch."""
    s = np.eye(3) + 0.1 * random((8, 3, 3), 1)
    a = s @ np.stack([of_norm("skew", 3, 0.01, k) for k in range(8)]) @ np.linalg.inv(s)
    x = random((8, 3, 3), 2)
    x = x + x.swapaxes(1, 2)
    term = cfjax.LieTerm(lambda t, y, args: Conjugation((1 + 0.3 * jnp.sin(t)) * args))
    sol = cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1e4, x, a, num_steps=10_000)
    ends = [np.sort(np.real(np.linalg.eigvals(y)), axis=1) for y in (x, np.asarray(sol.ys[-1]))]
    # Each step adds the rounding of an increment, at random: 0.01 sqrt(10^4) units. The sums over
    # the steps are compensated, and add nothing.
    off = np.linalg.norm(ends[1] - ends[0], axis=1) / np.linalg.norm(ends[0], axis=1)
    assert off.max() <= 8 * EPS


def by_scipy(field, t, x):
    """Where the flow of a complex field carries x by the time t."""
    a, n = t * np.asarray(field.a), len(x)
    e = scipy.linalg.expm(a)
    if isinstance(field, Conjugation):
        return e @ x @ scipy.linalg.expm(-a)
    q = 0 * a if field.q is None else t * np.asarray(field.q)
    block = scipy.linalg.expm(np.block([[a, q], [0 * a, -a.conj().T]]))
    return (e @ x + block[:n, n:]) @ e.conj().T


def test_the_mean_of_a_flow():
    a, q, x = random((3, 3, 3), 1, complex) / 3
    given = Conjugation(a), Congruence(a), Congruence(a, q)
    found = jax.jit(lambda x: [field.mean(x) for field in given])(x)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    times, weights = (nodes + 1) / 2, weights / 2
    for field, mean in zip(given, found, strict=True):
        want = sum(w * by_scipy(field, t, x) for w, t in zip(weights, times, strict=True))
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
