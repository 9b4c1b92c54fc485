"""Hybrid Monte Carlo: lattice gauge fields sampled by trajectories on a group.

The links U of a periodic lattice with two axes are matrices of SU(n). They are to have the density
`exp(-S)`, with Wilson's action `S = -beta / n sum Re tr(plaquette)` over all squares. Each link
gets a momentum P in su(n) with density `exp(tr P^2)`, and the pair moves by Hamilton's equations of
`H = S - sum tr P^2`: a kick `P' = F(U)`, then a drift `U' = P U`, each with an exact flow. A
symmetric splitting of the two is reversible and keeps volume. Then the end of a trajectory is
accepted with the probability `min(1, exp(-dH))`, and the density is exact at every step size. The
error dH decides alone how often that happens.

Many chains run at once: links and momenta have shape `(chains, 2, rows, columns, n, n)`.

For SU(2) the mean of a plaquette is known, a sum over characters.

Source: Duane, Kennedy, Pendleton & Roweth, Hybrid Monte Carlo, Phys. Lett. B 195 (1987),
doi:10.1016/0370-2693(87)91197-X; Creutz, Global Monte Carlo algorithms for many-fermion systems,
Phys. Rev. D 38 (1988), doi:10.1103/PhysRevD.38.1228.
"""

import functools
from itertools import accumulate
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Key

import cfjax

from . import _figures as figures

t0, t1 = 0.0, 1.0
solver = cfjax.BlanesMoan4()

Links = Complex[Array | np.ndarray, "chains 2 rows columns n n"]
State = dict[str, Links]

# Half a step of Blanes and Moan's SRKN11b, from the outside: kick, drift, kick, ....
_HALF = (
    *(0.0414649985182624, 0.123229775946271, 0.198128671918067, 0.290553797799558),
    *(-0.0400061921041533, -0.127049212625417, 0.0752539843015807, -0.246331761062075),
    *(-0.0115113874206879, 0.357208872795928, 0.2366699247869311),
)
_STAGES = tuple(accumulate(_HALF, lambda before, x: x - before))

_L = 0.1931833275037836

# Each with its forces a step. Omelyan, Mryglod & Folk, Comput. Phys. Commun. 151 (2003),
# doi:10.1016/S0010-4655(02)00754-3; Blanes & Moan, J. Comput. Appl. Math. 142 (2002),
# doi:10.1016/S0377-0427(01)00492-7. SRKN11b has order 6 where H is quadratic in the momenta.
METHODS: dict[str, tuple[Any, int]] = {
    "Strang": (cfjax.Strang(), 1),
    "Omelyan": (cfjax.Splitting((_L, 0.5 - _L, 0.5 - _L, _L)), 2),
    "BlanesMoan4": (cfjax.BlanesMoan4(), 6),
    "BlanesMoan6": (cfjax.BlanesMoan6(), 10),
    "SRKN11b": (cfjax.Splitting((*_STAGES, *reversed(_STAGES))), 11),
}


@functools.partial(jax.jit, static_argnums=1)
def momenta(key: Key[Array, ""], shape: tuple[int, ...]) -> Complex[Array, "..."]:
    """Matrices of su(n) with density `exp(tr P^2)`, of shape `(..., n, n)`."""
    real, imaginary = jax.random.normal(key, (2, *shape)) / jnp.sqrt(2)
    return algebra(lax.complex(real, imaginary))


def algebra(x: Complex[Array, "*batch n n"]) -> Complex[Array, "*batch n n"]:
    """The part in su(n): skew-Hermitian and traceless."""
    x = (x - jnp.conj(jnp.swapaxes(x, -1, -2))) / 2
    trace = jnp.trace(x, axis1=-2, axis2=-1)[..., None, None]
    return x - trace / x.shape[-1] * _identity(x)


def plaquette(links: Links) -> Float[Array, " chains"]:
    """The mean of `Re tr(plaquette) / n` in each chain."""
    u, v = links[:, 0], links[:, 1]
    there, back = _product(u, jnp.roll(v, -1, 1)), _product(v, jnp.roll(u, -1, 2))
    rows, columns, n = links.shape[2:5]
    return jnp.sum((there * jnp.conj(back)).real, axis=(1, 2, 3, 4)) / (rows * columns * n)


