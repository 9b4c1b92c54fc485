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
        y, has_converged = _iterated(step, start, rtol, max_steps)
        # JAX asks for a derivative of it.
        return y, has_converged.astype(jnp.float32)

    def linear_solve(matvec: Map, b: PyTree) -> PyTree:
        step = lambda x: jtu.tree_map(lambda x, a, b: x - (a - b), x, matvec(x), b)  # noqa: E731
        x, has_converged = _iterated(step, b, rtol, max_steps)
        return jtu.tree_map(lambda x: jnp.where(has_converged, x, jnp.nan), x)

    def tangent_solve(matvec: Map, b: PyTree) -> PyTree:
        return lax.custom_linear_solve(matvec, b, linear_solve, linear_solve)

    y, has_converged = lax.custom_root(residual, start, solve, tangent_solve, has_aux=True)
    return y, has_converged > 0


class _Turn(NamedTuple):
    """How far an iteration is.

    `starts` are the sizes of the arrays at the start, and `changes` how much they changed, the last
    time first.
    """

    y: PyTree
    new: PyTree
    number: Int[Array, ""]
    starts: list[Array]
    changes: tuple[list[Array], list[Array], list[Array]]


def _iterated(
    step: Map, start: PyTree, rtol: float | None, max_steps: int
) -> tuple[PyTree, Bool[Array, ""]]:
    """Replaces y by `step(y)` until no array changes by more than its rounding, or the tolerance.

    Changes may grow for many turns before they fall, if the derivative of the step is not normal.
    So only changes of the size of rounding end where they do not fall.

    An array that has come so far stays while others move. Otherwise the rounding of large numbers
    may change small ones in every turn, such as a momentum among forces that nearly cancel.
    """
    leaves, structure = jtu.tree_flatten(start)

    def are_done(turn: _Turn) -> Bool[Array, " arrays"]:
        def is_done(new: Array, own: Array, last: Array, _: Array, before: Array) -> Array:
            eps = float(jnp.finfo(new.dtype).eps)
            tolerance = 2 * eps if rtol is None else rtol
            # Eigenvalues come in pairs of opposite signs, with which a change may be larger than
            # the last one. So it is compared with the one before. What falls no more may be what
            # the rounding of the field leaves.
            has_ended = (turn.number >= 4) & (last >= before) | (turn.number >= max_steps)
            most = jnp.where(has_ended, max(1e4 * eps, tolerance), tolerance)
            whole = jnp.maximum(size(new), own)
            return jnp.isfinite(last) & (last <= most.astype(own.dtype) * whole)

        parts = map(is_done, structure.flatten_up_to(turn.new), turn.starts, *turn.changes)
        return jnp.asarray(list(parts), bool)

    # XLA computes the start and a step once if what else uses their entries is in another turn.
    def turned(turn: _Turn) -> _Turn:
        y = turn.new
        if len(leaves) > 1:
            done = are_done(turn)
            pairs = zip(structure.flatten_up_to(turn.y), structure.flatten_up_to(y), strict=True)
            y = structure.unflatten(
                jnp.where(k, *pair) for k, pair in zip(done, pairs, strict=True)
            )
        new = step(y)
        change = jtu.tree_leaves(jtu.tree_map(lambda new, y: size(new - y), new, y))
        starts = [
            jnp.where(turn.number == 0, size(y), own)
            for y, own in zip(jtu.tree_leaves(y), turn.starts, strict=True)
        ]
        last, before, _ = turn.changes
        return _Turn(y, new, turn.number + 1, starts, (change, last, before))

    def goes_on(turn: _Turn) -> Bool[Array, ""]:
        # What is not a number never ends otherwise.
        is_number = jnp.all(jnp.asarray([~jnp.isnan(x) for x in turn.changes[0]], bool))
        return (turn.number < max_steps) & ~jnp.all(are_done(turn)) & is_number

    zeros = [jnp.zeros((), jnp.finfo(x.dtype).dtype) for x in leaves]
    infinite = [jnp.full_like(x, jnp.inf) for x in zeros]
    turn = _Turn(start, start, jnp.asarray(0), zeros, (infinite, infinite, infinite))
    turn = lax.while_loop(goes_on, turned, turn)
    return turn.new, jnp.all(are_done(turn))
