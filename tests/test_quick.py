"""Every solver and every field once, with a gradient: minutes tell whether a version works at all.

`make test-quick` runs this with the canary, leading axes and the public names. In `make test` other
tests see the same solvers and fields.
"""

import inspect

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solver_table import FRAME, ON_SPHERE, SOLVERS, problem_for, unit

import cfjax

SQUARE = np.array([[0.4, -0.2], [0.1, 0.3]])

FIELDS = {
    "array": (lambda t, y, args: args * jnp.sin(y), ON_SPHERE),
    "Rotation": (unit, ON_SPHERE),
    "QuaternionRotation": (
        lambda t, y, args: cfjax.QuaternionRotation(args * y[1:] + t, frame="body", layout="wxyz"),
        np.array([0.1, 0.5, -0.5, 0.7]),
    ),
    "RigidMotion": (
        lambda t, y, args: cfjax.RigidMotion(
            omega=args * y[4:] + t, v=args, frame="body", layout="wxyz_xyz"
        ),
        np.array([0.6, 0.0, 0.8, 0.0, 0.3, -0.4, 0.5]),
    ),
    "PlanarMotion": (
        lambda t, y, args: cfjax.PlanarMotion(
            omega=args[0] * y[2] + t, v=args[1:] + y[2:], frame="fixed", layout="unit_complex_xy"
        ),
        np.array([0.6, 0.8, 0.3, -0.4]),
    ),
    "ExtendedMotion": (
        lambda t, y, args: cfjax.ExtendedMotion(
            omega=args * y[7:] + t, a=args, v=args * y[4:7], frame="body", layout="wxyz_v_p"
        ),
        np.array([0.6, 0.0, 0.8, 0.0, 0.3, -0.4, 0.5, 0.1, 0.2, -0.3]),
    ),
    "InertialMotion": (
        lambda t, y, args: cfjax.InertialMotion(
            omega=args * y[7:] + t, force=args, gravity=-args / 2, layout="wxyz_v_p"
        ),
        np.array([0.6, 0.0, 0.8, 0.0, 0.3, -0.4, 0.5, 0.1, 0.2, -0.3]),
    ),
    "LeftMatrix": (lambda t, y, args: cfjax.LeftMatrix(jnp.outer(args, y)), ON_SPHERE),
    "RightMatrix": (lambda t, y, args: cfjax.RightMatrix(jnp.outer(y, args)), ON_SPHERE),
    "Conjugation": (lambda t, y, args: cfjax.Conjugation(args[:2, None] * y + t), SQUARE),
    "Congruence": (lambda t, y, args: cfjax.Congruence(args[:2, None] * y, jnp.sin(y + t)), SQUARE),
    "Lindblad": (
        lambda t, y, args: cfjax.Lindblad(
            jnp.diag(args * (t + jnp.diag(y).real)), [args[:, None] * np.eye(3, k=1)]
        ),
        np.full((3, 3), 1 / 3 + 0j),
    ),
    "LinearAffine": (
        lambda t, y, args: cfjax.LinearAffine(jnp.outer(args, jnp.sin(y)), y + t),
        ON_SPHERE,
    ),
    "Scaling": (lambda t, y, args: cfjax.Scaling(args * jnp.cos(y + t)), ON_SPHERE),
    "LowRankSkew": (unit, FRAME),
    "SphereRotation": (lambda t, y, args: cfjax.SphereRotation(args * y + t), ON_SPHERE),
    "BorderedSkew": (
        lambda t, y, args: cfjax.BorderedSkew(
            jnp.concatenate([jnp.array([[0.0, 0.3], [-0.3, 0.0]]), args[None, :2] * y[2:]])
        ),
        FRAME,
    ),
    "OperatorSum": (
        lambda t, y, args: cfjax.OperatorSum(
            args[:2] * y[:2] + t, [np.eye(3, k=1), np.arange(3.0)]
        ),
        ON_SPHERE,
    ),
    "Affine": (
        lambda t, y, args: cfjax.Affine(jnp.sin(y), -args, cfjax.SineTransform()),
        ON_SPHERE,
    ),
}


def check(solver, term, y0, has_gradient):
    """Against a reference in plain space, and a gradient against a difference."""
    parts = term.terms if isinstance(term, diffrax.MultiTerm) else (term,)
    fields = [part.field for part in parts if isinstance(part, cfjax.LieTerm)]

    def end(args):
        return cfjax.integrate(term, solver, 0.0, 0.2, y0, args, num_steps=2).ys[-1]

    args, direction = jnp.array([0.5, -0.4, 0.9]), jnp.array([0.3, 0.2, -0.5])

    def rate(t, y):
        return sum(cfjax.tangent(field(t, y, args), y) for field in fields)

    y0 = jnp.asarray(y0)
    exact = np.asarray(y0 + 0.2 * rate(0.1, y0 + 0.1 * rate(0.0, y0)))
    # The midpoint rule in one step, rates up to 2; and two steps of Euler's method at worst: both
    # are off by less than 0.2 * 0.1 * 2^2 / 2.
    np.testing.assert_allclose(np.asarray(end(args)), exact, rtol=0, atol=0.04)
    if has_gradient:
        weights = np.arange(1.0, 1 + y0.size).reshape(y0.shape)
        loss = jax.jit(lambda args: jnp.sum(jnp.real(end(args)) * weights))
        slope = (loss(args + 1e-4 * direction) - loss(args - 1e-4 * direction)) / 2e-4
        # The difference is off by (1e-4)^2 / 6 times a third derivative, and by 1e-16 / 1e-4.
        found = jax.grad(loss)(args) @ direction
        assert found == pytest.approx(float(slope), rel=1e-6, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOLVERS)
def test_every_solver(name):
    row = SOLVERS[name]
    check(row.make(), *problem_for(row.takes), has_gradient=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_every_field(name):
    field, y0 = FIELDS[name]
    check(cfjax.CF3(), cfjax.LieTerm(field), y0, has_gradient=True)


def test_no_field_is_left_out():
    fields = {
        name
        for name, value in inspect.getmembers(cfjax)
        if inspect.isclass(value) and issubclass(value, cfjax.AbstractFrozenField)
    }
    abstract = {name for name in fields if name.startswith("Abstract")}
    # What a field is in plain space.
    assert fields - abstract - {"Nearest"} == FIELDS.keys() - {"array"}


@pytest.mark.slow
def test_steps_that_are_controlled():
    """By diffrax, with output within the steps."""
    solution = diffrax.diffeqsolve(
        cfjax.LieTerm(unit),
        cfjax.CF43(),
        0.0,
        1.0,
        0.1,
        jnp.asarray(ON_SPHERE),
        jnp.array([0.5, -0.4, 0.9]),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-6),
        saveat=diffrax.SaveAt(dense=True),
    )
    # Rounding of some ten steps, each of a few units.
    np.testing.assert_allclose(jnp.linalg.norm(solution.evaluate(0.37)), 1, rtol=0, atol=1e-14)
