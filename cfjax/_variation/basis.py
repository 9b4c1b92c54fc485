"""Bases of matrix Lie algebras, which the classes of matrices do not know."""

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Inexact, Real

from .._numerics.matmul import matmul

Kind = Literal["so", "su", "u", "gl"]


def algebra_basis(kind: Kind, n: int) -> np.ndarray:
    """A basis of a matrix Lie algebra over the real numbers, for `cfjax.VariationTerm`.

    **Arguments:**

    - `kind`: which n x n matrices:

        | | matrices | length d | normalised to |
        | --- | --- | --- | --- |
        | `"so"` | real and skew-symmetric | n (n - 1) / 2 | entries 1 and -1 |
        | `"su"` | skew-Hermitian with trace 0 | n^2 - 1 | `tr(T_j^H T_k)` 1/2 for j = k, 0 else |
        | `"u"` | skew-Hermitian | n^2 | the same |
        | `"gl"` | real | n^2 | one entry 1 |

      For `"so"` with n = 3 these are the cross products with the three axes, so that coefficients
      are angular velocities. So they are for `"su"` with n = 2: the matrices `-i sigma_k / 2` of
      Pauli. Otherwise `"so"` has `e_j e_i^T - e_i e_j^T` for i < j in the order of rows, and
      `"su"` -i/2 times the matrices of Gell-Mann in an order of its own: symmetric, antisymmetric,
      diagonal.
    - `n`: the size, at least 2, or 1 for `"u"` and `"gl"`.

    **Returns:** a NumPy array of shape `(d, n, n)`, complex128 for `"su"` and `"u"` and otherwise
    float64. A `VariationTerm` converts it to the precision of the state.

    **Raises** `ValueError` for another kind or size.
    """
    if kind not in ("so", "su", "u", "gl"):
        raise ValueError(f'kind must be "so", "su", "u" or "gl", got {kind!r}.')
    least = 2 if kind in ("so", "su") else 1
    if not isinstance(n, int | np.integer) or isinstance(n, bool) or n < least:
        raise ValueError(f'n must be an int of at least {least} for "{kind}", got {n!r}.')
    unit = np.eye(n * n).reshape(n, n, n, n)  # unit[i, j] has its one in row i and column j
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    if kind == "gl":
        return unit.reshape(n * n, n, n)
    if kind == "so":
        if n == 3:
            pairs = [(1, 2), (2, 0), (0, 1)]
        return np.stack([unit[j, i] - unit[i, j] for i, j in pairs])
    matrices = [-0.5j * (unit[i, j] + unit[j, i]) for i, j in pairs]
    matrices += [(unit[j, i] - unit[i, j]) / 2 + 0j for i, j in pairs]
    for m in range(1, n):
        diagonal = np.r_[np.ones(m), -m, np.zeros(n - m - 1)]
        matrices.append(-0.5j * np.diag(diagonal / np.sqrt(m * (m + 1) / 2)))
    if kind == "u":
        matrices.append(-1j * np.eye(n) / np.sqrt(2 * n))
    return np.stack(matrices)


class Basis:
    """A basis of matrices, a constant of the program.

    `dual` has the functionals of its coefficients: `c_k = re sum(dual[k] * a)` for the matrix
    `a = sum_k c_k T_k`.

    **Raises** `TypeError` or `ValueError` unless the matrices, shape `(d, n, n)`, are linearly
    independent over the real numbers and closed under the commutator.
    """

    def __init__(self, basis: Any):
        if isinstance(basis, Tracer):
            raise TypeError("basis must be known when the program is traced: a NumPy array.")
        try:
            basis = np.asarray(basis)
            is_number = np.issubdtype(basis.dtype, np.number)
        except (TypeError, ValueError):
            is_number = False
        if not is_number:
            raise TypeError(f"basis must be an array of matrices, got {basis!r}.")
        if basis.ndim != 3 or basis.shape[1] != basis.shape[2] or not len(basis):
            raise ValueError(f"basis must have shape (d, n, n), got {basis.shape}.")
        basis = basis.astype(complex if np.iscomplexobj(basis) else float)
        d = len(basis)
        flat = basis.reshape(d, -1)
        real = np.concatenate([flat.real, flat.imag], axis=1)
        singular = np.linalg.svd(real, compute_uv=False)
        if len(singular) < d or singular[-1] < 1e-6 * singular[0]:
            raise ValueError(f"basis must have {d} matrices that are linearly independent over R.")
        # x -> re sum(dual * x): the imaginary part has the other sign.
        pinv = np.linalg.pinv(real)
        dual = pinv[: flat.shape[1]] - 1j * pinv[flat.shape[1] :]
        dual = dual.T.reshape(basis.shape)
        commutators = np.einsum("aij,bjk->abik", basis, basis)
        commutators = commutators - commutators.swapaxes(0, 1)
        c = np.einsum("dij,abij->abd", dual, commutators).real
        defect = np.abs(np.einsum("abd,dij->abij", c, basis) - commutators).max()
        if defect > 1e-6 * np.abs(basis).max() ** 2:
            raise ValueError(
                "basis must be closed under the commutator, and one of two of its matrices is off "
                f"its span by {defect:.1g}. cfjax.algebra_basis has those of some algebras."
            )
        self.matrices = basis
        self.dual = dual if np.iscomplexobj(basis) else dual.real

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Basis) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> Any:
        return self.matrices.shape, self.matrices.dtype, self.matrices.tobytes()

    @property
    def size(self) -> int:
        """The matrices have so many rows."""
        return self.matrices.shape[-1]

    def coefficients(self, a: Inexact[Array, "*batch n n"]) -> Real[Array, "*batch d"]:
        d, dtype = len(self.dual), jnp.finfo(a.dtype).dtype
        flat, rows = a.reshape(*a.shape[:-2], -1), self.dual.reshape(d, -1).T
        product = matmul(flat.real, jnp.asarray(rows.real, dtype))
        if not jnp.iscomplexobj(flat) or not np.iscomplexobj(rows):
            return product
        return product - matmul(flat.imag, jnp.asarray(rows.imag, dtype))

    def matrix(self, c: Real[Array, "*batch d"], dtype: Any) -> Inexact[Array, "*batch n n"]:
        """The matrix with these coefficients. `dtype` may be real only if the basis is."""
        d, n = self.matrices.shape[:2]
        flat = self.matrices.reshape(d, -1)
        product = matmul(c, jnp.asarray(flat.real, c.dtype))
        if jnp.issubdtype(dtype, jnp.complexfloating):
            imaginary = jnp.asarray(flat.imag, c.dtype)
            product = lax.complex(product, matmul(c, imaginary))
        return product.reshape(*c.shape[:-1], n, n)
