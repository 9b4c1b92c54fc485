"""Evaluation of a function with short vectors held as their components.

XLA fuses scalars well and vectors of three badly: it computes what several components need once
for each of them, or sends it through memory. A step of a small system runs several times faster
when no short vector is ever built inside it, above all in a batch.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, DropVar, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun
from jaxtyping import Array, PyTree

from ._functions.pack import pack, pack_p, unpack, unpack_p

# Longer vectors fuse well as they are, and the program grows with the number of components.
_MAX_LENGTH = 6
_MAX_PRODUCT = 16

_CHEAP = frozenset(
    "abs add add_any and ceil clamp complex conj convert_element_type copy eq floor ge gt imag "
    "integer_pow is_finite le lt max min mul ne neg not or real round select_n sign square sub "
    "xor".split()
)
_EXPENSIVE = frozenset(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh div erf exp exp2 expm1 log log1p "
    "logistic pow rem rsqrt sin sinh sqrt tan tanh".split()
)


@jtu.register_pytree_node_class
class Components(tuple):
    """A vector as the tuple of its components, which are scalars."""

    def tree_flatten(self) -> tuple[tuple, None]:
        return tuple(self), None

    @classmethod
    def tree_unflatten(cls, _, children):
        return cls(children)


def split(tree: PyTree) -> PyTree:
    """The tree with every vector of at most six entries in components."""
    return jtu.tree_map(lambda x: _entries(x) if is_short(x) else x, tree)


def join(tree: PyTree) -> PyTree:
    """The reverse of `split`."""
    return jtu.tree_map(_whole, tree, is_leaf=_is_components)


def by_components(fun: Callable[[PyTree], PyTree], y: PyTree) -> PyTree:
    """`fun(y)`, computed with every vector of at most six entries in components.

    `fun` takes whole arrays; `y` and the result are trees that are split. The result agrees with
    that of `fun` to rounding. `fun` may close over traced values. Operations that have no rule here
    get the vector whole, so every function works. Where nothing in `y` is split, this is `fun(y)`.

    Divisions by what no `y` changes become products with the reciprocal, as XLA does for literals:
    a loop then computes the reciprocal once, and a division would be a barrier to fusion. Not so
    where a part of `y` stays whole: there the barrier saves XLA from computing the components anew
    for every entry of that part.
    """
    if not _has_components(y):
        return split(fun(y))
    program, parameters = trace(fun, y)
    return program(y, parameters)


def trace(
    fun: Callable[[PyTree], PyTree], y: PyTree
) -> tuple[Callable[[PyTree, PyTree], PyTree], PyTree]:
    """A program for `by_components`, and what `fun` closes over, split: `program(y, parameters)`.

    The program itself closes over nothing that is traced.
    """
    jaxpr, out = jax.make_jaxpr(fun, return_shape=True)(join(y))

    def program(y: PyTree, parameters: PyTree) -> PyTree:
        if _has_components(y):
            values = jtu.tree_leaves(y, is_leaf=_is_components)
            is_all = all(_is_components(value) or jnp.ndim(value) == 0 for value in values)
            fixed = [is_all] * len(parameters) + [False] * len(values)
            outs, _ = _evaluate(jaxpr.jaxpr, (*parameters, *values), fixed)
        else:
            outs = jaxpr_as_fun(ClosedJaxpr(jaxpr.jaxpr, join(parameters)))(*jtu.tree_leaves(y))
        return split(jtu.tree_unflatten(jtu.tree_structure(out), outs))

    return program, split(list(map(jnp.asarray, jaxpr.consts)))


def _evaluate(
    jaxpr: Jaxpr, values: Sequence[Any], fixed: Sequence[bool]
) -> tuple[list[Any], list[bool]]:
    """What a program makes of values for its constants and arguments, some of which are fixed.

    Fixed results are those that depend on nothing else.
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
        env[variable] = _entries(value) if is_short(value) else value
        if not is_one:
            loose.add(variable)
    for eqn in jaxpr.eqns:
        values = [read(v) for v in eqn.invars]
        fixed = [is_fixed(v) for v in eqn.invars]
        outs_fixed = [all(fixed)] * len(eqn.outvars)
        name = eqn.primitive.name
        if name in ("jit", "pjit"):
            inner = eqn.params["jaxpr"]
            constants = [True] * len(inner.consts)
            outs, outs_fixed = _evaluate(
                inner.jaxpr, (*inner.consts, *values), (*constants, *fixed)
            )
        elif eqn.primitive is unpack_p and isinstance(values[0], Components):
            outs = values[0]
        else:
            out = _in_components(eqn, name, values, fixed)
            outs = [out] if out is not None else _on_whole_arrays(jaxpr, eqn, values)
        env.update(zip(eqn.outvars, outs, strict=True))
        loose.update(v for v, is_one in zip(eqn.outvars, outs_fixed, strict=True) if not is_one)
    return [read(v) for v in jaxpr.outvars], [is_fixed(v) for v in jaxpr.outvars]


