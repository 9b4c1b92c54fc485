"""Many equal steps in one loop, each of which is one operation."""

from collections.abc import Callable
from typing import Any

import jax
from jax import lax
from jaxtyping import Array, Int, PyTree

from .limits import MAX_ENTRIES
from .program import read
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
    `keep`.
    """
    reading = read(step, carry, MAX_ENTRIES["loop"])

    def once(carry: PyTree) -> PyTree:
        return jax.checkpoint(step)(carry) if reading is None else bound(reading, carry)

    def body(carry: PyTree, _: None) -> tuple[PyTree, Any]:
        carry = once(carry)
        return carry, None if keep is None else keep(carry)

    if isinstance(num_steps, int):
        return lax.scan(body, carry, length=num_steps)
    return lax.fori_loop(0, num_steps, lambda _, carry: once(carry), carry), None
