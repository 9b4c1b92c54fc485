"""Steps in coordinates other than those of the exponential, which the fields offer."""

from typing import ClassVar

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import PyTree

from .._field import has_rate, in_coordinates, landing, rate
from .compiled import materialised_in_rows
from .step import Chart

_NOT_SKEW = (
    'coordinates="projected" needs skew-Hermitian matrices a in LeftMatrix and RightMatrix, as for '
    "orthogonal and unitary matrices, and a is not skew-Hermitian at the start. Use a "
    "commutator-free method, for example cfjax.CF4()."
)


def landed(field: PyTree, start: PyTree) -> PyTree:
    """Where a field in these coordinates leads from the start of a step, on the manifold; or NaN
    where there is no such point.
    """
    increment, is_there = landing(field, start)
    return jtu.tree_map(lambda y, v: jnp.where(is_there, y + v, jnp.nan), start, increment)


class AbstractCoordinateChart(Chart):
    """A step whose fields are `AbstractCoordinates`, by the method of the fields of this name.

    Sums of them are coordinates u of a point. A Munthe-Kaas method is the Runge-Kutta method of its
    tableau for u, whose velocity is the `rate`.
    """

    __slots__ = ()

    name: ClassVar[str]

    apply_flow = staticmethod(landed)

    @classmethod
    def charted(cls, sums, field, point, earlier=()):
        return in_coordinates(cls.name, field, sums.state(point)), point

    def rate(self, u, field, degree):
        return rate(u, field, self.origin)

    def has_rate(self, u):
        return has_rate(u)

    def flow_of_step(self, field):
        increment, is_there = landing(field, self.origin)
        # A part that is no sum has its state there.
        end = jtu.tree_map(jnp.add, self.start, increment)
        return materialised_in_rows(end), is_there


class ProjectedChart(AbstractCoordinateChart):
    """A step in plain space, whose end is brought back to the manifold."""

    __slots__ = ()

    name = "projected"

    @classmethod
    def case_of_start(cls, field, y0):
        has_step = has_rate(in_coordinates(cls.name, lax.stop_gradient(field()), y0))
        return None if has_step is None else (~has_step, _NOT_SKEW)


class CayleyChart(AbstractCoordinateChart):
    """A step in the coordinates of Cayley's transform."""

    __slots__ = ()

    name = "cayley"


CHARTS: dict[str, type[Chart]] = {
    "exponential": Chart,
    "projected": ProjectedChart,
    "cayley": CayleyChart,
}
