"""Motions of poses, each a rotation and some vectors, by elements of a Lie algebra."""

from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Real

from .._field import AbstractAlgebraElement
from .._numerics.matmul import matmul
from .._numerics.quaternion import Frame
from .coordinates import Pose
from .elementwise import check_other, check_point, check_real, each, each_of_its_own, elementwise


class AbstractMotion(AbstractAlgebraElement):
    """A motion of poses: a rotation of some dimension, and so many vectors beside it."""

    omega: eqx.AbstractVar[Array]
    layout: eqx.AbstractVar[Any]

    dimension: ClassVar[int]
    num_vectors: ClassVar[int]
    # Its arrays, in the order in which functions of `numerics` take them, and one that has the
    # shape of a vector.
    coordinates: ClassVar[tuple[str, ...]]
    vector: ClassVar[str]
    # What must agree where motions have a bracket.
    conventions: ClassVar[tuple[str, ...]]
    # A pose in one vector has a unit number of so many entries.
    number: ClassVar[str]
    number_size: ClassVar[int]
    # The indices of the entries of the number, then of the vectors, in a pose in one vector.
    layouts: ClassVar[dict[str, tuple[int, ...]]]
    layouts_in_words: ClassVar[str]
    # The module with its tangent, increment, bracket and has_dexpinv.
    numerics: ClassVar[Any]

    def flow(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return point + self._each(
            partial(self.numerics.increment, leads_back=False), point, is_flow=True
        )

    def increment(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(partial(self.numerics.increment, leads_back=True), point, is_flow=True)

    def tangent(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(self.numerics.tangent, point)

    def projected(self, point: Float[Array, "..."]) -> Any:
        axes = self._num_axes
        indices = ()
        if point.shape[axes:] == self._pose_shapes[1]:
            indices = self._indices[: self.number_size]
        velocity = Pose(self.tangent(point), self.dimension, indices)
        return elementwise(velocity, axes) if axes else velocity

    def bracket(self, other: Any) -> Any:
        return self._with(self.numerics.bracket, other)

    def has_dexpinv(self) -> Bool[Array, ""]:
        return self.numerics.has_dexpinv(self.omega)

    def defect(self, point: Float[Array, "..."]) -> tuple[Real[Array, ""], str] | None:
        n, core = self.dimension, point.shape[self._num_axes :]
        if core == (n,):
            return None
        if len(core) == 2:
            rows = [tuple(int(k == j) for k in range(core[0])) for j in range(n, core[0])]
            last = (
                f"last column and row {rows[0]}"
                if len(rows) == 1
                else f"last {len(rows)} columns and rows {' and '.join(map(str, rows))}"
            )
            expected = f"a rotation, of determinant 1, before its {last}"
            defect = each(partial(_defect, n), self._num_axes)(point)
        else:
            indices = self._indices[: self.number_size]
            if {0, core[0] - 1}.isdisjoint(indices):
                place = f"entries [{min(indices)}:{max(indices) + 1}]"
            else:
                place = f"{'first' if 0 in indices else 'last'} {len(indices)} entries"
            expected = f"{self.number} in its {place}"
            defect = jnp.abs(sum(point[..., k] ** 2 for k in indices) - 1)
        return jnp.max(defect, initial=0), expected

    def _check_layout(self) -> None:
        if self.layout is not None and self.layout not in tuple(self.layouts):
            raise ValueError(f"layout must be one of {tuple(self.layouts)}, got {self.layout!r}.")

    def _check_dtypes(self) -> None:
        arrays = {name: getattr(self, name) for name in self.coordinates}
        for name, x in arrays.items():
            check_real(name, x)
        dtypes = dict.fromkeys(str(x.dtype) for x in arrays.values())
        if len(dtypes) > 1:
            raise TypeError(f"{_listed(arrays)} must have one dtype, got {_listed(dtypes)}.")

    def _with(self, fun: Any, other: Any) -> Any:
        check_other(self, other)
        mine, its = ({k: getattr(x, k) for k in self.conventions} for x in (self, other))
        if mine != its:
            got = " and ".join(", ".join(f"{k}={x!r}" for k, x in d.items()) for d in (mine, its))
            raise ValueError(
                f"Cannot compute the bracket of two {type(self).__name__}s: both must have the "
                f"same {' and '.join(self.conventions)}, got {got}."
            )
        fun = each(fun, self._num_axes)
        arrays = fun(*(self._sign * x for x in self._arrays), *other._arrays)
        return type(self)(**dict(zip(self.coordinates, arrays, strict=True)), **mine)

    @property
    def _sign(self) -> int:
        """1, or -1 where motions compose in the reverse order, as those of minus them in order."""
        return -1

    @property
    def _arrays(self) -> list[Array]:
        return [getattr(self, name) for name in self.coordinates]

    @property
    def _indices(self) -> tuple[int, ...]:
        if self.layout is None:
            raise TypeError(
                f"{type(self).__name__} needs a layout for poses of shape {self._pose_shapes[1]}: "
                f"{self.layouts_in_words}. There is no default, as a wrong guess would go "
                "unnoticed."
            )
        return self.layouts[self.layout]

    @property
    def _pose_shapes(self) -> list[tuple[int, ...]]:
        n, k = self.dimension, self.num_vectors
        return [(n + k, n + k), (self.number_size + k * n,)]

    @property
    def _num_axes(self) -> int:
        return getattr(self, self.vector).ndim - 1

    def _check_point(self, point: Array) -> None:
        check_point(self, self.vector, self._num_axes, self._pose_shapes, point)

    def _each(self, fun: Any, point: Array, is_flow: bool = False) -> Any:
        axes = self._num_axes
        self._check_point(point)
        dtype = getattr(self, self.vector).dtype
        if point.dtype != dtype:
            raise TypeError(
                f"{type(self).__name__} with {self.vector} in {dtype} acts on points in {dtype}, "
                f"got {point.dtype}."
            )
        is_vector = point.shape[axes:] == self._pose_shapes[1]
        options = {name: getattr(self, name) for name in self.conventions if name != "layout"}
        fun = partial(fun, indices=self._indices if is_vector else (), **options)
        return each(fun, axes, is_flow)(*self._arrays, point)


class AbstractFramedMotion(AbstractMotion):
    """A motion with an angular velocity and a velocity for each vector, in one of two frames."""

    v: eqx.AbstractVar[Array]
    frame: eqx.AbstractVar[Frame]

    vector: ClassVar[str] = "v"
    conventions: ClassVar[tuple[str, ...]] = ("frame", "layout")

    def __check_init__(self):
        n, shape = self.dimension, self.v.shape
        if self.v.ndim < 1 or shape[-1] != n:
            raise ValueError(f"v must have shape ({n},) or (*batch, {n}), got {shape}.")
        for name in self.coordinates:
            expected = shape[:-1] if name == "omega" and n == 2 else shape
            found = getattr(self, name).shape
            if found != expected:
                raise ValueError(
                    f"{name} must have shape {expected} where v has {shape}, got {found}."
                )
        self._check_dtypes()
        if self.frame not in ("body", "fixed"):
            raise ValueError(f'frame must be "body" or "fixed", got {self.frame!r}.')
        self._check_layout()

    def framed(self, point: Float[Array, "..."]) -> Any:
        """Itself on poses, and the velocity on points."""
        if point.shape[self._num_axes :] == (self.dimension,):
            return self.tangent(point)
        return each_of_its_own(self, self._num_axes, point)

    def dexpinv(self, other: Any, degree: int) -> Any:
        """Exact, whatever the degree, for angles below a full turn, whatever the velocities are."""
        return self._with(self.numerics.dexpinv, other)

    @property
    def _sign(self) -> int:
        return 1 if self.frame == "fixed" else -1


def _listed(words: Any) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}"


def _defect(n: int, matrix: Float[Array, "k k"]) -> Float[Array, ""]:
    rotation, last = matrix[:n, :n], matrix[n:]
    eye = jnp.eye(len(matrix), dtype=matrix.dtype)
    gram = matmul(rotation.T, rotation)
    defects = (gram - eye[:n, :n], jnp.linalg.det(rotation) - 1, last - eye[n:])
    return jnp.max(jnp.asarray([jnp.max(jnp.abs(x)) for x in defects]))
