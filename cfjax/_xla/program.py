"""A step on single numbers instead of short vectors, and on one array for each of their entries.

XLA fuses numbers well and vectors of three badly: it computes what several entries need once for
each of them, or materialises it. So the program of a step is read, and evaluated again with
every small array as its entries. In a state with leading axes, many short vectors, the entries
are arrays of these axes.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import (
    ClosedJaxpr,
    Jaxpr,
    JaxprEqn,
    Literal,
)
from jaxtyping import Array, PyTree

from .jaxprs import (
    altered,
    evaluate,
    flattened,
    replaced,
    structs_of,
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
from .scope import (
    is_numeric,
    is_on,
    is_rows,
    is_short,
    unread,
    within,
)
from .smooth import by_fixed, has_reciprocals, scaled_reciprocal
from .struct_of_arrays import (
    StructOfArrays,
    apart_like,
    is_inexact,
    is_small,
    is_small_shape,
    is_whole,
    known,
    literal,
    struct_of_arrays,
)
from .turns import in_parts, is_table, of_tables
from .understood import MOVES, REDUCTIONS, is_in_place, is_readable

# Calls that are scalarised as a part of the program.
_CALLS = {"jit": "jaxpr", "pjit": "jaxpr"}
# Where nothing is differentiated any more, rules for that are not needed either.
_LAST_CALLS = _CALLS | {"custom_jvp_call": "call_jaxpr"}


def split(tree: PyTree, rows: bool = False) -> PyTree:
    """The tree, small arrays as scalars and with `rows` short vectors as structs of arrays."""

    def apart(x: Any) -> Any:
        return struct_of_arrays(x) if is_small(x) or (rows and is_rows(x)) else x

    return jtu.tree_map(apart, tree, is_leaf=_is_apart)


def split_like(other: PyTree, tree: PyTree) -> PyTree:
    """The tree scalarised as another one of its structure, shapes and dtypes is."""

    def apart(like: Any, x: Any) -> Any:
        return apart_like(like, x) if _is_apart(like) else _whole(x)

    return jtu.tree_map(apart, other, tree, is_leaf=_is_apart)


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
    fun: Callable[[PyTree], PyTree],
    y: PyTree,
    most: int = MAX_ENTRIES["step"],
) -> Reading | None:
    """The program of `fun` at `y`, which has at most so many entries.

    None if it does not pay or cannot be scalarised. It must have no effects and be readable
    (`is_readable`).
    """
    rows = _has_rows(y, most)
    if not is_on() or not (rows or _is_small_state(y, most)):
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
    known, given = [], []
    for pair in zip(code.constvars, consts, strict=True):
        is_known = not isinstance(pair[1], jax.Array) or _known_constant(pair[1]) is not None
        (known if is_known else given).append(pair)
    variables = [v for v, _ in given]
    code = altered(code, constvars=[v for v, _ in known], invars=[*variables, *code.invars])
    return ClosedJaxpr(code, [x for _, x in known]), [jnp.asarray(x) for _, x in given]


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
    jaxpr, consts = program.jaxpr, list(map(_constant, program.consts))
    flags = [*[True] * len(consts), *fixed]
    is_long = length(jaxpr) > FLAT_WHOLE
    calls = _LAST_CALLS if is_last else _CALLS
    cut = None if not is_cut else "groups" if is_last else "turns"
    form = _Form(rows, is_long, cut, has_reciprocals(jaxpr, flags), calls, {}, {})
    outs, _ = _evaluate(jaxpr, (*consts, *operands), flags, form)
    like = jax.eval_shape(functools.partial(split, rows=rows), structs_of(program.out_avals))
    # What is known before the program runs may come out as NumPy's.
    outs = [x if _is_apart(x) else jnp.asarray(x) for x in outs]
    return split_like(like, outs)


def _known_constant(x: Any) -> np.ndarray | None:
    """An array of indices that is known now."""
    if isinstance(x, Tracer) or not isinstance(x, jax.Array | np.ndarray | np.generic):
        return None
    return None if np.size(x) > MAX_SIZE or is_inexact(x) or not is_numeric(x) else np.asarray(x)


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
    if name in _LAST_CALLS:
        return length(eqn.params[_LAST_CALLS[name]].jaxpr)
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
    """Of the longest loop over stages, or 1."""
    inner = [
        eqn.params[_LAST_CALLS[name]].jaxpr
        for eqn in jaxpr.eqns
        if (name := eqn.primitive.name) in _LAST_CALLS
    ]
    loops = [eqn.params["length"] for eqn in jaxpr.eqns if eqn.primitive.name == "scan"]
    return max([1, *loops, *map(num_turns, inner)])


def _entries(shape: tuple[int, ...]) -> int:
    """About how many numbers or whole arrays an array is scalarised into, if it is."""
    if is_small_shape(shape):
        return math.prod(shape)
    return shape[-1] if len(shape) > 1 and shape[-1] <= MAX_LENGTH else 1


class _Form(NamedTuple):
    """How a program is scalarised.

    Whether arrays have leading axes and the program is long; whether it is cut at the turns of a
    loop, or at groups of turns; whether products with reciprocals take the place of divisions by
    what is fixed; which calls are a part of it, and under which parameter; its literals, each of
    which is made once; and what is materialised.
    """

    rows: bool
    is_long: bool
    cut: str | None
    has_reciprocals: bool
    calls: dict[str, str]
    literals: dict[Any, Any]
    kept: dict[int, Any]


def _evaluate(
    jaxpr: Jaxpr, values: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """What a program makes of values for its constants and arguments, some of which are fixed.

    Fixed results are those that depend on nothing else.
    """
    env: dict[Any, Any] = {}
    loose: set[Any] = set()

    def read(v: Any) -> Any:
        if not isinstance(v, Literal):
            return env[v]
        aval: Any = v.aval
        value = np.asarray(v.val)
        key = value.tobytes(), value.dtype, aval.dtype
        if key not in form.literals:
            form.literals[key] = literal(v)
        return form.literals[key]

    def is_fixed(v: Any) -> bool:
        return isinstance(v, Literal) or v not in loose

    variables = (*jaxpr.constvars, *jaxpr.invars)
    for variable, value, is_one in zip(variables, values, fixed, strict=True):
        is_known = isinstance(value, np.ndarray) and value.ndim > 0
        env[variable] = struct_of_arrays(value) if is_known or is_small(value) else value
        if not is_one:
            loose.add(variable)
    # Each reciprocal once.
    divisors: dict[int, tuple[Any, Any, Any]] = {}
    for eqn in jaxpr.eqns:
        values = [read(v) for v in eqn.invars]
        fixed = [is_fixed(v) for v in eqn.invars]
        outs_fixed = [all(fixed)] * len(eqn.outvars)
        name = eqn.primitive.name
        if name in form.calls:
            inner = eqn.params[form.calls[name]]
            outs, outs_fixed = _evaluate_inner(inner, values, fixed, form)
        elif eqn.primitive is is_scalarised_p:
            # In a derivative, what is computed again at the end of a step that fails would be zero
            # times NaN.
            is_one = eqn.params["in_derivatives"] or form.calls is _LAST_CALLS
            outs = [np.asarray(is_one)]
        elif name == "scan":
            outs, outs_fixed = _unrolled(Loop.of(eqn), values, fixed, form)
        elif name == "cond":
            which = known(values[0])
            if which is None:
                raise Declined
            # As XLA does with a number that is none of a branch.
            branches = eqn.params["branches"]
            branch = branches[min(max(int(which), 0), len(branches) - 1)]
            outs, outs_fixed = _evaluate_inner(branch, values[1:], fixed[1:], form)
        elif form.has_reciprocals and by_fixed(eqn, fixed):
            x, divisor = values
            if id(divisor) not in divisors:
                # With the divisor, so that it is not forgotten and its identity used again.
                divisors[id(divisor)] = *scaled_reciprocal(divisor), divisor
            scale, reciprocal, _ = divisors[id(divisor)]
            eqn = eqn.replace(primitive=lax.mul_p, params=_PARAMETERS_OF_A_PRODUCT)
            outs = _results(jaxpr, eqn, [x, scale], fixed, form)
            outs = _results(jaxpr, eqn, [*outs, reciprocal], fixed, form)
        else:
            outs = _results(jaxpr, eqn, values, fixed, form)
        env.update(zip(eqn.outvars, outs, strict=True))
        loose.update(v for v, is_one in zip(eqn.outvars, outs_fixed, strict=True) if not is_one)
    return [read(v) for v in jaxpr.outvars], [is_fixed(v) for v in jaxpr.outvars]


def _evaluate_inner(
    program: ClosedJaxpr, values: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    consts = list(map(_constant, program.consts))
    return _evaluate(program.jaxpr, (*consts, *values), (*[True] * len(consts), *fixed), form)


def _unrolled(
    loop: Loop, values: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """The results of a loop, one turn after the other."""
    n, m = loop.num_constants, loop.num_constants + loop.num_carried
    carry = values[n:m]
    # What is fixed in the first turn need not be so in the next.
    flags = [*fixed[:n], *[False] * len(carry), *fixed[m:]]
    rows: dict[int, list[Any]] = {}
    outs_fixed: list[bool] = []
    group, size = 0, length(loop.body.jaxpr)
    for k in loop.turns:
        turn = [_entry(x, k) for x in values[m:]]
        given = [*values[:n], *carry, *turn]
        run = _in_parts if form.cut == "turns" else _evaluate_inner
        outs, outs_fixed = run(loop.body, given, flags, form)
        carry, rows[k] = outs[: m - n], outs[m - n :]
        if form.cut == "groups":
            group += 1
            new = {id(x) for x in jtu.tree_leaves(carry) if isinstance(x, Tracer)} - {*form.kept}
            # With one turn more.
            is_full = (group + 1) * size > FUNCTION
            if is_full or (group + 1) * len(new) > group * MAX_RESULTS_IN_BATCHES:
                carry, group = _entries_materialised(carry, form.kept), 0
                form.kept.update((id(x), x) for x in jtu.tree_leaves(carry))
    stacks = map(_stacked, zip(*(rows[k] for k in range(loop.length)), strict=True))
    # It is the same in every turn.
    return [*carry, *stacks], [*[False] * len(carry), *outs_fixed[m - n :]]


def _in_parts(
    program: ClosedJaxpr, values: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """A turn, of which reverse mode keeps what goes in and comes out, and computes the rest again.

    These are materialised, so that what XLA computes at once is about one turn.
    """
    program = flattened(program, ("jit", "pjit"))
    jaxpr, consts = program.jaxpr, list(map(_constant, program.consts))
    code = altered(jaxpr, constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars])
    values, fixed = [*consts, *values], [*[True] * len(consts), *fixed]
    are_tables = is_table
    if form.rows:
        # The points along the other axes are not those of stages.
        pairs = zip(code.invars, values, strict=True)
        are_tables = of_tables(code, [v for v, x in pairs if _is_apart(x) and x.is_table])

    def core(part: Jaxpr, given: Sequence[Any], are_fixed: Sequence[bool]) -> Any:
        given = _entries_materialised(given, {})
        return _again(part, given, are_fixed, form, list(map(are_tables, part.outvars)))

    def rest(part: Jaxpr, given: Sequence[Any], are_fixed: Sequence[bool]) -> Any:
        return _evaluate(part, given, are_fixed, form)

    made = in_parts(code, values, fixed, core, rest, are_tables)
    found = [(literal(v), True) if isinstance(v, Literal) else made[v] for v in jaxpr.outvars]
    return [x for x, _ in found], [is_one for _, is_one in found]


def _entries_materialised(values: Sequence[Any], kept: dict[int, Any]) -> list[Any]:
    """The same, with all numbers and entries materialised together that are not `kept` already."""
    apart = [k for k, x in enumerate(values) if not is_whole(x)]
    leaves, structure = jtu.tree_flatten([values[k] for k in apart])
    moving = {id(x): x for x in leaves if isinstance(x, Tracer) and id(x) not in kept}
    new = dict(zip(moving, together(list(moving.values())), strict=True))
    made = structure.unflatten([new.get(id(x), x) for x in leaves])
    return replaced(values, apart, made)


def _again(
    jaxpr: Jaxpr,
    values: Sequence[Any],
    fixed: Sequence[bool],
    form: _Form,
    are_tables: Sequence[bool],
) -> tuple[list[Any], list[bool]]:
    """What a program makes of values, which reverse mode computes again."""
    leaves, structure = jtu.tree_flatten(list(values))
    places = [k for k, x in enumerate(leaves) if isinstance(x, Tracer)]
    known: Any = None

    def run(some: list[Any]) -> list[Any]:
        nonlocal known
        given = structure.unflatten(replaced(leaves, places, some))
        inner = form._replace(literals={}, kept={})
        outs, outs_fixed = _evaluate(jaxpr, given, fixed, inner)
        single = [k for k, is_one in enumerate(outs_fixed) if not (is_one or are_tables[k])]
        new = _entries_materialised([outs[k] for k in single], inner.kept)
        made, shape = jtu.tree_flatten(replaced(outs, single, new))
        moving = [k for k, x in enumerate(made) if isinstance(x, Tracer)]
        known = [None if k in moving else x for k, x in enumerate(made)], moving, shape, outs_fixed
        return [made[k] for k in moving]

    new = jax.checkpoint(run)([leaves[k] for k in places])
    made, moving, shape, outs_fixed = known
    return shape.unflatten(replaced(made, moving, new)), outs_fixed


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


def _constant(x: Any) -> Any:
    """What a program closes over: known, if it is no array of JAX's."""
    if isinstance(x, jax.Array):
        found = _known_constant(x)
        return x if found is None else found
    if not is_numeric(x) or not is_inexact(np.asarray(x)):
        return x
    # As JAX's, which may overflow.
    if np.ndim(x) == 0 or np.size(x) > _MAX_KNOWN or is_rows(x):
        return jnp.asarray(x)
    return StructOfArrays(list(map(jnp.asarray, np.ravel(x))), np.shape(x))


