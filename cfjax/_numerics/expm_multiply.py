"""The exponential of an operator, given by its products with vectors, times a vector."""

import functools
from collections.abc import Callable
from itertools import zip_longest
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Inexact, Real

from .expm_series import TAYLOR_THETA, chebyshev_of_exp_minus_one, row_for
from .loop import loop
from .squaring import max_over_batch

# Half lengths of the intervals for Chebyshev series: of few bits, so that float32 has them exactly.
# On a shorter one the error of the derivative at zero, relative to the length, is too large.
_INTERVALS = tuple(m * 2.0**k for k in range(-6, 4) for m in (8, 10, 12, 14))
# The width of the rectangles for Chebyshev series of operators that are nearly skew. In wider ones
# the terms grow and cancel.
_DECAY, _GROWTH = 0.5, 0.125
# At least the square root of the highest degree.
_ROOT_OF_LONGEST = 13
# A norm beyond so many pieces is taken for a mistake.
_ROOT_OF_MOST = 32
_MOST_PIECES = _ROOT_OF_MOST**2


class Dense(NamedTuple):
    """`result()` is used instead if more than `most` products would be needed."""

    most: int
    result: Callable[[], Array]


class Strip(NamedTuple):
    """Bounds on the numerical range of an operator: `-decay <= Re z <= growth`, and `|Im z|`."""

    imaginary: Array
    decay: Array
    growth: Array


class _Series(NamedTuple):
    """Polynomials that are exp - 1 up to the norms in `lengths`, one in each row.

    They are `sum_k weights[k] R_k` with `R_0 = 1` and
    `R_(k+1) = A R_k / divisors[k] + previous R_(k-1)`.
    """

    lengths: np.ndarray
    degrees: np.ndarray
    divisors: np.ndarray
    weights: np.ndarray
    previous: float


class _Steps(NamedTuple):
    """The number of steps and the polynomial of each, which takes `degree` products."""

    is_possible: Array
    number: Array
    degree: Array
    divisors: Array
    weights: Array
    previous: Any


def expm_minus_one_multiply(
    product: Callable[[Array], Array],
    x: Inexact[Array, "..."],
    norm: Real[Array, ""],
    *,
    is_skew: bool | Bool[Array, ""] = False,
    strip: Strip | None = None,
    dense: Dense | None = None,
) -> Inexact[Array, "..."]:
    """`(exp(A) - 1) x`, by products with A. Added to x, it has a smaller rounding error than
    `exp(A) x`.

    **Arguments:**

    - `product`: multiplies an array like `x` by A. It may close over traced values.
    - `norm`: no less than a consistent norm of A, or its spectral radius if A is skew.
    - `is_skew`: whether A is skew-Hermitian, in some inner product.
    - `strip`: of an operator that is nearly skew, where its numerical range lies. Then a Chebyshev
      series is used if it takes fewer products than Taylor's.
    - `dense`: another way to compute the result, taken if it is cheaper.

    **Cost:** in double precision 9, 13, 17 and 25 products for norms of 0.09, 0.4, 0.93 and 2.4,
    and 10.3 for each unit of larger ones; if A is skew 9, 12, 16, 24, 40, 64 and 160 for norms of
    0.125, 0.5, 1.25, 4, 12, 28 and 112, and 1.4 for each unit beyond. Reverse mode stores fewer
    than 200 vectors, however large the norm is. Under `jax.vmap` the largest norm decides.

    **Accuracy:** a backward error of a few units in the last place for each unit of the norm; the
    number of terms depends on A alone and not on `x`, so derivatives are as accurate. NaN for
    norms beyond 1024 times the largest above, unless they are for `dense`.

    Source: Al-Mohy & Higham, Computing the action of the matrix exponential, SIAM J. Sci. Comput.
    33 (2011), doi:10.1137/100788860; for skew operators Tal-Ezer & Kosloff, J. Chem. Phys. 81
    (1984), doi:10.1063/1.448136; for the strip Crouzeix & Palencia, The numerical range is a
    (1 + sqrt 2)-spectral set, SIAM J. Matrix Anal. Appl. 38 (2017), doi:10.1137/17M1116672.
    """
    norm = max_over_batch(lax.stop_gradient(norm).astype(jnp.finfo(x.dtype).dtype))
    steps = _steps(norm, is_skew)
    if strip is not None:
        bounds = (max_over_batch(lax.stop_gradient(x).astype(norm.dtype)) for x in strip)
        steps = _fewer(steps, _steps_on_strip(norm, Strip(*bounds)))
    if dense is None:
        return _by_products(product, x, steps)
    # An infinite norm is for `dense`, and NaN stays NaN.
    is_long = steps.degree * steps.number > dense.most
    return lax.cond(
        is_long | (norm > 0) & ~steps.is_possible,
        # Without a checkpoint the branch not taken would return zeros for the residuals of this.
        jax.checkpoint(lambda: dense.result()),
        lambda: _by_products(product, x, steps),
    )


def _by_products(product: Callable[[Array], Array], x: Array, steps: _Steps) -> Array:
    is_possible, number, degree, divisors, weights, previous_weight = steps
    has_three_terms = not (isinstance(previous_weight, float) and previous_weight == 0)

    def series_times(x: Array) -> Array:
        def add(k: Array, carry: Any) -> Any:
            previous, last, total = carry
            new = _by_real(product(last), lambda x: x / divisors[k])
            if has_three_terms:
                new, previous = new + _by_real(previous, lambda x: previous_weight * x), last
            return previous, new, total + _by_real(new, lambda x: x * weights[k + 1])

        previous = jnp.zeros_like(x) if has_three_terms else None
        total = _by_real(x, lambda x: x * weights[0])
        return loop(add, (previous, x, total), degree, root=_ROOT_OF_LONGEST)[2]

    change = loop(
        lambda _, change: change + series_times(x + change),
        jnp.zeros_like(x),
        number,
        root=_ROOT_OF_MOST,
        mostly=1,
    )
    return _by_real(change, lambda x: jnp.where(is_possible, x, jnp.nan))


