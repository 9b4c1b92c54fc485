"""SphereRotation: flows and sums, steps against full matrices, length, derivatives, errors."""

from typing import Any

import diffrax
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
# For n = 3 there is a way of its own.
SIZES = [1, 2, 3, 6]


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape))


def unit(*shape, seed=1):
    y = normal(*shape, seed=seed)
    return y / jnp.linalg.norm(y, axis=-1, keepdims=True)


def dense(g, y):
    g, y = (np.asarray(x, float) for x in (g, y))
    return np.outer(g, y) - np.outer(y, g)


flow = jax.jit(lambda field, point: field.flow(point))


@pytest.mark.parametrize(
    ("n", "dtype"), [*((n, np.float64) for n in SIZES), (3, np.float32), (6, np.float32)]
)
def test_flow(n, dtype):
    y = np.asarray(unit(n)).astype(dtype)
    direction = np.asarray(unit(n)).astype(dtype)
    for norm in (0.0, 1e-9, 0.4, np.pi, 30.0):
        g = (norm * direction).astype(dtype)
        got = flow(SphereRotation(g), y)
        assert got.dtype == dtype
        # The start is moved to length 1 by one unit; the angle is rounded, 10 units for the sums.
        atol = 20 * EPS[dtype] * (1 + 2 * norm)
        np.testing.assert_allclose(got, scipy.linalg.expm(dense(g, y)) @ y, rtol=0, atol=atol)
        np.testing.assert_allclose(
            SphereRotation(g).tangent(jnp.asarray(y)), dense(g, y) @ y, rtol=0, atol=atol
        )


@pytest.mark.representatives(2)
@pytest.mark.parametrize("n", SIZES)
def test_a_sum_of_fields_frozen_at_different_points(n):
    """Each has the point where it is frozen, and the sum is their exact skew sum."""

    @jax.jit
    def along(gs, y, weights):
        entered: list[Any] = []
        points, start = [], y
        for g in gs:
            field, here = SphereRotation(g).to_chart(y if not entered else start, entered)
            points.append(field.from_chart(here))
            start = here if not entered else start
            entered.append(field)
            # On to where the next is frozen.
            start = field.flow(start)
        total = cfjax.combine(weights, entered)
        return points, total.from_chart(total.flow(start)), total.from_chart(start)

    gs, y = normal(3, n), unit(n)
    for weights in ([0.7, -0.4, 1.3], [0.0, 0.0, 0.0], [20.0, 0.0, -20.0]):
        points, end, start = along(gs, y, weights)
        matrix = sum(w * dense(g, p) for w, g, p in zip(weights, gs, points, strict=True))
        # A dozen units of rounding, and that of the angle.
        atol = 20 * EPS[np.float64] * (1 + np.linalg.norm(matrix))
        np.testing.assert_allclose(end, scipy.linalg.expm(matrix) @ start, rtol=0, atol=atol)
    assert n == 1 or np.abs(points[1] - points[0]).max() > 0.01


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


METHODS: dict[str, Any] = {
    "CF4": cfjax.CF4(),
    "CG3": cfjax.CG3(),
    "RKMK4": cfjax.RKMK4(),
    "Bosh3": cfjax.RKMK(diffrax.Bosh3.tableau),
    "Williamson3": cfjax.Williamson3(),
    # Its stages are a loop.
    "YRK135": cfjax.YRK135(),
}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("n", [2, 6])
def test_a_step_is_the_step_with_full_matrices(n, name):
    y0 = unit(n)
    step = lambda field: jax.jit(  # noqa: E731
        lambda y: problems.first_step(METHODS[name], cfjax.LieTerm(field), 0.2, 0.5, y, None)[0]
    )
    found, expected = (step(field)(y0) for field in (sphere, full))
    # Both round each of up to six flows by some units; the weights of YRK135 reach 36.
    atol = 2e-12 if name == "YRK135" else 2e-14
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
    assert np.abs(found - y0).max() > 0.05


def of_shape(field, shape):
    for _ in shape[1:]:
        field = jax.vmap(field, in_axes=(None, 0, None))
    return cfjax.LieTerm(field)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("shape", [(3,), (2, 4, 3)])
def test_in_space_it_is_the_rotation(shape, name):
    """The cross product with y x g, so the solves agree: alone and for many."""
    found, expected = (
        cfjax.integrate(
            of_shape(field, shape), METHODS[name], 0.0, 1.0, unit(*shape), num_steps=10
        ).ys
        for field in (sphere, rotation)
    )
    # The same field, whose coordinates are rounded in another order: a unit in each of ten steps.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(3,), (4, 3)])
def test_in_space_it_is_the_rotation_within_steps(shape):
    @eqx.filter_jit
    def solve(field):
        saveat = diffrax.SaveAt(ts=jnp.array([0.13, 0.7, 1.0]))
        term, y0 = of_shape(field, shape), unit(*shape)
        return diffrax.diffeqsolve(term, cfjax.CF4(), 0, 1, 0.1, y0, saveat=saveat).ys

    np.testing.assert_allclose(solve(sphere), solve(rotation), rtol=0, atol=2e-14)


