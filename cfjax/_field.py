"""Frozen vector fields: the one thing a commutator-free method needs to know of a manifold."""

import abc
import functools
import inspect
import warnings
from collections.abc import Sequence
from fractions import Fraction
from math import factorial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree, Real

from ._arrays import Weight, check_coordinates, describe, linear_combination, struct


class AbstractFrozenField(eqx.Module):
    """A vector field of the frame, with coefficients frozen at one point.

    A method needs two things (Celledoni, Marthinsen & Owren 2003, Section 2): the flow of the
    field, and linear combinations with other fields of the same frame. A subclass defines:

    - `flow(point)`: where the field carries `point` in unit time, shaped like `point`;
    - `tangent(point)`: the velocity of that flow at `point`, shaped like `point`;
    - `combine(weights, fields)`: by default linear in every array of the class. Override it where
      an array is structure (a spectrum, a factor) instead of a coordinate.

    `flow` and `tangent` must accept the zero field. `cfjax.check_field` checks whether a class does
    all of this.

    The point is one array. A class that acts on several parts of the state together sets
    `acts_on_subtree = True`. Then its point, and what `flow` and `tangent` return, is the pytree of
    these parts, at the place of the field in the state.

    A class may also work in its own coordinates within a step, a chart, if that is cheaper. It then
    overrides `to_chart` and `from_chart` too.
    """

    # Whether the point that the field acts on is a pytree instead of one array.
    acts_on_subtree: ClassVar[bool] = False

    # Whether a flow is arithmetic entry by entry, which the compiler may do several times.
    is_entrywise: ClassVar[bool] = False

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        if "acts_on_subtree" in vars(cls):
            # With an annotation it would be a field of the dataclass, and a leaf of the pytree.
            annotation = inspect.get_annotations(cls).get("acts_on_subtree", ClassVar)
            if "ClassVar" not in str(annotation):
                raise TypeError(
                    f"{cls.__name__}.acts_on_subtree must belong to the class and not to its "
                    "instances: write `acts_on_subtree = True`, without an annotation or with "
                    f"`typing.ClassVar[bool]`, got the annotation {annotation!r}."
                )
        for old, new in (("enter", "to_chart"), ("leave", "from_chart")):
            if old in vars(cls):
                warnings.warn(
                    f"{cls.__name__}.{old} is deprecated: the method is called {new} now.",
                    DeprecationWarning,
                    stacklevel=2,
                )
                setattr(cls, new, vars(cls)[old])

    @abc.abstractmethod
    def flow(self, point: Any) -> Any:
        """The point that `point` reaches in unit time; shaped like `point`."""

    @abc.abstractmethod
    def tangent(self, point: Any) -> Any:
        """The ambient velocity at `point`, the derivative of the flow at time zero."""

    # diffrax's explicit methods try the first, its implicit ones the second (`field**ω`), and their
    # own errors say nothing of the cause.
    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError(self._not_an_array_message())

    def __pow__(self, other: Any) -> Any:
        raise TypeError(self._not_an_array_message())

    def _not_an_array_message(self) -> str:
        return (
            f"{type(self).__name__} is a frozen vector field and not an array. A solver of linear "
            "spaces cannot take it: use a method of cfjax, for example cfjax.CF4(), or give the "
            "velocity as an array."
        )

    def increment(self, point: Any) -> Any:
        """`flow(point) - point`, with a rounding error as small as the increment, or None.

        A class that defines it gets compensated summation over the steps
        (`_solvers/sums.py`). Do not define it for a field whose flow keeps signs or
        relative accuracy: the sum of point and increment keeps absolute accuracy only. None, the
        default, means no compensation.
        """
        return None

    def mean(self, point: Any) -> Any:
        """The mean of the flow from `point` over unit time, for `cfjax.ImplicitMidpoint`.

        By default the point in the middle of the flow. For a linear field `x' = a x` the two differ
        by `a^2 x / 24` and higher powers. With the mean itself that method keeps more invariants.
        """
        return type(self).combine((0.5,), (self,)).flow(point)

    def framed(self, point: Any) -> Any:
        """What has the same velocity at `point`, in the coordinates of variations.

        `cfjax.VariationTerm` writes a variation of a point in the coordinates, all arrays, of what
        this returns:

        - an algebra element that moves every point freely, as a rotation moves attitudes: no
          element but zero has velocity zero at a point. It has an own angular velocity, or what
          its coordinates are, for each element of leading axes;
        - by default the velocity, which is an array.

        It must be linear in the field. `cfjax.check_field` checks this.
        """
        return self.tangent(point)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> Any:
        """The field `sum_i weights[i] * fields[i]`. Weights are real scalars.

        **Raises** `TypeError` if a leaf of the class is not a floating or complex array, or fields
        differ in more than these.
        """
        for path, leaf in jtu.tree_leaves_with_path(fields[0]):
            check_coordinates(f"{cls.__name__}{jtu.keystr(path)}", leaf)
        treedef = jtu.tree_structure(fields[0])
        if any(jtu.tree_structure(field) != treedef for field in fields[1:]):
            texts = " and ".join(dict.fromkeys(map(describe, fields)))
            raise TypeError(f"Fields that are added must agree in all but arrays, got {texts}.")
        return jtu.tree_map(lambda *leaves: linear_combination(weights, leaves), *fields)

    def defect(self, point: Any) -> tuple[Real[Array, ""], str] | None:
        """How far `point` is off the manifold that such fields act on, and what it must satisfy.

        None, the default, if the fields act on every point. A solve refuses a start that is off by
        more than the root of a unit of rounding. It calls this method of a field whose arrays are
        shapes and dtypes.
        """
        del point
        return None

    def faults(self) -> Sequence[tuple[Bool[Array, ""], str]]:
        """What may be wrong with the values of this field: whether it is, and what must hold.

        By default nothing. A solve calls it for the fields at its start, and raises an error where
        one of these is true.
        """
        return ()

    def to_chart(self, point: Any, earlier: Sequence[Any]) -> tuple["AbstractFrozenField", Any]:
        """This field and the point where it is frozen, in the chart of the step.

        A solver calls it after every evaluation. `earlier` has the fields of this step that are
        already in the chart. At the first evaluation `earlier` is empty and `point` is the state
        itself. All flows of the step start from the point that this first call returns, so it can
        correct drift. By default nothing changes.
        """
        del earlier
        return self, point

    def projected(self, point: Any) -> "AbstractCoordinates | None":
        """This field at a point in plain space, for `cfjax.Projected`.

        The point need not be on the manifold. A class of your own returns
        `cfjax.Nearest(self.tangent(point), nearest)`, where `nearest(point)` is the point of the
        manifold nearest to another point; or what another field returns. None, the default, if
        there is none.
        """
        del point
        return None

    def cayley(self, point: Any) -> "AbstractCoordinates | None":
        """This field at a point, for `cfjax.RKMK(..., coordinates="cayley")`; or None, the default.

        A class that stands for a matrix can return that of its matrix, for example
        `cfjax.LeftMatrix(a).cayley(point)`.
        """
        del point
        return None

    def room(self, point: Any, num_fields: int) -> Any:
        """A chart of the step with room for so many fields, of which this is the first.

        For a loop over the stages, whose arrays must not grow: `cfjax._fields.low_rank.Room` is
        one. None, the default, if it has none. This field and `point` are in the chart of the step.
        """
        del point, num_fields
        return None

    def from_chart(self, point: Any) -> Any:
        """The state at a point of the chart, for a field in the chart. By default the point."""
        return point


