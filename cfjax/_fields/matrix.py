"""Matrix Lie algebras, acting from the left or from the right."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Inexact

from .._field import AbstractAlgebraElement
from .._numerics.expm import expm_parts, one_norm
from .._numerics.expm_times import expm_minus_one_times
from .._numerics.matmul import matmul


class LeftMatrix(AbstractAlgebraElement):
    """The linear field `x' = a x`, whose flow is `x -> exp(a) x`.

    It acts on a vector, shape `(n,)`, or a matrix, shape `(n, k)`. Any matrix Lie algebra, real
    or complex: with a skew `a` the flow keeps orthonormal columns, with a skew-Hermitian one it
    keeps unitary ones, and so on.

    A flow costs one dense exponential, 4 or 5 products of size n and one for each squaring, and a
    product with the point. For few columns, `8 k <= n` (`16 k <= n` if complex), and a 1-norm of
    `a` up to 2.4 it costs 12 to 25 products with the point and no exponential.

    **Arguments:** `a`, shape `(n, n)`, float32, float64, complex64 or complex128. A real `a` may
    act on a complex point of the same precision.

    **Raises** `ValueError` for a shape that is not square, `TypeError` for another dtype.
    """

    a: Inexact[Array, "n n"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        _check_square(self.a)

    def flow(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return _flow(_product, self.a, point)

    def displacement(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return _displacement(_product, self.a, point)

    def tangent(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        n = len(self.a)
        if point.ndim not in (1, 2) or point.shape[0] != n:
            raise ValueError(
                f"LeftMatrix with a of shape ({n}, {n}) acts on shapes ({n},) and ({n}, k), got "
                f"{point.shape}."
            )
        return _product(self.a, point)

    def bracket(self, other: Any) -> "LeftMatrix":
        _check_other(LeftMatrix, other)
        return type(self)(_product(self.a, other.a) - _product(other.a, self.a))


class RightMatrix(AbstractAlgebraElement):
    """The linear field `x' = x a`, whose flow is `x -> x exp(a)`.

    It acts on a row, shape `(n,)`, or a matrix, shape `(k, n)`. For an attitude matrix this is an
    angular velocity in the moving frame. All else as for `LeftMatrix`.
    """

    a: Inexact[Array, "n n"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        _check_square(self.a)

    def flow(self, point: Inexact[Array, "*k n"]) -> Inexact[Array, "*k n"]:
        return _flow(_product_from_right, self.a, point)

    def displacement(self, point: Inexact[Array, "*k n"]) -> Inexact[Array, "*k n"]:
        return _displacement(_product_from_right, self.a, point)

    def tangent(self, point: Inexact[Array, "*k n"]) -> Inexact[Array, "*k n"]:
        n = len(self.a)
        if point.ndim not in (1, 2) or point.shape[-1] != n:
            raise ValueError(
                f"RightMatrix with a of shape ({n}, {n}) acts on shapes ({n},) and (k, {n}), got "
                f"{point.shape}."
            )
        return _product(point, self.a)

    def bracket(self, other: Any) -> "RightMatrix":
        _check_other(RightMatrix, other)
        # Flows from the right compose the other way round.
        return type(self)(_product(other.a, self.a) - _product(self.a, other.a))


def _check_other(side: type, other: Any) -> None:
    if not isinstance(other, side):
        raise TypeError(
            f"{side.__name__} has a bracket with another {side.__name__} only, got "
            f"{type(other).__name__}."
        )


def _check_square(a: Array) -> None:
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise ValueError(f"a must have shape (n, n), got {a.shape}.")
    if a.dtype not in (jnp.float32, jnp.float64, jnp.complex64, jnp.complex128):
        raise TypeError(f"a must be float32, float64, complex64 or complex128, got {a.dtype}.")


def _flow(product: Callable[[Array, Array], Array], a: Array, point: Array) -> Array:
    if _is_thin(a, point):
        return point + _displacement(product, a, point)
    weight, moved = _dense(product, a, point)
    return weight * point + moved


def _displacement(product: Callable[[Array, Array], Array], a: Array, point: Array) -> Array:
    def dense() -> Array:
        weight, moved = _dense(product, a, point)
        return (weight - 1) * point + moved

    if not _is_thin(a, point):
        return dense()
    return expm_minus_one_times(lambda x: product(a, x), point, one_norm(a), dense)


def _dense(product: Callable[[Array, Array], Array], a: Array, point: Array) -> tuple[Array, Array]:
    """`w, z` with `w x + z` the point that x moves to."""
    weight, rest = expm_parts(a)
    weight = weight.astype(point.dtype)
    # With a itself the product is exact but for the rounding of its sums, which is random.
    return weight, weight * product(a, point) + product(rest, point)


def _is_thin(a: Array, point: Array) -> bool:
    """Whether some 15 products with the point are cheaper than 5 of size n, as measured."""
    return (16 if jnp.iscomplexobj(point) else 8) * point.size <= a.size


def _product(a: Array, b: Array) -> Array:
    # A real matrix may meet a complex one of its own precision.
    if jnp.finfo(a.dtype).dtype == jnp.finfo(b.dtype).dtype:
        dtype = np.promote_types(a.dtype, b.dtype)
        a, b = a.astype(dtype), b.astype(dtype)
    return matmul(a, b)


def _product_from_right(a: Array, x: Array) -> Array:
    return _product(x, a)
