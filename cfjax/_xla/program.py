"""The program of a step, on single numbers instead of short vectors.

XLA fuses numbers well and vectors of three badly: it computes what several entries need once for
each of them, or materialises it. So the program of a step is read, and evaluated again with
every small array as its entries.
"""

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
    without_dead_code,
)
from .limits import MAX_ENTRIES, MAX_OPERATIONS, MAX_SIZE
from .materialise import materialised, materialised_p
from .numbers import (
    array_of,
    as_array,
    as_tree,
    is_small,
    is_whole,
    literal,
    numbers,
    of_jax,
    static_value,
    whole,
)
from .over_stages import Loop, is_scalarised_p
from .rules import on_numbers
from .scope import is_numeric, is_on, is_short, is_small_shape, unread, within
from .smooth import by_fixed, has_reciprocals, scaled_reciprocal
from .understood import MOVES, REDUCTIONS, is_in_place, is_readable


class Declined(Exception):
    """A program has something that is not to be scalarised."""


class Reading(NamedTuple):
    """The program of a function that can be scalarised.

    It takes what the function closes over first, but for what is known now. `shape` is that of its
    results.
    """

    program: ClosedJaxpr
    parameters: Sequence[Array]
    shape: PyTree


def read(
    fun: Callable[[PyTree], PyTree], y: PyTree, max_entries: int = MAX_ENTRIES["step"]
) -> Reading | None:
    """The program of `fun` at `y`, which has at most so many entries.

    None if it cannot be scalarised or is too long. It must have no effects and be readable
    (`is_readable`).
    """
    leaves = jtu.tree_leaves(y)
    is_small_state = any(map(is_short, leaves)) and all(
        is_short(x) or (np.ndim(x) == 0 and is_numeric(x)) for x in leaves
    )
    if not (is_on() and is_small_state and sum(map(np.size, leaves)) <= max_entries):
        return None
    with within():
        jaxpr, shape = jax.make_jaxpr(fun, return_shape=True)(y)
    try:
        code = without_dead_code(jaxpr.jaxpr)
        if jaxpr.effects or not is_readable(code) or length(code) > MAX_OPERATIONS:
            return None
    except Exception as error:
        return unread(error)
    return Reading(*_with_parameters(code, jaxpr.consts), shape)


def _with_parameters(code: Jaxpr, consts: Sequence[Any]) -> tuple[ClosedJaxpr, list[Array]]:
    static, parameters = [], []
    for v, x in zip(code.constvars, consts, strict=True):
        (static if _is_static(x) else parameters).append((v, x))
    invars = [*(v for v, _ in parameters), *code.invars]
    code = altered(code, constvars=[v for v, _ in static], invars=invars)
    return ClosedJaxpr(code, [x for _, x in static]), [jnp.asarray(x) for _, x in parameters]


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
        terms = _entries(eqn.invars[0])
    return sum(terms * _entries(v) for v in eqn.outvars)


def _entries(v: Any) -> int:
    """How many numbers or whole arrays an array is scalarised into."""
    shape = getattr(v.aval, "shape", ())
    return math.prod(shape) if is_small_shape(shape) else 1


def of_numbers(
    program: ClosedJaxpr,
    fixed: Sequence[bool],
    operands: Sequence[Any],
    is_last: bool = True,
    has_marks: bool = True,
) -> list[Any]:
    """The results of a program, apart. So are its operands.

    `fixed` says which of them are the same in every step, `is_last` whether nothing is
    differentiated any more, and `has_marks` whether what is marked for it is materialised.
    """
    form = _Form(has_reciprocals(program.jaxpr, fixed), is_last, has_marks, {})
    outs, _ = _evaluate(program, list(map(as_array, operands)), fixed, form)
    return list(map(_result, outs))


def _result(x: Any) -> Any:
    """As `split` has it, and without what is NumPy's."""
    if is_whole(x) and not is_small(x):
        return x
    x = numbers(x)
    x = array_of(list(map(of_jax, x.flat)), x.shape)
    return as_tree(x) if x.shape else x[()]


class _Form(NamedTuple):
    """How a program is scalarised."""

    has_reciprocals: bool  # In the place of divisions by what is fixed.
    is_last: bool  # Nothing is differentiated any more.
    has_marks: bool  # What is marked for it is materialised.
    literals: dict[Any, Any]  # Each is made once.


def _evaluate(
    program: ClosedJaxpr, operands: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """The results of a program, and whether each is fixed: depends on fixed operands alone."""
    jaxpr, consts = program.jaxpr, map(_constant, program.consts)
    varying = set(itertools.compress(jaxpr.invars, (not x for x in fixed)))
    env: dict[Any, Any] = {}
    for v, x in zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *operands), strict=True):
        env[v] = numbers(x) if is_small(x) else x

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
        elif eqn.primitive is materialised_p and not form.has_marks:
            outs = values
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
                parts = map(as_array, scaled_reciprocal(as_tree(divisor)))
                divisors[id(divisor)] = *parts, divisor
            scale, reciprocal, _ = divisors[id(divisor)]
            eqn = eqn.replace(primitive=lax.mul_p, params=_PARAMETERS_OF_A_PRODUCT)
            outs = _results(eqn, [x, scale])
            outs = _results(eqn, [*outs, reciprocal])
        else:
            outs = _results(eqn, values)
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
    return np.asarray(x[k]) if isinstance(x, np.ndarray) and x.dtype != object else x[k]


def _stacked(rows: Sequence[Any]) -> Any:
    """Rows along a new first axis."""
    if any(map(is_whole, rows)):
        return jnp.stack(list(map(whole, rows)))
    return np.stack(list(map(numbers, rows)))


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
    if np.ndim(x) == 0 or np.size(x) > _MAX_STATIC:
        return jnp.asarray(x)
    return array_of(list(map(jnp.asarray, np.ravel(x))), np.shape(x))


# As of the weights of a method of 16 stages.
_MAX_STATIC = 4 * MAX_SIZE
# As a version of JAX has them.
_PARAMETERS_OF_A_PRODUCT = jax.make_jaxpr(lax.mul)(1.0, 1.0).jaxpr.eqns[0].params


def _results(eqn: JaxprEqn, values: list[Any]) -> Sequence[Any]:
    """The results of one operation: on numbers, if there is a rule for it."""
    if eqn.primitive is materialised_p:
        leaves, structure = jtu.tree_flatten(list(map(as_tree, values)))
        return list(map(as_array, structure.unflatten(materialised(leaves))))
    outs = on_numbers(eqn, values)
    if outs is not None:
        return outs
    if is_in_place(eqn):
        raise Declined
    outs = evaluate(eqn, list(map(whole, values)))
    return [numbers(x) if is_small(x) else x for x in outs]
