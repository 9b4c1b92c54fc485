"""Linear operators on vectors: arrays, and those of lineax.

An array of shape `(n, n)` is a matrix, one of shape `(n,)` a diagonal.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array

from .matmul import matmul, promoted

# The most rows of a matrix whose 2-norm is computed: some milliseconds, at every trace of a field.
_MAX_ROWS = 128


def entries_of(operator: Any) -> Any:
    """The matrix or diagonal that an operator stores, or None if it stores neither."""
    if isinstance(operator, jax.Array | np.ndarray):
        return operator
    if isinstance(operator, lx.MatrixLinearOperator):
        return operator.as_matrix()
    if isinstance(operator, lx.DiagonalLinearOperator):
        return lx.diagonal(operator)
    return None


def shape_of(operator: Any) -> tuple[int, ...]:
    if isinstance(operator, lx.AbstractLinearOperator):
        return operator.out_size(), operator.in_size()
    return operator.shape


def dtype_of(operator: Any) -> Any:
    if isinstance(operator, lx.AbstractLinearOperator):
        return operator.in_structure().dtype
    # NumPy's doubles are single where JAX has no doubles.
    return jnp.result_type(operator)


def applied(operator: Any, x: Array) -> Array:
    """The operator applied to a vector, or to columns."""
    if (entries := entries_of(operator)) is not None:
        a = jnp.asarray(entries)
        if a.ndim == 1:
            return scaled(a.reshape(-1, *[1] * (x.ndim - 1)), x)
        return matmul(*promoted(a, x))
    # One of lineax takes vectors of its own dtype only.
    mv = jax.vmap(operator.mv, 1, 1) if x.ndim == 2 else operator.mv
    dtype = dtype_of(operator)
    if jnp.iscomplexobj(x) and not jnp.issubdtype(dtype, jnp.complexfloating):
        return lax.complex(mv(x.real), mv(x.imag))
    return mv(x.astype(dtype))


def scaled(c: Array, x: Array) -> Array:
    """The product entry by entry, in the common dtype."""
    return jnp.multiply(*promoted(c, x))


def added(terms: Iterable[Array]) -> Array:
    """The sum of arrays, in their common dtype."""
    total, *terms = terms
    for term in terms:
        total = jnp.add(*promoted(total, term))
    return total


def two_norm(a: Any) -> float | None:
    """The 2-norm of a matrix or diagonal, a little more than it; NaN if an entry is NaN.

    None if its entries are not known when the program is traced, or if that would take long.
    """
    if isinstance(a, Tracer) or (a.ndim == 2 and len(a) > _MAX_ROWS):
        return None
    wide = np.asarray(a).astype(np.result_type(a.dtype, np.float64))
    norm = np.max(np.abs(wide), initial=0) if wide.ndim == 1 else _largest_singular_value(wide)
    return float(norm) * (1 + 1e-6)


def _largest_singular_value(a: np.ndarray) -> float:
    if not np.isfinite(a).all():
        return np.nan
    for phase in (1.0, 1j):
        if np.array_equal(phase * a, (phase * a).conj().T):
            return float(np.abs(np.linalg.eigvalsh(phase * a)).max(initial=0))
    return float(np.linalg.norm(a, 2))
