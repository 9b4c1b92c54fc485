"""phi_1 of a dense matrix, times a vector: the increment of an affine flow."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Inexact

from .expm import (
    TAYLOR_SCHEMES,
    by_norm,
    in_full_register,
    one_norm,
    taylor_from_second,
)
from .expm_multiply import FIRST_DEGREE, LONGEST
from .matmul import matmul, plus_identity, promoted, small_product
from .squaring import max_over_batch

# So many terms of Taylor's series.
_DEGREES = {"float32": (5, 10, 15), "float64": (12, 16, 20, 25)}

# A matrix a and a vector v, for the block matrix `[[a, v], [0, 0]]`.
_Pair = tuple[Array, Array]


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
    thetas = [LONGEST[precision][degree - FIRST_DEGREE[precision]] for degree in degrees]
    norm = max_over_batch(lax.stop_gradient(one_norm(a)))

    # One branch within the other: a loop over all of them has a far slower derivative.
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

    # Without a checkpoint the branch not taken must still hand out room for what the other saves.
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
        rest, moved = taylor_from_second(scheme, first, second, _product)
        return rest, first[1] + moved

    n = len(v)
    a = in_full_register(a)
    v = jnp.pad(v, (0, len(a) - n))
    _, (_, moved) = by_norm(
        [scheme.theta],
        (a, v),
        _product((a, v), (a, v)),
        approximate,
        lambda first, small: (plus_identity(small[0] + first[0]), small[1]),
        _doubled,
    )
    return moved[:n]


def _product(x: _Pair, y: _Pair) -> _Pair:
    return small_product(x[0], y[0]), _times(x[0], y[1])


def _doubled(x: _Pair) -> _Pair:
    e, v = x
    return small_product(e, e), v + _times(e, v)


def _times(a: Array, v: Array) -> Array:
    return matmul(*promoted(a, v))
