"""A function on single numbers: where it is scalarised, and where it is left as it is."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import Tracer
from jaxtyping import PyTree

from .materialise import materialised
from .operation import operation
from .program import join, read, split, traced
from .scope import is_rewritten
from .step import step
from .struct_of_arrays import StructOfArrays


def scalarised(
    fun: Callable[[PyTree], PyTree], y: PyTree, is_pair: bool = False, in_batches: bool = False
) -> PyTree:
    """`fun(y)`, computed on single numbers where `y` is a small state of short vectors.

    The result agrees with that of `fun` to rounding. `fun` may close over traced values. Operations
    that have no rule get the array whole. Where `y` is another state or the program cannot be
    scalarised, and within another one that is scalarised, this is `fun(y)`. With `is_pair` the
    function returns a pair, of which mostly the first part alone is used. With `in_batches` values
    of one system and derivatives are left as they are.
    """
    reading = None if is_rewritten() else read(fun, y)
    if reading is None:
        return fun(y)
    if not reading.rows:
        return step(reading, y, is_pair, in_batches)
    program = traced(fun, y, reading)
    if program is None:
        return fun(y)
    y, parameters = split((y, program.parameters), program.rows)
    # What is around may use single entries, so that XLA computes anew what these share.
    out = operation(
        program.run,
        *_materialised((y, parameters)),
        is_batch=program.rows,
        plain=program.plain,
    )
    # One by one: what is not used is not computed.
    is_apart = lambda x: isinstance(x, StructOfArrays)  # noqa: E731
    return jtu.tree_map(lambda x: join(_materialised(x)), out, is_leaf=is_apart)


def _materialised(tree: Any) -> Any:
    """The same, with all single numbers materialised where this is differentiated."""
    leaves, structure = jtu.tree_flatten(tree)
    places = [k for k, x in enumerate(leaves) if _is_number(x)]
    if places:
        new = materialised([leaves[k] for k in places], in_batches=True, now=False)
        for k, x in zip(places, new, strict=True):
            leaves[k] = x
    return jtu.tree_unflatten(structure, leaves)


def _is_number(x: Any) -> bool:
    return isinstance(x, Tracer) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.inexact)
