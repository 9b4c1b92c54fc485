"""Spin waves: the frequencies of Heisenberg's magnet, from a long run without damping.

Every spin of a periodic square lattice turns about the sum B of its four neighbours, `s' = B x s`,
in units in which the gyromagnetic ratio and the coupling are one. Small tilts are waves,
`s_x + 1j s_y = exp(1j (k . r + w t))` with the frequency `w = 4 - 2 cos(kx) - 2 cos(ky)`. One
single wave is an exact solution whatever its tilt, with `cos(tilt)` times that frequency.

The lattice is a chessboard. Spins of one colour have neighbours of the other colour alone, so they
turn about fixed fields, and the flow of one colour is exact. Two-colour splittings keep the energy
to rounding at every step size. The frequencies are those of the method, and differ by its order.

A state has shape `(rows, columns, 3)`, both even. The field and the energy are those of
`cfjax.scenes.spins`.

Source: Krech, Bunker & Landau, Fast spin dynamics algorithms for classical spin systems, Comput.
Phys. Commun. 111 (1998), doi:10.1016/S0010-4655(98)00009-5.
"""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Int

import cfjax

from . import _figures as figures
from . import spins
from ._scene import by_name

t0, t1 = 0.0, 4.0
solver = cfjax.Strang()

Spins = Float[Array | np.ndarray, "rows columns 3"]

# Exchange alone: with anisotropy the flow of a colour would not be exact.
MAGNET = spins.Magnet(anisotropy=0.0, applied=(0.0, 0.0, 0.0), damping=0.0)


def colour(parity: int) -> cfjax.LieTerm:
    """The term that turns the spins of one colour, about fields that do not change meanwhile."""

    def field(t: Any, y: Spins, args: spins.Magnet) -> cfjax.Rotation:
        # In NumPy, as a constant of the program. XLA takes minutes to work it out.
        row, column = np.ogrid[: y.shape[0], : y.shape[1]]
        is_mine = ((row + column) % 2 == parity)[..., None]
        return cfjax.Rotation(jnp.where(is_mine, spins.effective_field(y, args), 0))

    return cfjax.LieTerm(field)


term = diffrax.MultiTerm(colour(0), colour(1))


def y0(side: int = 64, tilt: float = 0.03, seed: int = 0) -> Float[np.ndarray, "side side 3"]:
    """Spins near z with all waves alike: random phases, and `tilt` as the mean square root."""
    phases = 2j * np.pi * np.random.default_rng(seed).random((side, side))
    across = tilt * side * np.fft.ifft2(np.exp(phases))
    y = np.stack([across.real, across.imag, np.ones((side, side))], axis=-1)
    return y / np.linalg.norm(y, axis=-1, keepdims=True)


def frequency(kx: Any, ky: Any) -> Any:
    """The frequency of a small wave."""
    return 4 - 2 * np.cos(kx) - 2 * np.cos(ky)


def frequency_of_strang(kx: Any, ky: Any, step: float) -> Any:
    """The frequency that a small wave has with steps of `cfjax.Strang` below pi / 4, exactly.

    A step couples the amplitudes of the two colours by a matrix with determinant exp(8j step). It
    has two eigenvalues of modulus one, for this frequency and for that of k + (pi, pi).
    """
    mean = (np.cos(kx) + np.cos(ky)) / 2
    return 4 - 2 / step * np.arcsin(mean * np.sin(2 * step))


def wave(
    t: float, side: int = 8, turns: tuple[int, int] = (1, 2), tilt: float = 1.0
) -> Float[np.ndarray, "side side 3"]:
    """A single wave at time `t`, exactly; `turns` are those of a spin along each axis."""
    kx, ky = 2 * np.pi * np.array(turns) / side
    row, column = np.ogrid[:side, :side]
    phase = kx * row + ky * column + np.cos(tilt) * frequency(kx, ky) * t
    z = np.full_like(phase, np.cos(tilt))
    return np.stack([np.sin(tilt) * np.cos(phase), np.sin(tilt) * np.sin(phase), z], axis=-1)


def reference(t: float) -> Float[np.ndarray, "8 8 3"]:
    """The exact solution of `problem` at time `t`: one wave."""
    return wave(t)


def amplitudes(y: Spins, waves: Int[Array | np.ndarray, "waves 2"]) -> Complex[Array, " waves"]:
    """The waves in a state; `waves` has the turns along each axis."""
    across = jnp.fft.fft2(lax.complex(y[..., 0], y[..., 1]))
    return across[waves[:, 0], waves[:, 1]] / across.size


