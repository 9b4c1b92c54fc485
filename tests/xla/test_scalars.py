"""`scalarised`: the same numbers as the function itself, under every transformation."""

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.experimental import io_callback
from xla.interpreter import lowered

import cfjax
from cfjax._xla import program, scalarised
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


def loops(y):
    total, _ = lax.scan(lambda c, w: (c * jnp.cos(w * y) + y, c[0]), y, jnp.asarray(W))
    return lax.fori_loop(0, 3, lambda i, c: c + jnp.sin(c) * y, total)


def closed_over_scan(y):
    # The body closes over y, so y is a constant of the inner program.
    return lax.scan(lambda c, _: (c + y @ M / (1 + c * c), c @ y), y, length=3)


# Functions of a vector (3,): arithmetic with rules of its own, and what has none.
VECTOR = {
    "identity": lambda y: y,
    "twice the same output": lambda y: (y, y, y[0], y),
    "arithmetic": lambda y: (2.0 * y - y * W + 1.0) / (3.0 + y) - (-y) / W + y / 7.0,
    "scalar with vector": lambda y: y[0] * y + y / y[2] - y[1],
    "length one with vector": lambda y: y[:1] * y + y / (2.0 + y[2:] * y[2:]),
    "cross": lambda y: jnp.cross(W, y) + jnp.cross(y, jnp.cross(y, W)),
    "dot": lambda y: (y @ y, y @ W, W @ y, jnp.vdot(y * y, W)),
    "matrix products": lambda y: M @ y + y @ M + M.T @ (y * y) + (y @ M) @ M,
    "matrix of y": lambda y: (jnp.outer(y, jnp.asarray(W)) @ y, jnp.diag(y) @ W, jnp.outer(y, y)),
    "other lengths": lambda y: (M[:2] @ y, y @ M[:, :1], np.ones((6, 3)) @ y, np.ones((8, 3)) @ y),
    "einsum": lambda y: (
        jnp.einsum("i,i->i", y, W),
        jnp.einsum("i,ij,j->", y, M, y),
        jnp.einsum("i,ij,j->i", y, M, y),
        jnp.einsum("ij,i->ji", M, y),
        jnp.einsum("i,->i", y, y[0]),
    ),
    "dot_general": lambda y: (
        lax.dot_general(y, y, (((), ()), ((0,), (0,)))),
        lax.dot_general(y, jnp.asarray(M), (((0,), (1,)), ((), ()))),
        lax.dot_general(jnp.asarray(M), y, (((0,), (0,)), ((), ()))),
        jnp.tensordot(y, y[1], axes=0),
    ),
    "indices": lambda y: (y[0], y[-1], y[1:], y[::-1], y[::2], y[:0], y[None, :], y[1:2]),
    "fancy indices": lambda y: (y[np.array([1, 2, 0])], y[jnp.argsort(y)], y[jnp.argmax(y)]),
    "traced index": lambda y: lax.dynamic_slice(y, ((y[0] > 0).astype(int),), (2,)),
    "update": lambda y: y.at[1].set(y[0] * y[2]).at[:2].add(y[1:]),
    "stack": lambda y: jnp.stack([y[2], y[0] * y[1], jnp.sin(y[1])]) + jnp.stack([y, y])[1],
    "concatenate": lambda y: (
        jnp.concatenate([y[1:], y[:1]]) * jnp.concatenate([y[:0], y]),
        jnp.concatenate([y, y, y]),
    ),
    "long in the middle": lambda y: jnp.concatenate([y, y * y, jnp.sin(y)])[2:6] * 2.0,
    "reshape": lambda y: (y[:1].reshape(()), y.reshape(3, 1) @ y[None], jnp.squeeze(y[1:2])),
    "broadcast": lambda y: jnp.broadcast_to(y[1], (3,)) * y + jnp.broadcast_to(y[:1], (3,)),
    "matrix in between": lambda y: jnp.sum(jnp.broadcast_to(y, (2, 3)) * 2.0, axis=0),
    "norm": lambda y: y / jnp.linalg.norm(y) + jnp.linalg.norm(y[:2]),
    "reductions": lambda y: (
        jnp.sum(y),
        jnp.prod(y),
        jnp.max(y),
        jnp.min(y),
        jnp.mean(y),
        jnp.cumsum(y),
        jnp.any(y > 0),
    ),
    "where": lambda y: jnp.where(y > 0, y * y, 3.0) + jnp.where(y[0] > 0, y, -y),
    "safe where": lambda y: jnp.where(y > 0, jnp.log(jnp.where(y > 0, y, 1.0)), 0.0),
    "cond": lambda y: lax.cond(y[0] > 0, lambda z: jnp.sin(z) * z, lambda z: y, y * y),
    "switch": lambda y: lax.switch((y[2] > 0).astype(int), [lambda: y, lambda: y * y]),
    "loops": loops,
    "closed over scan": closed_over_scan,
    "elementary": lambda y: (
        jnp.exp(y) * jnp.sin(y) + jnp.cos(y * y) - jnp.tanh(y) * jnp.arctan(y),
        jnp.log(2.0 + y) * jnp.sqrt(2.0 + y) + jnp.expm1(y) + jnp.log1p(y * y),
        jnp.arctan2(y, y[0]) + jnp.cbrt(2.0 + y) + jax.scipy.special.erf(y) + lax.rsqrt(2.0 + y),
    ),
    "two of one": lambda y: jnp.exp(y) * jnp.exp(y) + jnp.sin(jnp.exp(y)),
    "powers": lambda y: (
        y**3 + y**-2 + jnp.square(y) + 2.0**y + (y * y) ** 0.3,
        jnp.power(y * y, y),
    ),
    "kinks": lambda y: jnp.clip(y, -0.5, 0.9) + jnp.abs(y) + jnp.sign(y) + jnp.maximum(y, y[0]),
    "rounding": lambda y: jnp.floor(y) + jnp.ceil(y) * jnp.round(y) + y % 0.4 + jnp.fmod(y, 0.25),
    "network functions": lambda y: (
        jax.nn.relu(y) + jax.nn.sigmoid(y) * jax.nn.softplus(y),
        jax.nn.softmax(y) + jax.nn.gelu(y),
        jax.nn.silu(y) + jax.nn.logsumexp(y),
    ),
    "network": lambda y: MLP(y),
    "custom jvp": lambda y: odd_jvp(y * y) + jax.jit(odd_jvp)(y),
    "checkpoint": jax.checkpoint(lambda y: jnp.sin(y) * jnp.exp(y @ y) * y),
    "jit in jit": jax.jit(lambda y: jax.jit(lambda a, b: (b * a, a))(y, y[0])),
    "sort": lambda y: jnp.sort(y) * W + jnp.sort(-y),
    "conversions": lambda y: (
        y.astype(jnp.float32) * 2.0,
        (10.0 * y).astype(jnp.int32),
        (y > 0).astype(jnp.int32) * 3,
        ~(y > 0) & (y < 1) | (y == 0),
    ),
    "integers": lambda y: (
        (10.0 * y).astype(int) // INTS,
        (10.0 * y).astype(int) % INTS,
        INTS @ INTS + (y[0] > 0).astype(int),
        lax.rem((10.0 * y).astype(int), jnp.asarray(INTS)) * y.astype(int),
    ),
    "complex inside": lambda y: (
        jnp.abs(jnp.exp(1j * y.astype(complex)) + lax.complex(y, y * y)),
        jnp.real(lax.complex(y, y) * jnp.conj(lax.complex(y, -y * y))),
    ),
    "constants out": lambda y: (np.float32(2.0), jnp.asarray(M), jnp.asarray(W), y, jnp.zeros(3)),
    "nothing out": lambda y: (None, (), {"y": y}),
    "matrix functions": lambda y: jnp.linalg.solve(M + jnp.diag(y * y), y) + jnp.linalg.inv(M) @ y,
    "vmap inside": lambda y: jax.vmap(lambda a, b: a * jnp.sin(b), in_axes=(0, None))(y, y[0]),
    "gradient inside": lambda y: jax.grad(lambda z: jnp.sum(jnp.sin(z) * z) + z @ M @ z)(y),
    "hessian inside": lambda y: jax.hessian(lambda z: jnp.sum(jnp.exp(z) * z))(y) @ y,
    "random": lambda y: (
        y * jax.random.normal(KEY, (3,), jnp.float64)
        + jax.random.uniform(jax.random.fold_in(KEY, 1), (), jnp.float64)
    ),
    "many random": lambda y: (
        y + jax.vmap(lambda k: jax.random.normal(k, dtype=jnp.float64))(jax.random.split(KEY, 3))
    ),
    "error_if": lambda y: eqx.error_if(y * y, jnp.any(y > 100), "too large") * y,
}

