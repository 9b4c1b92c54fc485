"""Whether a function is linear in one of its arguments, as far as its program shows."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import PyTree


class Linearity(NamedTuple):
    """How a value depends on x, and what it is where x is zero.

    - `power`: 0 if it does not depend on x, 1 if it is linear but for a constant, 2 if it has
      products of x with itself, 3 if that is not known.
    - `constant`: "zero"; "some", if it is not zero for all states; or "unknown".
    """

    power: int
    constant: str


# Of constants that are looked at.
_LARGEST = 10_000

_ZERO, _SOME, _UNKNOWN = (Linearity(0, constant) for constant in ("zero", "some", "unknown"))
_NOT_KNOWN = Linearity(3, "unknown")

_SUMS = frozenset(("add", "add_any", "sub"))
# Linear in all operands together.
_LINEAR = frozenset(
    "broadcast_in_dim cfjax_pack cfjax_unpack complex concatenate conj convert_element_type copy "
    "cumsum imag neg pad real reduce_sum reshape rev slice split squeeze stack tile transpose "
    "unstack".split()
)
# In those beside indices and predicates.
_LINEAR_IN_PART = {
    "dynamic_slice": slice(1),
    "dynamic_update_slice": slice(2),
    "gather": slice(1),
    "scatter": slice(0, None, 2),
    "scatter-add": slice(0, None, 2),
    "scatter_add": slice(0, None, 2),
    "select_n": slice(1, None),
}
# In each of two operands.
_PRODUCTS = frozenset(("dot_general", "mul"))
# Those that add entries, which may cancel.
_CONTRACTIONS = frozenset(("cumsum", "dot_general", "reduce_sum"))
# In one of two operands: which.
_LINEAR_IN_ONE = {"div": 0, "triangular_solve": 1}
# Operations that call a program, and under which parameter.
_CALLS = {
    "cfjax_call": "program",
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


def linearity(
    fun: Callable[[Any, Any, Any], PyTree], x: PyTree, state: PyTree, others: PyTree
) -> list[Linearity]:
    """What is known of each array of `fun(x, state, others)` as a function of x.

    The constant is known where it comes from the state and from numbers alone, without sums in
    which parts of it may cancel.
    """
    made = jax.make_jaxpr(fun)(x, state, others)
    arguments = [(x, Linearity(1, "zero")), (state, _SOME), (others, _UNKNOWN)]
    given = [known for part, known in arguments for _ in jtu.tree_leaves(part)]
    return _of_program(made, given)


def _of_program(program: ClosedJaxpr, given: Sequence[Linearity]) -> list[Linearity]:
    return _of_jaxpr(program.jaxpr, [*map(_of_constant, program.consts), *given])


def _of_jaxpr(jaxpr: Jaxpr, given: Sequence[Linearity]) -> list[Linearity]:
    """`given` are those of the constants and of the arguments."""
    found = dict(zip((*jaxpr.constvars, *jaxpr.invars), given, strict=True))

    def read(atom: Any) -> Linearity:
        return _of_constant(atom.val) if isinstance(atom, Literal) else found[atom]

    for eqn in jaxpr.eqns:
        found.update(zip(eqn.outvars, _of_operation(eqn, [*map(read, eqn.invars)]), strict=True))
    return [*map(read, jaxpr.outvars)]


def _of_constant(value: Any) -> Linearity:
    if isinstance(value, Tracer) or not _is_number(value) or np.size(value) > _LARGEST:
        return _UNKNOWN
    value = np.asarray(value)
    # Masks may cancel in a product.
    return _ZERO if not value.any() else _SOME if value.all() else _UNKNOWN


def _is_number(value: Any) -> bool:
    # Not a key, nor an array of several processes.
    is_here = getattr(value, "is_fully_addressable", True)
    return is_here and jax.dtypes.issubdtype(getattr(value, "dtype", np.float64), np.number)


def _of_operation(eqn: JaxprEqn, operands: list[Linearity]) -> list[Linearity]:
    name, number = eqn.primitive.name, len(eqn.outvars)
    inner: Any = eqn.params.get(_CALLS.get(name, ""))
    if inner is not None:
        found = _of_inner(inner, operands)
    else:
        found = [_of_simple(eqn, name, operands)] * number
    return found if len(found) == number else [_without_rule(operands)] * number


def _of_simple(eqn: JaxprEqn, name: str, operands: list[Linearity]) -> Linearity:
    if name in _SUMS:
        return _sum(*operands)
    if name in _LINEAR and _is_inexact(eqn.outvars[0].aval):
        found = functools.reduce(_joined, operands)
        return _may_cancel(found) if name in _CONTRACTIONS else found
    # `x.at[i].apply(f)` has f in its scatter.
    if name in _LINEAR_IN_PART and not (name == "scatter" and eqn.params.get("update_jaxpr")):
        places = range(len(operands))[_LINEAR_IN_PART[name]]
        if all(x.power == 0 for k, x in enumerate(operands) if k not in places):
            return functools.reduce(_joined, (operands[k] for k in places))
    if name in _PRODUCTS and len(operands) == 2:
        found = _product(*operands)
        return _may_cancel(found) if name in _CONTRACTIONS else found
    if name in _LINEAR_IN_ONE and len(operands) == 2:
        place = _LINEAR_IN_ONE[name]
        one, other = operands[place], operands[1 - place]
        if other.power == 0:
            return _product(one, other if other == _SOME else _UNKNOWN)
    if name == "square" or (name == "integer_pow" and eqn.params["y"] >= 2):
        return _product(operands[0], operands[0])
    return _without_rule(operands)


def _is_inexact(aval: Any) -> bool:
    return jax.dtypes.issubdtype(aval.dtype, np.inexact)


def _sum(a: Linearity, b: Linearity) -> Linearity:
    power = max(a.power, b.power)
    for x, y in ((a, b), (b, a)):
        if x.constant == "zero":
            return Linearity(power, y.constant)
    # Two may cancel.
    return Linearity(power, "unknown")


def _product(a: Linearity, b: Linearity) -> Linearity:
    if _ZERO in (a, b):
        return _ZERO
    powers, constants = {a.power, b.power}, {a.constant, b.constant}
    power = 3 if 3 in powers else min(2, sum((a.power, b.power)))
    constant = "zero" if "zero" in constants else "some" if constants == {"some"} else "unknown"
    return Linearity(power, constant)


def _may_cancel(x: Linearity) -> Linearity:
    return x._replace(constant="unknown") if x.constant == "some" else x


def _without_rule(operands: Sequence[Linearity]) -> Linearity:
    return _UNKNOWN if all(x.power == 0 for x in operands) else _NOT_KNOWN


def _joined(a: Linearity, b: Linearity) -> Linearity:
    """What is known of a value of which some is the one and some the other."""
    power = a.power if a.power == b.power else 1 if max(a.power, b.power) == 1 else 3
    return Linearity(power, a.constant if a.constant == b.constant else "unknown")


def _of_inner(inner: Any, operands: Sequence[Linearity]) -> list[Linearity]:
    is_closed = hasattr(inner, "consts")
    return _of_program(inner, operands) if is_closed else _of_jaxpr(inner, operands)
