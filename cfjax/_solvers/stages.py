"""The stages of a step rolled into one loop, so that a program has the field and its flow once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._arrays import describe
from .._field import AbstractFrozenField, combine, is_field
from .._fields.elementwise import Elementwise
from .._methods.tableau import Product, Row
from .._numerics.matmul import matmul
from .._numerics.vectors import pack
from .chart import Chart
from .compiled import chosen, limits, over_stages, scalarised, where_scalarised


def can_roll(unroll: bool | None, field: PyTree, point: PyTree) -> bool:
    """Whether flows of combinations of such fields may be one loop, and where `unroll` is None
    whether that pays.

    Fields must combine in the usual way and have no chart of their own. Fields of far more numbers
    than the point has are faster unrolled.
    """
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    is_possible = any(map(is_field, parts)) and _is_plain(field)
    if unroll is not None:
        return is_possible and not unroll
    return is_possible and _size(field) <= max(limits.MAX_SIZE, 4 * _size(point))


def _can_roll_in_room(
    unroll: bool | None, chart: Chart, known: Sequence[Any], num_stages: int
) -> bool:
    """Whether a field with a chart of its own has room for all stages, after those known.

    It compiles in a third of the time, and runs an eighth to a third longer.
    """
    first = known[-1]
    if unroll or not is_field(first) or type(first).room is AbstractFrozenField.room:
        return False
    pays = unroll is False or _size(chart.start) <= limits.LARGE
    if not pays or any(x.span is not first.span for x in known):
        return False
    room = first.room(chart.start, num_stages)
    return room is not None and _fits(room, chart, first)


def _fits(room: Any, chart: Chart, first: Any) -> bool:
    is_like = False

    def look() -> None:
        nonlocal is_like
        k, z = room.coordinates(first, chart.start)
        later = chart.frozen_after([room.field(k)], jnp.zeros(()), room.point(z))
        is_like = type(later) is type(first) and _is_like(room.kept(0), room.entered(later))

    jax.eval_shape(look)
    return is_like


def is_uniform(chart: Chart) -> bool:
    """Whether the field has one structure, and its arrays one shape and dtype, at all stages."""
    first, c = chart.fields[0], jnp.zeros(())
    return _is_like(first, jax.eval_shape(lambda: chart.frozen_after([first], c, chart.start)))


def _size(tree: PyTree) -> int:
    return sum(jnp.size(x) for x in jtu.tree_leaves(tree))


def _is_plain(field: PyTree) -> bool:
    """Whether its parts combine in the usual way and have no chart of their own."""
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    return all(_is_plain_part(part) for part in parts if is_field(part))


def _is_plain_part(field: AbstractFrozenField) -> bool:
    cls: Any = type(field.field if isinstance(field, Elementwise) else field)
    usual: Any = AbstractFrozenField
    return (
        cls.combine.__func__ is usual.combine.__func__
        and cls.to_chart is usual.to_chart
        and cls.from_chart is usual.from_chart
    )


def rolled_flows(
    rows: Real[np.ndarray, "flows *powers stages"],
    fields: Sequence[PyTree],
    point: PyTree,
    flow: Callable[[PyTree, PyTree], PyTree],
    weights: Callable[[Array], Real[Array, " stages"]] = lambda row: row,
) -> PyTree:
    """Where flows of combinations of the fields lead, that of the first row first.

    A combination has the `weights` of its row, which are of the first fields, and zero where all
    of the row is.
    """
    fields = fields[: rows.shape[-1]]

    def moved(point: PyTree) -> PyTree:
        # XLA computes what leads to each of the arrays that `jnp.stack` gets for itself.
        stacked = _Stacked(jtu.tree_map(lambda *leaves: pack(leaves), *fields))

        def body(point: PyTree, turn: Any) -> Any:
            row, is_used = turn
            return flow(stacked.combination(_Row(weights(row), is_used)), point), None

        return over_stages(body, point, (rows, rows.any(axis=tuple(range(1, rows.ndim - 1)))))[0]

    # A weak type would be lost on the way.
    start = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x)), point)
    # For one system a loop of flows is as fast, and its derivatives compile faster.
    return scalarised(moved, start, in_batches=True)


class _Row(NamedTuple):
    """The weights of a combination, and which of them are not zero.

    Where the loop over stages is unrolled, the others are left out.
    """

    weights: Any
    are_used: Any

    @classmethod
    def of(cls, rows: Sequence[Sequence[Any]], n: int) -> "_Row":
        """Rows of n weights, of which the last may be missing."""
        padded = np.array([[*map(float, row), *[0.0] * (n - len(row))] for row in rows])
        return cls(padded, padded != 0)


class _Flow(NamedTuple):
    """A flow of a step: from which point, along which combination of the fields, to which point,
    and the stage that is evaluated there, with its time. What is no stage has the number after the
    last one.
    """

    source: Any
    row: Any
    target: Any
    stage: Any
    c: Any


def _flows(products: Sequence[Product], stages: Sequence[Product], times: Row) -> _Flow:
    """The flows of a step as arrays, one turn of a loop for each, and each to a point of its own.

    The last of `stages` is its end.
    """
    place = {product: k for k, product in enumerate(products)}
    evaluated = {rows: k for k, rows in enumerate(stages[:-1])}
    flows = []
    for target, product in enumerate(products[1:], 1):
        stage = evaluated.get(product, len(times))
        c = float(times[stage]) if product in evaluated else 0.0
        flows.append(_Flow(place[product[:-1]], product[-1], target, stage, c))
    source, weights, target, stage, c = zip(*flows, strict=True)
    rows = _Row.of(weights, len(times))
    return _Flow(np.asarray(source), rows, *map(np.asarray, (target, stage, c)))


def rolled(
    unroll: bool | None, chart: Chart, stages: Sequence[Product], times: Row
) -> dict[Product, PyTree]:
    """The points of a step, of which the first field is known; `chart` gets all its fields.

    `stages` are the products of flows that lead to the stages, each to a point of its own, and to
    the end; `times` are the times of the stages. There are no points where the field allows no
    loop, where `unroll` asks for none, and where it does not pay.
    """
    first, num_stages = chart.fields[0], len(times)
    fields: Any = None
    # One more for the flows that lead to no stage.
    if can_roll(unroll, first, chart.start) and is_uniform(chart):
        fields = _Stacked.of([first], num_stages + 1)
    elif _can_roll_in_room(unroll, chart, [first], num_stages):
        fields = _InRoom.of([first], chart.start, num_stages, num_stages + 1)
    if fields is None:
        return {}
    # Each after those that it begins with. The first has no flows.
    products = list(dict.fromkeys(rows[:n] for rows in stages for n in range(len(rows) + 1)))

    def body(carry: Any, x: _Flow) -> Any:
        points, fields = carry
        field = fields.field(fields.combination(x.row))
        point = chart.flow(field, fields.point(_at(points, x.source)))
        new = chosen(
            x.stage < num_stages,
            lambda: fields.entered(chart.frozen_after([field], x.c, point)),
            lambda: fields.kept(x.stage),
        )
        z = fields.coordinates(point)
        fields, new = fields.extended(new, z, x.stage)
        return (_put(points, x.target, z), fields.put(x.stage, new)), None

    start = fields.coordinates(chart.start)
    carry = _stack(start, len(products)), fields
    (points, fields), _ = over_stages(body, carry, _flows(products, stages, times))
    chart.start = fields.point(start)
    chart.fields[:] = [fields.at(k) for k in range(num_stages)]
    return {rows: fields.point(_at(points, k)) for k, rows in enumerate(products) if k}


def rolled_elements(
    unroll: bool | None,
    chart: Chart,
    known: Sequence[PyTree],
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    element: Callable[[PyTree, PyTree], PyTree],
    number: Callable[[PyTree], Real[Array, ""] | None],
) -> tuple[list[PyTree], Real[Array, ""] | None] | None:
    """The known stages k, and for each row and time c the stage `element(u, f)`; and the sum of the
    `number` of each u, or None.

    Here `u = sum_j row[j] k[j]`, and f is the field at time c and the point where u leads from the
    start. None where the field allows no loop, where `unroll` asks for none, and where it does not
    pay.
    """
    first, n = known[0], len(known) + len(rows)
    if len(rows) < 2 or not all(map(any, rows)):
        return None

    if can_roll(unroll, first, first) and is_uniform(chart):
        fields = _Stacked.of(known, n)
        made, total = _rolled_elements(chart, fields, len(known), rows, times, element, number)
        return [*known, *made[len(known) :]], total
    if not _can_roll_in_room(unroll, chart, known, n):
        return None
    # A bracket takes time as the third power of the room: less for the first ones.
    half = len(rows) // 2 if len(rows) > limits.MANY else 0
    for few in (slice(half), slice(half, None)) if half else (slice(None),):
        m = len(known) + len(rows[few])
        fields = _InRoom.of(known, chart.start, m, m)
        known, _ = _rolled_elements(chart, fields, len(known), rows[few], times[few], element)
    return list(known), None


def _rolled_elements(
    chart: Chart,
    fields: Any,
    num_known: int,
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    element: Callable[[PyTree, PyTree], PyTree],
    number: Callable[[PyTree], Real[Array, ""] | None] = lambda u: None,
) -> tuple[list[PyTree], Real[Array, ""] | None]:
    n = num_known + len(rows)

    def body(carry: Any, x: Any) -> Any:
        (fields, total), (k, row, c) = carry, x
        combination = fields.combination(row)
        u = fields.field(combination)
        point = chart.flow(u, chart.start)
        new = fields.entered(chart.frozen_after([u], c, point))
        fields, new = fields.extended(new, fields.coordinates(point), k)
        u = fields.field(combination)
        total = None if total is None else total + number(u)
        return (fields.put(k, element(u, new)), total), None

    turns = np.arange(num_known, n), _Row.of(rows, n), np.asarray(times, float)
    # Of zero, which varies along the axes of a mesh as the known ones do.
    zero = combine((0.0,), (fields.at(0),))
    (fields, total), _ = over_stages(body, (fields, number(zero)), turns)
    return [fields.at(k) for k in range(n)], total


class _Stacked(eqx.Module):
    """Fields that combine in the usual way, stacked along a new first axis of their arrays.

    Those that are not there yet are zero.
    """

    stacked: PyTree

    @classmethod
    def of(cls, known: Sequence[PyTree], n: int) -> "_Stacked":
        fields = cls(_stack(known[0], n))
        for k, field in enumerate(known[1:], 1):
            fields = fields.put(k, field)
        return fields

    def combination(self, row: "_Row") -> PyTree:
        """That of the first fields, as many as the row has entries."""
        return jtu.tree_map(lambda f: _combination(row, f), self.stacked)

    def field(self, combination: PyTree) -> PyTree:
        return combination

    def at(self, k: Any) -> PyTree:
        return _at(self.stacked, k)

    def put(self, k: Any, field: PyTree) -> "_Stacked":
        """With field k."""
        return _Stacked(_put(self.stacked, k, self.entered(field)))

    def point(self, z: PyTree) -> PyTree:
        return z

    def coordinates(self, point: PyTree) -> PyTree:
        """Of a point of the step, in arrays that do not grow."""
        return point

    def kept(self, k: Any) -> PyTree:
        """What `entered` returns, where no field is evaluated."""
        # Varying along the axes of a mesh as they do.
        return jtu.tree_map(lambda f: jnp.zeros_like(f[0]), self.stacked)

    def entered(self, field: PyTree) -> PyTree:
        """What to keep of a field that was evaluated."""
        return _like(self.kept(0), field)

    def extended(self, new: PyTree, z: PyTree, k: Any) -> tuple["_Stacked", PyTree]:
        """With room for field k, of which `new` is kept, frozen at the point z; and the field."""
        return self, new


class _InRoom(eqx.Module):
    """Fields with a chart of their own, which grows from stage to stage, by their coordinates in a
    room for all of them (`AbstractFrozenField.room`).
    """

    room: Any
    ks: Real[Array, "n m m"]

    @classmethod
    def of(cls, known: Sequence[Any], point: Any, num_fields: int, n: int) -> "_InRoom | None":
        """With room for some fields and coordinates of n; None where they offer no room."""
        room = known[-1].room(point, num_fields)
        if room is None:
            return None
        ks = [room.coordinates(field, point)[0] for field in known]
        return cls(room, jnp.zeros((n, *ks[0].shape), ks[0].dtype).at[: len(ks)].set(jnp.stack(ks)))

    def combination(self, row: "_Row") -> Array:
        return _combination(row, self.ks)

    def field(self, combination: Array) -> Any:
        return self.room.field(combination)

    def at(self, k: Any) -> Any:
        return self.room.field(_at(self.ks, k))

    def put(self, k: Any, field: Any) -> "_InRoom":
        return _InRoom(self.room, _put(self.ks, k, field.k))

    def point(self, z: Array) -> Any:
        return self.room.point(z)

    def coordinates(self, point: Any) -> Array:
        return jnp.pad(point.z, ((0, self.ks.shape[1] - len(point.z)), (0, 0)))

    def kept(self, k: Any) -> Any:
        return self.room.kept(k)

    def entered(self, field: Any) -> Any:
        return _like(self.room.kept(0), self.room.entered(field))

    def extended(self, new: Any, z: Array, k: Any) -> tuple["_InRoom", Any]:
        room, new = self.room.extended(new, z, k)
        return _InRoom(room, self.ks), room.field(new)


def _is_like(a: PyTree, b: PyTree) -> bool:
    return jtu.tree_structure(a) == jtu.tree_structure(b) and _types(a) == _types(b)


def _like(first: PyTree, value: PyTree) -> PyTree:
    # What was seen of the field before may not hold for every time.
    if not _is_like(first, value):
        raise TypeError(
            "The field must return frozen fields of one structure, shape and dtype at all stages "
            f"of a step, got {describe(first)} and {describe(value)}. With unroll=True the solver "
            "accepts other fields too."
        )
    # Only a weak type may be left over.
    return jtu.tree_map(lambda v, f: jnp.asarray(v, f.dtype), value, first)


def _stack(tree: PyTree, n: int) -> PyTree:
    """The first of n."""
    # Spread over a mesh as it is.
    pad = lambda x: [(0, n - 1, 0), *[(0, 0, 0)] * jnp.ndim(x)]  # noqa: E731
    return jtu.tree_map(lambda x: lax.pad(x[None], jnp.zeros((), x.dtype), pad(x)), tree)


def _combination(row: _Row, fields: Array) -> Array:
    fields = fields[: len(row.weights)]
    if jnp.size(fields[0]) <= limits.LARGE:
        return _sum(row, fields)
    return where_scalarised(lambda: _sum(row, fields), lambda: _product(row.weights, fields))


def _sum(row: _Row, fields: Array) -> Array:
    each = len(fields), *[1] * (fields.ndim - 1)
    terms = row.weights.astype(fields.dtype).reshape(each) * fields
    # Where the loop is unrolled, those that are zero are not there.
    terms = jnp.where(row.are_used.reshape(each), terms, jnp.zeros((), terms.dtype))
    return jnp.sum(terms, axis=0)


def _product(weights: Array, fields: Array) -> Array:
    """The same, faster for large fields."""
    if jnp.iscomplexobj(fields):
        return lax.complex(_product(weights, fields.real), _product(weights, fields.imag))
    product = matmul(weights.astype(fields.dtype), fields.reshape(len(weights), -1))
    return product.reshape(fields.shape[1:])


def _at(tree: PyTree, k: Any) -> PyTree:
    return jtu.tree_map(lambda x: lax.dynamic_index_in_dim(x, k, keepdims=False), tree)


def _put(tree: PyTree, k: Any, values: PyTree) -> PyTree:
    return jtu.tree_map(lambda x, v: lax.dynamic_update_index_in_dim(x, v, k, 0), tree, values)


def _types(tree: PyTree) -> list[tuple[tuple[int, ...], Any]]:
    return [(jnp.shape(x), jnp.result_type(x)) for x in jtu.tree_leaves(tree)]