TREE = {
    "float32": (lambda y: y * 2.0 + 1.0 / y - y[0] * 3 + jnp.sum(y), Y.astype(np.float32)),
    "float16": (lambda y: y * 2.0 + jnp.exp(y) * (y @ y), Y.astype(np.float16)),
    "complex": (
        lambda y: jnp.exp(y) * jnp.vdot(y, y) + y @ (M @ y.real).astype(complex) + y**2 / (2 + y),
        Y + 1j * W,
    ),
    "complex parts": (lambda y: (y.real * y.imag, jnp.abs(y), jnp.conj(y) * y[0]), Y + 1j * W),
    "length one": (lambda y: (y * y, y[0] * jnp.exp(y), y @ y, jnp.sum(y), y.reshape(())), Y[:1]),
    "empty": (lambda y: (jnp.exp(y["e"]), y["e"] * 2, jnp.sum(y["e"]) + y["a"]),
              {"a": Y, "e": np.zeros(0)}),
    "empty product": (lambda y: (np.zeros((3, 0)) @ y["e"], y["e"] @ y["e"], y["e"], y["a"]),
                      {"a": Y, "e": np.zeros(0)}),
    "long and short": (
        lambda y: (y["b"][0][:3] * y["a"], {"b": jnp.sin(y["b"][0]) * y["a"][1], "c": y["c"]}),
        {"a": Y, "b": (np.linspace(0.1, 1, 9),), "c": np.ones((2, 2))},
    ),
    "only long": (lambda y: jnp.sin(y) * y[0], np.linspace(0.1, 1, 9)),
    "length seven and eight": (lambda y: jnp.exp(y[0][:3]) * y[1][2] + y[1][5:], (
        np.linspace(0.1, 1, 7), np.linspace(0.1, 1, 8))),
    "scalars": (lambda y: (y[0] * y[1], y[1] ** 2, jnp.stack([y[1], y[1]])), (Y, np.asarray(0.4))),
    "integers and flags": (
        lambda y: (y["n"] * 2, ~y["b"], jnp.where(y["b"], y["a"], y["a"] * y["n"][1].astype(float)),
                   y["n"]),
        {"a": Y, "n": INTS, "b": np.array([True, False, True])},
    ),
}  # fmt: skip

