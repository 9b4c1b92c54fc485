"""The rules: what operations make of numbers and structs of arrays."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from . import arithmetic, moves
from .jaxprs import evaluate, is_inexact
from .scope import is_numeric
from .struct_of_arrays import Call, StructOfArrays, is_small_shape, is_whole, static_value
from .understood import ELEMENTWISE, REDUCTIONS, is_understood

_RULES: dict[str, Callable[[Call], StructOfArrays | list[StructOfArrays] | None]] = {
    "broadcast_in_dim": moves.broadcast,
    "cfjax_pack": moves.stacked,
    "cfjax_unpack": moves.unpacked,
    "concatenate": moves.concatenated,
    "cumprod": arithmetic.cumulative,
    "cumsum": arithmetic.cumulative,
    "dot_general": arithmetic.product,
    "dynamic_slice": moves.moved,
    "dynamic_update_slice": moves.moved,
    "fft": arithmetic.transformed,
    "gather": moves.gathered,
    "pad": moves.padded,
    "reshape": moves.reshaped,
    "rev": moves.flipped,
    "scatter": moves.scattered,
    "scatter-add": moves.scattered,
    "scatter-mul": moves.scattered,
    "slice": moves.sliced,
    "split": moves.split,
    "squeeze": moves.reshaped,
    "stack": moves.stacked,
    "transpose": moves.transposed,
    "unstack": moves.unpacked,
    **dict.fromkeys(ELEMENTWISE, arithmetic.elementwise),
    **dict.fromkeys(REDUCTIONS, arithmetic.reduced),
}


def on_entries(
    eqn: JaxprEqn, values: Sequence[Any], fixed: Sequence[bool], rows: bool
) -> Sequence[Any] | None:
    """The results of one operation, if there is a rule for it, otherwise None.

    With `rows` there are arrays with leading axes, and what goes in or comes out may be large.
    """
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    if not all(map(is_numeric, avals)):
        return None
    outs = avals[len(eqn.invars) :]
    is_large = rows and (
        any(isinstance(x, StructOfArrays) and x.long for x in values)
        or not all(is_small_shape(aval.shape) for aval in avals)
    )
    if not is_large:
        static = [x for x in map(static_value, values) if x is not None]
        is_static = len(static) == len(values) and not any(map(is_inexact, outs))
        if is_static and not eqn.effects:
            return _of_static(eqn, static)
        if not all(is_small_shape(aval.shape) for aval in outs) or any(map(is_whole, values)):
            return None
    if eqn.effects or not is_understood(eqn) or any(aval.size == 0 for aval in avals):
        return None
    rule = _RULES[eqn.primitive.name]
    results = rule(Call(eqn, values, fixed, [aval.shape for aval in outs], is_large))
    if results is None:
        return None
    results = results if isinstance(results, list) else [results]
    # Without axes it is a number.
    return [x if x.shape else x.entries[0] for x in results]


def _of_static(eqn: JaxprEqn, values: Sequence[np.ndarray]) -> list[np.ndarray]:
    with jax.ensure_compile_time_eval():
        return list(map(np.asarray, evaluate(eqn, values)))
