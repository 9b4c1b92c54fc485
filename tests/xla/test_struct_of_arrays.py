"""Short vectors along leading axes: the same numbers, and none of the operations without a rule."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax import lax
from xla.interpreter import lowered, run

import cfjax
from cfjax._solvers.stacked import LARGE
from cfjax._xla import program, scalarised
from cfjax._xla.program import join, split
from cfjax._xla.scope import is_rows
from cfjax._xla.struct_of_arrays import StructOfArrays, static_value, struct_of_arrays

pytestmark = pytest.mark.usefixtures("rewritten")

RNG = np.random.default_rng(0)
Y = RNG.normal(size=(9, 8, 3))
SITES = RNG.normal(size=(9, 8, 3))
M = RNG.normal(size=(3, 3))
W = np.array([1.3, 0.4, -0.8])
NINE = RNG.normal(size=(9, 9))


def crosses(y):
    return jnp.cross(y, jnp.roll(y, 1, 0)) + jnp.cross(y, W)


def lengths(y):
    return y / jnp.linalg.norm(y, axis=-1, keepdims=True) + jnp.sum(y * y, -1)[..., None]


def moved(y):
    flat = y.reshape(-1, 3)[::-1].reshape(y.shape)
    return flat + jnp.flip(y, 1) + jnp.moveaxis(jnp.moveaxis(y, 0, 1), 1, 0) * y.transpose(0, 1, 2)


def joined(y):
    last = jnp.concatenate([y[..., 1:], y[..., :1]], -1)
    padded = jnp.pad(y, ((1, 1), (0, 0), (0, 1)))[1:-1, :, :3]
    ends = jnp.concatenate([y[:2], y[-2:], y[2:-2]], 0)
    middle = lax.pad(y, np.zeros((), y.dtype), ((-4, -4, 0), (0, 0, 0), (0, 0, 0)))
    return last * jnp.stack([y[..., 2], y[..., 0] ** 2, y[..., 1]], -1) + padded * ends - middle


def windows(y):
    part = lax.dynamic_slice(y, (0, 0, 1), (9, 8, 2))
    return lax.dynamic_update_slice(y * W, part * part, (3, 3, 3))


def picked(y):
    return y[..., jnp.array([1, 2, 0])] * y.at[..., 2].add(1.5) + y.at[..., :2].set(0.5)


def sums(y):
    centre = jnp.mean(y, (0, 1)) + jnp.sum(jnp.broadcast_to(W, y.shape), 0)
    running = jnp.cumsum(y, 0) * jnp.prod(y, -1)[..., None]
    return y - centre + jnp.sum(y, 0)[None] * jnp.max(y) + running


def products(y):
    bonds = jnp.einsum("...i,ij->...j", y, M) + y @ M
    outer = y[..., :, None] * y[..., None, :]
    return bonds + jnp.einsum("...ij,...j->...i", outer, y) + jnp.einsum("ab,bcj->acj", NINE, y)


def frames(y):
    turned = jnp.stack([y, jnp.roll(y, 1, -1), y * W], -2)
    return (
        jnp.einsum("...ij,...jk,...k->...i", turned, turned, y)
        + jnp.trace(turned, 0, -2, -1)[..., None]
    )


def waves(y):
    k = jnp.fft.fftfreq(9)[:, None, None]
    return jnp.fft.ifftn(jnp.fft.fftn(y, axes=(0, 1)) * jnp.exp(-k * k), axes=(0, 1)).real


def parameters(y):
    sites, scale = jnp.asarray(SITES), jnp.asarray(0.3)
    return sites * scale / (1 + scale) + y / scale + y / sites * jnp.asarray(W)


FUNCTIONS = [crosses, lengths, moved, joined, picked, windows, sums, products, frames, waves,
             parameters]  # fmt: skip


@pytest.fixture(autouse=True)
def as_users_write():
    """Arrays of different ranks and types together, as JAX allows by default."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture
