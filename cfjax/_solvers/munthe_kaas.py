"""Munthe-Kaas methods: one flow for each stage, paid for with commutators."""

import abc
import contextlib
import functools
from collections.abc import Callable
from fractions import Fraction
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real

from .._field import (
    AbstractAlgebraElement,
    bracket,
    combine,
    dexpinv,
    enter,
    flow,
    is_field,
    leave,
    without_bracket,
)
from .._field import value as value_of
from .._methods.continuous_extension import runge_kutta_extension
from .._methods.order_conditions import runge_kutta_order
from .._methods.tableau import ContinuousExtension, Row
from .base import AbstractLieSolver, Move
from .dense import Path
from .stages import FieldVaries, can_loop, elements


class AbstractMuntheKaas(AbstractLieSolver):
    """The step `exp(v) y0` with v in the Lie algebra. Fields without a bracket are refused."""

    b: eqx.AbstractVar[Row]
    # Of the flow of v, so that it leads to points within the step.
    continuous_extension: eqx.AbstractVar[ContinuousExtension]

    @abc.abstractmethod
    def elements(self, field: Callable[[Any, PyTree], PyTree]) -> list[PyTree]:
        """What v is the combination of that has the weights `b`.

        `field(c, u)` is `h f(t + c h, exp(u) y0)`, and `u = None` means zero.
        """

    def move(self, field, y0):
        v, elements, start = self.logarithm(field, y0)
        path = Path.of(self.continuous_extension, value_of(start), elements)
        return Move(leave(v, flow(v, start)), path)

    def logarithm(self, field: Callable[[Any, PyTree], PyTree], y0: PyTree) -> Any:
        """The element v with the end of the step `exp(v) y0`, what it is a combination of, and y0.

        They are in the step's coordinates.
        """
        fields: list[PyTree] = []
        start = y0

        def field_at(c: float | Real[Array, ""], u: PyTree) -> PyTree:
            nonlocal start
            here = start if u is None else flow(u, start)
            value = field(c, leave(fields[0], here) if fields else here)
            value, here = enter(value, here, fields)
            for part in jtu.tree_leaves(value, is_leaf=is_field):
                if is_field(part) and not isinstance(part, AbstractAlgebraElement):
                    raise TypeError(without_bracket(part))
            if not fields:
                start = here
            fields.append(value)
            return value

        elements = self.elements(field_at)
        return _combine_nonzero(self.b, elements), elements, start


def _sixths(*numerators: int | Fraction) -> Row:
    return tuple(Fraction(n) / 6 for n in numerators)


class RKMK3(AbstractMuntheKaas):
    """Munthe-Kaas method of order 3 with one commutator: 3 evaluations, 3 flows.

    Dense output of order 2.

    Source: Munthe-Kaas & Owren, Computations in a free Lie algebra, Phil. Trans. R. Soc. A 357
    (1999), doi:10.1098/rsta.1999.0361.
    """

    b: ClassVar[Row] = _sixths(1, 4, 1, -1)
    continuous_extension: ClassVar[ContinuousExtension] = (
        (_sixths(6, 0, 0, 0), _sixths(-5, 4, 1, 0), _sixths(0, 0, 0, -1)),
    )

    def order(self, terms) -> int:
        return 3

    def elements(self, field):
        k1 = field(0.0, None)
        k2 = field(0.5, combine((1 / 2,), (k1,)))
        k3 = field(1.0, combine((-1.0, 2.0), (k1, k2)))
        return [k1, k2, k3, bracket(k1, k2)]


