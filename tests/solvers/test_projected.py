"""`Projected`: stages in plain space, and the end of each step on the manifold."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import matrix_checks
import matrix_problems
import numpy as np
import problems
import pytest
import scipy.linalg
from matrix_checks import product
from matrix_problems import PROBLEMS, Problem, skew
from scipy.linalg import expm

import cfjax

TSIT5, DOPRI8 = cfjax.Projected(diffrax.Tsit5()), cfjax.Projected(diffrax.Dopri8())
# Programs with one stage for all compile faster, and so do those of few stages.
SHORT = cfjax.Projected(diffrax.Heun())
ROLLED = {
    "Tsit5": cfjax.Projected(diffrax.Tsit5(), unroll=False),
    "Dopri8": cfjax.Projected(diffrax.Dopri8(), unroll=False),
}
# Steps to t = 2 that leave more than rounding.
STEPS = {"Tsit5": (16, 32, 64), "Dopri8": (6, 8, 12)}


def some(*names):
    return {name: PROBLEMS[name] for name in names}


# Each class of fields and of coordinates.
FEW = some("columns", "rows", "orthonormal columns, low rank", "Toda", "Riccati")


@pytest.mark.parametrize(
    "given, name",
    [
        pytest.param(FEW, "Tsit5", id="few-Tsit5"),
        pytest.param(PROBLEMS, "Tsit5", id="all-Tsit5", marks=pytest.mark.slow),
        pytest.param(PROBLEMS, "Dopri8", id="all-Dopri8", marks=pytest.mark.slow),
    ],
)
def test_order_and_manifold_against_exact_answers(given, name, subtests):
    """Tsitouras' error terms of order 5 are so small that the next show, up to half an order."""
    slopes, few = (-0.3, 1.1), (2.0, 16 if name == "Tsit5" else 3)
    matrix_checks.check_order(subtests, ROLLED[name], given, STEPS[name], slopes, few)


def spinning(t, y, args):
    b, c = args
    return cfjax.LeftMatrix(jnp.cos(t) * b + jnp.sin(2 * t) * y @ c @ y.T)


@pytest.mark.slow
def test_many_steps_stay_on_the_manifold(subtests):
    fields = {
        "SO(5)": (spinning, np.eye(5), (skew(5), skew(5))),
        "columns": (spinning, matrix_problems.COLUMNS, (skew(6), skew(3) / 3)),
    }
    given = {name: Problem(*x, exact=None) for name, x in fields.items()}
    matrix_checks.check_many_steps(subtests, ROLLED["Tsit5"], given, 100_000, is_relative=True)


def test_columns_that_start_off_by_rounding_become_orthonormal():
    """As by other methods. A matrix that acts from one side keeps the products as they are."""
    given = product(some("orthonormal columns, low rank", "bordered"))
    y0 = {name: y * (1 + 1e-9) for name, y in given.y0.items()}
    for end in given._replace(y0=y0).end(SHORT, 0.1, 1).values():
        np.testing.assert_allclose(end.T @ end, np.eye(3), rtol=0, atol=2e-15)


# One step against formulas written by hand


def by_hand(problem, tableau, h):
    """The end of the step in plain space, its estimate, and the phase of the determinant."""
    rates, phases = [], []
    for c, row in zip((0.0, *tableau.c), ((), *tableau.a_lower), strict=True):
        y = problem.y0 + sum((a * k for a, k in zip(row, rates, strict=True)), 0 * problem.y0)
        field = problem.field(c * h, jnp.asarray(y), problem.args)
        rates.append(h * np.asarray(cfjax.tangent(field, jnp.asarray(y))))
        phases.append(h * np.trace(np.asarray(field.a)).imag)
    pairs = zip(tableau.b_sol, tableau.b_error, rates, strict=True)
    weighted = [(b * k, e * k) for b, e, k in pairs]
    phase = tableau.b_sol @ phases
    return problem.y0 + sum(x for x, _ in weighted), sum(x for _, x in weighted), phase


