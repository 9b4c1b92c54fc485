"""Squarings of what was scaled down by a power of two, as many as each member of a batch needs."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Int, PyTree, Real

from .matmul import small_product

T = TypeVar("T", bound=PyTree)

# Squarings beyond these go through a loop: each one written out costs compile time everywhere.
_WRITTEN_OUT = 4


def exponent(size: Real[Array, ""]) -> Int[Array, ""]:
    """The least e with `size < 2^e`; large if the size is inf or NaN."""
    # The exponent field is exact where a rounded log2 is not, and puts inf and NaN on top.
    info = jnp.finfo(size.dtype)
    bits = lax.bitcast_convert_type(size, jnp.dtype(f"int{info.bits}"))
    return (bits >> info.nmant) - (info.maxexp - 2)


def squarings(s: Int[Array, ""], dtype: np.dtype) -> tuple[Int[Array, ""], Real[Array, ""]]:
    """The number of squarings s >= 0, and 2^-s; 0 and NaN where no s will do."""
    info = jnp.finfo(dtype)
    # Every squaring doubles the error: after as many as there are digits, none is left.
    possible = s <= info.nmant
    s = jnp.where(possible, s, 0)
    power = lax.bitcast_convert_type((info.maxexp - 1 - s) << info.nmant, dtype)
    return s.astype(jnp.int32), jnp.where(possible, power, jnp.nan)


# A condition that vmap batches becomes a select, which runs both branches. The maximum over the
# batch is not batched, so a condition on it stays a real branch.
@custom_vmap
def max_over_batch(s: Array) -> Array:
    return s


@max_over_batch.def_vmap
def _(axis_size: int, in_batched: list[bool], s: Array) -> tuple[Array, bool]:
    del axis_size, in_batched
    return max_over_batch(jnp.max(s, initial=0)), False


def repeat(step: Callable[[T], T], x: T, s: Array) -> T:
    """`step` s times. A loop of branches, since one of unknown length has no reverse mode."""
    most = max_over_batch(s)

    # Without checkpoints the branch not taken must still hand out room for what the other saves.
    @jax.checkpoint
    def once(x: T, k: int | Array) -> T:
        return jtu.tree_map(lambda new, old: jnp.where(k < s, new, old), step(x), x)

    def step_if(x: T, k: int | Array) -> tuple[T, None]:
        return lax.cond(k < most, once, lambda x, k: x, x, k), None

    @jax.checkpoint
    def many(x: T) -> T:
        digits = jnp.finfo(jtu.tree_leaves(x)[0].dtype).nmant
        ks = jnp.arange(_WRITTEN_OUT, digits, dtype=s.dtype)
        return lax.scan(step_if, x, ks)[0]

    for k in range(_WRITTEN_OUT):
        x, _ = step_if(x, k)
    return lax.cond(most > _WRITTEN_OUT, many, lambda x: x, x)


@jax.custom_jvp
def squared(x: T, s: Int[Array, ""]) -> T:
    """Square matrices to the power 2^s. Compiles faster than `repeat`."""
    return lax.fori_loop(0, max_over_batch(s), lambda k, x: _square_if(k < s, x), x)


@squared.defjvp
def _(primals, tangents):
    x, s = primals
    most = max_over_batch(s)
    digits = jnp.finfo(jtu.tree_leaves(x)[0].dtype).nmant
    ks = jnp.arange(-(-digits // 4) * 4, dtype=s.dtype).reshape(-1, 4)

    # A loop of unknown length has no reverse mode. Four at a time, as most are not needed.
    @jax.checkpoint
    def four(x: T, ks: Array) -> T:
        return lax.scan(lambda x, k: (_square_if(k < s, x), None), x, ks)[0]

    def four_if(x: T, ks: Array) -> tuple[T, None]:
        return lax.cond(ks[0] < most, four, lambda x, ks: x, x, ks), None

    return jax.jvp(lambda x: lax.scan(four_if, x, ks)[0], (x,), tangents[:1])


def _square_if(condition: Array, x: T) -> T:
    return jtu.tree_map(lambda x: jnp.where(condition, small_product(x, x), x), x)
