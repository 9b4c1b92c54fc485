"""`Loop`: the numbers and derivatives of a plain scan, whatever travels packed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from jax import lax

from cfjax._loop import Loop

VECTOR = jnp.asarray([0.3, -0.7, 1.1])
MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3)))
LONG = jnp.linspace(-1.0, 1.0, 9)
NUM_STEPS = 5


def mix(carry, parameters):
    """A step that couples everything with everything."""
    floats = [x for x in jtu.tree_leaves((carry, parameters)) if jnp.issubdtype(x.dtype, float)]
    total = sum(jnp.sum(jnp.sin((n + 1) * x)).astype(float) for n, x in enumerate(floats))

    def advance(x):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x + 1
        share = total.astype(x.dtype)
        return x + jnp.cos(share * x) / (1 + share**2)

    return jtu.tree_map(advance, carry)


CASES = {
    "vector": (VECTOR, ()),
    "vector and parameters": (VECTOR, {"a": VECTOR * 2, "b": jnp.asarray(0.4)}),
    "parts": ((VECTOR, {"x": jnp.asarray(0.5), "m": MATRIX, "n": jnp.asarray(3)}), (LONG, VECTOR)),
    "no short vector": ((MATRIX, LONG), VECTOR),
    "two precisions": ((VECTOR, VECTOR.astype(np.float32)), (VECTOR.astype(np.float32), VECTOR)),
    "more parameters than travel": (VECTOR, [VECTOR * k for k in range(1, 9)]),
    "integers among the parameters": (VECTOR, (jnp.arange(3), VECTOR, jnp.asarray(True))),
    "empty": ((VECTOR, jnp.zeros(0)), jnp.zeros(0)),
}


def plain(carry, parameters):
    return lax.scan(lambda c, _: (mix(c, parameters), None), carry, length=NUM_STEPS)[0]


def looped(carry, parameters):
    loop = Loop(mix, carry, parameters)
    return loop.leave(loop(loop.enter(carry), NUM_STEPS))


def scalar(run):
    def fun(floats, rest):
        leaves = jtu.tree_leaves(run(*eqx.combine(floats, rest)))
        return sum(jnp.sum(jnp.exp(x.astype(float) / (n + 2))) for n, x in enumerate(leaves))

    return fun


def close(found, want):
    leaves = [x for x in jtu.tree_leaves(want) if jnp.issubdtype(x.dtype, jnp.floating)]
    # Every number depends on all, so on the roundings of the coarsest and the size of the largest.
    # Five coupled steps magnify them a hundredfold.
    eps = max(float(jnp.finfo(x.dtype).eps) for x in leaves)
    scale = max(1.0, *(float(jnp.max(jnp.abs(x), initial=0)) for x in leaves))
    jtu.tree_map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e3 * eps * scale), found, want
    )
    assert jtu.tree_structure(found) == jtu.tree_structure(want)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_values(case):
    want = jax.jit(plain)(*case)
    found = jax.jit(looped)(*case)
    close(found, want)
    assert jtu.tree_map(lambda x: x.dtype, found) == jtu.tree_map(lambda x: x.dtype, want)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
@pytest.mark.parametrize(
    "transform",
    [
        jax.grad,
        lambda f: lambda x, rest: jax.jvp(lambda x: f(x, rest), (x,), (x,)),
        lambda f: lambda x, rest: jax.jvp(lambda x: jax.grad(f)(x, rest), (x,), (x,)),
    ],
    ids=["reverse", "forward", "forward over reverse"],
)
def test_derivatives(case, transform):
    x, rest = eqx.partition(case, eqx.is_inexact_array)
    want, found = (jax.jit(transform(scalar(run)))(x, rest) for run in (plain, looped))
    close(found, want)


def test_a_batch():
    carry, parameters = CASES["vector and parameters"]
    carry = jnp.stack([carry, carry * 2])
    for axes in ((0, None), (None, 0)):
        values = (carry, parameters) if axes[0] == 0 else (carry[0], {"a": carry, "b": carry[:, 0]})
        want, found = (jax.jit(jax.vmap(run, axes))(*values) for run in (plain, looped))
        close(found, want)
        want, found = (
            jax.jit(jax.vmap(jax.grad(lambda c, p, run=run: scalar(run)((c, p), (c, p))), axes))(
                *values
            )
            for run in (plain, looped)
        )
        close(found, want)
