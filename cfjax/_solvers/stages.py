"""The stages of a step rolled into one loop, so that a program has the field and its flow once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree, Real

from .._field import AbstractFrozenField, combine, is_field
from .._methods.tableau import Product, Row
from .compiled import chosen, over_stages
from .stacked import (
    LARGE,
    MANY,
    Stacked,
    Weights,
    can_roll,
    cast_like,
    combination_of,
    entry,
    same_types,
    size_of,
    stack_with_zeros,
    with_entry,
)
from .step import Chart


def _can_roll_in_room(
    unroll: bool | None, chart: Chart, fields: Sequence[Any], num_stages: int
) -> bool:
    """Whether fields with a chart of their own have room for all stages.

    It compiles in a third of the time, and runs an eighth to a third longer.
    """
    field = fields[-1]
    if unroll or not is_field(field) or type(field).room is AbstractFrozenField.room:
        return False
    pays = unroll is False or size_of(chart.start) <= LARGE
    if not pays or any(x.span is not field.span for x in fields):
        return False
    room = field.room(chart.start, num_stages)
    return room is not None and _fits(room, chart, field)


def _fits(room: Any, chart: Chart, field: Any) -> bool:
    fits = False

    def trace() -> None:
        nonlocal fits
        k, z = room.coordinates(field, chart.start)
        second = chart.field(jnp.zeros(()), room.point(z), [room.field(k)])
        fits = type(second) is type(field) and same_types(room.kept(0), room.entered(second))

    jax.eval_shape(trace)
    return fits


def is_uniform(chart: Chart) -> bool:
    """Whether the field has one structure, and its arrays one shape and dtype, at all stages."""
    second = jax.eval_shape(lambda: chart.field(jnp.zeros(()), chart.start, [chart.first_field]))
    return same_types(chart.first_field, second)


class _Flow(NamedTuple):
    """A flow of a step: from which point, along which combination of the fields, to which point,
    and the stage that is evaluated there, with its time. A point without a stage has the number
    after the last one.
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
    index = {product: k for k, product in enumerate(products)}
    stage_of = {rows: k for k, rows in enumerate(stages[:-1])}
    flows = []
    for target, product in enumerate(products[1:], 1):
        stage = stage_of.get(product, len(times))
        c = float(times[stage]) if product in stage_of else 0.0
        flows.append(_Flow(index[product[:-1]], product[-1], target, stage, c))
    source, weights, target, stage, c = zip(*flows, strict=True)
    rows = Weights.of(weights, len(times))
    return _Flow(np.asarray(source), rows, *map(np.asarray, (target, stage, c)))


class Stages(NamedTuple):
    """The coordinates of a step, the fields of its stages, and where products of flows lead."""

    chart: Chart
    fields: list[PyTree]
    points: dict[Product, PyTree]


def rolled(
    unroll: bool | None, chart: Chart, stages: Sequence[Product], times: Row
) -> Stages | None:
    """The stages of a step in one loop.

    `stages` are the products of flows that lead to the stages, each to a point of its own, and to
    the end; `times` are the times of the stages. None where the field allows no loop, where
    `unroll` asks for none, and where it does not pay.
    """
    first, num_stages = chart.first_field, len(times)
    fields: Any = None
    # One more for the flows that lead to no stage.
    if can_roll(unroll, first, chart.start) and is_uniform(chart):
        fields = Stacked.of([first], num_stages + 1)
    elif _can_roll_in_room(unroll, chart, [first], num_stages):
        fields = _InRoom.of([first], chart.start, num_stages, num_stages + 1)
    if fields is None:
        return None
    # Each after its prefixes. The first has no flows.
    products = list(dict.fromkeys(rows[:n] for rows in stages for n in range(len(rows) + 1)))

    def body(carry: Any, x: _Flow) -> Any:
        points, fields = carry
        field = fields.field(fields.combination(x.row))
        point = chart.flow(field, fields.point(entry(points, x.source)))
        new = chosen(
            x.stage < num_stages,
            lambda: fields.stored(chart.field(x.c, point, [field])),
            lambda: fields.placeholder(x.stage),
        )
        z = fields.coordinates(point)
        fields, new = fields.enlarged(new, z, x.stage)
        return (with_entry(points, x.target, z), fields.put(x.stage, new)), None

    start = fields.coordinates(chart.start)
    carry = stack_with_zeros(start, len(products)), fields
    (points, fields), _ = over_stages(body, carry, _flows(products, stages, times))
    return Stages(
        chart._replace(start=fields.point(start)),
        [fields.at(k) for k in range(num_stages)],
        {rows: fields.point(entry(points, k)) for k, rows in enumerate(products) if k},
    )


