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

import cfjax

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
@pytest.mark.parametrize(
    "loop, solver, problem",
    [
        ("integrate", "CF4", BODY),
        ("integrate", "RKMK4", BODY),
        ("integrate", "CF4", MATRIX),
        ("integrate", "CF4", FLIGHT),
        ("diffeqsolve", "CF4", BODY),
        ("diffeqsolve", "RKMK4", MATRIX),
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


# Hard places


class Scaled(eqx.Module):
    """A field times a number, which may be zero."""

    field: Any
    scale: jax.Array

    def __call__(self, t, y, args):
        return cfjax.combine((self.scale,), (self.field(t, y, args),))


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


@solvers
def test_at_a_field_that_vanishes_with_the_state(solver):
    """y = 0 is a fixed point of the body, and the flow there is the identity to first order."""
    jacobian = jax.jit(
        jax.jacrev(lambda y: end("integrate", solver, problems.rigid_body, y, BODY[2]))
    )(jnp.zeros(3))
    np.testing.assert_allclose(jacobian, np.eye(3), rtol=0, atol=1e-15)


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


@pytest.mark.parametrize(
    "solver, problem, num_steps",
    [("RKMK4", BODY, 4), ("CF4", MATRIX, 2)],
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
    forward_over_reverse = jax.jit(lambda x, v: jax.jvp(jax.grad(fun), (x,), (v,))[1])
    found = forward_over_reverse(x, v)
    expected = problems.central_difference(gradient, x, v, STEP)
    # Sixth derivatives of 3e5.
    problems.assert_close(found, expected, atol=2e-8)
    # The Hessian is symmetric, up to roundings of sums of 10^4 products of order 10.
    left, right = problems.inner(found, w), problems.inner(forward_over_reverse(x, w), v)
    np.testing.assert_allclose(left, right, rtol=1e-11, atol=1e-11)


def test_a_gradient_of_a_gradient():
    """Reverse over reverse, against differences of gradients."""
    field, y0, args = BODY
    v = problems.random_like(y0, 4)
    gradient = jax.grad(
        lambda y: functional(end("integrate", cfjax.CF4(), field, y, args, num_steps=4))
    )
    found = jax.jit(jax.grad(lambda y: problems.inner(gradient(y), v)))(y0)
    expected = problems.central_difference(jax.jit(gradient), y0, v, STEP)
    # Sixth derivatives of 3e5, as above.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-8)


# Structure


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
