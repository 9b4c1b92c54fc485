"""The exponential of a 2 x 2 or 3 x 3 matrix by the theorem of Cayley and Hamilton.

A matrix is a root of its own characteristic polynomial, `a^n = c_(n-1) a^(n-1) + .. + c_0`. So what
is a power series in `a` is a polynomial of degree n - 1 in it, whose coefficients are power series
in the numbers c. These are entire functions, and nothing happens where eigenvalues meet.
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

from .matmul import plus_identity, small_product
from .squaring import exponent, magnitude, squared, squarings
from .vectors import materialised, unpack

# Of Taylor's polynomial.
_DEGREE = {"float32": 13, "float64": 22}
# The largest sizes without a squaring: see `_characteristic`. For skew-Hermitian matrices a
# Frobenius norm of 2^½, where the polynomials have a backward error below half a unit in the last
# place up to norms of 1.7 and 1.8. Other matrices may need that, as eigenvalues do not bound them.
_SIZES = (2.0, 0.56)

# A real number, or a complex one in two parts: XLA makes slow code of complex arithmetic.
_Number = tuple[Array, ...]


@jax.jit  # One trace for the many exponentials of a step.
def expm_parts(
    a: Inexact[Array, "n n"],
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"]]:
    """`weight, rest` with `exp(a) = weight (I + a) + rest`, for n = 2 or 3, as `expm.expm_parts`.

    **Cost:** a matrix product, 70 products of numbers, and a matrix product for each of s
    squarings. s = ⌈log₂(‖a‖ / 2^½)⌉ ≥ 0 in the Frobenius norm if a is Hermitian or skew-Hermitian.
    A change of units, `d a d^-1` with d diagonal, does not alter s.

    The rounding of the rest is as small as a^2.
    """
    weight, (rest,) = _parts(a, both=False)
    return weight, rest


@jax.jit
def expm_both_parts(
    a: Inexact[Array, "n n"],
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"], Inexact[Array, "n n"]]:
    """`w, p, m` with `exp(a) = w (I + a) + p` and `exp(-a) = w (I - a) + m`, for n = 2 or 3."""
    weight, (plus, minus) = _parts(a, both=True)
    return weight, plus, minus


def _parts(a: Array, *, both: bool) -> tuple[Array, list[Array]]:
    c, s, scale = _scaled(a)
    square = small_product(a, a)
    matrices = [(a, c)]
    if both:
        # The k-th from the last has k factors a.
        matrices += [(-a, [x if (len(c) - j) % 2 == 0 else -x for j, x in enumerate(c)])]
    rests = [_taylor(x, square, c, scale) for x, c in matrices]

    def exponentials(rests: list[Array]) -> list[Array]:
        pairs = zip(rests, matrices, strict=True)
        return [plus_identity(rest + _times_real(scale, x)) for rest, (x, _) in pairs]

    return (s == 0).astype(a.dtype), squared(rests, exponentials, s)


def _scaled(a: Array) -> tuple[list[Array], Array, Array]:
    """The `c_0 .. c_(n-1)` of a times 2^-s, the number of squarings s, and 2^-s."""
    c, sizes = _characteristic(a)
    sizes = [lax.stop_gradient(size) / most for size, most in zip(sizes, _SIZES, strict=False)]
    s = (exponent(sizes[0]) + 1) // 2
    if len(sizes) > 1:
        s = jnp.maximum(s, (exponent(sizes[1]) + 2) // 3)
    s, scale = squarings(jnp.maximum(s, 0), sizes[0].dtype)
    # The power of two is locally constant, so its derivative is zero.
    factor = scale
    for j in reversed(range(len(c))):
        c[j] = _times_real(factor, c[j])
        factor = factor * scale
    return c, s, scale


def _characteristic(a: Array) -> tuple[list[Array], list[Array]]:
    """The numbers `c_0 .. c_(n-1)`, and how large the matrix is.

    The sizes are `sum_ij |a_ij a_ji|` and, for n = 3, the sum of both `|a_ij a_jk a_ki|`, each up
    to a factor 2^½. After some change of units no entry is larger than the largest mean of those
    cycles, and in exponentials and their roundings here a change of units changes nothing else. For
    a skew-Hermitian matrix the first is the square of its Frobenius norm, which bounds the second.
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
    rest = x[0, 0] * minors[2] + x[2, 2] * pairs[0, 1] + x[1, 1] * pairs[0, 2]
    c = [around[0] + around[1] - rest, _plus(*minors), x[0, 0] + x[1, 1] + x[2, 2]]
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
    # Numbers are scaled and not the matrix: XLA would compute its scale anew for every product.
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
    # Otherwise every use of one of them would compute all of them anew: outside of batches, a
    # derivative would.
    return materialised(_series_of((m, first, count), c), in_batches=True, alone=m > 1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series_of(which: tuple[int, int, int], c: list[Array]) -> list[Array]:
    m, first, count = which
    is_complex = jnp.iscomplexobj(c[0])
    parts = [(x.real, x.imag) if is_complex else (x,) for x in c]
    zero = jnp.zeros_like(parts[0][0])
    top = _DEGREE[zero.dtype.name]
    # Backwards in k: the one of power m is that of power m - 1, and the next ones times c.
    levels: list[dict[int, _Number]] = [{} for _ in range(m)]
    for k in range(top, first - 1, -1):
        rounded, rest = _reciprocal_of_factorial(k, zero.dtype)
        total: _Number = (zero + rounded, zero)[: len(parts[0])]
        for level in levels:
            later = [(x, level.get(k + len(c) - j)) for j, x in enumerate(parts)]
            products = [_times(x, y) for x, y in later if y is not None]
            if level is levels[0] and 2 < k < 6:
                products[0] = (products[0][0] + rest, *products[0][1:])
            # The number last: it is the largest.
            total = level[k] = _sum(*products, total)
    out = [levels[-1][k] for k in range(first, first + count)]
    return [lax.complex(*x) if is_complex else x[0] for x in out]


@_series_of.defjvp
def _(which, primals, tangents):
    m, first, count = which
    (c,), (c_dot,) = primals, tangents
    n = len(c)
    # The derivative of g^m with respect to c_j is m x^(n-j) g^(m+1).
    slopes = _series(m + 1, first + 1, count + n - 1, c)
    out = [m * _plus(*(slopes[k + n - j - 1] * c_dot[j] for j in range(n))) for k in range(count)]
    return _series_of(which, c), out


def _reciprocal_of_factorial(k: int, dtype: np.dtype) -> tuple[float, float]:
    """`1 / k!` as the nearest number and what is missing.

    An error here is the same in every step. For 1/3!, 1/4! and 1/5! it is what unitary matrices
    would drift by: 40 times as fast as with the rest.
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
