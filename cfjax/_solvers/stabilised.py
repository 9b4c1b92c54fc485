"""Stabilised methods: explicit, with as many stages as large diffusion or relaxation takes."""

import abc
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, PyTree, Real

from .._field import combine, is_field, tangent
from .._fields.semilinear import AbstractSemilinearField
from .._methods.tableau import ContinuousExtension
from .._numerics.checks import Fault
from .._numerics.squaring import max_over_batch
from .._term import velocity
from .base import State, evaluation_times, finite_if_complex, result_of
from .compiled import chosen, over_stages, scalarised, scan_list
from .dense import Path
from .spectral_radius import Iteration, first_iteration, largest, next_iteration, rate_along
from .stacked import cast_like
from .stages import is_uniform
from .step import AbstractChartSolver, Chart, Step

# Power iteration converges from below, and a radius that is too small by 2 % makes 41 stages
# unstable.
_SAFETY = 1.1
# The least ratio of the radius to that of the step before.
_LEAST_RATIO = 0.9


# How many times the mean velocity of a step that at its end must be for a look at its modes. Of a
# mode at the end of the range it is half the rate or more, and of smooth motion about one.
_MUCH_FASTER = 3
# By how much the rate of the modes in it may be beyond the range, over the step: there a step
# multiplies them by 4 to 7.
_BEYOND = 1


class _State(State):
    # None where the radius is not estimated.
    iteration: Iteration | None
    # The most stages that a step needed, or None where they are given.
    most: Real[Array, ""] | None
    # Whether a step was unstable, or None where nothing tells.
    is_unstable: Bool[Array, ""] | None


