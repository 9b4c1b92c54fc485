"""What a radar knows of a ship: the covariance of a Kalman filter in continuous time.

The ship sails in circles around the radar. Its state, shape `(4,)`, is the deviation of position
and velocity from the plan. Water resists motion along the keel little and motion across it
strongly, so `A = [[0, I], [0, -D]]` with a D that turns with the ship. Waves push the ship at
random, with a density of `noise` in each direction of the acceleration, which gives Q. The radar
measures range well and bearing badly. Its measurements give information on the position at a rate
of `S = C^T R^-1 C`, which turns with the ship too. The covariance P of the state, shape `(4, 4)`,
obeys Riccati's equation,

`P' = A P + P A^T + Q - P S P`,

and Lyapunov's equation, with S = 0, while an island hides the ship. All quantities are
dimensionless.

Frozen, the field is a congruence with the source Q, `P' = a P + P a^T + Q` with `a = A - P S / 2`.
Its flow keeps P positive definite, whatever `a` is: `exp(a) P exp(a)^T` is definite, and the
integral of such terms with Q is semidefinite. A method keeps P definite, with steps of any size, if
the weights of each of its exponentials have a sum, which multiplies Q, that is not negative: `CF3`
and `CF4` do, but not `CF54`.

Joseph's form of the equation, `a = A - P S` with the source `Q + P S P`, is the linearisation and
is more accurate in long steps, but only `LieEuler` and `CF2` are safe with it: other methods weight
the sources of several stages, including P S P, with both signs.

Source: Kalman & Bucy, New results in linear filtering and prediction theory, J. Basic Eng. 83
(1961), doi:10.1115/1.3658902.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import cfjax

from . import _figures as figures
from ._scene import by_name, in_plain_space

t0, t1 = 0.0, 5.0
# Adaptive steps too: CF54 does not keep covariances positive.
solver = cfjax.CF4()

Covariance = Float[Array | np.ndarray, "4 4"]


class Track(NamedTuple):
    """The ship, the waves, the radar, and when an island is between them."""

    # Angle per time, of the ship about the radar.
    rate: Any = np.pi / 30
    # Rates at which the velocity decays.
    drag_across: Any = 1.0
    drag_along: Any = 0.05
    noise: Any = 0.004
    # Variance times time, of a position.
    range: Any = 0.05
    bearing: Any = 0.5
    lost: Any = 20.0
    found: Any = 40.0


def y0(deviation: float = 0.5) -> Float[np.ndarray, "4 4"]:
    """The covariance when the ship comes into sight; `deviation` is that of the position."""
    return np.diag([deviation**2, deviation**2, 0.01, 0.01])


def field(t: Any, y: Covariance, args: Track) -> cfjax.Congruence:
    """The frozen field. At times `args.lost` and `args.found` it jumps: give these as `jump_ts`."""
    a, q, s = _coefficients(t, y, args)
    return cfjax.Congruence(a - y @ s / 2, q)


def velocity(t: Any, y: Covariance, args: Track) -> Float[Array, "4 4"]:
    """The same field in plain space, where no method keeps P definite."""
    a, q, s = _coefficients(t, y, args)
    return a @ y + y @ a.T + q - y @ s @ y


def smallest(y: Float[Array | np.ndarray, "*times 4 4"]) -> Float[Array, "*times"]:
    """The smallest eigenvalue, positive for a covariance. NaN if y is not finite."""
    return jnp.linalg.eigvalsh(y)[..., 0]


def reference(
    t: float | Float[np.ndarray, "*times"], start: Float[np.ndarray, "4 4"], args: Track
) -> Float[np.ndarray, "*times 4 4"]:
    """The exact covariance at times `t` in NumPy's float64.

    In axes that turn with the ship nothing depends on time. In these axes `P = Y X^-1`, where the
    exponential of the Hamiltonian matrix `[[-A^T, S], [Q, A]]` moves X and Y from I and P, in
    pieces so short that X stays well conditioned.
    """
    from scipy.linalg import expm

    times = np.asarray(t, float)
    spin = np.kron(np.eye(2), [[0.0, -args.rate], [args.rate, 0.0]])
    a = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)) - np.diag(
        [0.0, 0.0, args.drag_across, args.drag_along]
    )
    q = np.diag([0.0, 0.0, args.noise, args.noise])
    s = np.diag([1 / args.range, 1 / args.bearing, 0.0, 0.0])
    covariances, now, p = {}, t0, np.asarray(start)
    jumps = np.clip([args.lost, args.found], t0, np.max(times))
    for then in np.unique([*times.flat, *jumps]):
        sees = not args.lost <= now < args.found
        h = np.block([[spin.T - a.T, sees * s], [q, a - spin]]) * (then - now)
        pieces = max(1, int(np.ceil(np.linalg.norm(h, 2))))
        e = expm(h / pieces)
        for _ in range(pieces):
            x, y = e[:4, :4] + e[:4, 4:] @ p, e[4:, :4] + e[4:, 4:] @ p
            p = np.linalg.solve(x.T, y.T)
            p = (p + p.T) / 2
        turn = expm(spin * then)
        now, covariances[then] = then, turn @ p @ turn.T
    return np.stack([covariances[t] for t in times.flat]).reshape(*times.shape, 4, 4)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(1.0), args=Track())


def invariants(y: Covariance, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {
        "smallest eigenvalue (stays positive)": smallest(y),
        "asymmetry": jnp.max(jnp.abs(y - y.T)),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A ship comes in sight, 20 to 1280 equal steps; Tsit5, Dopri5 and RK4 in plain space."""
    # On arrays CF4 is the classical method of order 4.
    rk4 = cfjax.LieTerm(velocity), cfjax.CF4()
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF3(), cfjax.CF4())
        | {"RK4": rk4}
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri5()),
        reference=reference(t1, y0(1.0), Track()),
        num_steps=[20 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """Once around the radar, to t = 60: what is known of the position; the smallest eigenvalue."""
    from matplotlib.patches import Ellipse, Wedge

    args, end, radius = Track(), 60.0, 10.0
    methods = {
        "RK4 in plain space": (cfjax.LieTerm(velocity), cfjax.CF4()),
        "Tsit5 in plain space": (diffrax.ODETerm(velocity), diffrax.Tsit5()),
        "CF4": (cfjax.LieTerm(field), cfjax.CF4()),
    }
    colours, lines = (figures.VERMILION, figures.GREEN, figures.BLUE), ("-", "--", "-")
    # The jumps are ends of steps: three pieces of one length, each with or without the island.
    pieces = [(t0, args.lost, False), (args.lost, args.found, True), (args.found, end, False)]
    ts, ys = np.linspace(t0, end, 961), {}
    options: Any = dict(num_steps=320, save_every=1, throw=False)
    for name, (term, solver) in methods.items():
        y = [y0()[None]]
        for start, stop, is_hidden in pieces:
            here = args._replace(lost=-np.inf if is_hidden else np.inf, found=np.inf)
            sol = cfjax.integrate(term, solver, start, stop, y[-1][-1], here, **options)
            y.append(np.asarray(sol.ys))
        ys[name] = np.concatenate(y)

    figure = figures.new(10.0, 4.6)
    sea, curves = figure.subplots(1, 2, width_ratios=(1, 1.1))
    lost, seen = (np.degrees(args.rate * t) for t in (args.lost, args.found))
    sea.add_patch(Wedge((0, 0), 20.0, lost, seen, width=15.5, color="0.94"))
    sea.add_patch(Wedge((0, 0), 4.5, lost, seen, width=1.2, color="0.6"))
    for t, p in zip(ts[:-1:32], ys["CF4"][:-1:32], strict=True):
        place = radius * np.cos(args.rate * t), radius * np.sin(args.rate * t)
        squares, axes = np.linalg.eigh(p[:2, :2])
        angle = np.degrees(np.arctan2(axes[1, 1], axes[0, 1]))
        # Two standard deviations to either side.
        wide, long = 4 * np.sqrt(squares)
        colour = figures.ORANGE if args.lost < t <= args.found else figures.BLUE
        sea.add_patch(Ellipse(place, long, wide, angle=angle, color=colour, alpha=0.4, lw=0))
        sea.plot(*place, ".", color=colour, markersize=4)
    sea.plot(0, 0, "k^")
    for text, place in {"radar": (0, -1.5), "island": (-3.6, 3.6), "start": (7.2, 0)}.items():
        sea.text(*place, text, ha="right" if text == "island" else "center", va="center")
    sea.set(title="Where the ship is, as the radar knows it", xticks=[], yticks=[])
    sea.set(aspect="equal", xlim=(-13.5, 13.5), ylim=(-13.5, 13.5))

    curves.axvspan(args.lost, args.found, color="0.94")
    curves.axhspan(-1, 0, color=figures.VERMILION, alpha=0.12, linewidth=0)
    curves.text(48.5, -0.0002, "no covariance", ha="right", va="top")
    curves.text(40.2, -0.0007, "RK4 and Tsit5, as soon as\nthe ship is seen again", va="center")
    near = np.linspace(34.0, 49.0, 301)
    exact = np.asarray(smallest(reference(near, y0(), args)))
    curves.plot(near, exact, color="0.7", linewidth=5, label="exact")
    for (name, y), colour, line in zip(ys.items(), colours, lines, strict=True):
        curves.plot(ts, np.asarray(smallest(y)), line, color=colour, label=name)
    curves.set(title="Smallest eigenvalue, steps of 1/16", xlabel="t")
    curves.set(xlim=(34.0, 49.0), ylim=(-0.001, 0.0025))
    curves.legend(frameon=False, loc="center right")
    return figure


def _coefficients(t: Any, y: Covariance, args: Track) -> tuple[Array, Array, Array]:
    """A, Q and S, in the precision of the state."""
    args = jax.tree.map(lambda x: jnp.asarray(x, y.dtype), args)
    angle = args.rate * t
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    axes = jnp.asarray([[cosine, -sine], [sine, cosine]])
    drag = axes @ jnp.diag(jnp.asarray([args.drag_across, args.drag_along])) @ axes.T
    information = axes @ jnp.diag(1 / jnp.asarray([args.range, args.bearing])) @ axes.T
    hidden = (t > args.lost) & (t < args.found)
    eye, zero = jnp.eye(2, dtype=y.dtype), jnp.zeros((2, 2), y.dtype)
    a = jnp.block([[zero, eye], [zero, -drag]])
    q = jnp.block([[zero, zero], [zero, args.noise * eye]])
    s = jnp.block([[jnp.where(hidden, 0, information), zero], [zero, zero]])
    return a, q, s
