"""Batches that are spread over the devices of a mesh: explicitly, and by `jax.shard_map`."""

import contextlib
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

import cfjax
from cfjax._xla.materialise import materialised
from cfjax._xla.pack import pack, unpack

ARGS = np.array([0.9, 0.6, 0.3])
STARTS = np.random.default_rng(4).standard_normal((8, 3))
STARTS /= np.linalg.norm(STARTS, axis=1)[:, None]


def rotation(t, y, args):
    return cfjax.Rotation(-y / args)


def affine(t, y, args):
    # A spectrum that is made anew is compared with the others, in each step.
    return cfjax.Affine(1.0, -(y**3), -jnp.square(args), cfjax.SineTransform())


def sphere(t, y, args):
    return cfjax.SphereRotation(args * y)


# Of the kinds of loops and checks: stages written out, in a loop, of one point.
SOLVES = {
    "CF4": (rotation, cfjax.CF4()),
    "RKMK4": (rotation, cfjax.RKMK4()),
    "BWRRK53": (sphere, cfjax.BWRRK53()),
    "Affine": (affine, cfjax.CF4()),
}


def of(name):
    field, solver = SOLVES[name]

    def end(y0):
        term = cfjax.LieTerm(field)
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, jnp.asarray(ARGS), num_steps=3).ys[-1]

    return jax.vmap(end)


def gradient(ys):
    return jax.grad(lambda y: jnp.sum(jnp.sin(of("CF4")(y))))(ys)


def packed(ys):
    def one(y):
        entries = unpack(y)
        # Of an entry of the batch, and one that all have.
        whole = pack([*entries, jnp.asarray(2.0)])
        along = materialised([whole, *entries], in_batches=True)
        return jnp.sum(along[0]) * pack(along[1:], sums=True)

    return jax.vmap(one)(ys) + jax.grad(lambda ys: jnp.sum(jax.vmap(one)(ys) ** 2))(ys)


FUNCTIONS = {**{name: of(name) for name in SOLVES}, "gradient": gradient, "packed": packed}

# Programs that are rewritten on one device, and those that are quick.
REWRITTEN = "CF4", "gradient"
QUICK = "CF4", "packed"


def programs(some):
    """Names, functions, and whether these may be rewritten."""
    cases = [
        *((name, fun, False) for name, fun in FUNCTIONS.items()),
        *((f"{name}, rewritten", FUNCTIONS[name], True) for name in REWRITTEN),
    ]
    return [case for case in cases if some == "all" or case[0].split(",")[0] in QUICK]


def differences(kind, some):
    """By name, how far the values on a mesh are from those on one device, or an error."""
    mesh = jax.make_mesh((4,), ("i",))
    starts = jax.device_put(STARTS, NamedSharding(mesh, P("i")))
    found = {}
    for name, fun, is_on in programs(some):
        with cfjax.rewriting(is_on):
            expected = jax.jit(fun)(STARTS)
            spread = fun
            if kind == "shard_map":
                spread = jax.shard_map(fun, mesh=mesh, in_specs=P("i"), out_specs=P("i"))
            with jax.set_mesh(mesh) if kind == "explicit" else contextlib.nullcontext():
                try:
                    value = jax.jit(spread)(starts)
                except Exception as error:
                    found[name] = repr(error)
                else:
                    assert value.sharding.spec[0] == "i"
                    found[name] = float(np.abs(np.asarray(value) - np.asarray(expected)).max())
    return found


@pytest.mark.parametrize("some", ["quick", pytest.param("all", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["explicit", "shard_map"])
def test_a_batch_on_a_mesh_is_that_on_one_device(kind, some):
    """In a process of its own, whose CPU is four devices."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"
    done = subprocess.run(
        [sys.executable, __file__, kind, some],
        env={**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert list(found) == [name for name, *_ in programs(some)]
    # The same operations, which may be fused otherwise: some hundred roundings of numbers below 10.
    wrong = {name: x for name, x in found.items() if isinstance(x, str) or x > 1e-13}
    assert not wrong


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_disable_most_optimizations", True)
    print(json.dumps(differences(*sys.argv[1:])))
