"""Fields on leading axes: one motion for each element of an array of points."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, PyTree, Real

from .._arrays import Weight
from .._field import (
    AbstractAlgebraElement,
    AbstractCoordinates,
    AbstractFrozenField,
    combine,
    is_field,
)
from .._numerics.vectors import limits, scalarised


def each(fun: Callable[..., PyTree], num_axes: int, is_flow: bool = False) -> Callable[..., PyTree]:
    """Maps `fun`, a function of arrays without leading axes, over so many leading axes.

    An axis of 1 is broadcast, and what depends only on such arrays is computed once. An array that
    `fun` returns unchanged stays the same object, and arguments that are one object stay one. A
    flow of many short vectors XLA gets on single numbers.

    **Raises** `ValueError` where the axes do not broadcast.
    """
    if num_axes == 0:
        return fun
    if is_flow:
        return _each_on_numbers(fun, num_axes)
    inner = each(fun, num_axes - 1)

    def mapped(*args: PyTree) -> PyTree:
        leaves, treedef = jtu.tree_flatten(args)
        distinct = list({id(x): x for x in leaves}.values())
        index = {id(x): k for k, x in enumerate(distinct)}
        lengths = {x.shape[0] for x in distinct}
        if len(lengths - {1}) > 1:
            raise ValueError(f"The leading axes must agree or be 1, got lengths {sorted(lengths)}.")
        axes = [None if len(lengths) > 1 and x.shape[0] == 1 else 0 for x in distinct]
        # `jax.vmap` may have returned NumPy arrays.
        operands = [
            jnp.asarray(x[0] if axis is None else x) for x, axis in zip(distinct, axes, strict=True)
        ]
        # For each output the operand that it is, or None.
        forwarded: list[int | None] = []
        out_treedef: Any = None

        def of_distinct(*elements: Any) -> list[Any]:
            nonlocal forwarded, out_treedef
            args = treedef.unflatten([elements[index[id(x)]] for x in leaves])
            outputs, out_treedef = jtu.tree_flatten(inner(*args))
            forwardable = {id(x): k for k, x in enumerate(elements) if axes[k] == 0}
            forwarded = [forwardable.get(id(x)) for x in outputs]
            return [x for x, k in zip(outputs, forwarded, strict=True) if k is None]

        computed = iter(jax.vmap(of_distinct, in_axes=axes)(*operands))
        return out_treedef.unflatten(
            [next(computed) if k is None else distinct[k] for k in forwarded]
        )

    return mapped


def _each_on_numbers(fun: Callable[..., PyTree], num_axes: int) -> Callable[..., PyTree]:
    def mapped(*args: PyTree) -> PyTree:
        sides = [np.shape(x)[:num_axes] for x in jtu.tree_leaves(args)]
        is_many = max(map(math.prod, sides)) > limits.MAX_SIZE
        one = (lambda *args: scalarised(lambda args: fun(*args), args)) if is_many else fun
        return each(one, num_axes)(*args)

    return mapped


def each_of_its_own(field: Any, num_axes: int, point: Array) -> Any:
    """The same field with arrays of its own for each element of the leading axes of a point."""
    axes = point.shape[:num_axes]

    def broadcast(x: Array) -> Array:
        shape = *axes, *x.shape[num_axes:]
        return x if x.shape == shape else jnp.broadcast_to(x, shape)

    return jtu.tree_map(broadcast, field)


def check_point(
    field: AbstractFrozenField,
    coordinates: str,
    num_axes: int,
    cores: Sequence[tuple[int | str, ...]],
    point: Array,
) -> None:
    """Raises `ValueError` unless the point has one of the shapes that the field acts on.

    `coordinates` names an array of the field with so many leading axes. `cores` has the shapes of
    points without them, with letters for any length.
    """
    shape = getattr(field, coordinates).shape
    # An axis of 1 is broadcast to any length.
    leading = [f"l{k}" if n == 1 else n for k, n in enumerate(shape[:num_axes])]
    if any(_fits(point.shape, (*leading, *core)) for core in cores):
        return
    shapes = " and ".join(_text(*leading, *core) for core in cores)
    hint = ""
    for core in cores:
        missing = point.ndim - len(core)
        if num_axes == 0 and missing > 0 and _fits(point.shape[missing:], core):
            hint = (
                " For one motion of each point give the coordinates leading axes: "
                f"{coordinates} of shape {_text(*point.shape[:missing], *shape)}, or "
                f"{_text(*[1] * missing, *shape)} for equal motions."
            )
            break
    raise ValueError(
        f"{type(field).__name__} with {coordinates} of shape {shape} acts on shapes {shapes}, got "
        f"{point.shape}.{hint}"
    )


def check_other(field: AbstractFrozenField, other: Any) -> None:
    """Raises `TypeError` unless `other` is of the field's class, as its bracket needs."""
    if not isinstance(other, type(field)):
        raise TypeError(
            f"Cannot compute the bracket of {type(field).__name__} and {type(other).__name__}: "
            "both must be of one class."
        )


