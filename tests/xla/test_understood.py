"""Rules look at every parameter of what they scalarise: programs that once gave other numbers."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from xla.interpreter import lowered, run
from xla.random_programs import in_a_batch

import cfjax
from cfjax._xla import scalarised
from cfjax._xla.understood import is_readable, is_understood

pytestmark = pytest.mark.usefixtures("rewritten")

TABLE = np.arange(10.0)
SIX = np.array([0.3, -0.7, 1.1, 0.4, -0.2, 0.9])
SEVEN = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
M = np.array([[0.2, -1.0], [0.7, 0.3]])
SPINS = np.random.default_rng(0).normal(size=(100, 3))

SMALL = {
    "reshape in Fortran's order": (
        lambda y: (jnp.asarray(M) @ y.reshape((2, 3), order="F")).ravel(order="F"),
        SIX,
    ),
    "lax.reshape with dimensions": (
        lambda y: lax.reshape(jnp.outer(y, y), (9, 4), dimensions=(1, 0)),
        SIX,
    ),
    "fill out of bounds": (
        lambda y: y.at[jnp.array([1, 2, 3])].get(mode="fill", fill_value=0.0),
        SIX[:3],
    ),
    "take out of bounds": (lambda y: jnp.nan_to_num(jnp.take(y, jnp.array([0, 5]))), SIX[:3]),
    "promise that is not kept": (lambda y: y[np.array([0, 5])], SIX[:3]),
    "largest, at ties": (lambda y: jnp.max(y) * y, np.array([1.0, 1.0, 1.0])),
    "smallest, at ties": (lambda y: jnp.min(y.reshape(2, 3), axis=1), np.array([1.0] * 6)),
    "interior padding": (lambda y: lax.pad(y, 0.5, [(1, -1, 2)]), SIX),
    "convolution and update in one": (
        lambda y: jnp.convolve(lax.dynamic_update_slice(y, y[:2] * y[1], (3,)), y[:3]),
        SIX,
    ),
    "each row and each entry": (
        lambda y: sum(a * b for a, b in jnp.unstack(y.reshape(2, 3), axis=1)) + jnp.unstack(y)[4],
        SIX,
    ),
    "nothing beside something": (lambda y: jnp.concatenate([y[:0], y, y[3:3]]), SIX),
    "key": (lambda y: jax.random.normal(jax.random.key(0), (6,)) * y, SIX),
    "permutation by a key": (lambda y: jax.random.permutation(jax.random.key(1), y), SIX),
    "apply": (lambda y: y.at[1].apply(jnp.exp), SIX),
}
# Derivatives that JAX does not have, or not on these numbers.
NO_GRADIENT = "take out of bounds", "apply"


def grad(fun, y):
    return jax.grad(lambda y: sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(fun(y))))(y)


def rewritten(fun):
    """One system is compiled as it was traced, a batch of one is not."""
    return in_a_batch(lambda y: scalarised(fun, y))


def test_values_and_gradients(subtests):
    """In one program, in which each is a step of its own."""

    def all_of(change, states):
        return {
            name: (
                change(fun)(y := states[name]),
                y if name in NO_GRADIENT else grad(change(fun), y),
            )
            for name, (fun, _) in SMALL.items()
        }

    states = {name: jnp.asarray(y) for name, (_, y) in SMALL.items()}
    found = run(lambda s: all_of(rewritten, s), states)
    expected = run(lambda s: all_of(lambda fun: fun, s), states)
    for name in SMALL:
        with subtests.test(name=name):
            # Each entry is the same few operations in one order or another.
            np.testing.assert_allclose(found[name][0], expected[name][0], rtol=1e-15, atol=1e-15)
            # Sums of up to 36 products.
            np.testing.assert_allclose(found[name][1], expected[name][1], rtol=1e-14, atol=1e-14)


def test_a_quotient_is_exact_where_its_last_bit_counts():
    funs = (
        lambda y, a: jnp.floor(y / a),
        lambda y, a: jnp.asarray(TABLE)[(y / a).astype(int)],
        lambda y, a: (y / a >= 1).astype(float),
        lambda y, a: jnp.sign(jnp.cumsum(y / a) - 1),
    )
    y = jnp.full(7, 49.0)
    assert np.float64(49.0) * (1 / np.float64(49.0)) < 1  # or this would test nothing
    ours = jax.jit(lambda y, a: [rewritten(lambda y, f=f: f(y, a))(y) for f in funs])(y, y)
    for found, fun in zip(ours, funs, strict=True):
        np.testing.assert_array_equal(found, fun(np.asarray(y), np.asarray(y)))


def divisions(fun, y, a):
    """How many by what is not a number of the program, whose reciprocal XLA takes by itself."""
    program = lowered(lambda y, a: rewritten(lambda y: fun(y, a))(y), y, a)
    return len(re.findall(r" div \w+ [a-z]", str(program)))


def test_a_quotient_is_a_product_where_all_is_smooth():
    y, a = jnp.asarray(SEVEN), jnp.asarray(SEVEN)
    assert divisions(lambda y, a: jnp.sin(y / a) @ y, y, a) == 0
    assert divisions(lambda y, a: jnp.floor(jnp.sin(y / a)), y, a) == 7
    # A rotation compares its angle with that of a full turn, and is smooth there.
    assert divisions(lambda y, a: cfjax.Rotation(y / a).flow(y), y[:3], a[:3]) == 0
    # What a step of integers gives is not.
    assert divisions(lambda y, a: cfjax.Rotation(jnp.round(y / a)).flow(y), y[:3], a[:3]) == 3


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_quotient_by_any_number_is_that_of_jax(dtype):
    """The reciprocals of the largest are no normal numbers."""
    ends = np.finfo(dtype)
    a = np.array([ends.max, -ends.max / 1.5, ends.max / 3, ends.max**0.45, 3, ends.tiny, 0], dtype)
    a = np.concatenate([a, [np.inf, np.nan]], dtype=dtype)
    assert not np.any(np.abs(1 / a[:3]) > ends.tiny)  # or this would test nothing
    x = np.array([ends.max, a[1], -a[2], 1, 3, 0, 0], dtype)
    xs, divisors = map(np.ravel, np.meshgrid(x, a))

    def results(change):
        def quotient(x, a):
            return change(lambda y: y / a)(jnp.full(3, x))[0]

        return jax.jit(jax.vmap(jax.value_and_grad(quotient, (0, 1))))(xs, divisors)

    ours, (dx, da) = results(lambda fun: lambda y: scalarised(fun, y))
    plain, (dx_plain, da_plain) = results(lambda fun: fun)
    # XLA takes numbers below the smallest normal one for zero.
    tolerance = dict(rtol=4 * ends.eps, atol=2 * ends.tiny)
    np.testing.assert_allclose(ours, plain, **tolerance)
    np.testing.assert_allclose(dx, dx_plain, **tolerance)
    # JAX divides by the square of a, which is a normal number for these.
    some = (np.abs(divisors) > ends.tiny**0.5) & (np.abs(divisors) < ends.max**0.5)
    assert some.sum() == 2 * len(x)
    np.testing.assert_allclose(da[some], da_plain[some], **tolerance)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("estimate", ["group", "algebra"])
def test_a_step_with_its_estimate_is_smooth(estimate):
    """It compares norms of errors, and yet has as many divisions as without those of the field."""
    y, solver = jnp.asarray(SIX[:3]), cfjax.CF2(estimate=estimate)

    def count(field):
        term = cfjax.LieTerm(lambda t, y, a: cfjax.Rotation(field(y, a)))

        def step(y, a, state):
            return solver.step(term, 0.0, 0.1, y, a, state, made_jump=False)[:2]

        state = solver.init(term, 0.0, 0.1, y, y)
        program = lowered(lambda y, a: in_a_batch(lambda y: step(y, a, state))(y), y, y)
        return len(re.findall(r" div \w+ [a-z]", str(program)))

    assert count(lambda y, a: y / a) == count(lambda y, a: y * a)


def shifted(s, k):
    return s.at[1:].set(lax.dynamic_slice_in_dim(s, k - 5, 99, 0))


def neighbours(t, y, args):
    """The neighbours of spins on a grid, and one number for all."""
    field = jnp.roll(y["s"], 1, 0) + 0.7 * jnp.roll(y["s"], -1, 1) + jnp.cos(t)
    field = (field + y["w"][None, None]) * jnp.asarray(SIX[None, None, :3])
    return {"s": cfjax.Rotation(field), "w": jnp.sum(y["s"], (0, 1)) / 72}


GRID = {"s": SPINS[:72].reshape(9, 8, 3), "w": SIX[3:]}
LATTICES = {
    # XLA updates arrays in place, and reads what it has overwritten if these have two shapes.
    "shifted by a number of the program": (lambda t, s, k: cfjax.Rotation(shifted(s, k)), SPINS),
    "one added to some": (lambda t, s, k: cfjax.Rotation(s.at[:10].add(s[k])), SPINS),
    "one set": (lambda t, s, k: cfjax.Rotation(s.at[k].set(s[k - 1])), SPINS),
    "largest of all": (lambda t, s, k: cfjax.Rotation(s * jnp.max(jnp.round(s))), SPINS),
    "sides of length 1": (
        lambda t, s, k: {
            "s": cfjax.Rotation(s["s"] * s["n"][..., None]),
            "n": -s["n"] * s["s"].sum(-1),
        },
        {"s": SPINS[:70].reshape(70, 1, 3), "n": SPINS[:70, :1]},
    ),
    "a chain": (
        lambda t, s, k: cfjax.Rotation(jnp.roll(s, 1, 0) + jnp.roll(s, -1, 0) + jnp.roll(s, 1, 1)),
        SPINS.reshape(100, 1, 3),
    ),
    "a chain in the second place": (
        lambda t, s, k: cfjax.Rotation(jnp.roll(s, 1, 0) + jnp.roll(s, -1, 1)),
        SPINS.reshape(1, 100, 3),
    ),
    "neighbours": (neighbours, GRID),
    "neighbours, many stages": (neighbours, GRID, cfjax.RKMK8()),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if k else []) for k, name in enumerate(LATTICES)],
)
def test_solves_of_lattices(name):
    field, y0, solver = (*LATTICES[name], cfjax.CF2())[:3]

    def solve(y0, k):
        term = cfjax.LieTerm(field)
        return cfjax.integrate(term, solver, 0.0, 0.1, y0, k, num_steps=2, save_every=1).ys

    def both(y0, k):
        return solve(y0, k), grad(lambda y0: solve(y0, k), y0)

    given = jax.tree.map(jnp.asarray, y0), jnp.asarray(5)
    ours = run(both, *given)
    # Only XLA overwrites arrays.
    if name == "shifted by a number of the program":
        ours = jax.jit(solve)(*given), ours[1]
    with cfjax.rewriting(False):
        plain = run(both, *given)
    # Tens of operations on numbers of size 1 in two steps, hundreds with many stages.
    for found, expected, atol in zip(ours, plain, (1e-13, 1e-12), strict=True):
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def equation(fun, *args):
    return jax.make_jaxpr(fun)(*args).jaxpr.eqns[-1]


def test_parameters():
    y = jnp.asarray(SIX)
    assert is_understood(equation(lambda y: lax.reshape(y, (2, 3)), y))
    known = equation(lambda y: lax.reshape(y, (2, 3)), y)
    assert not is_understood(known.replace(params=known.params | {"dimensions": (1, 0)}))
    # As a newer version of JAX may have.
    assert not is_understood(known.replace(params=known.params | {"new": None}))
    exact = equation(lambda y: lax.dot_general(y, y, (((0,), (0,)), ((), ()))), y)
    rounded = exact.params | {"precision": lax.DotAlgorithmPreset.BF16_BF16_F32}
    assert is_understood(exact) and not is_understood(exact.replace(params=rounded))
    assert not is_understood(equation(lambda y: lax.sort(y), y))


def test_advice_to_the_compiler():
    def advised(y):
        with set_xla_metadata(some="advice"):
            return jnp.sin(y)

    assert not is_readable(jax.make_jaxpr(advised)(jnp.asarray(SIX)).jaxpr)
    assert is_readable(jax.make_jaxpr(jnp.sin)(jnp.asarray(SIX)).jaxpr)


def test_updates_in_place_that_have_no_rule_are_left_alone():
    y, k = jnp.asarray(SIX), jnp.asarray(2)

    def on_vectors(fun):
        text = jax.jit(lambda k: rewritten(lambda y: jnp.sin(fun(y, k)))(y)).lower(k).as_text()
        return any("sine" in line and "6xf64" in line for line in text.splitlines())

    assert not on_vectors(lambda y, k: y.at[2].set(y[3]))
    assert on_vectors(lambda y, k: y.at[k].set(y[3]))


@jax.jit
def helper(y, inertia):
    return -y / inertia


def test_a_field_with_a_jitted_helper_is_rewritten():
    """JAX keeps what it has traced of the helper, first outside of a step that is rewritten."""
    term = cfjax.LieTerm(lambda t, y, inertia: cfjax.Rotation(helper(y, inertia)))

    def solve(y):
        inertia = jnp.array([0.9, 0.6, 0.3])
        return cfjax.integrate(term, cfjax.CF3(), 0.0, 1.0, y, inertia, num_steps=3).ys

    assert "cfjax_step" in str(jax.make_jaxpr(solve)(jnp.asarray(SIX[:3])))
