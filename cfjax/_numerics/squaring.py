"""Scaling by a power of two and squaring, as often as each member of a batch needs."""

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

# The square root of the largest number of squarings, at least as many as there are digits.
_ROOT_OF_MOST = 8
# Most matrices need no more. Up to so many are stored for a derivative, or done together.
_MOSTLY = 4


def magnitude(x: Array) -> Array:
    """`|re| + |im|`, without a hypot, for which there is no vector instruction."""
    return jnp.abs(x.real) + jnp.abs(x.imag) if jnp.iscomplexobj(x) else jnp.abs(x)


def exponent(size: Real[Array, ""], degree: int = 1) -> Int[Array, ""]:
    """The least e with `size < 2^(degree e)`; large if the size is inf or NaN."""
    # The exponent field is exact where a rounded log2 is not, and puts inf and NaN on top.
    info = jnp.finfo(size.dtype)
    bits = lax.bitcast_convert_type(size, jnp.dtype(f"int{info.bits}"))
    e = (bits >> info.nmant) - (info.maxexp - 2)
    return e if degree == 1 else (e + (degree - 1)) // degree


def squarings(s: Int[Array, ""], dtype: np.dtype) -> tuple[Int[Array, ""], Real[Array, ""]]:
    """The number of squarings `s = max(s, 0)`, and 2^-s; 0 and NaN if there are too many."""
    info = jnp.finfo(dtype)
    s = jnp.maximum(s, 0)
    # Each squaring doubles the error, so after as many as there are digits no digit is right.
    is_possible = s <= info.nmant
    s = jnp.where(is_possible, s, 0)
    # The power of two is locally constant, so its derivative is zero.
    power = lax.bitcast_convert_type((info.maxexp - 1 - s) << info.nmant, dtype)
    return s.astype(jnp.int32), jnp.where(is_possible, power, jnp.nan)


# A condition that vmap batches becomes a select, which runs both branches. The maximum over the
# batch is not batched, so a condition on it stays a branch. It ignores NaN, so that one member does
# not decide for the others; that member is NaN in both branches.
@custom_vmap
def max_over_batch(s: Array) -> Array:
    return s


@max_over_batch.def_vmap
def _(axis_size: int, in_batched: list[bool], s: Array) -> tuple[Array, bool]:
    del axis_size, in_batched
    return max_over_batch(jnp.max(s, axis=0, initial=0, where=s == s)), False


def squared(
    unsquared: T, start: Callable[[T], T], s: Int[Array, ""], double: Callable[[T], T] | None = None
) -> T:
    """`unsquared` where s is 0, otherwise `start(unsquared)` doubled s times.

    Each member of a batch is doubled as often as it needs. `double` squares every leaf by default,
    and must not close over traced values.
    """
    double = double or _squares
    most = max_over_batch(s)
    is_tiny = jtu.tree_leaves(unsquared)[0].shape[0] <= 4

    def with_squarings(unsquared: T) -> T:
        if is_tiny:
            result = _doubled(double, start(unsquared), s)
        else:
            double_if = lambda k, x: _where(k < s, double(x), x)  # noqa: E731
            result = loop(double_if, start(unsquared), most, root=_ROOT_OF_MOST, mostly=_MOSTLY)
        return _where(s == 0, unsquared, result)

    # Without a checkpoint the branch not taken would return zeros for the residuals of the other.
    return lax.cond(most > 0, jax.checkpoint(with_squarings), lambda x: x, unsquared)


def _squares(x: T) -> T:
    return jtu.tree_map(lambda x: small_product(x, x), x)


# Products up to size 4 fuse, and a branch costs more than the products that it saves. There the
# derivative of `loop` has up to 1.5 times the operations, and compiles up to 1.3 times as long.
@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _doubled(double: Callable[[T], T], x: T, s: Int[Array, ""]) -> T:
    return lax.fori_loop(0, max_over_batch(s), lambda k, x: _where(k < s, double(x), x), x)


@_doubled.defjvp
def _(double, primals, tangents):
    x, s = primals
    most = max_over_batch(s)
    digits = jnp.finfo(jtu.tree_leaves(x)[0].dtype).nmant
    ks = jnp.arange(-(-digits // _MOSTLY) * _MOSTLY, dtype=s.dtype).reshape(-1, _MOSTLY)

    # A loop of unknown length has no reverse mode. In groups, as most squarings are not needed.
    @jax.checkpoint
    def group(x: T, ks: Array) -> T:
        return lax.scan(lambda x, k: (_where(k < s, double(x), x), None), x, ks)[0]

    def group_if(x: T, ks: Array) -> tuple[T, None]:
        return lax.cond(ks[0] < most, group, lambda x, ks: x, x, ks), None

    return jax.jvp(lambda x: lax.scan(group_if, x, ks)[0], (x,), tangents[:1])


def _where(condition: Array, x: T, y: T) -> T:
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), x, y)
