"""A step on single numbers instead of short vectors, and on one array for each of their entries.

XLA fuses numbers well and vectors of three badly: it computes what several entries need once for
each of them, or materialises it. So the program of a step is read, and evaluated again with
every small array as its entries. In a state with leading axes, many short vectors, the entries
are arrays of these axes.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import Array, PyTree

from .jaxprs import (
    CALLS,
    OPENED,
    OPENED_LAST,
    altered,
    are_among,
    evaluate,
    flattened,
    is_inexact,
    replaced,
    structs,
    without_constants,
    without_dead_code,
)
from .limits import (
    FLAT_MANY,
    FLAT_WHOLE,
    FUNCTION,
    MAX_ENTRIES,
    MAX_LENGTH,
    MAX_RESULTS_IN_BATCHES,
    MAX_SIZE,
)
from .materialise import materialised, materialised_p, together
from .over_stages import Loop, is_scalarised_p
from .rules import on_entries
from .scope import is_numeric, is_on, is_rows, is_short, unread, within
from .smooth import by_fixed, has_reciprocals, scaled_reciprocal
from .struct_of_arrays import (
    StructOfArrays,
    apart_like,
    is_small,
    is_small_shape,
    is_whole,
    literal,
    static_value,
    struct_of_arrays,
)
from .turns import in_parts, is_table, of_tables
from .understood import MOVES, REDUCTIONS, is_in_place, is_readable


def split(tree: PyTree, rows: bool = False) -> PyTree:
    """The tree, small arrays as scalars and with `rows` short vectors as structs of arrays."""

    def apart(x: Any) -> Any:
        return struct_of_arrays(x) if is_small(x) or (rows and is_rows(x)) else x

    return jtu.tree_map(apart, tree, is_leaf=_is_apart)


def join(tree: PyTree) -> PyTree:
    """The reverse of `split`."""
    return jtu.tree_map(_whole, tree, is_leaf=_is_apart)


def _is_apart(x: Any) -> bool:
    return isinstance(x, StructOfArrays)


def _whole(x: Any) -> Any:
    return x.whole() if _is_apart(x) else x


class Declined(Exception):
    """A program has something that is not to be scalarised."""


class Reading(NamedTuple):
    """The program of a function that can be scalarised.

    It takes what the function closes over first, but for what is known now. `shape` is that of its
    results. With `rows` its state has short vectors along leading axes.
    """

    program: ClosedJaxpr
    parameters: Sequence[Array]
    shape: PyTree
    rows: bool


def read(
    fun: Callable[[PyTree], PyTree], y: PyTree, max_entries: int = MAX_ENTRIES["step"]
) -> Reading | None:
    """The program of `fun` at `y`, which has at most so many entries.

    None if it does not pay or cannot be scalarised. It must have no effects and be readable
    (`is_readable`).
    """
    rows = _has_rows(y, max_entries)
    if not is_on() or not (rows or _is_small_state(y, max_entries)):
        return None
    with within():
        jaxpr, shape = jax.make_jaxpr(fun, return_shape=True)(y)
    try:
        code = without_dead_code(jaxpr.jaxpr)
        if jaxpr.effects or not is_readable(code):
            return None
        # All of it, or each turn of a loop over stages.
        scans = (eqn for eqn in code.eqns if eqn.primitive.name == "scan")
        loops = [eqn.params["jaxpr"].jaxpr for eqn in scans]
        if min(map(length, (code, *loops))) > FLAT_MANY:
            return None
    except Exception as error:
        return unread(error)
    return Reading(*_with_parameters(code, jaxpr.consts), shape, rows)


def _with_parameters(code: Jaxpr, consts: Sequence[Any]) -> tuple[ClosedJaxpr, list[Array]]:
    static, parameters = [], []
    for v, x in zip(code.constvars, consts, strict=True):
        (static if _is_static(x) else parameters).append((v, x))
    invars = [*(v for v, _ in parameters), *code.invars]
    code = altered(code, constvars=[v for v, _ in static], invars=invars)
    return ClosedJaxpr(code, [x for _, x in static]), [jnp.asarray(x) for _, x in parameters]


def on_numbers(
    program: ClosedJaxpr,
    fixed: Sequence[bool],
    operands: Sequence[Any],
    rows: bool,
    is_last: bool = True,
    is_cut: bool = False,
) -> list[Any]:
    """The results of a program, apart. So are its operands.

    `fixed` says which of them are the same in every step, and `is_last` whether nothing is
    differentiated any more. With `is_cut` each turn of a loop is a piece that reverse mode computes
    again, or several turns together where nothing is differentiated.
    """
    jaxpr = program.jaxpr
    is_long = length(jaxpr) > FLAT_WHOLE
    cut = None if not is_cut else "groups" if is_last else "turns"
    form = _Form(rows, is_long, cut, has_reciprocals(jaxpr, fixed), is_last, {}, {})
    outs, _ = _evaluate(program, operands, fixed, form)
    likes = jax.eval_shape(functools.partial(split, rows=rows), structs(program.out_avals))
    # What is known before the program runs may come out as NumPy's.
    outs = [x if _is_apart(x) else jnp.asarray(x) for x in outs]
    pairs = zip(likes, outs, strict=True)
    return [apart_like(like, x) if _is_apart(like) else _whole(x) for like, x in pairs]


def _is_small_state(y: PyTree, max_entries: int) -> bool:
    leaves = jtu.tree_leaves(y)
    return (
        any(map(is_short, leaves))
        and all(is_short(x) or (np.ndim(x) == 0 and is_numeric(x)) for x in leaves)
        and sum(map(np.size, leaves)) <= max_entries
    )


def _has_rows(y: PyTree, max_entries: int) -> bool:
    """Whether this is a state with short vectors along leading axes."""
    leaves = jtu.tree_leaves(y)
    return (
        any(map(is_rows, leaves))
        and all(map(is_numeric, leaves))
        and sum(map(_entries, map(np.shape, leaves))) <= max_entries
    )


def length(jaxpr: Jaxpr) -> float:
    """About how many operations on single numbers there will be, where nothing is left whole.

    Loops over stages are unrolled, and functions with a derivative of their own are opened.
    """
    return sum(map(_length_of, jaxpr.eqns))


def _length_of(eqn: JaxprEqn) -> float:
    name = eqn.primitive.name
    if name in OPENED_LAST:
        return length(eqn.params[CALLS[name]].jaxpr)
    if name == "scan":
        return eqn.params["length"] * length(eqn.params["jaxpr"].jaxpr)
    if name == "cond":
        return max(length(branch.jaxpr) for branch in eqn.params["branches"])
    if name == "while":
        return math.inf
    if name in MOVES:
        return 0
    terms = 1
    if name == "dot_general":
        left: Any = eqn.invars[0].aval
        (axes, _), _ = eqn.params["dimension_numbers"]
        terms = 2 * math.prod(left.shape[k] for k in axes)
        terms = terms if terms <= 2 * MAX_SIZE else 1
    elif name in REDUCTIONS:
        terms = _entries(getattr(eqn.invars[0].aval, "shape", ()))
    shapes: list[tuple[int, ...]] = [getattr(v.aval, "shape", ()) for v in eqn.outvars]
    return sum(terms * n for n in map(_entries, shapes))


def num_turns(jaxpr: Jaxpr) -> int:
    """The number of turns of the longest loop over stages, or 1."""
    calls = [eqn for eqn in jaxpr.eqns if eqn.primitive.name in OPENED_LAST]
    inner = [eqn.params[CALLS[eqn.primitive.name]].jaxpr for eqn in calls]
    loops = [eqn.params["length"] for eqn in jaxpr.eqns if eqn.primitive.name == "scan"]
    return max([1, *loops, *map(num_turns, inner)])


def _entries(shape: tuple[int, ...]) -> int:
    """About how many numbers or whole arrays an array is scalarised into, if it is."""
    if is_small_shape(shape):
        return math.prod(shape)
    return shape[-1] if len(shape) > 1 and shape[-1] <= MAX_LENGTH else 1


class _Form(NamedTuple):
    """How a program is scalarised."""

    rows: bool  # It has arrays with leading axes.
    is_long: bool  # Too long for one function of XLA's.
    # "turns": each turn of a loop is a piece that reverse mode computes again. "groups": what
    # several turns carry is materialised.
    cut: str | None
    has_reciprocals: bool  # In the place of divisions by what is fixed.
    is_last: bool  # Nothing is differentiated any more.
    literals: dict[Any, Any]  # Each is made once.
    in_memory: dict[int, Any]  # What is materialised already, by its identity.


def _evaluate(
    program: ClosedJaxpr, operands: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """The results of a program, and whether each is fixed: depends on fixed operands alone."""
    jaxpr, consts = program.jaxpr, map(_constant, program.consts)
    varying = set(itertools.compress(jaxpr.invars, (not x for x in fixed)))
    env: dict[Any, Any] = {}
    for v, x in zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *operands), strict=True):
        is_array = isinstance(x, np.ndarray) and x.ndim > 0
        env[v] = struct_of_arrays(x) if is_array or is_small(x) else x

    def read(v: Any) -> Any:
        if not isinstance(v, Literal):
            return env[v]
        aval: Any = v.aval
        value = np.asarray(v.val)
        key = value.tobytes(), value.dtype, aval.dtype
        if key not in form.literals:
            form.literals[key] = literal(v)
        return form.literals[key]

    # Each reciprocal once.
    divisors: dict[int, tuple[Any, Any, Any]] = {}
    for eqn in jaxpr.eqns:
        values = list(map(read, eqn.invars))
        fixed = [not x for x in are_among(eqn.invars, varying)]
        outs_fixed = [all(fixed)] * len(eqn.outvars)
        name = eqn.primitive.name
        if name in (OPENED_LAST if form.is_last else OPENED):
            outs, outs_fixed = _evaluate(eqn.params[CALLS[name]], values, fixed, form)
        elif eqn.primitive is is_scalarised_p:
            # In a derivative, what is computed again at the end of a step that fails would be zero
            # times NaN.
            outs = [np.asarray(eqn.params["in_derivatives"] or form.is_last)]
        elif name == "scan":
            outs, outs_fixed = _unrolled(Loop.of(eqn), values, fixed, form)
        elif name == "cond":
            which = static_value(values[0])
            if which is None:
                raise Declined
            # As XLA does with a number that is none of a branch.
            branches = eqn.params["branches"]
            branch = branches[min(max(int(which), 0), len(branches) - 1)]
            outs, outs_fixed = _evaluate(branch, values[1:], fixed[1:], form)
        elif form.has_reciprocals and by_fixed(eqn, fixed):
            x, divisor = values
            if id(divisor) not in divisors:
                # With the divisor, so that it is not forgotten and its identity used again.
                divisors[id(divisor)] = *scaled_reciprocal(divisor), divisor
            scale, reciprocal, _ = divisors[id(divisor)]
            eqn = eqn.replace(primitive=lax.mul_p, params=_PARAMETERS_OF_A_PRODUCT)
            outs = _results(eqn, [x, scale], fixed, form)
            outs = _results(eqn, [*outs, reciprocal], fixed, form)
        else:
            outs = _results(eqn, values, fixed, form)
        env.update(zip(eqn.outvars, outs, strict=True))
        varying.update(v for v, x in zip(eqn.outvars, outs_fixed, strict=True) if not x)
    return list(map(read, jaxpr.outvars)), [not x for x in are_among(jaxpr.outvars, varying)]


def _unrolled(
    loop: Loop, operands: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """The results of a loop, one turn after the other."""
    n, m = loop.num_constants, loop.num_constants + loop.num_carried
    carry = operands[n:m]
    # What is fixed in the first turn need not be so in the next.
    flags = [*fixed[:n], *[False] * len(carry), *fixed[m:]]
    ys: dict[int, list[Any]] = {}
    outs_fixed: list[bool] = []
    run = _in_parts if form.cut == "turns" else _evaluate
    group, size = 0, length(loop.body.jaxpr)
    for k in loop.turns:
        turn = [_entry(x, k) for x in operands[m:]]
        outs, outs_fixed = run(loop.body, [*operands[:n], *carry, *turn], flags, form)
        carry, ys[k] = outs[: m - n], outs[m - n :]
        if form.cut == "groups":
            group += 1
            traced = {id(x) for x in jtu.tree_leaves(carry) if isinstance(x, Tracer)}
            num_new = len(traced - {*form.in_memory})
            # With one turn more.
            is_full = (group + 1) * size > FUNCTION
            if is_full or (group + 1) * num_new > group * MAX_RESULTS_IN_BATCHES:
                carry, group = _entries_materialised(carry, form.in_memory), 0
                form.in_memory.update((id(x), x) for x in jtu.tree_leaves(carry))
    stacks = map(_stacked, zip(*(ys[k] for k in sorted(ys)), strict=True))
    # It is the same in every turn.
    return [*carry, *stacks], [*[False] * len(carry), *outs_fixed[m - n :]]


def _in_parts(
    program: ClosedJaxpr, operands: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """A turn, of which reverse mode keeps what goes in and comes out, and computes the rest again.

    These are materialised, so that what XLA computes at once is about one turn.
    """
    program = flattened(program, OPENED)
    jaxpr, consts = without_constants(program).jaxpr, list(map(_constant, program.consts))
    operands, fixed = [*consts, *operands], [*[True] * len(consts), *fixed]
    are_tables = is_table
    if form.rows:
        # The points along the other axes are not those of stages.
        pairs = zip(jaxpr.invars, operands, strict=True)
        are_tables = of_tables(jaxpr, [v for v, x in pairs if _is_apart(x) and x.is_table])

    def on_vectors(part: Jaxpr, operands: Sequence[Any], fixed: Sequence[bool]) -> Any:
        operands = _entries_materialised(operands, {})
        return _again(part, operands, fixed, form, list(map(are_tables, part.outvars)))

    def on_tables(part: Jaxpr, operands: Sequence[Any], fixed: Sequence[bool]) -> Any:
        return _evaluate(ClosedJaxpr(part, []), operands, fixed, form)

    return in_parts(jaxpr, operands, fixed, on_vectors, on_tables, are_tables)


def _entries_materialised(values: Sequence[Any], in_memory: dict[int, Any]) -> list[Any]:
    """The same, with all numbers and entries materialised together that are not `in_memory`."""
    apart = [k for k, x in enumerate(values) if not is_whole(x)]
    leaves, structure = jtu.tree_flatten([values[k] for k in apart])
    traced = {id(x): x for x in leaves if isinstance(x, Tracer) and id(x) not in in_memory}
    new = dict(zip(traced, together(list(traced.values())), strict=True))
    return replaced(values, apart, structure.unflatten([new.get(id(x), x) for x in leaves]))


def _again(
    jaxpr: Jaxpr,
    operands: Sequence[Any],
    fixed: Sequence[bool],
    form: _Form,
    are_tables: Sequence[bool],
) -> tuple[list[Any], list[bool]]:
    """The results of a program, which reverse mode computes again."""
    leaves, structure = jtu.tree_flatten(list(operands))
    traced = [k for k, x in enumerate(leaves) if isinstance(x, Tracer)]
    static: Any = None

    def run(residuals: list[Any]) -> list[Any]:
        nonlocal static
        operands = structure.unflatten(replaced(leaves, traced, residuals))
        inner = form._replace(literals={}, in_memory={})
        outs, outs_fixed = _evaluate(ClosedJaxpr(jaxpr, []), operands, fixed, inner)
        single = [k for k, x in enumerate(outs_fixed) if not (x or are_tables[k])]
        new = _entries_materialised([outs[k] for k in single], inner.in_memory)
        entries, shape = jtu.tree_flatten(replaced(outs, single, new))
        places = [k for k, x in enumerate(entries) if isinstance(x, Tracer)]
        static = replaced(entries, places, [None] * len(places)), places, shape, outs_fixed
        return [entries[k] for k in places]

    new = jax.checkpoint(run)([leaves[k] for k in traced])
    entries, places, shape, outs_fixed = static
    return shape.unflatten(replaced(entries, places, new)), outs_fixed


def _entry(x: Any, k: int) -> Any:
    """Entry k along the first axis."""
    if not _is_apart(x):
        return x[k]
    places = x.places[k]
    return x.at(places, x.shape[1:], x.is_short[1:]) if x.shape[1:] else x.entries[int(places)]


def _stacked(rows: Sequence[Any]) -> Any:
    """Rows along a new first axis."""
    if any(map(is_whole, rows)):
        return jnp.stack(list(map(_whole, rows)))
    parts = list(map(struct_of_arrays, rows))
    return StructOfArrays([e for x in parts for e in x.entries], (len(parts), *parts[0].shape))


def _is_static(x: Any) -> bool:
    """Whether a constant is known now, as an array of indices, and all that is none of JAX's."""
    if not isinstance(x, jax.Array):
        return True
    is_traced = isinstance(x, Tracer)
    return not (is_traced or x.size > MAX_SIZE or is_inexact(x)) and is_numeric(x)


