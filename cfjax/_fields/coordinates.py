"""Fields in the coordinates of a step: in plain space, and those of Cayley's transform.

`projected` and `cayley` of a frozen field make them.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Inexact, Real

from .._field import AbstractCoordinates
from .._numerics.cayley import (
    TangentCoordinates,
    is_within_half_a_turn,
    log_determinant,
    without_turns,
)
from .._numerics.polar import polar_correction
from .._numerics.squaring import magnitude


class AbstractProjected(AbstractCoordinates):
    """The translation by a velocity `v` in plain space.

    The end of a step is moved to the manifold, by as little as the step is off it.
    """

    v: eqx.AbstractVar[Inexact[Array, "..."]]

    def flow(self, point: Array) -> Array:
        return point + self.v

    def increment(self, point: Array) -> Array:
        return self.v

    def tangent(self, point: Array) -> Array:
        return self.v


class Polar(AbstractProjected):
    """The end keeps the products of columns, or has orthonormal columns.

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

    def has_rate(self) -> Bool[Array, ""]:
        # A sum of fields of which one has no value here has none either.
        return ~jnp.isnan(lax.stop_gradient(self.skew_defect))

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        v, is_there = polar_correction(
            self._columns(start), self._columns(self.v), self.are_orthonormal
        )
        v = v.T if self.are_rows else v
        return v.reshape(start.shape), is_there & self.has_rate()

    def _columns(self, x: Array) -> Inexact[Array, "n k"]:
        return x.T if self.are_rows and x.ndim > 1 else x.reshape(len(x), -1)


class BesideCayley(AbstractProjected):
    """The end is that of `Cayley`, by an element of the algebra that is computed beside the point.

    No stage looks at this element.
    """

    v: Inexact[Array, "n n"]
    beside: "Cayley"

    def tangent(self, point: Array) -> Array:
        # What moves the end: a fluid may turn far while its vorticity changes little.
        return self.beside.tangent(point)

    def rate(self, field: Any, start: Any) -> "BesideCayley":
        return BesideCayley(field.v, self.beside.rate(field.beside, start))

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        return self.beside.landing(start)


class Cayley(AbstractCoordinates):
    """A matrix u, with `cay(u) = (I - u/2)^-1 (I + u/2)` in place of its exponential.

    **Arguments:**

    - `u`: a field of a matrix `a` with methods `dcayinv` and `cayley_increment`.
    - `trace`: that of the matrix, if the determinant of points is to follow it; or None.
    """

    u: Any
    trace: Inexact[Array, "*batch"] | None = None

    def flow(self, point: Array) -> Array:
        return point + self.increment(point)

    def increment(self, point: Array) -> Array:
        return self.u.cayley_increment(point)

    def tangent(self, point: Array) -> Array:
        return self.u.tangent(point)

    def rate(self, field: Any, start: Any) -> "Cayley":
        # The trace of a sum of these matrices is another, as its own field has one.
        return Cayley(self.u.dcayinv(field.u), field.trace)

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        increment = self.increment(start)
        if self.trace is not None:
            # The logarithm of the determinant has moved by the trace. Both differ by the error of
            # the step, and by whole turns.
            missing = without_turns(self.trace - log_determinant(self.u.a)) / len(self.u.a)
            increment = increment + jnp.expm1(missing) * (start + increment)
        return increment, is_within_half_a_turn(self.u.a)


class Tangent(AbstractCoordinates):
    """A tangent vector v at orthonormal columns, or at a unit vector, as coordinates of others.

    See `TangentCoordinates`.
    """

    v: Inexact[Array, "n *p"]
    is_rate_of_start: ClassVar[bool] = True

    def flow(self, point: Array) -> Array:
        return point + self._at(point).increment.reshape(point.shape)

    def tangent(self, point: Array) -> Array:
        return self.v

    def rate(self, field: Any, start: Array) -> "Tangent":
        velocity = field.v.reshape(len(start), -1)
        return Tangent(self._at(start).rate(velocity).reshape(start.shape))

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        coordinates = self._at(start)
        increment = coordinates.increment.reshape(start.shape)
        return increment, coordinates.is_within_half_a_turn()

    def _at(self, point: Array) -> TangentCoordinates:
        return TangentCoordinates(*(x.reshape(len(x), -1) for x in (point, self.v)))


def skew_defect(a: Inexact[Array, "n n"]) -> Real[Array, ""]:
    """0 if a matrix is skew-Hermitian but for rounding, otherwise NaN.

    It is 0 too if an entry is NaN, which says nothing of a matrix: the step then ends in NaN.
    """
    a = lax.stop_gradient(a)
    size, defect = (jnp.max(magnitude(x)) for x in (a, a + a.conj().T))
    zero = jnp.zeros((), size.dtype)
    return jnp.where(defect > 1e3 * jnp.finfo(size.dtype).eps * size, jnp.nan, zero)
