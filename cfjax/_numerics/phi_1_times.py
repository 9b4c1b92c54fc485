"""phi_1 of a dense matrix, times a vector: the increment of an affine flow."""

import jax.numpy as jnp
from jaxtyping import Array, Inexact

from .expm import (
    TAYLOR_SCHEMES,
    by_norm,
    in_full_register,
    one_norm,
    plus_identity,
    taylor_from_second,
)
from .expm_times import phi_1_series
from .matmul import matmul, promoted, small_product
from .squaring import repeat

# A matrix a and a vector v, for the block matrix `[[a, v], [0, 0]]`.
_Pair = tuple[Array, Array]


def phi_1_times(a: Inexact[Array, "n n"], v: Inexact[Array, " n"]) -> Inexact[Array, " n"]:
    """`phi_1(a) v = v + a v / 2! + a^2 v / 3! + ...`, with a rounding as small as `v`.

    **Cost:** up to a 1-norm of 2.4, 11 to 24 products with a vector, as in `phi_1_series`. Beyond,
    5 matrix products (4 in single precision), and one for each squaring.

    A real `a` may meet a complex `v` of the same precision.
    """
    return phi_1_series(lambda x: _times(a, x), v, one_norm(a), lambda: _by_squaring(a, v))


def _by_squaring(a: Array, v: Array) -> Array:
    """From exp([[a, v], [0, 0]]) = [[exp(a), phi_1(a) v], [0, 1]]."""
    schemes = TAYLOR_SCHEMES[a.dtype.name]

    def parts(k: int, first: _Pair, second: _Pair, s: Array | None) -> Array:
        (a, v), rest = first, taylor_from_second(schemes[k], first, second, _product)
        v = v + rest[1]
        if s is None:
            return v
        return repeat(_doubled, (plus_identity(rest[0] + a), v), s)[1]

    n = v.shape[0]
    a = in_full_register(a)
    v = jnp.pad(v, (0, a.shape[0] - n))
    thetas = [scheme.theta for scheme in schemes]
    return by_norm(thetas, (a, v), _product((a, v), (a, v)), parts)[:n]


def _product(x: _Pair, y: _Pair) -> _Pair:
    return small_product(x[0], y[0]), _times(x[0], y[1])


def _doubled(x: _Pair) -> _Pair:
    e, v = x
    return small_product(e, e), v + _times(e, v)


def _times(a: Array, v: Array) -> Array:
    return matmul(*promoted(a, v))
