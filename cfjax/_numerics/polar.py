"""The nearest columns with given products."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Inexact, Real

from .cayley import without_turns
from .matmul import promoted, small_product
from .span import square
from .squaring import max_over_batch
from .vectors import unpack

# Each squares the defect, times 3/4. From a defect of 0.3 on five of them do not lead to rounding.
_MOST = 5


def polar_correction(
    y: Inexact[Array, "n k"], v: Inexact[Array, "n k"], are_orthonormal: bool
) -> tuple[Inexact[Array, "n k"], Bool[Array, ""]]:
    """v so corrected that the columns `y + v` have the products of those of y; and whether they do.

    With `are_orthonormal` they are orthonormal, which y must be up to a small error; otherwise y
    must have full rank. The defect `e = (y + v)^H (y + v) - y^H y` is as small as v, and so is its
    rounding. One correction is `v - (y + v) g^-1 e / 2` with `g = y^H y`. The next follows if e was
    above a hundredth of the root of a unit of rounding.
    """
    gram = square(y) if are_orthonormal else _times(y.conj().T, y)
    eye = jnp.eye(len(gram), dtype=gram.dtype)
    distance = gram - eye
    eps = float(jnp.finfo(gram.dtype).eps)
    if are_orthonormal:
        relative = lambda e: e  # noqa: E731
    else:
        is_identity = max_over_batch(_size(distance)) <= 1e3 * eps
        inverse = lax.cond(is_identity, lambda gram: eye, jnp.linalg.inv, gram)

        def relative(e: Array) -> Array:
            return lax.cond(is_identity, lambda e: e, lambda e: _times(inverse, e), e)

    def correct(v: Array) -> tuple[Array, Real[Array, ""]]:
        half = _times((y + v / 2).conj().T, v)
        e = half + half.conj().T
        e = relative(e + distance if are_orthonormal else e)
        return v - _times(y + v, e) / 2, _size(e)

    # The correction after a defect of this size leaves a defect of rounding; but over many steps
    # these add up, as all have one sign.
    bound = 0.25 * eps**0.5

    def turn(carry: tuple[Array, Real[Array, ""]], _: None) -> tuple[tuple[Array, Array], None]:
        v, size = carry
        is_needed = max_over_batch(size) > 0.01 * eps**0.5
        return lax.cond(is_needed, correct, lambda v: (v, size), v), None

    (v, size), _ = lax.scan(turn, correct(v), length=_MOST - 1)
    return v, size <= bound


def polar_correction_of_rows(
    y: Inexact[Array, "n k"], v: Inexact[Array, "n k"]
) -> tuple[Inexact[Array, "n k"], Bool[Array, ""]]:
    """The same for more columns than rows, which must have full rank.

    It is the unitary factor of the matrix that takes y to `y + v`, times y.
    """
    y, v = promoted(y, v)
    adjoint = y.conj().T
    taken = _times(_times(v, adjoint), jnp.linalg.inv(_times(y, adjoint)))
    taken, is_there = polar_correction(jnp.eye(len(y), dtype=y.dtype), taken, are_orthonormal=True)
    return _times(taken, y), is_there


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


def _size(x: Array) -> Real[Array, ""]:
    return jnp.max(jnp.abs(lax.stop_gradient(x)), initial=0)


def _times(x: Array, y: Array) -> Array:
    return small_product(*promoted(x, y))