def action(links: Links, beta: Any) -> Float[Array, " chains"]:
    """Wilson's action S of each chain."""
    rows, columns = links.shape[2:4]
    return -beta * rows * columns * plaquette(links)


def energy(y: State, beta: Any) -> Float[Array, " chains"]:
    """The Hamiltonian H of each chain."""
    return action(y["U"], beta) + jnp.sum(jnp.abs(y["P"]) ** 2, axis=(1, 2, 3, 4, 5))


def kick(t: Any, y: State, beta: Any) -> dict[str, Any]:
    """The force on the momenta, from the derivative of the action by the links."""
    gradient = jax.grad(lambda u: jnp.sum(action(u, beta)))(y["U"])
    return {"U": None, "P": algebra(_product(y["U"], jnp.swapaxes(gradient, -1, -2))) / 2}


def drift(t: Any, y: State, beta: Any) -> dict[str, Any]:
    """The links move with constant momenta."""
    return {"U": cfjax.LeftMatrix(y["P"]), "P": None}


term = diffrax.MultiTerm(cfjax.LieTerm(kick), cfjax.LieTerm(drift))


@functools.partial(jax.jit, static_argnums=(0, 1), static_argnames=("n",))
def y0(chains: int = 64, side: int = 4, *, beta: Any = 2.0, n: int = 2, seed: Any = 0) -> State:
    """A start with plaquettes about as large as those of the density, but not yet of it."""
    shape = chains, 2, side, side, n, n
    first, second = jax.random.split(jax.random.key(seed))
    spread = momenta(first, shape)
    spread = spread / jnp.sqrt(jnp.asarray(beta, spread.dtype))
    return {"U": cfjax.LeftMatrix(spread).flow(_identity(spread)), "P": momenta(second, shape)}


@functools.partial(jax.jit, static_argnums=(2, 3), static_argnames=("num_steps",))
def samples(
    start: Links,
    beta: Any,
    num_trajectories: int,
    solver: diffrax.AbstractSolver = solver,
    *,
    num_steps: int = 2,
    seed: Any = 0,
) -> tuple[Links, Float[Array, "num_trajectories chains"], Float[Array, "num_trajectories chains"]]:
    """The links at the end; after each trajectory the plaquette, and the dH that it had.

    Trajectories have length one and by default two steps of `cfjax.BlanesMoan4`. An error of a mean
    is honest only between chains, as one chain's values depend on each other: see `estimate`.
    """

    def trajectory(links: Any, key: Any) -> Any:
        first, second = jax.random.split(key)
        begin = {"U": links, "P": momenta(first, links.shape)}
        options: Any = dict(num_steps=num_steps, throw=False)
        ys = cfjax.integrate(term, solver, t0, t1, begin, beta, **options).ys
        end: Any = jax.tree.map(lambda y: y[-1], ys)
        dh = energy(end, beta) - energy(begin, beta)
        is_accepted = jax.random.uniform(second, dh.shape) < jnp.exp(-dh)
        links = jnp.where(is_accepted[:, None, None, None, None, None], end["U"], links)
        return links, (plaquette(links), dh)

    keys = jax.random.split(jax.random.key(seed), num_trajectories)
    links, (plaquettes, errors) = lax.scan(trajectory, start, keys)
    return links, plaquettes, errors


def estimate(values: Float[Array | np.ndarray, "times chains"]) -> tuple[float, float]:
    """The mean, and its standard error from the means of independent chains."""
    means = np.mean(values, axis=0)
    return float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(len(means)))


def reference(beta: Any, side: int = 4) -> Any:
    """The exact mean of the plaquette of SU(2), to rounding.

    With V plaquettes Z is the sum of `(2 I_n(beta) / beta)^V` over the characters n = 1, 2, ...,
    and the mean is the derivative of log Z by beta, over V.

    Source: Drouffe & Zuber, Strong coupling and mean field methods in lattice gauge theories, Phys.
    Rep. 102 (1983), doi:10.1016/0370-1573(83)90034-0.
    """
    from scipy.special import ive

    beta = np.asarray(beta, float)[..., None]
    n = np.arange(1, 60)
    # Relative to the first, as the powers are large. I_n' is the mean of the neighbours.
    weight = (ive(n, beta) / ive(1, beta)) ** (side * side)
    slope = (ive(n - 1, beta) + ive(n + 1, beta)) / (2 * ive(n, beta)) - 1 / beta
    return np.sum(weight * slope, axis=-1) / np.sum(weight, axis=-1)


