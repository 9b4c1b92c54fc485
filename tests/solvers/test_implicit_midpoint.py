"""The implicit midpoint rule: order, energy, derivatives, and iterations that do not converge."""

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


@pytest.mark.slow
def test_the_energy_of_the_midpoint_does_not_drift():
    ys: Any = cfjax.integrate(
        TERM, MIDPOINT, 0.0, 1e4, START, INERTIA, num_steps=100_000, save_every=100
    ).ys
    energies = np.asarray(jnp.sum(ys**2 / INERTIA, axis=1) / 2)
    tenths = energies.reshape(10, -1).mean(axis=1)
    # Each mean is one over 100 saved states of an oscillation: flat means within its scatter.
    assert np.ptp(tenths) < np.std(energies) / 5


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
    "options, text",
    [
        ({"rtol": 0.0}, "rtol must be positive and finite, or None, got 0.0"),
        # Any first guess would be close enough.
        ({"rtol": np.inf}, "rtol must be positive and finite, or None, got inf"),
        ({"rtol": True}, "rtol must be positive and finite, or None, got True"),
        ({"rtol": "1"}, "rtol must be positive and finite, or None, got '1'"),
        ({"max_steps": True}, "max_steps must be an integer from 1 on, got True"),
        ({"max_steps": 0}, "max_steps must be an integer"),
    ],
)
def test_wrong_arguments(options, text, no_shape_hook):
    with pytest.raises(ValueError, match=text):
        cfjax.ImplicitMidpoint(**options)
