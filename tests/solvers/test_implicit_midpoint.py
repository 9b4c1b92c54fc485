"""The implicit midpoint rule: order, derivatives, and iterations that do not converge."""

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


def test_derivatives_of_the_midpoint_are_those_of_the_implicit_function():
    def end(y, inertia):
        return cfjax.integrate(TERM, MIDPOINT, 0.0, 1.0, y, inertia, num_steps=4).ys[-1]

    forward, reverse = (
        jax.jit(d(end, argnums=(0, 1)), compiler_options=problems.QUICK)(START, INERTIA)
        for d in (jax.jacfwd, jax.jacrev)
    )
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
    found = jax.jit(jax.jacrev(still), compiler_options=problems.QUICK)(START)
    np.testing.assert_array_equal(found, np.eye(3))


def test_a_midpoint_that_does_not_converge_fails():
    for solver in (MIDPOINT, cfjax.Composition(MIDPOINT, 4)):
        with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
            cfjax.integrate(TERM, solver, 0.0, 100.0, 5 * START, INERTIA, num_steps=3)
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        diffrax.diffeqsolve(TERM, MIDPOINT, 0.0, 100.0, 30.0, 5 * START, INERTIA)


def test_few_iterations_for_a_tolerance():
    """With rtol the solve ends earlier, and is as exact as that."""

    def end(solver):
        return cfjax.integrate(TERM, solver, 0.0, 1.0, START, INERTIA, num_steps=2).ys[-1]

    rtol = 1e-6
    off = np.max(np.abs(end(cfjax.ImplicitMidpoint(rtol=rtol)) - end(MIDPOINT)))
    # A change below rtol leaves about as much, in each of two steps.
    assert 1e-3 * rtol < off < 2 * rtol
    with pytest.raises(eqx.EquinoxRuntimeError, match="diverged"):
        end(cfjax.ImplicitMidpoint(max_steps=3))


def test_batches_and_float32():
    starts = jnp.stack([START, 2 * START, 0.5 * START])
    end = lambda y: cfjax.integrate(TERM, MIDPOINT, 0.0, 1.0, y, INERTIA, num_steps=4).ys[-1]  # noqa: E731
    one_by_one = jnp.stack([end(y) for y in starts])
    # A batch iterates until the last has converged, to rounding.
    np.testing.assert_allclose(jax.vmap(end)(starts), one_by_one, rtol=0, atol=1e-14)
    start, inertia = START.astype(jnp.float32), INERTIA.astype(jnp.float32)
    low = cfjax.integrate(TERM, MIDPOINT, 0.0, 1.0, start, inertia, num_steps=4).ys[-1]
    assert low.dtype == jnp.float32
    np.testing.assert_allclose(low, end(START), rtol=0, atol=2e-6)


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
