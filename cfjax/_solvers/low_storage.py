"""Low-storage methods: one point and one sum of fields, whatever the number of stages."""

from collections.abc import Callable
from fractions import Fraction
from operator import itemgetter
from typing import Any, ClassVar

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import PyTree

from .._field import combine
from .._methods.tableau import Product, Row, Tableau
from .commutator_free import AbstractCommutatorFree, trimmed
from .stacked import LARGE, MANY
from .stages import Stages, is_uniform
from .step import Chart


class AbstractLowStorage(AbstractCommutatorFree, diffrax.AbstractStratonovichSolver):
    """`d <- a[i] d + h f(t + c[i] h, Y)`, `Y <- exp(b[i] d) Y` for every stage i, with a[0] = 0.

    It keeps two copies of the state, the point and the sum of fields that moves it. Fields in
    coordinates of a step (`LowRankSkew`) and output within a step still need the memory of all
    stages.
    """

    a: ClassVar[Row]
    b: ClassVar[Row]

    def stages(self, chart):
        rows = trimmed(self.tableau.beta)
        embedded = None if self.estimate is None else self.tableau.embedded
        penultimate = embedded is not None and trimmed(embedded) == rows[:-1]
        # Every estimate uses all fields, except that of the point before the end.
        needs_all_fields = embedded is not None and not (penultimate and self.estimate == "group")
        if not (needs_all_fields or self._is_unrolled(chart.start)) and is_uniform(chart):
            return self._stages_in_loop(chart)
        fields: list[PyTree] = [chart.first_field]
        points: dict[Product, PyTree] = {(): chart.start}
        total, point = chart.first_field, chart.start
        for k, (a, b, c) in enumerate(zip(self.a, self.b, self.tableau.c, strict=True)):
            if k:
                points[rows[:k]] = point = chart.branching(point)
                fields = [*fields, chart.field(float(c), point, fields)]
                total = combine((float(a), 1.0), (total, fields[-1]))
            point = chart.flow(combine((float(b),), (total,)), point)
        points[rows] = point
        return Stages(chart, fields, points)

    def _stages_in_loop(self, chart: Chart) -> Stages:
        """With no more than the last two points."""

        def stage(carry, coefficients):
            a, b, c = coefficients
            total, point, _ = carry
            field = chart.field(c, point, [total])
            total = combine((a, 1.0), (total, field))
            return (total, chart.flow(combine((b,), (total,)), point), point), field

        first, start, rows = chart.first_field, chart.start, trimmed(self.tableau.beta)
        point = chart.flow(combine((float(self.b[0]),), (first,)), start)
        coefficients = tuple(
            jnp.asarray([float(x) for x in row[1:]]) for row in (self.a, self.b, self.tableau.c)
        )
        (_, end, penultimate), stacked = lax.scan(stage, (first, point, start), coefficients)
        # The compiler drops them where the caller asks for no output within the step.
        fields = [first]
        fields += [jtu.tree_map(itemgetter(i), stacked) for i in range(len(self.b) - 1)]
        return Stages(chart, fields, {(): start, rows[:-1]: penultimate, rows: end})

    def _is_unrolled(self, point: PyTree) -> bool:
        if self.unroll is not None:
            return self.unroll
        size = sum(jnp.size(leaf) for leaf in jtu.tree_leaves(point))
        # Unrolled stages cost compile time quadratically. And XLA keeps the fields of several of
        # them, to add them up at once.
        return len(self.b) <= MANY and size <= 2 * LARGE


def _tableau(a: Row, b: Row, embedded: Callable[[Product], Any] | None = None) -> Tableau:
    """The method in the usual form; `embedded` is a function of the end point's rows."""
    rows: list[Any] = []
    total: list[Any] = []
    for factor, weight in zip(a, b, strict=True):
        total = [*(Fraction(factor) * entry for entry in total), Fraction(1)]
        row = [Fraction(weight) * entry for entry in total]
        # Rounded once, where the coefficients are.
        rows.append(row if isinstance(b[0], Fraction) else list(map(float, row)))
    stages = [rows[:r] for r in range(len(rows))]
    return Tableau(stages, rows, None if embedded is None else embedded(tuple(rows)))


class Williamson3(AbstractLowStorage):
    """Order 3, 3 evaluations, 3 flows. Dense output of order 2.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Williamson, J. Comput. Phys. 35 (1980), doi:10.1016/0021-9991(80)90033-9; Bazavov,
    BIT 62 (2022), doi:10.1007/s10543-021-00892-x.
    """

    a: ClassVar[Row] = (Fraction(0), Fraction(-5, 9), Fraction(-153, 128))
    b: ClassVar[Row] = (Fraction(1, 3), Fraction(15, 16), Fraction(8, 15))
    tableau: ClassVar[Tableau] = _tableau(a, b)


class BWRRK33(AbstractLowStorage):
    """Order 3, 3 evaluations, 3 flows. Dense output of order 2.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Bazavov, BIT 62 (2022), doi:10.1007/s10543-021-00892-x.
    """

    a: ClassVar[Row] = (Fraction(0), -0.637694471842202, -1.306647717737108)
    b: ClassVar[Row] = (0.457379997569388, 0.925296410920922, 0.393813594675071)
    tableau: ClassVar[Tableau] = _tableau(a, b)


