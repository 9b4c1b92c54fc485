"""Motions of extended poses, a rotation with a velocity and a position: the algebra se_2(3)."""

from dataclasses import KW_ONLY
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import extended_motion
from .._numerics.quaternion import Frame
from .motion import AbstractFramedMotion

Layout = Literal[
    "wxyz_v_p",
    "xyzw_v_p",
    "wxyz_p_v",
    "xyzw_p_v",
    "p_wxyz_v",
    "p_xyzw_v",
    "p_v_wxyz",
    "p_v_xyzw",
]


def _indices(layout: str) -> tuple[int, ...]:
    """The indices of w, x, y, z of the quaternion, of the velocity and of the position."""
    places, end = {}, 0
    for part in layout.split("_"):
        letters = part if len(part) == 4 else [part + x for x in "xyz"]
        places |= {letter: end + k for k, letter in enumerate(letters)}
        end += len(letters)
    return tuple(places[x] for x in (*"wxyz", "vx", "vy", "vz", "px", "py", "pz"))


LAYOUTS = {layout: _indices(layout) for layout in get_args(Layout)}
LAYOUTS_IN_WORDS = (
    'layout="wxyz_v_p" (a quaternion, then a velocity and a position), "p_xyzw_v" (as in '
    f"manif::SE_2_3), {', '.join(repr(x) for x in LAYOUTS if x not in ('wxyz_v_p', 'p_xyzw_v'))}"
).replace("'", '"')


class ExtendedMotion(AbstractFramedMotion):
    """A motion of an extended pose: an angular velocity `omega`, an acceleration `a` and a `v`.

    An extended pose is an attitude R, which takes the coordinates of the body to fixed ones, a
    velocity and a position. The group of such motions is SE_2(3). It acts on

    - an extended pose as a matrix, `(5, 5)`: `[[R, velocity, position], [0, 1, 0], [0, 0, 1]]`;
    - an extended pose as one vector, `(10,)`: a unit quaternion, the velocity and the position.
      `layout` says where they are.

    With the matrix `X = [[omega x, a, v], [0, 0, 0], [0, 0, 0]]`, an extended pose T moves by
    `T' = X T` with `frame="fixed"`: velocity and position turn about the origin, and `a` and `v`
    are added to what that gives. With `frame="body"` it is `T' = T X`: `a` and `v` are the
    derivatives of velocity and position, in the coordinates of the body. So the position does not
    move with the velocity of the pose unless `v` says so: for a body that flies by itself use
    `cfjax.InertialMotion`. There is no default. Only motions of one frame and layout can be added.

    With leading axes, shape `(*batch, 3)`, each pose of shapes `(*batch, 5, 5)` and `(*batch, 10)`
    moves on its own. An axis of 1 is broadcast.

    The flow is the closed form of the exponential. It is exact to rounding for every angle, and so
    are its derivatives, also at zero. Bracket and `dexpinv` are closed forms too. Rounding is as
    with `cfjax.RigidMotion`.

    **Arguments:**

    - `omega`: shape `(*batch, 3)`, float32 or float64, in radians per unit of time.
    - `a`, `v`: shape and dtype of `omega`.
    - `frame`: `"body"` or `"fixed"`.
    - `layout`: needed for poses of shape `(10,)`. It lists the parts in order: `"wxyz"` or
      `"xyzw"`, a quaternion with its scalar part w first or last; `"v"`, the velocity; `"p"`, the
      position. So `"wxyz_v_p"`, `"wxyz_p_v"`, `"p_wxyz_v"`, `"p_v_wxyz"`, and the same with
      `"xyzw"`; `"p_xyzw_v"` is that of manif's `SE_2_3`.

    **Raises** `ValueError` for another shape, frame or layout; `TypeError` for another dtype, or
    for shape `(10,)` without a layout, as a wrong guess would go unnoticed. Starting a solve off
    the manifold is an error, as with `cfjax.RigidMotion`.

    Source: Barrau & Bonnabel, The invariant extended Kalman filter as a stable observer, IEEE
    Trans. Autom. Control 62 (2017), doi:10.1109/TAC.2016.2594085.
    """

    _: KW_ONLY
    omega: Float[Array, "*batch 3"] = eqx.field(converter=jnp.asarray)
    a: Float[Array, "*batch 3"] = eqx.field(converter=jnp.asarray)
    v: Float[Array, "*batch 3"] = eqx.field(converter=jnp.asarray)
    frame: Frame = eqx.field(static=True)
    layout: Layout | None = eqx.field(static=True, default=None)

    dimension: ClassVar[int] = 3
    num_vectors: ClassVar[int] = 2
    coordinates: ClassVar[tuple[str, ...]] = ("omega", "a", "v")
    number: ClassVar[str] = "a unit quaternion"
    number_size: ClassVar[int] = 4
    layouts: ClassVar[dict[str, tuple[int, ...]]] = LAYOUTS
    layouts_in_words: ClassVar[str] = LAYOUTS_IN_WORDS
    numerics: ClassVar[Any] = extended_motion
