"""What the rules know of JAX's operations: names, parameters, and the values of these.

A rule looks at the parameters that are listed here, and at no others. An operation with another
parameter, as a newer JAX may have, or another value of one, gets its arrays whole.
"""

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
# Operations that only move entries.
MOVES = frozenset(
    "broadcast_in_dim concatenate dynamic_slice dynamic_update_slice gather pad reshape rev "
    "scatter slice split squeeze stack transpose unstack".split()
)
# The parameters of each operation. The rules of elementwise ones hand all of theirs on.
_HANDED_ON = "accuracy input_dtype new_dtype out_dtype rounding_method sharding weak_type y"
_INDEXED = "dimension_numbers indices_are_sorted mode unique_indices "
_TEXTS: dict[str, str] = {
    "broadcast_in_dim": "broadcast_dimensions shape sharding",
    "concatenate": "dimension",
    "dot_general": "dimension_numbers out_sharding precision preferred_element_type",
    "dynamic_slice": "slice_sizes",
    "dynamic_update_slice": "",
    "gather": _INDEXED + "fill_value slice_sizes",
    "pad": "padding_config",
    "reshape": "dimensions new_sizes sharding",
    "rev": "dimensions",
    **dict.fromkeys(
        ("scatter", "scatter-add", "scatter-mul"), _INDEXED + "update_consts update_jaxpr"
    ),
    "slice": "limit_indices start_indices strides",
    "split": "axis sizes",
    "squeeze": "dimensions",
    "stack": "axis",
    "transpose": "permutation",
    "unstack": "axis",
    **dict.fromkeys(ELEMENTWISE, _HANDED_ON),
    **dict.fromkeys(REDUCTIONS, "axes out_sharding"),
}
_PARAMETERS = {name: frozenset(text.split()) for name, text in _TEXTS.items()}
# Parameters that must be None. `x.at[i].apply(f)` has f in its scatter; in `scatter-add` it repeats
# what the name says.
_NONE = frozenset((("reshape", "dimensions"), ("scatter", "update_jaxpr")))


def is_understood(eqn: JaxprEqn) -> bool:
    """Whether the rules know all of an operation."""
    name = eqn.primitive.name
    return name in _PARAMETERS and all(
        k in _PARAMETERS[name] and _is_known(name, k, value) for k, value in eqn.params.items()
    )


def _is_known(name: str, parameter: str, value: Any) -> bool:
    if parameter in ("sharding", "out_sharding") or (name, parameter) in _NONE:
        return value is None
    if parameter == "precision":
        # Not an algorithm, which may ask for the rounding of another dtype.
        pair = value if isinstance(value, tuple) else (value,)
        return all(x is None or isinstance(x, lax.Precision) for x in pair)
    return True


def is_in_place(eqn: JaxprEqn) -> bool:
    """Whether XLA may update an operand of it in place.

    Then jaxlib 0.10 reads what it has overwritten if the array, or the result, also has another
    shape: `x.at[1:].set(lax.dynamic_slice_in_dim(x, k, 99))` with a reshape beside it. Taken apart,
    arrays have other shapes in many places.
    """
    name = eqn.primitive.name
    return name == "dynamic_update_slice" or name.startswith("scatter")


_CONTROL = frozenset(("cond", "scan", "while"))

# The name of loops over stages (`stages.py`), and of choices within them.
STAGES = "cfjax_stages"


def is_readable(jaxpr: Jaxpr) -> bool:
    """Whether a program can be scalarised.

    - It has no branches and loops, as in the exponential of a matrix, but for those over the stages
      of a method. They would stay whole, and what is around them, scalarised, XLA would compute
      anew for each of the entries that go in.
    - It has no function with a rule for reverse mode only.
    - It is on one device, as far as the types of its values say, in no `jax.shard_map`.
    - It says nothing to the compiler about some of its operations.
    """
    return all(
        (eqn.primitive.name not in _CONTROL or _is_of_stages(eqn))
        and "custom_vjp" not in eqn.primitive.name
        and not _has_advice(eqn)
        and all(_is_on_one_device(v.aval) for v in (*eqn.invars, *eqn.outvars))
        and all(map(is_readable, jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )


def _is_of_stages(eqn: JaxprEqn) -> bool:
    # What is within a loop has a name stack of its own, so a user's loop there has not this name.
    return STAGES in str(getattr(eqn.source_info, "name_stack", "")) and (
        eqn.primitive.name != "while"
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
