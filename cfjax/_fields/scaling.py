"""Growth, decay and phases: entries that are multiplied."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from .._field import AbstractAlgebraElement
from .._numerics.matmul import promoted
from .._numerics.transforms import DTYPES
from .elementwise import check_other


class Scaling(AbstractAlgebraElement):
    """The field `x' = rate x`, entry by entry, whose flow is `x -> exp(rate) x`.

    A real rate makes entries grow or decay, and no step changes their sign. An imaginary rate turns
    the phases of complex entries, and keeps their moduli to a unit of rounding in each flow. Each
    entry is multiplied by a factor that is off by a few units of rounding, so small entries are as
    accurate, relative to their size, as large ones.

    Examples are populations whose rates depend on each other, and the potential of a Schrödinger
    equation, `Scaling(-1j * v)`, as one term of `cfjax.Strang`. The potential may depend on
    `abs(psi)`, which is constant along such a flow: so the flow is exact.

    The state may have any shape. `rate` is broadcast to it as in NumPy, from the last axis. All
    elements commute. So every explicit Runge-Kutta method is a Munthe-Kaas method without
    corrections, which acts on the logarithms of the entries. A flow costs an exponential for each
    entry of `rate`, and a product for each entry of the state.

    **Arguments:** `rate`, shaped like the state, or with fewer axes or axes of 1. float32, float64,
    complex64 or complex128, in the precision of the state. A complex rate needs a complex state.

    **Raises** `TypeError` for another dtype. When it acts on a point, `ValueError` for a shape that
    `rate` does not broadcast to, `TypeError` for another precision.
    """

    rate: Inexact[Array, "*rate"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        if self.rate.dtype.name not in DTYPES:
            raise TypeError(f"rate must be one of {', '.join(DTYPES)}, got {self.rate.dtype}.")

    # There is no increment: point + increment would keep absolute accuracy only, and a sum that
    # rounds may change a sign.
    def flow(self, point: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        return self._times(jnp.exp(self.rate), point)

    def tangent(self, point: Inexact[Array, "*point"]) -> Inexact[Array, "*point"]:
        return self._times(self.rate, point)

    def bracket(self, other: Any) -> "Scaling":
        check_other(self, other)
        return Scaling(jnp.zeros_like(self.rate))

    def dexpinv(self, other: Any, degree: int) -> "Scaling":
        # All brackets are zero.
        return other

    def _times(self, factor: Array, point: Array) -> Array:
        """The product with a factor that has the shape of the rate."""
        rate = self.rate
        ones = (1,) * (point.ndim - rate.ndim)
        shape = ones + rate.shape
        if len(shape) != point.ndim or any(
            n not in (1, m) for n, m in zip(shape, point.shape, strict=True)
        ):
            hint = ""
            if rate.shape == point.shape[: rate.ndim]:
                hint = f" For rates along the first axes give rate the shape {rate.shape + ones}."
            raise ValueError(
                f"Scaling with rate of shape {rate.shape} acts on the shapes that rate broadcasts "
                f"to, got {point.shape}.{hint}"
            )
        if jnp.finfo(rate.dtype).dtype != jnp.finfo(point.dtype).dtype:
            raise TypeError(
                f"rate must have the precision of the point, {point.dtype}, got {rate.dtype}."
            )
        factor, point = promoted(factor.reshape(shape), point)
        return factor * point
