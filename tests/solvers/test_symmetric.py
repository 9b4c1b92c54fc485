"""What all symmetric methods keep: Poisson maps, invariants, and the way back."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

TOP, TOP_START = problems.DRIVEN_TOP, problems.arrays(problems.DRIVEN_TOP_START)
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

    both = jax.jacfwd(lambda s: (step(s),) * 2, has_aux=True)
    d, end = jax.jit(both, compiler_options=problems.QUICK)(SPINS)
    d = np.asarray(d).reshape(9, 9)
    return np.max(np.abs(d @ structure(SPINS) @ d.T - structure(end)))


def test_a_step_at_the_mean_is_a_poisson_map():
    # Products of matrices of size one, and a fixed point that is known to rounding.
    assert poisson_defect(of_spins(cfjax.Rotation), MIDPOINT) < 1e-14


@pytest.mark.slow
def test_a_step_at_the_middle_of_the_flow_is_no_poisson_map():
    # Another point than the mean, by the square of the step.
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


@pytest.mark.parametrize(
    "term, solver, start",
    [
        (TERM, MIDPOINT, START),
        (TOP, cfjax.Composition(cfjax.Strang(), 4), TOP_START),
        pytest.param(TOP, cfjax.BlanesMoan4(), TOP_START, marks=pytest.mark.slow),
    ],
    ids=["midpoint", "Composition", "BlanesMoan4"],
)
def test_steps_backwards_undo_steps_forwards(term, solver, start):
    assert solver.is_symmetric
    ends = cfjax.integrate(term, solver, 0.0, 4.0, start, INERTIA, num_steps=50).ys
    end = jax.tree.map(lambda y: y[-1], ends)
    back = cfjax.integrate(term, solver, 4.0, 0.0, end, INERTIA, num_steps=50).ys
    # A hundred steps of rounding, of numbers of size 2, which the motion magnifies a few times.
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(start), strict=True):
        np.testing.assert_allclose(a[-1], b, rtol=0, atol=2e-13)


@pytest.mark.parametrize(
    "term, solver, start",
    [
        (TOP, cfjax.Strang(), TOP_START),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                (TOP, cfjax.Composition(cfjax.Strang(), 4), TOP_START),
                (TERM, MIDPOINT, START),
            ]
        ),
    ],
    ids=["Strang", "Composition", "midpoint"],
)
def test_output_within_a_step(term, solver, start):
    """It meets both ends, and stays on the manifold between."""

    def output(y0, args):
        y1, _, info, _, _ = problems.first_step(solver, term, 0.0, 0.25, y0, args)
        path = solver.interpolation_cls(t0=jnp.asarray(0.0), t1=jnp.asarray(0.25), **info)
        return y1, jax.vmap(path.evaluate)(jnp.linspace(0.0, 0.25, 6))

    end, ys = problems.op_by_op(output, start, INERTIA)
    ends = jax.tree.map(lambda y: (y[0], y[-1]), ys)
    problems.assert_close(ends, jax.tree.map(lambda a, b: (a, b), start, end), 1e-14)
    if term is TOP:
        squares = np.einsum("tij,tik->tjk", ys["q"], ys["q"])
        expected = np.tile(np.eye(3), (6, 1, 1))
        np.testing.assert_allclose(squares, expected, rtol=0, atol=1e-14)
    else:
        np.testing.assert_allclose(np.linalg.norm(ys, axis=1), 1, rtol=0, atol=1e-14)


def test_a_jump_of_the_field_evaluates_the_first_force_again(subtests):
    """diffrax says where the field jumps; the first force of a step is then evaluated again."""
    pendulum = diffrax.MultiTerm(
        cfjax.LieTerm(lambda t, y, args: {"q": None, "p": -jnp.sin(y["q"])}),
        cfjax.LieTerm(lambda t, y, args: {"q": y["p"], "p": None}),
    )

    def ends(solver, start, other, is_jump):
        init = lambda y: solver.init(pendulum, 0.0, 0.1, y, None)  # noqa: E731
        fresh, stale = init(start), init(other)

        def step(state, made_jump):
            return solver.step(pendulum, 0.0, 0.1, start, None, state, made_jump)[0]

        return step(fresh, ~is_jump), step(stale, is_jump), step(stale, ~is_jump)

    start, other = ({"q": np.array([q]), "p": np.array([0.3])} for q in (0.5, -1.0))
    for solver in (cfjax.Strang(), cfjax.Composition(cfjax.Strang(), 4)):
        with subtests.test(solver=repr(solver)):
            want, got, wrong = problems.op_by_op(partial(ends, solver), start, other, True)
            for name in want:
                np.testing.assert_array_equal(got[name], want[name])
            assert np.max(np.abs(wrong["p"] - want["p"])) > 1e-3


def test_noise_is_refused():
    path = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))
    noise = cfjax.LieControlTerm(lambda t, y, args, w: cfjax.Rotation(w), path)
    for solver in (MIDPOINT, cfjax.Composition(MIDPOINT, 4)):
        with pytest.raises(TypeError, match="does not support noise"):
            term = diffrax.MultiTerm(TERM, noise)
            cfjax.integrate(term, solver, 0.0, 1.0, START, INERTIA, num_steps=2)