def _constant(x: Any) -> Any:
    """A constant of a program: known, if it is no array of JAX's."""
    if isinstance(x, jax.Array):
        return np.asarray(x) if _is_static(x) else x
    if not is_numeric(x) or not is_inexact(np.asarray(x)):
        return x
    # As JAX's, which may overflow.
    if np.ndim(x) == 0 or np.size(x) > _MAX_STATIC or is_rows(x):
        return jnp.asarray(x)
    return StructOfArrays(list(map(jnp.asarray, np.ravel(x))), np.shape(x))


# As of the weights of a method of 16 stages.
_MAX_STATIC = 4 * MAX_SIZE
# As a version of JAX has them.
_PARAMETERS_OF_A_PRODUCT = jax.make_jaxpr(lax.mul)(1.0, 1.0).jaxpr.eqns[0].params


def _results(eqn: JaxprEqn, values: list[Any], fixed: Sequence[bool], form: _Form) -> Sequence[Any]:
    """The results of one operation: scalarised, if there is a rule for it."""
    if eqn.primitive is materialised_p:
        if eqn.params["is_cut"] and not form.is_long:
            return values
        leaves, structure = jtu.tree_flatten(values)
        new = materialised(leaves, **eqn.params)
        form.in_memory.update((id(x), x) for x in new)
        return structure.unflatten(new)
    outs = on_entries(eqn, values, fixed, form.rows)
    if outs is None and is_in_place(eqn):
        raise Declined
    return list(map(split, evaluate(eqn, list(map(_whole, values))))) if outs is None else outs
