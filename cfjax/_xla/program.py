"""A step on single numbers instead of short vectors, and on one array for each of their entries.

XLA fuses numbers well and vectors of three badly: it computes what several entries need once for
each of them, or materialises it. So the program of a step is read, and evaluated again with
every small array as its entries. In a state with leading axes, many short vectors, the entries
are arrays of these axes.
"""

import contextlib
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
    jaxpr_as_fun,
)
from jaxtyping import Array, PyTree

from .jaxprs import evaluate, without_dead_code
from .limits import FUNCTION, MAX_ENTRIES, MAX_LENGTH, MAX_OPERATIONS, MAX_SIZE
from .materialise import materialised, materialised_p
from .operation import operation
from .rules import on_entries
from .scope import (
    Place,
    in_equal_steps,
    is_numeric,
    is_on,
    is_rows,
    is_short,
    rewriting,
    unread,
    where,
    within,
)
from .smooth import by_fixed, has_reciprocals, scaled_reciprocal
from .struct_of_arrays import (
    StructOfArrays,
    apart_like,
    is_inexact,
    is_small,
    literal,
    struct_of_arrays,
)
from .understood import MOVES, REDUCTIONS, is_in_place, is_readable

# Of a longer step that stands alone, not in a loop of equal steps, derivatives are left to JAX: a
# gradient through diffrax's loop would take two to three times as long to compile.
_SHORT_TO_DIFFERENTIATE = FUNCTION // 2

_CALLS = frozenset(("jit", "pjit"))


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


def scalarised(fun: Callable[[PyTree], PyTree], y: PyTree, is_derived: bool = True) -> PyTree:
    """`fun(y)`, computed on single numbers where `y` is a small state of short vectors.

    The result agrees with that of `fun` to rounding. `fun` may close over traced values. Operations
    that have no rule here get the array whole. Where `y` is another state, the program is too long
    or cannot be scalarised, and inside of `trace`, this is `fun(y)`. Unless `is_derived`, and where
    the program is long, derivatives are JAX's own of the program as it is, which compile faster.
    """
    program = None if where() else trace(fun, y, "step", is_derived)
    if program is None:
        return fun(y)
    y, parameters = split((y, program.parameters), program.rows)
    # What is around may use single entries, so that XLA computes anew what these share. It does
    # little harm to a step, but much to a derivative.
    is_long = program.length > _SHORT_TO_DIFFERENTIATE
    is_derived = is_derived and (not is_long or in_equal_steps())
    through = _materialised if is_derived else lambda x: x
    # The derivative of an adaptive loop computes a step at one place and uses its derivative at
    # another. What that needs of the step is many numbers: to compute them again is cheaper than to
    # materialise them.
    out = operation(
        program.run,
        *through((y, parameters)),
        place="step",
        is_batch=program.rows,
        plain=program.plain,
        order=1 if is_derived else 0,
    )
    # One by one: what is not used is not computed.
    return jtu.tree_map(lambda x: _whole(through(x)), out, is_leaf=_is_apart)


def are_long(fun: Callable[[PyTree], PyTree], y: PyTree, times: int) -> bool:
    """Whether so many of `fun(y)` are too long to be scalarised."""
    code = without_dead_code(jax.make_jaxpr(fun)(y).jaxpr)
    return times * _operations(code) > MAX_OPERATIONS


class Program(NamedTuple):
    """A function that is scalarised, and what it closes over.

    `run(y, parameters)` takes both split, returns what is split and closes over nothing traced.
    `plain` is the same, but for how it computes: as the function does. With `rows` the state has
    short vectors along leading axes, and is to be split so. `length` counts operations.
    """

    run: Callable[[PyTree, PyTree], PyTree]
    plain: Callable[[PyTree, PyTree], PyTree]
    parameters: list[Array]
    rows: bool
    length: int


class _Declined(Exception):
    """A program has something that is not to be scalarised."""