def _steps(norm: Array, is_skew: bool | Array) -> _Steps:
    if not isinstance(is_skew, bool):
        return _where(is_skew, _steps(norm, True), _steps(norm, False))
    series = (_chebyshev if is_skew else _taylor)(norm.dtype.name)
    return _steps_of(series, norm, norm / float(series.lengths[-1]))


def _steps_on_strip(norm: Array, strip: Strip) -> _Steps:
    series = _on_strip(norm.dtype.name)
    decay, growth = strip.decay / _DECAY, strip.growth / _GROWTH
    pieces = jnp.maximum(strip.imaginary / float(series.lengths[-1]), jnp.maximum(decay, growth))
    return _steps_of(series, strip.imaginary, pieces)


def _steps_of(series: _Series, length: Array, pieces: Array) -> _Steps:
    """So many pieces, rounded up."""
    # False for NaN.
    is_possible = pieces <= _MOST_PIECES
    number = jnp.where(is_possible, jnp.maximum(jnp.ceil(pieces), 1), 1)
    row = row_for(length / number, series.lengths)
    return _Steps(
        is_possible,
        number.astype(jnp.int32),
        jnp.asarray(series.degrees, jnp.int32)[row],
        jnp.asarray(series.divisors, length.dtype)[row] * number,
        jnp.asarray(series.weights, length.dtype)[row],
        series.previous,
    )


def _fewer(a: _Steps, b: _Steps) -> _Steps:
    """The one of fewer products."""
    is_better = b.is_possible & (b.number * b.degree < a.number * a.degree)
    return _where(is_better | ~a.is_possible, b, a)


def _where(condition: Array, a: _Steps, b: _Steps) -> _Steps:
    longest = max(len(a.divisors), len(b.divisors))

    def padded(steps: _Steps) -> _Steps:
        missing = longest - len(steps.divisors)
        return steps._replace(
            divisors=jnp.pad(steps.divisors, (0, missing), constant_values=1),
            weights=jnp.pad(steps.weights, (0, missing)),
        )

    return jtu.tree_map(functools.partial(jnp.where, condition), padded(a), padded(b))


def row_norm(a: Inexact[Array, "n *n"]) -> Real[Array, ""]:
    """The largest sum of absolute values in a row of a matrix or, of a vector, absolute value."""
    # Without a hypot, for which there is no vector instruction. Underflow does not matter here.
    size = jnp.sqrt(a.real**2 + a.imag**2) if jnp.iscomplexobj(a) else jnp.abs(a)
    return jnp.max(size if a.ndim == 1 else jnp.sum(size, axis=1), initial=0)


def _by_real(x: Array, scale: Callable[[Array], Array]) -> Array:
    """A product or quotient with a real number, without products with a zero imaginary part."""
    return lax.complex(scale(x.real), scale(x.imag)) if jnp.iscomplexobj(x) else scale(x)


@functools.cache
def _taylor(precision: str) -> _Series:
    degrees, lengths = map(np.array, zip(*TAYLOR_THETA[precision].items(), strict=True))
    ks = np.tile(np.arange(1.0, degrees[-1] + 1), (len(lengths), 1))
    weights = np.concatenate([np.zeros_like(ks[:, :1]), np.ones_like(ks)], axis=1)
    return _Series(lengths, degrees, ks, weights, previous=0.0)


@functools.cache
def _chebyshev(precision: str) -> _Series:
    # The truncation errors of the steps add up, so each is well below rounding. On short intervals
    # it is relative to their length, as the flow is that near the identity.
    eps = float(jnp.finfo(precision).eps)
    lengths = np.array(_INTERVALS)
    rows = [chebyshev_of_exp_minus_one(x, eps / 16 * min(1.0, x)) for x in _INTERVALS]
    return _three_terms(lengths, lengths, rows)


@functools.cache
def _on_strip(precision: str) -> _Series:
    """Polynomials for the rectangles `-_DECAY <= Re z <= _GROWTH`, `|Im z| <= lengths`."""
    eps = float(jnp.finfo(precision).eps)
    # For a shorter one Taylor's takes fewer products. The longest would need too high a degree.
    intervals = np.array([x for x in _INTERVALS[:-1] if x >= 1])
    # In the rectangle as long as the interval the terms, and so the rounding error, would be larger
    # by up to 7.
    lengths = intervals / 1.05
    rows = []
    for interval, length in zip(intervals, lengths, strict=True):
        # By Crouzeix & Palencia the error of a polynomial of A is at most `1 + sqrt(2)` times the
        # largest one on the rectangle, that in a corner.
        corners = np.array([-_DECAY + 1j * length, _GROWTH + 1j * length]) / (1j * interval)
        roots = np.sqrt(corners**2 - 1)
        growth = max(np.abs(corners + roots).max(), np.abs(corners - roots).max())
        rows.append(chebyshev_of_exp_minus_one(interval, eps / 8, growth))
    return _three_terms(lengths, intervals, rows)


def _three_terms(lengths: np.ndarray, intervals: np.ndarray, rows: list[list[float]]) -> _Series:
    """Chebyshev series on intervals, for use up to the lengths."""
    degrees = np.array([len(row) - 1 for row in rows])
    weights = np.array([*zip_longest(*rows, fillvalue=0.0)]).T
    divisors = np.tile(intervals[:, None] / 2, (1, degrees.max()))
    divisors[:, 0] *= 2
    return _Series(lengths, degrees, divisors, weights, previous=1.0)
