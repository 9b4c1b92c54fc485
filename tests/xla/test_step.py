"""A step as one operation that holds its program as it was traced."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from xla import random_programs

import cfjax

pytestmark = pytest.mark.usefixtures("rewritten_by_default")

X = jnp.asarray([0.3, -0.7, 1.1])
SCALE = jnp.asarray(1.3)


def as_it_is(x, scale):
    """A vector, one that depends on the parameter alone, a number and an integer."""
    for k in range(3):
        cross = jnp.cross(x, jnp.sin(x * scale) / (k + 2))
        x = x + cross * (1 - scale / (k + 5)) + jnp.roll(x, 1) * x[0] / 9
    return {"x": x, "fixed": scale * jnp.arange(3.0), "all": x @ x, "count": jnp.asarray(3)}


def rewritten(x, scale):
    return random_programs.rewritten(as_it_is)(x, scale)


def size(fun):
    def total(x, scale):
        out = fun(x, scale)
        return jnp.sum(jnp.cos(out["x"] * out["fixed"])) * out["all"]

    return total


@pytest.fixture(params=["flat", "as traced"], autouse=True)
def lengths(request, monkeypatch):
    """Compiled on single numbers, and as too long for that."""
    # Forgets the programs of the other way, of the same functions.
    jax.clear_caches()
    if request.param == "as traced":
        for name, limit in (
            ("OF_FEW", (0, 0)),
            ("OF_MANY", (0, 0)),
            ("FLAT_MANY", 0),
        ):
            monkeypatch.setattr(random_programs.lowering, name, limit)
    return request.param


def quick(fun):
    return jax.jit(fun, compiler_options=problems.QUICK)


def check(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        # Some hundred operations of size 10 at most, in another order.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_values(lengths):
    check(quick(rewritten)(X, SCALE), as_it_is(X, SCALE))
    check(rewritten(X, SCALE), as_it_is(X, SCALE))
    lines = jax.jit(rewritten).lower(X, SCALE).as_text().splitlines()
    assert any("sine" in line for line in lines)
    on_vectors = any("sine" in line and "3xf64" in line for line in lines)
    assert on_vectors == (lengths == "as traced")


def test_it_is_traced_once():
    """Whatever becomes of it."""
    calls = []

    def counted(x, scale):
        calls.append(x)
        return as_it_is(x, scale)

    fun = size(random_programs.rewritten(counted))
    jax.jit(jax.vmap(jax.value_and_grad(fun), (0, None))).lower(jnp.outer(X, X), SCALE)
    assert len(calls) == 1


ALONG = {few: jnp.linspace(0.2, 1.4, few) for few in (0, 2, 40)}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("axes", [(0, None), (None, 0), (0, 0)])
@pytest.mark.parametrize("count", ALONG)
def test_batches(axes, count):
    """Batches of none, of few, as directions are, and of many."""
    along = ALONG[count]
    x = jnp.outer(along, X) if axes[0] == 0 else X
    scale = along * SCALE if axes[1] == 0 else SCALE
    for transform in (lambda f: f, lambda f: jax.grad(size(f), (0, 1))):
        found = quick(jax.vmap(transform(rewritten), axes))(x, scale)
        check(found, jax.vmap(transform(as_it_is), axes)(x, scale))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("axes", [((0, None), (None, 0)), ((1, 0), (0, None)), ((0, 0), (1, 1))])
def test_batches_of_batches(axes):
    inner, outer = axes
    x, scale = X, SCALE
    for length, ax in ((5, inner), (4, outer)):
        grown = [x, scale]
        for k, axis in enumerate(ax):
            if axis is not None:
                grown[k] = jnp.stack([grown[k] * (1 + j / 9) for j in range(length)], axis)
        x, scale = grown
    both = lambda f: jax.vmap(jax.vmap(f, inner), outer)  # noqa: E731
    check(quick(both(rewritten))(x, scale), both(as_it_is)(x, scale))
    assert both(rewritten)(x, scale)["all"].shape == (4, 5)
    gradient = lambda f: both(jax.grad(size(f), (0, 1)))  # noqa: E731
    check(quick(gradient(rewritten))(x, scale), gradient(as_it_is)(x, scale))
    of_both = lambda f: jax.grad(lambda *a: jnp.sum(both(size(f))(*a)), (0, 1))  # noqa: E731
    check(quick(of_both(rewritten))(x, scale), of_both(as_it_is)(x, scale))
    jacobian = lambda f: both(jax.jacfwd(size(f), (0, 1)))  # noqa: E731
    check(quick(jacobian(rewritten))(x, scale), jacobian(as_it_is)(x, scale))


def test_directions_in_a_batch():
    """Inside of it and around it."""
    xs = jnp.outer(ALONG[40], X)
    for around in (
        lambda f: jax.vmap(jax.jacfwd(size(f), 0), (0, None)),
        lambda f: jax.jacfwd(jax.vmap(size(f), (0, None)), 1),
        lambda f: jax.jacrev(lambda x, s: jax.vmap(f, (0, None))(x, s)["x"][:2], 1),
    ):
        check(quick(around(rewritten))(xs, SCALE), around(as_it_is)(xs, SCALE))


MODES = jax.jacfwd, jax.jacrev


@pytest.mark.representatives(1)
@pytest.mark.parametrize("outer", MODES)
@pytest.mark.parametrize("inner", MODES)
@pytest.mark.parametrize("argument", [0, 1])
def test_derivatives(inner, outer, argument):
    first = lambda f: inner(size(f), argument)  # noqa: E731
    check(quick(first(rewritten))(X, SCALE), first(as_it_is)(X, SCALE))
    second = lambda f: outer(first(f), argument)  # noqa: E731
    check(quick(second(rewritten))(X, SCALE), second(as_it_is)(X, SCALE))


@pytest.mark.slow
def test_third_derivatives():
    third = lambda f: jax.jacfwd(jax.jacrev(jax.grad(size(f))))  # noqa: E731
    check(quick(third(rewritten))(X, SCALE), third(as_it_is)(X, SCALE))


def test_derivatives_in_loops():
    def looped(fun):
        def total(x, scale):
            def turn(x, k):
                return fun(x, scale * k)["x"] / 2, None

            return jnp.sum(jax.lax.scan(turn, x, jnp.linspace(0.1, 1, 5))[0] ** 2)

        return jax.value_and_grad(total, (0, 1))

    check(quick(looped(rewritten))(X, SCALE), looped(as_it_is)(X, SCALE))
    xs = jnp.outer(ALONG[40], X)
    batch = lambda f: jax.vmap(looped(f), (0, None))  # noqa: E731
    check(quick(batch(rewritten))(xs, SCALE), batch(as_it_is)(xs, SCALE))


def linear(x, scale):
    for k in range(6):
        x = x * scale + jnp.cross(x, jnp.sin(scale * jnp.arange(3.0) + k))
    return x


def test_what_is_linear_is_transposed():
    fun = lambda x: random_programs.rewritten(linear)(x, SCALE)  # noqa: E731
    (found,) = jax.linear_transpose(fun, X)(X[::-1])
    check(found, jax.jacfwd(linear)(X, SCALE).T @ X[::-1])
    batch = jax.vmap(fun)
    xs = jnp.outer(ALONG[40], X)
    (found,) = jax.linear_transpose(batch, xs)(xs[:, ::-1])
    check(found, xs[:, ::-1] @ jax.jacfwd(linear)(X, SCALE))


def test_a_derivative_in_two_operands_is_transposed_in_one():
    """The other direction is known, and adds what the transpose leaves out."""

    def along(fun, direction):
        return jax.jvp(lambda x, s: fun(x, s)["x"], (X, SCALE), (X, direction))[1]

    (found,) = jax.linear_transpose(lambda s: along(rewritten, s), SCALE)(X[::-1])
    check(found, jax.jacfwd(lambda s: as_it_is(X, s)["x"])(SCALE) @ X[::-1])


def test_constants_that_agree_in_nine_digits_stay_apart():
    fun = lambda x, p: x * (1 / 3 + 1e-10) - x * (1 / 3)  # noqa: E731
    found = quick(random_programs.rewritten(fun))(X, 0.0)
    # The rounding of two numbers of size 0.4.
    np.testing.assert_allclose(found, 1e-10 * X, rtol=0, atol=1e-16)


def test_reverse_mode_keeps_the_operands_alone():
    _, back = jax.vjp(lambda x: rewritten(x, SCALE)["x"], X)
    # And 1 / 3 for each k as constants of the program.
    assert sum(x.size for x in jax.tree.leaves(back)) <= X.size + 3


def test_what_a_batch_does_not_reach_is_in_no_batch():
    axes = {"x": 0, "fixed": None, "all": 0, "count": None}
    batch = jax.vmap(rewritten, (0, None), axes)
    found = jax.eval_shape(batch, jnp.outer(ALONG[40], X), SCALE)
    assert [x.shape for x in jax.tree.leaves(found)] == [(40,), (), (3,), (40, 3)]
    expected = jax.vmap(as_it_is, (0, None), axes)(jnp.outer(ALONG[40], X), SCALE)
    check(quick(batch)(jnp.outer(ALONG[40], X), SCALE), expected)


def test_directions_that_are_zero_are_not_computed():
    """What does not depend on x has no derivative in x."""
    fun = lambda x: rewritten(x, SCALE)["fixed"]  # noqa: E731
    program = jax.make_jaxpr(lambda v: jax.jvp(fun, (X,), (v,))[1])(X)
    (zero,) = program.jaxpr.outvars
    assert not any(zero in eqn.outvars for eqn in program.eqns if "cfjax" in eqn.primitive.name)


@jax.custom_jvp
def absolute(x):
    return jnp.abs(x)


@absolute.defjvp
def _(primals, tangents):
    # Not what JAX would make of it, so that it shows.
    return absolute(*primals), 7 * tangents[0]


def test_a_derivative_of_its_own():
    fun = lambda x: jnp.sum(random_programs.rewritten(lambda y, p: absolute(y) * y[::-1])(x, 0.0))  # noqa: E731
    plain = lambda x: jnp.sum(absolute(x) * x[::-1])  # noqa: E731
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        check(quick(derivative(fun))(X), derivative(plain)(X))
    check(quick(fun)(X), plain(X))


def names(fun, *args):
    return str(jax.make_jaxpr(fun)(*args))


def test_what_has_only_a_reverse_mode_or_effects_is_no_operation(capsys):
    @jax.custom_vjp
    def cut(x):
        return x * x

    cut.defvjp(lambda x: (x * x, x), lambda x, ct: (3 * ct * x,))
    fun = lambda x: random_programs.rewritten(lambda y, p: cut(y))(x, 0.0)  # noqa: E731
    assert "cfjax_step" not in names(fun, X)
    check(jax.grad(lambda x: jnp.sum(fun(x)))(X), 3 * X)

    def said(y, p):
        jax.debug.print("here")
        return y * y

    fun = lambda x: random_programs.rewritten(said)(x, 0.0)  # noqa: E731
    assert "cfjax_step" not in names(fun, X)
    jax.jit(fun)(X)
    jax.effects_barrier()
    assert capsys.readouterr().out.count("here") == 1


def test_a_program_can_be_exported():
    made = jax.export.export(jax.jit(jax.grad(size(rewritten))))(X, SCALE)
    check(made.call(X, SCALE), jax.grad(size(as_it_is))(X, SCALE))


def test_it_keeps_nothing_of_a_trace():
    with jax.checking_leaks():
        looped = lambda x, s: jax.lax.map(lambda k: rewritten(x, s)["x"] * k, ALONG[2])  # noqa: E731
        jax.jit(jax.vmap(looped, (0, None))).lower(jnp.outer(ALONG[2], X), SCALE)


def test_rewriting_is_read_where_it_is_traced():
    with cfjax.rewriting(False):
        assert "cfjax_step" not in names(rewritten, X, SCALE)
    assert "cfjax_step" in names(rewritten, X, SCALE)
