"""Output within the steps: observed orders, the manifold, the nodes, events.

The order conditions of its coefficients are in methods/test_order_conditions.py.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
import problems
import pytest
from scipy.integrate import solve_ivp
from solver_table import COMMUTATOR_FREE, MUNTHE_KAAS, SOLVERS, named, problem_for

import cfjax

# `RKMK5` and `RKMK8` are Tsit5 and Dopri8.
METHODS = named("commutator-free", "low-storage") | MUNTHE_KAAS
METHODS |= {name: COMMUTATOR_FREE[name] for name in ("family A, 1/2", "family B, 2/3")}
METHODS |= {name: SOLVERS[name] for name in ("RKMK3", "RKMK4")}
BODY = problems.driven_body, jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)


def test_output_within_a_step_is_a_short_program():
    """What compiles it grows with the operations; an event's root finder differentiates them."""
    solver, (field, y0, args) = cfjax.CF54(), BODY
    term = cfjax.LieTerm(field)
    info: Any = problems.first_step(solver, term, jnp.asarray(0.0), jnp.asarray(0.1), y0, args)[2]

    def within(t):
        return solver.interpolation_cls(t0=jnp.asarray(0.0), t1=jnp.asarray(0.1), **info).evaluate(
            t
        )

    # 8 flows of 8 stages, whose weights have 5 powers of the time: 832 number by number, else 197.
    assert problems.num_operations(jax.make_jaxpr(within)(0.05).jaxpr) < 250


def dense(solver, n, field, y0, args, t1=1.0, **kwargs):
    return diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        solver,
        0.0,
        t1,
        t1 / n,
        y0,
        args,
        max_steps=n + 1,
        saveat=diffrax.SaveAt(dense=True),
        **kwargs,
    )


# The errors of Dopri8 are at rounding after two of these steps, so its own are longer.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in ("CF4", "RKMK4")))
        for name in METHODS
    ],
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["CF4", "CK54", "RKMK4", pytest.param("CF54", marks=pytest.mark.slow)]
)
def test_random_times_are_on_the_manifold_and_nodes_are_the_steps(name):
    solver = METHODS[name].make()
    field, y0, args = BODY
    n = 8
    sol = dense(solver, n, field, y0, args)
    times = np.random.default_rng(0).uniform(0, 1, 200)
    ys = jax.vmap(sol.evaluate)(jnp.asarray(times))
    lengths = np.linalg.norm(ys, axis=1)
    assert np.abs(lengths - np.linalg.norm(y0)).max() < 1e-13
    problem = cfjax.LieTerm(field), solver, 0.0, 1.0, 1 / n, y0, args
    at_steps = diffrax.SaveAt(t0=True, steps=True)
    steps = diffrax.diffeqsolve(*problem, saveat=at_steps, max_steps=n)
    for left in (True, False):
        for t, y in zip(steps.ts, steps.ys, strict=True):
            # The same flows in another order of rounding.
            np.testing.assert_allclose(sol.evaluate(t, left=left), y, rtol=0, atol=1e-14)
    at_times = diffrax.SaveAt(ts=jnp.sort(jnp.asarray(times)))
    saved = diffrax.diffeqsolve(*problem, saveat=at_times, max_steps=n)
    np.testing.assert_allclose(saved.ys, ys[np.argsort(times)], rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, direction", [pytest.param("CF3", 1, marks=pytest.mark.slow), ("CF4", -1)]
)
def test_derivatives_in_time(name, direction):
    solver, order = METHODS[name].make(), METHODS[name].output
    field, y0, args = BODY
    n = 16
    sol = dense(solver, n, field, y0, args, t1=float(direction))
    for t in (0.0, 0.03, 0.5, 0.97, 1.0):
        t = direction * t
        h = 1e-3 / n
        found = sol.derivative(t)
        # The velocity of the field at the point: to the order of the continuous extension.
        w = problems.driven_body_ode(t, np.asarray(sol.evaluate(t)), problems.INERTIA)
        np.testing.assert_allclose(found, w, rtol=0, atol=3 * (1 / n) ** order)
        if 0 < abs(t) < 1 and t * n % 1:
            change = [sol.evaluate(t + k * h) for k in (-2, -1, 1, 2)]
            slope = ((change[0] - change[3]) - 8 * (change[1] - change[2])) / (12 * h)
            np.testing.assert_allclose(found, slope, rtol=0, atol=1e-9)


# Quick tests of those whose output is that of their substeps.
SUBSTEPS = "Richardson", "Composition", "WeakOrder2"


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name not in SUBSTEPS)) for name in SOLVERS],
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


@pytest.mark.slow
def test_a_product_of_manifolds():
    y0, args = problems.arrays(problems.FLIGHT_START), problems.arrays(problems.FLIGHT_ARGS)
    sol = dense(cfjax.CF4(), 32, problems.body_in_flight, y0, args)
    t = 0.517
    answer = problems.reference(
        lambda t, y: problems.body_in_flight_ode(t, y, problems.FLIGHT_ARGS),
        0.0,
        t,
        problems.flat(problems.FLIGHT_START),
    )
    found = sol.evaluate(t)
    np.testing.assert_allclose(problems.flat(found), answer, rtol=0, atol=1e-6)
    q = np.asarray(found["attitude"])
    np.testing.assert_allclose(q.T @ q, np.eye(3), rtol=0, atol=1e-14)


FRAME = np.linalg.qr(np.random.default_rng(1).standard_normal((12, 2)))[0]
SCALE = np.linspace(1.0, 2.0, 12)[:, None]


