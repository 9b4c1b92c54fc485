"""`expm`: its polynomials, its accuracy at every norm, batches, derivatives, and what it refuses."""

import inspect
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from jax.test_util import check_grads

from cfjax._functions.expm import _DEGREE_15, _DEGREE_21, _SCHEMES, expm

DTYPES = [np.float32, np.float64, np.complex64, np.complex128]
SCHEMES = pytest.mark.parametrize(
    ("scheme", "degree", "unit"), [(_DEGREE_15, 15, 2.0**-24), (_DEGREE_21, 21, 2.0**-53)]
)


def random(kind, n, norm, seed=0, dtype=np.float64):
    """A matrix with the given 2-norm. Skew and negative ones are normal, a general one is not."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    if np.issubdtype(dtype, np.complexfloating):
        a = a + 1j * rng.normal(size=(n, n))
    if kind == "skew":
        a = a - a.conj().T
    elif kind == "negative":
        a = -a @ a.conj().T
    return (a / np.linalg.norm(a, 2) * norm).astype(dtype)


def reference(a):
    """exp(a) by scaling and squaring a Taylor polynomial in 60 digits.

    2⁻⁸ norm and 24 terms leave 1e-82; 30 squarings lose at most 9 of the 60 digits.
    """
    a = np.asarray(a)
    with mpmath.workdps(60):
        squarings = max(0, math.ceil(math.log2(max(np.linalg.norm(a, 1), 1e-320)))) + 8
        x = mpmath.matrix(a.tolist()) / mpmath.mpf(2) ** squarings
        total = term = mpmath.eye(a.shape[0])
        for k in range(1, 25):
            term = term * x / k
            total = total + term
        for _ in range(squarings):
            total = total * total
        return np.array(total.tolist(), dtype=np.promote_types(a.dtype, np.float64))


def error(got, exact):
    return np.linalg.norm(np.asarray(got) - exact, 2) / np.linalg.norm(exact, 2)


def coefficients(scheme):
    """The scheme's polynomial, expanded without rounding."""

    def plus(p, q):
        length = max(len(p), len(q))
        p, q = ([*r, *[Fraction(0)] * (length - len(r))] for r in (p, q))
        return [x + y for x, y in zip(p, q, strict=True)]

    def times(p, q):
        out = [Fraction(0)] * (len(p) + len(q) - 1)
        for i, x in enumerate(p):
            for j, y in enumerate(q):
                out[i + j] += x * y
        return out

    def combine(weights, known):
        total = [Fraction(0)]
        for w, p in zip(weights, known, strict=True):
            total = plus(total, [Fraction(w) * x for x in p])
        return total

    rows = scheme.rows
    known = [[Fraction(int(i == k)) for i in range(k + 1)] for k in range(1, scheme.powers + 1)]
    known.append(times(known[-1], combine(rows[0], known)))
    y1 = times(combine(rows[1], known), combine(rows[2], known))
    known.append(plus(y1, combine(rows[3], known)))
    rest = plus(times(combine(rows[4], known), combine(rows[5], known)), combine(rows[6], known))
    return plus(rest, [Fraction(1)])


@SCHEMES
def test_polynomial_is_the_taylor_polynomial(scheme, degree, unit):
    del unit
    got = coefficients(scheme)
    assert got[0] == got[1] == 1
    for k in range(2, degree + 1):
        # Rounding the weights to double moves a coefficient by at most 2.8e-16 (computed here).
        assert abs(float(got[k] * math.factorial(k) - 1)) < 4e-16
    # The degrees above are not Taylor's, or the name of the scheme would be wrong.
    assert all(
        abs(float(got[k] * math.factorial(k) - 1)) > 0.1 for k in range(degree + 1, len(got))
    )


@SCHEMES
def test_theta_is_where_the_backward_error_reaches_the_unit_roundoff(scheme, degree, unit):
    length = 60  # At theta the terms beyond are below 1e-20 of the first.
    p = coefficients(scheme)
    p = [Fraction(1, math.factorial(k)) for k in range(degree + 1)] + p[degree + 1 :]
    p += [Fraction(0)] * (length - len(p))
    exp = [Fraction((-1) ** k, math.factorial(k)) for k in range(length)]
    q = [sum(p[i] * exp[k - i] for i in range(k + 1)) for k in range(length)]
    log = [0.0] * length  # exp(x + Σ log_k xᵏ) is the polynomial.
    exact = [Fraction(0)] * length
    for k in range(1, length):
        inner = sum((i * exact[i] * q[k - i] for i in range(degree, k)), Fraction(0))
        exact[k] = q[k] - inner / k
        log[k] = abs(float(exact[k]))
    assert not any(log[: degree + 1])

    def backward(x):
        return sum(c * x ** (k - 1) for k, c in enumerate(log) if k > degree)

    assert backward(scheme.theta) <= unit < backward(scheme.theta * 1.001)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["skew", "negative", "general"])