def check_real(name: str, array: Array) -> None:
    """Raises `TypeError` unless the array is float32 or float64."""
    if array.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"{name} must be float32 or float64, got {array.dtype}.")


def _fits(shape: Sequence[int], expected: Sequence[int | str]) -> bool:
    return len(shape) == len(expected) and all(
        isinstance(side, str) or side == n for side, n in zip(expected, shape, strict=True)
    )


def _text(*sides: int | str) -> str:
    return f"({', '.join(map(str, sides))}{',' if len(sides) == 1 else ''})"


def elementwise(field: AbstractFrozenField, num_axes: int = 1) -> AbstractFrozenField:
    """A field for each element of leading axes, made from one field whose arrays have these axes.

    With it any class of frozen fields moves arrays of points, all in one program:

    ```python
    def field(t, y, args):  # y of shape (100, 3)
        return cfjax.elementwise(jax.vmap(lambda y: MyField(-y))(y))
    ```

    Element k of the state moves along the field that has element k of each array. An axis of 1 is
    broadcast. The fields of cfjax take leading axes by themselves.

    **Arguments:**

    - `field`: a frozen field whose arrays all have the leading axes in front, such as the result of
      `jax.vmap` of a function that returns a field.
    - `num_axes`: how many leading axes.

    **Returns:** a frozen field. It is an algebra element if `field` is one.

    **Raises** `TypeError` if `field` is not a frozen field or `num_axes` not a positive int, and
    `ValueError` for an array with fewer axes.
    """
    if not isinstance(field, AbstractFrozenField):
        raise TypeError(f"field must be a frozen vector field, got {field!r}.")
    if not isinstance(num_axes, int) or isinstance(num_axes, bool) or num_axes < 1:
        raise TypeError(f"num_axes must be a positive int, got {num_axes!r}.")
    for path, leaf in jtu.tree_leaves_with_path(field):
        if jnp.ndim(leaf) < num_axes:
            raise ValueError(
                f"Every array of field must have {num_axes} leading axes, got shape "
                f"{jnp.shape(leaf)} for {type(field).__name__}{jtu.keystr(path)}."
            )
    if isinstance(field, Elementwise):
        field, num_axes = field.field, num_axes + field.num_axes
    if isinstance(field, AbstractCoordinates):
        return ElementwiseCoordinates(field, num_axes)
    is_element = isinstance(field, AbstractAlgebraElement)
    return (ElementwiseElement if is_element else Elementwise)(field, num_axes)


