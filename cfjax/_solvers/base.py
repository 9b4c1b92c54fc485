"""What all Lie group methods are to diffrax: one-step maps made of flows."""

import abc
import copy
import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, PyTree, Real

from .._control_term import fault_of_increments, is_driven
from .._field import is_field
from .._numerics.checks import Fault
from .._term import product, velocity
from .chart import Chart
from .compensation import added, at, no_compensation, zeros
from .compiled import (
    computed_again,
    control_of,
    materialised_in_rows,
    scalarised,
    shared_end,
)
from .dense import AbstractPath, Interpolation


class _OfInstances(property):
    """A property that tells those who ask the class for it that they forgot the brackets.

    An `AttributeError`, as for any other attribute that a class does not have.
    """

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None and owner is not None:
            name = owner.__name__
            raise AttributeError(f"solver must be an instance, {name}(), got the class {name}.")
        return super().__get__(instance, owner)


class AbstractLieSolver(diffrax.AbstractSolver):
    """A method with fixed coefficients that moves along flows.

    It takes the geometry from what the term's vector field returns: `cfjax.LieTerm` for frozen
    fields, any other diffrax term for a linear space.

    Where the field offers increments, the sum over the steps is compensated (`compensation.py`).
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    # What diffrax asks a solver for first.
    term_compatible_contr_kwargs = _OfInstances(lambda self: {})

    @property
    def is_symmetric(self) -> bool:
        """Whether a step backwards in time undoes one forwards, but for rounding."""
        return False

    @property
    def shows_failure(self) -> bool:
        """Whether a step that fails ends in what is not finite, so that its result says no more."""
        return True

    def strong_order(self, terms) -> float:
        """That of any noise. It is 1 if the noise commutes."""
        return 0.5

    @property
    def first_same_as_last(self) -> bool:
        """Whether the last evaluation of a step is the first one of the next step."""
        return False

    def init(self, terms, t0, t1, y0, args) -> "State":
        """Checks the times and the start, and makes the state of the solver.

        **Raises** a runtime error for a time that is NaN, or a start off the manifold that a field
        acts on.
        """
        state, fault = self.start(terms, t0, t1, y0, args)
        zero = fault.error(jnp.zeros((), jnp.result_type(t0)))
        return State(state.compensation, state.first, zero)

    def start(self, terms, t0, t1, y0, args) -> tuple["State", Fault]:
        """The state of the solver, whose steps carry no checks, and what is wrong with the start.

        That is for a loop which reports it itself, with no call of the host.
        """
        self = self.for_terms(terms)

        def at_start(y0):
            field = product(terms, terms.vf(t0, y0, args), terms.contr(t0, t1))
            return field, no_compensation(field, y0)

        field, compensation = eqx.filter_eval_shape(at_start, y0)
        compensation = zeros(compensation, y0)
        first = terms.vf(t0, y0, args) if self.first_same_as_last else None
        fault = fault_of_start(t0, t1, (field,), y0)
        fault = fault_of_increments(fault, terms, t0, t1, y0, args)
        return State(compensation, first, None), fault

    def for_terms(self, terms: PyTree[diffrax.AbstractTerm]) -> "AbstractLieSolver":
        """The same method for these terms: without its estimate where a path drives one of them.

        It would compare two methods on the same chord of the path, and not see that the path is
        not straight.

        **Raises** `TypeError` if the method cannot take such terms.
        """
        return self.without_estimate() if is_driven(terms) else self

    def without_estimate(self) -> "AbstractLieSolver":
        """The same method for steps that nobody controls: it keeps nothing for an estimate."""
        return self._with(estimate=None) if hasattr(self, "estimate") else self

    def unrolled(self) -> "AbstractLieSolver":
        """The same method with its stages one by one in the program, where each can be counted."""
        return self._with(unroll=True) if hasattr(self, "unroll") else self

    def _with(self, **fields: Any) -> "AbstractLieSolver":
        changed = copy.copy(self)
        for name, value in fields.items():
            # As dataclasses do. Not every solver is made from its fields.
            object.__setattr__(changed, name, value)
        return changed

    def func(self, terms, t0, y0, args) -> Any:
        """The velocity at `y0`, shaped like it. A control that is not time has diffrax's own."""
        return velocity(terms, terms.vf(t0, y0, args), y0)


