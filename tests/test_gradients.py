"""Derivatives of solutions: right, finite in the hard places, and of any order.

Finite differences are of order 4 with step 1e-3. They err by 1e-12 / 30 times a fifth derivative,
and by rounding: 1e-15 / 1e-3. Each test states the size of the derivatives it assumes.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import problems
import pytest

import cfjax

STEP = 1e-3
LIE: dict[str, Any] = {"LieEuler": cfjax.LieEuler(), "CF4": cfjax.CF4(), "RKMK4": cfjax.RKMK4()}

BODY = (problems.rigid_body, jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA))
MATRIX = (
    problems.left_matrix,
    jnp.asarray(problems.ORTHOGONAL),
    jnp.asarray(problems.GENERATORS) / 4,
)
FLIGHT = (
    problems.body_in_flight,
    problems.arrays(problems.FLIGHT_START),
    problems.arrays(problems.FLIGHT_ARGS),
)


def end(solver, field, y0, args, t1=1.0, num_steps=8) -> Any:
    term = cfjax.LieTerm(field)
    ys = cfjax.integrate(term, solver, 0.0, t1, y0, args, num_steps=num_steps).ys
    return jtu.tree_map(lambda x: x[-1], ys)


def functional(y) -> Any:
    """A smooth function of a state that treats no two entries alike."""
    leaves = jtu.tree_leaves(y)
    return sum(
        jnp.sum(jnp.sin(x * jnp.arange(1.0, 1 + x.size).reshape(x.shape) / 4)) for x in leaves
    )


# Right


# The body divides by its inertia, 5! comes in, and directions are up to 2 long: derivatives of
# 3e4. The matrices are sums of products, with derivatives of 1e4.
@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver, problem",
    [("LieEuler", BODY), ("RKMK4", MATRIX), ("CF4", FLIGHT)],
    ids=lambda x: x if isinstance(x, str) else x[0].__name__,
)
def test_gradients_in_start_and_args(solver, problem):
    """Finite; reverse, forward and finite differences agree. Also where no time passes."""
    field, *x = problem

    def fun(x, t1):
        return functional(end(LIE[solver], field, *x, t1))

    @partial(jax.jit, compiler_options=problems.QUICK)
    def everything(x, t1, v):
        value, gradient = jax.value_and_grad(fun, (0, 1))(x, t1)
        forward = None
        if problem is not FLIGHT:
            forward = jax.jvp(lambda x: fun(x, t1), (x,), (v,))[1]
        slope, velocity = jax.grad(functional)(x[0]), cfjax.tangent(field(t1, *x), x[0])
        return value, gradient, forward, slope, problems.inner(slope, velocity)

    # Not as arrays of JAX, of which each operation would be compiled.
    x, v = jax.device_get((x, problems.random_like(x, 0)))
    expected = problems.central_difference(lambda x: everything(x, 1.0, v)[0], x, v, STEP)
    _, (gradient, _), forward, *_ = everything(x, 1.0, v)
    # Every group of parameters matters, so a gradient of zero would not pass.
    leaves = jtu.tree_leaves(gradient)
    assert all(np.isfinite(x).all() and np.abs(x).max() > 1e-3 for x in leaves)
    reverse = problems.inner(gradient, v)
    np.testing.assert_allclose(reverse, expected, rtol=0, atol=2e-9)
    if forward is not None:
        # One program, differentiated in two orders: sums of some 10^4 products, little cancels.
        np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-12)
    # t1 = t0: the end is the start, and its derivative in t1 is the velocity.
    _, ((d_start, _), d_t1), _, slope, rate = everything(x, 0.0, v)
    problems.assert_close(d_start, slope, 1e-14)
    np.testing.assert_allclose(d_t1, rate, rtol=0, atol=1e-14)


# Every kind of method, with a field of each kind of coordinates in a step


class Scaled(eqx.Module):
    """A field times a number, which may be zero."""

    field: Any
    scale: jax.Array

    def __call__(self, t, y, args):
        return cfjax.combine((self.scale,), (self.field(t, y, args),))


def low_rank(t, y, args):
    return cfjax.LowRankSkew(args * jnp.cos(y + t))


def affine(t, y, args):
    b, spectrum = args
    return cfjax.Affine(b * jnp.sin(y + t), spectrum, cfjax.SineTransform())


def translation(t, y, args):
    return args * jnp.sin(y + t)


def growth(t, y, args):
    return problems.Growth(args * jnp.stack([1 - y[1], y[0] - t]))


_rng = np.random.default_rng(2)
FRAME = jnp.asarray(np.linalg.qr(_rng.standard_normal((5, 2)))[0])
LINEAR = (jnp.asarray(_rng.standard_normal(4)), jnp.asarray([0.0, -1.0, 2.0, -5.0]))
GRID: dict[str, tuple[Any, Any, Any]] = {
    "translation": (translation, jnp.arange(3.0), jnp.asarray([0.5, -1.0, 1.5])),
    "vector": (problems.driven_body, BODY[1], BODY[2]),
    "left": MATRIX,
    "low rank": (low_rank, FRAME, jnp.asarray(_rng.standard_normal((5, 2)))),
    "affine": (affine, jnp.arange(4.0) / 4, LINEAR),
    "own class": (growth, jnp.asarray([0.5, 1.5]), jnp.asarray([1.0, -0.5])),
}
METHODS = {
    "CF2": cfjax.CF2(),
    "RKMK3": cfjax.RKMK3(),
    "Williamson3": cfjax.Williamson3(),
    "CayleyRK4": cfjax.CayleyRK4(),
}
PAIRS = [
    *((kind, "CF2") for kind in GRID),
    *((kind, "RKMK3") for kind in ("vector", "left")),
    ("affine", "Williamson3"),
    ("low rank", "CayleyRK4"),
]
# Scale of the field, t0 and t1: a generic step, a zero field, a zero step, and both.
PLACES = jnp.asarray([(1.0, 0.2, 0.9), (0.0, 0.2, 0.9), (1.0, 0.2, 0.2), (0.0, 0.2, 0.2)])


@pytest.mark.representatives(1)
@pytest.mark.parametrize("kind, method", PAIRS)
def test_finite_and_right_for_every_field_and_method(kind, method):
    """In the field's scale, both times, the start and args (a spectrum in them) at once.

    One step, in a batch: there both sides of every choice are computed, and NaN on the side that
    is not taken would show in a gradient.
    """
    field, y0, args = GRID[kind]
    solver = METHODS[method]

    def fun(x):
        (scale, t0, t1), y0, args = x
        if kind == "low rank":
            y0 = problems.orthonormal(y0)
        term = cfjax.LieTerm(Scaled(field, scale))
        return functional(problems.first_step(solver, term, t0, t1, y0, args)[0])

    batch = jax.jit(jax.vmap(jax.value_and_grad(fun)), compiler_options=problems.QUICK)
    x = jtu.tree_map(lambda a: jnp.broadcast_to(a, (len(PLACES), *a.shape)), (y0, args))
    x = (PLACES, *x)
    _, gradient = batch(x)
    assert all(np.all(np.isfinite(leaf)) for leaf in jtu.tree_leaves(gradient))
    for seed in (0, 1):
        v = problems.random_like(x, seed)
        expected = problems.central_difference(lambda x: batch(x)[0], x, v, STEP / 4)
        products = jtu.tree_map(lambda a, b: jnp.sum((a * b).reshape(len(a), -1), 1), gradient, v)
        found = sum(jtu.tree_leaves(products))
        # One long step, in directions of length up to 9: fifth derivatives of 1e6, times
        # 4e-15 / 30. Rounding: 1e-15 / 2.5e-4, of values up to 10.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


# Higher order


def orders(fun):
    """The Hessian in all four orders of forward and reverse mode."""
    modes = (jax.jacfwd, jax.jacrev)
    return [outer(inner(fun)) for inner in modes for outer in modes]


@pytest.mark.slow
def test_hessians_in_every_order():
    """In start and inertia, against differences of gradients."""
    field, y0, args = BODY

    def fun(x):
        return functional(end(cfjax.CF3(), field, x[:3], x[3:], num_steps=4))

    x = jnp.concatenate([y0, args])
    gradient = jax.jit(jax.grad(fun))
    expected = [problems.central_difference(gradient, x, v, STEP) for v in jnp.eye(6)]
    for hessian in orders(fun):
        found = jax.jit(hessian, compiler_options=problems.QUICK)(x)
        # Sixth derivatives of 3e5.
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-8)


@pytest.mark.slow
def test_programs_of_second_derivatives_are_short():
    """Some four times those of the gradient, in every order, and compiled no longer than they are.

    The more often a derivative is taken, the more XLA would compute several times.
    """
    field, y0, args = BODY

    def fun(y):
        return functional(end(cfjax.CF4(), field, y, args))

    def lowered(fun):
        program = jax.jit(fun).lower(y0)
        return program, program.as_text().count("\n")

    _, gradient = lowered(jax.grad(fun))
    product, length = lowered(lambda y: jax.jvp(jax.grad(fun), (y,), (y0,))[1])
    assert length < 4 * gradient
    for hessian in orders(fun):
        assert lowered(hessian)[1] < 1.2 * length
    # 13 900 as measured, of 16 500. It was 142 000 for a Hessian of 13 700.
    assert product.compile().as_text().count("\n") < 1.2 * length
