"""A ferromagnet: the Landau-Lifshitz-Gilbert equation for unit spins on a lattice.

`s' = -(s x B + damping s x (s x B)) / (1 + damping^2)`, in units in which the gyromagnetic ratio
is one. The effective field B of a spin is `exchange` times the sum of its neighbours, an anisotropy
along z and an applied field. Every spin keeps its length, and the energy never rises. Frozen, the
field is a rotation of each spin.

A state has shape `(*sides, 3)`, a periodic lattice of any number of axes. A single spin, shape
`(3,)`, has no neighbours and is a macrospin.

Source: Gilbert, A phenomenological theory of damping in ferromagnetic materials, IEEE Trans. Magn.
40 (2004), doi:10.1109/TMAG.2004.836740.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 4.0
# On a lattice it takes less memory than RKMK8, and for errors above 1e-7 no more time.
solver = cfjax.CF4()

Spins = Float[Array | np.ndarray, "*sides 3"]


class Magnet(NamedTuple):
    """The terms of the energy, and the damping."""

    exchange: Any = 1.0
    anisotropy: Any = 0.2
    applied: Any = (0.0, 0.0, 0.1)
    damping: Any = 0.1


def y0(*sides: int, seed: int = 0) -> Float[np.ndarray, "*sides 3"]:
    """Spins in random directions: a magnet that has just been cooled."""
    spins = np.random.default_rng(seed).normal(size=(*sides, 3))
    return spins / np.linalg.norm(spins, axis=-1, keepdims=True)


def effective_field(y: Spins, args: Magnet) -> Float[Array, "*sides 3"]:
    """The field B that acts on each spin, minus the derivative of the energy."""
    return args.exchange * _neighbours(y) + _own(y, args, args.anisotropy)


def field(t: Any, y: Spins, args: Magnet) -> cfjax.Rotation:
    """The frozen field: with angular velocity `(B + damping s x B) / (1 + damping^2)`."""
    b = effective_field(y, args)
    turned = b + args.damping * jnp.cross(y, b)
    return cfjax.Rotation(turned / (1 + args.damping**2))


def velocity(t: Any, y: Spins, args: Magnet) -> Float[Array, "*sides 3"]:
    """The same field in plain space, where no method keeps the length of a spin."""
    return jnp.cross(field(t, y, args).omega, y)


def energy(y: Spins, args: Magnet) -> Float[Array, ""]:
    """The energy of the lattice. Every bond between neighbours counts once."""
    half = args.exchange / 2 * _neighbours(y) + _own(y, args, args.anisotropy / 2)
    return -jnp.sum(y * half)


def macrospin(
    t: float | Float[np.ndarray, "*times"], start: Float[np.ndarray, "3"], args: Magnet
) -> Float[np.ndarray, "*times 3"]:
    """The exact motion of a single spin in an applied field along z, without anisotropy.

    The spin turns about the field and falls towards it: with h' = h / (1 + damping^2) the azimuth
    grows by `h' t`, and `tan(theta / 2)` falls by the factor `exp(-damping h' t)`. Computed in
    NumPy's float64.
    """
    rate = args.applied[2] / (1 + args.damping**2) * np.asarray(t, float)
    # tan(theta / 2), from the smaller of the two sides.
    radius = np.hypot(start[0], start[1]) / (1 + start[2]) * np.exp(-args.damping * rate)
    azimuth = np.arctan2(start[1], start[0]) + rate
    sine = 2 * radius / (1 + radius**2)
    cosine = (1 - radius**2) / (1 + radius**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)


def reference(
    t: float, start: Float[np.ndarray, "*sides 3"], args: Magnet
) -> Float[np.ndarray, "*sides 3"]:
    """The spins at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13."""
    axes = tuple(range(start.ndim - 1))

    def rate(t: float, s: np.ndarray) -> np.ndarray:
        sums = sum((np.roll(s, 1, k) + np.roll(s, -1, k) for k in axes), np.zeros_like(s))
        b = args.exchange * sums + np.asarray(args.applied)
        b[..., 2] += args.anisotropy * s[..., 2]
        precession = np.cross(s, b)
        return -(precession + args.damping * np.cross(s, precession)) / (1 + args.damping**2)

    return by_dop853(rate, start, t)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(8, 8), args=Magnet())


def invariants(y: Spins, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"energy (falls)": energy(y, args), "length of each spin": jnp.linalg.norm(y, axis=-1)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """An 8 x 8 ferromagnet to t = 4, 20 to 640 equal steps; Tsit5 and Dopri5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF3(), cfjax.CF4(), cfjax.CF43(), cfjax.CF54())
        | in_plain_space(velocity, diffrax.Dopri5(), diffrax.Tsit5()),
        reference=reference(t1, y0(8, 8), Magnet()),
        num_steps=[20 * 2**k for k in range(6)],
        **options,
    )


def picture(side: int = 96) -> figures.Figure:
    """A larger magnet, quenched, to t = 160: domains grow, walls move, vortices vanish.

    Colour is the direction in the plane, brightness the component along z. The disc has the colours
    of all directions, from upwards in its centre to downwards at its rim.
    """
    from matplotlib.patches import Circle

    # An easy plane, so that there are vortices.
    args = Magnet(anisotropy=-0.3, applied=(0.0, 0.0, 0.0), damping=0.2)
    steps = dict(t1=160.0, num_steps=640, save_every=8, save_initial=True)
    _, ys = solve(problem(), solver, y0=y0(side, side), args=args, **steps)
    times = (0, 2, 10, 40, 160)
    figure = figures.new(2.2 * len(times) + 1.6, 2.5)
    *lattices, key = figure.subplots(1, len(times) + 1, width_ratios=(*len(times) * (1,), 0.6))
    for ax, t in zip(lattices, times, strict=True):
        ax.imshow(_colours(ys[t // 2]))
        ax.set(xticks=[], yticks=[], title=f"t = {t}")
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 201)])
    polar, azimuth = np.pi * np.minimum(np.hypot(x, y), 1), np.arctan2(y, x)
    across = np.sin(polar)
    directions = np.stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    disc = key.imshow(_colours(directions), extent=(-1, 1, -1, 1), origin="lower")
    disc.set_clip_path(Circle((0, 0), 1, transform=key.transData))
    key.text(0, 0, "+z", ha="center", va="center")
    key.text(1.1, 0, "x", va="center")
    key.text(0, 1.1, "y", ha="center")
    key.set(title="Directions\n", xlabel="rim: -z", xticks=[], yticks=[])
    key.set_frame_on(False)
    return figure


def _colours(s: Float[np.ndarray, "*sides 3"]) -> Float[np.ndarray, "*sides 3"]:
    """The hue of a direction in the plane; white upwards, black downwards."""
    from matplotlib.colors import hsv_to_rgb

    z = s[..., 2]
    hue = np.arctan2(s[..., 1], s[..., 0]) / (2 * np.pi) % 1
    return hsv_to_rgb(np.stack([hue, np.minimum(1, 1 - z), np.minimum(1, 1 + z)], axis=-1))


def _neighbours(y: Spins) -> Float[Array, "*sides 3"]:
    axes = range(jnp.ndim(y) - 1)
    return sum((jnp.roll(y, 1, k) + jnp.roll(y, -1, k) for k in axes), jnp.zeros_like(y))


def _own(y: Spins, args: Magnet, anisotropy: Any) -> Float[Array, "*sides 3"]:
    """The fields that a spin has without neighbours."""
    easy = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], y.dtype), y.shape)
    return anisotropy * easy * y + jnp.broadcast_to(jnp.asarray(args.applied, y.dtype), y.shape)
