"""Equal steps whose reverse mode undoes them, so that its only residual is the end."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Inexact, PyTree, Real

from ._numerics.checks import Fault
from ._solvers.base import size

Step = Callable[[PyTree], PyTree]

_MISSED = (
    "step_back led back to a start that is wrong in more than half of its digits: rounding errors "
    "grew too much on the way back. Take fewer steps between two saved states, or use "
    "checkpoint_every instead of step_back."
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
    diff, nondiff = _partition_inexact((carry, step))
    nondiff, static = eqx.partition((nondiff, back), eqx.is_array)

    @jax.custom_vjp
    def steps(diff: PyTree, nondiff: PyTree) -> PyTree:
        nondiff, _ = eqx.combine(nondiff, static)
        carry, step = eqx.combine(diff, nondiff)
        return repeat(lambda carry: step(carry), carry, num_steps)

    def forward(diff: PyTree, nondiff: PyTree) -> tuple[PyTree, PyTree]:
        end = steps(diff, nondiff)
        return end, (diff, nondiff, end)

    def backward(residuals: PyTree, ct: PyTree) -> tuple[PyTree, None]:
        diff, nondiff, end = residuals
        nondiff, back = eqx.combine(nondiff, static)
        nondiff_step = nondiff[1]

        def undo(state: tuple[PyTree, ...], _: None) -> tuple[Any, None]:
            carry, end_ct, step_ct, sizes = state
            carry = back(carry)
            diff_carry, nondiff = _partition_inexact(carry)

            def diff_step(diff_carry: PyTree, diff: PyTree) -> PyTree:
                step = eqx.combine(diff, nondiff_step)
                return _partition_inexact(step(eqx.combine(diff_carry, nondiff)))[0]

            _, pullback = jax.vjp(diff_step, diff_carry, diff[1])
            start_ct, step_ct_part = pullback(end_ct)
            step_ct = jtu.tree_map(jnp.add, step_ct, step_ct_part)
            sizes = jtu.tree_map(lambda largest, y: jnp.maximum(largest, size(y)), sizes, carry[1])
            return (carry, start_ct, step_ct, sizes), None

        end_ct = eqx.filter(ct, jtu.tree_map(eqx.is_inexact_array, end))
        state = end, end_ct, jtu.tree_map(jnp.zeros_like, diff[1]), jtu.tree_map(size, end[1])
        (undone, *cts, sizes), _ = lax.scan(undo, state, length=num_steps)
        start, step = eqx.combine(diff, nondiff)

        def state_after_step(y: PyTree) -> PyTree:
            return step(eqx.tree_at(lambda carry: carry[1], start, y))[1]

        misses = _misses(state_after_step, start[1], undone[1], sizes)
        fault = Fault.none().with_case(misses, _MISSED)
        zero = (fault.error if throw else fault.nan)(jnp.zeros(()))
        return jtu.tree_map(lambda x: x + zero.astype(x.dtype), tuple(cts)), None

    steps.defvjp(forward, backward)
    return steps(diff, nondiff)


def _partition_inexact(tree: PyTree) -> tuple[PyTree, PyTree]:
    """The leaves that have derivatives, and all others."""
    return eqx.partition(tree, eqx.is_inexact_array)


def _misses(
    step: Callable[[PyTree], PyTree], start: PyTree, undone: PyTree, sizes: PyTree
) -> Bool[Array, ""]:
    """Whether an array of the state is off by more than half of its digits.

    `sizes` are those of the arrays on the way. An array that is zero but for the rounding of the
    others has no digits of its own, so it may be as far off as a step moves it if all others change
    in half of their digits.
    """

    def tolerance(x: Array, scale: Real[Array, ""]) -> Real[Array, ""]:
        return float(jnp.finfo(x.dtype).eps) ** 0.5 * scale

    tolerances = jtu.tree_map(tolerance, start, sizes)
    _, changes = jax.jvp(step, (start,), (jtu.tree_map(_perturbation, start, tolerances),))

    def is_off(
        start: Array, undone: Array, scale: Real[Array, ""], change: Array
    ) -> Bool[Array, ""]:
        # True for NaN.
        return ~(size(undone - start) <= jnp.maximum(scale, size(change)))

    are_off = jtu.tree_map(is_off, start, undone, tolerances, changes)
    return jnp.any(jnp.asarray(jtu.tree_leaves(are_off), bool))


def _perturbation(x: Array, amplitude: Real[Array, ""]) -> Inexact[Array, "..."]:
    """A change of all entries by up to `amplitude`, with no symmetry that could hide its effect."""
    change = amplitude * jnp.cos(jnp.arange(x.size, dtype=amplitude.dtype)).reshape(x.shape)
    return (1 + 1j) * change if jnp.iscomplexobj(x) else change
