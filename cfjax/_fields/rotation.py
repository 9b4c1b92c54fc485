"""Rotations of space: the Lie algebra so(3) in three numbers."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._field import AbstractAlgebraElement
from .._numerics.rotate import cross_product, dexpinv, has_dexpinv, increment, mean, rotate
from .coordinates import OfLength, Polar
from .elementwise import check_other, check_point, check_real, each, each_of_its_own, elementwise


class Rotation(AbstractAlgebraElement):
    """The rotation of space with angular velocity `omega`: `x' = omega x x` (cross product).

    It acts on a vector, shape `(3,)`, and on every column of a matrix, shape `(3, k)`. With k = 3
    it acts on attitude matrices in SO(3), with `omega` in the fixed frame. (`cfjax.RightMatrix`
    takes the angular velocity in the body's frame; unit quaternions with `cfjax.QuaternionRotation`
    are faster.)

    With leading axes, shape `(*batch, 3)`, it acts on shapes `(*batch, 3)` and `(*batch, 3, k)`:
    each element moves on its own, as the spins of a lattice do. An axis of 1 is broadcast, so
    `omega` of shape `(1, 3)` turns all vectors of a state of shape `(100, 3)`.

    The flow is Rodrigues' formula, about 100 flops, exact to rounding for every angle, and so are
    its derivatives of every order, also at `omega = 0`. An angle beyond 2^45 (2^16 in float32),
    where rounding leaves no two digits of the direction, gives NaN. A vector may have any length,
    so its length is not corrected: in a solve of equal flows of one angle it drifts by up to some
    units of rounding a flow above a radian, and by these times the square of the angle below.

    **Arguments:** `omega`, shape `(*batch, 3)`, float32 or float64, in radians per unit of time.

    **Raises** `ValueError` for another shape, `TypeError` for another dtype.
    """

    omega: Float[Array, "*batch 3"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        check_angular_velocity(self.omega)

    def flow(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(rotate, point, is_flow=True)

    def increment(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(increment, point, is_flow=True)

    def tangent(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(cross_product, point)

    def mean(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(mean, point)

    def framed(self, point: Float[Array, "..."]) -> Any:
        """Itself on matrices (3, 3), which are attitudes, and the velocity on other points."""
        if point.shape[self._num_axes :] != (3, 3):
            return self.tangent(point)
        return each_of_its_own(self, self._num_axes, point)

    def projected(self, point: Float[Array, "..."]) -> Any:
        if self._num_axes:
            return elementwise(self, self._num_axes).projected(point)
        v = self.tangent(point)
        return OfLength(v, is_unit=False) if v.ndim == 1 else Polar(v, jnp.zeros((), v.dtype))

    def bracket(self, other: Any) -> "Rotation":
        return self._with(cross_product, other)

    def dexpinv(self, other: Any, degree: int) -> "Rotation":
        """Exact, whatever the degree, for angles below a full turn."""
        return self._with(dexpinv, other)

    def has_dexpinv(self) -> Bool[Array, ""]:
        return has_dexpinv(self.omega)

    def _with(self, fun: Any, other: Any) -> "Rotation":
        check_other(self, other)
        return type(self)(each(fun, self._num_axes)(self.omega, other.omega))

    @property
    def _num_axes(self) -> int:
        return self.omega.ndim - 1

    def _each(
        self, fun: Callable[[Array, Array], Array], point: Array, is_flow: bool = False
    ) -> Array:
        check_point(self, "omega", self._num_axes, [(3,), (3, "k")], point)
        if jnp.iscomplexobj(point):
            raise TypeError(f"Rotation acts on real arrays, got {point.dtype}.")
        return each(fun, self._num_axes, is_flow)(self.omega, point)


def check_angular_velocity(omega: Array) -> None:
    if omega.ndim < 1 or omega.shape[-1] != 3:
        raise ValueError(f"omega must have shape (3,) or (*batch, 3), got {omega.shape}.")
    check_real("omega", omega)