def leftover(monkeypatch):
    """The names of operations that got arrays whole."""
    names = []

    def noted(eqn, values):
        if any(map(np.ndim, values)):
            names.append(eqn.primitive.name)
        return evaluate(eqn, values)

    evaluate = program.evaluate
    monkeypatch.setattr(program, "evaluate", noted)
    return names


def all_of(funs, change):
    return lambda y: [change(fun)(y) for fun in funs]


def apart(fun):
    return lambda y: scalarised(fun, y)


def test_as_the_function_itself(leftover, subtests):
    found = run(all_of(FUNCTIONS, apart), Y)
    # The largest of all stays whole, as all ties have a share in its derivative.
    assert set(leftover) <= {"iota", "reduce_max"}
    for fun, x in zip(FUNCTIONS, found, strict=True):
        with subtests.test(function=fun.__name__):
            # Sums in another order. The products have at most 9 terms of size 10.
            np.testing.assert_allclose(x, run(fun, Y), rtol=1e-13, atol=1e-13)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("first", range(3))
def test_derivatives(first):
    funs = FUNCTIONS[first::3]

    def both(fun):
        loss = lambda y: jnp.sum(jnp.sin(fun(y)))  # noqa: E731
        tangent = lambda y: jax.jvp(fun, (y,), (jnp.cos(y),))[1]  # noqa: E731
        return lambda y: (jax.grad(loss)(y), tangent(y))

    found = run(all_of(funs, lambda fun: both(apart(fun))), Y)
    want = run(all_of(funs, both), Y)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        # Derivatives of up to 100 in size.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_in_batches():
    ys, funs = jnp.stack([Y, 2 * Y, -Y]), (crosses, products, sums)
    found = run(jax.vmap(all_of(funs, apart)), ys)
    for a, b in zip(found, run(jax.vmap(all_of(funs, lambda fun: fun)), ys), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)


def test_what_has_no_rule_gets_arrays_whole(leftover):
    def fun(y):
        waves = jnp.fft.ifft(2 * jnp.fft.fft(y)).real
        return jnp.sort(y, 0) + y * lax.cummax(y, axis=2) + odd(y) + waves

    @jax.custom_jvp
    def odd(y):
        return jnp.sin(y)

    odd.defjvp(lambda p, t: (odd(*p), 7.0 * t[0]))
    np.testing.assert_allclose(run(apart(fun), Y), run(fun, Y), rtol=1e-14, atol=1e-14)
    assert set(leftover) == {"sort", "cummax", "fft"}
    slope = lambda f: run(lambda y: jax.jvp(f, (y,), (jnp.ones_like(y),))[1], Y)  # noqa: E731
    # Sums of three numbers, in another order. The rule of `odd` survives.
    np.testing.assert_allclose(slope(apart(fun)), slope(fun), atol=1e-14)


def test_windows_of_leading_axes_stay_whole():
    """At a place that is known, and that is not."""

    def fun(y, place):
        part = lax.dynamic_slice(jnp.sin(y), (place, 0, 0), (4, 8, 3))
        return y + jnp.sum(part, 0), lax.dynamic_update_slice(y * W, part, (3, place, 0))

    def both(y, place):
        return [apart(functools.partial(fun, place=k))(y) for k in (2, place)]

    found, want = run(both, Y, jnp.asarray(2)), run(functools.partial(fun, place=2), Y)
    for a, b in zip(jax.tree.leaves(found), 2 * want, strict=True):
        # Sums of five numbers of size 3 at most.
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-14)


def test_a_matrix_is_no_lattice():
    # A matrix of 100 rows: products with itself are what XLA knows best, so they stay whole.
    y = jnp.asarray(RNG.normal(size=(100, 4)))
    fun = lambda y: y @ (y.T @ y)  # noqa: E731
    # A sum of 100 terms, with another order.
    np.testing.assert_allclose(run(apart(fun), y), run(fun, y), rtol=1e-12, atol=1e-12)


