"""Matrix Lie algebras, acting from the left or from the right."""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Inexact, Real

from .._field import AbstractAlgebraElement
from .._numerics.cayley import dcayinv, solve, solve_from_right
from .._numerics.expm import expm_parts
from .._numerics.expm_multiply import Dense, expm_minus_one_multiply, row_norm
from .._numerics.matmul import by_columns, plus_identity, promoted, small_product
from .._numerics.squaring import max_over_batch
from .._numerics.vectors import computed_once
from .coordinates import Cayley, Polar, skew_defect
from .elementwise import check_other, check_point, each, elementwise


class AbstractMatrix(AbstractAlgebraElement):
    """An element of a matrix Lie algebra. A subclass defines an action on points."""

    a: Inexact[Array, "*#batch n n"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        if self.a.ndim < 2 or self.a.shape[-2] != self.a.shape[-1]:
            raise ValueError(f"a must have shape (n, n) or (*batch, n, n), got {self.a.shape}.")
        if self.a.dtype not in (jnp.float32, jnp.float64, jnp.complex64, jnp.complex128):
            raise TypeError(
                f"a must be float32, float64, complex64 or complex128, got {self.a.dtype}."
            )

    @property
    def _num_axes(self) -> int:
        return self.a.ndim - 2


def check_companion(
    name: str, array: Array, a: Inexact[Array, "*batch n n"], core: tuple[int, ...]
) -> None:
    """Raises `ValueError` or `TypeError` unless an array fits a matrix that it comes with."""
    num_axes = a.ndim - 2
    leading = array.shape[: array.ndim - len(core)]
    agrees = array.shape[array.ndim - len(core) :] == core and len(leading) == num_axes
    if not agrees or any(
        m != n and 1 not in (m, n) for m, n in zip(leading, a.shape, strict=False)
    ):
        expected = ", ".join(map(str, (*a.shape[:num_axes], *core)))
        raise ValueError(
            f"{name} must have shape ({expected}{',' if a.ndim + len(core) == 3 else ''}) with a "
            f"of shape {a.shape}, up to leading axes of 1, got {array.shape}."
        )
    precision = jnp.finfo(a.dtype).dtype
    if not jnp.issubdtype(array.dtype, jnp.inexact) or jnp.finfo(array.dtype).dtype != precision:
        raise TypeError(
            f"{name} must be real or complex of the precision of a, {precision}, got {array.dtype}."
        )


class AbstractOneSided(AbstractMatrix):
    """An element of a matrix Lie algebra that multiplies points from one side."""

    # The axis of a matrix that it multiplies.
    axis: ClassVar[int]

    @staticmethod
    @abc.abstractmethod
    def act(a: Array, x: Array) -> Array:
        """The product of a matrix with a point, from the side that this class acts from."""

    def flow(self, point: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        return self._each(partial(exp_times, type(self)), point)

    def increment(self, point: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        return self._each(partial(exp_minus_one_times, type(self)), point)

    def tangent(self, point: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        return self._each(self.act, point)

    def bracket(self, other: Any) -> "AbstractOneSided":
        check_other(self, other)
        # Flows from the right compose in the reverse order, and so do these products.
        act = each(self.act, self._num_axes)
        return type(self)(act(self.a, other.a) - act(other.a, self.a))

    def projected(self, point: Inexact[Array, "..."]) -> Any:
        if self._num_axes:
            return elementwise(self, self._num_axes).projected(point)
        # In a batch XLA would compute the matrix for each of these anew, entry by entry.
        a = computed_once(self.a)
        velocity, trace = type(self)(a).tangent(point), None
        if jnp.iscomplexobj(velocity) and point.shape == a.shape:
            trace = jnp.trace(a).astype(velocity.dtype)
        return Polar(velocity, skew_defect(a), trace, are_rows=self.axis == -1)

    def cayley(self, point: Inexact[Array, "..."]) -> Any:
        trace = None
        # The transform keeps every quadratic form, but determinants only where they follow from
        # one up to their sign.
        if self.a.shape[-1] == 3 and jnp.iscomplexobj(self.a):
            trace = jnp.trace(self.a, axis1=-2, axis2=-1)
        field = Cayley(self, trace)
        return elementwise(field, self._num_axes) if self._num_axes else field

    def dcayinv(self, other: Any) -> Any:
        """How u, this field, changes where `cay(u)` does with the matrix of the other field.

        For fields without leading axes.
        """
        return type(self)(dcayinv(self.a, other.a))

    @abc.abstractmethod
    def cayley_increment(self, x: Inexact[Array, "..."]) -> Inexact[Array, "..."]:
        """By how much `cay(u)` of this field, u, moves x; for a field without leading axes."""

    def _each(self, fun: Callable[[Array, Array], Array], point: Array) -> Array:
        n = self.a.shape[-1]
        matrix = (n, "k") if self.axis == 0 else ("k", n)
        check_point(self, "a", self._num_axes, [(n,), matrix], point)
        return each(fun, self._num_axes)(self.a, point)


class LeftMatrix(AbstractOneSided):
    """The linear field `x' = a x`, whose flow is `x -> exp(a) x`.

    It acts on a vector, shape `(n,)`, or a matrix, shape `(n, k)`. `a` may be from any matrix Lie
    algebra, real or complex: if `a` is skew, the flow keeps columns orthonormal, if it is
    skew-Hermitian, unitary, and so on.

    With leading axes, shape `(*batch, n, n)`, it acts on shapes `(*batch, n)` and `(*batch, n, k)`:
    each element moves on its own, as the links of a lattice do. An axis of 1 is broadcast, and its
    exponential is computed once.

    A flow costs one dense exponential, 4 or 5 products of size n and one for each squaring, and a
    product with the point. For n = 2 and 3 the exponential costs 1 product and some 70 products of
    numbers. For few columns, `16 k <= n`, it costs 10 to 25 products with the point for norms up to
    2.4 and 10 for each unit beyond, or 1.4 to 2.3 if `a` is skew-Hermitian; the norm is the largest
    sum of absolute values in a row. A flow that would take more than 2 n products, or 3 n if `a` is
    complex, uses the exponential.

    **Arguments:** `a`, shape `(*batch, n, n)`, float32, float64, complex64 or complex128. A real
    `a` may act on a complex point of the same precision.

    **Raises** `ValueError` for a shape that is not square, `TypeError` for another dtype.
    """

    axis: ClassVar[int] = 0

    @staticmethod
    def act(a: Inexact[Array, "n n"], x: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return small_product(*promoted(a, x))

    def cayley_increment(self, x: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return solve(plus_identity(-self.a / 2), self.act(self.a, x))


class RightMatrix(AbstractOneSided):
    """The linear field `x' = x a`, whose flow is `x -> x exp(a)`.

    It acts on a row, shape `(*batch, n)`, or a matrix, shape `(*batch, k, n)`. For an attitude
    matrix this is an angular velocity in the moving frame. Otherwise it is like `LeftMatrix`.
    """

    axis: ClassVar[int] = -1

    @staticmethod
    def act(a: Inexact[Array, "n n"], x: Inexact[Array, "*k n"]) -> Inexact[Array, "*k n"]:
        return small_product(*promoted(x, a))

    def dcayinv(self, other: "RightMatrix") -> "RightMatrix":
        # The body's frame has the other sign.
        return RightMatrix(dcayinv(-self.a, other.a))

    def cayley_increment(self, x: Inexact[Array, "*k n"]) -> Inexact[Array, "*k n"]:
        return solve_from_right(self.act(self.a, x), plus_identity(-self.a / 2))


def exp_times(
    cls: type[AbstractOneSided],
    a: Array,
    point: Array,
    bound: Real[Array, ""] | None = None,
    is_skew: bool | None = None,
) -> Array:
    """The flow of one point along one matrix.

    `bound` is a bound on the 2-norm of `a`. `is_skew` says whether `a` is skew-Hermitian; if it is
    None, the program tests it.
    """
    if _is_thin(a, point):
        return point + exp_minus_one_times(cls, a, point, bound, is_skew)
    weight, shift = _dense(cls, a, point)
    return weight * point + shift


def exp_minus_one_times(
    cls: type[AbstractOneSided],
    a: Array,
    point: Array,
    bound: Real[Array, ""] | None = None,
    is_skew: bool | None = None,
) -> Array:
    """`exp_times` less the point."""

    def dense() -> Array:
        weight, shift = _dense(cls, a, point)
        return (weight - 1) * point + shift

    if not _is_thin(a, point):
        return dense()
    if cls.axis == 0:
        product = by_columns(a)
    else:
        columns = by_columns(a.T)
        product = lambda x: columns(x.T).T  # noqa: E731
    constant = lax.stop_gradient(a)
    norm = max_over_batch(row_norm(constant))
    skew = _is_skew(constant, norm) if is_skew is None else is_skew
    if bound is not None:
        norm = jnp.minimum(norm, bound)
    # The dense exponential takes as long as so many products or more, as measured.
    max_products = (3 if jnp.iscomplexobj(a) else 2) * a.shape[0]
    dense_flow = Dense(max_products, dense)
    return expm_minus_one_multiply(product, point, norm, is_skew=skew, dense=dense_flow)


def _dense(cls: type[AbstractOneSided], a: Array, point: Array) -> tuple[Array, Array]:
    """`w, z` such that the flow of the point x is `w x + z`."""
    weight, remainder = expm_parts(a)
    weight = weight.astype(point.dtype)
    # The product with a itself is exact but for the rounding of its sums, which is random.
    return weight, weight * cls.act(a, point) + cls.act(remainder, point)


def _is_thin(a: Array, point: Array) -> bool:
    """Whether some 15 products with the point are cheaper than 5 of size n, as measured."""
    return 16 * point.size <= a.size


def _is_skew(a: Array, norm: Array) -> Bool[Array, ""]:
    """Whether all matrices of a batch are skew-Hermitian to rounding, if their norm exceeds 1."""

    def is_skew() -> Array:
        # So small a Hermitian part changes a Chebyshev series by rounding.
        defect = row_norm(a + a.conj().T)
        return max_over_batch(defect) <= 8 * jnp.finfo(norm.dtype).eps * norm

    # Below it a Taylor series takes as few products.
    return lax.cond(norm > 1, is_skew, lambda: jnp.zeros((), bool))
