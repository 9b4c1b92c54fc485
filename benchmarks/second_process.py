"""Time of a second process, whose programs JAX has cached on disk, from its start to the result.

A process that is not measured fills JAX's compilation cache, in a folder for each program. What is
left is to import, to trace, to lower and to read the program. `EQX_ON_ERROR=nan` is set, as JAX
keeps no program that calls the host. The problem is the rigid body; diffrax's Tsit5 solves it in
plain space, in a process that does not import cfjax. Processes take turns.
"""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fresh_process

if TYPE_CHECKING:
    import results

PROGRAMS = ("integrate", "its gradient", "diffeqsolve")
METHODS = ("Tsit5", "CF4", "CF54", "RKMK5", "RKMK8")
STEPS = 50


def solve(program: str, method: str, folder: str) -> None:
    """The whole solve, imports included."""
    os.environ["EQX_ON_ERROR"] = "nan"
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    inertia, y0 = jnp.array([7 / 8, 5 / 8, 1 / 4]), jnp.array([8 / 9, 4 / 9, 1 / 9])
    options: dict[str, Any] = dict(throw=False)
    if method == "Tsit5":
        term: Any = diffrax.ODETerm(lambda t, y, args: jnp.cross(-y / inertia, y))
        solver, integrate = diffrax.Tsit5(), diffrax.diffeqsolve
    else:
        import cfjax

        term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(-y / inertia))
        solver, integrate = getattr(cfjax, method)(), cfjax.integrate
    if integrate is diffrax.diffeqsolve or program == "diffeqsolve":
        integrate, options = diffrax.diffeqsolve, dict(options, dt0=1 / STEPS)
    else:
        options["num_steps"] = STEPS

    def final_state(y0: Any) -> Any:
        return integrate(term, solver, t0=0.0, t1=1.0, y0=y0, **options).ys

    gradient = jax.grad(lambda y0: jnp.sum(final_state(y0) ** 3))
    jax.block_until_ready(jax.jit(gradient if program == "its gradient" else final_state)(y0))


def measure(quick: bool) -> "Iterator[results.Row]":
    import results

    with tempfile.TemporaryDirectory() as cache:
        for program in PROGRAMS:

            def second(method: str, program: str = program) -> tuple[float, float]:
                folder = str(Path(cache, program, method))
                return fresh_process.seconds(__file__, program, method, folder)

            for method in METHODS:
                second(method)
            turns = [[second(m) for m in METHODS] for _ in range(2 if quick else 5)]
            base = [turn[0][0] for turn in turns]
            for k, method in enumerate(METHODS):
                seconds = [turn[k][0] for turn in turns]
                yield {
                    "program": program,
                    "method": method,
                    "CPU seconds": results.spread(seconds),
                    "seconds": results.spread(turn[k][1] for turn in turns),
                    "over Tsit5": results.ratios(seconds, base),
                }


if __name__ == "__main__":
    fresh_process.run(__file__, __doc__, measure, solve)
