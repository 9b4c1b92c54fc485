"""Programs of JAX as values: what they need, what reaches what, parts of them, their evaluation."""

import itertools
from collections.abc import Callable, Container, Hashable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import (
    ClosedJaxpr,
    DropVar,
    Jaxpr,
    JaxprEqn,
    Literal,
    jaxpr_as_fun,
    jaxprs_in_params,
)
from jaxtyping import Array

# Operations that call a program, and under which parameter.
CALLS = {
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
}
# The calls that are opened in what may be differentiated again; and where nothing is differentiated
# any more, so that no rule for a derivative is needed.
OPENED = frozenset(("jit",))
OPENED_LAST = OPENED | {"custom_jvp_call"}


def program_of(fun: Callable[..., Sequence[Array]], *operands: Any) -> ClosedJaxpr:
    closed = jax.make_jaxpr(fun)(*operands)
    return ClosedJaxpr(without_dead_code(closed.jaxpr), closed.consts)


def structs(avals: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]


def variables(atoms: Iterable[Any]) -> list[Any]:
    return [v for v in atoms if not isinstance(v, Literal)]


def are_among(atoms: Iterable[Any], some: Container[Any]) -> list[bool]:
    """Which of the atoms are some variables. JAX's literals have no hash."""
    return [not isinstance(v, Literal) and v in some for v in atoms]


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
    return jaxpr.replace(eqns=live(jaxpr.eqns, variables(jaxpr.outvars)))


def live(eqns: Sequence[JaxprEqn], outvars: Iterable[Any]) -> list[JaxprEqn]:
    """The equations that the results need."""
    needed, reverse = set(outvars), []
    for eqn in reversed(eqns):
        if eqn.effects or not needed.isdisjoint(eqn.outvars):
            reverse.append(eqn)
            needed.update(variables(eqn.invars))
    return reverse[::-1]


def narrowed(
    program: ClosedJaxpr, results: Sequence[int], operands: Sequence[int] | None = None
) -> tuple[ClosedJaxpr, Sequence[int]]:
    """A program for some of the results, and the operands that it takes.

    By default these are those that it needs.
    """
    jaxpr = program.jaxpr
    code = without_dead_code(altered(jaxpr, outvars=[jaxpr.outvars[k] for k in results]))
    if operands is None:
        used = {v for e in code.eqns for v in variables(e.invars)} | set(variables(code.outvars))
        operands = [k for k, v in enumerate(code.invars) if v in used]
    code = altered(code, invars=[code.invars[k] for k in operands])
    return ClosedJaxpr(code, program.consts), operands


def reached(jaxpr: Jaxpr, operands: Iterable[bool]) -> list[bool]:
    """Which results may depend on some of the operands."""
    values = set(itertools.compress(jaxpr.invars, operands))
    for eqn in jaxpr.eqns:
        if not values.isdisjoint(variables(eqn.invars)):
            values.update(eqn.outvars)
    return are_among(jaxpr.outvars, values)


# To make others of: JAX wants to know of each program where it was traced.
_EMPTY = jax.make_jaxpr(lambda: ())().jaxpr


def evaluate(eqn: JaxprEqn, values: Sequence[Any]) -> Sequence[Any]:
    """The results of one operation of a program; None for those that are dropped."""
    # Most are of this kind, and the other way makes a program of each.
    if not eqn.primitive.multiple_results and not any(jaxprs_in_params(eqn.params)):
        return [eqn.primitive.bind(*values, **eqn.params)]
    env = {v: x for v, x in zip(eqn.invars, values, strict=True) if not isinstance(v, Literal)}
    # JAX's own evaluator knows how every operation is called, in every version of JAX.
    outvars = [v for v in eqn.outvars if not isinstance(v, DropVar)]
    alone = altered(_EMPTY, invars=list(env), outvars=outvars, eqns=[eqn])
    outs = iter(jaxpr_as_fun(ClosedJaxpr(alone, []))(*env.values()))
    return [None if isinstance(v, DropVar) else next(outs) for v in eqn.outvars]


def parameters(eqn: JaxprEqn) -> Hashable:
    """What tells the operation from others on the same operands."""
    values = tuple(sorted(eqn.params.items(), key=lambda item: item[0]))
    try:
        hash(values)
    except TypeError:
        return object()  # Equal to no other, so such operations are never merged.
    return values
