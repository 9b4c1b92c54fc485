"""Munthe-Kaas methods: order, brackets, what they refuse, and that they never trace twice."""

import subprocess
import sys
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
from cfjax.scenes import heavy_top, spacecraft

ROWS: dict[str, Row] = {name: SOLVERS[name] for name in ("RKMK3", "RKMK4")} | MUNTHE_KAAS
METHODS: dict[str, Any] = {name: row.make() for name, row in ROWS.items()}
# A program of 13 stages is for few tests.
SHORT = [name for name in ROWS if name != "Dopri8"]
names = pytest.mark.parametrize("name", SHORT)

# As in test_commutator_free.py. Steps down to 1/128 leave 2e-12 for order 5, 20 times the error
# of the reference.
STEPS = (16, 32, 64, 128)
TOLERANCE = 0.15


# Order


def observed_order(problem, solver, **kwargs) -> float:
    field, y0, args, answer = problem
    found = problems.errors(field, solver, 1.0, y0, args, answer, STEPS, **kwargs)
    assert found.min() > 10 * problems.REFERENCE_ERROR
    assert found.max() < 1
    return problems.slope(STEPS, found)


@pytest.mark.parametrize(
    "side, name",
    [
        pytest.param(side, name, marks=[pytest.mark.slow] * ((side, name) != ("left", "RKMK4")))
        for side in ("left", "right")
        for name in SHORT
    ],
)
def test_order_on_matrices(matrix_problems, side, name):
    solver, order = METHODS[name], ROWS[name].order
    assert solver.order(None) == order
    assert abs(observed_order(matrix_problems[side], solver) - order) < TOLERANCE


# Dopri5 and Tsit5 meet the error of the reference here before their order shows: their test is in
# scenes/test_rigid_body.py.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["RKMK3", "RKMK4", "Heun", "Bosh3"])
def test_order_on_the_sphere(body_problem, name):
    assert abs(observed_order(body_problem, METHODS[name]) - ROWS[name].order) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", ["RKMK3", "RKMK4", "Bosh3"])
def test_order_on_a_product_of_manifolds(flight_problem, name):
    assert abs(observed_order(flight_problem, METHODS[name]) - ROWS[name].order) < TOLERANCE


class WrongSide(cfjax.LeftMatrix):
    """A matrix that acts from the left with the bracket of one that acts from the right."""

    def bracket(self, other):
        return type(self)(-(cfjax.LeftMatrix.bracket(self, other).a))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["RKMK3", "RKMK4", "Bosh3"])
def test_a_mistaken_sign_of_the_bracket_loses_the_order(matrix_problems, name):
    """The problem sees it: with the other sign every method here is of order 2."""
    _, y0, args, answer = matrix_problems["left"]

    def field(t, y, args):
        return WrongSide(problems.generator(jnp, t, y, args))

    order = observed_order((field, y0, args, answer), METHODS[name])
    assert abs(order - 2) < TOLERANCE


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["RKMK4", "Tsit5"])
def test_a_mistaken_stage_time_loses_the_order(matrix_problems, name):
    order = observed_order(matrix_problems["left"], METHODS[name], ignore_stage_times=True)
    assert abs(order - 1) < TOLERANCE


@pytest.mark.parametrize(
    "tableau, order",
    [
        (diffrax.Midpoint.tableau, 2),
        (diffrax.Ralston.tableau, 2),
        (diffrax.Heun.tableau, 2),
        pytest.param(diffrax.Dopri8.tableau, 8, marks=pytest.mark.slow),
    ],
)
def test_the_order_is_the_tableaus(tableau, order):
    assert cfjax.RKMK(tableau).order(None) == order


# One step against formulas written by hand, with SciPy's exponential


def one_step(solver, field, y0, t0=0.3, h=0.25, args=None, term=cfjax.LieTerm, which=0):
    @jax.jit
    def step(t0, t1, y0, args):
        return problems.first_step(solver, term(field), t0, t1, y0, args)[which]

    return step(jnp.asarray(t0), jnp.asarray(t0 + h), problems.arrays(y0), problems.arrays(args))


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


