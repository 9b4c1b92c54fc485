"""Derivatives of solutions: right, finite in the hard places, and of any order.

Finite differences are of order 4 with step 1e-3. They err by 1e-12 / 30 times a fifth derivative,
and by rounding: 1e-15 / 1e-3. Each test states the size of the derivatives it assumes.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import problems
import pytest
import scipy.linalg

import cfjax
from cfjax.scenes import heat, stiefel

STEP = 1e-3
LIE: dict[str, Any] = {"CF4": cfjax.CF4(), "RKMK4": cfjax.RKMK4()}
solvers = pytest.mark.parametrize("solver", LIE.values(), ids=LIE.keys())

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


def end(loop, solver, field, y0, args, t1=1.0, num_steps=8) -> Any:
    term = cfjax.LieTerm(field)
    if loop == "integrate":
        ys = cfjax.integrate(term, solver, 0.0, t1, y0, args, num_steps=num_steps).ys
    else:
        h = t1 / num_steps
        ys = diffrax.diffeqsolve(term, solver, 0.0, t1, h, y0, args, max_steps=num_steps).ys
    assert ys is not None
    return jtu.tree_map(lambda x: x[-1], ys)


def functional(y) -> Any:
    """A smooth function of a state that treats no two entries alike."""
    leaves = jtu.tree_leaves(y)
    return sum(
        jnp.sum(jnp.sin(x * jnp.arange(1.0, 1 + x.size).reshape(x.shape) / 4)) for x in leaves
    )


def check(fun, x, atol, seed=0, forwards=True):
    """Finite; reverse, forward and finite differences agree."""
    direction = problems.random_like(x, seed)
    fun = jax.jit(fun)
    expected = problems.central_difference(fun, x, direction, STEP)
    gradient = jax.jit(jax.grad(fun))(x)
    assert all(np.all(np.isfinite(leaf)) for leaf in jtu.tree_leaves(gradient))
    reverse = problems.inner(gradient, direction)
    np.testing.assert_allclose(reverse, expected, rtol=0, atol=atol)
    if forwards:
        _, forward = jax.jit(lambda x, v: jax.jvp(fun, (x,), (v,)))(x, direction)
        # One program, differentiated in two orders: sums of some 10^4 products, little cancels.
        np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-12)
    return gradient


# Right


# The body divides by its inertia, 5! comes in, and directions are up to 2 long: derivatives of
# 3e4. The matrices are sums of products, with derivatives of 1e4.
@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "loop, solver, problem",
    [
        ("integrate", "CF4", BODY),
        ("integrate", "RKMK4", BODY),
        ("integrate", "CF4", MATRIX),
        ("integrate", "CF4", FLIGHT),
        ("diffeqsolve", "CF4", BODY),
        pytest.param("diffeqsolve", "RKMK4", MATRIX, marks=pytest.mark.slow),
    ],
    ids=lambda x: x if isinstance(x, str) else x[0].__name__,
)
def test_gradients_in_start_and_args(loop, solver, problem):
    field, y0, args = problem
    gradient = check(
        lambda x: functional(end(loop, LIE[solver], field, *x)),
        (y0, args),
        atol=2e-9,
        # Diffrax's default adjoint has reverse mode only. For the others see test_diffrax.py.
        forwards=loop == "integrate" and problem is not FLIGHT,
    )
    # Every group of parameters matters, so a gradient of zero would not pass.
    assert all(np.abs(leaf).max() > 1e-3 for leaf in jtu.tree_leaves(gradient))


@pytest.mark.slow
def test_the_two_loops_have_the_same_gradient():
    found, expected = (
        jax.jit(jax.grad(lambda x, loop=loop: functional(end(loop, LIE["CF4"], BODY[0], *x))))(
            BODY[1:]
        )
        for loop in ("integrate", "diffeqsolve")
    )
    for a, b in zip(found, expected, strict=True):
        # Steps of 1/8 are exact, so both loops take the same ones.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


class Network(eqx.Module):
    """An angular velocity learnt from the state and the time: parameters inside the field."""

    mlp: eqx.nn.MLP

    def __call__(self, t, y, args):
        return cfjax.Rotation(self.mlp(jnp.append(y, t)))


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["integrate", pytest.param("diffeqsolve", marks=pytest.mark.slow)])
def test_gradients_in_a_network_held_by_the_term(loop):
    """By `eqx.filter_grad` over the term, for a batch of starts."""
    mlp = eqx.nn.MLP(4, 3, 5, 1, activation=jnp.tanh, key=jax.random.key(0), dtype=float)
    starts = jnp.stack([BODY[1], -BODY[1], BODY[1][::-1]])

    def loss(term):
        last = jax.vmap(lambda y0: end(loop, cfjax.CF2(), term.field, y0, None, num_steps=2))
        return functional(last(starts))

    term = cfjax.LieTerm(Network(mlp))
    gradient = eqx.filter_jit(eqx.filter_grad(loss))(term)
    leaves = jtu.tree_leaves(gradient)
    assert len(leaves) == 4 and all(np.abs(leaf).max() > 1e-3 for leaf in leaves)
    parameters, rest = eqx.partition(term, eqx.is_inexact_array)
    direction = problems.random_like(parameters, 1)
    value = eqx.filter_jit(lambda p: loss(eqx.combine(p, rest)))
    # Sums of three, with fifth derivatives of 1e4.
    expected = problems.central_difference(value, parameters, direction, STEP)
    found = problems.inner(gradient, direction)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-9)


# Every kind of field with every kind of method


class Scaled(eqx.Module):
    """A field times a number, which may be zero."""

    field: Any
    scale: jax.Array

    def __call__(self, t, y, args):
        return cfjax.combine((self.scale,), (self.field(t, y, args),))


def turned(t, y, args):
    return cfjax.Rotation(args * jnp.cos(t) + jnp.sin(2 * y[:, 0]))


def low_rank(t, y, args):
    return cfjax.LowRankSkew(args * jnp.cos(y + t))


def bordered(t, y, args):
    return cfjax.BorderedSkew(args * jnp.cos(y + t))


def affine(t, y, args):
    b, spectrum = args
    return cfjax.Affine(b * jnp.sin(y + t), spectrum)


def affine_on_points(t, y, args):
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
    "attitude": (turned, jnp.eye(3), jnp.asarray([0.5, -1.0, 1.5])),
    "left": MATRIX,
    "right": (problems.right_matrix, *MATRIX[1:]),
    "low rank": (low_rank, FRAME, jnp.asarray(_rng.standard_normal((5, 2)))),
    "bordered": (bordered, FRAME, jnp.asarray(_rng.standard_normal((5, 2)))),
    "affine": (affine, jnp.arange(4.0) / 4, LINEAR),
    "affine on points": (affine_on_points, jnp.arange(4.0) / 4, LINEAR),
    "own class": (growth, jnp.asarray([0.5, 1.5]), jnp.asarray([1.0, -0.5])),
}
METHODS = {
    "CF4": cfjax.CF4(estimate=None),
    "RKMK3": cfjax.RKMK3(),
    "Williamson3": cfjax.Williamson3(),
    "CayleyRK4": cfjax.CayleyRK4(),
}
# The low-storage methods ask nothing more of a field: they get one of each kind of points.
PAIRS = [
    *(pytest.param(kind, "CF4", marks=[pytest.mark.slow] * (kind == "attitude")) for kind in GRID),
    *(
        pytest.param(kind, "RKMK3", marks=[pytest.mark.slow] * (kind not in ("vector", "affine")))
        for kind in GRID
        if kind != "own class"
    ),
    *((kind, "Williamson3") for kind in ("right", "low rank", "affine on points")),
    *((kind, "CayleyRK4") for kind in ("low rank", "bordered")),
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
        if kind in ("low rank", "bordered"):
            y0 = problems.orthonormal(y0)
        term = cfjax.LieTerm(Scaled(field, scale))
        state = solver.init(term, t0, t1, y0, args)
        return functional(solver.step(term, t0, t1, y0, args, state, made_jump=False)[0])

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


# Hard places


@pytest.mark.slow
@pytest.mark.parametrize("solver, problem", [("RKMK4", BODY), ("CF4", MATRIX)])
def test_at_a_zero_field(solver, problem):
    """At scale 0 the end is the start, and its derivative in the scale is the field's integral."""
    field, y0, args = problem

    def fun(x):
        scale, y0 = x
        return functional(end("integrate", LIE[solver], Scaled(field, scale), y0, args))

    d_scale, d_start = check(fun, (jnp.asarray(0.0), y0), atol=2e-9)
    np.testing.assert_allclose(d_start, jax.grad(functional)(y0), rtol=0, atol=1e-14)
    # Both methods are Simpson's rule on each of 8 steps: h^4 / 2880 times a fourth derivative of
    # 16 (sin 2t), or 1e-6.
    ts, ws = np.polynomial.legendre.leggauss(8)
    velocity = sum(
        w / 2 * cfjax.tangent(field(jnp.asarray((t + 1) / 2), y0, args), y0)
        for t, w in zip(ts, ws, strict=True)
    )
    expected = problems.inner(jax.grad(functional)(y0), velocity)
    assert abs(expected) > 1e-3
    np.testing.assert_allclose(d_scale, expected, rtol=0, atol=2e-6)


