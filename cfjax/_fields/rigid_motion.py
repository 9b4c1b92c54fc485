"""Rigid motions of space and of the plane: the Lie algebras se(3) and se(2)."""

from dataclasses import KW_ONLY
from functools import partial
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Real

from .._field import AbstractAlgebraElement
from .._numerics import planar_motion, rigid_motion
from .._numerics.matmul import matmul
from .._numerics.quaternion import Frame
from .elementwise import check_other, check_point, check_real, each, each_of_its_own

Layout = Literal["wxyz_xyz", "xyz_xyzw", "xyzw_xyz", "xyz_wxyz"]
PlanarLayout = Literal["unit_complex_xy", "xy_unit_complex"]


class AbstractMotion(AbstractAlgebraElement):
    """A motion of space or of the plane."""

    omega: eqx.AbstractVar[Array]
    v: eqx.AbstractVar[Array]
    frame: eqx.AbstractVar[Frame]
    layout: eqx.AbstractVar[Any]

    dimension: ClassVar[int]
    # A pose in one vector is a unit number of so many entries, and a position.
    number: ClassVar[str]
    number_size: ClassVar[int]
    # The indices of the entries of the number, then of the position, in a pose in one vector.
    layouts: ClassVar[dict[str, tuple[int, ...]]]
    conventions: ClassVar[str]
    # The module with its tangent, increment, bracket, dexpinv and has_dexpinv.
    numerics: ClassVar[Any]

    def __check_init__(self):
        n = self.dimension
        if self.v.ndim < 1 or self.v.shape[-1] != n:
            raise ValueError(f"v must have shape ({n},) or (*batch, {n}), got {self.v.shape}.")
        expected = self.v.shape if n == 3 else self.v.shape[:-1]
        if self.omega.shape != expected:
            raise ValueError(
                f"omega must have shape {expected} where v has {self.v.shape}, got "
                f"{self.omega.shape}."
            )
        for name, x in (("omega", self.omega), ("v", self.v)):
            check_real(name, x)
        if self.omega.dtype != self.v.dtype:
            raise TypeError(
                f"omega and v must have one dtype, got {self.omega.dtype} and {self.v.dtype}."
            )
        if self.frame not in ("body", "fixed"):
            raise ValueError(f'frame must be "body" or "fixed", got {self.frame!r}.')
        if self.layout is not None and self.layout not in tuple(self.layouts):
            raise ValueError(f"layout must be one of {tuple(self.layouts)}, got {self.layout!r}.")

    def flow(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return point + self._each(partial(self.numerics.increment, leads_back=False), point)

    def increment(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(partial(self.numerics.increment, leads_back=True), point)

    def tangent(self, point: Float[Array, "..."]) -> Float[Array, "..."]:
        return self._each(self.numerics.tangent, point)

    def framed(self, point: Float[Array, "..."]) -> Any:
        """Itself on poses, and the velocity on points."""
        if point.shape[self._num_axes :] == (self.dimension,):
            return self.tangent(point)
        return each_of_its_own(self, self._num_axes, point)

    def bracket(self, other: Any) -> "AbstractMotion":
        return self._with(self.numerics.bracket, other)

    def dexpinv(self, other: Any, degree: int) -> "AbstractMotion":
        """Exact, whatever the degree, for angles below a full turn, whatever `v` is."""
        return self._with(self.numerics.dexpinv, other)

    def has_dexpinv(self) -> Bool[Array, ""]:
        return self.numerics.has_dexpinv(self.omega)

    def _with(self, fun: Any, other: Any) -> "AbstractMotion":
        check_other(self, other)
        if (other.frame, other.layout) != (self.frame, self.layout):
            raise ValueError(
                f"{type(self).__name__} has a bracket with a motion of the same frame and layout "
                f"only, got frame={self.frame!r}, layout={self.layout!r} and "
                f"frame={other.frame!r}, layout={other.layout!r}."
            )
        # In the frame of the body flows compose in the reverse order, as those of minus the motions
        # in the fixed frame.
        sign = 1 if self.frame == "fixed" else -1
        fun = each(fun, self._num_axes)
        omega, v = fun(sign * self.omega, sign * self.v, other.omega, other.v)
        return type(self)(omega=omega, v=v, frame=self.frame, layout=self.layout)

    def defect(self, point: Float[Array, "..."]) -> tuple[Real[Array, ""], str] | None:
        n, core = self.dimension, point.shape[self._num_axes :]
        if core == (n,):
            return None
        if len(core) == 2:
            row = (0,) * n + (1,)
            expected = f"a rotation, of determinant 1, before its last column and row {row}"
            defect = each(_defect, self._num_axes)(point)
        else:
            indices = self._indices[: self.number_size]
            end = "first" if 0 in indices else "last"
            expected = f"{self.number} in its {end} {len(indices)} entries"
            defect = jnp.abs(sum(point[..., k] ** 2 for k in indices) - 1)
        return jnp.max(defect, initial=0), expected

    @property
    def _indices(self) -> tuple[int, ...]:
        if self.layout is None:
            raise TypeError(
                f"{type(self).__name__} needs a layout for poses of shape "
                f"({self.number_size + self.dimension},): {self.conventions}. There is no default, "
                "as a wrong guess would go unnoticed."
            )
        return self.layouts[self.layout]

    @property
    def _num_axes(self) -> int:
        return self.v.ndim - 1

    def _each(self, fun: Any, point: Array) -> Array:
        n, axes = self.dimension, self._num_axes
        name, poses = type(self).__name__, [(n + 1, n + 1), (self.number_size + n,)]
        if self.frame == "body" and point.shape[axes:] == (n,):
            raise ValueError(
                f'{name} with frame="body" moves poses, shapes {poses[0]} and {poses[1]}: a point '
                f'has no frame of its own, got shape {point.shape}. Use frame="fixed".'
            )
        check_point(self, "v", axes, poses + [(n,)] * (self.frame == "fixed"), point)
        if point.dtype != self.v.dtype:
            raise TypeError(
                f"{name} with v in {self.v.dtype} acts on points in {self.v.dtype}, got "
                f"{point.dtype}."
            )
        is_vector = point.shape[axes:] == poses[1]
        fun = partial(fun, frame=self.frame, indices=self._indices if is_vector else ())
        return each(fun, axes)(self.omega, self.v, point)


class RigidMotion(AbstractMotion):
    """A rigid motion of space: an angular velocity `omega` and a velocity `v`.

    It acts on

    - a pose as a homogeneous matrix, `(4, 4)`: rotation and position, and (0, 0, 0, 1) below;
    - a pose as one vector, `(7,)`, the fastest: a unit quaternion, which takes the coordinates of
      the body to fixed ones, and the position. `layout` says where they are;
    - a point, `(3,)`, in the fixed frame only.

    With `frame="fixed"`, `omega` and `v` have fixed coordinates, and `v` is the velocity of the
    point at the origin: `T' = X T` for the matrix `X = [[omega x, v], [0, 0]]`, and
    `x' = omega x x + v` for positions and points. With `frame="body"` they have the coordinates of
    the body, and `v` is the velocity of its origin: `T' = T X`. There is no default. Only motions
    of one frame and layout can be added.

    With leading axes, shape `(*batch, 3)`, each pose of shapes `(*batch, 4, 4)` and `(*batch, 7)`
    moves on its own. An axis of 1 is broadcast.

    The flow is the closed form of the exponential, 100 to 200 flops. It is exact to rounding for
    every angle, and so are its derivatives, also at zero. (The rounding of second derivatives
    grows with the square of the angle.) An angle beyond 2^45 (2^16 in float32) gives NaN. A solve
    keeps the length of a quaternion to rounding, however many steps. Matrices are not corrected:
    they drift as vectors do along `cfjax.Rotation`.

    **Arguments:**

    - `omega`: shape `(*batch, 3)`, float32 or float64, in radians per unit of time.
    - `v`: shape and dtype of `omega`, in lengths per unit of time.
    - `frame`: `"body"` or `"fixed"`.
    - `layout`: needed for poses of shape `(7,)`: `"wxyz_xyz"`, as in `jaxlie.SE3`, has the
      quaternion first, and in it the scalar part w; `"xyz_xyzw"`, as in ROS `geometry_msgs/Pose`,
      has the position first, and w last; also `"xyzw_xyz"` and `"xyz_wxyz"`.

    **Raises** `ValueError` for another shape, frame or layout, or for points in the frame of the
    body; `TypeError` for another dtype, or for shape `(7,)` without a layout, as a wrong guess
    would go unnoticed. Starting a solve off the manifold by more than the root of a unit
    of rounding, in the square of the quaternion's length or in an entry of `R^T R`, is an error.
    """

    _: KW_ONLY
    omega: Float[Array, "*batch 3"] = eqx.field(converter=jnp.asarray)
    v: Float[Array, "*batch 3"] = eqx.field(converter=jnp.asarray)
    frame: Frame = eqx.field(static=True)
    layout: Layout | None = eqx.field(static=True, default=None)

    dimension: ClassVar[int] = 3
    number: ClassVar[str] = "a unit quaternion"
    number_size: ClassVar[int] = 4
    layouts: ClassVar[dict[str, tuple[int, ...]]] = {
        "wxyz_xyz": (0, 1, 2, 3, 4, 5, 6),
        "xyz_xyzw": (6, 3, 4, 5, 0, 1, 2),
        "xyzw_xyz": (3, 0, 1, 2, 4, 5, 6),
        "xyz_wxyz": (3, 4, 5, 6, 0, 1, 2),
    }
    conventions: ClassVar[str] = (
        'layout="wxyz_xyz" (a quaternion, then a position, as in jaxlie.SE3), '
        'layout="xyz_xyzw" (a position, then a quaternion, as in ROS geometry_msgs/Pose), '
        '"xyzw_xyz" or "xyz_wxyz"'
    )
    numerics: ClassVar[Any] = rigid_motion


class PlanarMotion(AbstractMotion):
    """A rigid motion of the plane: an angular velocity `omega` and a velocity `v`.

    It acts on

    - a pose as a homogeneous matrix, `(3, 3)`: rotation and position, and (0, 0, 1) below;
    - a pose as one vector, `(4,)`: cosine and sine of its angle, and the position. `layout` says
      which comes first;
    - a point, `(2,)`, in the fixed frame only.

    **Arguments:**

    - `omega`: shape `(*batch,)`, float32 or float64, in radians per unit of time.
    - `v`: shape `(*batch, 2)`, in lengths per unit of time.
    - `frame`: `"body"` or `"fixed"`.
    - `layout`: needed for poses of shape `(4,)`: `"unit_complex_xy"`, as in `jaxlie.SE2`, or
      `"xy_unit_complex"`, with the position first, as in Pinocchio's planar joint.

    Otherwise it is like `cfjax.RigidMotion`.
    """

    _: KW_ONLY
    omega: Float[Array, "*batch"] = eqx.field(converter=jnp.asarray)
    v: Float[Array, "*batch 2"] = eqx.field(converter=jnp.asarray)
    frame: Frame = eqx.field(static=True)
    layout: PlanarLayout | None = eqx.field(static=True, default=None)

    dimension: ClassVar[int] = 2
    number: ClassVar[str] = "a unit complex number"
    number_size: ClassVar[int] = 2
    layouts: ClassVar[dict[str, tuple[int, ...]]] = {
        "unit_complex_xy": (0, 1, 2, 3),
        "xy_unit_complex": (2, 3, 0, 1),
    }
    conventions: ClassVar[str] = (
        'layout="unit_complex_xy" (cosine and sine, then a position, as in jaxlie.SE2) or '
        'layout="xy_unit_complex" (a position first, as in Pinocchio\'s planar joint)'
    )
    numerics: ClassVar[Any] = planar_motion


def _defect(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    rotation, last = matrix[:-1, :-1], matrix[-1]
    eye = jnp.eye(len(matrix), dtype=matrix.dtype)
    gram = matmul(rotation.T, rotation)
    defects = (gram - eye[:-1, :-1], jnp.linalg.det(rotation) - 1, last - eye[-1])
    return jnp.max(jnp.asarray([jnp.max(jnp.abs(x)) for x in defects]))
