"""Evaluation of a function with small arrays held as their components.

XLA fuses scalars well and vectors of three badly: it computes what several components need once
for each of them, or sends it through memory. A step of a small system runs several times faster
when no small array is ever built inside it, above all in a batch.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple, SupportsIndex

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.custom_batching import custom_vmap
from jax.extend.core import (
    ClosedJaxpr,
    Jaxpr,
    JaxprEqn,
    Literal,
    jaxpr_as_fun,
    jaxprs_in_params,
)
from jaxtyping import Array, PyTree

from .held import held, held_p
from .operation import evaluate, operation, variables, without_dead_code
from .pack import pack, pack_p, unpack, unpack_p

# Larger arrays fuse well as they are, and the program grows with the number of components. With
# matrices come the vectors of all their entries.
_MAX_LENGTH = 6
_MAX_SIZE = 9
_MAX_PRODUCT = 36

# Operations between two cuts of a program of vectors, and of matrices, where more are linear. Into
# one function XLA on CPU puts at most 2000 operations. Beyond, and wherever entries of one array
# are used apart, it computes anew what two later results share: in long programs exponentially
# often. Its operations are some 1.7 times ours, and a derivative has three or four times as many.
# A step of CF4 for one vector, with its estimate, has 512 and is better whole.
_MAX_OPERATIONS = 550, 850
# Every so many cuts there is one for values too; the others are for derivatives alone.
_CUTS_OF_VALUES = 2

_CHEAP = frozenset(
    "abs add add_any and ceil clamp complex conj convert_element_type copy eq floor ge gt imag "
    "integer_pow is_finite le lt max min mul ne neg not or real round select_n sign square sub "
    "xor".split()
)
_EXPENSIVE = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh div erf exp exp2 expm1 log log1p "
    "logistic pow rem rsqrt sin sinh sqrt tan tanh".split()
)

_CALLS = frozenset(("jit", "pjit"))
_BRANCHES = frozenset(("cond", "scan", "while"))


@jtu.register_pytree_node_class
class Components:
    """A small array as its entries, which are scalars, row by row."""

    def __init__(self, entries: Iterable[Any], shape: tuple[int, ...]):
        self.entries = tuple(entries)
        self.shape = shape

    def at(self, places: np.ndarray) -> Any:
        """The entries at some places, which are their numbers: an array, or one entry."""
        if places.ndim == 0:
            return self.entries[int(places)]
        return Components([self.entries[k] for k in places.flat], places.shape)

    def tree_flatten(self) -> tuple[tuple, tuple[int, ...]]:
        return self.entries, self.shape

    @classmethod
    def tree_unflatten(cls, shape, children):
        return cls(children, shape)


def split(tree: PyTree, matrices: bool) -> PyTree:
    """The tree with every vector of at most six entries in components.

    With `matrices` every array of at most nine entries, such as a matrix of 3 x 3.
    """
    return jtu.tree_map(lambda x: _components(x) if _is_small(np.shape(x), matrices) else x, tree)


def join(tree: PyTree) -> PyTree:
    """The reverse of `split`."""
    return jtu.tree_map(_whole, tree, is_leaf=_is_components)


def is_small(x: Any) -> bool:
    """Whether this is an array of at most nine entries."""
    return _is_small(np.shape(x), matrices=True)


def is_short(x: Any) -> bool:
    """Whether an array is a vector of at most six entries."""
    return _is_small(np.shape(x), matrices=False)


def has_few(tree: PyTree, most: int) -> bool:
    """Whether there are small matrices, and with all small arrays no more than `most` entries."""
    small = [x for x in jtu.tree_leaves(tree) if is_small(x)]
    return any(np.ndim(x) > 1 for x in small) and sum(map(np.size, small)) <= most


def by_components(fun: Callable[[PyTree], PyTree], y: PyTree, *, has_extra: bool = False) -> PyTree:
    """`fun(y)`, computed with every vector of at most six entries in components.

    Small matrices too, where they are few: XLA would compute anew for every component what many
    share, above all backwards. The result agrees with that of `fun` to rounding. `fun` may close
    over traced values. Operations that have no rule here get the array whole, so every function
    works. Where nothing in `y` is small, and inside of `trace`, this is `fun(y)`. With `has_extra`
    its result is a pair of what is needed and what perhaps is not.

    Divisions by what no `y` changes become products with the reciprocal, as XLA does for literals:
    a loop then computes the reciprocal once, and a division would be a barrier to fusion. Not so
    where a part of `y` stays whole: there the barrier saves XLA from computing the components anew
    for every entry of that part.
    """
    if is_inside() or not any(map(is_small, jtu.tree_leaves(y))):
        return fun(y)
    program, parameters, is_straight, is_plain = trace(fun, y, has_extra)
    matrices = is_straight and has_few(y, _MAX_SIZE)
    # What is around may use single entries, so that XLA computes anew what these share. It does
    # little harm to a step, but much to a derivative.
    y, parameters = _held(split((y, parameters), matrices), now=False)

    def step(y: PyTree, parameters: PyTree) -> PyTree:
        return program(y, parameters, matrices, True)

    # The derivative of an adaptive loop computes a step at one place and uses its derivative at
    # another. What that needs of the step is many scalars: to compute them again is cheaper than to
    # send them there through memory.
    out = operation(step, y, parameters) if _is_split(y) and is_plain else step(y, parameters)
    # What is known before the program runs may come out as NumPy's.
    out = jtu.tree_map(jnp.asarray, out)
    # One by one: what nobody uses is not computed.
    return jtu.tree_map(lambda x: _whole(_held(x, now=False)), out, is_leaf=_is_components)


_is_inside: ContextVar[bool] = ContextVar("is_inside", default=False)


def is_inside() -> bool:
    """Whether this is part of a program that is taken apart as a whole."""
    return _is_inside.get()


def trace(
    fun: Callable[[PyTree], PyTree], y: PyTree, has_extra: bool = False
) -> tuple[Callable[[PyTree, PyTree, bool, bool], PyTree], list[Array], bool, bool]:
    """A program for `by_components`, what `fun` closes over, whether to split matrices, and whether
    it can be an operation.

    `program(y, parameters, matrices, cuts)` takes both split, with the same `matrices`, and returns
    what is split. It closes over nothing that is traced. Where it is long, its values go through
    memory at some places: in a batch, and with `cuts` also alone.

    Matrices that go through branches or loops, as in `expm`, are better left whole: XLA fuses
    nothing across these.
    """
    token = _is_inside.set(True)
    try:
        jaxpr, out = jax.make_jaxpr(fun, return_shape=True)(y)
    finally:
        _is_inside.reset(token)
    code = without_dead_code(jaxpr.jaxpr)
    needed = code.outvars[: len(jtu.tree_leaves(out[0]))] if has_extra else code.outvars

    def program(y: PyTree, parameters: PyTree, matrices: bool, cuts: bool) -> PyTree:
        values = jtu.tree_leaves(y, is_leaf=_is_components)
        if _has_components(y):
            fixed = [True] * len(parameters) + [False] * len(values)
            rules = _Rules(matrices, _is_split(y), cuts)
            outs, _ = _evaluate(code, (*parameters, *values), fixed, rules, needed)
        else:
            outs = jaxpr_as_fun(ClosedJaxpr(code, join(parameters)))(*values)
        return split(jtu.tree_unflatten(jtu.tree_structure(out), outs), matrices)

    parameters = list(map(jnp.asarray, jaxpr.consts))
    return program, parameters, _is_straight(code), not jaxpr.effects and _has_jvp(code)


def _is_straight(jaxpr: Jaxpr) -> bool:
    """Whether no small matrix goes through a branch or a loop."""

    def is_matrix(v: Any) -> bool:
        return v.aval.ndim > 1 and _is_small(v.aval.shape, matrices=True)

    return all(
        _is_straight(eqn.params["jaxpr"].jaxpr)
        if eqn.primitive.name in _CALLS
        else eqn.primitive.name not in _BRANCHES or not any(map(is_matrix, eqn.invars))
        for eqn in jaxpr.eqns
    )


def _has_jvp(jaxpr: Jaxpr) -> bool:
    """Whether no function in it has a rule for reverse mode alone."""
    return all(
        "custom_vjp" not in eqn.primitive.name and all(map(_has_jvp, jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )


class _Rules(NamedTuple):
    """What is taken apart besides vectors, if fixed divisors become reciprocals, and if there are
    cuts outside of batches.
    """

    matrices: bool
    reciprocals: bool
    cuts: bool


def _evaluate(
    jaxpr: Jaxpr,
    values: Sequence[Any],
    fixed: Sequence[bool],
    rules: _Rules,
    needed: Sequence[Any],
) -> tuple[list[Any], list[bool]]:
    """What a program makes of values for its constants and arguments, some of which are fixed.

    Fixed results are those that depend on nothing else. Those in `needed` are not dead code.
    """
    env: dict[Any, Any] = {}
    loose: set[Any] = set()

    def read(v: Any) -> Any:
        aval: Any = v.aval
        return jnp.asarray(v.val, aval.dtype) if isinstance(v, Literal) else env[v]

    def is_fixed(v: Any) -> bool:
        return isinstance(v, Literal) or v not in loose

    variables = (*jaxpr.constvars, *jaxpr.invars)
    for variable, value, is_one in zip(variables, values, fixed, strict=True):
        if not isinstance(value, Components):
            # What is known before the program runs may still be NumPy's.
            value = jnp.asarray(value)
        env[variable] = _components(value) if _is_small(value.shape, rules.matrices) else value
        if not is_one:
            loose.add(variable)
    cuts = _cuts(jaxpr, rules)
    for k, eqn in enumerate(jaxpr.eqns):
        if k in cuts:
            for used in _used(jaxpr, k, needed):
                live = [v for v in used if v in env]
                values = _held([env[v] for v in live], now=cuts[k], alone=rules.cuts)
                env.update(zip(live, values, strict=True))
        values = [read(v) for v in eqn.invars]
        fixed = [is_fixed(v) for v in eqn.invars]
        outs_fixed = [all(fixed)] * len(eqn.outvars)
        name = eqn.primitive.name
        if name in _CALLS:
            inner = eqn.params["jaxpr"]
            constants = [True] * len(inner.consts)
            outs, outs_fixed = _evaluate(
                inner.jaxpr,
                (*inner.consts, *values),
                (*constants, *fixed),
                rules,
                inner.jaxpr.outvars,
            )
        elif eqn.primitive is unpack_p and isinstance(values[0], Components):
            places = np.moveaxis(_places(values[0]), eqn.params["axis"], 0)
            outs = [values[0].at(np.asarray(part)) for part in places]
        elif eqn.primitive is held_p and np.shape(values[0]) != ():
            # What is whole is in memory anyway.
            outs = [
                _components(held([_whole(x)], **eqn.params)[0]) if _is_components(x) else x
                for x in values
            ]
        else:
            out = _in_components(eqn, name, values, fixed, rules)
            outs = [out] if out is not None else evaluate(jaxpr, eqn, list(map(_whole, values)))
        env.update(zip(eqn.outvars, outs, strict=True))
        loose.update(v for v, is_one in zip(eqn.outvars, outs_fixed, strict=True) if not is_one)
    return [read(v) for v in jaxpr.outvars], [is_fixed(v) for v in jaxpr.outvars]


def _held(tree: Any, now: bool, alone: bool = True) -> Any:
    """The same, with all single numbers through memory, but constants."""
    leaves, structure = jtu.tree_flatten(tree, is_leaf=_is_components)
    groups = [x.entries if _is_components(x) else (x,) for x in leaves]
    numbers = [x for group in groups for x in group if _is_number(x)]
    if not numbers:
        return tree
    new = iter(held(numbers, in_batches=True, alone=alone, now=now))
    groups = [[next(new) if _is_number(x) else x for x in group] for group in groups]
    leaves = [
        Components(group, x.shape) if _is_components(x) else group[0]
        for x, group in zip(leaves, groups, strict=True)
    ]
    return jtu.tree_unflatten(structure, leaves)


def _is_number(x: Any) -> bool:
    return isinstance(x, Tracer) and x.ndim == 0 and jnp.issubdtype(x.dtype, jnp.inexact)


def _cuts(jaxpr: Jaxpr, rules: _Rules) -> dict[int, bool]:
    """Before which operations a long program is cut, and whether not only in derivatives.

    What is used after a cut goes through memory, also what has been held before: the derivative in
    it is then a sum over what comes after the cut, and is held too.
    """
    most = _MAX_OPERATIONS[rules.matrices]
    counts = [_operations(eqn, rules.matrices) for eqn in jaxpr.eqns]
    # These have cuts of their own.
    counts = [n if n <= most else 0 for n in counts]
    segments = math.ceil(sum(counts) / most)
    ends = sum(counts) * np.arange(1, segments) / segments
    places = np.searchsorted(np.cumsum([0, *counts]), ends)
    return {int(place): n % _CUTS_OF_VALUES == 0 for n, place in enumerate(places, 1)}


def _used(jaxpr: Jaxpr, place: int, needed: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """What an operation and those after it use for results that are needed, and else."""
    wanted = dict.fromkeys(variables(needed))
    others = dict.fromkeys(variables(jaxpr.outvars))
    for eqn in reversed(jaxpr.eqns[place:]):
        is_needed = eqn.effects or not wanted.keys().isdisjoint(eqn.outvars)
        (wanted if is_needed else others).update(dict.fromkeys(variables(eqn.invars)))
    return list(wanted), [v for v in others if v not in wanted]


def _operations(eqn: JaxprEqn, matrices: bool) -> int:
    """About how many operations on single numbers or whole arrays there will be."""
    if eqn.primitive.name in _CALLS:
        return sum(_operations(inner, matrices) for inner in eqn.params["jaxpr"].jaxpr.eqns)
    if eqn.primitive.name in _MOVES or eqn.primitive in (pack_p, unpack_p):
        return 0
    terms = 1
    if eqn.primitive.name == "dot_general":
        left: Any = eqn.invars[0].aval
        (axes, _), _ = eqn.params["dimension_numbers"]
        terms = 2 * math.prod(left.shape[k] for k in axes)
    shapes: list[tuple[int, ...]] = [getattr(v.aval, "shape", ()) for v in eqn.outvars]
    return sum(terms * math.prod(x) if x == () or _is_small(x, matrices) else 1 for x in shapes)


def _in_components(
    eqn: JaxprEqn, name: str, values: list[Any], fixed: Sequence[bool], rules: _Rules
) -> Any:
    """The result of one operation, if there is a rule for it, else None."""
    if eqn.primitive.multiple_results:
        return None
    aval: Any = eqn.outvars[0].aval
    shape = getattr(aval, "shape", None)
    if shape is None or not (shape == () or _is_small(shape, rules.matrices)):
        return None
    if name == "div" and fixed == [False, True] and jnp.issubdtype(aval.dtype, jnp.floating):
        if rules.reciprocals:
            return _by_reciprocal(values[0], values[1], shape)
    if shape != ():
        if name in _CHEAP or name in _EXPENSIVE:
            rows = list(zip(*(_components(v, shape).entries for v in values), strict=True))
            if name in _CHEAP:
                return Components((eqn.primitive.bind(*row, **eqn.params) for row in rows), shape)
            return _expensive(eqn, rows, shape)
        if eqn.primitive is pack_p:
            return _moved(values, lambda *places: np.stack(places, eqn.params["axis"]))
        if name == "concatenate":
            axis = eqn.params["dimension"]
            return _moved(values, lambda *places: np.concatenate(places, axis))
    if values and (isinstance(values[0], Components) or name == "broadcast_in_dim"):
        if name in _MOVES:
            return _moved(values[:1], lambda places: _MOVES[name](places, shape, eqn.params))
        if name == "reduce_sum":
            return _summed(values[0], eqn.params["axes"], shape)
    if name == "dot_general" and _is_plain_product(eqn, values, fixed):
        return _product(values[0], values[1], eqn.params["dimension_numbers"][0], shape)
    return None


def _broadcast(places: np.ndarray, shape: tuple[int, ...], params: dict[str, Any]) -> np.ndarray:
    sides = [1] * len(shape)
    for k, n in zip(params["broadcast_dimensions"], places.shape, strict=True):
        sides[k] = n
    return np.broadcast_to(places.reshape(sides), shape)


def _slice(places: np.ndarray, shape: tuple[int, ...], params: dict[str, Any]) -> np.ndarray:
    starts, limits = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or [1] * len(shape)
    return places[tuple(slice(*ends) for ends in zip(starts, limits, strides, strict=True))]


# Operations that only move entries: what they do to an array of places.
_MOVES: dict[str, Callable[[np.ndarray, tuple[int, ...], dict[str, Any]], np.ndarray]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda places, shape, params: places.reshape(shape),
    "squeeze": lambda places, shape, params: places.reshape(shape),
    "slice": _slice,
    "transpose": lambda places, shape, params: places.transpose(params["permutation"]),
    "rev": lambda places, shape, params: np.flip(places, params["dimensions"]),
}


def _moved(values: Sequence[Any], move: Callable[..., np.ndarray]) -> Any:
    arrays = list(map(_components, values))
    entries = [entry for x in arrays for entry in x.entries]
    firsts = np.cumsum([0, *(len(x.entries) for x in arrays)])
    places = move(*(np.asarray(n + _places(x)) for n, x in zip(firsts, arrays, strict=False)))
    return Components(entries, (len(entries),)).at(places)


def _summed(x: Components, axes: Sequence[SupportsIndex], shape: tuple[int, ...]) -> Any:
    kept = [k for k in range(len(x.shape)) if k not in axes]
    rows = _places(x).transpose(*kept, *axes).reshape(math.prod(shape), -1)
    return _shaped([functools.reduce(operator.add, x.at(row).entries) for row in rows], shape)


def _by_reciprocal(x: Any, divisor: Any, shape: tuple[int, ...]) -> Any:
    # Each reciprocal once, also if there is one divisor for all entries.
    divisor = jtu.tree_map(lambda entry: lax.integer_pow(entry, -1), divisor)
    if shape == ():
        return x * divisor
    pairs = zip(_components(x, shape).entries, _components(divisor, shape).entries, strict=True)
    return Components((a * b for a, b in pairs), shape)


def _expensive(eqn: JaxprEqn, rows: Sequence[tuple], shape: tuple[int, ...]) -> Components:
    """An operation that XLA never repeats, but writes to memory as often as it occurs.

    For a single system one vector goes through memory faster than several scalars. In a batch
    every component is a long vector of its own.
    """

    def by_component(rows):
        return tuple(eqn.primitive.bind(*row, **eqn.params) for row in rows)

    def whole(rows):
        columns = (pack(column) for column in zip(*rows, strict=True))
        return tuple(unpack(eqn.primitive.bind(*columns, **eqn.params)))

    rows = jtu.tree_map(jnp.asarray, tuple(rows))
    # A constant by the time XLA sees it, so only one of the two is compiled.
    batched = _is_batched(jtu.tree_map(lambda x: x != x, rows))
    return Components(lax.cond(batched, by_component, whole, rows), shape)


@custom_vmap
def _is_batched(values: PyTree) -> Array:
    """Whether any of the values, which are not differentiable, is batched by a `vmap`."""
    return jnp.asarray(False)


@_is_batched.def_vmap
def _(axis_size: int, in_batched: PyTree, values: PyTree) -> tuple[Array, bool]:
    return jnp.asarray(True), False


def _is_plain_product(eqn: JaxprEqn, values: Sequence[Any], fixed: Sequence[bool]) -> bool:
    """A small product of vectors or matrices, of one dtype.

    Not with a part of the state that is whole: taking that apart is slower, above all backwards.
    """
    contracted, batched = eqn.params["dimension_numbers"]
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    terms = math.prod(avals[0].shape[k] for k in contracted[0])
    return (
        any(map(_is_components, values))
        and all(is_one or _is_components(v) for v, is_one in zip(values, fixed, strict=True))
        and batched == ((), ())
        and len({aval.dtype for aval in avals}) == 1
        and 1 <= avals[2].size * terms <= _MAX_PRODUCT
    )


def _product(left: Any, right: Any, contracted: Any, shape: tuple[int, ...]) -> Any:
    rows, columns = (
        np.moveaxis(_places(x), axes, range(len(axes)))
        .reshape(math.prod(x.shape[k] for k in axes), -1)
        .T
        for x, axes in zip(map(_components, (left, right)), contracted, strict=True)
    )
    left, right = _components(left), _components(right)
    dots = [_dot(left.at(a).entries, right.at(b).entries) for a in rows for b in columns]
    return _shaped(dots, shape)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return functools.reduce(operator.add, (x * y for x, y in zip(a, b, strict=True)))


def _is_split(tree: PyTree) -> bool:
    """Whether all of it is in components or a single number."""
    leaves = jtu.tree_leaves(tree, is_leaf=_is_components)
    return all(_is_components(x) or jnp.ndim(x) == 0 for x in leaves)


def _has_components(tree: PyTree) -> bool:
    return any(map(_is_components, jtu.tree_leaves(tree, is_leaf=_is_components)))


def _is_components(x: Any) -> bool:
    return isinstance(x, Components)


def _is_small(shape: tuple[int, ...], matrices: bool) -> bool:
    if matrices:
        return len(shape) > 0 and 1 <= math.prod(shape) <= _MAX_SIZE
    return len(shape) == 1 and 1 <= shape[0] <= _MAX_LENGTH


def _shaped(entries: Sequence[Any], shape: tuple[int, ...]) -> Any:
    return Components(entries, shape) if shape else entries[0]


def _places(x: Components) -> np.ndarray:
    return np.arange(len(x.entries)).reshape(x.shape)


def _components(x: Any, shape: tuple[int, ...] = ()) -> Components:
    """An array in components; with a shape, broadcast to it."""
    if not isinstance(x, Components):
        x = Components(unpack(jnp.ravel(x)) if jnp.ndim(x) else [x], jnp.shape(x))
    return x if shape in ((), x.shape) else x.at(np.broadcast_to(_places(x), shape))


def _whole(x: Any) -> Any:
    return pack(x.entries).reshape(x.shape) if isinstance(x, Components) else x
