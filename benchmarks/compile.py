"""Time to compile typical programs, relative to a method of diffrax in plain space.

It measures processor time to trace, lower and compile, which other work on the machine disturbs
less than wall time, and the instructions of optimised HLO, for the programs and scenes of
`compile_programs.py`. Methods take turns. Then it measures second derivatives.

`tests/xla/test_sizes.py` holds the instructions to what is stored here.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax.scenes import rigid_body
from compile_programs import SCENES, Scene, lowered, size


def second_derivative(name: str) -> Callable[[Any], Any]:
    def loss(inertia):
        term = cfjax.LieTerm(rigid_body.field)
        y0 = jnp.asarray(rigid_body.y0)
        ys = cfjax.integrate(term, cfjax.CF4(), 0.0, 10.0, y0, inertia, num_steps=100).ys
        return jnp.asarray(ys)[-1] @ jnp.array([1.0, 2.0, 3.0])

    gradient = jax.grad(loss)
    product = lambda inertia: jax.jvp(gradient, (inertia,), (jnp.ones(3),))[1]  # noqa: E731
    return {"gradient": gradient, "product": product, "Hessian": jax.hessian(loss)}[name]


def measure(quick: bool) -> Iterator[results.Row]:
    repeats = 1 if quick else 2
    # Warm-up: the first program pays for what all of them share.
    compiled(SCENES["rigid body"](), "gradient", "Tsit5")
    for name, make in [*SCENES.items()][: 1 if quick else None]:
        scene = make()
        methods = [scene.base, *scene.methods]
        for program in scene.programs:
            compilations = [[compiled(scene, program, m) for m in methods] for _ in range(repeats)]
            times = np.array([[seconds for seconds, _ in turn] for turn in compilations]).T
            sizes = [size for _, size in compilations[0]]
            for method, seconds, number in zip(methods, times, sizes, strict=True):
                yield {
                    "scene": name,
                    "program": program,
                    "method": method,
                    "CPU seconds": results.spread(seconds),
                    "over": scene.base,
                    "seconds, ratio": results.ratios(seconds, times[0]),
                    "instructions": number,
                    "instructions, ratio": number / sizes[0],
                }
    for name in ("gradient", "product", "Hessian"):
        seconds = [seconds_of(second_derivative(name)) for _ in range(repeats)]
        yield {"derivative": name, "CPU seconds": results.spread(seconds)}


def compiled(scene: Scene, program: str, method: str) -> tuple[float, int]:
    """Seconds of the processor, and instructions."""
    begin = time.process_time()
    executable = lowered(scene, program, method).compile()
    return time.process_time() - begin, size(executable)


def seconds_of(fun: Callable[[Any], Any]) -> float:
    """Seconds of the processor, for a new function each time, as jax caches programs."""
    begin = time.process_time()
    jax.jit(fun).lower(jnp.asarray(rigid_body.inertia)).compile()
    return time.process_time() - begin


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
