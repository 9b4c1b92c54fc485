"""The gradient of a fit to data at every step: time to compile and to run.

`cfjax.integrate` makes equal steps and saves the state after each step (or each fifth step). The
loss is the sum of cubes of all saved numbers, and the derivative is with respect to the start and
the moments of inertia. It measures the processor time to trace, lower and compile, in one run, and
the time of a gradient. Programs of one row take turns.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import rigid_body

STEPS, STEP = 200, 0.05
REPEATS = 10  # of a program in one turn


def craft(t, y, inertia):
    omega = y["m"] / inertia
    return {
        "q": cfjax.QuaternionRotation(omega, frame="body", layout="wxyz"),
        "m": cfjax.Rotation(-omega),
    }


PROBLEMS: dict[str, tuple[Callable[..., Any], Any, Any]] = {
    "rigid body": (rigid_body.field, rigid_body.y0, rigid_body.inertia),
    "spacecraft": (
        craft,
        {"q": jnp.array([1.0, 0.0, 0.0, 0.0]), "m": jnp.array([0.05, 1.0, 0.0])},
        jnp.array([3.0, 2.0, 1.0]),
    ),
}
SOLVERS = {
    "CF4": cfjax.CF4(),
    "CF43": cfjax.CF43(),
    "CF54": cfjax.CF54(),
    "RKMK5": cfjax.RKMK5(),
    "RKMK8": cfjax.RKMK8(),
    "Projected(Dopri8)": cfjax.Projected(diffrax.Dopri8()),
}
# How often the state is saved.
FORMS = {"every step": 1, "every fifth": 5}


def fit(field: Any, solver: Any, save_every: int) -> Callable[[Any, Any], Any]:
    def loss(y0: Any, inertia: Any) -> Any:
        solution = cfjax.integrate(
            cfjax.LieTerm(field),
            solver,
            0.0,
            STEPS * STEP,
            y0,
            inertia,
            num_steps=STEPS,
            save_every=save_every,
        )
        return sum(jnp.sum(ys**3) for ys in jax.tree.leaves(solution.ys))

    return jax.value_and_grad(loss, argnums=(0, 1))


def measure(quick: bool) -> Iterator[results.Row]:
    for problem in [*PROBLEMS][: 1 if quick else None]:
        field, *args = PROBLEMS[problem]
        args = jax.tree.map(jnp.asarray, args)
        for name, solver in SOLVERS.items():
            runs, seconds = [], {}
            for form, save_every in FORMS.items():
                begin = time.process_time()
                run = results.compiled(fit(field, solver, save_every), *args, repeats=REPEATS)
                seconds[form] = time.process_time() - begin
                runs.append(run)
            times = take_turns(runs, repeats=5 if quick else 25) / REPEATS
            base = times[list(FORMS).index("every fifth")]
            for form, gradient_seconds in zip(FORMS, times, strict=True):
                yield {
                    "problem": problem,
                    "solver": name,
                    "saved": form,
                    "compile, seconds": results.digits(seconds[form]),
                    "gradient, seconds": results.spread(gradient_seconds),
                    "over every fifth": results.ratios(gradient_seconds, base),
                }


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
