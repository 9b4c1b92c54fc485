"""Products of matrices in the precision of their dtype."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact

# The default precision drops digits of float32 on GPU and TPU.
matmul = functools.partial(jnp.matmul, precision=lax.Precision.HIGHEST)


def promoted(
    a: Inexact[Array, "..."], b: Inexact[Array, "..."]
) -> tuple[Inexact[Array, "..."], Inexact[Array, "..."]]:
    """Both in one dtype, if a real array meets a complex one of its own precision."""
    if jnp.finfo(a.dtype).dtype == jnp.finfo(b.dtype).dtype:
        dtype = np.promote_types(a.dtype, b.dtype)
        a, b = a.astype(dtype), b.astype(dtype)
    return a, b
