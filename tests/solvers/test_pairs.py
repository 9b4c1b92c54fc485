"""Embedded pairs: the estimate, its blind spots, and what it costs.

That an estimate is what the embedded method says is in test_step.py, for every pair, and its
order in methods/test_order_conditions.py.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from solver_table import named

import cfjax

METHODS = {name: row for name, row in named("commutator-free").items() if row.embedded}
PAIRS: dict[str, Any] = {name: row.make() for name, row in METHODS.items()}
pairs = pytest.mark.parametrize("name", PAIRS)
Y0, INERTIA = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)


def solver_of(name, estimate="group"):
    return type(PAIRS[name])(estimate=estimate)


def solve_with(solver, field, y0, t1):
    """A program of the tolerance, the first step and the parameters of the field."""

    @jax.jit
    def solve(atol, dt0, args):
        return diffrax.diffeqsolve(
            *(cfjax.LieTerm(field), solver, 0.0, t1, dt0, jnp.asarray(y0), args),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=atol),
            max_steps=100_000,
        )

    return lambda atol, args=None, dt0=0.01: solve(*problems.arrays((atol, dt0, args)))


# The estimate


def test_an_estimate_of_no_kind_is_an_error(no_shape_hook):
    with pytest.raises(ValueError, match="estimate must be 'group', 'algebra' or None, got 'x'"):
        cfjax.CF4(estimate="x")  # pyright: ignore[reportArgumentType]


def test_without_an_estimate_error_control_is_refused():
    with pytest.raises(RuntimeError, match="error estimate"):
        solve_with(solver_of("CF4", None), problems.rigid_body, Y0, 1.0)(1e-3, INERTIA)


# Problems on which a bad estimate is blind. Answers: closed form, and SciPy.

LANDAU_ZENER = np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 0.0]])


def landau_zener(t, y, args):
    """Linear in time and independent of the state: all of the error is in commutators."""
    return cfjax.Rotation(args[0] + t * args[1])


ON_SPHERE = np.array([0.6, 0.0, 0.8])


@pytest.fixture(scope="module")
def landau_zener_answer():
    ode = lambda t, y: np.cross(LANDAU_ZENER[0] + t * LANDAU_ZENER[1], y)  # noqa: E731
    return problems.reference(ode, 0.0, 2.0, ON_SPHERE)


@pytest.mark.representatives(1)
@pairs
def test_the_group_estimate_sees_an_error_of_commutators_alone(name, landau_zener_answer):
    solve = solve_with(PAIRS[name], landau_zener, ON_SPHERE, 2.0)
    for atol in (1e-4, 1e-7):
        error = np.linalg.norm(solve(atol, LANDAU_ZENER).ys[-1] - landau_zener_answer)
        assert 1e-4 * atol < error < 30 * atol


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CF3", "CF2", "CF4", "CF54"])
def test_the_estimate_in_the_algebra_is_blind_to_commutators_alone(name, landau_zener_answer):
    y0, args = jnp.asarray(ON_SPHERE), jnp.asarray(LANDAU_ZENER)

    @jax.jit
    def estimate(y0):
        times, term = (jnp.asarray(0.3), jnp.asarray(0.8)), cfjax.LieTerm(landau_zener)
        return problems.first_step(solver_of(name, "algebra"), term, *times, y0, args)[1]

    blind = np.linalg.norm(estimate(y0))
    if name in ("CF2", "CF4"):
        # The embedded method of the one is of order 1, and sees that the field changes at all. That
        # of the other sees that its last stage is apart from the end.
        assert blind > 1e-4
    else:
        # Rounding of coefficients up to 1.3 times a field of size 3.
        assert blind < 1e-15 * 30
        # So no error stops the steps from growing.
        sol = solve_with(solver_of(name, "algebra"), landau_zener, y0, 2.0)(1e-7, args)
        assert np.linalg.norm(sol.ys[-1] - landau_zener_answer) > 1e-5


@pytest.mark.representatives(1)
@pytest.mark.parametrize("estimate", ["group", "algebra"])
def test_a_weak_dependence_on_the_state_hides_no_error(estimate):
    """CF4's embedded method sees how the field changes with the state: here next to nothing."""

    def field(t, y, rate):
        return 3 * jnp.cos(5 * t) - rate * y

    solve = solve_with(solver_of("CF4", estimate), field, [0.5], 2.0)
    for rate in (0.0, 1e-6, 1e-4, 1e-2):
        driven = lambda t: 3 * (rate * np.cos(5 * t) + 5 * np.sin(5 * t)) / (25 + rate**2)  # noqa: B023, E731
        exact = (0.5 - driven(0.0)) * np.exp(-2 * rate) + driven(2.0)
        sol = solve(1e-6, rate)
        # Some 40 steps of at most the tolerance each, of either sign. A blind estimate let 4 to 20
        # steps pass, with up to 360 000 times the tolerance.
        assert abs(float(sol.ys[-1, 0]) - exact) < 10 * 1e-6
        assert sol.stats["num_accepted_steps"] > 30


# Error control, and first same as last


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF4", "CF3", "CF43", "CF54"])
def test_error_per_tolerance_is_steady(name):
    """A method that is first same as last evaluates once at the start, and never twice there."""
    calls = []

    def field(t, y, args):
        jax.debug.callback(lambda: calls.append(None))
        return problems.driven_body(t, y, args)

    def check_evaluations(sol):
        jax.effects_barrier()
        row, num_steps = METHODS[name], int(sol.stats["num_steps"])
        assert len(calls) == row.first + row.evaluations * num_steps
        calls.clear()

    ode = lambda t, y: problems.driven_body_ode(t, y, problems.INERTIA)  # noqa: E731
    answer = problems.reference(ode, 0.0, 5.0, problems.MOMENTUM)
    solve, ratios = solve_with(PAIRS[name], field, Y0, 5.0), []
    for atol in [1e-4, 1e-6, 1e-8, 1e-10][: 2 if name == "CF3" else 4]:
        sol = solve(atol, INERTIA)
        check_evaluations(sol)
        ratios.append(np.linalg.norm(sol.ys[-1] - answer) / atol)
    assert max(ratios) < 10 * min(ratios)
    assert max(ratios) < 20
    # The first step is far too long, so some are rejected.
    sol = solve(1e-6, INERTIA, dt0=1.0)
    assert sol.stats["num_rejected_steps"] > 0
    check_evaluations(sol)


def test_a_kept_evaluation_is_discarded_after_a_jump():
    solver, term = cfjax.CF4(), cfjax.LieTerm(problems.driven_body)

    @jax.jit
    def ends(y0, jump):
        times = jnp.asarray(0.0), jnp.asarray(0.1)
        fresh = solver.init(term, *times, y0, INERTIA)
        stale = eqx.tree_at(lambda state: state.first.omega, fresh, replace_fn=lambda x: x + 1)
        return [
            solver.step(term, *times, y0, INERTIA, state, made_jump=made_jump)[0]
            for state, made_jump in ((fresh, False), (stale, False), (stale, True), (stale, jump))
        ]

    right, wrong, *found = ends(Y0, True)
    assert np.linalg.norm(wrong - right) > 1e-3
    problems.assert_close(found, [right, right], 1e-15)
