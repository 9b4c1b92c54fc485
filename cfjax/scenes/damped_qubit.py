"""A qubit that is driven and decays: its state spirals into the steady state.

The density matrix rho, shape `(2, 2)`, of a ground state and an excited state obeys Lindblad's
equation in the frame of the drive, with ħ = 1,

`rho' = -i [H, rho] + decay (L rho L^H - {L^H L, rho} / 2)`,
`H = [[0, r], [r, 2 detuning]] / 2`, `L = [[0, 1], [0, 0]]`,

where the drive is switched on smoothly, `r = rabi (1 - exp(-t / rise))`. So the field depends on t
but not on rho. In the Bloch ball, the state turns about the axis `(r, 0, -detuning)` and moves
towards the ground state at the top. In the end the excited state has the population
`rabi^2 / 4 / (detuning^2 + decay^2 / 4 + rabi^2 / 2)`.

The flow of the frozen field is completely positive: it maps density matrices to density matrices,
also those of a qubit that is entangled with something else. The rate is constant, so a step of CF4
or Magnus4 is completely positive as well, however long it is.

Source: Torrey, Transient nutations in nuclear magnetic resonance, Phys. Rev. 76 (1949),
doi:10.1103/PhysRev.76.1059.
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

t0, t1 = 0.0, 30.0
solver = cfjax.Magnus4()

Density = Complex[Array | np.ndarray, "2 2"]
_LOWER = np.array([[0.0, 1.0], [0.0, 0.0]])


class Qubit(NamedTuple):
    """The drive, the rate of decay, and the time in which the drive rises."""

    rabi: Any = 3.0
    detuning: Any = 2.0
    decay: Any = 0.2
    rise: Any = 0.5


def y0() -> Complex[np.ndarray, "2 2"]:
    """The ground state."""
    return np.diag([1.0 + 0.0j, 0.0])


def field(t: Any, y: Density, args: Qubit) -> cfjax.Lindblad:
    """The frozen field."""
    h, decay = _coefficients(t, y, args)
    return cfjax.Lindblad(h, [_LOWER.astype(h.dtype)], decay[None])


def velocity(t: Any, y: Density, args: Qubit) -> Complex[Array, "2 2"]:
    """The same field in plain space, where eigenvalues may become negative."""
    h, decay = _coefficients(t, y, args)
    jump = _LOWER.astype(y.dtype)
    loss = jump.T @ jump / 2
    h = h.astype(y.dtype)
    gain = jump @ y @ jump.T - loss @ y - y @ loss
    return -1j * (h @ y - y @ h) + decay.astype(y.dtype) * gain


def bloch(y: Complex[Array | np.ndarray, "*times 2 2"]) -> Float[Array, "*times 3"]:
    """The Bloch vector. Its length is 1 for a pure state; the ground state is `(0, 0, 1)`."""
    turning, height = 2 * y[..., 1, 0], y[..., 0, 0] - y[..., 1, 1]
    return jnp.stack([jnp.real(turning), jnp.imag(turning), jnp.real(height)], axis=-1)


def density(vector: Float[Array | np.ndarray, "3"]) -> Complex[np.ndarray, "2 2"]:
    """The density matrix of a Bloch vector."""
    x, y, z = np.asarray(vector)
    return np.array([[1 + z, x - 1j * y], [x + 1j * y, 1 - z]]) / 2


def steady(args: Qubit) -> Complex[np.ndarray, "2 2"]:
    """The state after a long time, exactly."""
    width = args.detuning**2 + args.decay**2 / 4
    excited = args.rabi**2 / 4 / (width + args.rabi**2 / 2)
    # Torrey's solution: the coherence follows the difference of the populations.
    across = args.rabi * (1 - 2 * excited) / 2 / width
    coherence = across * (-args.detuning - 0.5j * args.decay)
    return np.array([[1 - excited, np.conj(coherence)], [coherence, excited]])


def reference(
    t: float, args: Qubit, start: Complex[np.ndarray, "2 2"] | None = None
) -> Complex[np.ndarray, "2 2"]:
    """The state at time `t`, by SciPy's DOP853 with a tolerance of 1e-13.

    It solves Bloch's equations for a real vector. The error at t = 30 is about 1e-12.
    """

    def rate(t: float, r: np.ndarray) -> np.ndarray:
        axis = np.array([args.rabi * (1 - np.exp(-t / args.rise)), 0.0, -args.detuning])
        losses = args.decay * np.array([-r[0] / 2, -r[1] / 2, 1 - r[2]])
        return np.cross(axis, r) + losses

    return density(by_dop853(rate, np.asarray(bloch(y0() if start is None else start)), t))


def choi(step: Any, t: Float[Array, "*times"], args: Any) -> Complex[Array, "*times 4 4"]:
    """Choi's matrix of the map `step(t, rho, args)` at times `t`, which is linear in rho.

    The map is completely positive if and only if no eigenvalue of this matrix is negative.
    """
    corners = np.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0]])
    states = jnp.asarray([density(corner) for corner in corners])

    def of_one(t: Array) -> Array:
        up, down, x, y = jax.vmap(lambda rho: step(t, rho, args))(states)
        x, y = x - (up + down) / 2, y - (up + down) / 2
        return jnp.block([[up, x + 1j * y], [x - 1j * y, down]])

    return jnp.vectorize(of_one, signature="()->(n,n)")(t)


def problem() -> dict[str, Any]:
    """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
    return dict(term=cfjax.LieTerm(field), t0=t0, t1=t1, y0=y0(), args=Qubit())


