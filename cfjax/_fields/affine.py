"""Affine fields with a linear part that a transform makes diagonal."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from .._arrays import Weight, describe, struct
from .._field import AbstractAlgebraElement, combine
from .._numerics.checks import differ, error_where
from .._numerics.phi import phi_1, phis
from .._numerics.transforms import DTYPES, AbstractTransform, TensorTransform
from .semilinear import AbstractSemilinearField


class Affine(AbstractAlgebraElement, AbstractSemilinearField):
    """The field `x' = alpha M x + b` with a fixed operator M, for stiff semilinear problems.

    M is diagonal in the coefficients of a transform, with the eigenvalues `spectrum`. The flow of
    the field is `exp(alpha M) x + phi_1(alpha M) b` with `phi_1(z) = (exp(z) - 1) / z`, exact
    however stiff M is. So to solve `u' = M u + g(u)` return
    `Affine(g(u), spectrum, transform)`, and use `cfjax.ETD54`. On a grid the transform is a
    `cfjax.TensorTransform` and u has the shape of the grid.

    M should contain at least four fifths of the stiffness, or half for `CF4`. So if a coefficient
    varies, use its largest value in M, not its mean.

    Boundary values and fluxes that are constant in time may be in b, divided by `dx^2`. Subtract
    those that vary, by a smooth w that has them: in b they would lower the order, of CF4 to two.

    Without a transform the state and `b` are the coefficients themselves, and a flow costs an
    exponential, a division and a polynomial for each eigenvalue. With a transform they are points.
    A step then works in coefficients: it transforms the start, each b, and each point at which it
    evaluates the field or ends, so `cfjax.CF4` takes 9 transforms. Outside of a step a flow takes
    three. A state of coefficients needs transforms only for g.

    The coordinates are `(alpha, b)`. **The spectrum is not a coordinate**: a linear combination has
    the spectrum of its first field, so the spectrum must not depend on time or state. It may depend
    on `args`, and has a derivative. The bracket is `[(a, b), (a', b')] = (0, M (a b' - a' b))`: a
    method that needs brackets multiplies by M, which makes the method stiff.

    **Arguments:**

    - `b`: shaped like the state, `(n,)` or `(n, k)` or any other shape. float32, float64,
      complex64 or complex128.
    - `spectrum`: the eigenvalues, shaped like the coefficients of `b` or, if these have more axes,
      like their first axes: with shape `(m,)` every column has the same eigenvalues. It has all
      axes that a `cfjax.TensorTransform` transforms. Real, or complex if the coefficients are.
    - `transform`: a `cfjax.AbstractTransform`, for example `cfjax.SineTransform()` or that of
      `cfjax.diagonalised`, or None. A transform of your own provides `forward(point)`, the
      coefficients, and `inverse(coefficients)`.
    - `alpha`: a real scalar, the factor of M.

    **Raises** `ValueError` for shapes that do not match, `TypeError` for dtypes that do not match,
    or for another kind of transform.

    Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
    Section 3.3, doi:10.1016/S0167-739X(02)00161-9; Munthe-Kaas, High order Runge-Kutta methods on
    manifolds, Appl. Numer. Math. 29 (1999), doi:10.1016/S0168-9274(98)00030-0.
    """

    alpha: Inexact[Array, ""]
    b: Inexact[Array, "*point"]
    spectrum: Inexact[Array, "*coefficients"]
    transform: AbstractTransform | None

    def __init__(
        self,
        b: Inexact[Array | np.ndarray, "*point"],
        spectrum: Inexact[Array | np.ndarray, "*coefficients"],
        transform: AbstractTransform | None = None,
        *,
        alpha: Any = 1.0,
    ):
        self.b, self.spectrum, self.transform = jnp.asarray(b), jnp.asarray(spectrum), transform
        if self.b.dtype.name not in DTYPES:
            raise TypeError(f"b must be one of {', '.join(DTYPES)}, got {self.b.dtype}.")
        if transform is not None and not isinstance(transform, AbstractTransform):
            raise TypeError(f"transform must be a cfjax.AbstractTransform, got {transform!r}.")
        # A Python number takes the precision of the field.
        precision = jnp.finfo(self.b.dtype).dtype
        is_number = isinstance(alpha, int | float)
        self.alpha = jnp.asarray(alpha, precision) if is_number else jnp.asarray(alpha)
        if self.alpha.shape != () or self.alpha.dtype != precision:
            raise ValueError(
                f"alpha must be a real scalar of the precision of b, {precision}, got "
                f"{self.alpha.dtype} of shape {self.alpha.shape}."
            )
        c = jax.eval_shape(self._coefficients, self.b)
        axes = min(1, c.ndim)
        if isinstance(transform, TensorTransform):
            # One with fewer axes would leave an operator out, which a square grid would not show.
            axes = len(transform.transforms)
        if (
            not axes <= self.spectrum.ndim <= c.ndim
            or self.spectrum.shape != c.shape[: self.spectrum.ndim]
        ):
            shapes = " or ".join(str(c.shape[:ndim]) for ndim in range(c.ndim, axes - 1, -1))
            raise ValueError(
                f"spectrum must have the shape {shapes} of the coefficients of b or of their first "
                f"axes, got {self.spectrum.shape}."
            )
        if self.spectrum.dtype not in (c.dtype, precision):
            raise TypeError(
                f"spectrum must be {precision} or have the dtype of the coefficients of b, "
                f"{c.dtype}, got {self.spectrum.dtype}."
            )

    def flow(self, point: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        self._check(point)
        z = self._exponent()
        x, b = self._coefficients(point), self._coefficients(self.b)
        return self._point(_times(jnp.exp(z), x) + _times(phi_1(z), b))

    def tangent(self, point: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        self._check(point)
        return self._point(_times(self._exponent(), self._coefficients(point))) + self.b

    def functions(self, pairs: Sequence[tuple[float, int]]) -> list[Array]:
        nodes = sorted({c for c, _ in pairs})
        z = jnp.stack([c * self._exponent() for c in nodes])
        values = phis(z, max(k for _, k in pairs))
        return [values[k][nodes.index(c)] for c, k in pairs]

    def times(self, function: Array, x: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        return self._point(_times(function, self._coefficients(x)))

    def rest(self, first: Any, point: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        # The alpha of a field may vary, though mostly it does not.
        b = _checked_b(self, first)
        change = (self.alpha - first.alpha).astype(self.spectrum.dtype) * self.spectrum
        return b + self._point(_times(change, self._coefficients(point)))

    def to_chart(self, point: Array, earlier: Sequence[Any]) -> tuple["Affine", Array]:
        if self.transform is None:
            return self, point
        if earlier:
            return _InCoefficients(self), point
        self._check(point)
        return _InCoefficients(self), self._coefficients(point)

    def bracket(self, other: Any) -> "Affine":
        # The commutator of the matrices [[alpha M, b], [0, 0]].
        b = combine((self.alpha, -other.alpha), (other.b, self.b))
        c = self._point(_times(self.spectrum, self._coefficients(b)))
        return self._with(jnp.zeros_like(self.alpha), c)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> "Affine":
        bs = [_checked_b(field, fields[0]) for field in fields]
        alpha = combine(weights, [field.alpha for field in fields])
        return fields[0]._with(alpha, combine(weights, bs))

    def _check(self, point: Array) -> None:
        if point.shape != self.b.shape or point.dtype != self.b.dtype:
            raise ValueError(
                f"Affine acts on points like its b, {self.b.dtype} of shape {self.b.shape}, got "
                f"{point.dtype} of shape {point.shape}."
            )

    def _with(self, alpha: Array, b: Array) -> "Affine":
        return eqx.tree_at(lambda field: (field.alpha, field.b), self, (alpha, b))

    def _exponent(self) -> Array:
        return self.alpha.astype(self.spectrum.dtype) * self.spectrum

    def _coefficients(self, point: Array) -> Array:
        return point if self.transform is None else self.transform.forward(point)

    def _point(self, coefficients: Array) -> Array:
        return coefficients if self.transform is None else self.transform.inverse(coefficients)


class _InCoefficients(Affine):
    """A field with a transform, in the chart of a step: its b and points are coefficients."""

    is_entrywise: ClassVar[bool] = True

    def __init__(self, field: Affine):
        self.alpha, self.spectrum, self.transform = field.alpha, field.spectrum, field.transform
        self.b = field._coefficients(field.b)

    def tangent(self, point: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        # At a state, as in every chart.
        return super()._point(super().tangent(super()._coefficients(point)))

    def to_chart(self, point: Array, earlier: Sequence[Any]) -> tuple["Affine", Array]:
        return self, point

    def from_chart(self, point: Array) -> Array:
        return super()._point(point)

    def _coefficients(self, point: Array) -> Array:
        return point

    def _point(self, coefficients: Array) -> Array:
        return coefficients


def _checked_b(field: Affine, first: Affine) -> Array:
    """The b of a field, with an error if its operator is not that of the first field."""
    operators = [(f.spectrum, f.transform) for f in (first, field)]
    # Arrays are compared by shape here.
    if struct(operators[0]) != struct(operators[1]) or struct(first.b) != struct(field.b):
        raise ValueError(
            "Affine fields that are added must have one operator, got the spectra and "
            f"transforms {describe(operators[0])} and {describe(operators[1])}."
        )
    # Most fields close over one array, and need no check of its values.
    if field.spectrum is first.spectrum:
        return field.b
    return error_where(
        field.b,
        differ(field.spectrum, first.spectrum),
        "Affine fields that are added must have one spectrum: it may not depend on time or "
        "state, and the terms of a diffrax.MultiTerm must share it.",
    )


def _times(diagonal: Array, coefficients: Array) -> Array:
    columns = (1,) * (coefficients.ndim - diagonal.ndim)
    return diagonal.reshape(*diagonal.shape, *columns).astype(coefficients.dtype) * coefficients
