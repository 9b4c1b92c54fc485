"""Motions of extended poses by what an inertial measurement unit reads, and gravity."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._numerics import inertial_motion
from .extended_motion import LAYOUTS, LAYOUTS_IN_WORDS, ExtendedMotion, Layout
from .motion import AbstractMotion


class InertialMotion(AbstractMotion):
    """The motion of a body with an inertial measurement unit (IMU), by its readings and gravity.

    The state is an extended pose, an attitude R, which takes the coordinates of the body to fixed
    ones, a velocity and a position. They move by

        R' = R (omega x),  velocity' = R force + gravity,  position' = time * velocity

    with the angular velocity `omega` and the specific force `force` in the coordinates of the body,
    as gyroscope and accelerometer read them, and `gravity` in fixed coordinates. It acts on

    - an extended pose as a matrix, `(5, 5)`: `[[R, velocity, position], [0, 1, 0], [0, 0, 1]]`;
    - an extended pose as one vector, `(10,)`, the fastest: a unit quaternion, the velocity and the
      position. `layout` says where they are.

    The flow is a closed form, exact to rounding for every angle: with constant readings one step of
    any length is exact. Readings that depend on time but not on the state make a field for Magnus
    methods. These fields are closed under the bracket: `time` is a coordinate, as sums of fields
    and step sizes scale it, and brackets add the two shifts below. `dexpinv` is a series.

    The noise of an IMU, in `cfjax.LieControlTerm`, is a motion with `time=0` and no gravity.

    Leading axes, rounding, and starts off the manifold are as with `cfjax.RigidMotion`.

    **Arguments:**

    - `omega`: shape `(*batch, 3)`, float32 or float64, in radians per unit of time.
    - `force`: shape and dtype of `omega`; the acceleration less gravity.
    - `gravity`: shape `(3,)`, or that of `omega`.
    - `time`: shape `()`, or the leading axes of `omega`.
    - `layout`: needed for poses of shape `(10,)`, as in `cfjax.ExtendedMotion`: for example
      `"wxyz_v_p"`.
    - `body_shift`, `fixed_shift`: shape `(3,)`, or that of `omega`: velocities of only the
      position, in the coordinates of the body and in fixed ones. They are zero by default; brackets
      need them.

    **Raises** `ValueError` for another shape or layout; `TypeError` for another dtype, or for shape
    `(10,)` without a layout, as a wrong guess would go unnoticed.

    Source: Brossard, Barrau, Chauchat & Bonnabel, Associating uncertainty to extended poses for
    on Lie group IMU preintegration with rotating Earth, IEEE Trans. Robot. 38 (2022),
    doi:10.1109/TRO.2021.3100156.
    """

    omega: Float[Array, "*batch 3"]
    force: Float[Array, "*batch 3"]
    gravity: Float[Array, "*batch 3"]
    time: Float[Array, "*batch"]
    layout: Layout | None = eqx.field(static=True)
    body_shift: Float[Array, "*batch 3"]
    fixed_shift: Float[Array, "*batch 3"]

    dimension: ClassVar[int] = 3
    num_vectors: ClassVar[int] = 2
    coordinates: ClassVar[tuple[str, ...]] = (
        *("omega", "force", "gravity", "time"),
        *("body_shift", "fixed_shift"),
    )
    vector: ClassVar[str] = "omega"
    conventions: ClassVar[tuple[str, ...]] = ("layout",)
    number: ClassVar[str] = "a unit quaternion"
    number_size: ClassVar[int] = 4
    layouts: ClassVar[dict[str, tuple[int, ...]]] = LAYOUTS
    layouts_in_words: ClassVar[str] = LAYOUTS_IN_WORDS
    numerics: ClassVar[Any] = inertial_motion

    def __init__(
        self,
        *,
        omega: ArrayLike,
        force: ArrayLike,
        gravity: ArrayLike,
        time: ArrayLike = 1.0,
        layout: Layout | None = None,
        body_shift: ArrayLike | None = None,
        fixed_shift: ArrayLike | None = None,
    ):
        omega = jnp.asarray(omega)

        def for_each(x: ArrayLike | None, core: tuple[int, ...]) -> Array:
            """One for all leading axes is repeated, so that sums keep their shapes."""
            if x is None:
                return jnp.zeros_like(omega)
            x = jnp.asarray(x, omega.dtype if isinstance(x, int | float) else None)
            return jnp.broadcast_to(x, omega.shape[:-1] + core) if x.shape == core else x

        self.omega, self.force = omega, jnp.asarray(force)
        self.gravity, self.time = for_each(gravity, (3,)), for_each(time, ())
        self.layout = layout
        self.body_shift, self.fixed_shift = for_each(body_shift, (3,)), for_each(fixed_shift, (3,))

    def __check_init__(self):
        shape = self.omega.shape
        if not shape or shape[-1] != 3:
            raise ValueError(f"omega must have shape (3,) or (*batch, 3), got {shape}.")
        for name in self.coordinates:
            found = getattr(self, name).shape
            if name == "time":
                expected, core = shape[:-1], ()
            else:
                expected, core = shape, (3,)
            if found != expected:
                one = "" if name == "force" or core == expected else f"{core} or "
                raise ValueError(
                    f"{name} must have shape {one}{expected} where omega has {shape}, got {found}."
                )
        self._check_dtypes()
        self._check_layout()

    def framed(self, point: Float[Array, "..."]) -> ExtendedMotion:
        """The motion in the frame of the body that gives a pose the same velocity."""
        omega, a, v = self._each(inertial_motion.in_body, point)
        return ExtendedMotion(omega=omega, a=a, v=v, frame="body", layout=self.layout)
