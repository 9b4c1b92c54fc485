"""Every feature of `diffrax.diffeqsolve`, with a commutator-free and a Munthe-Kaas method."""

import warnings
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import problems
import pytest

import cfjax

SOLVERS: dict[str, diffrax.AbstractSolver] = {
    "CF4": cfjax.CF4(),
    "RKMK4": cfjax.RKMK4(),
}
# Without an error estimate.
PLAIN: dict[str, diffrax.AbstractSolver] = {"CG4": cfjax.CG4(), "RKMK4": cfjax.RKMK4()}
plain_solvers = pytest.mark.parametrize("solver", PLAIN.values(), ids=PLAIN.keys())
solvers = pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS.keys())
directions = pytest.mark.parametrize("direction", [1, -1], ids=["forwards", "backwards"])

Y0 = jnp.asarray(problems.MOMENTUM)
ARGS = jnp.asarray(problems.INERTIA)
TERM = cfjax.LieTerm(problems.driven_body)
# 20 steps to t = 1. The errors of both methods there are below 1e-5, and the solution moves
# by 0.3 or more within any two steps, so a value from a wrong time cannot pass.
STEPS = 20
ERROR = 1e-5


def solve(solver, t1=1.0, dt0=1.0 / STEPS, y0=Y0, args=ARGS, term=TERM, **kwargs):
    return diffrax.diffeqsolve(term, solver, 0.0, t1, dt0, y0, args, **kwargs)


def by_steps(solver, times, y0=Y0, args=ARGS, field=problems.driven_body) -> Any:
    """The states at `times`, by calls of `step` alone."""
    return _by_steps(solver, jnp.asarray(times), y0, args, field)


@eqx.filter_jit
def _by_steps(solver, times, y0, args, field):
    term = cfjax.LieTerm(field)

    def step(carry, interval):
        y, state = carry
        y1, _, _, state, _ = solver.step(term, *interval, y, args, state, made_jump=False)
        return (y1, state), y1

    state = solver.init(term, times[0], times[1], y0, args)
    _, ys = jax.lax.scan(step, (y0, state), (times[:-1], times[1:]))
    return jtu.tree_map(lambda first, rest: jnp.concatenate([first[None], rest]), y0, ys)


def nodes(direction=1, n=STEPS):
    return direction * np.arange(n + 1) / STEPS


