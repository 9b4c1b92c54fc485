"""Loops over the stages of a method, which are unrolled in programs of many systems."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from xla import random_programs
from xla.interpreter import run

import cfjax
from cfjax.scenes import heavy_top, rigid_body, spacecraft

pytestmark = pytest.mark.usefixtures("rewritten")

# Whether long programs are rewritten too.
TAKES_LONG = jax.__version_info__ >= (0, 12)


def step_of(scene, solver, field=None, num_results=2):
    """The end of a step and its error, as a function of the state and the parameters; with three
    results, what output within the step needs too.
    """
    given = scene.problem()
    term = given["term"] if field is None else cfjax.LieTerm(field)
    t0, t1 = jnp.asarray(0.1), jnp.asarray(0.12)

    def step(y, args):
        state = solver.init(term, t0, t1, y, args)
        return solver.step(term, t0, t1, y, args, state, made_jump=False)[:num_results]

    args = jax.tree.map(jnp.asarray, given.get("args"))
    return step, given["y0"], args


def size(fun):
    return lambda *args: sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(fun(*args)))


def lines_of(fun, *args):
    return jax.jit(fun).lower(*args).as_text().splitlines()


def num_loops(fun, *args):
    """Those over stages: the number of turns of one that has one turn goes through a barrier."""
    lines = lines_of(fun, *args)
    of_one_turn = sum(bool(re.search(r"optimization_barrier %\w+ : tensor<i32>", x)) for x in lines)
    return sum("stablehlo.while" in line for line in lines) - of_one_turn


def batch_of(fun, y, args):
    ys = jax.tree.map(lambda x: jnp.stack([x, -x]), y)
    return jax.vmap(fun, (0, None)), ys, args


def test_which_steps_are_unrolled():
    """Those of batches, and before jax 0.12 short ones alone."""
    solvers = cfjax.CF4(), cfjax.RKMK8()
    short, long = (step_of(rigid_body, solver, num_results=3) for solver in solvers)
    assert "scan" in str(jax.make_jaxpr(short[0])(*short[1:]))
    assert num_loops(*short) > 0 and num_loops(*long) > 0
    assert num_loops(*batch_of(*short)) == 0
    assert (num_loops(*batch_of(*long)) == 0) == TAKES_LONG
    # Directions are no batch.
    assert num_loops(jax.jacfwd(short[0]), *short[1:]) > 0
    with cfjax.rewriting(False):
        assert num_loops(*batch_of(*short)) > 0


@pytest.mark.skipif(jax.__version_info__ < (0, 12), reason="XLA compiles shorter loops so.")
def test_a_gradient_of_a_step_in_no_loop_is_one_function():
    """Otherwise XLA computes in each of its functions what they need of the others."""
    step, y, args = step_of(rigid_body, cfjax.CF54())
    batch, ys, args = batch_of(jax.grad(size(step)), y, args)
    text = jax.jit(batch).lower(ys, args).compile().as_text()
    start = text.index("\nENTRY")
    # What is long is called as one.
    assert 'xla_cpu_small_call="true"' in text[start:]
    lengths = {
        name: len(lines.splitlines())
        for name, lines in re.findall(r"\n%(\S+) .*?\{\n(.*?)\n\}", text[:start], re.DOTALL)
    }
    assert max(lengths.values()) > 1000
    called = re.findall(r"fusion\(.*calls=%([\w.-]+)", text[start:])
    assert called and max(lengths[name] for name in called) < 500


@pytest.mark.slow
def test_thirteen_stages_of_seven_numbers_are_unrolled_in_a_batch():
    assert (num_loops(*batch_of(*step_of(heavy_top, cfjax.RKMK8()))) == 0) == TAKES_LONG


@pytest.mark.slow
def test_what_is_unrolled_has_no_terms_that_are_zero():
    """It is the program of stages that were traced one by one, where a weight of one is no
    product.
    """

    def products(unroll):
        batch = batch_of(*step_of(rigid_body, cfjax.CF3(unroll=unroll)))
        return sum("stablehlo.multiply" in line for line in lines_of(*batch))

    # A flow more would be forty. XLA merges what is computed twice alike.
    assert 100 < products(True) <= products(None) < products(True) + 30


def compiled(fun):
    return jax.jit(fun, compiler_options=problems.QUICK)


def as_it_is(fun, *args):
    """By NumPy, for which nothing is compiled."""
    with cfjax.rewriting(False):
        return run(fun, *args)


def batch(step):
    return lambda y, args: batch_of(step, y, args)[0](*batch_of(step, y, args)[1:])


def gradients(step):
    return batch(jax.grad(size(step)))


def hessians(step):
    return batch(jax.hessian(size(step)))


def jacobians(step):
    return batch(jax.jacfwd(step))


@pytest.mark.parametrize("is_too_long", [False, True])
def test_values_and_gradients_of_a_short_step(monkeypatch, is_too_long):
    """However it is compiled; by NumPy, as nothing of that is XLA's."""
    step, *start = step_of(rigid_body, cfjax.CF2())
    if is_too_long:
        monkeypatch.setattr(random_programs.lowering, "MAX_OPERATIONS", 300)
    # Programs of the same step, made otherwise.
    jax.clear_caches()
    for transform in (batch, gradients):
        close(run(transform(step), *start), as_it_is(transform(step), *start), 1e-13)
    assert (num_loops(gradients(step), *start) > 0) == is_too_long
    jax.clear_caches()


