"""Fields on leading axes: one motion for each element of an array of points."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree, Real

from .._arrays import Weight
from .._field import AbstractAlgebraElement, AbstractFrozenField, combine


def each(fun: Callable[..., PyTree], num_axes: int) -> Callable[..., PyTree]:
    """`fun` of arrays without leading axes, for each element of arrays with so many of them.

    An axis of 1 is broadcast, and what only such arrays decide is computed once. An array that
    `fun` returns as it got it stays the same object, and arrays that are one object stay one.

    **Raises** `ValueError` where the axes do not broadcast.
    """
    if num_axes == 0:
        return fun
    inner = each(fun, num_axes - 1)

    def mapped(*args: PyTree) -> PyTree:
        leaves, structure = jtu.tree_flatten(args)
        distinct = list({id(x): x for x in leaves}.values())
        place = {id(x): k for k, x in enumerate(distinct)}
        lengths = {x.shape[0] for x in distinct}
        others = lengths - {1}
        if len(others) > 1:
            raise ValueError(f"The leading axes must agree or be 1, got lengths {sorted(lengths)}.")
        is_fixed = [bool(others) and x.shape[0] == 1 for x in distinct]
        given = [x[0] if fixed else x for x, fixed in zip(distinct, is_fixed, strict=True)]
        kept: list[int | None] = []
        out_structure: Any = None

        def of_distinct(*inside: Array) -> list[Array]:
            nonlocal kept, out_structure
            args = structure.unflatten([inside[place[id(x)]] for x in leaves])
            outs, out_structure = jtu.tree_flatten(inner(*args))
            found = {id(x): k for k, x in enumerate(inside) if not is_fixed[k]}
            kept = [found.get(id(x)) for x in outs]
            return [x for x, k in zip(outs, kept, strict=True) if k is None]

        axes = [None if fixed else 0 for fixed in is_fixed]
        made = iter(jax.vmap(of_distinct, in_axes=axes)(*given))
        return out_structure.unflatten([next(made) if k is None else distinct[k] for k in kept])

    return mapped


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
    leading = shape[:num_axes]
    front, core = point.shape[:num_axes], point.shape[num_axes:]
    broadcasts = len(front) == num_axes and all(map(_broadcasts, leading, front))
    if broadcasts and any(_fits(core, expected) for expected in cores):
        return
    # An axis of 1 is broadcast to any length.
    sides = [f"l{k}" if n == 1 else n for k, n in enumerate(leading)]
    shapes = " and ".join(_text(*sides, *core) for core in cores)
    hint = ""
    for expected in cores:
        more = point.ndim - len(expected)
        if num_axes == 0 and more > 0 and _fits(point.shape[more:], expected):
            hint = (
                " For one motion of each point give the coordinates leading axes: "
                f"{coordinates} of shape {_text(*point.shape[:more], *shape)}, or "
                f"{_text(*[1] * more, *shape)} for equal motions."
            )
            break
    raise ValueError(
        f"{type(field).__name__} with {coordinates} of shape {shape} acts on shapes {shapes}, got "
        f"{point.shape}.{hint}"
    )


def check_other(field: AbstractFrozenField, other: Any) -> None:
    """Raises `TypeError` unless the other is of the field's class, as its bracket needs."""
    if not isinstance(other, type(field)):
        name = type(field).__name__
        raise TypeError(
            f"{name} has a bracket with another {name} only, got {type(other).__name__}."
        )


def _broadcasts(a: int, b: int) -> bool:
    return a in (1, b)


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
        return self._each(lambda field, point: field.flow(point))(self.field, point)

    def tangent(self, point: Any) -> Any:
        return self._each(lambda field, point: field.tangent(point))(self.field, point)

    def increment(self, point: Any) -> Any:
        return self._each(lambda field, point: field.increment(point))(self.field, point)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> Any:
        combined = fields[0]._each(lambda *parts: combine(weights, parts))
        return elementwise(combined(*(field.field for field in fields)), fields[0].num_axes)

    def defect(self, point: Any) -> tuple[Real[Array, ""], str] | None:
        text = None

        def off(point: Any) -> Any:
            nonlocal text
            found = self.field.defect(point)
            if found is not None:
                text = found[1]
                return found[0]

        found = self._each(off)(point)
        return None if text is None else (jnp.max(found, initial=0), text)

    def to_chart(self, point: Any, earlier: Sequence[Any]) -> tuple[AbstractFrozenField, Any]:
        inside = [field.field for field in earlier]
        each = self._each(lambda field, point, *earlier: field.to_chart(point, earlier))
        field, point = each(self.field, point, *inside)
        return elementwise(field, self.num_axes), point

    def from_chart(self, point: Any) -> Any:
        return self._each(lambda field, point: field.from_chart(point))(self.field, point)

    def _each(self, fun: Callable[..., PyTree]) -> Callable[..., PyTree]:
        return each(fun, self.num_axes)


class ElementwiseElement(Elementwise, AbstractAlgebraElement):
    """Of algebra elements: an algebra element."""

    def bracket(self, other: Any) -> Any:
        brackets = self._each(lambda a, b: a.bracket(b))(self.field, other.field)
        return elementwise(brackets, self.num_axes)

    def dexpinv(self, other: Any, degree: int) -> Any:
        images = self._each(lambda a, b: a.dexpinv(b, degree))(self.field, other.field)
        return elementwise(images, self.num_axes)

    def has_dexpinv(self) -> Bool[Array, ""] | None:
        found = self._each(lambda a: a.has_dexpinv())(self.field)
        return None if found is None else jnp.all(found)
