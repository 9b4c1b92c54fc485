"""The scenes of `benchmarks/peers.py`, each with the programs that solve it.

- A spacecraft, `cfjax.scenes.spacecraft` to t = 40. The reference is exact.
- An attitude matrix whose angular velocity is given in time, to t = 10: georax shows its
  convergence on this problem. The reference is SciPy's DOP853 at its smallest tolerance.
- The Kuramoto-Sivashinsky equation to t = 30, with the period, the start and the 128 points of
  Kassam & Trefethen (doi:10.1137/S1064827502410633), for exponax. The reference is SciPy's DOP853
  again, with the same modes in NumPy: the error is that of time alone.
"""

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import on_host
from cfjax.scenes import spacecraft


class Program(NamedTuple):
    """From a start and a setting, which is a number of steps or SciPy's tolerance, to the end."""

    package: str
    solve: Callable[[Any, Any], Any]
    settings: Sequence[float]


class Scene(NamedTuple):
    y0: Any
    error: Callable[[Any], float]
    # The distance from the group, if there is one.
    distance: Callable[[Any], float] | None
    target: float
    # Runs of a program in one turn: a single one may be too short for the clock.
    repeats: int
    programs: dict[str, Program]


def steps(smallest: int) -> list[int]:
    return [smallest * 2**k for k in range(4)]


TOLERANCES = [1e-5, 1e-7, 1e-9, 1e-11]


def equal_steps(field: Any, solver: Any, t1: float) -> Callable:
    def solve(y0: Any, num_steps: int) -> Any:
        sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, t1, y0, num_steps=num_steps)
        return jax.tree.map(lambda ys: ys[-1], sol.ys)

    return solve


def in_plain_space(velocity: Any, solver: diffrax.AbstractSolver, t1: float) -> Callable:
    term = diffrax.ODETerm(velocity)

    def solve(y0: Any, num_steps: int) -> Any:
        # Rounding of the times may make a step more.
        max_steps = num_steps + 1
        sol = diffrax.diffeqsolve(term, solver, 0.0, t1, t1 / num_steps, y0, max_steps=max_steps)
        return jax.tree.map(lambda ys: ys[-1], sol.ys)

    return solve


class Projected(diffrax.Tsit5):
    """Tsit5 that returns to the manifold after each step.

    The last stage of a step is the first of the next, as in Tsit5: what it is off is of the order
    of the error.
    """

    project: Callable = eqx.field(static=True, kw_only=True)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Any:
        y1, *remainder = super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        return self.project(y1), *remainder


def by_scipy(velocity: Callable, t1: float, method: str = "DOP853") -> Callable:
    return lambda y0, rtol: on_host.solve(velocity, t1, y0, method=method, rtol=rtol)


def with_jaxlie(
    rates: Callable, t1: float, to_state: Callable, from_state: Callable, smallest: int
) -> dict[str, Program]:
    """A classical RK4 written by hand around jaxlie's SO3, with a vector m beside the attitude.

    The stages are at `R @ SO3.exp(u)`. As it is often written, the four angular velocities are
    averaged as they are, which is of order two. With `jlog` each is first multiplied by the inverse
    right Jacobian at its u, which jaxlie has by that name: this is the equation that u solves, and
    the method of order four of Munthe-Kaas.
    """
    if importlib.util.find_spec("jaxlie") is None:
        return {}
    # An import statement would be an error to pyright, where the peers are not installed.
    jaxlie = importlib.import_module("jaxlie")

    def solver(uses_jlog: bool) -> Callable:
        def derivative(t: Any, r: Any, u: Any, m: Any) -> Any:
            turn = jaxlie.SO3.exp(u)
            omega, torque = rates(t, r @ turn, m)
            return turn.jlog() @ omega if uses_jlog else omega, torque

        def solve(y0: Any, num_steps: int) -> Any:
            h = t1 / num_steps

            def step(k: Any, y: Any) -> Any:
                (r, m), t = y, k * h
                omega1, m1 = rates(t, r, m)
                omega2, m2 = derivative(t + h / 2, r, h / 2 * omega1, m + h / 2 * m1)
                omega3, m3 = derivative(t + h / 2, r, h / 2 * omega2, m + h / 2 * m2)
                omega4, m4 = derivative(t + h, r, h * omega3, m + h * m3)
                turn = jaxlie.SO3.exp(h / 6 * (omega1 + 2 * omega2 + 2 * omega3 + omega4))
                return r @ turn, m + h / 6 * (m1 + 2 * m2 + 2 * m3 + m4)

            return from_state(*jax.lax.fori_loop(0, num_steps, step, to_state(jaxlie.SO3, y0)))

        return solve

    return {
        "jaxlie, RK4": Program("jaxlie", solver(False), steps(smallest)),
        "jaxlie, RK4, jlog": Program("jaxlie", solver(True), steps(smallest)),
    }


