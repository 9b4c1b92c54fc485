"""Square matrices of few diagonals, as those of ladder operators are, and their products."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Inexact

from .matmul import promoted, small_product

# With more diagonals, or in smaller matrices, dense products are as fast in a batch.
_MOST_DIAGONALS = 3
_LEAST_ROWS = 5


class Diagonals(eqx.Module):
    """The matrix a with `a[i, i + offsets[k]] = entries[k, i]`, and zeros elsewhere.

    `jax.vmap` may return it with leading axes.
    """

    entries: Inexact[Array | np.ndarray, "*batch k n"]
    offsets: tuple[int, ...] = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, ...]:
        *leading, _, n = self.entries.shape
        return *leading, n, n

    @property
    def dtype(self) -> Any:
        return self.entries.dtype


Matrix = Inexact[Array | np.ndarray, "*leading n n"] | Diagonals


def compact(a: Inexact[Array | np.ndarray, "*batch n n"]) -> Matrix:
    """The matrix by its diagonals, if these are few and known when the program is traced.

    Another matrix that is known becomes one of NumPy, so that it stays known.
    """
    if isinstance(a, Tracer) or a.ndim != 2:
        return jnp.asarray(a)
    known = np.asarray(a)
    rows, columns = np.nonzero(known)
    offsets = sorted({*(columns - rows).tolist()}) or [0]
    if len(known) < _LEAST_ROWS or len(offsets) > _MOST_DIAGONALS:
        return known
    entries = np.zeros((len(offsets), len(known)), known.dtype)
    for k, offset in enumerate(offsets):
        diagonal = np.diagonal(known, offset)
        entries[k, max(-offset, 0) : max(-offset, 0) + len(diagonal)] = diagonal
    return Diagonals(entries, tuple(offsets))


def adjoint(a: Matrix) -> Matrix:
    """The conjugate transpose."""
    if not isinstance(a, Diagonals):
        return a.conj().T
    numpy: Any = np if isinstance(a.entries, np.ndarray) else jnp
    # An entry that does not exist is zero, so that it may wrap around.
    rows = [numpy.roll(e, k) for e, k in zip(a.entries, a.offsets, strict=True)]
    return Diagonals(numpy.stack(rows).conj(), tuple(-k for k in a.offsets))


def times(a: Matrix, x: Inexact[Array, "n m"]) -> Inexact[Array, "n m"]:
    """`a @ x`: k products of numbers for each entry of x, or a product of matrices."""
    if not isinstance(a, Diagonals):
        return small_product(*promoted(jnp.asarray(a), x))
    zero, total = jnp.zeros((), x.dtype), None
    for entries, offset in zip(jnp.asarray(a.entries), a.offsets, strict=True):
        # The rows moved up by the offset, with zeros in the empty ones.
        moved = lax.pad(x, zero, [(-offset, offset, 0), (0, 0, 0)])
        term = jnp.multiply(*promoted(entries[:, None], moved))
        total = term if total is None else total + term
    return jnp.zeros_like(x) if total is None else total


def times_adjoint(x: Inexact[Array, "m n"], a: Matrix) -> Inexact[Array, "m n"]:
    """`x @ a^H`, as `times`."""
    if not isinstance(a, Diagonals):
        return small_product(*promoted(x, jnp.asarray(adjoint(a))))
    return times(a, x.conj().T).conj().T


def dense(a: Matrix) -> Inexact[Array | np.ndarray, "n n"]:
    """The matrix with all its entries. One that is known stays known."""
    if not isinstance(a, Diagonals):
        return a
    n = a.shape[-1]
    total: Any = 0
    for e, k in zip(a.entries, a.offsets, strict=True):
        total = total + e[:, None] * np.eye(n, k=k, dtype=e.dtype)
    return total


def gram(a: Matrix) -> Inexact[Array, "n n"]:
    """`a^H @ a`."""
    whole = dense(a)
    if isinstance(whole, np.ndarray):
        return jnp.asarray(whole.conj().T @ whole)
    return times(adjoint(a), whole)
