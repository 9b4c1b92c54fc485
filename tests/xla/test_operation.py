"""A program as one operation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

from cfjax._xla import operation as module
from cfjax._xla.operation import operation
from cfjax._xla.pack import pack, unpack

X = jnp.asarray([0.3, -0.7, 1.1])
SCALE = jnp.asarray(1.3)


def turn(x, scale, count):
    """Several numbers, one whole array, one that does not depend on x, and an integer."""
    a, b, c = unpack(x)
    for k in range(count):
        a, b, c = a + scale * b * c / (k + 2), jnp.sin(b) + a * a / 9, c * (1 - scale / (k + 5))
    return [pack([a, b, c]), b * x, scale * scale, jnp.asarray(count)]


def plain(x, scale):
    return turn(x, scale, 6)


def whole(x, scale):
    return operation(lambda x, scale: turn(x, scale, 6), x, scale)


def size(fun):
    return lambda x, scale: jnp.sum(jnp.cos(fun(x, scale)[0] * fun(x, scale)[1]))


@pytest.fixture(params=["one function", "several"], autouse=True)
def lengths(request, monkeypatch):
    """Compiled as they are, and in pieces."""
    if request.param == "several":
        monkeypatch.setattr(module, "_PIECE", 12)
        monkeypatch.setattr(module, "WHOLE", (0, 0, 0))
        monkeypatch.setattr(module, "_GROUP", 30)


def quick(fun):
    return jax.jit(fun, compiler_options=problems.QUICK)


def check(found, expected):
    # Some hundred operations of size 10 at most, in another order.
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert jnp.result_type(a) == jnp.result_type(b)
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_values():
    check(quick(whole)(X, SCALE), plain(X, SCALE))
    check(whole(X, SCALE), plain(X, SCALE))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("axes", [(0, None), (None, 0), (0, 0)])
@pytest.mark.parametrize("count", [2, 40])
def test_batches(axes, count):
    """Of few, and of more than are computed one by one."""
    along = jnp.linspace(0.2, 1.4, count)
    x = jnp.outer(along, X) if axes[0] == 0 else X
    scale = along * SCALE if axes[1] == 0 else SCALE
    for transform in (lambda f: f, lambda f: jax.grad(size(f), (0, 1))):
        found = quick(jax.vmap(transform(whole), axes))(x, scale)
        check(found, jax.vmap(transform(plain), axes)(x, scale))


MODES = jax.jacfwd, jax.jacrev


@pytest.mark.representatives(1)
@pytest.mark.parametrize("outer", MODES)
@pytest.mark.parametrize("inner", MODES)
@pytest.mark.parametrize("argument", [0, 1])
def test_derivatives(inner, outer, argument):
    first = lambda f: inner(size(f), argument)  # noqa: E731
    check(quick(first(whole))(X, SCALE), first(plain)(X, SCALE))
    second = lambda f: outer(first(f), argument)  # noqa: E731
    check(quick(second(whole))(X, SCALE), second(plain)(X, SCALE))


@pytest.mark.slow
def test_third_derivatives():
    third = lambda f: jax.jacfwd(jax.jacrev(jax.grad(size(f))))  # noqa: E731
    check(quick(third(whole))(X, SCALE), third(plain)(X, SCALE))


@pytest.mark.representatives(1)
def test_long_derivatives_in_batches_are_cut():
    xs, gradient = jnp.outer(jnp.linspace(0.1, 1, 40), X), jax.grad(size(whole))
    batch = jax.vmap(gradient, (0, None))
    check(quick(batch)(xs, SCALE), jax.vmap(jax.grad(size(plain)), (0, None))(xs, SCALE))
    # What is shared by two pieces of a batch goes through a call.
    texts = [jax.jit(fun).lower(x, SCALE).as_text() for fun, x in ((gradient, X), (batch, xs))]
    is_cut = module.WHOLE[1] == 0
    assert ["inlineable" in text for text in texts] == [is_cut, is_cut]


@pytest.mark.slow
def test_directions_that_are_many():
    """More than are computed one by one."""
    directions = jnp.asarray(np.random.default_rng(1).normal(size=(20, 3)))

    def along(fun):
        def product(v):
            return jax.jvp(jax.grad(size(fun)), (X, SCALE), (v, 0.0 * SCALE))[1]

        return jax.vmap(product)(directions)

    check(quick(lambda: along(whole))(), along(plain))


def test_constants_that_agree_in_nine_digits_stay_apart():
    def fun(x):
        a = unpack(x)[0]
        return a * (1 / 3 + 1e-10) - a * (1 / 3)

    found = quick(lambda x: operation(fun, x))(X)
    # The rounding of two numbers of size 0.1.
    np.testing.assert_allclose(found, 1e-10 * X[0], rtol=0, atol=1e-16)


def test_closing_over_traced_values():
    fun = lambda scale: operation(lambda x: turn(x, scale, 6), X)[0]  # noqa: E731
    check(quick(jax.jacrev(fun))(SCALE), jax.jacfwd(lambda scale: plain(X, scale)[0])(SCALE))


def test_reverse_mode_keeps_the_operands_alone():
    _, back = jax.vjp(lambda x: whole(x, SCALE)[0], X)
    assert sum(x.size for x in jax.tree.leaves(back)) <= X.size + 1


def test_what_a_batch_does_not_reach_is_in_no_batch():
    program = jax.make_jaxpr(jax.vmap(whole, (0, None), [0, 0, None, None]))(jnp.outer(X, X), SCALE)
    avals: list[Any] = [v.aval for v in program.jaxpr.outvars]
    assert [aval.shape for aval in avals] == [(3, 3), (3, 3), (), ()]


def test_directions_that_are_zero_are_not_computed():
    """The number that does not depend on x has no derivative in x."""
    program = jax.make_jaxpr(lambda v: jax.jvp(lambda x: whole(x, SCALE)[2], (X,), (v,))[1])(X)
    (zero,) = program.jaxpr.outvars
    assert not any(zero in eqn.outvars for eqn in program.eqns if "cfjax" in eqn.primitive.name)


@pytest.mark.representatives(1)
def test_branches_and_loops_inside():
    def fun(x):
        y = jax.lax.fori_loop(0, 3, lambda k, y: y * x + k, x)
        return [jnp.where(y[0] > 0, y, x), jax.lax.cond(y[1] > 0, jnp.sin, jnp.cos, y)]

    both = lambda f: lambda x: jnp.sum(f(x)[0] * f(x)[1])  # noqa: E731
    found = quick(jax.hessian(both(lambda x: operation(fun, x))))(X)
    check(found, jax.hessian(both(fun))(X))
