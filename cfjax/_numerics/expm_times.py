"""phi_1 of a dense matrix, applied to a few columns."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Inexact, Real

from .squaring import max_over_batch

# So many terms of Taylor's series, and the largest norm for which they have a backward error below
# half a unit in the last place, up to where the terms grow and cancel. As in Table 3.1 of the
# source; tests/numerics/test_expm_times.py derives them.
_DEGREES = {
    "float32": ((5, 0.1308), (10, 0.9951), (15, 2.217)),
    "float64": ((12, 0.2996), (16, 0.7802), (20, 1.438), (25, 2.428)),
}


def phi_1_series(
    product: Callable[[Array], Array],
    v: Inexact[Array, "..."],
    norm: Real[Array, ""],
    dense: Callable[[], Array],
) -> Inexact[Array, "..."]:
    """`phi_1(A) v = v + A v / 2! + A^2 v / 3! + ...`, where `A phi_1(A) = exp(A) - 1`.

    **Arguments:**

    - `product`: multiplies an array like `v` by A.
    - `norm`: a consistent norm of A, such as the 1-norm.
    - `dense`: gives the result in another way. Used if the norm is above 2.4.

    **Cost:** 11, 15, 19 or 24 products for norms up to 0.3, 0.78, 1.4 and 2.4; in single precision
    4, 9 or 14 up to 0.13, 0.99 and 2.2. Under `jax.vmap` the largest decides.

    **Accuracy:** a backward error of a few units in the last place. The number of terms depends on
    A alone and not on `v`, so derivatives are as accurate.

    Source: Al-Mohy & Higham, Computing the action of the matrix exponential, SIAM J. Sci. Comput.
    33 (2011), doi:10.1137/100788860.
    """
    norm = max_over_batch(lax.stop_gradient(norm))
    degrees, thetas = zip(*_DEGREES[jnp.finfo(v.dtype).dtype.name], strict=True)

    # One branch within the other: a loop over all of them has a far slower derivative.
    def add(term: Array, total: Array, first: int, n: int) -> Array:
        for k in range(first, degrees[n] + 1):
            term = product(term) / k
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
        jax.checkpoint(lambda v: dense()),
        lambda v: add(v, v, 2, 0),
        v,
    )
