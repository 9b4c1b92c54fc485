"""What all Lie group methods are to diffrax: one-step maps made of flows."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Inexact, PyTree, Real

from .._components import by_components, is_inside, is_short, is_small
from .._dense import Interpolation, Path
from .._failure import result_of
from .._frozen_field import Displaced, flow, is_displaced, value
from .._functions.held import held
from .._functions.pack import pack, unpack


class AbstractLieSolver(diffrax.AbstractSolver):
    """A method with fixed coefficients that moves along flows.

    It takes the geometry from what the term's vector field returns: `cfjax.LieTerm` for frozen
    fields, any other diffrax term for a linear space.

    Rounding the state after every flow makes lengths, orthogonality and the like drift as a random
    walk. Where the field offers displacements, these are summed first, so the state is rounded once
    a step, and matrices are summed with compensation: the state of the solver is what the last sum
    lost. (Hairer, Lubich & Wanner, Geometric Numerical Integration, Section VIII.5.) Vectors are
    not: their loops are so small that it would cost a fifth of the time.
    """

    term_structure: ClassVar = diffrax.AbstractTerm

    interpolation_cls: ClassVar[Callable[..., diffrax.AbstractLocalInterpolation]] = Interpolation

    @property
    def first_same_as_last(self) -> bool:
        """Whether the last evaluation of a step is the first one of the next step."""
        return False

    @abc.abstractmethod
    def move(self, field: Callable[[Any, PyTree], PyTree], y0: PyTree) -> "Move":
        """A step from `y0`; `field(c, y)` is `h f(t + c h, y)`, a frozen field."""

    def init(self, terms, t0, t1, y0, args) -> PyTree:
        """What the compensated sums have lost; and the field at `y0`, where a step reuses it."""
        lost = self._no_loss(terms, t0, t1, y0, args)
        return (lost, terms.vf(t0, y0, args)) if self.first_same_as_last else lost

    def without_estimate(self) -> "AbstractLieSolver":
        """The same method for steps that nobody controls: it keeps nothing for an estimate."""
        return self

    def _no_loss(self, terms, t0, t1, y0, args) -> PyTree:
        """A `_Sum` for the parts of the state that are one, and None for the others."""
        if not any(jnp.ndim(y) >= 2 or is_short(y) for y in jtu.tree_leaves(y0)):
            return jtu.tree_map(lambda y: None, y0)

        def first_flow(y0):
            field = terms.prod(terms.vf(t0, y0, args), terms.contr(t0, t1))
            return flow(field, jtu.tree_map(_at_rest, y0))

        def no_loss(end, y):
            # Where the field offers no displacement, its flow ends in a plain point.
            if not is_displaced(end) or not (jnp.ndim(y) >= 2 or is_short(y)):
                return None
            return _Sum(jnp.zeros_like(y) if jnp.ndim(y) >= 2 else None)

        end = eqx.filter_eval_shape(first_flow, y0)
        return jtu.tree_map(no_loss, end, y0, is_leaf=is_displaced)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        lost, first = solver_state, None
        if self.first_same_as_last and solver_state is not None:
            lost, first = solver_state
        if first is not None and made_jump is not False:
            first = _select(made_jump, lambda: terms.vf(t0, y0, args), first)

        # In a loop of diffrax each of the sums below would compute the step of a batch anew.
        in_batches = not is_inside()

        def move(y0):
            control = terms.contr(t0, t1)
            values = []

            def field(c: float | Real[Array, ""], y: PyTree) -> PyTree:
                if values or first is None:
                    # The end of the step exactly, not up to rounding: the field may jump there.
                    if isinstance(c, float):
                        t = t1 if c == 1 else t0 + c * (t1 - t0)
                    else:
                        c = jnp.asarray(c, jnp.result_type(t0))
                        t = jnp.where(c == 1, t1, t0 + c * (t1 - t0))
                    values.append(terms.vf(t, value(y), args))
                else:
                    values.append(first)
                return terms.prod(values[-1], control)

            start = jtu.tree_map(
                lambda lost, y: y if lost is None else _at_rest(y), lost, y0, is_leaf=_is_leaf
            )
            made = self.move(field, start)
            end = jtu.tree_map(
                lambda lost, end: _held_displacement(lost, end, in_batches),
                lost,
                made.end,
                is_leaf=_is_leaf,
            )
            # The end of a step and the field there are always wanted, the rest is not.
            return (end, None if first is None else values[-1]), (made.error, made.path)

        (end, last), (error, path) = by_components(move, y0, has_extra=True)
        sums = jtu.tree_map(
            lambda lost, p: (p, None) if lost is None else lost.up_to(p),
            lost,
            end,
            is_leaf=_is_leaf,
        )
        y1, new_lost = (
            jtu.tree_map(lambda _, pair: pair[k], lost, sums, is_leaf=_is_leaf)  # noqa: B023
            for k in range(2)
        )
        has_two = self.first_same_as_last and solver_state is not None
        solver_state = (new_lost, last) if has_two else new_lost
        return y1, error, dict(path=path), solver_state, result_of(y1)

    def func(self, terms, t0, y0, args) -> Any:
        return terms.vf(t0, y0, args)


class Move(eqx.Module):
    """A step: where it ends, the way there for output within it, and an estimate of its error."""

    end: PyTree
    path: Path
    error: PyTree = None


def _select(made_jump: Any, anew: Callable[[], PyTree], kept: PyTree) -> PyTree:
    if made_jump is True:
        return anew()
    return lax.cond(made_jump, anew, lambda: kept)


class _Sum(eqx.Module):
    """Says that a part of the state is a start and displacements, and keeps what its sum lost."""

    lost: Array | None

    def up_to(self, end: Displaced) -> tuple[Array, "_Sum"]:
        """The end with what the step before lost, and what this sum loses (Knuth's TwoSum)."""
        if self.lost is None:
            return end.value, self
        a, b = end.start, end.displacement + lax.stop_gradient(self.lost)
        total = a + b
        rounded = total - a
        return total, _Sum(lax.stop_gradient((a - (total - rounded)) + (b - rounded)))


def held_entries(point: Any) -> Any:
    """The same point; the entries of a short vector are computed once for all that uses them."""
    if is_displaced(point):
        return Displaced(point.start, held_entries(point.displacement))
    return pack(held(unpack(point))) if is_short(point) else point


def _held_displacement(lost: Any, end: Any, in_batches: bool) -> Any:
    """The end of a step. A compensated sum uses the displacement several times."""
    if isinstance(lost, _Sum) and is_small(lost.lost):
        return Displaced(end.start, held([end.displacement], in_batches=in_batches)[0])
    return end


def _is_leaf(x: Any) -> bool:
    return x is None or isinstance(x, _Sum)


def _at_rest(y: Inexact[Array, "..."]) -> Displaced:
    return Displaced(y, jnp.zeros_like(y))
