"""A program as one operation of JAX, whose first derivative is such an operation too.

A derivative of a program of scalars has several times its operations. It becomes a program of its
own here, so that when it is compiled its length is known. A long program is a sequence of pieces,
between which few values are on their way, and its derivatives are sequences of derivatives of the
pieces. What is too long for one of XLA's functions is compiled as several, which materialise
these values.

A derivative that would take too long to compile is JAX's own of the program as it was before it was
scalarised (`_Plain`).
"""

import functools
import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import (
    ClosedJaxpr,
    DropVar,
    Jaxpr,
    JaxprEqn,
    Literal,
    Primitive,
    jaxpr_as_fun,
    jaxprs_in_params,
)
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from .materialise import materialised
from .pack import pack_p, unpack_p
from .scope import Place

# What two of its functions need, XLA computes in both, and into one it puts some 2000 operations.
# In long programs it then computes single ones exponentially often: in values never as measured, in
# first derivatives from some 8000 operations on, counted as they are written, within diffrax's loop
# from 4000, in batches from 5000, and in second ones earlier. Those are compiled as several, though
# to materialise what they share takes time.
_WHOLE = {"loop": (math.inf, 6000, 3000), "step": (math.inf, 3500, 3000)}
_WHOLE_IN_BATCHES = (math.inf, 4500, 3000)
_GROUP = 1000
# A derivative has up to five times the operations, and should fit.
_PIECE = 250
# Of so many directions each is computed on its own.
_FEW = 16

_FREE = frozenset(
    "broadcast_in_dim reshape squeeze slice transpose copy convert_element_type".split()
)


def operation(
    fun: Callable[..., PyTree],
    *args: PyTree,
    place: Place,
    is_batch: bool = False,
    plain: Callable[..., PyTree] | None = None,
    order: int = 1,
) -> PyTree:
    """`fun(*args)`, as one operation, of a batch if it is one already.

    `fun` may close over traced values, and has no effects. Reverse mode keeps the arguments and
    computes everything again, as with `jax.checkpoint`. `plain` is the same function before it was
    scalarised, and closes over nothing that is traced: derivatives beyond `order` are of that.
    """
    leaves, structure = jtu.tree_flatten(args)
    leaves = list(map(jnp.asarray, leaves))
    out_structure: Any = None

    def of_leaves(*leaves):
        nonlocal out_structure
        out = fun(*jtu.tree_unflatten(structure, leaves))
        out, out_structure = jtu.tree_flatten(jtu.tree_map(jnp.asarray, out))
        return out

    made = jax.make_jaxpr(of_leaves)(*leaves)
    operands = [*map(jnp.asarray, made.consts), *leaves]
    code = made.jaxpr.replace(
        constvars=[],
        invars=[*made.jaxpr.constvars, *made.jaxpr.invars],
        debug_info=made.jaxpr.debug_info.with_unknown_names(),
    )
    # Integers, as the number of a step, are on their own: no derivative is of them, and a transpose
    # of what is linear has their values.
    is_smooth = [_is_inexact(v.aval) for v in code.outvars]
    smooth = [k for k, is_one in enumerate(is_smooth) if is_one]
    whole = [k for k, is_one in enumerate(is_smooth) if not is_one]
    outs: list[Any] = [None] * len(code.outvars)
    exact, takes = _narrowed(ClosedJaxpr(code, []), whole)
    outs = _with(outs, whole, jaxpr_as_fun(exact)(*(operands[k] for k in takes)))

    kind = _Kind(place, is_batch=is_batch, last=order)
    code = without_dead_code(code.replace(outvars=[code.outvars[k] for k in smooth]))
    program = ClosedJaxpr(code, [])
    ends = _places(code)
    if len(ends) > 2:
        pieces = functools.partial(_in_pieces, program, ends, kind)
        program = _program(pieces, *_structs(code.invars))
    is_closed = not any(isinstance(x, Tracer) for x in made.consts)
    before = None
    if plain is not None and is_closed:

        def of_plain_leaves(*operands):
            # What comes first are constants of the program that was scalarised.
            leaves = operands[len(operands) - structure.num_leaves :]
            outs = jtu.tree_leaves(plain(*jtu.tree_unflatten(structure, leaves)))
            return [outs[k] for k in smooth]

        before = _Plain(of_plain_leaves, _structs(code.invars))
    outs = _with(
        outs, smooth, operation_p.bind(*operands, program=program, kind=kind, plain=before)
    )
    return jtu.tree_unflatten(out_structure, outs)


