"""Whether a function may jump where its argument changes continuously, by its jaxpr."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import JaxprEqn, Literal, jaxprs_in_params
from jaxtyping import PyTree

from .linearity import CALLS

# Operations on floating-point numbers that jump themselves. All others that jump have integers or
# booleans on the way: comparisons, indices, arguments of extrema.
_JUMPS = frozenset("ceil floor rem round sign".split())


def may_jump(fun: Callable[[Any], PyTree], x: Any) -> bool:
    """Whether the arrays of `fun(x)` may jump at some x.

    They may if there is an integer, a boolean or a function of the host between x and them.
    """

    def arrays(x: Any) -> list[Any]:
        return [leaf for leaf in jtu.tree_leaves(fun(x)) if eqx.is_array(leaf)]

    return _may_jump(jax.make_jaxpr(arrays)(x), [True])


def _may_jump(jaxpr: Any, are_dependent: Sequence[bool]) -> bool:
    """For a jaxpr, closed or open, of whose inputs some depend on x."""
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    dependent = {v for v, x in zip(jaxpr.invars, are_dependent, strict=True) if x}
    for eqn in jaxpr.eqns:
        operands = [not isinstance(v, Literal) and v in dependent for v in eqn.invars]
        if not any(operands):
            continue
        inner = eqn.params.get(CALLS.get(eqn.primitive.name, ""))
        if _jumps(eqn) if inner is None else _may_jump(inner, operands):
            return True
        dependent.update(eqn.outvars)
    return False


def _jumps(eqn: JaxprEqn) -> bool:
    """Whether an operation, or one within its loop or branches, may jump."""
    name = eqn.primitive.name
    if name in ("eq", "ne") and eqn.invars[0] is eqn.invars[1]:
        # Whether it is NaN.
        return False
    if not eqn.outvars:
        # A print leads nowhere.
        return False
    avals: list[Any] = [v.aval for v in eqn.outvars]
    are_inexact = (jax.dtypes.issubdtype(aval.dtype, np.inexact) for aval in avals)
    if name in _JUMPS or "call" in name or not all(are_inexact):
        return True
    programs = (getattr(x, "jaxpr", x) for x in jaxprs_in_params(eqn.params))
    return any(_jumps(inner) for program in programs for inner in program.eqns)