class RKMK4(AbstractMuntheKaas):
    """Munthe-Kaas method of order 4 with two commutators: 4 evaluations, 4 flows.

    Dense output of order 3.

    Source: Munthe-Kaas & Owren, Computations in a free Lie algebra, Phil. Trans. R. Soc. A 357
    (1999), doi:10.1098/rsta.1999.0361. Their two brackets of the last line,
    `-[Q1, Q2]/6 - [Q1, Q4]/12`, are `-[K1, K4]/12`.
    """

    b: ClassVar[Row] = _sixths(1, 2, 2, 1, Fraction(-1, 2))
    continuous_extension: ClassVar[ContinuousExtension] = (
        (
            _sixths(6, 0, 0, 0, 0),
            _sixths(-9, 6, 6, -3, 0),
            _sixths(4, -4, -4, 4, Fraction(-1, 2)),
        ),
    )

    def order(self, terms) -> int:
        return 4

    def elements(self, field):
        k1 = field(0.0, None)
        k2 = field(0.5, combine((1 / 2,), (k1,)))
        k3 = field(0.5, combine((1 / 2, -1 / 8), (k2, bracket(k1, k2))))
        k4 = field(1.0, k3)
        return [k1, k2, k3, k4, bracket(k1, k4)]


class RKMK(AbstractMuntheKaas):
    """The Munthe-Kaas method of any explicit Runge-Kutta method.

    Each stage takes the inverse derivative of the exponential as a series, with all its
    commutators: an s-stage method of order q costs up to `(s - 1)(q - 2)` of them. It has order q.
    Its stages also make the dense output: of order q - 1 with every tableau of diffrax but that of
    `Dopri8`, with which it is of order 5.

    **Arguments:** `tableau`, a `diffrax.ButcherTableau`, for example `diffrax.Dopri5.tableau`.

    **Raises** `TypeError` if it is something else, `ValueError` if the method is implicit.

    Source: Munthe-Kaas, High order Runge-Kutta methods on manifolds, Appl. Numer. Math. 29 (1999),
    doi:10.1016/S0168-9274(98)00030-0.
    """

    # Tuples: unlike diffrax's tableau they compare by value, as a static field must.
    a: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    b: tuple[float, ...] = eqx.field(static=True)
    # Not the sums of the rows: rounding could put a stage behind the end of the step.
    c: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, tableau: diffrax.ButcherTableau):
        if not isinstance(tableau, diffrax.ButcherTableau):
            own = getattr(tableau, "tableau", None)
            is_solver = isinstance(own, diffrax.ButcherTableau)
            name = tableau.__name__ if isinstance(tableau, type) else type(tableau).__name__
            advice = f" Write diffrax.{name}.tableau." if is_solver else ""
            raise TypeError(f"tableau must be a diffrax.ButcherTableau, got {tableau!r}.{advice}")
        if tableau.implicit:
            raise ValueError("tableau must be explicit, got one of an implicit method.")
        b = tableau.b_sol.tolist()
        # A last stage without weight only serves an error estimate or the next step.
        while b[-1] == 0:
            b.pop()
        self.a = ((), *(tuple(row.tolist()) for row in tableau.a_lower[: len(b) - 1]))
        self.b = tuple(b)
        self.c = (0.0, *tableau.c.tolist()[: len(b) - 1])

    def order(self, terms) -> int:
        return _classical_order(self.a[1:], self.b)

    @property
    def continuous_extension(self) -> ContinuousExtension:
        return runge_kutta_extension(self.a, self.b)

    def elements(self, field):
        degree = self.order(None) - 2

        def element(c: Any, u: PyTree) -> PyTree:
            return dexpinv(u, field(c, u), degree)

        stages = [field(0.0, None)]
        if all(map(any, self.a[1:])) and can_loop(stages[0]):
            with contextlib.suppress(FieldVaries):
                return elements(stages[0], self.a, self.c, element)
        for c, row in zip(self.c[1:], self.a[1:], strict=True):
            u = _combine_nonzero(row, stages) if any(row) else None
            stages.append(field(c, None) if u is None else element(c, u))
        return stages


_classical_order = functools.lru_cache(runge_kutta_order)


def _combine_nonzero(weights: Any, fields: Any) -> PyTree:
    used = [(float(w), f) for w, f in zip(weights, fields, strict=True) if w != 0]
    return combine(*zip(*used, strict=True))
