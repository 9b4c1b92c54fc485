"""The compiled program of a step with noise."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import pytest

import cfjax


def thermal(t, y, args, dw):
    return cfjax.Rotation(0.3 * dw + 0.03 * jnp.cross(y, dw))


def drift(t, y, args):
    return cfjax.Rotation(0.1 * y)


def shifts(fun, *args):
    """How many shifts of bits the compiled program has, which are those of random numbers."""
    text = jax.jit(fun).lower(*args).compile().as_text()
    return text.count("shift-right-logical(")


@pytest.mark.parametrize("is_rewritten", [True, False])
@pytest.mark.parametrize("shape", [(3,), (200, 3)])
@pytest.mark.parametrize(
    "solver",
    [cfjax.CF4(), cfjax.WeakOrder2(), cfjax.ShiftedNoise()],
    ids=lambda solver: type(solver).__name__,
)
@pytest.mark.representatives(1)
def test_numbers_are_drawn_once_a_step(solver, shape, is_rewritten):
    """XLA would draw them again for each flow that uses them, of which there are 5 and more."""
    key, y0 = jax.random.key(0), jnp.broadcast_to(jnp.asarray([1.0, 0.0, 0.0]), shape)

    def path(key):
        return diffrax.UnsafeBrownianPath(shape, key, levy_area=diffrax.SpaceTimeLevyArea)

    def solve(key, y0):
        term = diffrax.MultiTerm(cfjax.LieTerm(drift), cfjax.LieControlTerm(thermal, path(key)))
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=50, throw=False).ys

    def alone(key, y0):
        def body(total, n):
            value: Any = path(key).evaluate(n * 0.1, (n + 1) * 0.1, use_levy=True)
            return total + value.W + value.H, None

        return jax.lax.scan(body, y0, jnp.arange(50.0))[0]

    with cfjax.rewriting(is_rewritten):
        # The keys of a step may be computed twice, which are a quarter of the shifts.
        assert shifts(solve, key, y0) <= 1.5 * shifts(alone, key, y0)