@pytest.mark.parametrize(
    ("n", "num_steps"),
    [(3, 100_000), (5, 10_000), pytest.param(5, 100_000, marks=pytest.mark.slow)],
)
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


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [3, 6])
def test_cayley_is_that_of_one_column(n):
    # Many columns are one field here.
    g = lambda t, y: g_of(t, y[:, 0])[:, None]  # noqa: E731
    column = lambda t, y, args: LowRankSkew(jax.vmap(g, (None, 0))(t, y))  # noqa: E731

    def end(field, y0):
        term = of_shape(field, y0.shape)
        return cfjax.integrate(term, cfjax.CayleyRK4(), 0.0, 0.5, y0, num_steps=3).ys[-1]

    y0 = unit(2, n)
    solve = cfjax.integrate(
        cfjax.LieTerm(column), cfjax.CayleyRK4(), 0.0, 0.5, y0[..., None], num_steps=3
    )
    expected = solve.ys[-1, ..., 0]
    # The same operations.
    np.testing.assert_allclose(end(sphere, y0), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(end(sphere, y0[0]), expected[0], rtol=0, atol=1e-14)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("shape", [(3,), (6,), (2, 3, 3), (2, 3, 6)])
def test_a_field_keeps_its_promises(shape):
    cfjax.check_field([SphereRotation(normal(*shape, seed=k)) for k in (5, 6)], unit(*shape))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [3, 6])
def test_leading_axes(n):
    """Each moves as it does alone; an axis of 1 is broadcast."""
    g, y = normal(3, 1, n), unit(3, 2, n)
    found = flow(SphereRotation(g), y)
    for i in range(3):
        for j in range(2):
            alone = flow(SphereRotation(g[i, 0]), y[i, j])
            np.testing.assert_allclose(found[i, j], alone, rtol=0, atol=1e-15)
    solve = lambda y0: cfjax.integrate(  # noqa: E731
        of_shape(sphere, y0.shape), cfjax.RKMK4(), 0.0, 0.5, y0, num_steps=3
    ).ys[-1]
    # Some roundings in each of three steps.
    np.testing.assert_allclose(solve(y[:, 0])[1], solve(y[1, 0]), rtol=0, atol=1e-14)


# Derivatives


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", SIZES)
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
        )

    at_zero, first, second, gradient, reverse = derivatives(u, w)
    tangent = np.eye(n) - np.outer(y, y)
    # Sums of n products of numbers of about 1.
    check = lambda found, expected: np.testing.assert_allclose(  # noqa: E731
        found, expected, rtol=0, atol=1e-14
    )
    check(at_zero, y)
    check(first, tangent @ u)
    check(second, -y * (u @ tangent @ w))
    check(gradient, tangent @ w)
    check(reverse, -(w @ y) * (tangent @ u))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [3, 6])
def test_gradients_of_a_solve(n):
    """Along the sphere and in a parameter, against differences."""
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


@pytest.mark.parametrize("shape", [(), (0,), (2, 0)])
def test_wrong_shape(shape, no_shape_hook):
    with pytest.raises(ValueError, match=r"g must have shape \(n,\) or \(\*batch, n\) .* got \("):
        SphereRotation(jnp.ones(shape))


@pytest.mark.parametrize("dtype", [np.int32, np.float16, np.complex128])
def test_wrong_dtype(dtype, no_shape_hook):
    with pytest.raises(TypeError, match="g must be float32 or float64, got"):
        SphereRotation(jnp.ones(3, dtype))


@pytest.mark.parametrize("n", [3, 4])
def test_wrong_point(n, no_shape_hook):
    field = SphereRotation(jnp.ones(n))
    texts = {
        (5,): rf"g of shape \({n},\) acts on shapes \({n},\), got \(5,\)",
        (7, n): rf"give the coordinates leading axes: g of shape \(7, {n}\), or \(1, {n}",
    }
    for shape, text in texts.items():
        with pytest.raises(ValueError, match=text):
            field.flow(jnp.ones(shape))
        with pytest.raises(ValueError, match=text):
            term = cfjax.LieTerm(lambda t, y, args: field)
            cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, jnp.ones(shape), num_steps=1)
    with pytest.raises(ValueError, match="SphereRotation of type float64 acts on points of the"):
        field.flow(jnp.ones(n, np.float32))
    with pytest.raises(ValueError, match=r"acts on shapes \(2, 4\), got \(3, 4\)"):
        SphereRotation(jnp.ones((2, 4))).flow(jnp.ones((3, 4)))


def test_outside_of_a_step_it_has_no_bracket():
    with pytest.raises(TypeError, match="SphereRotation has none"):
        cfjax.bracket(SphereRotation(normal(5)), SphereRotation(normal(5)))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [3, 4])
def test_a_start_that_is_not_of_length_1_is_refused(n):
    term = cfjax.LieTerm(sphere)
    solve = lambda y0: cfjax.integrate(  # noqa: E731
        term, cfjax.LieEuler(), 0.0, 0.1, y0, num_steps=1
    ).ys[-1]
    y0 = unit(n)
    for stretch, off in ((1.001, "0.0001"), (1 - 5e-8, "1e-08"), (0.0, "0.1")):
        with pytest.raises(eqx.EquinoxRuntimeError, match=rf"y0 must have length 1, .* {off}\."):
            solve(stretch * y0)
    # Within the root of a unit of rounding the correction, of second order, leads to length 1.
    assert abs(float(jnp.linalg.norm(solve((1 + 5e-9) * y0))) - 1) < 1e-14
    assert np.all(np.isnan(SphereRotation(y0).flow(1.1 * y0)))
