"""Heat conduction in a rod of variable diffusivity: a stiff semidiscrete system.

`u_t = (mu(x) u_x)_x` on [-1, 1] with `u(-1, t) = u(1, t) = 0`, `u(x, 0) = 1 - |x|` and
`mu(x) = 1 - x^2`, by central differences on N intervals of width dx. All quantities are
dimensionless. The state y has the N - 1 orthonormal sine coefficients of the grid values
u_1..u_{N-1}, so both have the same 2-norm. The frozen field keeps the part with constant
diffusivity, which the sine transform diagonalises, and freezes the rest.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.3, doi:10.1016/S0167-739X(02)00161-9.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import in_plain_space, solve

t0, t1 = 0.0, 0.5
# Not ETD54: a third of the largest diffusivity is outside of the exact part, as in the paper, and
# ETD54 then blows up with fewer than 400 steps.
solver = cfjax.CF4()


class Diffusivity(NamedTuple):
    """What the fields take as `args`."""

    mu: Float[Array | np.ndarray, " N"]  # at the midpoints of the intervals
    constant: Float[Array | np.ndarray, ""]  # the part that the flows solve exactly


def diffusivity(num_intervals: int = 100) -> Diffusivity:
    """The paper's `mu(x) = 1 - x^2`, and its mean."""
    mu = 1 - _midpoints(num_intervals) ** 2
    return Diffusivity(mu, np.asarray(np.mean(mu)))


def y0(num_intervals: int = 100) -> Float[np.ndarray, " n"]:
    """The sine coefficients of the initial temperature `1 - |x|`."""
    # Not at import: few who import the package need it.
    from scipy.fft import dst

    return np.asarray(dst(1 - np.abs(_points(num_intervals)), type=1, norm="ortho"))


def field(t: Any, y: Float[Array, " n"], args: Diffusivity) -> cfjax.Affine:
    """The frozen field at sine coefficients `y`. Costs two sine transforms."""
    n = len(y)
    k = np.arange(1, n + 1)
    second_difference = -(((n + 1) * np.sin(k * np.pi / (2 * (n + 1)))) ** 2)
    mu, constant = jnp.asarray(args.mu), jnp.asarray(args.constant)
    b = _operator(mu - constant, to_grid(y))
    return cfjax.Affine(from_grid(b), constant * jnp.asarray(second_difference, y.dtype))


def grid_field(t: Any, u: Float[Array, " n"], args: Diffusivity) -> Float[Array, " n"]:
    """The velocity of the grid values `u`, for methods of a linear space.

    As a translation: with it CF4 is the classical Runge-Kutta method.
    """
    return _operator(jnp.asarray(args.mu), u)


def to_grid(y: Float[Array, " n"]) -> Float[Array, " n"]:
    """The grid values of sine coefficients."""
    return cfjax.SineTransform().inverse(y)


def from_grid(u: Float[Array, " n"]) -> Float[Array, " n"]:
    """The sine coefficients of grid values."""
    return cfjax.SineTransform().forward(u)


def reference(
    t: float | Float[Array | np.ndarray, "*times"], mu: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "*times n"]:
    """The exact grid values of the semidiscrete system at times `t`, in NumPy's float64.

    It is computed by the eigenvectors of the symmetric matrix of the system. The error is that of
    the eigenvalues, a few units of rounding of the largest, times t.
    """
    from scipy.linalg import eigh_tridiagonal

    scale = (len(mu) / 2) ** 2
    rates, vectors = eigh_tridiagonal(-scale * (mu[:-1] + mu[1:]), scale * mu[1:-1])
    modes = vectors.T @ (1 - np.abs(_points(len(mu))))
    return (np.exp(np.asarray(t, float)[..., None] * rates) * modes) @ vectors.T


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=diffusivity())


