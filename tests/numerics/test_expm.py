"""`expm`: accuracy at every norm, batches, derivatives, and what it refuses."""

import inspect
import itertools
import math
from fractions import Fraction
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import DTYPES, POSE, THETA, backward_error, coefficients, exact_expm, small, to_numpy
from xla.interpreter import run

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
with_tangent = jax.jit(lambda a, d: jax.jvp(expm, (a,), (d,)))
random = partial(small, dtype=np.float64)
KINDS = [
    *itertools.product(("skew", "negative", "general"), (1e-8, 0.3, 1.0, 4.0)),
    *itertools.product(("skew", "negative"), (30.0, 1000.0, 1e5)),
    ("general", 30.0),
]


def error(got, a):
    """Relative to the exact exponential. SciPy's double precision is exact enough for single."""
    if np.finfo(a.dtype).bits == 32:
        exact = scipy.linalg.expm(a.astype(np.promote_types(a.dtype, np.float64)))
    else:
        exact = to_numpy(exact_expm(a))
    return np.linalg.norm(np.asarray(got) - exact, 2) / np.linalg.norm(exact, 2)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("dtype", [np.float32, np.complex128, np.float64, np.complex64])
def test_accuracy(dtype, subtests):
    for kind, norm in KINDS:
        a = random(kind, 5, norm, dtype=dtype)
        condition = 1.0
        if kind == "general":
            condition = scipy.linalg.expm_cond(a.astype(np.promote_types(dtype, np.float64)))
        # A squaring of a normal matrix doubles the relative error and adds one product's, n units:
        # in all n·2ˢ ≤ n·norm. 4 covers the polynomial. A general one can lose its condition.
        bound = 4 * 5 * np.finfo(dtype).eps * max(1.0, norm, condition)
        got = compiled(a)
        with subtests.test(case=f"{kind} {norm}"):
            assert got.dtype == dtype
            assert error(got, a) <= bound


def test_accuracy_on_both_sides_of_theta():
    """Of a general matrix, where the next scheme takes over or a squaring begins."""
    for theta, relative in itertools.product(THETA["float64"], (0.999, 1.001)):
        a = random("general", 5, 1.0)
        a = a * (relative * theta / np.sqrt(np.abs(a @ a).sum(0).max()))
        # As in test_accuracy.
        bound = 4 * 5 * 2.3e-16 * max(1.0, scipy.linalg.expm_cond(a))
        assert error(compiled(a), a) <= bound, (theta, relative)


def test_every_size_and_exactly_at_zero(subtests):
    """A field that vanishes must not move the state, however often: no tolerance."""
    assert compiled(jnp.zeros((0, 0))).shape == (0, 0)
    single, double = ((np.float32, n) for n in (1, 4, 7)), ((np.complex128, n) for n in (1, 4, 6))
    # Sizes 1, up to 4, 5 to 7 and above go different ways.
    for dtype, n in (*single, *double, (np.float64, 8)):
        a = random("skew" if n > 1 else "general", n, 1.5, dtype=dtype)
        direction, zero = random("general", n, 1.0, dtype=dtype), np.zeros((n, n), dtype)
        value, _ = run(with_tangent, a, direction)
        at_zero, tangent = run(with_tangent, zero, direction)
        tiny = (1e-30 * direction).astype(dtype)
        moved, off = run(with_tangent, tiny, direction)[0], ~np.eye(n, dtype=bool)
        with subtests.test(case=f"{n} {np.dtype(dtype).name}"):
            assert value.dtype == dtype and value.shape == (n, n)
            # One product's error is n units; 4 products follow the first, most well below one.
            assert error(value, a) <= 2 * (n + 2) * np.finfo(dtype).eps
            assert np.array_equal(at_zero, np.eye(n))
            assert np.array_equal(tangent, direction)
            assert np.array_equal(moved[off], tiny[off])
    smallest, off = random("general", 5, 1e-300), ~np.eye(5, dtype=bool)
    assert np.array_equal(np.asarray(compiled(smallest))[off], smallest[off])