class AbstractStabilised(AbstractChartSolver, diffrax.AbstractAdaptiveSolver):
    """A Runge-Kutta method of many stages, each of which is one flow from the start of the step.

    With s stages a step is stable for eigenvalues on the negative axis up to some `s^2 / 2`, or
    `s^2 / 3` for `RKG2`, over the step, where other explicit methods with s evaluations reach to
    some 0.7 s. So it is for fields with large diffusion or relaxation, and no large imaginary
    eigenvalues, whose solution is smooth after a while. The stages move along sums of frozen
    fields, without a commutator, and stay on the manifold however long a step is.

    Output within a step has order 2 and stays on the manifold. The last evaluation of a step is the
    first one of the next. Whatever the number of stages, a step keeps five arrays like the state:
    the state, the first field, two elements of the recursion and the point of an evaluation; what
    an evaluation keeps itself comes on top. `RKL3` keeps eight with given stages, ten with chosen
    ones, as elements of parts and the middle of the step. An estimated radius takes two more,
    three with `RKL3`.
    Reverse mode works by checkpoints; forward mode needs `stages`, as it has no rule for a loop
    whose length is chosen.
    """

    # Twice the index of the Gegenbauer polynomials.
    twice_index: eqx.AbstractClassVar[int]
    # Of the combination of the elements of a step that leads to points within it.
    continuous_extension: eqx.AbstractClassVar[ContinuousExtension]
    takes_noise: ClassVar[bool] = False

    stages: int | None = eqx.field(static=True, default=None)
    spectral_radius: float | Callable[[Any, PyTree, PyTree], Any] | None = eqx.field(
        default=None, kw_only=True
    )
    max_stages: int = eqx.field(static=True, default=200, kw_only=True)
    # The length of the step at hand times the radius, where that decides. NaN if it is too large.
    stiffness: Real[Array, ""] | None = eqx.field(default=None, init=False)

    def __check_init__(self):
        for name, value in (("stages", self.stages), ("max_stages", self.max_stages)):
            if value is None and name == "stages":
                continue
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"{name} must be an int, got {value!r}.")
            if value < 3:
                raise ValueError(f"{name} must be at least 3, got {value}.")
        radius = self.spectral_radius
        if self.stages is not None and radius is not None:
            raise ValueError(
                "stages and spectral_radius must not be given together, as the radius decides "
                f"how many stages a step has: got {self.stages} and {radius!r}."
            )
        is_array = isinstance(radius, jax.Array) and not radius.shape
        is_number = is_array or isinstance(radius, int | float | np.number)
        is_number = is_number and not isinstance(radius, bool)
        if radius is not None and not is_number and not callable(radius):
            raise TypeError(
                "spectral_radius must be a number, a function (t, y, args) or None, got "
                f"{radius!r}."
            )
        if isinstance(radius, int | float | np.number) and not 0 <= float(radius) < math.inf:
            raise ValueError(f"spectral_radius must not be negative or infinite, got {radius}.")

    @abc.abstractmethod
    def elements(self, chart: Chart) -> "_Elements":
        """The elements of the algebra along which a step moves."""

    def range_of(self, z: Any) -> Any:
        """How far a step is stable on the negative axis whose stages are chosen for z."""
        return _reach(_stages_for(z, self.twice_index), self.twice_index)

    @property
    def first_same_as_last(self) -> bool:
        return True

    def error_order(self, terms) -> int:
        return 3

    def init(self, terms, t0, t1, y0, args) -> _State:
        state, fault = self.start(terms, t0, t1, y0, args)
        zero = fault.error(jnp.zeros((), jnp.result_type(t0)))
        return eqx.tree_at(lambda s: s.zero, state, zero, is_leaf=lambda x: x is None)

    def ended(self, solver_state, fault):
        if self.stages is not None:
            return fault
        if solver_state.is_unstable is not None:
            fault = fault.with_case(
                solver_state.is_unstable,
                "A step was unstable, as the spectral radius grew within it or faster than its "
                "estimate follows. Take more steps, or give a bound on it (spectral_radius) or "
                "the number of stages (stages).",
            )
        for level in (1, 2, 5, 10, 100, 1000):
            limit = level * self.max_stages
            fault = fault.with_case(
                solver_state.most > limit,
                f"max_stages={self.max_stages} is too small: a step takes more than {limit} "
                "stages. Take more steps or, with max_stages, more stages.",
            )
        return fault

    def start(self, terms, t0, t1, y0, args) -> tuple[_State, Fault]:
        state, fault = super().start(terms, t0, t1, y0, args)
        iteration = most = is_unstable = None
        if self.stages is None:
            begin, _ = evaluation_times(t0, t1)
            if self.spectral_radius is None:
                iteration = first_iteration(terms, begin, y0, args)
                is_unstable = jnp.zeros((), bool)
            radius = self._radius(begin, y0, args, iteration)
            if self.spectral_radius is not None:
                fault = fault.with_case(
                    ~(radius >= 0),
                    "spectral_radius must not be negative, got a negative number or NaN at the "
                    "start.",
                )
            most = jnp.zeros((), (jnp.abs(t1 - t0) * radius).dtype)
        return _State(state.compensation, state.first, None, iteration, most, is_unstable), fault

    def _radius(self, t, y, args, iteration: Iteration | None) -> Real[Array, ""]:
        if iteration is not None:
            return _SAFETY * iteration.growth
        radius = self.spectral_radius
        return lax.stop_gradient(jnp.asarray(radius(t, y, args) if callable(radius) else radius))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        self.for_terms(terms)
        solver: Any = self
        z: Any = None
        iteration, most = solver_state.iteration, solver_state.most
        start, end = evaluation_times(t0, t1)
        if iteration is not None:
            # At the end of the step, as it may grow with time.
            first = velocity(terms, _first(solver_state, terms, start, y0, args), y0)
            now = next_iteration(terms, end, y0, args, iteration, first)
            iteration = now._replace(
                growth=jnp.maximum(now.growth, _LEAST_RATIO * iteration.growth)
            )
        if self.stages is None:
            radius = self._radius(end, y0, args, iteration)
            if callable(self.spectral_radius):
                radius = jnp.maximum(self._radius(start, y0, args, None), radius)
            z = jnp.abs(t1 - t0) * radius
            number = _stages_for(z, self.twice_index)
            # Not NaN, of states after a step that failed.
            most = jnp.where(number > most, number, most)
            is_possible = number <= self.max_stages
            solver = self._with(stiffness=jnp.where(is_possible, z, jnp.nan))
        y1, error, dense_info, state, result = AbstractChartSolver.step(
            solver, terms, t0, t1, y0, args, solver_state, made_jump
        )
        is_unstable = solver_state.is_unstable
        if iteration is not None:
            last = _first(state, terms, end, y1, args)
            range_ = self.range_of(z)
            now_unstable = _is_unstable(range_, terms, t0, t1, y0, y1, args, last)
            # As above the estimate of an impossible step.
            zero = jnp.where(now_unstable, jnp.nan, 0.0)
            y1, error = jtu.tree_map(lambda x: x + zero.astype(x.dtype), (y1, error))
            error, result = finite_if_complex(error), result_of(y1)
            is_unstable = is_unstable | now_unstable
        state = _State(state.compensation, state.first, state.zero, iteration, most, is_unstable)
        return y1, error, dense_info, state, result

    def step_in(self, chart):
        _check_fields(self, chart)
        elements = self.elements(chart)

        def flow(end: PyTree, weights: tuple[Any, ...]) -> tuple[PyTree, PyTree]:
            element = combine(weights, elements.all)
            return chart.flow(element, end), element

        # One program for all of them.
        end, flows = scan_list(flow, chart.start, elements.weights)
        value = chart.value_at(1.0, end)
        last = chart.frozen(value, end, [chart.first_field])
        error = tangent(elements.error(last), chart.state(end))
        y1 = chart.end(end)
        if self.stiffness is not None:
            # NaN is an infinite error to diffrax, so that the step is taken again, shorter.
            zero = jnp.where(self._is_possible, 0.0, jnp.nan)
            y1, error = jtu.tree_map(lambda x: x + zero.astype(x.dtype), (y1, error))
        path = Path.of(
            self.continuous_extension,
            chart.origin,
            [chart.first_field, *flows, last],
        )
        return Step(y1, path, error, value)

    @property
    def _is_possible(self) -> Any:
        return True if self.stiffness is None else ~jnp.isnan(self.stiffness)

    def _number(self, length: float) -> Any:
        """How many stages such a part of the step has."""
        l = self.twice_index  # noqa: E741
        if self.stages is None:
            # NaN is impossible, and 3 will do.
            return _stages_for(length * jnp.nan_to_num(jnp.asarray(self.stiffness)), l)
        # As many as reach as far, in a part of it.
        return self.stages if length == 1 else _stages_for(length * _reach(self.stages, l), l)

    def _element(self, chart: Chart, first: PyTree, point: PyTree, part: "_Part") -> PyTree:
        """The element that leads from a point with the field `first` over a part of the step."""
        l = self.twice_index  # noqa: E741
        # An impossible step has zeros and no stage, so that its derivative is finite.
        number, is_possible = part.number, self._is_possible

        def stage(j: Any, carry: Any) -> Any:
            u, last, time, time_before = carry
            field = chart.field(part.start + part.length * time, chart.flow(u, point), [first])
            mu, nu, of_field, of_first = _weights(j, number, l, part.ratio)
            weights = mu + nu - 1, -nu, of_field * part.length, of_first * part.length
            last = cast_like(first, combine(weights, (u, last, cast_like(first, field), first)))
            new = combine((1.0, 1.0), (u, last))
            new_time = mu * time + nu * time_before + of_field + of_first
            return cast_like(first, new), last, new_time, time

        # The time of the first stage, and the weight of the first field there.
        w = (l + 1) / (2 * (l + 2)) * part.ratio * _slope(number, l)
        w = jnp.where(is_possible, w if self.stages is None else jnp.asarray(w, float), 0.0)
        zero = jnp.zeros_like(w)
        u = combine((w * part.length,), (first,))
        # An element and its last increment: both change in place, where XLA would copy two elements
        # to exchange them.
        carry = u, u, w, zero
        if self.stages is not None:
            turns = np.arange(2.0, number + 1)
            (u, *_), _ = over_stages(lambda carry, j: (stage(j, carry), None), carry, turns)
            return u
        # A loop of no more turns than there are stages.
        # On a lattice a turn on single numbers takes half to a third of the time.
        _, (u, *_) = eqxi.while_loop(
            lambda value: is_possible & (value[0] <= number),
            lambda value: (
                value[0] + 1,
                scalarised(lambda carry: stage(value[0], carry), value[1]),
            ),
            (jnp.full_like(w, 2), jtu.tree_map(_reverse_mode_only, carry)),
            max_steps=self.max_stages,
            kind="checkpointed",
        )
        return u


