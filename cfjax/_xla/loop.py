"""Many equal steps in one loop, which XLA turns into one function; so it does its derivative."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Int, PyTree

from .operation import operation
from .pack import pack, unpack
from .program import join, split, trace

# Beyond, the derivative gains less than copying them costs.
_MAX_TRAVELLERS = 16


def repeat(
    step: Callable[[PyTree], PyTree], carry: PyTree, num_steps: int | Int[Array, ""]
) -> PyTree:
    """Replaces `carry` by `step(carry)`, `num_steps` times.

    `step` may close over traced values. Reverse mode keeps one carry a step, and computes the step
    again. It needs a Python int; an array makes one program for every number of steps.

    On CPU a loop of small steps is fast if XLA has few operations left after fusion, and it fuses
    towards each result all that leads to it. So where the step is taken apart there is one result:
    the numbers of the carry travel as one vector. In a derivative the numbers among the parameters,
    that is, what `step` closes over, travel with them unchanged: in the reversed loop they are the
    sums of the derivatives, which else would be results of their own.
    """
    program = trace(step, carry, "loop")
    if program is None:
        return _loop(jax.checkpoint(step), carry, num_steps)
    leaves, structure = jtu.tree_flatten(carry)
    leaves = list(map(jnp.asarray, leaves))

    def of_leaves(leaves: list[Any], parameters: list[Any]) -> list[Any]:
        carry = jtu.tree_unflatten(structure, leaves)
        return structure.flatten_up_to(program.run(carry, parameters))

    leaves = _repeat(
        leaves, program.parameters, run=of_leaves, num_steps=num_steps, rows=program.rows
    )
    return jtu.tree_unflatten(structure, leaves)


def _loop(step: Callable[[PyTree], PyTree], carry: PyTree, num_steps: Any) -> PyTree:
    if isinstance(num_steps, int):
        return lax.scan(lambda carry, _: (step(carry), None), carry, length=num_steps)[0]
    return lax.fori_loop(0, num_steps, lambda _, carry: step(carry), carry)


@eqx.filter_custom_jvp
def _repeat(
    leaves: list[Array],
    parameters: list[Array],
    *,
    run: Callable,
    num_steps: int | Array,
    rows: bool,
) -> list[Array]:
    moves = [True] * len(leaves), [False] * len(parameters)
    return _scan(run, num_steps, leaves, parameters, moves[0], moves[1], rows)


@_repeat.def_jvp
def _(primals, tangents, *, run, num_steps, rows):
    moves = [[tangent is not None for tangent in group] for group in tangents]
    sizes = [len(jtu.tree_leaves(split(x, rows))) for x in primals[1]]
    if sum(n for n, is_one in zip(sizes, moves[1], strict=True) if is_one) > _MAX_TRAVELLERS:
        moves[1] = [False] * len(sizes)
    return eqx.filter_jvp(
        lambda leaves, parameters: _scan(
            run, num_steps, leaves, parameters, moves[0], moves[1], rows
        ),
        primals,
        tangents,
    )


def _scan(
    run: Callable[[list[Any], list[Any]], list[Any]],
    num_steps: int | Int[Array, ""],
    leaves: list[Array],
    parameters: list[Array],
    leaves_move: Sequence[bool],
    parameters_move: Sequence[bool],
    rows: bool,
) -> list[Array]:
    """The loop, where those parameters travel that are in components, if they move.

    Numbers of the carry that do not move, such as what sums have lost, are a vector of their own:
    a derivative does not carry it.
    """
    moves = [
        is_one
        for x, is_one in zip(leaves, leaves_move, strict=True)
        for _ in jtu.tree_leaves(split(x, rows))
    ]
    leaves, structure = jtu.tree_flatten(split(leaves, rows))
    packed = _packed(leaves)
    moves, _ = _partition(moves, packed)
    numbers, rest = _partition(leaves, packed)
    travels = [
        is_one and bool(numbers) and _is_number(piece, numbers[0].dtype)
        for x, is_one in zip(parameters, parameters_move, strict=True)
        for piece in jtu.tree_leaves(split(x, rows))
    ]
    pieces, parameter_structure = jtu.tree_flatten(split(parameters, rows))
    known, others = _partition(pieces, travels)

    def vectors(numbers: list[Array], travellers: list[Array]) -> list[Array]:
        moving, still = _partition(numbers, moves)
        return [pack(group) for group in ([*moving, *travellers], still) if group]

    def entries(vectors: list[Array]) -> tuple[list[Array], list[Array]]:
        found = [entry for vector in vectors for entry in unpack(vector)]
        end = len(found) - moves.count(False)
        moving, travellers = found[: sum(moves)], found[sum(moves) : end]
        return _merge(moving, found[end:], moves), travellers

    def step(
        numbers: list[Array], travellers: list[Array], rest: list[Array], known: Any, others: Any
    ) -> Any:
        pieces = _merge(
            [_borrow(*pair) for pair in zip(known, travellers, strict=True)], others, travels
        )
        leaves = run(
            jtu.tree_unflatten(structure, _merge(numbers, rest, packed)),
            jtu.tree_unflatten(parameter_structure, pieces),
        )
        numbers, rest = _partition(jtu.tree_leaves(leaves), packed)
        return vectors(numbers, travellers), rest

    def body(carry: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
        return operation(
            step, *entries(carry[0]), carry[1], known, others, place="loop", is_batch=rows
        )

    carried, rest = _loop(body, (vectors(numbers, known), rest), num_steps)
    numbers, _ = entries(carried)
    return join(jtu.tree_unflatten(structure, _merge(numbers, rest, packed)))


def _packed(leaves: list[Array]) -> list[bool]:
    """Which leaves of the carry travel in the vector: numbers of one dtype."""
    numbers = [x for x in leaves if _is_number(x, x.dtype)]
    return [bool(numbers) and _is_number(x, numbers[0].dtype) for x in leaves]


def _is_number(x: Array, dtype: Any) -> bool:
    return x.ndim == 0 and x.dtype == dtype and jnp.issubdtype(dtype, jnp.inexact)


def _partition(leaves: Sequence[Any], where: Sequence[bool]) -> tuple[list[Any], list[Any]]:
    pairs = list(zip(leaves, where, strict=True))
    return [x for x, is_one in pairs if is_one], [x for x, is_one in pairs if not is_one]


def _merge(ones: Sequence[Any], others: Sequence[Any], where: Sequence[bool]) -> list[Any]:
    sources = iter(ones), iter(others)
    return [next(sources[0 if is_one else 1]) for is_one in where]


@jax.custom_jvp
def _borrow(value: Array, derivative: Array) -> Array:
    """The value of the one with the derivative of the other."""
    return value


@_borrow.defjvp
def _(primals, tangents):
    return primals[0], tangents[1]
