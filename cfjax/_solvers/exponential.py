"""Exponential Runge-Kutta methods: flows along polynomials in time, for stiff semilinear fields."""

import functools
from collections.abc import Sequence
from fractions import Fraction
from math import factorial
from typing import Any, ClassVar, Literal

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Real

from .._field import Rest, combine, from_chart, is_field, to_chart
from .._fields.semilinear import AbstractSemilinearField
from .._methods import exponential as _exponential
from .._methods.exponential import Columns, Combination, ExponentialTableau
from .._term import product
from .base import AbstractTableauSolver, check_choice
from .dense import AbstractPath
from .dependence import dependents
from .step import AbstractChartSolver, Step


class AbstractExponential(AbstractTableauSolver, AbstractChartSolver):
    """Steps for `x' = L x + g(t, x)` that are exact in L, with g as a polynomial in time.

    The field must return `cfjax.Affine`, `cfjax.LinearAffine`, another
    `cfjax.AbstractSemilinearField`, or an array for each part of the state. A step takes L from the
    first field, and g from every field: its velocity less L times the point. So L may depend on
    time, state and parameters. An array is the case L = 0: in a linear space each method is a
    Runge-Kutta method.

    L should hold nearly all of the stiffness: see *Stiff equations* in the documentation.

    With a stiff order p the error is of order p however stiff L is, also where g does not vanish at
    a boundary. No commutator-free method has a stiff order above 2.

    The functions `phi_k(c h L)` are made for each step. `cfjax.integrate` makes them once, if L
    depends on neither time nor state.

    `ExponentialRungeKutta` explains `estimate`.

    **Raises** `TypeError` when the program is traced for a field of another class, or a term that a
    path drives; `ValueError` for another `estimate`.
    """

    tableau: eqx.AbstractVar[ExponentialTableau]
    takes_noise: ClassVar[bool] = False
    estimate: Literal["group"] | None = eqx.field(static=True, default="group", kw_only=True)
    # For equal steps: their length, as differences of times would differ from step to step by their
    # rounding, and for each part of the field the coefficients of its linear part, where that is
    # the same in all steps. `for_equal_steps` sets them.
    equal_length: Real[Array, ""] | None = eqx.field(default=None, init=False)
    known: tuple[Any, ...] | None = eqx.field(default=None, init=False)

    def __check_init__(self):
        check_choice("estimate", self.estimate, "group", None)

    @property
    def first_same_as_last(self) -> bool:
        return self.estimate is not None and self.tableau.uses_last

    def for_equal_steps(self, terms, length, t0, y0, args) -> Any:
        """The same method for steps of this length only, with the coefficients of all linear parts
        that depend on neither time nor state.
        """
        solver: Any = self._with(equal_length=length)

        def coefficients(time_and_state: tuple[Any, PyTree]) -> list[tuple[Any, Any]]:
            t, y = time_and_state
            control = terms.contr(*solver.interval(t, t))
            first, _ = to_chart(product(terms, terms.vf(t, y, args), control), y, ())
            return list(enumerate(solver._linear_part(first).coefficients))

        dependent = dependents(coefficients, (t0, y0))
        if dependent is None:
            return solver
        pairs = coefficients((t0, y0))
        return solver._with(known=tuple(None if k in dependent else part for k, part in pairs))

    def interval(self, t0: Any, t1: Any) -> tuple[Any, Any]:
        if self.equal_length is None:
            return t0, t1
        return jnp.zeros_like(self.equal_length), self.equal_length

    def step_in(self, chart):
        tableau, first = self.tableau, chart.first_field
        linear = self._linear_part(first)
        # The velocity at the start, and by how much g differs there and at each later stage.
        changes = {1: _nonlinear(first, combine([0.0], [first]), chart.origin)}
        g = _nonlinear(first, first, chart.origin)

        def reach(row: Columns, changes: dict[int, PyTree]) -> PyTree:
            point = jtu.tree_map(jnp.add, chart.start, linear.increment(row, changes))
            return chart.branching(point)

        def change(field: PyTree, point: PyTree) -> PyTree:
            return jtu.tree_map(jnp.subtract, _nonlinear(field, first, chart.sums.state(point)), g)

        *rows, last_row = self._rows
        fields = [first]
        for stage, row in enumerate(rows, 2):
            point = reach(row, changes)
            fields = [*fields, chart.field(float(tableau.c[stage - 1]), point, fields)]
            changes = {**changes, stage: change(fields[-1], point)}
        end = reach(last_row, changes)
        powers = [
            combine([float(w) for _, w in power], [changes[j] for j, _ in power])
            for power in tableau.powers
        ]
        path = _PolynomialPath(type(self).__name__, first, chart.origin, changes[1], powers)
        if self._error is None:
            return Step(chart.end(end), path)
        last = None
        if tableau.uses_last:
            last = chart.value_at(1.0, end)
            field = chart.frozen(last, end, fields)
            changes = {**changes, tableau.num_stages + 1: change(field, end)}
        error = from_chart(first, linear.increment(self._error, changes))
        return Step(chart.end(end), path, error, last)

    def _linear_part(self, first: PyTree) -> "_LinearPart":
        rows = [*self._rows, self._error or ()]
        return _LinearPart(type(self).__name__, first, rows, self.known)

    @property
    def _error(self) -> Columns | None:
        return None if self.estimate is None else self.tableau.error

    @property
    def _rows(self) -> list[Columns]:
        """The rows of the stages from 2 on and of the end, with the velocity as first column."""
        tableau = self.tableau
        ends = zip((*tableau.c[1:], Fraction(1)), (*tableau.a[1:], tableau.b), strict=True)
        return [((1, ((1, c, c),)), *row) for c, row in ends]


