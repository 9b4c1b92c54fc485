"""Whether a field is linear in an increment: what its program shows, and what a check of it finds.

A program that does not show it is asked for values, by `cfjax.check_terms` and by a solve.
"""

from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import problems
import pytest

import cfjax
from cfjax._numerics.linearity import linearity

STATE = jnp.asarray(problems.MOMENTUM)

# What a program shows: the power of x, and what is left where x is zero. By hand.
SHOWN: dict[str, Any] = {
    "constant": (lambda x, y, a: y, 0, "some"),
    "parameter": (lambda x, y, a: a, 0, "unknown"),
    "zero": (lambda x, y, a: 0.0 * x, 0, "zero"),
    "linear": (lambda x, y, a: y * x * a, 1, "zero"),
    "sum": (lambda x, y, a: x + x[::-1], 1, "zero"),
    "matrix": (lambda x, y, a: jnp.outer(y, y) @ x, 1, "zero"),
    "affine": (lambda x, y, a: y * x + y, 1, "some"),
    # The parameter may be zero, and two parts of the state may cancel.
    "affine in a parameter": (lambda x, y, a: x + a, 1, "unknown"),
    "a difference": (lambda x, y, a: x + (y - y[::-1]), 1, "unknown"),
    "square": (lambda x, y, a: x * x, 2, "zero"),
    "power": (lambda x, y, a: x**2, 2, "zero"),
    "sine": (lambda x, y, a: jnp.sin(x), 3, "unknown"),
    "quotient": (lambda x, y, a: y / x, 3, "unknown"),
}


def test_linearity_of_a_program(subtests):
    for name, (fun, power, constant) in SHOWN.items():
        (found,) = linearity(fun, jnp.ones(3), STATE, jnp.ones(3))
        with subtests.test(case=name):
            assert (found.power, found.constant) == (power, constant)


# Fields of an increment

A = np.array([[2.0, 0.1, 0.0], [0.3, 1.0, 0.2], [0.0, -0.4, 3.0]])
DECAY = -np.arange(3.0)


@jax.custom_jvp
def with_a_rule(x):
    return 2 * x


with_a_rule.defjvp(lambda x, dx: (with_a_rule(*x), 2 * dx[0]))


class Kept(eqx.Module):
    """A field with an array that a compiled program does not know."""

    rest: Any

    def __call__(self, t, y, args, dw):
        return cfjax.LinearAffine(self.rest, dw)


def on_host(dw):
    shape = jax.ShapeDtypeStruct(dw.shape, dw.dtype)
    return jax.pure_callback(lambda x: 2 * np.asarray(x), shape, dw, vmap_method="sequential")


LINEAR: dict[str, Any] = {
    "product": lambda y, a, dw: y * dw * a,
    "Rotation": lambda y, a, dw: cfjax.Rotation(jnp.cross(y, dw) + A @ dw),
    "stack": lambda y, a, dw: cfjax.Rotation(jnp.stack([dw[0], 0.0, dw[2] * y[1]])),
    "entry": lambda y, a, dw: jnp.zeros(3).at[1].set(dw[0]),
    "all entries": lambda y, a, dw: y.at[:].set(dw),
    "gather": lambda y, a, dw: dw[jnp.argsort(y)],
    "where": lambda y, a, dw: jnp.where(y > 0.5, dw, 0.0),
    "cond": lambda y, a, dw: jax.lax.cond(y[0] > 0, lambda x: x, lambda x: 2 * x, dw),
    "loop": lambda y, a, dw: jax.lax.fori_loop(0, 3, lambda k, c: c + y[k] * dw, jnp.zeros(3)),
    "jit": lambda y, a, dw: jax.jit(lambda x: x * y)(dw),
    "custom_jvp": lambda y, a, dw: with_a_rule(dw),
    "jvp": lambda y, a, dw: jax.jvp(lambda y: jnp.sin(y) * y, (y,), (dw,))[1],
    "solve": lambda y, a, dw: jnp.linalg.solve(A + jnp.diag(y), dw),
    "fft": lambda y, a, dw: jnp.fft.irfft(jnp.fft.rfft(dw) * jnp.fft.rfft(y), 3),
    "lineax": lambda y, a, dw: lx.linear_solve(lx.MatrixLinearOperator(A * a), dw).value,
    "host": lambda y, a, dw: on_host(dw),
    # Linear, but not as far as the program shows.
    "unit vector": lambda y, a, dw: dw / jnp.linalg.norm(dw) * jnp.linalg.norm(dw),
    "matrix": lambda y, a, dw: cfjax.LeftMatrix(dw[0] * a * A),
    "Affine": lambda y, a, dw: cfjax.Affine(dw, DECAY, alpha=dw[0]),
    "Affine, zero": lambda y, a, dw: cfjax.Affine(dw, DECAY, cfjax.SineTransform(), alpha=0.0),
    "LinearAffine, zero": lambda y, a, dw: cfjax.LinearAffine(np.zeros((3, 3)), dw),
    "kept zeros": lambda y, a, dw: Kept(jnp.zeros((3, 3)))(0, y, a, dw),
    "operators": lambda y, a, dw: cfjax.OperatorSum(dw * a, [A, A - 1, A.T]),
    "times zero": lambda y, a, dw: 0.0 * y + dw,
}
DRIFTS: dict[str, Any] = {
    "of the state": lambda y, a, dw: y * dw - y,
    "of a parameter": lambda y, a, dw: dw - a * y,
    "Rotation": lambda y, a, dw: cfjax.Rotation(y * dw - y),
    "Rotation, of a parameter": lambda y, a, dw: cfjax.Rotation(dw - a * y),
    "alone": lambda y, a, dw: cfjax.Rotation(-y),
    "Affine": lambda y, a, dw: cfjax.Affine(dw, DECAY),
}
NOT_LINEAR: dict[str, Any] = {
    "square": lambda y, a, dw: y * dw**2,
    "product": lambda y, a, dw: cfjax.Rotation(dw * dw[0]),
    "sine": lambda y, a, dw: y * jnp.sin(dw),
    "sign": lambda y, a, dw: y * jnp.sign(dw),
    "rectified": lambda y, a, dw: y * jnp.maximum(dw, 0.0),
    "apply": lambda y, a, dw: dw.at[0].apply(jnp.sin),
    "integers": lambda y, a, dw: dw.astype(int).astype(float),
}
THREE = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))


