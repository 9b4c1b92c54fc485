"""A function on single numbers: where it is scalarised, and where it is left as it is."""

from collections.abc import Callable

import jax.tree_util as jtu
from jaxtyping import PyTree

from .materialise import numbers_materialised
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
    y, parameters = split((y, program.parameters), rows=True)
    # What is around may use single entries, so that XLA computes anew what these share.
    given = numbers_materialised((y, parameters), now=False)
    out = operation(program.run, *given, plain=program.plain)
    # One by one: what is not used is not computed.
    is_apart = lambda x: isinstance(x, StructOfArrays)  # noqa: E731
    return jtu.tree_map(lambda x: join(numbers_materialised(x, now=False)), out, is_leaf=is_apart)
