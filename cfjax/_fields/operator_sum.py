"""Sums of fixed operators, of which only the coefficients vary."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact, Real

from .._arrays import Weight, describe, struct
from .._field import AbstractFrozenField, combine
from .._numerics.checks import differ, needing
from .._numerics.expm_multiply import expm_minus_one_multiply, row_norm
from .._numerics.matmul import by_columns, promoted
from .._numerics.operators import (
    added,
    applied,
    bound_of_sparse,
    dtype_of,
    entries_of,
    is_known,
    is_sparse,
    scaled,
    shape_of,
    size_of,
    two_norm,
)
from .._numerics.transforms import DTYPES
from .matrix import LeftMatrix, exp_minus_one_times, exp_times

# What a declared norm may be too small by, and a linear function off by: half of the digits.
_SLACK = 1e-3


class OperatorSum(AbstractFrozenField):
    """The field `x' = sum_k c_k A_k x` with fixed operators A_k.

    It is for controlled, driven and annealed systems, `i psi' = (H_0 + u(t) H_1) psi` and the like,
    up to sizes whose matrices do not fit in memory. The coordinates are the coefficients alone, so
    a linear combination of fields costs K numbers. **The operators are not coordinates**: they must
    be the same at every time and state. They may depend on `args`, and have derivatives. There is
    no bracket, as the commutator of two operators is another operator, so use commutator-free
    methods.

    ```python
    def field(t, y, args):
        return cfjax.OperatorSum([-1j, -1j * pulse(t, args)], [h0, h1], is_skew=True)
    ```

    The flow needs products with vectors only. It is the Taylor series of the exponential or, if
    `is_skew`, its Chebyshev series, to rounding. Arrays are added up first, which takes as long as
    a product with each; a field of arrays alone then works as `LeftMatrix` does, by a dense
    exponential if that is faster.

    **Arguments:**

    - `coefficients`: shape `(K,)`, or K scalars. Real or complex.
    - `operators`: K of these, each on vectors of size n, in any mix: an array of shape `(n, n)`; an
      array of shape `(n,)`, a diagonal; a `jax.experimental.sparse.BCOO`; a
      `lineax.AbstractLinearOperator`; a linear function of a vector. To declare a bound on the
      2-norm of an operator, give a pair `(operator, norm)`. Functions need a bound, and so do
      lineax operators other than matrices and diagonals. A function is compared by `==`, so define
      it outside of the field; a function with arrays is an `equinox.Module` or a
      `jax.tree_util.Partial`.
    - `is_skew`: whether every sum that occurs is skew-Hermitian, as in Schrödinger's equation. Then
      the flow is unitary to rounding and needs fewer products.

    It acts on a vector, shape `(n,)`, or on columns, shape `(n, k)`, of the common dtype of
    products and coefficients.

    **Cost:** a flow takes some 10 to 25 products with each operator for norms up to 2.4 and 10 for
    each unit beyond. If `is_skew`, it takes 9 to 20, 64 for a norm of 28 and 160 for one of 112.
    The bound on the norm is the sum of the bounds of the operators or, for arrays, the largest sum
    of absolute values in a row of their sum, if that is less. The 2-norm of an array that is known
    when the program is traced is computed then; if the array is not known, as in `args`, declare
    the norm if the matrix is large and full. Reverse mode keeps fewer than 200 vectors for each
    flow.

    **Raises** `TypeError` or `ValueError` if the numbers of coefficients and operators differ, if
    operators differ in shape or precision or are of another kind, or if a norm is missing or not a
    number; and, if values are known when the program is traced, for a function that is not linear,
    an operator whose norm exceeds its bound, or one that is not skew-Hermitian although `is_skew`
    and real coefficients say so.

    Source: Al-Mohy & Higham, Computing the action of the matrix exponential, SIAM J. Sci. Comput.
    33 (2011), doi:10.1137/100788860; Tal-Ezer & Kosloff, An accurate and efficient scheme for
    propagating the time dependent Schrödinger equation, J. Chem. Phys. 81 (1984),
    doi:10.1063/1.448136.
    """

    coefficients: Inexact[Array, " k"]
    operators: tuple[Any, ...]
    norms: tuple[Any, ...]
    is_skew: bool = eqx.field(static=True)

    def __init__(self, coefficients: Any, operators: Sequence[Any], *, is_skew: bool = False):
        if not isinstance(operators, Sequence) or len(operators) == 0:
            raise TypeError(
                f"operators must be a sequence of at least one operator, got {describe(operators)}."
            )
        if not isinstance(is_skew, bool):
            raise TypeError(f"is_skew must be True or False, got {is_skew!r}.")
        self.is_skew = is_skew
        pairs = [_with_norm(k, operator) for k, operator in enumerate(operators)]
        self.operators = tuple(operator for operator, _ in pairs)
        precision = _precision(self.operators)
        self.coefficients = _coefficients(coefficients, len(operators), precision)
        precision = jnp.finfo(self.coefficients.dtype).dtype
        self.norms = tuple(_norm(k, *pair, precision) for k, pair in enumerate(pairs))
        sizes = {n: k for k, a in reversed([*enumerate(self.operators)]) if (n := size_of(a))}
        if len(sizes) > 1:
            found = " and ".join(f"{n} for operators[{k}]" for n, k in reversed(sizes.items()))
            raise ValueError(f"operators must act on vectors of one size, got {found}.")
        dtypes = [self.coefficients.dtype, *map(dtype_of, self.operators)]
        is_complex = any(jnp.issubdtype(x, jnp.complexfloating) for x in dtypes if x is not None)
        for n in sizes:
            self._check_values(n, _dtype(precision, is_complex))

    def flow(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self._moved(point, exp_times, lambda change: point + change)

    def increment(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self._moved(point, exp_minus_one_times, lambda change: change)

    def _moved(
        self, point: Array, of_matrix: Callable[..., Array], of_added: Callable[[Array], Array]
    ) -> Array:
        self._check(point)
        matrix, diagonal, others, bound = self._summed()
        if matrix is not None and not others:
            a = matrix if diagonal is None else jnp.add(*promoted(matrix, jnp.diag(diagonal)))
            return of_matrix(LeftMatrix, a, point, bound, self.is_skew or None)
        products = [] if matrix is None else [by_columns(matrix)]
        products += [] if diagonal is None else [partial(applied, diagonal)]

        def product(x: Array) -> Array:
            terms = [times(x) for times in products]
            return added(terms + [scaled(c, applied(a, x)) for c, a in others])

        return of_added(expm_minus_one_multiply(product, point, bound, is_skew=self.is_skew))

    def tangent(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        self._check(point)
        terms = (
            scaled(c, applied(a, point))
            for c, a in zip(self.coefficients, self.operators, strict=True)
        )
        return added(terms)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> "OperatorSum":
        coefficients = combine(weights, _of_the_same_operators(fields))
        return eqx.tree_at(lambda field: field.coefficients, fields[0], coefficients)

    def _summed(self) -> tuple[Any, Any, list[tuple[Array, Any]], Real[Array, ""]]:
        """The sums of all matrices and of all diagonals, what else there is with its coefficients,
        and a bound on the norm of everything.
        """
        arrays: dict[int, list[tuple[Array, Any]]] = {1: [], 2: []}
        others, bounds = [], []
        for c, a, norm in zip(self.coefficients, self.operators, self.norms, strict=True):
            size = None if norm is None else jnp.abs(lax.stop_gradient(c)) * norm
            entries = entries_of(a)
            if entries is None:
                others.append((c, a))
                bounds.append(size)
            else:
                arrays[entries.ndim].append((scaled(c, jnp.asarray(entries)), size))
        diagonal, matrix = (
            added(a for a, _ in found) if found else None for found in arrays.values()
        )
        found = [pair for pairs in arrays.values() for pair in pairs]
        if found:
            # The norm of the sum of arrays may be far below the sum of the norms, and that of the
            # rows may be far above the 2-norm.
            of_sum = added(_row_norm(a) for a in (diagonal, matrix) if a is not None)
            of_each = added(_row_norm(a) if size is None else size for a, size in found)
            bounds.append(jnp.minimum(of_sum, of_each))
        return matrix, diagonal, others, added(bounds)

    def _check(self, point: Array) -> None:
        sizes = {size_of(a) for a in self.operators} - {None}
        if point.ndim not in (1, 2) or any(n != point.shape[0] for n in sizes):
            n = next(iter(sizes), "n")
            raise ValueError(
                f"OperatorSum with operators of size {n} acts on shapes ({n},) and ({n}, k), got "
                f"{point.shape}."
            )
        if not sizes:
            self._check_values(point.shape[0], point.dtype)

    def _check_values(self, n: int, dtype: Any) -> None:
        """Products with random vectors, of all operators whose values are known here and now."""
        rng = np.random.default_rng(0)
        x, y = (_cast(rng.normal(size=n) + 1j * rng.normal(size=n), dtype) for _ in range(2))
        length = np.linalg.norm(x)
        says_skew = self.is_skew and not jnp.iscomplexobj(self.coefficients)
        for k, (a, norm) in enumerate(zip(self.operators, self.norms, strict=True)):
            is_free = entries_of(a) is None and not is_sparse(a)
            if not (is_free or says_skew) or not is_known(a):
                continue
            with jax.ensure_compile_time_eval():
                ax, ay, both = (applied(a, jnp.asarray(z)) for z in (x, y, x - 2 * y))
            if not is_known((ax, ay, both)):
                continue
            ax, ay, both = map(np.asarray, (ax, ay, both))
            if ax.shape != (n,):
                raise ValueError(
                    f"operators[{k}] must return a vector of size {n} for one, got {ax.shape}."
                )
            size = np.linalg.norm(ax) + np.linalg.norm(ay)
            if not np.linalg.norm(both - (ax - 2 * ay)) <= _SLACK * size:
                raise ValueError(
                    f"operators[{k}] must be linear, but A(x - 2 y) is not A x - 2 A y for random "
                    "vectors x and y."
                )
            bound = float(norm) if norm is not None and is_known(norm) else np.inf
            if np.linalg.norm(ax) > (1 + _SLACK) * bound * length:
                raise ValueError(
                    f"operators[{k}] must have a norm of at least {np.linalg.norm(ax) / length:.4g}"
                    f", as a random vector shows, got {bound:.4g}."
                )
            if says_skew and abs(np.vdot(x, ax).real) > _SLACK * length * np.linalg.norm(ax):
                raise ValueError(
                    f"operators[{k}] must be skew-Hermitian, as is_skew and real coefficients say, "
                    "but x^H A x is not imaginary for a random vector x."
                )


class _Function(eqx.Module):
    """A function that is part of the structure."""

    function: Callable[[Array], Array] = eqx.field(static=True)

    def __call__(self, x: Array) -> Array:
        return self.function(x)


def _with_norm(k: int, operator: Any) -> tuple[Any, Any]:
    """The operator in the form in which it is kept, and its declared norm."""
    norm = None
    if isinstance(operator, tuple) and len(operator) == 2:
        operator, norm = operator
    if shape_of(operator) is not None:
        return operator, norm
    if callable(operator):
        function: Any = operator
        return _Function(function) if jtu.all_leaves([operator]) else function, norm
    raise TypeError(
        f"operators[{k}] must be an array, a jax.experimental.sparse.BCOO, a lineax operator, a "
        f"function, or a pair of one and its norm, got {describe(operator)}."
    )


def _precision(operators: Sequence[Any]) -> Any:
    """That of the operators; None if only functions."""
    found: dict[Any, int] = {}
    for k, operator in enumerate(operators):
        shape = shape_of(operator)
        if shape is None:
            continue
        if is_sparse(operator) and (operator.n_batch or operator.n_dense):
            raise ValueError(
                f"operators[{k}] must be a BCOO without batch and dense dimensions, got "
                f"n_batch={operator.n_batch} and n_dense={operator.n_dense}. Write "
                "jax.experimental.sparse.bcoo_update_layout(operator, n_batch=0, n_dense=0)."
            )
        if not (len(shape) == 1 or (len(shape) == 2 and shape[0] == shape[1])):
            raise ValueError(
                f"operators[{k}] must have shape (n, n), or (n,) for a diagonal, got {shape}."
            )
        if isinstance(operator, lx.AbstractLinearOperator):
            parts = jtu.tree_leaves((operator.in_structure(), operator.out_structure()))
            if any(part.ndim != 1 for part in parts) or len(parts) != 2:
                raise ValueError(
                    f"operators[{k}] must act on vectors, shape (n,), got the structure "
                    f"{describe(operator.in_structure())}."
                )
        dtype = dtype_of(operator)
        if jnp.dtype(dtype).name not in DTYPES:
            raise TypeError(f"operators[{k}] must be one of {', '.join(DTYPES)}, got {dtype}.")
        found.setdefault(jnp.finfo(dtype).dtype, k)
    if len(found) > 1:
        each = " and ".join(f"{precision} for operators[{k}]" for precision, k in found.items())
        raise TypeError(f"operators must have one precision, got {each}.")
    return next(iter(found), None)


def _coefficients(given: Any, number: int, precision: Any) -> Array:
    if not isinstance(given, jax.Array | np.ndarray):
        scalars = [c if isinstance(c, jax.Array) else np.asarray(c) for c in given]
        if any(np.shape(c) != () for c in scalars):
            raise ValueError(
                "coefficients must be an array of shape (K,) or a sequence of scalars, got shapes "
                f"{[np.shape(c) for c in scalars]}."
            )
        # Python's numbers take the precision of the others.
        dtypes = [c.dtype for c in given if hasattr(c, "dtype")]
        own = {jnp.finfo(x).dtype: x for x in dtypes if jnp.issubdtype(x, jnp.inexact)}
        precision = precision or next(iter(own), jnp.result_type(float))
        for wrong in own.keys() - {precision}:
            raise TypeError(f"coefficients must have the precision {precision}, got {own[wrong]}.")
        dtype = _dtype(precision, any(map(jnp.iscomplexobj, scalars)))
        given = jnp.stack([jnp.asarray(c).astype(dtype) for c in scalars]) if scalars else []
    values = jnp.asarray(given)
    if values.shape != (number,):
        raise ValueError(
            f"coefficients must be one for each of the {number} operators, shape ({number},), got "
            f"{values.shape}."
        )
    if values.dtype.name not in DTYPES or (
        precision is not None and jnp.finfo(values.dtype).dtype != precision
    ):
        raise TypeError(
            f"coefficients must be real or complex of the precision of the operators, "
            f"{precision or 'float32 or float64'}, got {values.dtype}."
        )
    return values


def _dtype(precision: Any, is_complex: bool) -> Any:
    return np.result_type(precision, np.complex64) if is_complex else precision


def _norm(k: int, operator: Any, norm: Any, precision: Any) -> Any:
    """The norm as an array; None for an array that is not known yet."""
    if norm is not None:
        is_number = isinstance(norm, int | float | np.generic | np.ndarray | jax.Array)
        if not is_number or jnp.shape(norm) or jnp.iscomplexobj(norm):
            raise TypeError(
                f"The norm of operators[{k}] must be a real number, got {describe(norm)}."
            )
        if not is_known(norm):
            return lax.stop_gradient(jnp.asarray(norm)).astype(precision)
        # In NumPy, so that it is known within a program, too.
        if not 0 <= float(norm) < np.inf:
            raise ValueError(f"The norm of operators[{k}] must be finite and >= 0, got {norm}.")
        return np.asarray(norm, precision)
    if (entries := entries_of(operator)) is not None:
        return two_norm(entries, precision)
    if is_sparse(operator):
        return bound_of_sparse(operator).astype(precision)
    kind = "A function" if shape_of(operator) is None else type(operator).__name__
    raise ValueError(
        f"{kind} needs a bound on its norm: give the pair (operator, norm) for operators[{k}]."
    )


def _row_norm(a: Array) -> Array:
    return row_norm(lax.stop_gradient(a))


def _cast(x: np.ndarray, dtype: Any) -> np.ndarray:
    return (x if jnp.issubdtype(dtype, jnp.complexfloating) else np.real(x)).astype(dtype)


def _of_the_same_operators(fields: Sequence[OperatorSum]) -> list[Array]:
    """The coefficients of each field, with an error in those with other operators."""
    first, *others = fields
    checked = [first.coefficients]
    for other in others:
        operators = first.operators, other.operators
        # Arrays are compared by shape here. Sparse ones have an == of their own.
        kinds = [(jtu.tree_structure(field.operators), field.is_skew) for field in (first, other)]
        shapes = [struct(jtu.tree_leaves(each)) for each in operators]
        if kinds[0] != kinds[1] or shapes[0] != shapes[1]:
            raise ValueError(
                "OperatorSum fields that are added must have the same operators and is_skew, got "
                f"{describe(operators[0])} and {describe(operators[1])}. Functions are the same if "
                "they are made once, outside of the field."
            )
        c = other.coefficients
        pairs = zip(*map(jtu.tree_leaves, operators), strict=True)
        # Most fields close over the same arrays, and need no check of their values.
        different = [differ(a, b) for a, b in pairs if a is not b]
        if different:
            zero = eqx.error_if(
                jnp.zeros(()),
                jnp.any(jnp.stack(different)),
                "OperatorSum fields that are added must have the same operators: these may not "
                "depend on time or state.",
            )
            c = needing(zero, c)
        checked.append(c)
    return checked
