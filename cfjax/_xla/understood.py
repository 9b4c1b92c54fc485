"""What the rules know of JAX's operations: names, parameters, and the values of these.

A rule looks at the parameters that are listed here, and at no others. An operation with another
parameter, as a newer JAX may have, or another value of one, gets its arrays whole.
"""

from collections.abc import Callable
from typing import Any

from jax import lax
from jax.extend.core import Jaxpr, JaxprEqn, jaxprs_in_params

ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp complex conj "
    "convert_element_type copy cos cosh div eq erf exp exp2 expm1 floor ge gt imag integer_pow "
    "is_finite le log log1p logistic lt max min mul ne neg not or pow real rem round rsqrt "
    "select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)
REDUCTIONS = frozenset("reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum".split())
# Those that only move entries.
MOVES = frozenset(
    "broadcast_in_dim cfjax_pack cfjax_unpack concatenate dynamic_slice dynamic_update_slice "
    "gather pad reshape rev scatter slice split squeeze stack transpose".split()
)
# XLA updates an array in place for these, and jaxlib 0.10 then reads what it has overwritten if the
# array, or the result, also has another shape: `x.at[1:].set(lax.dynamic_slice_in_dim(x, k, 99))`
# with a reshape beside it. Taken apart, arrays have other shapes in many places.
_IN_PLACE = frozenset(("dynamic_update_slice",))


def _any(value: Any) -> bool:
    return True


def _none(value: Any) -> bool:
    return value is None


def _is_precision(value: Any) -> bool:
    """Not an algorithm, which may ask for the rounding of another dtype."""
    pair = value if isinstance(value, tuple) else (value,)
    return all(x is None or isinstance(x, lax.Precision) for x in pair)


# The rules of these hand all parameters on.
_HANDED_ON = dict(
    accuracy=_any,
    input_dtype=_any,
    new_dtype=_any,
    out_dtype=_any,
    rounding_method=_any,
    sharding=_none,
    weak_type=_any,
    y=_any,
)
_GATHER = dict(
    dimension_numbers=_any,
    fill_value=_any,
    indices_are_sorted=_any,
    mode=_any,
    slice_sizes=_any,
    unique_indices=_any,
)
_SCATTER = dict(
    dimension_numbers=_any,
    indices_are_sorted=_any,
    mode=_any,
    unique_indices=_any,
    update_consts=_any,
)
_PARAMETERS: dict[str, dict[str, Callable[[Any], bool]]] = {
    "broadcast_in_dim": dict(shape=_any, broadcast_dimensions=_any, sharding=_none),
    "cfjax_pack": dict(axis=_any, sums=_any),
    "cfjax_unpack": dict(axis=_any),
    "concatenate": dict(dimension=_any),
    "cumprod": dict(axis=_any, reverse=_any),
    "cumsum": dict(axis=_any, reverse=_any),
    "dot_general": dict(
        dimension_numbers=_any,
        out_sharding=_none,
        precision=_is_precision,
        preferred_element_type=_any,
    ),
    "dynamic_slice": dict(slice_sizes=_any),
    "dynamic_update_slice": dict(),
    "fft": dict(fft_lengths=_any, fft_type=_any),
    "gather": _GATHER,
    "pad": dict(padding_config=_any),
    "reshape": dict(dimensions=_none, new_sizes=_any, sharding=_none),
    "rev": dict(dimensions=_any),
    # `x.at[i].apply(f)` has f there.
    "scatter": _SCATTER | dict(update_jaxpr=_none),
    # Here it repeats what the name says.
    "scatter-add": _SCATTER | dict(update_jaxpr=_any),
    "scatter-mul": _SCATTER | dict(update_jaxpr=_any),
    "scatter_add": _SCATTER | dict(update_jaxpr=_any),
    "scatter_mul": _SCATTER | dict(update_jaxpr=_any),
    "slice": dict(limit_indices=_any, start_indices=_any, strides=_any),
    "split": dict(axis=_any, sizes=_any),
    "squeeze": dict(dimensions=_any),
    "stack": dict(axis=_any),
    "transpose": dict(permutation=_any),
}


def is_understood(eqn: JaxprEqn) -> bool:
    """Whether the rules know all of an operation."""
    name = eqn.primitive.name
    if name in ELEMENTWISE:
        known = _HANDED_ON
    elif name in REDUCTIONS:
        known = dict(axes=_any, out_sharding=_none)
    else:
        known = _PARAMETERS.get(name)
    return known is not None and all(k in known and known[k](v) for k, v in eqn.params.items())


def is_in_place(eqn: JaxprEqn) -> bool:
    """Whether XLA may update an operand of it in place."""
    return eqn.primitive.name in _IN_PLACE or eqn.primitive.name.startswith("scatter")


_CONTROL = frozenset(("cond", "scan", "while"))


def is_readable(jaxpr: Jaxpr) -> bool:
    """Whether a program can be scalarised.

    - It has no branches and loops, as in the exponential of a matrix. They would stay whole, and
      what is around them, scalarised, XLA would compute anew for each of the entries that go in.
    - It has no function with a rule for reverse mode only.
    - It is on one device, as far as the types of its values say, in no `jax.shard_map`.
    - It says nothing to the compiler about some of its operations.
    """
    return all(
        eqn.primitive.name not in _CONTROL
        and "custom_vjp" not in eqn.primitive.name
        and not _has_advice(eqn)
        and all(_is_on_one_device(v.aval) for v in (*eqn.invars, *eqn.outvars))
        and all(map(is_readable, jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )


def _has_advice(eqn: JaxprEqn) -> bool:
    context = [getattr(eqn.ctx, name, None) for name in ("compute_type", "xla_metadata")]
    shardings = [*eqn.params.get("in_shardings", ()), *eqn.params.get("out_shardings", ())]
    return any(context) or any(type(x).__name__ != "UnspecifiedValue" for x in shardings)


def _is_on_one_device(aval: Any) -> bool:
    spec = getattr(getattr(aval, "sharding", None), "spec", ())
    # What differs over the devices of a `jax.shard_map`; newer versions of JAX keep it elsewhere.
    is_varying = bool(getattr(aval, "vma", None)) or bool(
        getattr(getattr(aval, "manual_axis_type", None), "varying", None)
    )
    return not is_varying and all(axis is None for axis in spec)