@pytest.mark.representatives(1)
@pytest.mark.parametrize("estimate", ["algebra", "group"])
@pytest.mark.parametrize(
    "name", ["RKMK3", "Heun", "Bosh3", pytest.param("Tsit5", marks=pytest.mark.slow)]
)
def test_the_estimate_is_what_the_embedded_method_says(name, estimate):
    y0, t0, h = problems.ORTHOGONAL, 0.3, 0.25

    def f(t, y):
        return problems.generator(np, t, y, problems.GENERATORS)

    v = by_hand(name, f, t0, y0, h)
    if name == "RKMK3":
        # The midpoint rule.
        embedded = h * f(t0 + h / 2, scipy.linalg.expm(h / 2 * f(t0, y0)) @ y0)
        solver = cfjax.RKMK3(estimate=estimate)
    else:
        tableau = getattr(diffrax, name).tableau
        embedded = by_hand(name, f, t0, y0, h, tableau.b_sol - tableau.b_error)
        solver = cfjax.RKMK(tableau, estimate=estimate)
    y1 = scipy.linalg.expm(v) @ y0
    if estimate == "algebra":
        expected = (v - embedded) @ y1
    else:
        expected = y1 - scipy.linalg.expm(embedded) @ y0
    assert np.linalg.norm(expected) > 1e-5
    found = one_step(solver, problems.left_matrix, y0, args=problems.GENERATORS, which=1)
    # As below.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)
    # Seen from a turned frame, all is turned, and so is the estimate.
    turn = scipy.linalg.expm(problems.GENERATORS[1] - problems.GENERATORS[1].T)

    def turned(t, z, args):
        return cfjax.LeftMatrix(turn @ problems.generator(jnp, t, turn.T @ z, args) @ turn.T)

    found = one_step(solver, turned, turn @ y0, args=problems.GENERATORS, which=1)
    np.testing.assert_allclose(found, turn @ expected, rtol=0, atol=2e-14)


@pytest.mark.parametrize(
    "name",
    ["RKMK3", *(pytest.param(n, marks=pytest.mark.slow) for n in ("Bosh3", "Tsit5", "Dopri8"))],
)
def test_the_estimate_falls_with_the_order_of_the_embedded_method(name):
    """Like h^p: on a group that does not commute, in state and time."""
    solver = METHODS[name]
    order = solver.order(None)
    assert solver.error_order(None) == order
    # Longer steps at high order, whose estimate would else meet rounding.
    steps = np.array([1.0, 0.5, 0.25]) / {3: 16, 5: 8, 8: 1.6}[order]
    start, args = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)

    @jax.jit
    def estimate(h):
        term, t0 = cfjax.LieTerm(problems.driven_body), jnp.asarray(0.3)
        return problems.first_step(solver, term, t0, t0 + h, start, args)[1]

    sizes = np.array([np.linalg.norm(estimate(h)) for h in steps])
    assert sizes.min() > 1e-14
    # Steps of order 8 are long, and what comes after the leading term shows.
    assert abs(problems.slope(1 / steps, sizes) - order) < (0.4 if order == 8 else 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Tsit5", "Dopri8"])
def test_error_control_keeps_to_its_tolerance(name):
    """Quaternions and momentum, against the closed form in Jacobi's elliptic functions."""
    inertia = jnp.asarray(spacecraft.inertia)

    def field(t, y, args):
        omega = y["m"] / inertia
        q = cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")
        return {"q": q, "m": jnp.cross(y["m"], omega)}

    solver = cfjax.RKMK(getattr(diffrax, name).tableau)
    off = errors_of_control(field, solver, spacecraft, 10.0, spacecraft.reference(10.0), None)
    assert (off < 10).all()


@pytest.mark.slow
def test_error_control_of_the_heavy_top():
    """Against SciPy in plain space; 30 radians, in steps of up to 3 at the loosest tolerance.

    There some ten steps are all, and the errors reach 14 tolerances; from 1e-8 on 8.
    """
    solver = cfjax.RKMK(diffrax.Dopri8.tableau)
    answer = heavy_top.reference(0.2)
    off = errors_of_control(heavy_top.field, solver, heavy_top, 0.2, answer, heavy_top.benchmark)
    assert (off[:4] < 20).all()
    assert (off[4:] < 10).all()


def errors_of_control(field, solver, scene, t1, answer, args):
    """In tolerances, from 1e-4 to 1e-11."""
    tolerances = 10.0 ** -np.arange(4, 12)

    @jax.jit
    def end(tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        first = 0.03 * t1 * tolerance ** (1 / 8)
        y0 = problems.arrays(scene.y0())
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            solver,
            0.0,
            t1,
            first,
            y0,
            args,
            stepsize_controller=control,
            max_steps=10_000,
        )
        return jax.tree_util.tree_map(lambda y: y[-1], sol.ys)

    return np.array([scene.error(end(tol), answer) / tol for tol in tolerances])


@names
def test_one_step_is_the_published_formula(name):
    y0, t0, h = problems.ORTHOGONAL, 0.3, 0.25

    def f(t, y):
        return problems.generator(np, t, y, problems.GENERATORS)

    expected = scipy.linalg.expm(by_hand(name, f, t0, y0, h)) @ y0
    found = one_step(METHODS[name], problems.left_matrix, y0, args=problems.GENERATORS)
    # At most 7 stages of a few rounded products of size 4. The terms that a wrong coefficient
    # would change are of order (h |A|)^5 / 720, or 1e-3.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)


@pytest.mark.slow
@names
def test_one_step_from_the_right_is_the_transposed_one(name):
    def transposed(t, x, args):
        return cfjax.RightMatrix(problems.generator(jnp, t, x.T, args).T)

    y0, args = problems.ORTHOGONAL, problems.GENERATORS
    left = one_step(METHODS[name], problems.left_matrix, y0, args=args)
    right = one_step(METHODS[name], transposed, y0.T, args=args)
    # As above: both are one formula, evaluated in another order.
    np.testing.assert_allclose(right, left.T, rtol=0, atol=2e-14)


class LongSeries(cfjax.LeftMatrix):
    """Matrices whose series is as good as exact, as the closed form of rotations is."""

    def dexpinv(self, other, degree):
        # A step turns by less than 1: what is left out is below (1 / 2 pi)^20 = 1e-16.
        return super().dexpinv(other, 18)


@pytest.mark.representatives(1)
@names
def test_rotations_agree_with_their_matrices(name):
    def as_matrices(t, y, args):
        x, y, z = problems.driven_body(t, y, args).omega
        o = jnp.zeros_like(x)
        rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
        return LongSeries(jnp.stack([jnp.stack(row) for row in rows]))

    y0, args = problems.MOMENTUM, problems.INERTIA
    found = one_step(METHODS[name], problems.driven_body, y0, args=args)
    expected = one_step(METHODS[name], as_matrices, y0, args=args)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def classical(tableau, f, t, y, h):
    stages = []
    for row in [[], *tableau.a_lower]:
        point = y + sum((a * k for a, k in zip(row, stages, strict=True)), start=0 * y)
        stages.append(h * f(t + sum(row) * h, point))
    return y + sum(b * k for b, k in zip(tableau.b_sol, stages, strict=True))


@pytest.mark.representatives(5)
@pytest.mark.parametrize("term", [cfjax.LieTerm, diffrax.ODETerm])
@pytest.mark.parametrize("shape", [(3,), (9,), (2, 3)])
@pytest.mark.parametrize("name", ["Heun", "Bosh3", "Dopri5", "Tsit5"])
def test_in_a_linear_space_it_is_the_classical_method(name, shape, term):
    def ode(xp, t, y):
        return xp.sin(y * t) - y[::-1] ** 2 / 2 + xp.cos(t)

    y0 = np.random.default_rng(2).standard_normal(shape)
    found = one_step(METHODS[name], lambda t, y, args: ode(jnp, t, y), y0, term=term)
    tableau = getattr(diffrax, name).tableau
    expected = classical(tableau, lambda t, y: ode(np, t, y), 0.3, y0, 0.25)
    # Coefficients up to 12 enlarge the rounding of about 7 stages of order 1.
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * np.finfo(float).eps)


