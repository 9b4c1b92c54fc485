"""Quantum annealing: a chain of spins in a transverse field that is slowly turned off.

`i psi' = H(t) psi` with `H = -(1 - s) sum_j X_j - s (sum_j Z_j Z_(j+1) + field sum_j Z_j)`, where s
rises from 0 to 1 over the ramp. The chain is open and starts in the ground state of the transverse
field. If the ramp is slow compared with the smallest gap on the way, the state ends in the ground
state of the Ising chain, with all spins up. Energies are in units of the coupling, times in units
of its inverse.

A state has shape `(2^n,)`, with the first spin as the highest bit; a bit of 0 is up. No matrix is
formed: the X_j flip axes of a view, and the other terms are a diagonal. Frozen, the field is a sum
of two fixed operators, and the state keeps its norm.

Source: Kadowaki & Nishimori, Quantum annealing in the transverse Ising model, Phys. Rev. E 58
(1998), doi:10.1103/PhysRevE.58.5355.
"""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Complex, Float

import cfjax

from . import _figures as figures
from ._scene import by_dop853, by_name, in_plain_space

t0, t1 = 0.0, 20.0
solver = cfjax.Magnus6()

State = Complex[Array | np.ndarray, " size"]

# What tells the two ordered states apart.
longitudinal = 0.2


def y0(num_spins: int = 8) -> Complex[np.ndarray, " size"]:
    """All spins along the transverse field."""
    return np.full(2**num_spins, 2.0 ** (-num_spins / 2), complex)


def ramp(t: Any, duration: Any = t1) -> Any:
    """s at time t: smooth, with no slope at both ends."""
    return jnp.sin(jnp.pi / 2 * t / duration) ** 2


def flips(x: Complex[Array, " size"]) -> Complex[Array, " size"]:
    """`sum_j X_j x`, where X_j flips spin j. Its norm is the number of spins."""
    views = (x.reshape(2**j, 2, -1) for j in range(_num_spins(x)))
    return sum((jnp.flip(view, 1).reshape(x.shape) for view in views), jnp.zeros_like(x))


@functools.cache
def couplings(num_spins: int) -> Float[np.ndarray, " size"]:
    """The diagonal of `sum_j Z_j Z_(j+1) + field sum_j Z_j`."""
    bits = np.arange(2**num_spins)[:, None] >> np.arange(num_spins)[::-1] & 1
    z = 1.0 - 2.0 * bits
    return np.sum(z[:, 1:] * z[:, :-1], axis=1) + longitudinal * np.sum(z, axis=1)


@functools.cache
def _operators(num_spins: int, precision: str) -> list[Any]:
    dtype = np.result_type(precision, np.complex64)
    vector = jax.ShapeDtypeStruct((2**num_spins,), dtype)
    turn = lx.FunctionLinearOperator(lambda x: 1j * flips(x), vector)
    return [(turn, num_spins), (1j * couplings(num_spins)).astype(dtype)]


def field(t: Any, y: State, args: Any = None) -> cfjax.OperatorSum:
    """The frozen field `-i H(t)`; `args` is the duration of the ramp, or None for `t1`."""
    s = ramp(t, t1 if args is None else args)
    operators = _operators(_num_spins(y), jnp.finfo(y.dtype).dtype.name)
    return cfjax.OperatorSum([1 - s, s], operators, is_skew=True)


def velocity(t: Any, y: State, args: Any = None) -> Complex[Array, " size"]:
    """The same field in plain space, where no method keeps the norm."""
    return cfjax.tangent(field(t, y, args), y)


def energy(t: Any, y: State, args: Any = None) -> Float[Array, ""]:
    """The mean energy at time t."""
    y = jnp.asarray(y)
    return jnp.vdot(y, 1j * velocity(t, y, args)).real


def fidelity(y: State) -> Float[Array, ""]:
    """The probability of the ground state at the end of the ramp: all spins up."""
    return jnp.abs(y[..., 0]) ** 2