def close(found, expected, atol=1e-14):
    """Equal to rounding: 20 steps, each with a few units of 1e-16 for entries below 1.

    The times that diffrax adds up differ from multiples of the step by about 1e-16 a step.
    """
    for a, b in zip(jtu.tree_leaves(found), jtu.tree_leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


@pytest.fixture(scope="module")
def answers():
    """The driven body at t = 1 and t = -1, not by cfjax."""

    def ode(t, y):
        return problems.driven_body_ode(t, y, problems.INERTIA)

    return {d: problems.reference(ode, 0.0, float(d), problems.MOMENTUM) for d in (1, -1)}


# Output


@pytest.mark.representatives(1)
@directions
@solvers
def test_the_end_is_the_solution(answers, solver, direction):
    sol = solve(solver, float(direction), direction / STEPS)
    assert sol.ts is not None and sol.ys is not None
    assert sol.ts.tolist() == [float(direction)]
    assert sol.stats["num_accepted_steps"] == STEPS
    assert np.linalg.norm(sol.ys[-1] - answers[direction]) < ERROR
    close(sol.ys[-1], by_steps(solver, nodes(direction))[-1])


@pytest.mark.representatives(1)
@directions
@solvers
def test_save_every_kind_at_once(solver, direction):
    """t0, t1, steps, every n-th step, a function, and several of them in a pytree."""

    def energy(t, y, args):
        return {"t": t, "E": jnp.sum(y**2 / args) / 2}

    saveat = diffrax.SaveAt(
        subs={
            "ends": diffrax.SubSaveAt(t0=True, t1=True),
            "steps": diffrax.SubSaveAt(steps=True),
            "with start": diffrax.SubSaveAt(t0=True, steps=True),
            "third": diffrax.SubSaveAt(t0=True, t1=True, steps=3),
            "energy": diffrax.SubSaveAt(steps=2, fn=energy),
        }
    )
    sol = solve(solver, float(direction), direction / STEPS, saveat=saveat, max_steps=STEPS)
    ts, ys = sol.ts, sol.ys
    assert ts is not None and ys is not None
    times = nodes(direction)
    exact = by_steps(solver, times)
    close((ts["ends"], ys["ends"]), (times[[0, -1]], exact[jnp.array([0, -1])]))
    close((ts["steps"], ys["steps"]), (times[1:], exact[1:]))
    close((ts["with start"], ys["with start"]), (times, exact))
    third = np.array([0, 3, 6, 9, 12, 15, 18, 20])
    close((ts["third"][: len(third)], ys["third"][: len(third)]), (times[third], exact[third]))
    # Diffrax fills what is left with infinity.
    assert np.all(np.isinf(ys["third"][len(third) :]))
    close(ys["energy"]["t"], times[2::2])
    close(ys["energy"]["E"], np.sum(np.asarray(exact)[2::2] ** 2 / problems.INERTIA, axis=1) / 2)


@pytest.mark.slow
@directions
@solvers
def test_save_at_times_that_the_steps_end_at(solver, direction):
    ts = direction * np.array([0.0, 0.03, 0.1, 0.17, 0.5, 0.51, 1.0])
    sol = diffrax.diffeqsolve(
        TERM,
        solver,
        ts[0],
        ts[-1],
        None,
        Y0,
        ARGS,
        saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.StepTo(ts),
    )
    assert sol.ts is not None and sol.ys is not None
    assert sol.ts.tolist() == ts.tolist()
    close(sol.ys, by_steps(solver, ts))


@pytest.mark.slow
@solvers
def test_save_at_nodes_of_a_regular_grid(solver):
    """Times that the steps meet up to rounding only."""
    ts = np.array([0.1, 0.3, 0.35, 0.7, 1.0])
    sol = solve(solver, saveat=diffrax.SaveAt(ts=ts))
    assert sol.ys is not None
    close(sol.ys, by_steps(solver, nodes())[np.round(ts * STEPS).astype(int)])


@pytest.mark.slow
@directions
def test_dense_output_is_that_of_the_steps_at_nodes(direction):
    solver, saveat = cfjax.RKMK4(), diffrax.SaveAt(dense=True)
    sol = solve(solver, float(direction), direction / STEPS, saveat=saveat, max_steps=STEPS)
    times = nodes(direction)
    exact = by_steps(solver, times)
    close(jax.vmap(sol.evaluate)(jnp.asarray(times)), exact)
    for left in (True, False):
        for k in (0, 7, STEPS):
            close(sol.evaluate(times[k], left=left), exact[k])
    close(sol.evaluate(times[3], times[11]), exact[11] - exact[3])


# Fields and states


@pytest.mark.slow
@solvers
def test_a_product_of_manifolds(flight_problem, solver):
    field, y0, args, answer = flight_problem
    y0, args = problems.arrays(y0), problems.arrays(args)
    saveat = diffrax.SaveAt(steps=True)
    sol = solve(solver, y0=y0, args=args, term=cfjax.LieTerm(field), saveat=saveat, max_steps=STEPS)
    close(sol.ys, jtu.tree_map(lambda x: x[1:], by_steps(solver, nodes(), y0, args, field)))
    end = jtu.tree_map(lambda x: x[-1], sol.ys)
    assert np.linalg.norm(problems.flat(end) - answer) < ERROR


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax:UserWarning")
@solvers
def test_a_complex_state(solver):
    """A unitary matrix. The problem commutes, so the answer is an exponential in closed form."""
    rng = np.random.default_rng(5)
    a = rng.standard_normal((3, 3)) + 1j * rng.standard_normal((3, 3))
    hermitian = (a + a.conj().T) / 2

    def field(t, y, args):
        return cfjax.LeftMatrix(-1j * jnp.cos(t).astype(args.dtype) * args)

    y0 = jnp.eye(3, dtype=complex)
    sol = solve(solver, y0=y0, args=jnp.asarray(hermitian), term=cfjax.LieTerm(field))
    assert sol.ys is not None
    y1 = np.asarray(sol.ys[-1])
    values, vectors = np.linalg.eigh(hermitian)
    answer = (vectors * np.exp(-1j * np.sin(1.0) * values)) @ vectors.conj().T
    assert y1.dtype == np.complex128
    # The quadrature behind both methods errs by about h^4 / 2880.
    assert np.linalg.norm(y1 - answer) < ERROR
    # 20 steps of at most 5 flows, each with a rounding of the unit.
    assert np.linalg.norm(y1.conj().T @ y1 - np.eye(3)) < 1e-13


@pytest.mark.representatives(1)
@solvers
def test_single_precision_stays_single(solver):
    y0, args = Y0.astype(jnp.float32), ARGS.astype(jnp.float32)
    times = [jnp.asarray(t, jnp.float32) for t in (0.0, 1.0, 1 / STEPS)]
    sol = diffrax.diffeqsolve(TERM, solver, *times, y0, args)
    assert sol.ts is not None and sol.ys is not None
    assert sol.ts.dtype == sol.ys.dtype == jnp.float32
    # 20 steps with roundings of 6e-8 each, and times that diffrax adds up in single precision.
    close(sol.ys[-1], by_steps(solver, nodes())[-1].astype(jnp.float32), atol=5e-6)


@pytest.mark.slow
@solvers
def test_a_jump_in_the_field_costs_no_order_when_steps_end_there(solver):
    """A field that changes at t = 0.37 for another one. Order measured across the jump."""
    jump = 0.37

    def field(t, y, args):
        # The stage at the end of a step is before the jump, the one at a start is behind it,
        # and they have the same time: a jump belongs between two floating-point numbers.
        drive = jnp.where(t < jump, 1.0, -2.0)
        return cfjax.Rotation(jnp.stack([drive, t, -drive]) - y / args)

    def ode(drive):
        return lambda t, y: np.cross(np.array([drive, t, -drive]) - y / problems.INERTIA, y)

    before = problems.reference(ode(1.0), 0.0, jump, problems.MOMENTUM)
    answer = problems.reference(ode(-2.0), jump, 1.0, before)
    before_jump = np.nextafter(jump, 0)

    @jax.jit
    def error(ts):
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            solver,
            ts[0],
            ts[-1],
            None,
            Y0,
            ARGS,
            stepsize_controller=diffrax.StepTo(ts),
        )
        assert sol.ys is not None
        return jnp.linalg.norm(sol.ys[-1] - answer)

    counts = (8, 16, 32, 64)
    found = []
    for n in counts:
        first, last = np.linspace(0, before_jump, n + 1), np.linspace(jump, 1, n + 1)
        found.append(float(error(jnp.asarray(np.concatenate([first, last])))))
    assert min(found) > 10 * problems.REFERENCE_ERROR
    assert abs(problems.slope(counts, np.array(found)) - solver.order(None)) < 0.2