def of_three(field):
    return cfjax.LieControlTerm(lambda t, y, args, dw: field(y, args, dw), THREE)


def checks(field, y=STATE):
    cfjax.check_terms(of_three(field), jnp.asarray(0.0), y, jnp.asarray(0.5))


def test_fields_that_are_linear_have_a_drift_or_are_not(subtests):
    for name, field in LINEAR.items():
        with subtests.test(case=("linear", name)):
            checks(field)
    texts = (
        (DRIFTS, r"zero where the increment is zero.*LieTerm\(drift"),
        (NOT_LINEAR, "that of a sum of two increments is not the sum of their"),
    )
    for fields, text in texts:
        for name, field in fields.items():
            with subtests.test(case=(text, name)), pytest.raises(ValueError, match=text):
                checks(field)


def test_a_drift_is_seen_where_the_start_is_special():
    """At zero that of an Ornstein-Uhlenbeck process is zero."""
    with pytest.raises(ValueError, match="not zero where the increment is zero"):
        checks(DRIFTS["of a parameter"], jnp.zeros(3))


def test_increments_of_several_parts_and_complex_ones():
    def field(t, y, args, dw):
        return {"a": y["a"] * dw["x"], "b": 1j * y["b"] * dw["z"].astype(complex), "c": None}

    shapes = {"x": jax.ShapeDtypeStruct((), float), "z": jax.ShapeDtypeStruct((2,), float)}
    path = diffrax.UnsafeBrownianPath(shapes, jax.random.key(0))
    y = {"a": jnp.ones(3), "b": jnp.ones(2, complex), "c": jnp.ones(1)}
    cfjax.check_terms(cfjax.LieControlTerm(field, path), jnp.asarray(0.0), y)

    def with_drift(t, y, args, dw):
        return {**field(t, y, args, dw), "c": y["c"]}

    at_rest = cfjax.LieTerm(lambda t, y, args: dict.fromkeys("abc"))
    both = diffrax.MultiTerm(at_rest, cfjax.LieControlTerm(with_drift, path))
    with pytest.raises(ValueError, match=r"terms\[1\]: The field of a cfjax.LieControlTerm must"):
        cfjax.check_terms(both, jnp.asarray(0.0), y)


def test_check_field_names_the_check_of_terms(no_shape_hook):
    terms: Any = [of_three(LINEAR["product"])] * 2
    with pytest.raises(TypeError, match=r"For terms there is cfjax\.check_terms"):
        cfjax.check_field(terms, STATE)


@pytest.mark.parametrize("solver", [cfjax.CF2(), diffrax.Euler()], ids=["CF2", "Euler"])
def test_a_solve_refuses_a_drift_in_the_noise(solver):
    """When it is traced, whichever the solver."""
    solve = partial(cfjax.integrate, of_three(DRIFTS["of the state"]), solver, 0.0, 1.0, STATE)
    with pytest.raises(ValueError, match="not zero where the increment is zero"):
        solve(num_steps=2)


def test_what_a_program_does_not_show_is_an_error_of_the_start():
    term = of_three(DRIFTS["of a parameter"])
    solve = partial(cfjax.integrate, term, cfjax.CF2(), 0.0, 1.0, STATE, num_steps=2)
    with pytest.raises(RuntimeError, match="not zero where the increment is zero"):
        solve(jnp.asarray(0.5))
    # For the parameter zero there is no drift.
    ends = jax.vmap(lambda a: solve(a, throw=False).ys[-1])(jnp.asarray([0.0, 0.5]))
    np.testing.assert_array_equal(np.isfinite(ends), [[True] * 3, [False] * 3])
