"""A program as one operation of JAX, whose first derivative is such an operation too.

A derivative of a program of scalars has several times its operations. It becomes a program of its
own here, so that when it is compiled its length is known. A long program is a sequence of pieces,
between which few values are on their way, and its derivatives are sequences of derivatives of the
pieces. What is too long for one of XLA's functions is compiled as several, which materialise
these values.

A second derivative is JAX's own of the program as it was before it was scalarised (`Plain`).
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jax.interpreters import mlir
from jaxtyping import PyTree

from .derivatives import Kind, Plain
from .jaxprs import (
    CALLS,
    altered,
    by_parts,
    called,
    flattened,
    is_inexact,
    narrowed,
    num_operations,
    operation_p,
    program_of,
    replaced,
    structs,
    variables,
    without_constants,
    without_dead_code,
)
from .limits import FUNCTION, MAX_RESULTS_IN_BATCHES, WHOLE
from .materialise import materialised, not_materialised

_GROUP = FUNCTION // 2
# A derivative has up to five times the operations, and should fit.
_PIECE = FUNCTION // 8


def operation(
    fun: Callable[..., PyTree],
    *args: PyTree,
    plain: Callable[..., PyTree] | None = None,
) -> PyTree:
    """`fun(*args)`, as one operation.

    `fun` may close over traced values, and has no effects. Reverse mode keeps the arguments and
    computes everything again, as with `jax.checkpoint`. `plain` is the same function before it was
    scalarised, and closes over nothing that is traced: derivatives beyond the first are of that.
    """
    leaves, structure = jtu.tree_flatten(args)
    leaves = list(map(jnp.asarray, leaves))
    out_structure: Any = None

    def of_leaves(*leaves):
        nonlocal out_structure
        out = fun(*jtu.tree_unflatten(structure, leaves))
        out, out_structure = jtu.tree_flatten(jtu.tree_map(jnp.asarray, out))
        return out

    made = flattened(jax.make_jaxpr(of_leaves)(*leaves), ["cfjax_call"])
    operands = [*map(jnp.asarray, made.consts), *leaves]
    code = without_constants(made).jaxpr
    # Integers, as the number of a step, are on their own: no derivative is of them, and a transpose
    # of what is linear has their values.
    outs: list[Any] = [None] * len(code.outvars)
    is_smooth = [is_inexact(v.aval) for v in code.outvars]
    smooth, whole = ([k for k, x in enumerate(is_smooth) if x == one] for one in (True, False))
    exact, takes = narrowed(ClosedJaxpr(code, []), whole)
    outs = replaced(outs, whole, jaxpr_as_fun(exact)(*(operands[k] for k in takes)))

    kind = Kind()
    code = without_dead_code(altered(code, outvars=[code.outvars[k] for k in smooth]))
    program, ends = ClosedJaxpr(code, []), _places(code)
    if len(ends) > 2:
        bind = functools.partial(operation_p.bind, kind=kind, plain=None)
        pieces = functools.partial(
            by_parts, program, ends, lambda piece, xs, is_last: bind(*xs, program=piece)
        )
        program = program_of(pieces, *structs(code.invars))
    before = None
    if plain is not None and not any(isinstance(x, Tracer) for x in made.consts):
        skipped = len(made.consts)

        def of_plain_leaves(*operands):
            # What comes first are constants of the program that was scalarised.
            outs = jtu.tree_leaves(plain(*jtu.tree_unflatten(structure, operands[skipped:])))
            return [outs[k] for k in smooth]

        before = Plain(of_plain_leaves, structs(code.invars))
    new = operation_p.bind(*operands, program=program, kind=kind, plain=before)
    return jtu.tree_unflatten(out_structure, replaced(outs, smooth, new))


def _places(jaxpr: Jaxpr) -> list[int]:
    """The ends of pieces of a program, where few values are on their way."""
    n, last = len(jaxpr.eqns), _last_uses(jaxpr)
    change = np.zeros(n + 2, int)
    for k, eqn in enumerate(jaxpr.eqns):
        for v in eqn.outvars:
            if v in last:
                change[k + 1] += 1
                change[last[v] + 1] -= 1
    live = np.cumsum(change)[:n]
    progress = np.cumsum([0, *map(num_operations, jaxpr.eqns)])
    parts = math.ceil(progress[-1] / _PIECE)
    length = progress[-1] / max(parts, 1)
    ends = [0]
    for k in range(1, parts):
        near = np.flatnonzero(np.abs(progress[:n] - k * length) < 0.4 * length)
        near = near[near > ends[-1]]
        if near.size:
            distance = np.abs(progress[near] - k * length)
            ends.append(int(near[np.lexsort((distance, live[near]))[0]]))
    return [*ends, n]


@operation_p.def_impl
def _run(*operands, program, kind, plain):
    ends = _groups(program.jaxpr, WHOLE[min(kind.order, 2)])
    # Of a second derivative there are several in one loop.
    if len(ends) == 2 and kind.order < 2:
        return _once(program, operands)

    def run(group: ClosedJaxpr, values: Sequence[Any], is_last: bool) -> Sequence[Any]:
        outs = _once(group, values)
        return outs if is_last else together(outs)

    # With the operands materialised, so that no other operation shares what is computed from them.
    return by_parts(program, ends, run, *together(operands))


def in_two(program: ClosedJaxpr, first: int, operands: Sequence[Any]) -> list[Any]:
    """The first results, and all others from a copy of the program.

    XLA would compute what leads to each of the others anew. The copy is in parts, each with few
    results, which are materialised together. What is not used is not computed.
    """
    given = range(len(program.jaxpr.outvars))
    main, main_takes = narrowed(program, given[:first])
    rest, rest_takes = narrowed(flattened(program, CALLS, is_once=True), given[first:])
    rest = not_materialised(rest)
    # So that the copy is not seen to be one.
    inputs = together([operands[k] for k in rest_takes])
    run = lambda part, values, is_last: together(jaxpr_as_fun(part)(*values))  # noqa: E731
    outs = by_parts(rest, _ends_of_few(rest.jaxpr), run, *inputs)
    return [*_once(main, [operands[k] for k in main_takes]), *outs]


def _ends_of_few(jaxpr: Jaxpr) -> list[int]:
    """The ends of parts of a program, as long as they give few values to the rest and the results.

    A part is also not too long for one function.
    """
    n = len(jaxpr.eqns)
    last = _last_uses(jaxpr)
    ends = [0]
    while ends[-1] < n:
        live, length, found = set(), 0, []
        for k in range(ends[-1], n):
            eqn = jaxpr.eqns[k]
            length += num_operations(eqn)
            live = {v for v in (*live, *eqn.outvars) if last.get(v, -1) > k}
            found.append((len(live) > MAX_RESULTS_IN_BATCHES and len(live), -k))
            if length > FUNCTION:
                break
        ends.append(1 - min(found)[1])
    return ends


def _last_uses(jaxpr: Jaxpr) -> dict[Any, int]:
    """The number of the operation that uses a value last; that after the last one for results."""
    last = dict.fromkeys(variables(jaxpr.outvars), len(jaxpr.eqns))
    for k, eqn in reversed(list(enumerate(jaxpr.eqns))):
        for v in variables(eqn.invars):
            last.setdefault(v, k)
    return last


def _once(program: ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
    return called(flattened(program, CALLS, is_once=True), operands)


def together(values: Sequence[Any]) -> list[Any]:
    """The same, but for integers materialised together."""
    smooth = [k for k, x in enumerate(values) if is_inexact(x)]
    new = materialised([values[k] for k in smooth], in_batches=True) if smooth else []
    return replaced(values, smooth, new)


def _groups(jaxpr: Jaxpr, most: int | float) -> list[int]:
    """The ends of pieces that are compiled together."""
    lengths = list(map(num_operations, jaxpr.eqns))
    ends, size = [0], 0
    if sum(lengths) > most and any(e.primitive is operation_p for e in jaxpr.eqns):
        for k, more in enumerate(lengths):
            if size and size + more > _GROUP:
                ends.append(k)
                size = 0
            size += more
    return [*ends, len(lengths)]


# Where newer versions of JAX put types of their own within, they take them out first.
operation_p.to_lojax = lambda *operands, program, **_: jaxpr_as_fun(program)(*operands)


@operation_p.def_abstract_eval
def _(*operands, program, **_):
    return [v.aval for v in program.jaxpr.outvars]


mlir.register_lowering(operation_p, mlir.lower_fun(_run, multiple_results=True))
