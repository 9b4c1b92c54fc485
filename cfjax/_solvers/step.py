"""A step: from `solver.step` of diffrax to the flows of frozen fields."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree, Real

from .._field import dexpinv, from_chart, has_dexpinv, is_field
from .._field import flow as carried
from .._term import product
from .base import (
    AbstractLieSolver,
    State,
    evaluation_times,
    finite_if_complex,
    result_of,
    time_at,
)
from .compiled import computed_again, computed_once, control_of, scalarised
from .dense import AbstractPath, Interpolation
from .sums import Sums

# A part of the step.
Time = float | Real[Array, ""]


class Step(eqx.Module):
    """A step: its end, its path for output within it, and an estimate of its error.

    The end is a point of the step, see `Sums`. `last` is the value of the field with which the next
    step begins, if the step has it. `is_materialised` says that the end and the estimate are
    materialised together.
    """

    end: PyTree
    path: AbstractPath
    error: PyTree = None
    last: PyTree = None
    is_materialised: bool = eqx.field(static=True, default=False)


class Chart(NamedTuple):
    """The coordinates of a step: where it starts, and how fields are evaluated at its points.

    A part of a point is in the coordinates that its field chooses
    (`AbstractFrozenField.to_chart`), or, if it is a compensated sum, the increment from the start
    (`Sums`). A method need not know which. The field `h f(t + c h, y)` of a step of length h is
    computed in two stages, as the next step may begin with the first: its *value*, which the term's
    `vf` returns, and the frozen field, `product` of the value.
    """

    value: Callable[[Time, PyTree], PyTree]
    product: Callable[[PyTree], PyTree]
    sums: Sums
    # The first evaluation, and its point.
    first_value: PyTree
    first_field: PyTree
    start: PyTree

    @classmethod
    def at_start(
        cls,
        value: Callable[[Time, PyTree], PyTree],
        product: Callable[[PyTree], PyTree],
        sums: Sums,
        first_value: PyTree,
    ) -> "Chart":
        """With the first field, from whose point all flows start. It may correct a drift."""
        first_field, start = cls.charted(sums, product(first_value), sums.start)
        return cls(value, product, sums, first_value, first_field, start)

    @classmethod
    def charted(
        cls, sums: Sums, field: PyTree, point: PyTree, earlier: Sequence[PyTree] = ()
    ) -> tuple[PyTree, PyTree]:
        """A field that is frozen at a point, after `earlier` ones, and the point, in the chart."""
        return sums.to_chart(field, point, earlier)

    def value_at(self, c: Time, point: PyTree) -> PyTree:
        """The value of the field at a point."""
        return self.value(c, from_chart(self.first_field, self.sums.state(point)))

    def frozen(self, value: PyTree, point: PyTree, earlier: Sequence[PyTree]) -> PyTree:
        """The field with this value at a point, after `earlier` ones, in the same coordinates."""
        return self.charted(self.sums, self.product(value), point, earlier)[0]

    def field(self, c: Time, point: PyTree, earlier: Sequence[PyTree]) -> PyTree:
        """The field at a point, `h f(t + c h, point)`, after `earlier` ones."""
        return self.frozen(self.value_at(c, point), point, earlier)

    def flow(self, field: PyTree, point: PyTree) -> PyTree:
        """Where a combination of fields of the step carries a point in unit time."""
        return self.sums.flow(field, point)

    def flow_of_step(self, field: PyTree) -> tuple[PyTree, Bool[Array, ""] | None]:
        """Where a step leads along one field: its end, and whether there is one, None if so."""
        return self.flow(field, self.start), None

    def rate(self, u: PyTree, field: PyTree, degree: int) -> PyTree:
        """How u changes where the point to which it leads from the start moves with a field.

        The degree is for a series of commutators.
        """
        return dexpinv(u, field, degree)

    def has_rate(self, u: PyTree) -> Bool[Array, ""] | None:
        """Whether `rate` at u has a value; None if nothing is known."""
        return has_dexpinv(u)

    # Within a step, from the state at its start, for `Path`.
    apply_flow = staticmethod(carried)

    def end(self, point: PyTree) -> PyTree:
        """The state at a point, or its increment from the start where it is a compensated sum."""
        return from_chart(self.first_field, point)

    def state(self, point: PyTree) -> PyTree:
        """The state at a point."""
        return self.sums.state(self.end(point))

    def difference(self, a: PyTree, b: PyTree) -> PyTree:
        """How far two points are apart in the ambient space."""
        return jtu.tree_map(jnp.subtract, self.end(a), self.end(b))

    @property
    def origin(self) -> PyTree:
        """The start in the coordinates of the fields, without sums: for output within the step."""
        return self.sums.state(self.start)

    def branching(self, point: PyTree) -> PyTree:
        """The same point, where the field is evaluated and from where flows go on.

        Otherwise XLA would compute flows that are arithmetic entry by entry anew for each of both,
        back to the start.
        """

        def part(f: Any, p: PyTree) -> PyTree:
            return computed_once(p) if is_field(f) and f.is_entrywise else p

        return jtu.tree_map(part, self.first_field, point, is_leaf=is_field)


class AbstractChartSolver(AbstractLieSolver):
    """A method whose step is one chart: flows of combinations of the fields in it."""

    @property
    def chart_type(self) -> type[Chart]:
        return Chart

    # Whether the fields depend on where in the state they are evaluated.
    is_of_state: ClassVar[bool] = True

    interpolation_cls: ClassVar[Any] = Interpolation

    @abc.abstractmethod
    def step_in(self, chart: Chart) -> Step:
        """A step from `chart.start`, where the field is `chart.first_field`."""

    @property
    def first_time(self) -> float:
        """The part of the step at which the field is evaluated first."""
        return 0.0

    def interval(self, t0: Any, t1: Any) -> tuple[Any, Any]:
        """Two times that are as far apart as the ends of the step."""
        return t0, t1

    def path_for_output(self, path: Any, field: Callable[[Any, PyTree], PyTree]) -> AbstractPath:
        """The path of a step with the further evaluations that output within it needs.

        `field(c, y)` is `h f(t + c h, y)`. This is separate from `step_in`, so that it is compiled
        only for output.
        """
        return path

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        # Not for concrete times.
        step = _step_once if isinstance(t0, Tracer) else AbstractChartSolver._step
        solver: Any = self.for_terms(terms)
        return step(solver, terms, t0, t1, y0, args, solver_state, made_jump)

    def _step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        compensation = solver_state.compensation

        def evaluate(t0: Any) -> PyTree:
            return terms.vf(evaluation_times(t0, t1)[0], y0, args)

        t0, first = begin_step(solver_state, t0, evaluate, made_jump)
        times = evaluation_times(t0, t1)

        def value(c: Time, y: PyTree) -> PyTree:
            return terms.vf(time_at(c, *times), y, args)

        def step_from(y0: PyTree) -> Step:
            control = control_of(terms, *self.interval(t0, t1))
            sums = Sums(y0, compensation)
            first_value = value(self.first_time, y0) if first is None else first
            frozen = lambda value: product(terms, value, control)  # noqa: E731
            step = self.step_in(self.chart_type.at_start(value, frozen, sums, first_value))
            end, error, last = step.end, step.error, None if first is None else step.last
            if not step.is_materialised:
                end, error = sums.materialised(end, error, is_followed=first is not None)
            if last is not None and self.is_of_state:
                # From the end alone, which costs one evaluation more.
                last = computed_again(last, lambda: value(1.0, sums.state(end)))
            return Step(end, step.path, error, last)

        y1, error, dense_info, state, result = finish_step(solver_state, step_from, y0)
        path = self.path_for_output(
            dense_info["path"], lambda c, y: product(terms, value(c, y), terms.contr(t0, t1))
        )
        return y1, error, dict(path=path), state, result


def begin_step(
    solver_state: State, t0: Any, evaluate: Callable[[Any], PyTree], made_jump: Any
) -> tuple[Any, PyTree]:
    """The time of a step, NaN if the start was wrong, and the value of the field there, or None."""
    first = solver_state.first
    if solver_state.zero is not None:
        # It has a weak type if the time has one.
        t0 = jnp.where(solver_state.zero == 0, t0, jnp.nan)
    if first is None or made_jump is False:
        return t0, first
    if made_jump is True:
        return t0, evaluate(t0)
    return t0, lax.cond(made_jump, evaluate, lambda _: first, t0)


def finish_step(
    solver_state: State, step_from: Callable[[PyTree], Step], y0: PyTree
) -> tuple[PyTree, PyTree, dict[str, Any], State, Any]:
    """The outputs of `solver.step` of diffrax: the state after the step, the estimate of its error,
    the path for dense output, the solver's state, and the result.
    """

    def outputs(y0: PyTree) -> tuple[PyTree, PyTree]:
        step = step_from(y0)
        return (step.end, step.last, step.error), step.path

    (end, last, error), path = scalarised(outputs, y0)
    y1, compensation = Sums(y0, solver_state.compensation).fast_two_sum(end)
    state = State(compensation, last, solver_state.zero, kept=solver_state.kept)
    return y1, finite_if_complex(error), dict(path=path), state, result_of(y1)


# diffrax traces a step three times, which takes longer than all else that it traces. Inline, the
# program is as if traced anew. Newer JAX has two ways for that, and with True it leaves a call in
# the program. (equinox hands on what it does not know to `jax.jit`.)
_inline_modes = getattr(jax, "Inline", None)
_inline: Any = True if _inline_modes is None else _inline_modes.JAX_EARLY
_step_once = eqx.filter_jit(AbstractChartSolver._step, inline=_inline)  # pyright: ignore[reportCallIssue]
