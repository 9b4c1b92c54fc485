"""Products of matrices in the precision of their dtype."""

import functools

import jax.numpy as jnp
from jax import lax

# The default precision drops digits of float32 on GPU and TPU.
matmul = functools.partial(jnp.matmul, precision=lax.Precision.HIGHEST)
