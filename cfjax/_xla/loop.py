"""Many equal steps in one loop, each of which is one operation."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, Int, PyTree

from .jaxprs import is_inexact, program_of, structs_of
from .limits import MANY, MAX_ENTRIES, MAX_SIZE
from .pack import pack, unpack
from .program import read
from .scope import is_rows
from .step import one_of


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
    form, n = _Form.of(leaves), len(parameters)

    def of_parts(*operands: Array) -> list[Array]:
        return form.packed(jaxpr_as_fun(program)(*operands[:n], *form.unpacked(operands[n:])))

    start = form.packed(leaves)
    code = program_of(of_parts, *parameters, *start)
    is_many = not isinstance(num_steps, int) or num_steps > MANY

    def once(parts: Sequence[Array]) -> list[Array]:
        return one_of(code, parameters, parts, reading.rows, is_many)

    def whole(parts: Sequence[Array]) -> PyTree:
        return jtu.tree_unflatten(structure, form.unpacked(parts))

    keeps = None if keep is None else lambda parts: parts
    end, kept = _loop(once, start, num_steps, keeps)
    return whole(end), None if keep is None else keep(jax.vmap(whole)(kept))


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


class _Form(NamedTuple):
    """What is carried in the place of some arrays.

    Those at some places are one vector, which comes first. Short vectors along leading axes are
    apart, one array for each of their entries.
    """

    arrays: Sequence[jax.ShapeDtypeStruct]
    places: Sequence[int]

    @classmethod
    def of(cls, arrays: Sequence[Array]) -> "_Form":
        dtype = next((x.dtype for x in arrays if is_inexact(x)), None)
        places = [k for k, x in enumerate(arrays) if x.dtype == dtype and x.size <= MAX_SIZE]
        return cls(structs_of(arrays), places)

    def packed(self, arrays: Sequence[Array]) -> list[Array]:
        vector, rest = [jnp.ravel(arrays[k]) for k in self.places], []
        for k, x in enumerate(arrays):
            if k not in self.places:
                rest += unpack(x, axis=x.ndim - 1) if is_rows(x) else [x]
        return [jnp.concatenate(vector), *rest] if vector else rest

    def unpacked(self, parts: Sequence[Array]) -> list[Array]:
        rest = iter(parts)
        ends = np.cumsum([self.arrays[k].size for k in self.places])[:-1]
        vector = iter(jnp.split(next(rest), ends) if self.places else ())

        def whole(k: int, x: jax.ShapeDtypeStruct) -> Array:
            if k in self.places:
                return next(vector).reshape(x.shape)
            if is_rows(x):
                return pack([next(rest) for _ in range(x.shape[-1])], axis=x.ndim - 1)
            return next(rest)

        return list(itertools.starmap(whole, enumerate(self.arrays)))