@pytest.mark.slow
@solvers
def test_at_a_field_that_vanishes_with_the_state(solver):
    """y = 0 is a fixed point of the body, and the flow there is the identity to first order."""
    jacobian = jax.jit(
        jax.jacrev(lambda y: end("integrate", solver, problems.rigid_body, y, BODY[2]))
    )(jnp.zeros(3))
    np.testing.assert_allclose(jacobian, np.eye(3), rtol=0, atol=1e-15)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("problem", [BODY, MATRIX], ids=["body", "matrix"])
def test_at_a_zero_step(problem):
    """t1 = t0: the end is the start, and its derivative in t1 is the velocity."""
    field, y0, args = problem

    def fun(x):
        t1, y0 = x
        return functional(end("integrate", cfjax.CF4(), field, y0, args, t1=t1))

    d_t1, d_start = check(fun, (jnp.asarray(0.0), y0), atol=2e-9)
    slope = jax.grad(functional)(y0)
    for a, b in zip(jtu.tree_leaves(d_start), jtu.tree_leaves(slope), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)
    velocity = cfjax.tangent(field(jnp.asarray(0.0), y0, args), y0)
    np.testing.assert_allclose(d_t1, problems.inner(slope, velocity), rtol=0, atol=1e-14)


@pytest.mark.slow
@solvers
def test_at_large_angles(solver):
    """From half a turn to more than six turns in one step.

    Derivatives grow with the angle a: the fifth is of order a^5. So the step of the difference
    shrinks with it, and what is left is a relative 1e-9 and the rounding of the angle.
    """
    field, y0, args = BODY

    @jax.jit
    def fun(y0, t1):
        return functional(end("integrate", solver, field, y0, args, num_steps=1, t1=t1))

    direction = problems.random_like(y0, 2)
    derivative = jax.jit(lambda y0, t1: jax.jvp(lambda y: fun(y, t1), (y0,), (direction,))[1])
    gradient_at = jax.jit(jax.grad(fun))
    angles = []
    for t1 in (3.0, 12.0, 40.0):
        angles.append(float(jnp.linalg.norm(t1 * y0 / args)))
        step = STEP / angles[-1]
        expected = problems.central_difference(lambda y, t1=t1: fun(y, t1), y0, direction, step)
        gradient = gradient_at(y0, t1)
        assert np.all(np.isfinite(gradient))
        # Each of four stages has an angle of the one before: |gradient| up to angle^4 at worst.
        scale = max(1.0, float(jnp.linalg.norm(gradient)))
        found = problems.inner(gradient, direction)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * scale)
        np.testing.assert_allclose(found, derivative(y0, t1), rtol=0, atol=1e-12 * scale)
    assert angles[0] < np.pi and angles[1] > 2 * np.pi and angles[2] > 6 * np.pi


