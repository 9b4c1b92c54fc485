"""Munthe-Kaas methods: order, brackets, cost and what they refuse."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.integrate
import scipy.linalg
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
                ("right", "RKMK3"),
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


# One step against formulas written by hand, with SciPy's exponential

T0, H = 0.3, 0.25


def one_step(solver, term, y0, args=None):
    """Its end and its estimate."""
    times = jnp.asarray(T0), jnp.asarray(T0 + H)
    return problems.first_step(solver, term, *times, y0, args)[:2]


def commutator(a, b):
    return a @ b - b @ a


def by_hand(name, f, t, y, h, weights=None):
    """The increment v of the step exp(v) y, or with other weights; `f(t, y)` is a matrix."""

    def at(c, u):
        return h * f(t + c * h, scipy.linalg.expm(u) @ y)

    if name in ("RKMK3", "RKMK4"):
        k1 = at(0, 0 * y)
        k2 = at(1 / 2, k1 / 2)
        q1, q2 = k1, k2 - k1
        if name == "RKMK3":
            k3 = at(1, -k1 + 2 * k2)
            q3 = k3 - 2 * k2 + k1
            return q1 + q2 + q3 / 6 - commutator(q1, q2) / 6
        k3 = at(1 / 2, q1 / 2 + q2 / 2 - commutator(q1, q2) / 8)
        q3 = k3 - k2
        k4 = at(1, q1 + q2 + q3)
        q4 = k4 - 2 * k2 + k1
        linear = q1 + q2 + q3 / 3 + q4 / 6
        return linear - commutator(q1, q2) / 6 - commutator(q1, q4) / 12

    tableau = getattr(diffrax, name).tableau
    order = ROWS[name].order
    bernoulli = [1, -1 / 2, 1 / 6, 0]
    stages = []
    rows = [[], *tableau.a_lower]
    for row in rows:
        u = sum((a * k for a, k in zip(row, stages, strict=True)), start=0 * y)
        c = sum(row)
        term, k, factorial = at(c, u), 0 * y, 1
        for j in range(order - 1):
            factorial *= max(j, 1)
            k = k + bernoulli[j] / factorial * term
            term = commutator(u, term)
        stages.append(k)
    weights = tableau.b_sol if weights is None else weights
    return sum(b * k for b, k in zip(weights, stages, strict=True))


def matrix(t, y):
    return problems.generator(np, t, y, problems.GENERATORS)


# A program of 13 stages is for few tests.
@pytest.mark.parametrize(
    "name, estimate",
    [*((name, "algebra") for name in ROWS if name != "Dopri8"), ("Bosh3", "group")],
)
def test_one_step_and_its_estimate_are_the_published_formulas(name, estimate):
    y0 = problems.ORTHOGONAL
    v, embedded = by_hand(name, matrix, T0, y0, H), None
    if name in ("RKMK3", "RKMK4"):
        solver = METHODS[name]
        if name == "RKMK3":
            # The midpoint rule.
            embedded = H * matrix(T0 + H / 2, scipy.linalg.expm(H / 2 * matrix(T0, y0)) @ y0)
    else:
        tableau = getattr(diffrax, name).tableau
        embedded = by_hand(name, matrix, T0, y0, H, tableau.b_sol - tableau.b_error)
        solver = cfjax.RKMK(tableau, estimate=estimate)
    y1, error = scipy.linalg.expm(v) @ y0, None
    if embedded is not None:
        other = scipy.linalg.expm(embedded) @ y0
        error = (v - embedded) @ y1 if estimate == "algebra" else y1 - other
        assert np.linalg.norm(error) > 1e-5

    def turned(t, z, args):
        turn, args = args
        return cfjax.LeftMatrix(turn @ problems.generator(jnp, t, turn.T @ z, args) @ turn.T)

    @jax.jit
    def step(turn):
        args = turn, problems.GENERATORS
        return one_step(solver, cfjax.LieTerm(turned), turn @ y0, args)

    # Seen from a turned frame, all is turned, and so is the estimate.
    for turn in np.eye(4), scipy.linalg.expm(problems.GENERATORS[1] - problems.GENERATORS[1].T):
        found = step(jnp.asarray(turn))
        # At most 7 stages of a few rounded products of size 4. The terms that a wrong coefficient
        # would change are of order (h |A|)^5 / 720, or 1e-3.
        np.testing.assert_allclose(found[0], turn @ y1, rtol=0, atol=2e-14)
        assert (found[1] is None) == (error is None)
        if error is not None:
            np.testing.assert_allclose(found[1], turn @ error, rtol=0, atol=2e-14)


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


def classical(tableau, f, t, y, h):
    stages = []
    for row in [[], *tableau.a_lower]:
        point = y + sum((a * k for a, k in zip(row, stages, strict=True)), start=0 * y)
        stages.append(h * f(t + sum(row) * h, point))
    return y + sum(b * k for b, k in zip(tableau.b_sol, stages, strict=True))


@pytest.mark.parametrize(
    "name, shape, term",
    [
        ("Bosh3", (3,), diffrax.ODETerm),
        ("Tsit5", (9,), cfjax.LieTerm),
        ("Heun", (2, 3), cfjax.LieTerm),
        pytest.param("Dopri5", (3,), cfjax.LieTerm, marks=pytest.mark.slow),
    ],
)
def test_in_a_linear_space_it_is_the_classical_method(name, shape, term):
    def ode(xp, t, y):
        return xp.sin(y * t) - y[::-1] ** 2 / 2 + xp.cos(t)

    y0 = np.random.default_rng(2).standard_normal(shape)
    term = term(lambda t, y, args: ode(jnp, t, y))
    found = jax.jit(lambda y0: one_step(METHODS[name], term, y0)[0])(y0)
    tableau = getattr(diffrax, name).tableau
    expected = classical(tableau, lambda t, y: ode(np, t, y), T0, y0, H)
    # Coefficients up to 12 enlarge the rounding of about 7 stages of order 1.
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * np.finfo(float).eps)


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


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", NAMED)
def test_a_named_method_turns_a_symmetric_body_with_its_order(name):
    """Its momentum m turns about the third axis at the rate r = m3 (1 / I3 - 1 / I1).

    Its attitude is exp(t m(0) / I1) exp(t r e3).
    """
    cls, order = getattr(cfjax, name), SOLVERS[name].order
    inertia, m0, t1 = np.array([1.0, 1.0, 0.4]), np.array([0.8, 0.3, 0.5]), 4.0

    def field(t, y, args):
        w = y["m"] / inertia
        q = cfjax.QuaternionRotation(w, frame="body", layout="wxyz")
        return {"q": q, "m": cfjax.Rotation(-w)}

    def turn(w):
        angle = np.linalg.norm(w)
        return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * w / angle)])

    rate = m0[2] * (1 / inertia[2] - 1 / inertia[0])
    p, q = turn(t1 * m0 / inertia[0]), turn(t1 * rate * np.array([0.0, 0.0, 1.0]))
    exact = np.array(
        [p[0] * q[0] - p[1:] @ q[1:], *(p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:]))]
    )
    y0 = {"q": jnp.eye(4)[0], "m": jnp.asarray(m0)}

    def off(n):
        end = cfjax.integrate(cfjax.LieTerm(field), cls(), 0.0, t1, y0, num_steps=n).ys["q"][-1]
        return np.abs(np.asarray(end) - exact).max()

    # The largest that are small enough: the errors are still a hundred roundings.
    steps = {5: (32, 64), 8: (8, 16)}[order]
    found = np.array(list(map(off, steps)))
    assert found[1] > 1e-13
    # With the next order's term, which adds a step size times a number of the problem.
    assert abs(problems.slope(steps, found) - order) < 0.4


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
        *((cfjax.RKMK, x.tableau, ValueError, explicit) for x in (diffrax.Kvaerno3,)),
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


@pytest.mark.slow
def test_output_within_steps_in_coordinates_of_the_step():
    """More stages than the step has, for fields whose span grows with every stage."""
    a = problems.GENERATORS[0] / 2

    def velocity(xp, t, y):
        return xp.sin(t) * (a @ y) + xp.cos(2 * t) * a[0]

    def ode(t, y):
        g = velocity(np, t, y)
        return g - y * (y @ g)

    y0, ts = np.full(4, 0.5), np.linspace(0, 1, 8)
    exact = scipy.integrate.solve_ivp(
        ode, (0, 1), y0, method="DOP853", rtol=2.3e-14, atol=1e-15, t_eval=ts
    )
    term = cfjax.LieTerm(lambda t, y, args: cfjax.SphereRotation(velocity(jnp, t, y)))
    solver = cfjax.RKMK(diffrax.Dopri8.tableau)
    off = []
    for h in (0.2, 0.1):
        sol = diffrax.diffeqsolve(
            term, solver, 0.0, 1.0, h, jnp.asarray(y0), saveat=diffrax.SaveAt(ts=ts)
        )
        assert sol.ys is not None
        off.append(np.abs(sol.ys - exact.y.T).max())
    # Halved steps divide the error by 2^8. Order 5 within would leave more than 1e-9.
    assert off[0] < 1e-7
    assert off[1] < max(off[0] / 100, 1e-13)