# Events


@pytest.mark.slow
@solvers
def test_a_boolean_event_ends_on_the_step_where_it_holds(solver):
    exact = np.asarray(by_steps(solver, nodes(n=40)))
    # Between two values that the first component takes on its way.
    level = (exact[9, 0] + exact[10, 0]) / 2
    below = exact[10, 0] < level

    def condition(t, y, args, **kwargs):
        return (y[0] < level) if below else (y[0] > level)

    first = int(np.argmax((exact[:, 0] < level) if below else (exact[:, 0] > level)))
    sol = solve(solver, t1=2.0, event=diffrax.Event(condition))
    assert sol.ts is not None and sol.ys is not None
    assert sol.result == diffrax.RESULTS.event_occurred
    close((sol.ts[-1], sol.ys[-1]), (nodes(n=40)[first], exact[first]))


@pytest.mark.representatives(1)
@solvers
def test_a_continuous_event_ends_on_the_step_where_its_sign_changes(solver):
    exact = np.asarray(by_steps(solver, nodes(n=40)))
    level = (exact[9, 0] + exact[10, 0]) / 2

    def condition(t, y, args, **kwargs):
        return y[0] - level

    signs = np.sign(exact[:, 0] - level)
    first = int(np.argmax(signs != signs[0]))
    sol = solve(solver, t1=2.0, event=diffrax.Event(condition))
    assert sol.ts is not None and sol.ys is not None
    close((sol.ts[-1], sol.ys[-1]), (nodes(n=40)[first], exact[first]))


