"""The rules: what operations make of numbers."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from . import arithmetic, moves
from .jaxprs import evaluate, is_inexact
from .numbers import is_whole, static_value
from .scope import is_numeric, is_small_shape
from .understood import ELEMENTWISE, REDUCTIONS, is_understood

_RULES: dict[str, Callable[[JaxprEqn, Sequence[Any]], Any]] = {
    **dict.fromkeys(moves.BY_NUMPY, moves.moved),
    "dot_general": arithmetic.product,
    **dict.fromkeys(("dynamic_slice", "dynamic_update_slice"), moves.sliced),
    "gather": moves.gathered,
    "pad": moves.padded,
    **dict.fromkeys(("scatter", "scatter-add", "scatter-mul"), moves.scattered),
    **dict.fromkeys(ELEMENTWISE, arithmetic.elementwise),
    **dict.fromkeys(REDUCTIONS, arithmetic.reduced),
}


def on_numbers(eqn: JaxprEqn, values: Sequence[Any]) -> Sequence[Any] | None:
    """The results of one operation, if there is a rule for it, otherwise None."""
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    if eqn.effects or not all(map(is_numeric, avals)):
        return None
    outs = avals[len(eqn.invars) :]
    static = [x for x in map(static_value, values) if x is not None]
    if len(static) == len(values) and not any(map(is_inexact, outs)):
        with jax.ensure_compile_time_eval():
            return list(map(np.asarray, evaluate(eqn, static)))
    if not all(is_small_shape(aval.shape) for aval in outs) or any(map(is_whole, values)):
        return None
    if not is_understood(eqn) or any(aval.size == 0 for aval in avals):
        return None
    results = _RULES[eqn.primitive.name](eqn, values)
    if results is None:
        return None
    results = results if isinstance(results, list) else [results]
    # Without axes it is a number.
    return [x if x.shape else x[()] for x in results]
