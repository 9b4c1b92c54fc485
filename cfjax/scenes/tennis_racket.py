"""A tennis racket that turns about a fixed point, under a small weight, over long times.

With the upward vertical `up` and the angular momentum m, both seen from the body:

`up' = cross(up, omega)`, `m' = cross(m, omega) + cross(up, weight)`, `omega = m / inertia`,

where `weight` is the weight of the body times the position of its centre of mass. The energy, the
momentum about the vertical and the length of `up` are constant. All quantities are dimensionless.

A free body turns stably about its axes of least and of largest inertia, and flips over and over
about the one between. A small weight leaves most motions regular: in a Poincaré section they stay
on closed curves. The flips become irregular. A splitting into the torque and the rotations about
the axes is symplectic and keeps the curves. Without that the energy drifts, across the curves.

Source: Arnold, Mathematical Methods of Classical Mechanics, Section 29 and Appendix 8,
doi:10.1007/978-1-4757-2063-1; McLachlan, Explicit Lie-Poisson integration and the Euler equations,
Phys. Rev. Lett. 71 (1993), doi:10.1103/PhysRevLett.71.3043.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, in_plain_space

t0, t1 = 0.0, 40.0
# To `t1`. The splitting of the picture pays over longer times.
solver = cfjax.Projected(diffrax.Dopri8())

# `up` and `m`, shapes `(3,)`.
State = dict[str, Float[Array | np.ndarray, "3"]]


class Racket(NamedTuple):
    """The principal moments of inertia, and the weight times the centre of mass."""

    inertia: Any = np.array([1.0, 1.5, 3.0])
    weight: Any = np.array([0.004, 0.0, 0.002])


def y0(angle: float = np.pi / 2, height: float = 0.1) -> State:
    """A state with these coordinates of `section`, energy 1/3 and vertical momentum 1/2.

    By default the body turns about almost its second axis, the middle one.
    """
    ring, args = np.sqrt(1 - height**2), Racket()
    along = np.array([ring * np.cos(angle), ring * np.sin(angle), height])
    across = (np.array([0.0, 0.0, 1.0]) - height * along) / ring
    up, length = along, 1.0
    # The weight is small, so the energy soon has the right momentum.
    for _ in range(20):
        up = (along + np.sqrt(4 * length**2 - 1) * across) / (2 * length)
        length = np.sqrt(2 * (1 / 3 - args.weight @ up) / np.sum(along**2 / args.inertia))
    return {"up": up, "m": length * along}


def kick(t: Any, y: State, args: Racket) -> dict[str, Any]:
    """The torque of the weight, which moves the momentum alone."""
    return {"up": None, "m": jnp.cross(y["up"], jnp.asarray(args.weight, y["m"].dtype))}


def spin(axis: int) -> cfjax.LieTerm:
    """The rotation about one principal axis."""

    def turning(t: Any, y: State, args: Racket) -> dict[str, Any]:
        omega = jnp.zeros_like(y["m"]).at[axis].set(y["m"][axis] / args.inertia[axis])
        return {"up": cfjax.Rotation(-omega), "m": cfjax.Rotation(-omega)}

    return cfjax.LieTerm(turning)


terms = diffrax.MultiTerm(cfjax.LieTerm(kick), spin(0), spin(1), spin(2))


def field(t: Any, y: State, args: Racket) -> dict[str, Any]:
    """The frozen field of all terms at once."""
    omega = y["m"] / jnp.asarray(args.inertia, y["m"].dtype)
    moved = cfjax.RigidMotion(omega=-omega, v=kick(t, y, args)["m"], frame="fixed")
    return {"up": cfjax.Rotation(-omega), "m": moved}


def velocity(t: Any, y: State, args: Racket) -> State:
    """The same field in plain space, where no method keeps the length of `up`."""
    return cfjax.tangent(field(t, y, args), y)


def energy(y: State, args: Racket) -> Float[Array, ""]:
    """The kinetic energy and that of the weight."""
    inertia, weight = (jnp.asarray(x, y["m"].dtype) for x in args)
    return jnp.sum(y["m"] ** 2 / inertia) / 2 + jnp.sum(weight * y["up"])


def section(up: Float[np.ndarray, "times 3"], m: Float[np.ndarray, "times 3"]) -> np.ndarray:
    """Where a motion crosses the plane of a Poincaré section, shape `(crossings, 2)`.

    The plane is crossed once a turn, where the third axis of the body comes between momentum and
    vertical. Its coordinates are the angle of the momentum from the first axis towards the second,
    and the part `m_3 / |m|`. A cubic through four states finds them, for steps of 0.4 to 1e-4.
    """
    square = np.sum(m**2, axis=-1)
    sine, cosine = np.cross(up, m)[:, 2], up[:, 2] * square - m[:, 2] * np.sum(up * m, axis=-1)
    phase = np.arctan2(np.sqrt(square) * sine, cosine)
    drop = phase[1:-2] - phase[2:-1]
    first = np.flatnonzero((phase[1:-2] > 0) & (phase[2:-1] <= 0) & (drop < np.pi))
    x, y = (np.stack([values[first + k] for k in range(4)]) for values in (phase, m))
    others = [np.delete(x, k, axis=0) for k in range(4)]
    weights = np.stack([np.prod(o / (o - x[k]), axis=0) for k, o in enumerate(others)])
    a, b, c = np.sum(weights[..., None] * y, axis=0).T
    return np.stack([np.arctan2(b, a), c / np.sqrt(a**2 + b**2 + c**2)], axis=-1)


def reference(t: float) -> State:
    """The state at time `t`, by SciPy's DOP853 in plain space, with a tolerance of 1e-13.

    The error at 40 is about 1e-12.
    """
    args = Racket()

    def rate(t: float, y: State) -> State:
        omega = y["m"] / args.inertia
        torque = np.cross(y["up"], args.weight)
        return {"up": np.cross(y["up"], omega), "m": np.cross(y["m"], omega) + torque}

    return by_dop853(rate, y0(), t)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=Racket())


def invariants(y: State, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    vertical, length = jnp.sum(jnp.asarray(y["up"] * y["m"])), jnp.linalg.norm(y["up"])
    return {"energy": energy(y, args), "vertical momentum": vertical, "length of up": length}


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A tennis racket to t = 40, 40 to 2560 equal steps; Tsit5 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.RKMK8())
        | by_name(*PROJECTED)
        | by_name(cfjax.Strang(), cfjax.BlanesMoan4(), cfjax.BlanesMoan6(), term=terms)
        | in_plain_space(velocity, diffrax.Tsit5()),
        reference=reference(t1),
        num_steps=[40 * 2**k for k in range(7)],
        **options,
    )


def picture(num_steps: int = 1_000_000) -> figures.Figure:
    """Sections of the same motions by Strang and by CF4, with a million steps of 0.4.

    A step of CF4 takes twice the operations of one of Strang, and four times as many torques.
    `num_steps` is a multiple of 20 000, or less than that.
    """
    inside = [(0.0, 0.15), (0.0, 0.35), (0.0, 0.55), (np.pi, 0.25), (np.pi, 0.45), (np.pi, 0.62)]
    outside = [(np.pi / 2, s * x) for s in (1, -1) for x in (0.25, 0.4, 0.6)]
    starts = [y0(), *(y0(*place) for place in inside + outside)]
    regular = [figures.BLUE, figures.ORANGE, figures.GREEN, figures.PURPLE]
    colours = [figures.VERMILION, *3 * regular]
    options: Any = dict(num_steps=min(num_steps, 20_000), save_every=1)

    figure = figures.new(10.5, 4.8)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    methods = (terms, cfjax.Strang()), (cfjax.LieTerm(field), cfjax.CF4())
    for ax, (term, solver) in zip(panels, methods, strict=True):

        @jax.jit
        @jax.vmap
        def go_on(y: State, term: Any = term, solver: Any = solver) -> Any:
            end = 0.4 * options["num_steps"]
            return cfjax.integrate(term, solver, 0.0, end, y, Racket(), **options).ys

        y = jax.tree.map(lambda *leaves: np.stack(leaves), *starts)
        for _ in range(num_steps // options["num_steps"]):
            ys = jax.tree.map(np.asarray, go_on(y))
            y = jax.tree.map(lambda x: x[:, -1], ys)
            for up, m, colour in zip(ys["up"], ys["m"], colours, strict=True):
                angle, height = section(up, m).T
                dots: Any = dict(color=colour, markersize=1.8, markeredgewidth=0, rasterized=True)
                ax.plot(np.degrees(angle), height, ".", **dots)
        ax.set(title=type(solver).__name__, xlabel="momentum from axis 1 to axis 2 (degrees)")
        ax.set(xlim=(-180, 180), ylim=(-1, 1), xticks=[-180, -90, 0, 90, 180])
    panels[0].set_ylabel("part of the momentum along axis 3")
    return figure