def problem() -> dict[str, Any]:
    """One trajectory of each chain, as arguments of `cfjax.integrate`."""
    return dict(term=term, t0=t0, t1=t1, y0=y0(), args=2.0)


def invariants(y: State, args: Any = 2.0) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    square = _product(jnp.conj(jnp.swapaxes(y["U"], -1, -2)), y["U"])
    defect = square - _identity(square)
    return {
        "energy of each chain": energy(y, args),
        "distance of each link from unitary": jnp.linalg.norm(defect, axis=(-2, -1)),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """The root mean square of dH of 64 trajectories of 4 x 4 plaquettes of SU(2), beta 2."""

    def error(end: State, start: State) -> float:
        return float(jnp.sqrt(jnp.mean((energy(end, 2.0) - energy(start, 2.0)) ** 2)))

    methods = {name: solver for name, (solver, _) in METHODS.items()} | {"CF4": cfjax.CF4()}
    settings: Any = dict(methods=methods, reference=y0(), num_steps=[2**k for k in range(7)])
    return cfjax.work_precision(**problem(), error=error, **(settings | options))


def picture(num_trajectories: int = 150, most_steps: int = 64) -> figures.Figure:
    """dH against its cost, with slopes 2, 4 and 6, and the plaquette on its exact curve."""
    num_steps = [2**k for k in range(most_steps.bit_length())]
    work = chart(num_steps=num_steps, repeats=1, progress=False)
    betas = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0])
    means = []
    for k, beta in enumerate(betas):
        _, values, _ = samples(y0(beta=beta, seed=k)["U"], beta, num_trajectories, seed=k)
        means.append(estimate(np.asarray(values)[num_trajectories // 5 :]))
    mean, deviation = np.transpose(means)

    figure = figures.new(9.5, 3.9)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1), height_ratios=(2, 1))
    left, right = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    below = figure.add_subplot(grid[1, 1], sharex=right)

    colours = (figures.ORANGE, figures.VERMILION, "#56B4E9", figures.BLUE, figures.GREEN)
    for (name, (_, forces)), colour, mark in zip(METHODS.items(), colours, "os^vD", strict=True):
        is_this = np.array([method == name for method in work.method])
        error, cost = work.error[is_this], forces * work.num_steps[is_this]
        # Above rounding.
        shown = (error < 3) & (error > 1e-11)
        style = dict(marker=mark, markersize=5, color=colour, label=name)
        left.loglog(cost[shown], error[shown], **style)
    for order, cost, error in ((2, 32.0, 1e-2), (4, 48.0, 9e-6), (6, 80.0, 2e-8)):
        left.loglog([cost, 2 * cost], [error, error / 2**order], "k-", linewidth=1)
        left.annotate(f"{order}", (1.5 * cost, error / 1.3**order))
    left.set(xlabel="forces in a trajectory", ylabel="root mean square of dH")
    left.set_title("SU(2), 4 x 4 plaquettes, $\\beta = 2$; slopes 2, 4, 6")
    left.legend(frameon=False, loc="lower left")

    often = np.linspace(0.02, 8.6, 200)
    right.plot(often, reference(often), color="0.4", linewidth=1, label="exact")
    right.plot(betas, mean, "o", color=figures.BLUE, markersize=5, label="sampled")
    right.set(ylabel="plaquette", title="Means of 64 chains, two standard errors", ylim=(0, 0.9))
    right.tick_params(labelbottom=False)
    right.legend(frameon=False)
    below.axhline(0, color="0.4", linewidth=1)
    off, bars = mean - reference(betas), 2 * deviation
    below.errorbar(betas, 1e3 * off, 1e3 * bars, fmt="o", color=figures.BLUE, markersize=5)
    below.set(xlabel="$\\beta$", ylabel="off / $10^{-3}$")
    return figure


def _identity(like: Array) -> Array:
    return jnp.broadcast_to(jnp.eye(like.shape[-1], dtype=like.dtype), like.shape)


def _product(x: Any, y: Any) -> Array:
    # Ten times as fast as `@`, which calls a function for each product of small matrices.
    return jnp.sum(x[..., :, :, None] * y[..., None, :, :], axis=-2)