def invariants(y: Float[Array, " n"], args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    u = to_grid(y)
    return {
        "highest temperature (falls)": jnp.max(u),
        "lowest temperature (stays positive)": jnp.min(u),
        "asymmetry": jnp.max(jnp.abs(u - u[::-1])),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """Heat conduction, N = 100, tolerances 1e-2 to 1e-7. CF4, RKMK4 and RK4 double steps."""

    def velocity(t, y, args):
        return from_grid(grid_field(t, to_grid(y), args))

    return cfjax.work_precision(
        **problem(),
        methods={
            "CF4": cfjax.Richardson(cfjax.CF4()),
            "CF43": cfjax.CF43(),
            "RKMK4": cfjax.Richardson(cfjax.RKMK4()),
            # On translations CF4 is the classical Runge-Kutta method.
            "RK4": (cfjax.LieTerm(velocity), cfjax.Richardson(cfjax.CF4())),
        }
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Kvaerno5()),
        reference=np.asarray(from_grid(jnp.asarray(reference(t1, np.asarray(diffusivity().mu))))),
        tolerances=[10.0**-k for k in range(2, 8)],
        **options,
    )


def picture(num_intervals: int = 100) -> figures.Figure:
    """The temperature as it falls, and the errors of CF4 and of RKMK4, which is not stable here."""
    n, args = 200, diffusivity(num_intervals)
    points = np.concatenate([[-1.0], _points(num_intervals), [1.0]])

    def temperatures(ys: Any) -> np.ndarray:
        u = np.asarray(jax.vmap(to_grid)(jnp.asarray(ys)))
        return np.pad(u, ((0, 0), (1, 1)))

    us, steps = {}, dict(num_steps=n, save_every=1, throw=False)
    for method in cfjax.CF4(), cfjax.RKMK4():
        times, ys = solve(problem(), method, y0=y0(num_intervals), args=args, **steps)
        us[type(method).__name__] = temperatures(ys)
    times = t1 * np.arange(1, n + 1) / n
    start = temperatures(y0(num_intervals)[None])
    figure = figures.new(10.0, 3.6)
    curves, image, errors = figure.subplots(1, 3)
    curves.plot(points, start[0], color="0.6", linestyle=":", label="t = 0")
    colours = figures.VERMILION, figures.ORANGE, figures.GREEN, figures.BLUE
    for t, colour in zip((0.025, 0.1, 0.25, 0.5), colours, strict=True):
        k = round(n * t / t1) - 1
        curves.plot(points, us["CF4"][k], color=colour, label=f"t = {times[k]:g}")
    curves.set(title="Temperature", xlabel="x")
    curves.legend(frameon=False)
    box = (-1.0, 1.0, t1, t0)
    rows = np.concatenate([start, us["CF4"]])
    shown = image.imshow(rows, extent=box, aspect="auto", cmap="inferno", vmin=0, vmax=1)
    figure.colorbar(shown, ax=image)
    image.set(title="Temperature", xlabel="x", ylabel="t")
    exact = reference(times, np.asarray(args.mu))
    for (name, u), colour in zip(us.items(), (figures.BLUE, figures.VERMILION), strict=True):
        off = np.abs(u[:, 1:-1] - exact).max(axis=1)
        errors.semilogy(times, np.where(off < 1, off, np.nan), color=colour, label=name)
    errors.set(title=f"Error, steps of {t1 / n:g}", xlabel="t")
    errors.legend(frameon=False)
    return figure


def _points(num_intervals: int) -> Float[np.ndarray, " n"]:
    return 2 * np.arange(1, num_intervals) / num_intervals - 1


def _midpoints(num_intervals: int) -> Float[np.ndarray, " N"]:
    return (2 * np.arange(num_intervals) + 1) / num_intervals - 1


def _operator(mu: Float[Array, " N"], u: Float[Array, " n"]) -> Float[Array, " n"]:
    """Central differences of the flux `mu u_x`."""
    flux = mu * jnp.diff(jnp.pad(u, 1))
    return (len(mu) / 2) ** 2 * jnp.diff(flux)
