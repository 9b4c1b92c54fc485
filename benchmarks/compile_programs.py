"""The programs of `benchmarks/compile.py`: typical programs, in small scenes.

A program takes a term, a solver and a start. Each comes as cfjax's and as the one of diffrax that
it is compared with, in plain space. The two differ where cfjax has its own loop of equal steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

import cfjax
from cfjax.scenes import allen_cahn, macrospin, rigid_body, spin_waves, spins

Program = Callable[[Any, Any, Any], Any]

T1, STEPS = 1.0, 50


def solve(**options: Any) -> Program:
    return lambda term, solver, y0: (
        diffrax.diffeqsolve(term, solver, 0.0, T1, T1 / STEPS, y0, max_steps=256, **options).ys
    )


def integrate(**options: Any) -> Program:
    return lambda term, solver, y0: (
        cfjax.integrate(term, solver, 0.0, T1, y0, num_steps=STEPS, **options).ys
    )


def gradient(program: Program) -> Program:
    def loss(ys: Any) -> Any:
        return sum(jnp.sum(jnp.abs(y) ** 4 + y.real) for y in jax.tree.leaves(ys))

    return lambda term, solver, y0: jax.grad(lambda y: loss(program(term, solver, y)))(y0)


def jacobian(program: Program) -> Program:
    return lambda term, solver, y0: jax.jacfwd(lambda y: program(term, solver, y))(y0)


def fit(program: Program) -> Program:
    """The start that is nearest to data, by Levenberg and Marquardt's method."""

    def least_squares(term: Any, solver: Any, y0: Any) -> Any:
        def residuals(y: Any, _: Any) -> Any:
            return jax.tree.map(lambda x: x - 0.5, program(term, solver, y))

        optimiser = optimistix.LevenbergMarquardt(1e-6, 1e-6)
        return optimistix.least_squares(
            residuals, optimiser, y0, options={"jac": "fwd"}, throw=False
        ).value

    return least_squares


def event_function(t: Any, y: Any, args: Any, **_: Any) -> Any:
    """Zero where the first number of the state is 0.3."""
    return jax.tree.leaves(y)[0].reshape(-1)[0] - 0.3


CONTROL: dict[str, Any] = dict(stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6))
TIMES: dict[str, Any] = dict(saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, T1, 11)))
EVENT: dict[str, Any] = dict(event=diffrax.Event(event_function, optimistix.Newton(1e-8, 1e-8)))
FORWARD: dict[str, Any] = dict(adjoint=diffrax.ForwardMode())


def both(program: Program) -> tuple[Program, Program]:
    return program, program


# The program of cfjax, and the one of diffrax that it is compared with.
PROGRAMS: dict[str, tuple[Program, Program]] = {
    "equal steps": both(solve()),
    "adaptive steps with output": both(solve(**CONTROL, **TIMES)),
    "event, adaptive steps with output": both(solve(**EVENT, **CONTROL, **TIMES)),
    "gradient": both(gradient(solve())),
    "gradient, adaptive steps with output": both(gradient(solve(**CONTROL, **TIMES))),
    "Jacobian, adaptive steps with output": both(jacobian(solve(**CONTROL, **TIMES, **FORWARD))),
    "fit by least squares": both(fit(solve(**CONTROL, **TIMES, **FORWARD))),
    "`integrate`": (integrate(), solve()),
    "`integrate`, gradient": (gradient(integrate()), gradient(solve())),
    "`integrate`, Jacobian": (jacobian(integrate()), jacobian(solve(**FORWARD))),
}
OF_EQUAL_STEPS = ("equal steps", "`integrate`", "gradient", "`integrate`, gradient")
OF_ADAPTIVE_STEPS = ("adaptive steps with output", "gradient, adaptive steps with output")


class Scene(NamedTuple):
    """A problem, and in plain space the term and the method that a user would take instead."""

    methods: dict[str, tuple[Any, Any]]  # of cfjax: a term and a solver
    base: str
    plain: tuple[Any, Any]
    y0: Any
    programs: tuple[str, ...]


METHODS = {
    "CF4": cfjax.CF4(),
    "CF54": cfjax.CF54(),
    "Projected(Dopri8)": cfjax.Projected(diffrax.Dopri8()),
}
MATRIX = np.random.default_rng(0).normal(size=(4, 4))


def skew(t: Any, y: Any, args: Any) -> cfjax.LeftMatrix:
    a = MATRIX @ y + jnp.sin(t) * MATRIX.T
    return cfjax.LeftMatrix(a - a.T)


def spacecraft(t: Any, y: Any, args: Any) -> dict[str, Any]:
    omega = y["m"] / jnp.array([3.0, 2.0, 1.0])
    q = cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")
    return {"q": q, "m": jnp.cross(y["m"], omega)}


