"""A program as two, the second of which gives many results that are mostly not used."""

import itertools
from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from .jaxprs import called, narrowed, part_of, variables, without_constants
from .limits import FUNCTION, MAX_RESULTS_IN_BATCHES
from .materialise import not_materialised, together
from .struct_of_arrays import literal

_FREE = frozenset(
    "broadcast_in_dim cfjax_pack cfjax_unpack convert_element_type copy reshape slice squeeze "
    "transpose".split()
)


def in_two(program: ClosedJaxpr, first: int, operands: Sequence[Any]) -> list[Any]:
    """The first results, and all others from a copy of the program, which calls no other.

    XLA would compute what leads to each of the others anew. The copy is in parts, each with few
    results, which are materialised together. What is not used is not computed.
    """
    results = range(len(program.jaxpr.outvars))
    main, main_places = narrowed(program, results[:first])
    tail, tail_places = narrowed(program, results[first:])
    # So that the copy is not seen to be one.
    inputs = together([operands[k] for k in tail_places])
    outs = _in_parts(not_materialised(tail), inputs)
    return [*called(main, [operands[k] for k in main_places]), *outs]


def _in_parts(program: ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
    jaxpr = without_constants(program).jaxpr
    env: dict[Any, Any] = dict(zip(jaxpr.invars, (*program.consts, *operands), strict=True))
    for start, stop in itertools.pairwise(_ends_of_few(jaxpr)):
        later = [v for e in jaxpr.eqns[stop:] for v in variables(e.invars)]
        part = part_of(jaxpr, jaxpr.eqns[start:stop], [*later, *variables(jaxpr.outvars)])
        outs = together(jaxpr_as_fun(ClosedJaxpr(part, []))(*(env[v] for v in part.invars)))
        env.update(zip(part.outvars, outs, strict=True))
    return [literal(v) if isinstance(v, Literal) else env[v] for v in jaxpr.outvars]


def _ends_of_few(jaxpr: Jaxpr) -> list[int]:
    """The ends of parts of a program, as long as they give few values to the rest and the results.

    A part is also not too long for one function.
    """
    n = len(jaxpr.eqns)
    last_uses = {v: k for k, eqn in enumerate(jaxpr.eqns) for v in variables(eqn.invars)}
    last_uses.update(dict.fromkeys(variables(jaxpr.outvars), n))
    ends = [0]
    while ends[-1] < n:
        live, length, choices = set(), 0, []
        for k in range(ends[-1], n):
            eqn = jaxpr.eqns[k]
            length += eqn.primitive.name not in _FREE
            live = {v for v in (*live, *eqn.outvars) if last_uses.get(v, -1) > k}
            choices.append((len(live) > MAX_RESULTS_IN_BATCHES and len(live), -k))
            if length > FUNCTION:
                break
        ends.append(1 - min(choices)[1])
    return ends
