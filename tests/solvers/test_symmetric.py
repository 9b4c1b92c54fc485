"""Symmetric methods for long times: the implicit midpoint rule at the mean, and compositions."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

INERTIA, START = jnp.asarray(problems.INERTIA), jnp.asarray(problems.MOMENTUM)
TERM = cfjax.LieTerm(problems.rigid_body)
MIDPOINT = cfjax.ImplicitMidpoint()


class Turn(cfjax.AbstractFrozenField):
    """A rotation that does not know the mean of its flow."""

    omega: jax.Array

    def flow(self, point):
        return cfjax.Rotation(self.omega).flow(point)

    def tangent(self, point):
        return cfjax.Rotation(self.omega).tangent(point)


def kick(t, y, args):
    torque = (1 + 0.3 * jnp.sin(t)) * jnp.cross(jnp.asarray([0.2, 0.3, 1.0]), y["q"][:, 2])
    return {"q": None, "m": torque}


def spin(axis):
    def field(t, y, args):
        m = jnp.eye(3)[axis] * y["m"] / args
        return {"q": cfjax.RightMatrix(jnp.cross(jnp.eye(3), m)), "m": cfjax.Rotation(-m)}

    return field


# A driven top, each of whose terms has an exact flow, and the same without splitting.
TOP = diffrax.MultiTerm(*map(cfjax.LieTerm, (kick, spin(0), spin(1), spin(2))))
TOP_START = {"q": jnp.eye(3), "m": jnp.asarray([1.0, 0.5, 2.0])}


def top_ode(t, y):
    q, m = y[3:].reshape(3, 3), y[:3]
    w = m / problems.INERTIA
    torque = (1 + 0.3 * np.sin(t)) * np.cross([0.2, 0.3, 1.0], q[:, 2])
    hat = np.cross(np.eye(3), w)
    return np.concatenate([np.cross(m, w) + torque, (q @ hat).ravel()])


@pytest.fixture(scope="module")
def top_answer():
    start = np.concatenate([TOP_START["m"], np.eye(3).ravel()])
    return problems.reference(top_ode, 0.0, 1.0, start)


def end_of_top(solver, num_steps):
    ys = cfjax.integrate(TOP, solver, 0.0, 1.0, TOP_START, INERTIA, num_steps=num_steps).ys
    return np.concatenate([np.ravel(ys["m"][-1]), np.ravel(ys["q"][-1])])


@pytest.mark.parametrize(
    "solver, order, num_steps",
    [
        (cfjax.Strang(), 2, (16, 32)),
        (cfjax.BlanesMoan4(), 4, (8, 16)),
        pytest.param(cfjax.BlanesMoan6(), 6, (4, 8), marks=pytest.mark.slow),
        (cfjax.Composition(cfjax.Strang(), 4), 4, (16, 32)),
        pytest.param(cfjax.Composition(cfjax.Strang(), 6), 6, (8, 16), marks=pytest.mark.slow),
        pytest.param(cfjax.Composition(cfjax.Strang(), 8), 8, (6, 12), marks=pytest.mark.slow),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, diffrax.AbstractSolver) else "",
)
def test_order_of_splittings_of_four_terms(solver, order, num_steps, top_answer):
    first, second = (np.max(np.abs(end_of_top(solver, n) - top_answer)) for n in num_steps)
    # Above the rounding of the reference, so the slope is the method's.
    assert second > 20 * problems.REFERENCE_ERROR
    assert order - 0.1 < np.log2(first / second) < order + 0.35
    assert solver.order(TOP) == order


@pytest.mark.representatives(2)
@pytest.mark.parametrize("kind", ["body", "left", "right", "flight"])
def test_order_of_the_midpoint(kind, request, matrix_problems):
    if kind in ("left", "right"):
        field, start, args, answer = matrix_problems[kind]
    else:
        field, start, args, answer = request.getfixturevalue(f"{kind}_problem")
    start, args = problems.arrays(start), problems.arrays(args)

    def off(solver, num_steps):
        ys = cfjax.integrate(
            cfjax.LieTerm(field), solver, 0.0, 1.0, start, args, num_steps=num_steps
        ).ys
        return np.max(np.abs(problems.flat(jax.tree.map(lambda y: y[-1], ys)) - answer))

    assert 1.9 < np.log2(off(MIDPOINT, 20) / off(MIDPOINT, 40)) < 2.1
    if kind == "body":
        four = cfjax.Composition(MIDPOINT, 4)
        assert 3.8 < np.log2(off(four, 8) / off(four, 16)) < 4.2


# Three spins with a Hamiltonian that has no symmetry.
COUPLING = jnp.asarray(np.random.default_rng(4).normal(size=(3, 3, 3)))
SPINS = np.random.default_rng(5).normal(size=(3, 3))
SPINS = jnp.asarray(SPINS / np.linalg.norm(SPINS, axis=1, keepdims=True))


def energy(s):
    pairs = jnp.einsum("ia,iab,ib->", s, COUPLING, jnp.roll(s, 1, axis=0))
    return pairs + jnp.sum(s[:, 2] ** 2) / 2


def of_spins(make):
    return cfjax.LieTerm(lambda t, s, args: make(-jax.grad(energy)(s)))


def poisson_defect(term, solver):
    """How far one step is from a Poisson map: D B D^T at the start less B at the end."""

    def step(s):
        return cfjax.integrate(term, solver, 0.0, 0.1, s, num_steps=1).ys[-1]

    def structure(s):
        blocks = [np.cross(np.eye(3), x) for x in np.asarray(s)]
        b = np.zeros((9, 9))
        for k, block in enumerate(blocks):
            b[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
        return b

    d = np.asarray(jax.jacfwd(step)(SPINS)).reshape(9, 9)
    return np.max(np.abs(d @ structure(SPINS) @ d.T - structure(step(SPINS))))


def test_a_step_at_the_mean_is_a_poisson_map():
    # Products of matrices of size one, and a fixed point that is known to rounding.
    assert poisson_defect(of_spins(cfjax.Rotation), MIDPOINT) < 1e-14
    # The middle of the flow is another point, by the square of the step.
    turn = cfjax.elementwise
    middle = poisson_defect(of_spins(lambda w: turn(jax.vmap(Turn)(w))), MIDPOINT)
    assert 1e-6 < middle < 1e-2


@pytest.mark.slow
def test_one_component_of_the_spins_at_a_time_is_a_poisson_map():
    def split(masks):
        def term(mask):
            # All three interact.
            others = lambda s: jnp.roll(s, 1, axis=0) + jnp.roll(s, -1, axis=0)  # noqa: E731
            return cfjax.LieTerm(lambda t, s, args: cfjax.Rotation(mask * others(s)))

        return diffrax.MultiTerm(*map(term, masks))

    eye = jnp.eye(3)
    # As for the midpoint.
    assert poisson_defect(split(eye[:, None, :]), cfjax.Strang()) < 1e-14
    # One spin at a time turns in the field of others, which do not feel it.
    assert 1e-6 < poisson_defect(split(eye[:, :, None]), cfjax.Strang()) < 1e-1


def test_linear_momenta_and_lengths_stay():
    """The total spin is kept by the mean, as exchange keeps it at every point."""

    def exchange(t, s, args):
        return cfjax.Rotation(-(jnp.roll(s, 1, axis=0) + jnp.roll(s, -1, axis=0)))

    ys = cfjax.integrate(cfjax.LieTerm(exchange), MIDPOINT, 0.0, 20.0, SPINS, num_steps=100).ys
    # 100 steps, each with a rounding of its solve.
    np.testing.assert_allclose(ys[-1].sum(0), SPINS.sum(0), rtol=0, atol=1e-13)
    np.testing.assert_allclose(jnp.linalg.norm(ys[-1], axis=1), 1, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_the_energy_of_the_midpoint_does_not_drift():
    ys: Any = cfjax.integrate(
        TERM, MIDPOINT, 0.0, 1e4, START, INERTIA, num_steps=100_000, save_every=100
    ).ys
    energies = np.asarray(jnp.sum(ys**2 / INERTIA, axis=1) / 2)
    tenths = energies.reshape(10, -1).mean(axis=1)
    # Each mean is one over 100 saved states of an oscillation: flat means within its scatter.
    assert np.ptp(tenths) < np.std(energies) / 5


@pytest.mark.parametrize(
    "term, solver, start",
    [
        (TERM, MIDPOINT, START),
        (TOP, cfjax.Strang(), TOP_START),
        (TOP, cfjax.BlanesMoan4(), TOP_START),
        (TOP, cfjax.Composition(cfjax.Strang(), 4), TOP_START),
    ],
    ids=["midpoint", "Strang", "BlanesMoan4", "Composition"],
)
def test_there_and_back(term, solver, start):
    assert solver.is_symmetric
    ends = cfjax.integrate(term, solver, 0.0, 4.0, start, INERTIA, num_steps=50).ys
    end = jax.tree.map(lambda y: y[-1], ends)
    back = cfjax.integrate(term, solver, 4.0, 0.0, end, INERTIA, num_steps=50).ys
    # A hundred steps of rounding, of numbers of size 2, which the motion magnifies a few times.
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(start), strict=True):
        np.testing.assert_allclose(a[-1], b, rtol=0, atol=2e-13)


def test_derivatives_of_the_midpoint_are_those_of_the_implicit_function():
    def end(y, inertia):
        return cfjax.integrate(TERM, MIDPOINT, 0.0, 1.0, y, inertia, num_steps=4).ys[-1]

    forward = jax.jit(jax.jacfwd(end, argnums=(0, 1)))(START, INERTIA)
    reverse = jax.jit(jax.jacrev(end, argnums=(0, 1)))(START, INERTIA)
    for k, (a, b) in enumerate(zip(forward, reverse, strict=True)):
        # Two linear solves, each to rounding.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14)
        for j in range(3):
            step = 1e-5 * jnp.eye(3)[j]
            args = [START, INERTIA]
            plus, minus = (
                end(*[x + sign * step if i == k else x for i, x in enumerate(args)])
                for sign in (1, -1)
            )
            # The square of the difference, and rounding over it.
            np.testing.assert_allclose(a[:, j], (plus - minus) / 2e-5, rtol=0, atol=1e-9)
    # At rest nothing moves, and the derivative is the identity.
    rest = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(0 * y))
    still = lambda y: cfjax.integrate(rest, MIDPOINT, 0.0, 1.0, y, num_steps=2).ys[-1]  # noqa: E731
    np.testing.assert_array_equal(jax.jacrev(still)(START), np.eye(3))


def test_a_midpoint_that_does_not_converge_fails():
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        cfjax.integrate(TERM, MIDPOINT, 0.0, 100.0, 5 * START, INERTIA, num_steps=3)
    solution = cfjax.integrate(
        TERM, MIDPOINT, 0.0, 100.0, 5 * START, INERTIA, num_steps=3, throw=False
    )
    assert solution.result != diffrax.RESULTS.successful
    one = cfjax.Composition(MIDPOINT, 4)
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        cfjax.integrate(TERM, one, 0.0, 100.0, 5 * START, INERTIA, num_steps=3)
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        diffrax.diffeqsolve(TERM, MIDPOINT, 0.0, 100.0, 30.0, 5 * START, INERTIA)


def test_few_iterations_for_a_tolerance():
    """With rtol the solve ends earlier, and is as exact as that."""

    def end(solver):
        return cfjax.integrate(TERM, solver, 0.0, 1.0, START, INERTIA, num_steps=2).ys[-1]

    exact = end(MIDPOINT)
    for rtol in (1e-4, 1e-8):
        off = np.max(np.abs(end(cfjax.ImplicitMidpoint(rtol=rtol)) - exact))
        # A change below rtol leaves about as much, in each of two steps.
        assert 1e-3 * rtol < off < 2 * rtol
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        end(cfjax.ImplicitMidpoint(max_steps=3))


def test_batches_and_float32():
    starts = jnp.stack([START, 2 * START, 0.5 * START])
    end = lambda y: cfjax.integrate(TERM, MIDPOINT, 0.0, 1.0, y, INERTIA, num_steps=5).ys[-1]  # noqa: E731
    one_by_one = jnp.stack([end(y) for y in starts])
    # A batch iterates until the last has converged, to rounding.
    np.testing.assert_allclose(jax.vmap(end)(starts), one_by_one, rtol=0, atol=1e-14)
    low = cfjax.integrate(
        TERM,
        MIDPOINT,
        0.0,
        1.0,
        START.astype(jnp.float32),
        INERTIA.astype(jnp.float32),
        num_steps=5,
    ).ys[-1]
    assert low.dtype == jnp.float32
    np.testing.assert_allclose(low, end(START), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    "term, solver, start",
    [
        (TERM, MIDPOINT, START),
        (TOP, cfjax.Strang(), TOP_START),
        pytest.param(TOP, cfjax.Composition(cfjax.Strang(), 4), TOP_START, marks=pytest.mark.slow),
    ],
    ids=["midpoint", "Strang", "Composition"],
)
def test_output_within_a_step(term, solver, start):
    saveat = diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 9), t1=True)
    solution = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.25, start, INERTIA, saveat=saveat)
    ends = cfjax.integrate(
        term, solver, 0.0, 1.0, start, INERTIA, num_steps=4, save_every=1, save_initial=True
    ).ys
    for a, b in zip(jax.tree.leaves(solution.ys), jax.tree.leaves(ends), strict=True):
        # At the ends of steps exactly.
        np.testing.assert_allclose(a[:9:2], b, rtol=0, atol=1e-14)
    # On the manifold between.
    ys: Any = solution.ys
    if term is TOP:
        squares = jnp.einsum("tij,tik->tjk", ys["q"], ys["q"])
        np.testing.assert_allclose(squares, np.tile(np.eye(3), (10, 1, 1)), rtol=0, atol=1e-14)
    else:
        np.testing.assert_allclose(jnp.linalg.norm(ys, axis=1), 1, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "solver",
    [cfjax.Strang(), cfjax.Composition(cfjax.Strang(), 4)],
    ids=lambda solver: type(solver).__name__,
)
def test_a_jump_of_the_field_refreshes_what_is_known(solver):
    """diffrax says where the field jumps; the first force of a step is then evaluated again."""
    stale = solver.init(TOP, 0.0, 0.1, {"q": jnp.eye(3)[::-1], "m": TOP_START["m"]}, INERTIA)
    fresh = solver.init(TOP, 0.0, 0.1, TOP_START, INERTIA)

    @jax.jit
    def step(state, made_jump):
        return solver.step(TOP, 0.0, 0.1, TOP_START, INERTIA, state, made_jump)[0]

    want, got, wrong = step(fresh, False), step(stale, True), step(stale, False)
    for name in want:
        np.testing.assert_array_equal(got[name], want[name])
    assert np.max(np.abs(wrong["m"] - want["m"])) > 1e-3


NOISE = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))
NOISY = diffrax.MultiTerm(
    TERM, cfjax.LieControlTerm(lambda t, y, args, w: cfjax.Rotation(w), NOISE)
)


@pytest.mark.parametrize(
    "make, kind, text",
    [
        (lambda: cfjax.ImplicitMidpoint(rtol=0.0), ValueError, "rtol must be positive or None"),
        (lambda: cfjax.ImplicitMidpoint(max_steps=0), ValueError, "max_steps must be an integer"),
        (lambda: cfjax.Composition(cfjax.CF4(), 4), TypeError, "solver must be a symmetric one"),
        (
            lambda: cfjax.Composition(cfjax.Strang(), 5),
            ValueError,
            "order must be 4, 6 or 8, got 5",
        ),
        (lambda: cfjax.Splitting((0.5, 0.4)), ValueError, "stages must be an even number of"),
        (lambda: cfjax.Splitting((1.0,)), ValueError, "stages must be an even number of"),
    ],
)
def test_wrong_arguments(make, kind, text, no_shape_hook):
    with pytest.raises(kind, match=text):
        make()


@pytest.mark.parametrize("solver", [MIDPOINT, cfjax.Composition(MIDPOINT, 4)])
def test_noise_is_refused(solver):
    with pytest.raises(TypeError, match="takes no noise"):
        cfjax.integrate(NOISY, solver, 0.0, 1.0, START, INERTIA, num_steps=2)
