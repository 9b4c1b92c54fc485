"""Random unit spins on a square lattice that order: the heat flow of harmonic maps to the sphere.

`s' = b - (b . s) s`, where b is the sum of the four neighbours of a spin: every spin turns straight
towards its neighbours. The energy, the sum of `1 - s . s'` over the bonds, never rises, and every
spin keeps its length. Frozen, the field is a rotation of each spin, about `s x b`. Time is in units
of the relaxation of a bond. A state has shape `(*sides, 3)`, a periodic lattice.

The flow is stiff and dissipative: rates go up to 8, while what is large decays as slowly as its
size. The spins cover the sphere some number of times, the degree. It is a whole number, and only
defects that shrink to the size of a cell change it. On the plane the energy of a degree Q is at
least `4 pi |Q|`, so each defect holds some `4 pi` until it falls through the lattice.

Two sublattices at an angle a to each other are solved exactly: as each spin has four neighbours,
`a' = -8 sin a`, or `tan(a / 2) = exp(-8 t) tan(a0 / 2)`. That is the fastest motion there is.

Source: Belavin & Polyakov, Metastable states of two-dimensional isotropic ferromagnets, JETP Lett.
22 (1975); Eells & Sampson, Harmonic mappings of Riemannian manifolds, Amer. J. Math. 86 (1964),
doi:10.2307/2373037; Berg & Lüscher, Definition and statistical distributions of a topological
number in the lattice O(3) sigma-model, Nucl. Phys. B 190 (1981),
doi:10.1016/0550-3213(81)90568-X, for the degree.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space

t0, t1 = 0.0, 100.0
# The method for large relaxation and errors of 1e-2 to 1e-3.
solver = cfjax.RKL2()

Spins = Float[Array | np.ndarray, "*sides 3"]

# A bound on the spectral radius, 4 d on a lattice of d axes: the 2 d neighbours of a spin add up to
# 2 d at most, and what it turns away from its own direction to 2 d.
RADIUS = 8.0


def y0(side: int = 64, seed: int = 0) -> Float[np.ndarray, "side side 3"]:
    """Spins in random directions."""
    spins = np.random.default_rng(seed).normal(size=(side, side, 3))
    return spins / np.linalg.norm(spins, axis=-1, keepdims=True)


def neighbours(y: Spins) -> Float[Array, "*sides 3"]:
    """The sum of the neighbours of each spin."""
    axes = range(jnp.ndim(y) - 1)
    return sum((jnp.roll(y, 1, k) + jnp.roll(y, -1, k) for k in axes), jnp.zeros_like(y))


def field(t: Any, y: Spins, args: Any = None) -> cfjax.Rotation:
    """The frozen field: with angular velocity `s x b`."""
    return cfjax.Rotation(jnp.cross(y, neighbours(y)))


def velocity(t: Any, y: Spins, args: Any = None) -> Float[Array, "*sides 3"]:
    """The same field in plain space, where no method keeps the length of a spin."""
    return jnp.cross(field(t, y).omega, y)


def density(y: Spins) -> Float[Array, "*sides"]:
    """The energy of each spin: half of that of its bonds."""
    bonds = 2 * (jnp.ndim(y) - 1)
    return (bonds - jnp.sum(y * neighbours(y), axis=-1)) / 2


def energy(y: Spins) -> Float[Array, ""]:
    """The energy. Every bond between neighbours counts once."""
    return jnp.sum(density(y))


def degree(y: Float[np.ndarray, "side side 3"]) -> Float[np.ndarray, "side side"]:
    """The part of the sphere that each cell covers, with a sign, in NumPy.

    A cell is two spherical triangles, whose solid angles are added. The sum over the lattice is a
    whole number to rounding.
    """
    a, b = y, np.roll(y, -1, 0)
    c, d = np.roll(b, -1, 1), np.roll(y, -1, 1)
    return (_solid_angle(a, b, c) + _solid_angle(a, c, d)) / (4 * np.pi)


def sublattices(t: float, angle: float, side: int = 2) -> Float[np.ndarray, "side side 3"]:
    """The exact state at time `t` of two sublattices, at this angle to each other at time zero.

    The sides of the lattice are even. Computed in NumPy's float64.
    """
    half = np.arctan(np.exp(-8 * t) * np.tan(angle / 2))
    sign = (-1.0) ** np.add.outer(np.arange(side), np.arange(side))
    return np.stack([sign * np.sin(half), 0 * sign, 0 * sign + np.cos(half)], axis=-1)


def reference(
    t: float, start: Float[np.ndarray, "*sides 3"] | None = None
) -> Float[np.ndarray, "*sides 3"]:
    """The spins at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-12."""
    start = y0() if start is None else start
    axes = tuple(range(start.ndim - 1))

    def rate(t: float, s: np.ndarray) -> np.ndarray:
        b = sum((np.roll(s, 1, k) + np.roll(s, -1, k) for k in axes), np.zeros_like(s))
        return b - np.sum(b * s, axis=-1, keepdims=True) * s

    return by_dop853(rate, start, t, rtol=1e-12, atol=1e-12)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0())


def invariants(y: Spins, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"energy (falls)": energy(y), "length of each spin": jnp.linalg.norm(y, axis=-1)}


def error(y: Spins, exact: Spins) -> float:
    """The root mean square over the spins."""
    return float(np.linalg.norm(np.asarray(y) - exact) / (np.size(exact) / 3) ** 0.5)


def chart(**options: Any) -> cfjax.WorkPrecision:
    """Random spins that order, 64 x 64, to t = 100, adaptive steps; Tsit5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(
            cfjax.RKL2(spectral_radius=RADIUS),
            cfjax.RKL3(spectral_radius=RADIUS),
            cfjax.CF4(),
            cfjax.CF43(),
        )
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1),
        tolerances=[10.0**-k for k in range(2, 7)],
        error=error,
        **options,
    )


