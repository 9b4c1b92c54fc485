"""Commutator-free Magnus methods: high order for fields that depend on t but not on y."""

from typing import Any, ClassVar, Literal

import diffrax
import equinox as eqx
import numpy as np
from jaxtyping import PyTree

from .._field import is_field
from .._methods import magnus as _magnus
from .._methods.magnus import MagnusTableau
from .._methods.tableau import Product
from .._numerics.checks import Fault
from .._term import product
from .base import State, check_choice, combine_nonzero
from .dense import Path
from .dependence import state_dependent, unknown_dependence
from .stacked import can_roll, rolled_flows
from .step import AbstractChartSolver, Chart, Step


class AbstractOfTime(AbstractChartSolver):
    """A method for fields that depend on t but not on y."""

    is_of_state: ClassVar[bool] = False

    # It takes fields at several times of a step, for which a path has one increment.
    takes_noise: ClassVar[bool] = False

    def start(self, terms, t0, t1, y0, args) -> tuple[State, Fault]:
        self.for_terms(terms)

        def field(y):
            return product(terms, terms.vf(t0, y, args), terms.contr(t0, t1))

        if dependent := state_dependent(field, y0):
            raise TypeError(_depends_on_state(type(self).__name__, *dependent[0]))
        return super().start(terms, t0, t1, y0, args)


class AbstractMagnus(AbstractOfTime):
    """Flows of linear combinations of the fields at some times within the step.

    For `y' = A(t) y`, and any other field whose coordinates depend on t but not on y.

    `Magnus6` explains `estimate` and `unroll`.

    If the nodes include both ends of the step, the last evaluation of a step is the first one of
    the next.

    **Raises** `TypeError` when the program is traced if the field depends on the state, including a
    field that is frozen at the state, such as `cfjax.LowRankSkew`, and a field that gives the state
    to a function of the host; `ValueError` for another `estimate` or `unroll`.
    """

    tableau: eqx.AbstractVar[MagnusTableau]
    estimate: Literal["group"] | None = eqx.field(static=True, default="group", kw_only=True)
    unroll: bool | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_choice("estimate", self.estimate, "group", None)
        check_choice("unroll", self.unroll, True, False, None)

    @property
    def is_symmetric(self) -> bool:
        return self.tableau.is_symmetric

    @property
    def first_same_as_last(self) -> bool:
        return self.tableau.shares_ends

    def order(self, terms) -> int:
        return self.tableau.order

    def error_order(self, terms) -> int | None:
        order = self.tableau.embedded_order
        return None if order is None else order + 1

    @property
    def first_time(self) -> float:
        return self.tableau.nodes[0]

    def step_in(self, chart):
        tableau, start = self.tableau, chart.start
        # The fields do not depend on the point.
        values = [chart.first_value, *(chart.value_at(c, start) for c in tableau.nodes[1:])]
        fields = [chart.first_field]
        for value in values[1:]:
            fields = [*fields, chart.frozen(value, start, fields)]
        embedded = None if self.estimate is None else tableau.embedded
        num_shared = 0 if embedded is None else _num_shared(tableau.rows, embedded)
        middle = self._flows(tableau.rows[:num_shared], chart, fields, start)
        end = self._flows(tableau.rows[num_shared:], chart, fields, middle)
        error = None
        if embedded is not None:
            error = chart.difference(end, self._flows(embedded[num_shared:], chart, fields, middle))
        path = Path.of(tableau.continuous_extension, chart.origin, fields)
        return Step(chart.end(end), path, error, values[-1])

    def _flows(self, rows: Product, chart: Chart, fields: list[PyTree], point: PyTree) -> PyTree:
        if len(rows) > 1 and can_roll(self.unroll, fields[0], point):
            return rolled_flows(np.array(rows, float), fields, point, chart.flow)
        for row in rows:
            point = chart.flow(combine_nonzero(row, fields), point)
        return point


def _num_shared(a: Product, b: Product) -> int:
    """The number of rows with which both begin."""
    return next(n for n, (x, y) in enumerate(zip(a, b, strict=False)) if x != y)


def _depends_on_state(solver: str, place: str, part: Any) -> str:
    if part is None:
        return (
            f"{unknown_dependence('y')}, and {solver} takes fields that depend on t but not on y: "
            "call it with t only, or use another method, for example cfjax.CF4()."
        )
    name = type(part).__name__ if is_field(part) else "a translation"
    advice = "" if is_field(part) else " Return y' = A(t) y as cfjax.LeftMatrix(A(t))."
    return (
        f"{solver} takes fields that depend on t but not on y, and for y{place} the field, {name}, "
        f"depends on the state.{advice} Use a method for such fields, for example cfjax.CF4()."
    )