def frame_field(t, y, args):
    return cfjax.LowRankSkew(jnp.cos(t) * SCALE * y + jnp.roll(y, 1, axis=0))


def frame_ode(t, y):
    y = y.reshape(12, 2)
    g = np.cos(t) * SCALE * y + np.roll(y, 1, axis=0)
    return ((g @ y.T - y @ g.T) @ y).ravel()


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "name", ["RKMK4", "CayleyRK4", pytest.param("CK54", marks=pytest.mark.slow)]
)
def test_the_error_between_the_steps_of_a_frame(name):
    """As above: of order 3 within a step."""
    solver = getattr(cfjax, name)()
    steps, thetas = np.array([4, 8, 16, 32]), np.array([0.21, 0.5, 0.83])

    @jax.jit
    def points(h):
        y0, times = jnp.asarray(FRAME), (jnp.asarray(0.0), h)
        info = problems.first_step(solver, cfjax.LieTerm(frame_field), *times, y0, None)[2]
        path = solver.interpolation_cls(t0=times[0], t1=times[1], **info)
        return jax.vmap(path.evaluate)(h * thetas), path.evaluate(h)

    errors = []
    for n in steps:
        h = 1 / (4 * n)
        found, end = points(jnp.asarray(h))
        for y in (*found, end):
            np.testing.assert_allclose(y.T @ y, np.eye(2), rtol=0, atol=1e-14)
        answer = [problems.reference(frame_ode, 0.0, s * h, FRAME.ravel()) for s in thetas]
        errors.append(np.linalg.norm(np.array(answer).reshape(3, 12, 2) - np.asarray(found)))
    assert errors[-1] > 10 * problems.REFERENCE_ERROR
    assert abs(problems.slope(steps, errors) - 4) < 0.15


@pytest.mark.slow
def test_frames_in_coordinates_of_their_own():
    """Low-rank fields share the columns of a step, also after diffrax has stored them."""
    y0, field = jnp.asarray(FRAME), frame_field
    t = 0.637
    answer = problems.reference(frame_ode, 0.0, t, FRAME.ravel()).reshape(12, 2)
    errors = []
    for n in (20, 40):
        sol = dense(cfjax.CF4(), n, field, y0, None)
        found = np.asarray(sol.evaluate(t))
        np.testing.assert_allclose(found.T @ found, np.eye(2), rtol=0, atol=1e-14)
        errors.append(np.linalg.norm(found - answer))
    assert errors[1] < 1e-6 and errors[0] < 1e-4
    arrays = jtu.tree_leaves(sol.interpolation.infos["path"])
    # The frame, and g of five evaluations: none of them twice.
    assert sum(leaf.shape[1:] == (12, 2) for leaf in arrays) <= 7
    adaptive = diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        cfjax.CF4(),
        0.0,
        t,
        0.1,
        y0,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-8),
    )
    assert np.linalg.norm(adaptive.ys[-1] - answer) < 1e-6


# Events: a pendulum on the sphere, position q and angular velocity w


def pendulum(t, y, gravity):
    torque = gravity * jnp.stack([-y["q"][1], y["q"][0], jnp.zeros(())])
    return {"q": cfjax.Rotation(y["w"]), "w": torque}


def pendulum_ode(gravity):
    def ode(t, y):
        q, w = y[:3], y[3:]
        return np.concatenate([np.cross(w, q), gravity * np.array([-q[1], q[0], 0.0])])

    return ode


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CF4"])
def test_a_pendulum_passes_a_plane_on_the_sphere_at_the_right_time(name):
    gravity = 2.0
    y0 = {"q": jnp.asarray([0.6, 0.0, -0.8]), "w": jnp.asarray([0.3, 1.0, 0.2])}

    def height(t, y, args, **kwargs):
        return y["q"][1] - 0.25

    def crossing(t, y):
        return y[1] - 0.25

    crossing.terminal = True
    answer = solve_ivp(
        pendulum_ode(gravity),
        (0, 20),
        problems.flat(y0),
        method="DOP853",
        rtol=2.3e-14,
        atol=1e-15,
        events=crossing,
    )
    time = answer.t_events[0][0]
    event = diffrax.Event(height, optx.Newton(rtol=1e-12, atol=1e-12))
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(pendulum),
        METHODS[name].make(),
        0.0,
        20.0,
        0.01,
        y0,
        jnp.asarray(gravity),
        event=event,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-10),
        max_steps=10_000,
    )
    assert sol.result == diffrax.RESULTS.event_occurred
    # The error of the solution at this tolerance; the root itself is found to 1e-12.
    assert abs(float(sol.ts[-1]) - time) < 1e-8
    assert abs(float(sol.ys["q"][-1, 1]) - 0.25) < 1e-11
    assert abs(np.linalg.norm(sol.ys["q"][-1]) - 1) < 1e-14


@pytest.mark.slow
def test_gradients_through_output_between_steps():
    field, y0, args = BODY

    def saved(y0):
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            cfjax.CF4(),
            0.0,
            1.0,
            0.25,
            y0,
            args,
            max_steps=4,
            saveat=diffrax.SaveAt(ts=jnp.asarray([0.3, 0.61])),
        )
        return jnp.sum(jnp.sin(sol.ys))

    gradient = jax.jit(jax.grad(saved))(y0)
    direction = problems.random_like(y0, 3)
    # 1e-3: the difference is good to 1e-12 and 1e-13 of rounding.
    expected = problems.central_difference(jax.jit(saved), y0, direction, 1e-3)
    assert abs(problems.inner(gradient, direction) - expected) < 1e-10