def rolled_elements(
    unroll: bool | None,
    chart: Chart,
    stages: Sequence[PyTree],
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    element: Callable[[PyTree, PyTree], PyTree],
    zero_of: Callable[[PyTree], Real[Array, ""] | None],
) -> tuple[list[PyTree], Real[Array, ""] | None, Stacked | None] | None:
    """The `stages` k, and for each row and time c a further stage `element(u, f)`; the sum of
    `zero_of(u)` over all u, or None; and all stages stacked, or None.

    Here `u = sum_j row[j] k[j]`, and f is the field at time c and the point where u leads from the
    start. None where the field allows no loop, where `unroll` asks for none, and where it does not
    pay.
    """
    first, n = stages[0], len(stages) + len(rows)
    if len(rows) < 2 or not all(map(any, rows)):
        return None

    if can_roll(unroll, first, first) and is_uniform(chart):
        fields = Stacked.of(stages, n)
        fields, total = _rolled_elements(chart, fields, len(stages), rows, times, element, zero_of)
        return [*stages, *map(fields.at, range(len(stages), n))], total, fields
    if not _can_roll_in_room(unroll, chart, stages, n):
        return None
    # The time of a bracket grows with the cube of the room: the first ones get a smaller room.
    half = len(rows) // 2 if len(rows) > MANY else 0
    for chunk in (slice(half), slice(half, None)) if half else (slice(None),):
        m = len(stages) + len(rows[chunk])
        fields = _InRoom.of(stages, chart.start, m, m)
        fields, _ = _rolled_elements(chart, fields, len(stages), rows[chunk], times[chunk], element)
        stages = [fields.at(k) for k in range(m)]
    return list(stages), None, None


def _rolled_elements(
    chart: Chart,
    fields: Any,
    num_stages: int,
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    element: Callable[[PyTree, PyTree], PyTree],
    zero_of: Callable[[PyTree], Real[Array, ""] | None] = lambda u: None,
) -> tuple[Any, Real[Array, ""] | None]:
    n = num_stages + len(rows)

    def body(carry: Any, x: Any) -> Any:
        (fields, total), (k, row, c) = carry, x
        combination = fields.combination(row)
        u = fields.field(combination)
        point = chart.flow(u, chart.start)
        new = fields.stored(chart.field(c, point, [u]))
        fields, new = fields.enlarged(new, fields.coordinates(point), k)
        u = fields.field(combination)
        total = None if total is None else total + zero_of(u)
        return (fields.put(k, element(u, new)), total), None

    xs = np.arange(num_stages, n), Weights.of(rows, n), np.asarray(times, float)
    # Computed, as it must vary along the axes of a mesh as the fields do.
    zero = combine((0.0,), (fields.at(0),))
    (fields, total), _ = over_stages(body, (fields, zero_of(zero)), xs)
    return fields, total


class _InRoom(eqx.Module):
    """Fields with a chart of their own, which grows from stage to stage, by their coordinates in a
    room for all of them (`AbstractFrozenField.room`).
    """

    room: Any
    ks: Real[Array, "n m m"]

    @classmethod
    def of(cls, fields: Sequence[Any], point: Any, num_fields: int, n: int) -> "_InRoom | None":
        """With room for some fields and coordinates of n; None where they offer no room."""
        room = fields[-1].room(point, num_fields)
        if room is None:
            return None
        ks = [room.coordinates(field, point)[0] for field in fields]
        return cls(room, jnp.zeros((n, *ks[0].shape), ks[0].dtype).at[: len(ks)].set(jnp.stack(ks)))

    def combination(self, row: Weights) -> Array:
        return combination_of(row, self.ks)

    def field(self, combination: Array) -> Any:
        return self.room.field(combination)

    def at(self, k: Any) -> Any:
        return self.room.field(entry(self.ks, k))

    def put(self, k: Any, field: Any) -> "_InRoom":
        return _InRoom(self.room, with_entry(self.ks, k, field.k))

    def point(self, z: Array) -> Any:
        return self.room.point(z)

    def coordinates(self, point: Any) -> Array:
        return jnp.pad(point.z, ((0, self.ks.shape[1] - len(point.z)), (0, 0)))

    def placeholder(self, k: Any) -> Any:
        return self.room.kept(k)

    def stored(self, field: Any) -> Any:
        return cast_like(self.room.kept(0), self.room.entered(field))

    def enlarged(self, new: Any, z: Array, k: Any) -> tuple["_InRoom", Any]:
        room, new = self.room.enlarged(new, z, k)
        return _InRoom(room, self.ks), room.field(new)