class _Plain:
    """The program of an operation before it was scalarised. It is traced if it is needed."""

    def __init__(self, fun: Callable[..., Sequence[Array]], operands: Sequence[Any]):
        self.fun, self.operands = fun, operands

    @functools.cached_property
    def program(self) -> ClosedJaxpr:
        return _program(lambda *leaves: [jnp.asarray(x) for x in self.fun(*leaves)], *self.operands)

    def derived(
        self,
        make: Callable[[ClosedJaxpr], Callable[..., Sequence[Array]]],
        operands: Sequence[Any],
        takes: Sequence[int],
        gives: Sequence[int],
    ) -> "_Plain":
        """What `make` makes of the program, for some of its operands and results.

        The results depend on no other operands.
        """

        def fun(*taken: Array) -> list[Array]:
            values = [jnp.zeros(x.shape, x.dtype) for x in operands]
            for k, x in zip(takes, taken, strict=True):
                values[k] = x
            outs = make(self.program)(*values)
            return [outs[k] for k in gives]

        return _Plain(fun, [operands[k] for k in takes])


def _places(jaxpr: Jaxpr) -> list[int]:
    """The ends of pieces of a program, where few values are on their way."""
    n = len(jaxpr.eqns)
    last = dict.fromkeys(variables(jaxpr.outvars), n)
    for k, eqn in reversed(list(enumerate(jaxpr.eqns))):
        for v in variables(eqn.invars):
            last.setdefault(v, k)
    change = np.zeros(n + 2, int)
    for k, eqn in enumerate(jaxpr.eqns):
        for v in eqn.outvars:
            if v in last:
                change[k + 1] += 1
                change[last[v] + 1] -= 1
    live = np.cumsum(change)[:n]
    progress = np.cumsum([0, *map(_length, jaxpr.eqns)])
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


def _length(eqn: JaxprEqn) -> int:
    """How many operations on numbers or whole arrays."""
    if eqn.primitive.name in _CALLS:
        return sum(map(_length, eqn.params[_CALLS[eqn.primitive.name]].eqns))
    return 0 if eqn.primitive.name in _FREE or eqn.primitive in (pack_p, unpack_p) else 1


def _in_pieces(
    program: ClosedJaxpr, ends: Sequence[int], kind: "_Kind", *operands: Array
) -> list[Array]:
    jaxpr = program.jaxpr
    env = dict(zip(jaxpr.invars, operands, strict=True))
    for start, stop in itertools.pairwise(ends):
        part, taken, given = _part(jaxpr, start, stop)
        outs = operation_p.bind(*(env[v] for v in taken), program=part, kind=kind, plain=None)
        env.update(zip(given, outs, strict=True))
    return _results(jaxpr, env)


