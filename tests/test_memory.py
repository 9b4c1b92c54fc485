"""What a solve with a new function keeps in memory: what JAX keeps of its program, and no more.

JAX keeps the programs of the last thousands of functions, in diffrax's solves as in cfjax's, until
`jax.clear_caches()`. (The functions themselves it keeps even longer.)
"""

import gc

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax.extend.core import JaxprEqn

import cfjax

INERTIA = jnp.array([3.0, 2.0, 1.0])
Y0 = jnp.array([0.9, 0.4, 0.1])


def forget():
    """All programs that JAX and equinox keep."""
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()


def operations():
    return sum(isinstance(x, JaxprEqn) for x in gc.get_objects())


def solve(solver, is_equal=False):
    """A program of a new field."""

    def field(t, y, args):
        is_plain = isinstance(solver, diffrax.Tsit5)
        return jnp.cross(-y / args, y) if is_plain else cfjax.Rotation(-y / args)

    term = cfjax.LieTerm(field)
    if is_equal:
        return lambda a: cfjax.integrate(term, solver, 0.0, 1.0, Y0, a, num_steps=4).ys
    return lambda a: diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.25, Y0, a).ys


def gradient(run):
    return jax.grad(lambda a: jnp.sum(run(a) ** 3))


PROGRAMS = {
    "LieEuler, equal steps, gradient": lambda: gradient(solve(cfjax.LieEuler(), is_equal=True)),
    "CF2, gradient": lambda: gradient(solve(cfjax.CF2())),
    "CF4, batch": lambda: solve(cfjax.CF4()),
    "Tsit5, gradient": lambda: gradient(solve(diffrax.Tsit5())),
}


@pytest.mark.usefixtures("rewritten")
@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", PROGRAMS)
def test_nothing_is_kept_but_what_jax_keeps(name):
    forget()
    before = operations()
    run = PROGRAMS[name]()
    if name.endswith("batch"):
        jax.jit(jax.vmap(run)).lower(jnp.stack([INERTIA] * 20))
    else:
        jax.jit(run).lower(INERTIA)
    assert operations() > before + 100
    del run
    forget()
    # A few that are made once, as of what a module compiles when it is used first.
    assert operations() <= before + 10
