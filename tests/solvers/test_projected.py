"""`RKMK(..., coordinates="projected")`: stages in plain space, and the end on the manifold."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import matrix_problems
import numpy as np
import problems
import pytest
import scipy.linalg
from matrix_problems import BOTH, PROBLEMS, Problem, low_rank, skew
from scipy.linalg import expm

import cfjax

PROJECTED: Any = {"coordinates": "projected"}
RKMK5, RKMK8 = cfjax.RKMK5(**PROJECTED), cfjax.RKMK8(**PROJECTED)
SOLVERS = {"RKMK5": RKMK5, "RKMK8": RKMK8}
# Steps to t = 2 that leave more than rounding.
STEPS = {"RKMK5": (16, 32, 64), "RKMK8": (6, 8, 12)}


def fixed_of(problem, y):
    """What stays, by NumPy: a spectrum, or products of columns or rows."""
    if problem in ("Toda", "conjugation"):
        # Of matrices that are not symmetric, as eigenvalues may be ill-conditioned.
        return np.stack([np.trace(np.linalg.matrix_power(y, k)) for k in range(1, len(y) + 1)])
    return y @ y.conj().T if problem in ("rows", "SO(5), body frame") else y.conj().T @ y


@pytest.mark.representatives(12)
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("problem", PROBLEMS)
def test_order_against_exact_answers(problem, name):
    """On the manifold too, in the fewest steps, which are off by far more.

    Tsitouras' error terms of order 5 are so small that the next ones show, up to half an order.

    Mistakes in the coordinates leave order 2.
    """
    given, solver = PROBLEMS[problem], SOLVERS[name]
    order = {"RKMK5": 5, "RKMK8": 8}[name]
    assert solver.order(None) == order
    exact = given.exact(2.0).ravel()
    off = problems.errors(given.field, solver, 2.0, given.y0, given.args, exact, STEPS[name])
    # A hundred roundings of numbers up to 3.
    assert off.min() > 5e-14
    assert order - 0.3 < problems.slope(STEPS[name], off) < order + 1.1
    if problem == "Riccati":
        return
    times_and_state = problems.arrays((0.0, 2.0, given.y0, given.args, STEPS[name][0]))
    t0, t1, y0, args, n = times_and_state
    end = np.asarray(problems.many_steps(given.field, solver, t0, t1, y0, args, n))
    np.testing.assert_allclose(
        fixed_of(problem, end), fixed_of(problem, given.y0), rtol=0, atol=2e-14
    )


def spinning(t, y, args):
    b, c = args
    return cfjax.LeftMatrix(jnp.cos(t) * b + jnp.sin(2 * t) * y @ c @ y.T)


@pytest.mark.parametrize(
    "problem, num_steps",
    [
        pytest.param(problem, n, marks=[pytest.mark.slow] * (n > 10_000))
        for problem in ("SO(5)", "columns", "low rank", "Toda")
        for n in (10_000, 100_000)
    ],
)
def test_many_steps_stay_on_the_manifold(problem, num_steps):
    """With fields that vary, in steps of 0.1: the products of the start, to 5e-14."""
    fields = {
        "SO(5)": (spinning, np.eye(5), (skew(5), skew(5))),
        "columns": (spinning, matrix_problems.COLUMNS, (skew(6), skew(3) / 3)),
        "low rank": (low_rank, matrix_problems.ORTHONORMAL, (skew(6), skew(3))),
        # Periodic in time, as Toda's own flow comes to rest.
        "Toda": (
            lambda t, y, args: cfjax.Conjugation(
                jnp.cos(t) * args + jnp.triu(y, 1) - jnp.tril(y, -1)
            ),
            matrix_problems.LATTICE,
            skew(4),
        ),
    }
    given = Problem(*fields[problem], exact=lambda t: np.zeros(0))
    end = given.end(RKMK5, 0.1 * num_steps, num_steps)
    found, expected = (fixed_of(problem, y) for y in (np.asarray(end), given.y0))
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-14 * max(scale, 1))


@pytest.mark.parametrize("problem", ["orthonormal columns, low rank", "bordered"])
def test_columns_that_start_off_by_rounding_become_orthonormal(problem):
    """As by other methods. A matrix that acts from one side keeps the products as they are."""
    given = PROBLEMS[problem]
    end = given._replace(y0=given.y0 * (1 + 1e-9)).end(RKMK5, 0.1, 1)
    np.testing.assert_allclose(end.T @ end, np.eye(3), rtol=0, atol=2e-15)


# One step against formulas written by hand


def one_step(problem, solver, h, which):
    """What `solver.step` returns, its number `which`."""

    @jax.jit
    def step(y0, args):
        t0, t1 = jnp.asarray(0.0), jnp.asarray(h)
        return problems.first_step(solver, problem.term, t0, t1, y0, args)[which]

    return step(*problems.arrays((problem.y0, problem.args)))


def by_hand(problem, tableau, h):
    """The end of the step in plain space, its estimate, and the stages' velocities."""
    rates = []
    for c, row in zip((0.0, *tableau.c), ((), *tableau.a_lower), strict=True):
        y = problem.y0 + sum((a * k for a, k in zip(row, rates, strict=True)), 0 * problem.y0)
        field = problem.field(c * h, jnp.asarray(y), problem.args)
        rates.append(h * np.asarray(cfjax.tangent(field, jnp.asarray(y))))
    pairs = zip(tableau.b_sol, tableau.b_error, rates, strict=True)
    weighted = [(b * k, e * k) for b, e, k in pairs]
    return problem.y0 + sum(x for x, _ in weighted), sum(x for _, x in weighted)