def _part(jaxpr: Jaxpr, start: int, stop: int) -> tuple[ClosedJaxpr, list[Any], list[Any]]:
    """Some operations of a program, what they take from those before, and give to those after."""
    eqns = jaxpr.eqns[start:stop]
    made = {v for e in eqns for v in e.outvars}
    taken = dict.fromkeys(v for e in eqns for v in variables(e.invars) if v not in made)
    later = [v for e in jaxpr.eqns[stop:] for v in variables(e.invars)]
    given = dict.fromkeys(v for v in (*later, *variables(jaxpr.outvars)) if v in made)
    part = jaxpr.replace(
        eqns=eqns,
        constvars=[],
        invars=list(taken),
        outvars=list(given),
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return ClosedJaxpr(part, []), list(taken), list(given)


def _results(jaxpr: Jaxpr, env: dict[Any, Any]) -> list[Any]:
    return [_read(v, env) for v in jaxpr.outvars]


def _read(v: Any, env: dict[Any, Any]) -> Any:
    aval: Any = v.aval
    return jnp.asarray(v.val, aval.dtype) if isinstance(v, Literal) else env[v]


def without_dead_code(jaxpr: Jaxpr) -> Jaxpr:
    """Only what the results need."""
    wanted = set(variables(jaxpr.outvars))
    kept = []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not wanted.isdisjoint(eqn.outvars):
            if eqn.primitive is operation_p:
                eqn = _pruned(eqn, wanted)
            kept.append(eqn)
            wanted.update(variables(eqn.invars))
    return jaxpr.replace(eqns=kept[::-1])


def _pruned(eqn: JaxprEqn, wanted: set[Any]) -> JaxprEqn:
    """An operation that gives only what is wanted."""
    gives = [k for k, v in enumerate(eqn.outvars) if v in wanted]
    kind, size = eqn.params["kind"], len(eqn.invars)
    program, takes = _narrowed(eqn.params["program"], gives)
    linear = sum(k >= size - kind.linear for k in takes)
    return eqn.replace(
        invars=[eqn.invars[k] for k in takes],
        outvars=[eqn.outvars[k] for k in gives],
        params={"program": program, "kind": kind._replace(linear=linear), "plain": None},
    )


def _narrowed(program: ClosedJaxpr, gives: Sequence[int]) -> tuple[ClosedJaxpr, list[int]]:
    """A program for some of the results, and the operands that it needs for that."""
    jaxpr = program.jaxpr
    names = jaxpr.debug_info.with_unknown_names()
    code = without_dead_code(
        jaxpr.replace(outvars=[jaxpr.outvars[k] for k in gives], debug_info=names)
    )
    used = {v for e in code.eqns for v in variables(e.invars)} | set(variables(code.outvars))
    takes = [k for k, v in enumerate(code.invars) if v in used]
    code = code.replace(invars=[code.invars[k] for k in takes], debug_info=names)
    return ClosedJaxpr(code, program.consts), takes


def variables(atoms: Iterable[Any]) -> list[Any]:
    return [v for v in atoms if not isinstance(v, Literal)]


class _Kind(NamedTuple):
    """Where it runs, how many of the last operands it is linear in, which derivative it is, whether
    it is of a batch, and up to which derivative there are operations.
    """

    place: Place
    linear: int = 0
    order: int = 0
    is_batch: bool = False
    last: int = 1


operation_p = Primitive("cfjax_operation")
operation_p.multiple_results = True


@operation_p.def_impl
def _run(*operands, program, kind, plain):
    order = min(kind.order, 2)
    most = _WHOLE[kind.place][order]
    if kind.is_batch:
        most = min(most, _WHOLE_IN_BATCHES[order])
    groups = _groups(program, most)
    # Of a second derivative there are several in one loop.
    if len(groups) == 1 and kind.order < 2:
        return _flattened(program, *operands)
    jaxpr = program.jaxpr
    env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*program.consts, *operands), strict=True))
    # Together with the operands, so that no other operation shares what is computed from them.
    smooth = [v for v in jaxpr.invars if _is_inexact(env[v])]
    new = materialised([env[v] for v in smooth], in_batches=True)
    env.update(zip(smooth, new, strict=True))
    for start, stop in groups:
        part, taken, given = _part(jaxpr, start, stop)
        outs = _flattened(part, *(env[v] for v in taken))
        smooth = [k for k, x in enumerate(outs) if _is_inexact(x)]
        if smooth and stop < len(jaxpr.eqns):
            for k, x in zip(
                smooth, materialised([outs[k] for k in smooth], in_batches=True), strict=True
            ):
                outs[k] = x
        env.update(zip(given, outs, strict=True))
    return _results(jaxpr, env)


def _groups(program: ClosedJaxpr, most: int | float) -> list[tuple[int, int]]:
    """Pieces that are compiled together, by their ends."""
    eqns = program.jaxpr.eqns
    n = len(eqns)
    if not any(e.primitive is operation_p for e in eqns) or sum(map(_length, eqns)) <= most:
        return [(0, n)]
    ends, size = [0], 0
    for k, e in enumerate(eqns):
        more = _length(e)
        if size and size + more > _GROUP:
            ends.append(k)
            size = 0
        size += more
    return list(itertools.pairwise([*ends, n]))


