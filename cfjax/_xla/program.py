"""A step on single numbers instead of short vectors, and on one array for each of their entries.

XLA fuses numbers well and vectors of three badly: it computes what several entries need once for
each of them, or sends it through memory. So the program of a step is read, and evaluated again with
every small array held as its entries. In a state with leading axes, many short vectors, the entries
are arrays of these axes.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import (
    ClosedJaxpr,
    Jaxpr,
    JaxprEqn,
    Literal,
    jaxpr_as_fun,
    jaxprs_in_params,
)
from jaxtyping import Array, PyTree

from .columns import Columns, columns, in_columns
from .components import (
    MOVES,
    REDUCTIONS,
    Components,
    components,
    in_components,
    is_inexact,
    is_small,
    literal,
)
from .held import held, held_p
from .operation import evaluate, operation, without_dead_code
from .pack import pack_p, unpack_p
from .scope import (
    MAX_LENGTH,
    MAX_SIZE,
    Place,
    is_numeric,
    is_on,
    is_rows,
    is_short,
    unread,
    where,
    within,
)

# A state is taken apart if all of it is numbers and short vectors, so many entries together, and if
# a step is not longer than that, counted in operations on single numbers: the time to compile grows
# with it, and more so in derivatives. `README.md` here has what that buys and costs. What a loop
# carries may have what sums have lost of each entry too, the number of the step and a result.
_MAX_ENTRIES: dict[Place, int] = {"step": 16, "loop": 34}
_MAX_OPERATIONS = 4000
# One that is longer is more than one of XLA's functions, and is cut.
_SHORT = 2000
# About as many combine the stages of a long method.
_COMBINATIONS = 1000

_CALLS = frozenset(("jit", "pjit"))
_CONTROL = frozenset(("cond", "scan", "while"))


def split(tree: PyTree, rows: bool = False) -> PyTree:
    """The tree with every small array in components, and with `rows` short vectors in columns."""

    def apart(x: Any) -> Any:
        if is_small(x):
            return components(x)
        return columns(x) if rows and is_rows(x) else x

    return jtu.tree_map(apart, tree, is_leaf=_is_apart)


def join(tree: PyTree) -> PyTree:
    """The reverse of `split`."""
    return jtu.tree_map(_whole, tree, is_leaf=_is_apart)


def _is_apart(x: Any) -> bool:
    return isinstance(x, Components | Columns)


def _whole(x: Any) -> Any:
    return x.whole() if _is_apart(x) else x


def by_components(fun: Callable[[PyTree], PyTree], y: PyTree) -> PyTree:
    """`fun(y)`, computed on single numbers where `y` is a small state of short vectors.

    The result agrees with that of `fun` to rounding. `fun` may close over traced values. Operations
    that have no rule here get the array whole. Where `y` is another state, the program is too long
    or cannot be read, and inside of `trace`, this is `fun(y)`.

    Divisions by what no `y` changes become products with the reciprocal, as XLA does for literals:
    a loop then computes the reciprocal once, and a division would be a barrier to fusion.
    """
    program = None if where() else trace(fun, y, "step")
    if program is None:
        return fun(y)
    # What is around may use single entries, so that XLA computes anew what these share. It does
    # little harm to a step, but much to a derivative.
    y, parameters = _held(split((y, program.parameters), program.rows))
    # The derivative of an adaptive loop computes a step at one place and uses its derivative at
    # another. What that needs of the step is many numbers: to compute them again is cheaper than to
    # send them there through memory.
    out = operation(program.run, y, parameters, place="step", is_batch=program.rows)
    # One by one: what nobody uses is not computed.
    return jtu.tree_map(lambda x: _whole(_held(x)), out, is_leaf=_is_apart)


def are_long(fun: Callable[[PyTree], PyTree], y: PyTree, times: int) -> bool:
    """Whether so many of `fun(y)`, and what combines them, are too long to be taken apart."""
    code = without_dead_code(jax.make_jaxpr(fun)(y).jaxpr)
    return times * _operations(code) > _MAX_OPERATIONS - _COMBINATIONS


class Program(NamedTuple):
    """A function that can be taken apart, and what it closes over.

    `run(y, parameters)` takes both split, returns what is split and closes over nothing traced.
    With `rows` the state has short vectors along leading axes, and is to be split so.
    """

    run: Callable[[PyTree, PyTree], PyTree]
    parameters: list[Array]
    rows: bool


def trace(fun: Callable[[PyTree], PyTree], y: PyTree, place: Place) -> Program | None:
    """`fun` as a program to take apart at `y`; None if that does not pay or cannot be done.

    It must have no effects, no branches or loops, and no function with a rule for reverse mode
    alone.
    """
    rows = _has_rows(y, _MAX_ENTRIES[place])
    if not is_on() or not (rows or _is_small_state(y, _MAX_ENTRIES[place])):
        return None
    with within(place, rows):
        jaxpr, out = jax.make_jaxpr(fun, return_shape=True)(y)
    structure = jtu.tree_structure(out)
    consts = [_constant(x) for x in jaxpr.consts]
    try:
        code = without_dead_code(jaxpr.jaxpr)
        if jaxpr.effects or not _is_readable(code):
            return None
        num_operations = _operations(code)
        if num_operations > _MAX_OPERATIONS:
            return None
    except Exception as error:
        return unread(error)

    def run(y: PyTree, parameters: PyTree) -> PyTree:
        rest = iter(parameters)
        values = [next(rest) if x is None else x for x in consts]
        moving = jtu.tree_leaves(y, is_leaf=_is_apart)
        fixed = [True] * len(values) + [False] * len(moving)
        try:
            outs, _ = _evaluate(code, (*values, *moving), fixed, rows, num_operations > _SHORT)
        except Exception as error:
            unread(error)
            outs = jaxpr_as_fun(ClosedJaxpr(code, list(map(_whole, values))))(*map(_whole, moving))
        # What is known before the program runs may come out as NumPy's.
        outs = [x if _is_apart(x) else jnp.asarray(x) for x in outs]
        return split(jtu.tree_unflatten(structure, outs), rows)

    parameters = [
        jnp.asarray(x) for x, known in zip(jaxpr.consts, consts, strict=True) if known is None
    ]
    return Program(run, parameters, rows)


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


def _is_readable(jaxpr: Jaxpr) -> bool:
    """Whether there are no branches and loops, nor functions with a rule for reverse mode alone.

    Branches and loops stay whole, as in the exponential of a matrix. What is around them, taken
    apart, XLA would compute anew for each of the entries that go in.
    """
    return all(
        eqn.primitive.name not in _CONTROL
        and "custom_vjp" not in eqn.primitive.name
        and all(map(_is_readable, jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )


def _operations(jaxpr: Jaxpr) -> int:
    """About how many operations on single numbers or whole arrays there will be."""
    return sum(map(_operations_of, jaxpr.eqns))


def _operations_of(eqn: JaxprEqn) -> int:
    name = eqn.primitive.name
    if name in _CALLS:
        return _operations(eqn.params["jaxpr"].jaxpr)
    if name in MOVES or name in ("split", "stack") or eqn.primitive in (pack_p, unpack_p):
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
    """About how many numbers or whole arrays an array is taken apart into, if it is."""
    if math.prod(shape) <= MAX_SIZE:
        return math.prod(shape)
    return shape[-1] if len(shape) > 1 and shape[-1] <= MAX_LENGTH else 1


def _evaluate(
    jaxpr: Jaxpr, values: Sequence[Any], fixed: Sequence[bool], rows: bool, is_long: bool
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
        env[variable] = components(value) if is_small(value) else value
        if not is_one:
            loose.add(variable)
    for eqn in jaxpr.eqns:
        values = [read(v) for v in eqn.invars]
        fixed = [is_fixed(v) for v in eqn.invars]
        outs_fixed = [all(fixed)] * len(eqn.outvars)
        if eqn.primitive.name in _CALLS:
            inner = eqn.params["jaxpr"]
            constants = [True] * len(inner.consts)
            outs, outs_fixed = _evaluate(
                inner.jaxpr, (*inner.consts, *values), (*constants, *fixed), rows, is_long
            )
        else:
            outs = _apart(jaxpr, eqn, values, fixed, rows, is_long)
            if outs is None:
                outs = map(split, evaluate(jaxpr, eqn, list(map(_whole, values))))
        env.update(zip(eqn.outvars, outs, strict=True))
        loose.update(v for v, is_one in zip(eqn.outvars, outs_fixed, strict=True) if not is_one)
    return [read(v) for v in jaxpr.outvars], [is_fixed(v) for v in jaxpr.outvars]


def _apart(
    jaxpr: Jaxpr, eqn: JaxprEqn, values: list[Any], fixed: Sequence[bool], rows: bool, is_long: bool
) -> Sequence[Any] | None:
    """The results of one operation, taken apart, if there is a rule for it, else None."""
    if eqn.primitive is held_p:
        if eqn.params["is_cut"] and not is_long:
            return values
        # What is whole is in memory anyway.
        groups = [jtu.tree_flatten(x) for x in values]
        new = iter(held([x for group, _ in groups for x in group], **eqn.params))
        return [shape.unflatten(next(new) for _ in group) for group, shape in groups]
    if rows:
        sizes = (math.prod(getattr(v.aval, "shape", ())) for v in (*eqn.invars, *eqn.outvars))
        if any(isinstance(x, Columns) for x in values) or max(sizes) > MAX_SIZE:
            return in_columns(eqn, values, fixed)
    return in_components(jaxpr, eqn, values, fixed)


def _held(tree: Any) -> Any:
    """The same, with all single numbers through memory where this is differentiated."""
    leaves, structure = jtu.tree_flatten(tree)
    places = [k for k, x in enumerate(leaves) if _is_number(x)]
    if places:
        new = held([leaves[k] for k in places], in_batches=True, now=False)
        for k, x in zip(places, new, strict=True):
            leaves[k] = x
    return jtu.tree_unflatten(structure, leaves)


def _is_number(x: Any) -> bool:
    return isinstance(x, Tracer) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.inexact)
