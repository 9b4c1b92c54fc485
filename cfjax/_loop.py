"""Many equal steps in one loop, which XLA turns into one function; so it does its derivative."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree

from ._components import by_components, join, split
from ._functions.pack import pack, unpack

# Beyond, the derivative gains less than copying them costs.
_MAX_PARAMETERS = 16


class Loop:
    """Repeats `carry = step(carry, parameters)`.

    Reverse mode keeps one carry a step, and computes the step again.

    On CPU a loop of small steps is fast if XLA has few operations left after fusion, and it fuses
    towards each result all that leads to it. So there is one result: the components of all short
    vectors of the carry travel as one vector. Those of the parameters travel with them unchanged
    for the sake of the reversed loop, in which they are the sums of the derivatives.
    """

    def __init__(self, step: Callable[[PyTree, PyTree], PyTree], carry: PyTree, parameters: PyTree):
        self._step = jax.checkpoint(lambda *args: by_components(step, *args))
        leaves, self._carry_tree = jtu.tree_flatten(split(carry))
        numbers = [x for x in leaves if _is_real_number(x)]
        self._dtype = numbers[0].dtype if numbers else None
        self._is_packed = list(map(self._is_packable, leaves))
        self._parameters, self._parameter_tree = jtu.tree_flatten(split(parameters))
        self._is_packed_parameter = list(map(self._is_packable, self._parameters))
        if sum(self._is_packed_parameter) > _MAX_PARAMETERS:
            self._is_packed_parameter = [False] * len(self._parameters)

    def enter(self, carry: PyTree) -> tuple[Array | None, list[Any]]:
        """The carry in the form in which it travels."""
        numbers, rest = _part(jtu.tree_leaves(split(carry)), self._is_packed)
        travelling, _ = _part(self._parameters, self._is_packed_parameter)
        return (pack([*numbers, *travelling]) if numbers else None), rest

    def leave(self, packed: tuple[Array | None, list[Any]]) -> PyTree:
        """The reverse of `enter`."""
        vector, rest = packed
        numbers = [] if vector is None else unpack(vector)
        leaves = _join(numbers, rest, self._is_packed)
        return join(jtu.tree_unflatten(self._carry_tree, leaves))

    def __call__(self, packed: tuple[Array | None, list[Any]], num_steps: int) -> Any:
        """The carry after some steps, both in the form in which it travels."""
        values, others = _part(self._parameters, self._is_packed_parameter)
        count = sum(self._is_packed)

        def body(packed, _):
            vector, rest = packed
            numbers = [] if vector is None else unpack(vector)
            travelling = numbers[count:]
            borrowed = [_borrow(*pair) for pair in zip(values, travelling, strict=True)]
            parameters = _join(borrowed, others, self._is_packed_parameter)
            carry = self._step(
                jtu.tree_unflatten(self._carry_tree, _join(numbers[:count], rest, self._is_packed)),
                jtu.tree_unflatten(self._parameter_tree, parameters),
            )
            numbers, rest = _part(jtu.tree_leaves(carry), self._is_packed)
            return ((pack([*numbers, *travelling]) if numbers else None), rest), None

        return lax.scan(body, packed, length=num_steps)[0]

    def _is_packable(self, x: Any) -> bool:
        return self._dtype is not None and _is_real_number(x) and x.dtype == self._dtype


def _is_real_number(x: Any) -> bool:
    return jnp.ndim(x) == 0 and jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _part(leaves: list[Any], where: list[bool]) -> tuple[list[Any], list[Any]]:
    pairs = list(zip(leaves, where, strict=True))
    return [x for x, is_one in pairs if is_one], [x for x, is_one in pairs if not is_one]


def _join(ones: list[Any], others: list[Any], where: list[bool]) -> list[Any]:
    sources = iter(ones), iter(others)
    return [next(sources[0 if is_one else 1]) for is_one in where]


@jax.custom_jvp
def _borrow(value: Array, derivative: Array) -> Array:
    """The value of the one with the derivative of the other."""
    return value


@_borrow.defjvp
def _(primals, tangents):
    return primals[0], tangents[1]