def of_spacecraft() -> Scene:
    inertia, t1 = spacecraft.inertia, spacecraft.t1
    exact = spacecraft.reference(t1)

    def field(t: Any, y: Any, args: Any) -> Any:
        omega = y["m"] / inertia
        attitude = cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")
        return {"q": attitude, "m": jnp.cross(y["m"], omega)}

    def velocity(t: Any, y: Any, args: Any) -> Any:
        return spacecraft.velocity(t, y, spacecraft.Craft())

    def normalised(y: Any) -> Any:
        return {"q": y["q"] / jnp.linalg.norm(y["q"]), "m": y["m"]}

    def velocity_of_columns(t: float, y: np.ndarray) -> np.ndarray:
        q0, q1, q2, q3, m1, m2, m3 = y
        w1, w2, w3 = m1 / inertia[0], m2 / inertia[1], m3 / inertia[2]
        return np.stack(
            [
                -(q1 * w1 + q2 * w2 + q3 * w3) / 2,
                (q0 * w1 + q2 * w3 - q3 * w2) / 2,
                (q0 * w2 + q3 * w1 - q1 * w3) / 2,
                (q0 * w3 + q1 * w2 - q2 * w1) / 2,
                m2 * w3 - m3 * w2,
                m3 * w1 - m1 * w3,
                m1 * w2 - m2 * w1,
            ]
        )

    def with_scipy(y0: Any, rtol: float) -> Any:
        # A batch is one system.
        columns = np.concatenate([y0["q"].T, y0["m"].T])
        y = on_host.solve(velocity_of_columns, t1, columns, rtol=rtol).T
        return {"q": y[..., :4], "m": y[..., 4:]}

    programs = {
        "CF4": Program("cfjax", equal_steps(field, cfjax.CF4(), t1), steps(100)),
        "CF54": Program("cfjax", equal_steps(field, cfjax.CF54(), t1), steps(50)),
        "RKMK(Dopri8)": Program(
            "cfjax", equal_steps(field, cfjax.RKMK(diffrax.Dopri8.tableau), t1), steps(12)
        ),
        "Projected(Dopri8)": Program(
            "cfjax", equal_steps(field, cfjax.Projected(diffrax.Dopri8()), t1), steps(12)
        ),
        "diffrax, Tsit5": Program(
            "diffrax", in_plain_space(velocity, diffrax.Tsit5(), t1), steps(50)
        ),
        "diffrax, Tsit5, projected": Program(
            "diffrax", in_plain_space(velocity, Projected(project=normalised), t1), steps(50)
        ),
        "diffrax, Dopri8": Program(
            "diffrax", in_plain_space(velocity, diffrax.Dopri8(), t1), steps(12)
        ),
        "SciPy, DOP853": Program("scipy", with_scipy, TOLERANCES),
    }
    programs |= with_jaxlie(
        lambda t, r, m: (m / inertia, jnp.cross(m, m / inertia)),
        t1,
        to_state=lambda SO3, y: (SO3(y["q"]), y["m"]),
        from_state=lambda r, m: {"q": r.wxyz, "m": m},
        smallest=100,
    )
    return Scene(
        jax.tree.map(jnp.asarray, spacecraft.y0()),
        lambda y: spacecraft.error(y, exact),
        lambda y: abs(float(np.linalg.norm(y["q"])) - 1),
        1e-8,
        10,
        programs,
    )