@pytest.mark.slow
@solvers
def test_at_large_angles_of_a_constant_field(solver):
    """Six turns in one step, with the derivative in closed form: a turn about the third axis."""

    def fun(omega):
        def field(t, y, args):
            return cfjax.Rotation(args)

        args = jnp.stack([0 * omega, 0 * omega, omega])
        y0 = jnp.asarray([1.0, 0.0, 0.0])
        return end("integrate", solver, field, y0, args, num_steps=1)

    jacobian = jax.jit(jax.jacrev(fun))
    for omega in (0.0, 1e-9, np.pi, 2 * np.pi, 37.7):
        found = jacobian(jnp.asarray(omega))
        exact = [-np.sin(omega), np.cos(omega), 0.0]
        # Angles of up to 38 are rounded by 7e-15, and go through up to five flows.
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13)


# Higher order


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, problem, num_steps",
    [("RKMK4", BODY, 4), pytest.param("CF4", MATRIX, 2, marks=pytest.mark.slow)],
    ids=["RKMK4-body", "CF4-matrix"],
)
def test_hessian_vector_products(solver, problem, num_steps):
    """Gradient of gradient, in the order that optimisers use, against differences of gradients."""
    field, y0, args = problem

    def fun(x):
        return functional(end("integrate", LIE[solver], field, *x, num_steps=num_steps))

    x = (y0, args)
    v, w = problems.random_like(x, 4), problems.random_like(x, 5)
    gradient = jax.jit(jax.grad(fun))
    forward_over_reverse = jax.jit(
        lambda x, v: jax.jvp(jax.grad(fun), (x,), (v,))[1], compiler_options=problems.QUICK
    )
    found = forward_over_reverse(x, v)
    expected = problems.central_difference(gradient, x, v, STEP)
    # Sixth derivatives of 3e5.
    problems.assert_close(found, expected, atol=2e-8)
    # The Hessian is symmetric, up to roundings of sums of 10^4 products of order 10.
    left, right = problems.inner(found, w), problems.inner(forward_over_reverse(x, w), v)
    np.testing.assert_allclose(left, right, rtol=1e-11, atol=1e-11)


