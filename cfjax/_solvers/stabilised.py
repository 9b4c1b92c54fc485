"""Stabilised methods: explicit, with as many stages as large diffusion or relaxation takes."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._control_term import is_driven
from .._field import AbstractFrozenField, combine, is_field, tangent
from .._fields.semilinear import AbstractSemilinearField
from .._methods.tableau import ContinuousExtension
from .._numerics.checks import Fault
from .base import State
from .compiled import over_stages
from .dense import Path
from .spectral_radius import FIRST_ITERATIONS, iterated, start_vector
from .stacked import cast_like
from .stages import is_uniform
from .step import AbstractChartSolver, Chart, Step

# Power iteration converges from below, and a radius that is too small by 2 % makes 41 stages
# unstable.
_SAFETY = 1.1
# The least ratio of the radius to that of the step before.
_LEAST_RATIO = 0.9


class _Iteration(NamedTuple):
    """The spectral radius, and the vector that the next power iteration begins with."""

    radius: Real[Array, ""]
    vector: PyTree


class _State(State):
    # None where the radius is not estimated.
    iteration: _Iteration | None


class AbstractStabilised(AbstractChartSolver, diffrax.AbstractAdaptiveSolver):
    """Runge-Kutta methods of many stages, each of which is one flow from the start of the step."""

    stages: int | None = eqx.field(static=True)
    spectral_radius: Any
    max_stages: int = eqx.field(static=True)
    # The length of the step at hand times the radius, where that decides.
    stiffness: Any

    # Twice the index of the Gegenbauer polynomials.
    twice_index: eqx.AbstractClassVar[int]
    # Of the combination of the elements of a step that leads to points within it.
    continuous_extension: eqx.AbstractClassVar[ContinuousExtension]

    def __init__(
        self,
        stages: int | None = None,
        *,
        spectral_radius: float | Callable[[Any, PyTree, PyTree], Any] | None = None,
        max_stages: int = 200,
    ):
        for name, value in (("stages", stages), ("max_stages", max_stages)):
            if value is None and name == "stages":
                continue
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"{name} must be an int, got {value!r}.")
            if value < 3:
                raise ValueError(f"{name} must be at least 3, got {value}.")
        if stages is not None and spectral_radius is not None:
            raise ValueError(
                "stages and spectral_radius must not be given together, as the radius decides "
                f"how many stages a step has: got {stages} and {spectral_radius!r}."
            )
        if isinstance(spectral_radius, int | float | np.generic) and not spectral_radius >= 0:
            raise ValueError(f"spectral_radius must not be negative, got {spectral_radius}.")
        self.stages = stages
        self.spectral_radius = spectral_radius
        self.max_stages = max_stages
        self.stiffness = None

    @abc.abstractmethod
    def elements(self, chart: Chart) -> "_Elements":
        """The elements of the algebra along which a step moves."""

    @property
    def first_same_as_last(self) -> bool:
        return True

    def error_order(self, terms) -> int:
        return 3

    def for_terms(self, terms):
        if is_driven(terms):
            raise TypeError(
                f"{type(self).__name__} is for ordinary differential equations, but a path drives "
                "one of the terms: use another method, for example cfjax.CF4()."
            )
        return self

    def init(self, terms, t0, t1, y0, args) -> _State:
        state, fault = self._start(terms, t0, t1, y0, args)
        zero = fault.error(jnp.zeros((), jnp.result_type(t0)))
        return _State(state.compensation, state.first, zero, state.iteration)

    def start(self, terms, t0, t1, y0, args):
        state, fault = self._start(terms, t0, t1, y0, args)
        if self.stages is None:
            # Nothing shortens an equal step.
            radius = self._radius(terms, t0, y0, args, state.iteration)
            number = _stages_for(jnp.abs(t1 - t0) * radius, self.twice_index)
            for level in (1, 2, 5, 10, 100, 1000):
                limit = level * self.max_stages
                fault = fault.with_case(
                    number > limit,
                    f"max_stages={self.max_stages} is too small: the first step takes more than "
                    f"{limit} stages. Take more steps or, with max_stages, more stages.",
                )
        return state, fault

    def _start(self, terms, t0, t1, y0, args) -> tuple[_State, Fault]:
        state, fault = super().start(terms, t0, t1, y0, args)
        iteration = None
        if self.stages is None and self.spectral_radius is None:
            vector = start_vector(y0)
            iteration = _Iteration(*iterated(terms, t0, y0, args, vector, FIRST_ITERATIONS))
        return _State(state.compensation, state.first, None, iteration), fault

    def _radius(self, terms, t0, y0, args, iteration: _Iteration | None) -> Real[Array, ""]:
        if iteration is not None:
            return _SAFETY * iteration.radius
        radius = self.spectral_radius
        return lax.stop_gradient(jnp.asarray(radius(t0, y0, args) if callable(radius) else radius))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        self.for_terms(terms)
        solver, iteration = self, solver_state.iteration
        if iteration is not None:
            radius, vector = iterated(terms, t0, y0, args, iteration.vector, 1)
            radius = jnp.maximum(radius, _LEAST_RATIO * iteration.radius)
            iteration = _Iteration(radius, vector)
        if self.stages is None:
            radius = self._radius(terms, t0, y0, args, iteration)
            solver = self._with(stiffness=jnp.abs(t1 - t0) * radius)
        y1, error, dense_info, state, result = super(AbstractStabilised, solver).step(
            terms, t0, t1, y0, args, solver_state, made_jump
        )
        state = _State(state.compensation, state.first, state.zero, iteration)
        return y1, error, dense_info, state, result

    def step_in(self, chart):
        _check_fields(self, chart)
        elements = self.elements(chart)
        end = chart.start
        for element in elements.flows:
            end = chart.flow(element, end)
        value = chart.value_at(1.0, end)
        last = chart.frozen(value, end, [chart.first_field])
        error = tangent(elements.error(last), chart.state(end))
        # NaN is an infinite error to diffrax, so that the step is taken again, shorter.
        y1, error = jtu.tree_map(
            lambda x: x + elements.zero.astype(jnp.finfo(x.dtype).dtype), (chart.end(end), error)
        )
        path = Path.of(
            self.continuous_extension,
            chart.origin,
            [chart.first_field, *elements.flows, last],
        )
        return Step(y1, path, error, value)

    def _element(
        self, chart: Chart, first: PyTree, point: PyTree, c: float = 0.0, length: float = 1.0
    ) -> "_Element":
        """The element that leads from a point, at time c and with the field `first`, over such a
        part of the step.
        """
        l = self.twice_index  # noqa: E741
        first = combine((length,), (first,)) if length != 1 else first
        is_chosen = self.stages is None
        if is_chosen:
            wanted = _stages_for(length * self.stiffness, l)
            is_possible = wanted <= self.max_stages
            number = jnp.where(is_possible, wanted, 1)
            zero = jnp.where(is_possible, jnp.zeros(()), jnp.nan)
        else:
            # As many as reach as far, in a part of the step.
            number = self.stages if length == 1 else _stages_for(length * _reach(self.stages, l), l)
            zero = jnp.zeros(())

        def stage(j: Any, carry: Any) -> Any:
            u, u_before, time, time_before = carry
            field = chart.field(c + length * time, chart.flow(u, point), [chart.first_field])
            field = combine((length,), (field,)) if length != 1 else field
            weights = _weights(j, number, l)
            new = combine(weights, (u, u_before, cast_like(first, field), first))
            new_time = weights[0] * time + weights[1] * time_before + weights[2] + weights[3]
            return cast_like(first, new), u, new_time, time

        w = _first_weight(number, l)
        zeros = jnp.zeros_like(w)
        carry = combine((w,), (first,)), combine((zeros,), (first,)), w, zeros
        if not is_chosen:
            turns = np.arange(2.0, number + 1)
            carry, _ = over_stages(lambda carry, j: (stage(j, carry), None), carry, turns)
            return _Element(carry[0], zero)
        # A loop of no more turns than there are stages.
        j = jnp.full_like(w, 2)
        _, carry = eqxi.while_loop(
            lambda value: value[0] <= number,
            lambda value: (value[0] + 1, stage(*value)),
            (j, carry),
            max_steps=self.max_stages,
            kind="checkpointed",
        )
        return _Element(carry[0], zero)


class _Element(NamedTuple):
    """An element of the algebra, and a zero, which is NaN if it takes too many stages."""

    element: PyTree
    zero: Real[Array, ""]


class _Elements(NamedTuple):
    """Elements along which a step moves, one after the other; the element of the estimate, from
    the field at the end; and a zero, which is NaN if the step takes too many stages.
    """

    flows: list[PyTree]
    error: Callable[[PyTree], PyTree]
    zero: Real[Array, ""]


class _OneElement(AbstractStabilised):
    continuous_extension: ClassVar[ContinuousExtension] = (((1, 0, 0), (-2, 3, -1), (1, -2, 1)),)

    def order(self, terms) -> int:
        return 2

    def elements(self, chart):
        first = chart.first_field
        u, zero = self._element(chart, first, chart.start)
        return _Elements([u], lambda last: combine((-0.8, 0.4, 0.4), (u, first, last)), zero)


class RKL2(_OneElement):
    twice_index: ClassVar[int] = 1


class RKG2(_OneElement):
    twice_index: ClassVar[int] = 3


class RKL3(AbstractStabilised):
    twice_index: ClassVar[int] = 1
    continuous_extension: ClassVar[ContinuousExtension] = (
        ((1, 0, 0, 0), (-2, 3, 0, -1), (1, -2, 0, 1)),
        ((0, 0, 0, 0), (0, 0, 3, 0), (0, 0, -2, 0)),
    )

    def order(self, terms) -> int:
        return 3

    def elements(self, chart):
        first, start = chart.first_field, chart.start
        u, zero = self._element(chart, first, start)
        v1, zero1 = self._element(chart, first, start, 0.0, 0.5)
        middle = chart.flow(v1, start)
        field = chart.field(0.5, middle, [first])
        v2, zero2 = self._element(chart, field, middle, 0.5, 0.5)
        flows = [combine((4 / 3, -1 / 6), (v, u)) for v in (v1, v2)]
        error = combine((1 / 3, 1 / 3, -1 / 3), (v1, v2, u))
        return _Elements(flows, lambda last: error, zero + zero1 + zero2)


def _check_fields(solver: AbstractStabilised, chart: Chart) -> None:
    name = type(solver).__name__
    for part in jtu.tree_leaves(chart.first_field, is_leaf=is_field):
        if isinstance(part, AbstractSemilinearField):
            raise TypeError(
                f"{name} does not take {type(part).__name__}, whose flow has an exact stiff part: "
                "use an exponential method, for example cfjax.ETD54()."
            )
    if not is_uniform(chart):
        raise TypeError(
            f"{name} adds up the fields of all its stages, and the sums of these, "
            "would grow with each: ... use cfjax.LeftMatrix or BorderedSkew"
        )


def _weights(j: Any, s: Any, l: int) -> tuple[Any, Any, Any, Any]:  # noqa: E741
    """Those of the two elements before, the field there and the first field, in stage j of s."""

    def b(j: Any) -> Any:
        j = jnp.maximum(j, 2)
        return (l + 1) * (j - 1) * (j + l + 1) / ((l + 3) * j * (j + l))

    mu = (2 * j + l - 2) / (j + l - 1) * b(j) / b(j - 1)
    nu = -(j - 1) / (j + l - 1) * b(j) / b(j - 2)
    of_field = mu * _slope(s, l)
    return mu, nu, of_field, (b(j - 1) - 1) * of_field


def _first_weight(s: Any, l: int) -> Array:  # noqa: E741
    """The time of the first stage, and the weight of the first field there."""
    return jnp.asarray((l + 1) / (2 * (l + 2)) * _slope(s, l), float)


def _slope(s: Any, l: int) -> Any:  # noqa: E741
    return (l + 3) / ((s - 1) * (s + l + 1))


def _reach(s: Any, l: int) -> Any:  # noqa: E741
    """How far s stages are stable on the negative axis."""
    return 2 / _slope(s, l)


def _stages_for(z: Any, l: int) -> Any:  # noqa: E741
    """The number of stages that reach to -z: odd, as then what is stiffest is damped most."""
    numpy: Any = jnp if isinstance(z, Array) else np
    root = numpy.sqrt((l + 2) ** 2 + 2 * z * (l + 3))
    s = numpy.maximum(numpy.ceil((root - l) / 2), 3)
    s = s + (1 - s % 2)
    return lax.stop_gradient(s) if numpy is jnp else int(s)
