"""Equal steps whose reverse mode undoes them, so that it keeps the end alone."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ._numerics.checks import Fault
from ._solvers.base import largest

Step = Callable[[PyTree], PyTree]

_MISSED = (
    "step_back led back to a start that is off by more than half of the digits: the way back "
    "multiplies rounding too often. Take fewer steps between two saved states, or checkpoint_every "
    "in place of step_back."
)


def repeat_and_undo(
    repeat: Callable[[Step, PyTree, int], PyTree],
    step: Step,
    back: Step,
    carry: PyTree,
    num_steps: int,
    throw: bool,
) -> PyTree:
    """`repeat(step, carry, num_steps)`, where `back` is the inverse of `step`.

    Both are pytrees, whose arrays have derivatives too. The second entry of a carry is the state.
    Where the way back misses the start, the derivative is NaN, or an error if `throw`.
    """
    moving, rest = _parts((carry, step))
    rest, static = eqx.partition((rest, back), eqx.is_array)

    @jax.custom_vjp
    def steps(moving: PyTree, rest: PyTree) -> PyTree:
        rest, _ = eqx.combine(rest, static)
        carry, step = eqx.combine(moving, rest)
        return repeat(lambda carry: step(carry), carry, num_steps)

    def forward(moving: PyTree, rest: PyTree) -> tuple[PyTree, PyTree]:
        end = steps(moving, rest)
        return end, (moving, rest, end)

    def backward(kept: PyTree, derivative: PyTree) -> tuple[PyTree, None]:
        moving, rest, end = kept
        rest, back = eqx.combine(rest, static)
        fixed = rest[1]

        def undo(state: tuple[PyTree, PyTree, PyTree], _: None) -> tuple[Any, None]:
            carry, of_end, of_step = state
            carry = back(carry)
            varying, rest = _parts(carry)

            def stepped(varying: PyTree, moving: PyTree) -> PyTree:
                step = eqx.combine(moving, fixed)
                return _parts(step(eqx.combine(varying, rest)))[0]

            _, pullback = jax.vjp(stepped, varying, moving[1])
            of_start, more = pullback(of_end)
            return (carry, of_start, jtu.tree_map(jnp.add, of_step, more)), None

        of_end = eqx.filter(derivative, jtu.tree_map(eqx.is_inexact_array, end))
        state = end, of_end, jtu.tree_map(jnp.zeros_like, moving[1])
        (found, *derivatives), _ = lax.scan(undo, state, length=num_steps)
        start, _ = eqx.combine(moving, rest)
        fault = Fault.none().with_case(_misses(start[1], found[1], end[1]), _MISSED)
        zero = (fault.error if throw else fault.nan)(jnp.zeros(()))
        return jtu.tree_map(lambda x: x + zero.astype(x.dtype), tuple(derivatives)), None

    steps.defvjp(forward, backward)
    return steps(moving, rest)


def _parts(tree: PyTree) -> tuple[PyTree, PyTree]:
    """What has a derivative, and the rest."""
    return eqx.partition(tree, eqx.is_inexact_array)


def _misses(start: PyTree, found: PyTree, end: PyTree) -> Bool[Array, ""]:
    """Whether two states differ by more than half of the digits of what is on the way.

    The digits are those of the part of lowest precision.
    """
    eps = max((float(jnp.finfo(x.dtype).eps) for x in jtu.tree_leaves(start)), default=0.0)
    off = largest(jtu.tree_map(jnp.subtract, found, start))
    return ~(off <= eps**0.5 * largest((start, end)))
