"""`jnp.stack` and `jnp.unstack` in a form that XLA fuses."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array


def pack(entries: Sequence[Array], axis: int = 0) -> Array:
    """`jnp.stack` of arrays of one shape and dtype, by selections.

    With `jnp.stack` XLA computes what several entries need once for each of them: a step of `CF4`
    on a pose takes twice as long.
    """
    parts = [jnp.expand_dims(x, axis) for x in entries]
    # Which is which is known: XLA would keep comparisons of places as arrays, outside of a loop.
    places = np.arange(len(parts)).reshape(-1, *[1] * (parts[0].ndim - axis - 1))
    bit = 1
    while len(parts) > 1:
        is_odd = places & bit != 0
        pairs = [jnp.where(is_odd, b, a) for a, b in zip(parts[::2], parts[1::2], strict=False)]
        parts, bit = pairs + parts[2 * len(pairs) :], 2 * bit
    return parts[0]


def unpack(x: Array, axis: int = 0) -> list[Array]:
    """`jnp.unstack`."""
    return [lax.index_in_dim(x, n, axis, keepdims=False) for n in range(x.shape[axis])]