def invariants(y: Density, args: Any = None) -> dict[str, Array]:
    """What stays, or goes one way, as its name says."""
    return {
        "trace": jnp.trace(y).real,
        "sum of negative eigenvalues": jnp.sum(jnp.minimum(jnp.linalg.eigvalsh(y), 0)),
        "distance from Hermitian": jnp.max(jnp.abs(y - y.conj().T)),
    }


def chart(**options: Any) -> cfjax.WorkPrecision:
    """A driven qubit to t = 30, 40 to 2560 equal steps; RK4, Tsit5 and Dopri8 in plain space."""
    return cfjax.work_precision(
        **problem(),
        methods=by_name(cfjax.CF4(), cfjax.Magnus4(), cfjax.Magnus6())
        | {"RK4": _rk4()}
        | in_plain_space(velocity, diffrax.Tsit5(), diffrax.Dopri8()),
        reference=reference(t1, Qubit()),
        num_steps=[40 * 2**k for k in range(7)],
        **options,
    )


def picture() -> figures.Figure:
    """The path of the Bloch vector; the most negative eigenvalue of Choi's matrix of one step."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    args = Qubit()
    figure = figures.new(9.5, 4.2)
    ball = figures.sphere(figure, 1, 2, 1, zoom=1.3)
    times, ys = solve(problem(), solver, num_steps=1500, save_every=1, save_initial=True)
    path = np.asarray(bloch(ys))
    pieces = np.stack([path[:-1], path[1:]], axis=1)
    lines = Line3DCollection(pieces, array=times[1:], cmap="viridis", linewidth=1.4, zorder=1)
    ball.add_collection3d(lines)
    end = np.asarray(bloch(steady(args)))
    ball.scatter(*end, color=figures.VERMILION, s=30, depthshade=False, zorder=2)
    ball.view_init(elev=15, azim=-145)
    ball.set_title("The state in the Bloch ball, late is yellow", y=0.97)

    curves = figure.add_subplot(1, 2, 2)
    methods = {
        "RK4": (_rk4(), figures.VERMILION, "o"),
        "Tsit5": ((diffrax.ODETerm(velocity), diffrax.Tsit5()), figures.ORANGE, "s"),
        "Dopri8": ((diffrax.ODETerm(velocity), diffrax.Dopri8()), figures.GREEN, "^"),
        "CF4": ((cfjax.LieTerm(field), cfjax.CF4()), figures.BLUE, "D"),
    }
    starts, steps = jnp.linspace(t0, t1, 61), 2.0 ** np.arange(-5, 1.3, 0.5)
    for name, (method, colour, marker) in methods.items():
        least = _least(method, steps, starts, args)
        # Rounding may have either sign.
        curves.loglog(steps, np.maximum(-least, 1e-17), marker=marker, color=colour, label=name)
    curves.axhspan(1e-18, 1e-15, color="0.9", linewidth=0)
    curves.text(steps[0], 6e-16, "not negative, to rounding", va="top")
    curves.set(title="Choi's matrix of one step, at its worst", xlabel="length of the step")
    curves.set(ylim=(3e-18, 1e3), ylabel="minus the smallest eigenvalue")
    curves.legend(frameon=False)
    return figure


def _rk4() -> tuple[cfjax.LieTerm, cfjax.CF4]:
    # On arrays CF4 is the classical method of order 4.
    return cfjax.LieTerm(velocity), cfjax.CF4()


def _least(method: Any, steps: np.ndarray, starts: Array, args: Qubit) -> np.ndarray:
    """The smallest eigenvalue of Choi's matrix of a step, over all its starts, for each length."""
    term, solver = method

    def step(t: Array, rho: Array, h: Array) -> Array:
        ys: Any = cfjax.integrate(term, solver, t, t + h, rho, args, num_steps=1).ys
        return ys[-1]

    matrices = jax.jit(lambda h: choi(step, starts, h))
    return np.asarray([np.linalg.eigvalsh(np.asarray(matrices(h))).min() for h in steps])


def _coefficients(t: Any, y: Density, args: Qubit) -> tuple[Array, Array]:
    """The Hamiltonian and the rate of decay, in the precision of the state."""
    dtype = jnp.finfo(y.dtype).dtype
    t, args = jax.tree.map(lambda x: jnp.asarray(x, dtype), (t, args))
    half = args.rabi * (1 - jnp.exp(-t / args.rise)) / 2
    h = jnp.stack([jnp.stack([0 * half, half]), jnp.stack([half, args.detuning])])
    return h, args.decay