# Progress meters


def test_a_text_progress_meter(capfd):
    meter = diffrax.TextProgressMeter(minimum_increase=0.25)
    sol = solve(cfjax.CF4(), progress_meter=meter)
    assert sol.ys is not None
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    lines = capfd.readouterr().out.split()
    assert lines[0] == "0.00%" and lines[-1] == "100.00%" and 4 <= len(lines) <= 6
    close(sol.ys[-1], by_steps(cfjax.CF4(), nodes())[-1])


@pytest.mark.slow
def test_a_bar_as_progress_meter(capfd):
    pytest.importorskip("tqdm")
    sol = solve(cfjax.CF4(), progress_meter=diffrax.TqdmProgressMeter())
    jax.block_until_ready(sol.ys)
    jax.effects_barrier()
    assert "100.00%" in capfd.readouterr().err


# Derivatives


class Driven(eqx.Module):
    """The driven body with parameters inside the field."""

    strength: jax.Array

    def __call__(self, t, y, args):
        drive = jnp.stack([jnp.sin(2 * t), jnp.cos(t), t])
        return cfjax.Rotation(self.strength * drive - y / args)


def functional(solver, adjoint, x):
    strength, y0, args = x
    term = cfjax.LieTerm(Driven(strength))
    saveat = diffrax.SaveAt(t1=True, steps=5)
    sol = solve(
        solver, 0.5, y0=y0, args=args, term=term, adjoint=adjoint, max_steps=16, saveat=saveat
    )
    assert sol.ys is not None
    # Only finite rows count: diffrax fills up with infinity.
    rows = sol.ys[:2]
    return jnp.sum(jnp.sin(rows * jnp.arange(1.0, 7.0).reshape(2, 3)))


X = (jnp.asarray(np.array([1.0, -0.5, 2.0])), Y0, ARGS)
ADJOINTS = {
    "checkpointed": diffrax.RecursiveCheckpointAdjoint(),
    "direct": diffrax.DirectAdjoint(),
    "forward": diffrax.ForwardMode(),
}


# Differences of order 4 with step 1e-3 err by 1e-12 times a fifth derivative below 1e3 here, and
# by 1e-15 / 1e-3 for rounding.
DIFFERENCE_STEP, DIFFERENCE_ERROR = 1e-3, 2e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, adjoint",
    [
        ("CF4", "checkpointed"),
        ("CF4", "direct"),
        ("CF4", "forward"),
        pytest.param("RKMK4", "checkpointed", marks=pytest.mark.slow),
    ],
)
def test_derivatives_in_start_args_and_field(name, adjoint):
    fun = jax.jit(lambda x: functional(SOLVERS[name], ADJOINTS[adjoint], x))
    direction = problems.random_like(X, 3)
    expected = problems.central_difference(fun, X, direction, DIFFERENCE_STEP)
    assert abs(expected) > 0.1
    if adjoint != "checkpointed":
        _, tangent = jax.jvp(fun, (X,), (direction,))
        np.testing.assert_allclose(tangent, expected, rtol=0, atol=DIFFERENCE_ERROR)
    if adjoint != "forward":
        gradient = jax.jit(jax.grad(fun))(X)
        found = problems.inner(gradient, direction)
        np.testing.assert_allclose(found, expected, rtol=0, atol=DIFFERENCE_ERROR)
        # Each of the three groups on its own, so that no error of one hides in another.
        for k in range(3):
            part = tuple(d if i == k else jnp.zeros_like(d) for i, d in enumerate(direction))
            found = problems.inner(gradient, part)
            expected = problems.central_difference(fun, X, part, DIFFERENCE_STEP)
            np.testing.assert_allclose(found, expected, rtol=0, atol=DIFFERENCE_ERROR)


