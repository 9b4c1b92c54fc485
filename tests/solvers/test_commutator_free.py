"""Commutator-free methods: order, stage times, cost, and what they reduce to in simple cases."""

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
import scipy.linalg
from solver_table import COMMUTATOR_FREE, named

import cfjax

ROWS = named("commutator-free") | COMMUTATOR_FREE
METHODS: dict[str, Any] = {name: row.make() for name, row in ROWS.items()}
methods = pytest.mark.parametrize("solver", METHODS.values(), ids=METHODS.keys())

# The step is small enough that the next order adds at most 0.1 to the slope, and the errors,
# 1e-12 at least, stay 10 times above those of the reference.
STEPS = (16, 32, 64, 128)
TOLERANCE = 0.15


def reversed_composition(solver) -> cfjax.CommutatorFree:
    """The mistake of applying the last exponential first."""
    tableau = solver.tableau
    return cfjax.CommutatorFree(
        cfjax.Tableau([rows[::-1] for rows in tableau.alpha], tableau.beta[::-1])
    )


def observed_order(problem, solver, steps=STEPS, **kwargs) -> float:
    field, y0, args, answer = problem
    found = problems.errors(field, solver, 1.0, y0, args, answer, steps, **kwargs)
    assert found.min() > 10 * problems.REFERENCE_ERROR
    assert found.max() < 1
    return problems.slope(steps, found)


# Order


@pytest.mark.parametrize(
    "side, solver",
    [
        pytest.param(side, solver, id=f"{side}-{name}", marks=[pytest.mark.slow] * is_slow)
        for name, solver in METHODS.items()
        for side, is_slow in (("left", name != "CF4"), ("right", name != "CF3"))
    ],
)
def test_order_on_matrices(matrix_problems, side, solver):
    # The smallest step of CF54 meets the error of the reference.
    steps = STEPS[:-1] if isinstance(solver, cfjax.CF54) else STEPS
    order = observed_order(matrix_problems[side], solver, steps)
    assert abs(order - solver.order(None)) < TOLERANCE


# The parts of this state are short vectors, which go another way through a step.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["CF2", "CF3", "CF4", "CG3"])
def test_order_on_a_product_of_manifolds(flight_problem, name):
    order = observed_order(flight_problem, METHODS[name])
    assert abs(order - METHODS[name].order(None)) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_order_on_the_sphere(body_problem, name):
    # Smaller steps of the most accurate methods meet the error of the reference.
    steps = {"CF43": (16, 32, 64, 128), "CF54": (8, 16, 32), "CG5": (16, 32, 64)}
    order = observed_order(body_problem, METHODS[name], steps.get(name, (32, 64, 128, 256)))
    assert abs(order - METHODS[name].order(None)) < TOLERANCE


# These two defend the choice of the problem: it sees the mistakes that packages have made.


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CG3", "CG4"])
def test_reversed_composition_loses_its_order(matrix_problems, name):
    wrong = observed_order(matrix_problems["left"], reversed_composition(METHODS[name]))
    assert abs(wrong - 2) < TOLERANCE
    # The right one is within 0.15 of its order, see above.
    assert wrong < METHODS[name].order(None) - TOLERANCE - 0.8


@pytest.mark.slow
@pytest.mark.parametrize("name", ["CG3", "CG4"])
def test_a_commuting_problem_does_not_see_reversed_composition(name):
    """Why the problem above must not commute: here both compositions are right."""

    def field(t, y, args):
        del y
        return cfjax.LeftMatrix(jnp.cos(3 * t) * args)

    a = np.array(problems.GENERATORS[0] - problems.GENERATORS[0].T)
    answer = problems.flat(scipy.linalg.expm(np.sin(3.0) / 3 * a) @ problems.ORTHOGONAL)
    problem = (field, problems.ORTHOGONAL, a, answer)
    right = METHODS[name]
    wrong = reversed_composition(right)
    found = [problems.errors(field, s, 1.0, *problem[1:], STEPS) for s in (right, wrong)]
    for each in found:
        assert problems.slope(STEPS, each) > right.order(None) - TOLERANCE
    # The two differ by rounding only: about 10 products a step, 128 steps.
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-13)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF2", "CF3", "CF4", "CG3"])
def test_a_mistaken_stage_time_loses_the_order(matrix_problems, name):
    order = observed_order(matrix_problems["left"], METHODS[name], ignore_stage_times=True)
    assert abs(order - 1) < TOLERANCE


