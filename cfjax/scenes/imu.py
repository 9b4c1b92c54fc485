"""Dead reckoning: the pose of a vehicle in the plane, from noisy readings of its own motion.

A gyroscope measures the rate of turn, and the wheels measure the speed. Both readings carry white
noise, in the sense of Stratonovich, and the wheels slip a little to the sides. The field is
constant in the frame of the vehicle, with or without noise. A pose has shape `(4,)`: cosine and
sine of the heading, then the position.

The positions form a banana, as an error of the heading turns the rest of the way. Their mean is
inside the banana, where hardly any sample is.

Source: Long, Wolfe, Mashner & Chirikjian, The banana distribution is Gaussian, Robotics: Science
and Systems VIII (2012), doi:10.15607/RSS.2012.VIII.034.
"""

import functools
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import cfjax

from . import _figures as figures

t0, t1 = 0.0, 60.0
# Order 3 is enough for fields that do not depend on the state.
solver = cfjax.WeakOrder2(cfjax.CF3())

Pose = Float[Array | np.ndarray, "4"]


class Readings(NamedTuple):
    """The rate of turn in rad/s and the speed in m/s, and the density of each noise.

    `turn_noise` is in rad/√s, `speed_noise` and `slip` are in m/√s.
    """

    turn: Any = 0.02
    speed: Any = 1.0
    turn_noise: Any = 0.09
    speed_noise: Any = 0.25
    slip: Any = 0.05


def y0() -> Float[np.ndarray, "4"]:
    """At the origin, on the way along x."""
    return np.array([1.0, 0.0, 0.0, 0.0])


def field(t: Any, y: Pose, args: Readings) -> cfjax.PlanarMotion:
    """The frozen field without noise: constant in the frame of the vehicle."""
    forwards = jnp.asarray([1.0, 0.0], y.dtype)
    turn = jnp.asarray(args.turn, y.dtype)
    return cfjax.PlanarMotion(
        omega=turn, v=args.speed * forwards, frame="body", layout="unit_complex_xy"
    )


def noise(t: Any, y: Pose, args: Readings, increment: Float[Array, "3"]) -> cfjax.PlanarMotion:
    """The frozen field that an increment of Brownian motion causes."""
    turn, *v = jnp.asarray([args.turn_noise, args.speed_noise, args.slip], y.dtype) * increment
    return cfjax.PlanarMotion(omega=turn, v=jnp.stack(v), frame="body", layout="unit_complex_xy")


def term(key: Key[Array, ""]) -> diffrax.MultiTerm:
    """The motion with one sample of the noise."""
    path = diffrax.UnsafeBrownianPath((3,), key, levy_area=diffrax.SpaceTimeLevyArea)
    return diffrax.MultiTerm(cfjax.LieTerm(field), cfjax.LieControlTerm(noise, path))


def samples(
    num_samples: int, args: Readings, *, num_steps: int = 60, seed: int = 0
) -> Float[Array, "num_samples num_steps 4"]:
    """Independent samples after each step of `cfjax.WeakOrder2`, whose errors are of order 2."""
    return _samples(jax.random.split(jax.random.key(seed), num_samples), args, num_steps)


def reference(
    t: float | Float[np.ndarray, "*times"], args: Readings
) -> Float[np.ndarray, "*times 4"]:
    """The exact means of the entries of a pose at times `t`, in NumPy's float64.

    The mean of the 3 x 3 matrix T of a pose is `exp(t (X + (E1^2 + E2^2 + E3^2) / 2))`, with the
    matrices of the motion and of the three noises.
    """
    mean = _mean(t, _matrices(args))
    return np.stack([mean[..., 0, 0], mean[..., 1, 0], mean[..., 0, 2], mean[..., 1, 2]], axis=-1)


def covariance(
    t: float | Float[np.ndarray, "*times"], args: Readings
) -> Float[np.ndarray, "*times 2 2"]:
    """The exact covariance of the position at times `t`, in NumPy's float64.

    The Kronecker square of T obeys the equation of T with `X ⊗ I + I ⊗ X` for each matrix X.
    """
    eye = np.eye(3)
    squares = _mean(t, [np.kron(x, eye) + np.kron(eye, x) for x in _matrices(args)])
    # The last column has the products of the positions, (x, y, 1) times (x, y, 1).
    products = squares[..., 8].reshape(*np.shape(t), 3, 3)[..., :2, :2]
    position = reference(t, args)[..., 2:]
    return products - position[..., :, None] * position[..., None, :]


