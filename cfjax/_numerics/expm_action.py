"""The exponential of a small skew operator, applied to a few columns."""

import functools
from collections.abc import Callable
from fractions import Fraction
from itertools import zip_longest
from math import factorial, floor

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .matmul import matmul, plus_identity
from .squaring import exponent, max_over_batch, squarings

# On shorter intervals the error of the second derivative at zero, `eps / length^2`, would show.
_SHORTEST = 0.1
# On longer ones the powers cancel and the rounding shows.
_LONGEST = 2.5


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
    choice = jnp.sum(bound > intervals[:-1].astype(b.dtype))
    coefficients = jnp.asarray(table, b.dtype)[choice]

    # In a loop: unrolled, every product would be compiled by itself.
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
    """Half lengths of intervals, in growing order, and one row for each with the coefficients.

    A row has those of z^2, z^3, .. of a polynomial that is `1 + z + .. = exp(z)` to `eps / 2` for
    imaginary z in the interval. All are positive, with zeros behind.
    """
    intervals, rows = [], []
    for degree in range(4, 30):
        # The first term left out is below z^2 2 (x / 2)^(degree - 1) / (degree + 1)!.
        power = degree + 1
        length = Fraction(floor(2000 * (eps / 16 * factorial(power)) ** (1 / power)), 1000)
        if _SHORTEST < length < _LONGEST:
            intervals.append(float(length))
            rows.append(_chebyshev(degree - 2, length))
    table = np.zeros((len(rows), len(rows[-1])))
    for i, row in enumerate(rows):
        table[i, : len(row)] = [float(a) for a in row]
    return np.array(intervals), table


def _chebyshev(degree: int, length: Fraction) -> list[Fraction]:
    """The powers of z in the Chebyshev series of `(exp(z) - 1 - z) / z^2`, truncated."""
    # R_k(z) = i^k T_k(-i z / length), so that R_{k+1} = 2 z / length R_k + R_{k-1}.
    basis = [[Fraction(1)], [Fraction(0), 1 / length]]
    while len(basis) < 2 * degree:
        shifted = [Fraction(0), *(2 * a / length for a in basis[-1])]
        basis.append([a + b for a, b in zip_longest(shifted, basis[-2], fillvalue=Fraction(0))])
    powers = [Fraction(1, factorial(k + 2)) for k in range(len(basis))]
    # From the top: what is left after every R_k above the degree is taken out.
    for r in basis[:degree:-1]:
        weight = powers.pop() / r[-1]
        for i, a in enumerate(r[:-1]):
            powers[i] -= weight * a
    return powers


def _by_squaring(
    a: Float[Array, "m m"], scale: Float[Array, " m"], bound: Float[Array, ""], b: Array
) -> Array:
    """`phi_1(a) b` from `exp [[a, b], [0, 0]]`, in a shorter program than `phi_1_times`."""
    m, k = b.shape
    # The result does not depend on the scales.
    scale = lax.stop_gradient(scale)[:, None]
    s, power = squarings(jnp.maximum(exponent(bound), 0), b.dtype)
    top = jnp.concatenate([a * scale.T / scale, b / scale], axis=1) * power
    x = jnp.pad(top, ((0, k), (0, 0)))

    def add(carry: tuple[Array, Array], degree: Array) -> tuple[tuple[Array, Array], None]:
        term = matmul(x, carry[0]) / degree
        return (term, carry[1] + term), None

    def square(x: Array, n: Array) -> tuple[Array, None]:
        return lax.cond(n < s, lambda x: matmul(x, x), lambda x: x, x), None

    # The norm is 1 at most, and 1 / 20! is below rounding.
    (_, e), _ = lax.scan(add, (x, plus_identity(x)), jnp.arange(2, 20, dtype=b.dtype))
    e, _ = lax.scan(square, e, jnp.arange(jnp.finfo(b.dtype).nmant, dtype=s.dtype))
    return scale * e[:m, m:]
