"""An error estimate for any solver, by step doubling."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, PyTree

from .._control_term import is_driven
from .base import finite_if_complex
from .dense import Interpolation, Substeps
from .solver import AbstractSolver, as_own
from .substeps import first_failure


class Richardson(AbstractSolver, diffrax.AbstractAdaptiveSolver, diffrax.AbstractWrappedSolver):
    """Any solver with an error estimate, by step doubling (Richardson extrapolation).

    Every step is made twice: as one step, to `y1`, and as two half steps, to `y2`. For a solver of
    order p the error of `y2` is `e = (y1 - y2) / (2^p - 1)`, up to terms of higher order. The
    solver continues from `y2`, whose error it estimates, or from `y1` with `as_in_paper` (see
    below). The difference is taken in the ambient space: it is not a tangent vector, but is of
    order `h^(p+1)` on a manifold too.

    A tolerance for `e` would bound the error of each step, and tighter tolerances take more steps,
    so the error at the end over the tolerance would grow like `tol^(-1/(p+1))`. So the estimate is
    the error that such steps add up to over the solution's own unit of time, in which a single step
    would have an error as large as the state. This unit has `(|y| / |e|)^(1/(p+1))` steps, and the
    estimate is `e` times that many, or `e` if that is less than one. The estimate is of order
    `h^p`, like the error at the end, which is then proportional to the tolerance. The norms are
    Euclidean, of one array of the state at a time, so the estimate does not depend on frames or
    units. A state far from its origin takes somewhat shorter steps than it needs: ten times |y|
    gives `10^(1/(p+1))` times the estimate.

    It makes adaptive steps with `diffrax.PIDController`; on compact groups use `rtol=0`. The ratio
    of the error at the end to the tolerance depends on the problem and on the length of the
    interval: for the free rigid body to t = 10 it is about 5 with `CF4` at all tolerances.

    A step costs three steps of the solver. The first evaluation is shared, if XLA recognises it.

    **Arguments:**

    - `solver`: a diffrax solver for ordinary differential equations, of known order. An implicit
      one solves its equations with the controller's tolerances.
    - `as_in_paper`: whether to continue from `y1` with `e` itself as the estimate, as the paper
      does for its tables. The estimate is then the error of a point that the solver does not use:
      the error of a step is `2^p` times as large.

    With `as_in_paper` the paper's controller is, with one difference,

    ```python
    diffrax.PIDController(
        rtol=0, atol=tol, norm=max_norm, safety=0.9, factormin=1e-3, factormax=1e3
    )
    ```

    with `max_norm` the maximum norm of the grid values. It is `h_new = 0.9 (tol / err)^(1/(p+1)) h`
    (printed upside down in the paper), and a step is kept if `err <= tol`. The difference: after a
    step that was kept, diffrax never shrinks the next one. So a solver at the limit of its
    stability has one step in eight rejected, and hardly any with the paper's controller.

    Output between steps is that of `solver` in the two half steps, or in the whole one if
    `as_in_paper`.

    **Raises** `TypeError` for arguments of other types, `ValueError` if the solver's order is
    unknown.

    Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
    Section 3.3, doi:10.1016/S0167-739X(02)00161-9; Hairer, Norsett & Wanner, Solving Ordinary
    Differential Equations I (1993), Section II.4, doi:10.1007/978-3-540-78862-1; for
    proportionality, Higham, IMA J. Numer. Anal. 11 (1991).
    """

    solver: diffrax.AbstractSolver
    as_in_paper: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        if not isinstance(self.solver, diffrax.AbstractSolver):
            raise TypeError(f"solver must be a diffrax solver, got {self.solver!r}.")
        if not isinstance(self.as_in_paper, bool):
            raise TypeError(f"as_in_paper must be a bool, got {self.as_in_paper!r}.")

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def root_finder(self) -> Any:
        """The root finder of an implicit solver: diffrax gives it the controller's tolerances."""
        return cast(diffrax.AbstractImplicitSolver, self.solver).root_finder

    @property
    def interpolation_cls(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        inner = self.solver.interpolation_cls
        return inner if self.as_in_paper else _HalvesFactory(inner)

    def order(self, terms) -> int:
        if is_driven(terms):
            raise TypeError(
                "Richardson extrapolates the order of an ordinary equation, which an equation "
                "driven by a path does not have: use diffrax.HalfSolver(solver) for adaptive steps."
            )
        order = self.solver.order(terms)
        if order is None:
            raise ValueError(f"Richardson needs a solver of known order, got {self.solver!r}.")
        return order

    def strong_order(self, terms) -> None:
        return None

    def error_order(self, terms) -> int:
        # diffrax takes the power of h that the estimate behaves like.
        return self.order(terms) + (1 if self.as_in_paper else 0)

    def start(self, terms, t0, t1, y0, args):
        return as_own(self.solver).start(terms, t0, t1, y0, args)

    def init(self, terms, t0, t1, y0, args) -> PyTree:
        return self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        middle = t0 + (t1 - t0) / 2

        def step(t0, t1, y0, state, made_jump):
            return self.solver.step(terms, t0, t1, y0, args, state, made_jump)

        y1, _, whole, state, result = step(t0, t1, y0, solver_state, made_jump)
        y_half, _, first, state_half, result_1 = step(t0, middle, y0, solver_state, made_jump)
        y2, _, second, state_2, result_2 = step(middle, t1, y_half, state_half, False)

        order = self.order(terms)
        error = jtu.tree_map(lambda a, b: (a - b) / (2**order - 1), y1, y2)
        if not self.as_in_paper:
            error = jtu.tree_map(partial(_accumulated, order), error, y0, y2)
        result = first_failure(result, result_1, result_2)
        if result is not diffrax.RESULTS.successful:
            # What a failed step returns may look like a small error. As in diffrax, it is rejected.
            okay = diffrax.is_okay(result)
            error = jtu.tree_map(lambda e: jnp.where(okay, e, jnp.inf), error)
        error = finite_if_complex(error)
        if self.as_in_paper:
            return y1, error, whole, state, result
        return y2, error, dict(first=first, second=second), state_2, result

    def func(self, terms, t0, y0, args) -> Any:
        return self.solver.func(terms, t0, y0, args)


def _accumulated(order: int, error: Array, y0: Array, y2: Array) -> Array:
    """The error of a step, times the number of such steps in the solution's own unit of time."""
    size = lax.stop_gradient(jnp.linalg.norm(jnp.ravel(error)))
    scale = lax.stop_gradient(jnp.maximum(*(jnp.linalg.norm(jnp.ravel(y)) for y in (y0, y2))))
    # Also where the error is zero or not a number.
    steps = jnp.where(size > 0, scale / jnp.where(size > 0, size, 1), 1) ** (1 / (order + 1))
    return error * jnp.maximum(steps, 1).astype(error.dtype)


class _HalvesFactory(NamedTuple):
    """Equal to itself and hashable, as diffrax keeps it as a static field."""

    interpolation_cls: Callable[..., diffrax.AbstractLocalInterpolation]

    def __call__(self, *, t0, t1, first, second) -> Interpolation:
        middle = t0 + (t1 - t0) / 2
        halves = (t0, middle, first), (middle, t1, second)
        outputs = [self.interpolation_cls(t0=t0, t1=t1, **info) for t0, t1, info in halves]
        return Interpolation(t0=t0, t1=t1, path=Substeps(outputs))
