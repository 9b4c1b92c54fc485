"""Commutator-free methods: one step for every tableau."""

from typing import ClassVar, Literal

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Inexact, PyTree

from .._control_term import is_driven
from .._field import tangent
from .._methods import pairs as _pairs
from .._methods import tableau as _tableau
from .._methods.continuous_extension import continuous_extension
from .._methods.tableau import Product, Row, Tableau
from .._numerics.vectors import smooth
from .base import AbstractTableauSolver, check_choice, combine_nonzero, without_trailing_zeros
from .compiled import materialised_together
from .dense import Path
from .stages import Stages, rolled
from .step import AbstractChartSolver, Chart, Step


class AbstractCommutatorFree(AbstractTableauSolver, AbstractChartSolver):
    """Flows of linear combinations of frozen fields, and no commutator.

    A class whose tableau has an embedded method is a `diffrax.AbstractAdaptiveSolver`.
    `CommutatorFree` explains `estimate` and `unroll`.
    """

    tableau: eqx.AbstractVar[Tableau]
    estimate: Literal["group", "algebra"] | None = eqx.field(
        static=True, default="group", kw_only=True
    )
    unroll: bool | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        check_choice("estimate", self.estimate, "group", "algebra", None)
        check_choice("unroll", self.unroll, True, False, None)

    @property
    def first_same_as_last(self) -> bool:
        tableau = self.tableau
        if self.estimate is None or tableau.embedded is None:
            return False
        return any(map(tableau.uses_last, (tableau.embedded, *continuous_extension(tableau))))

    def step_in(self, chart):
        tableau = self.tableau
        beta, embedded = trimmed(tableau.beta), self._embedded
        chart, fields, points = self.stages(chart)
        end = points[beta]
        # All that follows is for error control and output within the step. The compiler leaves it
        # out where the caller asks for neither.
        extension, last = continuous_extension(tableau), None
        if any(map(tableau.uses_last, (embedded or (), *extension))):
            last = chart.value_at(1.0, end)
            fields = [*fields, chart.frozen(last, end, fields)]
        path = Path.of(extension, chart.origin, fields)
        if embedded is None:
            return Step(chart.end(end), path, last=last)
        if self.estimate == "algebra":
            difference = combine_nonzero(_difference(embedded, tableau.beta), fields)
            error = tangent(difference, chart.state(end))
        else:
            points = with_product(trimmed(embedded), Stages(chart, fields, points))
            error = chart.difference(end, points[trimmed(embedded)])
        if not tableau.uses_last(embedded):
            return Step(chart.end(end), path, error, last)
        last_stage = trimmed(tableau.alpha[-1])
        gap = chart.difference(
            end, with_product(last_stage, Stages(chart, fields, points))[last_stage]
        )
        # The ratio of their sizes needs all of their entries.
        end, error, gap = materialised_together((chart.end(end), error, gap))
        error = jtu.tree_map(_larger_estimate, error, gap, chart.sums.displacement(end))
        return Step(end, path, error, last, is_materialised=True)

    def stages(self, chart: Chart) -> Stages:
        """The fields of the stages, and the points at them and at the end."""
        tableau = self.tableau
        alpha, beta = [trimmed(rows) for rows in tableau.alpha], trimmed(tableau.beta)
        # Two stages at one point would be one flow with two times.
        if len(set(alpha)) == len(alpha):
            stages = rolled(self.unroll, chart, [*alpha, beta], tableau.c)
            if stages is not None:
                return stages
        prefixes = {rows[:n] for rows in (*alpha, beta) for n in range(1, len(rows))}
        fields, points = [chart.first_field], {(): chart.start}
        for c, rows in list(zip(tableau.c, alpha, strict=True))[1:]:
            points = with_product(rows, Stages(chart, fields, points))
            if rows in prefixes:
                points = {**points, rows: chart.branching(points[rows])}
            fields = [*fields, chart.field(float(c), points[rows], fields)]
        return Stages(chart, fields, with_product(beta, Stages(chart, fields, points)))

    @property
    def _embedded(self) -> Product | None:
        return None if self.estimate is None else self.tableau.embedded


def with_product(rows: Product, stages: Stages) -> dict[Product, PyTree]:
    """The points of the stages, and the point to which a product of flows leads.

    Rows that begin alike share their flows. (The paper's "reusing flow calculations".)
    """
    chart, fields, points = stages
    if rows in points:
        return points
    if not rows:
        return {**points, rows: chart.start}
    points = with_product(rows[:-1], stages)
    return {**points, rows: chart.flow(combine_nonzero(rows[-1], fields), points[rows[:-1]])}


