"""Embedded pairs: the estimate, its blind spots, and what it costs."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp
from solver_table import named

import cfjax

METHODS = {name: row for name, row in named("commutator-free").items() if row.embedded}
PAIRS: dict[str, Any] = {name: row.make() for name, row in METHODS.items()}
pairs = pytest.mark.parametrize("name", PAIRS)
estimates = pytest.mark.parametrize("estimate", ["group", "algebra"])
ABSOLUTE = dict(rtol=0.0)


def solver_of(name, estimate="group"):
    return type(PAIRS[name])(estimate=estimate)


def one_step(solver, field, y0, h, args=None, t0=0.3) -> Any:
    """A jitted step: its end and its estimate."""

    @jax.jit
    def step(y0, h):
        times = jnp.asarray(t0), jnp.asarray(t0) + h
        return problems.first_step(solver, cfjax.LieTerm(field), *times, y0, args)[:2]

    return step(problems.arrays(y0), jnp.asarray(h))


def solve(solver, field, y0, t1, atol, args=None, dt0=0.01, t0=0.0, **kwargs):
    kwargs.setdefault("stepsize_controller", diffrax.PIDController(atol=atol, **ABSOLUTE))
    return diffrax.diffeqsolve(
        cfjax.LieTerm(field), solver, t0, t1, dt0, y0, args, max_steps=100_000, **kwargs
    )


# The estimate


@pairs
def test_the_embedded_method_has_the_order_below(name):
    tableau, order = PAIRS[name].tableau, METHODS[name].embedded
    assert cfjax.order(tableau.embedded_method) == order == cfjax.order(tableau) - 1
    assert PAIRS[name].error_order(None) == cfjax.order(tableau)


@pytest.mark.slow
@pairs
@estimates
def test_the_estimate_falls_with_the_order_of_the_embedded_method(name, estimate):
    """On a group that does not commute, in state and time: like h^p."""
    # Longer steps at order 5, whose estimate would else meet rounding.
    steps = np.array([1 / 8, 1 / 16, 1 / 32]) / (1 if name == "CF54" else 4)
    problem = problems.driven_body, problems.MOMENTUM
    args = jnp.asarray(problems.INERTIA)
    step = jax.jit(lambda h: one_step(solver_of(name, estimate), *problem, h, args)[1])
    sizes = [np.linalg.norm(step(h)) for h in steps]
    # Ten times above the rounding of a step.
    assert min(sizes) > 1e-14
    slope = problems.slope(1 / steps, np.array(sizes))
    assert abs(slope - cfjax.order(PAIRS[name].tableau)) < 0.15


@pytest.mark.slow
@pairs
def test_the_estimate_is_the_distance_from_the_embedded_method(name):
    """The embedded method as a method of its own takes the step from scratch."""
    solver = PAIRS[name]
    embedded = cfjax.CommutatorFree(solver.tableau.embedded_method)
    problem = problems.driven_body, problems.MOMENTUM, 0.25, jnp.asarray(problems.INERTIA)
    if name == "CF4":
        problem = problems.body_in_flight, problems.FLIGHT_START, 0.25, problems.FLIGHT_ARGS
    end, error = one_step(solver, *problem)
    expected = jtu.tree_map(jnp.subtract, end, one_step(embedded, *problem)[0])
    # A few flows of entries of order 1.
    problems.assert_close(error, expected, 1e-14)


def test_an_estimate_of_no_kind_is_an_error(no_shape_hook):
    with pytest.raises(ValueError, match="estimate must be 'group', 'algebra' or None, got 'x'"):
        cfjax.CF4(estimate="x")  # pyright: ignore[reportArgumentType]


@pytest.mark.representatives(2)
@pairs
def test_without_an_estimate_error_control_is_refused(name):
    with pytest.raises(RuntimeError, match="error estimate"):
        solve(solver_of(name, None), problems.rigid_body, jnp.ones(3), 1.0, 1e-3, jnp.ones(3))


# Problems on which a bad estimate is blind. Answers: closed form, and SciPy.


def logistic(t, y, args):
    """Commutes with itself at every point: translations of a line."""
    return y * (1 - y)


LANDAU_ZENER = np.array([[0.0, 0.0, 1.0], [3.0, 0.0, 0.0]])


def landau_zener(t, y, args):
    """Linear in time and independent of the state: all of the error is in commutators."""
    return cfjax.Rotation(args[0] + t * args[1])


@pytest.fixture(scope="module")
def landau_zener_answer():
    def ode(t, y):
        return np.cross(LANDAU_ZENER[0] + t * LANDAU_ZENER[1], y)

    return problems.reference(ode, 0.0, 2.0, np.array([0.6, 0.0, 0.8]))


@pytest.mark.representatives(1)
@pairs
def test_the_group_estimate_sees_an_error_of_commuting_fields(name):
    exact = 1 / (1 + 9 * np.exp(-2.0))
    for atol in (1e-4, 1e-7):
        sol = solve(PAIRS[name], logistic, jnp.asarray([0.1]), 2.0, jnp.asarray(atol))
        # Some steps with an error of atol at most each, and by far less in fact.
        assert 1e-4 * atol < abs(float(sol.ys[-1, 0]) - exact) < 10 * atol


@pytest.mark.representatives(1)
@pairs
def test_the_group_estimate_sees_an_error_of_commutators_alone(name, landau_zener_answer):
    y0, args = jnp.asarray([0.6, 0.0, 0.8]), jnp.asarray(LANDAU_ZENER)
    for atol in (1e-4, 1e-7):
        sol = solve(PAIRS[name], landau_zener, y0, 2.0, jnp.asarray(atol), args)
        error = np.linalg.norm(sol.ys[-1] - landau_zener_answer)
        assert 1e-4 * atol < error < 30 * atol


@pytest.mark.representatives(1)
@pairs
def test_the_estimate_in_the_algebra_is_blind_to_commutators_alone(name, landau_zener_answer):
    y0, args = jnp.asarray([0.6, 0.0, 0.8]), jnp.asarray(LANDAU_ZENER)
    blind = one_step(solver_of(name, "algebra"), landau_zener, y0, 0.5, args)[1]
    seen = one_step(solver_of(name, "group"), landau_zener, y0, 0.5, args)[1]
    if name in ("CF2", "CF4"):
        # The embedded method of the one is of order 1, and sees that the field changes at all. That
        # of the other sees that its last stage is apart from the end.
        assert np.linalg.norm(blind) > 1e-4
    else:
        # Rounding of coefficients up to 1.3 times a field of size 3.
        assert np.linalg.norm(blind) < 1e-15 * 30
    assert np.linalg.norm(seen) > 1e-5
    # So no error stops the steps from growing.
    if name not in ("CF2", "CF4"):
        sol = solve(solver_of(name, "algebra"), landau_zener, y0, 2.0, 1e-7, args)
        assert np.linalg.norm(sol.ys[-1] - landau_zener_answer) > 1e-5


@pytest.mark.representatives(1)
@pytest.mark.parametrize("estimate", ["group", "algebra"])
def test_a_weak_dependence_on_the_state_hides_no_error(estimate):
    """CF4's embedded method sees how the field changes with the state: here next to nothing."""

    def field(t, y, rate):
        return 3 * jnp.cos(5 * t) - rate * y

    for rate in (0.0, 1e-6, 1e-4, 1e-2):
        driven = lambda t: 3 * (rate * np.cos(5 * t) + 5 * np.sin(5 * t)) / (25 + rate**2)  # noqa: B023, E731
        exact = (0.5 - driven(0.0)) * np.exp(-2 * rate) + driven(2.0)
        sol = solve(
            solver_of("CF4", estimate),
            field,
            jnp.asarray([0.5]),
            2.0,
            jnp.asarray(1e-6),
            jnp.asarray(rate),
        )
        # Some 40 steps of at most the tolerance each, of either sign. A blind estimate let 4 to 20
        # steps pass, with up to 360 000 times the tolerance.
        assert abs(float(sol.ys[-1, 0]) - exact) < 10 * 1e-6
        assert sol.stats["num_accepted_steps"] > 30