def test_large_but_nilpotent_needs_no_squaring():
    # The norm of a would ask for 20 squarings, that of a² for none: then I + a comes out exactly.
    for n in (2, 5):
        a = np.zeros((n, n))
        a[0, 1] = 1e6
        assert np.array_equal(compiled(a), np.eye(n) + a)


def test_negative_eigenvalues_underflow_to_zero():
    got = np.asarray(compiled(np.diag([-1000.0, 1.0, -1.0, 0.0, 0.0])))
    assert got[0, 0] == 0
    # 10 squarings: 2¹⁰ units of rounding.
    np.testing.assert_allclose(np.diag(got)[1:3], [np.e, 1 / np.e], rtol=2**10 * 2.3e-16)


def test_each_member_of_a_batch_has_its_own_scaling_and_what_is_not_finite():
    norms = [1e-8, 0.5, 3.0, 2e4]
    batch = np.stack([random("skew", 5, norm, seed=i) for i, norm in enumerate(norms)] * 2)
    batch[4:7, 0, 4] = [np.nan, np.inf, -np.inf]
    got = run(jax.vmap(expm), batch)
    for x, a, norm in zip(got, batch, norms, strict=False):
        # As in test_accuracy. With the scaling of the largest this would be 2e4 times as much.
        assert error(x, a) <= 4 * 5 * 2.3e-16 * max(1.0, norm)
    assert np.isnan(got[4:7]).all() and np.array_equal(got[3], got[7])
    for n in (1, 3, 5):
        a = random("general", n, 3.0)
        for bad in (np.nan, np.inf, -np.inf):
            a[0, n - 1] = bad
            assert np.isnan(run(compiled, a)).all()
    a = jnp.asarray([[0.0, np.inf], [0.0, 0.0]])
    assert np.isnan(run(jax.grad(lambda a: jnp.sum(compiled(a))), a)).all()


def test_overflow_and_too_large_are_never_a_plausible_number(subtests):
    for n, dtype in [*((5, dtype) for dtype in DTYPES), (2, np.float32), (2, np.complex128)]:
        rotation = np.zeros((n, n), dtype)
        rotation[0, 1], rotation[1, 0] = 1, -1
        digits = 2.0 ** np.finfo(dtype).nmant
        theta = 1.0 if n == 2 else THETA[np.finfo(dtype).dtype.name][-1]
        times = lambda x, a, dtype=dtype: compiled((x * a).astype(dtype))  # noqa: E731
        with subtests.test(case=f"{n} {np.dtype(dtype).name}"):
            assert not np.isfinite(np.diag(times(2000, np.eye(n)))).any()
            assert np.isfinite(times(0.99 * theta * digits, rotation)).all()
            assert np.isnan(times(1.01 * theta * digits, rotation)).all()
            assert np.isnan(times(float(np.finfo(dtype).max) / 8, rotation)).all()


def conditions(f, *args):
    return str(jax.make_jaxpr(f)(*args)).count(" cond[")


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [6, 3])
def test_branches_stay_branches_in_a_batch(n):
    # A batched condition would become a select that squares every time, up to 52 times.
    a = jnp.asarray(np.stack([random("skew", n, norm) for norm in (0.1, 50.0)]))

    def loop(f):
        return lambda a: jax.lax.scan(lambda x, _: (f(x), None), a, None, length=2)[0]

    assert conditions(jax.vmap(jax.vmap(expm)), a[None]) == conditions(expm, a[0]) > 0
    for f in (jax.grad(lambda a: jnp.sum(expm(a))), loop(jax.checkpoint(expm))):
        assert conditions(jax.vmap(f), a) == conditions(f, a[0]) > 0
    # A map over something else leaves the matrix, and so its condition, unbatched.
    assert conditions(jax.vmap(lambda _, x: expm(x), in_axes=(0, None)), a, a[0]) > 0


@jax.jit
def both_derivatives(a, direction):
    pushed = jax.jvp(expm, (a,), (direction,))[1]
    return pushed, jax.vjp(expm, a)[1](direction)[0]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
