"""Time of a covariance and a sensitivity over that of the solve alone.

A window of one second of an inertial measurement unit, 200 steps of CF4, with its covariance P
(9 x 9) and its Jacobian S by the biases (9 x 6), one and 1000 at once; and an attitude with its
covariance (3 x 3). `cfjax.VariationTerm` takes turns with `jax.jacfwd` of the solve, with
`jax.jacfwd` of each step and the recursion of an extended Kalman filter, and with preintegration on
the manifold by a loop in C and one in NumPy. These three are of order two in the step, and the run
checks that they agree with the others to that order. Times and compile times are those of the
processor.
"""

import ctypes
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results

STEPS, MANY = 200, 1000
# One window in a turn.
ONE_TURN = 20
GRAVITY = np.array([0.0, 0.0, -9.81])
# Of angles and of velocities, in unit time.
NOISE = np.array([0.02**2, 0.05**2])
START = {"q": np.array([1.0, 0.0, 0.0, 0.0]), "v": np.zeros(3), "x": np.zeros(3)}
CF4, UNROLLED = cfjax.CF4(), cfjax.CF4(unroll=True)
Programs = dict[str, Callable[[], Any]]


def measure(quick: bool) -> Iterator[results.Row]:
    rounds = 3 if quick else 9
    biases = 0.01 * np.random.default_rng(0).normal(size=(MANY, 6))
    with tempfile.TemporaryDirectory() as folder:
        library = results.compile_c("variations.c", Path(folder))
        hand = {"NumPy": by_numpy} | ({"C": in_c(library)} if library is not None else {})
        for problem, programs in (("IMU", IMU), ("attitude", ATTITUDE)):
            one, compile_times = compiled_anew(programs, biases[0], 1 if quick else 2)
            many = {
                name: results.compiled(jax.vmap(run), jnp.asarray(biases))
                for name, run in programs.items()
            }
            for count, runs, repeats in ((1, one, ONE_TURN), (MANY, many, 1)):
                if problem == "IMU":
                    if count == 1:
                        check({name: run() for name, run in one.items()}, hand, biases[0])
                    theta = biases[:count]
                    runs |= {name: lambda run=run, b=theta: run(b) for name, run in hand.items()}
                times = processor_seconds(runs, rounds, repeats)
                for name, seconds in times.items():
                    row = {
                        "problem": problem,
                        "program": name,
                        "windows": count,
                        "seconds a window": results.spread(seconds / count),
                        "over the solve": results.ratios(seconds, times["solve"]),
                    }
                    if name in compile_times:
                        row["compile CPU seconds"] = results.spread(compile_times[name])
                        row["compile over the solve"] = results.ratios(
                            compile_times[name], compile_times["solve"]
                        )
                    yield row


# The readings, with which the biases of both sensors are subtracted.


def gyro(t: Any) -> jax.Array:
    return jnp.stack([jnp.sin(3 * t), jnp.cos(2 * t), 0.5 + 0 * t])


def force(t: Any) -> jax.Array:
    return jnp.stack([jnp.cos(t), jnp.sin(2 * t), 9.81 + 0 * t])


def turning(omega: Any) -> cfjax.QuaternionRotation:
    return cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")


def turned(q: Any, x: Any) -> jax.Array:
    return cfjax.quaternion_rotate(q, x, layout="wxyz")


def window(t: Any, y: Any, bias: Any) -> Any:
    acceleration = turned(y["q"], force(t) - bias[3:]) + GRAVITY
    return {"q": turning(gyro(t) - bias[:3]), "v": acceleration, "x": y["v"]}


def window_noise(t: Any, y: Any, bias: Any, dw: Any) -> Any:
    angles, velocity = np.sqrt(NOISE)[:, None] * dw.reshape(2, 3)
    return {"q": turning(angles), "v": turned(y["q"], velocity), "x": None}


def inertial(t: Any, y: Any, bias: Any) -> Any:
    """The same window as one extended pose."""
    return cfjax.InertialMotion(
        omega=gyro(t) - bias[:3], force=force(t) - bias[3:], gravity=GRAVITY, layout="wxyz_v_p"
    )


