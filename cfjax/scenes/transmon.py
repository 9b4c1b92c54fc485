"""A transmon under a microwave pulse: a few levels of an anharmonic oscillator, in the laboratory.

With `hbar = 1`, time in ns and energies in rad/ns, `i U' = H(t) U` with

`H(t) = diag(frequency n + anharmonicity n (n - 1) / 2) + drive(t) (a + a^T)`,

where n = 0, 1, .. counts the levels and `a` lowers them. The drive is at the frequency of the two
lowest levels, within an envelope of two parts:

`drive(t) = in_phase(t) cos(frequency t) + quadrature(t) sin(frequency t)`,
`in_phase(t) = sum_k x_k (1 - cos(2 pi k t / duration))`,
`quadrature(t) = sum_k y_k sin(2 pi k t / duration)`, both in rad/ns, with k = 1, 2, ..

So the pulse begins and ends at zero. It should swap the two lowest levels. The third level makes
this hard, as its distance from the second is nearly the same: a short pulse reaches it too. A
quadrature proportional to the slope of the in-phase part corrects most of this loss.

The field depends on t but not on y. The frozen field is a skew-Hermitian matrix, whose flow keeps a
propagator unitary and the norm of a state. Nothing is averaged: the drive keeps its fast
oscillation.

Source: Motzoi, Gambetta, Rebentrost & Wilhelm, Simple pulses for elimination of leakage in weakly
nonlinear qubits, Phys. Rev. Lett. 103 (2009), doi:10.1103/PhysRevLett.103.110501.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space, solve

# A propagator, a state, or several states as columns.
Columns = Complex[Array | np.ndarray, "levels *columns"]


class Pulse(NamedTuple):
    """A transmon and the pulse on it. `t1 = duration`.

    `in_phase` and `quadrature` have shape `(K,)`, for the same or other K.
    """

    in_phase: Any
    quadrature: Any
    duration: Any = 8.0
    frequency: Any = 2 * np.pi * 5.0
    anharmonicity: Any = -2 * np.pi * 0.3


t0 = 0.0
solver = cfjax.Magnus6()


def plain(duration: float = 8.0) -> Pulse:
    """The pulse that swaps the two lowest levels if there are no others, up to a fast ripple."""
    return Pulse(np.array([np.pi / duration]), np.array([0.0]), duration)


def corrected(duration: float = 8.0) -> Pulse:
    """The same with a quadrature of `-in_phase' / (2 anharmonicity)`, which loses less."""
    pulse = plain(duration)
    slope = pulse.in_phase * 2 * np.pi / duration
    return pulse._replace(quadrature=-slope / (2 * pulse.anharmonicity))


def y0(levels: int = 4) -> Complex[np.ndarray, "levels levels"]:
    """The propagator at the start. Its first column is the ground state."""
    return np.eye(levels, dtype=complex)


def field(t: Any, y: Columns, args: Pulse) -> cfjax.LeftMatrix:
    """The frozen field, on a propagator, a state or columns."""
    return cfjax.LeftMatrix(-1j * _hamiltonian(t, y, args))


def velocity(t: Any, y: Columns, args: Pulse) -> Complex[Array, "levels *columns"]:
    """The same field in plain space, where no method keeps the norm."""
    return -1j * (_hamiltonian(t, y, args) @ y)


def drive(t: Any, args: Pulse) -> Float[Array, "*times"]:
    """The amplitude of the drive, in rad/ns."""
    t, args = _like(jnp.result_type(t), (t, args))
    first, second = envelope(t, args)
    phase = args.frequency * t
    return first * jnp.cos(phase) + second * jnp.sin(phase)


def envelope(t: Any, args: Pulse) -> tuple[Float[Array, "*times"], Float[Array, "*times"]]:
    """The in-phase part and the quadrature of the drive, in rad/ns."""
    t, args = _like(jnp.result_type(t), (t, args))
    angle = 2 * np.pi / args.duration * t
    pairs = [enumerate(args.in_phase, start=1), enumerate(args.quadrature, start=1)]
    first = [x * (1 - jnp.cos(k * angle)) for k, x in pairs[0]]
    second = [y * jnp.sin(k * angle) for k, y in pairs[1]]
    return sum(first, jnp.zeros_like(t)), sum(second, jnp.zeros_like(t))


def infidelity(y: Complex[Array | np.ndarray, "levels levels"], args: Pulse) -> Float[Array, ""]:
    """One less the mean fidelity of a propagator as a swap, over all states of two levels.

    It is computed in the frame that turns with the drive. Population in higher levels counts as
    lost.

    Source: Pedersen, Moller & Molmer, Fidelity of quantum operations, Phys. Lett. A 367 (2007),
    doi:10.1016/j.physleta.2007.02.069.
    """
    angle = jnp.asarray(args.frequency * args.duration, jnp.finfo(y.dtype).dtype)
    turn = jnp.stack([jnp.ones_like(y[0, 0]), lax.complex(jnp.cos(angle), jnp.sin(angle))])
    swapped = (turn[:, None] * y[:2, :2])[::-1]
    population = jnp.sum(jnp.square(jnp.abs(swapped)))
    return 1 - (population + jnp.square(jnp.abs(jnp.trace(swapped)))) / 6


def reference(args: Pulse, levels: int = 4) -> Complex[np.ndarray, "levels levels"]:
    """The propagator at the end, by SciPy's DOP853 with a tolerance of 1e-13.

    It is solved in a frame in which the levels rest, so that steps are longer and no code of this
    file is used.
    """
    n = np.arange(levels)
    energies = args.frequency * n + args.anharmonicity * n * (n - 1) / 2
    root = np.sqrt(n[1:])

    def rate(t, y):
        angle = 2 * np.pi * t / args.duration
        first = sum(x * (1 - np.cos((k + 1) * angle)) for k, x in enumerate(args.in_phase))
        second = sum(x * np.sin((k + 1) * angle) for k, x in enumerate(args.quadrature))
        phase = args.frequency * t
        size = first * np.cos(phase) + second * np.sin(phase)
        hops = size * root * np.exp(1j * t * (energies[1:] - energies[:-1]))
        h = np.diag(hops, -1) + np.diag(hops.conj(), 1)
        return -1j * (h @ y)

    y = by_dop853(rate, y0(levels), args.duration)
    return np.exp(-1j * energies * args.duration)[:, None] * y


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    args = corrected()
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=args.duration, y0=y0(), args=args)


def invariants(y: Columns, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    defect = jnp.conj(y.T) @ y - np.eye(len(y), dtype=y.dtype)
    return {"distance from unitary": jnp.linalg.norm(defect)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The corrected pulse on a propagator, 100 to 3200 equal steps; Tsit5 and Dopri8 beside it."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.Magnus4(), cfjax.Magnus6(), cfjax.Magnus8())
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(corrected()),
        num_steps=[100 * 2**k for k in range(6)],
        **options,
    )


def picture() -> figures.Figure:
    """The two parts of a pulse, and where the levels go under it, without and with quadrature."""
    figure = figures.new(10.5, 5.2)
    axes = figure.subplots(2, 2, sharex=True)
    colours = figures.BLUE, figures.ORANGE, figures.VERMILION, figures.PURPLE
    pulses = {"in phase only": plain(), "with quadrature": corrected()}
    for (up, down), (name, args) in zip(axes.T, pulses.items(), strict=True):
        steps = dict(t1=args.duration, num_steps=1200, save_every=1)
        times, ys = solve(problem(), solver, args=args, **steps)
        loss = float(infidelity(ys[-1], args))
        up.set_title(f"{name}: infidelity {loss:.1e}")
        up.plot(times, np.asarray(drive(times, args)), color="0.8", linewidth=0.8, label="drive")
        in_phase, quadrature = envelope(times, args)
        up.plot(times, np.asarray(in_phase), color=figures.BLUE, label="in phase")
        up.plot(times, np.asarray(quadrature), color=figures.VERMILION, label="quadrature")
        for k, colour in enumerate(colours):
            down.semilogy(times, np.abs(ys[:, k, 0]) ** 2, color=colour, label=f"level {k}")
        down.set(ylim=(1e-7, 2), xlabel="time, ns")
    axes[0, 0].set_ylabel("rad/ns")
    axes[1, 0].set_ylabel("population")
    for row in axes:
        row[1].legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _hamiltonian(t: Any, y: Columns, args: Pulse) -> Complex[Array, "levels levels"]:
    """In the precision of the state."""
    t, args = _like(jnp.finfo(y.dtype).dtype, (t, args))
    n = np.arange(y.shape[0])
    numbers, pairs, root = (np.asarray(x, t.dtype) for x in (n, n * (n - 1) / 2, n[1:] ** 0.5))
    energies = args.frequency * numbers + args.anharmonicity * pairs
    h = jnp.diag(energies) + drive(t, args) * (np.diag(root, 1) + np.diag(root, -1))
    return h.astype(y.dtype)


def _like(dtype: Any, tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)