def deterministic(field: Callable[..., Any], y0: Any) -> Scene:
    methods = {name: (cfjax.LieTerm(field), solver) for name, solver in METHODS.items()}

    def velocity(t: Any, y: Any, args: Any) -> Any:
        return cfjax.tangent(field(t, y, args), y)

    plain = diffrax.ODETerm(velocity), diffrax.Tsit5()
    return Scene(methods, "Tsit5", plain, jax.tree.map(jnp.asarray, y0), tuple(PROGRAMS))


def noisy() -> Scene:
    """A spin at a temperature."""
    args, y0 = macrospin.Particle(), jnp.asarray(macrospin.y0())
    tree = diffrax.VirtualBrownianTree(
        0.0, T1, 1e-3, (3,), jax.random.key(0), diffrax.SpaceTimeLevyArea
    )

    def drift(t: Any, y: Any, _: Any) -> cfjax.Rotation:
        return macrospin.field(t, y, args)

    def noise(t: Any, y: Any, _: Any, increment: Any) -> cfjax.Rotation:
        return macrospin.thermal(t, y, args, increment)

    def diffusion(t: Any, y: Any, _: Any) -> Any:
        move = lambda x: cfjax.tangent(noise(t, y, None, x), y)  # noqa: E731
        return jax.vmap(move, out_axes=1)(jnp.eye(3))

    ours = diffrax.MultiTerm(cfjax.LieTerm(drift), cfjax.LieControlTerm(noise, tree))
    plain = diffrax.MultiTerm(
        diffrax.ODETerm(lambda t, y, _: cfjax.tangent(drift(t, y, None), y)),
        diffrax.ControlTerm(diffusion, tree),
    )
    solvers = {"CF2": cfjax.CF2(), "WeakOrder2": cfjax.WeakOrder2()}
    solvers["ShiftedNoise"] = cfjax.ShiftedNoise()
    methods = {name: (ours, solver) for name, solver in solvers.items()}
    return Scene(methods, "SPaRK", (plain, diffrax.SPaRK()), y0, OF_EQUAL_STEPS)


def long_times() -> Scene:
    """Spins on a lattice."""
    magnet, y0 = spin_waves.MAGNET, jnp.asarray(spin_waves.y0(16))

    def field(t: Any, y: Any, _: Any) -> cfjax.Rotation:
        return spins.field(t, y, magnet)

    def colour(parity: int) -> cfjax.LieTerm:
        field = spin_waves.colour(parity).field
        return cfjax.LieTerm(lambda t, y, _: field(t, y, magnet))

    split = diffrax.MultiTerm(colour(0), colour(1))
    methods: dict[str, tuple[Any, Any]] = {
        "Strang": (split, cfjax.Strang()),
        "BlanesMoan4": (split, cfjax.BlanesMoan4()),
        "BlanesMoan6": (split, cfjax.BlanesMoan6()),
        "ImplicitMidpoint": (cfjax.LieTerm(field), cfjax.ImplicitMidpoint()),
    }
    velocity = diffrax.ODETerm(lambda t, y, _: cfjax.tangent(field(t, y, None), y))
    plain = velocity, diffrax.LeapfrogMidpoint()
    return Scene(methods, "LeapfrogMidpoint", plain, y0, OF_EQUAL_STEPS)


def stiff() -> Scene:
    """Fronts between two phases."""
    width, y0 = allen_cahn.WIDTH, jnp.asarray(allen_cahn.y0(64))
    term = cfjax.LieTerm(lambda t, y, _: allen_cahn.field(t, y, width))
    methods = {
        "CF43": (term, cfjax.CF43()),
        "ETD43": (term, cfjax.ETD43()),
        "ETD54": (term, cfjax.ETD54()),
    }
    velocity = diffrax.ODETerm(lambda t, y, _: allen_cahn.velocity(t, y, width))
    return Scene(methods, "Kvaerno5", (velocity, diffrax.Kvaerno5()), y0, OF_ADAPTIVE_STEPS)


SCENES: dict[str, Callable[[], Scene]] = {
    "rigid body": lambda: deterministic(
        lambda t, y, args: rigid_body.field(t, y, rigid_body.inertia), rigid_body.y0
    ),
    "spacecraft": lambda: deterministic(
        spacecraft,
        {"q": np.array([1.0, 0.0, 0.0, 0.0]), "m": np.array([0.05, 1.0, 0.0])},
    ),
    "4 x 4 matrices": lambda: deterministic(skew, np.eye(4)),
    "noise": noisy,
    "long times": long_times,
    "stiff": stiff,
}


def lowered(scene: Scene, program: str, method: str) -> jax.stages.Lowered:
    """The program, traced anew each time. The method is one of the scene or its `base`."""
    ours, theirs = PROGRAMS[program]
    is_base = method == scene.base
    fun, (term, solver) = (theirs, scene.plain) if is_base else (ours, scene.methods[method])
    return jax.jit(lambda y: fun(term, solver, y)).lower(scene.y0)


def size(compiled: jax.stages.Compiled) -> int:
    """The instructions of optimised HLO, which are the same on every machine.

    The text has tables of source lines too, which depend on who calls.
    """
    return (compiled.as_text() or "").count(" = ")