@pytest.mark.parametrize("which", ["Dopri5", "Dopri8"])
def test_one_step_is_the_unitary_matrix_nearest_to_that_of_plain_space(which):
    given, tableau = PROBLEMS["SU(3)"], getattr(diffrax, which).tableau
    plain, _ = by_hand(given, tableau, 0.7)
    nearest, _ = scipy.linalg.polar(plain)
    assert np.abs(plain - nearest).max() > 1e-9
    found = one_step(given, cfjax.RKMK(tableau, **PROJECTED), 0.7, 0)
    # Stages of a few rounded products.
    np.testing.assert_allclose(found, nearest, rtol=0, atol=2e-14)


def test_the_estimate_is_that_of_plain_space():
    # Not first same as last: there the last velocity is that at the projected end.
    given, tableau = PROBLEMS["SO(5)"], diffrax.Dopri8.tableau
    _, estimate = by_hand(given, tableau, 0.7)
    found = one_step(given, cfjax.RKMK(tableau, **PROJECTED), 0.7, 1)
    np.testing.assert_allclose(found, estimate, rtol=0, atol=2e-14)


def test_the_estimate_of_a_flow_from_both_sides_is_of_its_end():
    """By an element d of the algebra, which moves the end by `d y + y d^H`.

    Between the ends of both methods is the same but for products of d and the element of the step,
    whose norm is at most 1.5 times the length of the step.
    """
    given = PROBLEMS["Riccati"]
    ends = cfjax.RKMK(diffrax.Dopri8.tableau, **PROJECTED, estimate="group")
    for h in (0.2, 0.1):
        algebra, group = (one_step(given, x, h, 1) for x in (cfjax.RKMK8(**PROJECTED), ends))
        assert np.linalg.norm(algebra - group) < 1.5 * h * np.linalg.norm(group)