U = np.array([[0.6 + 0.2j, -0.3j], [0.4 + 0.1j, 0.5 - 0.7j]])
MATRIX = {
    "moved entries": (
        lambda m: (m.T @ m[::-1], m[0], m[:, 1:], jnp.stack([m[0], m[:, 1]]), m.reshape(9)[2:5],
                   jnp.concatenate([m[1:], m[:1]]), jnp.concatenate([m, m], 1), m[1, 2], m[None]),
        M,
    ),
    "matrix arithmetic": (
        lambda m: (m * m[:1] - 2.0 / (3.0 + m), jnp.sin(m) * m[:, :1], jnp.sum(m, 0), jnp.trace(m),
                   jnp.linalg.norm(m), m[:1, :1] * m, jnp.where(m > 0, m, W), jnp.sum(m * m)),
        M,
    ),
    "products of matrices": (
        lambda m: (m @ m @ W, M @ m - m @ M, jnp.outer(m[0], m[:, 1]),
                   jnp.kron(m[:2, :2], m[1:, 1:]),
                   jnp.einsum("ij,kj->ki", m, m), jnp.einsum("ij,ij->i", m, m),
                   jnp.tensordot(m, m), jnp.sum(m[:, :, None] * m[None], axis=1)),
        M,
    ),
    "matrix and vector": (
        lambda y: (y["v"] * y["m"][0] @ y["m"].T, {"v": y["m"] @ jnp.cross(y["v"], W)}),
        {"m": M[:2], "v": Y},
    ), "complex matrix": (lambda u: (u @ u.conj().T, u.real * 2, jnp.exp(u) @ (u[0] * 1j)), U),
    "through a branch": (lambda m: lax.cond(m[0, 0] > 0, lambda m: m @ m, jnp.sin, m + 1.0), M),
    "too many": (lambda y: [jnp.cross(y[0] @ y[1], y[1]), y[1] @ y[2]], [M, M + 1, M * 2]), "held":
    (lambda m: (materialised([m, m * m])[1] @ m, *materialised([m[0, 0], m[0, 1] * m[2, 2]])), M),
}  # fmt: skip

