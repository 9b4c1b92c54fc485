"""Skew fields of low rank, for points with orthonormal columns: the Stiefel manifold."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._arrays import Weight
from .._field import AbstractAlgebraElement, AbstractFrozenField, combine
from .._numerics.expm_action import phi_1_action
from .._numerics.matmul import matmul
from .._numerics.span import (
    Blocks,
    Corner,
    Span,
    correction,
    inner,
    joined,
    orthonormal_defect,
    plus_product,
    square,
)
from .coordinates import Polar, Tangent
from .elementwise import check_point, check_real, each, elementwise


class AbstractSkew(AbstractFrozenField):
    """A skew field, which acts on orthonormal columns."""

    def defect(self, point: Float[Array, "*batch n p"]) -> tuple[Array, str]:
        defect = each(lambda y: orthonormal_defect(square(y)), point.ndim - 2)(point)
        return jnp.max(jnp.abs(defect), initial=0), "orthonormal columns (in entries of y0.T @ y0)"

    def projected(self, point: Float[Array, "*batch n p"]) -> Any:
        if point.ndim > 2:
            return elementwise(self, point.ndim - 2).projected(point)
        # Skew by construction.
        defect = jnp.zeros((), point.dtype)
        return Polar(self.tangent(point), defect, are_orthonormal=True)

    def cayley(self, point: Float[Array, "*batch n p"]) -> Any:
        velocity = Tangent(self.tangent(point))
        return elementwise(velocity, point.ndim - 2) if point.ndim > 2 else velocity


class LowRankSkew(AbstractSkew):
    """The field `x' = (g y^T - y g^T) x` at points near y, the point where it is frozen.

    It acts on a matrix with orthonormal columns, shape `(n, p)`, and keeps them orthonormal. The
    point y is the one that `field(t, y, args)` was called with, so only `g` determines the field,
    and sums of such fields at one point are fields of the same form.

    No n x n matrix is formed. Within a step the points and fields stay in the span of its first
    point and of all g so far, p columns each: a step of s stages costs about
    `2 n p^2 (s + 1)(s + 2)` flops and `n p (s + 1)` numbers. For points of up to some 2000 numbers
    the stages are rolled into one loop, which compiles faster and takes up to twice as many flops.
    Within a step a field is an algebra element, whose brackets stay in the span, so Munthe-Kaas
    methods accept it. Outside of a step it has no bracket, as the bracket depends on the point y.
    Every step starts from `y (3 I - y^T y) / 2`, so that rounding does not add up.

    With leading axes, shape `(*batch, n, p)`, each element moves on its own.

    **Arguments:** `g`, shape `(*batch, n, p)` with n >= p, float32 or float64.

    **Raises** `ValueError` for another shape, `TypeError` for another dtype. A solve that starts
    from columns that are not orthonormal, by more than the root of a unit of rounding in an entry
    of `y^T y`, is an error. Outside of a solve a point that is off by 0.1 gives NaN.

    Source: Celledoni & Owren, On the implementation of Lie group methods on the Stiefel manifold,
    Numer. Algorithms 32 (2003), for exponentials of low rank.
    """

    g: Float[Array, "*batch n p"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        _check_factor("g", self.g)

    def flow(self, point: Float[Array, "*batch n p"]) -> Float[Array, "*batch n p"]:
        """The flow of `point`, which is taken as the point where the field is frozen."""
        field, start = self.to_chart(point, ())
        return field.from_chart(field.flow(start))

    def tangent(self, point: Float[Array, "*batch n p"]) -> Float[Array, "*batch n p"]:
        check_like(self, "g", 2, point)
        if self.g.ndim > 2:
            return elementwise(self, self.g.ndim - 2).tangent(point)
        return matmul(self.g, matmul(point.T, point)) - matmul(point, matmul(self.g.T, point))

    def to_chart(self, point: Any, earlier: Sequence[Any]) -> tuple[Any, Any]:
        if not earlier:
            check_like(self, "g", 2, point)
        if self.g.ndim > 2:
            return elementwise(self, self.g.ndim - 2).to_chart(point, earlier)
        return SpanSkew.in_chart(self.g, point, earlier)


class AbstractSkewElement(AbstractSkew, AbstractAlgebraElement):
    """A skew field with a bracket. A sum of bordered fields is bordered, any other is on a span."""

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> Any:
        if all(isinstance(f, BorderedSkew) for f in fields):
            return BorderedSkew(combine(weights, [f.gamma for f in fields]))
        fields = _on_one_span(fields)
        k, a = combine(weights, [(f.k, f.a) for f in fields])
        return type(fields[0])(k, a, fields[0].span)


class BorderedSkew(AbstractSkewElement):
    """The field `x' = (gamma E^T - E gamma^T) x`, where E is the first p columns of the identity.

    If the first p rows of `gamma` are L and the others B, its matrix is
    `[[L - L^T, -B^T], [B, 0]]`. It acts on a matrix with orthonormal columns, shape `(n, p)`. Sums
    keep the form, so a flow costs `6 n p^2` flops in every commutator-free method. Brackets do not:
    the result is a skew matrix on a growing span of columns.

    Every step starts from `y (3 I - y^T y) / 2`, so that rounding does not add up.

    With leading axes, shape `(*batch, n, p)`, each element moves on its own.

    **Arguments:** `gamma`, shape `(*batch, n, p)` with n >= p, float32 or float64.

    **Raises** `ValueError` for another shape, `TypeError` for another dtype. A solve that starts
    from columns that are not orthonormal, by more than the root of a unit of rounding in an entry
    of `y^T y`, is an error. Outside of a solve a point that is off by 0.1 gives NaN.

    Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
    Section 3.2, doi:10.1016/S0167-739X(02)00161-9.
    """

    gamma: Float[Array, "*batch n p"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        _check_factor("gamma", self.gamma)

    def flow(self, point: Float[Array, "*batch n p"]) -> Float[Array, "*batch n p"]:
        check_like(self, "gamma", 2, point)
        if self.gamma.ndim > 2:
            return self._elementwise(self).flow(point)
        p = point.shape[1]
        corner, border = self.gamma[:p], self.gamma[p:]
        corner = corner - corner.T
        gram = matmul(border.T, border)
        top, bottom = point[:p], point[p:]
        # The bottom moves in the span of the border: bottom + border w, with top' = corner top -
        # gram w - border^T bottom and w' = top.
        row = jnp.concatenate([corner, -gram], axis=1)

        def product(x: Array) -> Array:
            return jnp.concatenate([matmul(row, x), x[:p]])

        # Norms that bound the 2-norm. A skew matrix has its singular values in pairs.
        half_norm = jnp.sqrt(lax.stop_gradient(jnp.sum(corner * corner)) / 2) / 2
        gram_norm = jnp.max(jnp.sum(jnp.abs(lax.stop_gradient(gram)), axis=1))

        def dense() -> tuple[Array, Array]:
            a = jnp.concatenate([row, jnp.eye(p, 2 * p, dtype=row.dtype)])
            scale = 1 / jnp.sqrt(jnp.maximum(gram_norm, 1))
            return a, jnp.repeat(jnp.stack([jnp.ones_like(scale), scale]), p)

        velocity = matmul(corner, top) - matmul(border.T, bottom)
        increment = phi_1_action(
            product,
            jnp.concatenate([velocity, top]),
            half_norm + jnp.sqrt(half_norm * half_norm + gram_norm),
            dense,
        )
        return jnp.concatenate([top + increment[:p], bottom + matmul(border, increment[p:])])

    def tangent(self, point: Float[Array, "*batch n p"]) -> Float[Array, "*batch n p"]:
        check_like(self, "gamma", 2, point)
        if self.gamma.ndim > 2:
            return self._elementwise(self).tangent(point)
        p = point.shape[1]
        velocity = matmul(self.gamma, point[:p])
        return jnp.concatenate([velocity[:p] - matmul(self.gamma.T, point), velocity[p:]])

    def bracket(self, other: Any) -> Any:
        if self.gamma.ndim > 2:
            return self._elementwise(self).bracket(self._elementwise(other))
        return _spanned(self).bracket(other)

    def dexpinv(self, other: Any, degree: int) -> Any:
        if self.gamma.ndim > 2:
            return self._elementwise(self).dexpinv(self._elementwise(other), degree)
        return super().dexpinv(other, degree)

    def to_chart(self, point: Any, earlier: Sequence[Any]) -> tuple[AbstractFrozenField, Any]:
        if self.gamma.ndim > 2:
            return self._elementwise(self).to_chart(point, earlier)
        if not earlier:
            check_like(self, "gamma", 2, point)
            point = point + matmul(point, correction(square(point)))
        return self, point

    def _elementwise(self, field: Any) -> Any:
        return elementwise(field, self.gamma.ndim - 2)


class SpanPoint(eqx.Module):
    """A point of a step, by its coefficients in the first blocks of a span."""

    z: Float[Array, "k p"]
    blocks: Blocks


class SpanSkew(AbstractSkewElement):
    """The field `x' = W k W^T x` with a skew k on the span of some columns W.

    Its rank is `len(k)` at most. Sums and brackets of fields on different spans live on the sum
    of the spans.
    """

    k: Float[Array, "m m"]
    # The field acts on coefficients by a: `W k W^T W = W a`. A bracket is a commutator of these.
    a: Float[Array, "m m"]
    span: Span

    @classmethod
    def in_chart(
        cls, g: Float[Array, "n p"], point: Any, earlier: Sequence["SpanSkew"]
    ) -> tuple["SpanSkew", SpanPoint]:
        """The field `g y^T - y g^T` frozen at the point y, and y, in the chart of a step."""
        if earlier:
            span, z = earlier[-1].span, point.z
        else:
            span = Span((point,), square(point))
            z = jnp.eye(point.shape[1], dtype=point.dtype)
            point = SpanPoint(z + correction(span.gram), span.blocks)
        return cls.of(g, z, span), point

    @classmethod
    def of(cls, g: Float[Array, "n p"], z: Float[Array, "k p"], span: Span) -> "SpanSkew":
        """The field `g y^T - y g^T` with `y = W z`, on the span of W and g."""
        p, length = g.shape[1], len(z)
        span = span.extended(g)
        m = len(span.gram)
        y = jnp.pad(z, ((0, m - p - length), (0, 0)))
        k = jnp.block([[jnp.zeros((m - p, m - p), z.dtype), -y], [y.T, jnp.zeros((p, p), z.dtype)]])
        g_rows, y_rows = span.gram[m - p :], matmul(z.T, span.gram[:length])
        top = jnp.pad(matmul(z, g_rows), ((0, m - p - length), (0, 0)))
        return cls(k, jnp.concatenate([-top, y_rows]), span)

    def flow(self, point: Any) -> Any:
        def increment(velocity: Array) -> Array:
            a = lax.stop_gradient(self.a)
            # This matrix is similar to a real skew one, whose eigenvalues come in pairs.
            bound = jnp.sqrt(jnp.maximum(-jnp.sum(a * a.T) / 2, 0))
            return phi_1_action(lambda x: matmul(self.a, x), velocity, bound, self._dense)

        if isinstance(point, SpanPoint):
            length, m = len(point.z), len(self.a)
            z = jnp.pad(point.z, ((0, m - length), (0, 0)))
            z = z + increment(matmul(self.a[:, :length], point.z))
            return SpanPoint(z, self.span.blocks)
        velocity = matmul(self.k, inner(self.span.blocks, point))
        return plus_product(point, self.span.blocks, increment(velocity))

    def _dense(self) -> tuple[Array, Array]:
        # Scaled to columns of length 1.
        squares = jnp.diagonal(self.span.gram)
        return self.a, jnp.where(squares > 0, lax.rsqrt(jnp.where(squares > 0, squares, 1)), 1)

    def tangent(self, point: Float[Array, "n p"]) -> Float[Array, "n p"]:
        blocks = self.span.blocks
        velocity = matmul(self.k, inner(blocks, point))
        return plus_product(jnp.zeros_like(point), blocks, velocity)

    def bracket(self, other: Any) -> "SpanSkew":
        x, y = _on_one_span((self, other))
        product = matmul(x.a, y.k)
        k = product - product.T
        return type(self)(k, matmul(k, x.span.gram), x.span)

    def from_chart(self, point: Any) -> Any:
        if isinstance(point, SpanPoint):
            p = point.z.shape[1]
            return matmul(joined(point.blocks[: len(point.z) // p]), point.z)
        return point

    def on(self, span: Span) -> "SpanSkew":
        """The same field on a span that has all its blocks."""
        if span is self.span:
            return self
        m = len(self.k)
        indices = span.column_indices(self.span)
        if np.array_equal(indices, np.arange(m)):
            k = _padded(self.k, len(span.gram))
            border = matmul(self.k, span.gram[:m, m:])
            a = jnp.concatenate([self.a, border], 1)
            return type(self)(k, jnp.pad(a, ((0, len(k) - m), (0, 0))), span)
        k = jnp.zeros(span.gram.shape, self.k.dtype).at[np.ix_(indices, indices)].set(self.k)
        return type(self)(k, matmul(k, span.gram), span)

    def room(self, point: Any, num_fields: int) -> "Room | None":
        blocks: tuple[Any, ...] = self.span.blocks
        if any(isinstance(block, Corner) for block in blocks):
            return None
        p = point.z.shape[1]
        m = (num_fields + 1) * p
        padding = ((0, 0), (0, m - len(self.span.gram)))
        columns = jnp.pad(jnp.concatenate(blocks, axis=1), padding)
        return Room(Span((columns,), _padded(self.span.gram, m)), p, type(self))


class Room(eqx.Module):
    """The span of a step with room for all of its fields, in arrays that do not grow.

    The columns of later fields are zero, and so are their coefficients.
    """

    span: Span
    p: int = eqx.field(static=True)
    cls: type[SpanSkew] = eqx.field(static=True)

    def coordinates(self, field: SpanSkew, point: SpanPoint) -> tuple[Array, Array]:
        m = len(self.span.gram)
        return _padded(field.k, m), jnp.pad(point.z, ((0, m - len(point.z)), (0, 0)))

    def field(self, k: Float[Array, "m m"]) -> SpanSkew:
        return self.cls(k, matmul(k, self.span.gram), self.span)

    def point(self, z: Float[Array, "m p"]) -> SpanPoint:
        return SpanPoint(z, self.span.blocks)

    def entered(self, field: SpanSkew) -> tuple[Array, Array]:
        """The new columns of a field in this chart, and their products with all columns.

        The last p rows of the latter are the products with themselves.
        """
        m = len(self.span.gram)
        columns: Any = field.span.blocks[-1]
        return columns, field.span.gram[:, m:]

    def kept(self, i: Any) -> tuple[Array, Array]:
        """The same of field i, which this span holds."""
        g, gram = (self._block(x, i, 1) for x in (self._columns, self.span.gram))
        return g, jnp.concatenate([gram, self._block(gram, i, 0)])

    def enlarged(
        self, new: tuple[Array, Array], z: Float[Array, "m p"], i: Any
    ) -> tuple["Room", Array]:
        """The room with the columns of field i, and the coordinates of that field, frozen at z."""
        g, products = new
        m = len(self.span.gram)
        products = self._with(products[:m], products[m:], i, 0)
        gram = self._with(self.span.gram, products, i, 1)
        gram = self._with(gram, products.T, i, 0)
        columns = self._with(self._columns, g, i, 1)
        yg = self._with(jnp.zeros_like(gram), z, i, 1)
        return Room(Span((columns,), gram), self.p, self.cls), yg.T - yg

    @property
    def _columns(self) -> Any:
        return self.span.blocks[0]

    def _block(self, x: Array, i: Any, axis: int) -> Array:
        return lax.dynamic_slice_in_dim(x, (i + 1) * self.p, self.p, axis)

    def _with(self, x: Array, block: Array, i: Any, axis: int) -> Array:
        return lax.dynamic_update_slice_in_dim(x, block, (i + 1) * self.p, axis)


def _padded(x: Float[Array, "k k"], m: int) -> Float[Array, "m m"]:
    return jnp.pad(x, (0, m - len(x)))


def _spanned(field: Any) -> SpanSkew:
    if not isinstance(field, BorderedSkew):
        return field
    # gamma E^T - E gamma^T, where E is the corner.
    p = field.gamma.shape[1]
    eye = jnp.eye(p, dtype=field.gamma.dtype)
    return SpanSkew.of(field.gamma, eye, Span((Corner(p),), eye))


def _on_one_span(fields: Sequence[Any]) -> list[SpanSkew]:
    spanned = [_spanned(f) for f in fields]
    span = Span.joint([f.span for f in spanned])
    return [f.on(span) for f in spanned]


def _check_factor(name: str, factor: Array) -> None:
    if factor.ndim < 2 or factor.shape[-2] < factor.shape[-1] or factor.shape[-1] < 1:
        raise ValueError(
            f"{name} must have shape (n, p) or (*batch, n, p) with n >= p >= 1, got {factor.shape}."
        )
    check_real(name, factor)


def check_like(field: AbstractFrozenField, name: str, num_axes: int, point: Array) -> None:
    """Raises `ValueError` unless the point has the shape and dtype of an array of the field.

    `num_axes` is how many axes both have besides the leading ones.
    """
    factor = getattr(field, name)
    check_point(field, name, factor.ndim - num_axes, [factor.shape[-num_axes:]], point)
    if point.dtype != factor.dtype:
        raise ValueError(
            f"{type(field).__name__} of type {factor.dtype} acts on points of the same, got "
            f"{point.dtype}."
        )
