"""Programs over a mesh of four devices, against the same on one: in a process whose CPU is four."""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

import cfjax

STARTS = np.random.default_rng(4).standard_normal((8, 3))
STARTS /= np.linalg.norm(STARTS, axis=1)[:, None]
KINDS = "explicit", "shard_map"


def differences(
    kinds: Iterable[str], programs: Iterable[tuple[str, Callable, bool]]
) -> dict[str, float | str]:
    """By name and kind, how far values on a mesh are from those on one device, or an error.

    `programs` are names, functions of a batch, and whether these may be rewritten.
    """
    mesh = jax.make_mesh((4,), ("i",))
    starts = jax.device_put(STARTS, NamedSharding(mesh, P("i")))
    found: dict[str, float | str] = {}
    for name, fun, is_on in programs:
        with cfjax.rewriting(is_on):
            expected = np.asarray(jax.jit(fun)(STARTS))
            for kind in kinds:
                place, spread = f"{name}, {kind}", fun
                if kind == "shard_map":
                    spread = jax.shard_map(fun, mesh=mesh, in_specs=P("i"), out_specs=P("i"))
                with jax.set_mesh(mesh) if kind == "explicit" else contextlib.nullcontext():
                    try:
                        value = jax.jit(spread)(starts)
                    except Exception as error:
                        found[place] = repr(error)
                    else:
                        assert value.sharding.spec[0] == "i"
                        found[place] = float(np.abs(np.asarray(value) - expected).max())
    return found


def check(file: str, names: list[str], *arguments: str) -> None:
    """Runs a file that calls `show` for programs with these names, and looks at what it shows."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"
    paths = filter(None, [str(Path(__file__).parent), os.environ.get("PYTHONPATH")])
    changes = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, file, *arguments]
    done = subprocess.run(command, env=os.environ | changes, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert list(found) == names
    # The same operations, which may be fused otherwise: some hundred roundings of numbers below 10.
    wrong = {name: x for name, x in found.items() if isinstance(x, str) or x > 1e-13}
    assert not wrong


def show(kind: str, programs: Iterable[tuple[str, Callable, bool]]) -> None:
    """Prints the differences of a kind, or of "both"."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_disable_most_optimizations", True)
    found = differences(KINDS if kind == "both" else [kind], programs)
    print(json.dumps(found))
