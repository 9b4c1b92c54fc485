"""Checks of methods in several coordinates, on flows of matrices: a product of flows at a time.

Each flow is alone in its part of the state, and a program of all is compiled once.
"""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from matrix_problems import LATTICE, ORTHONORMAL, Problem, expm, low_rank, skew

import cfjax

quick = functools.partial(jax.jit, compiler_options=problems.QUICK)
FAILS = "without bound, or the steps"


def scaled(s, field):
    return jax.tree.map(lambda x: s.astype(x.dtype) * x, field)


def product(given: dict[str, Problem]) -> Problem:
    def field(t, y, args):
        return {name: flow.field(t, y[name], args[name]) for name, flow in given.items()}

    y0, args = ({x: flow[k] for x, flow in given.items()} for k in (1, 2))
    return Problem(field, y0, args, lambda t: {x: flow.exact(t) for x, flow in given.items()})


def fixed_of(name, y):
    """What stays, by NumPy: a spectrum, or products of columns or rows."""
    if name == "Riccati":
        return np.zeros(0)
    if name in ("Toda", "conjugation"):
        # Of matrices that are not symmetric, as eigenvalues may be ill-conditioned.
        return np.stack([np.trace(np.linalg.matrix_power(y, k)) for k in range(1, len(y) + 1)])
    return y @ y.conj().T if name in ("rows", "SO(5), body frame") else y.conj().T @ y


def check_order(subtests, solver, given, steps, slopes, few, fixed=fixed_of):
    """To t = 2 against exact answers; and what stays in few steps, which are off by far more.

    Mistakes in the coordinates leave order 2.
    """
    whole, order = product(given), solver.order(None)
    y0, args = problems.arrays((whole.y0, whole.args))

    def end(t1, n):
        times = problems.arrays((0.0, t1))
        return problems.many_steps(whole.field, solver, *times, y0, args, jnp.asarray(n))

    ends, early = [end(2.0, n) for n in steps], end(*few)
    for name, flow in given.items():
        with subtests.test(problem=name):
            off = np.array([np.linalg.norm(y[name] - flow.exact(2.0)) for y in ends])
            # A hundred roundings of numbers up to 3.
            is_seen = off > 5e-14
            assert is_seen.sum() > 1
            slope = problems.slope(np.array(steps)[is_seen], off[is_seen])
            assert order + slopes[0] < slope < order + slopes[1]
            found, start = np.asarray(early[name]), flow.y0
            assert np.abs(found - flow.exact(few[0])).max() > 1e-10
            np.testing.assert_allclose(fixed(name, found), fixed(name, start), rtol=0, atol=2e-14)


def periodic(t, y, args):
    """As Toda's own flow comes to rest."""
    return cfjax.Conjugation(jnp.cos(t) * args + jnp.triu(y, 1) - jnp.tril(y, -1))


# For many steps: with fields that vary.
VARYING = {
    "low rank": Problem(low_rank, ORTHONORMAL, (skew(6), skew(3)), None),
    "Toda": Problem(periodic, LATTICE, skew(4), None),
}


def check_many_steps(
    subtests, solver, given, num_steps, fixed=fixed_of, is_relative=False, more=VARYING
):
    """In steps of 0.1: what stays does to 5e-14, of the largest entry above 1 if relative."""
    given = more | given
    ends: Any = product(given).end(solver, 0.1 * num_steps, num_steps)
    for name, flow in given.items():
        found, expected = (fixed(name, np.asarray(y)) for y in (ends[name], flow.y0))
        scale = max(np.abs(expected).max(), 1) if is_relative else 1
        with subtests.test(problem=name):
            np.testing.assert_allclose(found, expected, rtol=0, atol=5e-14 * scale)


def check_output(subtests, solver, given, steps, fixed=fixed_of):
    """Within steps, of two lengths: what stays, and the order."""
    whole, order, ts = product(given), solver.order(None), np.linspace(0.05, 2.0, 16)
    y0, args = problems.arrays((whole.y0, whole.args))

    @jax.jit
    def saved(h):
        return diffrax.diffeqsolve(
            whole.term, solver, 0.0, 2.0, h, y0, args, saveat=diffrax.SaveAt(ts=ts)
        ).ys

    outputs = [saved(2.0 / n) for n in steps]
    for name, flow in given.items():
        exact = np.stack([flow.exact(t) for t in ts])
        pair = [np.asarray(ys[name]) for ys in outputs]
        with subtests.test(problem=name):
            for y in np.concatenate(pair):
                np.testing.assert_allclose(fixed(name, y), fixed(name, flow.y0), rtol=0, atol=1e-14)
            off = [np.abs(ys - exact).max() for ys in pair]
            # The end of a step has the order of the method, and is saved too.
            assert order - 1.5 < np.log2(off[0] / off[1]) < order + 1.3


def one_step(solver, field, y0, args):
    times = problems.arrays((0.0, 0.4))
    return problems.first_step(solver, cfjax.LieTerm(field), *times, y0, args)[0]