class _Part(NamedTuple):
    """A part of a step, with so many stages, of which the first is at `ratio` times its time."""

    number: Any
    start: Any = 0.0
    length: Any = 1.0
    ratio: Any = 1.0


class _Elements(NamedTuple):
    """Elements, the weights of them in the flows along which a step moves, one after the other, and
    the element of the estimate, from the field at the end.
    """

    all: tuple[PyTree, ...]
    weights: list[tuple[Any, ...]]
    error: Callable[[PyTree], PyTree]


class _OneElement(AbstractStabilised):
    """The step `exp(u) y0` with u from the recursion: order 2, on every manifold.

    Let `u' = dexpinv_u F` be the equation in the algebra and `v' = F` the one without its
    commutators. Then `u - v = -h^3 / 12 [F, F'] + O(h^4)`, so a method of order 2 for v is one of
    order 2 on the manifold.
    """

    continuous_extension: ClassVar[ContinuousExtension] = (
        ((1.0, 0.0, 0.0), (-2.0, 3.0, -1.0), (1.0, -2.0, 1.0)),
    )

    def order(self, terms) -> int:
        return 2

    def elements(self, chart):
        first = chart.first_field
        u = self._element(chart, first, chart.start, _Part(self._number(1.0)))
        error = lambda last: combine((-0.8, 0.4, 0.4), (u, first, last))  # noqa: E731
        return _Elements((u,), [(1.0,)], error)