def inertial_noise(t: Any, y: Any, bias: Any, dw: Any) -> Any:
    angles, velocity = np.sqrt(NOISE)[:, None] * dw.reshape(2, 3)
    return cfjax.InertialMotion(
        omega=angles, force=velocity, gravity=0 * angles, time=0.0, layout="wxyz_v_p"
    )


def attitude(t: Any, q: Any, bias: Any) -> Any:
    return turning(gyro(t) - bias[:3])


def attitude_noise(t: Any, q: Any, bias: Any, dw: Any) -> Any:
    return turning(np.sqrt(NOISE[0]) * dw)


# Programs by name. Each maps the biases, shape (6,), to what a window has at its end.


def solve(field: Any, start: Any, num_steps: int = STEPS) -> Callable[[Any], Any]:
    return lambda bias: end(cfjax.LieTerm(field), start, bias, num_steps)


def end(term: Any, y0: Any, bias: Any, num_steps: int, solver: Any = CF4) -> Any:
    sol = cfjax.integrate(term, solver, 0.0, 1.0, y0, bias, num_steps=num_steps, throw=False)
    return jax.tree.map(lambda x: x[-1], sol.ys)


def varied(
    field: Any,
    noise: Any,
    start: Any,
    channels: int,
    num_steps: int = STEPS,
    solver: Any = CF4,
    **carried: Any,
) -> Callable[[Any], Any]:
    def program(bias: Any) -> Any:
        term = cfjax.VariationTerm(
            cfjax.LieTerm(field), noise=noise, channels=channels, parameters=lambda bias: bias
        )
        # Not by `term.start`, whose checks are for one start and not for each window.
        y0 = jax.tree.map(jnp.asarray, cfjax.Variation(start, **carried))
        y = end(term, y0 if channels > 3 else y0.by_rows(), bias, num_steps, solver)
        return {name: getattr(y, name) for name in carried} | {"state": y.state}

    return program


def moved(y: Any, eta: Any) -> Any:
    """The product moved by the coordinates of a variation."""
    return {"q": turning(eta[:3]).flow(y["q"]), "v": y["v"] + eta[3:6], "x": y["x"] + eta[6:]}


def back(y: Any, end: Any) -> jax.Array:
    """To first order, the coordinates that take y to another."""
    w, v = y["q"][0], y["q"][1:]
    angles = 2 * (w * end["q"][1:] - end["q"][0] * v - jnp.cross(v, end["q"][1:]))
    return jnp.concatenate([angles, end["v"] - y["v"], end["x"] - y["x"]])


def with_jacobian(run: Callable[[Any], Any], x: Any) -> tuple[Any, jax.Array]:
    """What `run` returns, and how its coordinates change with the vector x."""
    jacobian, y = jax.jacfwd(lambda x: (run(x),) * 2, has_aux=True)(x)
    along = lambda change: jax.jvp(lambda new: back(y, new), (y,), (change,))[1]  # noqa: E731
    return y, jax.vmap(along, in_axes=-1, out_axes=-1)(jacobian)


def sensitivity_by_jacfwd(bias: Any) -> Any:
    y, sensitivity = with_jacobian(solve(window, START), bias)
    return {"state": y, "sensitivity": sensitivity}


def filtered(bias: Any, num_steps: int = STEPS) -> Any:
    """Each step by `jax.jacfwd`, and with it P and S as in an extended Kalman filter."""
    term, h = cfjax.LieTerm(window), 1 / num_steps
    noise = h / 2 * jnp.diag(jnp.asarray(np.repeat([*NOISE, 0.0], 3)))

    def step(carry: Any, t: Any) -> Any:
        y, p, s = carry

        def one(x: Any) -> Any:
            start, bias = moved(y, x[:9]), x[9:]
            sol = cfjax.integrate(term, CF4, t, t + h, start, bias, num_steps=1, throw=False)
            return jax.tree.map(lambda x: x[-1], sol.ys)

        new, jacobian = with_jacobian(one, jnp.concatenate([jnp.zeros(9), bias]))
        f, by_bias = jacobian[:, :9], jacobian[:, 9:]
        return (new, f @ (p + noise) @ f.T + noise, f @ s + by_bias), None

    carry = jax.tree.map(jnp.asarray, START), jnp.zeros((9, 9)), jnp.zeros((9, 6))
    (y, p, s), _ = jax.lax.scan(step, carry, h * jnp.arange(num_steps, dtype=float))
    return {"state": y, "covariance": p, "sensitivity": s}


