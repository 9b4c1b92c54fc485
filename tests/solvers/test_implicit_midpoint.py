"""The implicit midpoint rule: order, derivatives, and iterations that do not converge."""

import functools

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


@pytest.mark.parametrize(
    "kind",
    ["body", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("left", "right", "flight"))],
)
def test_order_of_the_midpoint(kind, request, matrix_problems):
    if kind in ("left", "right"):
        problem = matrix_problems[kind]
    else:
        problem = request.getfixturevalue(f"{kind}_problem")
    field, start, args, answer = problem

    def order(solver, *steps):
        errors = problems.errors(field, solver, 1.0, start, args, answer, steps)
        return problems.slope(steps, errors)

    assert 1.9 < order(MIDPOINT, 20, 40) < 2.1
    if kind == "body":
        assert 3.8 < order(cfjax.Composition(MIDPOINT, 4), 8, 16) < 4.2


def end_of_body(y, inertia, solver=MIDPOINT):
    """After four steps: calls with the same shapes have one program."""
    return cfjax.integrate(TERM, solver, 0.0, 1.0, y, inertia, num_steps=4).ys[-1]


def test_derivatives_of_the_midpoint_are_those_of_the_implicit_function():
    """In forward mode they are in test_fixed_point.py."""
    weights, times = np.array([1.0, -0.5, 2.0]), problems.arrays((0.0, 0.25))

    @jax.jit
    def step(y, inertia):
        return problems.first_step(MIDPOINT, TERM, *times, y, inertia)[0]

    @functools.partial(jax.jit, compiler_options=problems.QUICK)
    def gradients(*x):
        return jax.vjp(step, *x)[1](jnp.asarray(weights))

    x = problems.MOMENTUM, problems.INERTIA
    for k, gradient in enumerate(gradients(START, INERTIA)):
        for j in range(3):
            change = 1e-5 * np.eye(3)[j]
            plus, minus = (
                np.asarray(step(*[jnp.asarray(a + d if i == k else a) for i, a in enumerate(x)]))
                for d in (change, -change)
            )
            # The square of the difference, and rounding over it.
            slope = weights @ (plus - minus) / 2e-5
            np.testing.assert_allclose(gradient[j], slope, rtol=0, atol=1e-9)
    # With infinite inertia nothing moves, and the derivative is the identity.
    np.testing.assert_array_equal(gradients(START, jnp.full(3, jnp.inf))[0], weights)


def test_a_midpoint_that_does_not_converge_fails():
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        end_of_body(400 * START, INERTIA)
    solver = cfjax.Composition(MIDPOINT, 4)
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        diffrax.diffeqsolve(TERM, solver, 0.0, 100.0, 30.0, 5 * START, INERTIA)


def test_few_iterations_for_a_tolerance():
    """With rtol the solve ends earlier, and is as exact as that."""
    rtol = 1e-6
    low = end_of_body(START, INERTIA, cfjax.ImplicitMidpoint(rtol=rtol))
    off = np.max(np.abs(low - end_of_body(START, INERTIA)))
    # A change below rtol leaves about as much, in each of four steps.
    assert 1e-3 * rtol < off < 2 * rtol
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        end_of_body(START, INERTIA, cfjax.ImplicitMidpoint(max_steps=3))


def test_wrong_arguments(no_shape_hook, subtests):
    # With an infinite rtol any first guess would be close enough.
    for options, text in (
        ({"rtol": 0.0}, "rtol must be positive and finite, or None, got 0.0"),
        ({"rtol": np.inf}, "rtol must be positive and finite, or None, got inf"),
        ({"rtol": True}, "rtol must be positive and finite, or None, got True"),
        ({"rtol": "1"}, "rtol must be positive and finite, or None, got '1'"),
        ({"max_steps": True}, "max_steps must be an integer from 1 on, got True"),
        ({"max_steps": 0}, "max_steps must be an integer"),
    ):
        with subtests.test(case=str(options)), pytest.raises(ValueError, match=text):
            cfjax.ImplicitMidpoint(**options)