class AbstractAlgebraElement(AbstractFrozenField):
    """A frozen field from a set that is closed under the bracket: an element of a Lie algebra.

    Munthe-Kaas methods accept only fields that are algebra elements in the chart of a step: these
    fields, and fields whose `to_chart` returns such an element. An example is `cfjax.LowRankSkew`,
    which has a bracket only together with the point where it is frozen.

    The bracket is normalised so that `y = exp(u) p` has
    `u' = v - [u, v]/2 + [u, [u, v]]/12 - ...` for the field v at y. In terms of the tangents X_a
    and X_b as functions of the point, `X_[a,b] = DX_a X_b - DX_b X_a`. So a matrix that acts from
    the left has `[a, b] = ab - ba`, and one that acts from the right `[a, b] = ba - ab`.
    """

    @abc.abstractmethod
    def bracket(self, other: Any) -> "AbstractAlgebraElement":
        """The bracket `[self, other]` with another element of the same class."""

    def dexpinv(self, other: Any, degree: int) -> "AbstractAlgebraElement":
        """The inverse derivative of the exponential at u, `self`, of v, `other`: the u' above.

        By default this is the series `sum_k B_k / k! ad_u^k(v)` with Bernoulli numbers B_k, up to k
        equal to `degree`, which takes as many brackets. A class whose algebra has a closed form
        overrides it, and the result is exact whatever the degree. The map has poles where an
        eigenvalue of `ad_u` is a multiple of 2 pi i, for rotations at full turns. The series
        converges up to the first pole. From there on the result must be finite, and means nothing:
        `has_dexpinv` says so.
        """
        weights, terms, term = [1.0], [other], other
        # The series has no odd terms but the first.
        for k in range(1, 1 + (degree if degree < 2 else degree // 2 * 2)):
            term = self.bracket(term)
            if k == 1 or k % 2 == 0:
                weights.append(float(_bernoulli(k) / factorial(k)))
                terms.append(term)
        return type(terms[-1]).combine(weights, terms)

    def has_dexpinv(self) -> Bool[Array, ""] | None:
        """Whether `dexpinv` at this element, for all its leading axes, has a value.

        A Munthe-Kaas step that needs a value where there is none fails. None, the default, if
        nothing is known, as of a series.
        """
        return None


class AbstractCoordinates(AbstractFrozenField):
    """A field in coordinates of a step in which sums of fields are sums of coordinates.

    A sum u of such fields leads to the point `flow(start)`, with `increment` as in other fields.
    `tangent` is the velocity of the field. The methods below are for parts without leading axes.
    """

    # Whether `rate` needs the start.
    is_rate_of_start: ClassVar[bool] = False

    def rate(self, field: Any, start: Any) -> Any:
        """How u, `self`, changes where the point to which it leads from `start` moves with `field`.

        By default as the field, for coordinates in which a point is the start plus a sum.
        """
        del start
        return field

    def has_rate(self) -> Bool[Array, ""] | None:
        """Whether `rate` at u has a value; None, the default, if it always has."""
        return None

    @abc.abstractmethod
    def landing(self, start: Any) -> tuple[Any, Bool[Array, ""]]:
        """By how much the step leads from a start on the manifold to an end on it; and whether
        there is such an end.
        """

    def kept(self, start: Any) -> PyTree[Array] | None:
        """What the ends of all steps have in common with the start of a solve, which `keeping`
        takes; None, the default, where each step keeps what there is at its own start.
        """

    def keeping(self, kept: PyTree[Array]) -> Any:
        """The same coordinates, whose `landing` restores what is kept.

        In single precision rounding would otherwise add up, as it is alike in steps that are alike.
        """
        raise NotImplementedError


class Rest(AbstractAlgebraElement):
    """The field of a part of the state that a term does not move: there a user writes None.

    It is added to fields of every kind.
    """

    acts_on_subtree = True

    def flow(self, point: PyTree) -> PyTree:
        return point

    def tangent(self, point: PyTree) -> PyTree:
        return jtu.tree_map(jnp.zeros_like, point)

    def mean(self, point: PyTree) -> PyTree:
        return point

    def increment(self, point: PyTree) -> PyTree:
        # Another term may make a compensated sum of this part.
        return self.tangent(point)

    def bracket(self, other: "Rest") -> "Rest":
        return self


def is_field(x: Any) -> bool:
    return isinstance(x, AbstractFrozenField)


def flow(field: PyTree, point: PyTree) -> PyTree:
    """Carries `point` along `field` for unit time.

    `field` is a pytree whose structure is a prefix of `point`'s. An array in it is a constant
    field, whose flow is a translation; an `AbstractFrozenField` acts on the part of `point` at the
    same place. A part with None does not move.
    """

    def flow_leaf(f, p):
        if f is None:
            return p
        if not is_field(f):
            return p + f
        end = f.flow(p)
        # A point in the chart of a step may come back with more coordinates.
        is_state = f.acts_on_subtree or jtu.all_leaves([p])
        if is_state and struct(end) != struct(p):
            raise ValueError(
                f"{type(f).__name__}.flow must return what is shaped like its point, "
                f"{describe(p)}, got {describe(end)}. Shape and dtype must agree."
            )
        return end

    return jtu.tree_map(flow_leaf, field, point, is_leaf=_is_field_or_none)


def tangent(field: PyTree, point: PyTree) -> PyTree:
    """The velocity of `field` at `point`, in the ambient space. Structures as in `flow`."""

    def velocity(f, p):
        if f is None:
            return jtu.tree_map(jnp.zeros_like, p)
        return f.tangent(p) if is_field(f) else f

    return jtu.tree_map(velocity, field, point, is_leaf=_is_field_or_none)


def _is_field_or_none(x: Any) -> bool:
    return x is None or is_field(x)


def combine(weights: Sequence[Weight], fields: Sequence[PyTree]) -> PyTree:
    """The field `sum_i weights[i] * fields[i]`, for fields of one structure.

    The weights are real scalars. They take the precision of the field, so a step in float64
    does not promote a field in float32.

    **Raises** `TypeError` if the fields have different structures, or different classes in a part.
    """
    parts, treedef = jtu.tree_flatten_with_path(fields[0], is_leaf=is_field)
    try:
        later_parts = [treedef.flatten_up_to(field) for field in fields[1:]]
    except ValueError as error:
        structures = [describe(jtu.tree_map(_name, f, is_leaf=is_field)) for f in fields]
        raise TypeError(
            f"Only fields of one structure can be added, got {' and '.join(structures)}."
        ) from error

    def combine_part(path: Any, *leaves: Any) -> Any:
        pairs = [(w, x) for w, x in zip(weights, leaves, strict=True) if not isinstance(x, Rest)]
        if not pairs:
            return leaves[0]
        part_weights, leaves = zip(*pairs, strict=True)
        if len({_combining_class(leaf) for leaf in leaves}) > 1:
            names = " and ".join(dict.fromkeys(map(_name, leaves)))
            place = jtu.keystr(path) and f" at {jtu.keystr(path)}"
            advice = _motion_advice(leaves)
            raise TypeError(
                f"Only fields of one kind can be added, got {names}{place}.{advice} If these are "
                "the terms of a diffrax.MultiTerm that move different parts of the state, return "
                "None for the part that a term does not move."
            )
        if is_field(leaves[0]):
            return type(leaves[0]).combine(part_weights, leaves)
        check_coordinates("A translation", leaves[0])
        return linear_combination(part_weights, leaves)

    columns = zip(parts, *later_parts, strict=True)
    return treedef.unflatten(combine_part(path, part, *later) for (path, part), *later in columns)


def _motion_advice(parts: Sequence[Any]) -> str:
    if {_name(part) for part in parts} != {"Rotation", "a translation"}:
        return ""
    return (
        " For points that turn and move return one field for both, "
        'cfjax.RigidMotion(omega=omega, v=v, frame="fixed").'
    )


def _name(x: Any) -> str:
    return type(x).__name__ if is_field(x) else "a translation"


def _combining_class(x: Any) -> Any:
    """The class of a field, or that from which it has inherited its own `combine`."""
    if not is_field(x):
        return None
    owner = next(c for c in type(x).__mro__ if "combine" in vars(c))
    return type(x) if owner is AbstractFrozenField else owner


def has_default_combine(cls: Any) -> bool:
    return cls.combine.__func__ is vars(AbstractFrozenField)["combine"].__func__


def bracket(a: PyTree, b: PyTree) -> PyTree:
    """The bracket `[a, b]` part by part. Translations commute.

    **Raises** `TypeError` if a part is a frozen field without a bracket, or only one of the two
    parts is a frozen field.
    """

    def bracket_leaf(x, y):
        if is_field(x) != is_field(y):
            raise TypeError(
                f"Cannot compute the bracket of {type(x).__name__} and {type(y).__name__}: a "
                "frozen field has none with a translation."
            )
        if isinstance(x, AbstractAlgebraElement):
            return x.bracket(y)
        if is_field(x):
            raise TypeError(no_bracket_message(x))
        return jnp.zeros_like(x)

    return jtu.tree_map(bracket_leaf, a, b, is_leaf=is_field)


def dexpinv(a: PyTree, b: PyTree, degree: int) -> PyTree:
    """The inverse derivative of the exponential at a, of b, part by part; `degree` for series.

    For translations it is the identity. The parts are translations or algebra elements.
    """
    return jtu.tree_map(
        lambda x, y: x.dexpinv(y, degree) if is_field(x) else y, a, b, is_leaf=is_field
    )


def has_dexpinv(a: PyTree) -> Bool[Array, ""] | None:
    """Whether `dexpinv` at a has a value in all parts; None if nothing is known of any part."""
    return _all_of([x.has_dexpinv() for x in jtu.tree_leaves(a, is_leaf=is_field) if is_field(x)])


def _all_of(flags: Sequence[Bool[Array, ""] | None]) -> Bool[Array, ""] | None:
    """Whether all that are known are true; None if none is known."""
    known = [x for x in flags if x is not None]
    return functools.reduce(jnp.logical_and, known) if known else None


@functools.cache
def _bernoulli(n: int) -> Fraction:
    """Bernoulli numbers with `B_1 = -1/2`, by the Akiyama-Tanigawa recursion."""
    row = [Fraction(1, m + 1) for m in range(n + 1)]
    for k in range(n, 0, -1):
        row = [(j + 1) * (row[j] - row[j + 1]) for j in range(k)]
    return -row[0] if n == 1 else row[0]


def to_chart(field: PyTree, point: PyTree, earlier: Sequence[PyTree]) -> tuple[PyTree, ...]:
    """`field` and the point where it is frozen, in the chart of a step, part by part."""
    parts, treedef = jtu.tree_flatten(field, is_leaf=is_field)
    columns = [treedef.flatten_up_to(tree) for tree in (point, *earlier)]
    charted = [
        f.to_chart(p, part_earlier) if is_field(f) else (f, p)
        for f, p, *part_earlier in zip(parts, *columns, strict=True)
    ]
    # A state may have no parts.
    return tuple(treedef.unflatten([pair[k] for pair in charted]) for k in range(2))


def from_chart(field: PyTree, point: PyTree) -> PyTree:
    """The state at a point of the chart, for a field in the chart."""
    return jtu.tree_map(
        lambda f, p: f.from_chart(p) if is_field(f) else p, field, point, is_leaf=is_field
    )


def in_coordinates(name: str, field: PyTree, point: PyTree) -> PyTree:
    """The field at a point in the coordinates of this name, `"projected"` or `"cayley"`, part by
    part.

    **Raises** `TypeError` for a part that has no such coordinates.
    """

    def part(f: Any, p: PyTree) -> Any:
        if not is_field(f) or isinstance(f, Rest):
            return f
        coordinates = getattr(f, name)(p)
        if coordinates is None:
            raise TypeError(_no_coordinates_message(name, f))
        return coordinates

    return jtu.tree_map(part, field, point, is_leaf=is_field)


def rate(u: PyTree, field: PyTree, start: PyTree) -> PyTree:
    """How coordinates u change where the point to which they lead moves with `field`."""
    return jtu.tree_map(
        lambda x, f, p: x.rate(f, p) if isinstance(x, AbstractCoordinates) else f,
        u,
        field,
        start,
        is_leaf=is_field,
    )


def has_rate(u: PyTree) -> Bool[Array, ""] | None:
    """Whether `rate` at u has a value in all parts; None if it always has."""
    parts = jtu.tree_leaves(u, is_leaf=is_field)
    return _all_of([x.has_rate() for x in parts if isinstance(x, AbstractCoordinates)])


def landing(field: PyTree, start: PyTree) -> tuple[PyTree, Bool[Array, ""]]:
    """By how much a field in such coordinates moves a point on the manifold, to another on it; and
    whether there is one in all parts.
    """

    def part(f: Any, p: PyTree) -> tuple[PyTree, Bool[Array, ""]]:
        if isinstance(f, AbstractCoordinates):
            return f.landing(p)
        return f.increment(p) if is_field(f) else f, jnp.asarray(True)

    fields, treedef = jtu.tree_flatten(field, is_leaf=is_field)
    pairs = list(map(part, fields, treedef.flatten_up_to(start)))
    is_there = functools.reduce(jnp.logical_and, [x for _, x in pairs], jnp.asarray(True))
    return treedef.unflatten([increment for increment, _ in pairs]), is_there


def kept(field: PyTree, start: PyTree) -> PyTree:
    """What `keeping` takes, part by part."""
    return jtu.tree_map(
        lambda f, p: f.kept(p) if isinstance(f, AbstractCoordinates) else None,
        field,
        start,
        is_leaf=is_field,
    )


def keeping(field: PyTree, kept: PyTree) -> PyTree:
    """A field in such coordinates, whose `landing` restores what is kept of the start."""
    fields, treedef = jtu.tree_flatten(field, is_leaf=is_field)
    pairs = zip(fields, treedef.flatten_up_to(kept), strict=True)
    return treedef.unflatten([f if x is None else f.keeping(x) for f, x in pairs])


def _no_coordinates_message(name: str, field: AbstractFrozenField) -> str:
    if name == "projected":
        instead = {
            "Scaling": "steps in plain space change signs. Use cfjax.CF4() or cfjax.RKMK5().",
            "Lindblad": "in plain space populations become negative. Use cfjax.Kraus4().",
        }
        default = (
            "its method `projected` returns None. Define it in a class of your own; otherwise use "
            "a commutator-free method, for example cfjax.CF4()."
        )
        cls = type(field).__name__
        return f"cfjax.Projected does not take {cls}: {instead.get(cls, default)}"
    has_closed_form = (
        isinstance(field, AbstractAlgebraElement)
        and type(field).dexpinv is not AbstractAlgebraElement.dexpinv
    )
    return f'{type(field).__name__} has no coordinates for coordinates="{name}". Use ' + (
        'coordinates="exponential", the default, where this field has a closed form.'
        if has_closed_form
        else "a commutator-free method, for example cfjax.CF4()."
    )


def no_bracket_message(field: AbstractFrozenField) -> str:
    return (
        f"A Munthe-Kaas method needs brackets, and {type(field).__name__} has none: it is an "
        "AbstractFrozenField but not an AbstractAlgebraElement. Use a commutator-free method, "
        "for example cfjax.CF4()."
    )