@pytest.mark.parametrize("norm", [1e-30, 1e-8, 0.3, 1.0, 4.0, 30.0, 1000.0, 1e5])
def test_accuracy(kind, norm, dtype):
    a = random(kind, 5, norm, dtype=dtype)
    condition = 1.0
    if kind == "general":
        if norm > 30:
            pytest.skip("exp overflows, or is conditioned worse than single precision")
        condition = scipy.linalg.expm_cond(a.astype(np.promote_types(dtype, np.float64)))
    # A squaring of a normal matrix doubles the relative error and adds one product's, n units: in all
    # n·2ˢ ≤ n·norm. 4 covers the polynomial. A general one can lose its condition number as well.
    bound = 4 * 5 * np.finfo(dtype).eps * max(1.0, norm, condition)
    got = expm(jnp.asarray(a))
    assert got.dtype == dtype
    assert error(got, reference(a)) <= bound


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 7, 8, 9, 33])
@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
def test_every_size(n, dtype):
    # Sizes 1, up to 4, 5 to 7 and above go different ways.
    if n == 0:
        assert expm(jnp.zeros((0, 0), dtype)).shape == (0, 0)
        return
    a = random("skew" if n > 1 else "general", n, 1.5, dtype=dtype)
    got = expm(jnp.asarray(a))
    assert got.dtype == dtype and got.shape == (n, n)
    # One product's error is n units; 4 products follow the first, most of them well below one.
    assert error(got, reference(a)) <= 2 * (n + 2) * np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 3, 6, 8])
def test_exact_at_zero(n, dtype):
    # A field that vanishes must not move the state, however often: no tolerance.
    assert np.array_equal(expm(jnp.zeros((n, n), dtype)), np.eye(n))
    direction = jnp.asarray(random("general", n, 1.0, dtype=dtype))
    value, tangent = jax.jvp(expm, (jnp.zeros((n, n), dtype),), (direction,))
    assert np.array_equal(value, np.eye(n))
    assert np.array_equal(tangent, direction)
    tiny = jnp.asarray(1e-30, dtype) * direction
    off = ~np.eye(n, dtype=bool)
    assert np.array_equal(np.asarray(expm(tiny))[off], np.asarray(tiny)[off])


def test_smallest_number():
    a = random("general", 5, 1e-300)
    off = ~np.eye(5, dtype=bool)
    assert np.array_equal(np.asarray(expm(jnp.asarray(a)))[off], a[off])


def test_large_but_nilpotent_needs_no_squaring():
    # The norm of a would ask for 20 squarings, that of a² for none: then I + a comes out exactly.
    a = jnp.asarray([[0.0, 1e6], [0.0, 0.0]])
    assert np.array_equal(expm(a), [[1.0, 1e6], [0.0, 1.0]])


def test_negative_eigenvalues_underflow_to_zero():
    a = jnp.diag(jnp.asarray([-1000.0, 1.0, -1.0]))
    got = np.asarray(expm(a))
    assert got[0, 0] == 0
    # 10 squarings: 2¹⁰ units of rounding.
    np.testing.assert_allclose(np.diag(got)[1:], [np.e, 1 / np.e], rtol=2**10 * 2.3e-16)


def test_each_member_of_a_batch_has_its_own_scaling():
    norms = [1e-8, 0.5, 3.0, 2e4]
    batch = np.stack([random("skew", 5, norm, seed=i) for i, norm in enumerate(norms)])
    got = jax.vmap(expm)(jnp.asarray(batch))
    for x, a, norm in zip(got, batch, norms, strict=True):
        # As in test_accuracy. With the scaling of the largest this would be 2e4 times as much.
        assert error(x, reference(a)) <= 4 * 5 * 2.3e-16 * max(1.0, norm)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("n", [1, 3, 6, 9])
