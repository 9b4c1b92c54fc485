"""The stages of a step as one loop, so that a program has the field and its flow once."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._field import AbstractFrozenField, Incremented, flow, is_field, is_incremented
from .._fields.elementwise import Elementwise
from .._xla import is_rewritten, pack, table

# A loop copies the fields of all stages in each of its turns. For a dense matrix of more entries
# that moves a vector, this takes longer than the flow.
_SMALL = 100

# Of a point in coordinates of the step, with its columns. Where a loop is differentiated, it keeps
# those of all stages for each of its turns.
_SMALL_STEP = 2048

# JAX traces anew where it changes.
_is_written_out = jax.make_user_context(False)


def written_out() -> contextlib.AbstractContextManager:
    """Within, no stages are traced as a loop: every flow is seen, and counted, on its own."""
    return _is_written_out(True)


class Flow(NamedTuple):
    """One flow of a step: from which point, along which combination of the fields, to which point;
    and the stage that is evaluated there, if any, with its time.
    """

    source: int
    row: Sequence[Any]
    target: int
    stage: int | None
    c: float


class FieldVaries(Exception):
    """The field has not one structure, shape and dtype at all stages."""


def can_loop(field: PyTree, point: PyTree, is_long: bool = False) -> bool:
    """Whether a loop over the stages pays: where there are flows, written for one point as for all.

    A step that is rewritten for XLA is faster written out, if it is not too long for that. So are
    fields that combine in a way of their own or work in coordinates of the step, whose arrays grow
    from stage to stage, and fields of far more numbers than the point has.
    """
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    return (
        (is_long or not is_rewritten())
        and not _is_written_out.value
        and any(map(is_field, parts))
        and _size(field) <= max(_SMALL, 4 * _size(point))
        and is_plain(field)
    )


def has_room(field: PyTree, point: PyTree) -> bool:
    """Whether a loop pays in coordinates of the step: for one small field that has room for others.

    It compiles in a third of the time, and runs an eighth to a third longer.
    """
    return (
        not is_rewritten()
        and not _is_written_out.value
        and is_field(field)
        and _size(point) <= _SMALL_STEP
        and type(field).room is not AbstractFrozenField.room
    )


def _size(tree: PyTree) -> int:
    return sum(jnp.size(x) for x in jtu.tree_leaves(tree))


def is_plain(field: PyTree) -> bool:
    """Whether its parts combine in the usual way and have no coordinates of a step."""
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    return all(_is_plain(part) for part in parts if is_field(part))


def _is_plain(field: AbstractFrozenField) -> bool:
    cls: Any = type(field.field if isinstance(field, Elementwise) else field)
    usual: Any = AbstractFrozenField
    return (
        cls.combine.__func__ is usual.combine.__func__
        and cls.enter is usual.enter
        and cls.leave is usual.leave
    )


def elements(
    known: Sequence[PyTree],
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    element: Callable[[Real[Array, ""], PyTree], PyTree],
) -> list[PyTree]:
    """After the known stages k, for each row and time c the stage `element(c, sum_j row[j] k[j])`.

    **Raises** `FieldVaries` as `run`.
    """
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


def elements_in_room(
    known: Sequence[Any],
    rows: Sequence[Sequence[Any]],
    times: Sequence[float],
    start: Any,
    field: Callable[[Real[Array, ""], Any, Any], Any],
    element: Callable[[Any, Any], Any],
) -> list[Any]:
    """As `elements`, for a field whose coordinates of a step grow from stage to stage.

    `field(c, here, earlier)` has entered at `here`, where the fields `earlier` have; the element is
    made of the combination that leads there from `start`, and of it.

    **Raises** `FieldVaries` where they cannot be in one array each.
    """
    if not rows:
        return list(known)
    first, n = known[-1], len(known) + len(rows)
    if any(x.span is not first.span for x in known):
        raise FieldVaries
    room = first.room(start, n)
    if room is None:
        raise FieldVaries

    def body(carry: Any, x: Any) -> Any:
        room, stages = carry
        k, row, c = x
        u = _combination(row, stages)
        along = room.field(u)
        here = flow(along, start)
        entered = field(c, here, [along])
        if type(entered) is not type(first):
            raise FieldVaries
        room, new = room.extended(_like(room.kept(k), room.entered(entered)), here.z, k)
        return (room, _put(stages, k, element(room.field(u), room.field(new)).k)), None

    ks = [room.coordinates(x, start)[0] for x in known]
    stages = jnp.zeros((n, *ks[0].shape), ks[0].dtype).at[: len(ks)].set(jnp.stack(ks))
    xs = jnp.arange(len(known), n), _padded(rows, n), jnp.asarray(times)
    (room, stages), _ = lax.scan(body, (room, stages), xs)
    return [room.field(stages[k]) for k in range(n)]


def along(weights: Real[Array, "flows stages"], fields: Sequence[PyTree], point: PyTree) -> PyTree:
    """Where flows of combinations of the first fields lead, that of the first row first."""
    # XLA computes what leads to each of the arrays that `jnp.stack` gets for itself.
    stages = jtu.tree_map(lambda *leaves: pack(leaves), *fields[: weights.shape[1]])

    def body(point: PyTree, row: Array) -> Any:
        return flow(jtu.tree_map(lambda f: _combination(row, f), stages), point), None

    # A weak type would be lost on the way.
    start = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x)), point)
    return lax.scan(body, start, weights)[0]


def run(
    flows: Sequence[Flow],
    num_stages: int,
    first: PyTree,
    start: PyTree,
    field: Callable[[Real[Array, ""], PyTree, PyTree], PyTree],
) -> tuple[list[PyTree], list[PyTree]]:
    """The points of a step, of which `start` is the first, and its fields, of which `first` is.

    `field(c, here, earlier)` has entered, where the field `earlier` has.

    **Raises** `FieldVaries` where they cannot be in one array each.
    """
    if not is_plain(first):
        return _run_in_room(flows, num_stages, first, start, field)
    moving, rest = _stripped(start)

    def body(carry: Any, x: Any) -> Any:
        points, fields = carry
        source, row, target, stage, c = x
        along = jtu.tree_map(lambda f: _combination(row, f[:num_stages]), fields)
        point = flow(along, _dressed(_at(points, source), rest))

        value = lax.cond(
            stage < num_stages,
            lambda: _like(first, field(c, point, first)),
            lambda: jtu.tree_map(jnp.zeros_like, first),
        )
        return (_put(points, target, _stripped(point)[0]), _put(fields, stage, value)), None

    # One more row for what is no stage.
    carry = _stack(moving, len(flows) + 1), _stack(first, num_stages + 1)
    (points, fields), _ = lax.scan(body, carry, _turns(flows, num_stages))
    return (
        [_dressed(_at(points, k), rest) for k in range(len(flows) + 1)],
        [_at(fields, k) for k in range(num_stages)],
    )


def _run_in_room(
    flows: Sequence[Flow],
    num_stages: int,
    first: AbstractFrozenField,
    start: Any,
    field: Callable[[Real[Array, ""], Any, Any], Any],
) -> tuple[list[Any], list[Any]]:
    """The same for a field whose coordinates of a step grow from stage to stage."""
    room = first.room(start, num_stages)
    if room is None:
        raise FieldVaries

    def body(carry: Any, x: Any) -> Any:
        room, points, fields = carry
        source, row, target, stage, c = x
        along = room.field(_combination(row, fields[:num_stages]))
        here = flow(along, room.point(_at(points, source)))

        def evaluated() -> Any:
            entered = field(c, here, along)
            if type(entered) is not type(first):
                raise FieldVaries
            return _like(room.kept(stage), room.entered(entered))

        new = lax.cond(stage < num_stages, evaluated, lambda: room.kept(stage))
        room, entered = room.extended(new, here.z, stage)
        return (room, _put(points, target, here.z), _put(fields, stage, entered)), None

    k, z = room.coordinates(first, start)
    carry = room, _stack(z, len(flows) + 1), _stack(k, num_stages + 1)
    (room, points, fields), _ = lax.scan(body, carry, _turns(flows, num_stages))
    return (
        [room.point(points[k]) for k in range(len(flows) + 1)],
        [room.field(fields[k]) for k in range(num_stages)],
    )


def _turns(flows: Sequence[Flow], num_stages: int) -> tuple[Array, ...]:
    return (
        jnp.asarray([f.source for f in flows]),
        _padded([f.row for f in flows], num_stages),
        jnp.asarray([f.target for f in flows]),
        jnp.asarray([num_stages if f.stage is None else f.stage for f in flows]),
        jnp.asarray([f.c for f in flows]),
    )


def _padded(rows: Sequence[Sequence[Any]], n: int) -> Array:
    return jnp.asarray([[*map(float, row), *[0.0] * (n - len(row))] for row in rows])


def _like(first: PyTree, value: PyTree) -> PyTree:
    if jtu.tree_structure(value) != jtu.tree_structure(first) or _types(value) != _types(first):
        # It may be an error, and is one in words where the stages are written out.
        raise FieldVaries
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


def _stripped(point: PyTree) -> tuple[PyTree, PyTree]:
    """What differs between the points of a step, and what does not: starts of increments."""
    leaves = lambda f: jtu.tree_map(f, point, is_leaf=is_incremented)  # noqa: E731
    return (
        leaves(lambda p: p.increment if is_incremented(p) else p),
        leaves(lambda p: p.start if is_incremented(p) else None),
    )


def _dressed(moving: PyTree, rest: PyTree) -> PyTree:
    return jtu.tree_map(
        lambda start, p: p if start is None else Incremented(start, p),
        rest,
        moving,
        is_leaf=lambda x: x is None,
    )