def test_the_value_of_what_is_known_along_leading_axes():
    """Entries with the long axes, or 1 in place of one, make the array that they are taken from."""
    whole = np.arange(4 * 5 * 3).reshape(4, 5, 3)
    short_last = StructOfArrays(np.moveaxis(whole, -1, 0), whole.shape, [False, False, True])
    np.testing.assert_array_equal(static_value(short_last), whole)
    short_first = StructOfArrays(whole, whole.shape, [True, False, False])
    np.testing.assert_array_equal(static_value(short_first), whole)
    repeated = StructOfArrays([np.zeros((4, 1)), np.ones((4, 1))], (4, 5, 2), [False, False, True])
    np.testing.assert_array_equal(static_value(repeated), np.broadcast_to([0.0, 1.0], (4, 5, 2)))
    # The dtype of no entries is not known, and no indices would be numbers with a fraction.
    assert static_value(StructOfArrays([], (0,))) is None


def test_split_and_join():
    tree = {"y": jnp.asarray(Y), "w": jnp.asarray(W), "few": jnp.ones((4, 3)), "big": jnp.ones(200)}

    def both(tree):
        parts = split(tree, True)
        assert isinstance(parts["y"], StructOfArrays) and len(parts["y"].entries) == 3
        assert parts["y"].entries[0].shape == (9, 8)
        assert parts["big"] is tree["big"]
        assert len(parts["few"].entries) == 12
        return join(parts)

    jax.tree.map(np.testing.assert_array_equal, run(both, tree), tree)


def test_which_states_are_rows():
    rows = {shape for shape in ((65, 3), (64, 3), (9, 8, 7), (100, 8), (100, 1), (300,))
            if is_rows(jnp.ones(shape))}  # fmt: skip
    assert rows == {(65, 3), (9, 8, 7)}


def test_parts_that_repeat_stay_small():
    x = struct_of_arrays(jnp.asarray(Y))
    assert x.inner == (1, 1, 3) and x.sides == (9, 8)
    fun = lambda y: y + jnp.broadcast_to(jnp.asarray(W), y.shape) * 2.0  # noqa: E731
    text = str(lowered(apart(fun), jnp.asarray(Y)))
    # W is doubled before it is spread, on arrays of one entry.
    assert "f64[1,1] = mul" in text


def test_flows_of_a_step_are_computed_once():
    """Neighbours need them, and would compute them anew: through memory instead."""
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.roll(y, 1, 0)))
    end = lambda y: cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y, num_steps=2).ys[-1]  # noqa: E731
    text = jax.jit(end).lower(Y).as_text()
    # Four fields, the six flows of CF4 and what neighbours take, each a call that stays one.
    assert text.count("call @_identity") >= 10


def test_a_solve_of_many_vectors():
    """Their combinations are products of matrices where they are not rewritten."""
    y = np.random.default_rng(1).normal(size=(40, 20, 3))
    assert y.size > LARGE
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.roll(y, 1, 0) + jnp.cos(t)))
    end = lambda y: cfjax.integrate(term, cfjax.CF2(), 0.0, 0.4, y, num_steps=3).ys[-1]  # noqa: E731
    found = jax.jit(end, compiler_options=problems.QUICK)(y)
    with cfjax.rewriting(False):
        expected = run(end, y)
    # Three steps of rotations, of vectors of size 4 at most.
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_a_linear_solve_is_transposed():
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.asarray(SITES) * jnp.cos(t)))
    end = lambda y: cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, y, num_steps=3).ys[-1]  # noqa: E731

    def transposed(y):
        return jax.linear_transpose(end, y)(jnp.cos(y)), jax.vjp(end, y)[1](jnp.cos(y))

    found, expected = run(transposed, Y)
    # Three steps of rotations, which are linear, of vectors of size 2 at most.
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)
