"""A GPU against the processor beside it: batches, lattices and large semidiscretised equations.

Each program runs on both, for the same arrays. Rigid bodies are members of a batch, each with its
own principal moments; a spin lattice and a reaction with diffusion are one large state. A gradient
is that of a sum over the members with respect to their starts. "as traced" is without rewriting for
XLA. The difference is the largest one between the results of both devices.
"""

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax.scenes import gray_scott, rigid_body, spins

END, STEPS = 10.0, 100


class Case(NamedTuple):
    """A program, its inputs in float64, and the number of members of the batch."""

    problem: str
    method: str
    run: Callable[[Any], Any]
    inputs: Any
    members: int


def velocity(t: Any, y: Any, args: Any) -> Any:
    return jnp.cross(y, y / args)


def term(solver: Any, field: Any, velocity: Any) -> Any:
    in_plain_space = isinstance(solver, diffrax.Tsit5)
    return diffrax.ODETerm(velocity) if in_plain_space else cfjax.LieTerm(field)


def equal_steps(solver: Any, rewrites: bool = True) -> Callable[[Any], Any]:
    equation = term(solver, rigid_body.field, velocity)

    def solve(y0: Any, inertia: Any) -> Any:
        with cfjax.rewriting(rewrites):
            options: Any = dict(num_steps=STEPS, throw=False)
            solution: Any = cfjax.integrate(equation, solver, 0.0, END, y0, inertia, **options)
            return solution.ys[-1]

    return lambda members: jax.vmap(solve)(*members)


def controlled(solver: Any, num_saves: int) -> Callable[[Any], Any]:
    equation = term(solver, rigid_body.field, velocity)

    def solve(y0: Any, inertia: Any) -> Any:
        times = jnp.linspace(0, END, num_saves, dtype=y0.dtype) if num_saves > 1 else None
        tolerance = 1e-7 if y0.dtype == float else 1e-4
        return diffrax.diffeqsolve(
            equation,
            solver,
            jnp.zeros((), y0.dtype),
            jnp.asarray(END, y0.dtype),
            None,
            y0,
            inertia,
            saveat=diffrax.SaveAt(ts=times, t1=times is None),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            throw=False,
        ).ys

    return lambda members: jax.vmap(solve)(*members)


def gradient(run: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return jax.grad(lambda members: jnp.sum(run(members)[:, 0]))


def bodies(count: int) -> Any:
    rng = np.random.default_rng(0)
    y0 = rng.normal(size=(count, 3))
    inertia = rigid_body.inertia * rng.uniform(0.9, 1.1, size=(count, 3))
    return y0 / np.linalg.norm(y0, axis=1, keepdims=True), inertia


def cases(quick: bool) -> Iterator[Case]:
    for members in (1, 1000, 100) if quick else (1, 1000, 100_000):
        inputs = bodies(members)
        case = functools.partial(Case, "rigid bodies, equal steps", inputs=inputs, members=members)
        yield case("CF4", equal_steps(cfjax.CF4()))
        if members > 1:
            yield case("CF4, as traced", equal_steps(cfjax.CF4(), False))
        yield case("Tsit5", equal_steps(diffrax.Tsit5()))
    members = 1000 if quick else 100_000
    inputs = bodies(members)
    case = functools.partial(
        Case, "gradient of rigid bodies, equal steps", inputs=inputs, members=members
    )
    yield case("CF4", gradient(equal_steps(cfjax.CF4())))
    yield case("Tsit5", gradient(equal_steps(diffrax.Tsit5())))
    for name, num_saves in (("end", 1), ("21 times", 21)):
        for solver in (cfjax.CF54(), cfjax.RKMK8(), diffrax.Tsit5()):
            method = type(solver).__name__
            problem = f"rigid bodies, adaptive steps, {name}"
            yield Case(problem, method, controlled(solver, num_saves), inputs, members)

    side = 64 if quick else 1024
    magnet: Any = dict(num_steps=20, throw=False)
    for method, solver, on in (
        ("CF4", cfjax.CF4(), True),
        ("CF4, as traced", cfjax.CF4(), False),
        ("Tsit5", diffrax.Tsit5(), True),
    ):

        def run(y: Any, solver: Any = solver, on: bool = on) -> Any:
            equation = term(solver, spins.field, spins.velocity)
            with cfjax.rewriting(on):
                solution: Any = cfjax.integrate(
                    equation, solver, 0.0, 1.0, y, spins.Magnet(), **magnet
                )
            return solution.ys[-1]

        yield Case(f"{side} x {side} spins", method, run, spins.y0(side, side), 1)

    n = 64 if quick else 512
    reaction = cfjax.LieTerm(gray_scott.field)
    for solver, steps in ((cfjax.ETD54(), 20), (cfjax.CF4(), 40)):

        def react(y: Any, solver: Any = solver, steps: int = steps) -> Any:
            options: Any = dict(args=gray_scott.Reactor(), num_steps=steps, throw=False)
            solution: Any = cfjax.integrate(reaction, solver, 0.0, 100.0, y, **options)
            return solution.ys["v"][-1]

        method = f"{type(solver).__name__}, {steps} steps"
        yield Case(f"Gray and Scott's reaction, {n} x {n}", method, react, gray_scott.y0(n), 1)


def measure(quick: bool) -> Iterator[results.Row]:
    # An error where there is none.
    devices = [jax.devices("gpu")[0], jax.devices("cpu")[0]]
    for dtype in ("float64", "float32"):
        for case in cases(quick):
            inputs = jax.tree.map(lambda x: np.asarray(x, dtype), case.inputs)  # noqa: B023
            measured = [_time(case.run, inputs, device) for device in devices]
            (on_gpu, *_), (on_cpu, *_) = measured
            gaps = jax.tree.map(lambda a, b: np.max(np.abs(a - b), initial=0.0), on_gpu, on_cpu)
            for device, (_, seconds, compile_seconds) in zip(devices, measured, strict=True):
                yield {
                    "problem": case.problem,
                    "dtype": dtype,
                    "members": case.members,
                    "method": case.method,
                    "device": device.device_kind,
                    "seconds": results.spread(seconds),
                    "compile seconds": results.digits(compile_seconds),
                    "difference": results.digits(max(map(float, jax.tree.leaves(gaps)))),
                }


def _time(run: Callable[[Any], Any], inputs: Any, device: Any) -> tuple[Any, list[float], float]:
    inputs = jax.device_put(inputs, device)
    begin = time.perf_counter()
    program = jax.jit(run).lower(inputs).compile()
    compile_seconds = time.perf_counter() - begin
    output = jax.block_until_ready(program(inputs))
    seconds = []
    begin = time.perf_counter()
    while len(seconds) < 7 and (not seconds or time.perf_counter() - begin < 2):
        before = time.perf_counter()
        jax.block_until_ready(program(inputs))
        seconds.append(time.perf_counter() - before)
    return jax.tree.map(np.asarray, output), seconds, compile_seconds


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
