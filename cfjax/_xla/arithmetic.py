"""Operations that compute something of entries: elementwise ones, sums and products."""

import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .jaxprs import is_inexact
from .limits import MAX_LENGTH, MAX_PRODUCT
from .struct_of_arrays import (
    Call,
    StructOfArrays,
    aligned,
    common,
    conformed,
    spread,
    static_value,
    struct_of_arrays,
)


def elementwise(call: Call) -> StructOfArrays | None:
    which = static_value(call.values[0])
    if call.eqn.primitive.name == "select_n" and which is not None and not call.is_large:
        return _chosen(call, which)
    if not call.shape:
        return None  # Of numbers.
    values = [x if np.shape(x) == () else struct_of_arrays(x) for x in call.values]
    arrays = [x for x in values if isinstance(x, StructOfArrays)]
    is_short = common(arrays, call.shape)
    columns = [
        conformed(x, call.shape, is_short).entries
        if isinstance(x, StructOfArrays)
        else itertools.repeat(x)
        for x in values
    ]
    compute = functools.partial(call.eqn.primitive.bind, **call.params)
    if not call.is_large:
        # Each on its own, so that a derivative has the order of sums that JAX has.
        return StructOfArrays(map(compute, *columns), call.shape)
    computed: dict[Any, Any] = {}

    def entry(*row: Any) -> Any:
        key = tuple(map(id, row))
        if key not in computed:
            # With the row, so that none of it is forgotten and its identity used again.
            computed[key] = compute(*aligned(row)), row
        return computed[key][0]

    return StructOfArrays(map(entry, *columns), call.shape, is_short)


def _chosen(call: Call, which: np.ndarray) -> StructOfArrays:
    """What is chosen, if it is known now, as of the weights of a stage that are zero."""
    cases = [struct_of_arrays(x).entries for x in call.values[1:]]
    places = np.broadcast_to(which, call.shape).astype(int)
    return StructOfArrays([cases[n][k] for k, n in enumerate(places.flat)], call.shape)


def reduced(call: Call) -> StructOfArrays | None:
    x, axes, name = call.first(), call.params["axes"], call.eqn.primitive.name
    positions = tuple(k for k, axis in enumerate(x.long) if axis in axes)
    free = [k for k in range(len(x.shape)) if k not in axes]
    rows = x.places.transpose(*free, *axes)
    rows = rows.reshape(math.prod(rows.shape[: len(free)]), -1)
    aval: Any = call.eqn.outvars[0].aval
    is_lexicographic = jnp.issubdtype(aval.dtype, jnp.complexfloating)
    if name in _EXTREMES and (is_lexicographic or (positions and rows.shape[1] > 1)):
        # Each of several largest entries has its share of the derivative, in whichever column it
        # is.
        return None
    entries = x.entries
    if positions:
        x = call.through(x)
        params = call.params | {"axes": positions}

        def column(e: Any) -> Any:
            sides = list(jnp.shape(e))
            for k in positions:
                sides[k] = x.sides[k]
            return call.eqn.primitive.bind(spread(e, sides), **params)

        entries = list(map(column, x.entries))
    if name in _EXTREMES and is_inexact(aval):
        combine = functools.partial(_extreme, _EXTREMES[name])
    else:
        combine = functools.partial(functools.reduce, _COMBINED[name])
    outs = (combine(aligned([jnp.asarray(entries[k]) for k in row])) for row in rows)
    return StructOfArrays(outs, call.shape, [x.is_short[k] for k in free])


_EXTREMES: dict[str, Callable[[Any, Any], Any]] = {"reduce_max": lax.max, "reduce_min": lax.min}
_COMBINED = _EXTREMES | {
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
    "reduce_prod": operator.mul,
    "reduce_sum": operator.add,
}


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _extreme(combine: Callable[[Any, Any], Any], entries: Sequence[Any]) -> Any:
    """The largest or smallest; the derivative is shared evenly by all that are, as in JAX."""
    return functools.reduce(combine, entries)


@_extreme.defjvp
def _(combine, primals, tangents):
    (entries,), (moving,) = primals, tangents
    extreme = _extreme(combine, entries)
    shares = [lax.convert_element_type(lax.eq(x, extreme), extreme.dtype) for x in entries]
    total = functools.reduce(operator.add, map(operator.mul, moving, shares))
    return extreme, total / functools.reduce(operator.add, shares)


def cumulative(call: Call) -> StructOfArrays | None:
    x, axis = call.first(), call.params["axis"]
    if x.is_short[axis]:
        return None
    params = call.params | {"axis": x.long.index(axis)}
    return x.mapped(lambda e: call.eqn.primitive.bind(spread(e, x.sides), **params), x.shape)


def transformed(call: Call) -> StructOfArrays | None:
    """Fourier transforms along the last axes."""
    x, n = call.first(), len(call.params["fft_lengths"])
    if any(x.is_short[len(x.shape) - n :]) or 1 in call.shape[-n:]:
        return None
    fun = lambda e: call.eqn.primitive.bind(spread(e, x.sides), **call.params)  # noqa: E731
    return x.mapped(fun, call.shape)


class _Factor(NamedTuple):
    """One side of a product, with its axes in the order that both agree on."""

    # The places of the entries: by batch, by row, by what is summed.
    places: np.ndarray
    entries: list[Any]
    # Whether the axes of the result that come of the row are short.
    is_short: list[bool]
    # How many long axes: of the batch, free, summed.
    long: list[int]


def _factor(x: StructOfArrays, batch: Sequence[int], summed: Sequence[int]) -> _Factor:
    free = [k for k in range(len(x.shape)) if k not in (*batch, *summed)]
    groups = batch, free, summed
    order = [*batch, *free, *summed]
    position = {axis: k for k, axis in enumerate(x.long)}
    moves = [position[k] for k in order if not x.is_short[k]]
    long = [sum(not x.is_short[k] for k in group) for group in groups]

    def column(e: Any) -> Any:
        e = e if moves == sorted(moves) else jnp.transpose(e, moves)
        # A sum counts what repeats.
        return spread(e, [x.sides[k] for k in moves]) if long[2] else e

    sizes = [math.prod(x.inner[k] for k in group) for group in groups]
    places = x.places.transpose(order).reshape(sizes)
    return _Factor(places, list(map(column, x.entries)), [x.is_short[k] for k in free], long)


def product(call: Call) -> StructOfArrays | None:
    """Small products for each place along the long axes, or products along these."""
    params = call.params
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
    x, y = conformed(x, x.shape, flags[0]), conformed(y, y.shape, flags[1])
    left, right = _factor(x, batches[0], sums[0]), _factor(y, batches[1], sums[1])
    if left.places.size * right.places.shape[1] > MAX_PRODUCT:
        return None
    batch, free, summed = left.long
    options = {k: params[k] for k in ("precision", "preferred_element_type")}

    def times(a: Any, b: Any) -> Any:
        if summed:
            ends = range(a.ndim - summed, a.ndim), range(b.ndim - summed, b.ndim)
            return lax.dot_general(a, b, (ends, (range(batch), range(batch))), **options)
        if right.long[1]:
            a = jnp.expand_dims(a, range(a.ndim, a.ndim + right.long[1]))
        if free:
            b = jnp.expand_dims(b, range(batch, batch + free))
        return operator.mul(*aligned((a, b)))

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
    is_short = [x.is_short[k] for k in batches[0]]
    return StructOfArrays(outs, call.shape, [*is_short, *left.is_short, *right.is_short])