# As of the weights of a method of 16 stages.
_MAX_KNOWN = 4 * MAX_SIZE


# As a version of JAX has them.
_PARAMETERS_OF_A_PRODUCT = jax.make_jaxpr(lax.mul)(1.0, 1.0).jaxpr.eqns[0].params


def _results(
    jaxpr: Jaxpr, eqn: JaxprEqn, values: list[Any], fixed: Sequence[bool], form: _Form
) -> list[Any]:
    """The results of one operation: scalarised, if there is a rule for it."""
    outs = _apart(jaxpr, eqn, values, fixed, form)
    if outs is None and is_in_place(eqn):
        raise Declined
    if outs is None:
        outs = map(split, evaluate(jaxpr, eqn, list(map(_whole, values))))
    return list(outs)


def _apart(
    jaxpr: Jaxpr, eqn: JaxprEqn, values: list[Any], fixed: Sequence[bool], form: _Form
) -> Sequence[Any] | None:
    """The results of one operation, scalarised, if there is a rule for it, otherwise None."""
    if eqn.primitive is materialised_p:
        if eqn.params["is_cut"] and not form.is_long:
            return values
        # What is whole is in memory anyway.
        groups = [jtu.tree_flatten(x) for x in values]
        new = materialised([x for group, _ in groups for x in group], **eqn.params)
        form.kept.update((id(x), x) for x in new)
        new = iter(new)
        return [shape.unflatten(next(new) for _ in group) for group, shape in groups]
    return on_entries(jaxpr, eqn, values, fixed, form.rows)
