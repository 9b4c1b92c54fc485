"""Rotations of unit vectors in any dimension: the sphere."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._field import AbstractFrozenField
from .._numerics.vectors import smooth
from .coordinates import OfLength, Tangent
from .elementwise import check_real, elementwise
from .low_rank import SpanSkew, check_like
from .rotation import Rotation


class SphereRotation(AbstractFrozenField):
    """The field `x' = (g y^T - y g^T) x` at points near y, the point where it is frozen.

    It acts on unit vectors, shape `(n,)` with any n >= 1, and keeps their length. At y itself it is
    `g - y (y @ g)`, the part of g that is tangent to the sphere. So `g` may be any velocity, and
    minus the gradient of a function of y gives the gradient flow of the function on the sphere. The
    point y is the one that `field(t, y, args)` was called with.

    No n x n matrix is formed. A flow turns the plane of y and g, and the flow of a sum of s fields
    turns the span of their 2s vectors, both in coordinates of the step, as with
    `cfjax.LowRankSkew`: a step of s stages costs about `2 n (s + 1)(s + 2)` flops. Within a step a
    field is an algebra element, so Munthe-Kaas methods accept it; outside of a step it has no
    bracket. Every step starts from `y (3 - y @ y) / 2`, so that rounding does not add up. For n = 3
    a field is, within a step, the `cfjax.Rotation` with angular velocity `y x g` (cross product),
    which by itself is 20 times as fast.

    With leading axes, shape `(*batch, n)`, each vector moves on its own. An axis of 1 is broadcast.

    **Arguments:** `g`, shape `(*batch, n)`, float32 or float64.

    **Raises** `ValueError` for another shape, `TypeError` for another dtype. Starting a solve from
    a vector whose length differs from 1 by more than the root of a unit of rounding is an error.
    Outside of a solve a length that is off by 0.05 gives NaN.
    """

    g: Float[Array, "*batch n"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        if self.g.ndim < 1 or self.g.shape[-1] < 1:
            raise ValueError(
                f"g must have shape (n,) or (*batch, n) with n >= 1, got {self.g.shape}."
            )
        check_real("g", self.g)

    def flow(self, point: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        """The flow of `point`, which is taken as the point where the field is frozen."""
        field, start = self.to_chart(point, ())
        return field.from_chart(field.flow(start))

    def tangent(self, point: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        check_like(self, "g", 1, point)
        square, normal = (jnp.sum(x * point, axis=-1, keepdims=True) for x in (point, self.g))
        return self.g * square - point * normal

    def defect(self, point: Float[Array, "*batch n"]) -> tuple[Array, str]:
        length = jnp.sqrt(jnp.sum(point * point, axis=-1))
        return jnp.max(jnp.abs(length - 1), initial=0), "length 1"

    def projected(self, point: Float[Array, "*batch n"]) -> Any:
        velocity = OfLength(self.tangent(point), is_unit=True)
        return elementwise(velocity, point.ndim - 1) if point.ndim > 1 else velocity

    def cayley(self, point: Float[Array, "*batch n"]) -> Any:
        velocity = Tangent(self.tangent(point))
        return elementwise(velocity, point.ndim - 1) if point.ndim > 1 else velocity

    def to_chart(self, point: Any, earlier: Sequence[Any]) -> tuple[AbstractFrozenField, Any]:
        if not earlier:
            check_like(self, "g", 1, point)
        if self.g.shape[-1] == 3:
            point = point if earlier else _corrected(point)
            return Rotation(jnp.cross(point, self.g)), point
        if self.g.ndim > 1:
            return elementwise(self, self.g.ndim - 1).to_chart(point, earlier)
        y = earlier[0].from_chart(point) if earlier else point
        # The part along y has no effect, but a large one would round. The flow does not depend on
        # how much is subtracted, so the factor needs no derivative.
        g = self.g - lax.stop_gradient(jnp.sum(y * self.g)) * y
        return _SpanRotation.in_chart(g[:, None], point if earlier else point[:, None], earlier)


@smooth
def _corrected(y: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """`y (3 - y @ y) / 2`, the first step of Newton's method for length 1."""
    defect = 1 - jnp.sum(y * y, axis=-1, keepdims=True)
    # A point far from the sphere is a mistake of the caller.
    is_near = jnp.abs(lax.stop_gradient(defect)) < 0.1
    return y + y * jnp.where(is_near, defect / 2, jnp.nan)


class _SpanRotation(SpanSkew):
    """A skew field on the span of columns, which acts on one column without its axis of 1."""

    def tangent(self, point: Float[Array, " n"]) -> Float[Array, " n"]:
        return super().tangent(point[:, None])[:, 0]

    def from_chart(self, point: Any) -> Float[Array, " n"]:
        return super().from_chart(point)[:, 0]