class _LinearPart:
    """The coefficients of a step: functions of the linear part of its first field.

    `stored` has those of each part of the field, or None for a part whose linear part may change.
    """

    def __init__(
        self,
        solver: str,
        first: PyTree,
        rows: Sequence[Columns],
        stored: Sequence[Any] | None = None,
    ):
        paths, self.treedef = jtu.tree_flatten_with_path(first, is_leaf=is_field)
        for path, part in paths:
            if is_field(part) and not isinstance(part, AbstractSemilinearField | Rest):
                raise TypeError(_has_no_linear_part(solver, jtu.keystr(path), part))
        self.parts = [part for _, part in paths]
        self.combinations = list(dict.fromkeys(terms for row in rows for _, terms in row))
        self.coefficients = [
            _coefficients(part, self.combinations) if values is None else values
            for part, values in zip(self.parts, stored or [None] * len(self.parts), strict=True)
        ]

    def increment(self, row: Columns, changes: dict[int, PyTree]) -> PyTree:
        """The sum over the columns of a row, each times its change."""
        flat = {j: self.treedef.flatten_up_to(changes[j]) for j, _ in row}

        def of_part(k: int, part: Any) -> PyTree:
            coefficients = dict(zip(self.combinations, self.coefficients[k], strict=True))
            return _sum([_multiply(part, coefficients[terms], flat[j][k]) for j, terms in row])

        return self.treedef.unflatten(of_part(k, part) for k, part in enumerate(self.parts))


def _sum(trees: Sequence[PyTree]) -> PyTree:
    return functools.reduce(lambda a, b: jtu.tree_map(jnp.add, a, b), trees)


def _coefficients(part: Any, combinations: Sequence[Combination]) -> list[Any]:
    if not isinstance(part, AbstractSemilinearField):
        # phi_k(0) is 1 / k!.
        return [float(sum(w / factorial(k) for k, _, w in terms)) for terms in combinations]
    pairs = list(dict.fromkeys((float(c), k) for terms in combinations for k, c, _ in terms))
    functions = dict(zip(pairs, part.functions(pairs), strict=True))

    def combined(terms: Combination) -> Any:
        weighted = [(float(w), functions[float(c), k]) for k, c, w in terms]
        return _sum([jtu.tree_map(lambda x: w * x, function) for w, function in weighted])  # noqa: B023

    return list(map(combined, combinations))


def _multiply(part: Any, coefficient: Any, x: PyTree) -> PyTree:
    if isinstance(part, AbstractSemilinearField):
        return part.times(coefficient, x)
    return jtu.tree_map(lambda x: coefficient * x, x)


def _nonlinear(field: PyTree, first: PyTree, point: PyTree) -> PyTree:
    """The velocity less that of the linear part of the first field: g."""

    def part(f: Any, first: Any, x: PyTree) -> PyTree:
        if not is_field(f):
            return f
        return f.rest(first, x) if isinstance(f, AbstractSemilinearField) else f.tangent(x)

    return jtu.tree_map(part, field, first, point, is_leaf=is_field)


