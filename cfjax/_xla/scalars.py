"""Small arrays as their entries, and what operations make of them."""

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import Jaxpr, JaxprEqn, Literal
from jaxtyping import Array

from .operation import evaluate
from .pack import pack, pack_p, unpack, unpack_p
from .scope import MAX_SIZE, is_numeric
from .understood import ELEMENTWISE, REDUCTIONS, is_understood

# Of the products of numbers that a product of arrays is scalarised into.
MAX_PRODUCT = 216

SCATTERS: dict[str, Callable[[Any, Any], Any]] = {
    "scatter-add": operator.add,
    "scatter-mul": operator.mul,
    "scatter_add": operator.add,
    "scatter_mul": operator.mul,
}


@jtu.register_pytree_node_class
class Scalars:
    """A small array as its entries, which are numbers, row by row."""

    def __init__(self, entries: Iterable[Any], shape: tuple[int, ...]):
        self.entries = tuple(entries)
        self.shape = shape

    def at(self, places: np.ndarray) -> Any:
        """The entries at some places, which are their numbers: an array, or one entry."""
        if places.ndim == 0:
            return self.entries[int(places)]
        return Scalars([self.entries[k] for k in places.flat], places.shape)

    def whole(self) -> Array:
        return pack(list(map(jnp.asarray, self.entries))).reshape(self.shape)

    def tree_flatten(self) -> tuple[tuple, tuple[int, ...]]:
        return self.entries, self.shape

    @classmethod
    def tree_unflatten(cls, shape, children):
        return cls(children, shape)


def literal(v: Literal) -> Any:
    aval: Any = v.aval
    # Integers stay NumPy's, so that it is known which entries an index takes.
    number = np.asarray if not jnp.issubdtype(aval.dtype, jnp.inexact) else jnp.asarray
    return number(v.val, aval.dtype)


def on_scalars(jaxpr: Jaxpr, eqn: JaxprEqn, values: list[Any]) -> Sequence[Any] | None:
    """The results of one operation, if there is a rule for it, otherwise None."""
    name = eqn.primitive.name
    avals: list[Any] = [v.aval for v in eqn.outvars]
    if not all(is_numeric(v.aval) for v in (*eqn.invars, *eqn.outvars)):
        return None
    constants = list(map(known, values))
    is_known = not any(x is None for x in constants) and not any(map(is_inexact, avals))
    if is_known and not eqn.effects:
        with jax.ensure_compile_time_eval():
            return list(map(np.asarray, evaluate(jaxpr, eqn, constants)))
    shapes: list[Any] = [aval.shape for aval in avals]
    if not is_understood(eqn) or not all(1 <= math.prod(shape) <= MAX_SIZE for shape in shapes):
        return None
    if eqn.primitive is unpack_p or name == "split":
        if not is_scalars(values[0]):
            return None
        axis = eqn.params["axis"]
        places = places_of(values[0])
        if eqn.primitive is unpack_p:
            parts = [places.take(k, axis) for k in range(places.shape[axis])]
        else:
            parts = np.split(places, np.cumsum(eqn.params["sizes"])[:-1], axis)
        return [values[0].at(np.asarray(part)) for part in parts]
    if eqn.primitive.multiple_results or any(map(_is_whole, values)):
        return None
    if name in MOVES:
        if not any(map(is_scalars, values)) and name not in _FROM_NUMBERS:
            return None
        return moved(eqn, values, shapes[0])
    if eqn.primitive is pack_p or name == "stack":
        return _arranged(values, lambda *places: np.stack(places, eqn.params["axis"]))
    if name in SCATTERS and is_scalars(values[0]):
        return scattered_into(SCATTERS[name], values, eqn.params, shapes[0])
    if shapes[0] != () and name in ELEMENTWISE:
        rows = zip(*(scalars(v, shapes[0]).entries for v in values), strict=True)
        return [Scalars((eqn.primitive.bind(*row, **eqn.params) for row in rows), shapes[0])]
    if name in REDUCTIONS and is_scalars(values[0]) and not is_lexicographic(eqn):
        return [_reduced(reduction(eqn), values[0], eqn.params["axes"], shapes[0])]
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
MOVES: dict[str, Callable[[np.ndarray, tuple[int, ...], dict[str, Any]], np.ndarray] | None] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": None,
    "dynamic_slice": None,
    "dynamic_update_slice": None,
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
_FROM_NUMBERS = frozenset(("broadcast_in_dim", "reshape"))
# Of the others: which operands are arrays whose entries are moved. The rest are indices.
_MOVED_OPERANDS = {
    "concatenate": slice(None),
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "pad": slice(2),
    "scatter": slice(0, None, 2),
}


