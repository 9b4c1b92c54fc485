"""Steps in coordinates other than those of the exponential, which the fields offer."""

from typing import ClassVar

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree, Real

from .._field import has_rate, in_coordinates, landing, rate
from .._numerics.vectors import smooth
from .compiled import materialised_together
from .step import Chart

_NOT_SKEW = (
    "cfjax.Projected needs skew-Hermitian matrices a in LeftMatrix and RightMatrix, as for "
    "orthogonal and unitary matrices, and a is not skew-Hermitian at the start. Use a "
    "commutator-free method, for example cfjax.CF4()."
)


@smooth
def zero_or_nan(is_defined: Bool[Array, ""], field: PyTree) -> Real[Array, ""]:
    """Zero, or NaN if not, in the precision of a field: a number for `plus_zero`.

    The derivative of a sum with it is that of the other summand, and so is finite.
    """
    dtype = jnp.finfo(jtu.tree_leaves(field)[0].dtype).dtype
    return jnp.where(is_defined, jnp.zeros((), dtype), jnp.nan)


def plus_zero(tree: PyTree, zero: Real[Array, ""]) -> PyTree:
    return jtu.tree_map(lambda x: x + zero.astype(x.dtype), tree)


def landed(field: PyTree, start: PyTree) -> PyTree:
    """Where a field in these coordinates leads from the start of a step, on the manifold; or NaN
    where there is no such point.
    """
    increment, _ = _landing_or_nan(field, start)
    return jtu.tree_map(jnp.add, start, increment)


@smooth
def _landing_or_nan(field: PyTree, start: PyTree) -> tuple[PyTree, Bool[Array, ""]]:
    """The same as `landing`, with NaN where there is no such point.

    A number and not a predicate: a comparison would keep the divisions of the whole step.
    """
    increment, is_there = landing(field, start)
    return plus_zero(increment, zero_or_nan(is_there, field)), is_there


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
        increment, is_there = _landing_or_nan(field, self.origin)
        # A part that is no sum has its state there.
        return jtu.tree_map(jnp.add, self.start, increment), is_there


class ProjectedChart(AbstractCoordinateChart):
    """A step in plain space, whose end is brought back to the manifold."""

    __slots__ = ()

    name = "projected"

    def flow_of_step(self, field):
        # Otherwise each entry of the end would compute the whole step anew.
        return super().flow_of_step(materialised_together(field))


class CayleyChart(AbstractCoordinateChart):
    """A step in the coordinates of Cayley's transform."""

    __slots__ = ()

    name = "cayley"


CHARTS: dict[str, type[Chart]] = {
    "exponential": Chart,
    "cayley": CayleyChart,
}
