"""SphereRotation: flows, steps against full matrices, length, derivatives, errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from matrices import rkmk3_step

import cfjax
from cfjax import SphereRotation

EPS = 2.0**-52


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).standard_normal(shape))


def unit(*shape, seed=1):
    y = normal(*shape, seed=seed)
    return y / jnp.linalg.norm(y, axis=-1, keepdims=True)


def dense(g, y):
    g, y = (np.asarray(x, float) for x in (g, y))
    return np.outer(g, y) - np.outer(y, g)


# What test_contract.py has not: few dimensions, in three of which there is a way of its own.


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [3, 1, 2])
def test_flow_in_few_dimensions(n):
    directions, ys = unit(2, 1, n), unit(2, 2, n)
    flow = jax.jit(lambda g, y: SphereRotation(g).flow(y))
    for norm in (0.0, 1e-9, 0.4, np.pi, 30.0):
        flows = flow(norm * directions, ys)
        for i, j in np.ndindex(2, 2):
            want = scipy.linalg.expm(dense(norm * directions[i, 0], ys[i, j])) @ ys[i, j]
            # The start is moved to length 1 by one unit; the angle is rounded, 10 units for the
            # sums.
            np.testing.assert_allclose(flows[i, j], want, rtol=0, atol=20 * EPS * (1 + 2 * norm))
    # Far from the sphere.
    assert np.all(np.isnan(flow(directions, 1.1 * ys)))


# Whole steps

A = np.asarray(normal(6, 6))


def g_of(xp, t, y):
    """Depends on time and state, and is not tangent."""
    n = len(y)
    return xp.cos(t) * (A[:n, :n] @ y) + A[0, :n] * (1 + t)


def sphere(t, y, args):
    return SphereRotation(g_of(jnp, t, y))


def test_a_step_is_the_step_with_full_matrices():
    """In space, where it is that of rotations, for two points; and in a span of vectors."""
    starts = {"space": unit(2, 3), "span": unit(6)}
    u = normal(6, seed=2)

    def field(t, y, args):
        return {"space": jax.vmap(sphere, (None, 0, None))(t, y["space"], args),
                "span": sphere(t, y["span"], args)}  # fmt: skip

    @jax.jit
    def moved(y):
        step = problems.first_step(cfjax.RKMK3(), cfjax.LieTerm(field), 0.2, 0.5, y, None)
        y = y["span"]
        frozen = SphereRotation(u)
        return step[0], frozen.to_chart(y, ())[0].tangent(y), frozen.flow(1.1 * y)

    found, in_chart, far = moved(starts)
    ends = zip([*starts["space"], starts["span"]], [*found["space"], found["span"]], strict=True)
    for y, end in ends:
        want = rkmk3_step(lambda t, y: dense(g_of(np, t, y), y), 0.2, 0.3, np.asarray(y))
        # Both round each of three flows by some units.
        np.testing.assert_allclose(end, want, rtol=0, atol=2e-14)
        assert np.abs(want - y).max() > 0.05
    y = np.asarray(starts["span"])
    np.testing.assert_allclose(in_chart, u - y * (y @ u), rtol=0, atol=1e-14)
    assert np.all(np.isnan(far))


@pytest.mark.representatives(1)
@pytest.mark.parametrize(("n", "num_steps"), [(5, 10_000), (3, 100_000)])
def test_length_is_kept_over_many_steps(n, num_steps):
    d = jnp.arange(1.0, n + 1)
    turn = normal(n, n, seed=2)
    field = lambda t, y, args: SphereRotation(jnp.cos(t) * d * y + turn @ y)  # noqa: E731
    ys = cfjax.integrate(
        cfjax.LieTerm(field),
        cfjax.CF2(),
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


def test_coordinates_of_cayley():
    """Where each of two points lands, and the rate with which the end has a velocity."""
    g, f, y = np.asarray(normal(2, 6)), np.asarray(normal(2, 6, seed=3)), np.asarray(unit(2, 6))

    @jax.jit
    def found(g, f, y):
        coordinates = SphereRotation(g).cayley(y)
        assert coordinates.has_rate() is None
        increment, is_there = coordinates.landing(y)
        rate = coordinates.rate(SphereRotation(f).cayley(y + increment), y)
        return increment, rate.tangent(y), is_there

    *ends, are_there = found(g, f, y)
    assert are_there
    for g_of_one, f_of_one, start, increment, rate in zip(g, f, y, *ends, strict=True):
        a, change = dense(g_of_one, start) / 2, dense(rate, start) / 2
        want = np.linalg.solve(np.eye(6) - a, 2 * a @ start)
        # Some units for numbers of size 1.
        np.testing.assert_allclose(increment, want, rtol=0, atol=4e-15)
        moves = np.linalg.solve(np.eye(6) - a, change @ (want + 2 * start))
        velocity = dense(f_of_one, start + want) @ (start + want)
        np.testing.assert_allclose(moves, velocity, rtol=0, atol=4e-14)


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