def test_derivative_is_the_frechet_derivative(dtype):
    direction = random("general", 6, 1.0, seed=1, dtype=dtype)
    for norm in (0.0, 1e-8, 0.5, 5.0, 200.0):
        a = random("skew", 6, norm, dtype=dtype)
        # The derivative's norm is at most 1. It loses as exp does, 4·n·norm units as in
        # test_accuracy, for each of its two factors exp; SciPy's loses as much. The transpose of
        # L(a, ·) is L(aᵀ, ·), for complex matrices as well.
        bound = 2 * 2 * 4 * 6 * 2.3e-16 * max(1.0, norm)
        for got, x in zip(run(both_derivatives, a, direction), (a, a.T), strict=True):
            exact = scipy.linalg.expm_frechet(x, direction, compute_expm=False)
            assert np.linalg.norm(got - exact, 2) <= bound, norm


def curved(a, b):
    return jnp.sum(jnp.sin(expm(a) @ b))


@jax.jit
def second_derivatives(a, v, b):
    def slope(a):
        return jax.jvp(lambda a: curved(a, b), (a,), (v,))[1]

    forward_over_reverse = jax.jvp(lambda a: jax.grad(curved)(a, b), (a,), (v,))[1]
    reverse_over_reverse = jax.grad(lambda a: jnp.vdot(jax.grad(curved)(a, b), v))(a)
    return forward_over_reverse, jax.grad(slope)(a), reverse_over_reverse


@pytest.mark.slow
def test_second_derivatives_and_maps_of_them():
    gradient = jax.jit(jax.grad(curved))
    shared, v = (random("general", 6, 1.0, seed=seed) for seed in (2, 3))
    # No squaring, at zero and elsewhere with either scheme; those written out; the loop as well.
    batch = np.stack([random("skew", 6, norm) for norm in (0.0, 0.3, 1.0, 10.0, 80.0)])
    slopes, seconds, h = [], [], 1e-5
    for a in batch:
        difference = (gradient(a + h * v, shared) - gradient(a - h * v, shared)) / (2 * h)
        found = second_derivatives(a, v, shared)
        for second in found:
            # The difference is off by h² = 1e-10 times a fourth derivative, and by the rounding of
            # the gradient, 4·6·80 units, over h: 4e-8.
            np.testing.assert_allclose(second, difference, rtol=0, atol=2e-7)
        slopes.append(gradient(a, shared))
        seconds.append(found[0])
    # Gradients of norm 1, rounded in another order: 4·6·80 units as in test_accuracy, and the
    # same for each of two factors exp. Second derivatives have three.
    tolerance = 2 * 4 * 6 * 80 * 2.3e-16
    mapped = jax.vmap(jax.grad(curved), in_axes=(0, None))
    of_sum = jax.grad(lambda a, b: jnp.sum(jax.vmap(curved, in_axes=(0, None))(a, b)))
    for f in (mapped, of_sum):
        np.testing.assert_allclose(jax.jit(f)(batch, shared), slopes, rtol=0, atol=tolerance)
    nested = jax.jit(jax.vmap(mapped, in_axes=(1, 0)))
    got = nested(np.stack([batch, batch], axis=1), np.stack([shared, shared]))
    np.testing.assert_allclose(got, np.stack([slopes] * 2), rtol=0, atol=tolerance)
    hessians = jax.jit(jax.vmap(jax.hessian(curved), in_axes=(0, None)))(batch, shared)
    products = jnp.einsum("bijkl,kl->bij", hessians, v)
    np.testing.assert_allclose(products, seconds, rtol=0, atol=3 * tolerance)


@pytest.mark.slow
def test_third_derivative():
    # d³/dx³ exp(x·J) = -J·exp(x·J) for a rotation J.
    rotation = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])
    third = jax.jit(jax.grad(jax.grad(jax.grad(lambda x: expm(x * rotation)[1, 0]))))
    for x in (0.0, 1.0, 7.0):
        # Each of at most four factors exp loses as in test_accuracy.
        np.testing.assert_allclose(third(x), -np.cos(x), rtol=0, atol=4 * 4 * 2 * 2.3e-16 * (1 + x))


