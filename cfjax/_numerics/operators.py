"""Linear operators on vectors in any form: arrays, sparse, of lineax, functions.

An array of shape `(n, n)` is a matrix, one of shape `(n,)` a diagonal.
"""

from collections.abc import Callable, Iterable
from hashlib import sha256
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, PyTree

from .matmul import matmul, promoted


def is_sparse(operator: Any) -> bool:
    # Without an import that nobody else may need.
    cls = type(operator)
    return cls.__name__ == "BCOO" and cls.__module__.startswith("jax.experimental.sparse")


def entries_of(operator: Any) -> Any:
    """The matrix or diagonal of an operator that is kept as one."""
    if isinstance(operator, jax.Array | np.ndarray):
        return operator
    if isinstance(operator, lx.MatrixLinearOperator):
        return operator.as_matrix()
    if isinstance(operator, lx.DiagonalLinearOperator):
        return lx.diagonal(operator)
    return None


def shape_of(operator: Any) -> tuple[int, ...] | None:
    """None of a function."""
    if isinstance(operator, jax.Array | np.ndarray) or is_sparse(operator):
        return operator.shape
    if isinstance(operator, lx.AbstractLinearOperator):
        return operator.out_size(), operator.in_size()
    return None


def size_of(operator: Any) -> int | None:
    """The length of the vectors that it acts on. None of a function."""
    shape = shape_of(operator)
    return None if shape is None else shape[-1]


def dtype_of(operator: Any) -> Any:
    """None of a function."""
    if isinstance(operator, np.ndarray):
        # Its doubles are single where JAX has no doubles.
        return jnp.result_type(operator)
    if isinstance(operator, lx.AbstractLinearOperator):
        return operator.in_structure().dtype
    return None if shape_of(operator) is None else operator.dtype


def applied(operator: Any, x: Array) -> Array:
    """What the operator makes of a vector, or of columns."""
    if (entries := entries_of(operator)) is not None:
        a = jnp.asarray(entries)
        if a.ndim == 1:
            return scaled(a.reshape(-1, *[1] * (x.ndim - 1)), x)
        return matmul(*promoted(a, x))
    if is_sparse(operator):
        data = promoted(operator.data, x)[0]
        return type(operator)((data, operator.indices), shape=operator.shape) @ x
    if not isinstance(operator, lx.AbstractLinearOperator):
        return _columnwise(operator, x)
    # A real one takes real vectors.
    if jnp.iscomplexobj(x) and not jnp.issubdtype(
        operator.in_structure().dtype, jnp.complexfloating
    ):
        return lax.complex(*(_columnwise(operator.mv, part) for part in (x.real, x.imag)))
    return _columnwise(operator.mv, x)


def _columnwise(function: Callable[[Array], Array], x: Array) -> Array:
    return (jax.vmap(function, 1, 1) if x.ndim == 2 else function)(x)


def scaled(c: Array, x: Array) -> Array:
    """Entry by entry, in the dtype that both have together."""
    return jnp.multiply(*promoted(c, x))


def added(terms: Iterable[Array]) -> Array:
    """The sum of arrays, in the dtype that all have together."""
    first, *others = terms
    for term in others:
        first = jnp.add(*promoted(first, term))
    return first


def is_known(x: PyTree) -> bool:
    """Whether all values are known when the program is traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jtu.tree_leaves(x))


# Those of arrays that were seen before, by their contents: a program is traced several times.
_seen: dict[bytes, float] = {}


def two_norm(a: Any, precision: Any) -> Any:
    """That of a matrix or diagonal whose entries are known, to a little more than rounding."""
    if not is_known(a):
        return None
    a = np.asarray(a)
    key = sha256(np.ascontiguousarray(a).tobytes() + repr((a.shape, a.dtype)).encode()).digest()
    if key not in _seen:
        if len(_seen) >= 1000:
            _seen.clear()
        wide = a.astype(np.result_type(a, np.float64))
        norm = np.max(np.abs(wide), initial=0) if a.ndim == 1 else _largest_singular_value(wide)
        # NaN where an entry is.
        _seen[key] = float(norm) * (1 + 1e-6)
    return np.asarray(_seen[key], precision)


def _largest_singular_value(a: np.ndarray) -> float:
    if not np.isfinite(a).all():
        return np.nan
    for phase in (1.0, 1j):
        if np.array_equal(phase * a, (phase * a).conj().T):
            return float(np.abs(np.linalg.eigvalsh(phase * a)).max(initial=0))
    return float(np.linalg.norm(a, 2))


def bound_of_sparse(a: Any) -> Any:
    """A bound on the 2-norm, from the sums of absolute values in the rows and in the columns."""
    known = is_known((a.data, a.indices))
    xp: Any = np if known else jnp
    size = xp.abs(xp.asarray(a.data if known else lax.stop_gradient(a.data)))
    sums = []
    for axis in range(2):
        if known:
            places = np.asarray(a.indices)[:, axis]
            # What is padding points beyond the end.
            total = np.bincount(places, size, minlength=a.shape[axis])[: a.shape[axis]]
        else:
            total = (
                jnp.zeros(a.shape[axis], size.dtype).at[a.indices[:, axis]].add(size, mode="drop")
            )
        sums.append(xp.max(total, initial=0))
    return xp.sqrt(sums[0] * sums[1])
