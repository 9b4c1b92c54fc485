"""A cat: an oscillator that exchanges photons in pairs ends in a superposition of two fields.

The density matrix rho of an oscillator, shape `(n, n)`, in the frame of its frequency and with
ħ = 1, obeys Lindblad's equation,

`rho' = -i [H, rho] + pairs D[a^2] rho + loss D[a] rho`,
`H = i pairs x ((a^H)^2 - a^2) / 2`, `D[L] rho = L rho L^H - {L^H L, rho} / 2`,

where `a` lowers the number of photons by one. Photons are lost in pairs and driven in pairs, and
the drive is switched on smoothly, `x = size^2 (1 - exp(-t / rise))`. Drive and loss in pairs
together are the same as one jump `a^2 - x`, so they stop at states with `a^2 = x`: the coherent
fields of amplitudes plus and minus `size`, and their superpositions. Both keep the number of
photons even. So from the vacuum, which is even, the state ends in the even superposition, a cat,
whose Wigner function has fringes between the two fields. The loss of single photons washes them
out.

The field depends on t but not on rho. Dissipation is stiff, as pairs are lost from the level n at
the rate `pairs n (n - 1)`.

Source: Mirrahimi, Leghtas, Albert, Touzard, Schoelkopf, Jiang & Devoret, Dynamically protected
cat-qubits, New J. Phys. 16 (2014), doi:10.1088/1367-2630/16/4/045014.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space, solve

t0, t1 = 0.0, 2.0
solver = cfjax.Kraus4()

Density = Complex[Array | np.ndarray, "n n"]


class Oscillator(NamedTuple):
    """The amplitude of the fields, the rates of pairs and of photons, and the rise of the drive."""

    size: Any = 2.0
    pairs: Any = 1.0
    loss: Any = 0.0
    rise: Any = 0.2


def y0(levels: int = 24) -> Complex[np.ndarray, "n n"]:
    """The vacuum."""
    return coherent(0.0, levels)


def coherent(amplitude: complex | float, levels: int = 24) -> Complex[np.ndarray, "n n"]:
    """The field of a laser."""
    psi = _amplitudes(amplitude, levels)
    return np.outer(psi, psi.conj()) / np.linalg.norm(psi) ** 2


def superposition(amplitude: complex | float, levels: int = 24) -> Complex[np.ndarray, "n n"]:
    """The even superposition of two fields, in which the motion without loss ends.

    With 24 levels and a size of 2 it ends there but for 5e-7, as higher levels are cut off.
    """
    psi = _amplitudes(amplitude, levels) + _amplitudes(-amplitude, levels)
    return np.outer(psi, psi.conj()) / np.linalg.norm(psi) ** 2


def field(t: Any, y: Density, args: Oscillator) -> cfjax.Lindblad:
    """The frozen field."""
    h, rates = _coefficients(t, y, args)
    return cfjax.Lindblad(h, _jumps(y), rates)


def velocity(t: Any, y: Density, args: Oscillator) -> Complex[Array, "n n"]:
    """The same field in plain space, where eigenvalues may become negative."""
    h, rates = _coefficients(t, y, args)
    total = -1j * (h @ y - y @ h)
    for rate, jump in zip(rates.astype(y.dtype), _jumps(y), strict=True):
        jump = jump.astype(y.dtype)
        loss = jump.T @ jump / 2
        total = total + rate * (jump @ y @ jump.T - loss @ y - y @ loss)
    return total


def parity(y: Complex[Array | np.ndarray, "*times n n"]) -> Float[Array, "*times"]:
    """1 if the number of photons is even, and -1 if it is odd."""
    populations = jnp.diagonal(y, axis1=-2, axis2=-1).real
    return jnp.sum(populations[..., ::2], -1) - jnp.sum(populations[..., 1::2], -1)


def wigner(
    y: Complex[np.ndarray, "*times n n"], amplitude: Complex[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "*times rows columns"]:
    """The Wigner function at complex amplitudes, at most 2 / pi in modulus. Its integral is 1."""
    from scipy.special import eval_genlaguerre, gammaln

    n, square = y.shape[-1], 4 * np.abs(amplitude) ** 2
    turning: Any
    element: Any
    total = np.zeros(y.shape[:-2] + amplitude.shape)
    for k in range(n):
        # The element for k photons and k + d more, and its adjoint.
        for d in range(n - k):
            size = np.exp((gammaln(k + 1) - gammaln(k + d + 1)) / 2 - square / 2)
            size *= (1 + (d > 0)) * (-1) ** k * eval_genlaguerre(k, d, square)
            turning, element = (2 * np.conj(amplitude)) ** d, y[..., k + d, k]
            total += np.multiply.outer(element.real, size * turning.real)
            total -= np.multiply.outer(element.imag, size * turning.imag)
    return 2 / np.pi * total


def negativity(
    y: Complex[np.ndarray, "*times n n"], reach: float = 4.0, points: int = 61
) -> Float[np.ndarray, "*times"]:
    """The integral of the Wigner function where it is negative, without its sign.

    It is zero for coherent fields and their mixtures. The sum goes over a square grid up to
    `reach`, and is off by some 1e-3.
    """
    side = np.linspace(-reach, reach, points)
    values = wigner(y, side + 1j * side[:, None])
    return np.asarray(-np.sum(np.minimum(values, 0), axis=(-2, -1)) * (side[1] - side[0]) ** 2)


def reference(
    t: float, args: Oscillator, start: Complex[np.ndarray, "n n"] | None = None
) -> Complex[np.ndarray, "n n"]:
    """The state at time `t`, by SciPy's DOP853 with a tolerance of 1e-13, element by element.

    The error at t = 2 is about 3e-12.
    """
    y = y0() if start is None else np.asarray(start)
    n = np.arange(len(y))
    # From n + 1 or n + 2 photons to n, and back; none come from levels that are cut off.
    one, two = np.sqrt(n[1:]), np.sqrt(n[1:-1] * n[2:])
    losses = args.pairs * n * (n - 1) + args.loss * n
    decay = (losses[:, None] + losses) / 2

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        change = -decay * y
        change[:-1, :-1] += args.loss * one[:, None] * one * y[1:, 1:]
        change[:-2, :-2] += args.pairs * two[:, None] * two * y[2:, 2:]
        x = args.pairs * args.size**2 * (1 - np.exp(-t / args.rise)) / 2
        # x (a^H^2 - a^2) rho, and its adjoint.
        product = np.zeros_like(y)
        product[:-2] -= x * two[:, None] * y[2:]
        product[2:] += x * two[:, None] * y[:-2]
        return change + product + product.conj().T

    return by_dop853(rate, y, t)


def error(y: Density, exact: Density) -> float:
    """The 2-norm of the difference, or NaN for a solve that has become unstable.

    Density matrices are never farther apart than the root of 2.
    """
    size = float(np.linalg.norm(np.asarray(y) - exact))
    return size if size < 2 else np.nan


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=Oscillator())


def invariants(y: Density, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says. Parity stays if no single photons are lost."""
    return {
        "trace": jnp.trace(y).real,
        "parity": parity(y),
        "sum of negative eigenvalues": jnp.sum(jnp.minimum(jnp.linalg.eigvalsh(y), 0)),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A cat from the vacuum, 6 to 768 equal steps; Tsit5 and Dopri8 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.Magnus4(), cfjax.Kraus4())
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1, Oscillator()),
        num_steps=[6 * 2**k for k in range(8)],
        error=error,
        **options,
    )


