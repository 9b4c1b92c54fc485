"""Fields that depend on the state are refused by a method that takes fields of time only."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import cfjax

START = np.array([0.6, 0.0, 0.8])

DEPENDING = {
    "coordinates": lambda t, y, _: cfjax.Rotation(y),
    "a comparison": lambda t, y, _: cfjax.Rotation(jnp.where(y > 0, t, -t)),
    "no derivative": lambda t, y, _: cfjax.Rotation(lax.stop_gradient(y)),
    "an index": lambda t, y, _: cfjax.Rotation(jnp.arange(9.0).reshape(3, 3)[jnp.argmax(y)]),
    "a branch": lambda t, y, _: cfjax.Rotation(
        lax.cond(y[0] > 0, lambda: jnp.ones(3), lambda: jnp.zeros(3))
    ),
    "a loop": lambda t, y, _: cfjax.Rotation(
        lax.fori_loop(0, 3, lambda k, w: jnp.roll(w, 1) + w[0] * y[0], jnp.ones(3))
    ),
    "a while loop": lambda t, y, _: cfjax.Rotation(
        lax.while_loop(lambda w: w[0] < y[0], lambda w: w + 1, jnp.ones(3))
    ),
    "where it is frozen": lambda t, y, _: cfjax.SphereRotation(jnp.ones(3) * t),
}


def solve(field, solver, y0=START):
    return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=2).ys[-1]


def test_a_field_that_depends_on_the_state_is_refused(subtests):
    message = r"t but not on y.*depends on the state.*cfjax.CF4\(\)"
    for name, field in DEPENDING.items():
        with subtests.test(field=name), pytest.raises(TypeError, match=message):
            solve(field, cfjax.Magnus6())
    with subtests.test(field="a frame in its own span"):
        y0 = np.linalg.qr(np.arange(8.0).reshape(4, 2) ** 2 + np.eye(4)[:, :2])[0]
        columns = jnp.sin(jnp.arange(8.0)).reshape(4, 2)
        with pytest.raises(TypeError, match="LowRankSkew, depends on the state"):
            solve(lambda t, y, _: cfjax.LowRankSkew(t * columns), cfjax.Magnus4(), y0)
    with subtests.test(field="an ordinary term"):
        term = diffrax.ODETerm(lambda t, y, _: t * y)
        with pytest.raises(TypeError, match="Magnus2 takes fields that depend on t but not on y"):
            cfjax.integrate(term, cfjax.Magnus2(), 0.0, 1.0, START, num_steps=2)
    with subtests.test(field="a part of the state"):
        term = cfjax.LieTerm(lambda t, y, _: {"R": cfjax.Rotation(jnp.ones(3)), "m": y["m"]})
        y0 = {"R": jnp.eye(3), "m": jnp.ones(3)}
        message = r"Magnus8.*y\['m'\].*a translation.*LeftMatrix\(A\(t\)\)"
        with pytest.raises(TypeError, match=message):
            diffrax.diffeqsolve(term, cfjax.Magnus8(), 0.0, 1.0, 0.1, y0)


def test_dependence_is_seen_within_other_solvers_and_transformations():
    def end(y0):
        return solve(DEPENDING["coordinates"], cfjax.Richardson(cfjax.Magnus2()), y0).sum()

    with pytest.raises(TypeError, match="depends on the state"):
        jax.jit(jax.vmap(jax.grad(end)))(jnp.ones((2, 3)))


def on_host(*operands, **options):
    """A generator that jax does not see through."""
    shape = jax.ShapeDtypeStruct((2, 2), np.float64)
    generator = np.array([[0.0, 1.0], [-1.0, 0.0]])
    return jax.pure_callback(lambda t, *_: t * generator, shape, *operands, **options)


def solve_on_host(field):
    return solve(field, cfjax.Magnus4(), jnp.asarray([1.0, 0.0]))


def test_a_function_of_the_host_may_take_the_time():
    y1 = solve_on_host(lambda t, y, args: cfjax.LeftMatrix(on_host(t)))
    # An angle of 1/2, to rounding: the generators at all times commute.
    np.testing.assert_allclose(y1, [np.cos(0.5), -np.sin(0.5)], rtol=0, atol=1e-15)


def test_a_function_of_the_host_may_not_take_the_state():
    message = r"^The field gives y to a function of the host \(jax\.pure_callback without"
    for options, text in (
        ({}, message),
        ({"vmap_method": "sequential"}, "LeftMatrix, depends on the state"),
    ):
        with pytest.raises(TypeError, match=text):
            solve_on_host(lambda t, y, args: cfjax.LeftMatrix(on_host(t, y, **options)))  # noqa: B023


def test_a_mistake_in_the_field_has_its_own_message():
    def field(t, y, args):
        raise NotImplementedError("the field's own")

    with pytest.raises(NotImplementedError, match="the field's own"):
        solve_on_host(field)


def test_shape_and_dtype_of_the_state_are_no_dependence():
    def field(t, y, args):
        w = jnp.zeros_like(y[0]) + jnp.full(y.shape[1:], args, y.dtype)
        return cfjax.Rotation(w + jnp.arange(w.size, dtype=y.dtype) * t.astype(y.dtype))

    def end(args):
        term, y0 = cfjax.LieTerm(field), jnp.eye(3)
        return cfjax.integrate(term, cfjax.Magnus2(), 0.0, 2.0, y0, args, num_steps=6).ys[-1, 0, 0]

    batch = jax.vmap(jax.value_and_grad(end))
    assert [x.shape for x in jax.eval_shape(batch, jnp.array([0.3, 0.4]))] == [(2,), (2,)]
