"""Operations that only move entries: which each entry of the result is.

What they do along short axes is done to an array of places now, what they do along long ones to
every entry when the program runs.
"""

import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn

from .limits import MAX_LENGTH
from .struct_of_arrays import (
    Call,
    StructOfArrays,
    common,
    conformed,
    spread,
    static_value,
    struct_of_arrays,
)

# Beyond moving, what is added or multiplied goes to an entry.
_SCATTERS: dict[str, Callable[[Any, Any], Any]] = {
    "scatter-add": operator.add,
    "scatter-mul": operator.mul,
}


def broadcast(call: Call) -> StructOfArrays | None:
    if len(call.values) > 1:
        return None  # Of a shape that is not known.
    x = call.first()
    axes = dict(zip(call.params["broadcast_dimensions"], range(len(x.shape)), strict=True))
    # First with the new axes, of length 1.
    sources = [axes.get(k) for k in range(len(call.shape))]
    sides = [1 if k is None else x.shape[k] for k in sources]
    x = StructOfArrays(x.entries, sides, [k is None or x.is_short[k] for k in sources])
    # What is new in a large array repeats.
    flags = [
        not call.is_large or (m != 1 and short) for m, short in zip(sides, x.is_short, strict=True)
    ]
    return conformed(x, call.shape, flags)


def reshaped(call: Call) -> StructOfArrays | None:
    x = call.first()
    if not x.long:
        return StructOfArrays(x.entries, call.shape)
    groups = _groups(x.shape, call.shape)
    is_short = list(x.is_short)
    for old, new in groups:
        # What is merged with long axes is long.
        if (len(old), len(new)) != (1, 1) and not all(is_short[k] for k in old):
            for k in old:
                is_short[k] = False
    x = conformed(x, x.shape, is_short)
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
        return spread(e, between).reshape(after)

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


def transposed(call: Call) -> StructOfArrays:
    x, order = call.first(), call.params["permutation"]
    places, flags = x.places.transpose(order), [x.is_short[k] for k in order]
    position = {axis: k for k, axis in enumerate(x.long)}
    moves = [position[axis] for axis in order if not x.is_short[axis]]
    if moves != sorted(moves):
        x = x.mapped(lambda e: jnp.transpose(e, moves), x.shape)
    return x.at(places, call.shape, flags)


def sliced(call: Call) -> StructOfArrays:
    params = call.params
    strides = params["strides"] or [1] * len(call.shape)
    ends = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return _part(call, call.first(), list(ends), call.shape)


def _part(
    call: Call, x: StructOfArrays, ends: Sequence[tuple[int, int, int]], shape: tuple[int, ...]
) -> StructOfArrays:
    """A slice, by its start, its limit and its stride along each axis."""
    long = x.long
    if any(ends[k] != (0, x.shape[k], 1) for k in long):
        x = call.through(x)

    def column(e: Any) -> Any:
        pairs = zip(long, jnp.shape(e), strict=True)
        some = [(0, 1, 1) if n == 1 else ends[axis] for axis, n in pairs]
        return lax.slice(e, *zip(*some, strict=True))

    x = x.mapped(column, [shape[k] if k in long else n for k, n in enumerate(x.shape)])
    places = x.places[tuple(slice(None) if k in long else slice(*e) for k, e in enumerate(ends))]
    return x.at(places, shape, x.is_short)


def split(call: Call) -> list[StructOfArrays]:
    """An array split into several along an axis."""
    x, axis = call.first(), call.params["axis"]
    if not x.is_short[axis] and axis == len(x.shape) - 1 and x.shape[axis] <= MAX_LENGTH:
        x = _apart_along(x, axis)
    firsts = np.cumsum([0, *call.params["sizes"]]).tolist()
    outs = []
    for (start, stop), shape in zip(itertools.pairwise(firsts), call.shapes, strict=True):
        ends = [(start, stop, 1) if k == axis else (0, n, 1) for k, n in enumerate(x.shape)]
        outs.append(_part(call, x, ends, shape))
    return outs


def unpacked(call: Call) -> list[StructOfArrays]:
    axis = call.params["axis"]
    x = _apart_along(call.first(), axis)
    flags = [short for k, short in enumerate(x.is_short) if k != axis]
    return [x.at(x.places.take([k], axis), shape, flags) for k, shape in enumerate(call.shapes)]


def _apart_along(x: StructOfArrays, axis: int) -> StructOfArrays:
    return conformed(x, x.shape, [short or k == axis for k, short in enumerate(x.is_short)])


def stacked(call: Call) -> StructOfArrays:
    axis = call.params["axis"]
    sides = (*call.shape[:axis], *call.shape[axis + 1 :])
    arrays = call.arrays()
    flags = common(arrays, sides)
    arrays = [conformed(x, sides, flags) for x in arrays]
    flags.insert(axis, True)
    entries, places = _numbered(arrays)
    return StructOfArrays([entries[k] for k in np.stack(places, axis).flat], call.shape, flags)


