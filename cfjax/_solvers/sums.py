"""The state as a sum: of its start in a step, and increments that are too small to change it.

Rounding the state after every flow makes lengths, orthogonality and the like drift as a random
walk. Where a field offers increments (`AbstractFrozenField.increment`), a step adds up these, and
the sum over the steps keeps what rounding has cut off: the compensation. (Hairer, Lubich & Wanner,
Geometric Numerical Integration, Section VIII.5.) It costs small vectors a tenth of the time.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree

from .._field import Rest, flow, from_chart, is_field, to_chart
from .compiled import computed_once, materialised_together


class Sums(NamedTuple):
    """The state where a step starts, and which parts of it are compensated sums.

    A point of the step is shaped like the state. A part that is such a sum has the increment from
    the start there, any other part the state, in the chart of its field.

    `compensation` is a pytree like the field of a step, with an array for each sum and None for
    every other part.
    """

    y0: PyTree
    compensation: PyTree = None

    @classmethod
    def of(cls, field: PyTree, y0: PyTree) -> "Sums":
        """The sums of the first step: zeros where `field` offers increments and has no chart."""

        def part(f: Any, y: PyTree) -> Array | None:
            is_array = is_field(f) and jtu.all_leaves([y])
            # In a chart of the field's own the point is another.
            is_sum = is_array and f.increment(y) is not None and f.to_chart(y, ())[1] is y
            return jnp.zeros_like(y) if is_sum else None

        return cls(y0, jtu.tree_map(part, field, y0, is_leaf=is_field))

    def map(self, fun: Callable[..., Any], *trees: PyTree) -> PyTree:
        """`fun(c, y0, *parts)` for each part of the state: c is None unless it is a sum."""
        is_none = lambda x: x is None  # noqa: E731
        return jtu.tree_map(fun, self.compensation, self.y0, *trees, is_leaf=is_none)

    def zeros(self) -> PyTree:
        """The compensation before the first step: like the state, which may be on a mesh."""
        return self.map(lambda c, y: None if c is None else jnp.zeros_like(y))

    @property
    def start(self) -> PyTree:
        """The point where the step starts."""
        return self.map(lambda c, y: y if c is None else jnp.zeros_like(y))

    def state(self, point: PyTree) -> PyTree:
        """The same point with its increments added up, still in the coordinates of the field."""
        return self.map(lambda c, y, z: z if c is None else y + z, point)

    def displacement(self, end: PyTree) -> PyTree:
        """How far the end of the step is from its start."""
        return self.map(lambda c, y, z: jtu.tree_map(jnp.subtract, z, y) if c is None else z, end)

    def to_chart(
        self, field: PyTree, point: PyTree, earlier: Sequence[PyTree] = ()
    ) -> tuple[PyTree, PyTree]:
        """A field that is frozen at a point, and the point, in the chart of the field.

        `earlier` are fields of the step that are in the chart already.
        """
        field, charted = to_chart(field, self.state(point), earlier)
        return field, self.map(lambda c, y, z, new: new if c is None else z, point, charted)

    def flow(self, field: PyTree, point: PyTree) -> PyTree:
        """Where a field carries a point in unit time, both in the chart of the field."""

        def part(f: Any, p: PyTree, y: PyTree) -> PyTree:
            # Another term of the equation may make a sum of it.
            is_sum = isinstance(y, jax.Array) and is_field(f) and not isinstance(f, Rest)
            return p + f.increment(y + p) if is_sum else flow(f, p)

        if self.compensation is None:
            return flow(field, point)
        starts = self.map(lambda c, y: None if c is None else y)
        return jtu.tree_map(part, field, point, starts, is_leaf=is_field)

    def flow_frozen(self, field: PyTree, point: PyTree) -> PyTree:
        """Where a field that is frozen at a point carries it."""
        field, point = self.to_chart(field, point)
        return computed_once(from_chart(field, self.flow(field, point)))

    def materialised(self, end: PyTree, error: PyTree, is_followed: bool) -> tuple[PyTree, PyTree]:
        """The end of a step and its error, which XLA would otherwise compute for each use of an
        entry.

        A sum uses each increment several times, and so does what follows from the end.
        """
        is_used = is_followed or error is not None
        used = self.map(lambda c, y, z: z if is_used or c is not None else None, end)
        used, error = materialised_together((used, error))
        end = self.map(lambda c, y, z, new: new if is_used or c is not None else z, end, used)
        return end, error

    def fast_two_sum(self, end: PyTree) -> tuple[PyTree, PyTree]:
        """The state at the end of the step, and the compensation of the next step (Dekker's
        FastTwoSum).
        """

        def part(c: Array | None, a: PyTree, end: PyTree) -> tuple[PyTree, Array | None]:
            if c is None:
                return end, None
            b = end + lax.stop_gradient(c)
            total = a + b
            return total, lax.stop_gradient(b - (total - a))

        pairs = self.map(part, end)
        y1, compensation = (self.map(lambda c, y, pair: pair[k], pairs) for k in range(2))  # noqa: B023
        return y1, compensation
