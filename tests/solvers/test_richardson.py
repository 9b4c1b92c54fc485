"""Richardson: the estimate, what it goes on with, its memory, its output, and its failures."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix
import problems
import pytest

import cfjax
from cfjax import Richardson
from cfjax.scenes import rigid_body

TERM = cfjax.LieTerm(problems.driven_body)
Y0, ARGS = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
ODE = diffrax.ODETerm(lambda t, y, args: -args * y * jnp.sin(t + y))
ODE_Y0, ODE_ARGS = jnp.asarray([0.5, 1.5]), jnp.asarray([1.0, 2.0])
variants = pytest.mark.parametrize("as_in_paper", [False, True], ids=["default", "paper"])
CASES: dict[str, tuple[diffrax.AbstractSolver, int, Any]] = {
    "CF3": (cfjax.CF3(), 3, (TERM, Y0, ARGS)),
    "CF4": (cfjax.CF4(), 4, (TERM, Y0, ARGS)),
    "Euler": (diffrax.Euler(), 1, (ODE, ODE_Y0, ODE_ARGS)),
    "Tsit5": (diffrax.Tsit5(), 5, (ODE, ODE_Y0, ODE_ARGS)),
}


@eqx.filter_jit
def one_step(solver, problem, t0, t1):
    term, y0, args = problem
    return problems.first_step(solver, term, t0, t1, y0, args)


@eqx.filter_jit
def solve(
    solver, problem, t1: Any = 2.0, dt0: Any = 0.1, t0: Any = 0.0, **kwargs
) -> diffrax.Solution:
    term, y0, args = problem
    kwargs = dict(max_steps=400) | kwargs
    return diffrax.diffeqsolve(term, solver, t0, t1, dt0, y0, args, **kwargs)


def ys(solution: diffrax.Solution) -> Any:
    assert solution.ys is not None
    return solution.ys


def close(a, b, atol=1e-14):
    """Equal to rounding: some dozen operations on numbers of size one."""
    for x, y in zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=atol)


# The estimate


def test_estimate_and_result_of_a_step(subtests):
    # The last stage of Tsit5 is the first of its next step.
    for name, as_in_paper in (("CF3", False), ("Tsit5", True)):
        with subtests.test(case=(name, str(as_in_paper))):
            check_a_step(name, as_in_paper)


def check_a_step(name, as_in_paper):
    solver, order, (term, y0, args) = CASES[name]
    wrapped = Richardson(solver, as_in_paper)

    def steps(t0, t1, y0, args):
        def by(solver, t0, t1, y0):
            return problems.first_step(solver, term, t0, t1, y0, args)[:2]

        half = (t0 + t1) / 2
        twice = by(solver, half, t1, by(solver, t0, half, y0)[0])[0]
        return *by(wrapped, t0, t1, y0), by(solver, t0, t1, y0)[0], twice

    with cfjax.rewriting(False):
        found, error, whole, twice = problems.op_by_op(steps, 0.3, 0.7, y0, args)
    close(found, whole if as_in_paper else twice)
    expected = np.asarray(whole - twice) / (2**order - 1)
    assert np.abs(expected).max() > 1e-8
    # Divided by its own size, the error is known to fewer digits.
    rounding = 1e-14
    if not as_in_paper:
        size = max(np.linalg.norm(y0), np.linalg.norm(twice))
        steps_per_unit = (size / np.linalg.norm(expected)) ** (1 / (order + 1))
        assert steps_per_unit > 1.5
        expected, rounding = expected * steps_per_unit, rounding * steps_per_unit
    close(error, expected, rounding)
    assert wrapped.order(term) == order
    assert wrapped.error_order(term) == order + as_in_paper


def step_of_euler(term, y0, args=None, h=1.0, as_in_paper=False):
    """The end of a step, and its error."""
    wrapped = Richardson(diffrax.Euler(), as_in_paper)
    step = lambda h, y0, args: problems.first_step(wrapped, term, 0.0 * h, h, y0, args)[:2]  # noqa: E731
    return problems.op_by_op(step, h, y0, args)


def test_exact_on_a_linear_space():
    """y' = y by Euler with h: y1 = 1 + h, y2 = (1 + h/2)^2, so the estimate is -h^2/4."""
    term = diffrax.ODETerm(lambda t, y, args: y)
    y1, error = step_of_euler(term, 1.0, h=0.5, as_in_paper=True)
    assert (float(y1), float(error)) == (1.5, -0.0625)
    # An error of y2 / 25 a step: five such steps until it is y2, by sqrt(25) as p = 1.
    y2, error = step_of_euler(term, 1.0, h=0.5)
    assert float(y2) == 1.5625
    assert float(error) == pytest.approx(-0.0625 * 5, rel=1e-15)
    # Exact steps have no error; one larger than the state is itself; NaN says so. For y' = -4 y
    # from 1: y1 = 1 - 4 and y2 = (1 - 2)^2.
    term = diffrax.ODETerm(lambda t, y, args: args * y)
    for slope, expected in ((0.0, 0.0), (-4.0, -4.0), (np.nan, np.nan)):
        error = step_of_euler(term, np.ones(2), slope)[1]
        np.testing.assert_array_equal(error, expected)


