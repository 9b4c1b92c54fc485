"""Fields in the coordinates of a step: in plain space, and those of Cayley's transform.

`projected` and `cayley` of a frozen field make them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Complex, Inexact, PyTree, Real

from .._arrays import describe, struct
from .._field import AbstractCoordinates
from .._numerics.cayley import (
    TangentCoordinates,
    is_within_half_a_turn,
    log_determinant,
    without_turns,
)
from .._numerics.lengths import length_correction, vector_of_length
from .._numerics.polar import (
    Products,
    phase_correction,
    polar_correction,
    polar_correction_of_rows,
)
from .._numerics.squaring import magnitude
from .._numerics.vectors import entries, pack, placed


class AbstractProjected(AbstractCoordinates):
    """The translation by a velocity `v` in plain space.

    The end of a step is moved to the manifold, by as little as the step is off it.
    """

    v: eqx.AbstractVar[PyTree[Array]]

    def flow(self, point: Any) -> Any:
        return jtu.tree_map(jnp.add, point, self.v)

    def increment(self, point: Any) -> Any:
        return self.v

    def tangent(self, point: Any) -> Any:
        return self.v


class OfLength(AbstractProjected):
    """The end of a vector has the length of its start, or length 1."""

    v: Real[Array, "*batch n"]
    is_unit: bool = eqx.field(static=True)
    square: Real[Array, ""] | None = None

    def kept(self, start: Array) -> Array | None:
        return None if self.is_unit else jnp.sum(start * start)

    def keeping(self, kept: Array) -> "OfLength":
        return replace(self, square=kept)

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        return vector_of_length(start, self.v, self.is_unit, self.square)


class Pose(AbstractProjected):
    """The end of a pose has a unit number or an orthogonal matrix. All else is as in plain space.

    **Arguments:**

    - `v`: the velocity, shaped like the pose.
    - `dimension`: the size of the rotation in a pose that is a matrix.
    - `indices`: where the unit number is in a pose that is a vector. A point has none.
    """

    v: Real[Array, "..."]
    dimension: int = eqx.field(static=True)
    indices: tuple[int, ...] = eqx.field(static=True, default=())

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        if start.ndim == 1:
            if not self.indices:
                return self.v, jnp.asarray(True)
            y, v = entries(start), entries(self.v)
            number, is_there = length_correction(
                [y[k] for k in self.indices], [v[k] for k in self.indices], True
            )
            rest = [k for k in range(len(v)) if k not in self.indices]
            turned = placed([*number, *(v[k] for k in rest)], [*self.indices, *rest])
            return pack(turned), is_there
        block = slice(self.dimension)
        turned, is_there = polar_correction(start[block, block], self.v[block, block], True)
        return self.v.at[block, block].set(turned), is_there


class Nearest(AbstractProjected):
    """A velocity in plain space, and the point of a manifold that is nearest to another point.

    For `AbstractFrozenField.projected`, which `cfjax.Projected` calls.

    **Arguments:**

    - `v`: the velocity, shaped like the point.
    - `nearest`: `nearest(point)` returns the point of the manifold nearest to a point that is off
      it, shaped like the point. It must be one function for all fields of a class, such as a
      function of a module.

    A step whose end is off by more than half of the size of the end fails.
    """

    v: PyTree[Array]
    nearest: Callable[[Any], Any] = eqx.field(static=True)

    def landing(self, start: Any) -> tuple[Any, Bool[Array, ""]]:
        end = jtu.tree_map(jnp.add, start, self.v)
        nearest = self.nearest(end)
        if struct(nearest) != struct(end):
            raise ValueError(
                "nearest must return what is shaped like its point, "
                f"{describe(end)}, got {describe(nearest)}."
            )
        increment = jtu.tree_map(jnp.subtract, nearest, start)
        off = lax.stop_gradient(jtu.tree_map(jnp.subtract, nearest, end))
        is_there = _square(off) <= _square(lax.stop_gradient(end)) / 4
        return increment, is_there


class Polar(AbstractProjected):
    """The end keeps the products of columns, or has orthonormal columns.

    **Arguments:**

    - `v`: the velocity, shaped like the point: a vector or columns; or rows, if `are_rows`.
    - `skew_defect`: 0 if the matrix of the field is skew-Hermitian, otherwise NaN.
    - `trace`: that of the matrix, if the determinant of points is to follow it; or None.
    - `are_orthonormal`: whether the columns are orthonormal at the end, instead of keeping their
      products.
    - `products`: those that the columns keep, or None for those at the start of the step.
    """

    v: Inexact[Array, "..."]
    skew_defect: Real[Array, ""]
    trace: Complex[Array, "*batch"] | None = None
    are_rows: bool = eqx.field(static=True, default=False)
    are_orthonormal: bool = eqx.field(static=True, default=False)
    products: Products | None = None

    def kept(self, start: Array) -> Products | None:
        columns = self._columns(start)
        if self.are_orthonormal or columns.shape[1] > len(columns):
            return None
        return Products.of(columns)

    def keeping(self, kept: Products) -> "Polar":
        return replace(self, products=kept)

    def has_rate(self) -> Bool[Array, ""]:
        # A sum of fields of which one has no value here has none either.
        return ~jnp.isnan(lax.stop_gradient(self.skew_defect))

    def landing(self, start: Array) -> tuple[Array, Bool[Array, ""]]:
        columns = self._columns(start)
        v = self._columns(self.v)
        if columns.shape[1] > len(columns):
            v, is_there = polar_correction_of_rows(columns, v)
        else:
            v, is_there = polar_correction(columns, v, self.are_orthonormal, self.products)
        if self.trace is not None:
            v = phase_correction(columns, v, self.trace)
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


def _square(tree: PyTree[Array]) -> Real[Array, ""]:
    squares = [jnp.sum(x.real * x.real + x.imag * x.imag) for x in jtu.tree_leaves(tree)]
    return jnp.sum(jnp.asarray(squares))