def orders(fun):
    """The Hessian in all four orders of forward and reverse mode."""
    modes = (jax.jacfwd, jax.jacrev)
    return [outer(inner(fun)) for inner in modes for outer in modes]


@pytest.mark.slow
@pytest.mark.parametrize("solver", [cfjax.CF3(), pytest.param(cfjax.CF4(), marks=pytest.mark.slow)])
def test_hessians_in_every_order(solver):
    """In start and inertia, against differences of gradients."""
    field, y0, args = BODY

    def fun(x):
        return functional(end("integrate", solver, field, x[:3], x[3:], num_steps=4))

    x = jnp.concatenate([y0, args])
    gradient = jax.jit(jax.grad(fun))
    expected = [problems.central_difference(gradient, x, v, STEP) for v in jnp.eye(6)]
    for hessian in orders(fun):
        found = jax.jit(hessian, compiler_options=problems.QUICK)(x)
        # Sixth derivatives of 3e5, as above.
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-8)


@pytest.mark.slow
def test_programs_of_second_derivatives_are_short():
    """Some four times those of the gradient, in every order, and compiled no longer than they are.

    The more often a derivative is taken, the more XLA would compute several times.
    """
    field, y0, args = BODY

    def fun(y):
        return functional(end("integrate", cfjax.CF4(), field, y, args))

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


@pytest.mark.slow
def test_a_gradient_of_a_gradient():
    """Reverse over reverse, against differences of gradients."""
    field, y0, args = BODY
    v = problems.random_like(y0, 4)
    gradient = jax.grad(
        lambda y: functional(end("integrate", cfjax.CF4(), field, y, args, num_steps=4))
    )
    second = jax.grad(lambda y: problems.inner(gradient(y), v))
    found = jax.jit(second, compiler_options=problems.QUICK)(y0)
    expected = problems.central_difference(jax.jit(gradient), y0, v, STEP)
    # Sixth derivatives of 3e5, as above.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-8)


