"""The implicit midpoint rule at the mean of a flow: an exact Poisson map where nothing splits."""

import math
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._field import is_field
from .._term import product
from .base import AbstractLieSolver, time_at
from .dense import Interpolation, Path
from .fixed_point import fixed_point
from .step import Step, begin_step, finish_step
from .sums import Sums

# The flow of the step's one field, for a part of the step.
_EXTENSION = (((1.0,),),)


class ImplicitMidpoint(AbstractLieSolver):
    """The implicit midpoint rule: order 2, symmetric, for Hamiltonian systems that do not split.

    A step is the flow of `F = h f(t + h/2, Y)`, where Y is the mean of the point along that flow.
    Where the field acts linearly, as `Rotation`, `Conjugation`, `Congruence` and arrays do, and is
    the coadjoint action of a Hamiltonian system, the step is an exact Poisson map: it keeps
    Casimirs and linear momenta to rounding, and the energy does not drift. For other fields Y is
    the middle of the flow (`AbstractFrozenField.mean`), and the step is symmetric only.

    Y is found by fixed-point iteration, 10 to 25 evaluations of the field for usual steps. It ends
    where the changes of each array are rounding of its own size, as what is left over makes the
    energy drift. Derivatives, forward and reverse, are those of the implicit function, by the same
    iteration, and NaN where that does not converge. Output within a step follows the flow, which is
    of order 2.

    **Arguments:** `rtol`, a tolerance for the changes relative to each array, by default rounding:
    1e-10 saves a third of the evaluations. `max_steps`, the most iterations.

    **Raises** `ValueError` for an `rtol` that is not positive or `max_steps` below 1. A step whose
    iteration does not converge, mostly one that is too long, fails with a `diffrax.RESULTS`.

    Source: Bou-Rabee & Marsden, Hamilton-Pontryagin integrators on Lie groups, Found. Comput. Math.
    9 (2009), doi:10.1007/s10208-008-9030-4.
    """

    rtol: float | None = None
    max_steps: int = eqx.field(default=100, static=True)

    interpolation_cls = Interpolation
    takes_noise: ClassVar[bool] = False

    def __check_init__(self):
        rtol = self.rtol
        is_number = eqx.is_array_like(rtol) and not isinstance(rtol, bool)
        if rtol is not None and not (is_number and 0 < rtol < math.inf):
            raise ValueError(f"rtol must be positive and finite, or None, got {rtol!r}.")
        is_int = isinstance(self.max_steps, int) and not isinstance(self.max_steps, bool)
        if not is_int or self.max_steps < 1:
            raise ValueError(f"max_steps must be an integer from 1 on, got {self.max_steps!r}.")

    @property
    def is_symmetric(self):
        return True

    @property
    def shows_failure(self):
        return False

    def order(self, terms):
        return 2

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        t0, _ = begin_step(solver_state, t0, lambda t0: None, made_jump)
        control, middle = terms.contr(t0, t1), time_at(0.5, t0, t1)

        def field(y: PyTree) -> PyTree:
            return product(terms, terms.vf(middle, y, args), control)

        y, has_converged = fixed_point(lambda y: _mean(field(y), y0), y0, self.rtol, self.max_steps)

        def step_from(y0: PyTree) -> Step:
            frozen, sums = field(y), Sums(y0, solver_state.compensation)
            end, _ = sums.materialised(sums.flow_frozen(frozen, sums.start), None, is_followed=True)
            charted, point = Sums(y0).to_chart(frozen, y0)
            return Step(end, Path.of(_EXTENSION, point, [charted]))

        y1, error, dense_info, state, result = finish_step(solver_state, step_from, y0)
        divergence: Any = diffrax.RESULTS.nonlinear_divergence
        result = diffrax.RESULTS.where(has_converged, result, divergence)
        return y1, error, dense_info, state, result


def _mean(field: PyTree, y0: PyTree) -> PyTree:
    """The mean of the flow of a field from y0 over unit time."""

    def part(f: Any, y: PyTree) -> PyTree:
        if not is_field(f):
            return y + f / 2
        charted, point = f.to_chart(y, ())
        return charted.from_chart(charted.mean(point))

    return jtu.tree_map(part, field, y0, is_leaf=is_field)