@pytest.mark.slow
@names
def test_a_constant_field_is_followed_exactly(name):
    """From no turn to several turns in one step, in both directions of time."""
    a = problems.GENERATORS[0] - problems.GENERATORS[0].T

    @jax.jit
    def step(h):
        term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(args))
        y0, args = jnp.eye(4), jnp.asarray(a)
        return problems.first_step(METHODS[name], term, 0 * h, h, y0, args)[0]

    for h in (0.0, 0.25, -1.0, 8.0):
        # Brackets of an element with its multiples vanish up to rounding: |h a|^2 eps, and up to
        # two brackets inside each other. The norm of a is 5.3.
        atol = 1e-14 * (1 + 6 * abs(h)) ** 3
        found = step(jnp.asarray(h))
        np.testing.assert_allclose(found, scipy.linalg.expm(h * a), rtol=0, atol=atol)


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


@pytest.mark.representatives(5)
@pytest.mark.parametrize(
    "name, evaluations, flows, brackets",
    [("RKMK3", 3, 3, 1), ("RKMK4", 4, 4, 2), ("Heun", 2, 2, 0), ("Bosh3", 3, 3, 2)],
)
@pytest.mark.parametrize("shape", [(3,), (4, 4)])
def test_a_step_costs_what_its_docstring_says(name, evaluations, flows, brackets, shape):
    counts = count_step(METHODS[name].without_estimate(), jnp.ones(shape))
    assert counts == {"evaluations": evaluations, "flows": flows, "brackets": brackets}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["Dopri5", "Tsit5"])
def test_a_method_of_order_five_keeps_within_its_brackets(name):
    """Two for each stage but the first, and no evaluation for a stage without weight."""
    solver = METHODS[name]
    counts = count_step(solver.without_estimate(), jnp.ones((4, 4)))
    assert counts == {"evaluations": 6, "flows": 6, "brackets": 5 * 2}
    # With the estimate the last evaluation is the first of the next step.
    assert solver.first_same_as_last
    counts = count_step(solver, jnp.ones((4, 4)))
    assert counts == {"evaluations": 6, "flows": 6, "brackets": 6 * 2}


