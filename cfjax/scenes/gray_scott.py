"""Gray and Scott's reaction on a periodic square: spots that grow, divide and fill the square.

The substance v makes more of itself from u, `u + 2 v -> 3 v`, and decays. The square is fed with u,
and everything flows off at the rate F of the feed:

`u' = D_u laplacian u - u v^2 + F (1 - u)`, `v' = D_v laplacian v + u v^2 - (F + K) v`.

Time, length and concentrations are dimensionless. The state is a dict of two grids of n x n values.
Each has a frozen field of its own, which solves the diffusion exactly, by Fourier transforms with
the eigenvalues `-|k|^2` of the Laplacian, and freezes the reaction.

Uniform states stay uniform, and follow the equations without diffusion, those of a stirred tank.
The mass obeys `d/dt mean(u + v) = F (1 - mean(u)) - (F + K) mean(v)`. Concentrations stay positive,
up to the error of the grid.

The problem is mildly stiff: diffusion is some 40 times as fast as the reaction. So for small errors
Tsit5 in plain space keeps up with the methods that solve diffusion exactly. On larger grids the
ratio grows with the square of n.

Source: Pearson, Complex patterns in a simple system, Science 261 (1993),
doi:10.1126/science.261.5118.189, for the diffusivities and the distance of the points, of which he
took 256 x 256.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 100.0
solver = cfjax.ETD54()

# The concentrations u and v, with the keys "u" and "v".
State = dict[str, Float[Array | np.ndarray, "n n"]]


class Reactor(NamedTuple):
    """What the fields take as `args`: by default spots that divide."""

    feed: Any = 0.03  # F
    kill: Any = 0.062  # K
    diffusivities: tuple[Any, Any] = (2e-5, 1e-5)  # of u and v
    side: Any = 0.625  # of the square


def y0(n: int = 64) -> dict[str, Float[np.ndarray, "n n"]]:
    """Three smooth spots with some v, on a square of u alone."""
    x = np.pi * np.arange(n) / n
    places = np.pi * np.array([[0.64, 0.27], [0.04, 0.02], [0.81, 0.91]])
    off = np.sin(x[:, None, None] - places[:, 0]) ** 2 + np.sin(x[:, None] - places[:, 1]) ** 2
    spots = np.exp(-25 * off).sum(axis=-1)
    return {"u": 1 - spots / 2, "v": spots / 4}


def field(t: Any, y: State, args: Reactor) -> dict[str, cfjax.Affine]:
    """The frozen fields of u and v."""
    n = len(y["u"])
    transform = cfjax.TensorTransform((cfjax.FourierTransform(), cfjax.RealFourierTransform(n)))
    k = np.fft.fftfreq(n, 1 / n), np.arange(n // 2 + 1.0)
    turns = jnp.asarray(np.add.outer(k[0] ** 2, k[1] ** 2), y["u"].dtype)
    laplacian = -((2 * np.pi / args.side) ** 2) * turns
    return {
        name: cfjax.Affine(rate, diffusivity * laplacian, transform)
        for (name, rate), diffusivity in zip(
            reaction(y, args).items(), args.diffusivities, strict=True
        )
    }


def reaction(y: Any, args: Reactor) -> dict[str, Any]:
    """The velocities without diffusion, those of a stirred tank."""
    u, v = y["u"], y["v"]
    made = u * v**2
    return {"u": args.feed * (1 - u) - made, "v": made - (args.feed + args.kill) * v}


def velocity(t: Any, y: State, args: Reactor) -> dict[str, Float[Array, "n n"]]:
    """The same field in plain space, where diffusion limits the steps."""
    return cfjax.tangent(field(t, y, args), y)


def reference(
    t: float, start: dict[str, Float[np.ndarray, "n n"]], args: Reactor
) -> dict[str, Float[np.ndarray, "n n"]]:
    """The state at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13.

    It solves the same system for the points, so its error is that of time alone: about 1e-13 in
    each value of the default start at 100. With n = 128 values differ by 4e-5.
    """
    shape = start["u"].shape
    k = 2 * np.pi / args.side * np.fft.fftfreq(shape[0], 1 / shape[0])
    laplacian = -np.add.outer(k**2, k[: shape[0] // 2 + 1] ** 2)

    def rate(t: float, y: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        u, v = y["u"], y["v"]
        u_spread, v_spread = (
            d * np.fft.irfft2(laplacian * np.fft.rfft2(x), shape)
            for d, x in zip(args.diffusivities, (u, v), strict=True)
        )
        conversion = u * v**2
        return {
            "u": u_spread - conversion + args.feed * (1 - u),
            "v": v_spread + conversion - (args.feed + args.kill) * v,
        }

    return by_dop853(rate, start, t)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=Reactor())


def invariants(y: State, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"lowest u (stays positive)": jnp.min(jnp.asarray(y["u"]))}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """Gray and Scott's reaction, 64 x 64 points, to t = 100, 10 to 320 equal steps."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.ETD43(), cfjax.ETD54())
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1, y0(), Reactor()),
        num_steps=[10 * 2**k for k in range(6)],
        **options,
    )


def picture(n: int = 64) -> figures.Figure:
    """The substance v at six times, to t = 6000."""
    steps = dict(num_steps=600, save_every=50, save_initial=True)
    _, ys = solve(problem(), solver, t1=6000.0, y0=y0(n), **steps)
    times = (0, 500, 1000, 1500, 2500, 6000)
    figure = figures.new(12.0, 2.2)
    side = Reactor().side
    axes = figure.subplots(1, len(times))
    for ax, t in zip(axes, times, strict=True):
        options: Any = dict(origin="lower", extent=(0, side, 0, side), cmap="magma")
        ax.imshow(ys["v"][t // 500].T, vmin=0, vmax=0.4, **options)
        ax.set(xticks=[], yticks=[], title=f"t = {t}")
    figure.colorbar(axes[0].images[0], ax=axes, label="v")
    return figure