def test_the_estimate_keeps_the_units_of_each_part():
    """Parts of other units, and other origins of time and space, are other numbers alone."""

    def parts(t, y, args):
        return {"a": -(y["a"] ** 2), "b": jnp.cos(y["b"])}

    y0 = {"a": jnp.asarray([0.5, 1.5]), "b": jnp.asarray(0.3)}

    def estimate(field, y0, h):
        solver, times = Richardson(diffrax.Ralston()), (jnp.asarray(0.0), jnp.asarray(h))
        return problems.first_step(solver, diffrax.ODETerm(field), *times, y0, None)[1]

    def estimates(y0):
        found = {}
        for part, scale in (("a", 1e6), ("b", 1e-6)):

            def alone(t, y, args, part=part, scale=scale):
                y = y0 | {part: y / scale}
                return 100 * scale * parts(t, y, args)[part]

            found[part] = estimate(alone, scale * y0[part], 0.005) / scale
        return found, estimate(parts, y0, 0.5)

    # Differences of numbers of size 1, known to a unit of rounding over their size.
    close(*jax.jit(estimates)(y0), 1e-14)


CONTROLLED = {
    "CF3": (cfjax.CF3(), cfjax.LieTerm(rigid_body.field)),
    "CF4": (cfjax.CF4(estimate=None), cfjax.LieTerm(rigid_body.field)),
    "RKMK4": (cfjax.RKMK4(), cfjax.LieTerm(rigid_body.field)),
    "Tsit5": (diffrax.Tsit5(), diffrax.ODETerm(lambda t, y, args: jnp.cross(y, y / args))),
}


@pytest.fixture(scope="module")
def rigid_body_answer():
    def ode(t, y):
        return np.cross(y, y / rigid_body.inertia)

    return problems.reference(ode, 0.0, 10.0, rigid_body.y0)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLED)
def test_the_error_is_proportional_to_the_tolerance(name, rigid_body_answer):
    """An estimate of order p + 1 would let their ratio grow by tol^(-1/(p+1)): 11 to 32 times."""
    solver, term = CONTROLLED[name]

    @jax.jit
    def end(atol):
        controller = diffrax.PIDController(rtol=0.0, atol=atol)
        return diffrax.diffeqsolve(
            term,
            Richardson(solver),
            0.0,
            10.0,
            0.01,
            jnp.asarray(rigid_body.y0),
            jnp.asarray(rigid_body.inertia),
            stepsize_controller=controller,
            max_steps=None,
        ).ys

    tolerances = np.array([1e-4, 1e-7, 1e-10])
    errors = [np.linalg.norm(end(jnp.asarray(atol))[-1] - rigid_body_answer) for atol in tolerances]
    ratios = np.array(errors) / tolerances
    # At 1e-4 the steps of the method of order 5 are too long for its leading error to tell. For
    # the others the next term of the error, of the size of such a step, is what changes the ratio.
    assert ratios.max() / ratios.min() < (3 if name == "Tsit5" else 1.6)
    # The body turns through some ten radians, for each of which errors may add up to the estimate.
    assert 0.1 < ratios.min() and ratios.max() < 20


# Memory: solvers whose last stage is the first of the next step.


@pytest.mark.slow
@variants
@pytest.mark.parametrize("name", ["CF4", "Tsit5"])
def test_accepted_steps_are_those_of_the_solver(name, as_in_paper):
    """After a rejection too."""
    solver, _, problem = CASES[name]
    term, y, args = problem
    found = solve(
        Richardson(solver, as_in_paper),
        problem,
        dt0=2.0,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-6),
        saveat=diffrax.SaveAt(t0=True, steps=True),
    )
    assert found.stats["num_rejected_steps"] > 0
    times = np.asarray(found.ts)[np.isfinite(found.ts)]
    for a, b, wanted in zip(times[:-1], times[1:], ys(found)[1:], strict=False):
        for c, d in [(a, b)] if as_in_paper else [(a, (a + b) / 2), ((a + b) / 2, b)]:
            y = one_step(solver, (term, y, args), jnp.asarray(c), jnp.asarray(d))[0]
        close(wanted, y, 1e-13)


