"""Many equal steps in one loop, each of which is one operation."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, Int, PyTree

from .jaxprs import program_of, structs
from .limits import MAX_ENTRIES
from .pack import pack, unpack
from .program import read
from .scope import is_rows
from .step import bound


def repeat(
    step: Callable[[PyTree], PyTree],
    carry: PyTree,
    num_steps: int | Int[Array, ""],
    keep: Callable[[PyTree], PyTree] | None = None,
) -> tuple[PyTree, PyTree]:
    """Replaces `carry` by `step(carry)`, `num_steps` times; and `keep(carry)` after each step.

    `step` may close over traced values. Reverse mode keeps one carry a step, and computes the step
    again. It needs a Python int; an array makes one program for every number of steps, without
    `keep`. What `keep` returns are parts of the carry; each is stacked along a new first axis.

    Short vectors along leading axes travel as one array for each of their entries.
    """
    reading = read(step, carry, MAX_ENTRIES["loop"])
    if reading is None:
        return _loop(jax.checkpoint(step), carry, num_steps, keep)
    leaves, structure = jtu.tree_flatten(carry)
    leaves = list(map(jnp.asarray, leaves))
    program, parameters = reading.program, reading.parameters
    arrays, n = structs(leaves), len(parameters)

    def of_parts(*operands: Array) -> list[Array]:
        return _parted(jaxpr_as_fun(program)(*operands[:n], *_joined(operands[n:], arrays)))

    start = _parted(leaves)
    code = program_of(of_parts, *parameters, *start)
    reading = reading._replace(program=code)

    def once(parts: Sequence[Array]) -> list[Array]:
        return bound(reading, parts)

    def whole(parts: Sequence[Array]) -> PyTree:
        return jtu.tree_unflatten(structure, _joined(parts, arrays))

    keeps = None if keep is None else lambda parts: parts
    end, carries = _loop(once, start, num_steps, keeps)
    return whole(end), None if keep is None else keep(jax.vmap(whole)(carries))


def _loop(
    step: Callable[[PyTree], PyTree],
    carry: PyTree,
    num_steps: Any,
    keep: Callable[[PyTree], PyTree] | None,
) -> tuple[PyTree, PyTree]:
    def body(carry: PyTree, _: None) -> tuple[PyTree, PyTree]:
        carry = step(carry)
        return carry, None if keep is None else keep(carry)

    if isinstance(num_steps, int):
        return lax.scan(body, carry, length=num_steps)
    return lax.fori_loop(0, num_steps, lambda _, carry: step(carry), carry), None


def _parted(arrays: Sequence[Array]) -> list[Array]:
    parts = (unpack(x, axis=x.ndim - 1) if is_rows(x) else [x] for x in arrays)
    return list(itertools.chain.from_iterable(parts))


def _joined(parts: Sequence[Array], arrays: Sequence[Any]) -> list[Array]:
    """The arrays, like these, that have such parts."""
    tail = iter(parts)

    def joined(x: Any) -> Array:
        if not is_rows(x):
            return next(tail)
        return pack([next(tail) for _ in range(x.shape[-1])], axis=x.ndim - 1)

    return list(map(joined, arrays))