def picture() -> figures.Figure:
    """The Wigner function at three times, and how much of it is negative, with and without loss."""
    figure = figures.new(12.0, 3.4)
    *maps, curves = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.1))
    steps: Any = dict(num_steps=200, save_every=8, save_initial=True)
    solves = {
        loss: solve(problem(), solver, args=Oscillator(loss=loss), **steps)
        for loss in (0.0, 0.03, 0.1)
    }
    times = solves[0.0][0]
    x, p = np.linspace(-3.5, 3.5, 141), np.linspace(-2.5, 2.5, 101)
    middle = int(np.argmin(np.abs(times - 0.4)))
    shown: Any = None
    for ax, k in zip(maps, (0, middle, -1), strict=True):
        values = wigner(solves[0.0][1][k], x + 1j * p[:, None])
        options: Any = dict(cmap="RdBu_r", vmin=-2 / np.pi, vmax=2 / np.pi, rasterized=True)
        shown = ax.pcolormesh(x, p, values, shading="gouraud", **options)
        ax.set(title=f"t = {times[k]:g}", aspect="equal", xticks=[-2, 0, 2], yticks=[-2, 0, 2])
    figure.colorbar(shown, ax=maps, location="bottom", shrink=0.4, aspect=40)
    colours = figures.BLUE, figures.ORANGE, figures.VERMILION
    for (loss, (_, ys)), colour in zip(solves.items(), colours, strict=True):
        curves.plot(times, negativity(ys), color=colour, label=f"loss {loss:g}")
    curves.set(title="Integral of the negative part", xlabel="t")
    curves.legend(frameon=False)
    return figure


def _amplitudes(amplitude: complex | float, levels: int) -> Complex[np.ndarray, " n"]:
    """The amplitudes of a coherent field, but for the norm."""
    factors = amplitude / np.sqrt(np.arange(1.0, levels))
    return np.cumprod(np.concatenate([[1.0 + 0.0j], factors]))


def _jumps(y: Density) -> list[np.ndarray]:
    """`a^2` and `a`, in the precision of the state."""
    lower = np.diag(np.sqrt(np.arange(1.0, y.shape[0])), 1)
    return [jump.astype(jnp.finfo(y.dtype).dtype) for jump in (lower @ lower, lower)]


def _coefficients(t: Any, y: Density, args: Oscillator) -> tuple[Array, Array]:
    """The Hamiltonian and the rates, in the precision of the state."""
    dtype = jnp.finfo(y.dtype).dtype
    t, args = jax.tree.map(lambda x: jnp.asarray(x, dtype), (t, args))
    x = args.size**2 * (1 - jnp.exp(-t / args.rise))
    pair, _ = _jumps(y)
    h = (args.pairs * x / 2).astype(y.dtype) * (1j * (pair.T - pair)).astype(y.dtype)
    return h, jnp.stack([args.pairs, args.loss])
