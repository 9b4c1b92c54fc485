"""Arrays scalarised along an axis and put together, in a form that XLA fuses.

As primitives of JAX, because the derivatives matter most. `jnp.stack` makes XLA compute what it
stacks once for every entry, and what JAX transposes `x[i]` or `jnp.where` into breaks a program of
scalars into many small ones. Here each of the two is the transpose of the other.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.sharding import PartitionSpec
from jaxtyping import Array


def pack(entries: Sequence[Array], axis: int = 0, sums: bool = False) -> Array:
    """`jnp.stack` of arrays of one shape and dtype.

    With `sums` the transpose takes the entries out as sums, which XLA computes once for all uses.
    """
    return pack_p.bind(*_varying_alike(entries), axis=axis, sums=sums)


def unpack(x: Array, axis: int = 0) -> list[Array]:
    """`jnp.unstack`."""
    return unpack_p.bind(x, axis=axis)


def _varying_alike(entries: Sequence[Array]) -> Sequence[Array]:
    """The same, varying along the same axes within `jax.shard_map`, as JAX's operations want it."""
    each = [_varying(x) for x in entries]
    together = frozenset().union(*each)
    if all(axes == together for axes in each):
        return entries
    return [
        lax.pcast(x, tuple(together - axes), to="varying") if together - axes else x
        for x, axes in zip(entries, each, strict=True)
    ]


def _varying(x: Array) -> frozenset[str]:
    """The axes of a mesh that it varies along within `jax.shard_map`."""
    aval: Any = jax.typeof(x)
    # Older versions of JAX have it right there.
    return aval.manual_axis_type.varying if hasattr(aval, "manual_axis_type") else aval.vma


def sharding(x: Array) -> Any:
    """Along which axes of a mesh it is spread; None without a mesh."""
    spread = jax.typeof(x).sharding
    return None if spread.mesh.empty else spread


def _with_shape(x: Any, shape: Sequence[int], spec: Sequence[Any]) -> Any:
    """An array that is like x in all but its shape, for abstract evaluation."""
    spread = x.sharding.update(spec=PartitionSpec(*spec))
    return x.update(shape=tuple(shape), sharding=spread, weak_type=False)


pack_p = Primitive("cfjax_pack")
unpack_p = Primitive("cfjax_unpack")
unpack_p.multiple_results = True


@pack_p.def_impl
def _pack_impl(*entries, axis, sums=False):
    shape = (*entries[0].shape[:axis], len(entries), *entries[0].shape[axis:])
    axes = [n for n in range(len(shape)) if n != axis]
    # Spread over a mesh as the entries are.
    spread = sharding(lax.expand_dims(entries[0], [axis]))
    parts = [lax.broadcast_in_dim(entry, shape, axes, out_sharding=spread) for entry in entries]
    # Which is which is known: XLA would keep comparisons of places as arrays, outside of a loop.
    places, bit = np.arange(len(entries)), 1
    while len(parts) > 1:
        is_odd = lax.broadcast_in_dim(places & bit != 0, shape, [axis], out_sharding=spread)
        pairs = [lax.select(is_odd, b, a) for a, b in zip(parts[::2], parts[1::2], strict=False)]
        parts, bit = pairs + parts[2 * len(pairs) :], 2 * bit
    return parts[0]


@unpack_p.def_impl
def _unpack_impl(x, *, axis):
    return [lax.index_in_dim(x, n, axis, keepdims=False) for n in range(x.shape[axis])]


@pack_p.def_abstract_eval
def _(*entries, axis, sums):
    x = entries[0]
    shape, spec = x.shape, x.sharding.spec
    return _with_shape(
        x, (*shape[:axis], len(entries), *shape[axis:]), (*spec[:axis], None, *spec[axis:])
    )


@unpack_p.def_abstract_eval
def _(x, *, axis):
    axes = [n for n in range(x.ndim) if n != axis]
    shape, spec = x.shape, x.sharding.spec
    return [_with_shape(x, [shape[n] for n in axes], [spec[n] for n in axes])] * shape[axis]


def _pack_jvp(entries, tangents, **params):
    tangents = map(ad.instantiate_zeros, tangents)
    return pack_p.bind(*entries, **params), pack_p.bind(*tangents, **params)


def _unpack_jvp(xs, tangents, *, axis):
    (x,), (tangent,) = xs, map(ad.instantiate_zeros, tangents)
    return unpack_p.bind(x, axis=axis), unpack_p.bind(tangent, axis=axis)


def _pack_transpose(ct, *entries, axis, sums):
    if type(ct) is ad.Zero:
        return [None] * len(entries)
    if sums:
        place = lax.broadcasted_iota(np.int32, ct.shape, axis, out_sharding=sharding(ct))
        return [jnp.sum(jnp.where(place == n, ct, 0), axis=axis) for n in range(len(entries))]
    return unpack_p.bind(ct, axis=axis)


def _unpack_transpose(cts, x, *, axis):
    if all(type(ct) is ad.Zero for ct in cts):
        return [None]
    return [pack_p.bind(*map(ad.instantiate_zeros, cts), axis=axis, sums=False)]


def _pack_batch(entries, dims, *, axis, sums):
    moved = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(entries, dims, strict=True)]
    # One that others are to be like, in how they are spread over a mesh too.
    like = next(x for x, d in zip(moved, dims, strict=True) if d is not None)
    entries = [
        lax.broadcast_in_dim(x, like.shape, range(1, like.ndim), out_sharding=sharding(like))
        if d is None
        else x
        for x, d in zip(moved, dims, strict=True)
    ]
    return pack_p.bind(*entries, axis=axis + 1, sums=sums), 0


def _unpack_batch(xs, dims, *, axis):
    (x,), (dim,) = xs, dims
    entries = unpack_p.bind(jnp.moveaxis(x, dim, 0), axis=axis + 1)
    return entries, [0] * len(entries)


ad.primitive_jvps[pack_p] = _pack_jvp
ad.primitive_jvps[unpack_p] = _unpack_jvp
ad.primitive_transposes[pack_p] = _pack_transpose
ad.primitive_transposes[unpack_p] = _unpack_transpose
batching.primitive_batchers[pack_p] = _pack_batch
batching.primitive_batchers[unpack_p] = _unpack_batch
mlir.register_lowering(pack_p, mlir.lower_fun(_pack_impl, multiple_results=False))
mlir.register_lowering(unpack_p, mlir.lower_fun(_unpack_impl, multiple_results=True))