@pytest.mark.slow
def test_the_estimate_of_cf4_where_the_field_does_not_depend_on_part_of_the_state():
    """CF4's embedded method differs by f(y1) only: no help where the field sees no state."""

    def field(t, y, args):
        return {"driven": cfjax.Rotation(jnp.stack([t, jnp.cos(t), t * t])), "free": -y["free"]}

    y0 = {"driven": jnp.eye(3), "free": jnp.ones(2)}

    def ode(t, y):
        w = np.array([t, np.cos(t), t * t])
        return np.cross(w, y.reshape(3, 3).T).T.ravel()

    exact = problems.reference(ode, 0.0, 2.0, np.eye(3).ravel()).reshape(3, 3)
    for atol in (1e-3, 1e-6):
        sol = solve(cfjax.CF4(), field, y0, 2.0, jnp.asarray(atol))
        assert np.linalg.norm(sol.ys["driven"][-1] - exact) < 10 * atol
        assert np.linalg.norm(sol.ys["free"][-1] - np.exp(-2.0)) < 10 * atol


# First same as last


class Counter:
    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1


def counted(field, counter):
    def counted_field(t, y, args):
        jax.debug.callback(counter)
        return field(t, y, args)

    return counted_field


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", ["CF4", "CF54", "CF3"])
def test_evaluations_with_accepted_and_rejected_steps(name):
    """A method that is first same as last evaluates once at the start, and never twice there."""
    counter = Counter()
    y0, inertia = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
    field = counted(problems.driven_body, counter)
    # The first step is far too long, so some are rejected.
    sol = solve(PAIRS[name], field, y0, 2.0, 1e-6, inertia, dt0=1.0)
    jax.effects_barrier()
    assert sol.stats["num_rejected_steps"] > 0
    row, num_steps = METHODS[name], int(sol.stats["num_steps"])
    assert counter.count == row.first + row.evaluations * num_steps


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF3", "CF4", "CF43", "CF54"])
def test_steps_over_a_jump(name):
    """The field changes at t = 0.7: what was evaluated before says nothing of after."""
    jump = 0.7

    def field(t, y, args):
        drive = jnp.where(t < jump, 1.0, -2.0) * jnp.asarray([0.3, 1.0, 0.2])
        return cfjax.Rotation(drive - y / args)

    def ode(sign):
        return lambda t, y: np.cross(sign * np.array([0.3, 1.0, 0.2]) - y / problems.INERTIA, y)

    middle = problems.reference(ode(1.0), 0.0, jump, problems.MOMENTUM)
    exact = problems.reference(ode(-2.0), jump, 2.0, middle)
    y0, inertia = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
    inner = diffrax.PIDController(atol=1e-9, **ABSOLUTE)
    controller = diffrax.ClipStepSizeController(inner, jump_ts=jnp.asarray([jump]))
    sol = solve(PAIRS[name], field, y0, 2.0, 1e-9, inertia, stepsize_controller=controller)
    assert np.linalg.norm(sol.ys[-1] - exact) < 1e-7
    # With the jump known it is no harder than without one.
    assert sol.stats["num_rejected_steps"] <= 5