@pytest.mark.slow
def test_batches_of_gradients_and_gradients_of_batches():
    fun = lambda x: functional(cfjax.CF4(), ADJOINTS["checkpointed"], x)  # noqa: E731
    batch = jtu.tree_map(lambda x: jnp.stack([x, 0.5 * x, x + 0.1]), X)
    total = jax.jit(lambda x: jnp.sum(jax.vmap(fun)(x)))
    each = jax.jit(jax.vmap(jax.grad(fun)))(batch)
    direction = problems.random_like(batch, 7)
    expected = problems.central_difference(total, batch, direction, DIFFERENCE_STEP)
    found = problems.inner(each, direction)
    # Three members of a batch, each as above.
    np.testing.assert_allclose(found, expected, rtol=0, atol=3 * DIFFERENCE_ERROR)
    # The members do not mix: one sum, and a gradient of about 100 products of order 1 to 10.
    close(jax.jit(jax.grad(total))(batch), each, atol=1e-12)


@pytest.mark.slow
def test_the_backsolve_adjoint():
    """`vf_prod` is the tangent in the ambient space, where every solver integrates backwards.

    What goes backwards is the state with its adjoint: arrays, on which CF4 is a Runge-Kutta method.
    """

    def fun(x, adjoint):
        strength, y0, args = x
        term = cfjax.LieTerm(Driven(strength))
        sol = solve(cfjax.CF4(), y0=y0, args=args, term=term, adjoint=adjoint, dt0=0.01)
        return jnp.sum(jnp.sin(sol.ys[-1]))

    expected, with_tsit5, with_cf4 = (
        jax.jit(jax.grad(lambda x, a=a: fun(x, a)), compiler_options=problems.QUICK)(X)
        for a in (
            diffrax.RecursiveCheckpointAdjoint(),
            diffrax.BacksolveAdjoint(solver=diffrax.Tsit5()),
            diffrax.BacksolveAdjoint(),
        )
    )
    # Two discretisations, with errors of h^4 = 1e-8 each.
    close(with_tsit5, expected, atol=1e-7)
    close(with_cf4, expected, atol=1e-7)


@pytest.mark.slow
def test_the_backsolve_adjoint_along_a_manifold():
    """Against differences of solves whose starts are on the sphere."""
    rng = np.random.default_rng(11)
    y0, turn, args, change = rng.standard_normal((4, 8))
    y0 /= np.linalg.norm(y0)
    turn -= y0 * (y0 @ turn)
    term = cfjax.LieTerm(lambda t, y, args: cfjax.SphereRotation(args * y[::-1]))

    def fun(s, adjoint):
        y = y0 + s[0] * turn
        y = y / jnp.linalg.norm(y)
        sol = solve(cfjax.CF4(), y0=y, args=args + s[1] * change, term=term, adjoint=adjoint)
        return jnp.sum(jnp.sin(sol.ys[-1] * jnp.arange(1.0, 9.0)))

    at = jnp.zeros(2)
    forward = jax.jit(lambda s: fun(s, diffrax.RecursiveCheckpointAdjoint()))
    found = jax.jit(jax.grad(lambda s: fun(s, diffrax.BacksolveAdjoint())))(at)
    for k, direction in enumerate(jnp.eye(2)):
        expected = problems.central_difference(forward, at, direction, DIFFERENCE_STEP)
        assert abs(expected) > 0.1
        # Each discretisation has an error of h^4 / 10 = 1e-6 at most.
        np.testing.assert_allclose(found[k], expected, rtol=0, atol=1e-5)