def reference(t: float, num_spins: int = 8) -> Complex[np.ndarray, " size"]:
    """The state at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13.

    With sparse matrices made of Kronecker products. The error is about 1e-11.
    """
    import scipy.sparse as sparse

    def at(j: int, pauli: Any) -> Any:
        left, right = sparse.identity(2**j), sparse.identity(2 ** (num_spins - j - 1))
        return sparse.kron(sparse.kron(left, pauli), right, "csr")

    x = sum(at(j, [[0, 1], [1, 0]]) for j in range(num_spins))
    zs = [at(j, [[1, 0], [0, -1]]) for j in range(num_spins)]
    pairs = sum(a @ b for a, b in zip(zs[1:], zs[:-1], strict=True))
    z = pairs + longitudinal * sum(zs)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        s = np.sin(np.pi / 2 * t / t1) ** 2
        return 1j * ((1 - s) * (x @ y) + s * (z @ y))

    return by_dop853(rate, y0(num_spins), t, atol=1e-15)


def problem(num_spins: int = 8) -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(num_spins))


def invariants(y: State, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"norm": jnp.linalg.norm(y)}


def chart(num_spins: int = 10, **options: Any) -> cfjax.WorkPrecision:
    """Ten spins, 80 to 1280 equal steps; Tsit5 and Dopri8 in plain space with equal operators."""
    return cfjax.work_precision(
        **problem(num_spins),
        methods=by_name(
            cfjax.CF4(), cfjax.CF54(), cfjax.Magnus4(), cfjax.Magnus6(), cfjax.Magnus8()
        )
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1, num_spins),
        # With fewer, methods in plain space are not stable.
        num_steps=[80 * 2**k for k in range(5)],
        **options,
    )


def picture(num_spins: int = 8) -> figures.Figure:
    """The levels with the energy of the state, how spins order, and what a slower ramp gains."""

    def solve(duration: Any) -> Any:
        arguments: Any = problem(num_spins) | dict(t1=duration, args=duration)
        return cfjax.integrate(**arguments, solver=solver, num_steps=50, save_every=1)

    durations = np.geomspace(1.0, 100.0, 25)
    ends = jax.lax.map(lambda duration: solve(duration).ys[-1], jnp.asarray(durations))
    sol = solve(jnp.asarray(t1))
    times, ys = np.asarray(sol.ts), np.asarray(sol.ys)
    eye = jnp.eye(2**num_spins, dtype=complex)
    # One after the other, in one program.
    h, energies = jax.lax.map(
        lambda pair: (1j * cfjax.tangent(field(pair[0], eye[0]), eye), energy(*pair)),
        (jnp.asarray(times), jnp.asarray(ys)),
    )
    lowest = np.linalg.eigvalsh(h)[:, :12]

    figure = figures.new(10.5, 3.4)
    levels, spins, slow = figure.subplots(1, 3)
    levels.plot(times, np.asarray(lowest), color="0.75", linewidth=1)
    levels.plot(times, energies, color=figures.VERMILION, label="the state")
    levels.set(title="Lowest levels, and the energy", xlabel="t", ylabel="energy")
    levels.legend(frameon=False)
    up = 1 - (np.arange(2**num_spins)[:, None] >> np.arange(num_spins)[::-1] & 1)
    means = 2 * (np.abs(ys) ** 2) @ up - 1
    box = (times[0], times[-1], num_spins + 0.5, 0.5)
    image = spins.imshow(means.T, aspect="auto", extent=box, cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(image, ax=spins)
    spins.set(title="Mean of each Z", xlabel="t", ylabel="spin")
    slow.semilogx(durations, np.asarray(fidelity(ends)), "o-", markersize=3, color=figures.BLUE)
    slow.set(title="Fidelity at the end", xlabel="duration of the ramp", ylim=(0, 1.02))
    return figure


def _num_spins(y: Any) -> int:
    return y.shape[0].bit_length() - 1
