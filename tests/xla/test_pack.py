"""`pack` and `unpack`: the numbers of `jnp.stack` under every transformation."""

import sys

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

from cfjax._xla.materialise import materialised
from cfjax._xla.pack import pack, unpack

RNG = np.random.default_rng(0)


@pytest.mark.representatives(10)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.complex128, np.int32, np.bool_])
@pytest.mark.parametrize("count", [1, 4, 11])
def test_pack_is_stack_and_unpack_its_inverse(axis, dtype, count):
    entries = [jnp.asarray(RNG.normal(size=(2, 5)) * 3, dtype) for _ in range(count)]
    for run in (pack, jax.jit(pack, static_argnums=1)):
        whole = run(entries, axis)
        assert whole.dtype == dtype
        np.testing.assert_array_equal(whole, np.stack(entries, axis))
    for entry, found in zip(entries, unpack(whole, axis), strict=True):
        np.testing.assert_array_equal(found, entry)


def weighted(stack):
    """A function whose derivatives differ from entry to entry. One entry is never used."""

    def fun(x, y):
        a, b, c = y if stack is jnp.stack else unpack(y)
        whole = stack([x * a, jnp.sin(b * x), x * x, c * a, x])
        return jnp.sum(jnp.exp(whole[1:4] / 2) * whole[:3])

    return fun


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    "transform",
    [
        jax.grad,
        lambda f: jax.grad(f, 1),
        lambda f: lambda x, y: jax.jvp(f, (x, y), (x + 1, y * y)),
        lambda f: lambda x, y: jax.jvp(lambda x: f(x, y), (x,), (x + 1,)),
        lambda f: jax.hessian(f, 1),
        lambda f: jax.grad(lambda x, y: jnp.sum(jax.grad(f, 1)(x, y) ** 2)),
        lambda f: lambda x, y: jax.vmap(jax.grad(f), (None, 0))(x, jnp.stack([y, y * y])),
        lambda f: lambda x, y: jax.vmap(f, (0, 1), 0)(y[:2], jnp.stack([y, y * y], 1)),
        lambda f: jax.grad(lambda x, y: jnp.sum(jax.vmap(f, (0, None))(x * y, y))),
    ],
    ids=[
        "grad",
        "grad 1",
        "jvp",
        "jvp of one",
        "hessian",
        "reverse twice",
        "grad in vmap",
        "vmap of both",
        "vmap in grad",
    ],
)
@pytest.mark.parametrize(
    "stack",
    [
        pack,
        lambda entries: pack(entries, sums=True),
        lambda entries: pack(materialised(entries)),
        lambda entries: pack(materialised(entries, in_batches=True)),
        lambda entries: pack(materialised(entries, in_batches=True, alone=False)),
    ],
    ids=["pack", "pack with sums", "materialised", "in batches", "in batches alone"],
)
def test_transformations(transform, stack):
    x, y = jnp.asarray(0.7), jnp.asarray(RNG.normal(size=3))
    want = transform(weighted(jnp.stack))(x, y)
    for run in (transform(weighted(stack)), jax.jit(transform(weighted(stack)))):
        # The same sums of at most some ten terms, perhaps in another order.
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-13), run(x, y), want
        )


def over_a_batch(ys):
    def one(y):
        entries = unpack(y)
        # It has an entry of the batch, and one that all have.
        whole = pack([*entries, jnp.asarray(2.0)])
        along = materialised([whole, *entries], in_batches=True)
        return jnp.sum(along[0]) * pack(along[1:], sums=True)

    return jax.vmap(one)(ys) + jax.grad(lambda ys: jnp.sum(jax.vmap(one)(ys) ** 2))(ys)


@pytest.mark.parametrize("kind", meshes.KINDS)
def test_a_batch_on_a_mesh_is_that_on_one_device(kind):
    meshes.check(__file__, ["packed"], kind)


if __name__ == "__main__":
    meshes.show(sys.argv[1], [("packed", over_a_batch, False)])
