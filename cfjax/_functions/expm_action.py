"""The exponential of a small skew operator, applied to a few columns."""

import functools
from collections.abc import Callable
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .expm import max_over_batch

# The highest degree of the Taylor polynomial of exp.
_DEGREE = 18


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
    degrees = np.arange(2, _DEGREE + 1)
    largest = np.array([_largest(degree, b.dtype) for degree in (*(degrees - 1), _DEGREE)])

    def add(carry: tuple[Array, Array], degree: Array) -> tuple[Array, Array]:
        term, total = carry
        term = product(term) / degree
        return term, total + term

    # In a loop: every product written out would be compiled by itself.
    def step(carry: tuple[Array, Array], x: Array) -> tuple[tuple[Array, Array], None]:
        degree, largest = x
        return lax.cond(bound > largest, add, lambda carry, degree: carry, carry, degree), None

    xs = np.stack([degrees, largest[:-1]], axis=1).astype(b.dtype)
    _, total = lax.scan(step, (b, b), xs)[0]
    return lax.cond(
        bound > largest[-1].astype(b.dtype),
        jax.checkpoint(lambda total: _phi_1(*dense(), bound, b)),
        lambda total: total,
        total,
    )


def _phi_1(
    a: Float[Array, "m m"], scale: Float[Array, " m"], bound: Float[Array, ""], b: Array
) -> Array:
    """`phi_1(a) b` for every norm: `exp [[a, b], [0, 0]]` by scaling and squaring."""
    m, k = b.shape
    # The result does not depend on the scales.
    scale = lax.stop_gradient(scale)[:, None]
    s = jnp.maximum(jnp.ceil(jnp.log2(bound)), 0)
    top = jnp.concatenate([a * scale.T / scale, b / scale], axis=1) * jnp.exp2(-s)
    x = jnp.pad(top, ((0, k), (0, 0)))
    product = functools.partial(jnp.matmul, precision=lax.Precision.HIGHEST)

    def add(carry: tuple[Array, Array], degree: Array) -> tuple[tuple[Array, Array], None]:
        term, total = carry
        term = product(x, term) / degree
        return (term, total + term), None

    def square(x: Array, n: Array) -> tuple[Array, None]:
        return lax.cond(n < s, lambda x: product(x, x), lambda x: x, x), None

    one = jnp.eye(m + k, dtype=b.dtype)
    (_, e), _ = lax.scan(add, (x, one + x), np.arange(2, _DEGREE + 1).astype(b.dtype))
    # Every squaring doubles the error: after as many as there are digits, none is left.
    nmant = jnp.finfo(b.dtype).nmant
    e, _ = lax.scan(square, e, np.arange(nmant).astype(b.dtype))
    return jnp.where(s <= nmant, scale * e[:m, m:], jnp.nan)


def _largest(degree: int, dtype: jnp.dtype) -> float:
    """The norm up to which the first term left out is no more than half a unit of rounding."""
    return float((jnp.finfo(dtype).eps / 2 * factorial(degree + 1)) ** (1 / (degree + 1)))
