"""What all Lie group methods are to diffrax: one-step maps made of flows."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Inexact, PyTree

from .._components import by_components
from .._dense import NodeInterpolation
from .._frozen_field import Displaced, flow, is_displaced, value


class AbstractLieSolver(diffrax.AbstractSolver):
    """A method with fixed coefficients that moves along flows.

    It takes the geometry from what the term's vector field returns: `cfjax.LieTerm` for frozen
    fields, any other diffrax term for a linear space.

    Rounding the state after every step makes orthogonality and the like drift as a random walk.
    Matrices, where the field offers displacements, are summed with compensation instead: the state
    of the solver is what the last sum lost. (Hairer, Lubich & Wanner, Geometric Numerical
    Integration, Section VIII.5.) Vectors are not: their loops are too small to carry more.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., NodeInterpolation]] = NodeInterpolation

    @abc.abstractmethod
    def end_point(self, field: Callable[[float, PyTree], PyTree], y0: PyTree) -> PyTree:
        """The end of a step from `y0`; `field(c, y)` is `h f(t + c h, y)`, a frozen field."""

    def init(self, terms, t0, t1, y0, args) -> PyTree:
        """Zeros for the compensated parts of the state, and None for the others."""
        if all(jnp.ndim(leaf) < 2 for leaf in jtu.tree_leaves(y0)):
            return jtu.tree_map(lambda y: None, y0)

        def first_flow(y0):
            field = terms.prod(terms.vf(t0, y0, args), terms.contr(t0, t1))
            return flow(field, jtu.tree_map(_at_rest, y0))

        # Where the field offers no displacement, its flow ends in a plain point.
        end = eqx.filter_eval_shape(first_flow, y0)
        return jtu.tree_map(
            lambda p, y: jnp.zeros_like(y) if is_displaced(p) else None,
            end,
            y0,
            is_leaf=is_displaced,
        )

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del made_jump

        def end_point(y0):
            control = terms.contr(t0, t1)

            def field(c: float, y: PyTree) -> PyTree:
                # The end of the step exactly, not up to rounding: the field may jump there.
                t = t1 if c == 1 else t0 + c * (t1 - t0)
                return terms.prod(terms.vf(t, value(y), args), control)

            start = jtu.tree_map(
                lambda lost, y: y if lost is None else _at_rest(y),
                solver_state,
                y0,
                is_leaf=_is_none,
            )
            return self.end_point(field, start)

        end = by_components(end_point, y0)
        sums = jtu.tree_map(
            lambda lost, p: (p, None) if lost is None else _sum(p, lost),
            solver_state,
            end,
            is_leaf=_is_none,
        )
        y1, lost = (
            jtu.tree_map(lambda _, pair: pair[k], solver_state, sums, is_leaf=_is_none)  # noqa: B023
            for k in range(2)
        )
        return y1, None, dict(y0=y0, y1=y1), lost, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args) -> Any:
        return terms.vf(t0, y0, args)


def _is_none(x: Any) -> bool:
    return x is None


def _at_rest(y: Inexact[Array, "..."]) -> Displaced | Inexact[Array, "..."]:
    return Displaced(y, jnp.zeros_like(y)) if jnp.ndim(y) >= 2 else y


def _sum(end: Displaced, lost: Array) -> tuple[Array, Array]:
    """The end point with what the step before lost, and what this sum loses (Knuth's TwoSum)."""
    a, b = end.start, end.displacement + lax.stop_gradient(lost)
    total = a + b
    rounded = total - a
    return total, lax.stop_gradient((a - (total - rounded)) + (b - rounded))
