"""The exponential of an operator that is known by its products with vectors, times a vector."""

import functools
from collections.abc import Callable
from decimal import Decimal, localcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Inexact, Real

from .loop import loop
from .squaring import max_over_batch

# Of Taylor polynomials of growing degree, beginning with these, the largest norm for which they
# have a backward error below half a unit in the last place; up to where the terms grow and cancel.
# As in Table 3.1 of Al-Mohy & Higham; tests/numerics/test_expm_multiply.py derives them.
FIRST_DEGREE = {"float32": 3, "float64": 5}
LONGEST = {
    "float32": [
        *[0.01123, 0.05116, 0.1308, 0.2495, 0.4014, 0.58, 0.7795],
        *[0.9951, 1.223, 1.461, 1.707, 1.959, 2.217],
    ],
    "float64": [
        *[0.0024, 0.009065, 0.02384, 0.04991, 0.08957, 0.1441, 0.2142],
        *[0.2996, 0.3997, 0.5139, 0.641, 0.7802, 0.9305, 1.09],
        *[1.26, 1.438, 1.623, 1.816, 2.014, 2.219, 2.428],
    ],
}
# Half lengths of the intervals for Chebyshev series: few bits, so that a division by them is exact.
# Below the shortest the error of the derivative at zero, which is relative to it, would show.
_INTERVALS = tuple(m * 2.0**k for k in range(-6, 4) for m in (8, 10, 12, 14))
# The square root of what the longest series has, or more.
_ROOT_OF_LONGEST = 13
# In so many pieces. What is longer is an accident.
_ROOT_OF_MOST = 32
_MOST_PIECES = _ROOT_OF_MOST**2


class Dense(NamedTuple):
    """What is done instead where over `most` products would be needed."""

    most: int
    result: Callable[[], Array]


class _Series(NamedTuple):
    """Polynomials that are exp - 1 up to the norms in `lengths`, one a row.

    `sum_k weights[k] R_k` with `R_0 = 1` and `R_(k+1) = A R_k / divisors[k] + before R_(k-1)`.
    """

    lengths: np.ndarray
    counts: np.ndarray
    divisors: np.ndarray
    weights: np.ndarray
    before: float


class _Chosen(NamedTuple):
    """One of them, for so many pieces, each of `degree` products."""

    possible: Array
    pieces: Array
    degree: Array
    divisors: Array
    weights: Array
    before: Any


def expm_minus_one_multiply(
    product: Callable[[Array], Array],
    x: Inexact[Array, "..."],
    norm: Real[Array, ""],
    *,
    is_skew: bool | Bool[Array, ""] = False,
    dense: Dense | None = None,
) -> Inexact[Array, "..."]:
    """`(exp(A) - 1) x`, by products with A alone. Added to x, it rounds less than exp(A) x does.

    **Arguments:**

    - `product`: multiplies an array like `x` by A. It may close over traced values.
    - `norm`: no less than a consistent norm of A, or its spectral radius if A is skew.
    - `is_skew`: whether A is skew-Hermitian, in some inner product.
    - `dense`: another way to the result, taken where it is cheaper.

    **Cost:** in double precision 9, 13, 17 and 25 products for norms of 0.09, 0.4, 0.93 and 2.4,
    and 10.3 for each unit of larger ones; if A is skew 9, 12, 16, 24, 40, 64 and 160 for norms of
    0.125, 0.5, 1.25, 4, 12, 28 and 112, and 1.4 for each unit beyond. Reverse mode keeps fewer than
    200 vectors, however large the norm is. Under `jax.vmap` the largest norm decides.

    **Accuracy:** a backward error of a few units in the last place for each unit of the norm; the
    number of terms depends on A alone and not on `x`, so derivatives are as accurate. NaN for
    norms beyond 1024 times the largest above, unless they are for `dense`.

    Source: Al-Mohy & Higham, Computing the action of the matrix exponential, SIAM J. Sci. Comput.
    33 (2011), doi:10.1137/100788860; for skew operators Tal-Ezer & Kosloff, J. Chem. Phys. 81
    (1984), doi:10.1063/1.448136.
    """
    norm = max_over_batch(lax.stop_gradient(norm).astype(jnp.finfo(x.dtype).dtype))
    chosen = _chosen(norm, is_skew)
    if dense is None:
        return _by_products(product, x, chosen)
    # An infinite norm is for `dense`, and NaN stays NaN.
    is_long = chosen.degree * chosen.pieces > dense.most
    return lax.cond(
        is_long | (norm > 0) & ~chosen.possible,
        # Without a checkpoint the branch not taken must hand out room for what the other saves.
        jax.checkpoint(lambda: dense.result()),
        lambda: _by_products(product, x, chosen),
    )


