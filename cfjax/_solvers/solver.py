"""The methods of a solver that `cfjax.integrate` uses beyond those of diffrax."""

from typing import Any

import diffrax
from jaxtyping import Array, PyTree, Real

from .._numerics.checks import Fault


class AbstractSolver(diffrax.AbstractSolver):
    """A diffrax solver with the methods that `cfjax.integrate` uses beyond those of diffrax.

    All solvers of this package derive from it. A solver of your own may do so too, in place of
    `diffrax.AbstractSolver`, and override any of these methods. Their defaults hold for every other
    diffrax solver.
    """

    @property
    def is_symmetric(self) -> bool:
        """Whether a step backwards in time undoes one forwards, but for rounding.

        For `cfjax.integrate(..., step_back=True)` and `cfjax.Composition`.
        """
        return False

    @property
    def shows_failure(self) -> bool:
        """Whether a step that fails ends in what is not finite, so that its result says no more.

        The loop of equal steps then need not look at the result of each.
        """
        return False

    def start(
        self, terms: PyTree, t0: Any, t1: Any, y0: PyTree, args: PyTree
    ) -> tuple[PyTree, Fault]:
        """As `init`, but returns what is wrong with the start, where `init` raises an error."""
        return self.init(terms, t0, t1, y0, args), Fault.none()

    def for_equal_steps(
        self, terms: PyTree, length: Real[Array, ""], t0: Any, y0: PyTree, args: PyTree
    ) -> Any:
        """The same method for steps of this length only, with what all of them share computed."""
        del terms, length, t0, y0, args
        return self

    def ended(self, solver_state: PyTree, fault: Fault) -> Fault:
        """The fault, with what the state of the solver says was wrong in equal steps."""
        del solver_state
        return fault

    def without_estimate(self) -> Any:
        """The same method for steps without error control: it computes nothing for an estimate."""
        return self


class _DiffraxSolver(AbstractSolver, diffrax.AbstractWrappedSolver):
    """Another solver of diffrax, with the defaults."""

    solver: diffrax.AbstractSolver

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.solver.interpolation_cls

    def order(self, terms):
        return self.solver.order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        return self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


def as_own(solver: diffrax.AbstractSolver) -> AbstractSolver:
    """The solver, wrapped with the defaults of `AbstractSolver` if it is not one."""
    # Not `isinstance`: for diffrax a wrapped solver is an instance of what it wraps.
    return solver if issubclass(type(solver), AbstractSolver) else _DiffraxSolver(solver)  # pyright: ignore[reportReturnType]
