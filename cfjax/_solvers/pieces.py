"""Methods for noise: a step follows a path of straight pieces, each a step of another method.

On a piece the equation is an ordinary one, of the field `a h f(y) + g(y)(b W + c H)`, where W is
the increment of the Brownian motion over the step of length h and H its space-time Lévy area,
normal of variance h/12 and independent of W. So a method is rows of numbers (a, b, c).
"""

import abc
import functools
import itertools
from math import sqrt
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._control_term import is_driven, paths
from .._term import product
from .base import AbstractLieSolver, result_of
from .commutator_free import CF4, LieEuler
from .compiled import control_of
from .dense import Interpolation, Substeps
from .dependence import state_dependent
from .step import AbstractChartSolver
from .substeps import substeps


class _Piece(NamedTuple):
    """The parts (a, b, c) of the step's time, W and H in a piece, and where it starts and ends."""

    time: Any
    increment: Any
    area: Any
    start: Any = 0.0
    end: Any = 0.0


class AbstractPieces(AbstractLieSolver, diffrax.AbstractStratonovichSolver):
    """Steps of a solver along the pieces of a path.

    For output within a step each piece has the same part of the step's time. That stays on the
    manifold and meets both ends, but is no Brownian path.
    """

    solver: eqx.AbstractVar[AbstractChartSolver]
    # Their times, increments and areas.
    rows: ClassVar[tuple[tuple[float, float, float], ...]]

    interpolation_cls: ClassVar[Any] = Interpolation

    def __check_init__(self):
        _check_solver("solver", self.solver)

    @abc.abstractmethod
    def check_for_state(self) -> None:
        """Raises `TypeError` if the fields of the noise must not depend on the state."""

    def solver_of(self, piece: _Piece, is_constant: bool) -> AbstractChartSolver:
        """The solver along a piece."""
        return self.solver

    def order(self, terms):
        return self.solver.order(terms)

    def without_estimate(self):
        return self._with(solver=self.solver.without_estimate())

    def unrolled(self):
        return self._with(solver=self.solver.unrolled())

    def start(self, terms, t0, t1, y0, args):
        _check_paths(type(self).__name__, terms)
        if not _is_constant(terms, t0, t1, y0, args):
            self.check_for_state()
        return super().start(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        control = control_of(terms, t0, t1, use_levy=True)
        is_constant = _is_constant(terms, t0, t1, y0, args)
        times = itertools.accumulate((a for a, *_ in self.rows), initial=0.0)
        intervals = itertools.pairwise(times)
        pieces = [_Piece(*row, *ends) for row, ends in zip(self.rows, intervals, strict=True)]

        def key(piece: _Piece) -> tuple[AbstractChartSolver, bool]:
            return self.solver_of(piece, is_constant), piece.time > 0

        progress, outputs = (y0, solver_state, diffrax.RESULTS.successful), []
        for (solver, _), group in itertools.groupby(pieces, key):
            terms_of = functools.partial(_terms_along, terms, control)
            progress, new_outputs = substeps(solver, terms_of, list(group), t0, t1, args, progress)
            outputs += new_outputs
        y1, state, _ = progress
        return y1, None, dict(path=Substeps(outputs)), state, result_of(y1)


class WeakOrder2(AbstractPieces):
    """Weak order 2 for any noise and any number of channels; strong order 1/2, 1 if it commutes.

    Two steps of `solver` with half of the drift each, and with the noise `W/2 ± sqrt(6) H`. By
    default that costs 8 evaluations and 10 flows a step. Each Brownian motion must offer its
    space-time Lévy area: `diffrax.UnsafeBrownianPath(..., levy_area=diffrax.SpaceTimeLevyArea)`.

    **Arguments:** `solver`, a commutator-free, low-storage, Crouch-Grossman or Munthe-Kaas method
    of order 4 or more. Order 3 is enough where the noise's fields do not depend on the state.

    **Raises** `TypeError` for another solver, for terms without noise or a path without the area,
    and for a solver of order 3 if the noise's fields depend on the state; `ValueError` for an order
    below 3.

    Source: Ninomiya & Ninomiya, Finance Stoch. 13 (2009), doi:10.1007/s00780-009-0101-4, with
    u = 3/4 and the second Gaussian `sqrt(12) H`.
    """

    solver: AbstractChartSolver = CF4()
    rows: ClassVar = ((1 / 2, 1 / 2, sqrt(6)), (1 / 2, 1 / 2, -sqrt(6)))

    def __check_init__(self):
        _check_order("solver", self.solver, 3)

    def check_for_state(self):
        _check_order_for_state("WeakOrder2", "solver", self.solver)


class ShiftedNoise(AbstractPieces):
    """Strong order 3/2 where the noise commutes, and 1/2 otherwise; weak order 1.

    A step of `noise_solver` along `(sqrt(3) + 1) H`, one of `solver` along the drift and
    `W - 2 sqrt(3) H`, and one of `noise_solver` along `(sqrt(3) - 1) H`. The first and the last
    take no time and do not evaluate the drift. Each Brownian motion must offer its space-time Lévy
    area, as for `cfjax.WeakOrder2`.

    **Arguments:** `solver` as for `cfjax.WeakOrder2`: `CF3` with additive noise costs 3
    evaluations of the drift and 5 flows. `noise_solver`, by default `solver`, or `LieEuler` where
    the noise's fields do not depend on the state, along which that is exact.

    **Raises** as `cfjax.WeakOrder2`, of both solvers.

    Source: replacing the Brownian path by a piecewise linear one that has its W and H and the mean
    of its further integrals is the approach of Foster, dos Reis & Strange, High order splitting
    methods for SDEs satisfying a commutativity condition, arXiv:2210.17543. These shifts, which are
    linear in H, were derived for this package.
    """

    solver: AbstractChartSolver = CF4()
    noise_solver: AbstractChartSolver | None = None
    rows: ClassVar = ((0.0, 0.0, sqrt(3) + 1), (1.0, 1.0, -2 * sqrt(3)), (0.0, 0.0, sqrt(3) - 1))

    def __check_init__(self):
        _check_order("solver", self.solver, 3)
        if self.noise_solver is not None:
            _check_solver("noise_solver", self.noise_solver)

    def check_for_state(self):
        _check_order_for_state("ShiftedNoise", "solver", self.solver)
        if self.noise_solver is not None:
            _check_order_for_state("ShiftedNoise", "noise_solver", self.noise_solver)

    def solver_of(self, piece, is_constant):
        if piece.time:
            return self.solver
        return self.noise_solver or (LieEuler() if is_constant else self.solver)


class _PieceTerm(diffrax.AbstractTerm):
    """A term with the control of a piece."""

    term: diffrax.AbstractTerm
    control: PyTree

    def vf(self, t, y, args):
        return self.term.vf(t, y, args)

    def contr(self, t0, t1, **kwargs):
        return self.control

    def prod(self, vf, control):
        return self.term.prod(vf, control)


def _terms_along(terms: Any, control: PyTree, piece: _Piece) -> diffrax.AbstractTerm:
    """The terms along a piece. One without time has those of the noise alone."""
    piece_terms = [
        _PieceTerm(term, _control_along(value, piece))
        for term, value in _terms_with_controls(terms, control)
        if _is_noise(value) or not (isinstance(piece.time, float) and piece.time == 0)
    ]
    return piece_terms[0] if len(piece_terms) == 1 else diffrax.MultiTerm(*piece_terms)


def _terms_with_controls(terms: Any, control: Any) -> list[tuple[diffrax.AbstractTerm, PyTree]]:
    """The terms of a sum, with their controls."""
    if not isinstance(terms, diffrax.MultiTerm):
        return [(terms, control)]
    pairs = zip(terms.terms, control, strict=True)
    return [pair for term, value in pairs for pair in _terms_with_controls(term, value)]


def _is_noise(control: PyTree) -> bool:
    return isinstance(control, diffrax.AbstractSpaceTimeLevyArea)


def _control_along(control: Any, piece: _Piece) -> PyTree:
    def increment(h: Any, w: Any, area: Any) -> Any:
        b, c = (jnp.asarray(x, w.dtype) for x in (piece.increment, piece.area))
        # A path that is followed backwards has the same area, and diffrax turns its sign.
        return b * w + c * jnp.sign(h).astype(w.dtype) * area

    if not _is_noise(control):
        return jnp.asarray(piece.time, jnp.result_type(control)) * control
    return jtu.tree_map(increment, control.dt, control.W, control.H)


def _is_constant(terms: Any, t0: Any, t1: Any, y0: PyTree, args: PyTree) -> bool:
    """Whether the noise's fields do not depend on the state."""
    noise_piece = _Piece(0.0, 1.0, 0.0)

    def field(y: PyTree) -> PyTree:
        noise = _terms_along(terms, terms.contr(t0, t1, use_levy=True), noise_piece)
        return product(noise, noise.vf(t0, y, args), noise.contr(t0, t1))

    return not state_dependent(field, y0)


def _check_paths(name: str, terms: PyTree) -> None:
    if not is_driven(terms):
        raise TypeError(
            f"{name} is for equations with noise, and no term has a Brownian motion: use another "
            "method, for example cfjax.CF4()."
        )
    for path in paths(terms):
        area: Any = getattr(path, "levy_area", None)
        is_brownian = isinstance(path, diffrax.AbstractBrownianPath)
        if not is_brownian or not issubclass(area, diffrax.AbstractSpaceTimeLevyArea):
            got = f"levy_area={area.__name__}" if is_brownian else type(path).__name__
            raise TypeError(
                f"{name} needs a Brownian motion with its space-time Lévy area, got {got}: write "
                "diffrax.UnsafeBrownianPath(..., levy_area=diffrax.SpaceTimeLevyArea), or the same "
                "for a diffrax.VirtualBrownianTree."
            )


def _check_solver(name: str, solver: Any) -> None:
    # For diffrax a wrapped solver is an instance of what it wraps.
    is_supported = issubclass(type(solver), diffrax.AbstractStratonovichSolver | LieEuler)
    if not issubclass(type(solver), AbstractChartSolver) or not is_supported:
        raise TypeError(
            f"{name} must be a commutator-free or Munthe-Kaas method, such as cfjax.CF4(), got "
            f"{solver!r}."
        )


def _check_order(name: str, solver: Any, min_order: int) -> None:
    if isinstance(solver, AbstractChartSolver) and (order := solver.order(None) or 0) < min_order:
        raise ValueError(
            f"{name} must have order {min_order} or more, got {solver!r} of order {order}."
        )


def _check_order_for_state(method: str, name: str, solver: AbstractChartSolver) -> None:
    if (order := solver.order(None) or 0) < 4:
        raise TypeError(
            f"{method} needs a {name} of order 4 where the noise's fields depend on the state, got "
            f"{type(solver).__name__}() of order {order}: use cfjax.CF4()."
        )
