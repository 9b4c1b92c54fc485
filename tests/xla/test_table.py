"""The stages of a step that is too long to be scalarised as a whole."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import heavy_top, rigid_body, spacecraft

SOLVER = cfjax.RKMK(diffrax.Dopri8.tableau)


def _loss(scene, num_steps):
    given = scene.problem()

    def loss(y0, args):
        sol = cfjax.integrate(given["term"], SOLVER, 0.0, 0.1, y0, args, num_steps=num_steps)
        return sum(jnp.sum(jnp.sin(y)) for y in jax.tree.leaves(sol.ys))

    return loss, given["y0"], given.get("args")


def test_only_where_the_whole_step_is_too_long(rewritten):
    """A body of three numbers is scalarised as a whole, which is three times as fast."""
    for scene, size, is_loop in (
        (spacecraft, 10, True),
        (heavy_top, 10, True),
        (rigid_body, 3, False),
    ):
        loss, *start = _loss(scene, 3)
        program = str(jax.make_jaxpr(loss)(*start))
        # The weights of 12 stages, and the numbers of all elements and of whether each is one.
        assert ("f64[12,13]" in program) == (f"f64[13,{size}]" in program) == is_loop
        assert "cfjax_operation" in program


@pytest.mark.parametrize("scene", [heavy_top, pytest.param(spacecraft, marks=pytest.mark.slow)])
def test_values_and_gradients_are_those_of_the_program_as_it_is(rewritten, scene):
    """Up to rounding, of which there are thousands in a step."""
    loss, *start = _loss(scene, 4)
    found = jax.jit(jax.value_and_grad(loss))(*start)
    with cfjax.rewriting(False):
        expected = jax.jit(jax.value_and_grad(loss))(*start)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, float(jnp.max(abs(b)))))


def test_a_batch_is_each_of_its_solves(rewritten):
    """Up to rounding, of which there are thousands."""
    loss, y0, args = _loss(spacecraft, 4)
    starts = jax.tree.map(lambda y: jnp.stack([y, -y]), y0)
    found = jax.jit(jax.vmap(loss, in_axes=(0, None)))(starts, args)
    each = [loss(jax.tree.map(lambda y: y[k], starts), args) for k in range(2)]  # noqa: B023
    np.testing.assert_allclose(found, each, rtol=1e-13)
