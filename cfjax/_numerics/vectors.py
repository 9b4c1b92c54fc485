"""Short vectors by their entries: numbers, arrays of leading axes, or rows and columns of a matrix.

XLA fuses arithmetic on entries, and `pack` puts the entries together again.
"""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Array, Float

from .._xla import computed_once as computed_once
from .._xla import limits as limits
from .._xla import materialised as materialised
from .._xla import pack as pack
from .._xla import scalarised as scalarised
from .._xla import smooth as smooth
from .._xla import unpack as unpack

Vector = Sequence[Any]


def entries(x: Float[Array, "n *k"]) -> list[Array]:
    """The entries along the first axis."""
    return [x[k] for k in range(x.shape[0])]


def placed(entries: Vector, indices: Sequence[int]) -> Vector:
    """The vector x with `x[indices[j]] = entries[j]`."""
    return [entries[indices.index(k)] for k in range(len(indices))]


def cross(a: Vector, b: Vector) -> Vector:
    """The cross product of two vectors of three entries."""
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def plus(a: Vector, b: Vector) -> Vector:
    return [x + y for x, y in zip(a, b, strict=True)]


def dot(a: Vector, b: Vector) -> Any:
    """The inner product of two vectors of three entries."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