@pytest.mark.representatives(1)
@variants
def test_memory_is_renewed_after_a_jump(as_in_paper):
    term = diffrax.ODETerm(lambda t, y, args: jnp.where(t < 0.9, -1.0, 3.0) * y)
    found = solve(
        Richardson(diffrax.Tsit5(), as_in_paper),
        (term, jnp.ones(1), None),
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=0.0, atol=1e-9), jump_ts=jnp.asarray([0.9])
        ),
    )
    # An old derivative after the jump would be an error of the size of a step.
    close(ys(found)[-1], [np.exp(-0.9 + 3 * 1.1)], 1e-6)


# Output between steps


@pytest.mark.slow
@variants
def test_dense_output_is_that_of_the_solver(as_in_paper):
    solver, _, problem = CASES["Tsit5"]
    saveat = diffrax.SaveAt(dense=True, t1=True)
    found = solve(Richardson(solver, as_in_paper), problem, saveat=saveat)
    plain = solve(solver, problem, dt0=0.1 if as_in_paper else 0.05, saveat=saveat)
    times = jnp.asarray(np.concatenate([np.linspace(0, 2, 41), [0.012, 0.07, 1.234, 1.99]]))
    close(jax.vmap(found.evaluate)(times), jax.vmap(plain.evaluate)(times), 1e-13)
    close(found.evaluate(0.33, 1.77), plain.evaluate(0.33, 1.77), 1e-13)
    # No jump at the ends of steps, nor halfway: one unit of rounding apart in time.
    for t in (0.3, 0.35):
        left, right = found.evaluate(t, left=True), found.evaluate(np.nextafter(t, 1), left=False)
        close(left, right)
    backwards = solve(Richardson(solver, as_in_paper), problem, -2.0, -0.1, saveat=saveat)
    plain = solve(solver, problem, -2.0, -0.1 if as_in_paper else -0.05, saveat=saveat)
    close(jax.vmap(backwards.evaluate)(-times), jax.vmap(plain.evaluate)(-times), 1e-13)


def test_equal_richardson_solvers_compile_once():
    assert Richardson(cfjax.CF4()) == Richardson(cfjax.CF4())
    assert hash(Richardson(cfjax.CF4())) == hash(Richardson(cfjax.CF4()))
    traces = []

    @eqx.filter_jit
    def run(solver):
        traces.append(solver)
        return solve(solver, CASES["Tsit5"][2], saveat=diffrax.SaveAt(dense=True)).evaluate(0.5)

    for _ in range(2):
        eqx.filter_eval_shape(run, Richardson(diffrax.Tsit5()))
    assert len(traces) == 1


# Failure


@pytest.mark.representatives(1)
@variants
def test_a_failure_of_the_solver_is_a_failure(as_in_paper):
    root_finder = diffrax.VeryChord(1e-12, 1e-12, optimistix.max_norm)
    inner = diffrax.ImplicitEuler(root_finder=root_finder)
    stiff = diffrax.ODETerm(lambda t, y, args: -1e3 * y**3 + jnp.exp(5 * y))
    solution = solve(
        Richardson(inner, as_in_paper), (stiff, jnp.asarray([1.0]), None), dt0=0.5, throw=False
    )
    # That of the solver, which is a Newton iteration with one slope.
    assert solution.result == diffrax.RESULTS.nonlinear_divergence


def test_a_step_that_is_not_finite_is_rejected():
    """`y' = 1 - y`, and no number from y = 1 on, where the second stage of a long step is."""
    term = cfjax.LieTerm(lambda t, y, args: jnp.where(y < 1, 1 - y, jnp.nan))
    controller = diffrax.PIDController(rtol=0.0, atol=1e-7)
    solver, problem = Richardson(cfjax.CF4()), (term, jnp.zeros(1), None)
    solution = solve(solver, problem, 3.0, 3.0, stepsize_controller=controller)
    assert solution.stats["num_rejected_steps"] > 0
    close(ys(solution)[-1], [1 - np.exp(-3)], 1e-5)


@pytest.mark.slow
def test_an_implicit_solver_takes_the_tolerances_of_the_controller():
    controller = diffrax.PIDController(rtol=0.0, atol=1e-7)
    problem = CASES["Tsit5"][2]
    found = solve(Richardson(diffrax.Kvaerno3()), problem, stepsize_controller=controller)
    close(ys(found), ys(solve(diffrax.Tsit5(), problem, dt0=0.01)), 1e-4)


class NoOrder(diffrax.Euler):
    def order(self, terms):  # pyright: ignore[reportIncompatibleMethodOverride]
        return None


def test_wrong_arguments(no_shape_hook, subtests):
    for wrong in (cfjax.CF4, "CF4", None):
        with (
            subtests.test(case=repr(wrong)),
            pytest.raises(TypeError, match="solver must be a diffrax solver, got"),
        ):
            Richardson(wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="as_in_paper must be a bool, got 'y2'"):
        Richardson(cfjax.CF4(), "y2")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="Richardson needs a solver of known order, got NoOrder"):
        solve(Richardson(NoOrder()), CASES["Euler"][2])
