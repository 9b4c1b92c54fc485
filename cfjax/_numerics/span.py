"""The span of some columns, and orthonormal columns."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .matmul import matmul


class Corner(eqx.Module):
    """The first p columns of the identity, as a block of columns that takes no memory."""

    p: int = eqx.field(static=True)


Blocks: TypeAlias = tuple[Corner | Array, ...]


class Span(eqx.Module):
    """Blocks of p columns W, which need not be independent, and their products `W^T W`.

    A corner can only be the first block.
    """

    blocks: Blocks
    gram: Float[Array, "m m"]

    @classmethod
    def joint(cls, spans: Sequence["Span"]) -> "Span":
        """The span of the blocks of all spans."""
        # With the corner in front, if there is one, and then the fewest new products.
        span = max(spans, key=lambda s: (isinstance(s.blocks[0], Corner), len(s.blocks)))
        for block in (block for s in spans for block in s.blocks):
            if span.index(block) < 0 and not isinstance(block, Corner):
                span = span.extended(block)
        return span

    def extended(self, block: Float[Array, "n p"]) -> "Span":
        blocks = (*self.blocks, block)
        products = inner(blocks, block)
        p = block.shape[1]
        top = jnp.concatenate([self.gram, products[:-p]], axis=1)
        return Span(blocks, jnp.concatenate([top, products.T]))

    def index(self, block: Any) -> int:
        """The index of the block that is the same array, or -1.

        Arrays are compared by identity, as their values are not known in a trace. Two with equal
        values make the span longer than necessary, and the field is the same.
        """
        for i, x in enumerate(self.blocks):
            if x is block or (isinstance(x, Corner) and isinstance(block, Corner)):
                return i
        return -1

    def column_indices(self, other: "Span") -> Int[np.ndarray, " k"]:
        """The indices here of the columns of another span, whose blocks are all in this one."""
        widths = [x.p if isinstance(x, Corner) else x.shape[1] for x in self.blocks]
        ends = np.cumsum(widths)
        columns = np.split(np.arange(ends[-1]), ends[:-1])
        return np.concatenate([columns[self.index(block)] for block in other.blocks])


def joined(blocks: Blocks) -> Float[Array, "n m"]:
    """The columns W without those of a corner."""
    columns: list[Any] = [x for x in blocks if not isinstance(x, Corner)]
    if columns[0].shape[1] == 1:
        # As rows they are copied as they lie in memory: twice as fast where they are long.
        return jnp.concatenate([x.T for x in columns]).T
    return jnp.concatenate(columns, axis=1)


def inner(blocks: Blocks, x: Float[Array, "n p"]) -> Float[Array, "m p"]:
    """`W^T x`."""
    if not isinstance(blocks[0], Corner):
        return matmul(joined(blocks).T, x)
    top = x[: blocks[0].p]
    return jnp.concatenate([top, matmul(joined(blocks[1:]).T, x)])


def plus_product(
    x: Float[Array, "n p"], blocks: Blocks, z: Float[Array, "m p"]
) -> Float[Array, "n p"]:
    """`x + W z`."""
    if isinstance(blocks[0], Corner):
        p = blocks[0].p
        x = jnp.concatenate([x[:p] + z[:p], x[p:]])
        blocks, z = blocks[1:], z[p:]
    return x + matmul(joined(blocks), z)


def square(y: Float[Array, "n p"]) -> Float[Array, "p p"]:
    """`y^T y`, in blocks of rows, as the rounding of long sums would limit orthonormality."""
    n, p = y.shape
    count = math.isqrt(n)
    rows = -(-n // count)
    blocks = jnp.pad(y, ((0, rows * count - n), (0, 0))).reshape(count, rows, p)
    return jnp.sum(matmul(jnp.swapaxes(blocks, 1, 2), blocks), axis=0)


def orthonormal_defect(square: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """How far columns are from orthonormal, `I - y^T y`."""
    return jnp.eye(len(square), dtype=square.dtype) - square


def correction(square: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """`(I - y^T y) / 2`, the first term of Newton's method for the nearest orthonormal columns."""
    defect = orthonormal_defect(square)
    # A point far from the manifold is a mistake of the caller.
    is_near = jnp.max(jnp.abs(lax.stop_gradient(defect))) < 0.1
    return jnp.where(is_near, defect / 2, jnp.nan)
