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

TERM = cfjax.LieTerm(problems.driven_body)
Y0, ARGS = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
ODE = diffrax.ODETerm(lambda t, y, args: -args * y * jnp.sin(t + y))
ODE_Y0, ODE_ARGS = jnp.asarray([0.5, 1.5]), jnp.asarray([1.0, 2.0])
halves = pytest.mark.parametrize("by_halves", [False, True], ids=["whole", "halves"])
CASES: dict[str, tuple[diffrax.AbstractSolver, int, Any]] = {
    "CF3": (cfjax.CF3(), 3, (TERM, Y0, ARGS)),
    "CF4": (cfjax.CF4(), 4, (TERM, Y0, ARGS)),
    "RKMK4": (cfjax.RKMK4(), 4, (TERM, Y0, ARGS)),
    "Euler": (diffrax.Euler(), 1, (ODE, ODE_Y0, ODE_ARGS)),
    "Tsit5": (diffrax.Tsit5(), 5, (ODE, ODE_Y0, ODE_ARGS)),
}
cases = pytest.mark.parametrize("name", CASES)


@eqx.filter_jit
def one_step(solver, problem, t0, t1):
    term, y0, args = problem
    state = solver.init(term, t0, t1, y0, args)
    return solver.step(term, t0, t1, y0, args, state, made_jump=False)


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


@cases
@halves
def test_estimate_and_result_of_a_step(name, by_halves):
    solver, order, problem = CASES[name]
    t0, t1 = jnp.asarray(0.3), jnp.asarray(0.7)
    wrapped = Richardson(solver, advance_by_halves=by_halves)
    term, _, args = problem
    found, error, _, _, _ = one_step(wrapped, problem, t0, t1)
    whole = one_step(solver, problem, t0, t1)[0]
    middle = one_step(solver, problem, t0, (t0 + t1) / 2)[0]
    twice = one_step(solver, (term, middle, args), (t0 + t1) / 2, t1)[0]
    close(found, twice if by_halves else whole)
    close(error, (whole - twice) / (2**order - 1))
    assert float(jnp.abs(error).max()) > 1e-8
    assert wrapped.order(term) == order
    assert wrapped.error_order(term) == order + 1


@pytest.mark.parametrize("name", ["CF3", "CF4", "RKMK4", "Euler"])
def test_the_estimate_is_the_error_of_the_two_halves(name, body_problem):
    """To leading order, and of order p + 1 in h, which error_order tells the controller."""
    solver, order, (term, y0, args) = CASES[name]
    steps = np.array([4, 8, 16])
    sizes = []
    for n in steps:
        t1 = jnp.asarray(0.5 / n)
        _, error, _, _, _ = one_step(Richardson(solver), (term, y0, args), jnp.asarray(0.0), t1)
        y2 = one_step(Richardson(solver, True), (term, y0, args), jnp.asarray(0.0), t1)[0]
        if term is TERM:
            ode = lambda t, y: problems.driven_body_ode(t, y, problems.INERTIA)  # noqa: E731
        else:
            ode = lambda t, y: -np.asarray(args) * y * np.sin(t + y)  # noqa: E731
        exact = problems.reference(ode, 0.0, float(t1), np.asarray(y0))
        sizes.append(np.linalg.norm(error))
        # The reference is exact to a few units of rounding over so short a time.
        if sizes[-1] > 1e-13:
            ratio = np.linalg.norm(exact - y2 + error) / np.linalg.norm(error)
            # The next term of the error is smaller by a factor of the order of h = 0.5 / n.
            assert ratio < 6 / n, (n, ratio)
    resolved = np.array(sizes) > 1e-14
    slope = problems.slope(list(steps[resolved]), np.array(sizes)[resolved])
    # At these steps the next order still shows: the two-sided bound is that of h, not of 0.15.
    assert abs(slope - (order + 1)) < 0.3


@halves
@pytest.mark.parametrize("name", ["CF4"])
def test_order(name, by_halves, body_problem):
    solver, order, _ = CASES[name]
    field, y0, args, answer = body_problem
    steps = [16, 32, 64]
    errors = problems.errors(field, Richardson(solver, by_halves), 1.0, y0, args, answer, steps)
    assert errors.min() > 50 * problems.REFERENCE_ERROR
    assert abs(problems.slope(steps, errors) - order) < 0.15


def test_exact_on_a_linear_space():
    """y' = y by Euler with h: y1 = 1 + h, y2 = (1 + h/2)^2, so the estimate is -h^2/4."""
    term = diffrax.ODETerm(lambda t, y, args: y)
    y1, error, *_ = one_step(
        Richardson(diffrax.Euler()), (term, jnp.asarray(1.0), None), 0.0, jnp.asarray(0.5)
    )
    assert (float(y1), float(error)) == (1.5, -0.0625)


