"""Batches of small matrices: on single numbers, and as they were traced."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

pytestmark = pytest.mark.usefixtures("rewritten_by_default")

RNG = np.random.default_rng(0)
A = RNG.normal(size=(3, 3))


def body(t, y, scale):
    """An attitude with its momentum."""
    omega = scale * (y["r"] @ (y["m"] / jnp.array([3.0, 2.0, 1.0])) + jnp.sin(t))
    return {"r": cfjax.Rotation(omega), "m": jnp.cross(y["m"], omega)}


def matrix(t, y, scale):
    z = scale * (A @ y + jnp.cos(t) * A)
    return cfjax.LeftMatrix(z - z.T)


def columns(t, y, scale):
    return cfjax.Rotation(scale * (y[:, 0] + jnp.cos(t)))


Y0 = {
    "body": (body, {"r": np.eye(3), "m": np.array([0.3, 1.0, -0.4])}),
    "matrix": (matrix, np.eye(3)),
    "columns": (columns, RNG.normal(size=(3, 2))),
}
# A fraction of a radian a step, so that one correction is enough; most of one, where it is not; and
# far too much.
SCALES = jnp.array([0.3, 2.0, 4.0, 40.0])


def solve(name, solver, scales):
    field, y0 = Y0[name]
    y0 = jax.tree.map(jnp.asarray, y0)

    def one(scale):
        term, times = cfjax.LieTerm(field), (0.0, 1.0)
        return cfjax.integrate(term, solver, *times, y0, scale, num_steps=5, throw=False).ys

    return jax.vmap(one)(scales)


def products(run):
    """How many products of whole matrices there are in a program, of all members."""
    lines = run.lower(SCALES).as_text().splitlines()
    return sum("dot_general" in line and "tensor<4x3" in line for line in lines)


def loss(name, solver, scales):
    leaves = jax.tree.leaves(solve(name, solver, scales))
    return sum(jnp.sum(jnp.sin(x[:, -1])) for x in leaves)


@pytest.mark.parametrize("name", Y0)
def test_a_batch_agrees_with_its_program_as_traced(name):
    solver = cfjax.Projected(diffrax.Bosh3())
    run = jax.jit(lambda scales: solve(name, solver, scales))
    found = run(SCALES)
    assert products(run) == 0
    with cfjax.rewriting(False):
        expected = run(SCALES)
        assert products(run) > 0
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.isfinite(b[:3]).all()
        assert np.isnan(b[3, -1]).all()
        # Five steps with some hundred operations on numbers up to 10.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", Y0)
def test_so_does_its_gradient(name):
    solver, scales = cfjax.Projected(diffrax.Bosh3()), SCALES[:3]
    found = jax.jit(jax.grad(lambda scales: loss(name, solver, scales)))(scales)
    with cfjax.rewriting(False):
        expected = jax.jit(jax.grad(lambda scales: loss(name, solver, scales)))(scales)
    problems.assert_close(found, expected, 1e-12)
