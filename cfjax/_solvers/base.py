"""What all Lie group methods are to diffrax: one-step maps made of flows."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
from jaxtyping import PyTree

from .._components import by_components
from .._dense import NodeInterpolation


class AbstractLieSolver(diffrax.AbstractSolver):
    """A method with fixed coefficients that needs no memory from step to step.

    It takes the geometry from what the term's vector field returns: `cfjax.LieTerm` for frozen
    fields, any other diffrax term for a linear space.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., NodeInterpolation]] = NodeInterpolation

    @abc.abstractmethod
    def end_point(self, field: Callable[[float, PyTree], PyTree], y0: PyTree) -> PyTree:
        """The end of a step from `y0`; `field(c, y)` is `h f(t + c h, y)`, a frozen field."""

    def init(self, terms, t0, t1, y0, args) -> None:
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del solver_state, made_jump

        def end_point(y0):
            control = terms.contr(t0, t1)

            def field(c: float, y: PyTree) -> PyTree:
                # The end of the step exactly, not up to rounding: the field may jump there.
                t = t1 if c == 1 else t0 + c * (t1 - t0)
                return terms.prod(terms.vf(t, y, args), control)

            return self.end_point(field, y0)

        y1 = by_components(end_point, y0)
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args) -> Any:
        return terms.vf(t0, y0, args)