def _in_components(eqn: JaxprEqn, name: str, values: list[Any], fixed: Sequence[bool]) -> Any:
    """The result of one operation, if there is a rule for it, else None."""
    aval: Any = eqn.outvars[0].aval if not eqn.primitive.multiple_results else None
    shape = getattr(aval, "shape", None)
    if name == "div" and fixed == [False, True] and _is_small_and_real(aval):
        return _by_reciprocal(values[0], values[1], aval.size)
    if shape is not None and len(shape) == 1 and 1 <= shape[0] <= _MAX_LENGTH:
        if name in _CHEAP or name in _EXPENSIVE:
            rows = list(zip(*(_entries(v, shape[0]) for v in values), strict=True))
            if name in _CHEAP:
                return Components(eqn.primitive.bind(*row, **eqn.params) for row in rows)
            return _expensive(eqn, rows)
        if name == "broadcast_in_dim" and _ndim(values[0]) == 0:
            return Components(values * shape[0])
        if name == "slice" and isinstance(values[0], Components):
            (start,), (stop,) = eqn.params["start_indices"], eqn.params["limit_indices"]
            (stride,) = eqn.params["strides"] or (1,)
            return Components(values[0][start:stop:stride])
        if eqn.primitive is pack_p:
            return Components(values)
        if name == "concatenate":
            return Components(entry for v in values for entry in _entries(v))
        if name == "dot_general" and _is_plain_product(eqn, values):
            return _product(eqn, *values)
    elif shape == () and values and isinstance(values[0], Components):
        if name in ("squeeze", "reshape"):
            return values[0][0]
        if name == "reduce_sum":
            return sum(values[0][1:], start=values[0][0])
        if name == "dot_general" and _is_plain_product(eqn, values):
            return _dot(values[0], _entries(values[1]))
    return None


def _on_whole_arrays(jaxpr: Jaxpr, eqn: JaxprEqn, values: Sequence[Any]) -> Sequence[Any]:
    known = {v: x for v, x in zip(eqn.invars, values, strict=True) if not isinstance(v, Literal)}
    # JAX's own evaluator knows how every operation is called, in every version of JAX.
    alone = jaxpr.replace(
        constvars=[],
        invars=list(known),
        outvars=[v for v in eqn.outvars if not isinstance(v, DropVar)],
        eqns=[eqn],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    outs = iter(jaxpr_as_fun(ClosedJaxpr(alone, []))(*map(_whole, known.values())))
    return [None if isinstance(v, DropVar) else next(outs) for v in eqn.outvars]


def _is_small_and_real(aval: Any) -> bool:
    return aval.ndim <= 1 and aval.size <= _MAX_LENGTH and jnp.issubdtype(aval.dtype, jnp.floating)


def _by_reciprocal(x: Any, divisor: Any, length: int) -> Any:
    if _ndim(x) == 0 and _ndim(divisor) == 0:
        return x * lax.integer_pow(divisor, -1)
    # Each reciprocal once, also if there is one divisor for all entries.
    reciprocals = [lax.integer_pow(entry, -1) for entry in _entries(divisor)]
    entries = zip(_entries(x, length), _entries(Components(reciprocals), length), strict=True)
    return Components(a * b for a, b in entries)


def _expensive(eqn: JaxprEqn, rows: Sequence[tuple]) -> Components:
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
    return Components(lax.cond(batched, by_component, whole, rows))


@custom_vmap
def _is_batched(values: PyTree) -> Array:
    """Whether any of the values, which are not differentiable, is batched by a `vmap`."""
    return jnp.asarray(False)


@_is_batched.def_vmap
def _(axis_size: int, in_batched: PyTree, values: PyTree) -> tuple[Array, bool]:
    return jnp.asarray(True), False


def _is_plain_product(eqn: JaxprEqn, values: Sequence[Any]) -> bool:
    """A vector times a vector or a small matrix, all of one dtype."""
    contracted, batched = eqn.params["dimension_numbers"]
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    return (
        any(isinstance(v, Components) for v in values)
        and all(aval.size <= _MAX_PRODUCT for aval in avals)
        and len({aval.dtype for aval in avals}) == 1
        and tuple(map(len, (*contracted, *batched))) == (1, 1, 0, 0)
    )


def _product(eqn: JaxprEqn, left: Any, right: Any) -> Components:
    (left_axes, right_axes), _ = eqn.params["dimension_numbers"]
    if isinstance(left, Components):
        left, right, left_axes = right, left, right_axes
    rows = left if left_axes == (1,) else left.T
    return Components(_dot(_entries(row), right) for row in rows)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total, *rest = (x * y for x, y in zip(a, b, strict=True))
    return sum(rest, start=total)


def _has_components(tree: PyTree) -> bool:
    return any(map(_is_components, jtu.tree_leaves(tree, is_leaf=_is_components)))


def _is_components(x: Any) -> bool:
    return isinstance(x, Components)


def is_short(x: Any) -> bool:
    return _ndim(x) == 1 and 1 <= len(x) <= _MAX_LENGTH


def _ndim(x: Any) -> int:
    return 1 if isinstance(x, Components) else jnp.ndim(x)


def _entries(x: Any, length: int | None = None) -> Components:
    """The components of a vector; `length` copies of a scalar or of the only entry."""
    if _ndim(x) == 0:
        return Components([x] * (length or 1))
    entries = x if isinstance(x, Components) else Components(unpack(x))
    return Components(entries * length) if length and len(entries) == 1 else entries


def _whole(x: Any) -> Any:
    return pack(x) if isinstance(x, Components) else x