def of_prescribed_velocity() -> Scene:
    t1 = 10.0

    def omega(t: Any, like: Any = jnp) -> Any:
        return like.array([1 + like.sin(t) / 2, like.cos(1.5 * t) / 2, like.sin(t / 2)])

    def field(t: Any, r: Any, args: Any) -> Any:
        return cfjax.RightMatrix(jnp.cross(jnp.eye(3), omega(t)))

    def quaternion_field(t: Any, q: Any, args: Any) -> Any:
        return cfjax.QuaternionRotation(omega(t), frame="body", layout="wxyz")

    def quaternion_velocity(t: Any, q: Any, args: Any) -> Any:
        w = omega(t)
        return jnp.append(-q[1:] @ w, q[0] * w + jnp.cross(q[1:], w)) / 2

    def as_quaternion(solve: Callable) -> Callable:
        def solve_matrix(r: Any, num_steps: int) -> Any:
            q = solve(cfjax.quaternion_from_matrix(r, layout="wxyz"), num_steps)
            # The matrix is quadratic in the length, so that its error shows in the distance.
            length = jnp.linalg.norm(q)
            return length**2 * cfjax.quaternion_to_matrix(q / length, layout="wxyz")

        return solve_matrix

    def velocity(t: Any, r: Any, args: Any) -> Any:
        return jnp.cross(r, omega(t))

    def nearer(r: Any) -> Any:
        """A step of Newton's to the nearest rotation, which squares the distance."""
        return r @ (3 * jnp.eye(3) - r.T @ r) / 2

    def with_numpy(t: float, r: np.ndarray) -> np.ndarray:
        x, y, z = omega(t, np)
        return r @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])

    exact = on_host.solve(with_numpy, t1, np.eye(3))
    programs = {
        "CF4": Program("cfjax", equal_steps(field, cfjax.CF4(), t1), steps(25)),
        "Magnus6": Program("cfjax", equal_steps(field, cfjax.Magnus6(), t1), steps(12)),
        "CF4, quaternion": Program(
            "cfjax", as_quaternion(equal_steps(quaternion_field, cfjax.CF4(), t1)), steps(25)
        ),
        "Magnus6, quaternion": Program(
            "cfjax", as_quaternion(equal_steps(quaternion_field, cfjax.Magnus6(), t1)), steps(12)
        ),
        "CG4": Program("cfjax", equal_steps(field, cfjax.CG4(), t1), steps(25)),
        "diffrax, Tsit5": Program(
            "diffrax", in_plain_space(velocity, diffrax.Tsit5(), t1), steps(12)
        ),
        "diffrax, Tsit5, projected": Program(
            "diffrax", in_plain_space(velocity, Projected(project=nearer), t1), steps(12)
        ),
        "diffrax, Dopri8": Program(
            "diffrax", in_plain_space(velocity, diffrax.Dopri8(), t1), steps(4)
        ),
        "diffrax, Dopri8, quaternion": Program(
            "diffrax",
            as_quaternion(in_plain_space(quaternion_velocity, diffrax.Dopri8(), t1)),
            steps(4),
        ),
        "SciPy, DOP853": Program("scipy", by_scipy(with_numpy, t1), TOLERANCES),
    }
    programs |= with_jaxlie(
        lambda t, r, m: (omega(t), m),
        t1,
        # No momentum.
        to_state=lambda SO3, r: (SO3.from_matrix(r), jnp.zeros(0)),
        from_state=lambda r, m: r.as_matrix(),
        smallest=25,
    )
    return Scene(
        jnp.eye(3),
        lambda r: float(np.linalg.norm(r - exact)),
        lambda r: float(np.linalg.norm(np.asarray(r).T @ r - np.eye(3))),
        1e-8,
        10,
        programs,
    )


def of_kuramoto() -> Scene:
    n, period, t1 = 128, 32 * np.pi, 30.0
    x = period * np.arange(n) / n
    y0 = np.cos(x / 16) * (1 + np.sin(x / 16))
    k = np.arange(n // 2 + 1)
    derivative = 2j * np.pi / period * k
    spectrum = (-(derivative**2) - derivative**4).real
    # The wave numbers that exponax keeps in the square by default.
    mask = k <= 2 / 3 * (n // 2) - 1

    def square(c: Any, like: Any) -> Any:
        u = like.fft.irfft(mask * c, n)
        return -derivative / 2 * mask * like.fft.rfft(u**2)

    def field(t: Any, c: Any, args: Any) -> Any:
        return cfjax.Affine(square(c, jnp), spectrum)

    def velocity(u: Any, like: Any) -> Any:
        c = like.fft.rfft(u)
        return like.fft.irfft(spectrum * c + square(c, like), n)

    def coefficients(solver: Any) -> Callable:
        solve = equal_steps(field, solver, t1)
        return lambda u, num_steps: jnp.fft.irfft(solve(jnp.fft.rfft(u), num_steps), n)

    def in_space(t: Any, u: Any, args: Any) -> Any:
        return velocity(u, jnp)

    def on_grid(t: float, u: np.ndarray) -> np.ndarray:
        return velocity(u, np)

    exact = on_host.solve(on_grid, t1, y0)
    programs = {
        "CF4": Program("cfjax", coefficients(cfjax.CF4()), steps(150)),
        "ETD54": Program("cfjax", coefficients(cfjax.ETD54()), steps(30)),
        # With 2000 it overflows.
        "diffrax, Tsit5": Program("diffrax", in_plain_space(in_space, diffrax.Tsit5(), t1), [2400]),
        "SciPy, DOP853": Program("scipy", by_scipy(on_grid, t1), TOLERANCES[::2]),
        "SciPy, LSODA": Program("scipy", by_scipy(on_grid, t1, "LSODA"), TOLERANCES),
    }
    if importlib.util.find_spec("exponax"):
        exponax = importlib.import_module("exponax")

        def etdrk4(u: Any, num_steps: int) -> Any:
            stepper = exponax.stepper.KuramotoSivashinskyConservative(
                1, period, n, t1 / num_steps, order=4
            )
            return exponax.RepeatedStepper(stepper, num_steps)(u[None])[0]

        programs["exponax, ETDRK4"] = Program("exponax", etdrk4, steps(150))
    return Scene(
        jnp.asarray(y0), lambda u: float(np.max(np.abs(u - exact))), None, 1e-6, 5, programs
    )


SCENES = {
    "spacecraft": of_spacecraft,
    "given angular velocity": of_prescribed_velocity,
    "Kuramoto-Sivashinsky": of_kuramoto,
}
