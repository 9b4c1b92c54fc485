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

import cfjax

A, B = problems.GENERATORS[:2]
FIELDS = {
    "product": (problems.body_in_flight, problems.FLIGHT_START, problems.FLIGHT_ARGS),
    "complex": (
        lambda t, y, args: cfjax.RightMatrix(
            (args[0] + args[0].T) * (1j * t.astype(complex)) + args[1] * y[0, 0]
        ),
        jnp.eye(4, dtype=complex),
        (A.astype(complex), B.astype(complex)),
    ),
}
SOLVERS = {
    "CF3": cfjax.CF3(),
    "CF4": cfjax.CF4(),
    "CG3": cfjax.CG3(),
    "RKMK(Tsit5)": cfjax.RKMK(diffrax.Tsit5.tableau),
    "RKMK(Bosh3)": cfjax.RKMK(diffrax.Bosh3.tableau),
    "RKMK(Dopri8)": cfjax.RKMK(diffrax.Dopri8.tableau),
}


def moved(solver, field, y0, args):
    """One step: its end, its estimate and a point within it."""
    term, time = cfjax.LieTerm(field), (jnp.asarray(0.1), jnp.asarray(0.4))
    state = solver.init(term, *time, y0, args)
    y1, error, dense, _, _ = solver.step(term, *time, y0, args, state, made_jump=False)
    return y1, error, solver.interpolation_cls(t0=time[0], t1=time[1], **dense).evaluate(0.2)


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


@pytest.mark.slow
@pytest.mark.parametrize("problem", FIELDS)
@pytest.mark.parametrize("name", ["CF4", "RKMK(Tsit5)"])
def test_a_step_with_rolled_stages(name, problem):
    field, y0, args = FIELDS[problem]
    y0, args = problems.arrays((y0, args))
    fun = lambda solver, y0, args: moved(solver, field, y0, args)  # noqa: E731
    # Entries of size 1, some ten flows with a few roundings each.
    assert_same(*both(fun, name, y0, args), 100)


def columns(t, y, args):
    return cfjax.LowRankSkew(args @ y * jnp.sin(t) + args[:, :2])


COLUMNS = problems.arrays(
    (
        np.linalg.qr(np.cos(np.arange(12.0)).reshape(6, 2))[0],
        np.sin(np.arange(36.0) ** 1.5).reshape(6, 6) / 2,
    )
)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", SOLVERS)
def test_rolled_stages_in_coordinates_that_grow(name):
    """In a loop there is room for all of them from the start."""
    fun = lambda solver, y0, args: moved(solver, columns, y0, args)  # noqa: E731
    # Ten flows, each a sum of ten products of vectors of up to 18 entries of size 1.
    assert_same(*both(fun, name, *COLUMNS), 1000)


def test_coordinates_that_grow_have_one_program_for_all_stages():
    """It compiles in the time that a program is long."""

    def evaluations(solver):
        calls = []

        def field(t, y, args):
            calls.append(1)
            return columns(t, y, args)

        jax.make_jaxpr(lambda y0, args: moved(solver, field, y0, args)[0])(*COLUMNS)
        return len(calls)

    # Once to check the start, to see whether the field jumps, at the start, to see whether later
    # ones are alike, in the loop and at the end; and at seven stages.
    assert evaluations(cfjax.CF54()) == 6
    assert evaluations(cfjax.CF54(unroll=True)) == 10


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "name, field, y0, args",
    [
        *(
            (
                name,
                lambda t, y, args: cfjax.Rotation(args * y[:, 0] + t * y[:, 1]),
                jnp.eye(3),
                jnp.array([0.5, -0.4, 0.9]),
            )
            for name in ("CF3", "RKMK(Bosh3)")
        ),
        ("CF4", columns, *COLUMNS),
    ],
    ids=["CF3", "RKMK(Bosh3)", "coordinates that grow"],
)
def test_a_gradient_with_rolled_stages_in_a_batch(name, field, y0, args):

    def fun(solver, y0, args):
        loss = lambda y0, args: jnp.sum(jnp.sin(moved(solver, field, y0, args)[0]))  # noqa: E731
        return jax.vmap(jax.grad(loss, (0, 1)), (0, None))(y0, args)

    # Sums of nine sines, each turned some ten times, and back through every stage; or of twelve,
    # each of ten products of vectors of up to 18 entries.
    units = 2000 if field is not columns else 10_000
    assert_same(*both(fun, name, jnp.stack([y0, -y0[::-1]]), args), units)


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
    time = jnp.asarray(0.1), jnp.asarray(0.4)
    found = problems.first_step(cfjax.CF2(), cfjax.LieTerm(field), *time, y0, None)[0]
    half = 0.25
    middle = y0 * np.exp(0.15 * np.cos(0.1) * y0 / 2)
    expected = y0 * np.exp(0.3 * np.cos(half) * middle / 2)
    np.testing.assert_allclose(found, expected, rtol=1e-15)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver",
    [cfjax.CF4(unroll=False), cfjax.RKMK5(unroll=False), cfjax.Magnus4(unroll=False)],
    ids=lambda solver: type(solver).__name__,
)
@pytest.mark.usefixtures("rewritten")
def test_a_small_step_is_rolled_if_asked_for(solver):
    """It is rewritten for XLA else, one flow after the other."""
    args = (jnp.array([0.5, -0.4, 0.9]), jnp.array([0.3, 0.2, -0.1]))

    def field(t, y, args):
        return cfjax.Rotation(args[0] + t * args[1])

    def end(solver, y0):
        times = jnp.asarray(0.1), jnp.asarray(0.4)
        return problems.first_step(solver, cfjax.LieTerm(field), *times, y0, args)[0]

    y0 = jnp.array([0.6, 0.0, 0.8])
    assert "scan[" in str(jax.make_jaxpr(partial(end, solver))(y0))
    assert "scan[" not in str(jax.make_jaxpr(partial(end, solver.unrolled()))(y0))
    with cfjax.rewriting(False):
        expected = problems.op_by_op(partial(end, solver.unrolled()), y0)
    # Entries of size 1, some ten flows with a few roundings each.
    assert_same(end(solver, y0), expected, 100)


def test_another_unroll_is_refused(no_shape_hook):
    for make in (cfjax.CF4, cfjax.RKMK5, cfjax.RKMK4, cfjax.Magnus4):
        with pytest.raises(ValueError, match="unroll must be True, False or None, got 1"):
            make(unroll=1)
