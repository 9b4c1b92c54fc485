"""Short vectors along leading axes as one array for each of their entries, and what operations make
of them.

In memory the entries of a vector lie side by side, so XLA can neither fuse nor vectorise well what
each of them needs of the others. As arrays of their own they are fast.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn
from jaxtyping import Array

from .materialise import materialised
from .pack import pack, pack_p, unpack, unpack_p
from .scalars import (
    MAX_PRODUCT,
    SCATTERS,
    Scalars,
    is_extreme,
    is_lexicographic,
    known,
    moved,
    reduction,
    scalars,
    scattered_into,
)
from .scope import MAX_LENGTH, MAX_SIZE, is_numeric, is_rows
from .understood import ELEMENTWISE, REDUCTIONS, is_understood


@jtu.register_pytree_node_class
class StructOfArrays:
    """An array as one array for each place along its short axes, row by row.

    `shape` is that of the whole. `is_short` says along which axes it is scalarised; an axis of
    length 1 always is. A column has the other axes, the long ones, in their order. Where all its
    entries along one of these are equal, it may have length 1 there.
    """

    def __init__(self, entries: Iterable[Any], shape: Sequence[int], is_short: Sequence[bool]):
        self.entries = tuple(entries)
        self.shape = tuple(shape)
        self.is_short = tuple(n == 1 or s for n, s in zip(shape, is_short, strict=True))

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

    def whole(self) -> Array:
        none = [False] * len(self.shape)
        (x,) = _to(self, self.shape, none).entries
        return _spread(x, [n for n in self.shape if n != 1]).reshape(self.shape)

    def tree_flatten(self) -> tuple[tuple, Any]:
        return self.entries, (self.shape, self.is_short)

    @classmethod
    def tree_unflatten(cls, aux, children):
        return cls(children, *aux)


def struct_of_arrays(x: Any) -> StructOfArrays:
    """An array as a struct of arrays; short vectors along leading axes by their entries."""
    if isinstance(x, StructOfArrays):
        return x
    if isinstance(x, Scalars | np.ndarray):
        x = scalars(x)
        return StructOfArrays(x.entries, x.shape, [True] * len(x.shape))
    is_short = [n == 1 for n in x.shape]
    flat = StructOfArrays([x.reshape([n for n in x.shape if n != 1])], x.shape, is_short)
    return _to(flat, x.shape, [*is_short[:-1], True]) if is_rows(x) else flat


def conformed(x: Any, like: StructOfArrays) -> StructOfArrays:
    """The array apart along the axes of another of its shape, and repeating where that does."""
    x = _to(struct_of_arrays(x), like.shape, like.is_short)
    entries = []
    for e, other in zip(x.entries, like.entries, strict=True):
        sides = np.broadcast_shapes(jnp.shape(e), jnp.shape(other))
        entries.append(lax.slice(_spread(e, sides), [0] * len(sides), jnp.shape(other)))
    return StructOfArrays(entries, x.shape, x.is_short)


class _Call(NamedTuple):
    """One operation on structs of arrays."""

    eqn: JaxprEqn
    values: Sequence[Any]
    fixed: Sequence[bool]
    # Of the only result.
    shape: tuple[int, ...]

    def arrays(self) -> list[StructOfArrays]:
        return [struct_of_arrays(x) for x in self.values]

    def through(self, x: StructOfArrays) -> StructOfArrays:
        """The first operand, computed once for all that neighbours along long axes take of it."""
        return x if self.fixed[0] else _once(x)


def on_struct_of_arrays(
    eqn: JaxprEqn, values: Sequence[Any], fixed: Sequence[bool]
) -> list[Any] | None:
    """The results of one operation, if there is a rule for it, otherwise None."""
    name = eqn.primitive.name
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    if eqn.effects or not is_understood(eqn):
        return None
    if not all(is_numeric(aval) and 0 not in aval.shape for aval in avals):
        return None
    call = _Call(eqn, values, fixed, avals[len(eqn.invars)].shape)
    if eqn.primitive is unpack_p or name == "split":
        outs = _split(call)
    elif eqn.primitive.multiple_results:
        return None
    elif name in ELEMENTWISE:
        outs = [_elementwise(call, lambda *row: eqn.primitive.bind(*row, **eqn.params))]
    else:
        rule = _rule(eqn)
        out = None if rule is None else rule(call)
        outs = None if out is None else [out]
    return None if outs is None else list(map(_settled, outs))


def _rule(eqn: JaxprEqn) -> Callable[[_Call], StructOfArrays | None] | None:
    name = eqn.primitive.name
    if eqn.primitive is pack_p:
        return _stacked
    if name in REDUCTIONS:
        return None if is_lexicographic(eqn) else _reduced
    return _RULES.get(name)


def _settled(x: StructOfArrays) -> Any:
    """Without long axes: a small array or a number."""
    if x.long or len(x.entries) > MAX_SIZE:
        return x
    return Scalars(x.entries, x.shape) if x.shape else x.entries[0]


def _at(
    x: StructOfArrays, places: np.ndarray, shape: Sequence[int], is_short: Sequence[bool]
) -> StructOfArrays:
    return StructOfArrays([x.entries[k] for k in places.flat], shape, is_short)


def _to(x: StructOfArrays, shape: Sequence[int], is_short: Sequence[bool]) -> StructOfArrays:
    """The array broadcast to a shape of as many axes, apart along some of them."""
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
            kept = {id(e): e for row in rows for e in row}
            number = {key: k for k, key in enumerate(kept)}
            numbers = np.array([[number[id(e)] for e in row] for row in rows])
            entries = list(kept.values())
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
    sides = np.broadcast_shapes(*map(jnp.shape, row))
    return pack([_spread(e, sides) for e in row], axis=position)


def _spread(x: Any, sides: Sequence[int]) -> Any:
    """A number, or an array that repeats along axes of length 1, with these sides."""
    x = jnp.asarray(x)
    if x.shape == tuple(sides):
        return x
    return lax.broadcast_in_dim(x, sides, range(x.ndim))


def _common(arrays: Sequence[StructOfArrays], shape: Sequence[int]) -> list[bool]:
    """Along which axes arrays that belong together are to be apart."""

    def decide(axis: int, n: int) -> bool:
        if n == 1:
            return True
        given = [x for x in arrays if x.shape[axis] != 1]
        short = any(x.is_short[axis] for x in given)
        long = any(not x.is_short[axis] and not _repeats(x, axis) for x in given)
        if short and long:
            return axis == len(shape) - 1 and n <= MAX_LENGTH
        return short

    return list(itertools.starmap(decide, enumerate(shape)))


def _repeats(x: StructOfArrays, axis: int) -> bool:
    """Whether it has the same entries everywhere along a long axis."""
    position = x.long.index(axis)
    return all(jnp.shape(e)[position] == 1 for e in x.entries)


def _once(x: StructOfArrays) -> StructOfArrays:
    """The same, materialised: what moves entries along long axes would compute them anew."""
    distinct = list({id(e): e for e in x.entries}.values())
    new = dict(zip(map(id, distinct), materialised(distinct, in_batches=True), strict=True))
    return StructOfArrays([new[id(e)] for e in x.entries], x.shape, x.is_short)


def _mapped(x: StructOfArrays, fun: Callable[[Any], Any], shape: Sequence[int]) -> StructOfArrays:
    """`fun` of every column, which keeps what is short. Long axes may become 1."""
    outs = map(fun, x.entries)
    gone = [k for k, axis in enumerate(x.long) if shape[axis] == 1]
    return StructOfArrays([jnp.squeeze(e, gone) if gone else e for e in outs], shape, x.is_short)


def _elementwise(call: _Call, fun: Callable[..., Any]) -> StructOfArrays:
    arrays = {k: struct_of_arrays(x) for k, x in enumerate(call.values) if _ndim(x)}
    is_short = _common(list(arrays.values()), call.shape)
    arrays = {k: _to(x, call.shape, is_short) for k, x in arrays.items()}
    made: dict[Any, Any] = {}

    def entry(place: int) -> Any:
        row = [arrays[k].entries[place] if k in arrays else x for k, x in enumerate(call.values)]
        key = tuple(map(id, row))
        if key not in made:
            sides = np.broadcast_shapes(*map(jnp.shape, row))
            # With the row, so that none of it is forgotten and its identity used again.
            made[key] = fun(*(_spread(e, sides) for e in row)), row
        return made[key][0]

    first = next(iter(arrays.values()))
    return StructOfArrays(map(entry, range(len(first.entries))), first.shape, first.is_short)


def _ndim(x: Any) -> int:
    return len(x.shape) if isinstance(x, Scalars | StructOfArrays) else np.ndim(x)


def _broadcast(call: _Call) -> StructOfArrays | None:
    x = call.values[0]
    if len(call.values) > 1:
        return None  # Of a shape that is not known.
    if not _ndim(x):
        is_short = [n == 1 for n in call.shape]
        return StructOfArrays([jnp.reshape(x, [1] * is_short.count(False))], call.shape, is_short)
    x = struct_of_arrays(x)
    axes = dict(zip(call.eqn.params["broadcast_dimensions"], range(len(x.shape)), strict=True))
    # First with the new axes, of length 1.
    spread = [axes.get(k) for k in range(len(call.shape))]
    sides = [1 if k is None else x.shape[k] for k in spread]
    x = StructOfArrays(x.entries, sides, [k is None or x.is_short[k] for k in spread])
    # What is new repeats.
    flags = [m != 1 and short for m, short in zip(sides, x.is_short, strict=True)]
    return _to(x, call.shape, flags)


def _reshaped(call: _Call) -> StructOfArrays | None:
    x = struct_of_arrays(call.values[0])
    groups = _groups(x.shape, call.shape)
    is_short = list(x.is_short)
    for old, new in groups:
        # What is merged with long axes is long.
        if (len(old), len(new)) != (1, 1) and not all(is_short[k] for k in old):
            for k in old:
                is_short[k] = False
    x = _to(x, x.shape, is_short)
    flags = [True] * len(call.shape)
    for old, new in groups:
        for k in new:
            flags[k] = all(is_short[j] for j in old)
    position = {axis: k for k, axis in enumerate(x.long)}

    def column(e: Any) -> Any:
        between, after = list(jnp.shape(e)), []
        for old, new in groups:
            if flags[new[0]]:
                continue
            sides = [between[position[k]] for k in old]
            if (len(old), len(new)) == (1, 1):
                after += sides
            elif all(n == 1 for n in sides):
                after += [1] * len(new)
            else:
                for k in old:
                    between[position[k]] = x.shape[k]
                after += [call.shape[k] for k in new]
        return _spread(e, between).reshape(after)

    return StructOfArrays(map(column, x.entries), call.shape, flags)


def _groups(old: Sequence[int], new: Sequence[int]) -> list[tuple[list[int], list[int]]]:
    """The axes of two shapes in the smallest groups that hold the same entries, without those of
    length 1.
    """
    left = [k for k, n in enumerate(old) if n != 1]
    right = [k for k, n in enumerate(new) if n != 1]
    groups = []
    while left:
        a, b = [left.pop(0)], [right.pop(0)]
        while (more := math.prod(old[k] for k in a) - math.prod(new[k] for k in b)) != 0:
            if more < 0:
                a.append(left.pop(0))
            else:
                b.append(right.pop(0))
        groups.append((a, b))
    return groups


def _transposed(call: _Call) -> StructOfArrays:
    x = struct_of_arrays(call.values[0])
    order = call.eqn.params["permutation"]
    position = {axis: k for k, axis in enumerate(x.long)}
    moves = [position[axis] for axis in order if not x.is_short[axis]]
    if moves != sorted(moves):
        x = StructOfArrays([jnp.transpose(e, moves) for e in x.entries], x.shape, x.is_short)
    return _at(x, x.places.transpose(order), call.shape, [x.is_short[k] for k in order])


def _sliced(call: _Call) -> StructOfArrays:
    x, params = struct_of_arrays(call.values[0]), call.eqn.params
    strides = params["strides"] or [1] * len(x.shape)
    ends = list(zip(params["start_indices"], params["limit_indices"], strides, strict=True))
    whole = [(0, n, 1) for n in x.shape]
    if any(ends[k] != whole[k] for k in x.long):
        x = call.through(x)
    shape = [x.shape[k] if short else call.shape[k] for k, short in enumerate(x.is_short)]

    def column(e: Any) -> Any:
        pairs = zip(x.long, jnp.shape(e), strict=True)
        some = [(0, 1, 1) if n == 1 else ends[axis] for axis, n in pairs]
        return lax.slice(e, *zip(*some, strict=True)) if some else e

    long = x.long
    x = _mapped(x, column, shape)
    places = x.places[tuple(slice(None) if k in long else slice(*e) for k, e in enumerate(ends))]
    return _at(x, places, call.shape, x.is_short)


def _reversed(call: _Call) -> StructOfArrays:
    x, dimensions = struct_of_arrays(call.values[0]), call.eqn.params["dimensions"]
    positions = [k for k, axis in enumerate(x.long) if axis in dimensions]
    if positions:
        x = _mapped(call.through(x), lambda e: lax.rev(e, positions), x.shape)
    short = [k for k in dimensions if x.is_short[k]]
    return _at(x, np.flip(x.places, tuple(short)), x.shape, x.is_short)


def _concatenated(call: _Call) -> StructOfArrays:
    axis = call.eqn.params["dimension"]
    arrays = call.arrays()
    # Without the axis along which they differ.
    sides = [1 if k == axis else n for k, n in enumerate(call.shape)]
    flags = _common(
        [
            StructOfArrays(x.entries, (*x.shape[:axis], 1, *x.shape[axis + 1 :]), x.is_short)
            if x.is_short[axis]
            else x
            for x in arrays
        ],
        sides,
    )
    is_last = axis == len(sides) - 1 and call.shape[axis] <= MAX_LENGTH
    is_short = is_last or all(x.is_short[axis] for x in arrays)
    flags[axis] = is_short
    if is_short:
        arrays = [_to(x, x.shape, flags) for x in arrays]
        entries, firsts = [], []
        for x in arrays:
            firsts.append(len(entries))
            entries += x.entries
        places = np.concatenate([n + x.places for n, x in zip(firsts, arrays, strict=True)], axis)
        flags[axis] = True
        return StructOfArrays([entries[k] for k in places.flat], call.shape, flags)
    position = flags[:axis].count(False)

    def long(x: StructOfArrays) -> list[Any]:
        x = _to(x, x.shape, flags)
        if x.shape[axis] == 1:
            return [jnp.expand_dims(e, position) for e in x.entries]
        return list(x.entries)

    lengths = [x.shape[axis] for x in arrays]

    def joined(*parts: Any) -> Any:
        others = [[*e.shape[:position], 1, *e.shape[position + 1 :]] for e in parts]
        sides = list(np.broadcast_shapes(*others))
        return lax.concatenate(
            [
                _spread(e, [*sides[:position], n, *sides[position + 1 :]])
                for n, e in zip(lengths, parts, strict=True)
            ],
            position,
        )

    return StructOfArrays(map(joined, *map(long, arrays)), call.shape, flags)


def _stacked(call: _Call) -> StructOfArrays:
    axis = call.eqn.params["axis"]
    if not _ndim(call.values[0]):
        entries = list(call.values)
        return StructOfArrays(entries, call.shape, [True])
    sides = (*call.shape[:axis], *call.shape[axis + 1 :])
    arrays = call.arrays()
    flags = _common(arrays, sides)
    arrays = [_to(x, sides, flags) for x in arrays]
    n = len(arrays[0].entries)
    entries = [e for x in arrays for e in x.entries]
    places = np.stack([k * n + x.places for k, x in enumerate(arrays)], axis)
    flags.insert(axis, True)
    return StructOfArrays([entries[k] for k in places.flat], call.shape, flags)


def _split(call: _Call) -> list[StructOfArrays]:
    x, axis = struct_of_arrays(call.values[0]), call.eqn.params["axis"]
    is_unpacked = call.eqn.primitive is unpack_p
    shapes: list[Any] = [v.aval.shape for v in call.eqn.outvars]  # pyright: ignore
    if not x.is_short[axis]:
        is_last = axis == len(x.shape) - 1 and x.shape[axis] <= MAX_LENGTH
        if is_unpacked or is_last:
            x = _to(x, x.shape, [s or k == axis for k, s in enumerate(x.is_short)])
    if is_unpacked:
        flags = [s for k, s in enumerate(x.is_short) if k != axis]
        return [_at(x, x.places.take(k, axis), shape, flags) for k, shape in enumerate(shapes)]
    ends = np.cumsum([0, *call.eqn.params["sizes"]])
    outs = []
    for (start, stop), shape in zip(itertools.pairwise(ends), shapes, strict=True):
        limits = [stop if k == axis else n for k, n in enumerate(x.shape)]
        starts = [start if k == axis else 0 for k in range(len(x.shape))]
        params = dict(start_indices=starts, limit_indices=limits, strides=None)
        part = call._replace(eqn=call.eqn.replace(params=params), values=[x], shape=shape)
        outs.append(_sliced(part))
    return outs


def _padded(call: _Call) -> StructOfArrays | None:
    if _ndim(call.values[1]):
        return None
    x, fill, config = (
        struct_of_arrays(call.values[0]),
        call.values[1],
        call.eqn.params["padding_config"],
    )
    sides = [call.shape[k] if not short else x.shape[k] for k, short in enumerate(x.is_short)]
    if any(tuple(config[k]) != (0, 0, 0) for k in x.long):
        x, along = call.through(x), [config[k] for k in x.long]
        x = _mapped(x, lambda e: lax.pad(_spread(e, x.sides), jnp.asarray(fill), along), sides)
    none = [(0, 0, 0) if not short else c for c, short in zip(config, x.is_short, strict=True)]
    inner = [n if short else 1 for n, short in zip(call.shape, x.is_short, strict=True)]
    eqn = call.eqn.replace(params={"padding_config": tuple(none)})
    outs = moved(eqn, [Scalars(x.entries, x.inner), fill], tuple(inner))
    if outs is None:
        return None
    # The number that fills repeats.
    entries = (e if jnp.ndim(e) else jnp.reshape(e, [1] * len(x.long)) for e in outs[0].entries)
    return StructOfArrays(entries, call.shape, x.is_short)


def _reduced(call: _Call) -> StructOfArrays | None:
    x, axes = struct_of_arrays(call.values[0]), call.eqn.params["axes"]
    positions = tuple(k for k, axis in enumerate(x.long) if axis in axes)
    entries = list(x.entries)
    kept = [k for k in range(len(x.shape)) if k not in axes]
    rows = x.places.transpose(*kept, *axes)
    if positions and is_extreme(call.eqn) and rows.size > math.prod(rows.shape[: len(kept)]):
        # Of all that are largest each has its share, in whichever column.
        return None
    if positions:
        x = call.through(x)
        params = call.eqn.params | {"axes": positions}

        def column(e: Any) -> Any:
            sides = list(jnp.shape(e))
            for k in positions:
                sides[k] = x.sides[k]
            return call.eqn.primitive.bind(_spread(e, sides), **params)

        entries = list(map(column, x.entries))
    rows = rows.reshape(math.prod(rows.shape[: len(kept)]), -1)
    combine = reduction(call.eqn)

    def reduced(row: np.ndarray) -> Any:
        parts = [entries[k] for k in row]
        sides = np.broadcast_shapes(*map(jnp.shape, parts))
        return combine([_spread(e, sides) for e in parts])

    outs = list(map(reduced, rows))
    return StructOfArrays(outs, call.shape, [x.is_short[k] for k in kept])


def _cumulative(call: _Call) -> StructOfArrays | None:
    x, axis = struct_of_arrays(call.values[0]), call.eqn.params["axis"]
    if x.is_short[axis]:
        return None
    params = call.eqn.params | {"axis": x.long.index(axis)}
    fun = lambda e: call.eqn.primitive.bind(_spread(e, x.sides), **params)  # noqa: E731
    return _mapped(x, fun, x.shape)


def _transformed(call: _Call) -> StructOfArrays | None:
    """Fourier transforms along the last axes."""
    x = struct_of_arrays(call.values[0])
    lengths = call.eqn.params["fft_lengths"]
    if any(x.is_short[len(x.shape) - len(lengths) :]) or 1 in call.shape[-len(lengths) :]:
        return None
    fun = lambda e: call.eqn.primitive.bind(_spread(e, x.sides), **call.eqn.params)  # noqa: E731
    return _mapped(x, fun, call.shape)


def _gathered(call: _Call) -> StructOfArrays | None:
    x, indices = struct_of_arrays(call.values[0]), known(call.values[1])
    params = call.eqn.params
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    if indices is None or any(
        k in gone or k in numbers.start_index_map or sizes[k] != x.shape[k] for k in x.long
    ):
        return None
    flags = [True] * len(call.shape)
    kept = (k for k in range(len(x.shape)) if k not in gone)
    for k, axis in zip(numbers.offset_dims, kept, strict=True):
        flags[k] = x.is_short[axis]
    inner = tuple(n if short else 1 for n, short in zip(call.shape, flags, strict=True))
    sizes = tuple(n if short else 1 for n, short in zip(sizes, x.is_short, strict=True))
    eqn = call.eqn.replace(params=params | {"slice_sizes": sizes})
    outs = moved(eqn, [Scalars(x.entries, x.inner), indices], inner)
    return None if outs is None else StructOfArrays(outs[0].entries, call.shape, flags)


def _scattered(call: _Call) -> StructOfArrays | None:
    name = call.eqn.primitive.name
    x, updates = struct_of_arrays(call.values[0]), struct_of_arrays(call.values[2])
    numbers = call.eqn.params["dimension_numbers"]
    gone = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    kept = [k for k in range(len(x.shape)) if k not in gone]
    window = dict(zip(numbers.update_window_dims, kept, strict=True))
    indexed = (*gone, *numbers.scatter_dims_to_operand_dims)
    if any(k in indexed for k in x.long) or any(
        not x.is_short[axis] and updates.shape[k] != x.shape[axis] for k, axis in window.items()
    ):
        return None
    flags = [k not in window or x.is_short[window[k]] for k in range(len(updates.shape))]
    updates = _to(updates, updates.shape, flags)
    inner, more = Scalars(x.entries, x.inner), Scalars(updates.entries, updates.inner)
    parts = [inner, call.values[1], more]
    if name == "scatter":
        outs = moved(call.eqn, parts, x.inner)
    else:
        outs = scattered_into(SCATTERS[name], parts, call.eqn.params, x.inner)
    return None if outs is None else StructOfArrays(outs[0].entries, x.shape, x.is_short)


class _Factor(NamedTuple):
    """One side of a product, with its axes in the order that both agree on."""

    # Of the entries: by batch, by row, by what is summed.
    places: np.ndarray
    entries: list[Any]
    # Those that are neither of the batch nor summed.
    free: list[int]
    # How many long axes: of the batch, free, summed.
    long: list[int]


def _factor(x: StructOfArrays, batch: Sequence[int], summed: Sequence[int]) -> _Factor:
    free = [k for k in range(len(x.shape)) if k not in (*batch, *summed)]
    groups = batch, free, summed
    order = [*batch, *free, *summed]
    position = {axis: k for k, axis in enumerate(x.long)}
    moves = [position[k] for k in order if not x.is_short[k]]
    is_sum = [k in summed for k in order if not x.is_short[k]]

    def column(e: Any) -> Any:
        e = e if moves == sorted(moves) else jnp.transpose(e, moves)
        if not any(is_sum):
            return e
        return _spread(e, [x.shape[k] for k in order if not x.is_short[k]])

    sizes = [math.prod(x.inner[k] for k in group) for group in groups]
    long = [sum(not x.is_short[k] for k in group) for group in groups]
    places = x.places.transpose(order).reshape(sizes)
    return _Factor(places, list(map(column, x.entries)), free, long)


def _product(call: _Call) -> StructOfArrays | None:
    """Small products for each place along the long axes, or products along these."""
    params = call.eqn.params
    sums, batches = params["dimension_numbers"]
    x, y = call.arrays()
    avals: list[Any] = [v.aval for v in (*call.eqn.invars, *call.eqn.outvars)]
    if len({aval.dtype for aval in avals}) != 1:
        return None
    # Axes that belong together are apart in both, or in none.
    flags = [list(x.is_short), list(y.is_short)]
    pairs = itertools.chain(zip(*sums, strict=True), zip(*batches, strict=True))
    for k, (a, b) in enumerate(pairs):
        is_sum = k < len(sums[0])
        if flags[0][a] != flags[1][b]:
            flags[0][a] = flags[1][b] = is_sum and x.shape[a] <= MAX_LENGTH
        if is_sum and not flags[0][a] and not any(call.fixed):
            return None  # Of two matrices, which XLA knows best.
    x, y = _to(x, x.shape, flags[0]), _to(y, y.shape, flags[1])
    left, right = _factor(x, batches[0], sums[0]), _factor(y, batches[1], sums[1])
    if left.places.size * right.places.shape[1] > MAX_PRODUCT:
        return None
    batch, left_long, summed = left.long
    options = {k: params[k] for k in ("precision", "preferred_element_type")}

    def times(a: Any, b: Any) -> Any:
        if summed:
            ends = range(a.ndim - summed, a.ndim), range(b.ndim - summed, b.ndim)
            return lax.dot_general(a, b, (ends, (range(batch), range(batch))), **options)
        a = jnp.expand_dims(a, range(a.ndim, a.ndim + right.long[1]))
        b = jnp.expand_dims(b, range(batch, batch + left_long))
        sides = np.broadcast_shapes(a.shape, b.shape)
        return _spread(a, sides) * _spread(b, sides)

    def dot(row: np.ndarray, column: np.ndarray) -> Any:
        pairs = zip(row, column, strict=True)
        return functools.reduce(
            operator.add, (times(left.entries[i], right.entries[j]) for i, j in pairs)
        )

    outs = [
        dot(row, column)
        for above, below in zip(left.places, right.places, strict=True)
        for row in above
        for column in below
    ]
    is_short = [x.is_short[k] for k in (*batches[0], *left.free)]
    return StructOfArrays(outs, call.shape, [*is_short, *(y.is_short[k] for k in right.free)])


_RULES: dict[str, Callable[[_Call], StructOfArrays | None]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _concatenated,
    "cumprod": _cumulative,
    "cumsum": _cumulative,
    "dot_general": _product,
    "fft": _transformed,
    "gather": _gathered,
    "pad": _padded,
    "reshape": _reshaped,
    "rev": _reversed,
    "scatter": _scattered,
    "scatter-add": _scattered,
    "scatter-mul": _scattered,
    "scatter_add": _scattered,
    "scatter_mul": _scattered,
    "slice": _sliced,
    "squeeze": _reshaped,
    "stack": _stacked,
    "transpose": _transposed,
}
