"""Norms and first steps for error control that does not depend on the frame."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._arguments import as_state, check_term_and_solver, time_dtype, time_scalar
from .._arrays import describe
from .._field import flow, tangent
from .._term import LieTerm


class ErrorNorm(eqx.Module):
    """The norm of a state whose parts have different scales: for `diffrax.PIDController(norm=...)`.

    It is the root of the mean, over the parts, of the mean square of each part divided by its
    scale. A part with many entries weighs no more than a part with few. Rotating a part does not
    change the norm.

    With `rtol=0` a step is accepted if the norm of its error is below `atol`, so `atol` is relative
    to the scales. A positive `rtol` applies entry by entry, and depends on the frame.

    **Arguments:** `scales`, a pytree of positive real scalars whose structure is a prefix of the
    state's: one for each part, in its unit.

    **Raises** `ValueError` for a scale that is not a scalar, or a structure that is not a prefix of
    the state's; `TypeError` for a scale that is not real; a runtime error for a scale that is not
    positive and finite.
    """

    scales: PyTree

    def __init__(self, scales: PyTree):
        for path, scale in jtu.tree_leaves_with_path(scales):
            if jnp.shape(scale) != ():
                raise ValueError(
                    f"scales{jtu.keystr(path)} must be a scalar, got shape {jnp.shape(scale)}."
                )
            is_real = eqx.is_array_like(scale) and jnp.issubdtype(
                jnp.result_type(scale), jnp.number
            )
            if not is_real or jnp.iscomplexobj(scale):
                raise TypeError(
                    f"scales{jtu.keystr(path)} must be a real number, got {describe(scale)}."
                )
        self.scales = jtu.tree_map(_positive, scales)

    def __call__(self, y: PyTree) -> Real[Array, ""]:
        scales, treedef = jtu.tree_flatten(self.scales)
        squares = []
        for scale, part in zip(scales, treedef.flatten_up_to(y), strict=True):
            square = _mean_square(part)
            squares.append(square / jnp.square(scale.astype(square.dtype)))
        # The root has no derivative at zero, and error control needs none.
        return jnp.sqrt(lax.stop_gradient(jnp.asarray(sum(squares)) / len(squares)))


def _positive(scale: Any) -> Real[Array, ""]:
    scale = jnp.asarray(scale)
    is_positive = (scale > 0) & jnp.isfinite(scale)
    return eqx.error_if(scale, ~is_positive, "scales must be positive and finite.")


def _mean_square(y: PyTree) -> Real[Array, ""]:
    leaves = jtu.tree_leaves(y)
    total = sum(jnp.sum(jnp.square(jnp.abs(leaf))) for leaf in leaves)
    return jnp.asarray(total / max(1, sum(jnp.size(leaf) for leaf in leaves)))


def starting_step(
    term: diffrax.AbstractTerm,
    solver: diffrax.AbstractSolver,
    t0: Any,
    t1: Any,
    y0: PyTree,
    args: PyTree = None,
    *,
    atol: float | Real[Array, ""],
    norm: Any = None,
) -> Real[Array, ""]:
    """A first step for `diffrax.diffeqsolve(..., dt0=...)`, whose own choice is always 0.01.

    The velocity v at the start and its rate of change r along a small flow determine the step h:
    its error, estimated as `h |v| (h r)^order`, is `atol / 100`. It costs 2 evaluations and 1 flow.

    The small flow moves the state by a hundredth of its size. For a state at or near zero the size
    is the geometric mean of `atol` and the distance that v covers until `t1`. If the state starts
    at rest, the small flow lasts a hundredth of the interval.

    **Arguments:** `term`, `solver`, `t0`, `t1`, `y0`, `args` as for `diffrax.diffeqsolve`; the
    solver's order is used. `atol`, positive, and `norm` as for `diffrax.PIDController`, with
    `rtol=0`.

    **Returns:** a scalar with the sign of `t1 - t0`, at most as long. It scales with the unit of
    time, and does not change with the unit of the state and `atol`.

    **Raises** `TypeError` if the term is not a `cfjax.LieTerm` or `diffrax.ODETerm`, if the solver
    is not an instance of a diffrax solver, or if `t0`, `t1` or `atol` is not a real scalar; a
    runtime error if `atol` is not positive and finite, if `t0` is not finite, if `t1` is NaN, or if
    it is infinite and the state stays at rest.

    Source: the algorithm of Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I,
    Section II.4, with an error and a small flow that scale with the unit of time.
    """
    if not isinstance(term, LieTerm | diffrax.ODETerm):
        raise TypeError(
            f"term must be a cfjax.LieTerm or a diffrax.ODETerm, got {type(term).__name__}."
        )
    check_term_and_solver(term, solver)
    norm = (lambda y: jnp.sqrt(_mean_square(y))) if norm is None else norm
    y0 = as_state(y0)
    dtype = time_dtype(y0)
    times = {"t0": t0, "t1": t1, "atol": atol}
    t0, t1, tolerance = (time_scalar(name, x, dtype) for name, x in times.items())
    is_tolerance = (tolerance > 0) & jnp.isfinite(tolerance)
    tolerance = eqx.error_if(tolerance, ~is_tolerance, "atol must be positive and finite.")
    t0 = eqx.error_if(t0, ~jnp.isfinite(t0), "t0 must be finite.")
    t1 = eqx.error_if(t1, jnp.isnan(t1), "t1 must be a number, got NaN.")
    length = jnp.abs(t1 - t0)
    sign = jnp.sign(t1 - t0)

    def scaled_norm(y):
        return norm(jtu.tree_map(lambda leaf: leaf / tolerance.astype(leaf.dtype), y))

    f0 = term.vf(t0, y0, args)
    v0 = tangent(f0, y0)
    # In units of atol.
    size, speed = scaled_norm(y0), scaled_norm(v0)
    distance = jnp.where(jnp.isfinite(length), speed * length, 1)
    size = jnp.maximum(size, jnp.sqrt(distance))
    time = jnp.where(speed > 0, size / jnp.where(speed > 0, speed, 1), length)
    h0 = (0.01 * jnp.minimum(time, length)).astype(dtype)
    y1 = flow(term.prod(f0, sign * h0), y0)
    v1 = tangent(term.vf(t0 + sign * h0, y1, args), y1)
    change = scaled_norm(jtu.tree_map(jnp.subtract, v1, v0))
    speed = jnp.maximum(speed, scaled_norm(v1))
    # How fast the velocity changes, as a rate: derivatives are taken to grow by it.
    rate = change / (jnp.where(h0 > 0, h0, 1) * jnp.where(speed > 0, speed, 1))
    order = solver.order(term) or 1
    error = speed * rate**order
    h1 = jnp.where(error > 0, (0.01 / jnp.where(error > 0, error, 1)) ** (1 / (order + 1)), length)
    step = jnp.minimum(jnp.where(speed > 0, jnp.minimum(100 * h0, h1), length), length)
    # Only the interval limits the step from a state that stays at rest.
    step = eqx.error_if(step, jnp.isinf(step), "t1 must be finite, as y0 is at rest.")
    return lax.stop_gradient((sign * step).astype(dtype))