def moved(eqn: JaxprEqn, values: Sequence[Any], shape: tuple[int, ...]) -> Sequence[Any] | None:
    name = eqn.primitive.name
    move = MOVES[name]
    if move is not None:
        return _arranged(values, lambda places: move(places, shape, eqn.params))
    if name == "concatenate":
        return _arranged(values, lambda *places: np.concatenate(places, eqn.params["dimension"]))
    moved = range(len(values))[_MOVED_OPERANDS[name]]
    indices = {k: known(x) for k, x in enumerate(values) if k not in moved}
    if any(x is None for x in indices.values()):
        return None

    def by_jax(*places: np.ndarray) -> np.ndarray:
        numbers = (np.asarray(x, np.int32) for x in places)
        operands = indices | dict(zip(moved, numbers, strict=True))
        operands = [jnp.asarray(operands[k]) for k in range(len(values))]
        if name == "scatter":
            return _scattered(operands, eqn.params)
        params = eqn.params
        if name == "gather":
            # What fills is no entry, nor is what was promised not to be asked for.
            is_clipped = params["mode"] == lax.GatherScatterMode.CLIP
            mode = lax.GatherScatterMode.CLIP if is_clipped else lax.GatherScatterMode.FILL_OR_DROP
            params = params | {"fill_value": -1, "mode": mode}
        return np.asarray(eqn.primitive.bind(*operands, **params))

    with jax.ensure_compile_time_eval():
        return _arranged([values[k] for k in moved], by_jax)


def _scattered(operands: Sequence[Array], params: dict[str, Any]) -> np.ndarray:
    names = "dimension_numbers", "indices_are_sorted", "unique_indices", "mode"
    options: dict[str, Any] = {k: params[k] for k in names}
    x, indices, updates = operands
    return np.asarray(lax.scatter(x, indices, updates, **options))


def scattered_into(
    combine: Callable[[Any, Any], Any],
    values: Sequence[Any],
    params: dict[str, Any],
    shape: tuple[int, ...],
) -> Sequence[Any] | None:
    indices = known(values[1])
    if indices is None:
        return None
    x, updates = scalars(values[0]), scalars(values[2])
    with jax.ensure_compile_time_eval():
        none = jnp.full(shape, -1, np.int32)
        places = jnp.asarray(np.asarray(places_of(updates), np.int32))
        taken = _scattered((none, jnp.asarray(indices), places), params)
    used = taken[taken >= 0]
    if len(np.unique(used)) < len(updates.entries):
        return None  # Some go to one entry, or to none.
    outs = (
        combine(entry, updates.entries[k]) if k >= 0 else entry
        for entry, k in zip(x.entries, taken.flat, strict=True)
    )
    return [Scalars(outs, shape)]


def _arranged(values: Sequence[Any], move: Callable[..., np.ndarray]) -> list[Any] | None:
    """What results from moving entries; None if it has others too."""
    arrays = list(map(scalars, values))
    entries = [entry for x in arrays for entry in x.entries]
    firsts = np.cumsum([0, *(len(x.entries) for x in arrays)])
    places = move(*(np.asarray(n + places_of(x)) for n, x in zip(firsts, arrays, strict=False)))
    if places.size and not (0 <= places.min() and places.max() < len(entries)):
        return None
    return [Scalars(entries, (len(entries),)).at(np.asarray(places))]


def reduction(eqn: JaxprEqn) -> Callable[[Sequence[Any]], Any]:
    """What a reduction makes of the entries that it reduces, all of one shape."""
    name, aval = eqn.primitive.name, eqn.outvars[0].aval
    if is_extreme(eqn) and is_inexact(aval):
        return functools.partial(_extreme, _EXTREMES[name])
    return functools.partial(functools.reduce, _COMBINED[name])


def is_extreme(eqn: JaxprEqn) -> bool:
    return eqn.primitive.name in _EXTREMES