def test_pytree_of_manifolds(flight_problem):
    field, y0, args, answer = flight_problem
    problem = (cfjax.LieTerm(field), problems.arrays(y0), problems.arrays(args))
    tolerance = 1e-7
    controller = diffrax.PIDController(rtol=0.0, atol=tolerance)
    solution = solve(Richardson(cfjax.CF4()), problem, 1.0, stepsize_controller=controller)
    end = problems.flat(jtu.tree_map(lambda y: y[-1], ys(solution)))
    # Fifteen times the estimate is the error of a step. The estimate is a root mean square of 15
    # numbers, and the errors of the steps add up.
    num_steps = float(solution.stats["num_steps"])
    assert np.linalg.norm(end - answer) < 15 * np.sqrt(15) * tolerance * num_steps
    attitude = end[:9].reshape(3, 3)
    close(attitude.T @ attitude, np.eye(3), 1e-13)


# Memory: solvers whose last stage is the first of the next step.


@pytest.mark.parametrize(
    "name, by_halves, direction",
    [("CF4", False, 1), ("CF4", True, -1), ("Tsit5", True, 1), ("Tsit5", False, -1)],
)
def test_fixed_steps_are_those_of_the_solver(name, by_halves, direction):
    solver, _, problem = CASES[name]
    found = solve(Richardson(solver, by_halves), problem, 2.0 * direction, 0.1 * direction)
    plain = solve(solver, problem, 2.0 * direction, (0.05 if by_halves else 0.1) * direction)
    close(ys(found), ys(plain), 1e-13)


@halves
@pytest.mark.parametrize("name", ["CF4", "Tsit5"])
def test_accepted_steps_are_those_of_the_solver(name, by_halves):
    """After a rejection too."""
    solver, _, problem = CASES[name]
    term, y, args = problem
    found = solve(
        Richardson(solver, by_halves),
        problem,
        dt0=2.0,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-6),
        saveat=diffrax.SaveAt(t0=True, steps=True),
    )
    assert found.stats["num_rejected_steps"] > 0
    times = np.asarray(found.ts)[np.isfinite(found.ts)]
    for a, b, wanted in zip(times[:-1], times[1:], ys(found)[1:], strict=False):
        for c, d in [(a, (a + b) / 2), ((a + b) / 2, b)] if by_halves else [(a, b)]:
            y = one_step(solver, (term, y, args), jnp.asarray(c), jnp.asarray(d))[0]
        close(wanted, y, 1e-13)


@halves
def test_memory_is_renewed_after_a_jump(by_halves):
    term = diffrax.ODETerm(lambda t, y, args: jnp.where(t < 0.9, -1.0, 3.0) * y)
    found = solve(
        Richardson(diffrax.Tsit5(), by_halves),
        (term, jnp.ones(1), None),
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=0.0, atol=1e-9), jump_ts=jnp.asarray([0.9])
        ),
    )
    # An old derivative after the jump would be an error of the size of a step.
    close(ys(found)[-1], [np.exp(-0.9 + 3 * 1.1)], 1e-6)


# Output between steps


@halves
def test_dense_output_is_that_of_the_solver(by_halves):
    solver, _, problem = CASES["Tsit5"]
    saveat = diffrax.SaveAt(dense=True, t1=True)
    found = solve(Richardson(solver, by_halves), problem, saveat=saveat)
    plain = solve(solver, problem, dt0=0.05 if by_halves else 0.1, saveat=saveat)
    times = jnp.asarray(np.concatenate([np.linspace(0, 2, 41), [0.012, 0.07, 1.234, 1.99]]))
    close(jax.vmap(found.evaluate)(times), jax.vmap(plain.evaluate)(times), 1e-13)
    close(found.evaluate(0.33, 1.77), plain.evaluate(0.33, 1.77), 1e-13)
    # No jump at the ends of steps, nor halfway: one unit of rounding apart in time.
    for t in (0.3, 0.35):
        left, right = found.evaluate(t, left=True), found.evaluate(np.nextafter(t, 1), left=False)
        close(left, right)
    backwards = solve(Richardson(solver, by_halves), problem, -2.0, -0.1, saveat=saveat)
    plain = solve(solver, problem, -2.0, -0.05 if by_halves else -0.1, saveat=saveat)
    close(jax.vmap(backwards.evaluate)(-times), jax.vmap(plain.evaluate)(-times), 1e-13)


