"""A step of a small system on single numbers instead of short vectors.

XLA fuses numbers well and vectors of three badly: it computes what several entries need once for
each of them, or sends it through memory. So the program of a step is read, and evaluated again with
every small array held as its entries.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
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
    jaxprs_in_params,
)
from jaxtyping import Array, PyTree

from .held import held, held_p
from .operation import evaluate, operation, without_dead_code
from .pack import pack, pack_p, unpack, unpack_p
from .scope import Place, is_numeric, is_on, is_short, unread, where, within

# A state is taken apart if all of it is numbers and short vectors, so many entries together, and if
# a step is not longer than that, counted in operations on single numbers: the time to compile grows
# with it, and more so in derivatives. `README.md` here has what that buys and costs.
_MAX_ENTRIES = 16
_MAX_OPERATIONS = 3000
# Within a step arrays made from them too, and constants: the 4 x 4 matrix of a quaternion, and the
# 4 x 4 x 4 numbers that multiply two.
_MAX_SIZE = 64
_MAX_PRODUCT = 216

_ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp complex conj "
    "convert_element_type copy cos cosh div eq erf exp exp2 expm1 floor ge gt imag integer_pow "
    "is_finite le log log1p logistic lt max min mul ne neg not or pow real rem round rsqrt "
    "select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
_REDUCTIONS: dict[str, Callable[[Any, Any], Any]] = {
    "reduce_and": operator.and_,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_or": operator.or_,
    "reduce_prod": operator.mul,
    "reduce_sum": operator.add,
}
_SCATTERS: dict[str, Callable[[Any, Any], Any]] = {
    "scatter-add": operator.add,
    "scatter-mul": operator.mul,
    "scatter_add": operator.add,
    "scatter_mul": operator.mul,
}
_CALLS = frozenset(("jit", "pjit"))
_CONTROL = frozenset(("cond", "scan", "while"))


@jtu.register_pytree_node_class
class Components:
    """A small array as its entries, which are numbers, row by row."""

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


def split(tree: PyTree) -> PyTree:
    """The tree with every small array in components."""
    return jtu.tree_map(lambda x: _components(x) if _is_small(x) else x, tree)


def join(tree: PyTree) -> PyTree:
    """The reverse of `split`."""
    return jtu.tree_map(_whole, tree, is_leaf=_is_components)


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
    y, parameters = _held(split((y, program.parameters)))
    # The derivative of an adaptive loop computes a step at one place and uses its derivative at
    # another. What that needs of the step is many numbers: to compute them again is cheaper than to
    # send them there through memory.
    out = operation(program.run, y, parameters, place="step")
    # One by one: what nobody uses is not computed.
    return jtu.tree_map(lambda x: _whole(_held(x)), out, is_leaf=_is_components)


class Program(NamedTuple):
    """A function that can be taken apart, and what it closes over.

    `run(y, parameters)` takes both split, returns what is split and closes over nothing traced.
    """

    run: Callable[[PyTree, PyTree], PyTree]
    parameters: list[Array]


def trace(fun: Callable[[PyTree], PyTree], y: PyTree, place: Place) -> Program | None:
    """`fun` as a program to take apart at `y`; None if that does not pay or cannot be done.

    It must have no effects, no branches or loops, and no function with a rule for reverse mode
    alone.
    """
    if not is_on() or not _is_small_state(y):
        return None
    with within(place):
        jaxpr, out = jax.make_jaxpr(fun, return_shape=True)(y)
    structure = jtu.tree_structure(out)
    consts = [_constant(x) for x in jaxpr.consts]
    try:
        code = without_dead_code(jaxpr.jaxpr)
        if jaxpr.effects or not _is_readable(code) or _operations(code) > _MAX_OPERATIONS:
            return None
    except Exception as error:
        return unread(error)

    def run(y: PyTree, parameters: PyTree) -> PyTree:
        rest = iter(parameters)
        values = [next(rest) if x is None else x for x in consts]
        moving = jtu.tree_leaves(y, is_leaf=_is_components)
        fixed = [True] * len(values) + [False] * len(moving)
        try:
            outs, _ = _evaluate(code, (*values, *moving), fixed)
        except Exception as error:
            unread(error)
            outs = jaxpr_as_fun(ClosedJaxpr(code, list(map(_whole, values))))(*map(_whole, moving))
        # What is known before the program runs may come out as NumPy's.
        outs = [x if _is_components(x) else jnp.asarray(x) for x in outs]
        return split(jtu.tree_unflatten(structure, outs))

    parameters = [
        jnp.asarray(x) for x, known in zip(jaxpr.consts, consts, strict=True) if known is None
    ]
    return Program(run, parameters)


def _constant(x: Any) -> np.ndarray | None:
    """An array of indices that is known now."""
    if isinstance(x, Tracer) or not isinstance(x, jax.Array | np.ndarray | np.generic):
        return None
    return None if np.size(x) > _MAX_SIZE or _is_inexact(x) or not is_numeric(x) else np.asarray(x)


def _is_small_state(y: PyTree) -> bool:
    leaves = jtu.tree_leaves(y)
    return (
        any(map(is_short, leaves))
        and all(is_short(x) or (np.ndim(x) == 0 and is_numeric(x)) for x in leaves)
        and sum(map(np.size, leaves)) <= _MAX_ENTRIES
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
    if name in _MOVES or name in ("split", "stack") or eqn.primitive in (pack_p, unpack_p):
        return 0
    terms = 1
    if name == "dot_general":
        left: Any = eqn.invars[0].aval
        (axes, _), _ = eqn.params["dimension_numbers"]
        terms = 2 * math.prod(left.shape[k] for k in axes)
    elif name in _REDUCTIONS:
        terms = math.prod(getattr(eqn.invars[0].aval, "shape", ()))
    shapes: list[tuple[int, ...]] = [getattr(v.aval, "shape", ()) for v in eqn.outvars]
    sizes = map(math.prod, shapes)
    return sum(terms * n if n <= _MAX_SIZE else 1 for n in sizes)


def _evaluate(
    jaxpr: Jaxpr, values: Sequence[Any], fixed: Sequence[bool]
) -> tuple[list[Any], list[bool]]:
    """What a program makes of values for its constants and arguments, some of which are fixed.

    Fixed results are those that depend on nothing else.
    """
    env: dict[Any, Any] = {}
    loose: set[Any] = set()

    def read(v: Any) -> Any:
        return _literal(v) if isinstance(v, Literal) else env[v]

    def is_fixed(v: Any) -> bool:
        return isinstance(v, Literal) or v not in loose

    variables = (*jaxpr.constvars, *jaxpr.invars)
    for variable, value, is_one in zip(variables, values, fixed, strict=True):
        env[variable] = _components(value) if _is_small(value) else value
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
                inner.jaxpr, (*inner.consts, *values), (*constants, *fixed)
            )
        else:
            outs = _in_components(jaxpr, eqn, values, fixed)
            if outs is None:
                outs = map(split, evaluate(jaxpr, eqn, list(map(_whole, values))))
        env.update(zip(eqn.outvars, outs, strict=True))
        loose.update(v for v, is_one in zip(eqn.outvars, outs_fixed, strict=True) if not is_one)
    return [read(v) for v in jaxpr.outvars], [is_fixed(v) for v in jaxpr.outvars]


def _literal(v: Literal) -> Any:
    aval: Any = v.aval
    # Integers stay NumPy's, so that it is known which entries an index takes.
    number = np.asarray if not jnp.issubdtype(aval.dtype, jnp.inexact) else jnp.asarray
    return number(v.val, aval.dtype)


def _in_components(
    jaxpr: Jaxpr, eqn: JaxprEqn, values: list[Any], fixed: Sequence[bool]
) -> Sequence[Any] | None:
    """The results of one operation, if there is a rule for it, else None."""
    name = eqn.primitive.name
    avals: list[Any] = [v.aval for v in eqn.outvars]
    known = list(map(_known, values))
    if not any(x is None for x in known) and not any(map(_is_inexact, avals)) and not eqn.effects:
        with jax.ensure_compile_time_eval():
            return list(map(np.asarray, evaluate(jaxpr, eqn, known)))
    shapes: list[Any] = [getattr(aval, "shape", None) for aval in avals]
    if eqn.primitive is held_p:
        # What is whole is in memory anyway.
        groups = [_components(x).entries if _is_components(x) else (x,) for x in values]
        new = iter(held([x for group in groups for x in group], **eqn.params))
        return [
            Components([next(new) for _ in group], x.shape) if _is_components(x) else next(new)
            for group, x in zip(groups, values, strict=True)
        ]
    if any(shape is None or not 1 <= math.prod(shape) <= _MAX_SIZE for shape in shapes):
        return None
    if eqn.primitive is unpack_p or name == "split":
        if not _is_components(values[0]):
            return None
        axis = eqn.params["axis"]
        places = _places(values[0])
        if eqn.primitive is unpack_p:
            parts = [places.take(k, axis) for k in range(places.shape[axis])]
        else:
            parts = np.split(places, np.cumsum(eqn.params["sizes"])[:-1], axis)
        return [values[0].at(np.asarray(part)) for part in parts]
    if eqn.primitive.multiple_results or any(map(_is_whole, values)):
        return None
    if name == "div" and list(fixed) == [False, True]:
        if jnp.issubdtype(avals[0].dtype, jnp.floating):
            return [_by_reciprocal(values[0], values[1], shapes[0])]
    if name in _MOVES:
        if not any(map(_is_components, values)) and name not in _FROM_NUMBERS:
            return None
        return _moved(eqn, values, shapes[0])
    if eqn.primitive is pack_p or name == "stack":
        return _arranged(values, lambda *places: np.stack(places, eqn.params["axis"]))
    if name in _SCATTERS and _is_components(values[0]):
        return _scattered_into(_SCATTERS[name], values, eqn.params, shapes[0])
    if shapes[0] != () and name in _ELEMENTWISE:
        rows = zip(*(_components(v, shapes[0]).entries for v in values), strict=True)
        return [Components((eqn.primitive.bind(*row, **eqn.params) for row in rows), shapes[0])]
    if name in _REDUCTIONS and _is_components(values[0]):
        return [_reduced(_REDUCTIONS[name], values[0], eqn.params["axes"], shapes[0])]
    if name == "dot_general" and _is_plain_product(eqn):
        return [_product(values[0], values[1], eqn.params["dimension_numbers"], shapes[0])]
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


# Operations that only move entries: what they do to an array of places. None: JAX itself does it,
# which takes longer.
_MOVES: dict[str, Callable[[np.ndarray, tuple[int, ...], dict[str, Any]], np.ndarray] | None] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": None,
    "dynamic_slice": None,
    "dynamic_update_slice": None,
    "expand_dims": lambda places, shape, params: places.reshape(shape),
    "gather": None,
    "pad": None,
    "reshape": lambda places, shape, params: places.reshape(shape),
    "rev": lambda places, shape, params: np.flip(places, params["dimensions"]),
    "scatter": None,
    "slice": _slice,
    "squeeze": lambda places, shape, params: places.reshape(shape),
    "transpose": lambda places, shape, params: places.transpose(params["permutation"]),
}
# Those that may make a small array from single numbers.
_FROM_NUMBERS = frozenset(("broadcast_in_dim", "reshape", "expand_dims"))
# Of the others: which operands are arrays whose entries are moved. The rest are indices.
_MOVED_OPERANDS = {
    "concatenate": slice(None),
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "pad": slice(2),
    "scatter": slice(0, None, 2),
}


def _moved(eqn: JaxprEqn, values: Sequence[Any], shape: tuple[int, ...]) -> Sequence[Any] | None:
    name = eqn.primitive.name
    move = _MOVES[name]
    if move is not None:
        return _arranged(values, lambda places: move(places, shape, eqn.params))
    if name == "concatenate":
        return _arranged(values, lambda *places: np.concatenate(places, eqn.params["dimension"]))
    moved = range(len(values))[_MOVED_OPERANDS[name]]
    indices = {k: _known(x) for k, x in enumerate(values) if k not in moved}
    if any(x is None for x in indices.values()):
        return None

    def by_jax(*places: np.ndarray) -> np.ndarray:
        given = indices | dict(zip(moved, places, strict=True))
        operands = [jnp.asarray(given[k], int) for k in range(len(values))]
        if name == "scatter":
            return _scattered(operands, eqn.params)
        return np.asarray(eqn.primitive.bind(*operands, **eqn.params))

    with jax.ensure_compile_time_eval():
        return _arranged([values[k] for k in moved], by_jax)


def _scattered(operands: Sequence[Array], params: dict[str, Any]) -> np.ndarray:
    names = "dimension_numbers", "indices_are_sorted", "unique_indices", "mode"
    options: dict[str, Any] = {k: params[k] for k in names}
    x, indices, updates = operands
    return np.asarray(lax.scatter(x, indices, updates, **options))


def _scattered_into(
    combine: Callable[[Any, Any], Any],
    values: Sequence[Any],
    params: dict[str, Any],
    shape: tuple[int, ...],
) -> Sequence[Any] | None:
    indices = _known(values[1])
    if indices is None:
        return None
    x, updates = _components(values[0]), _components(values[2])
    with jax.ensure_compile_time_eval():
        none, places = jnp.full(shape, -1), jnp.asarray(_places(updates))
        taken = _scattered((none, jnp.asarray(indices), places), params)
    used = taken[taken >= 0]
    if len(np.unique(used)) < len(updates.entries):
        return None  # Some go to one entry, or to none.
    outs = (
        combine(entry, updates.entries[k]) if k >= 0 else entry
        for entry, k in zip(x.entries, taken.flat, strict=True)
    )
    return [Components(outs, shape)]


def _arranged(values: Sequence[Any], move: Callable[..., np.ndarray]) -> list[Any] | None:
    """What results from moving entries; None if it has others too."""
    arrays = list(map(_components, values))
    entries = [entry for x in arrays for entry in x.entries]
    firsts = np.cumsum([0, *(len(x.entries) for x in arrays)])
    places = move(*(np.asarray(n + _places(x)) for n, x in zip(firsts, arrays, strict=False)))
    if places.size and not (0 <= places.min() and places.max() < len(entries)):
        return None
    return [Components(entries, (len(entries),)).at(np.asarray(places))]


def _reduced(
    combine: Callable[[Any, Any], Any], x: Components, axes: Sequence[int], shape: tuple[int, ...]
) -> Any:
    kept = [k for k in range(len(x.shape)) if k not in axes]
    rows = _places(x).transpose(*kept, *axes).reshape(math.prod(shape), -1)
    return _shaped([functools.reduce(combine, x.at(row).entries) for row in rows], shape)


def _by_reciprocal(x: Any, divisor: Any, shape: tuple[int, ...]) -> Any:
    # Each reciprocal once, also if there is one divisor for all entries.
    divisor = jtu.tree_map(lambda entry: lax.integer_pow(entry, -1), divisor)
    if shape == ():
        return x * divisor
    pairs = zip(_components(x, shape).entries, _components(divisor, shape).entries, strict=True)
    return Components((a * b for a, b in pairs), shape)


def _is_plain_product(eqn: JaxprEqn) -> bool:
    """A small product of one dtype with something to sum up."""
    (axes, _), _ = eqn.params["dimension_numbers"]
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    terms = math.prod(avals[0].shape[k] for k in axes)
    return len({aval.dtype for aval in avals}) == 1 and 1 <= avals[2].size * terms <= _MAX_PRODUCT


def _product(left: Any, right: Any, dimensions: Any, shape: tuple[int, ...]) -> Any:
    contracted, batched = dimensions
    left, right = map(_components, (left, right))

    def rows(x: Components, contracted: Sequence[int], batched: Sequence[int]) -> np.ndarray:
        """The places, by batch, by row, by what is summed."""
        free = [k for k in range(len(x.shape)) if k not in (*contracted, *batched)]
        batch, terms = (math.prod(x.shape[k] for k in axes) for axes in (batched, contracted))
        return _places(x).transpose(*batched, *free, *contracted).reshape(batch, -1, terms)

    dots = [
        _dot(left.at(a).entries, right.at(b).entries)
        for above, below in zip(
            rows(left, contracted[0], batched[0]),
            rows(right, contracted[1], batched[1]),
            strict=True,
        )
        for a in above
        for b in below
    ]
    return _shaped(dots, shape)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return functools.reduce(operator.add, (x * y for x, y in zip(a, b, strict=True)))


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


def _is_inexact(aval: Any) -> bool:
    return not hasattr(aval, "dtype") or jnp.issubdtype(aval.dtype, jnp.inexact)


def _is_components(x: Any) -> bool:
    return isinstance(x, Components)


def _is_whole(x: Any) -> bool:
    return not isinstance(x, Components | np.ndarray) and np.ndim(x) > 0


def _is_small(x: Any) -> bool:
    """Whether this is an array to take apart. NumPy's are known while the program is made."""
    return _is_whole(x) and 1 <= np.size(x) <= _MAX_SIZE and is_numeric(x)


def _known(x: Any) -> np.ndarray | None:
    if isinstance(x, Components):
        entries = list(map(_known, x.entries))
        return None if any(e is None for e in entries) else np.asarray(entries).reshape(x.shape)
    return np.asarray(x) if isinstance(x, np.ndarray | np.generic) else None


def _shaped(entries: Sequence[Any], shape: tuple[int, ...]) -> Any:
    return Components(entries, shape) if shape else entries[0]


def _places(x: Components) -> np.ndarray:
    return np.arange(len(x.entries)).reshape(x.shape)


def _components(x: Any, shape: tuple[int, ...] = ()) -> Components:
    """An array in components; with a shape, broadcast to it."""
    if isinstance(x, np.ndarray):
        x = Components([np.asarray(entry) for entry in x.flat], x.shape)
    elif not isinstance(x, Components):
        x = Components(unpack(jnp.ravel(x)) if jnp.ndim(x) else [x], jnp.shape(x))
    return x if shape in ((), x.shape) else x.at(np.broadcast_to(_places(x), shape))


def _whole(x: Any) -> Any:
    return pack(list(map(jnp.asarray, x.entries))).reshape(x.shape) if _is_components(x) else x