# Simple cases with a known answer


def one_step(solver, field, y0, t0=0.3, h=0.25, args=None, term=cfjax.LieTerm):
    """One step from `t0`, compiled."""

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


def midpoint(f, t, y, h):
    return y + h * f(t + h / 2, y + h / 2 * f(t, y))


def euler(f, t, y, h):
    return y + h * f(t, y)


@pytest.mark.representatives(6)
@pytest.mark.parametrize("term", [cfjax.LieTerm, diffrax.ODETerm])
@pytest.mark.parametrize("shape", [(), (3,), (9,), (2, 3)])
@pytest.mark.parametrize(
    "name, classical",
    [("CF4", classical_4), ("CF3", heun_3), ("CF2", midpoint), ("LieEuler", euler)],
)
def test_in_a_linear_space_it_is_the_classical_method(name, classical, shape, term):
    def field(xp, t, y):
        return ode(xp, t, y) if shape else xp.sin(y * t) - y**2 / 2

    y0 = np.random.default_rng(1).standard_normal(shape)
    found = one_step(METHODS[name], lambda t, y, args: field(jnp, t, y), y0, term=term)
    expected = classical(lambda t, y: field(np, t, y), 0.3, y0, 0.25)
    # Entries are of order 1, and an entry goes through about 20 rounded operations.
    np.testing.assert_allclose(found, expected, rtol=0, atol=20 * np.finfo(float).eps)


@pytest.mark.slow
@methods
def test_a_constant_field_is_followed_exactly(solver):
    """From no turn to several turns in one step, in both directions of time."""
    a = problems.GENERATORS[0] - problems.GENERATORS[0].T

    @jax.jit
    def step(h):
        term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(args))
        y0, args = jnp.eye(4), jnp.asarray(a)
        return problems.first_step(solver, term, 0 * h, h, y0, args)[0]

    for h in (0.0, 0.25, -1.0, 8.0):
        # Inner flows go past the step's end (up to 2 |h| |a|), and each is wrong by a rounding of
        # its norm. The norm of a is 5.3.
        atol = 1e-14 * (1 + 30 * abs(h))
        found = step(jnp.asarray(h))
        np.testing.assert_allclose(found, scipy.linalg.expm(h * a), rtol=0, atol=atol)


# Not the methods of many flows: 43 of each kind in one program take long to compile.
@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["LieEuler", "CF2", "CF3", "CF4", "CG3"])
def test_rotations_agree_with_their_matrices(name):
    """The same problem on the sphere, once with Rodrigues' formula and once with matrices."""

    def as_matrices(t, y, args):
        x, y, z = problems.driven_body(t, y, args).omega
        o = jnp.zeros_like(x)
        rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
        return cfjax.LeftMatrix(jnp.stack([jnp.stack(row) for row in rows]))

    y0, args = problems.MOMENTUM, problems.INERTIA
    found = one_step(METHODS[name], problems.driven_body, y0, args=args)
    expected = one_step(METHODS[name], as_matrices, y0, args=args)
    # At most 6 flows, each with a few roundings of a vector of length 1.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF3", "CF4", "CG3"])
def test_the_transposed_problem_has_the_transposed_solution(name):
    """y' = A(t, y) y and x' = x A(t, x^T)^T are one problem, for x = y^T."""

    def transposed(t, x, args):
        return cfjax.RightMatrix(problems.generator(jnp, t, x.T, args).T)

    y0, args = problems.ORTHOGONAL, problems.GENERATORS
    left = one_step(METHODS[name], problems.left_matrix, y0, args=args)
    right = one_step(METHODS[name], transposed, y0.T, args=args)
    # Up to 6 flows with about 10 rounded products of size 4 each.
    np.testing.assert_allclose(right, left.T, rtol=0, atol=2e-14)


