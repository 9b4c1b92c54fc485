"""Compensated sums: a state that does not lose what its increments are too small to change.

Rounding the state after every flow makes lengths, orthogonality and the like drift as a random
walk. Where a field offers increments (`AbstractFrozenField.increment`), a step adds up these, and
the sum over the steps keeps what rounding has cut off: the compensation. (Hairer, Lubich & Wanner,
Geometric Numerical Integration, Section VIII.5.) It costs small vectors a tenth of the time.

A compensation is a pytree like the field of a step, with an array for each part of the state that
is such a sum, and None for every other part.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree

from .._field import is_field


def no_compensation(field: PyTree, y0: PyTree) -> PyTree:
    """That of the first step: zeros where `field` offers increments from a state as it is."""

    def part(f: Any, y: PyTree) -> Array | None:
        is_array = is_field(f) and jtu.all_leaves([y])
        # In a chart of the field's own the point is another.
        is_sum = is_array and f.increment(y) is not None and f.to_chart(y, ())[1] is y
        return jnp.zeros_like(y) if is_sum else None

    return jtu.tree_map(part, field, y0, is_leaf=is_field)


def zeros(compensation: PyTree, y0: PyTree) -> PyTree:
    """That of the first step, given by shape: like the state, which may be spread over a mesh."""
    return with_sums(lambda c, y: None if c is None else jnp.zeros_like(y), compensation, y0)


def with_sums(fun: Callable[..., Any], compensation: PyTree, *trees: PyTree) -> PyTree:
    """`fun(c, *leaves)` for each part of the state, where c is None unless the part is a sum."""
    return jtu.tree_map(fun, compensation, *trees, is_leaf=lambda x: x is None)


def at(y0: PyTree, end: PyTree, compensation: PyTree) -> PyTree:
    """The state at the end of a step, of whose sums `end` has the increments."""
    return with_sums(lambda c, y, z: z if c is None else y + z, compensation, y0, end)


def added(y0: PyTree, end: PyTree, compensation: PyTree) -> tuple[PyTree, PyTree]:
    """The same with the compensation, and the one of the next step (Dekker's FastTwoSum)."""

    def part(c: Array | None, a: PyTree, end: PyTree) -> tuple[PyTree, Array | None]:
        if c is None:
            return end, None
        b = end + lax.stop_gradient(c)
        total = a + b
        return total, lax.stop_gradient(b - (total - a))

    pairs = with_sums(part, compensation, y0, end)
    first, second = (with_sums(lambda _, pair: pair[k], compensation, pairs) for k in range(2))  # noqa: B023
    return first, second