def test_refuses_what_is_not_a_square_matrix_or_of_another_dtype(no_shape_hook, subtests):
    # Unwrapped, since the suite's shape checks would answer first.
    plain: Any = inspect.unwrap(expm)
    for shape in ((), (3,), (2, 3), (2, 3, 3)):
        text = r"`a` must be a square matrix.*got shape"
        with subtests.test(case=str(shape)), pytest.raises(ValueError, match=text):
            plain(jnp.zeros(shape))
    for dtype in (jnp.int32, jnp.bool_, jnp.float16, jnp.bfloat16):
        text = rf"`a` must have dtype .*got {jnp.dtype(dtype).name}"
        with subtests.test(case=text), pytest.raises(TypeError, match=text):
            plain(jnp.zeros((2, 2), dtype))


def test_expm_of_an_array_of_numpy(no_shape_hook):
    a = np.array([[0.0, -0.5], [0.5, 0.0]])
    expected = [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    np.testing.assert_allclose(expm(a), expected, rtol=0, atol=1e-15)
    slope = run(lambda t: jax.jvp(lambda t: expm(t * a), (t,), (1.0,))[1], 0.0)
    np.testing.assert_allclose(slope, a, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match=r"`a` must be a square matrix, shape \(n, n\), got"):
        expm(np.ones((2, 3)))


# Polynomials

SCHEMES = [
    (_DEGREE_15, 15, 2.0**-24),
    (_DEGREE_15_DOUBLE, 15, 2.0**-53),
    (_DEGREE_21, 21, 2.0**-53),
]


def test_polynomials_and_where_their_backward_error_reaches_the_unit_roundoff(subtests):
    for scheme, degree, unit in SCHEMES:
        got = coefficients(scheme)
        off = [float(got[k] * math.factorial(k) - 1) for k in range(len(got))]
        log = backward_error(got, degree)
        backward = lambda x, log=log, n=degree: sum(  # noqa: E731
            c * x ** (k - 1) for k, c in enumerate(log) if k > n
        )
        with subtests.test(case=f"{degree} {scheme.theta}"):
            assert off[:2] == [0, 0]
            # Rounding the weights to double moves a coefficient by at most 2.8e-16 (computed here).
            assert max(map(abs, off[2 : degree + 1])) < 4e-16
            # The degrees above are not Taylor's, or the name of the scheme would be wrong.
            assert min(map(abs, off[degree + 1 :])) > 0.1
            # What the first are off by is the same in every step: drift grows with their number.
            for k in range(2, 7):
                assert abs(float(got[k] - Fraction(1, math.factorial(k)))) < 1e-17
            assert backward(scheme.theta) <= unit < backward(scheme.theta * 1.001)
    for precision, thetas in THETA.items():
        assert tuple(scheme.theta for scheme in TAYLOR_SCHEMES[precision]) == thetas


def test_the_rounding_of_the_rest_is_as_small_as_it_is():
    cases = [(kind, norm) for kind in ("skew", "meet", "general") for norm in (1e-6, 1e-3, 0.5)]
    for n, dtype in ((2, np.float32), (3, np.complex128)):
        a = np.stack([small(kind, n, norm, 0, dtype) for kind, norm in cases])
        weights, found = run(jax.vmap(expm_parts), a)
        assert (np.asarray(weights) == 1).all()
        for x, rest in zip(a, np.asarray(found), strict=True):
            with mpmath.workdps(60):
                m = mpmath.matrix(x.tolist())
                exact = to_numpy(exact_expm(x) - mpmath.eye(n) - m)
            # The errors of c, and of one product, relative to the square of a, which for real skew
            # matrices of size 2 is no smaller than the norm squared.
            atol = 8 * np.finfo(dtype).eps * np.linalg.norm(x) ** 2
            np.testing.assert_allclose(rest, exact, rtol=0, atol=atol)
    weight, rest = run(expm_parts, POSE)
    assert weight == 1 and np.array_equal(rest[2], np.zeros(3))