def close(found, expected, atol):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=0, atol=atol * max(1.0, float(np.max(abs(b)))))


@pytest.mark.slow
@pytest.mark.parametrize(
    "transform, scene, solver",
    [
        (batch, heavy_top, cfjax.RKMK8()),
        (hessians, rigid_body, cfjax.CF2()),
        (gradients, heavy_top, cfjax.RKMK8()),
        (gradients, spacecraft, cfjax.RKMK8()),
        (jacobians, spacecraft, cfjax.RKMK8()),
    ],
)
def test_a_step_agrees_with_the_program_as_it_is(transform, scene, solver):
    """Up to rounding, of which there are thousands in a step."""
    step, *start = step_of(scene, solver)
    found = compiled(transform(step))(*start)
    close(found, as_it_is(transform(step), *start), 1e-13 if transform is hessians else 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [cfjax.CF54(), cfjax.RKMK8()])
def test_a_solve_agrees_however_its_steps_are_compiled(solver):
    """With output and error control, alone and in batches."""
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(-y / args + jnp.sin(t)))
    inertia = jnp.asarray([1.0, 2.0, 3.0])

    def solve(y):
        controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
        options = dict(stepsize_controller=controller, max_steps=64)
        at = diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 4))
        return diffrax.diffeqsolve(
            term, solver, 0.0, 1.0, None, y, inertia, saveat=at, **options
        ).ys

    few = jnp.outer(jnp.linspace(0.2, 1.4, 3), jnp.asarray([0.3, -0.7, 1.1]))
    units = 2.0**-52 * np.asarray([0, 1, -1, 4, -4, 16, -16])
    expected, *near = (as_it_is(jax.vmap(solve), few * (1 + x)) for x in units)
    # Some twenty steps, in each of which a rounding is multiplied by less than 2. But the length of
    # a step follows from the estimate. Where that is rounding, the solution moves with any change
    # of the start by a like amount: by at most twice the largest of six.
    atol = 1e-13 + 2 * np.max([np.abs(x - expected).max(axis=(1, 2)) for x in near], axis=0)
    assert (atol < 2e-13).sum() >= 2
    assert (np.abs(compiled(jax.vmap(solve))(few) - expected).max(axis=(1, 2)) <= atol).all()
    assert np.abs(compiled(solve)(few[0]) - expected[0]).max() <= atol[0]


@pytest.mark.slow
def test_output_within_a_step_is_scalarised_in_batches():
    """For one system its flows are a loop."""
    _, y, args = step_of(rigid_body, cfjax.CF3())
    term, dense = rigid_body.problem()["term"], diffrax.SaveAt(dense=True)
    sol = diffrax.diffeqsolve(term, cfjax.CF3(), 0.0, 1.0, 0.25, y, args, saveat=dense)
    times = jnp.linspace(0.05, 0.95, 5)

    at = lambda t: sol.evaluate(t)  # noqa: E731
    batch = jax.vmap(at)
    # Another finds the step.
    assert num_loops(at, 0.3) == num_loops(batch, times) + 1 == 2
    # Some hundred operations on numbers of size one.
    np.testing.assert_allclose(jax.jit(batch)(times), as_it_is(batch, times), rtol=0, atol=1e-13)


def test_a_loop_of_a_field_is_left_alone():
    """Also within the loop over stages."""

    def field(t, y, args):
        return cfjax.Rotation(jax.lax.fori_loop(0, 3, lambda k, w: w / args, y))

    step = step_of(rigid_body, cfjax.CF4(), field)
    assert "cfjax_step" not in str(jax.make_jaxpr(step[0])(*step[1:]))


def test_an_update_whose_place_is_not_known_is_left_alone():
    def updated(x):
        y = jnp.sin(x) * x[0]
        place = jnp.argmax(y)
        return y.at[place].set(jax.lax.dynamic_index_in_dim(y, 2 - place, keepdims=False))

    x = jnp.asarray([0.3, -0.7, 1.1])
    batch = jax.vmap(lambda x: random_programs.rewritten(lambda y, _: updated(y))(x, None))
    xs = jnp.stack([x, x[::-1]])
    np.testing.assert_array_equal(batch(xs), jax.vmap(updated)(xs))
    assert any("stablehlo.sine" in s and "x3xf64" in s for s in lines_of(batch, xs))


def test_the_switch_is_a_bool(no_shape_hook):
    with pytest.raises(TypeError, match=r"on must be True or False, got 'yes'"):
        cfjax.rewriting("yes")  # pyright: ignore[reportArgumentType]
