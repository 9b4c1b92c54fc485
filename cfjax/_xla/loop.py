"""Many equal steps in one loop, each of which is one operation on one vector."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, Int, PyTree

from .jaxprs import is_inexact, program_of
from .limits import MANY, MAX_ENTRIES
from .operation import operation
from .program import Reading, join, read, split, split_like, traced
from .step import one_of, with_parameters


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
    which is kept as it is.
    """
    reading = read(step, carry, MAX_ENTRIES["loop"])
    if reading is None:
        steps = None
    elif reading.rows:
        steps = _of_rows(step, carry, reading)
    else:
        is_many = not isinstance(num_steps, int) or num_steps > MANY
        steps = _of_vector(carry, reading, is_many)
    if steps is None:
        return _loop(jax.checkpoint(step), carry, num_steps, keep)
    keeps = None if keep is None else lambda carried: carried
    end, kept = _loop(steps.step, steps.start, num_steps, keeps)
    return steps.whole(end), None if keep is None else keep(jax.vmap(steps.whole)(kept))


class _Steps(NamedTuple):
    """A step of what is carried, what that is at first, and the carry as it was."""

    step: Callable[[PyTree], PyTree]
    start: PyTree
    whole: Callable[[PyTree], PyTree]


def _of_vector(carry: PyTree, reading: Reading, is_many: bool) -> _Steps:
    leaves, structure = jtu.tree_flatten(carry)
    leaves = list(map(jnp.asarray, leaves))
    program, parameters = with_parameters(reading)
    form, n = _Form.of(leaves), len(parameters)

    def on_vector(*operands: Array) -> list[Array]:
        return form.packed(jaxpr_as_fun(program)(*operands[:n], *form.unpacked(operands[n:])))

    start = form.packed(leaves)
    code = program_of(on_vector, *parameters, *start)
    return _Steps(
        lambda arrays: one_of(code, parameters, arrays, is_many),
        start,
        lambda arrays: jtu.tree_unflatten(structure, form.unpacked(arrays)),
    )


def _of_rows(step: Callable[[PyTree], PyTree], carry: PyTree, reading: Reading) -> _Steps | None:
    """Of a state with leading axes, whose entries stay apart from step to step."""
    program = traced(step, carry, reading)
    if program is None:
        return None
    start, parameters = split((carry, program.parameters), rows=True)

    def like_start(run: Callable[[PyTree, PyTree], PyTree]) -> Callable[[PyTree, PyTree], PyTree]:
        return lambda y, parameters: split_like(start, run(y, parameters))

    run, plain = map(like_start, (program.run, program.plain))
    return _Steps(lambda y: operation(run, y, parameters, plain=plain), start, join)


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
    """Arrays, of which those at some places are packed into one vector, which comes first."""

    shapes: Sequence[tuple[int, ...]]
    places: Sequence[int]

    @classmethod
    def of(cls, arrays: Sequence[Array]) -> "_Form":
        dtype = next((x.dtype for x in arrays if is_inexact(x)), None)
        return cls([x.shape for x in arrays], [k for k, x in enumerate(arrays) if x.dtype == dtype])

    def packed(self, arrays: Sequence[Array]) -> list[Array]:
        rest = [x for k, x in enumerate(arrays) if k not in self.places]
        entries = [jnp.ravel(arrays[k]) for k in self.places]
        return [jnp.concatenate(entries), *rest] if entries else rest

    def unpacked(self, arrays: Sequence[Array]) -> list[Array]:
        if not self.places:
            return list(arrays)
        sizes = [math.prod(self.shapes[k]) for k in self.places]
        parts = iter(jnp.split(arrays[0], np.cumsum(sizes)[:-1]))
        rest = iter(arrays[1:])
        return [
            next(parts).reshape(shape) if k in self.places else next(rest)
            for k, shape in enumerate(self.shapes)
        ]
