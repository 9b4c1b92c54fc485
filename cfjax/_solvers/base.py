"""The interface of Lie group methods to diffrax, and the start of a solve."""

import copy
from collections.abc import Sequence
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, PyTree, Real

from .._control_term import fault_of_increments, is_driven
from .._field import AbstractFrozenField, combine, is_field
from .._methods.order_conditions import order
from .._numerics.checks import Fault
from .._numerics.jumps import may_jump
from .._term import product, velocity
from .solver import AbstractSolver
from .sums import Sums


class _InstanceProperty(property):
    """A property of instances. On the class it is an `AttributeError` that asks for an instance."""

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None and owner is not None:
            name = owner.__name__
            raise AttributeError(f"solver must be an instance, {name}(), got the class {name}.")
        return super().__get__(instance, owner)


class AbstractLieSolver(AbstractSolver):
    """A method with fixed coefficients that moves along flows.

    It takes the geometry from what the term's vector field returns: `cfjax.LieTerm` for frozen
    fields, any other diffrax term for a linear space.

    Where the field offers increments, the sum over the steps is compensated (`sums.py`).
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    # Whether a path, such as Brownian motion, may drive a term.
    takes_noise: ClassVar[bool] = True
    # What diffrax asks a solver for first.
    term_compatible_contr_kwargs = _InstanceProperty(lambda self: {})

    @property
    def shows_failure(self) -> bool:
        return True

    def strong_order(self, terms) -> float:
        """The strong order for any noise. It is 1 if the noise commutes."""
        return 0.5

    @property
    def first_same_as_last(self) -> bool:
        """Whether the last evaluation of a step is the first one of the next step.

        It is not where the field may jump between both (`first_value`).
        """
        return False

    def init(self, terms, t0, t1, y0, args) -> "State":
        """Checks the times and the start, and returns the state of the solver.

        **Raises** a runtime error for a time that is NaN, or a start off the manifold that a field
        acts on.
        """
        state, fault = self.start(terms, t0, t1, y0, args)
        zero = fault.error(jnp.zeros((), jnp.result_type(t0)))
        return State(state.compensation, state.first, zero, kept=state.kept)

    def start(self, terms, t0, t1, y0, args) -> tuple["State", Fault]:
        # Steps of this state carry no checks: a loop reports what is wrong with the start itself,
        # with no call of the host.
        self = self.for_terms(terms)

        def field_and_compensation(y0):
            field = product(terms, terms.vf(t0, y0, args), terms.contr(t0, t1))
            return field, Sums.of(field, y0).compensation

        field, compensation = eqx.filter_eval_shape(field_and_compensation, y0)
        compensation = Sums(y0, compensation).zeros()
        first = first_value(terms, t0, t1, y0, args) if self.first_same_as_last else None
        fault = fault_of_start(t0, t1, (field,), y0)
        fault = fault_of_fields(fault, (field,), terms, t0, y0, args)
        fault = fault_of_increments(fault, terms, t0, t1, y0, args)
        return State(compensation, first, None), fault

    def for_terms(self, terms: PyTree[diffrax.AbstractTerm]) -> "AbstractLieSolver":
        """The same method for these terms: without its estimate where a path drives one of them.

        An embedded method takes the same straight line for the path in a step, so it cannot see the
        error of the noise.

        **Raises** `TypeError` if the method cannot take such terms.
        """
        if not is_driven(terms):
            return self
        if not self.takes_noise:
            raise TypeError(
                f"{type(self).__name__} does not support noise or other path-driven terms: use "
                "another method, for example cfjax.CF4() or cfjax.WeakOrder2()."
            )
        return self.without_estimate()

    def without_estimate(self) -> "AbstractLieSolver":
        return self._with(estimate=None) if hasattr(self, "estimate") else self

    def unrolled(self) -> "AbstractLieSolver":
        """The same method with its stages one by one in the program, where each can be counted."""
        return self._with(unroll=True) if hasattr(self, "unroll") else self

    def _with(self, **fields: Any) -> "AbstractLieSolver":
        solver = copy.copy(self)
        for name, value in fields.items():
            # As dataclasses do: not every solver has an `__init__` that takes its fields.
            object.__setattr__(solver, name, value)
        return solver

    def func(self, terms, t0, y0, args) -> Any:
        """The velocity at `y0`, shaped like it; for a control other than time see `velocity`."""
        return velocity(terms, terms.vf(t0, y0, args), y0)


class AbstractTableauSolver(AbstractLieSolver):
    """A method whose order is that of its tableau."""

    tableau: eqx.AbstractVar[Any]
    # The orders of the method and of its embedded one, for a named method that takes longer to
    # prove than a small step to trace. Tests prove them.
    orders: ClassVar[tuple[int, int | None] | None] = None

    def order(self, terms) -> int:
        return self.orders[0] if self.orders else order(self.tableau)

    def error_order(self, terms):
        if is_driven(terms):
            return super().error_order(terms)
        embedded = self.tableau.embedded_method
        if embedded is None:
            return None
        return (self.orders[1] if self.orders and self.orders[1] else order(embedded)) + 1


def check_choice(name: str, value: Any, *choices: Any) -> None:
    """Raises `ValueError` unless the value is one of the choices."""
    if not any(value is x or (isinstance(x, str) and value == x) for x in choices):
        texts = list(map(repr, choices))
        raise ValueError(f"{name} must be {', '.join(texts[:-1])} or {texts[-1]}, got {value!r}.")


def combine_nonzero(weights: Sequence[Any], fields: Sequence[PyTree]) -> PyTree:
    """The combination without the fields of weight zero. Either may have fewer entries."""
    terms = [(float(w), f) for w, f in zip(weights, fields, strict=False) if w != 0]
    return combine(*zip(*terms, strict=True))


def without_trailing_zeros(row: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(row[: max((k for k, x in enumerate(row, 1) if x != 0), default=0)])


def is_finite(y: PyTree) -> Bool[Array, ""]:
    return jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in jtu.tree_leaves(y)], bool).all()


def finite_if_complex(error: PyTree) -> PyTree:
    """The estimate of a step's error, with a large number where a complex one is not finite.

    For diffrax an error of NaN is infinite, so that the step is taken again, shorter. But it
    divides by the tolerance, and a complex infinity over a number is NaN, which would be the length
    of the next step.
    """

    def entries(e: Array) -> Array:
        if not jnp.iscomplexobj(e):
            return e
        # It can be divided by a small tolerance.
        return jnp.where(jnp.isfinite(e), e, float(jnp.finfo(e.dtype).max) ** 0.5)

    return jtu.tree_map(entries, error)


def size(x: Array) -> Real[Array, ""]:
    """The largest modulus of an entry."""
    return jnp.max(jnp.abs(x), initial=0)


def result_of(y: PyTree) -> diffrax.RESULTS:
    """A step that ends in infinity or NaN is a failure."""
    if not jtu.tree_leaves(y):
        return diffrax.RESULTS.successful
    nonfinite: Any = diffrax.RESULTS.nonfinite
    return diffrax.RESULTS.where(is_finite(y), diffrax.RESULTS.successful, nonfinite)


def time_at(c: Any, t0: Any, t1: Any) -> Any:
    """The time at a part c of the step, at its end exactly."""
    if isinstance(c, float):
        return t1 if c == 1 else t0 + c * (t1 - t0)
    c = jnp.asarray(c, jnp.result_type(t0))
    return jnp.where(c == 1, t1, t0 + c * (t1 - t0))


# How far within a step its first and last evaluations are, in units of rounding of the times: more
# than the two roundings of a step's end, and the two of an edge with which a field compares it.
_UNITS = 4


def evaluation_times(t0: Any, t1: Any) -> tuple[Any, Any]:
    """The times between which a step evaluates the field: its ends, some roundings within it.

    A field may jump where a step ends, as pulses in slots do. The step then takes the limit from
    within, at both ends, so a step backwards in time evaluates the field at the same times. At most
    an eighth of the step on either side, for steps that are hardly longer than a rounding.
    """
    eps = float(jnp.finfo(jnp.result_type(t0, t1, float)).eps)
    bound = _UNITS * eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    shift = lax.stop_gradient(jnp.clip((t1 - t0) / 8, -bound, bound))
    return t0 + shift, t1 - shift


def first_value(terms: PyTree, t0: Any, t1: Any, y0: PyTree, args: PyTree) -> PyTree | None:
    """The value of the field with which the first step begins, where each step hands on its last.

    None where the field may jump in time: then each step evaluates both of its ends, from within.
    """

    def field(t: Any) -> PyTree:
        return product(terms, terms.vf(t, y0, args), terms.contr(t0, t1))

    return None if may_jump(field, t0) else terms.vf(evaluation_times(t0, t1)[0], y0, args)


class State(eqx.Module):
    """The solver's state from step to step.

    - `compensation`: what rounding has cut off the parts of the state that are compensated sums.
    - `first`: the value of the field at the start of the next step, if the last step ended with it.
    - `zero`: carries the checks of the start. Every step uses it, as otherwise diffrax would drop
      it.
    - `kept`: what stays as it is at the start of the solve, or None.
    """

    compensation: PyTree
    first: PyTree
    zero: Real[Array, ""] | None
    kept: PyTree = eqx.field(default=None, kw_only=True)


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


def fault_of_fields(
    fault: Fault, fields: Sequence[PyTree], terms: Any, t0: Any, y0: PyTree, args: PyTree
) -> Fault:
    """What fields say of their values. `fields` are the same, by shape."""
    parts = filter(is_field, jtu.tree_leaves(fields, is_leaf=is_field))
    default = AbstractFrozenField.faults
    if all(type(part).faults is default for part in parts):
        return fault
    for term in terms.terms if isinstance(terms, diffrax.MultiTerm) else (terms,):
        # Not their products with the step, whose sign may be another.
        value = lax.stop_gradient(term.vf(t0, y0, args))
        for path, part in jtu.tree_leaves_with_path(value, is_leaf=is_field):
            for holds, condition in part.faults() if is_field(part) else ():
                place = f"{type(part).__name__} for y{jtu.keystr(path)}"
                fault = fault.with_case(holds, f"{place} at the start: {condition}.")
    return fault


def _off_manifold(fault: Fault, part: Any, place: str, point: PyTree) -> Fault:
    defect = part.defect(point) if is_field(part) else None
    if defect is None:
        return fault
    distance, condition = lax.stop_gradient(defect[0]), defect[1]
    # Within it one step of Newton's method, which the fields take, leads to the manifold. NaN has
    # an error of its own.
    threshold = float(np.sqrt(jnp.finfo(distance.dtype).eps))
    for level in (threshold, *(x for x in _LEVELS if x > threshold)):
        fault = fault.with_case(
            distance > level,
            f"y{place} must start on the manifold that {type(part).__name__} acts on: y0{place} "
            f"must have {condition}, and is off by more than {level:.1g}.",
        )
    return fault
