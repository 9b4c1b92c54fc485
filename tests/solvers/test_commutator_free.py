"""Commutator-free methods: order, stage times, cost, and what they reduce to in simple cases."""

import functools
import itertools
import math
from fractions import Fraction
from typing import Any

import diffrax
import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from solver_table import COMMUTATOR_FREE, named

import cfjax

ROWS = named("commutator-free") | COMMUTATOR_FREE
METHODS: dict[str, Any] = {name: row.make() for name, row in ROWS.items()}

# The step is small enough that the next order adds at most 0.1 to the slope, and the errors,
# 1e-12 at least, stay 10 times above those of the reference.
STEPS = (16, 32, 64, 128)
TOLERANCE = 0.15


def observed_order(problem, solver, steps=STEPS, **kwargs) -> float:
    field, y0, args, answer = problem
    found = problems.errors(field, solver, 1.0, y0, args, answer, steps, **kwargs)
    assert found.min() > 10 * problems.REFERENCE_ERROR
    assert found.max() < 1
    return problems.slope(steps, found)


# Order. One step of each is what its tableau says, in test_step.py, and few slopes are observed.
# Smaller steps of the most accurate methods meet the error of the reference.


@pytest.mark.parametrize(
    "problem, name, steps",
    [
        ("left", "CF4", STEPS),
        ("right", "CF3", STEPS),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("left", "CF54", STEPS[:-1]),
                ("left", "CG4", STEPS),
                ("left", "family B, 2/3", STEPS),
                # Short vectors, which go another way through a step.
                ("sphere", "CF43", STEPS),
                ("sphere", "CG5", STEPS[:-1]),
                ("product", "CF2", STEPS),
                ("product", "CF4", STEPS),
            ]
        ),
    ],
)
def test_order(matrix_problems, body_problem, flight_problem, problem, name, steps):
    given = matrix_problems | {"sphere": body_problem, "product": flight_problem}
    order = observed_order(given[problem], METHODS[name], steps)
    assert abs(order - METHODS[name].order(None)) < TOLERANCE


@pytest.mark.slow
def test_a_mistaken_stage_time_loses_the_order(matrix_problems):
    """So the problem sees it."""
    order = observed_order(matrix_problems["left"], METHODS["CF4"], ignore_stage_times=True)
    assert abs(order - 1) < TOLERANCE


# Simple cases with a known answer


def one_step(solver, field, y0, t0=0.3, h=0.25, args=None, term=cfjax.LieTerm):
    @jax.jit
    def step(t0, t1, y0, args):
        return problems.first_step(solver, term(field), t0, t1, y0, args)[0]

    return step(jnp.asarray(t0), jnp.asarray(t0 + h), problems.arrays(y0), problems.arrays(args))


def ode(xp: Any, t, y):
    """A field on vectors that depends on time and couples all entries."""
    return xp.sin(y * t) - y[::-1] ** 2 / 2 + xp.cos(t)


def classical_4(f, t, y, h):
    k1 = f(t, y)
    k2 = f(t + h / 2, y + h / 2 * k1)
    k3 = f(t + h / 2, y + h / 2 * k2)
    k4 = f(t + h, y + h * k3)
    return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def heun_3(f, t, y, h):
    k1 = f(t, y)
    k2 = f(t + h / 3, y + h / 3 * k1)
    k3 = f(t + 2 * h / 3, y + 2 * h / 3 * k2)
    return y + h / 4 * (k1 + 3 * k3)


@pytest.mark.parametrize(
    "name, classical, shape, term",
    [
        ("CF4", classical_4, (3,), diffrax.ODETerm),
        ("CF3", heun_3, (9,), cfjax.LieTerm),
        ("CF3", heun_3, (2, 3), cfjax.LieTerm),
        ("CF4", classical_4, (), cfjax.LieTerm),
    ],
)
def test_in_a_linear_space_it_is_the_classical_method(name, classical, shape, term):
    def field(xp, t, y):
        return ode(xp, t, y) if shape else xp.sin(y * t) - y**2 / 2

    y0 = np.random.default_rng(1).standard_normal(shape)
    found = one_step(METHODS[name], lambda t, y, args: field(jnp, t, y), y0, term=term)
    expected = classical(lambda t, y: field(np, t, y), 0.3, y0, 0.25)
    # Entries are of order 1, and an entry goes through about 20 rounded operations.
    np.testing.assert_allclose(found, expected, rtol=0, atol=20 * np.finfo(float).eps)


# Cost


class Counting(cfjax.AbstractFrozenField):
    """A translation that counts its flows. No bracket, so it is no algebra element."""

    v: jax.Array
    counts: dict = eqx.field(static=True)

    def flow(self, point):
        self.counts["flows"] += 1
        return point + self.v

    def tangent(self, point):
        return self.v