def test_a_kept_evaluation_is_discarded_after_a_jump():
    solver, term = cfjax.CF4(), cfjax.LieTerm(problems.driven_body)
    y0, inertia = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
    times = jnp.asarray(0.0), jnp.asarray(0.1)
    fresh = solver.init(term, *times, y0, inertia)
    stale = eqx.tree_at(lambda state: state.first.omega, fresh, replace_fn=lambda x: x + 1)
    right = solver.step(term, *times, y0, inertia, fresh, made_jump=False)[0]
    wrong = solver.step(term, *times, y0, inertia, stale, made_jump=False)[0]
    assert np.linalg.norm(wrong - right) > 1e-3
    for jump in (True, jnp.asarray(True)):
        found = solver.step(term, *times, y0, inertia, stale, made_jump=jump)[0]
        np.testing.assert_allclose(found, right, rtol=0, atol=1e-15)


# Error control


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF3", "CF4", "CF43", "CF54"])
def test_error_per_tolerance_is_steady(name):
    y0, inertia = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
    answer = solve_ivp(
        lambda t, y: problems.driven_body_ode(t, y, problems.INERTIA),
        (0, 5),
        problems.MOMENTUM,
        method="DOP853",
        rtol=2.3e-14,
        atol=1e-15,
    ).y[:, -1]
    tolerances = [1e-4, 1e-6, 1e-8, 1e-10][: 2 if name == "CF3" else 4]
    ratios = []
    for atol in tolerances:
        sol = solve(PAIRS[name], problems.driven_body, y0, 5.0, jnp.asarray(atol), inertia)
        ratios.append(np.linalg.norm(sol.ys[-1] - answer) / atol)
    assert max(ratios) < 10 * min(ratios)
    assert max(ratios) < 20


@pytest.mark.slow
def test_both_estimates_of_cf4_have_one_size_for_a_matrix_to_leading_order():
    """Where steps are compensated sums. The signs differ, which no controller sees."""
    args = jnp.asarray(problems.GENERATORS)

    def difference(h):
        sizes = []
        for estimate in ("group", "algebra"):
            solver, term = solver_of("CF4", estimate), cfjax.LieTerm(problems.left_matrix)
            y0 = jnp.asarray(problems.ORTHOGONAL)
            t0, t1 = jnp.asarray(0.3), jnp.asarray(0.3 + h)
            state = solver.init(term, t0, t1, y0, args)
            error = solver.step(term, t0, t1, y0, args, state, made_jump=False)[1]
            sizes.append(jnp.linalg.norm(error))
        group, algebra = sizes
        return jnp.abs(group - algebra) / group

    large, small = jax.jit(jax.vmap(difference))(jnp.array([1 / 8, 1 / 32]))
    # The relative difference falls at least like h.
    assert small < large / 3 and small < 0.1
