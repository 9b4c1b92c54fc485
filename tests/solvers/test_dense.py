"""Output within the steps: observed orders, the manifold, derivatives.

The order conditions of its coefficients are in methods/test_order_conditions.py, and
test_step.py compares the output of commutator-free methods with that of an interpreter.
"""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp
from solver_table import MUNTHE_KAAS, SOLVERS, problem_for

import cfjax
from cfjax._solvers.dense import Substeps

# `RKMK5` and `RKMK8` are Tsit5 and Dopri8.
METHODS = MUNTHE_KAAS | {name: SOLVERS[name] for name in ("RKMK3", "RKMK4", "CF4")}
BODY = problems.driven_body, jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)


def test_output_within_a_step_is_a_short_program():
    """What compiles it grows with the operations; an event's root finder differentiates them."""
    solver, (field, y0, args) = cfjax.CF54(), BODY
    term = cfjax.LieTerm(field)
    times = jnp.asarray(0.0), jnp.asarray(0.1)
    info: Any = jax.eval_shape(lambda: problems.first_step(solver, term, *times, y0, args)[2])
    info = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), info)

    def within(t):
        return solver.interpolation_cls(t0=times[0], t1=times[1], **info).evaluate(t)

    # 8 flows of 8 stages, whose weights have 5 powers of the time: 832 number by number, else 259.
    assert problems.num_operations(jax.make_jaxpr(within)(0.05).jaxpr) < 300


def dense(solver, n, field, y0, args, t1=1.0, **kwargs):
    return diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        solver,
        *(0.0, t1, t1 / n, y0, args),
        max_steps=n + 1,
        saveat=diffrax.SaveAt(dense=True),
        **kwargs,
    )


# The errors of Dopri8 are at rounding after two of these steps, so its own are longer.
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "RKMK4")) for name in METHODS],
)
def test_the_error_between_the_steps_falls_with_the_order_of_the_solution(name):
    """Within one step like h^(order + 1), so it keeps the order of the solution."""
    solver, order = METHODS[name].make(), METHODS[name].output
    steps = np.array([4, 8, 16, 32]) if order < 7 else np.array([0.5, 0.7, 1.0, 1.4])
    thetas = np.array([0.21, 0.5, 0.83])
    field, y0, args = BODY

    # Apart, as XLA takes minutes for Dopri8 in one piece outside of a loop.
    @jax.jit
    def step(h):
        return problems.first_step(solver, cfjax.LieTerm(field), 0 * h, h, y0, args)[2]

    @jax.jit
    def point(info, h, theta):
        return solver.interpolation_cls(t0=0 * h, t1=h, **info).evaluate(theta * h)

    errors = []
    for n in steps:
        h = 1 / (4 * n)
        answer = solve_ivp(
            lambda t, y: problems.driven_body_ode(t, y, problems.INERTIA),
            (0, h),
            problems.MOMENTUM,
            method="DOP853",
            rtol=2.3e-14,
            atol=1e-16,
            t_eval=thetas * h,
        ).y.T
        info = step(jnp.asarray(h))
        found = [point(info, jnp.asarray(h), jnp.asarray(theta)) for theta in thetas]
        errors.append(np.linalg.norm(np.array(found) - answer))
    errors = np.array(errors)
    kept = errors > 3e-15
    assert kept.sum() >= 3
    slope = problems.slope(steps[kept], errors[kept])
    assert abs(slope - (order + 1)) < 0.15


def test_output_of_substeps_of_several_kinds():
    """Each has the same part of the time, and the first and the last what is outside of the step.

    Here all are linear.
    """
    ends = np.array([0.0, 1.0, 3.0, 7.0])
    linear, cubic = (
        diffrax.LocalLinearInterpolation,
        diffrax.ThirdOrderHermitePolynomialInterpolation,
    )
    path = Substeps(
        [
            linear(t0=0.0, t1=0.2, **problems.arrays({"y0": 0.0, "y1": 1.0})),
            cubic(t0=0.2, t1=0.5, **problems.arrays({"y0": 1.0, "y1": 3.0, "k0": 2.0, "k1": 2.0})),
            linear(t0=0.5, t1=0.6, **problems.arrays({"y0": 3.0, "y1": 7.0})),
        ]
    )
    thetas = np.array([-0.1, 0.1, 0.3, 0.4, 0.5, 0.6, 0.7, 0.9, 1.1])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(path.point)))(thetas)
    part = np.clip(np.floor(3 * thetas), 0, 2).astype(int)
    rates = np.diff(ends)[part]
    # Some roundings of numbers up to 10.
    expected = ends[part] + (3 * thetas - part) * rates
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(slopes, 3 * rates, rtol=0, atol=1e-13)


