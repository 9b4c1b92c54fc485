"""Errors of a spacecraft's attitude and rates that grow, or not, in a gravity gradient.

A rigid body on a circular orbit, with the unit of time such that an orbit takes 2 pi. Its attitude
q takes the coordinates of the body to fixed ones, w is its angular velocity in the body, and the
earth pulls harder at what is nearer to it:

`q' = q (0, w) / 2`, `I w' = (I w) x w + 3 r x (I r)`,

with r the direction from the earth to the body, in the body. The transition matrix takes errors of
the start, an angle about each axis of the body and three rates, to those of the end:

`eta' = -w x eta + dw`, `I dw' = (I dw) x w + (I w) x dw + 3 (dr x (I r) + r x (I dr))`,
`dr = r x eta`.

With its longest axis to the earth a body swings about this attitude, and errors stay bounded. With
its longest axis along the orbit an error in the plane grows by `exp(sqrt(3 (I_x - I_y) / I_z) t)`.

Source: Hughes, Spacecraft Attitude Dynamics, Wiley 1986, Chapters 8 and 9.
"""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import PROJECTED, by_dop853, by_name, solve

# Two orbits.
t0, t1 = 0.0, 4 * np.pi
solver = cfjax.Projected(diffrax.Dopri8())

# `q`, shape `(*times, 4)`, and `w`, shape `(*times, 3)`.
State = dict[str, Float[Array | np.ndarray, "..."]]


class Craft(NamedTuple):
    """The principal moments of inertia: about the axis to the earth, along, and across."""

    inertia: Any = (1.0, 2.0, 2.4)


def y0(swing: float = 0.2) -> State:
    """Above the earth, turned by an angle in the plane of the orbit; at its rate.

    The first axis is up, the second along the orbit, the third across. q is stored as (w, x, y, z).
    """
    q = np.array([np.cos(swing / 2), 0.0, 0.0, np.sin(swing / 2)])
    return {"q": q, "w": np.array([0.0, 0.0, 1.0])}


def field(t: Any, y: State, args: Craft) -> dict[str, Any]:
    """The frozen field."""
    attitude = cfjax.QuaternionRotation(jnp.asarray(y["w"]), frame="body", layout="wxyz")
    return {"q": attitude, "w": _acceleration(t, y, args)}


def velocity(t: Any, y: State, args: Craft) -> dict[str, Any]:
    """The same field in plain space."""
    w, q = y["w"], y["q"]
    vector = q[0] * w + jnp.cross(q[1:], w)
    rate = jnp.append(-jnp.sum(q[1:] * w), vector) / 2
    return {"q": rate, "w": _acceleration(t, y, args)}


term = cfjax.VariationTerm(cfjax.LieTerm(field))


def energy(t: Any, y: State, args: Craft) -> Float[Array, ""]:
    """Jacobi's integral, which is constant: the energy in the frame that turns with the orbit."""
    inertia = jnp.asarray(args.inertia, y["w"].dtype)
    up, across = (_in_body(y["q"], v) for v in (_up(t), jnp.eye(3)[2]))
    turning = jnp.sum(inertia * y["w"] * (y["w"] / 2 - across))
    return turning + 1.5 * jnp.sum(inertia * up**2)