ZOO = {
    **{name: (fun, Y) for name, fun in VECTOR.items()},
    **TREE,
    **MATRIX,
    "custom vjp": (lambda y: odd_vjp(y * y) + jax.jit(odd_vjp)(y), Y),
}
ALL = pytest.mark.parametrize("name", ZOO)
# A custom_vjp function has a reverse mode only, once.
NO_FORWARD_MODE = ["custom vjp"]


def halves(y):
    """The floating leaves of y as a list, and the way back to y."""
    leaves, treedef = jax.tree.flatten(jax.tree.map(jnp.asarray, y))
    moving = [i for i, x in enumerate(leaves) if jnp.issubdtype(x.dtype, jnp.inexact)]

    def back(xs):
        new = dict(zip(moving, xs, strict=True))
        return treedef.unflatten([new.get(i, x) for i, x in enumerate(leaves)])

    return [leaves[i] for i in moving], back


def inexact(out):
    return [
        x for x in map(jnp.asarray, jax.tree.leaves(out)) if jnp.issubdtype(x.dtype, jnp.inexact)
    ]


def loss_of(fun, back):
    """A scalar that every floating output enters with weights of its own, and quadratically.

    The square makes the value of the function, not only its derivative, enter second derivatives.
    """

    def loss(xs):
        total = jnp.zeros(())
        for k, x in enumerate(inexact(fun(back(xs)))):
            parts = (x.real, x.imag) if jnp.iscomplexobj(x) else (x,)
            for part in parts:
                wide = part.astype(float)
                weights = np.cos(np.arange(wide.size) + k).reshape(wide.shape)
                total = total + jnp.sum(weights * wide) + jnp.sum(wide * wide) / 3
        return total

    return loss


def whole(fun):
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
# The loss below is double, but its parts may have been rounded to less.
LOW = {"float32": np.float32, "float16": np.float16, "conversions": np.float32}


@pytest.mark.representatives(10)
@ALL
def test_values(name):
    fun, y = ZOO[name]
    y = jax.tree.map(jnp.asarray, y)
    want = jax.jit(fun)(y)
    assert_same(jax.jit(whole(fun))(y), want, VALUE)


@pytest.mark.parametrize("config", [(2, 1, 0), (-1, 2, 0), (1, -2, 1), (-2, -1, 2), (0, -1, 0)])
def test_padding_is_moved_as_jax_moves_it(config):
    def fun(y):
        return lax.pad(y, y[0] * 2, [config]), lax.pad(jnp.outer(y, Y), 7.0, [config] * 2)

    assert_same(jax.jit(whole(fun))(Y), jax.jit(fun)(Y), VALUE)


@pytest.mark.parametrize("start", [-9, -1, 0, 1, 2, 9])
def test_slices_are_moved_as_jax_moves_them(start):
    """Slices that begin outside of the array too."""

    def fun(y):
        m = jnp.outer(y, Y)
        row = lax.dynamic_slice_p.bind(m, np.int32(start), np.int32(1), slice_sizes=(2, 2))
        put = lax.dynamic_update_slice_p.bind(m, m[:2, :2] + 1, np.int32(start), np.int32(start))
        return row, put

    assert_same(jax.jit(whole(fun))(Y), jax.jit(fun)(Y), VALUE)


def test_what_is_known_is_of_this_operation():
    """Two operations are alike but for a parameter."""

    def fun(y):
        k = lax.iota(np.int32, 3)
        m = jnp.stack([k, k + 1, 2 * k])
        firsts = lax.argmax(m, 0, np.int32), lax.argmax(m, 1, np.int32)
        return [y[x] for x in (*firsts, lax.cumsum(k), lax.cumsum(k, reverse=True) % 3)]

    assert_same(jax.jit(whole(fun))(Y), jax.jit(fun)(Y), VALUE)