def in_the_times(adjoint, t0, t1):
    """The end of a step and a half; diffrax holds the size of the first and ends the last at t1."""
    sol = diffrax.diffeqsolve(
        TERM, cfjax.CF2(), t0, t1, 0.5, Y0, ARGS, adjoint=adjoint, max_steps=4
    )
    return jnp.sum(jnp.sin(sol.ys[-1]))


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_derivatives_in_the_times(adjoint):
    fun = lambda times: in_the_times(ADJOINTS[adjoint], *times)  # noqa: E731
    times, direction = (jnp.asarray(0.1), jnp.asarray(0.85)), (jnp.asarray(1.0), jnp.asarray(-0.5))

    def derivative(times):
        if adjoint == "forward":
            return jax.jvp(fun, (times,), (direction,))[1]
        return problems.inner(jax.grad(fun)(times), direction)

    expected = problems.central_difference(jax.jit(fun), times, direction, DIFFERENCE_STEP)
    assert abs(expected) > 0.1
    found = jax.jit(derivative, compiler_options=problems.QUICK)(times)
    np.testing.assert_allclose(found, expected, rtol=0, atol=DIFFERENCE_ERROR)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["checkpointed", "direct"])
def test_hessian_vector_products(adjoint):
    """The same steps as `cfjax.integrate`, whose products are tested against differences."""
    solver = cfjax.CF2(estimate=None)
    _, v, _ = problems.random_like(X, 2)

    def by_diffrax(y):
        sol = solve(solver, dt0=0.5, y0=y, adjoint=ADJOINTS[adjoint], max_steps=2)
        return jnp.sum(jnp.sin(sol.ys[-1]))

    def by_integrate(y):
        sol = cfjax.integrate(TERM, solver, 0.0, 1.0, y, ARGS, num_steps=2)
        return jnp.sum(jnp.sin(sol.ys[-1]))

    def forward_over_reverse(fun):
        product = lambda y: jax.jvp(jax.grad(fun), (y,), (v,))[1]  # noqa: E731
        return jax.jit(product, compiler_options=problems.QUICK)(Y0)

    def reverse_over_forward(fun):
        product = jax.grad(lambda y: jax.jvp(fun, (y,), (v,))[1])
        return jax.jit(product, compiler_options=problems.QUICK)(Y0)

    expected = forward_over_reverse(by_integrate)
    assert np.abs(expected).max() > 0.1
    # Sums of some 1000 products in another order.
    close(forward_over_reverse(by_diffrax), expected, atol=1e-13)
    if adjoint == "direct":
        close(reverse_over_forward(by_diffrax), expected, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    "adjoint, derivative, message",
    [
        (diffrax.RecursiveCheckpointAdjoint(), jax.jacfwd, "forward-mode autodiff"),
        (diffrax.ForwardMode(), jax.grad, "Reverse-mode differentiation does not work"),
        (diffrax.BacksolveAdjoint(), jax.grad, "cannot be autodifferentiated"),
    ],
    ids=lambda x: getattr(x, "__name__", type(x).__name__),
)
def test_what_an_adjoint_cannot_do_is_an_error(adjoint, derivative, message):
    """diffrax's own errors, in the start or, going backwards, in the times."""
    with pytest.raises((TypeError, ValueError, RuntimeError), match=message):
        derivative(lambda t1: in_the_times(adjoint, 0.1, t1))(0.85)


# Transformations


