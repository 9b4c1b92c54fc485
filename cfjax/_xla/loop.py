"""Many equal steps in one loop, which XLA turns into one function; so it does its derivative."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Int, PyTree

from .limits import MAX_ENTRIES
from .operation import operation
from .pack import pack, unpack
from .program import join, split, split_like, trace


def repeat(
    step: Callable[[PyTree], PyTree],
    carry: PyTree,
    num_steps: int | Int[Array, ""],
    keep: Callable[[PyTree], PyTree] | None = None,
    order: int = 1,
) -> tuple[PyTree, PyTree]:
    """Replaces `carry` by `step(carry)`, `num_steps` times; and `keep(carry)` after each step.

    `step` may close over traced values. Reverse mode keeps one carry a step, and computes the step
    again. It needs a Python int; an array makes one program for every number of steps, without
    `keep`. What `keep` returns are parts of the carry; each is stacked along a new first axis. Of
    derivatives those up to `order` are scalarised, as the step is; they take long to compile.

    On CPU a loop of small steps is fast if XLA has few operations left after fusion, and it fuses
    towards each result all that leads to it. So where the step is scalarised there is one result:
    the numbers of the carry travel as one vector, which is kept as it is. In a derivative the
    numbers among the parameters, that is, what `step` closes over, travel with them unchanged: in
    the reversed loop they are the sums of the derivatives, which otherwise would be results of
    their own.
    """
    program = trace(step, carry, "loop")
    if program is None:
        return _loop(jax.checkpoint(step), carry, num_steps, keep)
    leaves, structure = jtu.tree_flatten(carry)
    leaves = list(map(jnp.asarray, leaves))

    def of_leaves(run: Callable[[PyTree, PyTree], PyTree]) -> Callable[..., list[Any]]:
        return lambda leaves, parameters: structure.flatten_up_to(
            run(jtu.tree_unflatten(structure, leaves), parameters)
        )

    leaves, kept = _repeat(
        leaves,
        program.parameters,
        step=_Step(of_leaves(program.run), of_leaves(program.plain), program.rows, order),
        num_steps=num_steps,
        is_kept=keep is not None,
    )
    if keep is not None:
        kept = keep(jtu.tree_unflatten(structure, kept))
    return jtu.tree_unflatten(structure, leaves), kept


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


class _Step(NamedTuple):
    """A step of leaves and parameters that are split, and the same before it was scalarised; and
    up to which derivative it is.
    """

    run: Callable[[list[Any], list[Any]], list[Any]]
    plain: Callable[[list[Any], list[Any]], list[Any]]
    rows: bool
    order: int


@eqx.filter_custom_jvp
def _repeat(
    leaves: list[Array],
    parameters: list[Array],
    *,
    step: _Step,
    num_steps: int | Array,
    is_kept: bool,
) -> tuple[list[Array], list[Array] | None]:
    moves = [True] * len(leaves), [False] * len(parameters)
    return _scan(step, num_steps, leaves, parameters, moves[0], moves[1], is_kept)


@_repeat.def_jvp
def _(primals, tangents, *, step, num_steps, is_kept):
    moves = [[tangent is not None for tangent in group] for group in tangents]
    sizes = [len(jtu.tree_leaves(split(x, step.rows))) for x in primals[1]]
    # Of more the derivative gains less than copying them costs.
    if sum(n for n, is_one in zip(sizes, moves[1], strict=True) if is_one) > MAX_ENTRIES["step"]:
        moves[1] = [False] * len(sizes)
    return eqx.filter_jvp(
        lambda leaves, parameters: _scan(
            step, num_steps, leaves, parameters, moves[0], moves[1], is_kept
        ),
        primals,
        tangents,
    )


def _scan(
    step: _Step,
    num_steps: int | Int[Array, ""],
    leaves: list[Array],
    parameters: list[Array],
    leaves_move: Sequence[bool],
    parameters_move: Sequence[bool],
    is_kept: bool,
) -> tuple[list[Array], list[Array] | None]:
    """The loop, where those parameters travel that are scalars, if they move.

    Numbers of the carry that do not move, such as what sums have lost, are a vector of their own:
    a derivative does not carry it.
    """
    rows = step.rows
    moves = [
        is_one
        for x, is_one in zip(leaves, leaves_move, strict=True)
        for _ in jtu.tree_leaves(split(x, rows))
    ]
    like = split(leaves, rows)
    leaves, structure = jtu.tree_flatten(like)
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

    def whole(carry: tuple[list[Array], list[Array]]) -> list[Array]:
        numbers, _ = entries(carry[0])
        return join(jtu.tree_unflatten(structure, _merge(numbers, carry[1], packed)))

    def stepped(run: Callable[[list[Any], list[Any]], list[Any]]) -> Callable[..., Any]:
        def stepped(
            numbers: list[Array],
            travellers: list[Array],
            rest: list[Array],
            known: Any,
            others: Any,
        ) -> Any:
            pieces = _merge(
                [_borrow(*pair) for pair in zip(known, travellers, strict=True)], others, travels
            )
            leaves = run(
                jtu.tree_unflatten(structure, _merge(numbers, rest, packed)),
                jtu.tree_unflatten(parameter_structure, pieces),
            )
            numbers, rest = _partition(jtu.tree_leaves(split_like(like, leaves)), packed)
            return vectors(numbers, travellers), rest

        return stepped

    def body(carry: tuple[list[Array], list[Array]]) -> tuple[list[Array], list[Array]]:
        return operation(
            stepped(step.run),
            *entries(carry[0]),
            carry[1],
            known,
            others,
            place="loop",
            is_batch=rows,
            plain=stepped(step.plain),
            order=step.order,
        )

    if not step.order:
        # An operation computes its step again in reverse; the step as it was would keep all of it.
        body = jax.checkpoint(body)
    keep = (lambda carry: carry) if is_kept else None
    carried, kept = _loop(body, (vectors(numbers, known), rest), num_steps, keep)
    return whole(carried), jax.vmap(whole)(kept) if is_kept else None


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