def test_output_between_steps_on_a_manifold_is_that_of_the_halves():
    problem = CASES["CF4"][2]
    saveat = diffrax.SaveAt(dense=True)
    found = solve(Richardson(cfjax.RKMK4(), True), problem, saveat=saveat)
    plain = solve(cfjax.RKMK4(), problem, dt0=0.05, saveat=saveat)
    for t in (0.525, 0.55, 0.5831):
        close(found.evaluate(t), plain.evaluate(t), 1e-13)


# Modes of use


def test_single_precision_and_batch():
    problem = (
        cfjax.LieTerm(problems.rigid_body),
        Y0.astype(jnp.float32),
        ARGS.astype(jnp.float32),
    )
    times = [jnp.asarray(t, jnp.float32) for t in (2.0, 0.1, 0.0)]
    controller = diffrax.PIDController(rtol=0.0, atol=1e-4)

    @jax.jit
    @jax.vmap
    def end(scale):
        scaled = (problem[0], scale * problem[1], problem[2])
        solver = Richardson(cfjax.CF4())
        return ys(solve(solver, scaled, *times, stepsize_controller=controller))[-1]

    scales = jnp.asarray([0.5, 1.0, 3.0], jnp.float32)
    found = end(scales)
    assert found.dtype == jnp.float32
    close(jnp.linalg.norm(found, axis=1), scales * jnp.linalg.norm(problem[1]), 1e-5)


def test_a_value_that_compiles_once():
    assert Richardson(cfjax.CF4()) == Richardson(cfjax.CF4())
    assert hash(Richardson(cfjax.CF4(), True)) == hash(Richardson(cfjax.CF4(), True))
    traces = []

    @eqx.filter_jit
    def run(solver):
        traces.append(solver)
        return solve(solver, CASES["Tsit5"][2], saveat=diffrax.SaveAt(dense=True)).evaluate(0.5)

    run(Richardson(diffrax.Tsit5(), True))
    run(Richardson(diffrax.Tsit5(), True))
    assert len(traces) == 1


# Failure


@halves
def test_a_failure_of_the_solver_is_a_failure(by_halves):
    root_finder = diffrax.VeryChord(1e-12, 1e-12, optimistix.max_norm)
    inner = diffrax.ImplicitEuler(root_finder=root_finder)
    stiff = diffrax.ODETerm(lambda t, y, args: -1e3 * y**3 + jnp.exp(5 * y))
    solution = solve(
        Richardson(inner, by_halves), (stiff, jnp.asarray([1.0]), None), dt0=0.5, throw=False
    )
    plain = solve(inner, (stiff, jnp.asarray([1.0]), None), dt0=0.5, throw=False)
    assert plain.result != diffrax.RESULTS.successful
    assert solution.result == plain.result


def test_a_step_that_is_not_finite_is_rejected():
    """`y' = 1 - y`, and no number from y = 1 on, where the second stage of a long step is."""
    term = cfjax.LieTerm(lambda t, y, args: jnp.where(y < 1, 1 - y, jnp.nan))
    controller = diffrax.PIDController(rtol=0.0, atol=1e-7)
    solver, problem = Richardson(cfjax.CF4()), (term, jnp.zeros(1), None)
    solution = solve(solver, problem, 3.0, 3.0, stepsize_controller=controller)
    assert solution.stats["num_rejected_steps"] > 0
    close(ys(solution)[-1], [1 - np.exp(-3)], 1e-5)


def test_an_implicit_solver_takes_the_tolerances_of_the_controller():
    controller = diffrax.PIDController(rtol=0.0, atol=1e-7)
    problem = CASES["Tsit5"][2]
    found = solve(Richardson(diffrax.Kvaerno3()), problem, stepsize_controller=controller)
    close(ys(found), ys(solve(diffrax.Tsit5(), problem, dt0=0.01)), 1e-4)


class NoOrder(diffrax.Euler):
    def order(self, terms):  # pyright: ignore[reportIncompatibleMethodOverride]
        return None


@pytest.mark.parametrize("solver", [cfjax.CF4, "CF4", None])
def test_wrong_solver(solver, no_shape_hook):
    with pytest.raises(TypeError, match="solver must be a diffrax solver, got"):
        Richardson(solver)


def test_wrong_option(no_shape_hook):
    with pytest.raises(TypeError, match="advance_by_halves must be a bool, got 'y2'"):
        Richardson(cfjax.CF4(), "y2")  # pyright: ignore[reportArgumentType]


def test_unknown_order():
    with pytest.raises(ValueError, match="Richardson needs a solver of known order, got NoOrder"):
        solve(Richardson(NoOrder()), CASES["Euler"][2])
