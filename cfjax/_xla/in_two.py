"""A program as two, the second of which gives many results that are mostly not used."""

from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from .jaxprs import (
    CALLS,
    by_parts,
    called,
    flattened,
    narrowed,
    num_operations,
    variables,
)
from .limits import FUNCTION, MAX_RESULTS_IN_BATCHES
from .materialise import not_materialised, together


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
    return [*called(flattened(main, CALLS, is_once=True), [operands[k] for k in main_takes]), *outs]


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