def picture(side: int = 64) -> figures.Figure:
    """The spins and the energy of each at four times, and the energy of all over time.

    Colour is the direction in the plane, brightness the component along z, as in `spins`.
    """
    shots = (0.0, 1.0, 10.0, 100.0)
    times = np.concatenate([[0.0], np.geomspace(0.1, 100.0, 61)])
    sol = diffrax.diffeqsolve(
        problem()["term"],
        cfjax.RKL2(spectral_radius=RADIUS),
        t0,
        times[-1],
        0.05,
        jnp.asarray(y0(side)),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-3),
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
    )
    ys = np.asarray(sol.ys)
    figure = figures.new(12.5, 4.6)
    subfigures: Any = figure.subfigures(1, 2, width_ratios=(2.1, 1))
    left, right = subfigures
    above, below = left.subplots(2, len(shots))
    for k, t in enumerate(shots):
        y = ys[np.argmin(np.abs(times - t))]
        above[k].imshow(_colours(y))
        above[k].set(xticks=[], yticks=[], title=f"t = {t:g}")
        values = np.asarray(density(jnp.asarray(y)))
        below[k].imshow(values, cmap="magma", vmin=0)
        covered = np.sum(np.abs(degree(y)))
        below[k].set(xticks=[], yticks=[], xlabel=f"covers {covered:.0f} spheres")
    above[0].set_ylabel("spins")
    below[0].set_ylabel("energy of a spin")
    ax = right.subplots()
    energies = np.asarray(jax.vmap(energy)(jnp.asarray(ys)))
    covered = np.array([np.sum(np.abs(degree(y))) for y in ys])
    total = np.array([np.sum(degree(y)) for y in ys])
    ax.loglog(times[1:], energies[1:], color=figures.BLUE, label="energy")
    ax.loglog(
        times[1:], 4 * np.pi * covered[1:], "--", color=figures.ORANGE, label="4π for each sphere"
    )
    # Zero has no place on a logarithmic axis.
    bound = np.maximum(4 * np.pi * np.abs(np.round(total[1:])), 1e-3)
    ax.step(times[1:], bound, ":", where="mid", color="0.3", label="4π |degree|")
    ax.set(xlabel="t", ylim=(4, None), title="Energy, and what defects hold")
    ax.legend(frameon=False)
    return figure


def _solid_angle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    def dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sum(x * y, axis=-1)

    volume = dot(a, np.cross(b, c))
    return 2 * np.arctan2(volume, 1 + dot(a, b) + dot(b, c) + dot(c, a))


def _colours(s: Float[np.ndarray, "*sides 3"]) -> Float[np.ndarray, "*sides 3"]:
    """The hue of a direction in the plane; white upwards, black downwards."""
    from matplotlib.colors import hsv_to_rgb

    z = s[..., 2]
    hue = np.arctan2(s[..., 1], s[..., 0]) / (2 * np.pi) % 1
    return hsv_to_rgb(np.stack([hue, np.minimum(1, 1 - z), np.minimum(1, 1 + z)], axis=-1))
