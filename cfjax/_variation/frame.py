"""Coordinates of variations: of elements of a frame, of matrices in a basis, or of velocities."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree, Real

from .._arguments import time_dtype
from .._arrays import describe, struct
from .._field import AbstractAlgebraElement, Rest, is_field
from .._fields.matrix import AbstractOneSided
from .basis import Basis


class Part:
    """How a variation of one part of the state is written in `size` numbers.

    `like` has the class and the shapes of what `framed` returns: an element of a class that moves
    every point freely, or arrays, the velocity.
    """

    def __init__(self, place: str, field: Any, like: PyTree, dtype: Any):
        self.place, self.field, self.like, self.dtype = place, field, like, dtype
        leaves, self.treedef = jtu.tree_flatten(like)
        self.shapes = [leaf.shape for leaf in leaves]
        self.size = sum(map(math.prod, self.shapes))
        self.is_element = is_field(like)

    def coordinates(self, framed: PyTree) -> Real[Array, " k"]:
        leaves = [x.reshape(-1) for x in jtu.tree_leaves(framed)]
        return jnp.concatenate(leaves) if leaves else jnp.zeros(0, self.dtype)

    def element(self, vector: Real[Array, " k"]) -> PyTree:
        leaves, start = [], 0
        for shape in self.shapes:
            stop = start + math.prod(shape)
            leaves.append(vector[start:stop].reshape(shape))
            start = stop
        return self.treedef.unflatten(leaves)

    def bracket(self, framed: PyTree, vector: Real[Array, " k"]) -> Real[Array, " k"]:
        """The coordinates of the bracket of `framed` and the element of a vector."""
        return self.coordinates(framed.bracket(self.element(vector)))


class MatrixPart(Part):
    """A matrix that multiplies from one side, by its coefficients in a basis."""

    def __init__(self, place: str, field: Any, like: Any, basis: Basis):
        self.place, self.field, self.like, self.basis = place, field, like, basis
        self.axes = like.a.shape[:-2]
        self.size = math.prod(self.axes) * len(basis.matrices)
        self.is_element = True

    def coordinates(self, framed: Any) -> Real[Array, " k"]:
        return self.basis.coefficients(framed.a).reshape(-1)

    def element(self, vector: Real[Array, " k"]) -> Any:
        c = vector.reshape(*self.axes, -1)
        return type(self.like)(self.basis.matrix(c, self.like.a.dtype))

    def is_outside(self, framed: Any) -> Bool[Array, ""]:
        """Whether a matrix is off the span of the basis by more than half of the digits."""
        a = framed.a
        rest = a - self.element(self.coordinates(framed)).a
        scale = jnp.max(jnp.abs(a), initial=0)
        return jnp.max(jnp.abs(rest), initial=0) > jnp.sqrt(jnp.finfo(scale.dtype).eps) * scale


class Frame(NamedTuple):
    """The coordinates of variations of a state, part after part."""

    treedef: Any
    parts: Sequence[Part]
    basis: Basis | None

    @classmethod
    def of(cls, field: PyTree, y: PyTree, basis: Basis | None) -> "Frame":
        """For fields of this structure. Of both only the shapes matter.

        **Raises** `TypeError` or `ValueError` if coordinates are not real, or the basis fits none.
        """
        pairs, treedef = jtu.tree_flatten_with_path(field, is_leaf=is_field)
        points = treedef.flatten_up_to(y)
        parts = [
            _part("y" + jtu.keystr(path), part, point, basis, time_dtype(y))
            for (path, part), point in zip(pairs, points, strict=True)
        ]
        if basis is not None and not any(isinstance(part, MatrixPart) for part in parts):
            classes = ", ".join(dict.fromkeys(describe_class(part) for _, part in pairs))
            raise TypeError(
                "basis is for cfjax.LeftMatrix and cfjax.RightMatrix on matrices, and the field "
                f"has {classes} only: leave it out."
            )
        return cls(treedef, parts, basis)

    @property
    def size(self) -> int:
        return sum(part.size for part in self.parts)

    @property
    def slices(self) -> list[slice]:
        slices, start = [], 0
        for part in self.parts:
            slices.append(slice(start, start + part.size))
            start += part.size
        return slices

    def framed(self, field: PyTree, y: PyTree) -> list[PyTree]:
        """What has the same velocity at y, for each part. The parts of `field` may rest."""
        fields, points = map(self.treedef.flatten_up_to, (field, y))
        return list(map(self.framed_part, fields, points))

    def framed_part(self, field: Any, point: PyTree) -> PyTree:
        return _framed(field, point, self.basis)

    def coordinates(self, framed: Sequence[PyTree]) -> list[Array]:
        return [part.coordinates(x) for part, x in zip(self.parts, framed, strict=True)]

    def velocity(self, k: int, vector: Real[Array, " k"], point: PyTree) -> PyTree:
        """The change of a part of the state that coordinates of a variation of it stand for."""
        element = self.parts[k].element(vector)
        return element.tangent(point) if is_field(element) else element


def _framed(field: Any, point: PyTree, basis: Basis | None) -> PyTree:
    if not is_field(field):
        return field
    if _is_in_basis(field, point, basis):
        axes = point.shape[:-2]
        return type(field)(jnp.broadcast_to(field.a, (*axes, *field.a.shape[-2:])))
    return field.framed(point)


def _is_in_basis(field: Any, point: PyTree, basis: Basis | None) -> bool:
    return (
        basis is not None
        and isinstance(field, AbstractOneSided)
        and point.ndim - (field.a.ndim - 2) == 2
    )


def _part(place: str, field: Any, point: PyTree, basis: Basis | None, dtype: Any) -> Part:
    like = jax.eval_shape(lambda: _framed(field, point, basis))
    if _is_in_basis(field, point, basis):
        assert basis is not None
        n = like.a.shape[-1]
        if n != basis.size:
            raise ValueError(
                f"basis must have matrices of shape {(n, n)} for {type(field).__name__} at "
                f"{place}, got {basis.matrices.shape[1:]}."
            )
        if jnp.iscomplexobj(basis.matrices) and not jnp.issubdtype(
            like.a.dtype, jnp.complexfloating
        ):
            raise TypeError(
                f"basis must be real for {type(field).__name__} of {like.a.dtype} at {place}, got "
                "complex matrices."
            )
        return MatrixPart(place, field, like, basis)
    for leaf in jtu.tree_leaves(like):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            name = describe_class(field)
            raise TypeError(
                f"A variation has real coordinates, and {name} for {place}, where the state is "
                f"{describe(point)}, has {leaf.dtype}. Name the basis of a LeftMatrix or "
                'RightMatrix, such as basis=cfjax.algebra_basis("su", n); for other fields keep '
                "real and imaginary parts as two parts of the state."
            )
    if is_field(like) and not isinstance(like, AbstractAlgebraElement):
        raise TypeError(
            f"{describe_class(field)}.framed at {place} must return an algebra element or the "
            f"velocity, got {type(like).__name__}, which has no bracket."
        )
    if not is_field(like) and struct(like) != struct(point):
        raise ValueError(
            f"{describe_class(field)}.framed at {place} must return a frozen field or what is "
            f"shaped like its point, {describe(point)}, got {describe(like)}."
        )
    return Part(place, field, like, dtype)


def describe_class(part: Any) -> str:
    if isinstance(part, Rest):
        return "None"
    return type(part).__name__ if is_field(part) else "a translation"