def _by_products(product: Callable[[Array], Array], x: Array, chosen: _Chosen) -> Array:
    possible, pieces, degree, divisors, weights, of_before = chosen
    needs_before = not (isinstance(of_before, float) and of_before == 0)

    def series_of(x: Array) -> Array:
        def add(k: Array, carry: Any) -> Any:
            before, last, total = carry
            new = _by_real(product(last), lambda x: x / divisors[k])
            if needs_before:
                new, before = new + _by_real(before, lambda x: of_before * x), last
            return before, new, total + _by_real(new, lambda x: x * weights[k + 1])

        before = jnp.zeros_like(x) if needs_before else None
        total = _by_real(x, lambda x: x * weights[0])
        return loop(add, (before, x, total), degree, root=_ROOT_OF_LONGEST)[2]

    moved = loop(
        lambda _, moved: moved + series_of(x + moved),
        jnp.zeros_like(x),
        pieces,
        root=_ROOT_OF_MOST,
        mostly=1,
    )
    return _by_real(moved, lambda x: jnp.where(possible, x, jnp.nan))


def _chosen(norm: Array, is_skew: bool | Array) -> _Chosen:
    if not isinstance(is_skew, bool):
        skew, other = _chosen(norm, True), _chosen(norm, False)
        short = len(skew.divisors) - len(other.divisors)
        other = other._replace(
            divisors=jnp.pad(other.divisors, (0, short), constant_values=1),
            weights=jnp.pad(other.weights, (0, short)),
        )
        return jtu.tree_map(functools.partial(jnp.where, is_skew), skew, other)
    series = (_chebyshev if is_skew else _taylor)(norm.dtype.name)
    longest = float(series.lengths[-1])
    # False for NaN.
    possible = norm <= _MOST_PIECES * longest
    pieces = jnp.where(possible, jnp.maximum(jnp.ceil(norm / longest), 1), 1)
    row = jnp.sum(norm / pieces > series.lengths[:-1].astype(norm.dtype))
    return _Chosen(
        possible,
        pieces.astype(jnp.int32),
        jnp.asarray(series.counts, jnp.int32)[row],
        jnp.asarray(series.divisors, norm.dtype)[row] * pieces,
        jnp.asarray(series.weights, norm.dtype)[row],
        series.before,
    )


def row_norm(a: Inexact[Array, "n *n"]) -> Real[Array, ""]:
    """The largest sum of absolute values in a row of a matrix, or entry of a diagonal."""
    # Without a hypot, which no vector instruction has. What underflows does not matter here.
    size = jnp.sqrt(a.real**2 + a.imag**2) if jnp.iscomplexobj(a) else jnp.abs(a)
    return jnp.max(size if a.ndim == 1 else jnp.sum(size, axis=1), initial=0)


def _by_real(x: Array, scale: Callable[[Array], Array]) -> Array:
    """A product or quotient with a real number, without the products with its imaginary zero."""
    return lax.complex(scale(x.real), scale(x.imag)) if jnp.iscomplexobj(x) else scale(x)


@functools.cache
def _taylor(precision: str) -> _Series:
    lengths = LONGEST[precision]
    counts = FIRST_DEGREE[precision] + np.arange(len(lengths))
    ks = np.tile(np.arange(1.0, counts[-1] + 1), (len(lengths), 1))
    weights = np.concatenate([np.zeros_like(ks[:, :1]), np.ones_like(ks)], axis=1)
    return _Series(np.array(lengths), counts, ks, weights, before=0.0)


@functools.cache
def _chebyshev(precision: str) -> _Series:
    """With `R_k(z) = i^k T_k(-i z / L)`, `exp(z) = J_0(L) + 2 sum_k J_k(L) R_k(z)`."""
    # What is left out may add up over the steps, so it is well below rounding; for short intervals
    # relative to them, as the flow is that near the identity.
    eps = float(jnp.finfo(precision).eps)
    rows = [_bessel(length, eps / 16 * min(1.0, length)) for length in _INTERVALS]
    counts = np.array([len(row) - 1 for row in rows])
    weights = np.zeros((len(rows), counts.max() + 1))
    for n, row in enumerate(rows):
        weights[n, : len(row)] = row
    divisors = np.tile(np.array(_INTERVALS)[:, None] / 2, (1, counts.max()))
    divisors[:, 0] *= 2
    return _Series(np.array(_INTERVALS), counts, divisors, weights, before=1.0)


def _bessel(length: float, tolerance: float) -> list[float]:
    """`J_0(L) - 1, 2 J_1(L), 2 J_2(L), ..` as far as they add up to more than the tolerance."""
    with localcontext() as context:
        context.prec = 40
        x = Decimal(length)
        # Backwards from where they are far below the last digit asked for (Miller).
        top = 40 + 2 * int(length)
        found = [Decimal(0), Decimal(1)]
        for k in range(top, 0, -1):
            found.append(2 * k / x * found[-1] - found[-2])
        found.reverse()
        total = found[0] + 2 * sum(found[2::2])
        series = [found[0] / total - 1, *(2 * j / total for j in found[1:])]
        rest = Decimal(0)
        while rest + abs(series[-1]) <= tolerance:
            rest += abs(series.pop())
        return [float(a) for a in series]
