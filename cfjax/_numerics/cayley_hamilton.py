"""The exponential of a 2 x 2 or 3 x 3 matrix by the theorem of Cayley and Hamilton.

A matrix is a root of its own characteristic polynomial, `a^n = c_(n-1) a^(n-1) + .. + c_0`. So a
power series in `a` is a polynomial of degree n - 1 in it, whose coefficients are power series in
the numbers c. These are entire functions, so equal eigenvalues need no special case.
"""

import functools
import operator
from fractions import Fraction
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact

from .expm_series import taylor_degree
from .matmul import plus_identity, small_product
from .squaring import exponent, magnitude, squared, squarings
from .vectors import materialised, unpack

# The largest sizes without a squaring: see `_characteristic`. For skew-Hermitian matrices this is a
# Frobenius norm of 2^½. The Taylor polynomial is for a larger norm, as the sizes bound the
# eigenvalues of other matrices and not their norms.
_SIZES = (2.0, 0.56)
_DEGREE = {precision: taylor_degree(precision, 1.7) for precision in ("float32", "float64")}

# A real number, or the two parts of a complex one, as XLA's complex arithmetic is slow.
_Number = tuple[Array, ...]


@jax.jit  # So that the exponentials of a step are traced once.
def expm_parts(
    a: Inexact[Array, "n n"],
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"]]:
    """`expm.expm_parts` for n = 2 or 3.

    **Cost:** a matrix product, 70 products of numbers, and a matrix product for each of s
    squarings. s = ⌈log₂(‖a‖ / 2^½)⌉ ≥ 0 in the Frobenius norm if a is Hermitian or skew-Hermitian.
    A change of units, `d a d^-1` with d diagonal, does not alter s.
    """
    weight, (remainder,) = _parts(a, both=False)
    return weight, remainder


@jax.jit
def expm_both_parts(
    a: Inexact[Array, "n n"],
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"], Inexact[Array, "n n"]]:
    """`expm_both.expm_both_parts` for n = 2 or 3."""
    weight, (plus, minus) = _parts(a, both=True)
    return weight, plus, minus


def _parts(a: Array, *, both: bool) -> tuple[Array, list[Array]]:
    c, s, scale = _scaled(a)
    square = small_product(a, a)
    matrices = [(a, c)]
    if both:
        # The k-th coefficient from the end has degree k in a.
        matrices += [(-a, [x if (len(c) - j) % 2 == 0 else -x for j, x in enumerate(c)])]
    remainders = [_taylor(x, square, c, scale) for x, c in matrices]

    def exponentials(remainders: list[Array]) -> list[Array]:
        pairs = zip(remainders, matrices, strict=True)
        return [plus_identity(r + _times_real(scale, x)) for r, (x, _) in pairs]

    return (s == 0).astype(a.dtype), squared(remainders, exponentials, s)


def _scaled(a: Array) -> tuple[list[Array], Array, Array]:
    """The `c_0 .. c_(n-1)` of a times 2^-s, the number of squarings s, and 2^-s."""
    c, sizes = _characteristic(a)
    sizes = [lax.stop_gradient(size) / most for size, most in zip(sizes, _SIZES, strict=False)]
    # The sizes are of degree 2 and 3 in a.
    s = functools.reduce(jnp.maximum, map(exponent, sizes, (2, 3)))
    s, scale = squarings(s, sizes[0].dtype)
    factor = scale
    for j in reversed(range(len(c))):
        c[j] = _times_real(factor, c[j])
        factor = factor * scale
    return c, s, scale


def _characteristic(a: Array) -> tuple[list[Array], list[Array]]:
    """The numbers `c_0 .. c_(n-1)`, and the sizes of the matrix.

    The sizes are `sum_ij |a_ij a_ji|` and, for n = 3, the sum of both `|a_ij a_jk a_ki|`, each up
    to a factor 2^½. In suitable units no entry is larger than the largest geometric mean over these
    cycles, and the exponentials here and their rounding errors only scale with the units. For a
    skew-Hermitian matrix the first size is the squared Frobenius norm, which bounds the second.
    """
    n = a.shape[0]
    entries = unpack(a.reshape(n * n))
    x = {(i, j): entries[n * i + j] for i in range(n) for j in range(n)}
    pairs = {(i, j): x[i, j] * x[j, i] for i in range(n) for j in range(i, n)}
    minors = [pair - x[i, i] * x[j, j] for (i, j), pair in pairs.items() if i < j]
    squares = _plus(*((1 + (i < j)) * magnitude(pair) for (i, j), pair in pairs.items()))
    if n == 2:
        return [minors[0], x[0, 0] + x[1, 1]], [squares]
    around = [x[0, 1] * x[1, 2] * x[2, 0], x[0, 2] * x[2, 1] * x[1, 0]]
    others = x[0, 0] * minors[2] + x[2, 2] * pairs[0, 1] + x[1, 1] * pairs[0, 2]
    c = [around[0] + around[1] - others, _plus(*minors), x[0, 0] + x[1, 1] + x[2, 2]]
    return c, [squares, _plus(*map(magnitude, around))]


def _times_real(factor: Array, x: Array) -> Array:
    return lax.complex(factor * x.real, factor * x.imag) if jnp.iscomplexobj(x) else factor * x


def _taylor(a: Array, square: Array, c: list[Array], scale: Array) -> Array:
    """`exp(b) - I - b` for `b = scale * a` and the `c` of b."""
    n = a.shape[0]
    # exp(b) = I + b + c_0 f_n I + (c_1 f_n + c_0 f_(n+1)) b + ..
    f = _series(1, 2, n, c)
    eye = jnp.eye(n, dtype=a.dtype)
    if n == 2:
        return (c[0] * f[0]) * eye + _times_real(scale, c[1] * f[0] + c[0] * f[1]) * a
    # Scales numbers and not the matrix, which XLA would scale again for every product.
    linear = _times_real(scale, c[1] * f[1] + c[0] * f[2]) * a
    linear = linear + _times_real(scale * scale, f[0]) * square
    return (c[0] * f[1]) * eye + linear


def _series(
    m: int, first: int, count: int, c: list[Inexact[Array, ""]]
) -> list[Inexact[Array, ""]]:
    """`f_k = sum_i h_i / (i + k)!` for k = first, first + 1, and so on.

    `h_i` are the coefficients of the power series of g^m with
    `g(x) = 1 / (1 - c_(n-1) x - .. - c_0 x^n)`.
    """
    # Otherwise every use of one of them would compute all of them again.
    return materialised(_series_of((m, first, count), c))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series_of(which: tuple[int, int, int], c: list[Array]) -> list[Array]:
    m, first, count = which
    is_complex = jnp.iscomplexobj(c[0])
    parts = [(x.real, x.imag) if is_complex else (x,) for x in c]
    zero = jnp.zeros_like(parts[0][0])
    top = _DEGREE[zero.dtype.name]
    # Backwards in k: `f_k` of g^m is that of g^(m-1) plus the next ones times c.
    levels: list[dict[int, _Number]] = [{} for _ in range(m)]
    for k in range(top, first - 1, -1):
        rounded, error = _reciprocal_of_factorial(k, zero.dtype)
        total: _Number = (zero + rounded, zero)[: len(parts[0])]
        for level in levels:
            later = [(x, level.get(k + len(c) - j)) for j, x in enumerate(parts)]
            products = [_times(x, y) for x, y in later if y is not None]
            if level is levels[0] and 2 < k < 6:
                products[0] = (products[0][0] + error, *products[0][1:])
            # The largest summand last, for the rounding.
            total = level[k] = _sum(*products, total)
    values = [levels[-1][k] for k in range(first, first + count)]
    return [lax.complex(*x) if is_complex else x[0] for x in values]


@_series_of.defjvp
def _(which, primals, tangents):
    m, first, count = which
    (c,), (c_dot,) = primals, tangents
    n = len(c)
    # The derivative of g^m with respect to c_j is m x^(n-j) g^(m+1).
    slopes = _series(m + 1, first + 1, count + n - 1, c)
    tangents_out = [
        m * _plus(*(slopes[k + n - j - 1] * c_dot[j] for j in range(n))) for k in range(count)
    ]
    return _series_of(which, c), tangents_out


def _reciprocal_of_factorial(k: int, dtype: np.dtype) -> tuple[float, float]:
    """`1 / k!`, rounded to the dtype, and the rounding error.

    The error is the same in every step. Without a correction for it in 1/3!, 1/4! and 1/5! unitary
    matrices would drift 40 times as fast.
    """
    exact = Fraction(1, factorial(k))
    rounded = float(dtype.type(exact))
    return rounded, float(exact - Fraction(rounded))


def _times(x: _Number, y: _Number) -> _Number:
    if len(x) == 1:
        return (x[0] * y[0],)
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _sum(*numbers: _Number) -> _Number:
    return tuple(_plus(*parts) for parts in zip(*numbers, strict=True))


def _plus(*terms: Array) -> Array:
    return functools.reduce(operator.add, terms)
