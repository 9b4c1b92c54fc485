"""An error estimate for any solver, by step doubling."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree


class Richardson(diffrax.AbstractAdaptiveSolver, diffrax.AbstractWrappedSolver):
    """Any solver with the error estimate of step doubling (Richardson extrapolation).

    Every step is made twice: as one step, to `y1`, and as two halves, to `y2`. For a solver of
    order p the error of `y1` is `2^p / (2^p - 1)` times their difference, and that of `y2` is
    `(y1 - y2) / (2^p - 1)`, up to terms of higher order. The estimate is the latter, whichever of
    the two the solver goes on with. The difference is taken in the ambient space: it is no tangent
    vector, but on a manifold too it is of order `h^(p+1)`.

    It makes adaptive steps with `diffrax.PIDController`; on compact groups use `rtol=0`. The
    paper's controller is, but for one point,

    ```python
    diffrax.PIDController(
        rtol=0, atol=tol, norm=max_norm, safety=0.9, factormin=1e-3, factormax=1e3
    )
    ```

    with `max_norm` the maximum norm of the grid values. It is `h_new = 0.9 (tol / err)^(1/(p+1)) h`
    (printed upside down in the paper), and a step is kept where `err <= tol`. The point: after a
    step that was kept, diffrax never shrinks the next one. So a solver at the limit of its
    stability has one step in eight rejected, where the paper's has hardly any.

    Costs three steps of the solver. Its first evaluation is shared, if XLA sees it.

    **Arguments:**

    - `solver`: a diffrax solver for ordinary differential equations, of known order.
    - `advance_by_halves`: whether to go on from `y2`, the more accurate solution at no further
      cost, instead of `y1`, as the paper does.

    Output between steps is as good as that of `solver`: by default that of its whole step, else
    that of its two half steps.

    **Raises** `TypeError` for arguments of other types, `ValueError` if the solver's order is
    unknown.

    Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
    Section 3.3; Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I (1993),
    Section II.4.
    """

    solver: diffrax.AbstractSolver
    advance_by_halves: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        if not isinstance(self.solver, diffrax.AbstractSolver):
            raise TypeError(f"solver must be a diffrax solver, got {self.solver!r}.")
        if not isinstance(self.advance_by_halves, bool):
            raise TypeError(f"advance_by_halves must be a bool, got {self.advance_by_halves!r}.")

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def root_finder(self) -> Any:
        """That of an implicit solver: diffrax gives it the controller's tolerances."""
        return cast(diffrax.AbstractImplicitSolver, self.solver).root_finder

    @property
    def interpolation_cls(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
    ) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        inner = self.solver.interpolation_cls
        return _HalvesFactory(inner) if self.advance_by_halves else inner

    def order(self, terms) -> int:
        order = self.solver.order(terms)
        if order is None:
            raise ValueError(f"Richardson needs a solver of known order, got {self.solver!r}.")
        return order

    def error_order(self, terms) -> int:
        # diffrax takes the power of h that the estimate behaves like.
        return self.order(terms) + 1

    def init(self, terms, t0, t1, y0, args) -> PyTree:
        return self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        middle = t0 + (t1 - t0) / 2

        def step(t0, t1, y0, state, made_jump):
            return self.solver.step(terms, t0, t1, y0, args, state, made_jump)

        y1, _, whole, state, result = step(t0, t1, y0, solver_state, made_jump)
        y_half, _, first, state_half, result_1 = step(t0, middle, y0, solver_state, made_jump)
        y2, _, second, state_2, result_2 = step(middle, t1, y_half, state_half, False)

        factor = 1 / (2 ** self.order(terms) - 1)
        error = jtu.tree_map(lambda a, b: (a - b) * factor, y1, y2)
        result = _first_failure(result, result_1, result_2)
        if result is not diffrax.RESULTS.successful:
            # What a failed step returns may look like a small error. As in diffrax, it is rejected.
            okay = diffrax.is_okay(result)
            error = jtu.tree_map(lambda e: jnp.where(okay, e, jnp.inf), error)
        if self.advance_by_halves:
            halves = dict(first=first, second=second)
            return y2, error, halves, state_2, result
        return y1, error, whole, state, result

    def func(self, terms, t0, y0, args) -> Any:
        return self.solver.func(terms, t0, y0, args)


def _first_failure(*results: diffrax.RESULTS) -> diffrax.RESULTS:
    first, *rest = results
    for result in rest:
        # Left out where no step can fail: a loop of small steps feels every operation.
        if result is not diffrax.RESULTS.successful:
            is_first = first == diffrax.RESULTS.successful
            first = diffrax.RESULTS.where(is_first, result, first)
    return first


class _HalvesFactory(NamedTuple):
    """Equal to itself and hashable, as diffrax keeps it as a static field."""

    interpolation_cls: Callable[..., diffrax.AbstractLocalInterpolation]

    def __call__(self, *, t0, t1, first, second) -> "_HalvesInterpolation":
        middle = t0 + (t1 - t0) / 2
        return _HalvesInterpolation(
            t0=t0,
            t1=t1,
            middle=middle,
            first=self.interpolation_cls(t0=t0, t1=middle, **first),
            second=self.interpolation_cls(t0=middle, t1=t1, **second),
        )


class _HalvesInterpolation(diffrax.AbstractLocalInterpolation):
    """The output of two half steps."""

    t0: Any
    t1: Any
    middle: Any
    first: diffrax.AbstractLocalInterpolation
    second: diffrax.AbstractLocalInterpolation

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree:
        """The solution at time `t0`, or its increment from `t0` to `t1`."""
        if t1 is not None:
            start, end = self.evaluate(t0, left=left), self.evaluate(t1, left=left)
            return jtu.tree_map(jnp.subtract, end, start)
        backwards = self.t1 < self.t0
        in_first = jnp.where(backwards, t0 >= self.middle, t0 <= self.middle)
        # Each half is asked at a time of its own only: others may be an error there.
        a = self.first.evaluate(jnp.where(in_first, t0, self.middle), left=left)
        b = self.second.evaluate(jnp.where(in_first, self.middle, t0), left=left)
        return jtu.tree_map(lambda a, b: jnp.where(in_first, a, b), a, b)