def trimmed(rows: Product) -> Product:
    """The rows without zeros at their ends, so that equal flows have equal rows."""
    return tuple(map(without_trailing_zeros, rows))


def _difference(a: Product, b: Product) -> Row:
    """The sum of all rows of a less that of b, which may have fewer entries."""
    negated = [[-entry for entry in row] + [0] * (len(a[0]) - len(row)) for row in b]
    return tuple(sum(column) for column in zip(*a, *negated, strict=True))


# Where its comparison is decided by rounding, both branches are equally good.
@smooth
def _larger_estimate(
    error: Inexact[Array, "..."], gap: Inexact[Array, "..."], displacement: Inexact[Array, "..."]
) -> Inexact[Array, "..."]:
    """The estimate, or `gap` times |gap| / (|displacement| + |gap|) where that is larger.

    An embedded method that compares the fields at the end and at the last stage sees only how the
    field changes with the state. The gap between these points shows how it changes with time too.
    It is of order 3 in the step, so with this factor of order 5, and makes no estimate of order 4
    worse.
    """
    error_square, gap_square, displacement_square = (
        lax.stop_gradient(jnp.sum(jnp.square(jnp.abs(x)))) for x in (error, gap, displacement)
    )
    total = jnp.sqrt(gap_square) + jnp.sqrt(displacement_square)
    factor = jnp.sqrt(gap_square) / jnp.where(total > 0, total, 1)
    gap_estimate = gap * factor.astype(gap.dtype)
    return jnp.where(factor * factor * gap_square > error_square, gap_estimate, error)


class CommutatorFree(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """The commutator-free method of a `cfjax.Tableau`.

    One step costs `tableau.num_evaluations` evaluations of the field and `tableau.num_flows` flows.
    Its order is `cfjax.order(tableau)`. If the tableau has an embedded method, there is an error
    estimate, which costs `tableau.num_embedded_flows` more. Dense output uses the tableau's
    continuous extension, or one derived from the order conditions, of order one below the method's
    but at most 4: for this a step evaluates the field at its end if the stages do not suffice.

    It is a `diffrax.AbstractAdaptiveSolver` for every tableau, as its class does not depend on the
    tableau. diffrax checks for the estimate itself, and refuses adaptive steps without one.

    **Arguments:**

    - `tableau`: a `cfjax.Tableau`.
    - `estimate`: the estimate of the error, if the tableau has an embedded method. `"group"`, the
      default, is the difference between the end points of the method and of the embedded method.
      `"algebra"` saves the flows of the embedded method: it adds up the fields of all flows of each
      method, and is the velocity of the difference of both sums at the end of the step. For fields
      that do not depend on the state and are linear in time, both sums are the same except in `CF2`
      and `CF4`, and this estimate misses the error that commutators cause. None leaves out the
      estimate, which constant steps do not need: small systems are faster without it on CPU.
      `cfjax.integrate` leaves it out.
    - `unroll`: how the stages of a step are compiled, like `scan_kind` in diffrax. True writes them
      one after the other into the program. False rolls them into one loop if the fields allow it,
      which makes the program shorter and quicker to compile. None, the default, chooses by the size
      of the state and the number of stages, for the fastest program.

    **Raises** `TypeError` if `tableau` is not a `cfjax.Tableau`; `ValueError` for another
    `estimate` or `unroll`.
    """

    tableau: Tableau = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.tableau, Tableau):
            raise TypeError(f"tableau must be a cfjax.Tableau, got {self.tableau!r}.")

    def for_terms(self, terms):
        if is_driven(terms) and self.order(terms) < 2:
            raise TypeError(
                "CommutatorFree takes noise in the sense of Stratonovich, for which its tableau "
                "must have order 2 or more. Use cfjax.LieEuler for order 1, in the sense of Itô."
            )
        return super().for_terms(terms)


class LieEuler(AbstractCommutatorFree, diffrax.AbstractItoSolver):
    """The exponential Euler step. Order 1, 1 evaluation, 1 flow. Dense output of order 1.

    It evaluates the field at the start of the step, so with noise it solves the Itô equation in the
    coordinates of the frame. In a linear space that is Itô's equation.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.
    """

    tableau: ClassVar[Tableau] = _tableau.LIE_EULER