@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
def test_not_finite_gives_nan_and_stays_with_its_member(bad, n, dtype):
    good = random("skew", n, 3.0, dtype=np.float32).astype(dtype)
    spoiled = good.copy()
    spoiled[0, n - 1] = bad
    assert np.isnan(expm(jnp.asarray(spoiled))).all()
    got = jax.vmap(expm)(jnp.asarray(np.stack([spoiled, good])))
    assert np.isnan(got[0]).all()
    # Both paths round in their own order: as in test_accuracy.
    assert error(got[1], np.asarray(expm(jnp.asarray(good)))) <= 12 * n * np.finfo(dtype).eps
    gradient = jax.grad(lambda a: jnp.sum(expm(a)).real)(jnp.asarray(spoiled))
    assert np.isnan(gradient).any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_overflow_and_too_large_are_never_a_plausible_number(dtype):
    eye = jnp.eye(3, dtype=dtype)
    assert not np.isfinite(np.diag(expm(jnp.asarray(2000, dtype) * eye))).any()
    rotation = jnp.asarray([[0, 1], [-1, 0]], dtype)
    digits = 2.0 ** np.finfo(dtype).nmant
    theta = _SCHEMES[np.dtype(dtype).name].theta
    assert np.isfinite(expm(jnp.asarray(0.99 * theta * digits, dtype) * rotation)).all()
    assert np.isnan(expm(jnp.asarray(1.01 * theta * digits, dtype) * rotation)).all()
    largest = jnp.asarray(np.finfo(dtype).max / 8, dtype)
    assert np.isnan(expm(largest * rotation)).all()


def conditions(f, *args):
    return str(jax.make_jaxpr(f)(*args)).count(" cond[")


def test_branches_stay_branches_in_a_batch():
    # A batched condition would become a select that squares every time, up to 52 times.
    a = jnp.asarray(np.stack([random("skew", 3, norm) for norm in (0.1, 50.0)]))

    def total(a):
        return jnp.sum(expm(a))

    def loop(f):
        return lambda a: jax.lax.scan(lambda x, _: (f(x), None), a, None, length=2)[0]

    for f in (expm, jax.grad(total), loop(jax.checkpoint(expm))):
        alone = conditions(f, a[0])
        assert alone > 0
        assert conditions(jax.vmap(f), a) == alone
        assert conditions(jax.vmap(jax.vmap(f)), a[None]) == alone
    # Only the last map has a batched condition to offer; the outer one knows nothing of it.
    assert conditions(jax.vmap(lambda _, x: expm(x), in_axes=(0, None)), a, a[0]) > 0


@pytest.mark.parametrize("norm", [0.0, 1e-8, 0.5, 5.0, 200.0])
@pytest.mark.parametrize("n", [3, 6, 8])
def test_derivative_is_the_frechet_derivative(n, norm):
    a = random("skew", n, norm)
    direction = random("general", n, 1.0, seed=1)
    exact = scipy.linalg.expm_frechet(a, direction, compute_expm=False)
    jvp = jax.jvp(expm, (jnp.asarray(a),), (jnp.asarray(direction),))[1]
    # The derivative at a is a rotation's: size 1. Both it and SciPy's lose as exp does, n·norm
    # units, and the derivative of s squarings adds s products of that error: 8 each is ample.
    bound = 2 * 8 * n * 2.3e-16 * max(1.0, norm)
    assert np.linalg.norm(np.asarray(jvp) - exact, 2) <= bound * max(1.0, np.linalg.norm(exact, 2))
    # The adjoint of L(a, ·) is L(aᵀ, ·).
    vjp = jax.vjp(expm, jnp.asarray(a))[1](jnp.asarray(direction))[0]
    exact = scipy.linalg.expm_frechet(a.T, direction, compute_expm=False)
    assert np.linalg.norm(np.asarray(vjp) - exact, 2) <= bound * max(1.0, np.linalg.norm(exact, 2))


@pytest.mark.parametrize("norm", [0.0, 1.0, 10.0, 80.0])
def test_second_derivatives(norm):
    # norm 1 needs no squaring, 10 those written out, 80 the loop as well.
    a = jnp.asarray(random("skew", 3, norm))
    # Differences with step 1e-4·(1 + norm)⁻¹ of a function with derivatives of size 1: errors 1e-8
    # from the step and norm·1e-12 from rounding; 1e-5 sees any wrong term.
    check_grads(
        expm, (a,), order=2, modes=("fwd", "rev"), eps=1e-4 / (1 + norm), rtol=1e-5, atol=1e-5
    )


