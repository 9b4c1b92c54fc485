"""Batches that are spread over the devices of a mesh: explicitly, and by `jax.shard_map`."""

import sys

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

import cfjax

ARGS = np.array([0.9, 0.6, 0.3])


def rotation(t, y, args):
    return cfjax.Rotation(-y / args)


def affine(t, y, args):
    # A spectrum that is made anew is compared with the others, in each step.
    return cfjax.Affine(-(y**3), -jnp.square(args), cfjax.SineTransform())


def sphere(t, y, args):
    return cfjax.SphereRotation(args * y)


# A solve for each kind of loops and checks: stages written out, in a loop, of one point.
SOLVES = {
    "CF2": (rotation, cfjax.CF2()),
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
    return jax.grad(lambda y: jnp.sum(jnp.sin(of("CF2")(y))))(ys)


FUNCTIONS = {**{name: of(name) for name in SOLVES}, "gradient": gradient}

# Programs that are rewritten on one device. The first of them is quick.
REWRITTEN = "CF2", "gradient"


def programs(some):
    """Names, functions, and whether these may be rewritten."""
    rewritten = [(f"{name}, rewritten", FUNCTIONS[name], True) for name in REWRITTEN]
    if some == "quick":
        return rewritten[:1]
    return [*((name, fun, False) for name, fun in FUNCTIONS.items()), *rewritten]


@pytest.mark.parametrize("some", ["quick", pytest.param("all", marks=pytest.mark.slow)])
def test_a_batch_on_a_mesh_is_that_on_one_device(some):
    names = [f"{name}, {kind}" for name, *_ in programs(some) for kind in meshes.KINDS]
    meshes.check(__file__, names, "both", some)


if __name__ == "__main__":
    kind, some = sys.argv[1:]
    meshes.show(kind, programs(some))
