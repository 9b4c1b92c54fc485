"""Exponentials against `jax.scipy.linalg.expm`: time in a loop, with gradients, and compile time.

The dense `expm` for several sizes, the flow of a matrix field on one vector, and the closed form
for rotations of space against the dense exponential of the 3 x 3 matrix.

Both are timed in turns in one process, so the ratios carry over to other machines and the times do
not.
"""

import itertools
import time
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax._numerics.expm import expm
from cfjax._numerics.rotate import rotate

SIZES = (3, 8, 32)
BATCHES = (1, 1000)
NORMS = (0.1, 0.5, 3.0)
FLOPS = 2e7  # Products per timed call, n³·batch·steps: some 10 to 100 milliseconds.


def matrices(n: int, batch: int, norm: float) -> tuple[Array, Array]:
    """Skew matrices with ‖a²‖^½ up to `norm`, and vectors."""
    rng = np.random.default_rng(n)
    a = rng.normal(size=(batch, n, n))
    a = a - a.transpose(0, 2, 1)
    size = np.sqrt(np.linalg.norm(a @ a, 1, axis=(1, 2)))
    a = a / size[:, None, None] * norm * rng.uniform(0.8, 1.0, size=(batch, 1, 1))
    return jnp.asarray(a), jnp.asarray(rng.normal(size=(batch, n)))


def apply_ours(a: Array, v: Array) -> Array:
    return expm(a) @ v


def apply_theirs(a: Array, v: Array) -> Array:
    return jax.scipy.linalg.expm(a) @ v


def flow_ours(a: Array, v: Array) -> Array:
    return cfjax.LeftMatrix(a).flow(v)


def rotate_ours(a: Array, v: Array) -> Array:
    return rotate(jnp.array([a[2, 1], a[0, 2], a[1, 0]]), v)


PROGRAMS = (
    ("rotate", rotate_ours, (3,)),
    ("expm", apply_ours, SIZES),
    ("flow", flow_ours, SIZES[1:]),
)


def loop(action: Callable[[Array, Array], Array], steps: int, gradient: bool) -> jax.stages.Wrapped:
    """A batch of loops that multiply a vector with an exponential which changes every step."""

    def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        a, v = carry
        return (a * (1 - 1e-9), action(a, v)), None

    def run(a: Array, v: Array) -> Array:
        body = jax.checkpoint(step) if gradient else step
        return jnp.sum(lax.scan(body, (a, v), None, length=steps)[0][1])

    return jax.jit(jax.vmap(jax.grad(run) if gradient else run))


def compare(
    ours: Callable[[Array, Array], Array],
    n: int,
    batch: int,
    norm: float,
    gradient: bool,
    repeats: int,
) -> results.Row:
    """Our times, and how many times longer theirs are."""
    a, v = matrices(n, batch, norm)
    steps = max(10, min(1000, int(FLOPS / (n**3 * batch) / (10 if gradient else 3))))
    programs, compiling = [], []
    for action in (ours, apply_theirs):
        lowered = loop(action, steps, gradient).lower(a, v)
        start = time.perf_counter()
        executable = lowered.compile()
        compiling.append(results.digits(time.perf_counter() - start))
        programs.append(lambda executable=executable: executable(a, v))
        jax.block_until_ready(programs[-1]())  # warm-up
    seconds, theirs = take_turns(programs, repeats=repeats)
    return {
        "seconds": results.spread(seconds / steps / batch),
        "times faster": results.ratios(theirs, seconds),
        "compile": compiling[0],
        "compile theirs": compiling[1],
    }


def measure(quick: bool) -> Iterator[results.Row]:
    for gradient in (False, True):
        for name, ours, sizes in PROGRAMS:
            norms = NORMS[:1] if quick else NORMS
            cases = itertools.product(sizes[: 1 if quick else None], BATCHES, norms)
            for n, batch, norm in cases:
                row = {"program": name, "n": n, "batch": batch, "norm": norm, "gradient": gradient}
                yield row | compare(ours, n, batch, norm, gradient, 3 if quick else 15)


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
