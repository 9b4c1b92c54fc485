"""Fields stacked along a new axis, so that a loop over stages has their flow once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._arrays import describe
from .._field import AbstractFrozenField, has_default_combine, is_field
from .._fields.elementwise import Elementwise
from .._numerics.matmul import matmul
from .._numerics.vectors import pack
from .compiled import limits, over_stages, scalarised, where_scalarised

# The numbers of a large point. If a loop over stages is differentiated, it keeps the points of all
# stages for each of its turns, which is too much memory for larger ones; and unrolled, XLA keeps
# several fields to add them up at once, which is too much for those of twice as many. (scenes)
LARGE = 2048
# The numbers of a large array of a field. In a loop over stages, combinations of larger ones are
# matrix products: with 1000 numbers a step takes a twentieth to a quarter less, with 64 as long.
# (scenes)
_LARGE_TERM = 512
# More stages of a method are many. It is mostly not scalarised as a whole, and unrolled its time to
# compile grows as the square of their number. (compile)
MANY = 9


def can_roll(unroll: bool | None, field: PyTree, point: PyTree) -> bool:
    """Whether flows of combinations of such fields may be one loop, and where `unroll` is None
    whether that pays.

    Fields must have the default `combine` and no chart of their own. Fields of far more numbers
    than the point has are faster unrolled.
    """
    fields = list(filter(is_field, jtu.tree_leaves(field, is_leaf=is_field)))
    is_possible = bool(fields) and all(map(_has_defaults, fields))
    if unroll is not None:
        return is_possible and not unroll
    return is_possible and size_of(field) <= max(limits.MAX_SIZE, 4 * size_of(point))


def size_of(tree: PyTree) -> int:
    return sum(jnp.size(x) for x in jtu.tree_leaves(tree))


def _has_defaults(field: AbstractFrozenField) -> bool:
    """Whether a field has the default `combine` and no chart of its own."""
    cls: Any = type(field.field if isinstance(field, Elementwise) else field)
    default = AbstractFrozenField
    has_chart = cls.to_chart is not default.to_chart or cls.from_chart is not default.from_chart
    return has_default_combine(cls) and not has_chart


def rolled_flows(
    rows: Real[np.ndarray, "flows *powers stages"],
    fields: Sequence[PyTree],
    point: PyTree,
    flow: Callable[[PyTree, PyTree], PyTree],
    weights: Callable[[Array], Real[Array, " stages"]] = lambda row: row,
) -> PyTree:
    """The point to which flows of combinations of the fields lead, that of the first row first.

    Each combination has the `weights` of its row, for as many fields as the row has columns. A
    weight is zero where the whole column of the row is.
    """
    fields = fields[: rows.shape[-1]]

    def end_point(point: PyTree) -> PyTree:
        # Not `jnp.stack`, as XLA would compute each of its operands separately.
        stacked = Stacked(jtu.tree_map(lambda *leaves: pack(leaves), *fields))

        def body(point: PyTree, x: Any) -> Any:
            row, is_used = x
            return flow(stacked.combination(Weights(weights(row), is_used)), point), None

        return over_stages(body, point, (rows, rows.any(axis=tuple(range(1, rows.ndim - 1)))))[0]

    # A weak type would be lost on the way.
    start = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x)), point)
    # For one system a loop of flows is as fast, and its derivatives compile faster.
    return scalarised(end_point, start, only_values=True)


class Weights(NamedTuple):
    """The weights of a combination, and which of them are not zero.

    If the loop over stages is unrolled, the terms of weight zero drop out.
    """

    weights: Any
    nonzero: Any

    @classmethod
    def of(cls, rows: Sequence[Sequence[Any]], n: int) -> "Weights":
        """Rows of n weights, of which the last may be missing."""
        padded = np.array([[*map(float, row), *[0.0] * (n - len(row))] for row in rows])
        return cls(padded, padded != 0)


class Stacked(eqx.Module):
    """Fields with the default `combine`, stacked along a new first axis of their arrays.

    Fields that are not evaluated yet are zero.
    """

    stacked: PyTree

    @classmethod
    def of(cls, fields: Sequence[PyTree], n: int) -> "Stacked":
        stacked = cls(stack_with_zeros(fields[0], n))
        for k, field in enumerate(fields[1:], 1):
            stacked = stacked.put(k, field)
        return stacked

    @property
    def size(self) -> int:
        return len(jtu.tree_leaves(self.stacked)[0])

    def combination(self, row: Weights) -> PyTree:
        """The combination of the first fields, as many as the row has entries."""
        return jtu.tree_map(lambda f: combination_of(row, f), self.stacked)

    def field(self, combination: PyTree) -> PyTree:
        return combination

    def at(self, k: Any) -> PyTree:
        return entry(self.stacked, k)

    def put(self, k: Any, field: PyTree) -> "Stacked":
        """With `field` as field k."""
        return Stacked(with_entry(self.stacked, k, self.stored(field)))

    def point(self, z: PyTree) -> PyTree:
        return z

    def coordinates(self, point: PyTree) -> PyTree:
        """The coordinates of a point of the step, in arrays that do not grow."""
        return point

    def placeholder(self, k: Any) -> PyTree:
        """In place of `stored(field)` where no field is evaluated."""
        # Varies along the axes of a mesh as the fields do.
        return jtu.tree_map(lambda f: jnp.zeros_like(f[0]), self.stacked)

    def stored(self, field: PyTree) -> PyTree:
        """The arrays to store of a field that was evaluated."""
        return cast_like(self.placeholder(0), field)

    def enlarged(self, new: PyTree, z: PyTree, k: Any) -> tuple["Stacked", PyTree]:
        """With room for field k, of which `new` is stored, frozen at the point z; and the field."""
        return self, new


def same_types(a: PyTree, b: PyTree) -> bool:
    return jtu.tree_structure(a) == jtu.tree_structure(b) and _types(a) == _types(b)


def cast_like(template: PyTree, value: PyTree) -> PyTree:
    # Only some times of the field were traced before.
    if not same_types(template, value):
        raise TypeError(
            "The field must return frozen fields of one structure, shape and dtype at all stages "
            f"of a step, got {describe(template)} and {describe(value)}. With unroll=True the "
            "solver accepts other fields too."
        )
    # Only a weak type may differ.
    return jtu.tree_map(lambda v, f: jnp.asarray(v, f.dtype), value, template)


def stack_with_zeros(tree: PyTree, n: int) -> PyTree:
    """The leaves as the first of n entries along a new axis, of which the others are zero."""
    # Padding keeps the sharding over a mesh.
    padding = lambda x: [(0, n - 1, 0), *[(0, 0, 0)] * jnp.ndim(x)]  # noqa: E731
    return jtu.tree_map(lambda x: lax.pad(x[None], jnp.zeros((), x.dtype), padding(x)), tree)


def combination_of(row: Weights, fields: Array) -> Array:
    fields = fields[: len(row.weights)]
    if jnp.size(fields[0]) <= _LARGE_TERM:
        return _sum(row, fields)
    return where_scalarised(lambda: _sum(row, fields), lambda: _product(row.weights, fields))


def _sum(row: Weights, fields: Array) -> Array:
    shape = len(fields), *[1] * (fields.ndim - 1)
    terms = row.weights.astype(fields.dtype).reshape(shape) * fields
    # If the loop is unrolled, terms of weight zero drop out.
    used = lambda: jnp.where(row.nonzero.reshape(shape), terms, jnp.zeros((), terms.dtype))  # noqa: E731
    return jnp.sum(where_scalarised(used, lambda: terms), axis=0)


def _product(weights: Array, fields: Array) -> Array:
    """The same, faster for large fields."""
    if jnp.iscomplexobj(fields):
        return lax.complex(_product(weights, fields.real), _product(weights, fields.imag))
    product = matmul(weights.astype(fields.dtype), fields.reshape(len(weights), -1))
    return product.reshape(fields.shape[1:])


def entry(tree: PyTree, k: Any) -> PyTree:
    return jtu.tree_map(lambda x: lax.dynamic_index_in_dim(x, k, keepdims=False), tree)


def with_entry(tree: PyTree, k: Any, values: PyTree) -> PyTree:
    return jtu.tree_map(lambda x, v: lax.dynamic_update_index_in_dim(x, v, k, 0), tree, values)


def _types(tree: PyTree) -> list[tuple[tuple[int, ...], Any]]:
    return [(jnp.shape(x), jnp.result_type(x)) for x in jtu.tree_leaves(tree)]