def is_lexicographic(eqn: JaxprEqn) -> bool:
    aval: Any = eqn.outvars[0].aval
    return is_extreme(eqn) and jnp.issubdtype(aval.dtype, jnp.complexfloating)


_EXTREMES: dict[str, Callable[[Any, Any], Any]] = {"reduce_max": lax.max, "reduce_min": lax.min}
_COMBINED = _EXTREMES | {
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
    "reduce_prod": operator.mul,
    "reduce_sum": operator.add,
}


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _extreme(combine: Callable[[Any, Any], Any], entries: Sequence[Any]) -> Any:
    """The largest or smallest; the derivative is shared evenly by all that are, as in JAX."""
    return functools.reduce(combine, entries)


@_extreme.defjvp
def _(combine, primals, tangents):
    (entries,), (moving,) = primals, tangents
    extreme = _extreme(combine, entries)
    shares = [lax.convert_element_type(lax.eq(x, extreme), extreme.dtype) for x in entries]
    total = functools.reduce(operator.add, map(operator.mul, moving, shares))
    return extreme, total / functools.reduce(operator.add, shares)


def _reduced(
    combine: Callable[[Sequence[Any]], Any],
    x: Scalars,
    axes: Sequence[int],
    shape: tuple[int, ...],
) -> Any:
    kept = [k for k in range(len(x.shape)) if k not in axes]
    rows = places_of(x).transpose(*kept, *axes).reshape(math.prod(shape), -1)
    return _shaped([combine([jnp.asarray(e) for e in x.at(row).entries]) for row in rows], shape)


def _is_plain_product(eqn: JaxprEqn) -> bool:
    """A small product of one dtype with something to sum up."""
    (axes, _), _ = eqn.params["dimension_numbers"]
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    terms = math.prod(avals[0].shape[k] for k in axes)
    return len({aval.dtype for aval in avals}) == 1 and 1 <= avals[2].size * terms <= MAX_PRODUCT


def _product(left: Any, right: Any, dimensions: Any, shape: tuple[int, ...]) -> Any:
    contracted, batched = dimensions
    left, right = map(scalars, (left, right))

    def rows(x: Scalars, contracted: Sequence[int], batched: Sequence[int]) -> np.ndarray:
        """The places, by batch, by row, by what is summed."""
        free = [k for k in range(len(x.shape)) if k not in (*contracted, *batched)]
        batch, terms = (math.prod(x.shape[k] for k in axes) for axes in (batched, contracted))
        return places_of(x).transpose(*batched, *free, *contracted).reshape(batch, -1, terms)

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


def is_inexact(aval: Any) -> bool:
    return not hasattr(aval, "dtype") or jnp.issubdtype(aval.dtype, jnp.inexact)


def is_scalars(x: Any) -> bool:
    return isinstance(x, Scalars)


def _is_whole(x: Any) -> bool:
    return not isinstance(x, Scalars | np.ndarray) and np.ndim(x) > 0


def is_small(x: Any) -> bool:
    """Whether this is an array to scalarise. NumPy's are known while the program is made."""
    return _is_whole(x) and 1 <= np.size(x) <= MAX_SIZE and is_numeric(x)


def known(x: Any) -> np.ndarray | None:
    if isinstance(x, Scalars):
        entries = list(map(known, x.entries))
        return None if any(e is None for e in entries) else np.asarray(entries).reshape(x.shape)
    return np.asarray(x) if isinstance(x, np.ndarray | np.generic) else None


def _shaped(entries: Sequence[Any], shape: tuple[int, ...]) -> Any:
    return Scalars(entries, shape) if shape else entries[0]


def places_of(x: Scalars) -> np.ndarray:
    return np.arange(len(x.entries)).reshape(x.shape)


def scalars(x: Any, shape: tuple[int, ...] = ()) -> Scalars:
    """An array as its entries; with a shape, broadcast to it."""
    if isinstance(x, np.ndarray):
        x = Scalars([np.asarray(entry) for entry in x.flat], x.shape)
    elif not isinstance(x, Scalars):
        x = Scalars(unpack(jnp.ravel(x)) if jnp.ndim(x) else [x], jnp.shape(x))
    return x if shape in ((), x.shape) else x.at(np.broadcast_to(places_of(x), shape))
