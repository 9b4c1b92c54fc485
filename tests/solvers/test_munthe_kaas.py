"""Munthe-Kaas methods: order, brackets, cost and what they refuse."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from solver_table import MUNTHE_KAAS, SOLVERS, Row

import cfjax
from cfjax.scenes import heavy_top

ROWS: dict[str, Row] = {name: SOLVERS[name] for name in ("RKMK3", "RKMK4")} | MUNTHE_KAAS
METHODS: dict[str, Any] = {name: row.make() for name, row in ROWS.items()}


# Dopri5 and Tsit5 meet the error of the reference on the sphere before their order shows: their
# test is in scenes/test_rigid_body.py.
@pytest.mark.parametrize(
    "problem, name",
    [
        ("left", "RKMK4"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("right", "Tsit5"),
                ("sphere", "Bosh3"),
                ("product", "RKMK4"),
            ]
        ),
    ],
)
def test_order(matrix_problems, body_problem, flight_problem, problem, name):
    given = matrix_problems | {"sphere": body_problem, "product": flight_problem}
    field, y0, args, answer = given[problem]
    # The steps and the tolerance of test_commutator_free.py. Steps down to 1/128 leave 2e-12 for
    # order 5, 20 times the error of the reference.
    steps = (16, 32, 64, 128)
    found = problems.errors(field, METHODS[name], 1.0, y0, args, answer, steps)
    assert found.min() > 10 * problems.REFERENCE_ERROR
    assert found.max() < 1
    assert abs(problems.slope(steps, found) - ROWS[name].order) < 0.15


@pytest.mark.slow
def test_error_control_of_the_heavy_top():
    """Against SciPy in plain space; 30 radians, in steps of up to 3 at the loosest tolerance.

    There some ten steps are all, and the errors reach 14 tolerances; from 1e-8 on 8.
    """
    solver, answer, t1 = cfjax.RKMK(diffrax.Dopri8.tableau), heavy_top.reference(0.2), 0.2
    tolerances = 10.0 ** -np.arange(4, 12)

    @jax.jit
    def end(tolerance):
        sol = diffrax.diffeqsolve(
            *(cfjax.LieTerm(heavy_top.field), solver, 0.0, t1, 0.03 * t1 * tolerance ** (1 / 8)),
            *(problems.arrays(heavy_top.y0()), heavy_top.benchmark),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
            max_steps=10_000,
        )
        return jax.tree_util.tree_map(lambda y: y[-1], sol.ys)

    off = np.array([heavy_top.error(end(x), answer) / x for x in tolerances])
    assert (off[:4] < 20).all()
    assert (off[4:] < 10).all()


# One step is what the coefficients say, in test_step.py.


def test_in_a_linear_space_it_is_the_classical_method():
    def ode(xp, t, y):
        return xp.sin(y * t) - y[::-1] ** 2 / 2 + xp.cos(t)

    y0, tableau = np.array([0.2, -0.5, 0.4]), diffrax.Bosh3.tableau
    t0, h, term = 0.3, 0.25, diffrax.ODETerm(lambda t, y, args: ode(jnp, t, y))

    @jax.jit
    def end(y0):
        times = jnp.asarray(t0), jnp.asarray(t0 + h)
        return problems.first_step(METHODS["Bosh3"], term, *times, y0, None)[0]

    stages = []
    for row in [[], *tableau.a_lower]:
        point = y0 + sum((a * k for a, k in zip(row, stages, strict=True)), start=0 * y0)
        stages.append(h * ode(np, t0 + sum(row) * h, point))
    expected = y0 + sum(b * k for b, k in zip(tableau.b_sol, stages, strict=True))
    # Some ten roundings of numbers of size 1.
    np.testing.assert_allclose(end(y0), expected, rtol=0, atol=10 * np.finfo(float).eps)


# Cost


class Counting(cfjax.AbstractAlgebraElement):
    """A translation that counts its flows and brackets."""

    v: jax.Array
    counts: dict = eqx.field(static=True)

    def flow(self, point):
        self.counts["flows"] += 1
        return point + self.v

    def tangent(self, point):
        return self.v

    def bracket(self, other):
        self.counts["brackets"] += 1
        return type(self)(jnp.zeros_like(self.v), self.counts)


def count_step(solver, y):
    solver = solver.unrolled()
    counts = dict(evaluations=0, flows=0, brackets=0)

    def field(t, y, args):
        counts["evaluations"] += 1
        return Counting(-y, counts)

    def step(y):
        term, time = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        state = solver.init(term, *time, y, None)
        counts.update(evaluations=0, flows=0, brackets=0)
        return solver.step(term, *time, y, None, state, made_jump=False)[0]

    jax.eval_shape(step, y)
    return counts


def test_a_step_costs_what_its_docstring_says(subtests):
    """Of order five two brackets for each stage but the first, none for stages without weight."""
    costs = {"RKMK3": (3, 3, 1), "RKMK4": (4, 4, 2), "Heun": (2, 2, 0), "Bosh3": (3, 3, 2)}
    costs |= {"Dopri5": (6, 6, 10), "Tsit5": (6, 6, 10)}
    for name, cost in costs.items():
        with subtests.test(name=name):
            solver = METHODS[name]
            counts = count_step(solver.without_estimate(), jnp.ones((4, 4)))
            assert tuple(counts.values()) == cost
            if ROWS[name].order == 5:
                # With the estimate the last evaluation is the first of the next step.
                assert solver.first_same_as_last
                counts = count_step(solver, jnp.ones((4, 4)))
                assert tuple(counts.values()) == (6, 6, 12)


# Of which tableau, evaluations that only output within the step takes, and brackets of a stage.
NAMED = {"RKMK5": (diffrax.Tsit5, 0, 2), "RKMK8": (diffrax.Dopri8, 4, 6)}


def test_a_named_method_is_that_of_its_tableau(subtests):
    for name, (plain, within, brackets) in NAMED.items():
        cls = getattr(cfjax, name)
        solver, same = cls(), cfjax.RKMK(plain.tableau)
        with subtests.test(name=name):
            for row in "a", "b", "b_error", "c":
                assert getattr(solver, row) == getattr(same, row)
            assert solver == cls() != cls(estimate="group")
            assert cls(estimate=None).estimate is None
            # As its docstring says.
            stages = SOLVERS[name].evaluations + within
            cost = {"evaluations": stages, "flows": stages, "brackets": (stages - 1) * brackets}
            assert count_step(solver.without_estimate(), jnp.ones((4, 4))) == cost


# Refusals


def test_a_field_without_bracket_is_refused_by_name(subtests):
    def nested(t, y, args):
        return {"a": -y["a"], "b": problems.Growth(-y["b"])}

    cases = [(lambda t, y, args: problems.Growth(-y), jnp.ones(3))]
    cases += [(nested, {"a": jnp.ones(3), "b": jnp.ones(3)})]
    for name in ("RKMK3", "RKMK4", "Tsit5"):
        for field, y0 in cases:
            message = r"Growth has none.*commutator-free.*cfjax\.CF4\(\)"
            with subtests.test(name=name), pytest.raises(TypeError, match=message):
                diffrax.diffeqsolve(cfjax.LieTerm(field), METHODS[name], 0.0, 1.0, 0.1, y0)


def test_messages_of_wrong_arguments(subtests, no_shape_hook):
    explicit = "tableau must be explicit, got one of an implicit method"
    of_diffrax = r"tableau must be a diffrax\.ButcherTableau, got "
    solver = of_diffrax + r".*Write diffrax\.Dopri8\.tableau"
    ours = r"tableau must be a cfjax\.Tableau, got "
    cases = [
        (cfjax.RKMK, diffrax.Kvaerno3.tableau, ValueError, explicit),
        *((cfjax.RKMK, x, TypeError, of_diffrax) for x in (None, 4, [[0.5]], cfjax.CF4.tableau)),
        (cfjax.RKMK, diffrax.KenCarp4.tableau, TypeError, of_diffrax),
        *((cfjax.RKMK, x, TypeError, solver) for x in (diffrax.Dopri8(), diffrax.Dopri8)),
        *((cfjax.CommutatorFree, x, TypeError, ours) for x in (None, [[[]], [[1]]], cfjax.CF4())),
        (cfjax.CommutatorFree, diffrax.Tsit5.tableau, TypeError, ours),
    ]
    for make, given, error, message in cases:
        with subtests.test(given=repr(given)), pytest.raises(error, match=message):
            make(given)


# Tracing


def test_a_tableau_without_embedded_method_has_no_estimate():
    midpoint = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]),),
        b_sol=np.array([0.0, 1.0]),
        b_error=np.zeros(2),
        c=np.array([0.5]),
    )
    solver = cfjax.RKMK(midpoint)
    assert (solver.order(None), solver.error_order(None)) == (2, None)
    term = cfjax.LieTerm(problems.rigid_body)
    control = diffrax.PIDController(rtol=0.0, atol=1e-3)
    with pytest.raises(RuntimeError, match="error estimate"):
        diffrax.diffeqsolve(
            term, solver, 0.0, 1.0, 0.1, jnp.ones(3), jnp.ones(3), stepsize_controller=control
        )


def test_equal_tableaus_give_equal_solvers():
    a, b = cfjax.RKMK(diffrax.Dopri5.tableau), cfjax.RKMK(diffrax.Dopri5.tableau)
    assert a == b and hash(a) == hash(b)
    assert a != cfjax.RKMK(diffrax.Tsit5.tableau)
    assert jax.tree_util.tree_structure(a) == jax.tree_util.tree_structure(b)
    assert hash(jax.tree_util.tree_structure(a)) == hash(jax.tree_util.tree_structure(b))
    # Coefficients are no leaves, so no gradient or batch reaches them.
    assert jax.tree_util.tree_leaves(a) == []
