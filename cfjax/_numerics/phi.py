"""The functions phi_k of exponential integrators: of numbers, of matrices, times a vector.

`phi_0 = exp`, and `phi_k(z) = sum_j z^j / (j + k)!`.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact

from .expm import (
    TAYLOR_SCHEMES,
    by_norm,
    in_full_register,
    one_norm,
    taylor_from_second,
)
from .expm_series import TAYLOR_THETA
from .matmul import matmul, plus_identity, promoted, small_product
from .polynomial import polynomial
from .squaring import max_over_batch
from .vectors import computed_once

# The degrees of the Taylor polynomials that `phi_1_times` chooses from.
_DEGREES = {"float32": (5, 10, 15), "float64": (12, 16, 20, 25)}
# A matrix a and a vector v, for the block matrix `[[a, v], [0, 0]]`.
_Pair = tuple[Array, Array]

# Within this radius `phis` sums a series, and outside it uses the recursion upwards from phi_0,
# which divides by z.
_RADIUS = 4.0


def phi(
    k: int, z: Inexact[Array | np.ndarray, "*batch"] | float | complex
) -> Inexact[Array, "*batch"]:
    """The function `phi_k(z) = sum_j z^j / (j + k)!` of exponential integrators, entry by entry.

    So `phi_0 = exp`, `phi_1(z) = (exp(z) - 1) / z` and `phi_(k+1)(z) = (phi_k(z) - 1 / k!) / z`. In
    terms of integrals `phi_k(z)` is that of `exp((1 - s) z) s^(k-1) / (k-1)!` over s from 0 to 1.

    **Arguments:**

    - `k`: 0 to 5, static.
    - `z`: float32, float64, complex64 or complex128, of any shape.

    **Accuracy:** within 5 units of rounding in double precision, and 10 in single, in the left half
    plane and on the imaginary axis up to `|z| = 1e5`. (Near the zeros `2 pi i n` of `phi_1` the
    error is relative to `1 / |z|`.) Derivatives of any order work, forward and reverse, at zero
    too.

    **Cost:** an exponential and some 80 operations; phi_0 is `jnp.exp`, phi_1 costs less.

    **Raises:** `ValueError` for another k, `TypeError` for another dtype.
    """
    if isinstance(k, bool) or not isinstance(k, int | np.integer) or not 0 <= k <= 5:
        raise ValueError(f"k must be an integer from 0 to 5, got {k!r}.")
    z = jnp.asarray(z)
    if z.dtype.name not in TAYLOR_SCHEMES:
        raise TypeError(f"z must be one of {', '.join(TAYLOR_SCHEMES)}, got {z.dtype}.")
    return phi_1(z) if k == 1 else phis(z, int(k), once=lambda x: x)[k]


def phis(
    z: Inexact[Array, "*batch"],
    most: int,
    once: Callable[[list[Array]], list[Array]] = computed_once,
) -> list[Inexact[Array, "*batch"]]:
    """`phi_0(z)` to `phi_most(z)`.

    `once` materialises arrays that XLA would otherwise compute again for each function.
    """
    if most == 0:
        return [jnp.exp(z)]
    # XLA computes moduli, quotients and exponentials of complex numbers slowly.
    is_small = jnp.real(z * jnp.conj(z)) < _RADIUS**2
    half = jnp.where(is_small, z, 0) / 2
    top = polynomial([1 / factorial(j + most) for j in range(_terms(_RADIUS / 2))], half)
    e, inverse = jnp.exp(jnp.where(is_small, half, z)), 1 / jnp.where(is_small, 1, z)
    top, e, inverse = once([top, e, inverse])
    inner = [top]
    for k in range(most, 1, -1):
        inner.insert(0, half * inner[0] + 1 / factorial(k - 1))
    inner.insert(0, e)
    values, outer = [jnp.where(is_small, e * e, e)], e
    for k in range(1, most + 1):
        doubled = _doubled_phi(k, inner, operator.mul)
        outer = (outer - 1 / factorial(k - 1)) * inverse
        values.append(jnp.where(is_small, doubled, outer))
    return values


def _doubled_phi(k: int, phis: Sequence[Array], product: Callable[[Array, Array], Array]) -> Array:
    """`phi_k(2 z)` from the functions of z. For real z all terms are positive."""
    terms = (phis[j] * (1 / factorial(k - j)) for j in range(1, k + 1))
    return functools.reduce(jnp.add, terms, product(phis[0], phis[k])) * 0.5**k


def phi_1(z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    """The function `phi_1(z) = (exp(z) - 1) / z`, with `phi_1(0) = 1`, entry by entry.

    The error is a few units of rounding for every real or complex `z`, small or large, and so is
    that of its derivatives of every order, at zero too. (Near its zeros `2 pi i k` the error is
    relative to `1 / |z|`.) Works in float32, float64, complex64 and complex128. Costs about
    two exponentials.
    """
    return _moment(0, z)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _moment(m: int, z: Inexact[Array, "*batch"]) -> Inexact[Array, "*batch"]:
    """The integral of `s^m exp(s z)` over s from 0 to 1: the m-th derivative of phi_1."""
    # A large polynomial keeps XLA:CPU from using vector instructions, so the value has a small one.
    # It is for loops, which may lose the derivative rule below.
    radius = float(max(2**-10, m))
    small = jnp.abs(z) < radius
    inner, outer = jnp.where(small, z, 0), jnp.where(small, 1, z)
    series = polynomial([1 / (factorial(j) * (m + j + 1)) for j in range(_terms(radius))], inner)
    if m == 0:
        return jnp.where(small, series, jnp.expm1(z) / outer)
    # Kummer's transformation: for Re z < 0 the terms of this series do not cancel.
    weights = [factorial(m) / factorial(m + j + 1) for j in range(_terms(radius))]
    reflected = jnp.exp(inner) * polynomial(weights, -inner)
    series = jnp.where(inner.real < 0, reflected, series)
    # The recursion loses digits to cancellation for small z, the series for large z.
    return jnp.where(small, series, (jnp.exp(z) - m * _moment(m - 1, z)) / outer)


@_moment.defjvp
def _(m, primals, tangents):
    (z,), (z_dot,) = primals, tangents
    return _moment(m, z), _moment(m + 1, z) * z_dot


def _terms(radius: float) -> int:
    """The number of terms of a series for exp that reaches rounding, for |z| up to the radius."""
    j = 1
    while radius**j / factorial(j) > 2.0**-54:
        j += 1
    return j


def phi_1_times(a: Inexact[Array, "n n"], v: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
    """`phi_1(a) v = v + a v / 2! + a^2 v / 3! + ...`, with a rounding as small as `v`.

    **Cost:** 11, 15, 19 or 24 products with a vector for 1-norms up to 0.3, 0.78, 1.4 and 2.4; in
    single precision 4, 9 or 14 up to 0.13, 0.99 and 2.2. Beyond, 5 matrix products (4 in single
    precision), and one for each squaring. Under `jax.vmap` the largest norm decides.

    **Accuracy:** a backward error of a few units in the last place. The number of terms depends on
    `a` alone and not on `v`, so derivatives are as accurate.

    A real `a` may meet a complex `v` of the same precision.

    Source: Al-Mohy & Higham, Computing the action of the matrix exponential, SIAM J. Sci. Comput.
    33 (2011), doi:10.1137/100788860.
    """
    precision = jnp.finfo(v.dtype).dtype.name
    degrees = _DEGREES[precision]
    thetas = [TAYLOR_THETA[precision][degree] for degree in degrees]
    norm = max_over_batch(lax.stop_gradient(one_norm(a)))

    # Nested branches: a loop over all degrees has a far slower derivative.
    def add(term: Array, total: Array, first: int, n: int) -> Array:
        for k in range(first, degrees[n] + 1):
            term = _times(a, term) / k
            total = total + term
        if n + 1 == len(degrees):
            return total
        return lax.cond(
            norm > thetas[n],
            lambda term, total: add(term, total, degrees[n] + 1, n + 1),
            lambda term, total: total,
            term,
            total,
        )

    # Without a checkpoint the branch not taken would return zeros for the residuals of the other.
    return lax.cond(
        norm > thetas[-1],
        jax.checkpoint(lambda v: _by_squaring(a, v)),
        lambda v: add(v, v, 2, 0),
        v,
    )


def _by_squaring(a: Array, v: Array) -> Array:
    """From exp([[a, v], [0, 0]]) = [[exp(a), phi_1(a) v], [0, 1]]."""
    scheme = TAYLOR_SCHEMES[a.dtype.name][-1]

    def approximate(_: int, first: _Pair, second: _Pair) -> _Pair:
        remainder, increment = taylor_from_second(scheme, first, second, _product)
        return remainder, first[1] + increment

    n = len(v)
    a = in_full_register(a)
    v = jnp.pad(v, (0, len(a) - n))
    _, (_, result) = by_norm(
        [scheme.theta],
        (a, v),
        _product((a, v), (a, v)),
        approximate,
        lambda first, value: (plus_identity(value[0] + first[0]), value[1]),
        _doubled,
    )
    return result[:n]


def _product(x: _Pair, y: _Pair) -> _Pair:
    return small_product(x[0], y[0]), _times(x[0], y[1])


def _doubled(x: _Pair) -> _Pair:
    e, v = x
    return small_product(e, e), v + _times(e, v)


def _times(a: Array, v: Array) -> Array:
    return matmul(*promoted(a, v))


def matrix_phis(
    a: Inexact[Array, "n n"], nodes: Sequence[float], most: int
) -> list[list[Inexact[Array, "n n"]]]:
    """For each node c the matrices `phi_0(c a)` to `phi_most(c a)`.

    **Cost:** with m = `most` and s = max(0, log2(norm / 1.5)), rounded up, 7 + m products of
    matrices and (m + 1) s more. Nodes that are doublings of others cost m + 1 for each doubling.
    """
    values: dict[float, tuple[Array, ...]] = {}
    for c in sorted(set(nodes)):
        # Up to two doublings take fewer products than another series.
        doublings = next((k for k in (1, 2) if c / 2**k in values), 0)
        value = values[c / 2**doublings] if doublings else _matrix_phis(c * a, most)
        for _ in range(doublings):
            value = _doubled_phis(value)
        values[c] = value
    return [list(values[c]) for c in nodes]


def _matrix_phis(a: Array, most: int) -> tuple[Array, ...]:
    def approximate(_: int, a: Array, a2: Array) -> tuple[Array, ...]:
        # The series of phi_most in powers of a^4 (Paterson & Stockmeyer), then downwards.
        one = jnp.eye(len(a), dtype=a.dtype)
        powers = [one, a, a2, small_product(a2, a)]
        a4 = small_product(a2, a2)
        top = jnp.zeros_like(a)
        for block in reversed(range(5)):
            weights = [1 / factorial(4 * block + r + most) for r in range(4)]
            row = functools.reduce(jnp.add, map(operator.mul, weights, powers))
            top = row if block == 4 else small_product(a4, top) + row
        values = [top]
        for k in range(most, 0, -1):
            values.insert(0, small_product(a, values[0]) + one * (1 / factorial(k - 1)))
        return tuple(values)

    second = small_product(a, a)
    return by_norm([1.5], a, second, approximate, lambda _, value: value, _doubled_phis)[1]


def _doubled_phis(phis: tuple[Array, ...]) -> tuple[Array, ...]:
    """The functions of twice the argument."""
    others = (_doubled_phi(k, phis, small_product) for k in range(1, len(phis)))
    return small_product(phis[0], phis[0]), *others