def trace(
    fun: Callable[[PyTree], PyTree], y: PyTree, place: Place, is_derived: bool = True
) -> Program | None:
    """`fun` as a program that is scalarised at `y`; None if that does not pay or cannot be done.

    It must have no effects and be readable (`is_readable`). Unless `is_derived`, what it was before
    may have loops whose turns are scalarised.
    """
    rows = _has_rows(y, MAX_ENTRIES[place])
    if not is_on() or not (rows or _is_small_state(y, MAX_ENTRIES[place])):
        return None
    with within(place, rows):
        jaxpr, out = jax.make_jaxpr(fun, return_shape=True)(y)
    structure = jtu.tree_structure(out)
    try:
        code = without_dead_code(jaxpr.jaxpr)
        num_operations = _operations(code)
        if jaxpr.effects or not is_readable(code) or num_operations > MAX_OPERATIONS:
            return None
    except Exception as error:
        return unread(error)
    before = ClosedJaxpr(code, jaxpr.consts)
    if place == "loop" or num_operations > _SHORT_TO_DIFFERENTIATE or not is_derived:
        # Where a step is not scalarised its stages may be one loop.
        with rewriting(False) if is_derived else contextlib.nullcontext():
            rolled, shape = jax.make_jaxpr(fun, return_shape=True)(y)
        before = rolled if jtu.tree_structure(shape) == structure else before
    unknown = {id(x): x for x in jaxpr.consts if _constant(x) is None}
    unknown |= {id(x): x for x in before.consts if isinstance(x, Tracer)}
    number = {key: k for k, key in enumerate(unknown)}

    def values(consts: Sequence[Any], parameters: PyTree) -> list[Any]:
        return [parameters[number[id(x)]] if id(x) in number else x for x in consts]

    def apart(y: PyTree, parameters: PyTree) -> PyTree:
        first = [x if _constant(x) is None else _constant(x) for x in jaxpr.consts]
        first, moving = values(first, parameters), jtu.tree_leaves(y, is_leaf=_is_apart)
        fixed = [True] * len(first) + [False] * len(moving)
        form = _Form(rows, num_operations > FUNCTION, has_reciprocals(code, fixed))
        outs, _ = _evaluate(code, (*first, *moving), fixed, form)
        # What is known before the program runs may come out as NumPy's.
        outs = [x if _is_apart(x) else jnp.asarray(x) for x in outs]
        return split(jtu.tree_unflatten(structure, outs), rows)

    parameters = list(map(jnp.asarray, unknown.values()))
    try:
        shapes = jax.eval_shape(lambda *args: split(args, rows), y, parameters)
        made, out = jax.make_jaxpr(apart, return_shape=True)(*shapes)
    except _Declined:
        return None
    except Exception as error:
        return unread(error)

    def run(y: PyTree, parameters: PyTree) -> PyTree:
        outs = jaxpr_as_fun(made)(*jtu.tree_leaves((y, parameters)))
        # A literal comes out as NumPy's.
        return jtu.tree_unflatten(jtu.tree_structure(out), list(map(jnp.asarray, outs)))

    def plain(y: PyTree, parameters: PyTree) -> PyTree:
        closed = ClosedJaxpr(before.jaxpr, list(map(_whole, values(before.consts, parameters))))
        outs = jaxpr_as_fun(closed)(*jtu.tree_leaves(join(y)))
        return split_like(out, jtu.tree_unflatten(structure, outs))

    return Program(run, plain, parameters, rows, num_operations)


def _constant(x: Any) -> np.ndarray | None:
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


def _operations(jaxpr: Jaxpr) -> int:
    """About how many operations on single numbers or whole arrays there will be."""
    return sum(map(_operations_of, jaxpr.eqns))


def _operations_of(eqn: JaxprEqn) -> int:
    name = eqn.primitive.name
    if name in _CALLS:
        return _operations(eqn.params["jaxpr"].jaxpr)
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
    if math.prod(shape) <= MAX_SIZE:
        return math.prod(shape)
    return shape[-1] if len(shape) > 1 and shape[-1] <= MAX_LENGTH else 1


class _Form(NamedTuple):
    """How a program is scalarised.

    Whether arrays have leading axes, the program is long, and products with reciprocals take the
    place of divisions by what is fixed.
    """

    rows: bool
    is_long: bool
    has_reciprocals: bool


def _evaluate(
    jaxpr: Jaxpr, values: Sequence[Any], fixed: Sequence[bool], form: _Form
) -> tuple[list[Any], list[bool]]:
    """What a program makes of values for its constants and arguments, some of which are fixed.

    Fixed results are those that depend on nothing else.
    """
    env: dict[Any, Any] = {}
    loose: set[Any] = set()

    def read(v: Any) -> Any:
        return literal(v) if isinstance(v, Literal) else env[v]

    def is_fixed(v: Any) -> bool:
        return isinstance(v, Literal) or v not in loose

    variables = (*jaxpr.constvars, *jaxpr.invars)
    for variable, value, is_one in zip(variables, values, fixed, strict=True):
        env[variable] = struct_of_arrays(value) if is_small(value) else value
        if not is_one:
            loose.add(variable)
    # Each reciprocal once.
    divisors: dict[int, tuple[Any, Any, Any]] = {}
    for eqn in jaxpr.eqns:
        values = [read(v) for v in eqn.invars]
        fixed = [is_fixed(v) for v in eqn.invars]
        outs_fixed = [all(fixed)] * len(eqn.outvars)
        if eqn.primitive.name in _CALLS:
            inner = eqn.params["jaxpr"]
            constants = [True] * len(inner.consts)
            outs, outs_fixed = _evaluate(
                inner.jaxpr, (*inner.consts, *values), (*constants, *fixed), form
            )
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


# As a version of JAX has them.
_PARAMETERS_OF_A_PRODUCT = jax.make_jaxpr(lax.mul)(1.0, 1.0).jaxpr.eqns[0].params


def _results(
    jaxpr: Jaxpr, eqn: JaxprEqn, values: list[Any], fixed: Sequence[bool], form: _Form
) -> list[Any]:
    """The results of one operation: scalarised, if there is a rule for it."""
    outs = _apart(jaxpr, eqn, values, fixed, form)
    if outs is None and is_in_place(eqn):
        raise _Declined
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
        new = iter(materialised([x for group, _ in groups for x in group], **eqn.params))
        return [shape.unflatten(next(new) for _ in group) for group, shape in groups]
    return on_entries(jaxpr, eqn, values, fixed, form.rows)


def _materialised(tree: Any) -> Any:
    """The same, with all single numbers materialised where this is differentiated."""
    leaves, structure = jtu.tree_flatten(tree)
    places = [k for k, x in enumerate(leaves) if _is_number(x)]
    if places:
        new = materialised([leaves[k] for k in places], in_batches=True, now=False)
        for k, x in zip(places, new, strict=True):
            leaves[k] = x
    return jtu.tree_unflatten(structure, leaves)


def _is_number(x: Any) -> bool:
    return isinstance(x, Tracer) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.inexact)
