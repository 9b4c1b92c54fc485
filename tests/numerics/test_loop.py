"""A loop as long as the program finds at run time: values, derivatives, batches, memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from xla.interpreter import run

from cfjax._numerics.loop import loop


def power(a, x, n, mostly=0):
    """`a^n x / n!`, with what is closed over and the number of the step."""
    step = lambda k, x: a * x / (k + 1).astype(x.dtype)  # noqa: E731
    return loop(step, jnp.asarray(x), n, root=4, mostly=mostly)


@functools.partial(jax.jit, static_argnums=3)
def everything(a, x, n, mostly):
    f = lambda a, x: power(a, x, n, mostly)  # noqa: E731
    forward = jax.jvp(lambda a: f(a, x), (a,), (1.0,))[1]
    return f(a, x), forward, jax.grad(f)(a, x), jax.grad(jax.grad(f))(a, x)


@pytest.mark.parametrize("mostly", [0, pytest.param(1, marks=pytest.mark.slow), 3])
def test_powers_and_their_derivatives(mostly, subtests):
    a, x = 1.5, 0.7
    for n in (0, 1, 3, 4, 5, 16):
        found = everything(a, x, jnp.asarray(n, jnp.int32), mostly)
        c = x / float(np.prod(np.arange(1, n + 1.0)))
        first, second = n * c * a ** (n - 1), n * (n - 1) * c * a ** (n - 2)
        with subtests.test(n=str(n)):
            # Some roundings for each step.
            np.testing.assert_allclose(found, [c * a**n, first, first, second], rtol=1e-14)


def test_a_batch_of_loops():
    a = jnp.asarray([0.5, 1.0, 2.0])
    found = run(jax.vmap(lambda a: jax.grad(power)(a, 1.0, jnp.asarray(3, jnp.int32))), a)
    np.testing.assert_allclose(found, a**2 / 2, rtol=1e-15)


def test_reverse_mode_keeps_as_much_however_long_the_loop_is():
    n, size = 5, 1000

    def pulled(x, length):
        return jax.vjp(lambda x: loop(lambda k, x: jnp.sin(x), x, length, root=n), x)[1]

    kept = jax.eval_shape(pulled, jnp.ones(size), jnp.asarray(3, jnp.int32))
    numbers = sum(leaf.size for leaf in jax.tree.leaves(kept))
    # It keeps n carries of n^2 = 25 steps, and a few numbers.
    assert numbers <= (n + 1) * size
