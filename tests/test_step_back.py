"""Gradients in constant memory, by steps backwards."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solver_table import SOLVERS

import cfjax

START = {"q": jnp.asarray([0.6, 0.0, 0.8]), "p": jnp.asarray([0.2, -0.4, 0.9])}
WEIGHTS = jnp.asarray([0.3, -0.7, 0.4])


def kick(t, y, args):
    return {"q": None, "p": jnp.cross(y["q"], args * WEIGHTS)}


def turn(t, y, args):
    """A rotation of the position about the momentum, which rests."""
    return {"q": cfjax.Rotation(y["p"]), "p": None}


def drive(t, y, args):
    return {"q": None, "p": args * jnp.sin(t) * WEIGHTS}


SPLIT = diffrax.MultiTerm(*map(cfjax.LieTerm, (drive, kick, turn)))


def whole(t, y, args):
    return {"q": cfjax.Rotation(y["p"]), "p": kick(t, y, args)["p"] + drive(t, y, args)["p"]}


def of_time(t, y, args):
    return {"q": cfjax.Rotation(args * WEIGHTS + jnp.sin(t)), "p": args * WEIGHTS * t}


def loss(args, y0, term, solver, num_steps=20, **options):
    ys = cfjax.integrate(term, solver, 0.0, 2.0, y0, args, num_steps=num_steps, **options).ys
    return jnp.sum(ys["q"] @ WEIGHTS) + jnp.sum(jnp.sin(ys["p"]))


def scaled(term, strength):
    """Fields that close over a number, by which their arguments are multiplied."""
    if isinstance(term, diffrax.MultiTerm):
        return diffrax.MultiTerm(*(scaled(part, strength) for part in term.terms))
    return cfjax.LieTerm(lambda t, y, args: term.field(t, y, args * strength))


def forced(t, y, args):
    """Of a pendulum for each entry."""
    return {"q": None, "p": jnp.sin(t) - args * jnp.sin(y["q"])}


def drift(t, y, args):
    return {"q": y["p"], "p": None}


def growing(t, y, args):
    return {"q": cfjax.Scaling(args * WEIGHTS * t), "p": args * WEIGHTS * t}


PENDULUM = diffrax.MultiTerm(cfjax.LieTerm(forced), cfjax.LieTerm(drift))
TERMS = {"terms": SPLIT, "any": cfjax.LieTerm(whole), "time only": cfjax.LieTerm(of_time)}
# The cheapest programs, of terms and of one term.
CHEAP = {("Strang", 5): PENDULUM, ("Magnus2", None): cfjax.LieTerm(growing)}
QUICK = [("Magnus2", None)]
SAVE_EVERY = {"BlanesMoan4": 5, "Composition": 1, "ImplicitMidpoint": 1, "Magnus4Lobatto": 5}
SLOW = [(name, SAVE_EVERY.get(name)) for name, row in SOLVERS.items() if row.is_symmetric]


@pytest.mark.parametrize(
    "name, save_every",
    [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW if case not in QUICK)],
)
def test_the_gradient_of_step_back_is_that_of_all_states_kept(name, save_every):
    solver = SOLVERS[name].make()
    term = CHEAP.get((name, save_every), TERMS[SOLVERS[name].takes])

    def ends(step_back):
        options = dict(save_every=save_every, save_initial=True, step_back=step_back)

        def captured(args, strength, y0):
            return loss(args, y0, scaled(term, strength), solver, **options)

        one = jnp.asarray(1.0)
        return jax.value_and_grad(captured, (0, 1, 2))(jnp.asarray(0.7), one, START)

    found, expected = (jax.jit(ends, static_argnums=0)(x) for x in (True, False))
    # Twenty steps, each of a few roundings, in the states and in the derivatives; the midpoint's
    # derivative is solved for to rounding once more.
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13), found, expected
    )


def swing(args, num_steps, **options):
    y0 = {"q": jnp.asarray([0.3]), "p": jnp.asarray([0.1])}
    times = 0.0, 2.0
    solver = cfjax.Strang()
    return jnp.sum(
        cfjax.integrate(PENDULUM, solver, *times, y0, args, num_steps=num_steps, **options).ys["q"]
    )


def test_memory_does_not_grow():
    def size(num_steps):
        program = jax.jit(jax.grad(lambda args: swing(args, num_steps, step_back=True)))
        memory = program.lower(jnp.asarray(0.7)).compile().memory_analysis()
        return memory.temp_size_in_bytes

    # All states would be two numbers of eight bytes each.
    assert size(5000) == size(50) < 4950 * 16


def source(t, y, args):
    return jnp.ones_like(y)


@pytest.mark.slow
def test_parts_of_two_precisions():
    """The digits are those of the part of lowest precision."""
    y0 = {"q": jnp.asarray([0.3], jnp.float32), "p": jnp.asarray([0.1], jnp.float32)}
    both = {"a": y0, "b": jax.tree.map(lambda x: x.astype(jnp.float64), y0)}

    def parts(field):
        def of_both(t, y, args):
            return {name: field(t, y[name], args) for name in "ab"}

        return cfjax.LieTerm(of_both)

    term = diffrax.MultiTerm(
        parts(lambda t, y, args: {"q": None, "p": -jnp.sin(y["q"])}),
        parts(lambda t, y, args: {"q": y["p"], "p": None}),
    )

    def end(y0):
        ys = cfjax.integrate(term, cfjax.Strang(), 0.0, 2.0, y0, num_steps=200, step_back=True).ys
        return jnp.sum(ys["b"]["q"]) + jnp.sum(ys["a"]["q"]).astype(jnp.float64)

    found = eqx.filter_jit(jax.grad(end))(both)
    # Two hundred roundings of float32.
    np.testing.assert_allclose(found["a"]["q"], found["b"]["q"], rtol=0, atol=200 * 1.2e-7)


def decay(t, y, args):
    return cfjax.Scaling(jnp.full_like(y, -40.0))


def test_a_large_part_beside_one_that_misses_the_start():
    """A position, to whose digits the other part is nothing."""

    def beside(field):
        return cfjax.LieTerm(lambda t, y, args: {"x": None, "y": field(t, y["y"], args)})

    def end(y0, x):
        term = diffrax.MultiTerm(beside(source), beside(decay))
        start = {"x": x, "y": y0}
        options = dict(num_steps=10, step_back=True, throw=False)
        return jnp.sum(cfjax.integrate(term, cfjax.Strang(), 0.0, 1.0, start, **options).ys["y"])

    assert np.all(np.isnan(jax.jit(jax.grad(end))(jnp.asarray([1.0, 2.0]), 1.5e11)))


def test_a_part_that_is_zero_but_for_rounding():
    """What the difference of equal numbers moves is never back at its digits."""

    def force(t, y, args):
        return {"q": None, "p": -y["q"], "z": 3 * y["q"][:1] - y["q"][1:]}

    term = diffrax.MultiTerm(
        cfjax.LieTerm(force), cfjax.LieTerm(lambda t, y, args: {"q": y["p"], "p": None, "z": None})
    )

    @jax.jit
    @jax.grad
    def found(q):
        start = {"q": q, "p": jnp.zeros(2), "z": jnp.zeros(1)}
        options = dict(num_steps=50, step_back=True, throw=False)
        ys = cfjax.integrate(term, cfjax.Strang(), 0.0, 5.0, start, **options).ys
        return jnp.sum(jnp.sin(ys["q"][-1])) + jnp.sum(ys["z"])

    # The derivative in each entry, by an imaginary step so small that its square is nothing.
    q = np.array([0.3, 0.9])
    x, p, z = q + 1e-30j * np.eye(2), 0.0, 0.0
    for _ in range(50):
        p, z = p - 0.05 * x, z + 0.05 * (3 * x[:, 0] - x[:, 1])
        x = x + 0.1 * p
        p, z = p - 0.05 * x, z + 0.05 * (3 * x[:, 0] - x[:, 1])
    expected = (np.sum(np.sin(x), axis=1) + z).imag / 1e-30
    # Fifty steps, each of a few roundings.
    np.testing.assert_allclose(found(jnp.asarray(q)), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "transform, by",
    [("jit", "start"), ("vmap", "captured"), pytest.param("grad", "args", marks=pytest.mark.slow)],
)
def test_step_back_that_misses_the_start(transform, by):
    """No digits are left beside the source of what has decayed by exp(-40)."""

    def end(x):
        rate, y0 = (1.0, x) if by == "start" else (x, jnp.ones(2))
        rate, args = (None, rate) if by == "args" else (rate, None)
        first = cfjax.LieTerm(
            lambda t, y, args: (args if rate is None else rate) * jnp.ones_like(y)
        )
        term = diffrax.MultiTerm(first, cfjax.LieTerm(decay))
        options = dict(num_steps=10, step_back=True)
        return jnp.sum(cfjax.integrate(term, cfjax.Strang(), 0.0, 1.0, y0, args, **options).ys)

    x = jnp.asarray([1.0, 2.0]) if by == "start" else jnp.asarray(1.0)
    gradient = jax.grad(end)
    if transform == "vmap":
        gradient, x = jax.vmap(gradient), x[None]
    elif transform == "jit":
        gradient = eqx.filter_jit(gradient)
    with pytest.raises(RuntimeError, match="step_back led back to a start"):
        jax.block_until_ready(gradient(x))


@pytest.mark.slow
def test_step_back_in_a_batch():
    def gradients(step_back):
        one = jax.grad(lambda args: swing(args, 20, step_back=step_back))
        return jax.jit(jax.vmap(one))(jnp.asarray([0.2, 0.7]))

    # As above.
    np.testing.assert_allclose(gradients(True), gradients(False), rtol=1e-12, atol=1e-13)


def test_step_back_refuses_other_solvers_and_options():
    term = cfjax.LieTerm(whole)
    with pytest.raises(ValueError, match=r"step_back takes a symmetric solver, .* got CF4"):
        loss(jnp.asarray(0.7), START, term, cfjax.CF4(), step_back=True)
    path = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))
    bath = cfjax.LieControlTerm(lambda t, y, args, dw: {"q": None, "p": dw}, path)
    noisy = diffrax.MultiTerm(*SPLIT.terms, bath)
    with pytest.raises(ValueError, match="step_back does not support noise"):
        loss(jnp.asarray(0.7), START, noisy, cfjax.Strang(), step_back=True)
    with pytest.raises(ValueError, match="either step_back or checkpoint_every, got both"):
        loss(jnp.asarray(0.7), START, SPLIT, cfjax.Strang(), step_back=True, checkpoint_every=4)