def test_control_keeps_to_its_tolerance():
    y0, args = problems.arrays((BOTH.y0, BOTH.args))

    @jax.jit
    def end(tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        options: Any = {"stepsize_controller": control}
        sol = diffrax.diffeqsolve(BOTH.term, RKMK5, 0.0, 2.0, 0.05, y0, args, **options)
        return jax.tree_util.tree_map(lambda y: y[-1], sol.ys)

    exact, tolerances = problems.flat(BOTH.exact(2.0)), (1e-5, 1e-7, 1e-9)
    off = [np.abs(problems.flat(end(x)) - exact).max() / x for x in tolerances]
    # The estimate is of a step, and errors of steps add up.
    assert max(off) < 10
    assert min(off) > 1e-3


# Output within steps


@pytest.mark.parametrize(
    "name, problem",
    [
        ("RKMK5", "SO(5)"),
        ("RKMK8", "Toda"),
        pytest.param("RKMK5", "bordered", marks=pytest.mark.slow),
    ],
)
def test_output_within_steps(name, problem):
    given, order = PROBLEMS[problem], {"RKMK5": 5, "RKMK8": 8}[name]
    y0, args = problems.arrays((given.y0, given.args))
    ts = np.linspace(0.05, 2.0, 16)
    exact = np.stack([given.exact(t) for t in ts])
    steps, off = ((10, 20), []) if order == 5 else ((4, 8), [])

    @jax.jit
    def saved(h):
        return diffrax.diffeqsolve(
            given.term, SOLVERS[name], 0.0, 2.0, h, y0, args, saveat=diffrax.SaveAt(ts=ts)
        ).ys

    for n in steps:
        ys = np.asarray(saved(2.0 / n))
        off.append(np.abs(ys - exact).max())
        for y in ys:
            np.testing.assert_allclose(
                fixed_of(problem, y), fixed_of(problem, given.y0), rtol=0, atol=1e-14
            )
    # The end of a step has the order of the method, and is saved too.
    assert order - 1.5 < np.log2(off[0] / off[1]) < order + 1.3


# Derivatives


def test_derivatives_are_those_of_difference_quotients():
    y0, args = problems.arrays((BOTH.y0, BOTH.args))
    weights = problems.random_like(y0, 1)

    def field(t, y, s):
        return BOTH.term.prod(BOTH.field(t, y, args), s)

    def value(s):
        ys = cfjax.integrate(cfjax.LieTerm(field), RKMK5, 0.0, 1.0, y0, s, num_steps=4).ys
        return problems.inner(weights, jax.tree_util.tree_map(lambda y: y[-1], ys))

    s = jnp.asarray(1.1)
    expected = problems.central_difference(jax.jit(value), s, 1.0, 1e-3)
    derivatives = (jax.grad(value), jax.jacfwd(value))
    found = [jax.jit(f, compiler_options=problems.QUICK)(s) for f in derivatives]
    # Rounding over the step of the quotient, and 1e-12 of its fourth power.
    np.testing.assert_allclose(found, [expected] * 2, rtol=0, atol=2e-11)


# Batches, precision, products of manifolds


def each_problem(*slow):
    given = [pytest.param(PROBLEMS[x], marks=pytest.mark.slow, id=x) for x in slow]
    return pytest.mark.parametrize("given", [pytest.param(BOTH, id="both"), *given])


@each_problem("SU(3)", "rows", "Riccati", "bordered", "orthonormal columns, low rank")
def test_vmap_and_leading_axes_are_single_solves(given):
    matrix_problems.check_batches(given, RKMK5, lambda scale, field: given.term.prod(field, scale))


def test_single_precision():
    y0, args = jax.tree_util.tree_map(lambda x: np.asarray(x, np.float32), (BOTH.y0, BOTH.args))
    end: Any = BOTH._replace(y0=y0, args=args).end(RKMK5, 2.0, 20)
    assert {x.dtype for x in jax.tree_util.tree_leaves(end)} == {jnp.dtype("float32")}
    # Some tens of roundings of numbers up to 3.
    problems.assert_close(end, BOTH.exact(2.0), 2e-5)


# Refusals


def test_more_columns_than_rows_are_refused():
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(jnp.zeros((2, 2))))
    with pytest.raises(ValueError, match=r"at most 2 vectors.*got shape \(2, 3\).*cfjax\.CF4"):
        cfjax.integrate(term, RKMK5, 0.0, 1.0, jnp.ones((2, 3)), num_steps=2)


