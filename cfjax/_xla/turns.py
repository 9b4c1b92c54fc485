"""Loops over stages turn by turn: each turn is scalarised, and tables of all stages stay whole."""

from collections.abc import Callable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun

from .jaxprs import (
    altered,
    flattened,
    program_of,
    structs,
    value_of,
    variables,
    without_dead_code,
)
from .limits import MAX_LENGTH
from .over_stages import Loop

# What computes a program, of operands of which some are fixed.
Run = Callable[[Sequence[Any], ClosedJaxpr, Sequence[bool]], Sequence[Any]]


def by_turns(program: ClosedJaxpr, fixed: Sequence[bool], run: Run) -> ClosedJaxpr:
    """The program, in whose loops `run` computes what each turn makes of short vectors."""
    jaxpr, eqns = program.jaxpr, []
    are_fixed = dict(zip(jaxpr.invars, fixed, strict=True))
    are_fixed.update((v, True) for v in jaxpr.constvars)
    for eqn in jaxpr.eqns:
        flags = [isinstance(v, Literal) or are_fixed[v] for v in eqn.invars]
        are_fixed.update((v, all(flags)) for v in eqn.outvars)
        eqns.append(_by_turns(eqn, flags, run) if eqn.primitive.name == "scan" else eqn)
    return ClosedJaxpr(altered(jaxpr, eqns=eqns), program.consts)


def _by_turns(eqn: JaxprEqn, fixed: Sequence[bool], run: Run) -> JaxprEqn:
    body = flattened(eqn.params["jaxpr"], ("jit", "pjit"))
    jaxpr, n = body.jaxpr, Loop.of(eqn).num_constants
    code = altered(jaxpr, constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars])
    # What is carried may change, and what it goes over does.
    flags = [*[True] * len(body.consts), *fixed[:n], *[False] * (len(fixed) - n)]
    turn = program_of(
        lambda *operands: _turn(code, [*body.consts, *operands], flags, run),
        *structs(jaxpr.invars),
    )
    return eqn.replace(params=eqn.params | {"jaxpr": turn})


def _turn(jaxpr: Jaxpr, operands: Sequence[Any], fixed: Sequence[bool], run: Run) -> Sequence[Any]:
    """The results of a turn, of which `run` computes what is not about tables."""

    def core(part: Jaxpr, given: Sequence[Any], are_fixed: Sequence[bool]) -> Any:
        return run(given, ClosedJaxpr(part, []), are_fixed), [False] * len(part.outvars)

    def rest(part: Jaxpr, given: Sequence[Any], _: Sequence[bool]) -> Any:
        return jaxpr_as_fun(ClosedJaxpr(part, []))(*given), [False] * len(part.outvars)

    made = in_parts(jaxpr, operands, fixed, core, rest, is_table)
    values = {v: x for v, (x, _) in made.items()}
    return [value_of(v, values) for v in jaxpr.outvars]


# What computes a part of a turn, of values of which some are fixed; and which results are.
Part = Callable[[Jaxpr, Sequence[Any], Sequence[bool]], tuple[Sequence[Any], Sequence[bool]]]


def in_parts(
    jaxpr: Jaxpr,
    operands: Sequence[Any],
    fixed: Sequence[bool],
    core: Part,
    rest: Part,
    is_table: Callable[[Any], bool],
) -> dict[Any, tuple[Any, bool]]:
    """The values of a turn, and whether each is fixed.

    `core` computes what is made of short vectors, `rest` what is read of tables and put into them.
    """
    values = zip(operands, fixed, strict=True)
    made: dict[Any, tuple[Any, bool]] = dict(zip(jaxpr.invars, values, strict=True))
    for part, run in zip(_parts_of(jaxpr, is_table), (rest, core, rest), strict=True):
        given = [made[v] for v in part.invars]
        outs = run(part, [x for x, _ in given], [is_one for _, is_one in given])
        made.update(zip(part.outvars, zip(*outs, strict=True), strict=True))
    return made


