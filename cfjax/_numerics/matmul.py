"""Products of matrices in the precision of their dtype."""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact

# The default precision drops digits of float32 on GPU and TPU.
matmul = functools.partial(jnp.matmul, precision=lax.Precision.HIGHEST)


def promoted(
    a: Inexact[Array, "..."], b: Inexact[Array, "..."]
) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."]]:
    """Both arrays in one dtype, if they have one precision."""
    if jnp.finfo(a.dtype).dtype == jnp.finfo(b.dtype).dtype:
        dtype = np.promote_types(a.dtype, b.dtype)
        a, b = a.astype(dtype), b.astype(dtype)
    return a, b


def by_columns(a: Inexact[Array, "n n"]) -> Callable[[Array], Array]:
    """`x -> a @ x`, for many products with vectors or few columns.

    XLA:CPU takes 4 times as long for a complex product with a vector as for the real products that
    it consists of. So the real and imaginary parts of `a` are separated, once.
    """
    n = a.shape[0]
    stacked = jnp.concatenate([a.real, a.imag]) if jnp.iscomplexobj(a) else a

    def product(x: Array) -> Array:
        if not jnp.iscomplexobj(x):
            p = matmul(stacked, x)
            return p if stacked is a else lax.complex(p[:n], p[n:])
        p, q = matmul(stacked, x.real), matmul(stacked, x.imag)
        return lax.complex(p, q) if stacked is a else lax.complex(p[:n] - q[n:], q[:n] + p[n:])

    return product


def small_product(x: Array, y: Array) -> Array:
    """`x @ y` for matrices that may be small, or a matrix and a vector, of one dtype."""
    # XLA:CPU writes a real dot up to n = 3 into the code around it. The next ones are calls, two
    # to four times slower than a sum, which fuses.
    n = x.shape[-1]
    if n == 4 or (n < 4 and jnp.iscomplexobj(x)):
        if x.ndim == 1:
            return jnp.sum(x[:, None] * y, axis=0)
        return jnp.sum(x * y[None, :] if y.ndim == 1 else x[:, :, None] * y[None, :, :], axis=1)
    return matmul(x, y)


def plus_identity(a: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    return a + jnp.eye(a.shape[0], dtype=a.dtype)
