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
    is_inexact,
    structs,
    without_dead_code,
)
from .limits import (
    FLAT_MANY,
    MAX_ENTRIES,
    MAX_LENGTH,
    MAX_SIZE,
)
from .materialise import materialised, materialised_p
from .over_stages import Loop, is_scalarised_p
from .rules import on_entries
from .scope import is_numeric, is_on, is_rows, is_short, unread, within
from .smooth import by_fixed, has_reciprocals, scaled_reciprocal
from .struct_of_arrays import (
    StructOfArrays,
    apart_like,
    common,
    conformed,
    is_small,
    is_small_shape,
    is_whole,
    literal,
    static_value,
    struct_of_arrays,
)
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
        if length(code) > FLAT_MANY:
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
) -> list[Any]:
    """The results of a program, apart. So are its operands.

    `fixed` says which of them are the same in every step, and `is_last` whether nothing is
    differentiated any more.
    """
    jaxpr = program.jaxpr
    form = _Form(rows, has_reciprocals(jaxpr, fixed), is_last, {})
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


def _entries(shape: tuple[int, ...]) -> int:
    """About how many numbers or whole arrays an array is scalarised into, if it is."""
    if is_small_shape(shape):
        return math.prod(shape)
    return shape[-1] if len(shape) > 1 and shape[-1] <= MAX_LENGTH else 1


class _Form(NamedTuple):
    """How a program is scalarised."""

    rows: bool  # It has arrays with leading axes.
    has_reciprocals: bool  # In the place of divisions by what is fixed.
    is_last: bool  # Nothing is differentiated any more.
    literals: dict[Any, Any]  # Each is made once.


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
    for k in loop.turns:
        turn = [_entry(x, k) for x in operands[m:]]
        outs, outs_fixed = _evaluate(loop.body, [*operands[:n], *carry, *turn], flags, form)
        carry, ys[k] = outs[: m - n], outs[m - n :]
    stacks = map(_stacked, zip(*(ys[k] for k in sorted(ys)), strict=True))
    # It is the same in every turn.
    return [*carry, *stacks], [*[False] * len(carry), *outs_fixed[m - n :]]


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
    shape = parts[0].shape
    flags = common(parts, shape)
    entries = [e for x in parts for e in conformed(x, shape, flags).entries]
    return StructOfArrays(entries, (len(parts), *shape), [True, *flags])


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
        leaves, structure = jtu.tree_flatten(values)
        return structure.unflatten(materialised(leaves, **eqn.params))
    outs = on_entries(eqn, values, fixed, form.rows)
    if outs is None and is_in_place(eqn):
        raise Declined
    return list(map(split, evaluate(eqn, list(map(_whole, values))))) if outs is None else outs
