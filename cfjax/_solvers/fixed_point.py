"""Fixed points by iteration, and derivatives of them."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Int, PyTree

from .base import size

Map = Callable[[PyTree], PyTree]


def fixed_point(
    fun: Map, start: PyTree, rtol: float | None, max_steps: int
) -> tuple[PyTree, Bool[Array, ""]]:
    """A solution of `fun(y) = y` by iteration from `start`, and whether it is one.

    Its derivatives are those of the implicit function, by the same iteration: NaN where that does
    not converge.
    """

    def residual(y: PyTree) -> PyTree:
        return jtu.tree_map(jnp.subtract, y, fun(y))

    def solve(residual: Map, start: PyTree) -> tuple[PyTree, Array]:
        step = lambda y: jtu.tree_map(jnp.subtract, y, residual(y))  # noqa: E731
        y, has_converged = _iterate(step, start, rtol, max_steps)
        # JAX asks for a derivative of it.
        return y, has_converged.astype(jnp.float32)

    def linear_solve(matvec: Map, b: PyTree) -> PyTree:
        step = lambda x: jtu.tree_map(lambda x, a, b: x - (a - b), x, matvec(x), b)  # noqa: E731
        x, has_converged = _iterate(step, b, rtol, max_steps)
        return jtu.tree_map(lambda x: jnp.where(has_converged, x, jnp.nan), x)

    def tangent_solve(matvec: Map, b: PyTree) -> PyTree:
        return lax.custom_linear_solve(matvec, b, linear_solve, linear_solve)

    y, has_converged = lax.custom_root(residual, start, solve, tangent_solve, has_aux=True)
    return y, has_converged > 0


class _Iteration(NamedTuple):
    """The state of an iteration.

    `start_sizes` are the sizes of the arrays at the start, and `changes` the sizes of their last
    three changes, the last one first.
    """

    y: PyTree
    y_next: PyTree
    number: Int[Array, ""]
    start_sizes: list[Array]
    changes: tuple[list[Array], list[Array], list[Array]]


def _iterate(
    step: Map, start: PyTree, rtol: float | None, max_steps: int
) -> tuple[PyTree, Bool[Array, ""]]:
    """Replaces y by `step(y)` until no array changes by more than its rounding, or the tolerance.

    Changes may grow for many turns before they fall, if the derivative of the step is not normal.
    So only changes of the size of rounding end where they do not fall.

    An array that is done stays while others change. Otherwise the rounding of large numbers
    may change small ones in every turn, such as a momentum among forces that nearly cancel.
    """
    leaves, treedef = jtu.tree_flatten(start)

    def are_done(state: _Iteration) -> Bool[Array, " arrays"]:
        def is_done(y: Array, start_size: Array, last: Array, _: Array, earlier: Array) -> Array:
            eps = float(jnp.finfo(y.dtype).eps)
            tolerance = 2 * eps if rtol is None else rtol
            # Eigenvalues come in pairs of opposite signs, with which a change may be larger than
            # the last one. So it is compared with an earlier one. A change that falls no more may
            # be the rounding of the field.
            has_ended = (state.number >= 4) & (last >= earlier) | (state.number >= max_steps)
            bound = jnp.where(has_ended, max(1e4 * eps, tolerance), tolerance)
            scale = jnp.maximum(size(y), start_size)
            return jnp.isfinite(last) & (last <= bound.astype(start_size.dtype) * scale)

        flags = map(is_done, treedef.flatten_up_to(state.y_next), state.start_sizes, *state.changes)
        return jnp.asarray(list(flags), bool)

    # XLA computes the start and a step once if what else uses their entries is in another turn.
    def advance(state: _Iteration) -> _Iteration:
        y = state.y_next
        if len(leaves) > 1:
            done = are_done(state)
            pairs = zip(treedef.flatten_up_to(state.y), treedef.flatten_up_to(y), strict=True)
            y = treedef.unflatten(jnp.where(k, *pair) for k, pair in zip(done, pairs, strict=True))
        y_next = step(y)
        change = jtu.tree_leaves(jtu.tree_map(lambda y_next, y: size(y_next - y), y_next, y))
        start_sizes = [
            jnp.where(state.number == 0, size(y), start_size)
            for y, start_size in zip(jtu.tree_leaves(y), state.start_sizes, strict=True)
        ]
        last, earlier, _ = state.changes
        return _Iteration(y, y_next, state.number + 1, start_sizes, (change, last, earlier))

    def continues(state: _Iteration) -> Bool[Array, ""]:
        # NaN would never end otherwise.
        is_number = jnp.all(jnp.asarray([~jnp.isnan(x) for x in state.changes[0]], bool))
        return (state.number < max_steps) & ~jnp.all(are_done(state)) & is_number

    zeros = [jnp.zeros((), jnp.finfo(x.dtype).dtype) for x in leaves]
    infinite = [jnp.full_like(x, jnp.inf) for x in zeros]
    state = _Iteration(start, start, jnp.asarray(0), zeros, (infinite, infinite, infinite))
    state = lax.while_loop(continues, advance, state)
    return state.y_next, jnp.all(are_done(state))
