"""The exponential of a small skew operator, applied to a few columns."""

from collections.abc import Callable
from math import factorial

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .expm import expm, max_over_batch

# Degrees of the Taylor polynomial of exp. Between two of them lies a branch: each costs compile
# time, each term left out saves a product.
_DEGREES = (8, 10, 12, 14, 18)


def phi_1_action(
    product: Callable[[Array], Array],
    b: Float[Array, "m k"],
    bound: Float[Array, ""],
    dense: Callable[[], tuple[Array, Array]],
) -> Float[Array, "m k"]:
    """`phi_1(A) b = b + A b / 2! + A^2 b / 3! + ...`, so that `exp(A) z = z + phi_1(A) A z`.

    For an A that is similar to a skew matrix, as every matrix of a skew field on a span is. Added
    to the whole, the result rounds less than a product with exp(A).

    **Arguments:**

    - `product`: multiplies an array like `b` by A.
    - `bound`: no less than the spectral radius of A.
    - `dense`: gives A itself, shape `(m, m)`, and scales, shape `(m,)`, in which it is nearly
      skew: `A[i, j] scale[j] / scale[i]`. Used if the bound is above 1.1 (2.5 in single precision).

    **Cost:** from 7 products, for a bound up to 0.07 in double precision, to 17. Under `jax.vmap`
    the largest bound decides. The error is below half a unit of rounding of exp. As it depends on
    A's norm alone, and not on `b`, the derivatives are as accurate.
    """
    bound = max_over_batch(lax.stop_gradient(bound))

    def terms(first: int, last: int) -> Callable[[tuple[Array, Array]], tuple[Array, Array]]:
        def add(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            term, total = carry
            for degree in range(first, last):
                term = product(term) / jnp.asarray(degree + 1, b.dtype)
                total = total + term
            return term, total

        return add

    carry = terms(1, _DEGREES[0])((b, b))
    for low, high in zip(_DEGREES, _DEGREES[1:], strict=False):
        more = bound > _largest(low, b.dtype)
        carry = lax.cond(more, terms(low, high), lambda carry: carry, carry)
    total = carry[1]
    return lax.cond(
        bound > _largest(_DEGREES[-1], b.dtype),
        lambda _: _phi_1(*dense(), b),
        lambda total: total,
        total,
    )


def _phi_1(a: Float[Array, "m m"], scale: Float[Array, " m"], b: Array) -> Array:
    """`phi_1(a) b` by the exponential of `[[a, b], [0, 0]]`, for every norm."""
    m, k = b.shape
    # The result does not depend on the scales.
    scale = lax.stop_gradient(scale)[:, None]
    top = jnp.concatenate([a * scale.T / scale, b / scale], axis=1)
    return scale * expm(jnp.pad(top, ((0, k), (0, 0))))[:m, m:]


def _largest(degree: int, dtype: jnp.dtype) -> float:
    """The norm up to which the first term left out is no more than half a unit of rounding."""
    return float((jnp.finfo(dtype).eps / 2 * factorial(degree + 1)) ** (1 / (degree + 1)))