class RKL2(_OneElement):
    """Order 2, stable up to `(s - 1)(s + 2) / 2` with s stages: s evaluations, s flows.

    Runge-Kutta-Legendre, for relative errors of some 1e-2 to 1e-3. The estimate comes at no extra
    cost. It is large where stiff parts are not smooth yet.

    **Arguments:**

    - `stages`: the number of stages of every step, at least 3; an odd number damps what is stiffest
      most. None, the default, chooses it in each step from the step size and the spectral radius.
    - `spectral_radius`: the spectral radius of the field, or a bound on it (see
      `cfjax.spectral_radius`): a number, or a function `(t, y, args)`, of which a step takes the
      larger value at its two times, with the state at its start. If it is too small, steps are
      unstable, which error control sees. None, the default, estimates it with 30 power iterations
      at the start, and one a step, or up to 30 where it rises. A step that is unstable all the same
      fails: error control takes it again, shorter, and `cfjax.integrate` raises an error.
    - `max_stages`: a step that needs more fails, before it evaluates a stage. Error control then
      takes it again, shorter. In float32 use some 50, as rounding errors grow with the square of
      the stages.

    **Raises** `TypeError` or `ValueError` for an argument of another kind or value, or `stages`
    together with `spectral_radius`. When the program is traced, `TypeError` for fields whose sums
    grow, such as `cfjax.LowRankSkew`, for fields with an exact stiff part, such as `cfjax.Affine`,
    and for terms that a path drives.

    Source: Meyer, Balsara & Aslam, A stabilized Runge-Kutta-Legendre method for explicit
    super-time-stepping of parabolic and mixed equations, J. Comput. Phys. 257 (2014),
    doi:10.1016/j.jcp.2013.08.021; the estimate as in Sommeijer, Shampine & Verwer, RKC: an explicit
    solver for parabolic PDEs, J. Comput. Appl. Math. 88 (1998),
    doi:10.1016/S0377-0427(97)00219-7.
    """

    twice_index: ClassVar[int] = 1


class RKG2(_OneElement):
    """Order 2, stable up to `(s - 1)(s + 4) / 3` with s stages: s evaluations, s flows.

    Runge-Kutta-Gegenbauer. It takes 1.2 times the stages of `RKL2`, and is stable in a wider region
    about the negative axis: for spectra with an imaginary part, as of advection or precession.

    `stages`, `spectral_radius` and `max_stages` are those of `cfjax.RKL2`.

    Source: the recursion of `RKL2` with Gegenbauer polynomials of index 3/2; for these methods
    Skaras, Saxton, Meyer & Aslam, Super-time-stepping schemes for parabolic equations with boundary
    conditions, J. Comput. Phys. 425 (2021), doi:10.1016/j.jcp.2020.109879.
    """

    twice_index: ClassVar[int] = 3


