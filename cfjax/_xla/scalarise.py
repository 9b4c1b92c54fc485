"""A function on single numbers: where it is scalarised, and where it is left as it is."""

from collections.abc import Callable

from jaxtyping import PyTree

from .program import read
from .scope import is_rewritten
from .step import step


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
    return step(reading, y, is_pair, in_batches)
