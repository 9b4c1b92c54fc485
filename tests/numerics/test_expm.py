"""`expm`: accuracy at every norm, batches, derivatives, and what it refuses."""

import inspect
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import POSE, THETA, backward_error, coefficients, exact_expm, small, to_numpy

from cfjax import expm
from cfjax._numerics.expm import (
    _DEGREE_15,
    _DEGREE_15_DOUBLE,
    _DEGREE_21,
    TAYLOR_SCHEMES,
    expm_parts,
)

# One compilation for each size and dtype keeps this file fast.
compiled = jax.jit(expm)

DTYPES = [np.float32, np.float64, np.complex64, np.complex128]


def random(kind, n, norm, seed=0, dtype: type = np.float64):
    """A matrix with the given 2-norm. Skew and negative ones are normal, with exp of norm 1."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    if np.issubdtype(dtype, np.complexfloating):
        a = a + 1j * rng.normal(size=(n, n))
    if kind == "skew":
        a = a - a.conj().T
    elif kind == "negative":
        a[:, 0] = 0  # An eigenvalue zero, or exp underflows for a large norm.
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


@pytest.mark.representatives(8)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("kind", "norm"),
    [
        *(
            (kind, norm)
            for kind in ("skew", "negative", "general")
            for norm in (1e-8, 0.3, 1.0, 4.0)
        ),
        *((kind, norm) for kind in ("skew", "negative") for norm in (30.0, 1000.0, 1e5)),
        ("general", 30.0),
    ],
)
def test_accuracy(kind, norm, dtype):
    a = random(kind, 5, norm, dtype=dtype)
    condition = 1.0
    if kind == "general":
        condition = scipy.linalg.expm_cond(a.astype(np.promote_types(dtype, np.float64)))
    # A squaring of a normal matrix doubles the relative error and adds one product's, n units: in
    # all n·2ˢ ≤ n·norm. 4 covers the polynomial. A general one can lose its condition number.
    bound = 4 * 5 * np.finfo(dtype).eps * max(1.0, norm, condition)
    got = compiled(jnp.asarray(a))
    assert got.dtype == dtype
    assert error(got, reference(a)) <= bound


@pytest.mark.representatives(1)
@pytest.mark.parametrize("theta", THETA["float64"])
@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
@pytest.mark.parametrize("relative", [0.999, 1.001])
def test_accuracy_on_both_sides_of_theta(relative, dtype, theta):
    # A general matrix of size 6, where the next scheme takes over or a squaring begins.
    a = random("general", 6, 1.0, dtype=dtype)
    square = a @ a
    size = (np.abs(np.real(square)) + np.abs(np.imag(square))).sum(0).max()
    a = a * (relative * theta / np.sqrt(size))
    # As in test_accuracy.
    bound = 4 * 6 * 2.3e-16 * max(1.0, scipy.linalg.expm_cond(a))
    assert error(compiled(jnp.asarray(a)), reference(a)) <= bound


@pytest.mark.representatives(6)
@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 5, 7, 8, 9, 33])
@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
def test_every_size(n, dtype):
    # Sizes 1, up to 4, 5 to 7 and above go different ways.
    if n == 0:
        assert compiled(jnp.zeros((0, 0), dtype)).shape == (0, 0)
        return
    a = random("skew" if n > 1 else "general", n, 1.5, dtype=dtype)
    got = compiled(jnp.asarray(a))
    assert got.dtype == dtype and got.shape == (n, n)
    # One product's error is n units; 4 products follow the first, most of them well below one.
    assert error(got, reference(a)) <= 2 * (n + 2) * np.finfo(dtype).eps


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 3, 6, 8])
def test_exact_at_zero(n, dtype):
    # A field that vanishes must not move the state, however often: no tolerance.
    assert np.array_equal(compiled(jnp.zeros((n, n), dtype)), np.eye(n))
    direction = jnp.asarray(random("general", n, 1.0, dtype=dtype))
    value, tangent = jax.jvp(compiled, (jnp.zeros((n, n), dtype),), (direction,))
    assert np.array_equal(value, np.eye(n))
    assert np.array_equal(tangent, direction)
    tiny = jnp.asarray(1e-30, dtype) * direction
    off = ~np.eye(n, dtype=bool)
    assert np.array_equal(np.asarray(compiled(tiny))[off], np.asarray(tiny)[off])


def test_smallest_number():
    a = random("general", 5, 1e-300)
    off = ~np.eye(5, dtype=bool)
    assert np.array_equal(np.asarray(compiled(jnp.asarray(a)))[off], a[off])


def test_large_but_nilpotent_needs_no_squaring():
    # The norm of a would ask for 20 squarings, that of a² for none: then I + a comes out exactly.
    a = jnp.asarray([[0.0, 1e6], [0.0, 0.0]])
    assert np.array_equal(compiled(a), [[1.0, 1e6], [0.0, 1.0]])


def test_negative_eigenvalues_underflow_to_zero():
    a = jnp.diag(jnp.asarray([-1000.0, 1.0, -1.0]))
    got = np.asarray(compiled(a))
    assert got[0, 0] == 0
    # 10 squarings: 2¹⁰ units of rounding.
    np.testing.assert_allclose(np.diag(got)[1:], [np.e, 1 / np.e], rtol=2**10 * 2.3e-16)


def test_each_member_of_a_batch_has_its_own_scaling():
    norms = [1e-8, 0.5, 3.0, 2e4]
    batch = np.stack([random("skew", 5, norm, seed=i) for i, norm in enumerate(norms)])
    got = jax.jit(jax.vmap(expm))(jnp.asarray(batch))
    for x, a, norm in zip(got, batch, norms, strict=True):
        # As in test_accuracy. With the scaling of the largest this would be 2e4 times as much.
        assert error(x, reference(a)) <= 4 * 5 * 2.3e-16 * max(1.0, norm)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [1, 3, 6, 9])
@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
def test_not_finite_gives_nan_and_stays_with_its_member(n, dtype):
    good = random("general", n, 3.0, dtype=np.float32).astype(dtype)
    batch = np.stack([good] * 4)
    batch[:3, 0, n - 1] = [np.nan, np.inf, -np.inf]
    got = jax.jit(jax.vmap(expm))(jnp.asarray(batch))
    assert np.isnan(got[:3]).all()
    # As in test_accuracy; the condition number of such a matrix is below 3·e³ = 60.
    assert error(got[3], reference(good)) <= 4 * n * np.finfo(dtype).eps * 60
    for bad in batch[:3]:
        assert np.isnan(compiled(jnp.asarray(bad))).all()


def test_not_finite_gives_nan_gradient():
    a = jnp.asarray([[0.0, np.inf], [0.0, 0.0]])
    assert np.isnan(jax.jit(jax.grad(lambda a: jnp.sum(compiled(a))))(a)).all()


@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("dtype", DTYPES)
def test_overflow_and_too_large_are_never_a_plausible_number(dtype, n):
    eye = jnp.eye(n, dtype=dtype)
    assert not np.isfinite(np.diag(compiled(jnp.asarray(2000, dtype) * eye))).any()
    rotation = jnp.zeros((n, n), dtype).at[0, 1].set(1).at[1, 0].set(-1)
    digits = 2.0 ** np.finfo(dtype).nmant
    theta = 1.0 if n == 2 else THETA[np.finfo(dtype).dtype.name][-1]
    assert np.isfinite(compiled(jnp.asarray(0.99 * theta * digits, dtype) * rotation)).all()
    assert np.isnan(compiled(jnp.asarray(1.01 * theta * digits, dtype) * rotation)).all()
    largest = jnp.asarray(np.finfo(dtype).max / 8, dtype)
    assert np.isnan(compiled(largest * rotation)).all()


def conditions(f, *args):
    return str(jax.make_jaxpr(f)(*args)).count(" cond[")


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [3, 6])
def test_branches_stay_branches_in_a_batch(n):
    # A batched condition would become a select that squares every time, up to 52 times.
    a = jnp.asarray(np.stack([random("skew", n, norm) for norm in (0.1, 50.0)]))

    def total(a):
        return jnp.sum(expm(a))

    def loop(f):
        return lambda a: jax.lax.scan(lambda x, _: (f(x), None), a, None, length=2)[0]

    for f in (expm, jax.grad(total), loop(jax.checkpoint(expm))):
        alone = conditions(f, a[0])
        assert alone > 0
        assert conditions(jax.vmap(f), a) == alone
        assert conditions(jax.vmap(jax.vmap(f)), a[None]) == alone
    # A map over something else leaves the matrix, and so its condition, unbatched.
    assert conditions(jax.vmap(lambda _, x: expm(x), in_axes=(0, None)), a, a[0]) > 0


@jax.jit
def both_derivatives(a, direction):
    pushed = jax.jvp(expm, (a,), (direction,))[1]
    return pushed, jax.vjp(expm, a)[1](direction)[0]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("norm", [0.0, 1e-8, 0.5, 5.0, 200.0])
@pytest.mark.parametrize(("n", "dtype"), [(3, np.float64), (6, np.float64), (3, np.complex128)])
def test_derivative_is_the_frechet_derivative(n, dtype, norm):
    a = random("skew", n, norm, dtype=dtype)
    direction = random("general", n, 1.0, seed=1, dtype=dtype)
    pushed, pulled = both_derivatives(jnp.asarray(a), jnp.asarray(direction))
    # The derivative's norm is at most 1. It loses as exp does, 4·n·norm units as in test_accuracy,
    # for each of its two factors exp; SciPy's loses as much.
    bound = 2 * 2 * 4 * n * 2.3e-16 * max(1.0, norm)
    exact = scipy.linalg.expm_frechet(a, direction, compute_expm=False)
    assert np.linalg.norm(np.asarray(pushed) - exact, 2) <= bound
    # The transpose of L(a, ·) is L(aᵀ, ·), for complex matrices as well.
    exact = scipy.linalg.expm_frechet(a.T, direction, compute_expm=False)
    assert np.linalg.norm(np.asarray(pulled) - exact, 2) <= bound


def curved(a, b):
    return jnp.sum(jnp.sin(expm(a) @ b))


gradient = jax.jit(jax.grad(curved))
SHARED = jnp.asarray(random("general", 3, 1.0, seed=2))
# No squaring, at zero and elsewhere; those written out; the loop as well.
BATCH = jnp.asarray(np.stack([random("skew", 3, norm) for norm in (0.0, 1.0, 10.0, 80.0)]))


@jax.jit
def second_derivatives(a, v):
    def slope(a):
        return jax.jvp(lambda a: curved(a, SHARED), (a,), (v,))[1]

    forward_over_reverse = jax.jvp(lambda a: jax.grad(curved)(a, SHARED), (a,), (v,))[1]
    reverse_over_reverse = jax.grad(lambda a: jnp.vdot(jax.grad(curved)(a, SHARED), v))(a)
    return forward_over_reverse, jax.grad(slope)(a), reverse_over_reverse


@pytest.mark.slow
@pytest.mark.parametrize("member", range(4))
def test_second_derivatives(member):
    a, v = BATCH[member], jnp.asarray(random("general", 3, 1.0, seed=3))
    h = 1e-5
    difference = (gradient(a + h * v, SHARED) - gradient(a - h * v, SHARED)) / (2 * h)
    for second in second_derivatives(a, v):
        # The difference is off by h² = 1e-10 times a fourth derivative, and by the rounding of the
        # gradient, 4·3·80 units, over h: 2e-8.
        np.testing.assert_allclose(second, difference, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_third_derivative():
    # d³/dx³ exp(x·J) = -J·exp(x·J) for a rotation J.
    rotation = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])

    def sine(x):
        return expm(x * rotation)[1, 0]

    third = jax.jit(jax.grad(jax.grad(jax.grad(sine))))
    for x in (0.0, 1.0, 7.0):
        # Each of at most four factors exp loses as in test_accuracy.
        np.testing.assert_allclose(third(x), -np.cos(x), rtol=0, atol=4 * 4 * 2 * 2.3e-16 * (1 + x))


@pytest.mark.slow
def test_maps_and_derivatives_commute():
    gradients = jnp.stack([gradient(a, SHARED) for a in BATCH])
    # Gradients of norm 1, rounded in another order: 4·3·80 units as in test_accuracy, and the
    # same for each of two factors exp.
    tolerance = 2 * 4 * 3 * 80 * 2.3e-16
    mapped = jax.vmap(jax.grad(curved), in_axes=(0, None))
    of_sum = jax.grad(lambda a, b: jnp.sum(jax.vmap(curved, in_axes=(0, None))(a, b)))
    for f in (mapped, of_sum):
        np.testing.assert_allclose(jax.jit(f)(BATCH, SHARED), gradients, rtol=0, atol=tolerance)
    nested = jax.jit(jax.vmap(mapped, in_axes=(1, 0)))
    got = nested(jnp.stack([BATCH, BATCH], axis=1), jnp.stack([SHARED, SHARED]))
    np.testing.assert_allclose(got, jnp.stack([gradients] * 2), rtol=0, atol=tolerance)


@pytest.mark.slow
def test_hessian_under_vmap():
    got = jax.jit(jax.vmap(jax.hessian(curved), in_axes=(0, None)))(BATCH, SHARED)
    v = jnp.asarray(random("general", 3, 1.0, seed=3))
    for hessian, a in zip(got, BATCH, strict=True):
        # Second derivatives of norm 1 with three factors exp: as in the test above.
        product = jnp.einsum("ijkl,kl->ij", hessian, v)
        tolerance = 3 * 2 * 4 * 3 * 80 * 2.3e-16
        np.testing.assert_allclose(product, second_derivatives(a, v)[0], rtol=0, atol=tolerance)


@pytest.mark.slow
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

    value, slope = jax.jit(jax.value_and_grad(written_out))(a)
    for wrap in (lambda f: f, jax.checkpoint):
        got = jax.jit(jax.value_and_grad(lambda a, wrap=wrap: loop(wrap, a)))(a)
        # The same operations, compiled in another order: some hundred roundings.
        np.testing.assert_allclose(got[0], value, rtol=1e-13)
        largest = float(jnp.max(jnp.abs(slope)))
        np.testing.assert_allclose(got[1], slope, rtol=0, atol=1e-13 * largest)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 3, 3)])
@pytest.mark.usefixtures("no_shape_hook")
def test_refuses_what_is_not_a_square_matrix(shape):
    # Unwrapped, since the suite's shape checks would answer first.
    with pytest.raises(ValueError, match=r"`a` must be a square matrix.*got shape"):
        inspect.unwrap(expm)(jnp.zeros(shape))


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.bool_, jnp.float16, jnp.bfloat16])
@pytest.mark.usefixtures("no_shape_hook")
def test_refuses_other_dtypes(dtype):
    with pytest.raises(TypeError, match=rf"`a` must have dtype .*got {jnp.dtype(dtype).name}"):
        inspect.unwrap(expm)(jnp.zeros((2, 2), dtype))


@pytest.mark.slow
@pytest.mark.parametrize("norm", [0.0, 0.3, 1.0])
def test_second_derivative_of_a_size_with_two_schemes(norm):
    # d²/dx² exp(x·a) = a²·exp(x·a).
    a = random("skew", 6, 1.0)
    entry = jax.jit(jax.grad(jax.grad(lambda x: jnp.sum(expm(x * a)))))
    exact = np.sum(a @ a @ scipy.linalg.expm(norm * a))
    # 36 entries, each of at most three factors that lose as in test_accuracy.
    assert abs(float(entry(norm)) - exact) <= 36 * 3 * 4 * 6 * 2.3e-16


def test_expm_of_an_array_of_numpy(no_shape_hook):
    a = np.array([[0.0, -0.5], [0.5, 0.0]])
    expected = [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    np.testing.assert_allclose(expm(a), expected, rtol=0, atol=1e-15)
    slope = jax.jvp(lambda t: expm(t * a), (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, a, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match=r"`a` must be a square matrix, shape \(n, n\), got"):
        expm(np.ones((2, 3)))


# Polynomials

SCHEMES = pytest.mark.parametrize(
    ("scheme", "degree", "unit"),
    [
        (_DEGREE_15, 15, 2.0**-24),
        (_DEGREE_15_DOUBLE, 15, 2.0**-53),
        (_DEGREE_21, 21, 2.0**-53),
    ],
)


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


@pytest.mark.parametrize("scheme", [_DEGREE_15, _DEGREE_21])
def test_the_first_coefficients_have_no_bias(scheme):
    """What they are off by is the same in every step, and drift grows with the number of steps."""
    got = coefficients(scheme)
    for k in range(2, 7):
        assert abs(float(got[k] - Fraction(1, math.factorial(k)))) < 1e-17


@SCHEMES
def test_theta_is_where_the_backward_error_reaches_the_unit_roundoff(scheme, degree, unit):
    log = backward_error(coefficients(scheme), degree)

    def backward(x):
        return sum(c * x ** (k - 1) for k, c in enumerate(log) if k > degree)

    assert backward(scheme.theta) <= unit < backward(scheme.theta * 1.001)


def test_theta_of_each_scheme():
    for precision, thetas in THETA.items():
        assert tuple(scheme.theta for scheme in TAYLOR_SCHEMES[precision]) == thetas


# The rest of exp(a)


@pytest.mark.parametrize("dtype", [np.float32, np.complex128])
@pytest.mark.parametrize("n", [2, 3])
def test_the_rounding_of_the_rest_is_as_small_as_it_is(n, dtype):
    cases = [(kind, norm) for kind in ("skew", "meet", "general") for norm in (1e-6, 1e-3, 0.5)]
    a = np.stack([small(kind, n, norm, 0, dtype) for kind, norm in cases])
    weights, found = jax.jit(jax.vmap(expm_parts))(a)
    assert (np.asarray(weights) == 1).all()
    for x, rest in zip(a, np.asarray(found), strict=True):
        with mpmath.workdps(60):
            m = mpmath.matrix(x.tolist())
            exact = to_numpy(exact_expm(x) - mpmath.eye(n) - m)
        # The errors of c, and of one product, relative to the square of a, which for real skew
        # matrices of size 2 is no smaller than the norm squared.
        atol = 8 * np.finfo(dtype).eps * np.linalg.norm(x) ** 2
        np.testing.assert_allclose(rest, exact, rtol=0, atol=atol)


def test_the_rest_of_a_pose_far_away():
    weight, rest = expm_parts(jnp.asarray(POSE))
    assert weight == 1
    assert np.array_equal(rest[2], np.zeros(3))
