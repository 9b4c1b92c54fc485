"""Whether a program computes, as told by the operations of StableHLO that it is lowered to.

So an operation that a newer version of JAX has is known without its name.
"""

import re
from collections.abc import Callable, Iterator
from typing import Any

import jax
from jaxtyping import PyTree

# Operations of StableHLO that move, compare, select, round or convert entries, or change their
# sign. Programs within them, such as that of a reduction, are looked at by themselves.
_WITHOUT_ARITHMETIC = frozenset(
    f"stablehlo.{name}"
    for name in (
        "bitcast_convert broadcast_in_dim case ceil clamp compare complex concatenate constant "
        "convert dynamic_slice dynamic_update_slice floor gather imag iota is_finite maximum "
        "minimum negate optimization_barrier pad real reduce reduce_precision reduce_window "
        "reshape return reverse round_nearest_afz round_nearest_even scatter select slice sort "
        "transpose while"
    ).split()
)
# Functions and calls of them.
_STRUCTURE = frozenset(("func.call", "func.func", "func.return"))
_INTEGERS = re.compile(r"tensor<(\d+x)*u?i\d+>")


def arithmetic_of(fun: Callable[..., PyTree], *args: PyTree) -> set[str]:
    """The operations in what `fun(*args)` is lowered to that may compute with floats.

    Operations of other dialects and calls of compiled functions are among them, as these may
    compute anything. The arguments may be `jax.ShapeDtypeStruct`s.

    **Raises** what JAX raises where `fun` cannot be lowered.
    """
    module: Any = jax.jit(fun).lower(*args).compiler_ir("stablehlo")
    return {op.name for op in _inside(module.operation) if not _is_free(op)}


def _inside(operation: Any) -> Iterator[Any]:
    for region in operation.regions:
        for block in region:
            for view in block:
                yield view.operation
                yield from _inside(view.operation)


def _is_free(operation: Any) -> bool:
    name = operation.name
    if name in _WITHOUT_ARITHMETIC or name in _STRUCTURE:
        return True
    types = [str(value.type) for value in (*operation.operands, *operation.results)]
    is_known = name.startswith("stablehlo.") and name != "stablehlo.custom_call"
    return is_known and all(map(_INTEGERS.fullmatch, types))
