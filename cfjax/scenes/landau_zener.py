"""The Landau-Zener problem: two levels that are swept through each other.

`i psi' = H(t) psi`, `H(t) = [[rate t, 2 coupling], [2 coupling, -rate t]] / 2`, with ħ = 1. Without
the coupling the levels would cross at t = 0; with it they stay apart by at least twice the
coupling. In a slow sweep the state follows its level, and in a fast sweep the state does not
change: from minus to plus infinity it stays the same with the probability
`exp(-2 pi coupling^2 / rate)`.

The field depends on t but not on y, and it is linear in t. The frozen field is a skew-Hermitian
matrix, whose flow keeps the norm.

Source: Zener, Non-adiabatic crossing of energy levels, Proc. R. Soc. A 137 (1932),
doi:10.1098/rspa.1932.0165.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

import cfjax

from . import _figures as figures
from ._scene import by_name, in_plain_space, solve

t0, t1 = -10.0, 10.0
solver = cfjax.Magnus6()


class Sweep(NamedTuple):
    """How fast the levels are swept, as energy over time, and what couples them, an energy."""

    rate: Any = 1.0
    coupling: Any = 0.5


slow = Sweep()


def y0() -> Complex[np.ndarray, "2"]:
    """The state whose level comes from below."""
    return np.array([1.0 + 0.0j, 0.0])


def field(t: Any, y: Complex[Array, "2 *columns"], args: Sweep) -> cfjax.LeftMatrix:
    """The frozen field, on a state or on a propagator."""
    return cfjax.LeftMatrix(-1j * _hamiltonian(t, args).astype(y.dtype))


def velocity(t: Any, y: Complex[Array, "2 *columns"], args: Sweep) -> Complex[Array, "2 *columns"]:
    """The same field in plain space, where no method keeps the norm."""
    return field(t, y, args).a @ y


def staying(y: Complex[Array | np.ndarray, "*times 2"]) -> Float[Array, "*times"]:
    """The probability of finding the initial state."""
    return jnp.square(jnp.abs(y[..., 0]))


def limit(args: Sweep) -> Any:
    """The probability of staying in the initial state, from minus to plus infinity."""
    return jnp.exp(-2 * jnp.pi * args.coupling**2 / args.rate)


def energies(t: Float[np.ndarray, "*times"], args: Sweep) -> Float[np.ndarray, "*times 2"]:
    """The levels, the lower one first."""
    half = np.hypot(args.rate * t / 2, args.coupling)
    return np.stack([-half, half], axis=-1)


def reference(
    t: float, start: Complex[np.ndarray, "2"] | None = None, args: Sweep = slow, t_start: float = t0
) -> Complex[np.ndarray, "2"]:
    """The state at time `t` of a start at `t_start`, in NumPy's complex128.

    It is computed by a Taylor series, in steps within which no phase grows by more than about one.
    The error is a few units of rounding for every step.
    """
    y = y0() if start is None else np.asarray(start)
    longest = max(abs(t), abs(t_start)) * abs(args.rate) / 2 + abs(args.coupling)
    n = max(1, int(np.ceil(abs(t - t_start) * longest)))
    h = (t - t_start) / n
    slope = -1j * h**2 * args.rate / 2 * np.diag([1.0, -1.0])
    for k in range(n):
        value = args.rate * (t_start + k * h)
        a = -1j * h / 2 * np.array([[value, 2 * args.coupling], [2 * args.coupling, -value]])
        before, term, total = np.zeros_like(y), y, y
        for m in range(1, 40):
            before, term = term, (a @ term + slope @ before) / m
            total = total + term
        y = total
    return y


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=slow)


def invariants(y: Complex[Array, "2"], args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"norm": jnp.linalg.norm(y)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A sweep from t = -10 to 10, 40 to 2560 equal steps; Tsit5 and Dopri8 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(
            cfjax.CF4(),
            cfjax.CF54(),
            cfjax.Magnus4(),
            cfjax.Magnus6(),
            cfjax.Magnus8(),
            cfjax.Magnus10(),
        )
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1),
        num_steps=[40 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """The levels and how they are filled; sweeps at several rates; the path on the sphere."""
    from matplotlib.collections import LineCollection
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    n = 1200
    sweeps = {rate: Sweep(rate, 0.5) for rate in (0.3, 1.0, 3.0, 10.0)}
    states = {}
    for rate, args in sweeps.items():
        _, states[rate] = solve(problem(), solver, args=args, num_steps=n, save_every=1)
    times = t0 + (t1 - t0) * np.arange(1, n + 1) / n
    figure = figures.new(10.5, 3.6)
    levels, chances = figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2)
    sphere = figures.sphere(figure, 1, 3, 3, zoom=1.25)

    near = np.abs(times) < 4
    t, psi = times[near], states[1.0][near]
    for sign in (1, -1):
        levels.plot(t, sign * t / 2, color="0.6", linestyle=":", linewidth=1)
    bands = energies(t, slow)
    for k in range(2):
        h = np.array([_hamiltonian_np(s, slow) for s in t])
        share = np.abs(np.einsum("ti,ti->t", np.linalg.eigh(h)[1][:, :, k].conj(), psi)) ** 2
        points = np.stack([t, bands[:, k]], axis=-1)
        pieces = np.stack([points[:-1], points[1:]], axis=1)
        lines = LineCollection(
            list(pieces), linewidths=1 + 6 * share, capstyle="round", color=figures.BLUE
        )
        levels.add_collection(lines)
    levels.set(title="Levels, as wide as they are filled", xlabel="t", ylabel="energy")

    colours = [figures.BLUE, figures.GREEN, figures.ORANGE, figures.VERMILION]
    for (rate, y), colour in zip(states.items(), colours, strict=True):
        chances.plot(times, np.asarray(staying(y)), color=colour, label=f"rate {rate:g}")
        end = float(limit(sweeps[rate]))
        chances.plot([0, t1], [end, end], color=colour, linestyle=":", linewidth=1)
    chances.set(title="Probability to stay, and its limit", xlabel="t", ylim=(-0.02, 1.02))
    chances.legend(frameon=False, loc="lower left")

    up, down = states[1.0].T
    across = 2 * up.conj() * down
    path = np.stack([across.real, across.imag, abs(up) ** 2 - abs(down) ** 2], axis=-1)
    pieces = np.stack([path[:-1], path[1:]], axis=1)
    sphere.add_collection3d(
        Line3DCollection(pieces, array=times[1:], cmap="viridis", linewidth=1.4, zorder=1)
    )
    sphere.set_title("The state at rate 1, late is yellow", y=0.97)
    return figure


def _hamiltonian(t: Any, args: Sweep) -> Float[Array, "2 2"]:
    half, coupling = args.rate * t / 2, jnp.asarray(args.coupling)
    return jnp.stack([jnp.stack([half, coupling]), jnp.stack([coupling, -half])])


def _hamiltonian_np(t: float, args: Sweep) -> Float[np.ndarray, "2 2"]:
    half = args.rate * t / 2
    return np.array([[half, args.coupling], [args.coupling, -half]])
