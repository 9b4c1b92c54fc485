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
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import ClosedJaxpr, DropVar, Jaxpr, JaxprEqn, Literal, jaxpr_as_fun
from jaxtyping import Array, PyTree

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


class _Vector(tuple):
    """A vector as the tuple of its components, which are scalars."""


def by_components(fun: Callable[[PyTree], PyTree], y: PyTree) -> PyTree:
    """`fun(y)`, computed with every vector of at most six entries in components.

    The result agrees with `fun(y)` to rounding. `fun` may close over traced values. Operations
    that have no rule here get the vector whole, so every function works. Where no leaf of `y` is
    a short vector, this is `fun(y)`.
    """
    if not any(_is_short(leaf) for leaf in jtu.tree_leaves(y)):
        return fun(y)
    jaxpr, out = jax.make_jaxpr(fun, return_shape=True)(y)
    values = _evaluate(jaxpr.jaxpr, jaxpr.consts, jtu.tree_leaves(y))
    return jtu.tree_unflatten(jtu.tree_structure(out), [_whole(v) for v in values])


def _evaluate(jaxpr: Jaxpr, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    env: dict[Any, Any] = {}

    def read(v: Any) -> Any:
        aval: Any = v.aval
        return jnp.asarray(v.val, aval.dtype) if isinstance(v, Literal) else env[v]

    for variable, value in zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True):
        if not isinstance(value, _Vector):
            # What is known before the program runs may still be NumPy's.
            value = jnp.asarray(value)
        env[variable] = _entries(value) if _is_short(value) else value
    for eqn in jaxpr.eqns:
        values = [read(v) for v in eqn.invars]
        name = eqn.primitive.name
        if name in ("jit", "pjit"):
            inner = eqn.params["jaxpr"]
            outs = _evaluate(inner.jaxpr, inner.consts, values)
        else:
            out = _in_components(eqn, name, values)
            outs = [out] if out is not None else _on_whole_arrays(jaxpr, eqn, values)
        env.update(zip(eqn.outvars, outs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _in_components(eqn: JaxprEqn, name: str, values: list[Any]) -> Any:
    """The result of one operation, if there is a rule for it, else None."""
    aval: Any = eqn.outvars[0].aval if not eqn.primitive.multiple_results else None
    shape = getattr(aval, "shape", None)
    if shape is not None and len(shape) == 1 and 1 <= shape[0] <= _MAX_LENGTH:
        if name in _CHEAP or name in _EXPENSIVE:
            rows = list(zip(*(_entries(v, shape[0]) for v in values), strict=True))
            if name in _CHEAP:
                return _Vector(eqn.primitive.bind(*row, **eqn.params) for row in rows)
            return _expensive(eqn, rows)
        if name == "broadcast_in_dim" and _ndim(values[0]) == 0:
            return _Vector(values * shape[0])
        if name == "slice" and isinstance(values[0], _Vector):
            (start,), (stop,) = eqn.params["start_indices"], eqn.params["limit_indices"]
            (stride,) = eqn.params["strides"] or (1,)
            return _Vector(values[0][start:stop:stride])
        if name == "concatenate":
            return _Vector(entry for v in values for entry in _entries(v))
        if name == "dot_general" and _is_plain_product(eqn, values):
            return _product(eqn, *values)
    elif shape == () and values and isinstance(values[0], _Vector):
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


def _expensive(eqn: JaxprEqn, rows: Sequence[tuple]) -> _Vector:
    """An operation that XLA never repeats, but writes to memory as often as it occurs.

    For a single system one vector goes through memory faster than several scalars. In a batch
    every component is a long vector of its own.
    """

    def by_component(rows):
        return tuple(eqn.primitive.bind(*row, **eqn.params) for row in rows)

    def whole(rows):
        columns = (jnp.stack(column) for column in zip(*rows, strict=True))
        return tuple(eqn.primitive.bind(*columns, **eqn.params))

    rows = jtu.tree_map(jnp.asarray, tuple(rows))
    # A constant by the time XLA sees it, so only one of the two is compiled.
    batched = _is_batched(jtu.tree_map(lambda x: x != x, rows))
    return _Vector(lax.cond(batched, by_component, whole, rows))


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
        any(isinstance(v, _Vector) for v in values)
        and all(aval.size <= _MAX_PRODUCT for aval in avals)
        and len({aval.dtype for aval in avals}) == 1
        and tuple(map(len, (*contracted, *batched))) == (1, 1, 0, 0)
    )


def _product(eqn: JaxprEqn, left: Any, right: Any) -> _Vector:
    (left_axes, right_axes), _ = eqn.params["dimension_numbers"]
    if isinstance(left, _Vector):
        left, right, left_axes = right, left, right_axes
    rows = left if left_axes == (1,) else left.T
    return _Vector(_dot(_entries(row), right) for row in rows)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total, *rest = (x * y for x, y in zip(a, b, strict=True))
    return sum(rest, start=total)


def _is_short(x: Any) -> bool:
    return _ndim(x) == 1 and 1 <= len(x) <= _MAX_LENGTH


def _ndim(x: Any) -> int:
    return 1 if isinstance(x, _Vector) else jnp.ndim(x)


def _entries(x: Any, length: int | None = None) -> _Vector:
    """The components of a vector; `length` copies of a scalar or of the only entry."""
    if _ndim(x) == 0:
        return _Vector([x] * (length or 1))
    entries = _Vector(x[i] for i in range(len(x)))
    return _Vector(entries * length) if length and len(entries) == 1 else entries


def _whole(x: Any) -> Any:
    """The array of some components. Not `jnp.stack`: see `_functions/rotate.py`."""
    if not isinstance(x, _Vector):
        return x
    whole = jnp.broadcast_to(x[-1], (len(x),))
    for i, entry in enumerate(x[:-1]):
        whole = jnp.where(np.arange(len(x)) == i, entry, whole)
    return whole