def _numbered(arrays: Sequence[StructOfArrays]) -> tuple[list[Any], list[np.ndarray]]:
    """The entries of several arrays together, and their places among these."""
    entries, places = [], []
    for x in arrays:
        places.append(np.asarray(len(entries) + x.places))
        entries += x.entries
    return entries, places


def concatenated(call: Call) -> StructOfArrays:
    axis = call.params["dimension"]
    arrays = call.arrays()
    # Without the axis along which they differ.
    sides = [1 if k == axis else n for k, n in enumerate(call.shape)]
    alike = [
        StructOfArrays(x.entries, (*x.shape[:axis], 1, *x.shape[axis + 1 :]), x.is_short)
        if x.is_short[axis]
        else x
        for x in arrays
    ]
    flags = common(alike, sides)
    is_last = axis == len(sides) - 1 and call.shape[axis] <= MAX_LENGTH
    flags[axis] = is_last or all(x.is_short[axis] for x in arrays)
    arrays = [conformed(x, x.shape, flags) for x in arrays]
    if flags[axis]:
        entries, places = _numbered(arrays)
        places = np.concatenate(places, axis)
        return StructOfArrays([entries[k] for k in places.flat], call.shape, flags)
    position = flags[:axis].count(False)
    lengths = [x.shape[axis] for x in arrays]
    columns = [
        [jnp.expand_dims(e, position) for e in x.entries] if n == 1 else x.entries
        for n, x in zip(lengths, arrays, strict=True)
    ]

    def joined(*parts: Any) -> Any:
        others = [[*e.shape[:position], 1, *e.shape[position + 1 :]] for e in parts]
        sides = list(np.broadcast_shapes(*others))
        return lax.concatenate(
            [
                spread(e, [*sides[:position], n, *sides[position + 1 :]])
                for n, e in zip(lengths, parts, strict=True)
            ],
            position,
        )

    return StructOfArrays(map(joined, *columns), call.shape, flags)


def flipped(call: Call) -> StructOfArrays:
    x, dimensions = call.first(), call.params["dimensions"]
    positions = [k for k, axis in enumerate(x.long) if axis in dimensions]
    if positions:
        x = call.through(x).mapped(lambda e: lax.rev(e, positions), x.shape)
    short = tuple(k for k in dimensions if x.is_short[k])
    return x.at(np.flip(x.places, short), x.shape, x.is_short)


# Which operands of these have the entries that are moved. The rest are indices.
_MOVED = {
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "pad": slice(2),
    "scatter": slice(0, None, 2),
}


def _by_jax(
    eqn: JaxprEqn, values: Sequence[Any], shape: Sequence[int], is_short: Sequence[bool]
) -> StructOfArrays | None:
    """The entries that JAX's own operation moves to each place; None if it gives others too."""
    moved = range(len(values))[_MOVED[eqn.primitive.name]]
    operands = [None if k in moved else static_value(x) for k, x in enumerate(values)]
    if any(x is None and k not in moved for k, x in enumerate(operands)):
        return None
    entries, places = _numbered([struct_of_arrays(values[k]) for k in moved])
    for k, x in zip(moved, places, strict=True):
        operands[k] = np.asarray(x, np.int32)
    params = eqn.params
    if eqn.primitive.name == "gather":
        # What fills is no entry, nor is what was promised not to be asked for.
        is_clipped = params["mode"] == lax.GatherScatterMode.CLIP
        mode = lax.GatherScatterMode.CLIP if is_clipped else lax.GatherScatterMode.FILL_OR_DROP
        params = params | {"fill_value": -1, "mode": mode}
    outs = _outs(eqn.replace(params=params), operands)
    if not (0 <= outs.min() and outs.max() < len(entries)):
        return None
    return StructOfArrays([entries[k] for k in outs.flat], shape, is_short)


def _outs(eqn: JaxprEqn, operands: list[Any]) -> np.ndarray:
    """The result. JAX would compile a program for each, which takes longer than the step."""
    name, x, params = eqn.primitive.name, operands[0], eqn.params
    if name == "pad":
        return _pad(x, operands[1], params["padding_config"])
    if name in ("gather", "scatter"):
        with jax.ensure_compile_time_eval():
            return np.asarray(eqn.primitive.bind(*map(jnp.asarray, operands), **params))
    is_update = name == "dynamic_update_slice"
    sizes = operands[1].shape if is_update else params["slice_sizes"]
    axes = zip(x.shape, operands[2 if is_update else 1 :], sizes, strict=True)
    firsts = [min(max(int(k), 0), n - size) for n, k, size in axes]
    window = tuple(slice(k, k + size) for k, size in zip(firsts, sizes, strict=True))
    if not is_update:
        return x[window]
    outs = x.copy()
    outs[window] = operands[1]
    return outs


