"""The cost of a gradient relative to its solve: CF4 and Tsit5, alone and in a batch.

The gradient of one number is with respect to the initial value. A solve and its gradient take
turns.
"""

from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import rigid_body

STEPS, END, BATCH = 100, 10.0, 1000
REPEATS = {1: 50, BATCH: 1}  # of a program in one turn, by the number of systems
INERTIA = rigid_body.inertia


def driven(t, attitude, args):
    return cfjax.Rotation(attitude @ jnp.stack([jnp.cos(t), jnp.ones_like(t), jnp.sin(t)]))


def body(t, state, args):
    omega = state["momentum"] / INERTIA
    return {
        "attitude": cfjax.Rotation(state["attitude"] @ omega),
        "momentum": cfjax.Rotation(-omega),
    }


STATES: dict[str, tuple[Callable[..., Any], Any]] = {
    "vector": (lambda t, y, args: rigid_body.field(t, y, INERTIA), rigid_body.y0),
    "attitude": (driven, np.eye(3)),
    "attitude and momentum": (body, {"attitude": np.eye(3), "momentum": rigid_body.y0}),
}


def in_space(field: Callable[..., Any]) -> diffrax.ODETerm:
    return diffrax.ODETerm(lambda t, y, args: cfjax.tangent(field(t, y, args), y))


def by_cfjax(field: Callable[..., Any], solver: diffrax.AbstractSolver, y0: Any) -> Any:
    return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, END, y0, num_steps=STEPS)


def by_diffrax(term: Any, solver: diffrax.AbstractSolver, y0: Any) -> Any:
    # Rounding of the times may make a step more.
    return diffrax.diffeqsolve(term, solver, 0.0, END, END / STEPS, y0, max_steps=STEPS + 1)


PROGRAMS: dict[str, Callable[[Callable[..., Any], Any], Any]] = {
    "cfjax.integrate, CF4": lambda field, y0: by_cfjax(field, cfjax.CF4(), y0),
    "cfjax.integrate, Projected(Tsit5)": lambda field, y0: by_cfjax(
        field, cfjax.Projected(diffrax.Tsit5()), y0
    ),
    "diffrax, CF4": lambda field, y0: by_diffrax(cfjax.LieTerm(field), cfjax.CF4(), y0),
    "diffrax, CF4(estimate=None)": lambda field, y0: by_diffrax(
        cfjax.LieTerm(field), cfjax.CF4(estimate=None), y0
    ),
    "diffrax, Tsit5": lambda field, y0: by_diffrax(in_space(field), diffrax.Tsit5(), y0),
}


def measure(quick: bool) -> Iterator[results.Row]:
    for state in [*STATES][: 1 if quick else None]:
        field, y0 = STATES[state]
        for systems in REPEATS:
            y0s = many(y0, systems)
            for name, solve in PROGRAMS.items():

                def value(y0, solve=solve, field=field):
                    leaves = jax.tree.leaves(solve(field, y0).ys)
                    return jnp.sum(jnp.stack([jnp.sum(jnp.sin(ys[-1])) for ys in leaves]))

                programs = [value, jax.grad(value)]
                if systems > 1:
                    programs = [jax.vmap(program) for program in programs]
                repeats = REPEATS[systems]
                runs = [results.compiled(p, y0s, repeats=repeats) for p in programs]
                solves, gradients = take_turns(runs, repeats=3 if quick else 25)
                work = STEPS * systems * repeats
                yield {
                    "state": state,
                    "program": name,
                    "systems": systems,
                    "solve, seconds a step": results.spread(solves / work),
                    "gradient, seconds a step": results.spread(gradients / work),
                    "gradient over solve": results.ratios(gradients, solves),
                }


def many(y0: Any, systems: int) -> Any:
    shape = (systems,) * (systems > 1)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, shape + x.shape), y0)


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
