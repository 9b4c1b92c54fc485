"""What goes through memory: the same numbers, and computed once."""

import re
import sys

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from xla.interpreter import run

import cfjax
from cfjax._xla import materialised, pack, scalarised, unpack

RNG = np.random.default_rng(0)


def weighted(keep):
    """A function whose derivatives differ from entry to entry. One entry is never used."""

    def fun(x, y):
        a, b, c = unpack(y)
        whole = jnp.stack(keep([x * a, jnp.sin(b * x), x * x, c * a, x]))
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


def test_transformations():
    def all_of(keep):
        return lambda x, y: [transform(weighted(keep))(x, y) for transform in TRANSFORMS]

    x, y = jnp.asarray(0.7), jnp.asarray(RNG.normal(size=3))
    found, expected = run(all_of(materialised), x, y), run(all_of(list), x, y)
    # The same sums of at most some ten terms, perhaps in another order.
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def test_what_is_materialised_is_computed_once():
    """Without it XLA computes the entries anew for each of two results."""

    def program(keep):
        def fun(x):
            entries = unpack(x)
            for _ in range(8):
                a, b, c = entries
                entries = [a * b + c, b * c - a, a + b * b]
            entries = keep(entries)
            return pack(entries), pack([a * a for a in entries])

        batch = jax.jit(jax.vmap(fun)).lower(jnp.ones((5, 3)))
        return batch.compile().cost_analysis()["flops"]

    assert program(materialised) < program(list)


def test_only_in_a_batch():
    """There a call is what XLA does not fuse. In a derivative too."""

    def has_call(transform, is_batch, is_mark=False):
        def fun(x):
            return jnp.sum(jnp.sin(pack(materialised(unpack(x * x), is_mark))))

        made = jax.vmap(transform(fun)) if is_batch else transform(fun)
        text = jax.jit(made).lower(jnp.ones((5, 3) if is_batch else 3)).compile().as_text()
        return " call(" in str(text)

    for transform in (lambda fun: fun, jax.grad):
        assert has_call(transform, True)
        assert not has_call(transform, False)
        # A mark is nothing by itself.
        assert not has_call(transform, True, is_mark=True)


def test_other_dtypes_stay():
    x = [jnp.asarray(True), jnp.asarray(3), jnp.asarray(0.5), jnp.asarray(2j, np.complex64)]
    for got, want in zip(jax.jit(lambda x: materialised(x))(x), x, strict=True):
        assert got.dtype == want.dtype and got == want


def test_increments_of_a_step_are_computed_together(rewritten):
    """The angular momentum moves the attitude too, and is computed once for both."""

    def field(t, y, args):
        rotation = cfjax.QuaternionRotation(y["m"] / args, frame="body", layout="wxyz")
        return {"q": rotation, "m": cfjax.Rotation(-y["m"] / args)}

    def solve(y0, args):
        term = cfjax.LieTerm(field)
        return cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, args, num_steps=2).ys

    y0 = {"q": jnp.array([1.0, 0.0, 0.0, 0.0]), "m": jnp.ones(3)}
    text = str(jax.make_jaxpr(solve)(y0, jnp.array([0.9, 0.6, 0.3])))
    groups = [line.split("=")[0] for line in text.splitlines() if "= cfjax_materialised[" in line]
    lengths = [map(int, re.findall(r"f64\[(\d+)\]", group)) for group in groups]
    assert 7 in map(sum, lengths)


def test_a_linear_solve_in_a_program_that_is_left_as_it_was_traced(rewritten):
    """Its programs have names."""

    def fun(y):
        return jnp.linalg.solve(jnp.outer(y, y) + 9 * jnp.eye(3), y)

    both = jax.jit(lambda y: (scalarised(fun, y, only_values=True), fun(y)))
    # The same operations.
    np.testing.assert_allclose(*both(jnp.arange(3.0)), rtol=1e-15)


def over_a_batch(ys):
    def one(y):
        entries = unpack(y)
        # It has an entry of the batch, and one that all have.
        whole = pack([*entries, jnp.asarray(2.0)])
        along = materialised([whole, *entries])
        return jnp.sum(along[0]) * pack(along[1:])

    return jax.vmap(one)(ys) + jax.grad(lambda ys: jnp.sum(jax.vmap(one)(ys) ** 2))(ys)


@pytest.mark.slow
def test_a_batch_on_a_mesh_is_that_on_one_device():
    meshes.check(__file__, [f"packed, {kind}" for kind in meshes.KINDS], "both")


if __name__ == "__main__":
    meshes.show(sys.argv[1], [("packed", over_a_batch, False)])