# Errors at run time


@pytest.mark.parametrize(
    "cls, is_batch",
    [
        (cfjax.LeftMatrix, False),
        (cfjax.LeftMatrix, True),
        pytest.param(cfjax.RightMatrix, False, marks=pytest.mark.slow),
    ],
)
def test_a_matrix_that_is_not_skew_is_an_error(cls, is_batch):
    a, y0 = jnp.asarray(skew(3)).at[0, 0].add(1e-9), jnp.eye(3)
    if is_batch:
        a, y0 = jnp.stack([jnp.asarray(skew(3)), a]), jnp.stack([y0] * 2)
    term = cfjax.LieTerm(lambda t, y, args: cls(a))
    message = "skew-Hermitian"
    with pytest.raises(RuntimeError, match=message):
        cfjax.integrate(term, RKMK5, 0.0, 1.0, y0, num_steps=2)
    control = diffrax.PIDController(rtol=0.0, atol=1e-5)
    with pytest.raises(RuntimeError, match=message):
        diffrax.diffeqsolve(term, RKMK5, 0.0, 1.0, 0.1, y0, stepsize_controller=control)


def test_a_matrix_of_nan_fails_alone():
    """It is no matrix that is not skew: such an error would end the batch."""
    solver = cfjax.RKMK(diffrax.Bosh3.tableau, **PROJECTED)
    term, y0 = cfjax.LieTerm(lambda t, y, a: cfjax.LeftMatrix(a)), jnp.eye(3)

    @jax.jit
    @jax.vmap
    def solve(a):
        sol = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.1, y0, a, throw=False)
        return sol.ys[-1], sol.result == diffrax.RESULTS.successful

    good = skew(3)
    bad = good * np.array([[1, np.nan, 1], [1, 1, 1], [1, 1, 1]])
    ys, are_successful = solve(np.stack([good, bad]))
    np.testing.assert_array_equal(are_successful, [True, False])
    # Ten steps of order 3, of angles of 0.1.
    np.testing.assert_allclose(ys[0], expm(good), rtol=0, atol=1e-4)
    assert np.isnan(ys[1]).all()
    with pytest.raises(RuntimeError, match="without bound, or the steps"):
        cfjax.integrate(term, solver, 0.0, 1.0, y0, jnp.asarray(bad), num_steps=2)


@pytest.mark.parametrize("y0", [np.zeros(3), np.ones((3, 2))], ids=["zero", "equal columns"])
def test_columns_without_full_rank_are_an_error(y0):
    a = jnp.asarray(skew(3))
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(a))
    with pytest.raises(RuntimeError, match="columns or rows of full rank"):
        cfjax.integrate(term, RKMK5, 0.0, 1.0, jnp.asarray(y0), num_steps=2)


@pytest.mark.parametrize("since", [0.3, 0.999])
def test_a_matrix_that_is_not_skew_later_is_an_error(since):
    """From within the first step on, or in the last stage of all alone; one of two elements."""
    a, y0 = jnp.asarray(skew(3)), jnp.stack([jnp.eye(3)] * 2)

    def field(t, y, args):
        # The projection alone would bring the end back.
        later = jnp.where(t > since, 1e-9, 0.0)
        return cfjax.LeftMatrix(jnp.stack([a, a.at[0, 0].add(later)]))

    with pytest.raises(RuntimeError, match="without bound, or the steps"):
        cfjax.integrate(cfjax.LieTerm(field), RKMK5, 0.0, 1.0, y0, num_steps=4)


