"""Floating-point operations of a JAX program, counted from its trace.

XLA's own cost analysis counts custom calls (factorisations, solves) as nothing, and what it
reports changes with the compiler.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import PyTree


def count_flops(fun: Callable[..., PyTree], *args: PyTree) -> int:
    """The floating-point operations of `fun(*args)`.

    - One for each entry of a result of `+ - * /`, a root, or an elementary function.
    - An integer power counts its multiplications by repeated squaring.
    - A product of matrices m x k and k x n counts 2 m n k; a sum of n entries, n - 1.
    - A scan counts its body as often as it runs; a conditional its most expensive branch.
    - Changes of sign, comparisons, selections, roundings, conversions, moves of data and integer
      arithmetic count nothing.

    What does not reach the result, and the same operation on the same operands, counts once at
    most, as compilers drop both. `args` may be `jax.ShapeDtypeStruct`s; only shapes and dtypes
    matter.

    **Raises** `NotImplementedError` for floating-point operations without a rule, for complex
    numbers, and for loops whose length is not known when the program is traced.
    """
    return _count(jax.make_jaxpr(fun)(*args))


class _Operation(NamedTuple):
    cost: int
    operands: Sequence[Hashable]
    results: Sequence[Hashable]


def _count(jaxpr: Jaxpr | ClosedJaxpr) -> int:
    # Insertion order is the order of the program.
    operations: dict[Hashable, _Operation] = {}
    inner = _open(jaxpr)
    live = set(_flatten(jaxpr, [object() for _ in inner.invars], operations))
    total = 0
    for operation in reversed(operations.values()):
        if not live.isdisjoint(operation.results):
            total += operation.cost
            live.update(operation.operands)
    return total


def _flatten(
    jaxpr: Jaxpr | ClosedJaxpr, arguments: Iterable[Hashable], operations: dict
) -> list[Hashable]:
    """Adds the operations with all calls inlined; returns the names of the results.

    Values that are equal because they are computed alike get one name.
    """
    inner = _open(jaxpr)
    names: dict[Any, Hashable] = dict(zip(inner.invars, arguments, strict=True))
    # By the array: one constant may have several variables.
    constants = jaxpr.consts if isinstance(jaxpr, ClosedJaxpr) else inner.constvars
    names.update((v, ("constant", id(c))) for v, c in zip(inner.constvars, constants, strict=True))

    def name(v):
        return ("literal", str(v.aval), repr(v.val)) if isinstance(v, Literal) else names[v]

    for eqn in inner.eqns:
        operands = [name(v) for v in eqn.invars]
        body = _CALLS.get(eqn.primitive.name)
        if body is not None:
            results = _flatten(eqn.params[body], operands, operations)
        else:
            key = (eqn.primitive, tuple(operands), _parameters(eqn))
            if key not in operations:
                results = [object() for _ in eqn.outvars]
                operations[key] = _Operation(_cost(eqn), operands, results)
            results = operations[key].results
        names.update(zip(eqn.outvars, results, strict=True))
    return [name(v) for v in inner.outvars]


def _open(jaxpr: Jaxpr | ClosedJaxpr) -> Jaxpr:
    return jaxpr.jaxpr if isinstance(jaxpr, ClosedJaxpr) else jaxpr


def _parameters(eqn: JaxprEqn) -> Hashable:
    parameters = tuple(sorted(eqn.params.items(), key=lambda item: item[0]))
    try:
        hash(parameters)
    except TypeError:
        return object()  # Equal to no other, so such operations are never merged.
    return parameters


def _cost(eqn: JaxprEqn) -> int:
    name = eqn.primitive.name
    dtypes = [getattr(v.aval, "dtype", None) for v in (*eqn.invars, *eqn.outvars)]
    if name not in _CONTROL and not any(d is not None and _is_inexact(d) for d in dtypes):
        return 0
    if any(d is not None and jnp.issubdtype(d, jnp.complexfloating) for d in dtypes):
        raise NotImplementedError(f"count_flops has no rule for complex numbers, found in {name}.")
    if name not in _COSTS:
        raise NotImplementedError(
            f"count_flops has no rule for the floating-point operation {name}: {eqn}"
        )
    return _COSTS[name](eqn)


def _is_inexact(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.inexact)


def _shape(v: Any) -> tuple[int, ...]:
    return v.aval.shape


def _size(v: Any) -> int:
    return prod(_shape(v))


def _nothing(eqn: JaxprEqn) -> int:
    return 0


def _each_entry(eqn: JaxprEqn) -> int:
    return _size(eqn.outvars[0])


def _integer_power(eqn: JaxprEqn) -> int:
    n = abs(eqn.params["y"])
    multiplications = n.bit_length() + n.bit_count() - 2 if n else 0
    return (multiplications + (eqn.params["y"] < 0)) * _size(eqn.outvars[0])


def _reduction(eqn: JaxprEqn) -> int:
    return _size(eqn.invars[0]) - _size(eqn.outvars[0])


def _cumulative(eqn: JaxprEqn) -> int:
    length = _shape(eqn.invars[0])[eqn.params["axis"]]
    # An empty array has no first entries to leave out.
    return _size(eqn.invars[0]) // max(length, 1) * (length - 1)


def _product(eqn: JaxprEqn) -> int:
    (axes, _), _ = eqn.params["dimension_numbers"]
    return 2 * _size(eqn.outvars[0]) * prod(_shape(eqn.invars[0])[i] for i in axes)


def _scan(eqn: JaxprEqn) -> int:
    return eqn.params["length"] * _count(eqn.params["jaxpr"])


def _branches(eqn: JaxprEqn) -> int:
    return max(_count(branch) for branch in eqn.params["branches"])


def _unknown_length(eqn: JaxprEqn) -> int:
    raise NotImplementedError(
        "count_flops cannot count a while loop: its length is not known when it is traced."
    )


# Calls by the parameter that holds the program.
_CALLS = {
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "remat2": "jaxpr",
}

_CONTROL: dict[str, Callable[[JaxprEqn], int]] = {
    "cond": _branches,
    "scan": _scan,
    "while": _unknown_length,
}

_ARITHMETIC = (
    "acos acosh add add_any asin asinh atan atan2 atanh cbrt cos cosh div erf exp exp2 expm1 log "
    "log1p logistic mul pow rem rsqrt sin sinh sqrt square sub tan tanh"
)
_FREE = (
    "abs argmax argmin bitcast_convert_type broadcast_in_dim ceil clamp concatenate "
    "convert_element_type copy copy_p dynamic_slice dynamic_update_slice eq expand_dims floor "
    "gather ge gt is_finite le lt max min ne neg optimization_barrier pad reduce_max reduce_min "
    "reshape rev round scatter select_n sign slice split squeeze stack stop_gradient transpose"
)
_COSTS: dict[str, Callable[[JaxprEqn], int]] = {
    **dict.fromkeys(_ARITHMETIC.split(), _each_entry),
    **dict.fromkeys(_FREE.split(), _nothing),
    **_CONTROL,
    "cumsum": _cumulative,
    "cumprod": _cumulative,
    "dot_general": _product,
    "integer_pow": _integer_power,
    "reduce_prod": _reduction,
    "reduce_sum": _reduction,
}
