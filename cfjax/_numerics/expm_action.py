"""The exponential of a small skew operator, applied to a few columns."""

import functools
from collections.abc import Callable
from itertools import zip_longest
from math import factorial, floor

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .expm_series import powers_of_phi_2, row_for
from .matmul import matmul, plus_identity
from .squaring import exponent, max_over_batch, squarings

# On a shorter interval the error of the second derivative at zero, `eps / length^2`, is too large.
_SHORTEST = 0.1
# On a longer one the powers cancel, and the rounding error is too large.
_LONGEST = 2.5


def phi_1_action(
    product: Callable[[Array], Array],
    b: Float[Array, "m k"],
    bound: Float[Array, ""],
    dense: Callable[[], tuple[Array, Array]],
) -> Float[Array, "m k"]:
    """`phi_1(A) b = b + A b / 2! + A^2 b / 3! + ...`, so that `exp(A) z = z + phi_1(A) A z`.

    A is similar to a skew matrix, as every matrix of a skew field on a span is. The sum
    `z + phi_1(A) A z` has a smaller rounding error than a product with exp(A).

    **Arguments:**

    - `product`: multiplies an array like `b` by A.
    - `bound`: no less than the spectral radius of A.
    - `dense`: gives A itself, shape `(m, m)`, and scales, shape `(m,)`, in which it is nearly
      skew: `A[i, j] scale[j] / scale[i]`. Used if the bound is above 2.

    **Cost:** one product less than the degree of a polynomial, which grows with the bound: 7
    products up to 0.1, 11 at 0.5, 14 at 1 in double precision. Under `jax.vmap` the largest bound
    decides.

    **Accuracy:** the polynomial differs from exp by less than half a unit of rounding on the
    imaginary interval that holds the eigenvalues, and less near zero, as it begins `1 + z`. A
    truncated Chebyshev series needs two or three products less than Taylor's. The choice depends
    on A's norm alone and not on `b`, so the derivatives are nearly as accurate.

    Source: Tal-Ezer & Kosloff, J. Chem. Phys. 81 (1984), doi:10.1063/1.448136, for Chebyshev
    series of skew operators.
    """
    # The value depends on the bound by less than rounding, so the derivative is zero.
    bound = max_over_batch(lax.stop_gradient(bound))
    intervals, table = _polynomials(float(jnp.finfo(b.dtype).eps))
    row = row_for(bound, intervals)
    coefficients = jnp.asarray(table, b.dtype)[row]

    # A loop, so that the product is compiled once.
    def step(carry: tuple[Array, Array], coefficient: Array) -> tuple[tuple[Array, Array], None]:

        def add(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            term = product(carry[0])
            return term, carry[1] + coefficient * term

        return lax.cond(coefficient > 0, add, lambda carry: carry, carry), None

    _, total = lax.scan(step, (b, b), coefficients)[0]
    return lax.cond(
        bound > intervals[-1].astype(b.dtype),
        jax.checkpoint(lambda total: _by_squaring(*dense(), bound, b)),
        lambda total: total,
        total,
    )


@functools.cache
def _polynomials(eps: float) -> tuple[np.ndarray, np.ndarray]:
    """Half lengths of intervals, in growing order, and a row of coefficients for each.

    A row has the coefficients of z^2, z^3, .. of a polynomial `1 + z + ..` that is exp(z) to
    `eps / 2` for imaginary z in the interval. They are positive, and padded with zeros.
    """
    intervals, rows = [], []
    for degree in range(4, 30):
        # The first term left out is below z^2 2 (x / 2)^(degree - 1) / (degree + 1)!.
        power = degree + 1
        length = floor(2000 * (eps / 16 * factorial(power)) ** (1 / power)) / 1000
        if _SHORTEST < length < _LONGEST:
            intervals.append(length)
            rows.append(powers_of_phi_2(length, degree - 2))
    return np.array(intervals), np.array([*zip_longest(*rows, fillvalue=0.0)]).T


def _by_squaring(
    a: Float[Array, "m m"], scale: Float[Array, " m"], bound: Float[Array, ""], b: Array
) -> Array:
    """`phi_1(a) b` from `exp [[a, b], [0, 0]]`, in a shorter program than `phi_1_times`."""
    m, k = b.shape
    # The exact result does not depend on the scales.
    scale = lax.stop_gradient(scale)[:, None]
    s, power = squarings(exponent(bound), b.dtype)
    top = jnp.concatenate([a * scale.T / scale, b / scale], axis=1) * power
    x = jnp.pad(top, ((0, k), (0, 0)))

    def add(carry: tuple[Array, Array], degree: Array) -> tuple[tuple[Array, Array], None]:
        term = matmul(x, carry[0]) / degree
        return (term, carry[1] + term), None

    def square(x: Array, n: Array) -> tuple[Array, None]:
        return lax.cond(n < s, lambda x: matmul(x, x), lambda x: x, x), None

    # The norm is at most 1, and 1 / 20! is below rounding.
    (_, e), _ = lax.scan(add, (x, plus_identity(x)), jnp.arange(2, 20, dtype=b.dtype))
    e, _ = lax.scan(square, e, jnp.arange(jnp.finfo(b.dtype).nmant, dtype=s.dtype))
    return scale * e[:m, m:]
