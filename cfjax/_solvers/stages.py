"""The stages of a step rolled into one loop, so that a program has the field and its flow once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._field import AbstractFrozenField, describe, is_field
from .._fields.elementwise import Elementwise
from .._methods.tableau import Product, Row
from .._xla import is_rewritten, pack, table
from .chart import Chart

# A loop copies the fields of all stages in each of its turns. For a dense matrix of more entries
# that moves a vector, this takes longer than the flow.
_SMALL = 100

# Of a point in the chart of a field, with its columns. Where a loop is differentiated, it keeps
# those of all stages for each of its turns.
_SMALL_STEP = 2048


def can_roll(unroll: bool | None, field: PyTree, point: PyTree, is_long: bool = False) -> bool:
    """Whether flows of combinations of such fields may be one loop, and where `unroll` is None
    whether that pays.

    Fields must combine in the usual way and have no chart of their own. A step that is rewritten
    for XLA is faster unrolled, if it is not too long for that, and so are fields of far more
    numbers than the point has.
    """
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    is_possible = any(map(is_field, parts)) and is_plain(field)
    if unroll is not None:
        return is_possible and not unroll
    pays = is_long or not is_rewritten()
    return is_possible and pays and _size(field) <= max(_SMALL, 4 * _size(point))


def can_roll_stages(unroll: bool | None, chart: Chart, num_stages: int) -> bool:
    """The same of stages that are evaluated at points of the step, of which the first one is known.

    A field with a chart of its own is rolled if it offers room for the coordinates of all stages.
    """
    first = chart.fields[0]
    if is_plain(first):
        return can_roll(unroll, first, chart.start) and is_uniform(chart)
    return can_roll_in_room(unroll, chart, [first], num_stages)


def can_roll_in_room(
    unroll: bool | None, chart: Chart, known: Sequence[Any], num_stages: int
) -> bool:
    """Whether a field with a chart of its own has room for all stages, after those known.

    It compiles in a third of the time, and runs an eighth to a third longer.
    """
    first = known[-1]
    if unroll or not is_field(first) or type(first).room is AbstractFrozenField.room:
        return False
    pays = unroll is False or (not is_rewritten() and _size(chart.start) <= _SMALL_STEP)
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


def is_plain(field: PyTree) -> bool:
    """Whether its parts combine in the usual way and have no chart of their own."""
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    return all(_is_plain(part) for part in parts if is_field(part))


def _is_plain(field: AbstractFrozenField) -> bool:
    cls: Any = type(field.field if isinstance(field, Elementwise) else field)
    usual: Any = AbstractFrozenField
    return (
        cls.combine.__func__ is usual.combine.__func__
        and cls.to_chart is usual.to_chart
        and cls.from_chart is usual.from_chart
    )


def rolled_elements(
    known: Sequence[PyTree],
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    element: Callable[[Real[Array, ""], PyTree], PyTree],
) -> list[PyTree]:
    """The known stages k, and for each row and time c `element(c, sum_j row[j] k[j])`."""
    first, n = known[0], len(known) + len(rows)
    weights = _padded(rows, n)
    made = table(
        lambda c, along: _like(first, element(c, along)), known, weights, jnp.asarray(times)
    )
    if made is not None:
        return made

    def body(stages: PyTree, x: Any) -> Any:
        k, row, c = x
        along = jtu.tree_map(lambda f: _combination(row, f), stages)
        return _put(stages, k, _like(first, element(c, along))), None

    xs = jnp.arange(len(known), n), weights, jnp.asarray(times)
    start = _stack(first, n)
    for k, stage in enumerate(known[1:], 1):
        start = _put(start, k, _like(first, stage))
    stages, _ = lax.scan(body, start, xs)
    return [*known, *(_at(stages, k) for k in range(len(known), n))]


def rolled_elements_in_room(
    known: Sequence[Any],
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    chart: Chart,
    element: Callable[[Any, Any], Any],
) -> list[Any]:
    """The same for a field with a chart of its own, which grows from stage to stage.

    The stage is `element(u, field)` of the combination u that leads to the point of the field.
    """
    if not rows:
        return list(known)
    first, n = known[-1], len(known) + len(rows)
    room = first.room(chart.start, n)

    def body(carry: Any, x: Any) -> Any:
        room, stages = carry
        k, row, c = x
        u = _combination(row, stages)
        along = room.field(u)
        here = chart.flow(along, chart.start)
        entered = chart.frozen_after([along], c, here)
        room, new = room.extended(_like(room.kept(k), room.entered(entered)), here.z, k)
        return (room, _put(stages, k, element(room.field(u), room.field(new)).k)), None

    ks = [room.coordinates(x, chart.start)[0] for x in known]
    stages = jnp.zeros((n, *ks[0].shape), ks[0].dtype).at[: len(ks)].set(jnp.stack(ks))
    xs = jnp.arange(len(known), n), _padded(rows, n), jnp.asarray(times)
    (room, stages), _ = lax.scan(body, (room, stages), xs)
    return [room.field(stages[k]) for k in range(n)]


def rolled_flows(
    weights: Real[Array, "flows stages"],
    fields: Sequence[PyTree],
    point: PyTree,
    flow: Callable[[PyTree, PyTree], PyTree],
) -> PyTree:
    """Where flows of combinations of the first fields lead, that of the first row first."""
    # XLA computes what leads to each of the arrays that `jnp.stack` gets for itself.
    stages = jtu.tree_map(lambda *leaves: pack(leaves), *fields[: weights.shape[1]])

    def body(point: PyTree, row: Array) -> Any:
        return flow(jtu.tree_map(lambda f: _combination(row, f), stages), point), None

    # A weak type would be lost on the way.
    start = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x)), point)
    return lax.scan(body, start, weights)[0]


class _Flow(NamedTuple):
    """One flow of a step: from which point, along which combination of the fields, to which point;
    and the stage that is evaluated there, if any, with its time.
    """

    source: int
    row: Row
    target: int
    stage: int | None
    c: float


def _flows(products: Sequence[Product], stages: Sequence[Product], times: Row) -> list[_Flow]:
    """The flows of a step, each to a point of its own; the last of `stages` is its end."""
    found = {product: k for k, product in enumerate(products)}
    evaluated = {rows: k for k, rows in enumerate(stages[:-1])}
    flows = []
    for product in products[1:]:
        stage = evaluated.get(product)
        c = float(times[stage]) if stage is not None else 0.0
        flows.append(_Flow(found[product[:-1]], product[-1], found[product], stage, c))
    return flows


def rolled(chart: Chart, stages: Sequence[Product], times: Row) -> dict[Product, PyTree]:
    """The points of a step, of which the first field is known; `chart` gets all its fields.

    `stages` are the products of flows that lead to the stages, each to a point of its own, and to
    the end; `times` are the times of the stages.
    """
    # Each after those that it begins with. The first has no flows.
    products = list(dict.fromkeys(rows[:n] for rows in stages for n in range(len(rows) + 1)))
    flows = _flows(products, stages, times)
    run = _rolled if is_plain(chart.fields[0]) else _rolled_in_room
    return dict(zip(products[1:], run(chart, flows, len(times)), strict=True))


def _rolled(chart: Chart, flows: Sequence[_Flow], num_stages: int) -> list[PyTree]:
    first, start = chart.fields[0], chart.start

    def body(carry: Any, x: Any) -> Any:
        points, fields = carry
        source, row, target, stage, c = x
        along = jtu.tree_map(lambda f: _combination(row, f[:num_stages]), fields)
        point = chart.flow(along, _at(points, source))
        field = lax.cond(
            stage < num_stages,
            lambda: _like(first, chart.frozen_after([first], c, point)),
            lambda: jtu.tree_map(jnp.zeros_like, first),
        )
        return (_put(points, target, point), _put(fields, stage, field)), None

    # One more row for the flows that lead to no stage.
    carry = _stack(start, len(flows) + 1), _stack(first, num_stages + 1)
    (points, fields), _ = lax.scan(body, carry, _turns(flows, num_stages))
    chart.fields[:] = [_at(fields, k) for k in range(num_stages)]
    return [_at(points, k + 1) for k in range(len(flows))]


def _rolled_in_room(chart: Chart, flows: Sequence[_Flow], num_stages: int) -> list[Any]:
    """The same for a field with a chart of its own, which grows from stage to stage."""
    first: Any = chart.fields[0]
    room = first.room(chart.start, num_stages)

    def body(carry: Any, x: Any) -> Any:
        room, points, fields = carry
        source, row, target, stage, c = x
        along = room.field(_combination(row, fields[:num_stages]))
        here = chart.flow(along, room.point(_at(points, source)))

        def evaluated() -> Any:
            return _like(room.kept(stage), room.entered(chart.frozen_after([along], c, here)))

        new = lax.cond(stage < num_stages, evaluated, lambda: room.kept(stage))
        room, entered = room.extended(new, here.z, stage)
        return (room, _put(points, target, here.z), _put(fields, stage, entered)), None

    k, z = room.coordinates(first, chart.start)
    carry = room, _stack(z, len(flows) + 1), _stack(k, num_stages + 1)
    (room, points, fields), _ = lax.scan(body, carry, _turns(flows, num_stages))
    chart.start = room.point(points[0])
    chart.fields[:] = [room.field(fields[k]) for k in range(num_stages)]
    return [room.point(points[k + 1]) for k in range(len(flows))]


def _turns(flows: Sequence[_Flow], num_stages: int) -> tuple[Array, ...]:
    return (
        jnp.asarray([f.source for f in flows]),
        _padded([f.row for f in flows], num_stages),
        jnp.asarray([f.target for f in flows]),
        jnp.asarray([num_stages if f.stage is None else f.stage for f in flows]),
        jnp.asarray([f.c for f in flows]),
    )


def _padded(rows: Sequence[Sequence[Any]], n: int) -> Array:
    return jnp.asarray([[*map(float, row), *[0.0] * (n - len(row))] for row in rows])


def _is_like(a: PyTree, b: PyTree) -> bool:
    return jtu.tree_structure(a) == jtu.tree_structure(b) and _types(a) == _types(b)


def _like(first: PyTree, value: PyTree) -> PyTree:
    # What was seen of the field before may not hold for every time.
    if not _is_like(first, value):
        raise TypeError(
            "The field must return frozen fields of one structure, shape and dtype at all stages "
            f"of a step, got {describe(first)} and {describe(value)}. With unroll=True the solver "
            "takes others too."
        )
    # Only a weak type may be left over.
    return jtu.tree_map(lambda v, f: jnp.asarray(v, f.dtype), value, first)


def _stack(tree: PyTree, n: int) -> PyTree:
    """The first of n."""
    # Spread over a mesh as it is.
    pad = lambda x: [(0, n - 1, 0), *[(0, 0, 0)] * jnp.ndim(x)]  # noqa: E731
    return jtu.tree_map(lambda x: lax.pad(x[None], jnp.zeros((), x.dtype), pad(x)), tree)


def _combination(row: Array, fields: Array) -> Array:
    weights = row.astype(fields.dtype).reshape(-1, *[1] * (fields.ndim - 1))
    return jnp.sum(weights * fields, axis=0)


def _at(tree: PyTree, k: Any) -> PyTree:
    return jtu.tree_map(lambda x: lax.dynamic_index_in_dim(x, k, keepdims=False), tree)


def _put(tree: PyTree, k: Any, values: PyTree) -> PyTree:
    return jtu.tree_map(lambda x, v: lax.dynamic_update_index_in_dim(x, v, k, 0), tree, values)


def _types(tree: PyTree) -> list[tuple[tuple[int, ...], Any]]:
    return [(jnp.shape(x), jnp.result_type(x)) for x in jtu.tree_leaves(tree)]
