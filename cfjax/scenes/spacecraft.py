"""A spacecraft: its attitude as a unit quaternion, and its angular momentum in the body.

`q' = q (0, omega) / 2` and `m' = m x omega + torque`, with `omega = m / inertia`. The start is near
the axis of middle inertia, about which no body turns stably: it tumbles over and over (the tennis
racket theorem). Without torque the momentum in the fixed frame and the energy are constant. All
quantities are dimensionless.

The frozen field rotates the quaternion, and moves the momentum as a rigid motion moves a point, so
only the torque changes its length.

Source: Landau & Lifshitz, Mechanics, Sections 35 to 37.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from . import rigid_body
from ._scene import PROJECTED, by_name, in_plain_space, solve

t0, t1 = 0.0, 40.0
solver = cfjax.Projected(diffrax.Dopri8())
inertia = np.array([3.0, 2.0, 1.0])

# `q`, shape `(*times, 4)`, and `m`, shape `(*times, 3)`.
State = dict[str, Float[Array | np.ndarray, "..."]]


class Craft(NamedTuple):
    """The principal moments of inertia, and thrusters that fire between two times."""

    inertia: Any = inertia
    # In the body's frame.
    torque: Any = (0.0, 0.0, 0.0)
    on: Any = 0.0
    off: Any = 0.0


def y0() -> State:
    """Turned a little off the middle axis. q is stored as (w, x, y, z)."""
    return {"q": np.array([1.0, 0.0, 0.0, 0.0]), "m": np.array([0.05, 1.0, 0.0])}


def field(t: Any, y: State, args: Craft) -> dict[str, Any]:
    """The frozen field. At times `args.on` and `args.off` it jumps: give these as `jump_ts`."""
    omega = y["m"] / jnp.asarray(args.inertia)
    fires = (t >= args.on) & (t < args.off)
    torque = jnp.where(fires, jnp.asarray(args.torque, omega.dtype), 0)
    return {
        "q": cfjax.QuaternionRotation(omega, frame="body", layout="wxyz"),
        "m": cfjax.RigidMotion(omega=-omega, v=torque, frame="fixed"),
    }


def velocity(t: Any, y: State, args: Craft) -> dict[str, Any]:
    """The same field in plain space, where no method keeps the length of the quaternion."""
    w, q = y["m"] / jnp.asarray(args.inertia), y["q"]
    fires = (t >= args.on) & (t < args.off)
    torque = jnp.where(fires, jnp.asarray(args.torque, w.dtype), 0)
    vector = q[0] * w + jnp.cross(q[1:], w)
    scalar = -jnp.sum(q[1:] * w)
    return {"q": jnp.append(scalar, vector) / 2, "m": jnp.cross(y["m"], w) + torque}


def energy(y: State, args: Craft) -> Float[Array, "*times"]:
    """The kinetic energy `m^T I^-1 m / 2`."""
    return rigid_body.energy(y["m"], jnp.asarray(args.inertia))


def fixed_momentum(y: State) -> Float[Array, "*times 3"]:
    """The angular momentum in the fixed frame."""
    return cfjax.quaternion_rotate(jnp.asarray(y["q"]), jnp.asarray(y["m"]), layout="wxyz")


def reference(t: float | Float[np.ndarray, "*times"]) -> State:
    """The exact free motion from `y0()` at times `t`, in NumPy's float64.

    Jacobi's elliptic functions give the momentum in the body. The momentum determines the axes of
    the body except for an angle about the fixed momentum, which is an integral, computed by Gauss's
    rule.
    """
    start = np.asarray(y0()["m"])
    times = np.asarray(t, float)
    momentum = lambda t: rigid_body.reference(t, start, inertia)  # noqa: E731
    length = np.linalg.norm(start)

    # About the momentum e: with the third axis at the angle theta from it, and the others turned
    # about that, the angle of the axis about e grows by this rate.
    def rate(t: np.ndarray) -> np.ndarray:
        square = momentum(t)[..., :2] ** 2
        return length * np.sum(square / inertia[:2], axis=-1) / np.sum(square, axis=-1)

    # Panels of at most 0.1, in which the rate is smooth to rounding with 12 nodes.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    panels = max(1, int(np.ceil(10 * np.max(np.abs(times), initial=0))))
    edges = np.multiply.outer(times, np.linspace(0, 1, panels + 1))
    half = (edges[..., 1:] - edges[..., :-1]) / 2
    middle = (edges[..., 1:] + edges[..., :-1]) / 2
    inner = np.sum(rate(middle[..., None] + half[..., None] * nodes) * weights, axis=-1)
    angle = np.sum(inner * half, axis=-1)

    m = momentum(times)
    # About the momentum by that angle, between the frames of start and end.
    zero = np.zeros_like(angle)
    cosine, sine = np.cos(angle), np.sin(angle)
    rows = (cosine, -sine, zero), (sine, cosine, zero), (zero, zero, zero + 1)
    turn = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    attitude = _frame(start) @ turn @ np.swapaxes(_frame(m), -1, -2)
    return {"q": _quaternion(attitude), "m": m}


def error(y: State, exact: State) -> float:
    """The distance of two states. q and -q are the same attitude."""
    q = np.asarray(y["q"])
    off = min(float(np.linalg.norm(q - sign * exact["q"])) for sign in (1, -1))
    return float(np.hypot(off, np.linalg.norm(np.asarray(y["m"]) - exact["m"])))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=Craft())


def invariants(y: State, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {
        "energy": energy(y, args),
        "momentum in the fixed frame": fixed_momentum(y),
        "length of the quaternion": jnp.linalg.norm(y["q"]),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A tumbling spacecraft to t = 40, 100 to 6400 equal steps; Tsit5 and Dopri8 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(
            cfjax.CF3(), cfjax.CF4(), cfjax.RKMK4(), cfjax.CF43(), cfjax.CF54(), cfjax.RKMK8()
        )
        | by_name(*PROJECTED)
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1),
        error=error,
        num_steps=[100 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """The path of the body's middle axis on the sphere, and the momentum in the body, to t = 40."""
    times, ys = solve(problem(), solver, num_steps=800, save_every=1)
    middle = jnp.broadcast_to(jnp.asarray([0.0, 1.0, 0.0], ys["q"].dtype), ys["m"].shape)
    path = np.asarray(cfjax.quaternion_rotate(ys["q"], middle, layout="wxyz"))
    figure = figures.new(9.0, 4.2)
    sphere: Any = figure.add_subplot(1, 2, 1, projection="3d")
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 25j, 0 : np.pi : 13j]
    ring = np.sin(latitude)
    ball = ring * np.cos(longitude), ring * np.sin(longitude), np.cos(latitude)
    sphere.plot_wireframe(*ball, color="0.85", linewidth=0.5)
    sphere.plot(*path.T, color=figures.BLUE, linewidth=1.2)
    sphere.scatter(*path[0], color=figures.VERMILION, s=30)
    sphere.set(title="The middle axis, from the dot on")
    sphere.set_axis_off()
    sphere.set_box_aspect((1, 1, 1), zoom=1.3)
    body = figure.add_subplot(1, 2, 2)
    for name, values, style in zip("123", ys["m"].T, ("-", "-", ":"), strict=True):
        body.plot(times, values, style, label=f"axis {name}")
    body.set(title="Momentum in the body", xlabel="t", ylim=(-1.4, 1.15))
    body.legend(loc="lower right", ncols=3, frameon=False)
    return figure


def _frame(m: Float[np.ndarray, "*times 3"]) -> Float[np.ndarray, "*times 3 3"]:
    """In the body: along m, the part of the third axis across it, and what is across both."""
    along = m / np.linalg.norm(m, axis=-1, keepdims=True)
    across = np.array([0.0, 0.0, 1.0]) - along * along[..., 2:]
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([across, np.cross(along, across), along], axis=-1)


def _quaternion(r: Float[np.ndarray, "*times 3 3"]) -> Float[np.ndarray, "*times 4"]:
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(r.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return q.reshape(*r.shape[:-2], 4)
