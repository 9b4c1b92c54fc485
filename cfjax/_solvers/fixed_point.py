"""Fixed points by iteration, and derivatives of them."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, PyTree, Real

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
    """How far an iteration is: the changes are of each array, in units of its rounding."""

    y: PyTree
    number: Int[Array, ""]
    change: Real[Array, " arrays"]
    # The last change and the one before.
    past: tuple[Real[Array, " arrays"], Real[Array, " arrays"]]


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
    if not leaves:
        return start, jnp.asarray(True)
    sizes = list(map(size, leaves))
    tolerance = np.asarray([1 if rtol is None else rtol / _unit(x) for x in leaves], np.float32)
    # What the rounding of a field may leave.
    most = np.maximum(tolerance, 5e3)

    def are_done(turn: _Turn) -> Bool[Array, " arrays"]:
        # Eigenvalues come in pairs of opposite signs, with which a change may be larger than the
        # last one. So it is compared with the one before.
        has_stalled = (turn.number >= 4) & (turn.change >= turn.past[1])
        return turn.change <= jnp.where(has_stalled, most, tolerance)

    def turned(turn: _Turn) -> _Turn:
        new = step(turn.y)
        ys, news = jtu.tree_leaves(turn.y), structure.flatten_up_to(new)
        changes = jnp.stack(list(map(_change, ys, news, sizes)))
        turn = _Turn(new, turn.number + 1, changes, (turn.change, turn.past[0]))
        if len(leaves) == 1:
            return turn
        done = are_done(turn)
        kept = done & ~jnp.all(done)
        chosen = [jnp.where(k, y, new) for k, y, new in zip(kept, ys, news, strict=True)]
        return turn._replace(y=structure.unflatten(chosen))

    def goes_on(turn: _Turn) -> Bool[Array, ""]:
        # NaN never ends otherwise.
        is_nan = jnp.isnan(jnp.max(turn.change))
        return (turn.number < max_steps) & ~jnp.all(are_done(turn)) & ~is_nan

    infinite = jnp.full(len(leaves), jnp.inf, jnp.float32)
    turn = _Turn(start, jnp.asarray(0), infinite, (infinite, infinite))
    turn = lax.while_loop(goes_on, turned, turn)
    return turn.y, jnp.all(are_done(turn))


def _unit(x: Array) -> float:
    return 2 * float(jnp.finfo(x.dtype).eps)


def _change(y: Array, new: Array, start: Real[Array, ""]) -> Real[Array, ""]:
    """By how many units of rounding an array changes, for what is as large as it is or was."""
    whole = jnp.maximum(jnp.maximum(size(new), start), jnp.finfo(y.dtype).tiny)
    return (size(new - y) / whole / _unit(y)).astype(jnp.float32)
