"""The exponentials of a small dense matrix and of its negative, for 1.5 times the cost of one."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Inexact

from . import cayley_hamilton
from .expm import by_norm, in_full_register, weighted_sum
from .matmul import plus_identity, small_product

# `Z^4 + 120 Z^3`, which both polynomials contain, as Z² times these weights of Z and Z².
_SHARED = (120.0, 1.0)
# Polynomials for `cosh(a) - I` and for `sinh(a)/a - I` in Z = a², (row 0)·(row 1) + (row 2), with
# weights over Z, Z² and the shared polynomial. For k = 1..7 the coefficient of Z^k is 1/(2k)! and
# 1/(2k + 1)!, up to the rounding of divisions. With the 120 above the coefficient of Z⁸ is 1/16!
# in the first and 1.13/17! in the second. All weights are positive, so nothing cancels.
_EVEN = (
    (122880.0, 8000.0, 1.0),
    tuple(w / math.factorial(16) for w in (2129280, 21280, 1)),
    (1 / 2, 662041 / 22702680, 12253 / 3269185920),
)
_ODD = (
    (263808.0, 0.0, 1.0),
    tuple(w / (240 * math.factorial(15)) for w in (3278592, 36000, 1)),
    (1 / 6, 5275939 / 945945000, 509 / 363242880),
)
# Where the backward error reaches half a unit in the last place.
# tests/numerics/test_expm_both.py derives the weights and these.
_THETA = {"float32": 2.645, "float64": 0.862}


def expm_both_parts(
    a: Inexact[Array, "n n"],
) -> tuple[Inexact[Array, ""], Inexact[Array, "n n"], Inexact[Array, "n n"]]:
    """`w, p, m` with `exp(a) = w (I + a) + p` and `exp(-a) = w (I - a) + m`.

    The weight w is 1 if no squaring is needed, otherwise 0, as in `expm_parts`.

    **Cost:** 6 matrix products and 2 s more, with s = ⌈log₂(‖a²‖^½ / θ)⌉ ≥ 0 in the 1-norm and
    θ = 0.862 (2.645 in single precision). Otherwise as `expm`.

    The even and the odd part of exp are polynomials in a², evaluated in the form of Sastre, Linear
    Algebra Appl. 539 (2018), doi:10.1016/j.laa.2017.11.010.
    """
    if a.shape[0] in (2, 3):
        return cayley_hamilton.expm_both_parts(a)

    def approximate(_: int, a: Array, z: Array) -> tuple[Array, Array]:
        z2 = small_product(z, z)
        terms = [z, z2, small_product(z2, weighted_sum(_SHARED, [z, z2]))]
        even, odd = _evaluated(_EVEN, terms), small_product(a, _evaluated(_ODD, terms))
        return even + odd, even - odd

    def start(a: Array, both: tuple[Array, Array]) -> tuple[Array, Array]:
        return plus_identity(both[0] + a), plus_identity(both[1] - a)

    n = a.shape[0]
    a = in_full_register(a)
    theta = _THETA[jnp.finfo(a.dtype).dtype.name]
    weight, (plus, minus) = by_norm([theta], a, small_product(a, a), approximate, start)
    return weight, plus[:n, :n], minus[:n, :n]


def _evaluated(rows: tuple[tuple[float, ...], ...], terms: list[Array]) -> Array:
    left, right, linear = (weighted_sum(row, terms) for row in rows)
    return small_product(left, right) + linear
