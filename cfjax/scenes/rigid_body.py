"""The free rigid body: Euler's equations for the angular momentum in the body frame.

`y' = y x (I^-1 y)` in R^3, with the inertia tensor `I = diag(inertia)`. All quantities are
dimensionless. The norm of y and the energy are constant. Frozen at y, the field is a rotation of
space.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.1, doi:10.1016/S0167-739X(02)00161-9.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from .._numerics.matmul import matmul
from . import _figures as figures
from ._scene import PROJECTED, by_name, in_plain_space

t0, t1 = 0.0, 100.0
solver = cfjax.Projected(diffrax.Dopri8())
y0 = np.array([8 / 9, 4 / 9, 1 / 9])
inertia = np.array([7 / 8, 5 / 8, 1 / 4])

# From DOP853 with a relative tolerance of 1e-13, rounded to 13 decimals.
tabulated = {
    1.0: np.array([0.9772312506553, -0.0356648663122, 0.2091580743211]),
    10.0: np.array([0.9776011780424, 0.020275466239, -0.2094870930605]),
    100.0: np.array([0.9702525351138, -0.1321047601124, -0.2028752090839]),
}


def field(t: Any, y: Float[Array, "3"], args: Float[Array | np.ndarray, "3"]) -> cfjax.Rotation:
    """The frozen field at angular momentum `y`, with the principal moments `args`."""
    return cfjax.Rotation(-y / args)


def velocity(t: Any, y: Float[Array, "3"], args: Any) -> Float[Array, "3"]:
    """The same field in plain space, where no method keeps the norm."""
    return jnp.cross(y, y / args)


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

    It uses Jacobi elliptic functions: the body turns about the axis of largest inertia, the first
    one, where y_1 > 0 keeps its sign. So the entries of `inertia` must be in falling order, and
    `y0` must be on that side of the middle axis: `y0 @ y0 >= inertia[1] * (y0 / inertia) @ y0`. The
    error is below 1e-14 for `|t| <= 100` and the default start. Source: Landau & Lifshitz,
    Mechanics, Section 37.
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


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0, args=inertia)


def invariants(y: Float[Array, "3"], args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"energy": energy(y, args), "length of the momentum": jnp.linalg.norm(y)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The free rigid body, 500 to 32 000 equal steps to t = 100; Tsit5 and Dopri5 in space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF3(), cfjax.RKMK3(), cfjax.CF4(), cfjax.RKMK4(), cfjax.CF43())
        | by_name(*PROJECTED)
        | in_plain_space(velocity, diffrax.Dopri5(), diffrax.Tsit5()),
        reference=reference(t1),
        num_steps=[500 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """Paths of the momentum to t = 20, and the energy, which methods keep to their order.

    The body turns stably about the axes of least and of largest inertia, but not about the middle
    one.
    """
    # Through the axes of largest and of least inertia, on both sides of the one between them.
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False) + np.pi / 24
    starts = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1)

    def solve(start: Any, solver: Any, n: int) -> Any:
        arguments: Any = problem() | dict(t1=20.0, y0=start)
        return cfjax.integrate(**arguments, solver=solver, num_steps=n, save_every=1)

    paths = np.asarray(jax.vmap(lambda start: solve(start, solver, 400).ys)(jnp.asarray(starts)))
    figure = figures.new(9.0, 4.2)
    sphere = figures.sphere(figure, 1, 2, 1, zoom=1.35, color="0.9")
    towards = np.array([1.0, 0.8, 0.7])
    for path in paths:
        # What is behind the sphere is left out.
        seen = np.where((path @ towards > 0)[:, None], path, np.nan)
        is_about_the_first = energy(path[0], inertia) < 0.5 / inertia[1]
        colour = figures.BLUE if is_about_the_first else figures.VERMILION
        sphere.plot(*seen.T, color=colour, linewidth=1.2)
    for name, axis in zip("123", np.eye(3), strict=True):
        sphere.text(*(1.1 * axis), name, ha="center", va="center")
    sphere.view_init(elev=29, azim=39)
    sphere.set(title="The momentum in the body, with its axes")

    drift = figure.add_subplot(1, 2, 2)
    n, exact = 80, float(energy(y0, inertia))
    methods = (cfjax.CF3(), figures.GREEN), (cfjax.CF4(), figures.BLUE), (solver, "k")
    for method, colour in methods:
        sol, name = solve(y0, method, n), type(method).__name__
        off = np.abs(np.asarray(energy(sol.ys, inertia)) - exact)
        drift.semilogy(np.asarray(sol.ts), np.maximum(off, 1e-17), color=colour, label=name)
    drift.set(title=f"Error of the energy, steps of {20 / n:g}", xlabel="t")
    drift.legend(frameon=False, loc="center right")
    return figure