@pytest.mark.parametrize(
    "fun",
    [
        lambda y: lax.cond(y[0] > 0, jnp.sin, jnp.cos, y),
        lambda y: lax.fori_loop(0, 3, lambda _, x: x * y, y),
        lambda y: cfjax.flow(cfjax.LeftMatrix(jnp.outer(y, y)), y),
    ],
    ids=["branches", "loop", "exponential of a matrix"],
)
def test_branches_and_loops_are_left_alone(fun):
    assert program.read(fun, jnp.asarray(Y)) is None
    assert program.read(jnp.sin, jnp.asarray(Y)) is not None


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["arithmetic", "elementary", "constants out", "integers", "loops"])
def test_values_outside_of_jit(name):
    fun, y = ZOO[name]
    got, want = scalarised(fun, jnp.asarray(y)), jax.jit(fun)(y)
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(got))
    assert_same(got, want, VALUE)


@pytest.mark.representatives(2)
@ALL
def test_derivatives(name):
    """Value, gradient, forward over reverse and reverse over reverse, in one program."""
    fun, y = ZOO[name]
    xs, back = halves(y)
    if any(jnp.iscomplexobj(x) for x in xs):
        # A real line through the complex point: second derivatives of real functions.
        real, imag = xs[0].real, xs[0].imag
        xs, back = [real], lambda parts, back=back: back([lax.complex(parts[0], imag)])
    dxs = [jnp.linspace(1.0, -0.7, x.size).reshape(x.shape).astype(x.dtype) for x in xs]

    @jax.jit
    def run(xs, dxs):
        results = []
        for f in (fun, whole(fun)):
            loss = loss_of(f, back)
            if name in NO_FORWARD_MODE:
                results.append((jax.value_and_grad(loss)(xs),))
                continue

            def slope(xs, loss=loss):
                pairs = zip(jax.grad(loss)(xs), dxs, strict=True)
                return sum((jnp.vdot(g, d).astype(float) for g, d in pairs), start=jnp.zeros(()))

            results.append(
                (
                    *jax.jvp(jax.value_and_grad(loss), (xs,), (dxs,)),
                    jax.grad(slope)(xs),
                )
            )
        return results

    want, got = run(xs, dxs)
    assert_same(got, want, DERIVATIVE, LOW.get(name, np.float64))


@pytest.mark.representatives(3)
@ALL
def test_batches(name):
    """vmap, vmap of vmap, vmap of grad and grad of vmap."""
    fun, y = ZOO[name]
    xs, back = halves(y)
    # Two by two systems, near each other so that no branch or kink is special.
    factors = np.array([[1.0, 0.95], [0.9, 1.05]])
    batch = [
        jnp.stack([jnp.stack([x * jnp.asarray(c, x.dtype) for c in row]) for row in factors])
        for x in xs
    ]

    @jax.jit
    def run(batch):
        results = []
        for f in (fun, whole(fun)):
            value = jax.vmap(jax.vmap(lambda xs, f=f: f(back(xs))))(batch)
            gradient = jax.vmap(jax.vmap(jax.grad(loss_of(f, back))))(batch)
            mean = lambda batch, f=f: jnp.sum(  # noqa: E731
                jnp.cos(jax.vmap(loss_of(f, back))([b[0] for b in batch]))
            )
            results.append((value, gradient, jax.grad(mean)(batch)))
        return results

    want, got = run(batch)
    assert_same(got[0], want[0], VALUE)
    assert_same(got[1:], want[1:], DERIVATIVE, LOW.get(name, np.float64))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [1, 3])