class AbstractChartSolver(AbstractLieSolver):
    """A method whose step is one chart: flows of combinations of the fields in it."""

    # Whether it evaluates the field at points of the step.
    is_of_state: ClassVar[bool] = True

    interpolation_cls: ClassVar[Callable[..., diffrax.AbstractLocalInterpolation]] = Interpolation

    @abc.abstractmethod
    def step_in(self, chart: Chart) -> "Step":
        """A step from `chart.start`, with the fields that `chart.frozen` evaluates."""

    def interval(self, t0: Any, t1: Any) -> tuple[Any, Any]:
        """Two times that are as far apart as the ends of the step."""
        return t0, t1

    def extended(self, path: Any, field: Callable[[Any, PyTree], PyTree]) -> AbstractPath:
        """The way of a step with what only output within it takes.

        `field(c, y)` is `h f(t + c h, y)`. Apart from `step_in`, which is compiled whether anybody
        asks for that or not.
        """
        return path

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        # Not where times are known.
        step = _step_once if isinstance(t0, Tracer) else AbstractChartSolver._step
        solver: Any = self.for_terms(terms)
        return step(solver, terms, t0, t1, y0, args, solver_state, made_jump)

    def _step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        compensation = solver_state.compensation
        t0, first = begun(solver_state, t0, lambda t0: terms.vf(t0, y0, args), made_jump)

        def evaluate(c: float | Real[Array, ""], y: PyTree) -> PyTree:
            return materialised_in_rows(terms.vf(time_at(c, t0, t1), y, args))

        def stepped(y0):
            control = control_of(terms, *self.interval(t0, t1))
            values = []

            def field(c: float | Real[Array, ""], y: PyTree) -> PyTree:
                if values or first is None:
                    values.append(evaluate(c, y))
                else:
                    values.append(first)
                return product(terms, values[-1], control)

            step = self.step_in(Chart(field, y0, compensation))
            end, error = step.end, step.error
            if not step.is_shared:
                end, error = shared_end(compensation, end, error, is_followed=first is not None)
            if first is None:
                last = None
            elif self.is_of_state:
                # From the end alone, which is one evaluation more.
                there = functools.partial(evaluate, 1.0, at(y0, end, compensation))
                last = computed_again(values[-1], there)
            else:
                last = values[-1]
            return (end, last, error), step.path

        y1, error, path, state, result = ended(solver_state, stepped, y0)
        path = self.extended(path, lambda c, y: product(terms, evaluate(c, y), terms.contr(t0, t1)))
        return y1, error, dict(path=path), state, result


class Step(eqx.Module):
    """A step: where it ends, the way there for output within it, and an estimate of its error.

    `is_shared` says that the end is materialised, with all that the estimate is made of.
    """

    end: PyTree
    path: AbstractPath
    error: PyTree = None
    is_shared: bool = eqx.field(static=True, default=False)


def check_choice(name: str, value: Any, *choices: Any) -> None:
    """Raises `ValueError` unless the value is one of the choices."""
    if not any(value is x or (isinstance(x, str) and value == x) for x in choices):
        texts = list(map(repr, choices))
        raise ValueError(f"{name} must be {', '.join(texts[:-1])} or {texts[-1]}, got {value!r}.")


def is_finite(y: PyTree) -> Bool[Array, ""]:
    return jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in jtu.tree_leaves(y)], bool).all()


def size(x: Array) -> Real[Array, ""]:
    """The largest modulus of an entry."""
    return jnp.max(jnp.abs(x), initial=0)


def result_of(y: PyTree) -> diffrax.RESULTS:
    """A step that ends in infinity or NaN is a failure."""
    if not jtu.tree_leaves(y):
        return diffrax.RESULTS.successful
    nonfinite: Any = diffrax.RESULTS.nonfinite
    return diffrax.RESULTS.where(is_finite(y), diffrax.RESULTS.successful, nonfinite)


