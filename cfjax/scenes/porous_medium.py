"""A spot that spreads through a porous medium, with a sharp edge: diffusion that depends on itself.

`u' = laplacian u^2` on a square whose walls nothing passes. It is the density of a gas in a porous
medium, or of water in the ground, in units in which nothing else is left. The diffusivity 2u
vanishes where there is nothing yet, so a spot has an edge, which moves with a finite speed. An
exact solution on the plane is Barenblatt's,

`u = max(0, (1 - r^2 / t^(1/2)) / (16 t^(1/2)))`,

with the edge at `r = t^(1/4)`. The peak falls, and what is still to happen takes longer and longer,
so that steps may grow in proportion to t.

The state has the values at the centres of n x n cells. Differences of neighbours over the width of
a cell are what flows through their wall, so the mass stays. The frozen field is an array. No
transform diagonalises the diffusion, which falls with time: an explicit method takes steps of less
than `2.8 / rho` with the spectral radius `rho`, about `16 n^2 max(u) / side^2`.

Source: Barenblatt, On some unsteady motions of a liquid and gas in a porous medium, Prikl. Mat.
Mekh. 16 (1952); Vázquez, The Porous Medium Equation, Oxford University Press (2006).
"""

from typing import Any, cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space

t0, t1 = 1.0, 100.0
# The method for large diffusion that no transform diagonalises.
solver = cfjax.RKL2()

Density = Float[Array | np.ndarray, "n n"]

SIDE = 7.0


def y0(n: int = 64) -> Float[np.ndarray, "n n"]:
    """Barenblatt's spot with an edge at radius one."""
    return barenblatt(t0, n)


def barenblatt(t: float, n: int = 64, side: float = SIDE) -> Float[np.ndarray, "n n"]:
    """The exact solution on the plane, at the centres of the cells."""
    x = centres(n, side)
    square = x[:, None] ** 2 + x**2
    return np.maximum(0, 1 - square / t**0.5) / (16 * t**0.5)


def centres(n: int = 64, side: float = SIDE) -> Float[np.ndarray, " n"]:
    """The centres of the cells along an axis, from the middle of the square."""
    return side * ((np.arange(n) + 0.5) / n - 0.5)


def field(t: Any, y: Density, args: Any) -> Float[Array, "n n"]:
    """The velocity, with the side of the square as `args`."""
    y = jnp.asarray(y)
    # In place of u^2, so that values below zero, as rounding makes them, diffuse too.
    square = y * jnp.abs(y)
    flows = (jnp.diff(jnp.pad(jnp.diff(square, axis=k), _walls(k)), axis=k) for k in (0, 1))
    return sum(flows, jnp.zeros_like(y)) * (len(y) / args) ** 2


def reference(
    t: float, start: Float[np.ndarray, "n n"] | None = None, side: float = SIDE
) -> Float[np.ndarray, "n n"]:
    """The cells at time `t`, from the start at time one, by SciPy's DOP853.

    It solves the same system for the cells, with a tolerance of 1e-13, so its error is that of time
    alone. From the default start it differs from Barenblatt's solution by 0.7 % of the solution at
    t = 4, in root mean squares, and by 0.24 % at t = 100.
    """
    start = y0() if start is None else start

    def rate(t: float, u: np.ndarray) -> np.ndarray:
        padded = np.pad(u * np.abs(u), 1, mode="edge")
        around = padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2]
        return (around - 4 * padded[1:-1, 1:-1]) * (len(u) / side) ** 2

    return by_dop853(rate, start, t - t0)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=SIDE)


def invariants(y: Density, args: Any = SIDE) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    y = jnp.asarray(y)
    return {"mass": jnp.mean(y) * args**2, "peak (falls)": jnp.max(y)}