class Elementwise(AbstractFrozenField):
    """What `elementwise` returns."""

    field: AbstractFrozenField
    num_axes: int = eqx.field(static=True)

    @property
    def acts_on_subtree(self) -> bool:
        return self.field.acts_on_subtree

    def flow(self, point: Any) -> Any:
        flow = each(lambda field, point: field.flow(point), self.num_axes, is_flow=True)
        return flow(self.field, point)

    def tangent(self, point: Any) -> Any:
        return self._each(lambda field, point: field.tangent(point))(self.field, point)

    def increment(self, point: Any) -> Any:
        increment = each(lambda field, point: field.increment(point), self.num_axes, is_flow=True)
        return increment(self.field, point)

    def framed(self, point: Any) -> Any:
        framed = self._each(lambda field, point: field.framed(point))(self.field, point)
        return elementwise(framed, self.num_axes) if is_field(framed) else framed

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> Any:
        combined = fields[0]._each(lambda *parts: combine(weights, parts))
        return elementwise(combined(*(field.field for field in fields)), fields[0].num_axes)

    def defect(self, point: Any) -> tuple[Real[Array, ""], str] | None:
        requirement = None

        def defect(point: Any) -> Any:
            nonlocal requirement
            size, requirement = self.field.defect(point) or (None, None)
            return size

        sizes = self._each(defect)(point)
        return None if requirement is None else (jnp.max(sizes, initial=0), requirement)

    def faults(self) -> Sequence[tuple[Bool[Array, ""], str]]:
        conditions = []

        def values(field: Any) -> list[Any]:
            conditions[:] = [condition for _, condition in field.faults()]
            return [holds for holds, _ in field.faults()]

        holds = self._each(values)(self.field)
        return [(jnp.any(x), condition) for x, condition in zip(holds, conditions, strict=True)]

    def to_chart(self, point: Any, earlier: Sequence[Any]) -> tuple[AbstractFrozenField, Any]:
        each = self._each(lambda field, point, *earlier: field.to_chart(point, earlier))
        field, point = each(self.field, point, *(field.field for field in earlier))
        return elementwise(field, self.num_axes), point

    def from_chart(self, point: Any) -> Any:
        return self._each(lambda field, point: field.from_chart(point))(self.field, point)

    def projected(self, point: Any) -> Any:
        field = self._each(lambda field, point: field.projected(point))(self.field, point)
        return None if field is None else elementwise(field, self.num_axes)

    def cayley(self, point: Any) -> Any:
        field = self._each(lambda field, point: field.cayley(point))(self.field, point)
        return None if field is None else elementwise(field, self.num_axes)

    def _each(self, fun: Callable[..., PyTree]) -> Callable[..., PyTree]:
        return each(fun, self.num_axes)


class ElementwiseElement(Elementwise, AbstractAlgebraElement):
    """What `elementwise` of an algebra element returns."""

    def bracket(self, other: Any) -> Any:
        brackets = self._each(lambda a, b: a.bracket(b))(self.field, other.field)
        return elementwise(brackets, self.num_axes)

    def dexpinv(self, other: Any, degree: int) -> Any:
        values = self._each(lambda a, b: a.dexpinv(b, degree))(self.field, other.field)
        return elementwise(values, self.num_axes)

    def has_dexpinv(self) -> Bool[Array, ""] | None:
        has_value = self._each(lambda a: a.has_dexpinv())(self.field)
        return None if has_value is None else jnp.all(has_value)


class ElementwiseCoordinates(Elementwise, AbstractCoordinates):
    """What `elementwise` of a field in coordinates of a step returns."""

    field: AbstractCoordinates

    def rate(self, field: Any, start: Any) -> Any:
        if self.field.is_rate_of_start:
            each = self._each(lambda u, field, start: u.rate(field, start))
            rates = each(self.field, field.field, start)
        else:
            # One for all points where the field is one.
            rates = self._each(lambda u, field: u.rate(field, None))(self.field, field.field)
        return elementwise(rates, self.num_axes)

    def has_rate(self) -> Bool[Array, ""] | None:
        has_value = self._each(lambda u: u.has_rate())(self.field)
        return None if has_value is None else jnp.all(has_value)

    def landing(self, start: Any) -> tuple[Any, Bool[Array, ""]]:
        increment, is_there = self._each(lambda u, start: u.landing(start))(self.field, start)
        return increment, jnp.all(is_there)

    def kept(self, start: Any) -> PyTree[Array] | None:
        return self._each(lambda u, start: u.kept(start))(self.field, start)

    def keeping(self, kept: PyTree[Array]) -> Any:
        field = self._each(lambda u, kept: u.keeping(kept))(self.field, kept)
        return elementwise(field, self.num_axes)