def _parts_of(jaxpr: Jaxpr, is_table: Callable[[Any], bool]) -> tuple[Jaxpr, Jaxpr, Jaxpr]:
    """What a turn reads of tables, what it makes of short vectors, and the tables of that."""
    before, within, after = _apart(jaxpr, is_table)
    end = _part(jaxpr, after, variables(jaxpr.outvars))
    core = _part(jaxpr, within, variables((*jaxpr.outvars, *end.invars)))
    start = _part(jaxpr, before, variables((*jaxpr.outvars, *end.invars, *core.invars)))
    return start, core, end


def _part(jaxpr: Jaxpr, eqns: Sequence[JaxprEqn], wanted: Sequence[Any]) -> Jaxpr:
    """A part of a program that makes what is wanted of it, and takes no more than it needs."""
    made = {v for eqn in eqns for v in eqn.outvars}
    outs = list(dict.fromkeys(v for v in wanted if v in made))
    code = altered(jaxpr, constvars=[], invars=[], eqns=list(eqns), outvars=outs)
    code = without_dead_code(code)
    known = {v for eqn in code.eqns for v in eqn.outvars}
    taken = dict.fromkeys(v for eqn in code.eqns for v in variables(eqn.invars) if v not in known)
    return altered(code, invars=list(taken))


def _apart(
    jaxpr: Jaxpr, is_table: Callable[[Any], bool]
) -> tuple[list[JaxprEqn], list[JaxprEqn], list[JaxprEqn]]:
    """What reads tables, what is on short vectors, and what makes tables of that."""
    available = {*jaxpr.constvars, *jaxpr.invars}
    tables = {v for v in jaxpr.invars if is_table(v)}
    could: list[int] = []
    needed: set[Any] = set()
    for k, eqn in enumerate(jaxpr.eqns):
        taken = variables(eqn.invars)
        if not all(v in available for v in taken):
            continue
        could.append(k)
        if tables.isdisjoint(taken):
            available.update(eqn.outvars)
            continue
        # What is made of a short vector that comes out of a table is scalarised.
        some = [v for v in eqn.outvars if is_table(v)]
        tables.update(some)
        available.update(some)
        needed.update(eqn.outvars)
    before: set[int] = set()
    for k in reversed(could):
        if not needed.isdisjoint(jaxpr.eqns[k].outvars):
            before.add(k)
            needed.update(variables(jaxpr.eqns[k].invars))
    after: set[int] = set()
    inner: set[Any] = set()
    for k in reversed(range(len(jaxpr.eqns))):
        eqn = jaxpr.eqns[k]
        has_table = any(is_table(v) for v in (*variables(eqn.invars), *eqn.outvars))
        if k in before or (has_table and inner.isdisjoint(eqn.outvars)):
            if k not in before:
                after.add(k)
        else:
            inner.update(variables(eqn.invars))
    parts: tuple[list[JaxprEqn], ...] = [], [], []
    for k, eqn in enumerate(jaxpr.eqns):
        parts[0 if k in before else 2 if k in after else 1].append(eqn)
    return parts[0], parts[1], parts[2]


def is_table(v: Any) -> bool:
    """Whether this is an array of vectors of all stages, or of what a loop made in all turns."""
    return len(v.aval.shape) > 1 and v.aval.size > MAX_LENGTH


def of_tables(jaxpr: Jaxpr, tables: Sequence[Any]) -> Callable[[Any], bool]:
    """Whether a value of a program is one of some tables, or a table that is made of them."""
    found, ranks = set(tables), {v.aval.ndim for v in tables}

    def is_one(v: Any) -> bool:
        return v.aval.ndim in ranks and v.aval.shape[0] > 1

    for eqn in jaxpr.eqns:
        if not found.isdisjoint(variables(eqn.invars)):
            found.update(filter(is_one, eqn.outvars))
    return found.__contains__
