"""Commutator-free methods: order, stage times, cost, and what they reduce to in simple cases."""

import functools
import itertools
from fractions import Fraction
from typing import Any

import diffrax
import equinox as eqx
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


def observed_order(problem, solver, steps, **kwargs) -> float:
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
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("right", "CF3", STEPS),
                ("left", "CF54", STEPS[:-1]),
                # Short vectors, which go another way through a step.
                ("sphere", "CG5", STEPS[:-1]),
                ("product", "CF2", STEPS),
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
    problem, solver = matrix_problems["left"], METHODS["CF4"]
    order = observed_order(problem, solver, STEPS, ignore_stage_times=True)
    assert abs(order - 1) < TOLERANCE


# Simple cases with a known answer


def classical_4(f, t, y, h):
    k1 = f(t, y)
    k2 = f(t + h / 2, y + h / 2 * k1)
    k3 = f(t + h / 2, y + h / 2 * k2)
    k4 = f(t + h, y + h * k3)
    return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def test_in_a_linear_space_it_is_the_classical_method(subtests):
    for shape, term in (((3,), diffrax.ODETerm), ((2, 3), cfjax.LieTerm), ((), cfjax.LieTerm)):

        def field(xp: Any, t, y, shape=shape):
            """It depends on time and couples all entries."""
            return xp.sin(y * t) - (y[::-1] if shape else y) ** 2 / 2 + xp.cos(t)

        @jax.jit
        def step(t0, t1, y0, term=term, field=field):
            given = term(lambda t, y, args: field(jnp, t, y))
            return problems.first_step(cfjax.CF4(), given, t0, t1, y0, None)[0]

        y0 = np.random.default_rng(1).standard_normal(shape)
        expected = classical_4(lambda t, y: field(np, t, y), 0.3, y0, 0.25)
        with subtests.test(shape=str(shape)):
            # Entries are of order 1, and an entry goes through about 20 rounded operations.
            np.testing.assert_allclose(
                step(0.3, 0.3 + 0.25, y0), expected, rtol=0, atol=20 * np.finfo(float).eps
            )


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
    shapes, names = ((3,), (4, 4)), ("CF4", "CF54", "CG3")
    for name, shape, estimate in itertools.product(names, shapes, (False, True)):
        solver = METHODS[name] if estimate else METHODS[name].without_estimate()
        tableau, is_rewritten = solver.tableau, shape == (3,)
        with cfjax.rewriting(is_rewritten):
            jax.eval_shape(functools.partial(step, solver.unrolled()), jnp.ones(shape))
        # The field at the end of the step comes on top, where the next step does not start with it.
        # Where it does, a rewritten step evaluates it once more, from the end alone.
        # CF54 has order 5 with stages that reach order 3 only, as methods/test_order_conditions.py
        # has it.
        last = is_rewritten if solver.first_same_as_last else name == "CF54"
        with subtests.test(case=(name, str(shape), str(estimate))):
            assert counts["evaluations"] == tableau.num_evaluations + last
            assert counts["flows"] == tableau.num_flows + estimate * tableau.num_embedded_flows


# Precision


def test_a_step_keeps_the_precision():
    start, args = problems.arrays((problems.ORTHOGONAL, problems.GENERATORS))
    y0, args = (x.astype(jnp.float32) for x in (start, args))
    term, time = cfjax.LieTerm(problems.left_matrix), (jnp.float32(0.0), jnp.float32(0.1))
    for name in ("CF3", "family B, 0.1"):
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
