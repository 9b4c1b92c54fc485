"""The free rigid body: Euler's equations for the angular momentum in the body frame.

`y' = y x (I^-1 y)` in R^3, with the inertia tensor `I = diag(inertia)`. All quantities are
dimensionless. The norm of y and the energy are constant. Frozen at y, the field is a rotation of
space.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.1, doi:10.1016/S0167-739X(02)00161-9.
"""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import CF3, CF4, CF43, RKMK3, RKMK4, LieTerm, Rotation, WorkPrecision, work_precision
from .._numerics.matmul import matmul

t0, t1 = 0.0, 100.0
y0 = np.array([8 / 9, 4 / 9, 1 / 9])
inertia = np.array([7 / 8, 5 / 8, 1 / 4])

# From DOP853 with a relative tolerance of 1e-13, rounded to 13 decimals.
tabulated = {
    1.0: np.array([0.9772312506553, -0.0356648663122, 0.2091580743211]),
    10.0: np.array([0.9776011780424, 0.020275466239, -0.2094870930605]),
    100.0: np.array([0.9702525351138, -0.1321047601124, -0.2028752090839]),
}


def field(t: Any, y: Float[Array, "3"], args: Float[Array | np.ndarray, "3"]) -> Rotation:
    """The frozen field at angular momentum `y`, with the principal moments `args`."""
    return Rotation(-y / args)


def energy(
    y: Float[Array | np.ndarray, "*batch 3"], inertia: Float[Array | np.ndarray, "3"]
) -> Float[Array, "*batch"]:
    """The kinetic energy `y^T I^-1 y / 2`."""
    return matmul(y * y, 0.5 / inertia)


def reference(
    t: float | Float[Array | np.ndarray, "*times"],
    y0: Float[np.ndarray, "3"] = y0,
    inertia: Float[np.ndarray, "3"] = inertia,
) -> Float[np.ndarray, "*times 3"]:
    """The exact solution at times `t`, in NumPy's float64.

    Jacobi elliptic functions: the body turns about the axis of largest inertia, the first one,
    where y_1 > 0 keeps its sign. So `inertia` must fall, and `y0` be on that side of the middle
    axis: `y0 @ y0 >= inertia[1] * (y0 / inertia) @ y0`. The error is below 1e-14 for `|t| <= 100`
    and the default start. Source: Landau & Lifshitz, Mechanics, Section 37.
    """
    # Not at import: few who import the package need it.
    from scipy.special import ellipj, ellipkinc

    a, b, c = 1 / inertia
    momentum, twice_energy = y0 @ y0, (y0 * y0) @ (1 / inertia)
    tilt = twice_energy - a * momentum
    y1_max = np.sqrt((c * momentum - twice_energy) / (c - a))
    y2_max = np.sqrt(tilt / (b - a))
    y3_max = np.sqrt(tilt / (c - a))
    rate = y1_max * np.sqrt((c - a) * (b - a))
    m = (c - b) * y2_max * y3_max / (rate * y1_max)
    start = ellipkinc(np.arctan2(-y0[1] / y2_max, y0[2] / y3_max), m)
    sn, cn, _, _ = ellipj(rate * np.asarray(t, float) + start, m)
    # SciPy's own dn is wrong by 3e-14.
    dn = np.sqrt(1 - m * sn**2)
    return np.stack([y1_max * dn, -y2_max * sn, y3_max * cn], axis=-1)


def chart(**options: Any) -> WorkPrecision:
    """The free rigid body, 500 to 32 000 equal steps to t = 100; Tsit5 and Dopri5 in space."""
    space = diffrax.ODETerm(lambda t, y, args: jnp.cross(y, y / args))
    return work_precision(
        LieTerm(field),
        t0,
        t1,
        y0,
        inertia,
        methods={
            "CF3": CF3(),
            "RKMK3": RKMK3(),
            "CF4": CF4(),
            "RKMK4": RKMK4(),
            "CF43": CF43(),
            "Dopri5": (space, diffrax.Dopri5()),
            "Tsit5": (space, diffrax.Tsit5()),
        },
        reference=reference(t1),
        num_steps=[500 * 2**k for k in range(7)],
        **options,
    )
