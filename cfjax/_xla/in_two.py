"""A program as two, the second of which gives many results that are mostly not used."""

import itertools
from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun

from .jaxprs import altered, called, narrowed, value_of, variables
from .limits import FUNCTION, MAX_RESULTS_IN_BATCHES
from .materialise import not_materialised, together

_FREE = frozenset(
    "broadcast_in_dim cfjax_pack cfjax_unpack convert_element_type copy reshape slice squeeze "
    "transpose".split()
)


def in_two(program: ClosedJaxpr, first: int, operands: Sequence[Any]) -> list[Any]:
    """The first results, and all others from a copy of the program, which calls no other.

    XLA would compute what leads to each of the others anew. The copy is in parts, each with few
    results, which are materialised together. What is not used is not computed.
    """
    given = range(len(program.jaxpr.outvars))
    main, main_takes = narrowed(program, given[:first])
    rest, rest_takes = narrowed(program, given[first:])
    # So that the copy is not seen to be one.
    inputs = together([operands[k] for k in rest_takes])
    outs = _in_parts(not_materialised(rest), inputs)
    return [*called(main, [operands[k] for k in main_takes]), *outs]


def _in_parts(program: ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
    jaxpr = program.jaxpr
    names, values = (*jaxpr.constvars, *jaxpr.invars), (*program.consts, *operands)
    env: dict[Any, Any] = dict(zip(names, values, strict=True))
    for start, stop in itertools.pairwise(_ends_of_few(jaxpr)):
        eqns = jaxpr.eqns[start:stop]
        made = {v for e in eqns for v in e.outvars}
        taken = dict.fromkeys(v for e in eqns for v in variables(e.invars) if v not in made)
        later = [v for e in jaxpr.eqns[stop:] for v in variables(e.invars)]
        given = dict.fromkeys(v for v in (*later, *variables(jaxpr.outvars)) if v in made)
        part = altered(jaxpr, eqns=eqns, constvars=[], invars=list(taken), outvars=list(given))
        outs = together(jaxpr_as_fun(ClosedJaxpr(part, []))(*(env[v] for v in taken)))
        env.update(zip(given, outs, strict=True))
    return [value_of(v, env) for v in jaxpr.outvars]


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
            length += eqn.primitive.name not in _FREE
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
