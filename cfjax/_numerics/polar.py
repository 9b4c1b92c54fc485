"""The nearest columns with given products."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Inexact, Real

from .cayley import without_turns
from .matmul import promoted, small_product
from .span import square
from .squaring import max_over_batch
from .vectors import unpack

# Each cubes the defect, times 5/8. Four of them lead to rounding from a defect of -0.6 to 0.8.
_MOST = 4


class Products(NamedTuple):
    """The products of columns with each other, and the inverse of their matrix."""

    products: Inexact[Array, "k k"]
    inverse: Inexact[Array, "k k"]

    @classmethod
    def of(cls, y: Inexact[Array, "n k"]) -> "Products":
        products = _times(y.conj().T, y)
        return cls(products, jnp.linalg.inv(products))


def polar_correction(
    y: Inexact[Array, "n k"],
    v: Inexact[Array, "n k"],
    are_orthonormal: bool,
    kept: Products | None = None,
) -> tuple[Inexact[Array, "n k"], Bool[Array, ""]]:
    """v so corrected that the columns `y + v` have the products of those of y; and whether they do.

    With `are_orthonormal` they are orthonormal, which y must be up to a small error; otherwise y
    must have full rank. With `kept` they have these products, from which those of y differ by
    rounding and whose derivative is not taken. The defect `e = (y + v)^H (y + v) - y^H y` is as
    small as v, and so is its rounding. One correction is `v - (y + v) (f / 2 - 3/8 f^2)` with
    `f = g^-1 e` and `g = y^H y`, Taylor's polynomial of the inverse of the root of `1 + f`. Others
    follow if f was above a 25th of the cube root of a unit of rounding.
    """
    distance, inverse = 0, None
    if are_orthonormal:
        gram = square(y)
        distance = gram - jnp.eye(len(gram), dtype=gram.dtype)
    elif kept is None:
        inverse = Products.of(y).inverse
    else:
        gram = _times(y.conj().T, y)
        distance, inverse = lax.stop_gradient(gram - kept.products), _inverse(gram, kept.inverse)

    def correct(v: Array) -> tuple[Array, Real[Array, ""]]:
        half = _times((y + v / 2).conj().T, v)
        e = half + half.conj().T + distance
        e = e if inverse is None else _times(inverse, e)
        return v - _times(y + v, _half(e)), _size(e)

    return _corrected(correct, v)


def polar_correction_of_rows(
    y: Inexact[Array, "n k"], v: Inexact[Array, "n k"]
) -> tuple[Inexact[Array, "n k"], Bool[Array, ""]]:
    """The same for more columns than rows, which must have full rank.

    It is the unitary factor of the matrix that takes y to `y + v`, times y.
    """
    y, v = promoted(y, v)
    adjoint = y.conj().T
    taken = _times(_times(v, adjoint), jnp.linalg.inv(_times(y, adjoint)))

    def correct(v: Array) -> tuple[Array, Real[Array, ""]]:
        # Not by the products of 1 + v/2, whose rounding is the same in all steps, and would add up.
        e = v + v.conj().T + _times(v.conj().T, v)
        half = _half(e)
        return v - (half + _times(v, half)), _size(e)

    taken, is_there = _corrected(correct, taken)
    return _times(taken, y), is_there


def _corrected(
    correct: Callable[[Array], tuple[Array, Real[Array, ""]]], v: Array
) -> tuple[Array, Bool[Array, ""]]:
    """v after a correction, or after four where one is not enough, and whether these are.

    `correct(v)` returns v after a correction, and the defect before.
    """
    eps = float(jnp.finfo(v.dtype).eps)
    # The correction after a defect of this size leaves a defect of rounding; but over many steps
    # these add up, as all have one sign, and no further correction is above the rounding of v.
    bound = 0.4 * eps ** (1 / 3)

    def turn(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], None]:
        return correct(carry[0]), None

    def more(once: tuple[Array, Array]) -> tuple[Array, Array]:
        return lax.scan(turn, once, length=_MOST - 1)[0]

    once = correct(v)
    is_needed = max_over_batch(once[1]) > bound / 10
    v, size = lax.cond(is_needed, more, lambda once: once, once)
    return v, size <= bound


def phase_correction(
    y: Complex[Array, "n n"], v: Complex[Array, "n n"], trace: Complex[Array, ""]
) -> Complex[Array, "n n"]:
    """v so corrected that the determinant of `y + v` is that of y times the phase of `exp(trace)`.

    `y + v` has the products of the columns of y, so only the phase may differ.
    """
    ratio = _phase_of_determinant(y + v) * _phase_of_determinant(y).conj()
    zero = jnp.zeros_like(ratio.real)
    missing = without_turns(lax.complex(zero, trace.imag - jnp.angle(ratio))) / len(y)
    return v + jnp.expm1(missing) * (y + v)


def _phase_of_determinant(m: Complex[Array, "n n"]) -> Complex[Array, ""]:
    """A number with the phase of the determinant."""
    n = len(m)
    if n > 3:
        return jnp.linalg.slogdet(m)[0]
    x = unpack(m.reshape(n * n))
    if n == 1:
        return x[0]
    if n == 2:
        return x[0] * x[3] - x[1] * x[2]
    cyclic = (0, 1, 2), (1, 2, 0), (2, 0, 1)
    a, b, c = (x[i] * (x[3 + j] * x[6 + k] - x[3 + k] * x[6 + j]) for i, j, k in cyclic)
    return a + b + c


@jax.custom_jvp
def _inverse(gram: Inexact[Array, "k k"], inverse: Inexact[Array, "k k"]) -> Array:
    """The inverse, which is known, with its derivative."""
    # In the batch if the derivative is: otherwise JAX 0.12 sums that of all members in each.
    return jnp.where(True, inverse, gram)


@_inverse.defjvp
def _(primals, tangents):
    (gram, inverse), (tangent, _) = primals, tangents
    return _inverse(gram, inverse), -_times(_times(inverse, tangent), inverse)


def _half(e: Inexact[Array, "k k"]) -> Inexact[Array, "k k"]:
    """`1 - (1 + e)^(-1/2)` up to the third power of e."""
    return e / 2 - 0.375 * _times(e, e)


def _size(x: Array) -> Real[Array, ""]:
    return jnp.max(jnp.abs(lax.stop_gradient(x)), initial=0)


def _times(x: Array, y: Array) -> Array:
    return small_product(*promoted(x, y))