def test_third_derivative():
    # d³/dx³ exp(x·J) = −J·exp(x·J) for a rotation J.
    rotation = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])

    def sine(x):
        return expm(x * rotation)[1, 0]

    third = jax.grad(jax.grad(jax.grad(sine)))
    for x in (0.0, 1.0, 7.0):
        # Rounding as in test_accuracy; every derivative of the squarings may double it.
        np.testing.assert_allclose(third(x), -np.cos(x), rtol=0, atol=2.3e-16 * 64 * (1 + x))


def test_complex_derivative():
    a = random("skew", 3, 6.0, dtype=np.complex128)
    direction = random("general", 3, 1.0, seed=1, dtype=np.complex128)
    exact = scipy.linalg.expm_frechet(a, direction, compute_expm=False)
    jvp = jax.jvp(expm, (jnp.asarray(a),), (jnp.asarray(direction),))[1]
    bound = 2 * 8 * 3 * 2.3e-16 * 6  # As in test_derivative_is_the_frechet_derivative.
    assert np.linalg.norm(np.asarray(jvp) - exact, 2) <= bound


def test_maps_and_derivatives_commute():
    batch = jnp.asarray(np.stack([random("skew", 3, norm) for norm in (0.0, 0.5, 5.0, 60.0)]))
    shared = jnp.asarray(random("general", 3, 1.0))

    def f(a, b):
        return jnp.sum(jnp.sin(expm(a @ b) @ expm(b)))

    gradients = jnp.stack([jax.grad(f)(a, shared) for a in batch])
    hessians = jnp.stack([jax.hessian(f)(a, shared) for a in batch])
    # The same sums in another order: n·norm units as in test_accuracy, for gradients of size
    # norm and Hessians of size norm².
    assert_close = np.testing.assert_allclose
    mapped = jax.vmap(jax.grad(f), in_axes=(0, None))
    assert_close(mapped(batch, shared), gradients, rtol=0, atol=1e-11)
    assert_close(jax.jit(mapped)(batch, shared), gradients, rtol=0, atol=1e-11)
    of_sum = jax.grad(lambda a: jnp.sum(jax.vmap(f, in_axes=(0, None))(a, shared)))
    assert_close(of_sum(batch), gradients, rtol=0, atol=1e-11)
    nested = jax.vmap(jax.vmap(jax.grad(f)), in_axes=(1, None))
    pairs = jnp.stack([batch, batch])
    both = nested(pairs, jnp.stack([shared, shared]))
    assert_close(both, jnp.stack([gradients, gradients], axis=1), rtol=0, atol=1e-11)
    mapped = jax.vmap(jax.hessian(f), in_axes=(0, None))
    assert_close(mapped(batch, shared), hessians, rtol=0, atol=1e-8)


def test_through_a_scan_with_checkpoints():
    a = jnp.asarray(random("general", 3, 4.0))

    def loop(wrap, a):
        step = wrap(lambda x, _: (0.3 * (expm(a) @ x - x), None))
        return jnp.sum(jax.lax.scan(step, jnp.eye(3), None, length=3)[0])

    def written_out(a):
        x = jnp.eye(3)
        for _ in range(3):
            x = 0.3 * (expm(a) @ x - x)
        return jnp.sum(x)

    value, gradient = jax.value_and_grad(written_out)(a)
    for wrap in (lambda f: f, jax.checkpoint):
        got = jax.jit(jax.value_and_grad(lambda a, wrap=wrap: loop(wrap, a)))(a)
        # The same operations, compiled together or one by one: some hundred roundings.
        np.testing.assert_allclose(got[0], value, rtol=1e-13)
        np.testing.assert_allclose(
            got[1], gradient, rtol=1e-13, atol=1e-13 * jnp.max(jnp.abs(gradient))
        )


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 3, 3)])
def test_refuses_what_is_not_a_square_matrix(shape):
    # Unwrapped, since the suite's shape checks would answer first.
    with pytest.raises(ValueError, match=r"`a` must be a square matrix.*got shape"):
        inspect.unwrap(expm)(jnp.zeros(shape))


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.bool_, jnp.float16, jnp.bfloat16])
def test_refuses_other_dtypes(dtype):
    with pytest.raises(TypeError, match=rf"`a` must have dtype .*got {jnp.dtype(dtype).name}"):
        inspect.unwrap(expm)(jnp.zeros((2, 2), dtype))
