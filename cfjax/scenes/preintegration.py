"""Preintegration: a drone's attitude, velocity and position from its own inertial readings.

A drone flies a figure of eight. It is level to its thrust, its nose points along a direction that
swings, and its inertial measurement unit (IMU) reads the angular velocity and the specific force in
the frame of the body. Path and attitude are known functions of time, so the readings are, too, and
the extended pose is known exactly at every time.

An estimator gets samples of the readings, and asks how a window of them changes the pose. The
schemes of the literature hold a sample or take the mean of two. `cfjax.InertialMotion` is exact for
readings that are held, and with `CF4` its error is that of interpolation: order 2 if that is linear
and 4 if it is cubic. Units are metres, seconds and radians.

Sources: Forster, Carlone, Dellaert & Scaramuzza, On-manifold preintegration for real-time
visual-inertial odometry, IEEE Trans. Robot. 33 (2017), doi:10.1109/TRO.2016.2597321; Brossard,
Barrau, Chauchat & Bonnabel, Associating uncertainty to extended poses for on Lie group IMU
preintegration with rotating Earth, IEEE Trans. Robot. 38 (2022), doi:10.1109/TRO.2021.3100156.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_name, in_plain_space, solve

t0, t1 = 0.0, 16.0
# What estimators have is samples, whose interpolation has kinks.
solver = cfjax.CF4()
gravity = np.array([0.0, 0.0, -9.81])

# A quaternion (w, x, y, z), a velocity and a position.
Pose = Float[Array | np.ndarray, "*times 10"]
Vector = Float[Array | np.ndarray, "3"]


class Sensor(NamedTuple):
    """Densities of the noise: of the gyroscope in rad/√s, of the accelerometer in m/s/√s."""

    gyro_noise: Any = 0.0004
    force_noise: Any = 0.006


def place(t: Any) -> Float[Array, "3"]:
    """The position on a figure of eight, 16 m long, that takes 16 s, with two humps."""
    s = 2 * jnp.pi * t / t1
    return jnp.stack([8 * jnp.sin(s), 4 * jnp.sin(2 * s), 4 - 2 * jnp.cos(s)])


def attitude(t: Any) -> Float[Array, "3 3"]:
    """The rotation from the body to fixed coordinates, with the third axis along the thrust."""
    up = _acceleration(t) - jnp.asarray(gravity)
    up /= jnp.linalg.norm(up)
    heading = 0.5 * jnp.sin(2 * t)
    left = jnp.cross(up, jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)]))
    left /= jnp.linalg.norm(left)
    return jnp.stack([jnp.cross(left, up), left, up], axis=1)


def readings(t: Any) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """What gyroscope and accelerometer read at time `t`, exactly."""
    t = jnp.asarray(t)
    turn, rate = jax.jvp(attitude, (t,), (jnp.ones_like(t),))
    spin = turn.T @ rate
    omega = jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
    return omega, turn.T @ (_acceleration(t) - jnp.asarray(gravity))


def y0(t: float = t0) -> Float[np.ndarray, "10"]:
    """The exact extended pose at the start of a window."""
    return reference(t)


def reference(t: float | Float[np.ndarray, "*times"]) -> Float[np.ndarray, "*times 10"]:
    """The exact extended pose at times `t`, to rounding. Its readings are derivatives of it."""

    def one(t: Array) -> Array:
        q = cfjax.quaternion_from_matrix(attitude(t), layout="wxyz")
        return jnp.concatenate([q, _velocity(t), place(t)])

    many = jax.jit(jnp.vectorize(one, signature="()->(n)"))
    return np.asarray(many(jnp.asarray(t, float)))


def field(t: Any, y: Pose, args: Any = None) -> cfjax.InertialMotion:
    """The frozen field of the exact readings. It depends on t but not on the pose."""
    return _motion(*readings(t))


def noise(t: Any, y: Pose, args: Sensor, increment: Float[Array, "6"]) -> cfjax.InertialMotion:
    """The frozen field that an increment of Brownian motion causes."""
    omega, force = args.gyro_noise * increment[:3], args.force_noise * increment[3:]
    return _motion(omega, force, gravity=jnp.zeros_like(omega), time=0.0)


def velocity(t: Any, y: Pose, args: Any = None) -> Pose:
    """The same field in plain space, where no method keeps the length of the quaternion."""
    (w, f), q = readings(t), y[:4]
    vector = q[0] * w + jnp.cross(q[1:], w)
    twice = 2 * jnp.cross(q[1:], f)
    turned = f + q[0] * twice + jnp.cross(q[1:], twice)
    scalar = -jnp.sum(q[1:] * w)
    quaternion = jnp.concatenate([scalar[None], vector]) / 2
    return jnp.concatenate([quaternion, turned + jnp.asarray(gravity), y[4:7]])


def error(y: Pose, exact: Pose) -> float:
    """The distance of two extended poses. q and -q are the same attitude."""
    signs = [np.linalg.norm(np.asarray(y)[:4] - sign * exact[:4]) for sign in (1, -1)]
    return float(np.hypot(min(signs), np.linalg.norm(np.asarray(y)[4:] - exact[4:])))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=None)


def invariants(y: Pose, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"length of q": jnp.linalg.norm(y[:4])}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The flight with exact readings, 80 to 5120 equal steps; Tsit5 and Dopri8 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.RKMK8(), cfjax.Magnus6(), cfjax.Magnus10())
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1),
        num_steps=[80 * 2**k for k in range(7)],
        error=error,
        **options,
    )


class Samples(NamedTuple):
    """Readings at equal distances `period`, with one more than there are intervals."""

    omega: Float[np.ndarray, "samples 3"]
    force: Float[np.ndarray, "samples 3"]
    period: Any


def samples(start: float, duration: float, rate: int) -> Samples:
    """The exact readings of a window, so many in a unit of time."""
    n = round(duration * rate)
    omega, force = jax.jit(jax.vmap(readings))(start + duration * np.arange(n + 1) / n)
    return Samples(np.asarray(omega), np.asarray(force), duration / n)


def on_manifold(seen: Samples, y: Pose, mean: bool = False) -> Pose:
    """The scheme of Forster and others: velocities are moved by the attitude before they turn.

    Each sample is held, or if `mean` the mean of two.
    """

    def step(y: Array, reading: tuple[Array, Array]) -> Array:
        omega, force = reading
        turned = cfjax.quaternion_rotate(y[:4], force, layout="wxyz") + jnp.asarray(gravity)
        return _moved(y, omega, turned, seen.period)

    return _each(step, _pairs(seen, mean), y)


def on_tangent_space(seen: Samples, y: Pose) -> Pose:
    """The same with the rotation since the start as a rotation vector, as in GTSAM. Held."""
    start, step = jnp.asarray(y), seen.period

    def move(y: Array, reading: tuple[Array, Array]) -> Array:
        omega, force = reading
        turn = cfjax.QuaternionRotation(y[:3], frame="body", layout="wxyz")
        q = turn.flow(start[:4])
        rate = cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")
        # The sign of the argument is that of the body's frame.
        vector = y[:3] + step * turn.dexpinv(rate, 20).omega
        turned = cfjax.quaternion_rotate(q, force, layout="wxyz") + jnp.asarray(gravity)
        position = y[6:] + step * y[3:6] + step**2 / 2 * turned
        return jnp.concatenate([vector, y[3:6] + step * turned, position])

    end = _each(move, _pairs(seen, False), jnp.concatenate([jnp.zeros(3), start[4:]]))
    turn = cfjax.QuaternionRotation(end[:3], frame="body", layout="wxyz")
    return jnp.concatenate([turn.flow(start[:4]), end[3:]])


def exact_if_held(seen: Samples, y: Pose, mean: bool = False) -> Pose:
    """The flow of `cfjax.InertialMotion`, as in the scheme of Brossard and others."""

    def step(y: Array, reading: tuple[Array, Array]) -> Array:
        return cfjax.combine((seen.period,), (_motion(*reading),)).flow(y)

    return _each(step, _pairs(seen, mean), y)


def interpolated(seen: Samples, y: Pose, cubic: bool = True) -> Pose:
    """`CF4` with a step to an interval; between two samples it asks for the middle alone.

    That is by four samples, or two if not `cubic`.
    """
    halves = jax.tree.map(lambda x: _halves(x, cubic), (seen.omega, seen.force))
    n = len(seen.omega) - 1

    def by_halves(t: Any, y: Array, args: Any) -> cfjax.InertialMotion:
        index = jnp.round(2 * t / seen.period).astype(int)
        return _motion(*(x[index] for x in args))

    end = n * seen.period
    term = cfjax.LieTerm(by_halves)
    ys: Any = cfjax.integrate(term, solver, 0.0, end, y, halves, num_steps=n).ys
    return ys[-1]


SCHEMES: dict[str, Callable[[Samples, Pose], Pose]] = {
    "on the manifold, held": on_manifold,
    "on the tangent space, held": on_tangent_space,
    "on the manifold, mean of two": lambda seen, y: on_manifold(seen, y, mean=True),
    "exact flow, held": exact_if_held,
    "exact flow, mean of two": lambda seen, y: exact_if_held(seen, y, mean=True),
    "CF4, linear interpolation": lambda seen, y: interpolated(seen, y, cubic=False),
    "CF4, cubic interpolation": interpolated,
}


def errors(
    scheme: Callable[[Samples, Pose], Pose], rate: int, start: float = 2.0, duration: float = 1.0
) -> tuple[float, float, float]:
    """The errors of angle, velocity and position after a window, with `rate` samples a unit."""
    # A program that runs once.
    with cfjax.rewriting(False):
        y = np.asarray(jax.jit(scheme)(samples(start, duration, rate), y0(start)))
    exact = reference(start + duration)
    signs = [np.linalg.norm(y[:4] - sign * exact[:4]) for sign in (1, -1)]
    off = [np.linalg.norm((y - exact)[part]) for part in (slice(4, 7), slice(7, 10))]
    return float(4 * np.arcsin(min(signs) / 2)), float(off[0]), float(off[1])


def covariances(
    args: Sensor | None = None, num_steps: int = 400
) -> tuple[Float[np.ndarray, " times"], cfjax.Variation]:
    """Times, the pose and its covariance, from a start that is known exactly.

    The covariance is that of angles, velocity and position in the frame of the body.
    """
    args = args or Sensor()
    term = cfjax.VariationTerm(cfjax.LieTerm(field), noise=noise, channels=6)
    start = term.start(t0, y0(), args, covariance=jnp.zeros((9, 9)))
    options = dict(term=term, y0=start, args=args, save_every=1, save_initial=True)
    return solve(problem(), solver, num_steps=num_steps, **options)


def picture() -> figures.Figure:
    """Errors of the schemes against the period of the samples; the flight, with 95 % ellipsoids."""
    figure = figures.new(11.0, 4.8)
    curves = figure.add_subplot(1, 2, 1)
    colours = [
        *(figures.VERMILION, figures.ORANGE, figures.PURPLE, "0.5", figures.GREEN),
        *("#56B4E9", figures.BLUE),
    ]
    rates = np.array([25, 100, 400])
    for (name, scheme), colour, marker in zip(SCHEMES.items(), colours, "ox^sDv*", strict=True):
        positions = [errors(scheme, int(rate))[2] for rate in rates]
        curves.loglog(1000 / rates, positions, marker=marker, color=colour, label=name)
    curves.set(title="A window of one second", ylabel="error of the position, m")
    curves.set(xlabel="period of the samples, ms", ylim=(1e-15, 2e-2))
    curves.set_xticks(1000 / rates, [f"{1000 / rate:g}" for rate in rates], minor=False)
    curves.set_xticks([], minor=True)
    curves.legend(frameon=False, fontsize=8)

    flight: Any = figure.add_subplot(1, 2, 2, projection="3d")
    times, ys = covariances()
    flight.plot(*ys.state[:, 7:].T, color="0.3", linewidth=1)
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 25j, 0 : np.pi : 13j]
    ring = np.sin(latitude)
    unit = np.stack([ring * np.cos(longitude), ring * np.sin(longitude), np.cos(latitude)])
    for k in range(0, len(times), len(times) // 8):
        turn = cfjax.quaternion_to_matrix(jnp.asarray(ys.state[k, :4]), layout="wxyz")
        p = turn @ ys.covariance[k, 6:, 6:] @ turn.T
        squares, axes = np.linalg.eigh(np.asarray(p))
        # 95 % of a Gaussian in space is within sqrt(7.815) standard deviations.
        stretch = axes * np.sqrt(7.815 * np.maximum(squares, 0))
        surface = np.einsum("ij,jkl->ikl", stretch, unit) + ys.state[k, 7:, None, None]
        flight.plot_surface(*surface, color=figures.BLUE, alpha=0.25, linewidth=0)
    flight.set(title="Where the drone may be, every 2 s", xlabel="x, m", ylabel="y, m")
    flight.set(zlabel="z, m", xlim=(-10, 10), ylim=(-6, 6), zlim=(0, 8))
    flight.set(xticks=(-8, 0, 8), yticks=(-4, 0, 4), zticks=(0, 4, 8))
    flight.set_box_aspect((20, 12, 8), zoom=1.2)
    flight.view_init(elev=30, azim=-70)
    return figure


def _motion(omega: Any, force: Any, gravity: Any = gravity, time: float = 1.0) -> Any:
    gravity = jnp.asarray(gravity, omega.dtype)
    return cfjax.InertialMotion(
        omega=omega, force=force, gravity=gravity, time=time, layout="wxyz_v_p"
    )


def _velocity(t: Any) -> Array:
    return jax.jvp(place, (t,), (jnp.ones_like(t),))[1]


def _acceleration(t: Any) -> Array:
    t = jnp.asarray(t)
    return jax.jvp(_velocity, (t,), (jnp.ones_like(t),))[1]


def _moved(y: Array, omega: Array, acceleration: Array, step: Any) -> Array:
    turn = cfjax.QuaternionRotation(step * omega, frame="body", layout="wxyz")
    position = y[7:] + step * y[4:7] + step**2 / 2 * acceleration
    return jnp.concatenate([turn.flow(y[:4]), y[4:7] + step * acceleration, position])


def _pairs(seen: Samples, mean: bool) -> tuple[Any, Any]:
    """A reading for each interval."""
    one = lambda x: (x[:-1] + x[1:]) / 2 if mean else x[:-1]  # noqa: E731
    return one(seen.omega), one(seen.force)


def _each(step: Callable[[Any, Any], Any], intervals: Any, y: Any) -> Any:
    return jax.lax.scan(lambda y, reading: (step(y, reading), None), jnp.asarray(y), intervals)[0]


def _halves(x: Any, cubic: bool) -> Any:
    """The samples, and between two of them a value by four of them, or by two."""
    middles = (x[:-1] + x[1:]) / 2
    if cubic:
        inner = (9 * (x[1:-2] + x[2:-1]) - (x[:-3] + x[3:])) / 16
        first = (5 * x[0] + 15 * x[1] - 5 * x[2] + x[3]) / 16
        last = (5 * x[-1] + 15 * x[-2] - 5 * x[-3] + x[-4]) / 16
        middles = jnp.concatenate([first[None], inner, last[None]])
    return jnp.zeros((2 * len(x) - 1, 3)).at[::2].set(x).at[1::2].set(middles)