def problem() -> dict[str, Any]:
    """One sample, as arguments of `cfjax.integrate`."""
    return dict(term=term(jax.random.key(0)), t0=t0, t1=t1, y0=y0(), args=Readings())


def invariants(y: Pose, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"cosine and sine": jnp.hypot(y[0], y[1])}


def picture(num_samples: int = 4000) -> figures.Figure:
    """Where the vehicle may be after 20, 40 and 60 s; the end beside a Gaussian in x and y."""
    from matplotlib.patches import Ellipse

    args, n = Readings(), 60
    times = t0 + (t1 - t0) * np.arange(1, n + 1) / n
    ys = np.asarray(samples(num_samples, args, num_steps=n))
    places = np.concatenate([np.zeros((num_samples, 1, 2)), ys[..., 2:]], axis=1)
    still = args._replace(turn_noise=0.0, speed_noise=0.0, slip=0.0)
    path, means = (reference(np.append(t0, times), x)[:, 2:] for x in (still, args))

    figure = figures.new(10.5, 4.6)
    ways, ends = figure.subplots(1, 2)
    colours = {20: figures.BLUE, 40: figures.GREEN, 60: figures.VERMILION}
    ways.plot(*places[:40].T, color="0.8", linewidth=0.5, zorder=0)
    for k, colour in colours.items():
        for ax in (ways, ends) if k == n else (ways,):
            ax.scatter(*places[:, k].T, s=3, alpha=0.4, linewidth=0, color=colour, zorder=1)
        ways.plot([], [], "o", markersize=4, color=colour, label=f"after {k} s")
    ways.plot(*path.T, "k-", linewidth=1.5, label="without noise")
    ways.plot(*means.T, "k--", linewidth=1.5, label="exact mean")
    ends.plot([], [], "o", markersize=4, color=colours[n], label=f"{num_samples:,} samples")
    ends.plot(*path[-1], "ks", markersize=7, label="without noise")
    ends.plot(*means[-1], "kx", markersize=9, label="exact mean")
    middle = places[:, -1].mean(axis=0)
    ends.plot(*middle, "ko", markersize=13, fillstyle="none", label="mean of the samples")
    squares, axes = np.linalg.eigh(covariance(t1, args))
    angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
    # 95 % of a Gaussian in the plane is within sqrt(-2 log 0.05) standard deviations.
    short, long = 2 * np.sqrt(-2 * np.log(0.05) * squares)
    style = dict(fill=False, color=figures.PURPLE, linewidth=1.5, label="Gaussian in x and y, 95 %")
    ends.add_patch(Ellipse(means[-1], long, short, angle=angle, **style))
    ways.set_title("Where the vehicle may be")
    ends.set_title("After 60 s")
    for ax in (ways, ends):
        ax.set(xlabel="x, m", ylabel="y, m", aspect="equal")
        ax.legend(frameon=False, loc="lower left")
    return figure


def _matrices(args: Readings) -> list[np.ndarray]:
    """The matrices of the motion and of the three noises."""

    def matrix(omega: float, x: float, y: float) -> np.ndarray:
        return np.array([[0.0, -omega, x], [omega, 0.0, y], [0.0, 0.0, 0.0]])

    return [
        matrix(args.turn, args.speed, 0.0),
        matrix(args.turn_noise, 0.0, 0.0),
        matrix(0.0, args.speed_noise, 0.0),
        matrix(0.0, 0.0, args.slip),
    ]


def _mean(t: Any, matrices: list[np.ndarray]) -> np.ndarray:
    from scipy.linalg import expm

    drift, *noises = matrices
    generator = drift + sum(e @ e for e in noises) / 2
    return expm(np.asarray(t, float)[..., None, None] * generator)


@functools.partial(jax.jit, static_argnums=2)
@functools.partial(jax.vmap, in_axes=(0, None, None))
def _samples(key: Any, args: Readings, num_steps: int) -> Any:
    # Order 3 is enough for fields that do not depend on the state.
    return cfjax.integrate(
        term(key), solver, t0, t1, y0(), args, num_steps=num_steps, save_every=1
    ).ys
