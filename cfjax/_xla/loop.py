"""Many equal steps in one loop, which XLA turns into one function; so it does its derivative."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Int, PyTree

from .components import has_few, join, split, trace
from .operation import operation
from .pack import pack, unpack

# Beyond, the derivative gains less than copying them costs.
_MAX_TRAVELLERS = 16
# With more components matrices stay whole, as in `by_components`. They count twice where their sums
# are compensated: so an attitude in SO(3) is the largest state taken apart in a derivative.
_MOST_FORWARD = 48
_MOST_BACKWARD = 18


def repeat(
    step: Callable[[PyTree], PyTree], carry: PyTree, num_steps: int | Int[Array, ""]
) -> PyTree:
    """Replaces `carry` by `step(carry)`, `num_steps` times.

    `step` may close over traced values. Reverse mode keeps one carry a step, and computes the step
    again. It needs a Python int; an array makes one program for every number of steps.

    On CPU a loop of small steps is fast if XLA has few operations left after fusion, and it fuses
    towards each result all that leads to it. So there is one result: the components of all small
    arrays of the carry travel as one vector. In a derivative the components of the parameters,
    that is, what `step` closes over, travel with them unchanged: in the reversed loop they are the
    sums of the derivatives, which else would be results of their own.
    """
    program, parameters, is_straight, is_plain = trace(step, carry)
    leaves, structure = jtu.tree_flatten(carry)

    def step_of_leaves(leaves: list[Any], values: list[Any], matrices: bool) -> list[Any]:
        carry = jtu.tree_unflatten(structure, leaves)
        return structure.flatten_up_to(program(carry, values, matrices, matrices))

    leaves = list(map(jnp.asarray, leaves))
    most = (_MOST_FORWARD, _MOST_BACKWARD) if is_straight else (0, 0)
    leaves = _repeat(
        leaves,
        parameters,
        program=step_of_leaves,
        num_steps=num_steps,
        most=most,
        is_plain=is_plain,
    )
    return jtu.tree_unflatten(structure, leaves)


@eqx.filter_custom_jvp
def _repeat(
    leaves: list[Array],
    values: list[Array],
    *,
    program: Callable,
    num_steps: int | Int[Array, ""],
    most: tuple[int, int],
    is_plain: bool,
) -> list[Array]:
    matrices = has_few(leaves, most[0])
    return _scan(program, num_steps, leaves, values, matrices, [False] * len(values), is_plain)


@_repeat.def_jvp
def _(primals, tangents, *, program, num_steps, most, is_plain):
    leaves, values = primals
    matrices = has_few(leaves, most[1])
    moves = [tangent is not None for tangent in tangents[1]]
    pieces = [len(jtu.tree_leaves(split(value, matrices))) for value in values]
    if sum(n for n, is_one in zip(pieces, moves, strict=True) if is_one) > _MAX_TRAVELLERS:
        moves = [False] * len(moves)
    return eqx.filter_jvp(
        lambda leaves, values: _scan(program, num_steps, leaves, values, matrices, moves, is_plain),
        primals,
        tangents,
    )


def _scan(
    program: Callable[[list[Any], list[Any], bool], list[Any]],
    num_steps: int | Int[Array, ""],
    leaves: list[Array],
    values: list[Array],
    matrices: bool,
    moves: Sequence[bool],
    is_plain: bool,
) -> list[Array]:
    """The loop, where values travel that are in components, if they move."""
    leaves, structure = jtu.tree_flatten(split(leaves, matrices))
    packed = _packed(leaves)
    numbers, rest = _part(leaves, packed)
    travels = [
        is_one and bool(numbers) and _is_number(piece, numbers[0].dtype)
        for value, is_one in zip(values, moves, strict=True)
        for piece in jtu.tree_leaves(split(value, matrices))
    ]
    values, value_structure = jtu.tree_flatten(split(values, matrices))
    known, others = _part(values, travels)

    def step(entries: list[Array], rest: list[Array], known: Any, others: Any) -> Any:
        numbers, travellers = entries[: sum(packed)], entries[sum(packed) :]
        values = _join(
            [_borrow(*pair) for pair in zip(known, travellers, strict=True)], others, travels
        )
        leaves = jtu.tree_leaves(
            program(
                jtu.tree_unflatten(structure, _join(numbers, rest, packed)),
                jtu.tree_unflatten(value_structure, values),
                matrices,
            )
        )
        numbers, rest = _part(leaves, packed)
        return pack([*numbers, *travellers]) if numbers else None, rest

    def body(carry: tuple[Array | None, list[Array]], _: None) -> tuple[Any, None]:
        vector, rest = carry
        entries = [] if vector is None else unpack(vector)
        if is_plain and not any(map(jnp.ndim, leaves)):
            return operation(step, entries, rest, known, others), None
        return jax.checkpoint(step)(entries, rest, known, others), None

    vector = pack([*numbers, *known]) if numbers else None
    if isinstance(num_steps, int):
        (vector, rest), _ = lax.scan(body, (vector, rest), length=num_steps)
    else:
        vector, rest = lax.fori_loop(
            0, num_steps, lambda _, carry: body(carry, None)[0], (vector, rest)
        )
    numbers = [] if vector is None else unpack(vector)[: sum(packed)]
    return join(jtu.tree_unflatten(structure, _join(numbers, rest, packed)))


def _packed(leaves: list[Array]) -> list[bool]:
    """Which leaves of the carry travel in the vector: numbers of one dtype."""
    numbers = [x for x in leaves if _is_number(x, x.dtype)]
    return [bool(numbers) and _is_number(x, numbers[0].dtype) for x in leaves]


def _is_number(x: Array, dtype: Any) -> bool:
    return x.ndim == 0 and x.dtype == dtype and jnp.issubdtype(dtype, jnp.inexact)


def _part(leaves: Sequence[Any], where: Sequence[bool]) -> tuple[list[Any], list[Any]]:
    pairs = list(zip(leaves, where, strict=True))
    return [x for x, is_one in pairs if is_one], [x for x, is_one in pairs if not is_one]


def _join(ones: Sequence[Any], others: Sequence[Any], where: Sequence[bool]) -> list[Any]:
    sources = iter(ones), iter(others)
    return [next(sources[0 if is_one else 1]) for is_one in where]


@jax.custom_jvp
def _borrow(value: Array, derivative: Array) -> Array:
    """The value of the one with the derivative of the other."""
    return value


@_borrow.defjvp
def _(primals, tangents):
    return primals[0], tangents[1]