@pytest.mark.slow
def test_a_batch_of_hessian_vector_products():
    """Reverse over forward and forward over reverse, each under vmap, against one at a time."""
    field, y0, args = BODY

    def fun(y):
        return functional(end("integrate", cfjax.CF2(), field, y, args, num_steps=2))

    def reverse_over_forward(y, v):
        return jax.grad(lambda y: jax.jvp(fun, (y,), (v,))[1])(y)

    def forward_over_reverse(y, v):
        return jax.jvp(jax.grad(fun), (y,), (v,))[1]

    starts = jnp.stack([y0, -y0, 0 * y0])
    directions = problems.random_like(starts, 1)
    one = jax.jit(reverse_over_forward, compiler_options=problems.QUICK)
    expected = jnp.stack([one(y, v) for y, v in zip(starts, directions, strict=True)])
    assert np.abs(expected).max() > 0.1
    for product in (reverse_over_forward, forward_over_reverse):
        batch = jax.jit(jax.vmap(product), compiler_options=problems.QUICK)
        # One program in another order: sums of some 1000 products.
        np.testing.assert_allclose(batch(starts, directions), expected, rtol=0, atol=1e-13)


# Closed forms


@pytest.mark.slow
@pytest.mark.parametrize("solver", [cfjax.CF4(), cfjax.RKMK4()], ids=["CF4", "RKMK4"])
def test_a_linear_flow_in_its_spectrum(solver):
    """`u' = M u + b` is solved exactly, so its derivatives in spectrum, b, start and time are."""
    spectrum = jnp.asarray([0.0, 1e-9, 1.5, -2.0, -1e4])
    b, y0 = jnp.asarray([1.0, 2.0, -1.0, 0.5, 3.0]), jnp.asarray([0.3, -1.0, 2.0, 1.0, 0.7])
    weights = jnp.asarray([1.0, -2.0, 0.5, 3.0, 4.0])

    def value(spectrum, b, y0, t):
        term = cfjax.LieTerm(lambda t, y, args: cfjax.Affine(b, spectrum))
        return cfjax.integrate(term, solver, 0.0, t, y0, num_steps=2).ys[-1] @ weights

    t = 0.8
    found = jax.jit(jax.grad(value, (0, 1, 2, 3)))(spectrum, b, y0, t)
    z, phi, slope = np.asarray(t * spectrum), np.full(5, t), np.full(5, t**2 / 2)
    # phi = (exp(t m) - 1) / m and its derivative in m; below 1e-8 their limits at zero.
    m = np.asarray(spectrum)[2:]
    phi[2:] = np.expm1(z[2:]) / m
    slope[2:] = (t * np.exp(z[2:]) - phi[2:]) / m
    exact = (
        weights * (t * np.exp(z) * y0 + slope * b),
        weights * phi,
        weights * np.exp(z),
        jnp.sum(weights * (np.exp(z) * (spectrum * y0 + b))),
    )
    for a, e in zip(found, exact, strict=True):
        # Two steps; the limits are off by 1e-9 / 6 at most, at the second eigenvalue.
        np.testing.assert_allclose(a, e, rtol=1e-12, atol=1e-9)