class CF2(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """The midpoint rule. Order 2, 2 evaluations, 2 flows. Dense output of order 2.

    The estimate compares with a step of `LieEuler` and costs 1 flow more.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.
    """

    tableau: ClassVar[Tableau] = _tableau.CF2


class CF3(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """Celledoni, Marthinsen & Owren's method of order 3: 3 evaluations, 3 flows.

    The estimate, with an embedded method of order 2, costs 1 flow more. Dense output of order 2.
    `cfjax.third_order_a` and `cfjax.third_order_b` give the families it belongs to.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Commutator-free Lie group methods, FGCS 19 (2003), equation (6),
    doi:10.1016/S0167-739X(02)00161-9.
    """

    tableau: ClassVar[Tableau] = _tableau.CF3


class CF4(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """Celledoni, Marthinsen & Owren's method of order 4: 4 evaluations, 5 flows.

    In a linear space this is the classical Runge-Kutta method. It is the choice for most fields
    except attitudes and poses (see `RKMK8`) and fields that do not depend on y (see `Magnus6`).

    The estimate costs 1 flow more. Its embedded method of order 3 is first same as last. It sees
    how the field changes with the state, but not how the field changes with time. So a small
    estimate is replaced by the distance of the last stage from the end, times the ratio of this
    distance to the distance from the start. Dense output of order 3.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Commutator-free Lie group methods, FGCS 19 (2003), equation (7),
    doi:10.1016/S0167-739X(02)00161-9.
    """

    tableau: ClassVar[Tableau] = _tableau.CF4


class CF43(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """Order 4 with an embedded method of order 3: 6 evaluations, 6 flows, 1 more for the estimate.

    Its error constant is 15 times smaller than that of `CF4`, and it is stable for undamped
    oscillations up to 3.85 and decay up to 5.84 (`CF4`: 2.83, 2.79). Dense output of order 3.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: derived for this package from the order conditions; see `cfjax.order`.
    """

    tableau: ClassVar[Tableau] = _pairs.CF43
    orders: ClassVar = (4, 3)


class CF54(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """Order 5 with an embedded method of order 4: 7 evaluations, 9 flows, 2 more for the estimate.

    It is stable for undamped oscillations only up to 0.86 (decay: 3.95), so use `CF43` for
    oscillations in large steps. Dense output of order 4, which uses the field at the end of the
    step.

    Do not use it for strong dissipation: one flow goes backwards in time by 0.24 of the step, so
    for `Affine` a step overflows once its length times the largest eigenvalue of M exceeds 3000
    (370 in float32). Error control rejects such a step, more often at loose tolerances than at
    tight ones. For strong dissipation use `CF4` or `CF43`, whose flows go forwards: no
    commutator-free method of an order above 4 has positive weights.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: derived for this package from the order conditions; see `cfjax.order`. Weights:
    Hofstätter & Koch, Numer. Math. 141 (2019), arXiv:1709.08473.
    """

    tableau: ClassVar[Tableau] = _pairs.CF54
    orders: ClassVar = (5, 4)


class CG3(
    AbstractCommutatorFree, diffrax.AbstractAdaptiveSolver, diffrax.AbstractStratonovichSolver
):
    """Crouch & Grossman's method of order 3: 3 evaluations, 6 flows of single fields.

    The estimate, with an embedded method of order 2, costs 3 flows more. Dense output of order 2.
    Some flows go backwards in time, so do not use it for strong dissipation: see `CF54`.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Crouch & Grossman, J. Nonlinear Sci. 3 (1993), doi:10.1007/BF02429858; coefficients of
    Owren & Marthinsen, BIT 39 (1999), doi:10.1023/A:1022325426017.
    """

    tableau: ClassVar[Tableau] = _tableau.CG3


class CG4(AbstractCommutatorFree, diffrax.AbstractStratonovichSolver):
    """A Crouch-Grossman method of order 4: 5 evaluations, 15 flows of single fields.

    Dense output of order 3.
    Some flows go backwards in time, so do not use it for strong dissipation: see `CF54`.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Jackiewicz, Marthinsen & Owren, Adv. Comput. Math. 13 (2000),
    doi:10.1023/A:1016645730465.
    """

    tableau: ClassVar[Tableau] = _tableau.CG4
    orders: ClassVar = (4, None)


class CG5(AbstractCommutatorFree, diffrax.AbstractStratonovichSolver):
    """A Crouch-Grossman method of order 5: 9 evaluations, 43 flows of single fields.

    Dense output of order 4, which uses the field at the end of the step. Two evaluations are before
    the start of the step, so do not use it for fields that jump.
    Some flows go backwards in time, so do not use it for strong dissipation: see `CF54`.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Jackiewicz, Marthinsen & Owren, Adv. Comput. Math. 13 (2000),
    doi:10.1023/A:1016645730465.
    """

    tableau: ClassVar[Tableau] = _tableau.CG5
    orders: ClassVar = (5, None)