class RKL3(AbstractStabilised):
    """Order 3, stable on the whole range of `RKL2`: 2.4 times its evaluations, 2 flows at the end.

    For relative errors of some 1e-4 to 1e-6. It extrapolates `RKL2`: with its elements u of the
    whole step and v1, v2 of the halves, which take fewer stages, the step is
    `exp(p v2 + q v1 + e u) exp(p v1 + q v2 + e u) y0`. The estimate, a multiple of `v1 + v2 - u`,
    comes at no extra cost, and stays small in stiff parts.

    Order 3 without a commutator: u is off by `h^3 (c A + d B + [F, F'] / 12)`, see
    `RKL2`, with A the third derivative of v, B the part of it with F's second derivative, and c and
    d that depend on the number of stages. In the halves c is r times that of u, and the
    time of their first stage is such that d is as well. So `a (v1 + v2) + (1 - a) u` has neither
    if `a = 4 / (4 - r)`. Two half steps have the logarithm `v1 + v2 + [v2, v1]/2`, with the sign of
    an action from the left. As `h^3 [F, F'] = -8 [v2, v1]`, the exact logarithm is this sum and
    `2/3 [v2, v1]`, up to `O(h^4)`. With `p + q = a`, `2 e = 1 - a` and `p - q = 4/3` the two flows
    have the sum and, as `u = v1 + v2 + O(h^3)`, the bracket `(p - q)/2 [v2, v1]`.

    `stages`, `spectral_radius` and `max_stages` are those of `cfjax.RKL2`.

    Source: derived for this package; it was not found in print.
    """

    twice_index: ClassVar[int] = 1
    continuous_extension: ClassVar[ContinuousExtension] = (
        ((1.0, 0.0, 0.0, 0.0), (-2.0, 3.0, 0.0, -1.0), (1.0, -2.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 3.0, 0.0), (0.0, 0.0, -2.0, 0.0)),
    )

    def order(self, terms) -> int:
        return 3

    def range_of(self, z):
        # The halves may have stages for less.
        return jnp.minimum(super().range_of(z), 2 * super().range_of(z / 2))

    def elements(self, chart):
        first, start = chart.first_field, chart.start
        s, m = self._number(1.0), self._number(0.5)
        most = self.stages or self.max_stages
        # c is -(1 + 2 w) / 18, and d is -3 b_1 times what follows.
        ws, wm = _slope(s, 1), _slope(m, 1)
        ds, dm = (
            w**2 * (_harmonic(number, most) - 1) / (number**2 + number)
            for w, number in ((ws, s), (wm, m))
        )
        r = (1 + 2 * wm) / (1 + 2 * ws)
        a, ratio = 4 / (4 - r), r * ds / dm

        parts = [_Part(m, 0.0, 0.5, ratio), _Part(m, 0.5, 0.5, ratio), _Part(s)]

        def after(v: PyTree, point: PyTree) -> tuple[PyTree, PyTree]:
            middle = chart.flow(v, point)
            return cast_like(first, chart.field(0.5, middle, [first])), middle

        def element(start_of_part: Any, x: tuple[Any, _Part]) -> Any:
            is_followed, part = x
            part = jtu.tree_map(lambda number: number.astype(s.dtype), part)
            field, point = start_of_part
            v = self._element(chart, field, point, part)
            return chosen(is_followed, lambda: after(v, point), lambda: (first, start)), v

        if self.stages is None:
            # One program for all of them.
            turns = list(zip((True, False, False), parts, strict=True))
            _, (v1, v2, u) = scan_list(element, (first, start), turns)
        else:
            v1 = self._element(chart, first, start, parts[0])
            field, middle = after(v1, start)
            v2 = self._element(chart, field, middle, parts[1])
            u = self._element(chart, first, start, parts[2])
        p, q, e = a / 2 + 2 / 3, a / 2 - 2 / 3, (1 - a) / 2
        error = combine((a - 1, a - 1, 1 - a), (v1, v2, u))
        return _Elements((v1, v2, u), [(p, q, e), (q, p, e)], lambda last: error)


def _first(state: State, terms: Any, t: Any, y: PyTree, args: PyTree) -> PyTree:
    """The value of the field where a step begins, which the last step has unless it may jump."""
    return terms.vf(t, y, args) if state.first is None else state.first