def test_jacobians_and_hessians(n):
    """jacfwd and jacrev put a batch of tangents on functions that are in no batch themselves."""
    y = jnp.asarray(np.linspace(0.4, 1.6, n))
    fun = lambda y: jnp.sum(jnp.exp(y) * y) / (1 + y @ y)  # noqa: E731
    # Its derivatives by hand.
    top, slope, curve = np.exp(y) * y, np.exp(y) * (y + 1), np.exp(y) * (y + 2)
    a, b = np.sum(top), 1 + np.vdot(y, y)
    mixed, square = np.outer(slope, y), np.outer(y, y)
    gradient = slope / b - 2 * a * y / b**2
    hessian = np.diag(curve) / b - 2 * (mixed + mixed.T) / b**2
    hessian = hessian - 2 * a * np.eye(n) / b**2 + 8 * a * square / b**3
    f = whole(fun)
    modes = (jax.jacfwd, jax.jacrev)

    @jax.jit
    def run(y):
        hessians = [second(first(f))(y) for first in modes for second in modes]
        batch = jax.vmap(jax.hessian(f))(jnp.stack([y, y]))
        return [mode(f)(y) for mode in modes], [*hessians, batch[0], batch[1]]

    gradients, hessians = run(y)
    # Sums of four terms of size 20 at most.
    for got in gradients:
        np.testing.assert_allclose(got, gradient, rtol=0, atol=1e-13)
    for got in hessians:
        np.testing.assert_allclose(got, hessian, rtol=0, atol=1e-13)


@pytest.mark.parametrize("fun", [jnp.sqrt, jnp.log, lambda y: 1 / y])
@pytest.mark.parametrize("first", [jax.jacfwd, jax.jacrev])
def test_entries_without_use_are_not_singular_in_second_derivatives(fun, first):
    """A root of all entries, of which one is used: the others must be what they are, not zero."""
    y = jnp.asarray([0.4, 0.9, 1.6])
    f = lambda y: jnp.concatenate([fun(y)[1:2], y])  # noqa: E731
    got = jax.jit(jax.jacfwd(first(whole(f))))(y)
    want = np.zeros((4, 3, 3))
    want[0, 1, 1] = jax.grad(jax.grad(fun))(0.9)
    # One operation of size 3.
    np.testing.assert_allclose(got, want, rtol=1e-15)


def test_the_gradient_of_a_batch_that_meets_what_is_in_none():
    """A stack of what has the axis of a batch and what does not."""
    y, p = jnp.asarray(np.arange(210.0).reshape(70, 3)), jnp.ones((70, 3))
    f = lambda y: scalarised(lambda y: jnp.stack([y, p], -2), y)  # noqa: E731
    batch = jnp.stack([y, 2 * y])
    got = jax.grad(lambda ys: jnp.sum(jax.vmap(f)(ys) ** 2))(batch)
    np.testing.assert_array_equal(got, 2 * batch)


def test_custom_vmap_rule_is_kept():
    fun = lambda y: odd_vmap(y) + y  # noqa: E731
    batch = jnp.stack([jnp.asarray(Y), jnp.asarray(W)])
    np.testing.assert_allclose(scalarised(fun, jnp.asarray(Y)), 3 * Y, rtol=1e-15)
    np.testing.assert_allclose(jax.vmap(whole(fun))(batch), 4 * batch, rtol=1e-15)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.0])
def test_special_values_stay_where_they_are(bad):
    y = jnp.asarray([0.5, bad, 2.0])
    for fun in (lambda y: y, lambda y: y * 1.0, lambda y: jnp.where(y == y, y, 0.0), jnp.sqrt):
        got, want = scalarised(fun, y), fun(y)
        np.testing.assert_array_equal(got, want)
        np.testing.assert_array_equal(np.signbit(got), np.signbit(want))
    # A cotangent that is not finite stays in its component too.
    gradient = jax.grad(lambda y: jnp.sum(scalarised(lambda y: 1 / y[1:] * y[0], y)[1:]))(
        jnp.asarray([1.0, 0.0, 2.0])
    )
    assert np.isfinite(gradient[2])


@pytest.mark.slow
def test_closing_over_traced_values():
    y, w, m = map(jnp.asarray, (Y, W, M))

    def scale(w, s, m):
        return scalarised(lambda y: jnp.exp(s * y) * w + m @ y / w, y)

    def plain(w, s, m):
        return jnp.exp(s * y) * w + m @ y / w

    np.testing.assert_allclose(jax.jit(scale)(w, 0.5, m), plain(w, 0.5, m), rtol=0, atol=1e-14)
    for argument in range(3):
        got = jax.jacrev(scale, argument)(w, 0.5, m)
        np.testing.assert_allclose(got, jax.jacrev(plain, argument)(w, 0.5, m), rtol=0, atol=1e-13)
    # A batch of closed-over values only: y itself is in no batch.
    got = jax.vmap(scale, (0, None, None))(jnp.stack([w, 2 * w]), 0.5, m)
    np.testing.assert_allclose(got[1], plain(2 * w, 0.5, m), rtol=0, atol=1e-14)
    got = jax.vmap(scale, (None, 0, None))(w, jnp.array([0.5, -0.1]), m)
    np.testing.assert_allclose(got[1], plain(w, -0.1, m), rtol=0, atol=1e-14)


