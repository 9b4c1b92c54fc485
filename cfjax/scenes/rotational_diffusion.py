"""A molecule in a liquid: rotational diffusion, the Brownian motion of the direction of its axis.

The direction y, shape `(3,)`, turns with the angular velocity `sqrt(2 diffusion)` times white noise
in three channels, in the sense of Stratonovich. Nothing else turns it. The mean of the Legendre
polynomial P_l of the cosine between y and the start decays as `exp(-l (l + 1) diffusion t)`.
Dielectric relaxation measures the decay for l = 1, and the fluorescence of dyes that for l = 2,
which is three times as fast.

Source: Perrin, Étude mathématique du mouvement brownien de rotation, Ann. Sci. Éc. Norm. Supér. 45
(1928), p. 1-51.
"""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import cfjax

from . import _figures as figures

t0, t1 = 0.0, 1.5
# Order 3 is enough for fields that do not depend on the state.
solver = cfjax.WeakOrder2(cfjax.CF3())

Direction = Float[Array | np.ndarray, "3"]


def y0() -> Float[np.ndarray, "3"]:
    """Along z."""
    return np.array([0.0, 0.0, 1.0])


def thermal(t: Any, y: Direction, args: Any, increment: Float[Array, "3"]) -> cfjax.Rotation:
    """The frozen field that an increment of Brownian motion causes; `args` is the diffusion."""
    return cfjax.Rotation(jnp.sqrt(2 * args) * increment)


def term(key: Key[Array, ""]) -> cfjax.LieControlTerm:
    """One sample of the noise."""
    noise = diffrax.UnsafeBrownianPath((3,), key, levy_area=diffrax.SpaceTimeLevyArea)
    return cfjax.LieControlTerm(thermal, noise)


def samples(
    num_samples: int, diffusion: float = 1.0, *, num_steps: int = 60, seed: int = 0
) -> Float[Array, "num_samples num_steps 3"]:
    """Independent samples after each step of `cfjax.WeakOrder2`, whose errors are of order 2."""
    return _samples(jax.random.split(jax.random.key(seed), num_samples), diffusion, num_steps)


def legendre(y: Float[Array | np.ndarray, "*batch 3"]) -> Float[Array | np.ndarray, "*batch 3"]:
    """The polynomials of degrees 1, 2 and 3 of the cosine between a direction and the start."""
    z = y[..., 2]
    return jnp.stack([z, (3 * z**2 - 1) / 2, (5 * z**3 - 3 * z) / 2], axis=-1)


def reference(
    t: float | Float[np.ndarray, "*times"], diffusion: float = 1.0
) -> Float[np.ndarray, "*times 3"]:
    """The exact means of `legendre` at times `t`."""
    degree = np.arange(1, 4)
    return np.exp(-degree * (degree + 1) * diffusion * np.asarray(t)[..., None])


def problem() -> dict[str, Any]:
    """One sample, as arguments of `cfjax.integrate`."""
    return dict(term=term(jax.random.key(0)), t0=t0, t1=t1, y0=y0(), args=1.0)


def invariants(y: Direction, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"length": jnp.linalg.norm(y)}


def picture(num_samples: int = 50_000) -> figures.Figure:
    """Axes on the sphere at three times, and how the three means decay."""
    n = 60
    times = t0 + (t1 - t0) * np.arange(1, n + 1) / n
    ys = samples(num_samples, num_steps=n)
    polynomials = np.asarray(legendre(ys))
    means, deviations = np.mean(polynomials, axis=0), np.std(polynomials, axis=0)

    figure = figures.new(10.5, 3.2)
    grid = figure.add_gridspec(1, 4, width_ratios=(1, 1, 1, 1.7))
    eye = np.array([np.cos(0.6), 0.0, np.sin(0.6)])
    for k, step in enumerate((2, 8, 40)):
        sphere = figures.sphere(figure, grid[k], zoom=1.5)
        sphere.view_init(elev=np.degrees(0.6), azim=0)
        y = np.asarray(ys[:4000, step - 1])
        # What the sphere hides is left out.
        seen = y[y @ eye > 0]
        sphere.scatter(*seen.T, s=3, color=figures.BLUE, alpha=0.5, linewidth=0, zorder=1)
        sphere.set_title(f"t = {times[step - 1]:g}", y=1.0)

    curves = figure.add_subplot(grid[3])
    often = np.linspace(t0, t1, 200)
    for k, colour in enumerate((figures.BLUE, figures.GREEN, figures.VERMILION)):
        curves.semilogy(often, reference(often)[:, k], color=colour, linewidth=1)
        # Where a mean is more than noise.
        error = deviations[:, k] / np.sqrt(num_samples)
        shown = reference(times)[:, k] > 3 * error
        shown[1::2] = False
        curves.errorbar(
            times[shown],
            means[shown, k],
            2 * error[shown],
            fmt=".",
            color=colour,
            elinewidth=1,
            label=f"$l = {k + 1}$",
        )
    curves.plot([], [], "k-", linewidth=1, label="exact")
    curves.set(xlabel="t", ylabel="mean of $P_l$", ylim=(5e-3, 1.3))
    curves.set_title(f"{num_samples:,} molecules, two standard errors")
    curves.legend(frameon=False)
    return figure


@functools.partial(jax.jit, static_argnums=2)
@functools.partial(jax.vmap, in_axes=(0, None, None))
def _samples(key: Any, diffusion: Any, num_steps: int) -> Any:
    return cfjax.integrate(
        term(key), solver, t0, t1, y0(), diffusion, num_steps=num_steps, save_every=1
    ).ys
