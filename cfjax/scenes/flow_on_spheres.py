"""Densities that flows carry: unit vectors and rotations that gather, and a network that learns.

A unit vector y moves towards the pole e, and a rotation R towards the identity:

`y' = k (e - (e . y) y)`, `R' = -k (R - R^T) / 2 R`.

Both have closed forms. With z the height of y, `1 + z` over `1 - z` grows as `exp(2 k t)`; of the
angle of R the tangent of a half falls as `exp(-k t)`. The density p of what starts with a density
p0, with respect to the uniform one, is known along each path:

`p / p0 = (cosh(k t) + z0 sinh(k t))^2`, `p / p0 = (a0 b0^2) / (a b^2)`,

with a the sine of the angle of R and b that of its half, `a0` and `b0` at the start.

A continuous normalising flow is the same with a network for the field: `fit` maximises the mean
log-likelihood of samples of a density with two peaks, those of von Mises and Fisher.

Source: Mathieu & Nickel, Riemannian continuous normalizing flows, NeurIPS 2020,
arXiv:2006.10605.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_name

t0, t1 = 0.0, 1.0
# It reaches rounding in half the steps of Projected, and in less time.
solver = cfjax.RKMK8()
pole = np.array([0.0, 0.0, 1.0])

# `vector`, shape `(*times, 3)`, and `rotation`, shape `(*times, 3, 3)`.
State = dict[str, Float[Array | np.ndarray, "..."]]
Points = Float[Array | np.ndarray, "points 3"]


def y0() -> State:
    """A vector near the equator, and a rotation by 2 radians."""
    return {"vector": np.array([0.6, 0.64, -0.48]), "rotation": _rotation(2.0)}


def field(t: Any, y: State, args: Any) -> dict[str, cfjax.Rotation]:
    """The frozen field. `args` is the rate k."""
    vector = jnp.asarray(y["vector"])
    m = jnp.asarray(y["rotation"])
    m = (m - m.T) / 2
    omega = jnp.stack([m[2, 1], m[0, 2], m[1, 0]])
    towards = jnp.cross(vector, jnp.asarray(pole, vector.dtype))
    return {"vector": cfjax.Rotation(args * towards), "rotation": cfjax.Rotation(-args * omega)}


term = cfjax.VariationTerm(cfjax.LieTerm(field))


def reference(t: float, k: float = 1.0, start: State | None = None) -> cfjax.Variation:
    """The exact state at time `t`, and what the log-density has grown by, to rounding.

    The growth is the sum of those of the vector and of the rotation.
    """
    start = y0() if start is None else start
    vector, matrix = np.asarray(start["vector"]), np.asarray(start["rotation"])
    z = vector @ pole
    stretch = np.cosh(k * t) + z * np.sinh(k * t)
    height = np.sinh(k * t) + z * np.cosh(k * t)
    vector = (vector - z * pole + height * pole) / stretch
    skew = (matrix - matrix.T) / 2
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    angle = np.arctan2(np.linalg.norm(axis), (np.trace(matrix) - 1) / 2)
    later = 2 * np.arctan(np.exp(-k * t) * np.tan(angle / 2))
    growth = 2 * np.log(stretch) + _log_weight(angle) - _log_weight(later)
    state = {"vector": vector, "rotation": _rotation(later, axis / np.linalg.norm(axis))}
    return cfjax.Variation(state, log_density=growth)


def density_of_heights(t: Any, height: Any, k: float = 1.0) -> Any:
    """The density of unit vectors at time `t`, over the uniform one, which it is at time zero."""
    return (np.cosh(k * t) - height * np.sinh(k * t)) ** -2


def density_of_angles(t: Any, angle: Any, k: float = 1.0) -> Any:
    """The density of rotations at time `t`, over Haar's measure, which it is at time zero."""
    before = 2 * np.arctan(np.exp(k * t) * np.tan(angle / 2))
    return np.exp(_log_weight(before) - _log_weight(angle))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    start = term.start(t0, y0(), 1.0, log_density=0.0)
    return dict(term=term, t0=t0, t1=t1, y0=start, args=1.0)