def _pad(x: np.ndarray, fill: Any, config: Sequence[tuple[int, int, int]]) -> np.ndarray:
    """As `lax.pad`: fills between entries, then puts more before and after, or takes away."""
    shape = [n + max(n - 1, 0) * inner for n, (_, _, inner) in zip(x.shape, config, strict=True)]
    spaced = np.full(shape, fill, x.dtype)
    spaced[tuple(slice(None, None, inner + 1) for _, _, inner in config)] = x
    more = [(max(low, 0), max(high, 0)) for low, high, _ in config]
    outs = np.pad(spaced, more, constant_values=fill)
    less = zip(outs.shape, config, strict=True)
    return outs[tuple(slice(max(-low, 0), n - max(-high, 0)) for n, (low, high, _) in less)]


def moved(call: Call) -> StructOfArrays | None:
    """Where indices are known, and long axes are whole."""
    x, values, params = call.first(), list(call.values), call.params
    is_update = "slice_sizes" not in params
    part = values[1].shape if is_update else params["slice_sizes"]
    if any(part[k] != x.shape[k] for k in x.long):
        return None
    if is_update:
        values[1] = conformed(struct_of_arrays(values[1]), part, x.is_short)
    else:
        sizes = (n if short else 1 for n, short in zip(part, x.is_short, strict=True))
        params = params | {"slice_sizes": tuple(sizes)}
    return _by_jax(call.eqn.replace(params=params), values, call.shape, x.is_short)


def padded(call: Call) -> StructOfArrays | None:
    x, fill, config = call.first(), call.values[1], call.params["padding_config"]
    flags, long = x.is_short, [config[k] for k in x.long]
    if any(tuple(ends) != (0, 0, 0) for ends in long):
        sides = [x.shape[k] if short else call.shape[k] for k, short in enumerate(flags)]
        number, lengths = jnp.asarray(fill), x.sides
        x = call.through(x).mapped(lambda e: lax.pad(spread(e, lengths), number, long), sides)
    short = [ends if is_one else (0, 0, 0) for ends, is_one in zip(config, flags, strict=True)]
    eqn = call.eqn.replace(params={"padding_config": tuple(short)})
    out = _by_jax(eqn, [x, fill], call.shape, flags)
    if out is None:
        return None
    # The number that fills repeats.
    n = len(x.long)
    entries = (e if jnp.ndim(e) == n else jnp.reshape(e, [1] * n) for e in out.entries)
    return StructOfArrays(entries, call.shape, flags)


def gathered(call: Call) -> StructOfArrays | None:
    x, params = call.first(), call.params
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    if any(k in gone or k in numbers.start_index_map or sizes[k] != x.shape[k] for k in x.long):
        return None
    flags = [True] * len(call.shape)
    window = (k for k in range(len(x.shape)) if k not in gone)
    for k, axis in zip(numbers.offset_dims, window, strict=True):
        flags[k] = x.is_short[axis]
    sizes = tuple(n if short else 1 for n, short in zip(sizes, x.is_short, strict=True))
    eqn = call.eqn.replace(params=params | {"slice_sizes": sizes})
    return _by_jax(eqn, call.values, call.shape, flags)


def scattered(call: Call) -> StructOfArrays | None:
    x, indices, updates = call.first(), call.values[1], struct_of_arrays(call.values[2])
    numbers = call.params["dimension_numbers"]
    gone = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    axes = (k for k in range(len(x.shape)) if k not in gone)
    window = dict(zip(numbers.update_window_dims, axes, strict=True))
    indexed = (*gone, *numbers.scatter_dims_to_operand_dims)
    if any(k in indexed for k in x.long) or any(
        not x.is_short[axis] and updates.shape[k] != x.shape[axis] for k, axis in window.items()
    ):
        return None
    flags = [k not in window or x.is_short[window[k]] for k in range(len(updates.shape))]
    updates = conformed(updates, updates.shape, flags)
    combine = _SCATTERS.get(call.eqn.primitive.name)
    if combine is None:
        return _by_jax(call.eqn, [x, indices, updates], x.shape, x.is_short)
    indices = static_value(indices)
    if indices is None:
        return None
    params = call.params | {"update_jaxpr": None, "update_consts": ()}
    with jax.ensure_compile_time_eval():
        places = jnp.asarray(np.asarray(updates.places, np.int32))
        none = jnp.full(x.inner, -1, np.int32)
        taken = np.asarray(lax.scatter_p.bind(none, jnp.asarray(indices), places, **params))
    if len(np.unique(taken[taken >= 0])) < len(updates.entries):
        return None  # Some go to one entry, or to none.
    pairs = zip(x.entries, taken.flat, strict=True)
    entries = (combine(entry, updates.entries[k]) if k >= 0 else entry for entry, k in pairs)
    return StructOfArrays(entries, x.shape, x.is_short)
