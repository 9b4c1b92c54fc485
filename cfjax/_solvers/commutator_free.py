"""Commutator-free methods: one step for every tableau."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import PyTree

from .. import _tableau
from .._frozen_field import combine, enter, flow, leave
from .._order_conditions import order
from .._tableau import Product, Tableau
from .base import AbstractLieSolver


class AbstractCommutatorFree(AbstractLieSolver):
    """Flows of linear combinations of frozen fields, and no commutator."""

    tableau: eqx.AbstractVar[Tableau]

    def order(self, terms) -> int:
        return order(self.tableau)

    def end_point(self, field, y0):
        fields: list[PyTree] = []
        # Rows that begin alike share their flows (the paper's "reusing flow calculations").
        points: dict[Product, PyTree] = {(): y0}

        def point(rows: Product) -> PyTree:
            if rows not in points:
                used = [(float(a), f) for a, f in zip(rows[-1], fields, strict=False) if a != 0]
                points[rows] = flow(combine(*zip(*used, strict=True)), point(rows[:-1]))
            return points[rows]

        for c, rows in zip(self.tableau.c, self.tableau.alpha, strict=True):
            here = point(rows)
            value = field(float(c), leave(fields[0], here) if fields else here)
            value, points[rows] = enter(value, here, fields)
            fields.append(value)
        return leave(fields[0], point(self.tableau.beta))


class CommutatorFree(AbstractCommutatorFree):
    """The commutator-free method of a `cfjax.Tableau`.

    One step costs `tableau.num_evaluations` evaluations of the field and `tableau.num_flows`
    flows. Its order is `cfjax.order(tableau)`.

    **Raises** `TypeError` if `tableau` is not a `cfjax.Tableau`.
    """

    tableau: Tableau = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.tableau, Tableau):
            raise TypeError(f"tableau must be a cfjax.Tableau, got {self.tableau!r}.")


class LieEuler(AbstractCommutatorFree):
    """The exponential Euler step. Order 1, 1 evaluation, 1 flow."""

    tableau: ClassVar[Tableau] = _tableau.LIE_EULER


class CF2(AbstractCommutatorFree):
    """The midpoint rule. Order 2, 2 evaluations, 2 flows."""

    tableau: ClassVar[Tableau] = _tableau.CF2


class CF3(AbstractCommutatorFree):
    """Celledoni, Marthinsen & Owren's method of order 3: 3 evaluations, 3 flows.

    `cfjax.third_order_a` and `cfjax.third_order_b` give the families it belongs to.

    Source: Commutator-free Lie group methods, FGCS 19 (2003), equation (6).
    """

    tableau: ClassVar[Tableau] = _tableau.CF3


class CF4(AbstractCommutatorFree):
    """Celledoni, Marthinsen & Owren's method of order 4: 4 evaluations, 5 flows.

    In a linear space this is the classical Runge-Kutta method. The choice for most problems.

    Source: Commutator-free Lie group methods, FGCS 19 (2003), equation (7).
    """

    tableau: ClassVar[Tableau] = _tableau.CF4


class CG3(AbstractCommutatorFree):
    """Crouch & Grossman's method of order 3: 3 evaluations, 6 flows of single fields.

    Source: Crouch & Grossman, J. Nonlinear Sci. 3 (1993); coefficients of Owren & Marthinsen,
    BIT 39 (1999).
    """

    tableau: ClassVar[Tableau] = _tableau.CG3


class CG4(AbstractCommutatorFree):
    """A Crouch-Grossman method of order 4: 5 evaluations, 15 flows of single fields.

    Source: Jackiewicz, Marthinsen & Owren, Adv. Comput. Math. 13 (2000).
    """

    tableau: ClassVar[Tableau] = _tableau.CG4


class CG5(AbstractCommutatorFree):
    """A Crouch-Grossman method of order 5: 9 evaluations, 43 flows of single fields.

    Source: Jackiewicz, Marthinsen & Owren, Adv. Comput. Math. 13 (2000).
    """

    tableau: ClassVar[Tableau] = _tableau.CG5
