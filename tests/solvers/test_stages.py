"""Stages rolled into a loop: the numbers and derivatives of stages that are not.

test_step.py compares rolled stages of every method with an interpreter.
"""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.linalg import expm
from solver_table import continuous_extension

import cfjax

SOLVERS = {
    "CF4": cfjax.CF4(),
    "CG3": cfjax.CG3(),
    "RKMK(Tsit5)": cfjax.RKMK(diffrax.Tsit5.tableau),
    "RKMK(Dopri8)": cfjax.RKMK(diffrax.Dopri8.tableau),
}


T0, H, THETA = 0.1, 0.3, 1 / 3


def moved(solver, field, y0, args):
    """One step: its end, its estimate and a point within it."""
    term, time = cfjax.LieTerm(field), (jnp.asarray(T0), jnp.asarray(T0 + H))
    y1, error, dense, _, _ = problems.first_step(solver, term, *time, y0, args)
    path = solver.interpolation_cls(t0=time[0], t1=time[1], **dense)
    return y1, error, path.evaluate(T0 + THETA * H)


def by_hand(tableau, matrix, y0):
    """The same of a commutator-free method in NumPy; the field is a matrix."""
    fields = []

    def end(rows):
        y = y0
        for row in rows:
            y = expm(sum(float(a) * f for a, f in zip(row, fields, strict=False))) @ y
        return y

    for rows, c in zip(tableau.alpha, tableau.c, strict=True):
        fields.append(H * matrix(T0 + float(c) * H, end(rows)))
    y1 = end(tableau.beta)
    fields.append(H * matrix(T0 + H, y1))
    # The coefficient of each field is a polynomial without a constant term.
    powers = THETA ** np.arange(1.0, 10.0)
    within = [powers[: len(flow)] @ np.array(flow, float) for flow in continuous_extension(tableau)]
    return y1, y1 - end(tableau.embedded), end(within)


def both(fun, name, *args):
    """`fun(solver, *args)` with the stages rolled and not."""
    runs = [partial(fun, solver) for solver in (SOLVERS[name], SOLVERS[name].unrolled())]
    rolled, plain = (str(jax.make_jaxpr(run)(*args)) for run in runs)
    assert "scan[" in rolled
    # Not the same program twice.
    assert rolled != plain
    return tuple(problems.op_by_op(run, *args) for run in runs)


def assert_same(found, expected, units):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=units * 2.0**-52)


def columns(t, y, args):
    return cfjax.LowRankSkew(args @ y * jnp.sin(t) + args[:, :2])


COLUMNS = problems.arrays(
    (
        np.linalg.qr(np.cos(np.arange(12.0)).reshape(6, 2))[0],
        np.sin(np.arange(36.0) ** 1.5).reshape(6, 6) / 2,
    )
)


# Ten flows, each a sum of ten products of vectors of up to 18 entries of size 1.
UNITS = 1000