@pytest.mark.slow
@solvers
def test_a_batch_of_starts_and_args(solver):
    @jax.jit
    def end(y0, args):
        sol = solve(solver, y0=y0, args=args)
        assert sol.ys is not None
        return sol.ys[-1]

    y0 = jnp.stack([Y0, -Y0, Y0[::-1]])
    args = jnp.stack([ARGS, ARGS + 1, 2 * ARGS])
    close(jax.vmap(end)(y0, args), jnp.stack([end(*x) for x in zip(y0, args, strict=True)]))
    close(jax.vmap(end, (0, None))(y0, ARGS), jnp.stack([end(y, ARGS) for y in y0]))
    close(jax.vmap(end, (None, 0))(Y0, args), jnp.stack([end(Y0, a) for a in args]))


@pytest.mark.representatives(1)
@solvers
def test_one_program_serves_all_values(solver):
    @eqx.debug.assert_max_traces(max_traces=1)
    def run(term, t1, dt0, y0, args):
        return diffrax.diffeqsolve(term, solver, jnp.asarray(0.0), t1, dt0, y0, args).ys

    compiled = eqx.filter_jit(run)
    for scale in (1.0, 0.5, 2.0):
        term = cfjax.LieTerm(Driven(jnp.asarray(scale)))
        ys = compiled(term, jnp.asarray(scale), jnp.asarray(0.1), scale * Y0, scale * ARGS)
        assert abs(float(jnp.linalg.norm(ys[-1])) - scale * float(jnp.linalg.norm(Y0))) < 1e-14


def test_a_step_is_traced_once():
    """diffrax asks three times, of one function of the same shapes."""
    calls = []

    def field(t, y, args):
        calls.append(t)
        return cfjax.Rotation(jnp.cos(t) * y * args)

    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    diffrax.diffeqsolve(
        cfjax.LieTerm(field), cfjax.CF4(), 0.0, 1.0, 0.1, Y0, ARGS, stepsize_controller=controller
    )
    # Five evaluations, the one at the end among them, and some before the first step.
    assert 5 < len(calls) < 2 * 5


# What does not fit


@pytest.mark.representatives(1)
@solvers
def test_too_few_steps(solver):
    with pytest.raises(eqx.EquinoxRuntimeError, match="maximum number of solver steps"):
        solve(solver, max_steps=STEPS - 1)
    sol = solve(solver, max_steps=STEPS - 1, throw=False)
    assert sol.result == diffrax.RESULTS.max_steps_reached


def explosion(solver, y0, rate=1.0, **kwargs):
    """`y' = rate y^2`, which is infinite at t = 1 / (rate y0)."""
    term = cfjax.LieTerm(lambda t, y, args: rate * y * y)
    return diffrax.diffeqsolve(term, solver, 0.0, 3.0, 0.1, y0, **kwargs)


@pytest.mark.representatives(1)
@solvers
def test_a_blow_up_with_constant_steps_is_a_result(solver):
    y0 = jnp.asarray([1.0, 0.2])
    sol = explosion(solver, y0, throw=False)
    assert sol.result == diffrax.RESULTS.nonfinite
    # It ends there, at most a few steps behind t = 1.
    assert 10 <= sol.stats["num_steps"] < 20
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        explosion(solver, y0)
    assert explosion(solver, y0 / 4, throw=False).result == diffrax.RESULTS.successful


@pytest.mark.slow
def test_in_a_batch_a_blow_up_leaves_the_others_alone():
    y0 = jnp.asarray([[1.0, 0.2], [0.1, 0.2]])
    ys = jax.vmap(lambda y0: explosion(cfjax.CF4(), y0, throw=False).ys[-1])(y0)
    # y0 / (1 - 3 y0), to the error of the method.
    np.testing.assert_allclose(ys[1], [0.1 / 0.7, 0.5], rtol=1e-5)
    # The first ends where it fails.
    assert not np.isfinite(ys[0]).all()


def test_in_a_batch_a_blow_up_is_an_error():
    y0 = jnp.asarray([[1.0], [0.1]])
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        jax.vmap(lambda y0: explosion(cfjax.LieEuler(), y0))(y0)


