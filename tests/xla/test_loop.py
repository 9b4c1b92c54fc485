"""`repeat`: the numbers and derivatives of a plain scan, whatever travels packed."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from jax import lax
from xla.interpreter import run

from cfjax._xla.loop import repeat

VECTOR = jnp.asarray([0.3, -0.7, 1.1])
MATRIX = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3)))
ATTITUDE = jnp.asarray(np.random.default_rng(1).normal(size=(3, 3)))
COMPLEX = jnp.asarray([0.4 + 0.2j, -0.3j])
LONG = jnp.linspace(-1.0, 1.0, 9)
NUM_STEPS = 5


def mix(carry, parameters):
    """A step that couples everything with everything."""
    floats = [x for x in jtu.tree_leaves((carry, parameters)) if x.dtype.kind in "fc"]
    total: Any = sum(jnp.sum(jnp.sin((n + 1) * x)).real.astype(float) for n, x in enumerate(floats))

    def advance(x):
        if x.dtype.kind not in "fc":
            return x + 1
        share = total.astype(x.dtype)
        return x + jnp.cos(share * x) / (1 + share**2)

    return jtu.tree_map(advance, carry)


CASES = {
    "vector": (VECTOR, ()),
    "vector and parameters": (VECTOR, {"a": VECTOR * 2, "b": jnp.asarray(0.4)}),
    "parts": ((VECTOR, {"x": jnp.asarray(0.5), "m": MATRIX, "n": jnp.asarray(3)}), (LONG, VECTOR)),
    "matrix": (ATTITUDE, (VECTOR, MATRIX)),
    "matrix as scalars forward only": ((ATTITUDE, MATRIX, VECTOR), VECTOR),
    "no short vector": ((MATRIX, LONG), VECTOR),
    "two precisions": ((VECTOR, VECTOR.astype(np.float32)), (VECTOR.astype(np.float32), VECTOR)),
    "more parameters than travel": (VECTOR, [VECTOR * k for k in range(1, 9)]),
    "integers among the parameters": (VECTOR, (jnp.arange(3), VECTOR, jnp.asarray(True))),
    "complex": (COMPLEX, (VECTOR, COMPLEX * 2)),
    "real and complex": ((VECTOR, COMPLEX), (VECTOR, COMPLEX)),
    "empty": ((VECTOR, jnp.zeros(0)), jnp.zeros(0)),
}


def plain(carry, parameters):
    return lax.scan(lambda c, _: (mix(c, parameters), None), carry, length=NUM_STEPS)[0]


def looped(carry, parameters):
    return repeat(lambda c: mix(c, parameters), carry, NUM_STEPS)[0]


def scalar(run):
    def fun(floats, rest):
        leaves = jtu.tree_leaves(run(*eqx.combine(floats, rest)))
        return sum(
            jnp.sum(jnp.exp(jnp.sin(x.astype(complex)) / (n + 2))).real
            for n, x in enumerate(leaves)
        )

    return fun


def close(found, want, case):
    def numbers(tree):
        return [x for x in jtu.tree_leaves(tree) if x.dtype.kind in "fc"]

    # Every number depends on all, so on the roundings of the coarsest and the size of the largest.
    # Five coupled steps magnify them a hundredfold.
    eps = max(float(jnp.finfo(x.dtype).eps) for x in numbers(case))
    scale = max(1.0, *(float(jnp.max(jnp.abs(x), initial=0)) for x in numbers(want)))
    jtu.tree_map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e3 * eps * scale), found, want
    )
    assert jtu.tree_structure(found) == jtu.tree_structure(want)


def check(transform, names):
    """The same of both, by NumPy."""
    for name in names:
        found, want = (run(transform(repeated), *CASES[name]) for repeated in (looped, plain))
        assert jtu.tree_map(lambda x: x.dtype, found) == jtu.tree_map(lambda x: x.dtype, want)
        close(found, want, CASES[name])


def test_values():
    check(lambda repeated: repeated, CASES)


def test_a_number_of_steps_that_is_traced(subtests):
    @jax.jit
    def several(case, num_steps):
        carry, parameters = case
        return repeat(lambda c: mix(c, parameters), carry, num_steps)[0]

    for name in ("parts", "no short vector"):
        with subtests.test(name=name):
            case = CASES[name]
            close(several(case, jnp.asarray(NUM_STEPS)), run(plain, *case), case)
            # The same program.
            close(several(case, jnp.asarray(0)), case[0], case)


def forward_over_reverse(f):
    return lambda x, rest: jax.jvp(lambda x: jax.grad(f)(x, rest), (x,), (x,))


@pytest.mark.parametrize(
    "transform, names",
    [
        (forward_over_reverse, ("parts",)),
        (jax.grad, ("two precisions",)),
        pytest.param(jax.grad, CASES, marks=pytest.mark.slow),
    ],
    ids=["forward over reverse", "reverse", "reverse of all"],
)
def test_derivatives(transform, names):
    def of_case(repeated):
        derivative = transform(scalar(repeated))
        return lambda *case: derivative(*eqx.partition(case, eqx.is_inexact_array))

    check(of_case, names)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("axes", [(0, None), (None, 0)], ids=["carry", "parameters"])
def test_a_batch(axes):
    """Of values, of gradients, and the gradient of a batch."""

    def batched(repeated):
        many = jax.vmap(repeated, axes)
        each = jax.vmap(jax.grad(lambda c, p: scalar(repeated)((c, p), (c, p)), (0, 1)), axes)
        whole = jax.grad(lambda c, p: scalar(many)((c, p), (c, p)), (0, 1))
        return lambda *case: [f(*case) for f in (many, each, whole)]

    vectors = jnp.stack([VECTOR, VECTOR * 2])
    case = (vectors, (VECTOR, VECTOR[0])) if axes[0] == 0 else (VECTOR, (vectors, vectors[:, 0]))
    found, want = (run(batched(repeated), *case) for repeated in (looped, plain))
    for a, b in zip(found, want, strict=True):
        close(a, b, case)


def test_only_what_is_differentiated():
    """One parameter among those that the step closes over, and one in an inner program."""

    def derivatives(repeated):
        def fun(a, b):
            def step(y):
                return y + jnp.sin(a * y) / (1 + jax.jit(lambda: b * b)())

            if repeated:
                return jnp.sum(repeat(step, VECTOR, NUM_STEPS)[0])
            return jnp.sum(lax.fori_loop(0, NUM_STEPS, lambda _, y: step(y), VECTOR))

        return lambda a, b: (jax.jacfwd(jax.grad(fun, 1), 0)(a, b), jax.grad(fun)(a, b))

    given = VECTOR, jnp.asarray(0.7)
    close(run(derivatives(True), *given), run(derivatives(False), *given), VECTOR)


def test_what_moves_only_later():
    """A part of the carry that is not differentiated itself, but depends on one that is."""

    def first(repeated):
        return jax.grad(lambda x: jnp.sum(repeated((x, VECTOR * 2), MATRIX)[1]))

    close(run(first(looped), VECTOR), run(first(plain), VECTOR), VECTOR)


def test_an_entry_that_is_known_before():
    """A force without a part along an axis leaves a literal in the carry."""

    def step(carry):
        x, _ = carry
        return jnp.cos(x), jnp.stack([jnp.zeros_like(x[0]), x[2], -x[1]])

    start = (VECTOR, jnp.zeros(3))
    expected = run(lambda c: lax.scan(lambda c, _: (step(c), None), c, length=NUM_STEPS)[0], start)
    for found, x in zip(repeat(step, start, NUM_STEPS)[0], expected, strict=True):
        # The same operations, which XLA may fuse in other ways.
        np.testing.assert_allclose(found, x, rtol=1e-15, atol=1e-15)
