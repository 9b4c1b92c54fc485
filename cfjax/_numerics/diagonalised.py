"""The eigenvectors of a fixed matrix as a transform, where no fast one is known."""

import hashlib
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Complex, Float, Inexact

from .matmul import matmul
from .transforms import DTYPES, AbstractTransform, checked


def _max_condition(dtype: Any) -> float:
    """The bound of the condition number of the eigenvectors, for points of this precision.

    A forward and an inverse transform may lose this factor of precision, and mostly lose a tenth of
    it. So half of the digits are left in float32, and ten digits in float64.
    """
    return min(1e6, float(np.finfo(dtype).eps) ** -0.5)


def diagonalised(
    matrix: Inexact[Array | np.ndarray, "n n"],
) -> tuple[Inexact[np.ndarray, " m"], AbstractTransform]:
    """The eigenvalues of a fixed matrix, and the transform to coefficients of its eigenvectors.

    For `cfjax.Affine` with an operator that no fast transform makes diagonal, for example diffusion
    with a variable coefficient:

    ```python
    spectrum, transform = cfjax.diagonalised(matrix)
    field = lambda t, u, args: cfjax.Affine(g(t, u), spectrum, transform)
    ```

    The matrix acts along the first axis; further axes are columns. It may also be the operator of
    one axis of a grid, in a `cfjax.TensorTransform`, where the eigenvalues of the axes are added:
    `np.add.outer(spectrum, other)`.

    The spectrum may be multiplied by a factor of `args`, as in `diffusivity * spectrum`, which has
    a derivative. The eigenvectors have none. For a matrix that itself depends on `args`, time or
    state there is `cfjax.LinearAffine(a, b)`.

    The dtype of the matrix says what the points are:

    - A real matrix with real eigenvalues takes real points, and complex ones: `m = n`.
    - A real matrix with complex eigenvalues takes real points. Their coefficients are complex, one
      for each real eigenvalue and for each pair of conjugate ones, as `RealFourierTransform` has
      them, so m is between n/2 and n. For complex points take
      `diagonalised(matrix.astype(complex))`.
    - A complex matrix takes complex points: `m = n`.

    Of the axes of a grid of real points one may have complex coefficients by itself. The others
    with complex eigenvalues take complex matrices.

    A matrix that is symmetric or Hermitian, or becomes so by a positive diagonal scaling
    `D A D^-1`, has real eigenvalues here, which `numpy.linalg.eigh` computes. Tridiagonal matrices
    whose opposite entries have positive products are such, for example `mu(x) u_xx` by differences.
    Others take `numpy.linalg.eig`.

    It computes in float64 on the host, once, which takes some `10 n^3` flops, or `25 n^3` with
    `eig`. A transform is a product with a dense n x n matrix, `2 n^2` flops a column. The matrices
    are constants of the program, and points in float32 are multiplied in float32.

    **Arguments:** `matrix`, shape `(n, n)` with n >= 1, finite, float32, float64, complex64 or
    complex128. Its values must be known when the program is traced.

    **Returns:** the eigenvalues, shape `(m,)`, in the precision of the matrix, and the transform.

    **Raises** `TypeError` for another dtype, or a matrix that is traced; `ValueError` for another
    shape, entries that are not finite, or eigenvectors whose condition number is 1e6 or more, or
    2.9e3 for a matrix in single precision, where rounding would be as large as 3e-4 of the result.
    A matrix without a basis of eigenvectors is such: use `cfjax.LinearAffine(a, b)`. The transform
    raises `ValueError` for points in single precision if the condition number is too large for
    them.

    Source: Golub & Van Loan, Matrix Computations (4th ed., 2013), Sections 7.1, 7.2 and 8.1.
    """
    a = _checked_matrix(matrix)
    precision = np.finfo(a.dtype).dtype
    wide = a.astype(np.result_type(a.dtype, np.float64))
    eigensystem = _by_symmetry(wide, precision) or _by_eig(wide, precision)
    eigenvalues, vectors, inverse, condition = eigensystem
    transform: AbstractTransform
    if np.iscomplexobj(a):
        to, back = _parts(inverse), _parts(vectors)
        transform = ComplexEigenvectors(_Matrix(to), _Matrix(back), condition)
    elif np.iscomplexobj(vectors):
        # One of each conjugate pair. The sum over a pair is twice the real part of one term.
        is_first = np.imag(eigenvalues) >= 0
        eigenvalues = eigenvalues[is_first]
        back = np.where(np.imag(eigenvalues) > 0, 2, 1) * vectors[:, is_first]
        real_back = np.concatenate([np.real(back), -np.imag(back)], axis=1)
        to = _parts(inverse[is_first])
        transform = ConjugateEigenvectors(_Matrix(to), _Matrix(real_back), condition)
    else:
        transform = RealEigenvectors(_Matrix(inverse), _Matrix(vectors), condition)
    least = np.complex64 if np.iscomplexobj(eigenvalues) else np.float32
    return eigenvalues.astype(np.result_type(precision, least)), transform