def transition_by_jacfwd(bias: Any) -> Any:
    run = lambda eta: end(  # noqa: E731
        cfjax.LieTerm(attitude), turning(eta).flow(jnp.asarray(START["q"])), bias, STEPS
    )
    return jax.jacfwd(run)(jnp.zeros(3))


P, S = np.zeros((9, 9)), np.zeros((9, 6))
IMU: dict[str, Callable[[Any], Any]] = {
    "solve": solve(window, START),
    "P and S": varied(window, window_noise, START, 6, covariance=P, sensitivity=S),
    "unrolled, P and S": varied(
        window, window_noise, START, 6, solver=UNROLLED, covariance=P, sensitivity=S
    ),
    "S": varied(window, window_noise, START, 6, sensitivity=S),
    "jacfwd, S": sensitivity_by_jacfwd,
    "jacfwd of steps, P and S": filtered,
    "inertial": solve(inertial, np.eye(10)[0]),
    "inertial, P and S": varied(
        inertial, inertial_noise, np.eye(10)[0], 6, covariance=P, sensitivity=S
    ),
}
ATTITUDE: dict[str, Callable[[Any], Any]] = {
    "solve": solve(attitude, START["q"]),
    "P": varied(attitude, attitude_noise, START["q"], 3, covariance=np.zeros((3, 3))),
    "jacfwd, transition": transition_by_jacfwd,
}


# By hand: attitude, velocity and position, P and S of each window.


def in_c(library: ctypes.CDLL) -> Callable[..., Any]:
    pointer = ctypes.POINTER(ctypes.c_double)
    library.windows.argtypes = [ctypes.c_long, ctypes.c_long, *[pointer] * 5]

    def run(biases: np.ndarray, num_steps: int = STEPS) -> Any:
        n = len(biases)
        out = np.empty((n, 15)), np.empty((n, 9, 9)), np.empty((n, 9, 6))
        arrays = (np.ascontiguousarray(biases), NOISE, *out)
        library.windows(n, num_steps, *(x.ctypes.data_as(pointer) for x in arrays))
        return out

    return run


def by_numpy(biases: np.ndarray, num_steps: int = STEPS) -> Any:
    """The scheme of variations.c with matrices of 9 x 9, for all windows together."""
    n, h = len(biases), 1 / num_steps
    r, v, x = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 3))
    p, s = np.zeros((n, 9, 9)), np.zeros((n, 9, 6))
    noise = h / 2 * np.diag(np.repeat([*NOISE, 0.0], 3))
    f, by_bias = np.tile(np.eye(9), (n, 1, 1)), np.zeros((n, 9, 6))
    f[:, 6:, 3:6] = h * np.eye(3)
    for k in range(num_steps):
        t = (k + 0.5) * h
        omega = np.array([np.sin(3 * t), np.cos(2 * t), 0.5]) - biases[:, :3]
        specific = np.array([np.cos(t), np.sin(2 * t), 9.81]) - biases[:, 3:]
        turn, jacobian = exponential(h * omega)
        half, of_half = exponential(h / 2 * omega)
        middle = r @ half
        a = np.squeeze(middle @ specific[:, :, None], -1) + GRAVITY
        x = x + h * v + h * h / 2 * a
        v, r = v + h * a, r @ turn
        crossed = middle @ hat(specific)
        by_angle = -crossed @ np.swapaxes(half, 1, 2)
        by_gyro = h / 2 * crossed @ of_half
        f[:, :3, :3] = np.swapaxes(turn, 1, 2)
        f[:, 3:6, :3], f[:, 6:, :3] = h * by_angle, h * h / 2 * by_angle
        by_bias[:, :3, :3] = -h * jacobian
        by_bias[:, 3:6] = h * np.concatenate([by_gyro, -middle], axis=2)
        by_bias[:, 6:] = h / 2 * by_bias[:, 3:6]
        p = f @ (p + noise) @ np.swapaxes(f, 1, 2) + noise
        s = f @ s + by_bias
    return np.concatenate([r.reshape(n, 9), v, x], axis=1), p, s


