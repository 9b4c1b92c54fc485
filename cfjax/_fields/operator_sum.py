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
from jax.core import Tracer
from jaxtyping import Array, Inexact, Real

from .._arrays import Weight, describe, struct
from .._field import AbstractFrozenField, combine
from .._numerics.checks import differ, error_where
from .._numerics.expm_multiply import expm_minus_one_multiply, row_norm
from .._numerics.matmul import by_columns, promoted
from .._numerics.operators import (
    added,
    applied,
    dtype_of,
    entries_of,
    scaled,
    shape_of,
    two_norm,
)
from .._numerics.transforms import DTYPES
from .matrix import LeftMatrix, exp_minus_one_times, exp_times


class OperatorSum(AbstractFrozenField):
    """The field `x' = sum_k c_k A_k x` with fixed operators A_k.

    It is for controlled, driven and annealed systems, `i psi' = (H_0 + u(t) H_1) psi` and the like,
    up to sizes whose matrices do not fit in memory. The only coordinates are the coefficients, so
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
    a product with each. If all operators are arrays, the field then works as `LeftMatrix` does, by
    a dense exponential if that is faster.

    **Arguments:**

    - `coefficients`: shape `(K,)`, or K scalars. Real or complex.
    - `operators`: K of these, each on vectors of size n, in any mix: an array of shape `(n, n)`; an
      array of shape `(n,)`, a diagonal; a `lineax.AbstractLinearOperator`, for example
      `lineax.FunctionLinearOperator(f, jax.ShapeDtypeStruct((n,), dtype))` of a linear function of
      a vector. To declare a bound on the 2-norm of an operator, give a pair `(operator, norm)`.
      Lineax operators other than matrices and diagonals need a bound. Make operators once, outside
      of the field: two operators that are made of one function are not equal.
    - `is_skew`: whether every sum that occurs is skew-Hermitian, as in Schrödinger's equation. Then
      the flow is unitary to rounding and needs fewer products.

    It acts on a vector, shape `(n,)`, or on columns, shape `(n, k)`, of the common dtype of
    products and coefficients.

    **Cost:** a flow takes some 10 to 25 products with each operator for norms up to 2.4 and 10 for
    each unit beyond. If `is_skew`, it takes 9 to 20, 64 for a norm of 28 and 160 for one of 112.
    The bound on the norm is the sum of the bounds of the operators or, for arrays, the largest sum
    of absolute values in a row of their sum, if that is less. The bound of a diagonal, and of a
    matrix with at most 128 rows, is its 2-norm if the array is known when the program is traced.
    Declare the norm of matrices that are larger or not known, as in `args`, if they are full: their
    rows may exceed it by a factor of sqrt(n). Reverse mode keeps fewer than 200 vectors for each
    flow.

    **Raises** `TypeError` or `ValueError` if the numbers of coefficients and operators differ, if
    operators differ in shape or precision or are of another kind, if a norm is missing or not a
    number, or if coefficients are real and an array is not skew-Hermitian although `is_skew` says
    so. Nothing else is checked: a flow is wrong if a declared norm is too small or an operator is
    not linear, which `cfjax.check_field` finds, and less accurate the longer a step is if another
    operator is not skew although `is_skew` says so.

    Source: Al-Mohy & Higham, Computing the action of the matrix exponential, SIAM J. Sci. Comput.
    33 (2011), doi:10.1137/100788860; Tal-Ezer & Kosloff, An accurate and efficient scheme for
    propagating the time dependent Schrödinger equation, J. Chem. Phys. 81 (1984),
    doi:10.1063/1.448136.
    """

    coefficients: Inexact[Array, " k"]
    arrays: tuple[Any, ...]
    structure: tuple[Any, ...] = eqx.field(static=True)
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
        # A lineax operator may hold a function, which cannot be a leaf of a field.
        is_array = lambda x: isinstance(x, jax.Array | np.ndarray)  # noqa: E731
        self.arrays, self.structure = eqx.partition(tuple(a for a, _ in pairs), is_array)
        precision = _precision(self.operators)
        sizes = {shape_of(a)[0]: k for k, a in reversed([*enumerate(self.operators)])}
        if len(sizes) > 1:
            listed = " and ".join(f"{n} for operators[{k}]" for n, k in reversed(sizes.items()))
            raise ValueError(f"operators must act on vectors of one size, got {listed}.")
        self.coefficients = _coefficients(coefficients, len(operators), precision)
        self.norms = tuple(_norm(k, *pair, precision) for k, pair in enumerate(pairs))
        if is_skew and not jnp.iscomplexobj(self.coefficients):
            for k, operator in enumerate(self.operators):
                _check_skew(k, operator)

    @property
    def operators(self) -> tuple[Any, ...]:
        return eqx.combine(self.arrays, self.structure)

    def flow(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self._apply(point, exp_times, lambda increment: point + increment)

    def increment(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self._apply(point, exp_minus_one_times, lambda increment: increment)

    def _apply(
        self, point: Array, of_matrix: Callable[..., Array], of_increment: Callable[[Array], Array]
    ) -> Array:
        """A function of the exponential, by that of one matrix or from the increment."""
        self._check(point)
        matrix, diagonal, matrix_free, bound = self._summed()
        if matrix is not None and not matrix_free:
            a = matrix if diagonal is None else jnp.add(*promoted(matrix, jnp.diag(diagonal)))
            return of_matrix(LeftMatrix, a, point, bound, self.is_skew or None)
        products = [] if matrix is None else [by_columns(matrix)]
        products += [] if diagonal is None else [partial(applied, diagonal)]

        def product(x: Array) -> Array:
            terms = [times(x) for times in products]
            return added(terms + [scaled(c, applied(a, x)) for c, a in matrix_free])

        return of_increment(expm_minus_one_multiply(product, point, bound, is_skew=self.is_skew))

    def tangent(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        self._check(point)
        terms = (
            scaled(c, applied(a, point))
            for c, a in zip(self.coefficients, self.operators, strict=True)
        )
        return added(terms)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> "OperatorSum":
        checked = [_checked_coefficients(field, fields[0]) for field in fields]
        coefficients = combine(weights, checked)
        return eqx.tree_at(lambda field: field.coefficients, fields[0], coefficients)

    def _summed(self) -> tuple[Any, Any, list[tuple[Array, Any]], Real[Array, ""]]:
        """The sums of all matrices and of all diagonals, the other operators with their
        coefficients, and a bound on the norm of the whole sum.
        """
        arrays: dict[int, list[tuple[Array, Any]]] = {1: [], 2: []}
        matrix_free, bounds = [], []
        for c, a, norm in zip(self.coefficients, self.operators, self.norms, strict=True):
            bound = None if norm is None else jnp.abs(lax.stop_gradient(c)) * norm
            entries = entries_of(a)
            if entries is None:
                matrix_free.append((c, a))
                bounds.append(bound)
            else:
                arrays[entries.ndim].append((scaled(c, jnp.asarray(entries)), bound))
        diagonal, matrix = (
            added(a for a, _ in pairs) if pairs else None for pairs in arrays.values()
        )
        terms = [pair for pairs in arrays.values() for pair in pairs]
        if terms:
            # The norm of the sum of arrays may be far below the sum of the norms, and that of the
            # rows may be far above the 2-norm.
            of_sum = added(_row_norm(a) for a in (diagonal, matrix) if a is not None)
            of_each = added(_row_norm(a) if bound is None else bound for a, bound in terms)
            bounds.append(jnp.minimum(of_sum, of_each))
        return matrix, diagonal, matrix_free, added(bounds)

    def _check(self, point: Array) -> None:
        n = shape_of(self.operators[0])[0]
        if point.ndim not in (1, 2) or n != point.shape[0]:
            raise ValueError(
                f"OperatorSum with operators of size {n} acts on shapes ({n},) and ({n}, k), got "
                f"{point.shape}."
            )


def _with_norm(k: int, operator: Any) -> tuple[Any, Any]:
    """The operator, and its declared norm."""
    norm = None
    if isinstance(operator, tuple) and len(operator) == 2:
        operator, norm = operator
    if not isinstance(operator, jax.Array | np.ndarray | lx.AbstractLinearOperator):
        hint = ""
        if callable(operator):
            hint = " Write a linear function of a vector as a lineax.FunctionLinearOperator."
        raise TypeError(
            f"operators[{k}] must be an array, a lineax operator, or a pair of one and its norm, "
            f"got {describe(operator)}.{hint}"
        )
    return operator, norm


def _precision(operators: Sequence[Any]) -> Any:
    """The precision of the operators."""
    precisions: dict[Any, int] = {}
    for k, operator in enumerate(operators):
        if isinstance(operator, lx.AbstractLinearOperator):
            structs = jtu.tree_leaves((operator.in_structure(), operator.out_structure()))
            if any(x.ndim != 1 for x in structs) or len(structs) != 2:
                raise ValueError(
                    f"operators[{k}] must act on vectors, shape (n,), got the structure "
                    f"{describe(operator.in_structure())}."
                )
        shape, dtype = shape_of(operator), dtype_of(operator)
        if not (len(shape) == 1 or (len(shape) == 2 and shape[0] == shape[1])):
            raise ValueError(
                f"operators[{k}] must have shape (n, n), or (n,) for a diagonal, got {shape}."
            )
        if jnp.dtype(dtype).name not in DTYPES:
            raise TypeError(f"operators[{k}] must be one of {', '.join(DTYPES)}, got {dtype}.")
        precisions.setdefault(jnp.finfo(dtype).dtype, k)
    if len(precisions) > 1:
        listed = " and ".join(f"{dtype} for operators[{k}]" for dtype, k in precisions.items())
        raise TypeError(f"operators must have one precision, got {listed}.")
    return next(iter(precisions))


def _coefficients(coefficients: Any, number: int, precision: Any) -> Array:
    if not isinstance(coefficients, jax.Array | np.ndarray):
        scalars = [c if isinstance(c, jax.Array) else np.asarray(c) for c in coefficients]
        if any(np.shape(c) != () for c in scalars):
            raise ValueError(
                "coefficients must be an array of shape (K,) or a sequence of scalars, got shapes "
                f"{[np.shape(c) for c in scalars]}."
            )
        # Python's numbers take the precision of the operators.
        dtypes = [c.dtype for c in coefficients if hasattr(c, "dtype")]
        for dtype in dtypes:
            if jnp.issubdtype(dtype, jnp.inexact) and jnp.finfo(dtype).dtype != precision:
                raise TypeError(f"coefficients must have the precision {precision}, got {dtype}.")
        is_complex = any(map(jnp.iscomplexobj, scalars))
        dtype = np.result_type(precision, np.complex64) if is_complex else precision
        coefficients = [jnp.asarray(c).astype(dtype) for c in scalars]
    values = jnp.asarray(coefficients)
    if values.shape != (number,):
        raise ValueError(
            f"coefficients must be one for each of the {number} operators, shape ({number},), got "
            f"{values.shape}."
        )
    if values.dtype.name not in DTYPES or jnp.finfo(values.dtype).dtype != precision:
        raise TypeError(
            f"coefficients must be real or complex of the precision of the operators, "
            f"{precision}, got {values.dtype}."
        )
    return values


def _norm(k: int, operator: Any, norm: Any, precision: Any) -> Any:
    """The norm as an array; None for an array whose rows bound it."""
    if norm is None:
        entries = entries_of(operator)
        if entries is None:
            raise ValueError(
                f"{type(operator).__name__} needs a bound on its norm: give the pair "
                f"(operator, norm) for operators[{k}]."
            )
        computed = two_norm(entries)
        return None if computed is None else np.asarray(computed, precision)
    is_number = isinstance(norm, int | float | np.generic | np.ndarray | jax.Array)
    if not is_number or jnp.shape(norm) or jnp.iscomplexobj(norm):
        raise TypeError(f"The norm of operators[{k}] must be a real number, got {describe(norm)}.")
    if isinstance(norm, Tracer):
        return lax.stop_gradient(norm).astype(precision)
    # In NumPy, so that its value is known in a trace.
    if not 0 <= float(norm) < np.inf:
        raise ValueError(f"The norm of operators[{k}] must be finite and >= 0, got {norm}.")
    return np.asarray(norm, precision)


def _check_skew(k: int, operator: Any) -> None:
    """Raises `ValueError` for an array whose values are known in a trace and not skew-Hermitian."""
    a = entries_of(operator)
    if a is None or isinstance(a, Tracer):
        return
    a = np.asarray(a)
    defect = a + a.conj() if a.ndim == 1 else a + a.conj().T
    # Half of the digits of single precision.
    if np.abs(defect).max(initial=0) > 1e-3 * np.abs(a).max(initial=0):
        raise ValueError(
            f"operators[{k}] must be skew-Hermitian, as is_skew and real coefficients say, but "
            f"A + A^H has an entry of size {np.abs(defect).max():.2g}, and A of "
            f"{np.abs(a).max():.2g}."
        )


def _row_norm(a: Array) -> Array:
    return row_norm(lax.stop_gradient(a))


def _checked_coefficients(field: OperatorSum, first: OperatorSum) -> Array:
    """The coefficients of a field, with an error if its operators are not those of the first."""
    leaves = [jtu.tree_leaves(f.arrays) for f in (first, field)]
    kinds = [
        (f.structure, jtu.tree_structure(f.arrays), struct(arrays), f.is_skew)
        for f, arrays in zip((first, field), leaves, strict=True)
    ]
    if kinds[0] != kinds[1]:
        raise ValueError(
            "OperatorSum fields that are added must have the same operators and is_skew, got "
            f"{describe(first.operators)} and {describe(field.operators)}. Lineax operators of "
            "functions are the same if they are made once, outside of the field."
        )
    # Most fields close over the same arrays, and need no check of their values.
    different = [differ(a, b) for a, b in zip(*leaves, strict=True) if a is not b]
    if not different:
        return field.coefficients
    return error_where(
        field.coefficients,
        jnp.any(jnp.stack(different)),
        "OperatorSum fields that are added must have the same operators: these may not "
        "depend on time or state.",
    )
