"""Which functions may jump is read from their programs."""

import jax
import jax.numpy as jnp

from cfjax._numerics.jumps import may_jump

TABLE = jnp.arange(10.0)
JUMPS = {
    "an index": lambda t: TABLE[jnp.floor(t * 10).astype(int)],
    "a search": lambda t: TABLE[jnp.searchsorted(TABLE, t)],
    "a comparison": lambda t: jnp.where(t < 0.5, TABLE, 2.0),
    "a whole number": lambda t: jnp.round(t) + jnp.ceil(t),
    "a sign": lambda t: jnp.sign(t - 0.5),
    "a remainder": lambda t: jnp.mod(t, 0.1),
    "a branch": lambda t: jax.lax.cond(t < 0.5, lambda: 1.0, lambda: 2.0),
    "within a function that is compiled": jax.jit(lambda t: jnp.heaviside(t - 0.5, 1.0)),
    "within a loop": lambda t: jax.lax.fori_loop(0, 3, lambda k, x: jnp.floor(x), t),
    "a derivative": jax.grad(jnp.abs),
    "one of two arrays": lambda t: (TABLE * t, jnp.floor(t)),
    "a branch within a loop": lambda t: jax.lax.scan(
        lambda x, a: (jax.lax.cond(x > a, lambda: x, lambda: a), None), t, TABLE
    )[0],
    "the host": lambda t: jax.pure_callback(
        lambda t: t, jax.ShapeDtypeStruct((), t.dtype), t, vmap_method="sequential"
    ),
}
CONTINUOUS = {
    "none of t": lambda t: jnp.where(TABLE > 3, TABLE, 0),
    "comparisons of other values": jax.jit(lambda t: jnp.exp(-t) * jnp.where(TABLE > 3, TABLE, 0)),
    "functions of networks": lambda t: jax.nn.softplus(TABLE * t) + jax.nn.relu(t) + jnp.tanh(t),
    "whether it is a number": lambda t: jnp.where(jnp.isnan(t), 0.0, t),
    "a print": lambda t: (jax.debug.print("{}", t), jnp.sin(t))[1],
    "bounds": lambda t: jnp.clip(t, 0.2, 0.4),
    "a loop": lambda t: jax.lax.scan(lambda x, a: (jnp.sin(a * x), None), t, TABLE)[0],
    "a derivative": jax.grad(lambda t: jnp.sin(t) ** 3),
}


def test_jumps_are_seen_and_what_is_continuous_does_not(subtests):
    for functions, expected in ((JUMPS, True), (CONTINUOUS, False)):
        for name, function in functions.items():
            with subtests.test(case=name):
                assert may_jump(function, 0.3) == expected
