"""Many equal steps in one loop, each of which is one operation."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, Int, PyTree

from .jaxprs import is_inexact, program_of, structs
from .limits import MANY, MAX_ENTRIES, MAX_SIZE
from .pack import pack, unpack
from .program import read
from .scope import is_rows
from .step import OF_FEW, OF_MANY, bound


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

    On CPU a loop of small steps is fast if XLA has few operations left after fusion, and it fuses
    towards each result all that leads to it. So the numbers of the carry travel as one vector,
    which is kept as it is. Those of short vectors along leading axes travel as one array for each
    of their entries.
    """
    reading = read(step, carry, MAX_ENTRIES["loop"])
    if reading is None:
        return _loop(jax.checkpoint(step), carry, num_steps, keep)
    leaves, structure = jtu.tree_flatten(carry)
    leaves = list(map(jnp.asarray, leaves))
    program, parameters = reading.program, reading.parameters
    packing, n = _Packing.of(leaves), len(parameters)

    def of_parts(*operands: Array) -> list[Array]:
        return packing.packed(jaxpr_as_fun(program)(*operands[:n], *packing.unpacked(operands[n:])))

    start = packing.packed(leaves)
    code = program_of(of_parts, *parameters, *start)
    is_many = not isinstance(num_steps, int) or num_steps > MANY
    max_lengths = OF_MANY if is_many else OF_FEW

    def once(parts: Sequence[Array]) -> list[Array]:
        return bound(code, parameters, parts, len(parts), reading.rows, max_lengths)

    def whole(parts: Sequence[Array]) -> PyTree:
        return jtu.tree_unflatten(structure, packing.unpacked(parts))

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


class _Packing(NamedTuple):
    """What is carried in the place of some arrays.

    The small ones are one vector, which comes first. Of the others short vectors along leading axes
    are apart, one array for each of their entries.
    """

    arrays: Sequence[jax.ShapeDtypeStruct]
    small: Sequence[int]
    others: Sequence[int]

    @classmethod
    def of(cls, arrays: Sequence[Array]) -> "_Packing":
        dtype = next((x.dtype for x in arrays if is_inexact(x)), None)
        small = [k for k, x in enumerate(arrays) if x.dtype == dtype and x.size <= MAX_SIZE]
        others = [k for k in range(len(arrays)) if k not in small]
        return cls(structs(arrays), small, others)

    def packed(self, arrays: Sequence[Array]) -> list[Array]:
        small = [jnp.ravel(arrays[k]) for k in self.small]
        parts = [jnp.concatenate(small)] if small else []
        for k in self.others:
            x = arrays[k]
            parts += unpack(x, axis=x.ndim - 1) if is_rows(x) else [x]
        return parts

    def unpacked(self, parts: Sequence[Array]) -> list[Array]:
        tail, arrays = iter(parts), {}
        if self.small:
            ends = np.cumsum([self.arrays[k].size for k in self.small])[:-1]
            arrays.update(zip(self.small, jnp.split(next(tail), ends), strict=True))
        for k in self.others:
            x = self.arrays[k]
            if is_rows(x):
                arrays[k] = pack([next(tail) for _ in range(x.shape[-1])], axis=x.ndim - 1)
            else:
                arrays[k] = next(tail)
        return [arrays[k].reshape(x.shape) for k, x in enumerate(self.arrays)]
