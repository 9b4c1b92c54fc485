"""The Kuramoto-Sivashinsky equation: chaos in one dimension, stiff through its fourth derivative.

`u_t = -u u_x - u_xx - u_xxxx` on a period L. Long waves grow, short waves decay, and the first term
carries energy from long to short ones. All quantities are dimensionless.

The state holds the Fourier coefficients of n = 2 (m - 1) points, `u = sum of c_k exp(2 pi i k x /
L)` over k from -n/2 to n/2, of which those with `k = 0 .. n/2` are stored. The frozen field
solves the linear terms exactly and freezes the product. A grid takes short waves of a product for
long ones. So only waves with `3 k < n` take part, by the two-thirds rule, and the others stay zero.

The mean of u is constant. Energy obeys `d/dt mean(u^2) / 2 = mean(u_x^2) - mean(u_xx^2)`, for the
waves that take part too.

Small differences grow: with the default period by a factor of e in about 11 units of time, the
Lyapunov time. An error grows some tenfold in the 30 units of `problem`. After some 400 units two
solutions in float64 have nothing in common, whatever the methods, so only short times can be
compared.

Source: Kassam & Trefethen, Fourth-order time-stepping for stiff PDEs, SIAM J. Sci. Comput. 26
(2005), doi:10.1137/S1064827502410633, for the start, the period and the number of points.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 30.0
solver = cfjax.ETD54()

Coefficients = Complex[Array | np.ndarray, " m"]

PERIOD = 32 * np.pi


def y0(n: int = 128) -> Complex[np.ndarray, " m"]:
    """The coefficients of `cos(x / 16) (1 + sin(x / 16))` with the default period; m = n/2 + 1."""
    x = 2 * np.pi * np.arange(n) / n
    c = np.fft.rfft(np.cos(x) * (1 + np.sin(x)), norm="forward")
    # Without the rounding of the others, which would be there for good.
    return np.where(np.arange(len(c)) <= 2, c, 0)


def field(t: Any, y: Coefficients, args: float | Float[Array | np.ndarray, ""]) -> cfjax.Affine:
    """The frozen field, with the period as `args`. Costs two real FFTs of length n."""
    k = wave_numbers(y, args)
    square = jnp.fft.rfft(to_grid(y) ** 2, norm="forward")
    is_kept = 3 * np.arange(len(k)) < 2 * (len(k) - 1)
    half = jnp.where(is_kept, k / 2, 0)
    return cfjax.Affine(lax.complex(half * square.imag, -half * square.real), k**2 - k**4)


def velocity(
    t: Any, y: Coefficients, args: float | Float[Array | np.ndarray, ""]
) -> Complex[Array, " m"]:
    """The same field in plain space, where the fourth derivative limits the steps."""
    return cfjax.tangent(field(t, y, args), y)


def wave_numbers(
    y: Coefficients, args: float | Float[Array | np.ndarray, ""]
) -> Float[Array, " m"]:
    """The wave numbers `2 pi k / L` of the coefficients."""
    return jnp.arange(len(y), dtype=jnp.real(y).dtype) * (2 * jnp.pi / args)


def to_grid(y: Coefficients) -> Float[Array, " n"]:
    """The values at the points `x_j = j L / n`."""
    return jnp.fft.irfft(y, 2 * (len(y) - 1), norm="forward")


def energy(y: Coefficients) -> Float[Array, ""]:
    """The mean of `u^2 / 2`."""
    return jnp.mean(to_grid(y) ** 2) / 2


def reference(
    t: float, start: Complex[np.ndarray, " m"], period: float = PERIOD
) -> Complex[np.ndarray, " m"]:
    """The coefficients at time `t`, by SciPy's DOP853 on the points, with a tolerance of 1e-13.

    It solves the same system for the points, so its error is that of time alone, below 1e-12 for
    the default start at 30. With n = 256 that solution differs by 1e-4.
    """
    n = 2 * (len(start) - 1)
    k = np.fft.fftfreq(n, 1 / n)
    wave = 2 * np.pi / period * k

    def rate(t: float, u: np.ndarray) -> np.ndarray:
        advection = -0.5j * np.where(3 * np.abs(k) < n, wave, 0) * np.fft.fft(u**2)
        return np.fft.ifft((wave**2 - wave**4) * np.fft.fft(u) + advection).real

    u = by_dop853(rate, np.fft.irfft(start, n, norm="forward"), t)
    return np.fft.rfft(u, norm="forward")


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=PERIOD)


def invariants(y: Coefficients, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"mean": jnp.real(jnp.asarray(y)[0])}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The Kuramoto-Sivashinsky equation, n = 128, to t = 30, 40 to 2560 equal steps."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.CF43(), cfjax.ETDRK4(), cfjax.ETD43(), cfjax.ETD54())
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1, y0()),
        num_steps=[40 * 2**k for k in range(7)],
        **options,
    )


def picture(time: float = 200.0) -> figures.Figure:
    """The solution to t = 200, and how fast two part that differ in the start or in the steps."""
    start, n = jnp.asarray(y0()), round(2 * time)

    def run(y: Any, steps_between: int) -> Any:
        steps = dict(num_steps=n * steps_between, save_every=steps_between, save_initial=True)
        _, ys = solve(problem(), solver, t1=time, y0=y, **steps)
        return np.asarray(jax.vmap(to_grid)(ys))

    u, times = run(start, 4), np.linspace(0.0, time, n + 1)
    # Not with the symmetry of the start.
    others = {
        "start 1e-10 apart": run(start.at[1].add(1e-10j), 4),
        "steps twice as long": run(start, 2),
    }
    figure = figures.new(9.5, 4.0)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.2))
    options: Any = dict(extent=(0, PERIOD, time, 0), aspect="auto", cmap="RdBu_r", vmin=-3, vmax=3)
    figure.colorbar(left.imshow(u, **options), ax=left)
    left.set(title="u", xlabel="x", ylabel="t")
    colours = figures.BLUE, figures.VERMILION
    for (name, other), colour in zip(others.items(), colours, strict=True):
        off = np.sqrt(np.mean((other - u) ** 2, axis=1))
        right.semilogy(times, np.where(off > 0, off, np.nan), color=colour, label=name)
    right.semilogy(times, 1e-10 * np.exp(times / 11), ":", color="0.4", label="exp(t / 11)")
    right.set(title="Distance of two solutions", xlabel="t")
    right.legend(frameon=False)
    return figure