@pytest.mark.slow
def test_heat_with_a_constant_diffusivity():
    """All steps are exact then: the sensitivity in the constant is `t M u(t)`.

    In other directions it is the derivative of a matrix exponential, and CF4 has an error of its
    order.
    """
    n, t = 8, 0.1
    u0 = 1 - np.abs(np.linspace(-1, 1, n + 1)[1:-1])
    bumps = np.random.default_rng(0).standard_normal(n)

    def matrix(mu):
        below = np.diag(mu[1:-1], -1)
        return (below + below.T - np.diag(mu[:-1] + mu[1:])) * (n / 2) ** 2

    def end_at(mu, constant, num_steps):
        args, y0 = heat.Diffusivity(mu, constant), heat.y0(n)
        term = cfjax.LieTerm(heat.field)
        ys = cfjax.integrate(term, cfjax.CF4(), 0.0, t, y0, args, num_steps=num_steps).ys
        return heat.to_grid(ys[-1])

    point = jnp.full(n, 0.6), jnp.asarray(0.6)
    a = matrix(np.asarray(point[0]))
    exact = scipy.linalg.expm(t * a) @ u0
    ends = {n: jax.jit(lambda *x, n=n: end_at(*x, n)) for n in (4, 8, 16)}
    all_of_it = jax.jvp(ends[4], point, (jnp.ones(n), jnp.asarray(1.0)))[1]
    np.testing.assert_allclose(all_of_it, t * a @ exact / 0.6, rtol=0, atol=1e-13)

    wanted = scipy.linalg.expm_frechet(t * a, t * matrix(bumps), compute_expm=False) @ u0
    found = {
        k: jax.jvp(f, point, (jnp.asarray(bumps), jnp.asarray(0.0)))[1] for k, f in ends.items()
    }
    errors = np.array([np.linalg.norm(x - wanted) for x in found.values()])
    assert np.linalg.norm(wanted) > 0.1 and 1e-12 < errors[-1] < 1e-4
    assert abs(problems.slope(list(found), errors) - 4) < 0.3
    gradient = jax.jit(jax.grad(lambda mu: ends[16](mu, point[1]) @ u0))(point[0])
    np.testing.assert_allclose(gradient @ bumps, found[16] @ u0, rtol=1e-12)


def skew_of(gamma):
    p = gamma.shape[1]
    wide = np.pad(gamma, ((0, 0), (0, len(gamma) - p)))
    return wide - wide.T


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["left", "bordered"])
def test_a_constant_field_on_the_stiefel_manifold(kind):
    """The end is `exp(t a) Q`: derivatives in a, by the Frechet derivative, and in t."""
    rng = np.random.default_rng(4)
    gamma, direction, weights = rng.standard_normal((3, 5, 2))
    field = {
        "left": lambda gamma: cfjax.LeftMatrix(jnp.pad(gamma, ((0, 0), (0, 3)))),
        "bordered": lambda gamma: cfjax.BorderedSkew(gamma),
    }[kind]
    matrix = skew_of if kind == "bordered" else lambda gamma: np.pad(gamma, ((0, 0), (0, 3)))

    def value(gamma, t):
        term = cfjax.LieTerm(lambda t, y, args: field(args))
        ys = cfjax.integrate(term, cfjax.CF4(), 0.0, t, FRAME, gamma, num_steps=2).ys
        return jnp.vdot(weights, ys[-1])

    d_gamma, d_t = jax.jit(jax.grad(value, (0, 1)))(jnp.asarray(gamma), 0.7)
    end, change = scipy.linalg.expm_frechet(0.7 * matrix(gamma), 0.7 * matrix(direction))
    # Two exact steps, and SciPy's own rounding, of sums of some 100 products of order 1 to 10.
    np.testing.assert_allclose(
        np.vdot(d_gamma, direction), np.vdot(weights, change @ FRAME), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        d_t, np.vdot(weights, matrix(gamma) @ end @ FRAME), rtol=0, atol=1e-12
    )


@pytest.mark.slow
def test_turning_the_frame_turns_its_solution():
    """For equal weights of the columns `Y(t; Q R) = Y(t; Q) R`: along `Q w` it moves by `Y w`.

    So in reverse the gradient G at Q of `<W, Y>` has `Q^T G` and `Y^T W` with one skew part. The
    steps turn with the frame too, so there is no error of the method.
    """
    d, _ = stiefel.diagonals(5, 2)
    args = jnp.asarray(d), jnp.asarray([-3.0, -3.0])
    weights = jnp.asarray(np.random.default_rng(1).standard_normal((5, 2)))

    def last(y0):
        term = cfjax.LieTerm(stiefel.first)
        return cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, y0, args, num_steps=4).ys[-1]

    def both(y0):
        y, pull = jax.vjp(last, y0)
        return y.T @ weights, y0.T @ pull(weights)[0]

    expected, found = jax.jit(both, compiler_options=problems.QUICK)(FRAME)
    assert np.abs(expected - expected.T).max() > 0.1
    # Four steps of some ten roundings.
    np.testing.assert_allclose(found - found.T, expected - expected.T, rtol=0, atol=1e-13)


