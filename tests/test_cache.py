"""What JAX keeps on disk for the next process: every program that calls nothing on the host."""

import ast
import os
import subprocess
import sys

import pytest

PROGRAMS = """
import collections
import jax, jax.numpy as jnp, numpy as np
import cfjax

events = collections.Counter()
jax.monitoring.register_event_listener(lambda name, **_: events.update([name.split("/")[-1]]))
term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(-y / args))
solver, y0, args = cfjax.{solver}(), np.array([0.6, 0.0, 0.8]), np.array([1.0, 2.0, 3.0])

def solve(args, throw):
    return cfjax.integrate(term, solver, 0.0, 1.0, y0, args, num_steps=12, throw=throw).ys[-1]

def loss(args):
    return jnp.sum(solve(args, False))

numbers = [solve(args, True), solve(args, False), jax.jit(jax.grad(loss))(args)]
names = "compile_requests_use_cache", "cache_hits", "cache_misses"
print([[float(x) for x in y] for y in numbers], [events[name] for name in names], sep="\\n")
"""


@pytest.mark.parametrize("solver", ["LieEuler", pytest.param("RKMK5", marks=pytest.mark.slow)])
def test_the_second_process_compiles_nothing(solver, tmp_path):
    """Called from Python, errors are looked for on the host; in a program, with `throw=False`."""
    settings = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        # As in these tests.
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }

    def run():
        program = [sys.executable, "-c", PROGRAMS.replace("{solver}", solver)]
        done = subprocess.run(program, capture_output=True, text=True, env=os.environ | settings)
        assert done.returncode == 0, done.stderr
        numbers, counts = map(ast.literal_eval, done.stdout.splitlines())
        return numbers, counts

    first, (requests, hits, misses) = run()
    assert hits == 0 and misses == requests > 0
    second, (requests, hits, misses) = run()
    assert misses == 0 and hits == requests > 0
    assert second == first
