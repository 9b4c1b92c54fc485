"""Many equal steps in one loop, each of which is one operation."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, Int, PyTree

from .jaxprs import altered, is_inexact, program_of, reached, structs_of
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
    which is kept as it is, and those without a derivative as another. Those of short vectors along
    leading axes travel as one array for each of their entries.
    """
    reading = read(step, carry, MAX_ENTRIES["loop"])
    if reading is None:
        return _loop(jax.checkpoint(step), carry, num_steps, keep)
    leaves, structure = jtu.tree_flatten(carry)
    leaves = list(map(jnp.asarray, leaves))
    program, parameters = reading.program, reading.parameters
    form, n = _Form.of(leaves, _are_moving(program, leaves)), len(parameters)

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


def _are_moving(program: ClosedJaxpr, leaves: Sequence[Array]) -> list[bool]:
    """Which parts of the carry have a derivative: not those behind a `stop_gradient`."""
    jaxpr = program.jaxpr
    eqns = [eqn for eqn in jaxpr.eqns if eqn.primitive.name != "stop_gradient"]
    return reached(altered(jaxpr, eqns=eqns), list(map(is_inexact, program.in_avals)))


class _Form(NamedTuple):
    """What is carried in the place of some arrays.

    Those of each group are one vector, and these come first. Short vectors along leading axes are
    apart, one array for each of their entries.
    """

    arrays: Sequence[jax.ShapeDtypeStruct]
    groups: Sequence[Sequence[int]]

    @classmethod
    def of(cls, arrays: Sequence[Array], are_moving: Sequence[bool]) -> "_Form":
        """Reverse mode does not keep what has no derivative, as what sums have lost, if apart."""
        dtype = next((x.dtype for x in arrays if is_inexact(x)), None)
        places = [k for k, x in enumerate(arrays) if x.dtype == dtype and x.size <= MAX_SIZE]
        groups = [[k for k in places if are_moving[k] == moves] for moves in (True, False)]
        return cls(structs_of(arrays), [group for group in groups if group])

    def packed(self, arrays: Sequence[Array]) -> list[Array]:
        vectors = [jnp.concatenate([jnp.ravel(arrays[k]) for k in group]) for group in self.groups]
        rest = []
        for k in self._others():
            x = arrays[k]
            rest += unpack(x, axis=x.ndim - 1) if is_rows(x) else [x]
        return [*vectors, *rest]

    def unpacked(self, parts: Sequence[Array]) -> list[Array]:
        rest, found = iter(parts), {}
        for group in self.groups:
            ends = np.cumsum([self.arrays[k].size for k in group])[:-1]
            found.update(zip(group, jnp.split(next(rest), ends), strict=True))
        for k in self._others():
            x = self.arrays[k]
            if is_rows(x):
                found[k] = pack([next(rest) for _ in range(x.shape[-1])], axis=x.ndim - 1)
            else:
                found[k] = next(rest)
        return [found[k].reshape(x.shape) for k, x in enumerate(self.arrays)]

    def _others(self) -> list[int]:
        grouped = {k for group in self.groups for k in group}
        return [k for k in range(len(self.arrays)) if k not in grouped]