# Of which tableau, evaluations that only output within the step takes, and brackets of a stage.
NAMED = {"RKMK5": (diffrax.Tsit5, 0, 2), "RKMK8": (diffrax.Dopri8, 4, 6)}


@pytest.mark.parametrize("name", NAMED)
def test_a_named_method_is_that_of_its_tableau(name):
    cls, (plain, within, brackets) = getattr(cfjax, name), NAMED[name]
    solver, same = cls(), cfjax.RKMK(plain.tableau)
    for row in "a", "b", "b_error", "c":
        assert getattr(solver, row) == getattr(same, row)
    assert solver.order(None) == SOLVERS[name].order
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


class Shear(cfjax.AbstractFrozenField):
    """A frozen field without a bracket."""

    v: jax.Array

    def flow(self, point):
        return point + self.v

    def tangent(self, point):
        return self.v


@pytest.mark.representatives(4)
@names
@pytest.mark.parametrize("nested", [False, True])
def test_a_field_without_bracket_is_refused_by_name(name, nested):
    def field(t, y, args):
        return {"a": -y["a"], "b": Shear(-y["b"])} if nested else Shear(-y)

    y0 = {"a": jnp.ones(3), "b": jnp.ones(3)} if nested else jnp.ones(3)
    term = cfjax.LieTerm(field)
    with pytest.raises(TypeError, match=r"Shear has none.*commutator-free.*cfjax\.CF4\(\)"):
        diffrax.diffeqsolve(term, METHODS[name], 0.0, 1.0, 0.1, y0)
    # The method it recommends takes the field. y' = -y on the step (0, 1) by the classical method.
    y1 = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=1).ys
    for leaf in jax.tree_util.tree_leaves(y1):
        np.testing.assert_allclose(leaf, np.full((1, 3), 3 / 8), rtol=1e-15)


@pytest.mark.parametrize("solver", [diffrax.Kvaerno3, diffrax.Kvaerno5])
def test_an_implicit_tableau_is_refused(solver):
    with pytest.raises(ValueError, match="tableau must be explicit, got one of an implicit method"):
        cfjax.RKMK(solver.tableau)


@pytest.mark.parametrize(
    "tableau", [None, 4, cfjax.CF4.tableau, diffrax.Dopri5(), [[0.5]], diffrax.KenCarp4.tableau]
)
def test_only_a_diffrax_tableau_makes_a_method(tableau):
    # The import hook of the test suite may answer first, see below.
    with pytest.raises(TypeError, match="tableau"):
        cfjax.RKMK(tableau)


def test_messages_of_wrong_arguments_without_the_import_hook():
    """In a Python without the import hook, which otherwise answers before the package does."""
    script = r"""
import cfjax, diffrax, pytest
for tableau in (None, 4, cfjax.CF4.tableau, diffrax.Dopri5(), diffrax.KenCarp4.tableau):
    with pytest.raises(TypeError, match=r"tableau must be a diffrax\.ButcherTableau, got "):
        cfjax.RKMK(tableau)
for tableau in (None, [[[]], [[1]]], diffrax.Tsit5.tableau, cfjax.CF4()):
    with pytest.raises(TypeError, match=r"tableau must be a cfjax\.Tableau, got "):
        cfjax.CommutatorFree(tableau)
for term in (None, lambda t, y, args: y, [1]):
    with pytest.raises(TypeError, match="term must be a diffrax term.*LieTerm"):
        cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, 1.0, num_steps=2)
for solver in (None, cfjax.CF4):
    with pytest.raises(TypeError, match="solver must be a diffrax solver.*CF4"):
        cfjax.integrate(cfjax.LieTerm(print), solver, 0.0, 1.0, 1.0, num_steps=2)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)


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


def test_equal_solvers_do_not_trace_again():
    traces = 0

    def field(t, y, args):
        nonlocal traces
        traces += 1
        return -y

    term = cfjax.LieTerm(field)

    def solve(solver, y):
        cfjax.integrate(term, solver, 0.0, 1.0, jnp.asarray([y]), num_steps=2)
        return traces

    first = solve(cfjax.RKMK(diffrax.Dopri5.tableau), 1.0)
    assert first > 0
    assert solve(cfjax.RKMK(diffrax.Dopri5.tableau), 2.0) == first
    assert solve(cfjax.RKMK(diffrax.Tsit5.tableau), 2.0) > first


@pytest.mark.parametrize("given", [diffrax.Dopri8(), diffrax.Dopri8])
def test_a_solver_in_place_of_its_tableau(given, no_shape_hook):
    with pytest.raises(TypeError, match=r"Write diffrax\.Dopri8\.tableau"):
        cfjax.RKMK(given)


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