def invariants(y: cfjax.Variation, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    turned = y.state["rotation"]
    distance = jnp.max(jnp.abs(turned @ turned.T - jnp.eye(3, dtype=turned.dtype)))
    return {"length": jnp.linalg.norm(y.state["vector"]), "distance from orthogonal": distance}


def error(y: cfjax.Variation, exact: cfjax.Variation) -> float:
    """The distance of two states and log-densities."""
    off = jax.tree.map(lambda a, b: float(np.linalg.norm(np.asarray(a) - b)), y, exact)
    return float(np.linalg.norm(jax.tree.leaves(off)))


def chart(**options: Any) -> cfjax.WorkPrecision:
    """State and log-density at t = 1, 5 to 160 equal steps."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.CF54(), cfjax.RKMK5(), cfjax.RKMK8(), *PROJECTED),
        reference=reference(t1),
        num_steps=[5 * 2**k for k in range(6)],
        error=error,
        **options,
    )


class Peaks(NamedTuple):
    """Two peaks on the sphere, their concentrations and the weight of the first."""

    at: Any = ((0.6, 0.0, 0.8), (0.0, -0.8, -0.6))
    concentration: Any = (12.0, 5.0)
    weight: Any = 0.4


def log_density_of(args: Peaks, y: Points) -> Float[np.ndarray, " points"]:
    """The logarithm of the density of the peaks over the uniform one."""
    kappa = np.asarray(args.concentration)
    weights = np.array([args.weight, 1 - args.weight]) * kappa / np.sinh(kappa)
    return np.log(np.exp(np.asarray(y) @ np.asarray(args.at).T * kappa) @ weights)


def samples_of(args: Peaks, count: int, seed: int = 0) -> Float[np.ndarray, "count 3"]:
    """Independent samples of the peaks."""
    rng = np.random.default_rng(seed)
    which = np.where(rng.uniform(size=count) < args.weight, 0, 1)
    kappa, centre = np.asarray(args.concentration)[which], np.asarray(args.at)[which]
    u = rng.uniform(size=count)
    height = 1 + np.log(u + (1 - u) * np.exp(-2 * kappa)) / kappa
    across = np.cross(centre, rng.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return height[:, None] * centre + np.sqrt(1 - height**2)[:, None] * across


class Network(NamedTuple):
    """One hidden layer: from a unit vector and the time to a velocity."""

    inner: Array
    bias: Array
    outer: Array


def network(key: Key[Array, ""], width: int = 12) -> Network:
    """At random, and so small that the flow hardly moves."""
    one, other = jax.random.split(key)
    inner, outer = jax.random.normal(one, (width, 4)), jax.random.normal(other, (width, 3))
    return Network(inner, jnp.zeros(width), 0.1 * outer / width)


def learned(t: Any, y: Float[Array, "3"], args: Network) -> cfjax.Rotation:
    """The frozen field of a network: the rotation that moves y by its velocity's tangent part."""
    hidden = jnp.tanh(args.inner @ jnp.append(y, t) + args.bias)
    return cfjax.Rotation(jnp.cross(y, hidden @ args.outer))


def log_likelihood(args: Network, y: Points, num_steps: int = 4) -> Float[Array, " points"]:
    """The logarithm of the density of a network at points, over the uniform one.

    From the points backwards in time, to the uniform density.
    """
    term = cfjax.VariationTerm(cfjax.LieTerm(learned))

    def of_one(y: Array) -> Array:
        start = cfjax.Variation(y, log_density=jnp.zeros((), y.dtype))
        ys: Any = cfjax.integrate(term, cfjax.CF4(), t1, t0, start, args, num_steps=num_steps).ys
        return -ys.log_density[-1]

    return jax.vmap(of_one)(jnp.asarray(y))


def fit(
    y: Points, *, num_updates: int = 100, seed: int = 0
) -> tuple[Network, Float[Array, " num_updates"]]:
    """A network by maximum likelihood, and the mean log-likelihood before each update, by Adam."""
    start = network(jax.random.key(seed))
    negative = lambda args: -jnp.mean(log_likelihood(args, y))  # noqa: E731

    def update(carry: Any, k: Array) -> Any:
        args, mean, square = carry
        value, slope = jax.value_and_grad(negative)(args)
        mean = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, mean, slope)
        square = jax.tree.map(lambda s, g: 0.99 * s + 0.01 * g**2, square, slope)

        def moved(x: Array, m: Array, s: Array) -> Array:
            return x - 0.03 * (m / (1 - 0.9**k)) / (jnp.sqrt(s / (1 - 0.99**k)) + 1e-8)

        return (jax.tree.map(moved, args, mean, square), mean, square), -value

    @jax.jit
    def run(start: Network) -> Any:
        zero = jax.tree.map(jnp.zeros_like, start)
        return jax.lax.scan(update, (start, zero, zero), jnp.arange(1.0, num_updates + 1))

    (args, *_), values = run(start)
    return args, values