class _Matrix:
    """A real matrix as a constant of programs, compared by its entries.

    As an array of the transform it would be stored for every step by output within a step.
    """

    def __init__(self, entries: Float[np.ndarray, "rows columns"]):
        entries = np.ascontiguousarray(entries)
        self.shape = entries.shape
        self._in_dtype = {entries.dtype: entries}
        self._key = entries.shape, hashlib.sha256(entries.tobytes()).digest()

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _Matrix) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __repr__(self) -> str:
        return f"{self.shape[0]}x{self.shape[1]} {self._key[1].hex()[:8]}"

    def __matmul__(self, x: Inexact[Array, "columns *k"]) -> Inexact[Array, "rows *k"]:
        if jnp.iscomplexobj(x):
            # Two real products take a third of the time of a complex one.
            return lax.complex(self @ x.real, self @ x.imag)
        # One object for all products, so that a program contains the constant once.
        (first, *_) = self._in_dtype.values()
        entries = self._in_dtype.setdefault(x.dtype, first.astype(x.dtype))
        return matmul(entries, x.reshape(len(x), -1)).reshape(-1, *x.shape[1:])


class AbstractEigenvectors(AbstractTransform):
    """A transform of `diagonalised`. Real and imaginary parts of complex matrices are stacked."""

    to: _Matrix = eqx.field(static=True)
    back: _Matrix = eqx.field(static=True)
    condition: float = eqx.field(static=True, repr=False)

    def _checked(self, x: Array, matrix: _Matrix) -> Array:
        x, length = checked(self, x), matrix.shape[1]
        # The precision of the points may be lower than that of the matrix.
        _check_condition("The matrix of cfjax.diagonalised", self.condition, x.dtype)
        if len(x) != length:
            raise ValueError(
                f"The transform of cfjax.diagonalised, {self!r}, got length {len(x)} along its "
                f"axis, expected {length}."
            )
        return x


