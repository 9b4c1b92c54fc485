"""What rewriting gains and costs, over all kinds of states, methods and programs.

Each program is lowered as it is by default, and as it was traced (`cfjax.rewriting(False)`). Where
both are the same there is nothing to measure. Else the two are compiled, and take turns. A ratio
above 1 is a loss, in the time of a run or in the processor time to trace, lower and compile.
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

STEPS, MEMBERS = 50, 200
H = 0.1
INERTIA = jnp.asarray(np.array([3.0, 2.0, 1.0]))
LAYOUT: dict[str, Any] = dict(frame="body", layout="wxyz")


class State(NamedTuple):
    field: Callable[..., Any]
    start: Any


def rate(t: Any, y: Any, inertia: Any) -> Any:
    return jnp.stack([jnp.cos(2 * t), jnp.sin(3 * t), 1 + jnp.cos(t)]) / inertia * (1 + y[-1] / 9)


def craft(t: Any, y: Any, inertia: Any) -> Any:
    omega = y["m"] / inertia
    return {"q": cfjax.QuaternionRotation(omega, **LAYOUT), "m": cfjax.Rotation(-omega)}


def matrix(t: Any, y: Any, inertia: Any) -> Any:
    a = jnp.outer(jnp.sin(t + jnp.arange(4.0)), y[0]) * inertia[0]
    return cfjax.LeftMatrix(a - a.T)


def lattice(t: Any, y: Any, inertia: Any) -> Any:
    return cfjax.Rotation(sum(jnp.roll(y, s, k) for s in (1, -1) for k in (0, 1)) / inertia)


def states() -> dict[str, State]:
    unit = jnp.asarray([1.0, 0.0, 0.0, 0.0])
    grid = np.stack(np.meshgrid(np.arange(16.0), np.arange(16.0), [0.0, 1.0, 2.0]), -1).sum(-1)
    return {
        "vector": State(lambda t, y, a: cfjax.Rotation(-y / a), jnp.asarray([1.0, 2.0, 0.5])),
        "quaternion": State(
            lambda t, q, a: cfjax.QuaternionRotation(rate(t, q, a), **LAYOUT), unit
        ),
        "pose": State(
            lambda t, y, a: cfjax.RigidMotion(
                omega=rate(t, y, a), v=jnp.sin(y[4:]), frame="body", layout="wxyz_xyz"
            ),
            jnp.append(unit, jnp.asarray([0.1, 0.2, 0.3])),
        ),
        "extended pose": State(
            lambda t, y, a: cfjax.ExtendedMotion(
                omega=rate(t, y, a),
                a=jnp.sin(y[4:7]),
                v=y[7:] / 9,
                frame="body",
                layout="wxyz_v_p",
            ),
            jnp.append(unit, jnp.asarray([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])),
        ),
        "dict": State(craft, {"q": unit, "m": jnp.asarray([1.0, 2.0, 0.5])}),
        "matrix": State(matrix, jnp.eye(4)),
        "lattice": State(lattice, jnp.asarray(np.sin(grid))),
    }


METHODS: dict[str, Callable[[], diffrax.AbstractSolver]] = {
    "CF4": cfjax.CF4,
    "CF54": cfjax.CF54,
    "RKMK8": cfjax.RKMK8,
    "Projected, Tsit5": lambda: cfjax.Projected(diffrax.Tsit5()),
    "Projected, Dopri8": lambda: cfjax.Projected(diffrax.Dopri8()),
}


def integrate(state: State, solver: Any, _: Any) -> Callable[..., Any]:
    term, options = cfjax.LieTerm(state.field), {"num_steps": STEPS, "throw": False}
    return lambda y, a: cfjax.integrate(term, solver, 0.0, STEPS * H, y, a, **options).ys


def diffeqsolve(state: State, solver: Any, adjoint: Any) -> Callable[..., Any]:
    term = cfjax.LieTerm(state.field)
    options = {"max_steps": STEPS, "throw": False, "adjoint": adjoint}
    return lambda y, a: diffrax.diffeqsolve(term, solver, 0.0, STEPS * H, H, y, a, **options).ys


DRIVERS = {"integrate": integrate, "diffeqsolve": diffeqsolve}


def loss(solve: Callable[..., Any]) -> Callable[..., Any]:
    return lambda y, a: sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(solve(y, a)))


def batch(solve: Callable[..., Any]) -> Callable[..., Any]:
    def of_members(y: Any, a: Any) -> Any:
        ys = jax.tree.map(lambda x: jnp.stack([x] * MEMBERS), y)
        return jax.vmap(solve, (0, None))(ys, a)

    return of_members


# Each with the adjoint that diffrax needs for it.
REVERSE = diffrax.RecursiveCheckpointAdjoint()
PROGRAMS: dict[str, tuple[Callable[..., Any], Any]] = {
    "value": (lambda solve: solve, REVERSE),
    "gradient": (lambda solve: jax.grad(loss(solve), (0, 1)), REVERSE),
    "jacfwd": (jax.jacfwd, diffrax.ForwardMode()),
    "jacrev": (jax.jacrev, REVERSE),
    "Hessian": (lambda solve: jax.hessian(loss(solve)), diffrax.DirectAdjoint()),
    "batch": (batch, REVERSE),
    "gradients of a batch": (lambda solve: batch(jax.grad(loss(solve), (0, 1))), REVERSE),
}
# A derivative by each of its 768 numbers would measure memory.
LEFT_OUT = {("lattice", name) for name in ("jacfwd", "jacrev", "Hessian")}


WAYS = {"by default": True, "as traced": False}


def measure(quick: bool, only: tuple[str, ...] = ()) -> Iterator[results.Row]:
    budget = 0.2 if quick else 2.0
    for state_name, state in states().items():
        if only and state_name not in only:
            continue
        for method, make in METHODS.items():
            for driver, drive in DRIVERS.items():
                for program, (transform, adjoint) in PROGRAMS.items():
                    if (state_name, program) in LEFT_OUT:
                        continue
                    fun = transform(drive(state, make(), adjoint))
                    where = {"problem": state_name, "method": method}
                    where |= {"driver": driver, "program": program}
                    yield where | _compared(fun, state.start, budget)


def _compared(fun: Callable[..., Any], y: Any, budget: float) -> results.Row:
    lowered, waits, compiled = {}, {}, {}
    for way, on in WAYS.items():
        with cfjax.rewriting(on):
            begin = time.process_time()
            lowered[way] = jax.jit(lambda y, a: fun(y, a)).lower(y, INERTIA)
            waits[way] = time.process_time() - begin
    if len({x.as_text() for x in lowered.values()}) == 1:
        return {"is rewritten": False}
    for way, program in lowered.items():
        begin = time.process_time()
        compiled[way] = functools.partial(program.compile(), y, INERTIA)
        waits[way] += time.process_time() - begin
    seconds = results.in_turns(compiled, repeats=200, budget=budget)
    ours, base = seconds["by default"], seconds["as traced"]
    over = waits["by default"] / waits["as traced"]
    return {
        "is rewritten": True,
        "seconds": results.spread(ours),
        "over as traced": results.ratios(ours, base),
        "compile seconds": results.digits(waits["by default"]),
        "compiling over as traced": results.digits(over),
    }


if __name__ == "__main__":
    results.run(__file__, __doc__, measure, list(states()))