def check_derivatives(solver, given, atol):
    """Of a step, forwards and in reverse, by a factor of the field."""
    whole = product(given)
    y0, args = problems.arrays((whole.y0, whole.args))
    weights = problems.random_like(y0, 1)

    def value(s):
        y = one_step(solver, lambda t, y, s: scaled(s, whole.field(t, y, args)), y0, s)
        products = jax.tree.map(lambda w, y: jnp.sum(w * jnp.real(y)), weights, y)
        return sum(jax.tree.leaves(products))

    @quick
    def derivatives(s):
        return *jax.value_and_grad(value)(s), jax.jvp(value, (s,), (jnp.ones_like(s),))[1]

    s = jnp.asarray(1.1)
    expected = problems.central_difference(lambda s: derivatives(s)[0], s, 1.0, 1e-3)
    # Rounding over the step of the quotient, and 1e-12 of its fourth power.
    np.testing.assert_allclose(derivatives(s)[1:], [expected] * 2, rtol=0, atol=atol)


def check_batches(solver, given):
    """`vmap` and leading axes, of fields at two scales, give what single steps do."""
    whole = product(given)
    y0, args = problems.arrays((whole.y0, whole.args))
    scales = jnp.asarray([0.3, 1.0])

    def of_one(t, y, scale):
        return scaled(scale, whole.field(t, y, args))

    def of_both(t, y, scales):
        return jax.vmap(lambda scale, y: of_one(t, y, scale))(scales, y)

    def alone(y0, scale):
        return one_step(solver, of_one, y0, scale)

    stack = lambda *xs: jnp.stack(xs)  # noqa: E731
    expected = jax.tree.map(stack, *(quick(alone)(y0, x) for x in scales))
    assert max(np.abs(x[0] - x[1]).max() for x in jax.tree.leaves(expected)) > 0.01
    of_axes = quick(lambda y0: one_step(solver, of_both, y0, scales))
    problems.assert_close(of_axes(jax.tree.map(stack, y0, y0)), expected, 1e-14)
    problems.assert_close(quick(jax.vmap(alone, (None, 0)))(y0, scales), expected, 1e-14)


def check_single_precision(solver, given, atol):
    def low(x):
        return np.asarray(x, np.complex64 if np.iscomplexobj(x) else np.float32)

    whole = product(given)
    y0, args = jax.tree.map(low, (whole.y0, whole.args))
    end: Any = whole._replace(y0=y0, args=args).end(solver, 2.0, 20)
    assert [x.dtype for x in jax.tree.leaves(end)] == [x.dtype for x in jax.tree.leaves(y0)]
    problems.assert_close(end, whole.exact(2.0), atol)


# Turns by an angle in unit time.

_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def turned(cls, angle):
    """The end after an angle, or after angles of several elements."""
    turn = expm(np.multiply.outer(angle, _TURN))
    if cls is cfjax.Congruence:
        return turn @ np.diag([1.0, 2.0, 3.0]) @ turn.T
    return turn[:, :1] if cls is cfjax.LowRankSkew else turn


def turning(cls):
    def field(t, y, angle):
        a = jnp.einsum("...,ij->...ij", angle, _TURN)
        return cls(a @ y if cls is cfjax.LowRankSkew else a)

    return field


def check_steps_that_are_too_long(subtests, solver, cases):
    """`cases` has a class of fields for each name, and an angle at which a step of it fails."""
    y0 = {name: turned(cls, 0.0 * angle) for name, (cls, angle) in cases.items()}
    slow = {name: np.ones_like(angle) for name, (_, angle) in cases.items()}
    fields = {name: turning(cls) for name, (cls, _) in cases.items()}
    term = cfjax.LieTerm(lambda t, y, args: {x: f(t, y[x], args[x]) for x, f in fields.items()})
    y0, slow = problems.arrays((y0, slow))

    def end(angles):
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, angles, num_steps=1).ys

    @jax.jit
    def controlled(angles, tolerance):
        control = diffrax.PIDController(rtol=0.0, atol=tolerance)
        sol = diffrax.diffeqsolve(
            term, solver, 0.0, 1.0, 1.0, y0, angles, stepsize_controller=control
        )
        return sol.ys, sol.stats["num_rejected_steps"]

    ends: Any = end(slow)
    for name, (cls, angle) in cases.items():
        angles = slow | {name: jnp.asarray(angle)}
        with subtests.test(name=name):
            assert np.abs(ends[name][-1] - turned(cls, np.ones_like(angle))).max() < 0.02
            with pytest.raises(RuntimeError, match=FAILS):
                end(angles)
            # With such a tolerance the estimate alone would not reject the step.
            assert controlled(angles, 1e3)[1] > 0
            found, _ = controlled(angles, 1e-6)
            assert np.abs(found[name][-1] - turned(cls, angle)).max() < 1e-5


def slope_of_a_controlled_turn(solver, cls):
    """The derivative of the first entry by a factor of the angle of 3, after a rejected step."""
    field, y0 = turning(cls), jnp.asarray(turned(cls, 0.0))

    def end(s):
        control = diffrax.PIDController(rtol=0.0, atol=1e-8)
        term = cfjax.LieTerm(lambda t, y, s: field(t, y, 3.0 * s))
        sol = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 1.0, y0, s, stepsize_controller=control)
        return sol.ys[-1, 0, 0]

    return jax.grad(end)(jnp.asarray(1.0))
