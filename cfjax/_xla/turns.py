"""Loops over stages turn by turn: each turn is scalarised, and tables of all stages stay whole."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from .jaxprs import (
    OPENED,
    altered,
    are_among,
    dependent,
    flattened,
    live,
    part_of,
    program_of,
    structs,
    variables,
    without_constants,
)
from .limits import MAX_LENGTH
from .over_stages import Loop
from .struct_of_arrays import literal

# What computes a program, of operands of which some are fixed.
Run = Callable[[Sequence[Any], ClosedJaxpr, Sequence[bool]], Sequence[Any]]


def by_turns(program: ClosedJaxpr, fixed: Sequence[bool], run: Run) -> ClosedJaxpr:
    """The program, in whose loops `run` computes what each turn makes of short vectors."""
    jaxpr = program.jaxpr
    varying = dependent(jaxpr, itertools.compress(jaxpr.invars, (not x for x in fixed)))
    eqns = [
        _by_turns(eqn, [not x for x in are_among(eqn.invars, varying)], run)
        if eqn.primitive.name == "scan"
        else eqn
        for eqn in jaxpr.eqns
    ]
    return ClosedJaxpr(altered(jaxpr, eqns=eqns), program.consts)


def _by_turns(eqn: JaxprEqn, fixed: Sequence[bool], run: Run) -> JaxprEqn:
    body, n = flattened(eqn.params["jaxpr"], OPENED), Loop.of(eqn).num_constants
    code = without_constants(body).jaxpr
    # What is carried may change, and what it goes over does.
    flags = [*[True] * len(body.consts), *fixed[:n], *[False] * (len(fixed) - n)]
    turn = program_of(
        lambda *operands: _turn(code, [*body.consts, *operands], flags, run),
        *structs(body.in_avals),
    )
    return eqn.replace(params=eqn.params | {"jaxpr": turn})


def _turn(jaxpr: Jaxpr, operands: Sequence[Any], fixed: Sequence[bool], run: Run) -> Sequence[Any]:
    """The results of a turn, of which `run` computes what is not about tables."""

    def on_vectors(part: Jaxpr, operands: Sequence[Any], are_fixed: Sequence[bool]) -> Any:
        return run(operands, ClosedJaxpr(part, []), are_fixed), [False] * len(part.outvars)

    def on_tables(part: Jaxpr, operands: Sequence[Any], _: Sequence[bool]) -> Any:
        return jaxpr_as_fun(ClosedJaxpr(part, []))(*operands), [False] * len(part.outvars)

    return in_parts(jaxpr, operands, fixed, on_vectors, on_tables, is_table)[0]


# What computes a part of a turn, of values of which some are fixed; and which results are.
Part = Callable[[Jaxpr, Sequence[Any], Sequence[bool]], tuple[Sequence[Any], Sequence[bool]]]


def in_parts(
    jaxpr: Jaxpr,
    operands: Sequence[Any],
    fixed: Sequence[bool],
    on_vectors: Part,
    on_tables: Part,
    is_table: Callable[[Any], bool],
) -> tuple[list[Any], list[bool]]:
    """The results of a turn, and whether each is fixed.

    `on_vectors` computes what is made of short vectors, `on_tables` what is read of tables and put
    into them.
    """
    values = zip(operands, fixed, strict=True)
    env: dict[Any, tuple[Any, bool]] = dict(zip(jaxpr.invars, values, strict=True))
    runs = on_tables, on_vectors, on_tables
    for part, run in zip(_parts_of(jaxpr, is_table), runs, strict=True):
        values = [env[v] for v in part.invars]
        outs = run(part, [x for x, _ in values], [is_fixed for _, is_fixed in values])
        env.update(zip(part.outvars, zip(*outs, strict=True), strict=True))
    outs = [(literal(v), True) if isinstance(v, Literal) else env[v] for v in jaxpr.outvars]
    return [x for x, _ in outs], [is_fixed for _, is_fixed in outs]


def _parts_of(jaxpr: Jaxpr, is_table: Callable[[Any], bool]) -> tuple[Jaxpr, Jaxpr, Jaxpr]:
    """What a turn reads of tables, what it makes of short vectors, and the tables of that."""
    available = {*jaxpr.constvars, *jaxpr.invars}
    tables = {v for v in jaxpr.invars if is_table(v)}
    ready: list[JaxprEqn] = []
    needed: set[Any] = set()
    for eqn in jaxpr.eqns:
        operands = variables(eqn.invars)
        if available.issuperset(operands):
            ready.append(eqn)
            if tables.isdisjoint(operands):
                available.update(eqn.outvars)
            else:
                # What is made of a short vector that comes out of a table is scalarised.
                new = list(filter(is_table, eqn.outvars))
                tables.update(new)
                available.update(new)
                needed.update(eqn.outvars)
    before = live(ready, needed)
    places = set(map(id, before))
    within: list[JaxprEqn] = []
    after: list[JaxprEqn] = []
    inner: set[Any] = set()
    for eqn in reversed(jaxpr.eqns):
        if id(eqn) not in places:
            operands = variables(eqn.invars)
            if any(map(is_table, (*operands, *eqn.outvars))) and inner.isdisjoint(eqn.outvars):
                after.append(eqn)
            else:
                within.append(eqn)
                inner.update(operands)
    outvars = variables(jaxpr.outvars)
    end = part_of(jaxpr, after[::-1], outvars)
    core = part_of(jaxpr, within[::-1], [*outvars, *end.invars])
    return part_of(jaxpr, before, [*outvars, *end.invars, *core.invars]), core, end


def is_table(v: Any) -> bool:
    """Whether this is an array of vectors of all stages, or of what a loop made in all turns."""
    return len(v.aval.shape) > 1 and v.aval.size > MAX_LENGTH


def of_tables(jaxpr: Jaxpr, tables: Sequence[Any]) -> Callable[[Any], bool]:
    """Whether a value of a program is one of some tables, or a table that is made of them."""
    ranks = {v.aval.ndim for v in tables}

    def is_like(v: Any) -> bool:
        return v.aval.ndim in ranks and v.aval.shape[0] > 1

    return dependent(jaxpr, tables, is_like).__contains__