def test_a_step_costs_what_its_tableau_says(subtests):
    """In flows: test_solver_table.py counts the evaluations of each method."""
    counts = {"flows": 0, "evaluations": 0}

    def field(t, y, args):
        counts["evaluations"] += 1
        return Counting(-y, counts)

    def step(solver, y):
        term, time = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        state = solver.init(term, *time, y, None)
        counts.update(flows=0, evaluations=0)
        return solver.step(term, *time, y, None, state, made_jump=False)[0]

    # Steps of the vector are rewritten on single numbers, those of the matrix not.
    shapes, names = ((3,), (4, 4)), ("LieEuler", "CF2", "CF4", "CF54", "CG3", "CG5")
    for name, shape, estimate in itertools.product(names, shapes, (False, True)):
        solver = METHODS[name] if estimate else METHODS[name].without_estimate()
        tableau, is_rewritten = solver.tableau, shape == (3,)
        with cfjax.rewriting(is_rewritten):
            jax.eval_shape(functools.partial(step, solver.unrolled()), jnp.ones(shape))
        # The field at the end of the step comes on top, where the next step does not start with it.
        # Where it does, a rewritten step evaluates it once more, from the end alone.
        # These have order 5 with stages that reach order 3 only, as
        # methods/test_order_conditions.py has it.
        uses_last = type(solver) in (cfjax.CF54, cfjax.CG5)
        last = is_rewritten if solver.first_same_as_last else uses_last
        with subtests.test(case=(name, str(shape), str(estimate))):
            assert counts["evaluations"] == tableau.num_evaluations + last
            assert counts["flows"] == tableau.num_flows + estimate * tableau.num_embedded_flows


# Precision


def test_a_step_keeps_the_precision():
    start, args = problems.arrays((problems.ORTHOGONAL, problems.GENERATORS))
    y0, args = (x.astype(jnp.float32) for x in (start, args))
    term, time = cfjax.LieTerm(problems.left_matrix), (jnp.float32(0.0), jnp.float32(0.1))
    for name in ("LieEuler", "CF3", "CF54", "CG4", "family B, 0.1"):
        step = lambda y, x=METHODS[name]: problems.first_step(x, term, *time, y, args)[0]  # noqa: E731
        y1 = jax.eval_shape(step, y0)
        assert (y1.shape, y1.dtype) == (y0.shape, jnp.float32)


# What a solver is


def test_solvers_are_compared_by_value():
    a = cfjax.CommutatorFree(cfjax.third_order_a(Fraction(1, 2)))
    b = cfjax.CommutatorFree(cfjax.third_order_a(Fraction(1, 2)))
    c = cfjax.CommutatorFree(cfjax.third_order_a(Fraction(3, 4)))
    assert a == b and hash(a) == hash(b)
    assert a != c
    # Coefficients are no leaves: nothing differentiates them, and they cannot be batched.
    assert jax.tree_util.tree_leaves(a) == []
    assert jax.tree_util.tree_structure(a) == jax.tree_util.tree_structure(b)


def test_equal_solvers_do_not_trace_again():
    traces = 0

    @eqx.filter_jit
    def step(solver, y):
        nonlocal traces
        traces += 1
        time = jnp.asarray(0.0), jnp.asarray(0.1)
        term = cfjax.LieTerm(lambda t, y, args: -y)
        return problems.first_step(solver, term, *time, y, None)[0]

    for y in (1.0, 2.0):
        step(cfjax.CommutatorFree(cfjax.third_order_b(Fraction(2, 3))), jnp.asarray([y]))
    assert traces == 1
    step(cfjax.CommutatorFree(cfjax.third_order_b(Fraction(3, 4))), jnp.asarray([1.0]))
    assert traces == 2


def test_a_mistaken_field_is_reported_with_its_place():
    def field(t, y, args):
        return {"a": cfjax.Rotation(y["a"]), "b": y["b"][:2]}

    y0 = {"a": jnp.ones(3), "b": jnp.ones(3)}
    time = jnp.asarray(0.0), jnp.asarray(0.1)
    with pytest.raises(ValueError, match=r"y\['b'\].*f64\[3\]"):
        problems.first_step(cfjax.CF4(), cfjax.LieTerm(field), *time, y0, None)


# A step in components and a step in whole vectors are two ways to one result.

finite = st.floats(-3, 3, allow_subnormal=False)


@jax.jit
def _step_of_vector_and_of_column(y, inertia, h):
    """CF4 on a vector, shape (3,), and on the matrix with that one column, shape (3, 1)."""

    def step(field, y):
        zero = jnp.zeros(())
        return problems.first_step(cfjax.CF4(), cfjax.LieTerm(field), zero, h, y, inertia)[0]

    def column(t, y, args):
        return problems.driven_body(t, y[:, 0], args)

    return step(problems.driven_body, y), step(column, y[:, None])[:, 0]


@hypothesis.given(
    y=st.tuples(finite, finite, finite),
    inertia=st.tuples(*[st.floats(0.1, 10)] * 3),
    h=finite,
)
@hypothesis.settings(deadline=None, max_examples=200)
def test_a_vector_and_a_column_take_the_same_step(y, inertia, h):
    found, expected = _step_of_vector_and_of_column(
        jnp.asarray(y), jnp.asarray(inertia), jnp.asarray(h)
    )
    # A rounding error is scaled by the angle of the flow, h |omega|, at each of 4 stages.
    largest = 3 * np.linalg.norm(y) * abs(h) / min(inertia) + 10 * abs(h)
    amplified = (1 + largest) ** 4 * (1 + np.linalg.norm(y))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15 * amplified)
    # Not NumPy's norm, whose squares underflow.
    length = math.hypot(*y)
    assert abs(math.hypot(*map(float, found)) - length) <= 2e-14 * length