@functools.partial(jax.jit, static_argnums=(3, 4))
def run(
    start: Spins,
    waves: Int[Array | np.ndarray, "waves 2"],
    step: Any,
    num_steps: int,
    solver: diffrax.AbstractSolver,
) -> tuple[Complex[Array, "num_steps waves"], Float[Array, " num_steps"]]:
    """The amplitudes of `waves` and the energy of a spin after each step."""

    def seen(t: Any, y: Spins, args: spins.Magnet) -> Any:
        return amplitudes(y, waves), spins.energy(y, args) / (y.size // 3)

    saveat = diffrax.SaveAt(steps=True, fn=seen)
    options: Any = dict(saveat=saveat, max_steps=num_steps)
    end = num_steps * step
    sol: Any = diffrax.diffeqsolve(term, solver, 0.0, end, step, start, MAGNET, **options)
    return sol.ys


def spectrum(
    signal: Complex[Array | np.ndarray, "times waves"], step: float
) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times waves"]]:
    """Frequencies from 0 to 2 pi / `step`, and the power of each wave at them.

    Hann's window makes lines two frequencies wide.
    """
    n = len(signal)
    window = np.hanning(n + 1)[:n, None]
    return 2 * np.pi * np.arange(n) / (n * step), np.abs(np.fft.fft(window * signal, axis=0)) ** 2


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`: one wave."""
    return dict(term=term, t0=t0, t1=t1, y0=wave(t0), args=MAGNET)


def invariants(y: Spins, args: spins.Magnet = MAGNET) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"energy": spins.energy(y, args), "length of each spin": jnp.linalg.norm(y, axis=-1)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A spin wave on 8 x 8 spins to t = 4, 10 to 320 equal steps."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.Strang(), cfjax.BlanesMoan4(), cfjax.BlanesMoan6())
        | by_name(cfjax.CF4(), cfjax.CF54(), term=cfjax.LieTerm(spins.field)),
        reference=reference(t1),
        num_steps=[10 * 2**k for k in range(6)],
        **options,
    )


def picture(side: int = 64, time: float = 120.0) -> figures.Figure:
    """Spectra for two step sizes on a path of waves, and the energy, against CF4's, to t = 120.

    The path leads from long waves, Γ, to those along an axis that alternate, X, to those that
    alternate along both, M, and back.
    """
    half = side // 2
    up, zero = np.arange(half), np.zeros(half, int)
    corners = (up, zero), (zero + half, up), (half - up, half - up), ([0], [0])
    waves = np.concatenate([np.stack(pair, axis=1) for pair in corners])
    kx, ky = 2 * np.pi * waves.T / side
    start = y0(side)
    before = float(spins.energy(start, MAGNET)) / side**2

    figure = figures.new(11, 3.4)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1.15, 1))
    runs = [(cfjax.Strang(), 0.1, figures.BLUE), (cfjax.Strang(), 0.5, figures.GREEN)]
    runs += [(cfjax.CF4(), 0.1, figures.VERMILION), (cfjax.CF4(), 0.5, figures.ORANGE)]
    for ax, (solver, step, colour) in zip((left, middle, None, None), runs, strict=True):
        signal, energies = run(start, waves, step, round(time / step), solver)
        name = f"{type(solver).__name__}, steps of {step:g}"
        # Relative to the energy of the waves: aligned spins have two bonds each.
        change = np.maximum.accumulate(np.abs(energies - before)) / (before + 2)
        times = step * np.arange(1, len(change) + 1)
        right.loglog(times, np.where(change > 0, change, np.nan), color=colour, label=name)
        if ax is not None:
            frequencies, power = spectrum(np.asarray(signal), step)
            shown = frequencies < 8.6
            ends = (-0.5, len(waves) - 0.5, 0, frequencies[shown][-1])
            decades = np.log10(power[shown] / np.max(power))
            options: Any = dict(origin="lower", aspect="auto", extent=ends, cmap="magma")
            ax.imshow(decades, **options, vmin=-6, vmax=0, interpolation="nearest")
            ax.plot(frequency(kx, ky), "--", color="#56B4E9", linewidth=1.2, label="exact")
            ax.set(xticks=[0, half, 2 * half, 3 * half], xticklabels=["Γ", "X", "M", "Γ"])
            ax.set(title=name, xlabel="wave")
    figure.colorbar(middle.images[0], label="power, powers of ten")
    left.set_ylabel("frequency")
    left.legend(frameon=False, labelcolor="w", loc="lower center")
    right.set(title="Energy of the waves", xlabel="t", ylabel="largest change, relative")
    right.legend(frameon=False)
    return figure
