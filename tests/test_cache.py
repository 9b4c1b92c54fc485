"""What JAX keeps on disk for the next process: every program that calls nothing on the host."""

import collections
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import cfjax

SETTINGS = {
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
EVENTS = "compile_requests_use_cache", "cache_hits", "cache_misses"


def decay(t, y, args):
    return -y / args


def rotation(t, y, args):
    return cfjax.Rotation(-y / args)


def solves(field, solver):
    """Three results, and how many programs are asked for, found on disk, and missed there.

    Called from Python, errors are looked for on the host; in a program, with `throw=False`.
    """
    term, events = cfjax.LieTerm(field), collections.Counter()
    y0, args = np.array([0.6, 0.0, 0.8]), np.array([1.0, 2.0, 3.0])

    def count(name, **_):
        events[name.split("/")[-1]] += 1

    def solve(args, throw):
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, args, num_steps=12, throw=throw).ys[-1]

    def loss(args):
        return jnp.sum(solve(args, False))

    jax.monitoring.register_event_listener(count)
    try:
        numbers = [solve(args, True), solve(args, False), jax.jit(jax.grad(loss))(args)]
    finally:
        jax.monitoring.unregister_event_listener(count)
    return [np.asarray(x).tolist() for x in numbers], [events[name] for name in EVENTS]


def check(run):
    first, (requests, hits, misses) = run()
    assert hits == 0 and misses == requests > 0
    second, (requests, hits, misses) = run()
    assert misses == 0 and hits == requests > 0
    assert second == first


def test_what_is_on_disk_is_not_compiled_again(tmp_path):
    """In one process that forgets its programs."""

    def run():
        jax.clear_caches()
        return solves(decay, cfjax.LieEuler())

    changes = SETTINGS | {"jax_compilation_cache_dir": str(tmp_path)}
    before = {name: getattr(jax.config, name) for name in changes}
    try:
        for name, value in changes.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        check(run)
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()


@pytest.mark.slow
def test_the_second_process_compiles_nothing(tmp_path):
    settings = {name.upper(): str(value) for name, value in SETTINGS.items()}

    def run():
        done = subprocess.run(
            [sys.executable, __file__],
            capture_output=True,
            text=True,
            env=os.environ | settings | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)},
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    check(run)


if __name__ == "__main__":
    print(json.dumps(solves(rotation, cfjax.RKMK5())))
