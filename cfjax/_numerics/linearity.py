"""Whether a function is linear in one of its arguments, by abstract interpretation of its jaxpr."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import JaxprEqn, Literal
from jaxtyping import PyTree


class Linearity(NamedTuple):
    """How a value depends on x.

    - `power`: 0 if it does not depend on x, 1 if it is linear but for a constant, 2 if it has
      products of x with itself, 3 if that is unknown.
    - `constant`: its value at x = 0: "zero"; "some", if it is not zero for all states; or
      "unknown".
    """

    power: int
    constant: str


# The most entries of a constant that are inspected.
_MAX_ENTRIES = 10_000

# Values that do not depend on x.
_ZERO, _SOME, _CONSTANT = (Linearity(0, constant) for constant in ("zero", "some", "unknown"))
_UNKNOWN = Linearity(3, "unknown")

_SUMS = frozenset(("add", "add_any", "sub"))
# Linear in all operands together.
_LINEAR = frozenset(
    "broadcast_in_dim cfjax_pack cfjax_unpack complex concatenate conj convert_element_type copy "
    "cumsum imag neg pad real reduce_sum reshape rev slice split squeeze stack tile transpose "
    "unstack".split()
)
# Linear in these operands together; the others are indices and predicates.
_LINEAR_IN_PART = {
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "scatter": slice(0, None, 2),
    "scatter-add": slice(0, None, 2),
    "scatter_add": slice(0, None, 2),
    "select_n": slice(1, None),
}
# Linear in each of two operands.
_BILINEAR = frozenset(("dot_general", "mul"))
# These add entries, which may cancel.
_CONTRACTIONS = frozenset(("cumsum", "dot_general", "reduce_sum"))
# Linear in this one of two operands.
_LINEAR_IN_ONE = {"div": 0, "triangular_solve": 1}
# Operations that call a jaxpr, and the parameter that holds it.
CALLS = {
    "cfjax_call": "program",
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


def linearity(
    fun: Callable[[Any, Any, Any], PyTree], x: PyTree, state: PyTree, args: PyTree
) -> list[Linearity]:
    """How each array of `fun(x, state, args)` depends on x.

    The constant is determined only if it comes from the state and from literals, without sums in
    which parts of it may cancel.
    """
    jaxpr = jax.make_jaxpr(fun)(x, state, args)
    inputs = [(x, Linearity(1, "zero")), (state, _SOME), (args, _CONSTANT)]
    return _interpret(jaxpr, [kind for tree, kind in inputs for _ in jtu.tree_leaves(tree)])


def _interpret(jaxpr: Any, operands: list[Linearity]) -> list[Linearity]:
    """The outputs of a jaxpr, closed or open. Operands of an open one begin with its constants."""
    if hasattr(jaxpr, "consts"):
        operands = [*map(_of_constant, jaxpr.consts), *operands]
        jaxpr = jaxpr.jaxpr
    env = dict(zip((*jaxpr.constvars, *jaxpr.invars), operands, strict=True))

    def read(atom: Any) -> Linearity:
        return _of_constant(atom.val) if isinstance(atom, Literal) else env[atom]

    for eqn in jaxpr.eqns:
        env.update(zip(eqn.outvars, _outputs(eqn, [*map(read, eqn.invars)]), strict=True))
    return [*map(read, jaxpr.outvars)]


def _of_constant(value: Any) -> Linearity:
    if isinstance(value, Tracer) or not _is_number(value) or np.size(value) > _MAX_ENTRIES:
        return _CONSTANT
    value = np.asarray(value)
    # Masks may cancel in a product.
    return _ZERO if not value.any() else _SOME if value.all() else _CONSTANT


def _is_number(value: Any) -> bool:
    # Not a key, nor an array of several processes.
    is_addressable = getattr(value, "is_fully_addressable", True)
    return is_addressable and jax.dtypes.issubdtype(getattr(value, "dtype", np.float64), np.number)


def _outputs(eqn: JaxprEqn, operands: list[Linearity]) -> list[Linearity]:
    num_outputs = len(eqn.outvars)
    jaxpr = eqn.params.get(CALLS.get(eqn.primitive.name, ""))
    if jaxpr is not None:
        outputs = _interpret(jaxpr, operands)
    else:
        outputs = [_output(eqn, operands)] * num_outputs
    return outputs if len(outputs) == num_outputs else [_without_rule(operands)] * num_outputs


def _output(eqn: JaxprEqn, operands: list[Linearity]) -> Linearity:
    """Each output of an operation that calls no jaxpr."""
    name = eqn.primitive.name
    if name in _SUMS:
        return _add(*operands)
    if name in _LINEAR and _is_inexact(eqn.outvars[0].aval):
        output = functools.reduce(_join, operands)
        return _may_cancel(output) if name in _CONTRACTIONS else output
    # `x.at[i].apply(f)` has f in its scatter.
    if name in _LINEAR_IN_PART and not (name == "scatter" and eqn.params.get("update_jaxpr")):
        linear = range(len(operands))[_LINEAR_IN_PART[name]]
        if all(x.power == 0 for k, x in enumerate(operands) if k not in linear):
            return functools.reduce(_join, (operands[k] for k in linear))
    if name in _BILINEAR and len(operands) == 2:
        output = _multiply(*operands)
        return _may_cancel(output) if name in _CONTRACTIONS else output
    if name in _LINEAR_IN_ONE and len(operands) == 2:
        linear = _LINEAR_IN_ONE[name]
        divisor = operands[1 - linear]
        if divisor.power == 0:
            return _multiply(operands[linear], divisor if divisor == _SOME else _CONSTANT)
    if name == "square" or (name == "integer_pow" and eqn.params["y"] >= 2):
        return _multiply(operands[0], operands[0])
    return _without_rule(operands)


def _is_inexact(aval: Any) -> bool:
    return jax.dtypes.issubdtype(aval.dtype, np.inexact)


def _add(a: Linearity, b: Linearity) -> Linearity:
    power = max(a.power, b.power)
    for x, y in ((a, b), (b, a)):
        if x.constant == "zero":
            return Linearity(power, y.constant)
    # Two may cancel.
    return Linearity(power, "unknown")


def _multiply(a: Linearity, b: Linearity) -> Linearity:
    if _ZERO in (a, b):
        return _ZERO
    powers, constants = {a.power, b.power}, {a.constant, b.constant}
    power = 3 if 3 in powers else min(2, a.power + b.power)
    constant = "zero" if "zero" in constants else "some" if constants == {"some"} else "unknown"
    return Linearity(power, constant)


def _may_cancel(x: Linearity) -> Linearity:
    return x._replace(constant="unknown") if x.constant == "some" else x


def _without_rule(operands: Sequence[Linearity]) -> Linearity:
    return _CONSTANT if all(x.power == 0 for x in operands) else _UNKNOWN


def _join(a: Linearity, b: Linearity) -> Linearity:
    """The linearity of an array with entries of both kinds."""
    power = a.power if a.power == b.power else 1 if max(a.power, b.power) == 1 else 3
    return Linearity(power, a.constant if a.constant == b.constant else "unknown")
