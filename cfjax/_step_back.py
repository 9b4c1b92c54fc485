"""Equal steps whose reverse mode undoes them, so that it keeps the end alone."""

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

        def undo(state: tuple[PyTree, ...], _: None) -> tuple[Any, None]:
            carry, of_end, of_step, sizes = state
            carry = back(carry)
            varying, rest = _parts(carry)

            def stepped(varying: PyTree, moving: PyTree) -> PyTree:
                step = eqx.combine(moving, fixed)
                return _parts(step(eqx.combine(varying, rest)))[0]

            _, pullback = jax.vjp(stepped, varying, moving[1])
            of_start, more = pullback(of_end)
            of_step = jtu.tree_map(jnp.add, of_step, more)
            sizes = jtu.tree_map(lambda most, y: jnp.maximum(most, size(y)), sizes, carry[1])
            return (carry, of_start, of_step, sizes), None

        of_end = eqx.filter(derivative, jtu.tree_map(eqx.is_inexact_array, end))
        state = end, of_end, jtu.tree_map(jnp.zeros_like, moving[1]), jtu.tree_map(size, end[1])
        (found, *derivatives, sizes), _ = lax.scan(undo, state, length=num_steps)
        start, step = eqx.combine(moving, rest)

        def moved(y: PyTree) -> PyTree:
            return step(eqx.tree_at(lambda carry: carry[1], start, y))[1]

        misses = _misses(moved, start[1], found[1], sizes)
        fault = Fault.none().with_case(misses, _MISSED)
        zero = (fault.error if throw else fault.nan)(jnp.zeros(()))
        return jtu.tree_map(lambda x: x + zero.astype(x.dtype), tuple(derivatives)), None

    steps.defvjp(forward, backward)
    return steps(moving, rest)


def _parts(tree: PyTree) -> tuple[PyTree, PyTree]:
    """What has a derivative, and the rest."""
    return eqx.partition(tree, eqx.is_inexact_array)


def _misses(
    step: Callable[[PyTree], PyTree], start: PyTree, found: PyTree, sizes: PyTree
) -> Bool[Array, ""]:
    """Whether an array of the state is off by more than half of its digits.

    `sizes` are those of the arrays on the way. An array that is zero but for the rounding of the
    others has no digits of its own, so it may be as far off as a step moves it if all others change
    in half of their digits.
    """

    def half(x: Array, own: Real[Array, ""]) -> Real[Array, ""]:
        return float(jnp.finfo(x.dtype).eps) ** 0.5 * own

    allowed = jtu.tree_map(half, start, sizes)
    _, moves = jax.jvp(step, (start,), (jtu.tree_map(_change, start, allowed),))

    def part(start: Array, found: Array, own: Real[Array, ""], move: Array) -> Bool[Array, ""]:
        # True for NaN.
        return ~(size(found - start) <= jnp.maximum(own, size(move)))

    parts = jtu.tree_map(part, start, found, allowed, moves)
    return jnp.any(jnp.asarray(jtu.tree_leaves(parts), bool))


def _change(x: Array, by: Real[Array, ""]) -> Inexact[Array, "..."]:
    """A change of all entries by up to this, in which no symmetry hides what depends on them."""
    change = by * jnp.cos(jnp.arange(x.size, dtype=by.dtype)).reshape(x.shape)
    return (1 + 1j) * change if jnp.iscomplexobj(x) else change
