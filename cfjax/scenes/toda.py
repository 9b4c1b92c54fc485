"""The Toda lattice: particles on a line that repel their neighbours, as an isospectral flow.

With the energy `sum p_k^2 / 2 + sum exp(q_k - q_(k+1))` and free ends, take the symmetric
tridiagonal matrix L with `-p_k / 2` on the diagonal and `exp((q_k - q_(k+1)) / 2) / 2` beside it.
Then `L' = B L - L B`, where B is the part of L above the diagonal minus the part below. The
eigenvalues of L do not change. As time goes on the particles move apart, and L becomes diagonal,
with its eigenvalues in falling order. All quantities are dimensionless.

The equation moves any symmetric matrix in this way. The frozen field is a conjugation, which keeps
the eigenvalues. The solution leaves the tridiagonal matrices by the error of the method.

Source: Flaschka, The Toda lattice. II. Existence of integrals, Phys. Rev. B 9 (1974),
doi:10.1103/PhysRevB.9.1924; Calvo, Iserles & Zanna, Numerical solution of isospectral flows, Math.
Comp. 66 (1997), doi:10.1090/S0025-5718-97-00902-2.
"""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_name, in_plain_space, solve

t0, t1 = 0.0, 10.0
solver = cfjax.Projected(diffrax.Dopri8())

# The particles of `y0()`: they run into each other.
positions = np.array([-10.0, -5.0, -1.0, 4.0, 9.0])
momenta = np.array([2.0, 1.0, 0.2, -0.8, -1.8])


def y0() -> Float[np.ndarray, "5 5"]:
    """The matrix of five particles that collide."""
    return matrix(positions, momenta)


def matrix(q: Float[np.ndarray, " n"], p: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """The matrix L of particles at `q` with momenta `p`."""
    beside = np.exp(-np.diff(q) / 2) / 2
    return np.diag(-p / 2) + np.diag(beside, 1) + np.diag(beside, -1)


def field(t: Any, y: Float[Array, "n n"], args: Any = None) -> cfjax.Conjugation:
    """The frozen field at any symmetric matrix."""
    # As B is skew, `Congruence` would do it too, for less. Other isospectral flows need this.
    return cfjax.Conjugation(jnp.triu(y, 1) - jnp.tril(y, -1))


def velocity(t: Any, y: Float[Array, "n n"], args: Any = None) -> Float[Array, "n n"]:
    """The same field in plain space, where methods lose the eigenvalues."""
    return cfjax.tangent(field(t, y), y)


def energy(y: Float[Array | np.ndarray, "*times n n"]) -> Float[Array, "*times"]:
    """The energy of the lattice, twice the sum of the squared eigenvalues."""
    return 2 * jnp.sum(jnp.square(y), axis=(-2, -1))


def reference(t: float, start: Float[np.ndarray, "n n"] | None = None) -> Float[np.ndarray, "n n"]:
    """The exact solution at time `t`, in NumPy's float64.

    With the factors `exp(t L) = Q R` of the start it is `Q^T L Q`. The time is split into pieces in
    which the condition number of the exponential is at most e: over the whole time, small columns
    would be lost to rounding. The error is a few units of rounding for every piece.
    """
    y = y0() if start is None else start
    values = np.linalg.eigvalsh(y)
    pieces = max(1, int(np.ceil(abs(t) * (values[-1] - values[0]))))
    for _ in range(pieces):
        values, vectors = np.linalg.eigh(y)
        exponential = (vectors * np.exp(t / pieces * (values - values.mean()))) @ vectors.T
        q, r = np.linalg.qr(exponential)
        q = q * np.sign(np.diag(r))
        y = q.T @ y @ q
        y = (y + y.T) / 2
    return y


def particles(
    y: Float[Array | np.ndarray, "*times n n"], center: float | Float[np.ndarray, "*times"]
) -> Float[np.ndarray, "*times n"]:
    """The positions of the particles, relative to their centre of mass.

    Beyond a distance of about 50 the numbers beside the diagonal are smaller than the error of the
    method.
    """
    beside = np.diagonal(np.asarray(y), 1, -2, -1)
    q = np.cumsum(-2 * np.log(2 * np.abs(beside)), axis=-1)
    q = np.concatenate([np.zeros_like(q[..., :1]), q], axis=-1)
    return q + (np.asarray(center) - q.mean(-1))[..., None]


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0())


def invariants(y: Float[Array, "n n"], args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {"energy": energy(y), "eigenvalues": jnp.linalg.eigvalsh(y)}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """Five particles of a Toda lattice to t = 10, 20 to 1280 equal steps; Tsit5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF3(), cfjax.CF4(), cfjax.RKMK4(), cfjax.CF43(), cfjax.CF54())
        | by_name(*PROJECTED)
        | in_plain_space(velocity, diffrax.Dopri5(), diffrax.Tsit5()),
        reference=reference(t1),
        num_steps=[20 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """The paths of particles that collide, to t = 14, and the matrix that becomes diagonal."""
    n, plain = 100, diffrax.ODETerm(velocity)
    options = dict(t1=14.0, num_steps=n, save_every=1)
    times, ys = solve(problem(), solver, **options)
    _, others = solve(problem(), diffrax.Tsit5(), term=plain, **options)
    q = particles(ys, positions.mean() + momenta.mean() * times)
    values = np.linalg.eigvalsh(y0())
    figure = figures.new(10.5, 3.6)
    lattice, diagonal, drift = figure.subplots(1, 3)
    colours = [figures.BLUE, figures.GREEN, figures.ORANGE, figures.VERMILION, figures.PURPLE]
    for k, colour in enumerate(colours):
        lattice.plot(q[:, k], times, color=colour)
        diagonal.plot(times, ys[:, k, k], color=colour)
    for value in values:
        diagonal.axhline(value, color="0.6", linestyle=":", linewidth=1, zorder=0)
    for name, y in {"Projected, Dopri8": ys, "Tsit5": others}.items():
        off = np.abs(np.linalg.eigvalsh((y + np.swapaxes(y, 1, 2)) / 2) - values).max(-1)
        drift.semilogy(times, np.maximum(off, 1e-16), label=f"{name}, {n} steps")
    lattice.set(title="Positions", xlabel="q", ylabel="t")
    diagonal.set(title="The diagonal, and the eigenvalues", xlabel="t")
    drift.set(title="Error of the eigenvalues", xlabel="t")
    drift.legend(frameon=False)
    return figure