def test_output_of_a_matrix_that_is_not_skew_is_nan():
    """The last of the stages for output alone has no other after it that would show it."""
    a, time = jnp.asarray(skew(3)), RKMK8._extension.times[-1]
    assert 0 < time < 1
    assert time not in RKMK8.c

    def field(t, y, time):
        return cfjax.LeftMatrix(a.at[0, 0].add(jnp.where(jnp.abs(t - time) < 1e-9, 1e-3, 0.0)))

    @jax.jit
    def output(time):
        options: Any = {"saveat": diffrax.SaveAt(ts=jnp.asarray([0.3, 0.6]))}
        term, y0 = cfjax.LieTerm(field), jnp.eye(3)
        return diffrax.diffeqsolve(term, RKMK8, 0.0, 1.0, 1.0, y0, time, **options).ys

    assert np.isfinite(output(-1.0)).all()
    assert np.isnan(output(time)).all()


@pytest.mark.slow
def test_control_does_not_pass_a_matrix_that_is_not_skew():
    a = jnp.asarray(skew(3))
    term = cfjax.LieTerm(
        lambda t, y, args: cfjax.LeftMatrix(a.at[0, 0].add(jnp.maximum(t - 0.3, 0.0)))
    )
    control = diffrax.PIDController(rtol=0.0, atol=1e-5)
    options: Any = {"stepsize_controller": control, "max_steps": 99}
    with pytest.raises(RuntimeError):
        diffrax.diffeqsolve(term, RKMK5, 0.0, 1.0, 0.1, jnp.eye(3), **options)


def test_rounding_of_a_skew_matrix_is_none():
    a = jnp.asarray(skew(3)).at[0, 0].add(1e-14)
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(a))
    end = cfjax.integrate(term, RKMK8, 0.0, 1.0, jnp.eye(3), num_steps=10).ys[-1]
    np.testing.assert_allclose(end, expm(a), rtol=0, atol=1e-12)


def fast(cls, angle):
    """Turns by an angle in unit time."""
    a = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])

    def field(t, y, args):
        return cls(angle * jnp.asarray(a))

    def exact(t):
        turn = expm(angle * t * a)
        return turn @ start @ turn.T if cls is cfjax.Congruence else turn @ start

    start = np.diag([1.0, 2.0, 3.0]) if cls is cfjax.Congruence else np.eye(3)
    return Problem(field, start, None, exact)


@pytest.mark.parametrize("cls, angle", [(cfjax.Congruence, 3.0), (cfjax.LeftMatrix, 4.0)])
def test_a_step_that_is_too_long_fails_and_is_taken_again(cls, angle):
    """Nearly half a turn for an element in Cayley's coordinates; of columns, an end too far off."""
    given = fast(cls, angle)
    with pytest.raises(RuntimeError, match="without bound, or the steps"):
        given.end(RKMK5, 1.0, 1)

    @jax.jit
    def controlled(tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        y0 = jnp.asarray(given.y0)
        sol = diffrax.diffeqsolve(given.term, RKMK5, 0.0, 1.0, 1.0, y0, stepsize_controller=control)
        return sol.ys[-1], sol.stats["num_rejected_steps"]

    # With such a tolerance the estimate of plain space would not reject the step.
    assert controlled(1e3)[1] > 0
    assert np.abs(controlled(1e-6)[0] - given.exact(1.0)).max() < 1e-5


@pytest.mark.slow
def test_a_rejected_step_has_no_derivative():
    given = fast(cfjax.Congruence, 3.0)

    def end(s):
        control = diffrax.PIDController(rtol=0.0, atol=1e-8)
        term = cfjax.LieTerm(lambda t, y, s: given.term.prod(given.field(t, y, None), s))
        sol = diffrax.diffeqsolve(
            term, RKMK5, 0.0, 1.0, 1.0, jnp.asarray(given.y0), s, stepsize_controller=control
        )
        return sol.ys[-1, 0, 0]

    # y[0, 0] is (3 - cos(2 angle)) / 2.
    found = jax.grad(end)(jnp.asarray(1.0))
    np.testing.assert_allclose(found, 3 * np.sin(6), rtol=0, atol=1e-5)