def test_one_step_and_its_estimates():
    """The unitary matrix nearest to the end in plain space, whose determinant follows the traces,
    with the estimate from there.

    Where matrices act from both sides, the estimate is by an element d of the algebra, which moves
    the end by `d y + y d^H`. Between the ends of both methods is the same but for products of d and
    the element of the step, whose norm is at most 1.5 times the length of the step.
    """
    # Not first same as last: there the last velocity is that at the projected end.
    given, tableau = some("SU(3)", "Riccati"), diffrax.Heun.tableau
    flows = product(given)
    y0, args = problems.arrays((flows.y0, flows.args))

    @jax.jit
    def step(h):
        by_algebra, by_ends = (
            problems.first_step(solver, flows.term, jnp.asarray(0.0), h, y0, args)[:2]
            for solver in (SHORT, SHORT._with(estimate="group"))
        )
        return *by_algebra, by_ends[1]["Riccati"]

    for h in (0.2, 0.1):
        ends, errors, by_ends = step(jnp.asarray(h))
        plain, estimate, phase = by_hand(given["SU(3)"], tableau, h)
        nearest, _ = scipy.linalg.polar(plain)
        ratio = np.linalg.det(nearest) / np.linalg.det(given["SU(3)"].y0)
        nearest *= np.exp(1j * (phase - np.angle(ratio)) / 3)
        assert np.abs(plain - nearest).max() > 1e-9
        # Stages of a few rounded products.
        np.testing.assert_allclose(ends["SU(3)"], nearest, rtol=0, atol=2e-14)
        np.testing.assert_allclose(errors["SU(3)"], estimate, rtol=0, atol=2e-14)
        off = np.linalg.norm(errors["Riccati"] - by_ends)
        assert off < 1.5 * h * np.linalg.norm(by_ends)


# Output within steps, derivatives, batches, precision


@pytest.mark.parametrize(
    "solver, steps",
    [
        (cfjax.Projected(diffrax.Bosh3()), (10, 20)),
        pytest.param(ROLLED["Dopri8"], (4, 8), marks=pytest.mark.slow),
    ],
    ids=["Bosh3", "Dopri8"],
)
def test_output_within_steps(solver, steps, subtests):
    matrix_checks.check_output(subtests, solver, some("SO(5)", "Toda"), steps)


# Constant steps compute no estimate.
CONSTANT = SHORT.without_estimate()


@pytest.mark.parametrize("name", ["columns", pytest.param("Toda", marks=pytest.mark.slow)])
def test_derivatives_are_those_of_difference_quotients(name):
    matrix_checks.check_derivatives(CONSTANT, some(name), 2e-11)


# Batches of matrices from one side are below.
REST = "SU(3)", "columns", "rows", "Riccati", "bordered", "orthonormal columns, low rank"


@pytest.mark.parametrize("names", [("Toda",), pytest.param(REST, marks=pytest.mark.slow)])
def test_vmap_and_leading_axes_are_single_solves(names):
    matrix_checks.check_batches(CONSTANT, some(*names))


def test_single_precision():
    # Some tens of roundings of numbers up to 3.
    matrix_checks.check_single_precision(ROLLED["Tsit5"], some("columns", "Toda"), 2e-5)


def test_more_columns_than_rows_turn_as_one():
    """As the columns that they are combinations of."""
    rng = np.random.default_rng(1)
    b, y0, wide = rng.normal(size=(3, 3)), np.eye(3), rng.normal(size=(3, 7))
    b = b - b.T

    def field(t, y, args):
        a = jnp.cos(t) * jnp.asarray(b)
        return {
            "frame": cfjax.LeftMatrix(a),
            "wide": cfjax.LeftMatrix(a),
            "rows": cfjax.RightMatrix(a),
        }

    start = problems.arrays({"frame": y0, "wide": wide, "rows": wide.T})
    ys: Any = cfjax.integrate(cfjax.LieTerm(field), SHORT, 0.0, 1.0, start, num_steps=5).ys
    turn = np.asarray(ys["frame"][-1])
    assert np.abs(turn - y0).max() > 0.5
    # Products of an inverse of condition 10.
    np.testing.assert_allclose(ys["wide"][-1], turn @ wide, rtol=0, atol=1e-13)
    gram = ys["rows"][-1].T @ ys["rows"][-1]
    np.testing.assert_allclose(
        np.linalg.eigvalsh(gram), np.linalg.eigvalsh(wide @ wide.T), rtol=1e-13
    )


# Errors at run time


