"""Loops over the stages of a method: unrolled where a step is short, otherwise turn by turn."""

import math
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from xla import random_programs
from xla.interpreter import run

import cfjax
from cfjax.scenes import heavy_top, rigid_body, spacecraft, spin_waves

pytestmark = pytest.mark.usefixtures("rewritten_by_default")


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
    return sum("stablehlo.while" in line for line in lines_of(fun, *args))


def num_calls(fun, *args):
    return sum("call @_identity" in line for line in lines_of(fun, *args))


def batch_of(fun, y, args):
    ys = jax.tree.map(lambda x: jnp.stack([x, -x]), y)
    return jax.vmap(fun, (0, None)), ys, args


def test_which_steps_are_unrolled():
    """Those of batches, and before jax 0.12 short ones of one system."""
    solvers = cfjax.CF4(), cfjax.RKMK8()
    short, long = (step_of(rigid_body, solver, num_results=3) for solver in solvers)
    assert "scan" in str(jax.make_jaxpr(short[0])(*short[1:]))
    assert (num_loops(*short) == 0) == (random_programs.lowering.FLAT_ONE > 0)
    assert num_loops(*long) > 0
    assert num_loops(*batch_of(*short)) == num_loops(*batch_of(*long)) == 0
    # Directions are no batch.
    assert num_loops(jax.jacfwd(short[0]), *short[1:]) > 0
    with cfjax.rewriting(True):
        assert num_loops(*short) == 0
    with cfjax.rewriting(False):
        assert num_loops(*batch_of(*short)) > 0


@pytest.mark.slow
def test_thirteen_stages_of_seven_numbers_are_unrolled_in_a_batch():
    assert num_loops(*batch_of(*step_of(heavy_top, cfjax.RKMK8()))) == 0


@pytest.mark.slow
def test_long_values_of_a_batch_are_cut_at_groups_of_turns(monkeypatch):
    """Otherwise a batch took half a second a step where what a field closes over is known."""
    inertia = rigid_body.problem()["args"]
    known = lambda t, y, args: cfjax.Rotation(-y / np.asarray(inertia))  # noqa: E731

    def num_materialised(solver):
        return num_calls(*batch_of(*step_of(rigid_body, solver, known)))

    # The 12 turns have 481 operations each, and XLA's functions 2000.
    number = num_materialised(cfjax.RKMK8())
    monkeypatch.setattr(random_programs.lowering, "UNCUT_VALUES", math.inf)
    jax.clear_caches()
    assert num_materialised(cfjax.RKMK8()) + 3 <= number
    # Short ones are not.
    assert num_materialised(cfjax.CF4()) < 5


def test_a_loop_is_as_long_as_it_is_unrolled(monkeypatch):
    """Of the weights that it is counted with, most are zero, so it needs no cut."""

    def field(t, y, args):
        q = cfjax.QuaternionRotation(y["m"] / args, frame="body", layout="wxyz")
        return {"q": q, "m": cfjax.Rotation(-y["m"] / args)}

    def end(y, args):
        term, solver = cfjax.LieTerm(field), cfjax.Projected(diffrax.Dopri8())
        options = {"num_steps": 2, "throw": False}
        return cfjax.integrate(term, solver, 0.0, 0.1, y, args, **options).ys

    step = batch_of(end, spacecraft.y0(), spacecraft.inertia)
    number = num_calls(*step)
    monkeypatch.setattr(random_programs.lowering, "UNCUT", 0)
    jax.clear_caches()
    assert num_calls(*step) > number
    jax.clear_caches()


@pytest.mark.slow
def test_no_function_of_a_long_gradient_is_longer_than_those_of_xla():
    """XLA would compute what two of its functions need in both: this gradient did not end."""

    def twist(t, y, args):
        return cfjax.RigidMotion(
            omega=y[1:4] * args + 0.1 * t, v=0.1 * y[4:], frame="body", layout="wxyz_xyz"
        )

    def loss(y, args):
        term, solver = cfjax.LieTerm(twist), cfjax.CF4()
        state = solver.init(term, 0.0, 0.1, y, args)

        def step(carry, t):
            y, state = carry
            y, _, _, state, _ = solver.step(term, t, t + 0.1, y, args, state, made_jump=False)
            return (y, state), None

        return jnp.sum(jax.lax.scan(step, (y, state), 0.1 * jnp.arange(10.0))[0][0])

    start = jnp.asarray([1.0, 0, 0, 0, 0.1, 0.2, 0.3]), jnp.asarray([1.0, 2.0, 3.0])
    program = jax.jit(jax.grad(loss, (0, 1))).lower(*start).compile().as_text()
    functions = str(program).split("\n}")
    longest = max(text.count(" = ") for text in functions if "fused_computation" in text)
    assert 200 < longest < 2000


