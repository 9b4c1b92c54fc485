"""A particle of a magnet at a temperature: the stochastic Landau-Lifshitz-Gilbert equation.

The particle is so small that it is magnetised in one direction y, shape `(3,)`. The direction turns
with the angular velocity `(B + damping y x B) / (1 + damping^2)`. The field B is `applied` along z,
plus `sqrt(2 damping temperature)` times white noise in three channels, in the sense of
Stratonovich. Units are those in which the gyromagnetic ratio, the magnetic moment and Boltzmann's
constant are one.

The particle starts cold, along the field, and heats up. In equilibrium its directions follow
Boltzmann's distribution, so the mean of z is Langevin's function of `applied / temperature`,
whatever the damping.

Source: Brown, Thermal fluctuations of a single-domain particle, Phys. Rev. 130 (1963),
doi:10.1103/PhysRev.130.1677.
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

t0, t1 = 0.0, 20.0
solver = cfjax.WeakOrder2()

Direction = Float[Array | np.ndarray, "3"]


class Particle(NamedTuple):
    """The field along z, the damping and the temperature."""

    applied: Any = 1.0
    damping: Any = 0.5
    temperature: Any = 0.3


def y0() -> Float[np.ndarray, "3"]:
    """The direction of the field."""
    return np.array([0.0, 0.0, 1.0])


def field(t: Any, y: Direction, args: Particle) -> cfjax.Rotation:
    """The frozen field without noise."""
    return _turning(args.applied * jnp.asarray([0.0, 0.0, 1.0], y.dtype), y, args)


def thermal(t: Any, y: Direction, args: Particle, increment: Float[Array, "3"]) -> cfjax.Rotation:
    """The frozen field that an increment of Brownian motion causes."""
    return _turning(jnp.sqrt(2 * args.damping * args.temperature) * increment, y, args)


def term(key: Key[Array, ""]) -> diffrax.MultiTerm:
    """The field with one sample of the noise."""
    noise = diffrax.UnsafeBrownianPath((3,), key, levy_area=diffrax.SpaceTimeLevyArea)
    return diffrax.MultiTerm(cfjax.LieTerm(field), cfjax.LieControlTerm(thermal, noise))


def samples(
    num_samples: int, args: Particle, *, num_steps: int = 160, seed: int = 0
) -> Float[Array, "num_samples num_steps 3"]:
    """Independent samples after each step of `cfjax.WeakOrder2`, whose errors are of order 2."""
    return _samples(jax.random.split(jax.random.key(seed), num_samples), args, num_steps)


def langevin(x: Any) -> Any:
    """Langevin's function, `coth(x) - 1 / x`: the mean of z in equilibrium, for x > 0."""
    return 1 / jnp.tanh(x) - 1 / x


def reference(
    t: float | Float[np.ndarray, "*times"], args: Particle
) -> Float[np.ndarray, "*times"]:
    """The exact mean of z at times `t`, in NumPy's float64.

    The Fokker-Planck equation is a linear equation for the means of the Legendre polynomials of z.
    It is cut off after the 40th, which costs less than 1e-10 if `applied` is at most 20 times
    `temperature`.
    """
    from scipy.linalg import expm

    degree = np.arange(41.0)
    rate = args.damping / (1 + args.damping**2)
    drift = rate * args.applied * degree * (degree + 1) / (2 * degree + 1)
    decay = rate * args.temperature * degree * (degree + 1)
    generator = np.diag(drift[1:], -1) - np.diag(drift[:-1], 1) - np.diag(decay)
    # At the start z is one, and so is each polynomial.
    means = [np.sum(expm(time * generator)[1]) for time in np.ravel(t)]
    return np.reshape(means, np.shape(t))


def problem() -> dict[str, Any]:
    """One sample, as arguments of `cfjax.integrate`."""
    return dict(term=term(jax.random.key(0)), t0=t0, t1=t1, y0=y0(), args=Particle())


def invariants(y: Direction, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"length": jnp.linalg.norm(y)}


def picture(num_samples: int = 4000) -> figures.Figure:
    """One sample on the sphere; means in time at some temperatures; means in equilibrium."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    n = 160
    times = t0 + (t1 - t0) * np.arange(1, n + 1) / n
    temperatures = [0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0]
    colours = {0.1: figures.BLUE, 0.3: figures.GREEN, 1.0: figures.ORANGE, 5.0: figures.VERMILION}
    ys = {}
    for seed, temperature in enumerate(temperatures):
        args = Particle(temperature=temperature)
        ys[temperature] = np.asarray(samples(num_samples, args, num_steps=n, seed=seed))

    figure = figures.new(10.5, 3.6)
    sphere = figures.sphere(figure, 1, 3, 1, zoom=1.4)
    means, ends = figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3)

    path = np.concatenate([y0()[None], ys[0.3][0]])
    pieces = np.stack([path[:-1], path[1:]], axis=1)
    sphere.add_collection3d(
        Line3DCollection(pieces, array=times, cmap="viridis", linewidth=1.2, zorder=1)
    )
    sphere.set_title("Temperature 0.3, late is yellow", y=0.97)

    often = t0 + (t1 - t0) * np.linspace(0, 1, 41) ** 2
    for temperature, colour in colours.items():
        args = Particle(temperature=temperature)
        means.plot(often, reference(often, args), color=colour, linewidth=1)
        end = float(langevin(args.applied / temperature))
        means.plot([t1, t1 + 2], [end, end], color=colour, linestyle=":", linewidth=1.5)
        some = slice(3, None, 8)
        measured = ys[temperature][:, some, 2].mean(axis=0)
        means.plot(times[some], measured, ".", color=colour, label=f"{temperature:g}")
    means.plot([], [], "k-", linewidth=1, label="exact")
    means.plot([], [], "k:", linewidth=1.5, label="Langevin")
    means.set(title=f"Mean of {num_samples} particles", xlabel="t", ylabel="z", ylim=(-0.02, 1.02))
    means.legend(frameon=False, title="temperature", ncols=2)

    fine = np.geomspace(0.03, 8.0, 200)
    ends.semilogx(fine, langevin(1 / fine), color="0.4", linewidth=1, label="Langevin")
    for temperature, values in ys.items():
        colour = colours.get(temperature, "0.4")
        ends.semilogx(temperature, values[:, -1, 2].mean(), "o", markersize=5, color=colour)
    ends.set(title=f"Mean at t = {t1:g}", xlabel="temperature", ylabel="z", ylim=(-0.02, 1.02))
    ends.legend(frameon=False)
    return figure


@functools.partial(jax.jit, static_argnums=2)
@functools.partial(jax.vmap, in_axes=(0, None, None))
def _samples(key: Any, args: Particle, num_steps: int) -> Any:
    return cfjax.integrate(
        term(key), solver, t0, t1, y0(), args, num_steps=num_steps, save_every=1
    ).ys


def _turning(b: Float[Array, "3"], y: Direction, args: Particle) -> cfjax.Rotation:
    return cfjax.Rotation((b + args.damping * jnp.cross(y, b)) / (1 + args.damping**2))
