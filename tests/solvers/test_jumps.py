"""Fields that jump where steps end: every evaluation of a step belongs to the step."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from solver_table import SOLVERS

import cfjax

# One step for each slot. The start is not zero, and users find the slot of a time in three ways: by
# its number, and from a table of edges of either convention.
T0, SLOT, NUM_SLOTS = 0.3, 0.07, 12
T1 = T0 + NUM_SLOTS * SLOT
EDGES = np.linspace(T0, T1, NUM_SLOTS + 1)
AMPLITUDES = np.random.default_rng(0).normal(size=(NUM_SLOTS, 3)) * 8
START = np.array([0.36, 0.48, 0.8])
# A step is a product of some 30 flows at most, each with 10 roundings of numbers below 1.
UNITS = NUM_SLOTS * 300


def slots(t):
    edges = EDGES.astype(t.dtype)
    return jnp.stack(
        [
            jnp.floor((t - T0) / SLOT).astype(jnp.int32),
            jnp.searchsorted(edges, t, side="right") - 1,
            jnp.searchsorted(edges, t, side="left") - 1,
        ]
    )


def amplitudes(t, amplitudes):
    """Those of the slot, three times; NaN before the first slot and after the last."""
    k = slots(t)
    return amplitudes.at[jnp.where(k < 0, NUM_SLOTS, k)].get(mode="fill", fill_value=jnp.nan)


def rotation(t, y, args):
    return cfjax.Rotation(amplitudes(t, args))


def propagators():
    """The exact motion of START, one state for each edge."""
    states = [START]
    for a in AMPLITUDES:
        states.append(scipy.linalg.expm(problems.hat(a) * SLOT) @ states[-1])
    return np.stack(states)


def assert_is(actual, expected):
    eps = float(np.finfo(actual.dtype).eps)
    np.testing.assert_allclose(actual, [expected] * 3, atol=UNITS * eps)


def takes_any(name):
    # A stage of CG5 is before the start of the step.
    return SOLVERS[name].takes in ("any", "brackets", "time only") and name != "CG5"


# All have their evaluations from one place.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "CF4"))
        for name in filter(takes_any, SOLVERS)
    ],
)
def test_a_field_that_is_constant_in_each_step_is_solved_exactly(name):
    def solve(t0, t1, y0):
        term, solver = cfjax.LieTerm(rotation), SOLVERS[name].make()
        sol = cfjax.integrate(term, solver, t0, t1, y0, AMPLITUDES, num_steps=NUM_SLOTS)
        return sol.ys[-1]

    end = solve(T0, T1, jnp.stack([START] * 3))
    assert_is(end, propagators()[-1])
    assert_is(solve(T1, T0, end), START)


def test_a_step_that_begins_or_ends_at_zero():
    """Where one of the times has no rounding."""

    def field(t, y, args):
        t0, t1, a = args
        return cfjax.Rotation(jnp.where((t > t0) & (t < t1), a, jnp.nan))

    @jax.jit
    def end(t0, t1):
        args = t0, t1, AMPLITUDES[0]
        return problems.first_step(cfjax.CF4(), cfjax.LieTerm(field), t0, t1, START, args)[0]

    for times in ((0.0, SLOT), (-SLOT, 0.0)):
        found = end(*problems.arrays(times))
        np.testing.assert_allclose(found, propagators()[1], atol=UNITS * float(np.finfo(float).eps))


def test_single_precision():
    amplitudes, start = np.float32(AMPLITUDES), jnp.stack([np.float32(START)] * 3)
    term = cfjax.LieTerm(rotation)
    sol = cfjax.integrate(term, cfjax.CF4(), T0, T1, start, amplitudes, num_steps=NUM_SLOTS)
    assert sol.ys.dtype == np.float32
    assert_is(sol.ys[-1], propagators()[-1])


def radius(t, y, args):
    return jnp.abs(amplitudes(t, args)).sum()


RKL2 = cfjax.RKL2(spectral_radius=radius)


@pytest.mark.parametrize("solver", [RKL2, pytest.param(cfjax.CF4(), marks=pytest.mark.slow)])
def test_the_last_evaluation_is_not_handed_on(solver):
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(rotation),
        solver,
        *(T0, T1, None, jnp.stack([START] * 3), AMPLITUDES),
        stepsize_controller=diffrax.StepTo(EDGES),
        saveat=diffrax.SaveAt(ts=EDGES),
    )
    for y, expected in zip(sol.ys, propagators(), strict=True):
        assert_is(y, expected)


def test_the_state_of_the_solver_has_no_evaluation():
    term, args = cfjax.LieTerm(rotation), jnp.asarray(AMPLITUDES)

    def states(solver, t0, t1, y0):
        state = solver.init(term, t0, t1, y0, args)
        return state, solver.step(term, t0, t1, y0, args, state, made_jump=False)[3]

    # Those whose last evaluation is otherwise the first one of the next step.
    for solver in (cfjax.CF4(), cfjax.RKMK5(), cfjax.Magnus6(), RKL2):
        times = jnp.asarray(T0), jnp.asarray(T0 + SLOT)
        for state in eqx.filter_eval_shape(states, solver, *times, jnp.stack([START] * 3)):
            assert state.first is None


def test_translations_and_exponential_methods():
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(lambda t, y, args: amplitudes(t, args)),
        cfjax.ETD43(),
        *(T0, T1, None, jnp.zeros((3, 3)), AMPLITUDES),
        stepsize_controller=diffrax.StepTo(EDGES),
        saveat=diffrax.SaveAt(ts=EDGES[1:]),
    )
    for y, expected in zip(sol.ys, SLOT * np.cumsum(AMPLITUDES, axis=0), strict=True):
        assert_is(y, expected)


def test_splittings():
    # The clock advances during the last term.
    clock = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.zeros((3, 3))))
    term = diffrax.MultiTerm(cfjax.LieTerm(rotation), clock)
    y0 = jnp.stack([START] * 3)
    solver = cfjax.Composition(cfjax.Strang(), 4)
    sol = cfjax.integrate(term, solver, T0, T1, y0, AMPLITUDES, num_steps=NUM_SLOTS)
    assert_is(sol.ys[-1], propagators()[-1])


@pytest.mark.slow
def test_a_qubit_that_is_driven_and_loses_energy():
    pauli = np.array([[[0, 1], [1, 0]], [[0, -1j], [1j, 0]], [[1, 0], [0, -1]]], complex)
    lowering, rates = np.array([[0, 1], [0, 0]], complex), jnp.full((3, 1), 0.7)

    def field(t, y, args):
        h = jnp.einsum("sk,kij->sij", amplitudes(t, args).astype(complex), pauli) / 2
        return cfjax.Lindblad(h, [lowering], rates)

    def solve(args, y0):
        term, solver = cfjax.LieTerm(field), cfjax.Kraus4()
        return cfjax.integrate(term, solver, T0, T1, y0, args, num_steps=NUM_SLOTS, save_every=1).ys

    start = jnp.stack([np.array([[0.3, 0.4j], [-0.4j, 0.7]])] * 3)
    # Kraus4 is not exact: in each slot it solves what has the same amplitudes in all slots.
    expected = start
    for a in AMPLITUDES:
        expected = solve(np.tile(a, (NUM_SLOTS, 1)), expected)[0]
    # The lengths of steps differ by the rounding of times.
    found = solve(AMPLITUDES, start)[-1]
    np.testing.assert_allclose(found, expected, atol=UNITS * float(np.finfo(float).eps))


def test_the_step_back_evaluates_the_same_slots():
    """The gradient in NumPy: the derivative of the flow of a slot between those of the others."""
    weights = np.arange(9.0).reshape(3, 3)

    def end(args):
        term, solver, y0 = cfjax.LieTerm(rotation), cfjax.Magnus4Lobatto(), jnp.stack([START] * 3)
        sol = cfjax.integrate(term, solver, T0, T1, y0, args, num_steps=NUM_SLOTS, step_back=True)
        return jnp.sum(sol.ys[-1] * weights)

    expected, after = np.zeros((NUM_SLOTS, 3)), weights.sum(axis=0)
    for k in reversed(range(NUM_SLOTS)):
        turn, before = SLOT * problems.hat(AMPLITUDES[k]), propagators()[k]
        for i, axis in enumerate(np.eye(3)):
            change = scipy.linalg.expm_frechet(turn, SLOT * problems.hat(axis), compute_expm=False)
            expected[k, i] = after @ change @ before
        after = after @ scipy.linalg.expm(turn)
    assert np.abs(expected).min() > 1e-3
    found = jax.jit(jax.grad(end), compiler_options=problems.QUICK)(jnp.asarray(AMPLITUDES))
    # Numbers of size 1, of as many products as the solution itself.
    np.testing.assert_allclose(found, expected, atol=UNITS * float(np.finfo(float).eps))
