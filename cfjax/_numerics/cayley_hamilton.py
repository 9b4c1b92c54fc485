"""The exponential of a 2 x 2 or 3 x 3 matrix by the theorem of Cayley and Hamilton.

A matrix is a root of its own characteristic polynomial, `a^n = c_(n-1) a^(n-1) + .. + c_0`. So what
is a power series in `a` is a polynomial of degree n - 1 in it, whose coefficients are power series
in the numbers c. These are entire functions, and nothing happens where eigenvalues meet.
"""

import functools
from collections.abc import Sequence
from math import factorial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Inexact, Real

from .._xla import held, pack, unpack

# Of Taylor's polynomial, with a backward error below half a unit in the last place for norms up to
# 2.2 and 2.4. So there is room for matrices that are not normal, see `cycles`.
_DEGREE = {"float32": 15, "float64": 25}

# A real number, or a complex one in two parts: XLA makes slow code of complex arithmetic.
_Number = tuple[Array, ...]


def characteristic(a: Inexact[Array, "n n"]) -> tuple[list[Inexact[Array, ""]], Real[Array, "2"]]:
    """The numbers `c_0 .. c_(n-1)`, and how large the matrix is by its cycles.

    The sizes are `sum_ij |a_ij a_ji|` and the sum of `|a_ij a_jk a_ki|` for different i, j, k, each
    up to a factor 2^½. A change of units `d a d^-1`, d diagonal, does not alter them. There is
    one after which no entry is larger than the largest mean of a cycle, and all of `exp` is the
    same up to that change. For normal matrices the first is the square of the Frobenius norm.
    """
    n = a.shape[0]
    entries = unpack(a.reshape(n * n))
    a_ = {(i, j): entries[n * i + j] for i in range(n) for j in range(n)}
    pairs = {(i, j): a_[i, j] * a_[j, i] for i in range(n) for j in range(i, n)}
    minors = [pairs[i, j] - a_[i, i] * a_[j, j] for i, j in pairs if i < j]
    squares = sum((1 + (i < j)) * _magnitude(x) for (i, j), x in pairs.items())
    trace = sum(a_[i, i] for i in range(n))
    if n == 2:
        return [minors[0], trace], [squares]
    around = [a_[0, 1] * a_[1, 2] * a_[2, 0], a_[0, 2] * a_[2, 1] * a_[1, 0]]
    rest = -a_[0, 0] * minors[2] - pairs[0, 1] * a_[2, 2] - pairs[0, 2] * a_[1, 1]
    determinant = around[0] + around[1] + rest
    return [determinant, sum(minors), trace], [squares, sum(map(_magnitude, around))]


def _magnitude(x: Array) -> Array:
    return jnp.abs(x.real) + jnp.abs(x.imag) if jnp.iscomplexobj(x) else jnp.abs(x)


def num_squarings(exponents: Sequence[Array]) -> Array:
    """For the exponents of the sizes: so many that `taylor` takes the matrix over 2^s."""
    s = (exponents[0] - 1) // 2
    return jnp.maximum(functools.reduce(jnp.maximum, [(e + 1) // 3 for e in exponents[1:]], s), 0)


def taylor(
    a: Inexact[Array, "n n"], c: Sequence[Inexact[Array, ""]], scale: Inexact[Array, ""]
) -> Inexact[Array, "n n"]:
    """`exp(b) - I - b` for `b = scale * a`, with a rounding as small as it is."""
    n = a.shape[0]
    powers = [scale]
    for _ in range(n - 1):
        powers.append(powers[-1] * scale)
    c = [x * power for x, power in zip(c, reversed(powers), strict=True)]
    # exp(b) = I + b + c_0 f_n I + (c_1 f_n + c_0 f_(n+1)) b + ..
    f = series(1, 2, n, c)
    eye = jnp.eye(n, dtype=a.dtype)
    if n == 2:
        return (c[0] * f[0]) * eye + ((c[1] * f[0] + c[0] * f[1]) * scale) * a
    # The matrix as it is, or each of the nine would be scaled anew for every use.
    square = jnp.sum(a[:, :, None] * a[None, :, :], axis=1)
    linear = ((c[1] * f[1] + c[0] * f[2]) * scale) * a + (f[0] * powers[1]) * square
    return (c[0] * f[1]) * eye + linear


def series(m: int, first: int, count: int, c: list[Inexact[Array, ""]]) -> list[Inexact[Array, ""]]:
    """`f_k = sum_i h_i / (i + k)!` for k = first, first + 1, and so on.

    `h_i` are the coefficients of the power series of g^m with
    `g(x) = 1 / (1 - c_(n-1) x - .. - c_0 x^n)`.
    """
    # Else all that uses one of them would compute them anew: alone, a derivative.
    return held(_series((m, first, count), c), in_batches=True, alone=m > 1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series(which: tuple[int, int, int], c: list[Array]) -> list[Array]:
    m, first, count = which
    is_complex = jnp.iscomplexobj(c[0])
    parts = [(x.real, x.imag) if is_complex else (x,) for x in c]
    zero = jnp.zeros_like(parts[0][0])
    top = _DEGREE[zero.dtype.name]
    # Backwards in k: the one of power m is that of power m - 1, and the next ones times c.
    levels: list[dict[int, _Number]] = [{} for _ in range(m)]
    for k in range(top, first - 1, -1):
        total: _Number = (zero + 1 / factorial(k), zero)[: len(parts[0])]
        for level in levels:
            later = [(x, level.get(k + len(c) - j)) for j, x in enumerate(parts)]
            products = [_times(x, y) for x, y in later if y is not None]
            # The number last: it is the largest.
            total = level[k] = _sum(*products, total)
    out = [levels[-1][k] for k in range(first, first + count)]
    return [lax.complex(*x) if is_complex else x[0] for x in out]


@_series.defjvp
def _(which, primals, tangents):
    m, first, count = which
    (c,), (c_dot,) = primals, tangents
    n = len(c)
    # The derivative of g^m with respect to c_j is m x^(n-j) g^(m+1).
    slopes = series(m + 1, first + 1, count + n - 1, c)
    out = [m * sum(slopes[k + n - j - 1] * c_dot[j] for j in range(n)) for k in range(count)]
    return _series(which, c), out


def _times(x: _Number, y: _Number) -> _Number:
    if len(x) == 1:
        return (x[0] * y[0],)
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _sum(*numbers: _Number) -> _Number:
    return tuple(sum(parts[1:], start=parts[0]) for parts in zip(*numbers, strict=True))
