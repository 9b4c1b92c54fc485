"""`pack` and `unpack`: the numbers of `jnp.stack` under every transformation."""

import sys

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from xla.interpreter import run

from cfjax._xla.materialise import materialised
from cfjax._xla.pack import pack, unpack

RNG = np.random.default_rng(0)


def test_pack_is_stack_and_unpack_its_inverse(subtests):
    cases = (
        (np.float32, 1, 0), (np.float64, 4, 1), (np.float64, 11, 0), (np.complex128, 11, 1),
        (np.int32, 4, 0), (np.bool_, 1, 1),
    )  # fmt: skip

    def there_and_back(given):
        packed = [pack(entries, axis) for entries, (_, _, axis) in zip(given, cases, strict=True)]
        return packed, [unpack(x, axis) for x, (_, _, axis) in zip(packed, cases, strict=True)]

    given = [
        [jnp.asarray(RNG.normal(size=(2, 5)) * 3, dtype) for _ in range(count)]
        for dtype, count, _ in cases
    ]
    for (dtype, count, axis), entries, whole, again in zip(
        cases, given, *jax.jit(there_and_back)(given), strict=True
    ):
        with subtests.test(dtype=dtype.__name__, count=str(count)):
            assert whole.dtype == dtype
            np.testing.assert_array_equal(whole, np.stack(entries, axis))
            np.testing.assert_array_equal(again, entries)


def weighted(stack):
    """A function whose derivatives differ from entry to entry. One entry is never used."""

    def fun(x, y):
        a, b, c = y if stack is jnp.stack else unpack(y)
        whole = stack([x * a, jnp.sin(b * x), x * x, c * a, x])
        return jnp.sum(jnp.exp(whole[1:4] / 2) * whole[:3])

    return fun


TRANSFORMS = [
    jax.grad,
    lambda f: jax.grad(f, 1),
    lambda f: lambda x, y: jax.jvp(f, (x, y), (x + 1, y * y)),
    lambda f: lambda x, y: jax.jvp(lambda x: f(x, y), (x,), (x + 1,)),
    lambda f: jax.hessian(f, 1),
    lambda f: jax.grad(lambda x, y: jnp.sum(jax.grad(f, 1)(x, y) ** 2)),
    lambda f: lambda x, y: jax.vmap(jax.grad(f), (None, 0))(x, jnp.stack([y, y * y])),
    lambda f: lambda x, y: jax.vmap(f, (0, 1), 0)(y[:2], jnp.stack([y, y * y], 1)),
    lambda f: jax.grad(lambda x, y: jnp.sum(jax.vmap(f, (0, None))(x * y, y))),
]


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
def test_transformations(stack):
    def all_of(stack):
        return lambda x, y: [transform(weighted(stack))(x, y) for transform in TRANSFORMS]

    x, y = jnp.asarray(0.7), jnp.asarray(RNG.normal(size=3))
    found, expected = run(all_of(stack), x, y), run(all_of(jnp.stack), x, y)
    # The same sums of at most some ten terms, perhaps in another order.
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def over_a_batch(ys):
    def one(y):
        entries = unpack(y)
        # It has an entry of the batch, and one that all have.
        whole = pack([*entries, jnp.asarray(2.0)])
        along = materialised([whole, *entries], in_batches=True)
        return jnp.sum(along[0]) * pack(along[1:], sums=True)

    return jax.vmap(one)(ys) + jax.grad(lambda ys: jnp.sum(jax.vmap(one)(ys) ** 2))(ys)


@pytest.mark.slow
def test_a_batch_on_a_mesh_is_that_on_one_device():
    meshes.check(__file__, [f"packed, {kind}" for kind in meshes.KINDS], "both")


if __name__ == "__main__":
    meshes.show(sys.argv[1], [("packed", over_a_batch, False)])
