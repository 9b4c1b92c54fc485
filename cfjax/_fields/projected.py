"""Fields in the coordinates of a step in plain space, whose end is brought back to the manifold.

`projected` of a frozen field makes them. They are linear: a sum of them has the sum of velocities.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Inexact, Real

from .._field import AbstractAlgebraElement
from .._numerics.polar import polar_correction
from .._numerics.squaring import magnitude


class AbstractProjected(AbstractAlgebraElement):
    """The translation by a velocity `v` in plain space.

    `projection` moves a point on the manifold by nearly as much, and to the manifold.
    """

    v: eqx.AbstractVar[Inexact[Array, "..."]]

    def flow(self, point: Array) -> Array:
        return point + self.v

    def increment(self, point: Array) -> Array:
        return self.v

    def tangent(self, point: Array) -> Array:
        return self.v

    def bracket(self, other: Any) -> Any:
        return type(self).combine((0.0,), (self,))

    def dexpinv(self, other: Any, degree: int) -> Any:
        return other


class Polar(AbstractProjected):
    """The projection keeps the products of columns, or makes the columns orthonormal.

    **Arguments:**

    - `v`: the velocity, shaped like the point: a vector or columns; or rows, if `are_rows`.
    - `skew_defect`: 0 if the matrix of the field is skew-Hermitian, otherwise NaN.
    - `are_orthonormal`: whether the columns are orthonormal at the end, instead of keeping their
      products.
    """

    v: Inexact[Array, "..."]
    skew_defect: Real[Array, ""]
    are_rows: bool = eqx.field(static=True, default=False)
    are_orthonormal: bool = eqx.field(static=True, default=False)

    def has_dexpinv(self) -> Bool[Array, ""]:
        # A sum of fields of which one has no value here has none either.
        return ~jnp.isnan(lax.stop_gradient(self.skew_defect))

    def projection(self, point: Array) -> tuple[Array, Bool[Array, ""]]:
        v, is_there = polar_correction(
            self._columns(point), self._columns(self.v), self.are_orthonormal
        )
        v = v.T if self.are_rows else v
        return v.reshape(point.shape), is_there & self.has_dexpinv()

    def _columns(self, x: Array) -> Inexact[Array, "n k"]:
        return x.T if self.are_rows and x.ndim > 1 else x.reshape(len(x), -1)


class BesideCayley(AbstractProjected):
    """The projection is the flow by an element of the algebra that is computed beside the point.

    No stage looks at this element. It is u in Cayley's coordinates, `cay(u) = (I - u/2)^-1
    (I + u/2)`, where a step leads from the identity to cay(u).

    **Arguments:** `v`, the velocity; `u`, a field with `dcayinv` and `cayley_increment`, without
    leading axes.
    """

    v: Inexact[Array, "n n"]
    u: Any

    def dexpinv(self, other: Any, degree: int) -> "BesideCayley":
        return BesideCayley(other.v, self.u.dcayinv(other.u))

    def projection(self, point: Array) -> tuple[Array, Bool[Array, ""]]:
        a = lax.stop_gradient(self.u.a)
        # The coordinates end where a step turns by pi. All pairs of angles above 2.5 to 2.75 are
        # beyond this bound, and no step whose angles are all below 1 is.
        size = jnp.sum(jnp.square(jnp.abs(a)))
        return self.u.cayley_increment(point), size <= 72 + 1.2 * len(a)


def skew_defect(a: Inexact[Array, "n n"]) -> Real[Array, ""]:
    """0 if a matrix is skew-Hermitian but for rounding, otherwise NaN."""
    a = lax.stop_gradient(a)
    size, defect = (jnp.max(magnitude(x)) for x in (a, a + a.conj().T))
    zero = jnp.zeros((), size.dtype)
    return jnp.where(defect <= 1e3 * jnp.finfo(size.dtype).eps * size, zero, jnp.nan)
