"""Which programs have functions that XLA never computes twice, of what is in a batch."""

import diffrax
import jax
import jax.numpy as jnp
import pytest
from jax import lax

import cfjax
from cfjax._xla.expensive import has_expensive


def of_time(y, t):
    """In a loop whose carry the state reaches, but not the sine."""

    def turn(carry, c):
        y, t = carry
        return (y * jnp.sin(t) + c, t + 1), y

    return lax.scan(turn, (y, t), jnp.arange(3.0))


def late(y, t):
    """The state reaches the sine in the second turn."""

    def turn(carry, _):
        y, z = carry
        return (y, y), jnp.sin(z)

    return lax.scan(turn, (y, t), None, length=3)


def chosen(y, t):
    return lax.cond(t > 0, lambda y, t: y * t, lambda y, t: jnp.exp(t) * y, y, t)


PROGRAMS = {
    "products": (lambda y, t: y * y + t / 3, False, False),
    "a sine of the time": (lambda y, t: y * jnp.sin(t), False, True),
    "in a function": (lambda y, t: jax.jit(jnp.tanh)(y) * t, True, False),
    "in a loop": (of_time, False, True),
    "in a later turn": (late, True, True),
    "in a branch": (chosen, False, True),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_what_reaches_it(name):
    fun, by_state, by_time = PROGRAMS[name]
    jaxpr = jax.make_jaxpr(fun)(1.0, 2.0).jaxpr
    assert has_expensive(jaxpr, [True, False]) == by_state
    assert has_expensive(jaxpr, [False, True]) == by_time
    assert not has_expensive(jaxpr, [False, False])


def test_a_derivative_materialises_less_where_there_is_one():
    """XLA would cut the program at every such function if two parts of it needed its value."""

    def num_calls(angular_velocity):
        term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(angular_velocity(y)))
        solver = cfjax.Projected(diffrax.Bosh3())

        def end(y):
            state = solver.init(term, 0.0, 0.1, y, None)
            return jnp.sum(solver.step(term, 0.0, 0.1, y, None, state, made_jump=False)[0] ** 3)

        batch = jax.jit(jax.vmap(jax.grad(end)))
        return batch.lower(jnp.eye(3)).as_text().count("call @_identity")

    assert 0 < num_calls(jnp.sin) < num_calls(lambda y: y * y * y)
