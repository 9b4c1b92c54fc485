"""Rotations of space: the Lie algebra so(3) in three numbers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._field import AbstractAlgebraElement
from .._numerics.rotate import cross, increment, rotate


class Rotation(AbstractAlgebraElement):
    """The rotation of space with angular velocity `omega`: `x' = omega x x` (cross product).

    It acts on a vector, shape `(3,)`, and on every column of a matrix, shape `(3, k)`: with
    k = 3 on attitude matrices in SO(3), with `omega` in the fixed frame.

    The flow is Rodrigues' formula, about 100 flops, exact to rounding for every angle, and so are
    its derivatives of every order, also at `omega = 0`. An angle beyond 2^45 (2^16 in float32),
    where rounding leaves no two digits of the direction, gives NaN.

    **Arguments:** `omega`, shape `(3,)`, float32 or float64, in radians per unit of time.

    **Raises** `ValueError` for another shape, `TypeError` for another dtype.
    """

    omega: Float[Array, "3"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        if self.omega.shape != (3,):
            raise ValueError(f"omega must have shape (3,), got {self.omega.shape}.")
        if self.omega.dtype not in (jnp.float32, jnp.float64):
            raise TypeError(f"omega must be float32 or float64, got {self.omega.dtype}.")

    def flow(self, point: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
        _check_point(point)
        return rotate(self.omega, point)

    def increment(self, point: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
        _check_point(point)
        return increment(self.omega, point)

    def tangent(self, point: Float[Array, "3 *k"]) -> Float[Array, "3 *k"]:
        _check_point(point)
        return cross(self.omega, point)

    def bracket(self, other: Any) -> "Rotation":
        if not isinstance(other, Rotation):
            raise TypeError(
                f"Rotation has a bracket with another Rotation only, got {type(other).__name__}."
            )
        return type(self)(cross(self.omega, other.omega))


def _check_point(point: Array) -> None:
    if point.ndim not in (1, 2) or point.shape[0] != 3:
        raise ValueError(f"Rotation acts on shapes (3,) and (3, k), got {point.shape}.")
    if jnp.iscomplexobj(point):
        raise TypeError(f"Rotation acts on real arrays, got {point.dtype}.")
