"""Point vortices on the sphere: a street of two rings of opposite signs, which breaks up.

A vortex of strength G turns the fluid about itself. Each vortex, a unit vector x, moves with the
fluid of all others:

`x_i' = sum over j of G_j cross(x_j, x_i) / (4 pi (1 - x_i . x_j))`.

The energy and the momentum, the sum of all `G x`, are constant. All quantities are dimensionless.

Two vortices alone turn about `G_1 x_1 + G_2 x_2`, which does not move, so their flow is exact. In
a round all vortices move in pairs, and as in a tournament N - 1 rounds bring every two of them
together. A splitting into rounds keeps the momentum to rounding. It is symplectic, so the energy
does not drift, as long as the steps are short for the vortices that come closest.

Source: Newton, The N-Vortex Problem, Springer (2001), Chapter 4, doi:10.1007/978-1-4684-9290-3;
Myerscough & Frank, Explicit, parallel Poisson integration of point vortices on the sphere, J.
Comput. Appl. Math. 304 (2016), doi:10.1016/j.cam.2016.02.053.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 20.0
# To `t1`. The splitting into rounds pays over longer times.
solver = cfjax.Projected(diffrax.Dopri8())

Vortices = Float[Array | np.ndarray, "N 3"]
Strengths = Float[Array | np.ndarray, " N"]


def y0(n: int = 4, latitude: float = 0.4, shift: float = 0.02) -> Float[np.ndarray, "N 3"]:
    """A ring of `n` vortices in the north and a staggered one in the south: N = 2 n.

    The `shift` moves each by another small angle. Without it they turn about the third axis.
    """
    k = np.arange(2 * n)
    longitude = (2 * k + k // n) * np.pi / n + shift * np.cos(k)
    latitudes = np.where(k < n, latitude, -latitude) + shift * np.sin(2 * k)
    direction = np.cos(longitude), np.sin(longitude), np.tan(latitudes)
    return np.cos(latitudes)[:, None] * np.stack(direction, axis=-1)


def strengths(n: int = 4) -> Float[np.ndarray, " N"]:
    """1 in the north and -1 in the south."""
    return np.repeat([1.0, -1.0], n)


def field(t: Any, y: Vortices, args: Strengths) -> cfjax.Rotation:
    """The frozen field of all vortices at once."""
    eye = jnp.eye(len(y), dtype=y.dtype)
    off = 1 - jnp.sum(y[:, None] * y[None], axis=-1)
    rate = args[None] * (1 - eye) / (4 * jnp.pi * (off + eye))
    return cfjax.Rotation(jnp.sum(rate[..., None] * y[None], axis=1))


def velocity(t: Any, y: Vortices, args: Strengths) -> Float[Array, "N 3"]:
    """The same field in plain space, where no method keeps the vortices on the sphere."""
    return jnp.cross(field(t, y, args).omega, y)


def rounds(num_vortices: int = 8) -> diffrax.MultiTerm:
    """The terms of a splitting, one less than the vortices, of which the number must be even.

    In each of them every vortex has one partner, with which it turns about `G_1 x_1 + G_2 x_2`.
    """
    last = num_vortices - 1
    k = np.arange(last)

    def term(r: int) -> cfjax.LieTerm:
        # The last vortex plays the one that would be its own partner.
        partner = np.append((2 * r - k) % last, r)
        partner[r] = last

        def pairs(t: Any, y: Vortices, args: Strengths) -> cfjax.Rotation:
            pulls = args[:, None] * y
            off = 1 - jnp.sum(y * y[partner], axis=-1, keepdims=True)
            return cfjax.Rotation((pulls + pulls[partner]) / (4 * jnp.pi * off))

        return cfjax.LieTerm(pairs)

    return diffrax.MultiTerm(*map(term, range(last)))


def energy(y: Vortices, args: Strengths) -> Float[Array, ""]:
    """The energy, `-sum of G_i G_j log(1 - x_i . x_j) / (4 pi)` over all pairs."""
    i, j = np.triu_indices(len(y), 1)
    off = 1 - jnp.sum(y[i] * y[j], axis=-1)
    return -jnp.sum(args[i] * args[j] * jnp.log(off)) / (4 * jnp.pi)


def momentum(y: Vortices, args: Strengths) -> Float[Array, "3"]:
    """The sum of all `G x`."""
    return jnp.sum(args[:, None] * y, axis=0)


def reference(
    t: float, start: Float[np.ndarray, "N 3"], args: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N 3"]:
    """The vortices at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13.

    The error of the default start at 20 is about 2e-11.
    """

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        square = np.sum((y[:, None] - y) ** 2, axis=-1)
        np.fill_diagonal(square, np.inf)
        return np.cross(args / (2 * np.pi * square) @ y, y)

    return by_dop853(rate, start, t)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=strengths())


def invariants(y: Vortices, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    args = jnp.asarray(args)
    return {
        "energy": energy(y, args),
        "momentum": momentum(y, args),
        "length of each vector": jnp.linalg.norm(y, axis=-1),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A street of vortices to t = 20, 20 to 1280 equal steps; Tsit5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.RKMK8(), *PROJECTED)
        | by_name(cfjax.Strang(), cfjax.BlanesMoan4(), cfjax.BlanesMoan6(), term=rounds())
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1, y0(), strengths()),
        num_steps=[20 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """Paths to t = 40, blue from the north; what three methods of equal cost keep to t = 100.

    Paths are faint behind the sphere. In a unit of time the methods evaluate each pair some 120
    times. Errors grow where two vortices of opposite signs meet.
    """
    args = jnp.asarray(strengths())
    steps = dict(t1=100.0, num_steps=1000, save_every=1, save_initial=True)
    shorter = steps | dict(num_steps=3000, save_every=3)
    times, rkmk8 = solve(problem(), cfjax.RKMK8(), **steps)
    _, cf4 = solve(problem(), cfjax.CF4(), **shorter)
    _, blanes_moan4 = solve(problem(), cfjax.BlanesMoan4(), term=rounds(), **steps)

    figure = figures.new(10.5, 3.2)
    grid = figure.add_gridspec(2, 4, width_ratios=[1, 1, 1, 1.2])
    towards = np.array([np.cos(0.35), 0.0, np.sin(0.35)])
    colours = figures.VERMILION, figures.BLUE
    for k, t in enumerate((10, 22, 40)):
        ax = figures.sphere(figure, grid[:, k], zoom=1.6, color="0.9")
        ax.view_init(elev=np.degrees(0.35), azim=0)
        # The last eight units of time.
        for i, path in enumerate(np.swapaxes(blanes_moan4[10 * t - 80 : 10 * t + 1], 0, 1)):
            colour = colours[i < len(args) // 2]
            is_seen = (path @ towards > 0)[:, None]
            ax.plot(*path.T, color=colour, linewidth=0.8, alpha=0.3, zorder=1)
            ax.plot(*np.where(is_seen, path, np.nan).T, color=colour, linewidth=1.5, zorder=2)
            ax.scatter(*path[-1], s=22, color=colour, alpha=1 if is_seen[-1] else 0.25, zorder=3)
        ax.set_title(f"t = {t}", y=1.0, size=10)

    labels = {
        "CF4": (cf4, figures.GREEN, (40, 1e-6)),
        "RKMK8": (rkmk8, figures.ORANGE, (40, 3e-12)),
        "BlanesMoan4": (blanes_moan4, "k", (48, 3e-15)),
    }
    for row, value in enumerate((energy, momentum)):
        ax = figure.add_subplot(grid[row, 3])
        for method, (ys, colour, place) in labels.items():
            values = np.asarray(jax.vmap(value, in_axes=(0, None))(ys, args))
            off = np.abs(values - values[0]).reshape(len(values), -1).max(axis=-1)
            ax.semilogy(times, np.maximum(off, 1e-17), color=colour, linewidth=1)
            if row == 1:
                ax.text(*place, method, color=colour, size=9)
                ax.set(xlabel="t")
        ax.set(ylim=(1e-17, 1e-3), yticks=[1e-16, 1e-12, 1e-8, 1e-4])
        ax.set_title(f"Error of the {value.__name__}", size=10)
    return figure
