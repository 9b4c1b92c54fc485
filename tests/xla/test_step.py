"""A step as one operation that holds its program as it was traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from xla import random_programs
from xla.interpreter import run

pytestmark = pytest.mark.usefixtures("rewritten")

X = jnp.asarray([0.3, -0.7, 1.1])
SCALE = jnp.asarray(1.3)
XS = jnp.outer(jnp.linspace(0.2, 1.4, 40), X)


def as_it_is(x, scale):
    """A vector, one that depends on the parameter alone, a number and an integer."""
    cross = jnp.cross(x, jnp.sin(x * scale) / 3)
    x = x + cross * (1 - scale / 5) + jnp.roll(x, 1) * x[0] / 9
    return {"x": x, "fixed": scale * jnp.arange(3.0), "all": x @ x, "count": jnp.asarray(3)}


def rewritten(x, scale):
    return random_programs.rewritten(as_it_is)(x, scale)


def size(fun):
    def total(x, scale):
        out = fun(x, scale)
        return jnp.sum(jnp.cos(out["x"] * out["fixed"])) * out["all"]

    return total


@pytest.fixture(params=["flat", "as traced"])
def lengths(request, monkeypatch):
    """Compiled on single numbers, and as too long for that."""
    # Forgets the programs of the other way, of the same functions.
    jax.clear_caches()
    if request.param == "as traced":
        monkeypatch.setattr(random_programs.lowering, "MAX_OPERATIONS", 0)
    yield request.param
    jax.clear_caches()


def check(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        # Some hundred operations of size 10 at most, in another order.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_values(lengths):
    expected = run(as_it_is, X, SCALE)
    compiled = jax.jit(rewritten)
    check(compiled(X, SCALE), expected)
    check(run(rewritten, X, SCALE), expected)
    lines = compiled.lower(X, SCALE).as_text().splitlines()
    on_vectors = ["3xf64" in line for line in lines if "sine" in line]
    assert on_vectors
    assert any(on_vectors) == (lengths == "as traced")


def batches(f):
    """Of many, of few, as directions are, and of none; their gradients."""
    return lambda xs, x, s: [
        jax.vmap(g, axes)(xs[:n] if axes[0] == 0 else x, xs[:n, 0] if axes[1] == 0 else s)
        for n, axes in ((40, (0, None)), (2, (None, 0)), (0, (0, 0)))
        for g in (f, jax.grad(size(f), (0, 1)))
    ]


def batches_of_batches(inner, outer):
    x, scale = X, SCALE
    for length, ax in ((5, inner), (4, outer)):
        grown = [x, scale]
        for k, axis in enumerate(ax):
            if axis is not None:
                grown[k] = jnp.stack([grown[k] * (1 + j / 9) for j in range(length)], axis)
        x, scale = grown
    both = lambda f: jax.vmap(jax.vmap(f, inner), outer)  # noqa: E731

    def all_of(f):
        of_both = jax.grad(lambda *a: jnp.sum(both(size(f))(*a)), (0, 1))
        gradient = jax.grad(size(f), (0, 1))
        jacobian = jax.jacfwd(size(f), (0, 1))
        return lambda *a: [g(*a) for g in (*map(both, (f, gradient, jacobian)), of_both)]

    return all_of, x, scale


def directions_in_a_batch(f):
    """Inside of it and around it."""
    around = (
        jax.vmap(jax.jacfwd(size(f), 0), (0, None)),
        jax.jacfwd(jax.vmap(size(f), (0, None)), 1),
        jax.jacrev(lambda x, s: jax.vmap(f, (0, None))(x, s)["x"][:2], 1),
    )
    return lambda *a: [g(*a) for g in around]


def derivatives(outer, inner):
    def all_of(f):
        forward, first = jax.jacfwd(size(f), (0, 1)), inner(size(f), (0, 1))
        return lambda *a: [g(*a) for g in (forward, first, outer(inner(size(f), 0), (0, 1)))]

    return all_of, X, SCALE


def in_loops(fun):
    def total(x, scale):
        def turn(x, k):
            return fun(x, scale * k)["x"] / 2, None

        return jnp.sum(jax.lax.scan(turn, x, jnp.linspace(0.1, 1, 5))[0] ** 2)

    gradient = jax.value_and_grad(total, (0, 1))
    return lambda xs, s: (gradient(X, s), jax.vmap(gradient, (0, None))(xs, s))


TRANSFORMS = {
    "batches": (batches, XS, X, SCALE),
    "batches of batches": batches_of_batches((0, None), (None, 0)),
    "directions in a batch": (directions_in_a_batch, XS, SCALE),
    "forward over reverse": derivatives(jax.jacfwd, jax.jacrev),
    "derivatives in loops": (in_loops, XS, SCALE),
}
SLOW = {
    "batches along other axes": batches_of_batches((1, 0), (0, None)),
    "batches of both": batches_of_batches((0, 0), (1, 1)),
    "reverse over reverse": derivatives(jax.jacrev, jax.jacrev),
    "reverse over forward": derivatives(jax.jacrev, jax.jacfwd),
    "third": derivatives(jax.jacfwd, lambda f, k: jax.jacrev(jax.grad(f, k))),
}


@pytest.mark.usefixtures("lengths")
@pytest.mark.representatives(6)
@pytest.mark.parametrize(
    "name", [*TRANSFORMS, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def test_transformations(name):
    """Rewritten and as it is, by NumPy, for which nothing is compiled."""
    transform, *args = (TRANSFORMS | SLOW)[name]
    check(run(transform(rewritten), *args), run(transform(as_it_is), *args))


def test_it_is_traced_once():
    """Whatever becomes of it."""
    calls = []

    def counted(x, scale):
        calls.append(x)
        return as_it_is(x, scale)

    fun = size(random_programs.rewritten(counted))
    jax.jit(jax.vmap(jax.value_and_grad(fun), (0, None))).lower(jnp.outer(X, X), SCALE)
    assert len(calls) == 1


def linear(x, scale):
    for k in range(3):
        x = x * scale + jnp.cross(x, jnp.sin(scale * jnp.arange(3.0) + k))
    return x


def test_what_is_linear_is_transposed():
    """Of two operands in one: the other direction is known, and adds what that leaves out."""
    fun = lambda x: random_programs.rewritten(linear)(x, SCALE)  # noqa: E731
    matrix = run(jax.jacfwd(linear), X, SCALE)
    (found,) = run(jax.linear_transpose(fun, X), X[::-1])
    check(found, matrix.T @ X[::-1])
    (found,) = run(jax.linear_transpose(jax.vmap(fun), XS), XS[:, ::-1])
    check(found, XS[:, ::-1] @ matrix)

    def along(direction):
        return jax.jvp(lambda x, s: rewritten(x, s)["x"], (X, SCALE), (X, direction))[1]

    (found,) = run(jax.linear_transpose(along, SCALE), X[::-1])
    check(found, run(jax.jacfwd(lambda s: as_it_is(X, s)["x"]), SCALE) @ X[::-1])


def test_constants_that_agree_in_nine_digits_stay_apart():
    fun = lambda x, p: x * (1 / 3 + 1e-10) - x * (1 / 3)  # noqa: E731
    found = run(random_programs.rewritten(fun), X, 0.0)
    # The rounding of two numbers of size 0.4.
    np.testing.assert_allclose(found, 1e-10 * X, rtol=0, atol=1e-16)


def test_reverse_mode_keeps_the_operands_alone():
    _, back = jax.vjp(lambda x: rewritten(x, SCALE)["x"], X)
    # And 1 / 3 as a constant of the program.
    assert sum(x.size for x in jax.tree.leaves(back)) <= X.size + 1


def test_what_a_batch_does_not_reach_is_in_no_batch():
    axes = {"x": 0, "fixed": None, "all": 0, "count": None}
    batch = jax.vmap(rewritten, (0, None), axes)
    found = run(batch, XS, SCALE)
    assert [x.shape for x in jax.tree.leaves(found)] == [(40,), (), (3,), (40, 3)]
    check(found, run(jax.vmap(as_it_is, (0, None), axes), XS, SCALE))


def test_directions_that_are_zero_are_not_computed():
    """What does not depend on x has no derivative in x."""
    fun = lambda x: rewritten(x, SCALE)["fixed"]  # noqa: E731
    program = jax.make_jaxpr(lambda v: jax.jvp(fun, (X,), (v,))[1])(X)
    (zero,) = program.jaxpr.outvars
    assert not any(zero in eqn.outvars for eqn in program.eqns if "cfjax" in eqn.primitive.name)
    fun = lambda x: random_programs.rewritten(lambda x, scale: scale * jnp.arange(3.0))(x, SCALE)  # noqa: E731
    np.testing.assert_array_equal(run(lambda v: jax.jvp(fun, (X,), (v,))[1], X), np.zeros(3))


DERIVATIVES = {
    "grad": jax.grad,
    "jacfwd": jax.jacfwd,
    "jacrev": jax.jacrev,
    "hessian": jax.hessian,
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
}


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", ["hessian", *(x for x in DERIVATIVES if x != "hessian")])
def test_derivatives_of_one_system_are_compiled_as_they_were_traced(name, monkeypatch):
    """Batches of directions are no batches of systems. A Hessian has directions of both kinds."""
    on_numbers, calls = random_programs.lowering._on_numbers, []

    def counted(*args):
        calls.append(args)
        return on_numbers(*args)

    monkeypatch.setattr(random_programs.lowering, "_on_numbers", counted)
    step = random_programs.lowering.scalarised
    loss = lambda x: size(lambda x, scale: step(lambda x: as_it_is(x, scale), x))(x, SCALE)  # noqa: E731
    derivative = DERIVATIVES[name](loss)
    jax.jit(derivative).lower(X)
    assert not calls
    jax.jit(jax.vmap(derivative)).lower(XS)
    assert calls


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
    all_of = lambda f: [g(X) for g in (f, jax.grad(f), jax.jacfwd(f), jax.hessian(f))]  # noqa: E731
    check(run(lambda: all_of(fun)), run(lambda: all_of(plain)))


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
    check(made.call(X, SCALE), run(jax.grad(size(as_it_is)), X, SCALE))


def test_it_keeps_nothing_of_a_trace():
    with jax.checking_leaks():
        looped = lambda x, s: jax.lax.map(lambda k: rewritten(x, s)["x"] * k, X)  # noqa: E731
        jax.jit(jax.vmap(looped, (0, None))).lower(XS[:2], SCALE)
