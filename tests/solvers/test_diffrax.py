"""Every feature of `diffrax.diffeqsolve`, with a commutator-free and a Munthe-Kaas method."""

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

SOLVERS: dict[str, diffrax.AbstractSolver] = {"CF3": cfjax.CF3(), "RKMK4": cfjax.RKMK4()}
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


def by_steps(solver, times) -> Any:
    """The states at `times`, by calls of `step` alone."""
    return _by_steps(solver, jnp.asarray(times))


@eqx.filter_jit
def _by_steps(solver, times):
    def step(carry, interval):
        y, state = carry
        y1, _, _, state, _ = solver.step(TERM, *interval, y, ARGS, state, made_jump=False)
        return (y1, state), y1

    state = solver.init(TERM, times[0], times[1], Y0, ARGS)
    _, ys = jax.lax.scan(step, (Y0, state), (times[:-1], times[1:]))
    return jnp.concatenate([Y0[None], ys])


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
def test_output_of_every_kind_at_once(answers, solver, direction, capfd):
    """t0, t1, steps, every n-th step and a function, in a pytree, with a progress meter."""

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
    sol = solve(
        solver,
        float(direction),
        direction / STEPS,
        saveat=saveat,
        max_steps=STEPS,
        progress_meter=diffrax.TextProgressMeter(minimum_increase=0.25),
    )
    ts, ys = jtu.tree_map(np.asarray, (sol.ts, sol.ys))
    times = nodes(direction)
    exact = np.asarray(by_steps(solver, times))
    assert ts["ends"].tolist() == [0.0, float(direction)]
    assert sol.stats["num_accepted_steps"] == STEPS
    assert np.linalg.norm(ys["ends"][-1] - answers[direction]) < ERROR
    close((ts["ends"], ys["ends"]), (times[[0, -1]], exact[[0, -1]]))
    close((ts["steps"], ys["steps"]), (times[1:], exact[1:]))
    close((ts["with start"], ys["with start"]), (times, exact))
    third = np.array([0, 3, 6, 9, 12, 15, 18, 20])
    close((ts["third"][: len(third)], ys["third"][: len(third)]), (times[third], exact[third]))
    # Diffrax fills what is left with infinity.
    assert np.all(np.isinf(ys["third"][len(third) :]))
    close(ys["energy"]["t"], times[2::2])
    close(ys["energy"]["E"], np.sum(exact[2::2] ** 2 / problems.INERTIA, axis=1) / 2)
    jax.effects_barrier()
    lines = capfd.readouterr().out.split()
    assert lines[0] == "0.00%" and lines[-1] == "100.00%" and 4 <= len(lines) <= 6


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
        ("CF3", "checkpointed"),
        ("CF3", "direct"),
        ("CF3", "forward"),
        ("RKMK4", "checkpointed"),
    ],
)
def test_derivatives_in_start_args_and_field(name, adjoint):
    """Of each member of a batch; the members do not mix."""
    fun = jax.jit(jax.vmap(lambda x: functional(SOLVERS[name], ADJOINTS[adjoint], x)))
    batch = jtu.tree_map(lambda x: jnp.stack([x, x + 0.1]), X)
    direction = jtu.tree_map(lambda d: jnp.stack([d, d / 2]), problems.random_like(X, 3))
    expected = problems.central_difference(fun, batch, direction, DIFFERENCE_STEP)
    assert np.abs(expected).min() > 0.1
    if adjoint != "checkpointed":
        _, tangent = jax.jvp(fun, (batch,), (direction,))
        np.testing.assert_allclose(tangent, expected, rtol=0, atol=DIFFERENCE_ERROR)
    if adjoint != "forward":
        gradient = jax.jit(jax.grad(lambda x: jnp.sum(fun(x))))(batch)
        # Each of the three groups on its own, so that no error of one hides in another.
        for k in range(3):
            part = tuple(d if i == k else jnp.zeros_like(d) for i, d in enumerate(direction))
            expected = problems.central_difference(fun, batch, part, DIFFERENCE_STEP)
            for member in range(2):
                own, along = jtu.tree_map(lambda x, m=member: x[m], (gradient, part))
                found = problems.inner(own, along)
                np.testing.assert_allclose(found, expected[member], rtol=0, atol=DIFFERENCE_ERROR)


# Tracing


def test_a_step_is_traced_once():
    """diffrax asks three times, of one function of the same shapes."""
    calls = []

    def field(t, y, args):
        calls.append(t)
        return cfjax.Rotation(jnp.cos(t) * y * args)

    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    term = cfjax.LieTerm(field)

    def run(y0):
        return solve(cfjax.CF4(), y0=y0, term=term, stepsize_controller=controller).ys

    eqx.filter_eval_shape(run, Y0)
    # Five evaluations, the one at the end among them, and some before the first step.
    assert 5 < len(calls) < 2 * 5


# What does not fit


# `y' = y^2`, which is infinite at t = 1 / y0.
EXPLOSION = cfjax.LieTerm(lambda t, y, args: y * y)
CF4 = cfjax.CF4(estimate=None)


def explosion(y0, t1, throw=False, solver=CF4):
    t1 = jnp.asarray(t1)
    return solve(solver, t1, 0.1, y0, None, EXPLOSION, throw=throw, max_steps=29)


def test_failures_are_results_and_errors():
    """Those of members of a batch are in batch/test_batch.py."""
    y0 = jnp.asarray([1.0, 0.2])
    too_long, infinite, ended = (
        explosion(y, t1) for y, t1 in ((y0 / 10, 3.0), (y0, 3.0), (y0 / 4, 2.8))
    )
    assert too_long.result == diffrax.RESULTS.max_steps_reached
    assert infinite.result == diffrax.RESULTS.nonfinite
    # It ends there, at most a few steps behind t = 1.
    assert 10 <= infinite.stats["num_steps"] < 20
    assert ended.result == diffrax.RESULTS.successful
    # y0 / (1 - 2.8 y0), to the error of the method.
    np.testing.assert_allclose(ended.ys[-1], [0.25 / 0.3, 0.05 / 0.86], rtol=1e-4)
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        explosion(y0, 3.0, True, cfjax.LieEuler())


def test_solvers_that_do_not_fit_are_refused(subtests):
    """Those of linear spaces would take coordinates of an algebra for a tangent vector.

    Euler, Midpoint, Heun and Ralston ask for `vf_prod` alone, which is the ambient tangent.
    """
    controller = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    with subtests.test(case="no estimate"), pytest.raises(RuntimeError, match="error estimate"):
        solve(cfjax.CG4(), stepsize_controller=controller)
    message = r"Rotation is a frozen vector field and not an array.*CF4"
    for solver in (diffrax.Bosh3(), diffrax.ReversibleHeun(), diffrax.Kvaerno3()):
        with (
            subtests.test(case=type(solver).__name__),
            pytest.raises(TypeError, match=message),
        ):
            solve(solver, stepsize_controller=controller)
    with subtests.test(case="integrate"), pytest.raises(TypeError, match=message):
        cfjax.integrate(TERM, diffrax.Tsit5(), 0.0, 1.0, Y0, ARGS, num_steps=2)


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