def test_effects_happen_once_and_in_order(capsys):
    def fun(y):
        jax.debug.print("start", ordered=True)
        jax.debug.print("{} {}", y[1], y, ordered=True)
        return y * jnp.sum(y)

    with np.printoptions(precision=3):
        jax.block_until_ready(jax.jit(whole(fun))(jnp.asarray(Y)))
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
        jax.block_until_ready(jax.jit(whole(fun))(jnp.asarray(Y)))
    assert np.isfinite(jax.jit(whole(fun))(jnp.asarray(Y) / 2)).all()


def test_axis_name():
    batch = jnp.stack([jnp.asarray(Y), jnp.asarray(W)])
    fun = lambda y: y / lax.psum(y, "i") + lax.axis_index("i").astype(float)  # noqa: E731
    got = jax.vmap(whole(fun), axis_name="i")(batch)
    want = batch / batch.sum(0, keepdims=True) + np.array([[0.0], [1.0]])
    np.testing.assert_allclose(got, want, rtol=1e-15)


def test_random_keys_as_state():
    y = {"a": jnp.asarray(Y), "key": KEY, "keys": jax.random.split(KEY, 2)}

    def fun(y):
        noise = jax.random.normal(y["key"], (3,), jnp.float64)
        return y["a"] * noise, y["keys"], jax.random.bits(y["keys"][1], (2,))

    for run in (scalarised, jax.jit(scalarised, static_argnums=0)):
        a, keys, bits = run(fun, y)
        np.testing.assert_allclose(a, fun(y)[0], rtol=1e-15)
        np.testing.assert_array_equal(jax.random.key_data(keys), jax.random.key_data(y["keys"]))
        np.testing.assert_array_equal(bits, fun(y)[2])


@pytest.mark.parametrize(
    "fun",
    [
        lambda y: y * jnp.sum(np.array([1e308, 1e308])),
        lambda y: y * jnp.dot(np.array([1e200, 1.0]), np.array([1e200, 1.0])),
        lambda y: y * jnp.dot(INTS * 2**62, INTS * 2**62).astype(float),
    ],
    ids=["sum", "dot", "integer dot"],
)
def test_constants_overflow_as_in_jax(fun):
    # Without the warnings that numpy's own scalars give.
    np.testing.assert_array_equal(scalarised(fun, jnp.asarray(Y)), fun(jnp.asarray(Y)))


def turn(y, n):
    for k in range(n):
        y = jnp.cross(W, y * y) * 0.1 + y * (1 - 1 / (k + 2))
    return y


def test_derivatives_keep_the_inputs_alone():
    """Not the scalars in between, which the loops of diffrax would send through memory."""
    _, slope = jax.vjp(lambda y: scalarised(lambda y: turn(y, 10), y), jnp.asarray(Y))
    # The start, whole and as materialised entries. Without the rule there are 80 numbers.
    assert sum(x.size for x in jax.tree.leaves(slope)) <= 2 * Y.size


def test_python_numbers_as_state():
    got = scalarised(lambda y: (y[0] * y[1], y[0]), (1.5, jnp.asarray(Y)))
    np.testing.assert_array_equal(got[0], 1.5 * Y)
    assert got[1] == 1.5


