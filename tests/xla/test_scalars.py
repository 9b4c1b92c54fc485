"""`scalarised`: the same numbers as the function itself, under every transformation."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.experimental import io_callback
from xla.interpreter import lowered, run
from xla.random_programs import KINDS, batch, gradient, in_a_batch, rewritten

import cfjax
from cfjax._xla import over_stages, program, scalarised
from cfjax._xla.materialise import materialised

pytestmark = pytest.mark.usefixtures("rewritten")

Y = np.array([0.3, -0.7, 1.1])
W = np.array([1.3, 0.4, -0.8])
M = np.array([[0.2, -1.0, 0.5], [0.7, 0.3, -0.4], [-0.6, 0.9, 1.2]])
INTS = np.array([3, -2, 5])
KEY = jax.random.key(0)
MLP = eqx.nn.MLP(3, 3, 5, 1, activation=jnp.tanh, key=KEY, dtype=jnp.float64)


# Rules whose derivative is not that of the code: what loses the rule gives other numbers.
@jax.custom_jvp
def odd_jvp(y):
    return jnp.sin(y) * y[0]


odd_jvp.defjvp(lambda p, t: (odd_jvp(*p), 7.0 * t[0] * p[0]))


@jax.custom_vjp
def odd_vjp(y):
    return jnp.exp(y) / y[1]


odd_vjp.defvjp(lambda y: (odd_vjp(y), y), lambda y, ct: (5.0 * ct * y,))


@jax.custom_batching.custom_vmap
def odd_vmap(y):
    return 2.0 * y


odd_vmap.def_vmap(lambda size, batched, y: (3.0 * y, True))


# Beside the operations of which random programs consist: functions of a vector (3,).
VECTOR = {
    "twice the same output": lambda y: (y, y, y[0], y),
    "arithmetic": lambda y: (2.0 * y - y * W + 1.0) / (3.0 + y) - (-y) / W + y / 7.0,
    "length one with vector": lambda y: y[:1] * y + y / (2.0 + y[2:] * y[2:]),
    "matrix of y": lambda y: (jnp.outer(y, jnp.asarray(W)) @ y, jnp.diag(y) @ W, jnp.outer(y, y)),
    "other lengths": lambda y: (M[:2] @ y, y @ M[:, :1], np.ones((6, 3)) @ y, np.ones((8, 3)) @ y),
    "dot_general": lambda y: (
        lax.dot_general(y, y, (((), ()), ((0,), (0,)))),
        lax.dot_general(y, jnp.asarray(M), (((0,), (1,)), ((), ()))),
        lax.dot_general(jnp.asarray(M), y, (((0,), (0,)), ((), ()))),
        jnp.tensordot(y, y[1], axes=0),
    ),
    "long in the middle": lambda y: jnp.concatenate([y, y * y, jnp.sin(y)])[2:6] * 2.0,
    "network": lambda y: MLP(y),
    "custom jvp": lambda y: odd_jvp(y * y) + jax.jit(odd_jvp)(y),
    "checkpoint": jax.checkpoint(lambda y: jnp.sin(y) * jnp.exp(y @ y) * y),
    "jit in jit": jax.jit(lambda y: jax.jit(lambda a, b: (b * a, a))(y, y[0])),
    "conversions": lambda y: (
        y.astype(jnp.float32) * 2.0,
        (10.0 * y).astype(jnp.int32),
        (y > 0).astype(jnp.int32) * 3,
        ~(y > 0) & (y < 1) | (y == 0),
    ),
    "complex inside": lambda y: (
        jnp.abs(jnp.exp(1j * y.astype(complex)) + lax.complex(y, y * y)),
        jnp.real(lax.complex(y, y) * jnp.conj(lax.complex(y, -y * y))),
    ),
    "constants out": lambda y: (np.float32(2.0), jnp.asarray(M), jnp.asarray(W), y, jnp.zeros(3)),
    "nothing out": lambda y: (None, (), {"y": y}),
    "hessian inside": lambda y: jax.hessian(lambda z: jnp.sum(jnp.exp(z) * z))(y) @ y,
    "many random": lambda y: (
        y + jax.vmap(lambda k: jax.random.normal(k, dtype=jnp.float64))(jax.random.split(KEY, 3))
    ),
    "error_if": lambda y: eqx.error_if(y * y, jnp.any(y > 100), "too large") * y,
    "materialised": lambda y: jnp.stack(materialised([y, y[::-1]])) @ materialised([y, y * y])[1],
}

TREE = {
    "float32": (lambda y: y * 2.0 + 1.0 / y - y[0] * 3 + jnp.sum(y), Y.astype(np.float32)),
    "float16": (lambda y: y * 2.0 + jnp.exp(y) * (y @ y), Y.astype(np.float16)),
    "complex": (
        lambda y: jnp.exp(y) * jnp.vdot(y, y) + y @ (M @ y.real).astype(complex) + y**2 / (2 + y),
        Y + 1j * W,
    ),
    "length one": (lambda y: (y * y, y[0] * jnp.exp(y), y @ y, jnp.sum(y), y.reshape(())), Y[:1]),
    "length seven": (lambda y: jnp.exp(y[:3]) * y[2:3], np.linspace(0.1, 1, 7)),
    "scalars": (lambda y: (y[0] * y[1], y[1] ** 2, jnp.stack([y[1], y[1]])), (Y, np.asarray(0.4))),
    "integers and flags": (
        lambda y: (y["n"] * 2, ~y["b"], jnp.where(y["b"], y["a"], y["a"] * y["n"][1].astype(float)),
                   y["n"]),
        {"a": Y, "n": INTS, "b": np.array([True, False, True])},
    ),
    # These stay as they are.
    "empty": (lambda y: (jnp.exp(y["e"]), np.zeros((3, 0)) @ y["e"], jnp.sum(y["e"]) + y["a"]),
              {"a": Y, "e": np.zeros(0)}),
    "long and short": (
        lambda y: (y["b"][0][:3] * y["a"], {"b": jnp.sin(y["b"][0]) * y["a"][1], "c": y["c"]}),
        {"a": Y, "b": (np.linspace(0.1, 1, 9),), "c": np.ones((2, 2))},
    ),
    "a matrix": (lambda m: (m @ m * m[:1], jnp.trace(m)), M),
}  # fmt: skip

ZOO = {
    **{name: (fun, Y) for name, fun in VECTOR.items()},
    **TREE,
    "custom vjp": (lambda y: odd_vjp(y * y) + jax.jit(odd_vjp)(y), Y),
}


def whole(fun):
    """In a batch of one, since one system is compiled as it was traced."""
    return in_a_batch(lambda y: scalarised(fun, y))


def alone(fun):
    return lambda y: scalarised(fun, y)


def assert_same(got, want, units, least=np.float64):
    """Same structure, shapes and dtypes; numbers to some units of rounding of their size."""
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        if jnp.issubdtype(b.dtype, jnp.inexact):
            size = max(1.0, float(np.max(np.abs(np.nan_to_num(b)), initial=0)))
            atol = units * size * float(max(jnp.finfo(b.dtype).eps, jnp.finfo(least).eps))
            wide = np.result_type(np.float64, b.dtype)
            np.testing.assert_allclose(a.astype(wide), b.astype(wide), rtol=0, atol=atol)
        else:
            np.testing.assert_array_equal(a, b)


# A dozen roundings in another order, at conditions of ten or so; a derivative has thrice as many.
VALUE, DERIVATIVE = 60, 180
# A gradient may be double, but parts of it may have been rounded to less.
LOW = {"float32": np.float32, "float16": np.float16, "conversions": np.float32}


def test_values(subtests):
    """By NumPy, as nothing is compiled; some of them by JAX, whose arrays they must be."""
    for name, (fun, y) in ZOO.items():
        y = jax.tree.map(jnp.asarray, y)
        with subtests.test(name=name):
            assert_same(run(whole(fun), y), run(fun, y), VALUE)
    for name in ("arithmetic", "constants out", "complex"):
        fun, y = ZOO[name]
        want = jax.jit(fun)(y)
        for got in (whole(fun)(jnp.asarray(y)), jax.jit(whole(fun))(y)):
            with subtests.test(name=f"{name}, by JAX"):
                assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(got))
                assert_same(got, want, VALUE)


def test_entries_are_moved_as_jax_moves_them():
    """Padding, slices that begin outside of the array too, and operations that are alike but for
    a parameter.
    """

    def fun(y):
        m = jnp.outer(y, Y)
        padded = [
            (lax.pad(y, y[0] * 2, [config]), lax.pad(m, 7.0, [config] * 2))
            for config in ((2, 1, 0), (-1, 2, 0), (1, -2, 1), (-2, -1, 2), (0, -1, 0))
        ]
        sliced = [
            (
                lax.dynamic_slice_p.bind(m, np.int32(k), np.int32(1), slice_sizes=(2, 2)),
                lax.dynamic_update_slice_p.bind(m, m[:2, :2] + 1, np.int32(k), np.int32(k)),
            )
            for k in (-9, -1, 0, 1, 2, 9)
        ]
        k = lax.iota(np.int32, 3)
        n = jnp.stack([k, k + 1, 2 * k])
        firsts = lax.argmax(n, 0, np.int32), lax.argmax(n, 1, np.int32)
        places = *firsts, lax.cumsum(k), lax.cumsum(k, reverse=True) % 3
        return padded, sliced, [y[x] for x in places]

    assert_same(run(whole(fun), Y), run(fun, Y), VALUE)


def test_branches_and_loops_are_left_alone():
    for fun in (
        lambda y: lax.cond(y[0] > 0, jnp.sin, jnp.cos, y),
        lambda y: lax.fori_loop(0, 3, lambda _, x: x * y, y),
        lambda y: cfjax.flow(cfjax.LeftMatrix(jnp.outer(y, y)), y),
    ):
        assert program.read(fun, jnp.asarray(Y)) is None
    assert program.read(jnp.sin, jnp.asarray(Y)) is not None


def test_a_loop_over_the_parts_of_an_array_that_stays_whole():
    """As the coefficients of a method of many stages for output within a step."""
    table = jnp.asarray(np.linspace(-1, 1, 120).reshape(3, 10, 4))

    def fun(y):
        return over_stages(lambda y, part: (jnp.cos(y) * part[0, :3], jnp.sum(part) * y), y, table)

    assert program.read(fun, jnp.asarray(Y)) is not None
    assert_same(run(whole(fun), Y), run(fun, Y), VALUE)


QUICK = ("custom jvp",)
# A custom_vjp function has a reverse mode only, once; and flags have no sign.
SKIPPED = {
    "custom vjp": ("jvp", "jvp of grad", "grad of grad"),
    "integers and flags": ("vmap", "grad of vmap", "vmap of vmap"),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in ZOO]
)
def test_derivatives_and_batches(name):
    """Forward over reverse, reverse over reverse, vmap of vmap and grad of vmap among them."""
    fun, y = ZOO[name]
    kinds = {name: kind for name, (kind, is_compiled) in KINDS.items() if not is_compiled} | {
        "grad of grad": lambda f: gradient(gradient(f)),
        "vmap of vmap": lambda f: batch(batch(f)),
    }
    chosen = [k for k in kinds if k not in SKIPPED.get(name, ())]
    plain = lambda y, _: fun(y)  # noqa: E731
    all_of = lambda f: lambda y: {kind: kinds[kind](f)(y, []) for kind in chosen}  # noqa: E731
    y = jax.tree.map(jnp.asarray, y)
    got, want = run(all_of(rewritten(plain)), y), run(all_of(plain), y)
    for kind in chosen:
        units = VALUE if kind in ("value", "vmap", "vmap of vmap") else DERIVATIVE
        assert_same(got[kind], want[kind], units, LOW.get(name, np.float64))


def test_entries_without_use_are_not_singular_in_second_derivatives():
    """A root of all entries, of which one is used: the others must be what they are, not zero."""
    y, funs = jnp.asarray([0.4, 0.9, 1.6]), (jnp.sqrt, jnp.log, lambda y: 1 / y)

    def second(fun, first):
        return jax.jacfwd(first(whole(lambda y: jnp.concatenate([fun(y)[1:2], y]))))

    def all_of(y):
        return [[second(fun, first)(y) for first in (jax.jacfwd, jax.jacrev)] for fun in funs]

    for fun, found in zip(funs, run(all_of, y), strict=True):
        want = np.zeros((4, 3, 3))
        want[0, 1, 1] = jax.grad(jax.grad(fun))(0.9)
        for got in found:
            # One operation of size 3.
            np.testing.assert_allclose(got, want, rtol=1e-15)


def test_the_gradient_of_a_batch_that_meets_what_is_in_none():
    """A stack of what has the axis of a batch and what does not."""
    y, p = jnp.asarray(np.arange(210.0).reshape(70, 3)), jnp.ones((70, 3))
    f = lambda y: scalarised(lambda y: jnp.stack([y, p], -2), y)  # noqa: E731
    batch = jnp.stack([y, 2 * y])
    got = run(jax.grad(lambda ys: jnp.sum(jax.vmap(f)(ys) ** 2)), batch)
    np.testing.assert_array_equal(got, 2 * batch)


def test_custom_vmap_rule_is_kept():
    fun = lambda y: odd_vmap(y) + y  # noqa: E731
    batch = jnp.stack([Y, W])
    np.testing.assert_allclose(run(alone(fun), Y), 3 * Y, rtol=1e-15)
    np.testing.assert_allclose(run(jax.vmap(whole(fun)), batch), 4 * batch, rtol=1e-15)


def test_special_values_stay_where_they_are():
    funs = lambda y: y, lambda y: y * 1.0, lambda y: jnp.where(y == y, y, 0.0), jnp.sqrt
    ys = jnp.asarray([[0.5, bad, 2.0] for bad in (np.nan, np.inf, -0.0)])
    got = jax.jit(lambda ys: [[whole(fun)(y) for fun in funs] for y in ys])(ys)
    want = run(lambda ys: [[fun(y) for fun in funs] for y in ys], ys)
    np.testing.assert_array_equal(got, want)
    np.testing.assert_array_equal(np.signbit(got), np.signbit(want))
    # A cotangent that is not finite stays in its component too.
    last = jax.grad(lambda y: jnp.sum(whole(lambda y: 1 / y[1:] * y[0])(y)[1:]))
    assert np.isfinite(run(last, jnp.asarray([1.0, 0.0, 2.0]))[2])


def test_effects_happen_once_and_in_order(capsys):
    def fun(y):
        jax.debug.print("start", ordered=True)
        jax.debug.print("{} {}", y[1], y, ordered=True)
        return y * jnp.sum(y)

    with np.printoptions(precision=3):
        jax.block_until_ready(jax.jit(alone(fun))(jnp.asarray(Y)))
        jax.effects_barrier()
    assert capsys.readouterr().out.splitlines() == ["start", "-0.7 [ 0.3 -0.7  1.1]"]


def test_effects_happen_once_in_a_derivative_too():
    seen = []

    def fun(y):
        io_callback(lambda: seen.append(1), None)
        return y * jnp.sum(y)

    slope = jax.jit(jax.grad(lambda y: jnp.sum(scalarised(fun, y))))(jnp.asarray(Y))
    jax.effects_barrier()
    np.testing.assert_allclose(slope, 2 * Y.sum(), rtol=1e-15)  # Four roundings.
    assert seen == [1]


def test_callback_without_arguments():
    shape = jax.ShapeDtypeStruct((), jnp.float64)
    fun = lambda y: y * jax.pure_callback(lambda: np.float64(3.0), shape)  # noqa: E731
    np.testing.assert_array_equal(scalarised(fun, jnp.asarray(Y)), 3 * Y)


def test_error_if_still_raises():
    fun = lambda y: eqx.error_if(y * y, jnp.any(y > 1), "too large") * y  # noqa: E731
    with pytest.raises(Exception, match="too large"):
        jax.block_until_ready(jax.jit(alone(fun))(jnp.asarray(Y)))
    assert np.isfinite(jax.jit(alone(fun))(jnp.asarray(Y) / 2)).all()


def test_axis_name():
    batch = jnp.stack([jnp.asarray(Y), jnp.asarray(W)])
    fun = lambda y: y / lax.psum(y, "i") + lax.axis_index("i").astype(float)  # noqa: E731
    got = jax.vmap(alone(fun), axis_name="i")(batch)
    want = batch / batch.sum(0, keepdims=True) + np.array([[0.0], [1.0]])
    np.testing.assert_allclose(got, want, rtol=1e-15)


def test_random_keys_as_state():
    y = {"a": jnp.asarray(Y), "key": KEY, "keys": jax.random.split(KEY, 2)}

    def fun(y):
        noise = jax.random.normal(y["key"], (3,), jnp.float64)
        return y["a"] * noise, y["keys"], jax.random.bits(y["keys"][1], (2,))

    expected, (a, keys, bits) = run(fun, y), run(alone(fun), y)
    np.testing.assert_allclose(a, expected[0], rtol=1e-15)
    np.testing.assert_array_equal(jax.random.key_data(keys), jax.random.key_data(y["keys"]))
    np.testing.assert_array_equal(bits, expected[2])


def test_constants_overflow_as_in_jax():
    def fun(y):
        return (
            y * jnp.sum(np.array([1e308, 1e308])),
            y * jnp.dot(np.array([1e200, 1.0]), np.array([1e200, 1.0])),
            y * jnp.dot(INTS * 2**62, INTS * 2**62).astype(float),
        )

    # Without the warnings that numpy's own scalars give.
    for got, want in zip(whole(fun)(jnp.asarray(Y)), fun(jnp.asarray(Y)), strict=True):
        np.testing.assert_array_equal(got, want)


def test_python_numbers_as_state():
    got = scalarised(lambda y: (y[0] * y[1], y[0]), (1.5, jnp.asarray(Y)))
    np.testing.assert_array_equal(got[0], 1.5 * Y)
    assert got[1] == 1.5


def test_errors_of_the_function_come_through():
    with pytest.raises(ZeroDivisionError):
        scalarised(lambda y: y * (1 // 0), jnp.asarray(Y))
    with pytest.raises(TypeError):
        scalarised(lambda y: y @ jnp.ones(4), jnp.asarray(Y))


ON_NUMBERS = [
    lambda y: jnp.cross(W, y * y) + (y @ M) * (y @ y) - jnp.stack([y[1], y[2], y[0]]),
    lambda y: jnp.array([[y[0], -y[1]], [y[1], y[2]]]) @ y[:2],
    lambda y: jnp.einsum("ij,j,k->ik", M, y, y)[1],
    lambda y: jnp.concatenate([y[1:], y[:1]]) / jnp.linalg.norm(y),
    lambda y: (2 * y).at[1].set(y[0]).at[1:].add(y[:2]).at[-1].multiply(3),
    lambda y: y[np.array([2, 0, 1])] * y[jnp.array([0, 0, 1])] + jnp.roll(y, 1),
    lambda y: jnp.kron(M[:2, :2], jnp.outer(y, y)[1:, 1:])[0] + jnp.tril(jnp.outer(y, y))[2, 0],
    lambda y: jnp.vstack([y, y * 2]).T.reshape(6)[::2] + jnp.prod(y) + jnp.max(y),
    lambda y: jnp.split(jnp.pad(y, 1), [2, 4])[1] * jnp.outer(y, y)[0, :2],
    lambda y: y * lax.stop_gradient(y * y),
]


def test_no_small_array_is_built_inside():
    """The reason for the file: however it is written, arithmetic is on numbers alone."""
    program = lowered(whole(lambda y: [f(y) for f in ON_NUMBERS]), Y).jaxpr
    arithmetic = {"add", "div", "dot_general", "max", "mul", "reduce_sum", "sqrt", "sub"}
    avals: list[Any] = [e.outvars[0].aval for e in program.eqns]
    names = (e.primitive.name for e in program.eqns)
    sizes = [(name, math.prod(x.shape)) for name, x in zip(names, avals, strict=True)]
    on_numbers = [size == 1 for name, size in sizes if name in arithmetic]
    assert len(on_numbers) > 100 and all(on_numbers)


def test_the_switch():
    """It is read where a program is traced, and compiled solves obey it, for the same arguments."""
    solve = jax.jit(whole(lambda y: jnp.cross(W, y * y)))
    texts = []
    for on in (True, False, True):
        with cfjax.rewriting(on):
            assert ("cfjax_step" in str(jax.make_jaxpr(solve)(Y))) == on
            texts.append(solve.lower(jnp.asarray(Y)).as_text())
    assert texts[0] == texts[2] != texts[1]


@pytest.mark.parametrize("rule", ["length", "_evaluate"])
def test_what_cannot_be_read_runs_as_it_is(rule, monkeypatch):
    """As on a JAX that is not known yet."""

    def fail(*args):
        raise KeyError("dimension")

    monkeypatch.setattr(program, rule, fail)
    fun = lambda y: jnp.cross(W, y) @ M  # noqa: E731
    with pytest.warns(RuntimeWarning, match="could not rewrite a program .* KeyError: 'dimension'"):
        got = jax.jit(whole(fun))(jnp.asarray(Y))
    np.testing.assert_allclose(got, fun(Y), rtol=0, atol=1e-15)
