"""Matrix Lie algebras that act on square matrices from both sides: conjugations, congruences."""

import abc
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Inexact

from .._arrays import Weight
from .._numerics.cayley import congruence_by_inverse, dcayinv, solve_from_both
from .._numerics.expm import expm, expm_parts
from .._numerics.expm_both import expm_both_parts
from .._numerics.expm_source import expm_parts_with_source
from .._numerics.matmul import plus_identity, promoted, small_product
from .coordinates import BesideCayley, Cayley
from .elementwise import check_other, check_point, each, elementwise
from .matrix import AbstractMatrix, check_companion


class AbstractTwoSided(AbstractMatrix):
    """An element of a matrix Lie algebra that acts on square matrices from both sides."""

    def flow(self, point: Inexact[Array, "*batch n n"]) -> Inexact[Array, "*batch n n"]:
        def of_one(field: Any, x: Array) -> Array:
            weight, shift = field.move(x)
            return weight * x + shift

        return self._each(of_one, point)

    def increment(self, point: Inexact[Array, "*batch n n"]) -> Inexact[Array, "*batch n n"]:
        def of_one(field: Any, x: Array) -> Array:
            weight, shift = field.move(x)
            return (weight - 1) * x + shift

        return self._each(of_one, point)

    def tangent(self, point: Inexact[Array, "*batch n n"]) -> Inexact[Array, "*batch n n"]:
        return self._each(lambda field, x: field.velocity(x), point)

    def mean(self, point: Inexact[Array, "*batch n n"]) -> Inexact[Array, "*batch n n"]:
        return self._each(lambda field, x: field.average(x), point)

    def bracket(self, other: Any) -> "AbstractTwoSided":
        check_other(self, other)
        return each(lambda x, y: x.commutator(y), self._num_axes)(self, other)

    def projected(self, point: Inexact[Array, "*batch n n"]) -> Any:
        if self._num_axes:
            return elementwise(self, self._num_axes).projected(point)
        return BesideCayley(self.tangent(point), Cayley(type(self)(self.effective())))

    def cayley(self, point: Inexact[Array, "*batch n n"]) -> Any:
        effective = each(lambda field: type(self)(field.effective()), self._num_axes)(self)
        field = Cayley(effective)
        return elementwise(field, self._num_axes) if self._num_axes else field

    def dcayinv(self, other: Any) -> Any:
        """How u, this field, changes where `cay(u)` does with the matrix of the other field.

        For fields without leading axes.
        """
        return type(self)(dcayinv(self.a, other.a))

    @abc.abstractmethod
    def cayley_increment(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        """By how much `cay(u)` of this field, u, moves x; for a field without leading axes."""

    @abc.abstractmethod
    def effective(self) -> Inexact[Array, "n n"]:
        """The matrix a without the multiple of the identity that has no effect."""

    @abc.abstractmethod
    def move(self, x: Inexact[Array, "n n"]) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"]]:
        """`w, z` such that the flow of x is `w x + z`, for a field without leading axes."""

    @abc.abstractmethod
    def average(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        """`mean`, for a field without leading axes."""

    @abc.abstractmethod
    def velocity(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        """`tangent`, for a field without leading axes."""

    @abc.abstractmethod
    def commutator(self, other: Any) -> "AbstractTwoSided":
        """`bracket`, for fields without leading axes."""

    def _each(self, fun: Callable[[Any, Array], Array], point: Array) -> Array:
        n = self.a.shape[-1]
        check_point(self, "a", self._num_axes, [(n, n)], point)
        return each(fun, self._num_axes)(self, point)


class Conjugation(AbstractTwoSided):
    """The linear field `x' = a x - x a`, whose flow is `x -> exp(a) x exp(-a)`.

    It acts on a square matrix, shape `(n, n)`, and keeps its eigenvalues. Examples are isospectral
    flows such as Toda's, density matrices with `a = -1j * H`, and operators in the Heisenberg
    picture with `a = 1j * H`. (If `a` is skew-Hermitian, as for density matrices,
    `cfjax.Congruence(a)` is the same field: it is a fifth cheaper, and keeps Hermitian matrices
    Hermitian to the last bit.)

    With leading axes, shape `(*batch, n, n)`, each element moves on its own. An axis of 1 is
    broadcast.

    A flow costs 6 matrix products for exp(a) and exp(-a) together, 2 for each squaring, and 4 with
    the point: 1.2 to 1.5 times `cfjax.expm` of that size up to n = 4, and 2.1 to 2.6 times above.

    **Arguments:** `a`, shape `(*batch, n, n)`, float32, float64, complex64 or complex128. A real
    `a` may act on a complex point of the same precision.

    **Raises** `ValueError` for a shape that is not square, `TypeError` for another dtype.
    """

    def move(self, x: Inexact[Array, "n n"]) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"]]:
        # The norm is smaller.
        a = self.effective()
        weight, remainder, inverse_remainder = expm_both_parts(a)
        return _from_both_sides(weight, (a, remainder), x, (-a, inverse_remainder))

    def average(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        # exp([[a, x], [0, a]]) has the integral of exp((1 - s) a) x exp(s a) above the diagonal.
        a, x = promoted(self.effective(), x)
        exp = expm(jnp.block([[a, x], [jnp.zeros_like(x), a]]))
        return _times(exp[: len(x), len(x) :], expm(-a))

    def velocity(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        return _commutator(self.a, x)

    def effective(self) -> Inexact[Array, "n n"]:
        return _minus_identity(self.a, jnp.trace(self.a) / self.a.shape[0])

    def cayley_increment(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        u, x = promoted(self.a, x)
        change = _commutator(u, x)
        return solve_from_both(plus_identity(-u / 2), change, plus_identity(u / 2))

    def commutator(self, other: Any) -> "Conjugation":
        return Conjugation(_commutator(self.a, other.a))


class Congruence(AbstractTwoSided):
    """The affine field `x' = a x + x a^H + q`, where a^H is the conjugate transpose.

    Its flow is `x -> exp(a) x exp(a)^H` and the integral of `exp(s a) q exp(s a)^H` over s from 0
    to 1. It acts on a square matrix, shape `(n, n)`. Examples are covariances of linear stochastic
    equations, with `q` the covariance of the noise, Lyapunov's equation, density matrices, and
    metrics. A definite x stays definite, also with a semidefinite `q`. x and `q` need not be
    Hermitian; if both are, the result is Hermitian to the last bit.

    With leading axes, shape `(*batch, n, n)`, each element moves on its own. An axis of 1 is
    broadcast.

    A flow costs one dense exponential and 4 products with the point, about 1.2 to 1.8 times
    `cfjax.expm` of that size. With a source it costs 16 to 19 products and 3 for each squaring, 4
    to 6 times `cfjax.expm`.

    **Arguments:**

    - `a`: shape `(*batch, n, n)`, float32, float64, complex64 or complex128. A real `a` may act on
      a complex point of the same precision.
    - `q`: the source, with as many axes and the same precision; or None. In a sum of fields or a
      bracket None counts as zero.

    **Raises** `ValueError` for a shape that is not square or does not match, `TypeError` for
    another dtype.
    """

    q: Inexact[Array, "*#batch n n"] | None = eqx.field(
        default=None, converter=lambda q: None if q is None else jnp.asarray(q)
    )

    def __check_init__(self):
        super().__check_init__()  # First, as its errors name the cause.
        if self.q is not None:
            check_companion("q", self.q, self.a, self.a.shape[-2:])

    def move(self, x: Inexact[Array, "n n"]) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"]]:
        # The norm is smaller.
        a = self.effective()
        is_hermitian = jnp.all(x == _adjoint(x))
        source = jnp.zeros((), x.dtype)
        if self.q is None:
            weight, remainder = expm_parts(a)
        else:
            is_hermitian &= jnp.all(self.q == _adjoint(self.q))
            weight, remainder, source = expm_parts_with_source(*promoted(a, self.q))
        adjoint = _adjoint(a), _adjoint(remainder)
        weight, shift = _from_both_sides(weight, (a, remainder), x, adjoint)
        shift = jnp.add(*promoted(shift, source))
        return weight, _without_skew_part(shift, is_hermitian)

    def average(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        mean = Congruence(self.a, x).flow(jnp.zeros_like(x))
        if self.q is None:
            return mean
        # And the integral of (1 - s) exp(s a) q exp(s a)^H over s from 0 to 1.
        a, q = promoted(self.a, self.q)
        b, zero, n = -_adjoint(a), jnp.zeros_like(a), len(a)
        eye = jnp.eye(n, dtype=a.dtype)
        exp = expm(jnp.block([[a, q, zero], [zero, b, eye], [zero, zero, b]]))
        return jnp.add(*promoted(mean, _times(exp[:n, 2 * n :], expm(-b))))

    def projected(self, point: Inexact[Array, "*batch n n"]) -> Any:
        return super().projected(point) if self.q is None else None

    def cayley(self, point: Inexact[Array, "*batch n n"]) -> Any:
        return super().cayley(point) if self.q is None else None

    def effective(self) -> Inexact[Array, "n n"]:
        if not jnp.iscomplexobj(self.a):
            return self.a
        trace = jnp.trace(self.a)
        return _minus_identity(self.a, (trace - trace.conj()) / (2 * self.a.shape[0]))

    def cayley_increment(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        is_hermitian = jnp.all(x == _adjoint(x))
        u, x = promoted(self.a, x)
        moved = congruence_by_inverse(plus_identity(-u / 2), _linear_part(u, x))
        return _without_skew_part(moved, is_hermitian)

    def velocity(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        v = _linear_part(self.a, x)
        return v if self.q is None else jnp.add(*promoted(v, self.q))

    def commutator(self, other: Any) -> "Congruence":
        x, y = _with_sources([self, other])
        q = None if x.q is None else _linear_part(x.a, y.q) - _linear_part(y.a, x.q)
        return Congruence(_commutator(x.a, y.a), q)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> "Congruence":
        return super().combine(weights, _with_sources(fields))

    def _each(self, fun: Callable[[Any, Array], Array], point: Array) -> Array:
        if self.q is not None:
            check_point(self, "q", self._num_axes, [self.q.shape[-2:]], point)
        return super()._each(fun, point)


def _from_both_sides(
    weight: Array, left: tuple[Array, Array], x: Array, right: tuple[Array, Array]
) -> tuple[Array, Array]:
    """`w, z` with `w x + z = (w (I + a) + r) x (w (I + b) + t)`, for `(a, r)` and `(b, t)`.

    Products with a and b themselves are exact but for the rounding of sums, which is random.
    """
    w = weight.astype(x.dtype)
    (a, r), (b, t) = left, right
    shift = w * _times(a, x) + _times(r, x)
    product = w * x + shift
    return w, w * (shift + _times(product, b)) + _times(product, t)


def _without_skew_part(x: Array, is_rounding: Bool[Array, ""]) -> Array:
    """Removes the skew-Hermitian part where it is rounding.

    Derivatives keep theirs, as a tangent need not be Hermitian.
    """
    mean = lax.stop_gradient(x + _adjoint(x)) / 2
    return jnp.where(is_rounding, mean + (x - lax.stop_gradient(x)), x)


def _with_sources(fields: Sequence[Any]) -> Sequence[Any]:
    """The same fields, all with a source if one has it."""
    sources = [field.q for field in fields if field.q is not None]
    if len(sources) in (0, len(fields)):
        return fields
    zero = jnp.zeros_like(sources[0])
    return [
        eqx.tree_at(lambda f: f.q, f, zero, is_leaf=lambda q: q is None) if f.q is None else f
        for f in fields
    ]


def _minus_identity(a: Array, number: Array) -> Array:
    return a - number * jnp.eye(a.shape[0], dtype=a.dtype)


def _linear_part(a: Array, x: Array) -> Array:
    return _times(a, x) + _times(x, _adjoint(a))


def _commutator(x: Array, y: Array) -> Array:
    return _times(x, y) - _times(y, x)


def _times(x: Array, y: Array) -> Array:
    return small_product(*promoted(x, y))


def _adjoint(x: Array) -> Array:
    return x.conj().T
