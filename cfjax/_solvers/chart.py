"""The coordinates of a step: its frozen fields, and where their flows lead."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real

from .._field import Rest, flow, from_chart, is_field, to_chart
from .compensation import at, with_sums
from .compiled import (
    invariant,
    materialised_if_long,
    materialised_in_rows,
    materialised_together,
)


class Chart:
    """Evaluates the frozen field at points of one step, and carries points along flows.

    A part of a point is in the coordinates that its field chooses
    (`AbstractFrozenField.to_chart`). If the state is a compensated sum there, it is the increment
    from the start of the step. Solvers need not know which.

    `start` is the point where all flows of the step begin. The first evaluation may change it, to
    correct a drift of the state. `fields` are the fields so far, in the order of evaluation.
    `field(c, y)` is `h f(t + c h, y)` at a state y, as the term returns it.
    """

    def __init__(
        self,
        field: Callable[[Any, PyTree], PyTree],
        y0: PyTree,
        compensation: PyTree = None,
    ):
        self.field = field
        self._y0 = y0
        self._compensation = compensation
        self.start = with_sums(lambda c, y: y if c is None else jnp.zeros_like(y), compensation, y0)
        self.fields: list[PyTree] = []

    @classmethod
    def at_path(
        cls, field: Callable[[Any, PyTree], PyTree], start: PyTree, fields: Sequence[PyTree]
    ) -> "Chart":
        """That of a step that has been made, without sums: for output within it."""
        chart = cls(field, start)
        chart.fields = list(fields)
        return chart

    def frozen(self, c: float | Real[Array, ""], point: PyTree) -> PyTree:
        """The field at a point of the step, `h f(t + c h, point)`, which joins `fields`."""
        field, here = self._frozen(c, point, self.fields)
        if not self.fields:
            self.start = with_sums(
                lambda c, z, p: p if c is None else z, self._compensation, self.start, here
            )
        self.fields.append(field)
        return field

    def frozen_after(
        self, earlier: Sequence[PyTree], c: float | Real[Array, ""], point: PyTree
    ) -> PyTree:
        """The same, but `fields` stays as it is: for a loop, which keeps them elsewhere."""
        return self._frozen(c, point, earlier)[0]

    def _frozen(self, c: Any, point: PyTree, earlier: Sequence[PyTree]) -> tuple[PyTree, ...]:
        here = self.without_sums(point) if earlier else self._y0
        y = from_chart(earlier[0], here) if earlier else here
        return to_chart(self.field(c, y), here, earlier)

    def flow(self, field: PyTree, point: PyTree) -> PyTree:
        """Where a combination of `fields` carries `point` in unit time."""

        if self._compensation is None:
            return carried(field, point)

        def part(f: Any, p: PyTree, y: Array | None) -> PyTree:
            return carried(f, p) if y is None else materialised_in_rows(p + f.increment(y + p))

        starts = with_sums(lambda c, y: None if c is None else y, self._compensation, self._y0)
        return jtu.tree_map(part, field, point, starts, is_leaf=is_field)

    def without_sums(self, point: PyTree) -> PyTree:
        """The same point, still in the coordinates of the fields, with increments added up."""
        return at(self._y0, point, self._compensation)

    def from_start(self, point: PyTree) -> PyTree:
        """The state at a point, or its increment from the start where it is a compensated sum."""
        return from_chart(self.fields[0], point)

    def state(self, point: PyTree) -> PyTree:
        """The state at a point."""
        return at(self._y0, self.from_start(point), self._compensation)

    def difference(self, a: PyTree, b: PyTree) -> PyTree:
        """How far two points are apart in the ambient space."""
        return jtu.tree_map(jnp.subtract, self.from_start(a), self.from_start(b))

    def way(self, end: PyTree) -> PyTree:
        """How far the end of the step, as `from_start` returns it, is from the start."""
        return with_sums(
            lambda c, y, z: jtu.tree_map(jnp.subtract, z, y) if c is None else z,
            self._compensation,
            self._y0,
            end,
        )

    def shared(self, tree: PyTree) -> PyTree:
        """The same arrays, of each of which several results are made.

        XLA computes them once then, and not anew for each result.
        """
        return materialised_together(tree)

    def constant(self, tree: PyTree) -> PyTree:
        """The same arrays, which in equal steps mostly do not change from step to step.

        Where they do not, the loop of equal steps computes them once.
        """
        return invariant(tree)

    def branching(self, point: PyTree) -> PyTree:
        """The same point, where the field is evaluated and from where flows go on.

        Otherwise XLA would compute flows that are arithmetic entry by entry anew for each of both,
        back to the start.
        """

        def part(f: Any, p: PyTree) -> PyTree:
            return materialised_in_rows(p, alone=True) if is_field(f) and f.is_entrywise else p

        return jtu.tree_map(part, self.fields[0], point, is_leaf=is_field)

    def narrow(self, point: PyTree) -> PyTree:
        """The same point, on which all depends that follows: where a long step may be cut."""
        return materialised_if_long(point)


def carried(field: PyTree, point: PyTree) -> PyTree:
    """`flow(field, point)`, computed once: with leading axes neighbours would compute it anew."""
    return jtu.tree_map(
        lambda f, p: materialised_in_rows(flow(f, p)) if is_field(f) else flow(f, p),
        field,
        point,
        is_leaf=is_field,
    )


def flow_at(field: PyTree, y: PyTree) -> PyTree:
    """Where a field that is frozen at the state y carries it."""
    field, point = to_chart(field, y, ())
    return from_chart(field, carried(field, point))


def moved(field: PyTree, z: PyTree, y0: PyTree, compensation: PyTree) -> PyTree:
    """Where a field carries a state, of which compensated sums are increments from y0."""

    def part(f: Any, z: PyTree, c: PyTree, y0: PyTree) -> PyTree:
        if not is_field(f):
            return z + f
        if isinstance(f, Rest):
            return z
        return z + f.increment(y0 + z) if isinstance(c, jax.Array) else flow_at(f, z)

    moved = jtu.tree_map(part, field, z, compensation, y0, is_leaf=is_field)
    return materialised_in_rows(moved, alone=True)
