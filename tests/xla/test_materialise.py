"""What goes through memory. That nothing else changes is in test_pack.py."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax._xla import scalarised
from cfjax._xla.materialise import materialised
from cfjax._xla.pack import pack, unpack
from cfjax.scenes import rigid_body


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

        return jax.jit(fun).lower(jnp.ones(3)).compile().cost_analysis()["flops"]

    assert program(materialised) < program(list)


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


# The estimate of the first needs the field at the end, that of the second does not.
@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF4(), cfjax.CF43(), cfjax.RKMK(diffrax.Tsit5.tableau)])
def test_a_step_is_computed_once_and_its_error_goes_through_memory(rewritten, solver):
    """It was computed four or five times: for each entry of the end, for the error and for a ratio
    in it. And of two sums in one function XLA makes, of what they share, a tree of calls, which
    takes a hundred times as long as the step.
    """
    functions = _functions(rigid_body, solver)
    # A step is more than 500 operations, a norm some tens.
    assert len([size for size, _ in functions if size > 500]) == 1
    assert all(size < 200 for size, sums in functions if sums > 1)


def _functions(scene, solver):
    """How long each function of XLA's program for adaptive steps is, and its number of sums."""
    given = scene.problem()

    def solve(y0, args):
        controller = diffrax.PIDController(rtol=0.0, atol=1e-6)
        return diffrax.diffeqsolve(
            given["term"], solver, 0.0, 1.0, 0.1, y0, args, stepsize_controller=controller
        ).ys

    program = jax.jit(solve).lower(given["y0"], given["args"]).compile().as_text()
    functions = re.findall(r"^%fused_computation[^\n]*\n(?:  .*\n)*", program, flags=re.MULTILINE)
    return [(text.count("\n"), text.count(" reduce(")) for text in functions]


def test_in_a_batch_only_if_asked_for():
    """There a call is what XLA does not fuse. In a derivative too."""

    def has_call(in_batches, transform):
        def fun(x):
            return jnp.sum(jnp.sin(pack(materialised(unpack(x * x), in_batches=in_batches))))

        batch = jax.jit(jax.vmap(transform(fun)))
        return " call(" in str(batch.lower(jnp.ones((5, 3))).compile().as_text())

    assert has_call(True, lambda fun: fun) and has_call(True, jax.grad)
    assert not has_call(False, lambda fun: fun)


def test_other_dtypes_stay():
    x = [jnp.asarray(True), jnp.asarray(3), jnp.asarray(0.5), jnp.asarray(2j, np.complex64)]
    for got, want in zip(jax.jit(lambda x: materialised(x))(x), x, strict=True):
        assert got.dtype == want.dtype and got == want


def test_a_linear_solve_in_a_program_that_is_left_as_it_was_traced(rewritten):
    """Its programs have names."""

    def fun(y):
        return jnp.linalg.solve(jnp.outer(y, y) + 9 * jnp.eye(3), y)

    both = jax.jit(lambda y: (scalarised(fun, y, only_values=True), fun(y)))
    # The same operations.
    np.testing.assert_allclose(*both(jnp.arange(3.0)), rtol=1e-15)
