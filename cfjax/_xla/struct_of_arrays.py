"""Arrays as numbers, or as arrays, one for each of their entries.

XLA computes what several entries of a small array need once for each of them, or materialises it.
In memory the entries of many short vectors lie side by side, so XLA can neither fuse nor vectorise
well what each of them needs of the others. As numbers, and as arrays of their own, they are fast.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn, Literal
from jaxtyping import Array

from .jaxprs import is_inexact
from .limits import MAX_LENGTH, MAX_SIZE, MAX_STAGES
from .materialise import materialised
from .pack import pack, unpack
from .scope import is_numeric, is_rows


@jtu.register_pytree_node_class
class StructOfArrays:
    """An array as one array for each place along its short axes, row by row.

    `shape` is that of the whole. `is_short` says along which axes it is scalarised, by default all;
    an axis of length 1 always is. An entry has the other axes, the long ones, in their order. Where
    all of it along one of these is equal, it may have length 1 there. A small array has no long
    axes, and its entries are numbers. NumPy's numbers are known while the program is made.
    """

    def __init__(
        self, entries: Iterable[Any], shape: Sequence[int], is_short: Sequence[bool] | None = None
    ):
        self.entries = tuple(entries)
        self.shape = tuple(shape)
        flags = [True] * len(self.shape) if is_short is None else is_short
        self.is_short = tuple(n == 1 or s for n, s in zip(self.shape, flags, strict=True))

    @property
    def inner(self) -> tuple[int, ...]:
        """The shape of the array of entries."""
        return tuple(n if short else 1 for n, short in zip(self.shape, self.is_short, strict=True))

    @property
    def places(self) -> np.ndarray:
        """The numbers of the entries, in that shape."""
        return np.arange(len(self.entries)).reshape(self.inner)

    @property
    def long(self) -> list[int]:
        """The axes of each entry."""
        return [k for k, short in enumerate(self.is_short) if not short]

    @property
    def sides(self) -> tuple[int, ...]:
        """The lengths of these axes, without repetitions."""
        return tuple(self.shape[k] for k in self.long)

    def at(
        self, places: np.ndarray, shape: Sequence[int], is_short: Sequence[bool] | None = None
    ) -> "StructOfArrays":
        """The entries at some places, as an array of that shape."""
        return StructOfArrays([self.entries[k] for k in places.flat], shape, is_short)

    def mapped(self, fun: Callable[[Any], Any], shape: Sequence[int]) -> "StructOfArrays":
        """`fun` of every entry, which keeps what is short. Long axes may become 1."""
        if not self.long:
            return self
        outs = map(fun, self.entries)
        gone = [k for k, axis in enumerate(self.long) if shape[axis] == 1]
        return StructOfArrays(
            [jnp.squeeze(e, gone) if gone else e for e in outs], shape, self.is_short
        )

    def whole(self) -> Array:
        if not self.long:
            return pack(list(map(jnp.asarray, self.entries))).reshape(self.shape)
        (x,) = conformed(self, self.shape, [False] * len(self.shape)).entries
        return spread(x, [n for n in self.shape if n != 1]).reshape(self.shape)

    def tree_flatten(self) -> tuple[tuple, Any]:
        return self.entries, (self.shape, self.is_short)

    @classmethod
    def tree_unflatten(cls, aux, children):
        return cls(children, *aux)


class Call(NamedTuple):
    """One operation on numbers and structs of arrays; which of them are fixed."""

    eqn: JaxprEqn
    values: Sequence[Any]
    fixed: Sequence[bool]
    # The shapes of the results.
    shapes: Sequence[tuple[int, ...]]
    # Whether there are arrays that are not small.
    is_large: bool

    @property
    def params(self) -> dict[str, Any]:
        return self.eqn.params

    @property
    def shape(self) -> tuple[int, ...]:
        return self.shapes[0]

    def arrays(self) -> list[StructOfArrays]:
        return [struct_of_arrays(x) for x in self.values]

    def first(self) -> StructOfArrays:
        return struct_of_arrays(self.values[0])

    def through(self, x: StructOfArrays) -> StructOfArrays:
        """The first operand, computed once for all that neighbours along long axes take of it."""
        if self.fixed[0]:
            return x
        distinct = list({id(e): e for e in x.entries}.values())
        new = dict(zip(map(id, distinct), materialised(distinct, in_batches=True), strict=True))
        return StructOfArrays([new[id(e)] for e in x.entries], x.shape, x.is_short)


def literal(v: Literal) -> Any:
    aval: Any = v.aval
    # Integers stay NumPy's, so that it is known which entries an index takes.
    return (jnp if is_inexact(aval) else np).asarray(v.val, aval.dtype)


def static_value(x: Any) -> np.ndarray | None:
    """What is known while the program is made."""
    if isinstance(x, StructOfArrays):
        # Without an entry the dtype is not known either.
        if not x.entries or not all(isinstance(e, np.ndarray | np.generic) for e in x.entries):
            return None
        stacked = np.stack([np.broadcast_to(e, x.sides) for e in x.entries])
        short = [k for k, is_short in enumerate(x.is_short) if is_short]
        stacked = stacked.reshape(*(x.shape[k] for k in short), *x.sides)
        return stacked.transpose(np.argsort([*short, *x.long]))
    return np.asarray(x) if isinstance(x, np.ndarray | np.generic) else None


def is_whole(x: Any) -> bool:
    return not isinstance(x, StructOfArrays | np.ndarray) and np.ndim(x) > 0


def is_small(x: Any) -> bool:
    """Whether this is an array of which each entry is to be a number."""
    return is_whole(x) and np.size(x) > 0 and is_small_shape(np.shape(x)) and is_numeric(x)


def is_small_shape(shape: tuple[int, ...]) -> bool:
    """Whether arrays of this shape are of few entries, or of a short vector for each stage."""
    if math.prod(shape) <= MAX_SIZE:
        return True
    return len(shape) == 2 and shape[0] <= MAX_STAGES and shape[1] <= MAX_LENGTH


def struct_of_arrays(x: Any) -> StructOfArrays:
    """A small array as its numbers, short vectors along leading axes by their entries.

    Any other array is a single entry.
    """
    if isinstance(x, StructOfArrays):
        return x
    if isinstance(x, np.ndarray):
        return StructOfArrays([np.asarray(entry) for entry in x.flat], x.shape)
    if jnp.ndim(x) == 0:
        return StructOfArrays([x], ())
    if is_small(x):
        return StructOfArrays(unpack(jnp.ravel(x)), x.shape)
    is_short = [n == 1 for n in x.shape]
    flat = StructOfArrays([x.reshape([n for n in x.shape if n != 1])], x.shape, is_short)
    return conformed(flat, x.shape, [*is_short[:-1], True]) if is_rows(x) else flat


def apart_like(like: StructOfArrays, x: Any) -> StructOfArrays:
    """The array apart along the axes of another of its shape, and repeating where that does."""
    x = conformed(struct_of_arrays(x), like.shape, like.is_short)
    if not x.long:
        return x
    entries = []
    for e, other in zip(x.entries, like.entries, strict=True):
        sides = np.broadcast_shapes(jnp.shape(e), jnp.shape(other))
        entries.append(lax.slice(spread(e, sides), [0] * len(sides), jnp.shape(other)))
    return StructOfArrays(entries, x.shape, x.is_short)


def conformed(x: StructOfArrays, shape: Sequence[int], is_short: Sequence[bool]) -> StructOfArrays:
    """The array broadcast to a shape of as many axes, apart along some of them."""
    if x.shape == tuple(shape) and x.is_short == tuple(is_short):
        return x
    entries, places, was_short = list(x.entries), x.places, list(x.is_short)
    for axis, n in enumerate(shape):
        if n == 1 or (was_short[axis] == is_short[axis] and x.shape[axis] == n):
            continue
        position = was_short[:axis].count(False)
        if x.shape[axis] == 1 and is_short[axis]:
            places = np.repeat(places, n, axis)
        elif x.shape[axis] == 1:
            entries = [jnp.expand_dims(e, position) for e in entries]
        elif is_short[axis]:
            rows = [_apart(e, n, position) for e in entries]
            distinct = {id(e): e for row in rows for e in row}
            number = {key: k for k, key in enumerate(distinct)}
            numbers = np.array([[number[id(e)] for e in row] for row in rows])
            entries = list(distinct.values())
            places = np.moveaxis(numbers[places.squeeze(axis)], -1, axis)
        else:
            rows = np.moveaxis(places, axis, -1)
            flat = rows.reshape(-1, n)
            entries = [_together([entries[k] for k in row], position) for row in flat]
            places = np.expand_dims(np.arange(len(flat)).reshape(rows.shape[:-1]), axis)
        was_short[axis] = is_short[axis]
    return StructOfArrays([entries[k] for k in places.flat], shape, is_short)


def _apart(x: Any, n: int, position: int) -> Sequence[Any]:
    if jnp.shape(x)[position] == 1:
        return [jnp.squeeze(x, position)] * n
    return unpack(x, axis=position)


def _together(row: Sequence[Any], position: int) -> Any:
    if all(e is row[0] for e in row):
        return jnp.expand_dims(row[0], position)
    return pack(aligned(row), axis=position)


def spread(x: Any, sides: Sequence[int]) -> Any:
    """A number, or an array that repeats along axes of length 1, with these sides."""
    x = jnp.asarray(x)
    if x.shape == tuple(sides):
        return x
    return lax.broadcast_in_dim(x, sides, range(x.ndim))


def aligned(row: Sequence[Any]) -> Sequence[Any]:
    """Entries that belong together, all of one shape."""
    shapes = set(map(np.shape, row))
    if len(shapes) == 1:
        return row
    sides = np.broadcast_shapes(*shapes)
    return [spread(e, sides) for e in row]


def common(arrays: Sequence[StructOfArrays], shape: Sequence[int]) -> list[bool]:
    """Along which axes arrays that belong together are to be apart."""
    if not any(x.long for x in arrays):
        return [True] * len(shape)

    def decide(axis: int, n: int) -> bool:
        if n == 1:
            return True
        along = [x for x in arrays if x.shape[axis] != 1]
        short = any(x.is_short[axis] for x in along)
        long = any(not x.is_short[axis] and not _repeats(x, axis) for x in along)
        if short and long:
            return axis == len(shape) - 1 and n <= MAX_LENGTH
        return short

    return list(itertools.starmap(decide, enumerate(shape)))


def _repeats(x: StructOfArrays, axis: int) -> bool:
    """Whether it has the same entries everywhere along a long axis."""
    position = x.long.index(axis)
    return all(jnp.shape(e)[position] == 1 for e in x.entries)