# The output of Richardson's steps is that of its substeps, which is that of CF2.
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "Richardson")) for name in SOLVERS],
)
def test_derivatives_in_time_within_a_step_and_at_both_ends(name):
    """Against differences of the output, of times before, and at the start of times after it."""
    row, h = SOLVERS[name], 0.25
    solver, (term, y0) = row.make(), problem_for(row.takes)
    y0, args = jnp.asarray(y0), jnp.asarray([0.5, -0.4, 0.9])
    # The derivative of a polynomial through five points.
    d, weights = h / 1000, np.array([25, -48, 36, -16, 3]) / 12
    times = h * np.array([0.0, 0.3, 0.5, 1.0])
    steps = d * np.array([1, -1, -1, -1])
    near = times + np.arange(5)[:, None] * steps

    @jax.jit
    def output(h):
        info = problems.first_step(solver, term, 0 * h, h, y0, args)[2]
        path = solver.interpolation_cls(t0=0 * h, t1=h, **info)
        return jax.vmap(path.derivative)(times), jax.vmap(jax.vmap(path.evaluate))(near)

    found, values = map(np.asarray, output(jnp.asarray(h)))
    slopes = -np.tensordot(weights, values, 1) / steps.reshape(-1, *[1] * y0.ndim)
    # Rounding: weights of 3e4 cancel in the output of Magnus10, so values have it of 2e-13, times
    # the 10 of all weights here, over d. The difference itself is off by d^4 / 5 times a fifth
    # derivative, of flows that turn at rates of 1.
    np.testing.assert_allclose(found, slopes, rtol=0, atol=1e-8)
    assert np.abs(slopes).max(axis=tuple(range(1, slopes.ndim))).min() > 1e-4


FRAME = np.linalg.qr(np.random.default_rng(1).standard_normal((12, 2)))[0]
SCALE = np.linspace(1.0, 2.0, 12)[:, None]


def frame_field(t, y, args):
    return cfjax.LowRankSkew(jnp.cos(t) * SCALE * y + jnp.roll(y, 1, axis=0))


def frame_ode(t, y):
    y = y.reshape(12, 2)
    g = np.cos(t) * SCALE * y + np.roll(y, 1, axis=0)
    return ((g @ y.T - y @ g.T) @ y).ravel()


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF2", "RKMK4", "CayleyRK4", "CK54"])
def test_the_error_between_the_steps_of_a_frame(name):
    """As above."""
    solver = getattr(cfjax, name)()
    steps, thetas = np.array([4, 8, 16, 32]), np.array([0.21, 0.5, 0.83, 1.0])

    @functools.partial(jax.jit, compiler_options=problems.QUICK)
    def points(h):
        y0, times = jnp.asarray(FRAME), (jnp.asarray(0.0), h)
        info = problems.first_step(solver, cfjax.LieTerm(frame_field), *times, y0, None)[2]
        path = solver.interpolation_cls(t0=times[0], t1=times[1], **info)
        return jax.vmap(path.evaluate)(h * thetas)

    errors = []
    for n in steps:
        h = 1 / (4 * n)
        found = np.asarray(points(jnp.asarray(h)))
        for y in found:
            np.testing.assert_allclose(y.T @ y, np.eye(2), rtol=0, atol=1e-14)
        answer = [problems.reference(frame_ode, 0.0, s * h, FRAME.ravel()) for s in thetas[:3]]
        errors.append(np.linalg.norm(np.reshape(answer, (3, 12, 2)) - found[:3]))
    assert errors[-1] > 10 * problems.REFERENCE_ERROR
    assert abs(problems.slope(steps, errors) - (SOLVERS[name].output + 1)) < 0.15


@pytest.mark.slow
def test_frames_in_coordinates_of_their_own():
    """Low-rank fields share the columns of a step, also after diffrax has stored them."""
    y0, t = jnp.asarray(FRAME), 0.637
    answer = problems.reference(frame_ode, 0.0, t, FRAME.ravel()).reshape(12, 2)
    errors = []
    for n in (20, 40):
        sol = dense(cfjax.CF4(), n, frame_field, y0, None)
        found = np.asarray(sol.evaluate(t))
        np.testing.assert_allclose(found.T @ found, np.eye(2), rtol=0, atol=1e-14)
        errors.append(np.linalg.norm(found - answer))
    assert errors[1] < 1e-6 and errors[0] < 1e-4
    arrays = jtu.tree_leaves(sol.interpolation.infos["path"])
    # The frame, and g of five evaluations: none of them twice.
    assert sum(leaf.shape[1:] == (12, 2) for leaf in arrays) <= 7


@pytest.mark.slow
def test_gradients_through_output_between_steps():
    field, y0, args = BODY

    def saved(y0):
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            cfjax.CF4(),
            *(0.0, 1.0, 0.25, y0, args),
            max_steps=4,
            saveat=diffrax.SaveAt(ts=jnp.asarray([0.3, 0.61])),
        )
        return jnp.sum(jnp.sin(sol.ys))

    gradient = jax.jit(jax.grad(saved))(y0)
    direction = problems.random_like(y0, 3)
    # 1e-3: the difference is good to 1e-12 and 1e-13 of rounding.
    expected = problems.central_difference(jax.jit(saved), y0, direction, 1e-3)
    assert abs(problems.inner(gradient, direction) - expected) < 1e-10