@pytest.mark.slow
def test_what_is_unrolled_has_no_terms_that_are_zero():
    """It is the program of stages that were traced one by one, where a weight of one is no
    product.
    """

    def products(unroll):
        batch = batch_of(*step_of(rigid_body, cfjax.CF3(unroll=unroll)))
        return sum("stablehlo.multiply" in line for line in lines_of(*batch))

    # A flow more would be forty.
    assert 100 < products(True) <= products(None) < products(True) + 10


def test_each_turn_of_a_long_step_is_scalarised(monkeypatch):
    """Sums over its stages are not."""
    step = batch_of(*step_of(spacecraft, cfjax.RKMK8()))
    monkeypatch.setattr(random_programs.lowering, "FLAT_MANY", 2000)
    _, *functions = jax.jit(step[0]).lower(*step[1:]).as_text().split("func.func")
    (turn,) = (text for text in functions if text.startswith(" private @cfjax"))

    def products(text, type):
        return sum("multiply" in s and f": tensor<{type}>" in s for s in text.splitlines())

    assert products(turn, "2xf64") > 100
    assert products(turn, "2x3xf64") == products(turn, "2x13x3xf64") == 0
    assert any(products(text, "2x13x3xf64") for text in functions)


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


# How a step is compiled that is as long as these limits say. Most others are compiled as a whole.
WAYS = {
    "turn by turn": {"FLAT_MANY": 300},
    "cut": {"FLAT_WHOLE": 0, "CUT_VALUES": 0, "UNCUT_VALUES": 0, "UNCUT": 0},
}


@pytest.mark.parametrize("way", WAYS)
def test_values_and_gradients_of_a_short_step(monkeypatch, way):
    """However it is compiled; by NumPy, as nothing of that is XLA's."""
    step, *start = step_of(rigid_body, cfjax.CF2())
    for name, limit in WAYS[way].items():
        monkeypatch.setattr(random_programs.lowering, name, limit)
    # Programs of the same step, made otherwise.
    jax.clear_caches()
    for transform in (batch, gradients):
        close(run(transform(step), *start), as_it_is(transform(step), *start), 1e-13)
    text = "".join(lines_of(gradients(step), *start))
    assert ("stablehlo.while" in text) == (way == "turn by turn")
    # What reverse mode computes again.
    assert ("optimization_barrier" in text) == (way == "cut")
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
    expected, near = (as_it_is(jax.vmap(solve), few * (1 + x)) for x in (0.0, 4 * 2.0**-52))
    # Some twenty steps, in each of which a rounding is multiplied by less than 2. But the length of
    # a step follows from the estimate, whose rounding is many of its own units: by that the
    # solution moves as by some units of rounding of the start.
    atol = 1e-13 + np.abs(near - expected).max(axis=(1, 2))
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
    assert any("stablehlo.sine" in s and "2x3xf64" in s for s in lines_of(batch, xs))


def test_the_switch_is_a_bool_or_none(no_shape_hook):
    with pytest.raises(TypeError, match=r"on must be True, False or None, got 'yes'"):
        cfjax.rewriting("yes")  # pyright: ignore[reportArgumentType]


def test_results_of_all_turns_along_leading_axes():
    """A splitting keeps what its terms compute in all turns, and some of it is sliced."""
    magnet, y0 = spin_waves.MAGNET, jnp.asarray(spin_waves.y0(10))
    colours = [spin_waves.colour(parity).field for parity in (0, 1)]
    terms = diffrax.MultiTerm(
        *(cfjax.LieTerm(lambda t, y, args, f=f: f(t, y, magnet)) for f in colours)
    )

    def solve(y):
        return cfjax.integrate(terms, cfjax.BlanesMoan4(), 0.0, 0.2, y, num_steps=2).ys[-1]

    with warnings.catch_warnings():
        # What cannot be rewritten runs as it is, with a warning.
        warnings.simplefilter("error")
        new = run(solve, y0)
    np.testing.assert_allclose(new, as_it_is(solve, y0), rtol=0, atol=1e-14)
