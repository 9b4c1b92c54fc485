"""Small arrays as NumPy's arrays of single numbers.

XLA computes what several entries of a small array need once for each of them, or materialises it.
As numbers they are fast: in a batch each is an array of all members.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array

from .jaxprs import is_inexact
from .pack import pack, unpack
from .scope import is_numeric, is_small_shape


@jtu.register_pytree_node_class
class Numbers:
    """An array of numbers as a pytree, whose leaves are the numbers.

    Numbers that are NumPy's are known while the program is made.
    """

    def __init__(self, array: np.ndarray):
        self.array = array

    def tree_flatten(self) -> tuple[list[Any], tuple[int, ...]]:
        return list(self.array.flat), self.array.shape

    @classmethod
    def tree_unflatten(cls, shape: tuple[int, ...], children: Sequence[Any]) -> "Numbers":
        return cls(array_of(children, shape))


def array_of(entries: Sequence[Any], shape: Sequence[int]) -> np.ndarray:
    array = np.empty(len(entries), object)
    for k, x in enumerate(entries):
        array[k] = x
    return array.reshape(shape)


def as_tree(x: Any) -> Any:
    return Numbers(x) if isinstance(x, np.ndarray) and x.dtype == object else x


def as_array(x: Any) -> Any:
    """The reverse of `as_tree`."""
    return x.array if isinstance(x, Numbers) else x


def split(arrays: Sequence[Any]) -> list[Any]:
    """The arrays, with the numbers of small ones in their place."""
    return [Numbers(numbers(x)) if is_small(x) else x for x in arrays]


def join(arrays: Sequence[Any]) -> list[Any]:
    """The reverse of `split`."""
    return [whole(as_array(x)) for x in arrays]


def numbers(x: Any) -> np.ndarray:
    """The numbers of an array that is not whole, or of a small one."""
    if isinstance(x, np.ndarray):
        return x if x.dtype == object else array_of(list(map(np.asarray, x.flat)), x.shape)
    return array_of(unpack(jnp.ravel(x)) if np.ndim(x) else [x], np.shape(x))


def whole(x: Any) -> Any:
    """The array that has these numbers."""
    if isinstance(x, np.ndarray) and x.dtype == object:
        return pack(list(map(of_jax, x.flat))).reshape(x.shape)
    return x


def of_jax(x: Any) -> Array:
    return x if isinstance(x, jax.Array) else jnp.asarray(x)


def is_whole(x: Any) -> bool:
    return not isinstance(x, np.ndarray) and np.ndim(x) > 0


def is_small(x: Any) -> bool:
    """Whether this is an array of which each entry is to be a number."""
    return is_whole(x) and np.size(x) > 0 and is_small_shape(np.shape(x)) and is_numeric(x)


def literal(v: Literal) -> Any:
    aval: Any = v.aval
    # Integers stay NumPy's, so that it is known which entries an index takes.
    return (jnp if is_inexact(aval) else np).asarray(v.val, aval.dtype)


def static_value(x: Any) -> np.ndarray | None:
    """What is known while the program is made."""
    if not isinstance(x, np.ndarray) or x.dtype != object:
        return np.asarray(x) if isinstance(x, np.ndarray | np.generic) else None
    # Without an entry the dtype is not known either.
    if x.size and all(isinstance(e, np.ndarray | np.generic) for e in x.flat):
        return np.stack(list(x.flat)).reshape(x.shape)
    return None


def of_places(fun: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray | None:
    """`fun` of arrays, of which it only moves the entries; None if it gives others too.

    It gets their places in its stead.
    """
    entries = [e for x in arrays for e in x.flat]
    firsts = np.cumsum([0, *(x.size for x in arrays)])
    outs = fun(*(places(x) + first for x, first in zip(arrays, firsts, strict=False)))
    if not (0 <= outs.min() and outs.max() < len(entries)):
        return None
    return array_of([entries[k] for k in outs.flat], outs.shape)


def places(x: np.ndarray) -> np.ndarray:
    return np.arange(x.size, dtype=np.int32).reshape(x.shape)
