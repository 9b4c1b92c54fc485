"""Steps in plain space whose end is brought back to the manifold."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._field import projected, projection
from .compiled import materialised_in_rows
from .step import Chart
from .sums import Sums


def end_of_projection(field: PyTree, start: PyTree) -> PyTree:
    """Where a field in these coordinates leads from the start of a step, on the manifold."""
    return jtu.tree_map(jnp.add, start, projection(field, start)[0])


class ProjectedChart(Chart):
    """A step whose stages are at the start plus sums of velocities, in plain space.

    Its fields are `AbstractFrozenField.projected` of the fields at the stages. They are linear, so
    that a Munthe-Kaas method in this chart is the Runge-Kutta method of its tableau.
    """

    __slots__ = ()

    apply_flow = staticmethod(end_of_projection)

    @classmethod
    def at_start(
        cls,
        value: Callable[[Any, PyTree], PyTree],
        product: Callable[[PyTree], PyTree],
        sums: Sums,
        first_value: PyTree,
    ) -> "ProjectedChart":
        first_field = projected(product(first_value), sums.y0)
        return cls(value, product, sums, first_value, first_field, sums.start)

    def frozen(self, value, point, earlier):
        return projected(self.product(value), self.sums.state(point))

    def flow_of_step(self, field):
        increment, is_there = projection(field, self.origin)
        end = jtu.tree_map(jnp.add, self.start, increment)
        return materialised_in_rows(end), is_there
