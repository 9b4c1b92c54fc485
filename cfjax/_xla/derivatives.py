"""The derivatives, transposes and batches of an operation, which are operations too."""

import functools
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import ad, batching
from jaxtyping import Array

from .jaxprs import (
    is_inexact,
    narrowed,
    num_operations,
    operation_p,
    program_of,
    reached,
    replaced,
    structs,
)
from .limits import FUNCTION, MAX_ENTRIES
from .materialise import materialised


class Kind(NamedTuple):
    """How many of the last operands it is linear in, and which derivative it is."""

    linear: int = 0
    order: int = 0


class Plain:
    """The program of an operation before it was scalarised. It is traced if it is needed."""

    def __init__(self, fun: Callable[..., Sequence[Array]], operands: Sequence[Any]):
        self.fun, self.operands = fun, operands

    @functools.cached_property
    def program(self) -> ClosedJaxpr:
        return program_of(
            lambda *leaves: [jnp.asarray(x) for x in self.fun(*leaves)], *self.operands
        )

    def derived(
        self,
        make: Callable[[ClosedJaxpr], Callable[..., Sequence[Array]]],
        operands: Sequence[Any],
        takes: Sequence[int],
        gives: Sequence[int],
    ) -> "Plain":
        """What `make` makes of the program, for some of its operands and results.

        The results need no other operands.
        """

        def fun(*taken: Array) -> list[Array]:
            zeros = [jnp.zeros(x.shape, x.dtype) for x in operands]
            outs = make(self.program)(*replaced(zeros, takes, taken))
            return [outs[k] for k in gives]

        return Plain(fun, [operands[k] for k in takes])


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


def jvp_of(
    program: ClosedJaxpr, primals: Sequence[Any], tangents: Sequence[Any], moving: Sequence[int]
) -> tuple[list[Any], list[Any]]:
    """The results of a program, and their derivatives, if only some operands move."""
    fun = jaxpr_as_fun(program)
    points, ways = ([xs[k] for k in moving] for xs in (primals, tangents))
    return jax.jvp(lambda *some: fun(*replaced(primals, moving, some)), points, ways)


def _jvp(primals, tangents, *, program, kind, plain):
    given = enumerate(zip(primals, tangents, strict=True))
    moving = [k for k, (x, way) in given if type(way) is not ad.Zero and is_inexact(x)]
    if moving and plain is not None and kind.order:
        return jvp_of(plain.program, primals, tangents, moving)
    outs = operation_p.bind(*primals, program=program, kind=kind, plain=plain)
    smooth = [k for k, x in enumerate(outs) if is_inexact(x)]
    out_tangents: list[Any] = [ad.Zero(v.aval.to_tangent_aval()) for v in program.jaxpr.outvars]
    if moving and smooth:
        derivative = _tangent(program, plain, tuple(moving), tuple(smooth))
        moved = (tangents[k] for k in moving)
        new = derivative.bind([*primals, *moved], kind._replace(order=kind.order + 1))
        out_tangents = replaced(out_tangents, derivative.gives, new)
    return outs, out_tangents


@once_for_each_program
def _tangent(
    program: ClosedJaxpr, plain: Plain | None, moving: Sequence[int], smooth: Sequence[int]
) -> "_Linear":
    n = len(program.jaxpr.invars)

    def tangent_of(program):
        def tangent(*values):
            def along(*some):
                outs = jaxpr_as_fun(program)(*replaced(values[:n], moving, some))
                return [outs[k] for k in smooth]

            return jax.jvp(along, tuple(values[k] for k in moving), values[n:])[1]

        return tangent

    operands = structs(program.jaxpr.invars)
    operands = [*operands, *(operands[k] for k in moving)]
    return _linear(tangent_of, program, plain, operands, n, smooth)


def _transpose(cotangents, *operands, program, kind, plain):
    unknown = tuple(k for k, x in enumerate(operands) if ad.is_undefined_primal(x))
    coming = tuple(k for k, x in enumerate(cotangents) if type(x) is not ad.Zero)
    results: list[Any] = [None] * len(operands)
    if not coming:
        return results
    if not all(is_inexact(operands[k].aval) for k in unknown):
        # The number of a step, for one. From 0.12 on JAX hands over what is not linear too.
        raise NotImplementedError(
            "jax.linear_transpose of a solve that is rewritten for XLA needs jax 0.11 or older. "
            "Call it within cfjax.rewriting(False), or take jax.vjp."
        )
    transposed = _transposed(program, plain, unknown, coming)
    fixed = (x for k, x in enumerate(operands) if k not in unknown)
    new = transposed.bind([*fixed, *(cotangents[k] for k in coming)], kind)
    return replaced(results, transposed.gives, new)


