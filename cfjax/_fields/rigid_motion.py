"""Rigid motions of space and of the plane: the Lie algebras se(3) and se(2)."""

from dataclasses import KW_ONLY
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import planar_motion, rigid_motion
from .._numerics.quaternion import Frame
from .elementwise import check_point
from .motion import AbstractFramedMotion

Layout = Literal["wxyz_xyz", "xyz_xyzw", "xyzw_xyz", "xyz_wxyz"]
PlanarLayout = Literal["unit_complex_xy", "xy_unit_complex"]


class AbstractPointMotion(AbstractFramedMotion):
    """A motion of poses with a position, and of points."""

    num_vectors: ClassVar[int] = 1
    coordinates: ClassVar[tuple[str, ...]] = ("omega", "v")

    def _check_point(self, point: Array) -> None:
        axes, poses, core = self._num_axes, self._pose_shapes, (self.dimension,)
        if self.frame == "body" and point.shape[axes:] == core:
            raise ValueError(
                f'{type(self).__name__} with frame="body" moves poses, shapes {poses[0]} and '
                f"{poses[1]}: a point has no frame of its own, got shape {point.shape}. Use "
                'frame="fixed".'
            )
        check_point(self, self.vector, axes, poses + [core] * (self.frame == "fixed"), point)


class RigidMotion(AbstractPointMotion):
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
    layouts_in_words: ClassVar[str] = (
        'layout="wxyz_xyz" (a quaternion, then a position, as in jaxlie.SE3), '
        'layout="xyz_xyzw" (a position, then a quaternion, as in ROS geometry_msgs/Pose), '
        '"xyzw_xyz" or "xyz_wxyz"'
    )
    numerics: ClassVar[Any] = rigid_motion


class PlanarMotion(AbstractPointMotion):
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
    layouts_in_words: ClassVar[str] = (
        'layout="unit_complex_xy" (cosine and sine, then a position, as in jaxlie.SE2) or '
        'layout="xy_unit_complex" (a position first, as in Pinocchio\'s planar joint)'
    )
    numerics: ClassVar[Any] = planar_motion
