"""Compositions: a symmetric method raised to a higher order by steps of several lengths."""

import itertools
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
from jax import lax

from .._methods.splitting import COMPOSITIONS
from .base import AbstractLieSolver, State, result_of
from .dense import Interpolation, Substeps
from .substeps import substeps


class _Interval(NamedTuple):
    """Where a substep begins and ends, as parts of the step."""

    start: Any
    end: Any


class Composition(AbstractLieSolver):
    """A symmetric solver to order 4, 6 or 8, by 5, 11 or 17 of its steps, some backwards in time.

    It keeps what the solver keeps: it is symplectic, symmetric or on the manifold as that is. For
    output within a step each of its steps has the same part of the time; that is on the manifold
    and meets both ends.

    ```python
    cfjax.integrate(term, cfjax.Composition(cfjax.Strang(), 6), 0.0, 100.0, y0, num_steps=1000)
    ```

    **Arguments:** `solver`, a symmetric one: `cfjax.Strang`, another splitting whose stages
    are a palindrome, or `cfjax.ImplicitMidpoint`. `order`, 4, 6 or 8.

    **Raises** `TypeError` for another solver, `ValueError` for another order; when traced
    `TypeError` for terms that a path drives.

    Source: Suzuki (order 4), Sofroniou & Spaletta (6), Kahan & Li (8), see
    `cfjax/_methods/splitting.py`; Hairer, Lubich & Wanner, Geometric Numerical Integration, Section
    V.3.2.
    """

    solver: AbstractLieSolver
    composition_order: int = eqx.field(static=True)

    interpolation_cls: ClassVar[Any] = Interpolation
    takes_noise: ClassVar[bool] = False

    def __init__(self, solver: AbstractLieSolver, order: int):
        if not isinstance(solver, AbstractLieSolver) or not solver.is_symmetric:
            raise TypeError(
                f"solver must be a symmetric one, such as cfjax.Strang(), got {solver!r}."
            )
        if order not in COMPOSITIONS:
            raise ValueError(f"order must be 4, 6 or 8, got {order!r}.")
        self.solver, self.composition_order = solver, order

    @property
    def term_structure(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def is_symmetric(self):
        return True

    @property
    def shows_failure(self):
        return self.solver.shows_failure

    def order(self, terms):
        return self.composition_order

    def for_terms(self, terms):
        self.solver.for_terms(terms)
        return super().for_terms(terms)

    def start(self, terms, t0, t1, y0, args):
        self.for_terms(terms)
        return self.solver.start(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        if made_jump is not False:
            first = lax.cond(
                made_jump,
                lambda: self.solver.start(terms, t0, t1, y0, args)[0].first,
                lambda: solver_state.first,
            )
            solver_state = State(solver_state.compensation, first, solver_state.zero)
        ends = [0.0, *itertools.accumulate(COMPOSITIONS[self.composition_order][:-1]), 1.0]
        intervals = list(itertools.starmap(_Interval, itertools.pairwise(ends)))
        (y1, state, result), outputs = substeps(
            self.solver,
            lambda _: terms,
            intervals,
            t0,
            t1,
            args,
            (y0, solver_state, diffrax.RESULTS.successful),
        )
        result = result_of(y1) if self.shows_failure else result
        return y1, None, dict(path=Substeps(outputs)), state, result
