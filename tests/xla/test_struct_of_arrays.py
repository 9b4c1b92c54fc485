"""Short vectors along leading axes: the same numbers, and none of the operations without a rule."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from jax import lax
from xla.interpreter import lowered

import cfjax
from cfjax._xla import limits, program, scalarised
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
MASK = SITES > 0


def crosses(y):
    return jnp.cross(y, jnp.roll(y, 1, 0)) + jnp.cross(y, W)


def lengths(y):
    return y / jnp.linalg.norm(y, axis=-1, keepdims=True) + jnp.sum(y * y, -1)[..., None]


def moved(y):
    flat = y.reshape(-1, 3)[::-1].reshape(y.shape)
    return flat + jnp.flip(y, 1) + jnp.moveaxis(jnp.moveaxis(y, 0, 1), 1, 0) * y.transpose(0, 1, 2)


def swapped(y):
    return jnp.swapaxes(jnp.swapaxes(y, 0, 1) * jnp.arange(8.0)[:, None, None], 0, 1)


def joined(y):
    last = jnp.concatenate([y[..., 1:], y[..., :1]], -1)
    padded = jnp.pad(y, ((1, 1), (0, 0), (0, 1)))[1:-1, :, :3]
    ends = jnp.concatenate([y[:2], y[-2:], y[2:-2]], 0)
    middle = lax.pad(y, np.zeros((), y.dtype), ((-4, -4, 0), (0, 0, 0), (0, 0, 0)))
    return last * jnp.stack([y[..., 2], y[..., 0] ** 2, y[..., 1]], -1) + padded * ends - middle


def split_up(y):
    a, b, c = jnp.split(y, 3, -1)
    first, rest = jnp.split(y, [4], 0)
    return jnp.concatenate([b, c, a], -1) + jnp.concatenate([rest, first], 0) + y[:, :1]


def windows(y):
    part = lax.dynamic_slice(y, (0, 0, 1), (9, 8, 2))
    return lax.dynamic_update_slice(y * W, part * part, (3, 3, 3))


def picked(y):
    return y[..., jnp.array([1, 2, 0])] * y.at[..., 2].add(1.5) + y.at[..., :2].set(0.5)


def added_at(y):
    return y.at[..., 0].multiply(y[..., 1]).at[..., jnp.array([2, 0])].add(y[..., :2])


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


def chosen(y):
    up = jnp.where(y[..., 2:] > 0, y, -y)
    return (
        jnp.where(MASK, up, SITES * y)
        + jnp.where(jnp.sum(y) > 0, y, 2 * y)
        + jnp.clip(y, -0.5, 0.5)
    )


def waves(y):
    k = jnp.fft.fftfreq(9)[:, None, None]
    return jnp.fft.ifftn(jnp.fft.fftn(y, axes=(0, 1)) * jnp.exp(-k * k), axes=(0, 1)).real


def parameters(y):
    sites, scale = jnp.asarray(SITES), jnp.asarray(0.3)
    return sites * scale / (1 + scale) + y / scale + y / sites * jnp.asarray(W)


FUNCTIONS = [crosses, lengths, moved, swapped, joined, split_up, picked, windows, added_at, sums,
             products, frames, chosen, waves, parameters]  # fmt: skip


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


@pytest.mark.representatives(6)
@pytest.mark.parametrize("fun", FUNCTIONS)
def test_as_the_function_itself(fun, leftover):
    apart = jax.jit(lambda y: scalarised(fun, y))(Y)
    # Sums in another order. The products have at most 9 terms of size 10.
    np.testing.assert_allclose(apart, fun(jnp.asarray(Y)), rtol=1e-13, atol=1e-13)
    # The largest of all stays whole, as all ties have a share in its derivative.
    assert set(leftover) <= {"iota", "reduce_max"}


@pytest.mark.representatives(4)
@pytest.mark.parametrize("fun", FUNCTIONS)
def test_derivatives(fun):
    def both(fun):
        loss = lambda y: jnp.sum(jnp.sin(fun(y)))  # noqa: E731
        tangent = lambda y: jax.jvp(fun, (y,), (jnp.cos(y),))[1]  # noqa: E731
        return lambda y: (jax.grad(loss)(y), tangent(y))

    found = jax.jit(both(lambda y: scalarised(fun, y)))(Y)
    with cfjax.rewriting(False):
        want = jax.jit(both(fun))(Y)
    for a, b in zip(found, want, strict=True):
        # Derivatives of up to 100 in size.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_in_batches():
    ys = jnp.stack([Y, 2 * Y, -Y])
    for fun in (crosses, products, sums):
        apart = jax.jit(jax.vmap(lambda y: scalarised(fun, y)))(ys)  # noqa: B023
        np.testing.assert_allclose(apart, jax.vmap(fun)(ys), rtol=1e-13, atol=1e-13)


def test_what_has_no_rule_gets_arrays_whole(leftover):
    def fun(y):
        return jnp.sort(y, 0) + y * lax.cummax(y, axis=2) + odd(y)

    @jax.custom_jvp
    def odd(y):
        return jnp.sin(y)

    odd.defjvp(lambda p, t: (odd(*p), 7.0 * t[0]))
    apart = jax.jit(lambda y: scalarised(fun, y))(Y)
    np.testing.assert_allclose(apart, fun(jnp.asarray(Y)), rtol=1e-14, atol=1e-14)
    assert set(leftover) == {"sort", "cummax"}
    slope = lambda f: jax.jvp(f, (jnp.asarray(Y),), (jnp.ones_like(Y),))[1]  # noqa: E731
    # Sums of three numbers, in another order. The rule of `odd` survives.
    np.testing.assert_allclose(slope(lambda y: scalarised(fun, y)), slope(fun), atol=1e-14)


@pytest.mark.parametrize("place", [2, jnp.asarray(2)])
def test_windows_of_leading_axes_stay_whole(place):
    def fun(y):
        part = lax.dynamic_slice(jnp.sin(y), (place, 0, 0), (4, 8, 3))
        return y + jnp.sum(part, 0), lax.dynamic_update_slice(y * W, part, (3, place, 0))

    for a, b in zip(jax.jit(lambda y: scalarised(fun, y))(Y), fun(jnp.asarray(Y)), strict=True):
        # Sums of five numbers of size 3 at most.
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-14)


def test_a_matrix_is_no_lattice():
    # A matrix of 100 rows: products with itself are what XLA knows best, so they stay whole.
    y = jnp.asarray(RNG.normal(size=(100, 4)))
    fun = lambda y: y @ (y.T @ y)  # noqa: E731
    # A sum of 100 terms, with another order.
    np.testing.assert_allclose(scalarised(fun, y), fun(y), rtol=1e-12, atol=1e-12)


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
    parts = split(tree, True)
    assert isinstance(parts["y"], StructOfArrays) and len(parts["y"].entries) == 3
    assert parts["y"].entries[0].shape == (9, 8)
    assert parts["big"] is tree["big"]
    assert len(parts["few"].entries) == 12
    for x, y in zip(jax.tree.leaves(join(parts)), jax.tree.leaves(tree), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((65, 3), True), ((64, 3), False), ((9, 8, 7), True), ((100, 8), False), ((100, 1), False),
     ((300,), False)],
)  # fmt: skip
def test_which_states_are_rows(shape, expected):
    assert is_rows(jnp.ones(shape)) == expected


def test_parts_that_repeat_stay_small():
    x = struct_of_arrays(jnp.asarray(Y))
    assert x.inner == (1, 1, 3) and x.sides == (9, 8)
    seen = []

    def fun(y):
        field = jnp.broadcast_to(jnp.asarray(W), y.shape)
        seen.append(field * 2.0)
        return y + seen[-1]

    text = str(lowered(lambda y: scalarised(fun, y), jnp.asarray(Y)))
    # W is doubled before it is spread, on arrays of one entry.
    assert "f64[1,1] = mul" in text


def test_flows_of_a_step_are_computed_once():
    """Neighbours need them, and would compute them anew: through memory instead."""
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.roll(y, 1, 0)))
    run = lambda y: cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y, num_steps=2).ys[-1]  # noqa: E731
    text = jax.jit(run).lower(Y).as_text()
    # Four fields, the six flows of CF4 and what neighbours take, each a call that stays one.
    assert text.count("call @_identity") >= 10


def neighbours(t, y, args):
    """The neighbours of spins on a grid, and one number for all."""
    field = jnp.roll(y["s"], 1, 0) + args * jnp.roll(y["s"], -1, 1) + y["w"] + jnp.cos(t)
    return {"s": cfjax.Rotation(field * jnp.asarray(W)), "w": jnp.sum(y["s"] * W, (0, 1)) / 72}


def loss(y, args, solver, how):
    term, times = cfjax.LieTerm(neighbours), dict(t0=0.0, t1=0.4)
    if how == "integrate":
        ys = cfjax.integrate(term, solver, y0=y, args=args, num_steps=3, **times).ys
    else:
        at = diffrax.SaveAt(ts=jnp.linspace(0.05, 0.4, 3))
        more = dict(dt0=0.2, y0=y, args=args, saveat=at, adjoint=diffrax.DirectAdjoint())
        ys = diffrax.diffeqsolve(term, solver, **more, **times).ys
    return jnp.sum(jnp.sin(ys["s"][-1] * jnp.arange(8.0)[:, None])) + jnp.sum(ys["w"])


STATE = {"s": SITES, "w": np.array([0.2, -0.4, 0.1])}
SOLVERS = [cfjax.CF4(), cfjax.CF54(), cfjax.RKMK8()]
HOW = [pytest.param(solver, "integrate", id=type(solver).__name__) for solver in SOLVERS]
HOW += [pytest.param(cfjax.CF4(), "diffeqsolve", id="output")]


def compare(found, tolerance):
    """Rewritten and not."""
    run = lambda: jax.tree.leaves(jax.jit(found, compiler_options=problems.QUICK)())  # noqa: E731
    rewritten = run()
    with cfjax.rewriting(False):
        plain = run()
    for a, b in zip(rewritten, plain, strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver, how", HOW)
def test_derivatives_of_a_solve(solver, how):
    """Long ones are cut at the stages."""

    def found():
        fun = lambda y, args: loss(y, args, solver, how)  # noqa: E731
        value, gradient = jax.value_and_grad(fun, (0, 1))(STATE, jnp.asarray(0.7))
        ones = jax.tree.map(jnp.ones_like, STATE)
        _, tangent = jax.jvp(fun, (STATE, jnp.asarray(0.7)), (ones, jnp.asarray(1.0)))
        return value, gradient, tangent

    # Three steps of some thousand operations, on numbers of size 10 at most.
    compare(found, 1e-12)


@pytest.mark.slow
def test_derivatives_of_a_solve_in_batches():
    def found():
        fun = lambda args: loss(STATE, args, cfjax.CF4(), "integrate")  # noqa: E731
        args = jnp.asarray([0.7, 0.1])
        product = lambda a: jax.jvp(jax.grad(fun), (a,), (a,))[1]  # noqa: E731
        return jax.vmap(fun)(args), jax.vmap(jax.grad(fun))(args), jax.vmap(product)(args)

    # As above, and second derivatives are ten times as large.
    compare(found, 1e-11)


def test_a_solve_of_many_vectors():
    """Their combinations are products of matrices where they are not rewritten."""
    y = np.random.default_rng(1).normal(size=(40, 20, 3))
    assert y.size > limits.LARGE
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.roll(y, 1, 0) + jnp.cos(t)))
    end = lambda y: cfjax.integrate(term, cfjax.CF4(), 0.0, 0.4, y, num_steps=3).ys[-1]  # noqa: E731
    # Three steps of rotations, of vectors of size 4 at most.
    compare(lambda: end(y), 1e-13)


def test_a_linear_solve_is_transposed():
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.asarray(SITES) * jnp.cos(t)))
    end = lambda y: cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y, num_steps=3).ys[-1]  # noqa: E731

    def transposed(y):
        return jax.linear_transpose(end, y)(jnp.cos(y)), jax.vjp(end, y)[1](jnp.cos(y))

    found, expected = jax.jit(transposed, compiler_options=problems.QUICK)(Y)
    # Three steps of rotations, which are linear, of vectors of size 2 at most.
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)
