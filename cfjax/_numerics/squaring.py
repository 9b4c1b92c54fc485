"""Squarings of what was scaled down by a power of two, as many as each member of a batch needs."""

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Int, PyTree, Real

from .loop import loop
from .matmul import small_product

T = TypeVar("T", bound=PyTree)

# The square root of the most squarings, which are as many as there are digits, or more.
_ROOT_OF_MOST = 8
# More are few. Up to so many are kept for a derivative, or done together.
_MOSTLY = 4


def magnitude(x: Array) -> Array:
    """`|re| + |im|`: no hypot, which no vector instruction has."""
    return jnp.abs(x.real) + jnp.abs(x.imag) if jnp.iscomplexobj(x) else jnp.abs(x)


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
# batch is not batched, so a condition on it stays a real branch. NaN of one member must not choose
# for the others, and is NaN in every branch.
@custom_vmap
def max_over_batch(s: Array) -> Array:
    return s


@max_over_batch.def_vmap
def _(axis_size: int, in_batched: list[bool], s: Array) -> tuple[Array, bool]:
    del axis_size, in_batched
    return max_over_batch(jnp.max(s, initial=0, where=s == s)), False


def squared(
    small: T, start: Callable[[T], T], s: Int[Array, ""], double: Callable[[T], T] | None = None
) -> T:
    """`small` where s is 0, otherwise `start(small)` doubled s times: if not said how, squared.

    Each member of a batch as often as it needs. `double` must close over nothing traced.
    """
    double = double or _squares
    most = max_over_batch(s)
    is_tiny = jtu.tree_leaves(small)[0].shape[0] <= 4

    def with_squarings(small: T) -> T:
        if is_tiny:
            whole = _doubled(double, start(small), s)
        else:
            double_if = lambda k, x: _where(k < s, double(x), x)  # noqa: E731
            whole = loop(double_if, start(small), most, root=_ROOT_OF_MOST, mostly=_MOSTLY)
        return _where(s == 0, small, whole)

    # Without a checkpoint the branch not taken must still hand out room for what the other saves.
    return lax.cond(most > 0, jax.checkpoint(with_squarings), lambda small: small, small)


def _squares(x: T) -> T:
    return jtu.tree_map(lambda x: small_product(x, x), x)


# Products up to size 4 fuse, and a branch costs more than the few that it saves. A derivative with
# `loop` has up to 1.5 times the operations there, and takes up to 1.3 times as long to compile.
@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _doubled(double: Callable[[T], T], x: T, s: Int[Array, ""]) -> T:
    return lax.fori_loop(0, max_over_batch(s), lambda k, x: _where(k < s, double(x), x), x)


@_doubled.defjvp
def _(double, primals, tangents):
    x, s = primals
    most = max_over_batch(s)
    digits = jnp.finfo(jtu.tree_leaves(x)[0].dtype).nmant
    ks = jnp.arange(-(-digits // _MOSTLY) * _MOSTLY, dtype=s.dtype).reshape(-1, _MOSTLY)

    # A loop of unknown length has no reverse mode. Some at a time, as most are not needed.
    @jax.checkpoint
    def some(x: T, ks: Array) -> T:
        return lax.scan(lambda x, k: (_where(k < s, double(x), x), None), x, ks)[0]

    def some_if(x: T, ks: Array) -> tuple[T, None]:
        return lax.cond(ks[0] < most, some, lambda x, ks: x, x, ks), None

    return jax.jvp(lambda x: lax.scan(some_if, x, ks)[0], (x,), tangents[:1])


def _where(condition: Array, x: T, y: T) -> T:
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), x, y)