def _has_no_linear_part(solver: str, place: str, part: Any) -> str:
    return (
        f"{solver} takes fields x' = L x + g: cfjax.Affine, cfjax.LinearAffine, another "
        f"cfjax.AbstractSemilinearField, or an array. For y{place} the field is "
        f"{type(part).__name__}. Use a commutator-free method, for example cfjax.CF4()."
    )


class _PolynomialPath(AbstractPath):
    """The path of a step: the flow along a polynomial in time."""

    solver: str = eqx.field(static=True)
    first: PyTree
    start: PyTree
    velocity: PyTree
    # The coefficients of the powers of the time, from the first on, of g less its value at the
    # start.
    powers: list[PyTree]

    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""
        theta = jnp.asarray(theta)
        changes = {
            m: combine([theta**m], [change])
            for m, change in enumerate((self.velocity, *self.powers), 1)
        }
        # The flow of s^(m-1) is (m-1)! phi_m.
        row = tuple((m, ((m, Fraction(1), Fraction(factorial(m - 1))),)) for m in changes)
        linear = _LinearPart(self.solver, combine([theta], [self.first]), [row])
        point = jtu.tree_map(jnp.add, self.start, linear.increment(row, changes))
        return from_chart(self.first, point)


class ExponentialRungeKutta(AbstractExponential, diffrax.AbstractAdaptiveSolver):
    """The exponential Runge-Kutta method of a `cfjax.ExponentialTableau`.

    A step costs `tableau.num_evaluations` evaluations. Its order is `cfjax.order(tableau)`, its
    stiff order `cfjax.stiff_order(tableau)`. Output within a step is that of the polynomial in time
    which leads to its end.

    It is a `diffrax.AbstractAdaptiveSolver` for every tableau, as its class does not depend on the
    tableau. diffrax refuses adaptive steps if the tableau has no estimate.

    **Arguments:**

    - `tableau`: a `cfjax.ExponentialTableau`.
    - `estimate`: `"group"`, the default, estimates the error by the embedded method of the tableau,
      if it has one. None leaves out the estimate, which constant steps do not need.
      `cfjax.integrate` leaves it out.

    **Raises** `TypeError` if `tableau` is not a `cfjax.ExponentialTableau`, and when the program is
    traced for a field of another class or a term that a path drives; `ValueError` for another
    `estimate`.
    """

    tableau: ExponentialTableau = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.tableau, ExponentialTableau):
            raise TypeError(f"tableau must be a cfjax.ExponentialTableau, got {self.tableau!r}.")


class ETDRK4(AbstractExponential):
    """Cox & Matthews' method, for comparison: order 4, stiff order 2, 4 evaluations.

    It has no estimate of the error. Dense output of order 3. `ETD43` has a stiff order of 4 for one
    evaluation more.

    `estimate` is that of `cfjax.ExponentialRungeKutta`.

    Source: Cox & Matthews, Exponential time differencing for stiff systems, J. Comput. Phys. 176
    (2002), doi:10.1006/jcph.2002.6995.
    """

    tableau: ClassVar[ExponentialTableau] = _exponential.ETDRK4
    orders: ClassVar = (4, None)


class ETD43(AbstractExponential, diffrax.AbstractAdaptiveSolver):
    """Order 4 and stiff order 4, with an embedded method of order 3: 5 evaluations.

    Its estimate uses the field at the end, with which the next step begins. For stiff problems and
    errors of about 1e-3. Dense output of order 3.

    `estimate` is that of `cfjax.ExponentialRungeKutta`.

    Source: derived for this package, with the conditions of Hochbruck & Ostermann, Explicit
    exponential Runge-Kutta methods for semilinear parabolic problems, SIAM J. Numer. Anal. 43
    (2005), doi:10.1137/040611434.
    """

    tableau: ClassVar[ExponentialTableau] = _exponential.ETD43
    orders: ClassVar = (4, 3)


class ETD54(AbstractExponential, diffrax.AbstractAdaptiveSolver):
    """Order 5 and stiff order 5, with an embedded method of order 4: 8 evaluations.

    The choice for stiff semilinear problems. Dense output of order 4.

    `estimate` is that of `cfjax.ExponentialRungeKutta`.

    Source: derived for this package, with the conditions of Luan & Ostermann, Exponential B-series:
    the stiff case, SIAM J. Numer. Anal. 51 (2013), doi:10.1137/130920204.
    """

    tableau: ClassVar[ExponentialTableau] = _exponential.ETD54
    orders: ClassVar = (5, 4)
