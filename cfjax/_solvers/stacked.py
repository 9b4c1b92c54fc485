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
from .._field import AbstractFrozenField, is_field
from .._fields.elementwise import Elementwise
from .._numerics.matmul import matmul
from .._numerics.vectors import pack
from .compiled import limits, over_stages, scalarised, where_scalarised


def can_roll(unroll: bool | None, field: PyTree, point: PyTree) -> bool:
    """Whether flows of combinations of such fields may be one loop, and where `unroll` is None
    whether that pays.

    Fields must combine in the usual way and have no chart of their own. Fields of far more numbers
    than the point has are faster unrolled.
    """
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    is_possible = any(map(is_field, parts)) and _is_plain(field)
    if unroll is not None:
        return is_possible and not unroll
    return is_possible and size_of(field) <= max(limits.MAX_SIZE, 4 * size_of(point))


def size_of(tree: PyTree) -> int:
    return sum(jnp.size(x) for x in jtu.tree_leaves(tree))


def _is_plain(field: PyTree) -> bool:
    """Whether its parts combine in the usual way and have no chart of their own."""
    parts = jtu.tree_leaves(field, is_leaf=is_field)
    return all(_is_plain_part(part) for part in parts if is_field(part))


def _is_plain_part(field: AbstractFrozenField) -> bool:
    cls: Any = type(field.field if isinstance(field, Elementwise) else field)
    usual: Any = AbstractFrozenField
    return (
        cls.combine.__func__ is usual.combine.__func__
        and cls.to_chart is usual.to_chart
        and cls.from_chart is usual.from_chart
    )


def rolled_flows(
    rows: Real[np.ndarray, "flows *powers stages"],
    fields: Sequence[PyTree],
    point: PyTree,
    flow: Callable[[PyTree, PyTree], PyTree],
    weights: Callable[[Array], Real[Array, " stages"]] = lambda row: row,
) -> PyTree:
    """Where flows of combinations of the fields lead, that of the first row first.

    A combination has the `weights` of its row, which are of the first fields, and zero where all
    of the row is.
    """
    fields = fields[: rows.shape[-1]]

    def moved(point: PyTree) -> PyTree:
        # XLA computes what leads to each of the arrays that `jnp.stack` gets for itself.
        stacked = Stacked(jtu.tree_map(lambda *leaves: pack(leaves), *fields))

        def body(point: PyTree, turn: Any) -> Any:
            row, is_used = turn
            return flow(stacked.combination(Weights(weights(row), is_used)), point), None

        return over_stages(body, point, (rows, rows.any(axis=tuple(range(1, rows.ndim - 1)))))[0]

    # A weak type would be lost on the way.
    start = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x)), point)
    # For one system a loop of flows is as fast, and its derivatives compile faster.
    return scalarised(moved, start, in_batches=True)


class Weights(NamedTuple):
    """The weights of a combination, and which of them are not zero.

    Where the loop over stages is unrolled, the others are left out.
    """

    weights: Any
    are_used: Any

    @classmethod
    def of(cls, rows: Sequence[Sequence[Any]], n: int) -> "Weights":
        """Rows of n weights, of which the last may be missing."""
        padded = np.array([[*map(float, row), *[0.0] * (n - len(row))] for row in rows])
        return cls(padded, padded != 0)


class Stacked(eqx.Module):
    """Fields that combine in the usual way, stacked along a new first axis of their arrays.

    Those that are not there yet are zero.
    """

    stacked: PyTree

    @classmethod
    def of(cls, known: Sequence[PyTree], n: int) -> "Stacked":
        fields = cls(first_of(known[0], n))
        for k, field in enumerate(known[1:], 1):
            fields = fields.put(k, field)
        return fields

    def combination(self, row: Weights) -> PyTree:
        """That of the first fields, as many as the row has entries."""
        return jtu.tree_map(lambda f: combination_of(row, f), self.stacked)

    def field(self, combination: PyTree) -> PyTree:
        return combination

    def at(self, k: Any) -> PyTree:
        return entry(self.stacked, k)

    def put(self, k: Any, field: PyTree) -> "Stacked":
        """With field k."""
        return Stacked(with_entry(self.stacked, k, self.entered(field)))

    def point(self, z: PyTree) -> PyTree:
        return z

    def coordinates(self, point: PyTree) -> PyTree:
        """Of a point of the step, in arrays that do not grow."""
        return point

    def kept(self, k: Any) -> PyTree:
        """What `entered` returns, where no field is evaluated."""
        # Varying along the axes of a mesh as they do.
        return jtu.tree_map(lambda f: jnp.zeros_like(f[0]), self.stacked)

    def entered(self, field: PyTree) -> PyTree:
        """What to keep of a field that was evaluated."""
        return like(self.kept(0), field)

    def enlarged(self, new: PyTree, z: PyTree, k: Any) -> tuple["Stacked", PyTree]:
        """With room for field k, of which `new` is kept, frozen at the point z; and the field."""
        return self, new


def is_like(a: PyTree, b: PyTree) -> bool:
    return jtu.tree_structure(a) == jtu.tree_structure(b) and _types(a) == _types(b)


def like(first: PyTree, value: PyTree) -> PyTree:
    # What was seen of the field before may not hold for every time.
    if not is_like(first, value):
        raise TypeError(
            "The field must return frozen fields of one structure, shape and dtype at all stages "
            f"of a step, got {describe(first)} and {describe(value)}. With unroll=True the solver "
            "accepts other fields too."
        )
    # Only a weak type may be left over.
    return jtu.tree_map(lambda v, f: jnp.asarray(v, f.dtype), value, first)


def first_of(tree: PyTree, n: int) -> PyTree:
    """The first of n."""
    # Spread over a mesh as it is.
    pad = lambda x: [(0, n - 1, 0), *[(0, 0, 0)] * jnp.ndim(x)]  # noqa: E731
    return jtu.tree_map(lambda x: lax.pad(x[None], jnp.zeros((), x.dtype), pad(x)), tree)


def combination_of(row: Weights, fields: Array) -> Array:
    fields = fields[: len(row.weights)]
    if jnp.size(fields[0]) <= limits.LARGE:
        return _sum(row, fields)
    return where_scalarised(lambda: _sum(row, fields), lambda: _product(row.weights, fields))


def _sum(row: Weights, fields: Array) -> Array:
    each = len(fields), *[1] * (fields.ndim - 1)
    terms = row.weights.astype(fields.dtype).reshape(each) * fields
    # Where the loop is unrolled, those that are zero are not there.
    terms = jnp.where(row.are_used.reshape(each), terms, jnp.zeros((), terms.dtype))
    return jnp.sum(terms, axis=0)


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