def test_errors_of_the_function_come_through():
    with pytest.raises(ZeroDivisionError):
        scalarised(lambda y: y * (1 // 0), jnp.asarray(Y))
    with pytest.raises(TypeError):
        scalarised(lambda y: y @ jnp.ones(4), jnp.asarray(Y))


@pytest.mark.parametrize(
    "fun",
    [
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
    ],
    ids="cross matrix einsum concatenate at take kron vstack split stop".split(),
)
def test_no_small_array_is_built_inside(fun):
    """The reason for the file: however it is written, arithmetic is on numbers alone."""
    inside = lowered(whole(fun), jnp.asarray(Y)).jaxpr
    (program,) = [e.params["program"].jaxpr for e in inside.eqns if "program" in e.params]
    built = [
        e.primitive.name
        for e in program.eqns
        if e.primitive.name not in ("cfjax_pack", "cfjax_unpack", "reshape")
        and any(v.aval.shape != () for v in (*e.invars, *e.outvars))
    ]
    assert built == []


def test_the_switch():
    fun = lambda y: jnp.cross(W, y)  # noqa: E731
    once, twice = (lambda y: scalarised(fun, y) for _ in range(2))
    for run, on in ((once, True), (twice, False)):
        with cfjax.rewriting(on):
            names = [e.primitive.name for e in jax.make_jaxpr(run)(Y).jaxpr.eqns]
        assert ("cfjax_step" in names) == on


def test_a_compiled_solve_obeys_the_switch():
    """Though its arguments are the same."""
    solve = jax.jit(lambda y: scalarised(lambda y: jnp.cross(W, y * y), y))
    texts = []
    for on in (True, False, True):
        with cfjax.rewriting(on):
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


# Random programs. Each step appends to a list of values one that earlier ones determine.
UNARY = [
    ("sin", jnp.sin),
    ("exp", lambda a: jnp.exp(jnp.clip(a, -2, 2))),
    ("square", lambda a: a * a / (1 + a * a)),
    ("neg", lambda a: -a),
    ("reverse", lambda a: a[::-1]),
    ("roll", lambda a: jnp.concatenate([a[1:], a[:1]])),
    ("abs", jnp.abs),
    ("sum", lambda a: a * jnp.tanh(jnp.sum(a))),
    ("first", lambda a: jnp.full_like(a, 0.5) * a[0]),
    ("tail", lambda a: jnp.concatenate([a[:1], a[1:] * a[:1]])),
    ("cumsum", lambda a: jnp.tanh(jnp.cumsum(a))),
    ("sort", jnp.sort),
    ("jit", jax.jit(lambda a: a * 0.5 + a[-1])),
    ("max", lambda a: a - jnp.max(a)),
]
BINARY = [
    ("add", lambda a, b: a + b),
    ("mul", lambda a, b: jnp.tanh(a * b)),
    ("div", lambda a, b: a / (2 + b * b)),
    ("where", lambda a, b: jnp.where(a > b, a, 0.3 * b)),
    ("dot", lambda a, b: jnp.tanh(a @ b) * a),
    ("matrix", lambda a, b: jnp.tanh(jnp.outer(a, b) @ a)),
    ("pair", lambda a, b: jnp.concatenate([a, b])[1 : 1 + len(a)]),
    ("atan2", lambda a, b: jnp.arctan2(a, 3 + b)),
    ("minimum", jnp.minimum),
    ("length one", lambda a, b: a[:1] * b),
]


@pytest.mark.slow
@hypothesis.given(
    n=st.sampled_from([1, 2, 3, 4, 7, 8]),
    steps=st.lists(
        st.tuples(
            st.integers(0, len(UNARY) + len(BINARY) - 1), st.integers(0, 99), st.integers(0, 99)
        ),
        min_size=1,
        max_size=8,
    ),
)
# A first call compiles; and derandomised, so that the suite is the same on every run.
@hypothesis.settings(deadline=None, max_examples=40, derandomize=True, database=None)
def test_random_programs(n, steps):
    def fun(y):
        values = [y["a"], y["b"]]
        for op, i, j in steps:
            a, b = values[i % len(values)], values[j % len(values)]
            unary = op < len(UNARY)
            values.append(UNARY[op][1](a) if unary else BINARY[op - len(UNARY)][1](a, b))
        return values[2:]

    rng = np.random.default_rng(n)
    y = {"a": jnp.asarray(rng.normal(size=n)), "b": jnp.asarray(rng.normal(size=n))}
    # Eight steps that each amplify by less than ten, but rarely more than one of them.
    for got, want in zip(scalarised(fun, y), fun(y), strict=True):
        assert got.shape == want.shape
        np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-11)