def picture() -> figures.Figure:
    """Densities of vectors and rotations at t = 0, 1/2 and 1; two peaks, and what a network learns.

    Dots have the log-densities that solves carry along, and lines are the closed forms.
    """
    figure = figures.new(9.5, 8.0)
    top = [figure.add_subplot(2, 2, k) for k in (1, 2)]
    start = {"vector": _vectors(np.linspace(-0.98, 0.98, 15)), "rotation": _turns(15)}

    @jax.jit
    @jax.vmap
    def carried(vector: Array, rotation: Array) -> Any:
        """Each beside one of the other kind that rests at a fixed point."""
        ends = []
        for y in (
            {"vector": vector, "rotation": jnp.eye(3)},
            {"vector": jnp.asarray(pole), "rotation": rotation},
        ):
            begin = cfjax.Variation(y, log_density=jnp.zeros(()))
            sol = cfjax.integrate(
                term, solver, t0, t1, begin, 1.0, num_steps=20, save_every=10, save_initial=True
            )
            ends.append(sol.ys)
        return ends

    of_vectors, of_rotations = carried(start["vector"], start["rotation"])
    # Densities at fixed points grow as well, that of a vector by 2 t and of a rotation by 3 t.
    times, colours = np.array([0.0, 0.5, 1.0]), (figures.ORANGE, figures.GREEN, figures.BLUE)
    height, angle = np.linspace(-1, 1, 200), np.linspace(0.01, np.pi - 1e-6, 200)
    for k, (t, colour) in enumerate(zip(times, colours, strict=True)):
        top[0].plot(height, density_of_heights(t, height), color=colour, label=f"t = {t:g}")
        top[1].semilogy(angle, density_of_angles(t, angle), color=colour, label=f"t = {t:g}")
        found = np.exp(np.asarray(of_vectors.log_density)[:, k] - 3 * t)
        top[0].plot(of_vectors.state["vector"][:, k, 2], found, "o", color=colour)
        found = np.exp(np.asarray(of_rotations.log_density)[:, k] - 2 * t)
        cosine = (np.trace(of_rotations.state["rotation"][:, k], axis1=1, axis2=2) - 1) / 2
        top[1].semilogy(np.arccos(np.clip(cosine, -1, 1)), found, "o", color=colour)
    top[0].set(title="Unit vectors", xlabel="height", ylabel="density over the uniform one")
    top[1].set(title="Rotations", xlabel="angle", ylabel="density over Haar's measure")
    for ax in top:
        ax.legend(frameon=False)

    args, points = Peaks(), samples_of(Peaks(), 1500)
    found, _ = fit(points)
    longitude, height = np.mgrid[-np.pi : np.pi : 73j, -1:1:37j]
    ring = np.sqrt(1 - height**2)
    grid = np.stack([ring * np.cos(longitude), ring * np.sin(longitude), height], axis=-1)
    maps = {
        "Two peaks, and 1500 samples": log_density_of(args, grid.reshape(-1, 3)),
        "What a network learns from them": log_likelihood(found, grid.reshape(-1, 3)),
    }
    below = [figure.add_subplot(2, 2, k) for k in (3, 4)]
    filled: Any = None
    for ax, (title, logs) in zip(below, maps.items(), strict=True):
        density = np.exp(np.asarray(logs)).reshape(longitude.shape)
        style: Any = dict(levels=np.linspace(0, 8, 17), cmap="viridis", extend="max")
        filled = ax.contourf(np.degrees(longitude), height, density, **style)
        ax.set(title=title, xlabel="longitude", ylabel="height", xticks=(-180, -90, 0, 90, 180))
    where = np.degrees(np.arctan2(points[:, 1], points[:, 0])), points[:, 2]
    below[0].plot(*where, ".", color="white", markersize=2)
    figure.colorbar(filled, ax=below, label="density over the uniform one")
    return figure


def _vectors(height: np.ndarray) -> np.ndarray:
    ring = np.sqrt(1 - height**2)
    return np.stack([ring, 0 * height, height], axis=-1)


def _turns(count: int) -> np.ndarray:
    return np.stack([_rotation(angle) for angle in np.linspace(0.1, 3.1, count)])


def _rotation(angle: float, axis: Any = (2 / 3, -1 / 3, 2 / 3)) -> np.ndarray:
    """By Rodrigues's formula."""
    x = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * x + (1 - np.cos(angle)) * x @ x


def _log_weight(angle: Any) -> Any:
    """The logarithm of sin(angle) sin(angle / 2)^2."""
    return np.log(np.sin(angle)) + 2 * np.log(np.sin(angle / 2))