@pytest.mark.slow
def test_a_gradient_beside_the_check_of_finiteness():
    slopes = jax.grad(lambda y0: jnp.sum(explosion(cfjax.CF4(), y0).ys[-1]))(jnp.asarray([0.1]))
    # (1 - 3 y0)^-2, to the error of the method.
    np.testing.assert_allclose(slopes, 1 / 0.49, rtol=1e-5)


@pytest.mark.representatives(1)
@plain_solvers
def test_error_control_without_an_estimate_is_refused(solver):
    controller = diffrax.PIDController(rtol=0, atol=1e-6)
    with pytest.raises(RuntimeError, match="error estimate"):
        solve(solver, stepsize_controller=controller)


@pytest.mark.slow
@solvers
def test_step_doubling_gives_an_estimate(answers, solver):
    """The tolerance governs the error. `atol` alone, as it is the same in every frame."""
    found = []
    for atol in (1e-5, 1e-9):
        sol = solve(
            diffrax.HalfSolver(solver),
            stepsize_controller=diffrax.PIDController(rtol=0, atol=atol),
        )
        assert sol.ys is not None
        error = float(np.linalg.norm(sol.ys[-1] - answers[1]))
        # The estimate is 2^p - 1 times too large, errors of some 10 to 100 steps add up.
        assert error < 100 * atol
        found.append((error, int(sol.stats["num_accepted_steps"])))
        # At most some hundred steps, with a rounding or two in each of their flows.
        assert abs(float(jnp.linalg.norm(sol.ys[-1]) - jnp.linalg.norm(Y0))) < 1e-13
    (loose, few), (tight, many) = found
    assert tight < loose / 100 and few < many


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    "solver",
    [diffrax.Bosh3(), diffrax.Tsit5(), diffrax.ReversibleHeun(), diffrax.Kvaerno3()],
    ids=lambda solver: type(solver).__name__,
)
def test_solvers_of_linear_spaces_refuse_frozen_fields(solver):
    """They would take coordinates of an algebra for a tangent vector.

    Euler, Midpoint, Heun and Ralston ask for `vf_prod` alone, which is the ambient tangent.
    """
    message = r"Rotation is a frozen vector field and not an array.*CF4"
    controller = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    with pytest.raises(TypeError, match=message):
        solve(solver, stepsize_controller=controller)
    if not isinstance(solver, diffrax.AbstractImplicitSolver):
        with pytest.raises(TypeError, match=message):
            cfjax.integrate(TERM, solver, 0.0, 1.0, Y0, ARGS, num_steps=2)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Heun()])
def test_solvers_of_linear_spaces_take_translations(solver):
    def field(t, y, args):
        return -args * y + jnp.sin(t)

    expected = solve(solver, term=diffrax.ODETerm(field))
    found = solve(solver, term=cfjax.LieTerm(field))
    close(found.ys, expected.ys, atol=0)


def test_no_warning_comes_from_a_plain_solve():
    """In particular none about a missing interpolation or an unknown order."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solve(cfjax.CF3(), saveat=diffrax.SaveAt(t0=True, t1=True))
    assert caught == []


@pytest.mark.slow
def test_the_solver_carries_no_state_from_step_to_step():
    """Two solves of half the length are one solve."""
    saveat = diffrax.SaveAt(t1=True, solver_state=True, controller_state=True, made_jump=True)
    first = solve(cfjax.CF4(), 0.5, saveat=saveat)
    assert first.ys is not None
    second = diffrax.diffeqsolve(
        TERM,
        cfjax.CF4(),
        0.5,
        1.0,
        1 / STEPS,
        first.ys[-1],
        ARGS,
        solver_state=first.solver_state,
        made_jump=first.made_jump,
    )
    assert second.ys is not None
    close(second.ys[-1], by_steps(cfjax.CF4(), nodes())[-1])