class RealEigenvectors(AbstractEigenvectors):
    """The transform of a real matrix with real eigenvalues."""

    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self.to @ self._checked(point, self.to)

    def inverse(self, coefficients: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self.back @ self._checked(coefficients, self.back)


class ConjugateEigenvectors(AbstractEigenvectors):
    """The transform of a real matrix with complex eigenvalues, to one of each conjugate pair."""

    _rank: ClassVar[int] = 1

    def forward(self, point: Float[Array, "n *k"]) -> Complex[Array, "m *k"]:
        point = self._checked(point, self.to)
        if jnp.iscomplexobj(point):
            raise TypeError(
                "cfjax.diagonalised of a real matrix with complex eigenvalues takes real points, "
                f"got {point.dtype}. For complex points take diagonalised(matrix.astype(complex))."
            )
        real, imag = jnp.split(self.to @ point, 2)
        return lax.complex(real, imag)

    def inverse(self, coefficients: Complex[Array, "m *k"]) -> Float[Array, "n *k"]:
        c = checked(self, coefficients)
        if len(c) != self.back.shape[1] // 2:
            raise ValueError(
                f"The transform of cfjax.diagonalised, {self!r}, got {len(c)} coefficients along "
                f"its axis, expected {self.back.shape[1] // 2}."
            )
        return self.back @ jnp.concatenate([c.real, c.imag])


class ComplexEigenvectors(AbstractEigenvectors):
    """The transform of a complex matrix."""

    _rank: ClassVar[int] = 2

    def forward(self, point: Complex[Array, "n *k"]) -> Complex[Array, "n *k"]:
        return self._times(self.to, point)

    def inverse(self, coefficients: Complex[Array, "n *k"]) -> Complex[Array, "n *k"]:
        return self._times(self.back, coefficients)

    def _times(self, matrix: _Matrix, x: Array) -> Array:
        x = self._checked(x, matrix)
        if not jnp.iscomplexobj(x):
            raise TypeError(
                f"cfjax.diagonalised of a complex matrix takes complex points, got {x.dtype}. Real "
                "points take that of a real matrix, along one axis of a grid."
            )
        p, q = jnp.split(matrix @ x, 2)
        return lax.complex(p.real - q.imag, p.imag + q.real)


def _checked_matrix(matrix: Any) -> np.ndarray:
    if isinstance(matrix, Tracer):
        raise TypeError(
            "matrix must be known before the program is traced, got a traced array, "
            f"{matrix.dtype} of shape {matrix.shape}. Call cfjax.diagonalised outside of jax.jit "
            "and of the field, or use cfjax.LinearAffine(a, b)."
        )
    a = np.asarray(matrix)
    if a.dtype.name not in DTYPES:
        raise TypeError(f"matrix must be one of {', '.join(DTYPES)}, got {a.dtype}.")
    if a.ndim != 2 or a.shape[0] != a.shape[1] or len(a) == 0:
        raise ValueError(f"matrix must have the shape (n, n) with n >= 1, got {a.shape}.")
    if not np.isfinite(a).all():
        raise ValueError(
            f"matrix must be finite, got {np.sum(~np.isfinite(a))} entries that are not."
        )
    return a


def _check_condition(what: str, condition: float, dtype: Any) -> None:
    if not condition < _max_condition(dtype):
        raise ValueError(
            f"{what} must have eigenvectors of a condition number below "
            f"{_max_condition(dtype):.0e}, got {condition:.1e}, for points in {np.dtype(dtype)}. "
            "Use cfjax.LinearAffine(a, b), which takes any matrix."
        )


# The eigenvalues, the eigenvectors, their inverse and their condition number.
_Eigensystem = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def _by_symmetry(a: np.ndarray, precision: Any) -> _Eigensystem | None:
    """The eigensystem if D a D^-1 is Hermitian but for rounding in this precision."""
    eps = np.finfo(precision).eps
    for scale in (np.ones(len(a)), _symmetrising(a)):
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            s = scale[:, None] * a / scale
            is_hermitian = np.abs(s - s.conj().T).max() <= 16 * eps * np.abs(s).max()
            condition = float(scale.max() / scale.min())
        if is_hermitian and condition < _max_condition(precision):
            eigenvalues, q = np.linalg.eigh((s + s.conj().T) / 2)
            return eigenvalues, q / scale[:, None], q.conj().T * scale, condition
    return None


def _symmetrising(a: np.ndarray) -> Float[np.ndarray, " n"]:
    """The diagonal of D, if there is one. Entries a_ij and a_ji give the ratio of d_i and d_j."""
    size, scale = np.abs(a), np.zeros(len(a))
    both = (size > 0) & (size.T > 0)
    with np.errstate(over="ignore", under="ignore"):
        for root in range(len(a)):
            if scale[root] == 0:
                scale[root], stack = 1, [root]
                while stack:
                    i = stack.pop()
                    new = np.flatnonzero(both[i] & (scale == 0))
                    scale[new] = scale[i] * np.sqrt(size[i, new] / size[new, i])
                    stack.extend(new)
    return scale


def _by_eig(a: np.ndarray, precision: Any) -> _Eigensystem:
    eigenvalues, vectors = np.linalg.eig(a)
    if not (np.iscomplexobj(a) or np.imag(eigenvalues).any()):
        # Some versions of NumPy return complex arrays for real eigenvalues too.
        eigenvalues, vectors = np.real(eigenvalues), np.real(vectors)
    with np.errstate(divide="ignore"):
        condition = float(np.linalg.cond(vectors))
    _check_condition("matrix", condition, precision)
    return eigenvalues, vectors, np.linalg.inv(vectors), condition


def _parts(a: np.ndarray) -> Float[np.ndarray, "rows columns"]:
    return np.concatenate([np.real(a), np.imag(a)])
