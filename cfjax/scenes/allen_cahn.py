"""The Allen-Cahn equation: two phases, the fronts between them, and a drop that shrinks.

`u_t = w^2 laplacian u + u - u^3` on the unit interval, square or cube, with no flux through its
walls. The phases are u = 1 and u = -1, and w is the width of a front. All quantities are
dimensionless. The state has the values at the centres of n cells along each axis. The frozen field
solves the diffusion exactly, by cosine transforms with the eigenvalues `-(pi k)^2`, and freezes the
reaction.

The equation descends an energy, the mean of `w^2 |grad u|^2 / 2 + (1 - u^2)^2 / 4`.

With `z = (x - 1/2) / (2^(1/2) w)` an exact solution on a line is

`u = sinh z / (cosh z + exp(3 (meeting - t) / 2))`.

Two fronts run into the unstable state u = 0 between them with the speed `3 w / 2^(1/2)`, until they
meet. Then they become one front that stands still, `tanh z`.

In two dimensions thin fronts move with their curvature times `w^2`. So a drop of any shape becomes
round, and its area falls at the rate `2 pi w^2`, as the curvature along a closed curve has the
integral 2 pi.

Source: Allen & Cahn, A microscopic theory for antiphase boundary motion and its application to
antiphase domain coarsening, Acta Metall. 27 (1979), doi:10.1016/0001-6160(79)90196-2.
"""

import functools
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_name, in_plain_space, solve

t0, t1 = 0.0, 6.0
solver = cfjax.ETD54()

# One, two or three axes.
Phases = Float[Array | np.ndarray, "*cells"]

WIDTH = 0.016
MEETING = 3.0


def y0(n: int = 256) -> Float[np.ndarray, " n"]:
    """The two fronts before they meet, on an interval."""
    return reference(t0, n)


def drop(n: int = 128) -> Float[np.ndarray, "n n"]:
    """A star of five points of the phase u = 1 in the phase u = -1."""
    x = (np.arange(n) + 0.5) / n - 0.5
    radius, angle = np.hypot(x[:, None], x), np.arctan2(x, x[:, None])
    return np.tanh((0.28 + 0.1 * np.cos(5 * angle) - radius) / (2**0.5 * 0.02))


def field(t: Any, y: Phases, args: float | Float[Array | np.ndarray, ""]) -> cfjax.Affine:
    """The frozen field, with the width w of a front as `args`."""
    transform = cfjax.TensorTransform([cfjax.CosineTransform()] * y.ndim)
    return cfjax.Affine(y - y**3, args**2 * jnp.asarray(_laplacian(y.shape), y.dtype), transform)


def velocity(t: Any, y: Phases, args: float | Float[Array | np.ndarray, ""]) -> Phases:
    """The same field in plain space, where diffusion limits the steps."""
    return cfjax.tangent(field(t, y, args), y)


def energy(y: Phases, args: float | Float[Array | np.ndarray, ""]) -> Float[Array, ""]:
    """The energy. A front of length one has `w 8^(1/2) / 3`."""
    y = jnp.asarray(y)
    transform = cfjax.TensorTransform([cfjax.CosineTransform()] * y.ndim)
    laplacian = jnp.asarray(_laplacian(y.shape), y.dtype)
    # The transform keeps the sum of squares.
    slopes = -laplacian * transform.forward(y) ** 2
    return jnp.mean(args**2 * slopes / 2 + (1 - y**2) ** 2 / 4)


def reference(t: float, n: int = 256, width: float = WIDTH) -> Float[np.ndarray, " n"]:
    """The exact solution at time `t`.

    It is nearly flat at the walls, and 256 cells resolve it: with the default width the solution of
    the cells from `y0` differs at 6 by less than 1e-11.
    """
    z = ((np.arange(n) + 0.5) / n - 0.5) / (2**0.5 * width)
    return np.sinh(z) / (np.cosh(z) + np.exp(1.5 * (MEETING - t)))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=WIDTH)


def invariants(y: Phases, args: Any = WIDTH) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"energy (falls)": energy(y, args)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The Allen-Cahn equation, 256 cells, to t = 6, 5 to 320 equal steps; Tsit5 in plain space.

    Kvaerno5 is not in it: its matrices are dense, and a step takes some hundred times as long.
    """
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.CF43(), cfjax.ETDRK4(), cfjax.ETD43(), cfjax.ETD54())
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1),
        num_steps=[5 * 2**k for k in range(7)],
        **options,
    )


def picture(n: int = 128) -> figures.Figure:
    """Fronts on a line that meet, and a drop that shrinks, with its area."""
    figure = figures.new(12.5, 3.2)
    left, *squares, right = figure.subplots(1, 5, width_ratios=(1.4, 1, 1, 1, 1.4))
    _, line = solve(problem(), solver, num_steps=15, save_every=5, save_initial=True)
    x = (np.arange(256) + 0.5) / 256
    colours = "#999999", figures.ORANGE, figures.VERMILION, figures.BLUE
    for k, (t, colour) in enumerate(zip((0.0, 2.0, 4.0, 6.0), colours, strict=True)):
        left.plot(x, line[k], color=colour, label=f"t = {t:g}")
        left.plot(x[::4], reference(t)[::4], ".", color=colour, markersize=4)
    left.set(title="Fronts on a line; dots: exact", xlim=(0.3, 0.7), xlabel="x", ylabel="u")
    left.legend(frameon=False)

    width, steps = 0.02, dict(num_steps=110, save_every=1, save_initial=True)
    times, ys = solve(problem(), solver, t1=110.0, y0=drop(n), args=width, **steps)
    for ax, t in zip(squares, (0, 10, 90), strict=True):
        ax.imshow(ys[t].T, origin="lower", cmap="RdBu_r", vmin=-1, vmax=1)
        ax.set(xticks=[], yticks=[], title=f"A drop, t = {t}")
    figure.colorbar(squares[0].images[0], ax=squares, label="u", shrink=0.7)
    area = np.mean((1 + ys) / 2, axis=(1, 2))
    right.plot(times, area, color=figures.BLUE, label="area of the drop")
    law = area[0] - 2 * np.pi * width**2 * times
    right.plot(times, np.maximum(law, 0), ":", color="0.3", label="thin fronts")
    right.set(ylim=(0, None), xlabel="t", title="Area")
    right.legend(frameon=False)
    return figure


def _laplacian(shape: tuple[int, ...]) -> Float[np.ndarray, "*cells"]:
    """Minus the squares of the wave numbers."""
    return functools.reduce(np.add.outer, [-((np.pi * np.arange(float(n))) ** 2) for n in shape])
