"""Stages in a loop: the numbers and derivatives of stages that are written out."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax
from cfjax._solvers.stages import written_out

A, B = problems.GENERATORS[:2]
FIELDS = {
    "matrix": (problems.left_matrix, problems.ORTHOGONAL, problems.GENERATORS),
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
    "CF54": cfjax.CF54(),
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


def both(fun, *args):
    looped = jax.jit(lambda *a: fun(*a)).lower(*args)
    with written_out():
        plain = jax.jit(lambda *a: fun(*a)).lower(*args)
    assert "while" in looped.as_text()
    # Not the same program twice.
    assert looped.as_text() != plain.as_text()
    return tuple(program.compile(problems.QUICK)(*args) for program in (looped, plain))


def assert_same(found, expected, units):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=units * 2.0**-52)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("problem", FIELDS)
@pytest.mark.parametrize("name", SOLVERS)
def test_a_step(name, problem):
    field, y0, args = FIELDS[problem]
    y0, args = problems.arrays((y0, args))
    fun = lambda y0, args: moved(SOLVERS[name], field, y0, args)  # noqa: E731
    # Entries of size 1, some ten flows with a few roundings each.
    assert_same(*both(fun, y0, args), 100)


def columns(t, y, args):
    return cfjax.LowRankSkew(args @ y * jnp.sin(t) + args[:, :2])


COLUMNS = problems.arrays(
    (
        np.linalg.qr(np.cos(np.arange(12.0)).reshape(6, 2))[0],
        np.sin(np.arange(36.0) ** 1.5).reshape(6, 6) / 2,
    )
)


@pytest.mark.representatives(3)
@pytest.mark.parametrize("name", SOLVERS)
def test_a_step_in_coordinates_that_grow(name):
    """In a loop there is room for all of them from the start."""
    fun = lambda y0, args: moved(SOLVERS[name], columns, y0, args)  # noqa: E731
    # Ten flows, each a sum of ten products of vectors of up to 18 entries of size 1.
    assert_same(*both(fun, *COLUMNS), 1000)


def test_a_gradient_in_coordinates_that_grow_in_a_batch():
    loss = lambda y0, args: jnp.sum(jnp.sin(moved(SOLVERS["CF4"], columns, y0, args)[0]))  # noqa: E731
    fun = jax.vmap(jax.grad(loss, (0, 1)), (0, None))
    # As above, and back through every stage.
    y0, args = COLUMNS
    assert_same(*both(fun, jnp.stack([y0, -y0[::-1]]), args), 10_000)


def test_coordinates_that_grow_have_one_program_for_all_stages():
    """It compiles in the time that a program is long."""

    def evaluations():
        calls = []

        def field(t, y, args):
            calls.append(1)
            return columns(t, y, args)

        jax.make_jaxpr(lambda y0, args: moved(cfjax.CF54(), field, y0, args)[0])(*COLUMNS)
        return len(calls)

    # Once to check the start, at the start, in the loop and at the end; and at seven stages.
    assert evaluations() == 4
    with written_out():
        assert evaluations() == 9


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["CF3", "RKMK(Bosh3)"])
def test_a_gradient_in_a_batch(name):
    field = lambda t, y, args: cfjax.Rotation(args * y[:, 0] + t * y[:, 1])  # noqa: E731
    y0, args = jnp.eye(3), jnp.array([0.5, -0.4, 0.9])
    loss = lambda y0, args: jnp.sum(jnp.sin(moved(SOLVERS[name], field, y0, args)[0]))  # noqa: E731
    fun = jax.vmap(jax.grad(loss, (0, 1)), (0, None))
    # Sums of nine sines, each turned some ten times, and back through every stage.
    assert_same(*both(fun, jnp.stack([y0, 2 * y0]), args), 2000)


class Weighted(cfjax.AbstractFrozenField):
    """Grows with a number of its own, which is static."""

    a: jax.Array
    number: int = eqx.field(static=True, default=0)

    def flow(self, point):
        return point * jnp.exp(self.a)

    def tangent(self, point):
        return self.a * point


def test_fields_of_different_kinds_are_an_error_in_words():
    def field(t, y, args):
        kinds.append(1)
        return cfjax.LeftMatrix(A) if len(kinds) < 3 else cfjax.RightMatrix(A)

    kinds = []
    with pytest.raises(TypeError, match="Only fields of one kind can be added"):
        moved(cfjax.CF4(), field, jnp.eye(4), None)


def test_a_field_that_varies_is_written_out():
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