@once_for_each_program
def _transposed(
    program: ClosedJaxpr, plain: Plain | None, linear: Sequence[int], coming: Sequence[int]
) -> "_Linear":
    given = structs(program.jaxpr.invars)
    fixed = [k for k in range(len(given)) if k not in linear]

    def transpose_of(program):
        def transposed(*values):
            known = replaced(given, fixed, values[: len(fixed)])

            def forward(*some):
                outs = jaxpr_as_fun(program)(*replaced(known, linear, some))
                return [outs[k] for k in coming]

            back = jax.linear_transpose(forward, *(given[k] for k in linear))
            return back(list(values[len(fixed) :]))

        return transposed

    cotangents = structs([program.jaxpr.outvars[k] for k in coming])
    operands = [*(given[k] for k in fixed), *cotangents]
    return _linear(transpose_of, program, plain, operands, len(fixed), linear)


class _Linear(NamedTuple):
    """A program that is linear in its last operands."""

    program: ClosedJaxpr
    plain: Plain | None
    takes: Sequence[int]
    linear: int
    gives: list[int]

    def bind(self, operands: Sequence[Any], kind: Kind) -> list[Any]:
        taken = (operands[k] for k in self.takes)
        kind = kind._replace(linear=self.linear)
        return operation_p.bind(*taken, program=self.program, kind=kind, plain=self.plain)


def _linear(
    make: Callable[[ClosedJaxpr], Callable[..., Sequence[Array]]],
    program: ClosedJaxpr,
    plain: Plain | None,
    operands: Sequence[Any],
    first: int,
    places: Sequence[int],
) -> _Linear:
    """What `make` makes of a program, linear in operands from `first` on, without what is zero."""
    made = program_of(make(program), *operands)
    everything = range(len(operands))
    are_reached = reached(made.jaxpr, [k >= first for k in everything])
    gives = [k for k, is_one in enumerate(are_reached) if is_one]
    program, takes = narrowed(made, gives)
    if plain is not None:
        if not set(range(first)) <= set(takes):
            # Whole arrays have entries that their results do not depend on, but which must be what
            # they are: zero times a derivative that is infinite at zero is NaN.
            _, needed = narrowed(plain.derived(make, operands, everything, gives).program)
            more = {k for k in needed if k < first}
            program, takes = narrowed(made, gives, sorted({*takes, *more}))
        plain = plain.derived(make, operands, takes, gives)
    linear = sum(k >= first for k in takes)
    return _Linear(program, plain, takes, linear, [places[k] for k in gives])


def _batch(operands, dims, *, program, kind, plain):
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    fixed = len(operands) - kind.linear
    if size <= MAX_ENTRIES["step"] and all(d is None for d in dims[:fixed]):
        # As for a Jacobian. Each on its own: in a program for all of them single numbers meet
        # arrays, and XLA would compute the former anew for every use.
        moving = [k for k, d in enumerate(dims) if d is not None]

        def one_by_one(*operands):
            def one(some):
                values = replaced(operands, moving, some)
                return operation_p.bind(*values, program=program, kind=kind, plain=plain)

            return lax.map(one, [jnp.moveaxis(operands[k], dims[k], 0) for k in moving])

        outs = one_by_one(*operands)
        out_dims = [0] * len(outs)
    else:
        is_long = sum(map(num_operations, program.jaxpr.eqns)) > FUNCTION
        if is_long and not kind.linear:
            # Single numbers, as the time of a step, that XLA would compute anew in each of its
            # functions: 100 ms for a step of a thousand bodies with `RKMK8`.
            single = [k for k, x in enumerate(operands) if dims[k] is None and is_inexact(x)]
            new = materialised([operands[k] for k in single]) if single else []
            operands = replaced(operands, single, new)
        batched, plain, out_dims = _batched(program, plain, tuple(dims), size)
        outs = operation_p.bind(*operands, program=batched, kind=kind, plain=plain)
    return outs, out_dims


@once_for_each_program
def _batched(
    program: ClosedJaxpr, plain: Plain | None, dims: tuple[int | None, ...], size: int
) -> tuple[ClosedJaxpr, Plain | None, list[int | None]]:
    operands = [
        x if d is None else jax.ShapeDtypeStruct((*x.shape[:d], size, *x.shape[d:]), x.dtype)
        for x, d in zip(structs(program.jaxpr.invars), dims, strict=True)
    ]
    are_reached = reached(program.jaxpr, [d is not None for d in dims])
    out_dims = [0 if is_one else None for is_one in are_reached]

    def batch_of(program):
        return jax.vmap(jaxpr_as_fun(program), in_axes=dims, out_axes=out_dims)

    def batch_of_plain(program):
        def batched(*values):
            outs = jax.vmap(jaxpr_as_fun(program), in_axes=dims)(*values)
            # Whole arrays may mix what the batch reaches with what it does not.
            first = [x[0] if size else jnp.zeros(x.shape[1:], x.dtype) for x in outs]
            return [x if d == 0 else y for x, y, d in zip(outs, first, out_dims, strict=True)]

        return batched

    if plain is not None:
        plain = plain.derived(batch_of_plain, operands, range(len(operands)), range(len(out_dims)))
    return program_of(batch_of(program), *operands), plain, out_dims


ad.primitive_jvps[operation_p] = _jvp
ad.primitive_transposes[operation_p] = _transpose
batching.primitive_batchers[operation_p] = _batch