@pytest.mark.slow
def test_a_product_of_manifolds_moves_its_parts_as_one():
    """One step of CF4 on the product, against NumPy and SciPy's exponential."""

    def hat(w):
        return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])

    def field(t, y):
        q, m, x = y
        w = m / problems.INERTIA
        push = np.array([np.cos(2 * t), np.sin(t), 1.0])
        return [hat(w), hat(push - w), q[:, 0] - 0.3 * x]

    def flow(weights, fields, y):
        a, b, v = (sum(w * f[i] for w, f in zip(weights, fields, strict=True)) for i in range(3))
        return [scipy.linalg.expm(a) @ y[0], scipy.linalg.expm(b) @ y[1], y[2] + v]

    t, h, s = 0.3, 0.25, problems.FLIGHT_START
    y = [s["attitude"], s["momentum"], s["position"]]
    f1 = [h * f for f in field(t, y)]
    y2 = flow([1 / 2], [f1], y)
    f2 = [h * f for f in field(t + h / 2, y2)]
    y3 = flow([1 / 2], [f2], y)
    f3 = [h * f for f in field(t + h / 2, y3)]
    y4 = flow([-1 / 2, 1], [f1, f3], y2)
    f4 = [h * f for f in field(t + h, y4)]
    fs = [f1, f2, f3, f4]
    half = flow([1 / 4, 1 / 6, 1 / 6, -1 / 12], fs, y)
    expected = flow([-1 / 12, 1 / 6, 1 / 6, 1 / 4], fs, half)

    found = one_step(
        cfjax.CF4(), problems.body_in_flight, problems.FLIGHT_START, args=problems.FLIGHT_ARGS
    )
    # 5 flows of entries of order 1.
    np.testing.assert_allclose(problems.flat(found), problems.flat(expected), rtol=0, atol=1e-14)


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


@pytest.mark.representatives(6)
@methods
@pytest.mark.parametrize("shape", [(3,), (4, 4)])
@pytest.mark.parametrize("estimate", [False, True])
def test_a_step_costs_what_its_tableau_says(solver, shape, estimate):
    counts = {"flows": 0, "evaluations": 0}
    solver = (solver if estimate else solver.without_estimate()).unrolled()
    tableau = solver.tableau

    def field(t, y, args):
        counts["evaluations"] += 1
        return Counting(-y, counts)

    def step(y):
        term, time = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        state = solver.init(term, *time, y, None)
        counts.update(flows=0, evaluations=0)
        return solver.step(term, *time, y, None, state, made_jump=False)[0]

    # Steps of the vector are rewritten on single numbers, those of the matrix not.
    is_rewritten = shape == (3,)
    with cfjax.rewriting(is_rewritten):
        jax.eval_shape(step, jnp.ones(shape))
    # The field at the end of the step comes on top, where the next step does not start with it.
    # Where it does, a rewritten step evaluates it once more, from the end alone.
    # These have order 5 with stages that reach order 3 only, as methods/test_order_conditions.py
    # has it.
    uses_last = type(solver) in (cfjax.CF54, cfjax.CG5)
    last = is_rewritten if solver.first_same_as_last else uses_last
    assert counts["evaluations"] == tableau.num_evaluations + last
    assert counts["flows"] == tableau.num_flows + estimate * tableau.num_embedded_flows


# Precision


@pytest.mark.representatives(8)
@methods
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_step_keeps_the_precision(solver, dtype):
    y0 = problems.arrays(problems.ORTHOGONAL.astype(dtype))
    args = problems.arrays(problems.GENERATORS.astype(dtype))
    time = jnp.asarray(0.0, dtype), jnp.asarray(0.1, dtype)
    term = cfjax.LieTerm(problems.left_matrix)
    y1 = jax.eval_shape(lambda y: problems.first_step(solver, term, *time, y, args)[0], y0)
    assert (y1.shape, y1.dtype) == (y0.shape, dtype)


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


@pytest.mark.parametrize("tableau", [None, [[[]], [[1]]], diffrax.Tsit5.tableau, cfjax.CF4()])
def test_only_a_tableau_makes_a_method(tableau):
    # The import hook of the test suite may answer first. The package's own words are in
    # test_munthe_kaas.py.
    with pytest.raises(TypeError, match="tableau"):
        cfjax.CommutatorFree(tableau)


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