def error(y: Density, exact: Density) -> float:
    """The root mean square of the difference, over that of the solution."""
    return float(np.linalg.norm(np.asarray(y) - exact) / np.linalg.norm(exact))


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A spot in a porous medium, 64 x 64 cells, to t = 100, adaptive steps; Tsit5 beside them."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.RKL2(), cfjax.RKL3(), cfjax.CF4(), cfjax.CF43())
        | in_plain_space(field, diffrax.Tsit5()),
        reference=reference(t1),
        tolerances=[10.0**-k for k in range(3, 8)],
        error=error,
        **options,
    )


def picture(n: int = 64) -> figures.Figure:
    """The spot at four times, beside the exact solution, and the steps that it takes."""
    times = np.array([1.0, 4.0, 20.0, 100.0])
    given: Any = problem() | dict(y0=jnp.asarray(y0(n)))
    sol = diffrax.diffeqsolve(
        given["term"],
        solver,
        t0,
        t1,
        1e-2,
        given["y0"],
        given["args"],
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-5),
        saveat=diffrax.SaveAt(
            subs=[diffrax.SubSaveAt(ts=jnp.asarray(times)), diffrax.SubSaveAt(t0=True, steps=True)]
        ),
        max_steps=1000,
    )
    spots, steps = jax.tree.map(np.asarray, sol.ys)
    ends = np.asarray(cast(Any, sol.ts)[1])
    used = np.isfinite(ends)
    ends, steps = ends[used], steps[used]

    figure = figures.new(12.5, 3.2)
    *squares, left, right = figure.subplots(1, 4, width_ratios=(1, 1, 1.5, 1.5))
    x, half = centres(n), SIDE / 2
    for k, ax in zip((0, -1), squares, strict=True):
        extent = (-half, half, -half, half)
        ax.imshow(spots[k] / spots[k].max(), extent=extent, cmap="magma", vmin=0, vmax=1)
        circle = times[k] ** 0.25 * np.exp(1j * np.linspace(0, 2 * np.pi, 200))
        ax.plot(circle.real, circle.imag, ":", color="white", linewidth=1)
        ax.set(xticks=[], yticks=[], title=f"t = {times[k]:g}, peak {spots[k].max():.2g}")
    squares[0].set_xlabel("dotted: the exact edge")
    colours = "#999999", figures.ORANGE, figures.VERMILION, figures.BLUE
    fine = np.linspace(-half, half, 400)
    middle = spots[:, n // 2]
    for t, spot, colour in zip(times, middle, colours, strict=True):
        # Off the axis of the square by half a cell.
        radius = np.hypot(fine, x[n // 2])
        exact = np.maximum(0, 1 - radius**2 / t**0.5) / (16 * t**0.5)
        left.plot(fine, exact, color=colour, linewidth=1, label=f"t = {t:g}")
        left.plot(x, spot, ".", color=colour, markersize=4)
    left.set(title="Across the middle; lines: exact", xlabel="x", ylabel="u", xlim=(-half, half))
    left.legend(frameon=False)
    lengths = np.diff(ends)
    radii = jax.vmap(lambda y: cfjax.spectral_radius(given["term"], t0, y, SIDE))(steps[:-1])
    # Odd numbers that reach a tenth further than the radius.
    stages = np.ceil((np.sqrt(9 + 8.8 * lengths * np.asarray(radii)) - 1) / 2) // 2 * 2 + 1
    label = f"{len(lengths)} steps of RKL2,\n{stages.min():.0f} to {stages.max():.0f} stages each"
    right.loglog(ends[1:], lengths, ".-", color=figures.BLUE, label=label)
    right.loglog(ends[:-1], 2.8 / np.asarray(radii), ":", color="0.3", label="stability of CF4")
    right.set(title="Length of a step", xlabel="t")
    right.legend(frameon=False)
    return figure


def _walls(axis: int) -> list[tuple[int, int]]:
    """No flow through the walls at the ends of an axis."""
    return [(1, 1) if k == axis else (0, 0) for k in (0, 1)]