class Magnus2(AbstractMagnus):
    """Order 2, for fields that do not depend on y: 1 evaluation, 1 flow.

    This is the exponential midpoint rule. Dense output of order 1. It has no estimate, but
    `cfjax.Richardson(cfjax.Magnus2())` has one.

    `estimate` and `unroll` are those of `cfjax.Magnus6`.
    """

    tableau: ClassVar[MagnusTableau] = _magnus.MAGNUS2


class Magnus4(AbstractMagnus, diffrax.AbstractAdaptiveSolver):
    """Order 4, for fields that do not depend on y: 3 evaluations, 3 flows.

    All flows go forwards in time. So this is the method for fields with strong dissipation: beyond
    order 4 some flow of every method goes backwards. The estimate, with an embedded method of order
    2, costs 1 flow more and leads to small steps: `cfjax.Richardson(cfjax.Magnus4())` takes fewer
    steps. Dense output of order 3.

    `estimate` and `unroll` are those of `cfjax.Magnus6`.

    Source: Alvermann & Fehske, High-order commutator-free exponential time-propagation of driven
    quantum systems, J. Comput. Phys. 230 (2011), doi:10.1016/j.jcp.2011.04.006. The embedded method
    was derived for this package.
    """

    tableau: ClassVar[MagnusTableau] = _magnus.MAGNUS4


class Magnus4Lobatto(AbstractMagnus, diffrax.AbstractAdaptiveSolver):
    """Order 4, for fields that do not depend on y: 2 evaluations, 2 flows.

    On such fields it gives the same result as `CF4` up to rounding, which takes 4 evaluations and 5
    flows. The estimate, with the midpoint rule, costs 1 flow more. Dense output of order 3.
    `Magnus4` has an error constant 50 times smaller for one evaluation and one flow more.

    `estimate` and `unroll` are those of `cfjax.Magnus6`.
    """

    tableau: ClassVar[MagnusTableau] = _magnus.MAGNUS4_LOBATTO


class Magnus6(AbstractMagnus, diffrax.AbstractAdaptiveSolver):
    """Order 6, for fields that do not depend on y: 4 evaluations, 5 flows and 2 for the estimate.

    The embedded method has order 4. Dense output of order 5. One flow goes backwards in time, by
    0.09 of the step, so do not use it for strong dissipation: see `CF54`.

    **Arguments:**

    - `estimate`: `"group"`, the default, estimates the error as the difference between the end
      points of the method and of the embedded method. None leaves out the estimate, which constant
      steps do not need. `cfjax.integrate` leaves it out.
    - `unroll`: how the flows of a step are compiled. True writes them one after the other into the
      program. False rolls them into a loop, which makes the program shorter and quicker to compile.
      None, the default, chooses by the size of the state, for the fastest program.

    **Raises** `TypeError` when the program is traced if the field depends on the state, including a
    field that is frozen at the state, such as `cfjax.LowRankSkew`, and a field that gives the state
    to a function of the host; `ValueError` for another `estimate` or `unroll`.

    Source: derived for this package from the order conditions.
    """

    tableau: ClassVar[MagnusTableau] = _magnus.MAGNUS6


class Magnus8(AbstractMagnus, diffrax.AbstractAdaptiveSolver):
    """Order 8, for fields that do not depend on y: 6 evaluations, 8 flows and 5 for the estimate.

    The embedded method is `Magnus6` on these nodes. Dense output of order 7. Two flows go backwards
    in time, each by 0.44 of the step, so do not use it for strong dissipation: see `CF54`.

    `estimate` and `unroll` are those of `cfjax.Magnus6`.

    Source: Hofstätter, arXiv:1902.11256. The nodes, seven of Lobatto's, and the estimate were
    chosen for this package.
    """

    tableau: ClassVar[MagnusTableau] = _magnus.MAGNUS8


class Magnus10(AbstractMagnus, diffrax.AbstractAdaptiveSolver):
    """Order 10, for fields that do not depend on y: 8 evaluations, 16 flows and 5 for the estimate.

    The embedded method is `Magnus6` on these nodes. Dense output of order 9. Some flows go
    backwards in time, by up to 0.31 of the step, so do not use it for strong dissipation: see
    `CF54`.

    Output within a step has a rounding error of some 1e-12, a hundred times that of the end of the
    step.

    `estimate` and `unroll` are those of `cfjax.Magnus6`.

    Source: `CF10` of Hofstätter's TimeDependentLinearODESystems.jl. The nodes, nine of Lobatto's,
    and the estimate were chosen for this package.
    """

    tableau: ClassVar[MagnusTableau] = _magnus.MAGNUS10