def _is_unstable(
    range_: Any, terms: Any, t0: Any, t1: Any, y0: PyTree, y1: PyTree, args: PyTree, last: PyTree
) -> Bool[Array, ""]:
    """Whether a step with this range has made modes beyond it large; `last` is the field at y1.

    They are fast, so they stand out in the velocity at the end, and its mean rate is theirs.
    """
    h, y0, y1, last = lax.stop_gradient((jnp.abs(t1 - t0), y0, y1, last))
    direction = velocity(terms, last, y1)
    fast, moved = h * largest(direction), largest(jtu.tree_map(jnp.subtract, y1, y0))
    # Rounding of a state at rest is fast too.
    rounding = jnp.sqrt(jnp.finfo(fast.dtype).eps) * largest(y1)
    is_fast = fast > jnp.maximum(_MUCH_FASTER * moved, rounding)
    # In the middle, as the field may be another one from the end on. Seldom: in a batch too.
    rate = lax.cond(
        max_over_batch(is_fast.astype(jnp.int32)) > 0,
        lambda: h * rate_along(terms, t0 + (t1 - t0) / 2, y1, args, direction),
        lambda: jnp.zeros_like(fast),
    )
    return is_fast & (rate > range_ + _BEYOND)


def _check_fields(solver: AbstractStabilised, chart: Chart) -> None:
    name, names = type(solver).__name__, []
    fields = chart.product(chart.first_value)
    for part in filter(is_field, jtu.tree_leaves(fields, is_leaf=is_field)):
        names.append(type(part).__name__)
        if isinstance(part, AbstractSemilinearField):
            raise TypeError(
                f"{name} does not take {type(part).__name__}, whose flow has an exact stiff part: "
                "use an exponential method, for example cfjax.ETD54()."
            )
    if not is_uniform(chart):
        raise TypeError(
            f"{name} adds up the fields of all stages, and sums of "
            f"{', '.join(names) or 'these fields'} grow with their number: use cfjax.LeftMatrix "
            "for few rows, cfjax.BorderedSkew for orthonormal columns, or another method, for "
            "example cfjax.CF4()."
        )


def _weights(j: Any, s: Any, l: int, ratio: Any) -> tuple[Any, Any, Any, Any]:  # noqa: E741
    """Those of the two elements before, the field there and the first field, in stage j of s."""

    def b(j: Any) -> Any:
        factor, j = jnp.where(j == 1, ratio, 1.0), jnp.maximum(j, 2)
        return factor * (l + 1) * (j - 1) * (j + l + 1) / ((l + 3) * j * (j + l))

    mu = (2 * j + l - 2) / (j + l - 1) * b(j) / b(j - 1)
    nu = -(j - 1) / (j + l - 1) * b(j) / b(j - 2)
    of_field = mu * _slope(s, l)
    return mu, nu, of_field, (b(j - 1) - 1) * of_field


def _harmonic(s: Any, most: int) -> Any:
    """The sum of the first s of the numbers 1 / k, of not more than `most`."""
    numpy: Any = jnp if isinstance(s, jax.Array) else np
    k = numpy.arange(1, most + 1, dtype=numpy.result_type(s))
    return numpy.sum(numpy.where(k <= s, 1 / k, 0))


def _slope(s: Any, l: int) -> Any:  # noqa: E741
    return (l + 3) / ((s - 1) * (s + l + 1))


def _reach(s: Any, l: int) -> Any:  # noqa: E741
    """How far s stages are stable on the negative axis."""
    return 2 / _slope(s, l)


def _stages_for(z: Any, l: int) -> Any:  # noqa: E741
    """The number of stages that reach to -z: odd, as then what is stiffest is damped most."""
    numpy: Any = jnp if isinstance(z, jax.Array) else np
    root = numpy.sqrt((l + 2) ** 2 + 2 * z * (l + 3))
    s = numpy.maximum(numpy.ceil((root - l) / 2), 3)
    s = s + (1 - s % 2)
    return lax.stop_gradient(s) if numpy is jnp else int(s)


@jax.custom_jvp
def _reverse_mode_only(x: Array) -> Array:
    """The same array. Forward mode through it is an error."""
    return x


@_reverse_mode_only.defjvp
def _(primals, tangents):
    return primals[0], _only_transposed_p.bind(tangents[0])


def _raise(*_, **__):
    raise TypeError(
        "Forward mode needs a number of stages, for example cfjax.RKL2(stages=9), as it has no "
        "rule for a loop whose length is chosen in each step. Reverse mode has one."
    )


_only_transposed_p = Primitive("cfjax_only_transposed")
_only_transposed_p.def_impl(_raise)
_only_transposed_p.def_abstract_eval(lambda x: x)
ad.deflinear2(_only_transposed_p, lambda cotangent, _: [cotangent])
batching.defvectorized(_only_transposed_p)
mlir.register_lowering(_only_transposed_p, _raise)
