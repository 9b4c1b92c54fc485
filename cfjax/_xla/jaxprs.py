"""Programs of JAX as values: what they need, what reaches what, parts of them, their evaluation."""

import functools
import weakref
from collections.abc import Callable, Container, Hashable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import (
    ClosedJaxpr,
    DropVar,
    Jaxpr,
    JaxprEqn,
    Literal,
    Primitive,
    Var,
    jaxpr_as_fun,
    jaxprs_in_params,
)
from jax.interpreters import mlir
from jaxtyping import Array

# A program as it stands, for one that is being traced.
call_p = Primitive("cfjax_call")
call_p.multiple_results = True

# Operations that call a program, and under which parameter. Where nothing is differentiated any
# more, rules for that are not needed either.
CALLS = {
    "cfjax_call": "program",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


def program_of(fun: Callable[..., Sequence[Array]], *structs: Any) -> ClosedJaxpr:
    made = jax.make_jaxpr(fun)(*structs)
    return ClosedJaxpr(without_dead_code(made.jaxpr), made.consts)


def structs(atoms: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return structs_of([v.aval for v in atoms])


def structs_of(avals: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]


def variables(atoms: Iterable[Any]) -> list[Any]:
    return [v for v in atoms if not isinstance(v, Literal)]


def altered(jaxpr: Jaxpr, **parts: Any) -> Jaxpr:
    """The same with other parts, whose names are not known."""
    return jaxpr.replace(debug_info=jaxpr.debug_info.with_unknown_names(), **parts)


def replaced(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    values = list(values)
    for k, x in zip(places, new, strict=True):
        values[k] = x
    return values


def is_inexact(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


def without_dead_code(jaxpr: Jaxpr) -> Jaxpr:
    """Only what the results need."""
    wanted = set(variables(jaxpr.outvars))
    kept = []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not wanted.isdisjoint(eqn.outvars):
            kept.append(eqn)
            wanted.update(variables(eqn.invars))
    return jaxpr.replace(eqns=kept[::-1])


def narrowed(
    program: ClosedJaxpr, gives: Sequence[int] | None = None, takes: Sequence[int] | None = None
) -> tuple[ClosedJaxpr, Sequence[int]]:
    """A program for some of the results, by default all, and the operands that it takes.

    By default these are those that it needs.
    """
    jaxpr = program.jaxpr
    outvars = jaxpr.outvars if gives is None else [jaxpr.outvars[k] for k in gives]
    code = without_dead_code(altered(jaxpr, outvars=outvars))
    if takes is None:
        used = {v for e in code.eqns for v in variables(e.invars)} | set(variables(code.outvars))
        takes = [k for k, v in enumerate(code.invars) if v in used]
    code = altered(code, invars=[code.invars[k] for k in takes])
    return ClosedJaxpr(code, program.consts), takes


def reached(jaxpr: Jaxpr, sources: Sequence[bool]) -> list[bool]:
    """Which results may depend on some of the operands."""
    found = {v for v, is_one in zip(jaxpr.invars, sources, strict=True) if is_one}

    def are_found(atoms: Sequence[Any]) -> list[bool]:
        return [not isinstance(v, Literal) and v in found for v in atoms]

    for eqn in jaxpr.eqns:
        if any(are_found(eqn.invars)):
            found.update(eqn.outvars)
    return are_found(jaxpr.outvars)


def value_of(v: Any, env: dict[Any, Any]) -> Any:
    """What a name of a program stands for, or its number."""
    aval: Any = v.aval
    return jnp.asarray(v.val, aval.dtype) if isinstance(v, Literal) else env[v]


def evaluate(jaxpr: Jaxpr, eqn: JaxprEqn, values: Sequence[Any]) -> Sequence[Any]:
    """The results of one operation of a program; None for those that are dropped."""
    # Most are of this kind, and the other way makes a program of each.
    if not eqn.primitive.multiple_results and not any(jaxprs_in_params(eqn.params)):
        return [eqn.primitive.bind(*values, **eqn.params)]
    known = {v: x for v, x in zip(eqn.invars, values, strict=True) if not isinstance(v, Literal)}
    # JAX's own evaluator knows how every operation is called, in every version of JAX.
    outvars = [v for v in eqn.outvars if not isinstance(v, DropVar)]
    alone = altered(jaxpr, constvars=[], invars=list(known), outvars=outvars, eqns=[eqn])
    outs = iter(jaxpr_as_fun(ClosedJaxpr(alone, []))(*known.values()))
    return [None if isinstance(v, DropVar) else next(outs) for v in eqn.outvars]


def called(program: ClosedJaxpr, operands: Sequence[Any]) -> list[Array]:
    """The results of a program, which is traced and lowered as one operation.

    `jaxpr_as_fun` would trace it again, operation by operation.
    """
    return call_p.bind(*program.consts, *operands, program=without_constants(program))


def without_constants(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program that takes what it closes over before its operands, and keeps none of it."""
    jaxpr = program.jaxpr
    invars = [*jaxpr.constvars, *jaxpr.invars]
    return ClosedJaxpr(altered(jaxpr, constvars=[], invars=invars), [])


def flattened(program: ClosedJaxpr, calls: Container[str], is_once: bool = False) -> ClosedJaxpr:
    """The program without calls of some kinds, and `is_once` with everything once that is computed
    alike.
    """
    consts: dict[int, tuple[Var, Any]] = {}
    eqns: list[JaxprEqn] = []
    known: dict[Any, list[Any]] = {}

    def run(program: ClosedJaxpr, atoms: Sequence[Any]) -> list[Any]:
        jaxpr, env = program.jaxpr, dict(zip(program.jaxpr.invars, atoms, strict=True))
        for v, value in zip(jaxpr.constvars, program.consts, strict=True):
            env[v], _ = consts.setdefault(id(value), (Var(v.aval), value))

        def read(v: Any) -> Any:
            return v if isinstance(v, Literal) else env[v]

        for eqn in jaxpr.eqns:
            invars, name = list(map(read, eqn.invars)), eqn.primitive.name
            if name in calls:
                outvars = run(eqn.params[CALLS[name]], invars)
            else:
                key = _key(eqn, invars) if is_once else object()
                outvars = known.get(key)
                if outvars is None:
                    outvars = [v if isinstance(v, DropVar) else Var(v.aval) for v in eqn.outvars]
                    known[key] = outvars
                    eqns.append(eqn.replace(invars=invars, outvars=outvars))
            env.update(zip(eqn.outvars, outvars, strict=True))
        return list(map(read, jaxpr.outvars))

    outvars = run(program, program.jaxpr.invars)
    constvars, values = zip(*consts.values(), strict=True) if consts else ((), ())
    jaxpr = altered(program.jaxpr, constvars=list(constvars), eqns=eqns, outvars=outvars)
    return ClosedJaxpr(without_dead_code(jaxpr), list(values))


def _key(eqn: JaxprEqn, invars: Sequence[Any]) -> Hashable:
    """What tells an operation from others."""
    atoms = (
        # Every bit: as text, numbers that agree in eight digits would be one.
        (str(v.aval), np.asarray(v.val).tobytes()) if isinstance(v, Literal) else v
        for v in invars
    )
    dropped = [isinstance(v, DropVar) for v in eqn.outvars]
    return eqn.primitive, *atoms, *dropped, parameters(eqn)


def parameters(eqn: JaxprEqn) -> Hashable:
    """What tells the operation from others on the same operands."""
    values = tuple(sorted(eqn.params.items(), key=lambda item: item[0]))
    try:
        hash(values)
    except TypeError:
        return object()  # Equal to no other, so such operations are never merged.
    return values


# Of the programs of a solve, which are differentiated one soon after the other.
_KEPT = 32


def once_for_each_program(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun(program, *rest)`, computed once while one program after the other is differentiated.

    No program is held that JAX has dropped, and of those that JAX keeps, which are thousands, what
    is derived is kept for the last ones alone.
    """
    kept: weakref.WeakKeyDictionary[ClosedJaxpr, dict[Any, Any]] = weakref.WeakKeyDictionary()

    @functools.wraps(fun)
    def once(program: ClosedJaxpr, *rest: Any) -> Any:
        found = kept.setdefault(program, {})
        if rest not in found:
            found[rest] = fun(program, *rest)
        result = found[rest]
        while len(kept) > _KEPT:
            del kept[next(iter(kept))]
        return result

    return once


@call_p.def_impl
def _run(*operands, program):
    # A literal comes out as NumPy's.
    return list(map(jnp.asarray, jaxpr_as_fun(program)(*operands)))


@call_p.def_abstract_eval
def _(*operands, program):
    return program.out_avals


mlir.register_lowering(
    call_p,
    lambda ctx, *args, program: mlir.core_call_lowering(
        ctx, *args, name="cfjax", call_jaxpr=program.jaxpr
    ),
)
call_p.to_lojax = _run
