"""The heavy top: a rigid body that turns about a fixed point under its weight, as a pose on SE(3).

With R the attitude, r the position of the centre of mass from the fixed point, and m the angular
momentum about that point, r and m in the fixed frame:

`R' = R hat(omega)`, `r' = R cross(omega, c)`, `m' = cross(r, weight)`, `omega = R^T m / inertia`,

where c is the centre of mass in the body. The third axis points upwards. Units are kg, m and s.

The frozen field is one motion of the body, with the angular velocity omega and the velocity
`cross(omega, c)` of its centre of mass. Such motions leave the fixed point where it is, so there is
no constraint that could drift. The momentum moves by a translation: no method changes its part
about the vertical. Energy is kept to the order of the method.

The numbers are from a benchmark of multibody dynamics: a disc on a rod, which spins fast.

Source: Brüls & Cardona, On the use of Lie group time integrators in multibody dynamics, J. Comput.
Nonlinear Dyn. 5 (2010), doi:10.1115/1.4001370.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 2.0
# Over long times a splitting, see the page on them.
solver = cfjax.Projected(diffrax.Dopri8())

# `pose`, shape `(*times, 7)`, and `m`, shape `(*times, 3)`.
State = dict[str, Float[Array | np.ndarray, "..."]]


class Top(NamedTuple):
    """A top whose axis is the second axis of the body."""

    mass: Any = 15.0
    # About the fixed point: there the principal axes are those of the body.
    inertia: Any = (15.234375, 0.46875, 15.234375)
    # Seen from the fixed point, in the body.
    center: Any = (0.0, 1.0, 0.0)
    gravity: Any = 9.81


benchmark = Top()


def y0(
    tilt: float = np.pi / 2,
    spin: float = 150.0,
    precession: float = -4.61538,
    args: Top = benchmark,
) -> State:
    """The axis at an angle `tilt` from the vertical, above the second axis of the fixed frame.

    The body turns about its axis with the angular velocity `spin`, and about the vertical with
    `precession`. The pose is a quaternion (w, x, y, z) and the position of the centre of mass.
    """
    half = (np.pi / 2 - tilt) / 2
    q = np.array([np.cos(half), np.sin(half), 0.0, 0.0])
    vertical = _rotate_np(_conjugate(q), np.array([0.0, 0.0, 1.0]))
    omega = np.array([0.0, spin, 0.0]) + precession * vertical
    return {
        "pose": np.concatenate([q, _rotate_np(q, np.asarray(args.center))]),
        "m": _rotate_np(q, np.asarray(args.inertia) * omega),
    }


def field(t: Any, y: State, args: Top) -> dict[str, Any]:
    """The frozen field."""
    q, x = y["pose"][:4], y["pose"][4:]
    omega = angular_velocity(y, args)
    v = jnp.cross(omega, jnp.asarray(args.center, q.dtype))
    return {
        "pose": cfjax.RigidMotion(omega=omega, v=v, frame="body", layout="wxyz_xyz"),
        "m": jnp.cross(x, _weight(args, q.dtype)),
    }


def velocity(t: Any, y: State, args: Top) -> dict[str, Any]:
    """The same field in plain space, where neither the quaternion nor the fixed point stays."""
    q, x = y["pose"][:4], y["pose"][4:]
    turn = lambda q, a: a + 2 * jnp.cross(q[1:], q[0] * a + jnp.cross(q[1:], a))  # noqa: E731
    omega = turn(_conjugate(q), y["m"]) / jnp.asarray(args.inertia, q.dtype)
    scalar = -jnp.sum(q[1:] * omega)
    vector = q[0] * omega + jnp.cross(q[1:], omega)
    moved = turn(q, jnp.cross(omega, jnp.asarray(args.center, q.dtype)))
    return {
        "pose": jnp.concatenate([jnp.append(scalar, vector) / 2, moved]),
        "m": jnp.cross(x, _weight(args, q.dtype)),
    }


def angular_velocity(y: State, args: Top) -> Float[Array, "*times 3"]:
    """The angular velocity omega, in the body."""
    q = y["pose"][..., :4]
    momentum = cfjax.quaternion_rotate(_conjugate(q), y["m"], layout="wxyz")
    return momentum / jnp.broadcast_to(jnp.asarray(args.inertia, q.dtype), momentum.shape)


def energy(y: State, args: Top) -> Float[Array, "*times"]:
    """The kinetic energy and that of the weight, in J."""
    omega = angular_velocity(y, args)
    inertia = jnp.broadcast_to(jnp.asarray(args.inertia, omega.dtype), omega.shape)
    height = y["pose"][..., 6]
    return jnp.sum(inertia * omega**2, axis=-1) / 2 + args.mass * args.gravity * height


def vertical_momentum(y: State) -> Float[Array | np.ndarray, "*times"]:
    """The angular momentum about the vertical, in kg m^2 / s."""
    return y["m"][..., 2]


def pivot(y: State, args: Top) -> Float[Array | np.ndarray, "*times 3"]:
    """Where the pose puts the point of the body that should stay at zero."""
    q, x = y["pose"][..., :4], y["pose"][..., 4:]
    center = jnp.broadcast_to(jnp.asarray(args.center, q.dtype), x.shape)
    return x - cfjax.quaternion_rotate(q, center, layout="wxyz")


def reference(t: float, start: State | None = None, args: Top = benchmark) -> State:
    """The state at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13.

    The reference uses the momentum in the body's frame, where `m' = cross(m, omega) + torque`, and
    takes the centre of mass from the attitude. The error for the benchmark is about 2e-12.
    """
    start = y0() if start is None else start
    inertia, center = np.asarray(args.inertia), np.asarray(args.center)
    weight = np.array([0.0, 0.0, -args.mass * args.gravity])

    def rate(t: float, y: State) -> State:
        q, m = y["q"], y["m"]
        omega = m / inertia
        torque = np.cross(center, _rotate_np(_conjugate(q), weight))
        vector = q[0] * omega + np.cross(q[1:], omega)
        scalar = -(q[1:] @ omega)
        return {"q": np.append(scalar, vector) / 2, "m": np.cross(m, omega) + torque}

    q = np.asarray(start["pose"])[:4]
    m = _rotate_np(_conjugate(q), np.asarray(start["m"]))
    end = by_dop853(rate, {"q": q, "m": m}, t)
    q, m = end["q"] / np.linalg.norm(end["q"]), end["m"]
    return {"pose": np.concatenate([q, _rotate_np(q, center)]), "m": _rotate_np(q, m)}


def error(y: State, exact: State) -> float:
    """The distance of two states, relative to their length for momenta.

    The quaternions q and -q are the same attitude.
    """
    pose, m = np.asarray(y["pose"]), np.asarray(y["m"])
    turned = min(np.linalg.norm(pose[:4] - s * exact["pose"][:4]) for s in (1, -1))
    moved = np.linalg.norm(pose[4:] - exact["pose"][4:])
    pushed = np.linalg.norm(m - exact["m"]) / np.linalg.norm(exact["m"])
    return float(np.linalg.norm([turned, moved, pushed]))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=benchmark)


def invariants(y: State, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {
        "energy (J)": energy(y, args),
        "momentum about the vertical": jnp.asarray(vertical_momentum(y)),
        "length of the quaternion": jnp.linalg.norm(y["pose"][:4]),
        "distance of the fixed point from zero": jnp.linalg.norm(pivot(y, args)),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The heavy top to t = 2, 125 to 8000 equal steps; Tsit5 and Dopri8 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(
            cfjax.CF3(), cfjax.CF4(), cfjax.RKMK4(), cfjax.CF43(), cfjax.CF54(), cfjax.RKMK8()
        )
        | by_name(*PROJECTED)
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1),
        error=error,
        num_steps=[125 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """Three tops to t = 5.6, and the paths of their axes on the sphere, from dark to bright.

    The path of an axis that starts backwards has loops, from rest it has cusps, and forwards it is
    a wave.
    """
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    starts = {"Started backwards": -1.2, "From rest": 0.0, "Started forwards": 0.8}
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 37j, 0 : np.pi / 2 : 10j]
    ring = np.sin(latitude)
    dome = ring * np.cos(longitude), ring * np.sin(longitude), np.cos(latitude)
    # A cone around the second axis of the body, then its base, in sectors of two colours.
    angle = np.linspace(0, 2 * np.pi, 49)
    rim = np.stack([0.3 * np.cos(angle), 0 * angle + 0.8, 0.3 * np.sin(angle)], axis=-1)
    edges = np.stack([rim[:-1], rim[1:]], axis=1)
    cone, base = (np.insert(edges, 2, [0, y, 0], axis=1) for y in (0.0, 0.8))
    sector = np.arange(48) // 8 % 2
    parts = (
        (cone, np.where(sector, "#A34800", "#C2B41F")),
        (base, np.where(sector, figures.VERMILION, "#F0E442")),
    )

    figure = figures.new(10.5, 3.6)
    for k, (title, precession) in enumerate(starts.items(), 1):
        start, steps = y0(1.0, 320.0, precession), dict(num_steps=5600, save_every=10)
        poses = solve(problem(), solver, t1=5.6, y0=start, **steps)[1]["pose"]
        path, end = poses[:, 4:], poses[-1, 4:]
        rotation = np.asarray(cfjax.quaternion_to_matrix(poses[-1, :4], layout="wxyz"))
        ax: Any = figure.add_subplot(1, 3, k, projection="3d", computed_zorder=False)
        ax.plot_wireframe(*dome, color="0.88", linewidth=0.5, zorder=0)
        for part, colours in parts:
            sectors = Poly3DCollection(part @ rotation.T, facecolors=colours, zorder=1)
            ax.add_collection3d(sectors)
        ax.plot(*np.stack([0.8 * end, end]).T, color="0.2", linewidth=1.5, zorder=2)
        lines = np.stack([path[:-1], path[1:]], axis=1)
        hue = np.arange(len(lines))
        coloured = Line3DCollection(lines, array=hue, cmap="viridis", linewidth=1.8, zorder=3)
        ax.add_collection3d(coloured)
        ax.set(xlim=(-0.75, 0.75), ylim=(-0.75, 0.75), zlim=(0, 0.75))
        ax.set_title(title, y=0.95)
        ax.set_axis_off()
        ax.view_init(elev=40, azim=120)
        ax.set_box_aspect((2, 2, 1), zoom=1.0)
    return figure


def _weight(args: Top, dtype: Any) -> Float[Array, "3"]:
    return jnp.asarray([0.0, 0.0, -args.mass * args.gravity], dtype)


def _conjugate(q: Any) -> Any:
    return q * np.broadcast_to(np.array([1, -1, -1, -1], q.dtype), q.shape)


def _rotate_np(q: Float[np.ndarray, "4"], x: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A vector turned by a unit quaternion, in NumPy."""
    return x + 2 * np.cross(q[1:], q[0] * x + np.cross(q[1:], x))