def hat(w: np.ndarray) -> np.ndarray:
    return np.swapaxes(np.cross(w[:, None, :], np.eye(3)), 1, 2)


def exponential(w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of rotation vectors that are not zero the rotations, and their right Jacobians."""
    a, square = np.linalg.norm(w, axis=1)[:, None, None], np.sum(w * w, axis=1)[:, None, None]
    m = hat(w)
    c1, c2, c3 = np.sin(a) / a, 2 * np.sin(a / 2) ** 2 / square, (a - np.sin(a)) / (a * square)
    return np.eye(3) + c1 * m + c2 * m @ m, np.eye(3) - c2 * m + c3 * m @ m


def check(found: Mapping[str, Any], hand: Mapping[str, Callable[..., Any]], bias: Any) -> None:
    """Raises unless all programs agree, to the order of each."""
    fine = varied(window, window_noise, START, 6, 4 * STEPS, covariance=P, sensitivity=S)
    exact = jax.jit(fine)(bias)

    def error(name: str, value: Any) -> float:
        return float(np.abs(value - exact[name]).max() / np.abs(exact[name]).max())

    for program, out in found.items():
        if not program.endswith("S"):
            continue
        out = in_fixed(out) if program == "inertial, P and S" else out
        for name in ("covariance", "sensitivity"):
            # CF4 with steps of 1/200 and rates of up to 3: the fourth power of a hundredth. What
            # has order two misses it by its square.
            bound = 1e-4 if program == "jacfwd of steps, P and S" else 1e-8
            if name in out and error(name, out[name]) > bound:
                raise RuntimeError(f"{program}: {name} off by {error(name, out[name])}.")
    for program, run in hand.items():
        coarse, halved = (run(bias[None], n) for n in (STEPS, 2 * STEPS))
        for k, name in ((1, "covariance"), (2, "sensitivity")):
            order = np.log2(error(name, coarse[k][0]) / error(name, halved[k][0]))
            if abs(order - 2) > 0.1:
                raise RuntimeError(f"{program}: the {name} has order {order:.2f}, not 2.")


def in_fixed(found: Mapping[str, Any]) -> dict[str, Any]:
    """Of an extended pose, with velocity and position in the fixed frame, as in the product."""
    rotation = cfjax.quaternion_to_matrix(found["state"][:4], layout="wxyz")
    turn = np.eye(9)
    turn[3:6, 3:6] = turn[6:, 6:] = rotation
    covariance = turn @ found["covariance"] @ turn.T
    return {"covariance": covariance, "sensitivity": turn @ found["sensitivity"]}


def compiled_anew(
    programs: Mapping[str, Callable[[Any], Any]], bias: np.ndarray, rounds: int
) -> tuple[Programs, dict[str, np.ndarray]]:
    """The programs, and the seconds of the processor to trace, lower and compile each."""
    runs: Programs = {}
    seconds: list[list[float]] = []
    for _ in range(rounds):
        seconds.append([])
        for name, run in programs.items():
            jax.clear_caches()
            begin = time.process_time()
            runs[name] = results.compiled(run, jnp.asarray(bias))
            seconds[-1].append(time.process_time() - begin)
    return runs, dict(zip(programs, np.array(seconds).T, strict=True))


def processor_seconds(runs: Programs, rounds: int, repeats: int) -> dict[str, np.ndarray]:
    """Of each program in each round. In a round each runs so often, which the clock can measure."""
    seconds = np.empty((len(runs), rounds))
    for k in range(rounds):
        for m, run in enumerate(runs.values()):
            begin = time.process_time()
            for _ in range(repeats):
                jax.block_until_ready(run())
            seconds[m, k] = (time.process_time() - begin) / repeats
    return dict(zip(runs, seconds, strict=True))


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