def test_a_matrix_that_is_not_skew_is_an_error(subtests):
    """But for rounding. From the start, within the first step, or in the last stage of all alone;
    also one of two elements.
    """
    a, unit = skew(3), np.eye(3)
    spoilt = np.zeros((3, 3))
    spoilt[0, 0] = 1.0
    fields = {"left": cfjax.LeftMatrix, "right": cfjax.RightMatrix, "batch": cfjax.LeftMatrix}
    y0 = problems.arrays({"left": unit, "right": unit, "batch": np.stack([unit] * 2)})
    skews = {"left": a, "right": a, "batch": np.stack([a, -a])}
    none = {name: 0 * x for name, x in skews.items()}

    def field(t, y, args):
        more, since = args
        # The projection alone would bring the end back.
        return {x: cls(skews[x] + jnp.where(t > since, more[x], 0)) for x, cls in fields.items()}

    def end(more, since):
        args = problems.arrays((none | more, since))
        return cfjax.integrate(cfjax.LieTerm(field), SHORT, 0.0, 1.0, y0, args, num_steps=2).ys

    rounding = {name: x + 1e-14 * spoilt for name, x in none.items()}
    expected = end({}, -1.0)
    problems.assert_close(end(rounding, -1.0), expected, 1e-12)
    # Each element alone. The other way round it is the transpose, for matrices that commute.
    left = expected["left"][-1]
    problems.assert_close(expected["batch"][-1], np.stack([left, left.T]), 1e-14)
    cases = {"left": 1e-9 * spoilt, "right": 1e-9 * spoilt, "batch": none["batch"].copy()}
    cases["batch"][1] = 1e-9 * spoilt
    for name, more in cases.items():
        for since in (-1.0, 0.1, 0.999):
            match = "skew-Hermitian" if since < 0 else matrix_checks.FAILS
            with subtests.test(case=(name, since)), pytest.raises(RuntimeError, match=match):
                end({name: more}, since)


def test_a_matrix_of_nan_fails_alone():
    """It is no matrix that is not skew: such an error would end the batch."""
    term, y0 = cfjax.LieTerm(lambda t, y, a: cfjax.LeftMatrix(a)), jnp.eye(3)

    @jax.jit
    @jax.vmap
    def solve(a):
        sol = cfjax.integrate(term, SHORT, 0.0, 1.0, y0, a, num_steps=50, throw=False)
        return sol.ys[-1], sol.result == diffrax.RESULTS.successful

    good = skew(3)
    bad = good * np.array([[1, np.nan, 1], [1, 1, 1], [1, 1, 1]])
    ys, are_successful = solve(np.stack([good, bad]))
    np.testing.assert_array_equal(are_successful, [True, False])
    # Steps of order 2, of angles of 0.02: the square over 6.
    np.testing.assert_allclose(ys[0], expm(good), rtol=0, atol=1e-4)
    assert np.isnan(ys[1]).all()


def test_columns_without_full_rank_are_an_error(subtests):
    a = jnp.asarray(skew(3))
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(a))
    for name, y0 in {"zero": jnp.zeros((3, 2)), "equal columns": jnp.ones((3, 2))}.items():
        with subtests.test(name=name):
            with pytest.raises(RuntimeError, match="columns or rows of full rank"):
                cfjax.integrate(term, SHORT, 0.0, 1.0, y0, num_steps=2)


@pytest.mark.slow
def test_output_of_a_matrix_that_is_not_skew_is_nan():
    """The last of the stages for output alone has no other after it that would show it."""
    a, time = jnp.asarray(skew(3)), DOPRI8._extension.times[-1]
    assert 0 < time < 1
    assert time not in DOPRI8.c

    def field(t, y, time):
        return cfjax.LeftMatrix(a.at[0, 0].add(jnp.where(jnp.abs(t - time) < 1e-9, 1e-3, 0.0)))

    @jax.jit
    def output(time):
        options: Any = {"saveat": diffrax.SaveAt(ts=jnp.asarray([0.3, 0.6]))}
        term, y0 = cfjax.LieTerm(field), jnp.eye(3)
        return diffrax.diffeqsolve(term, DOPRI8, 0.0, 1.0, 1.0, y0, time, **options).ys

    assert np.isfinite(output(-1.0)).all()
    assert np.isnan(output(time)).all()


def test_a_step_that_is_too_long_fails_and_is_taken_again(subtests):
    """Nearly half a turn for an element in Cayley's coordinates; of columns, an end too far off."""
    cases: Any = {"Congruence": (cfjax.Congruence, np.array(3.0))}
    cases["LeftMatrix"] = cfjax.LeftMatrix, np.array(4.0)
    matrix_checks.check_steps_that_are_too_long(subtests, ROLLED["Tsit5"], cases)


@pytest.mark.slow
def test_a_rejected_step_has_no_derivative():
    found = matrix_checks.slope_of_a_controlled_turn(TSIT5, cfjax.Congruence)
    # The entry is (3 - cos(2 angle)) / 2.
    np.testing.assert_allclose(found, 3 * np.sin(6), rtol=0, atol=1e-5)
