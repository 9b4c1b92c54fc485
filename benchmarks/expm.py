"""Exponentials against `jax.scipy.linalg.expm`: time in a loop, with gradients, and compile time.

The dense `expm` for several sizes, the flow of a matrix field on one vector, and the closed form
for rotations of space against the dense exponential of the 3 x 3 matrix.

Run `python benchmarks/expm.py`. Both are timed in turns in one process, so the ratios carry over to
other machines and the times do not.
"""

import itertools
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from rich.console import Console
from rich.table import Table

import cfjax
from cfjax._numerics.expm import expm
from cfjax._numerics.rotate import rotate

SIZES = (3, 8, 32)
BATCHES = (1, 100, 1000)
NORMS = (0.1, 0.5, 3.0)
REPEATS = 7
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
    name: str,
    ours: Callable[[Array, Array], Array],
    n: int,
    batch: int,
    norm: float,
    gradient: bool,
) -> list[str]:
    """One row of the table for the exponential `ours`."""
    a, v = matrices(n, batch, norm)
    steps = max(10, min(1000, int(FLOPS / (n**3 * batch) / (10 if gradient else 3))))
    programs, compiling, times = [], [], ([], [])
    for action in (ours, apply_theirs):
        lowered = loop(action, steps, gradient).lower(a, v)
        start = time.perf_counter()
        programs.append(lowered.compile())
        compiling.append(time.perf_counter() - start)
    for repeat in range(REPEATS + 1):
        for program, taken in zip(programs, times, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(program(a, v))
            if repeat > 0:  # The first call warms up.
                taken.append(time.perf_counter() - start)
    ratios = [t / o for o, t in zip(*times, strict=True)]
    return [
        "gradient" if gradient else "forward",
        name,
        *(str(x) for x in (n, batch, norm)),
        f"{statistics.median(times[0]) / steps / batch * 1e6:.2f}",
        f"{statistics.median(ratios):.1f}",
        f"{min(ratios):.1f} to {max(ratios):.1f}",
        f"{compiling[0]:.2f} / {compiling[1]:.2f}",
    ]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    table = Table(title="Exponentials against jax.scipy.linalg.expm, float64")
    columns = ("", "ours", "n", "batch", "norm", "µs each", "times faster", "spread", "compile, s")
    for column in columns:
        table.add_column(column, justify="right")
    for gradient in (False, True):
        for name, ours, sizes in PROGRAMS:
            for n, batch, norm in itertools.product(sizes, BATCHES, NORMS):
                table.add_row(*compare(name, ours, n, batch, norm, gradient))
        table.add_section()
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
