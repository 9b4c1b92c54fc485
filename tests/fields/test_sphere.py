"""SphereRotation: flows, steps against full matrices, length, derivatives, errors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg

import cfjax
from cfjax import LeftMatrix, LowRankSkew, Rotation, SphereRotation

EPS = {np.float32: 2.0**-23, np.float64: 2.0**-52}


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape))


def unit(*shape, seed=1):
    y = normal(*shape, seed=seed)
    return y / jnp.linalg.norm(y, axis=-1, keepdims=True)


def dense(g, y):
    g, y = (np.asarray(x, float) for x in (g, y))
    return np.outer(g, y) - np.outer(y, g)


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("n", "dtype"), [(3, np.float64), (1, np.float32), (6, np.float32), (2, np.float64)]
)
def test_flow(n, dtype):
    """Of pairs of vectors, each of which has one field. For n = 3 there is a way of its own."""
    moved = jax.jit(lambda field, y: (field.flow(y), field.tangent(y)))
    directions, ys = unit(2, 1, n), np.asarray(unit(2, 2, n)).astype(dtype)
    for norm in (0.0, 1e-9, 0.4, np.pi, 30.0):
        gs = np.asarray(norm * directions).astype(dtype)
        flows, tangents = moved(SphereRotation(gs), ys)
        assert flows.dtype == dtype
        for i, j in np.ndindex(2, 2):
            a, y = dense(gs[i, 0], ys[i, j]), ys[i, j]
            # The start is moved to length 1 by one unit; the angle is rounded, 10 units for the
            # sums.
            atol = 20 * EPS[dtype] * (1 + 2 * norm)
            np.testing.assert_allclose(flows[i, j], scipy.linalg.expm(a) @ y, rtol=0, atol=atol)
            atol = 20 * EPS[dtype] * norm
            np.testing.assert_allclose(tangents[i, j], a @ y, rtol=0, atol=atol)


# Whole steps

A = normal(6, 6)


def g_of(t, y):
    """Depends on time and state, and is not tangent."""
    n = y.shape[-1]
    return jnp.cos(t) * A[:n, :n] @ y + A[0, :n] * (1 + t)


def sphere(t, y, args):
    return SphereRotation(g_of(t, y))


def full(t, y, args):
    g = g_of(t, y)
    return LeftMatrix(jnp.outer(g, y) - jnp.outer(y, g))


def rotation(t, y, args):
    return Rotation(jnp.cross(y, g_of(t, y)))


# The stages of the last are a loop.
METHODS: list[Any] = [cfjax.CF4(), cfjax.RKMK4(), cfjax.YRK135()]


def one_step(solver, term, y0):
    return jax.jit(lambda y: problems.first_step(solver, term, 0.2, 0.5, y, None)[0])(y0)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", METHODS, ids=repr)
def test_a_step_is_the_step_with_full_matrices(solver):
    y0 = unit(6)
    found, expected = (one_step(solver, cfjax.LieTerm(field), y0) for field in (sphere, full))
    # Both round each of up to six flows by some units; the weights of YRK135 reach 36.
    atol = 2e-12 if isinstance(solver, cfjax.YRK135) else 2e-14
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
    assert np.abs(found - y0).max() > 0.05


def of_shape(field, shape):
    for _ in shape[1:]:
        field = jax.vmap(field, in_axes=(None, 0, None))
    return cfjax.LieTerm(field)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("shape", "solver"), [((2, 4, 3), METHODS[1]), ((3,), METHODS[0]), ((2, 4, 3), METHODS[2])]
)
def test_in_space_it_is_the_rotation(shape, solver):
    """The cross product with y x g, so the steps agree: alone and for many."""
    y0 = unit(*shape)
    found, expected = (one_step(solver, of_shape(field, shape), y0) for field in (sphere, rotation))
    # The same field, whose coordinates are rounded in another order.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)


@pytest.mark.parametrize(("n", "num_steps"), [(3, 100_000), (5, 10_000)])
def test_length_is_kept_over_many_steps(n, num_steps):
    d = jnp.arange(1.0, n + 1)
    turn = normal(n, n, seed=2)
    field = lambda t, y, args: SphereRotation(jnp.cos(t) * d * y + turn @ y)  # noqa: E731
    ys = cfjax.integrate(
        cfjax.LieTerm(field),
        cfjax.CF4(),
        0.0,
        num_steps * 0.03,
        unit(n),
        num_steps=num_steps,
        save_every=num_steps // 10,
    ).ys
    wide = np.asarray(ys).astype(np.longdouble)
    # Rounding to double alone moves the length by half a unit in every entry.
    assert np.abs(np.sqrt(np.sum(wide * wide, axis=1)) - 1).max() < 2e-15
    # It moves all the while.
    assert np.abs(wide[-1] - wide[-2]).max() > 1e-2


def test_cayley_is_that_of_one_column():
    # Many columns are one field here.
    g = lambda t, y: g_of(t, y[:, 0])[:, None]  # noqa: E731
    column = lambda t, y, args: LowRankSkew(jax.vmap(g, (None, 0))(t, y))  # noqa: E731
    y0, solver = unit(2, 6), cfjax.CayleyRK4()
    expected = one_step(solver, cfjax.LieTerm(column), y0[..., None])[..., 0]
    # The same operations.
    for y, want in ((y0, expected), (y0[0], expected[0])):
        found = one_step(solver, of_shape(sphere, y.shape), y)
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


# Derivatives


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [6, 3, 1])
def test_derivatives_at_zero(n):
    """There the flow is `y + v - y (v @ v) / 2 + ..`, where v is the part of g tangent at y."""
    y, zero = unit(n), jnp.zeros(n)
    u, w = normal(2, n)
    move = lambda g: SphereRotation(g).flow(y)  # noqa: E731

    @jax.jit
    def derivatives(u, w):
        first = lambda g: jax.jvp(move, (g,), (u,))[1]  # noqa: E731
        weigh = lambda g: w @ move(g)  # noqa: E731
        return (
            move(zero),
            first(zero),
            jax.jvp(first, (zero,), (w,))[1],
            jax.grad(weigh)(zero),
            jax.grad(lambda g: u @ jax.grad(weigh)(g))(zero),
            SphereRotation(u).to_chart(y, ())[0].tangent(y),
        )

    at_zero, first, second, gradient, reverse, in_chart = derivatives(u, w)
    tangent = np.eye(n) - np.outer(y, y)
    # Sums of n products of numbers of about 1.
    check = lambda found, expected: np.testing.assert_allclose(  # noqa: E731
        found, expected, rtol=0, atol=1e-14
    )
    check(at_zero, y)
    check(first, tangent @ u)
    check(in_chart, tangent @ u)
    check(second, -y * (u @ tangent @ w))
    check(gradient, tangent @ w)
    check(reverse, -(w @ y) * (tangent @ u))


def test_gradients_of_a_solve():
    """Along the sphere and in a parameter, against differences."""
    n = 3
    v = normal(n)

    def loss(x):
        y0, scale = x
        y0 = y0 / jnp.sqrt(y0 @ y0)
        field = lambda t, y, args: SphereRotation(scale * g_of(t, y))  # noqa: E731
        ys = cfjax.integrate(cfjax.LieTerm(field), cfjax.CF3(), 0.0, 0.5, y0, num_steps=3).ys
        return v @ jnp.sin(ys[-1])

    x = unit(n), jnp.asarray(0.7)
    along = problems.random_like(x, 1)
    found = problems.inner(jax.jit(jax.grad(loss))(x), along)
    # Fifth derivatives of up to 1e4 times 1e-12 / 30, and rounding of 1e-15 over 1e-3.
    expected = problems.central_difference(jax.jit(loss), x, along, 1e-3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-9)


# What is refused


def test_wrong_arguments(subtests, no_shape_hook):
    for shape in [(), (0,), (2, 0)]:
        text = r"g must have shape \(n,\) or \(\*batch, n\) .* got \("
        with subtests.test(shape=str(shape)), pytest.raises(ValueError, match=text):
            SphereRotation(jnp.ones(shape))
    for dtype in ("int32", "float16", "complex128"):
        text = "g must be float32 or float64, got"
        with subtests.test(dtype=dtype), pytest.raises(TypeError, match=text):
            SphereRotation(jnp.ones(3, dtype))
    with pytest.raises(TypeError, match="SphereRotation has none"):
        cfjax.bracket(SphereRotation(normal(5)), SphereRotation(normal(5)))


def test_wrong_point(subtests, no_shape_hook):
    for n in (3, 4):
        field = SphereRotation(jnp.ones(n))
        term = cfjax.LieTerm(lambda t, y, args, field=field: field)
        texts = {
            (5,): rf"g of shape \({n},\) acts on shapes \({n},\), got \(5,\)",
            (7, n): rf"give the coordinates leading axes: g of shape \(7, {n}\), or \(1, {n}",
        }
        for shape, text in texts.items():
            with subtests.test(n=str(n), shape=str(shape)):
                with pytest.raises(ValueError, match=text):
                    field.flow(jnp.ones(shape))
                with pytest.raises(ValueError, match=text):
                    cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, jnp.ones(shape), num_steps=1)
    with pytest.raises(ValueError, match="SphereRotation of type float64 acts on points of the"):
        field.flow(jnp.ones(n, np.float32))
    with pytest.raises(ValueError, match=r"acts on shapes \(2, 4\), got \(3, 4\)"):
        SphereRotation(jnp.ones((2, 4))).flow(jnp.ones((3, 4)))


def test_a_start_that_is_not_of_length_1_is_refused():
    term, y0 = cfjax.LieTerm(sphere), unit(3)
    solve = lambda y0: cfjax.integrate(  # noqa: E731
        term, cfjax.LieEuler(), 0.0, 0.1, y0, num_steps=1
    ).ys[-1]
    for stretch, off in ((1.001, "0.0001"), (1 - 5e-8, "1e-08"), (0.0, "0.1")):
        with pytest.raises(eqx.EquinoxRuntimeError, match=rf"y0 must have length 1, .* {off}\."):
            solve(stretch * y0)
    # Within the root of a unit of rounding the correction, of second order, leads to length 1.
    assert abs(float(jnp.linalg.norm(solve((1 + 5e-9) * y0))) - 1) < 1e-14
    for y in (y0, unit(4)):
        end = jax.jit(lambda y: SphereRotation(y).flow(1.1 * y))(y)
        assert np.all(np.isnan(end))