def test_rolled_stages_in_coordinates_that_grow():
    """In a loop there is room for all of them from the start."""
    y0, a = COLUMNS

    def matrix(t, y):
        g = a @ y * np.sin(t) + a[:, :2]
        return g @ y.T - y @ g.T

    step = jax.jit(partial(moved, cfjax.CF3(), columns), compiler_options=problems.QUICK)
    assert_same(step(y0, a), by_hand(cfjax.CF3.tableau, matrix, np.asarray(y0)), UNITS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_stages_in_coordinates_that_grow_are_rolled(name):
    fun = lambda solver, y0, args: moved(solver, columns, y0, args)  # noqa: E731
    assert_same(*both(fun, name, *COLUMNS), UNITS)


def test_coordinates_that_grow_have_one_program_for_all_stages():
    """It compiles in the time that a program is long."""

    def evaluations(solver):
        calls = []

        def field(t, y, args):
            calls.append(1)
            return columns(t, y, args)

        term, time = cfjax.LieTerm(field), (jnp.asarray(T0), jnp.asarray(T0 + H))
        jax.eval_shape(lambda *x: problems.first_step(solver, term, *time, *x)[0], *COLUMNS)
        return len(calls)

    # Once to check the start, to see whether the field jumps, at the start, to see whether later
    # ones are alike, in the loop and at the end; and at seven stages.
    assert evaluations(cfjax.CF54()) == 6
    assert evaluations(cfjax.CF54(unroll=True)) == 10


def batch_of_gradients(solver, field, y0, args):
    loss = lambda y0, args: jnp.sum(jnp.sin(moved(solver, field, y0, args)[0]))  # noqa: E731
    return jax.vmap(jax.grad(loss, (0, 1)), (0, None))(jnp.stack([y0, -y0[::-1]]), args)


@pytest.mark.slow
def test_a_gradient_with_rolled_stages_in_a_batch():
    """In NumPy by complex steps, which no rounding limits."""
    args = np.array([0.5, -0.4, 0.9])

    def derivative(y0, args, *direction):
        dy0, dargs = (1e-30j * x for x in direction)
        matrix = lambda t, y: problems.hat((args + dargs) * y[:, 0] + t * y[:, 1])  # noqa: E731
        end = by_hand(cfjax.CF3.tableau, matrix, y0 + dy0)[0]
        return np.sum(np.sin(end)).imag / 1e-30

    def gradient(y0):
        of_y0 = [derivative(y0, args, e.reshape(3, 3), 0 * args) for e in np.eye(9)]
        return np.reshape(of_y0, (3, 3)), np.array([derivative(y0, args, 0, e) for e in np.eye(3)])

    field = lambda t, y, args: cfjax.Rotation(args * y[:, 0] + t * y[:, 1])  # noqa: E731
    run = jax.jit(partial(batch_of_gradients, cfjax.CF3(), field), compiler_options=problems.QUICK)
    expected = map(np.stack, zip(*map(gradient, (np.eye(3), -np.eye(3)[::-1])), strict=True))
    # Sums of nine sines, each turned some ten times, and back through every stage.
    assert_same(run(*problems.arrays((np.eye(3), args))), tuple(expected), 2000)


@pytest.mark.slow
def test_a_gradient_with_rolled_stages_in_coordinates_that_grow():
    fun = lambda solver, *args: batch_of_gradients(solver, columns, *args)  # noqa: E731
    # Sums of twelve sines, each of ten products of vectors of up to 18 entries, and back.
    assert_same(*both(fun, "CF4", *COLUMNS), 10_000)


class Weighted(cfjax.AbstractFrozenField):
    """Grows with a number of its own, which is static."""

    a: jax.Array
    number: int = eqx.field(static=True, default=0)

    def flow(self, point):
        return point * jnp.exp(self.a)

    def tangent(self, point):
        return self.a * point


def test_a_field_that_varies_is_unrolled():
    """Here in its static part, which no array can hold for all stages."""

    def field(t, y, args):
        numbers.append(1)
        return Weighted(jnp.cos(t) * y / 2, len(numbers))

    numbers = []
    y0 = jnp.linspace(0.5, 1.0, 9)
    time = jnp.asarray(T0), jnp.asarray(T0 + H)
    step = lambda y0: problems.first_step(cfjax.CF2(), cfjax.LieTerm(field), *time, y0, None)[0]  # noqa: E731
    found = jax.jit(step)(y0)
    half = 0.25
    middle = y0 * np.exp(0.15 * np.cos(0.1) * y0 / 2)
    expected = y0 * np.exp(0.3 * np.cos(half) * middle / 2)
    np.testing.assert_allclose(found, expected, rtol=1e-15)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver",
    [cfjax.CF2(unroll=False), cfjax.RKMK5(unroll=False), cfjax.Magnus4(unroll=False)],
    ids=lambda solver: type(solver).__name__,
)
@pytest.mark.usefixtures("rewritten")
def test_a_small_step_is_rolled_if_asked_for(solver):
    """It is rewritten for XLA else, one flow after the other."""
    args = (jnp.array([0.5, -0.4, 0.9]), jnp.array([0.3, 0.2, -0.1]))

    def field(t, y, args):
        return cfjax.Rotation(args[0] + t * args[1])

    def end(solver, y0):
        times = jnp.asarray(T0), jnp.asarray(T0 + H)
        return problems.first_step(solver, cfjax.LieTerm(field), *times, y0, args)[0]

    y0 = jnp.array([0.6, 0.0, 0.8])
    assert "scan[" in str(jax.make_jaxpr(partial(end, solver))(y0))
    assert "scan[" not in str(jax.make_jaxpr(partial(end, solver.unrolled()))(y0))
    with cfjax.rewriting(False):
        expected = jax.jit(partial(end, solver.unrolled()))(y0)
    # Entries of size 1, some ten flows with a few roundings each.
    assert_same(jax.jit(partial(end, solver))(y0), expected, 100)


def test_another_unroll_is_refused(no_shape_hook):
    for make in (cfjax.CF4, cfjax.RKMK5, cfjax.RKMK4, cfjax.Magnus4):
        with pytest.raises(ValueError, match="unroll must be True, False or None, got 1"):
            make(unroll=1)
