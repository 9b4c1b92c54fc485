"""A step that is scalarised in batches only."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from xla import random_programs

import cfjax

X = jnp.asarray([0.3, -0.7, 1.1])
SCALE = jnp.asarray(1.3)


pytestmark = pytest.mark.usefixtures("rewritten_by_default")


def as_it_is(x, scale):
    """A vector, a number, an integer, and a number that does not depend on x.

    It is long: six times four operations on 49 numbers, and a product.
    """
    v = jnp.concatenate([x, x[:1], x * x])
    table = jnp.outer(v, v)
    for k in range(6):
        table = table + scale * jnp.sin(table) / (k + 2)
    x = x + (table @ v)[:3] / 9
    return {"x": x, "all": jnp.sum(x * x), "count": jnp.asarray(3), "fixed": scale**2}


def rewritten(x, scale):
    return random_programs.rewritten(as_it_is)(x, scale)


def size(fun):
    return lambda *args: fun(*args)["all"] * jnp.sum(jnp.cos(fun(*args)["x"])) + fun(*args)["fixed"]


def quick(fun):
    return jax.jit(fun, compiler_options=problems.QUICK)


def check(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        # Some thousand operations of size 10 at most, in another order.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def is_scalarised(fun, *args):
    """Whether the operations are on numbers, or of a batch on a vector for each."""
    lines = jax.jit(fun).lower(*args).as_text().splitlines()
    return not any("stablehlo.sine" in line and "7x7xf64" in line for line in lines)


BATCH = jnp.outer(jnp.linspace(0.2, 1.4, 40), X)
SCALES = jnp.linspace(0.5, 1.5, 40)


def test_alone_it_is_as_it_was():
    check(quick(rewritten)(X, SCALE), as_it_is(X, SCALE))
    check(rewritten(X, SCALE), as_it_is(X, SCALE))
    assert not is_scalarised(rewritten, X, SCALE)
    with cfjax.rewriting(True):
        check(quick(rewritten)(X, SCALE), as_it_is(X, SCALE))
        assert is_scalarised(rewritten, X, SCALE)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("axes", [(0, 0), (0, None), (None, 0)])
def test_a_batch_is_scalarised(axes):
    args = BATCH if axes[0] == 0 else X, SCALES if axes[1] == 0 else SCALE
    batch = jax.vmap(rewritten, axes)
    check(quick(batch)(*args), jax.vmap(as_it_is, axes)(*args))
    assert is_scalarised(batch, *args)
    # Of a batch of batches too.
    twice = jax.vmap(batch, (0, None))
    args = jnp.stack([args[0], 2 * args[0]]), args[1]
    check(quick(twice)(*args), jax.vmap(jax.vmap(as_it_is, axes), (0, None))(*args))
    assert is_scalarised(twice, *args)


def test_a_loop_is_batched_after_it_was_traced():
    def loop(fun):
        return lambda x: jax.lax.fori_loop(0, 5, lambda k, x: fun(x, SCALE)["x"], x)

    check(quick(loop(rewritten))(X), loop(as_it_is)(X))
    assert not is_scalarised(loop(rewritten), X)
    batch = jax.vmap(loop(rewritten))
    check(quick(batch)(BATCH), jax.vmap(loop(as_it_is))(BATCH))
    assert is_scalarised(batch, BATCH)


def test_what_a_batch_does_not_reach_is_in_no_batch():
    axes = {"x": 0, "all": 0, "count": None, "fixed": None}
    found = jax.eval_shape(jax.vmap(rewritten, (0, None), axes), BATCH, SCALE)
    assert jax.tree.map(lambda x: x.shape, found) == {
        "x": (40, 3),
        "all": (40,),
        "count": (),
        "fixed": (),
    }


@pytest.mark.representatives(1)
@pytest.mark.parametrize("argument", [0, 1])
@pytest.mark.parametrize("transform", [jax.jacrev, jax.jacfwd, jax.hessian])
def test_derivatives(transform, argument):
    derivative = lambda f: transform(size(f), argument)  # noqa: E731
    expected = derivative(as_it_is)(X, SCALE)
    check(quick(derivative(rewritten))(X, SCALE), expected)
    batch = lambda f: jax.vmap(derivative(f), (0, None))  # noqa: E731
    check(quick(batch(rewritten))(BATCH, SCALE), batch(as_it_is)(BATCH, SCALE))
    # The derivative of a batch.
    of_batch = lambda f: transform(  # noqa: E731
        lambda *args: jnp.sum(jax.vmap(size(f), (0, None))(*args)), argument
    )
    few = BATCH[:3]
    check(quick(of_batch(rewritten))(few, SCALE), of_batch(as_it_is)(few, SCALE))


def test_derivatives_are_scalarised_if_asked_for():
    gradient = jax.vmap(jax.grad(size(rewritten)), (0, None))
    assert not is_scalarised(gradient, BATCH, SCALE)
    with cfjax.rewriting(True):
        assert is_scalarised(gradient, BATCH, SCALE)
        check(quick(jax.grad(size(rewritten)))(X, SCALE), jax.grad(size(as_it_is))(X, SCALE))


def test_output_within_a_step_is_scalarised_in_batches():
    """Its flows are short, and a loop."""
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(y * jnp.cos(t) / jnp.arange(1.0, 4.0))),
        cfjax.CF54(),
        0.0,
        1.0,
        0.25,
        X,
        saveat=diffrax.SaveAt(dense=True),
    )
    times = jnp.linspace(0.05, 0.95, 20)
    one, batch = jax.make_jaxpr(sol.evaluate)(0.3), jax.make_jaxpr(jax.vmap(sol.evaluate))(times)
    for program, is_batch in ((one, False), (batch, True)):
        assert ("cfjax_operation" in str(program)) == is_batch
        assert ("cfjax_alone" in str(program)) != is_batch
    check(jax.vmap(sol.evaluate)(times), jnp.stack([sol.evaluate(t) for t in times]))


def test_what_is_linear_is_transposed():
    def turn(x, scale):
        table = jnp.outer(jnp.concatenate([x, x, x[:1]]), jnp.arange(1.0, 8.0))
        for k in range(12):
            table = table + table.T * scale / (k + 20)
        return x + table[0, :3]

    (found,) = jax.linear_transpose(lambda x: random_programs.rewritten(turn)(x, SCALE), X)(X[::-1])
    check(found, jax.jacfwd(turn)(X, SCALE).T @ X[::-1])


def test_what_cannot_be_scalarised_is_batched_as_it_is():
    """An update in place where the place is not known."""

    def updated(x, scale):
        y = as_it_is(x, scale)["x"]
        place = jnp.argmax(y)
        return y.at[place].set(jax.lax.dynamic_index_in_dim(y, 2 - place, keepdims=False))

    def both(x, scale):
        return random_programs.rewritten(updated)(x, scale)

    batch = jax.vmap(both, (0, None))
    check(quick(batch)(BATCH, SCALE), jax.vmap(updated, (0, None))(BATCH, SCALE))
    assert not is_scalarised(batch, BATCH, SCALE)


def test_it_keeps_nothing_of_a_trace():
    """The batch comes after the trace has ended, as that of a loop."""
    with jax.checking_leaks():
        looped = lambda x, s: jax.lax.map(lambda k: rewritten(x, s)["x"] * k, SCALES)  # noqa: E731
        jax.jit(jax.vmap(looped, (0, None))).lower(BATCH, SCALE)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF54(), cfjax.RKMK8()])
def test_a_solve_agrees_however_its_steps_are_compiled(solver):
    """With output and error control, alone and in batches."""
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(-y / args + jnp.sin(t)))
    inertia = jnp.asarray([1.0, 2.0, 3.0])

    def solve(y):
        return diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            1.0,
            None,
            y,
            inertia,
            saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 4)),
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
            max_steps=64,
        ).ys

    few = BATCH[:3]
    with cfjax.rewriting(False):
        expected = quick(jax.vmap(solve))(few)
    # Some twenty steps, in each of which a rounding is multiplied by less than 2.
    tight = dict(rtol=0, atol=1e-13)
    for on in (None, True):
        with cfjax.rewriting(on):
            np.testing.assert_allclose(quick(jax.vmap(solve))(few), expected, **tight)
            np.testing.assert_allclose(quick(solve)(few[0]), expected[0], **tight)


def test_the_switch_is_a_bool_or_none(no_shape_hook):
    with pytest.raises(TypeError, match=r"on must be True, False or None, got 'yes'"):
        cfjax.rewriting("yes")  # pyright: ignore[reportArgumentType]