# Nothing is differentiated any more, so rules for that are not needed either.
_CALLS = {
    "cfjax_operation": "program",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


def _flattened(program: ClosedJaxpr, *operands: Array) -> list[Array]:
    """The program without calls, and with everything once that is computed alike."""
    # With the operands, so that none of them is forgotten and its identity used again.
    known: dict[Any, tuple[list[Any], Sequence[Any]]] = {}

    def run(program: ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
        jaxpr = program.jaxpr
        names = *jaxpr.constvars, *jaxpr.invars
        env = dict(zip(names, (*program.consts, *operands), strict=True))
        for eqn in jaxpr.eqns:
            name = eqn.primitive.name
            if name in _CALLS:
                outs = run(eqn.params[_CALLS[name]], [_read(v, env) for v in eqn.invars])
            else:
                keys = (
                    # Every bit: as text, numbers that agree in eight digits would be one.
                    (str(v.aval), np.asarray(v.val).tobytes())
                    if isinstance(v, Literal)
                    else id(env[v])
                    for v in eqn.invars
                )
                dropped = [isinstance(v, DropVar) for v in eqn.outvars]
                key = eqn.primitive, *keys, *dropped, parameters(eqn)
                if key not in known:
                    values = [_read(v, env) for v in eqn.invars]
                    known[key] = values, evaluate(jaxpr, eqn, values)
                _, outs = known[key]
            env.update(zip(eqn.outvars, outs, strict=True))
        return _results(jaxpr, env)

    return run(program, operands)


def parameters(eqn: JaxprEqn) -> Hashable:
    """What tells the operation from others on the same operands."""
    values = tuple(sorted(eqn.params.items(), key=lambda item: item[0]))
    try:
        hash(values)
    except TypeError:
        return object()  # Equal to no other, so such operations are never merged.
    return values


def evaluate(jaxpr: Jaxpr, eqn: JaxprEqn, values: Sequence[Any]) -> Sequence[Any]:
    """The results of one operation of a program; None for those that are dropped."""
    # Most are of this kind, and the other way makes a program of each.
    if not eqn.primitive.multiple_results and not any(jaxprs_in_params(eqn.params)):
        return [eqn.primitive.bind(*values, **eqn.params)]
    known = {v: x for v, x in zip(eqn.invars, values, strict=True) if not isinstance(v, Literal)}
    # JAX's own evaluator knows how every operation is called, in every version of JAX.
    alone = jaxpr.replace(
        constvars=[],
        invars=list(known),
        outvars=[v for v in eqn.outvars if not isinstance(v, DropVar)],
        eqns=[eqn],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    outs = iter(jaxpr_as_fun(ClosedJaxpr(alone, []))(*known.values()))
    return [None if isinstance(v, DropVar) else next(outs) for v in eqn.outvars]


# Where newer versions of JAX put types of their own within, they take them out first.
operation_p.to_lojax = lambda *operands, program, **_: jaxpr_as_fun(program)(*operands)


def _is_inexact(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


@operation_p.def_abstract_eval
def _(*operands, program, **_):
    return [v.aval for v in program.jaxpr.outvars]


def _jvp(primals, tangents, *, program, kind, plain):
    moving = [
        k
        for k, (x, tangent) in enumerate(zip(primals, tangents, strict=True))
        if type(tangent) is not ad.Zero and _is_inexact(x)
    ]
    if moving and plain is not None and kind.order >= kind.last:
        return _plain_jvp(plain, primals, tangents, moving)
    outs = operation_p.bind(*primals, program=program, kind=kind, plain=plain)
    smooth = [k for k, x in enumerate(outs) if _is_inexact(x)]
    out_tangents: list[Any] = [ad.Zero(v.aval.to_tangent_aval()) for v in program.jaxpr.outvars]
    if moving and smooth:
        derivative = _tangent(program, plain, tuple(moving), tuple(smooth))
        moved = (tangents[k] for k in moving)
        new = derivative.bind([*primals, *moved], kind._replace(order=kind.order + 1))
        for k, tangent in zip(derivative.gives, new, strict=True):
            out_tangents[k] = tangent
    return outs, out_tangents


def _plain_jvp(
    plain: _Plain, primals: Sequence[Any], tangents: Sequence[Any], moving: Sequence[int]
) -> tuple[Sequence[Any], list[Any]]:
    def along(*some):
        outs = jaxpr_as_fun(plain.program)(*_with(primals, moving, some))
        smooth = [x for x in outs if _is_inexact(x)]
        return smooth, outs

    points, ways = (tuple(xs[k] for k in moving) for xs in (primals, tangents))
    _, moved, outs = jax.jvp(along, points, ways, has_aux=True)
    moved = iter(moved)
    return outs, [
        next(moved) if _is_inexact(x) else ad.Zero(jax.typeof(x).to_tangent_aval()) for x in outs
    ]


def _with(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    values = list(values)
    for k, x in zip(places, new, strict=True):
        values[k] = x
    return values


@functools.lru_cache(maxsize=256)
def _tangent(
    program: ClosedJaxpr, plain: _Plain | None, moving: Sequence[int], smooth: Sequence[int]
) -> "_Linear":
    n = len(program.jaxpr.invars)

    def tangent_of(program):
        def tangent(*values):
            def along(*some):
                outs = jaxpr_as_fun(program)(*_with(values[:n], moving, some))
                return [outs[k] for k in smooth]

            return jax.jvp(along, tuple(values[k] for k in moving), values[n:])[1]

        return tangent

    operands = _structs(program.jaxpr.invars)
    operands = [*operands, *(operands[k] for k in moving)]
    return _linear(tangent_of, program, plain, operands, n, smooth)


def _transpose(cotangents, *operands, program, kind, plain):
    unknown = tuple(k for k, x in enumerate(operands) if ad.is_undefined_primal(x))
    coming = tuple(k for k, x in enumerate(cotangents) if type(x) is not ad.Zero)
    results: list[Any] = [None] * len(operands)
    if coming:
        transposed = _transposed(program, plain, unknown, coming)
        fixed = (x for k, x in enumerate(operands) if k not in unknown)
        come = (cotangents[k] for k in coming)
        new = transposed.bind([*fixed, *come], kind)
        for k, x in zip(transposed.gives, new, strict=True):
            results[k] = x
    return results


@functools.lru_cache(maxsize=256)
def _transposed(
    program: ClosedJaxpr, plain: _Plain | None, linear: Sequence[int], coming: Sequence[int]
) -> "_Linear":
    structs = _structs(program.jaxpr.invars)
    fixed = [k for k in range(len(structs)) if k not in linear]

    def transpose_of(program):
        def transposed(*values):
            known = dict(zip(fixed, values, strict=False))

            def forward(*some):
                operands = known | dict(zip(linear, some, strict=True))
                outs = jaxpr_as_fun(program)(*(operands[k] for k in range(len(structs))))
                return [outs[k] for k in coming]

            back = jax.linear_transpose(forward, *(structs[k] for k in linear))
            return back(list(values[len(fixed) :]))

        return transposed

    cotangents = _structs([program.jaxpr.outvars[k] for k in coming])
    operands = [*(structs[k] for k in fixed), *cotangents]
    return _linear(transpose_of, program, plain, operands, len(fixed), linear)


class _Linear(NamedTuple):
    """A program that is linear in its last operands."""

    program: ClosedJaxpr
    plain: _Plain | None
    takes: list[int]
    linear: int
    gives: list[int]

    def bind(self, operands: Sequence[Any], kind: _Kind) -> list[Any]:
        taken = (operands[k] for k in self.takes)
        kind = kind._replace(linear=self.linear)
        return operation_p.bind(*taken, program=self.program, kind=kind, plain=self.plain)


def _linear(
    make: Callable[[ClosedJaxpr], Callable[..., Sequence[Array]]],
    program: ClosedJaxpr,
    plain: _Plain | None,
    operands: Sequence[Any],
    first: int,
    places: Sequence[int],
) -> _Linear:
    """What `make` makes of a program, linear in operands from `first` on, without what is zero."""
    made = _program(make(program), *operands)
    reached = _reached(made.jaxpr, made.jaxpr.invars[first:])
    outs = enumerate(made.jaxpr.outvars)
    gives = [k for k, v in outs if not isinstance(v, Literal) and v in reached]
    program, takes = _narrowed(made, gives)
    plain = None if plain is None else plain.derived(make, operands, takes, gives)
    return _Linear(
        program, plain, takes, sum(k >= first for k in takes), [places[k] for k in gives]
    )


def _reached(jaxpr: Jaxpr, sources: Iterable[Any]) -> set[Any]:
    """The variables whose values may depend on some of the operands."""
    reached = set(sources)
    for eqn in jaxpr.eqns:
        if eqn.primitive is operation_p:
            inner = eqn.params["program"].jaxpr
            pairs = zip(inner.invars, eqn.invars, strict=True)
            given = [v for v, x in pairs if not isinstance(x, Literal) and x in reached]
            within = _reached(inner, given)
            pairs = zip(eqn.outvars, inner.outvars, strict=True)
            reached.update(v for v, x in pairs if not isinstance(x, Literal) and x in within)
        elif not reached.isdisjoint(variables(eqn.invars)):
            reached.update(eqn.outvars)
    return reached


def _batch(operands, dims, *, program, kind, plain):
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    fixed = len(operands) - kind.linear
    if size <= _FEW and all(d is None for d in dims[:fixed]):
        # As for a Jacobian: in a program for all of them single numbers meet arrays, and XLA would
        # compute the former anew for every use.
        moving = [k for k, d in enumerate(dims) if d is not None]

        def one(some):
            given = dict(enumerate(operands)) | dict(zip(moving, some, strict=True))
            values = (given[k] for k in range(len(operands)))
            return operation_p.bind(*values, program=program, kind=kind, plain=plain)

        outs = lax.map(one, [jnp.moveaxis(operands[k], dims[k], 0) for k in moving])
        out_dims = [0] * len(outs)
    else:
        batched, plain, out_dims = _batched(program, plain, tuple(dims), size)
        kind = kind._replace(is_batch=True)
        outs = operation_p.bind(*operands, program=batched, kind=kind, plain=plain)
    return outs, out_dims


@functools.lru_cache(maxsize=256)
def _batched(
    program: ClosedJaxpr, plain: _Plain | None, dims: tuple[int | None, ...], size: int
) -> tuple[ClosedJaxpr, _Plain | None, list[int | None]]:
    structs = [
        x if d is None else jax.ShapeDtypeStruct((*x.shape[:d], size, *x.shape[d:]), x.dtype)
        for x, d in zip(_structs(program.jaxpr.invars), dims, strict=True)
    ]
    jaxpr = program.jaxpr
    moving = (v for v, d in zip(jaxpr.invars, dims, strict=True) if d is not None)
    reached = _reached(jaxpr, moving)
    out_dims = [0 if not isinstance(v, Literal) and v in reached else None for v in jaxpr.outvars]

    def batch_of(program):
        return jax.vmap(jaxpr_as_fun(program), in_axes=dims, out_axes=out_dims)

    if plain is not None:
        plain = plain.derived(batch_of, structs, range(len(structs)), range(len(out_dims)))
    return _program(batch_of(program), *structs), plain, out_dims


def _program(fun: Callable[..., Sequence[Array]], *structs: Any) -> ClosedJaxpr:
    made = jax.make_jaxpr(fun)(*structs)
    return ClosedJaxpr(without_dead_code(made.jaxpr), made.consts)


def _structs(atoms: Sequence[Any]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in atoms]


ad.primitive_jvps[operation_p] = _jvp
ad.primitive_transposes[operation_p] = _transpose
batching.primitive_batchers[operation_p] = _batch
mlir.register_lowering(operation_p, mlir.lower_fun(_run, multiple_results=True))