# On the manifold


def tangential(y, g):
    """The formula of the page on gradients."""
    if y.ndim == 1:
        return g - (y @ g) * y
    return g - y @ (y.T @ g + g.T @ y) / 2


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["sphere", "rotations", "orthogonal"])
def test_the_gradient_in_the_algebra_is_the_tangential_one(problem):
    """`w -> loss(exp(w) y)` at w = 0 sees the tangential part of the Euclidean gradient alone."""
    if problem == "sphere":
        y, args, field = *BODY[1:], problems.rigid_body
        y, make, size = y / jnp.linalg.norm(y), cfjax.Rotation, 3
    elif problem == "rotations":
        y, args, field = jnp.eye(3)[::-1], jnp.asarray([0.5, -1.0, 1.5]), turned
        make, size = cfjax.Rotation, 3
    else:
        y, args, field = MATRIX[1], MATRIX[2], MATRIX[0]
        size = 16
        make = lambda a: cfjax.LeftMatrix(a.reshape(4, 4) - a.reshape(4, 4).T)  # noqa: E731

    def loss(y):
        return functional(end("integrate", cfjax.CF2(), field, y, args, num_steps=2))

    def both(y):
        in_algebra = jax.grad(lambda w: loss(cfjax.flow(make(w), y)))(jnp.zeros(size))
        return in_algebra, tangential(y, jax.grad(loss)(y))

    in_algebra, gradient = jax.jit(both, compiler_options=problems.QUICK)(y)
    assert np.abs(gradient).max() > 0.1
    # Tangent to the manifold: the flows along it keep orthogonality to first order.
    symmetric = y.T @ gradient
    np.testing.assert_allclose(symmetric + symmetric.T, 0 * symmetric, rtol=0, atol=1e-14)
    for w in jnp.eye(size):
        # Sums of some 100 products of order 1 to 10.
        slope = jnp.vdot(gradient, make(w).tangent(y))
        np.testing.assert_allclose(in_algebra @ w, slope, rtol=0, atol=1e-12)


# Structure


@pytest.mark.slow
@solvers
def test_the_energy_of_the_body_has_its_initial_gradient_forever(solver):
    """Energy is constant, so d E(y(T)) / d y(0) = dE(y(0)), up to the method's error.

    The defect falls with the method's order, which no wrong gradient would do.
    """
    field, y0, args = BODY

    def energy(y):
        return jnp.sum(y**2 / args) / 2

    @jax.jit
    def defect(n):
        # In forward mode, which can differentiate a loop of any number of steps: one program.
        gradient = jax.jacfwd(
            lambda y: energy(
                problems.many_steps(field, solver, jnp.asarray(0.0), jnp.asarray(5.0), y, args, n)
            )
        )
        return jnp.linalg.norm(gradient(y0) - jax.grad(energy)(y0))

    steps = (10, 20, 40, 80)
    found = np.array([float(defect(jnp.asarray(n))) for n in steps])
    # Rounding adds 1e-15 a step. On a quantity that is conserved one order may be gained.
    assert found.min() > 1e-12
    assert solver.order(None) - 0.3 < problems.slope(steps, found) < solver.order(None) + 1.3


@pytest.mark.slow
@solvers
def test_the_length_of_the_momentum_has_its_initial_gradient_exactly(solver):
    """The flow keeps |y| whatever the field, so this gradient has no error of the method."""
    field, y0, args = BODY

    def length(y):
        return jnp.linalg.norm(y)

    def at_end(x):
        return length(end("integrate", solver, field, *x, t1=5.0, num_steps=20))

    d_start, d_args = jax.jit(jax.grad(at_end))((y0, args))
    # Roundings of 20 steps in each direction.
    np.testing.assert_allclose(d_start, jax.grad(length)(y0), rtol=0, atol=1e-13)
    np.testing.assert_allclose(d_args, np.zeros(3), rtol=0, atol=1e-13)