class BWRRK53(AbstractLowStorage, diffrax.AbstractAdaptiveSolver):
    """Order 3, 5 evaluations, 5 flows. The estimate, of order 2, comes at no extra cost.
    Dense output of order 3.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Bazavov, BIT 62 (2022), doi:10.1007/s10543-021-00892-x.
    """

    a: ClassVar[Row] = (
        Fraction(0),
        Fraction(-5, 8),
        Fraction(-4, 3),
        Fraction(-3, 4),
        Fraction(-8, 5),
    )
    b: ClassVar[Row] = (
        Fraction(1, 4),
        Fraction(2, 3),
        Fraction(1, 2),
        Fraction(2, 5),
        Fraction(1, 9),
    )
    tableau: ClassVar[Tableau] = _tableau(a, b, lambda rows: rows[:-1])


class CK34(AbstractLowStorage, diffrax.AbstractAdaptiveSolver):
    """Order 3, 4 evaluations, 4 flows. The estimate, of order 2, comes at no extra cost.
    Dense output of order 3.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Carpenter & Kennedy, NASA TM-109112 (1994).
    """

    a: ClassVar[Row] = (Fraction(0), -0.7825460361923583, -2.042914325731225, -1.799337253940777)
    b: ClassVar[Row] = (
        0.06688758201974097,
        2.876554598956719,
        0.5534657361343982,
        0.3912730180961791,
    )
    tableau: ClassVar[Tableau] = _tableau(a, b, lambda rows: rows[:-1])


class CK54(AbstractLowStorage):
    """Order 4, 5 evaluations, 5 flows. Dense output of order 3.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Carpenter & Kennedy, NASA TM-109112 (1994).
    """

    a: ClassVar[Row] = (
        Fraction(0),
        -567301805773 / 1357537059087,
        -2404267990393 / 2016746695238,
        -3550918686646 / 2091501179385,
        -1275806237668 / 842570457699,
    )
    b: ClassVar[Row] = (
        1432997174477 / 9575080441755,
        5161836677717 / 13612068292357,
        1720146321549 / 2090206949498,
        3134564353537 / 4481467310338,
        2277821191437 / 14882151754819,
    )
    tableau: ClassVar[Tableau] = _tableau(a, b)
    orders: ClassVar = (4, None)


class Luscher3(AbstractLowStorage, diffrax.AbstractAdaptiveSolver):
    """Order 3, 3 evaluations, 3 flows. The estimate, of order 2, costs 1 flow more, and two more
    copies of the state. Dense output of order 2.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Lüscher, JHEP 08 (2010) 071, doi:10.1007/JHEP08(2010)071; estimate: Fritzsch & Ramos,
    JHEP 10 (2013) 008, doi:10.1007/JHEP10(2013)008.
    """

    a: ClassVar[Row] = (Fraction(0), Fraction(-17, 32), Fraction(-32, 27))
    b: ClassVar[Row] = (Fraction(1, 4), Fraction(8, 9), Fraction(3, 4))
    tableau: ClassVar[Tableau] = _tableau(a, b, lambda rows: [[-1, 2]])


class YRK135(AbstractLowStorage):
    """Order 5, 13 evaluations, 13 flows. Dense output of order 4.

    Some flows go backwards in time, so do not use it for strong dissipation: see `CF54`.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Yan (2017); Bazavov, BIT 62 (2022), doi:10.1007/s10543-021-00892-x.
    """

    a: ClassVar[Row] = (
        Fraction(0),
        -0.3367214311942741,
        -1.2018205782908165,
        -2.6261919625495067,
        -1.5418507843260567,
        -0.2845614242371758,
        -0.1700096844304301,
        -1.0839412680446805,
        -11.61787957751822,
        -4.520520805746419,
        -35.86177355832474,
        -2.1340899996007288e-05,
        -0.06631151668786135,
    )
    b: ClassVar[Row] = (
        0.0696326402470594,
        0.08891846277809203,
        1.046149012342678,
        0.42761794305080486,
        0.20975844551667144,
        -0.11457151862012135,
        -0.01392019988507068,
        4.033065562695671,
        0.3510684675245716,
        -0.16066651367556575,
        -0.005863316322503893,
        0.07729613386515187,
        0.054301254676908335,
    )
    tableau: ClassVar[Tableau] = _tableau(a, b)
    orders: ClassVar = (5, None)


class CFEES25(AbstractLowStorage, diffrax.AbstractAdaptiveSolver):
    """Order 2, 3 evaluations, 3 flows; a backward step undoes a step to order 5. The estimate, of
    order 1, costs 1 flow more, and one more copy of the state. Dense output of order 2.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Shmelev, Thompson & Salvi, arXiv:2509.20599 (2025).
    """

    a: ClassVar[Row] = (Fraction(0), Fraction(-7, 15), Fraction(-35, 32))
    b: ClassVar[Row] = (Fraction(1, 3), Fraction(15, 16), Fraction(2, 5))
    tableau: ClassVar[Tableau] = _tableau(
        a, b, lambda rows: [*rows[:-1], [Fraction(5, 48), Fraction(1, 16)]]
    )


class CFEES27(AbstractLowStorage):
    """Order 2, 4 evaluations, 4 flows; a backward step undoes a step to order 7. Dense output of
    order 2.

    `estimate` and `unroll` are those of `cfjax.CommutatorFree`.

    Source: Shmelev, Thompson & Salvi, arXiv:2509.20599 (2025).
    """

    a: ClassVar[Row] = (Fraction(0), -0.4477152501692066, -0.9225889843221229, -1.205283153123382)
    b: ClassVar[Row] = (
        0.19526214587563498,
        0.6767766952966369,
        0.6796227589829593,
        0.23879612503625855,
    )
    tableau: ClassVar[Tableau] = _tableau(a, b)
