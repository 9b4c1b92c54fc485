"""A table of short vectors, each made of a combination of those before, in one loop."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree, Real

from .operation import operation
from .pack import pack, unpack
from .program import join, split, trace
from .scope import in_equal_steps, is_on, is_short, where


def table(
    fun: Callable[[Real[Array, ""], PyTree], PyTree],
    known: Sequence[PyTree],
    rows: Real[Array, "new n"],
    xs: Real[Array, "new"],
) -> list[PyTree] | None:
    """After the known trees k, for each row and x the tree `fun(x, sum_j row[j] k[j])`.

    For what is too long to be scalarised as a whole: a turn of the loop is on single numbers, and
    a tree is one vector, so that XLA makes few functions of a turn. `fun` must return a tree of the
    structure, shapes and dtypes that it gets.

    None where the trees are not numbers and short vectors of one dtype, where all around is taken
    apart anyway, and where nothing is.
    """
    first, n = known[0], rows.shape[1]
    leaves = jtu.tree_leaves(first)
    is_small = all(jnp.ndim(x) == 0 or is_short(x) for x in leaves)
    if where() or not is_on() or not is_small or len({x.dtype for x in leaves}) != 1:
        return None
    numbers, structure = jtu.tree_flatten(split(first))

    def to_vector(tree: PyTree) -> Array:
        return pack(jtu.tree_leaves(split(tree)))

    def from_vector(vector: Array) -> PyTree:
        return join(jtu.tree_unflatten(structure, unpack(vector)))

    def entry(x: Array, vector: Array) -> Array:
        program = trace(lambda tree: fun(x, tree), from_vector(vector), "step")
        if program is None:
            return to_vector(fun(x, from_vector(vector)))

        def vector_of(run: Callable[[PyTree, PyTree], PyTree]) -> Callable[[Any, Any], Array]:
            return lambda numbers, parameters: to_vector(
                run(jtu.tree_unflatten(structure, numbers), parameters)
            )

        return operation(
            vector_of(program.run),
            unpack(vector),
            split(program.parameters),
            place="step",
            plain=vector_of(program.plain),
            order=1 if in_equal_steps() else 0,
        )

    def body(vectors: Array, turn: Any) -> Any:
        k, row, x = turn
        vector = jnp.sum(row[:, None].astype(vectors.dtype) * vectors, axis=0)
        return lax.dynamic_update_index_in_dim(vectors, entry(x, vector), k, 0), None

    start = jnp.zeros((n, len(numbers)), leaves[0].dtype)
    start = start.at[: len(known)].set(jnp.stack([to_vector(tree) for tree in known]))
    vectors, _ = lax.scan(body, start, (jnp.arange(len(known), n), rows, xs))
    return [*known, *(from_vector(vectors[k]) for k in range(len(known), n))]