def reference(t: float, args: Craft | None = None, start: State | None = None) -> cfjax.Variation:
    """State and transition matrix at time `t`, by SciPy's DOP853 with a tolerance of 1e-13.

    The equations of the errors are written by hand. The error at t = 4 pi is about 1e-11 of the
    largest entry.
    """
    inertia = np.asarray((args or Craft()).inertia, float)
    start = y0() if start is None else start

    def rate(t: float, y: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        q, w, eta, dw = y["q"], y["w"], y["phi"][:3].T, y["phi"][3:].T
        up = np.array([np.cos(t), np.sin(t), 0.0])
        r = _turn_back(q, up)
        dr = np.cross(r, eta)
        moment = np.cross(dr, inertia * r) + np.cross(r, inertia * dr)
        torque = np.cross(inertia * dw, w) + np.cross(inertia * w, dw) + 3 * moment
        return {
            "phi": np.concatenate([(dw - np.cross(w, eta)).T, (torque / inertia).T]),
            "q": np.append(-q[1:] @ w, q[0] * w + np.cross(q[1:], w)) / 2,
            "w": (np.cross(inertia * w, w) + 3 * np.cross(r, inertia * r)) / inertia,
        }

    begin = {"phi": np.eye(6), **{key: np.asarray(x, float) for key, x in start.items()}}
    end = by_dop853(rate, begin, t)
    return cfjax.Variation({"q": end["q"], "w": end["w"]}, transition=end["phi"])


def at_rest(t: float, args: Craft) -> Float[np.ndarray, "6 6"]:
    """The exact transition matrix of a body at rest in the frame that turns, for any inertia.

    There the equations of the errors are constant, with `w = (0, 0, 1)` and `r = (1, 0, 0)`.
    """
    from scipy.linalg import expm

    a, b, c = np.asarray(args.inertia, float)
    m = np.zeros((6, 6))
    m[:3, 3:] = np.eye(3)
    m[0, 1], m[1, 0] = 1.0, -1.0
    m[3, 4], m[4, 3] = (b - c) / a, (c - a) / b
    m[4, 1], m[5, 2] = 3 * (a - c) / b, 3 * (a - b) / c
    return expm(t * m)


def error(y: cfjax.Variation, exact: cfjax.Variation) -> float:
    """The distance of two states and transition matrices. q and -q are the same attitude."""
    q = np.asarray(y.state["q"])
    attitude = min(float(np.linalg.norm(q - sign * exact.state["q"])) for sign in (1, -1))
    others = (y.state["w"] - exact.state["w"], y.transition - exact.transition)
    return float(np.linalg.norm([attitude, *(float(np.linalg.norm(x)) for x in others)]))


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    start = term.start(t0, y0(), Craft(), transition=True)
    return dict(term=term, t0=t0, t1=t1, y0=start, args=Craft())


def invariants(y: cfjax.Variation, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {
        "length of q": jnp.linalg.norm(y.state["q"]),
        "determinant": jnp.linalg.det(y.transition),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """State and transition matrix after two orbits, 40 to 1280 equal steps."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.CF54(), cfjax.RKMK5(), cfjax.RKMK8(), *PROJECTED),
        reference=reference(t1),
        num_steps=[40 * 2**k for k in range(6)],
        error=error,
        **options,
    )


def growth(
    args: Craft, start: State, num_steps: int = 400
) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times 6"]]:
    """Times, and what an error of size 1 in each coordinate of the start has become, as a norm.

    The norm is that of three angles and three rates.
    """
    begin = term.start(t0, start, args, transition=True)
    options = dict(y0=begin, args=args, num_steps=num_steps, save_every=1, save_initial=True)
    times, ys = solve(problem(), solver, **options)
    return times, np.linalg.norm(ys.transition, axis=1)


def picture() -> figures.Figure:
    """How errors of the start grow over two orbits, with the long axis up and along the orbit."""
    figure = figures.new(10.5, 4.3)
    panels = figure.subplots(1, 2, sharey=True)
    a, b, c = Craft().inertia
    crafts = {
        "The longest axis to the earth": Craft(),
        "The longest axis along the orbit": Craft((b, a, c)),
    }
    names = ["to the earth", "along the orbit", "across the orbit"]
    colours = [figures.BLUE, figures.GREEN, figures.VERMILION]
    for ax, (title, args) in zip(panels, crafts.items(), strict=True):
        times, sizes = growth(args, y0(0.0))
        orbits = times / (2 * np.pi)
        for k, colour in enumerate(colours):
            ax.semilogy(
                orbits, sizes[:, k], color=colour, label=f"in the angle about the axis {names[k]}"
            )
            ax.semilogy(orbits, sizes[:, 3 + k], "--", color=colour)
        ax.plot([], [], "--", color="0.4", label="in the rates about the same axes")
        ax.set(title=title, xlabel="orbits", xlim=(0, 2), ylim=(0.3, 1e7))
        if args.inertia[1] < args.inertia[0]:
            rate = np.sqrt(3 * (args.inertia[0] - args.inertia[1]) / args.inertia[2])
            law = f"proportional to exp({rate:.2f} t)"
            ax.semilogy(orbits, 0.25 * np.exp(rate * times), "k:", label=law)
        ax.legend(frameon=False, loc="upper left", title="An error of size 1 at the start")
    panels[0].set_ylabel("error later: angles and rates")
    return figure


def _up(t: Any) -> Array:
    """From the earth to the body, in fixed coordinates."""
    return jnp.stack([jnp.cos(t), jnp.sin(t), jnp.zeros_like(jnp.asarray(t))])


def _in_body(q: Any, v: Array) -> Array:
    back = jnp.asarray(q) * jnp.asarray([1.0, -1.0, -1.0, -1.0], q.dtype)
    return cfjax.quaternion_rotate(back, v.astype(q.dtype), layout="wxyz")


def _acceleration(t: Any, y: State, args: Craft) -> Array:
    w = jnp.asarray(y["w"])
    inertia = jnp.asarray(args.inertia, w.dtype)
    up = _in_body(y["q"], _up(t))
    return (jnp.cross(inertia * w, w) + 3 * jnp.cross(up, inertia * up)) / inertia


def _turn_back(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    twice = 2 * np.cross(v, q[1:])
    return v + q[0] * twice + np.cross(twice, q[1:])