def time_at(c: float | Real[Array, ""], t0: Any, t1: Any) -> Any:
    """The time at a part c of the step, at its end exactly: the field may jump there."""
    if isinstance(c, float):
        return t1 if c == 1 else t0 + c * (t1 - t0)
    c = jnp.asarray(c, jnp.result_type(t0))
    return jnp.where(c == 1, t1, t0 + c * (t1 - t0))


def begun(
    solver_state: "State", t0: Any, evaluate: Callable[[Any], PyTree], made_jump: Any
) -> tuple[Any, PyTree]:
    """The time of a step, NaN if the start was wrong, and the field there if that is known."""
    first = solver_state.first
    if solver_state.zero is not None:
        # Of a weak type, if the time is.
        t0 = jnp.where(solver_state.zero == 0, t0, jnp.nan)
    if first is None or made_jump is False:
        return t0, first
    if made_jump is True:
        return t0, evaluate(t0)
    return t0, lax.cond(made_jump, evaluate, lambda _: first, t0)


def ended(
    solver_state: "State", stepped: Callable[[PyTree], Any], y0: PyTree
) -> tuple[PyTree, PyTree, Any, "State", diffrax.RESULTS]:
    """The state after a step, the estimate of its error, what output within it takes, the solver's
    state, and the result.

    `stepped(y0)` is a pair. First is the end, an increment where the state is a compensated sum,
    with the field that the next step begins with and the estimate, or None for these. Second is
    what output takes.
    """
    (end, first, error), within = scalarised(stepped, y0, is_pair=True)
    y1, compensation = added(y0, end, solver_state.compensation)
    return y1, error, within, State(compensation, first, solver_state.zero), result_of(y1)


class State(eqx.Module):
    """What a solver keeps from step to step.

    - `compensation`: what rounding has cut off the parts of the state that are compensated sums.
    - `first`: the field at the start of the next step, where the last evaluation was there.
    - `zero`: carries the checks of the start. Every step needs it, as diffrax drops what no step
      uses.
    """

    compensation: PyTree
    first: PyTree
    zero: Real[Array, ""] | None


# By how much a start is off, in the message. The error itself may be in a compiled program.
_LEVELS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0)


def fault_of_start(t0: Any, t1: Any, fields: Sequence[PyTree], y0: PyTree) -> Fault:
    """Whether a time is NaN or `y0` off the manifold of a field. The fields are given by shape."""
    is_nan = jnp.isnan(t0) | jnp.isnan(t1)
    fault = Fault.none().with_case(is_nan, "t0, t1 and dt0 must be numbers, got NaN.")
    for field in fields:
        parts, treedef = jtu.tree_flatten_with_path(field, is_leaf=is_field)
        for (path, part), point in zip(parts, treedef.flatten_up_to(y0), strict=True):
            fault = _off_manifold(fault, part, jtu.keystr(path), point)
    return fault


def _off_manifold(fault: Fault, part: Any, place: str, point: PyTree) -> Fault:
    defect = part.defect(point) if is_field(part) else None
    if defect is None:
        return fault
    off, expected = lax.stop_gradient(defect[0]), defect[1]
    # Within it one step of Newton's method, which the fields take, leads to the manifold. NaN has
    # an error of its own.
    least = float(np.sqrt(jnp.finfo(off.dtype).eps))
    for x in (least, *(level for level in _LEVELS if level > least)):
        fault = fault.with_case(
            off > x,
            f"y{place} must start on the manifold that {type(part).__name__} acts on: y0{place} "
            f"must have {expected}, and is off by more than {x:.1g}.",
        )
    return fault


# diffrax traces a step three times, which takes longer than all else that it traces. Inline, the
# program is as if traced anew. Newer JAX has two ways for that, and with True it leaves a call in
# the program. (equinox hands on what it does not know to `jax.jit`.)
_kinds = getattr(jax, "Inline", None)
_inline: Any = True if _kinds is None else _kinds.JAX_EARLY
_step_once = eqx.filter_jit(AbstractChartSolver._step, inline=_inline)  # pyright: ignore[reportCallIssue]
