"""Fields on leading axes: every element moves as it does alone, whatever the method."""

from functools import partial
from operator import itemgetter
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import cfjax

RNG = np.random.default_rng(0)


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape))


A3, A6 = normal(3, 3), normal(6, 6)
FRAMES = jnp.asarray(np.linalg.qr(normal(4, 6, 2))[0])


class Written(cfjax.AbstractAlgebraElement):
    """A rotation as a user writes it, for one point."""

    w: jax.Array

    def flow(self, point):
        return cfjax.Rotation(self.w).flow(point)

    def tangent(self, point):
        return jnp.cross(self.w, point)

    def bracket(self, other):
        return Written(jnp.cross(self.w, other.w))


# The field of one element at x, how its coordinates become those of many, and many points. The
# other classes have their leading axes in test_contract.py.
FIELDS = {
    "Rotation": (lambda t, x: cfjax.Rotation(jnp.sin(A3 @ x + t)), normal(5, 3)),
    "LeftMatrix": (lambda t, x: cfjax.LeftMatrix(0.3 * jnp.cos(t) * A3 @ x), normal(4, 3, 3)),
    "LeftMatrix of vectors": (
        lambda t, x: cfjax.LeftMatrix(0.1 * jnp.outer(x, jnp.cos(x + t))),
        normal(2, 12),
    ),
    "Congruence": (
        lambda t, x: cfjax.Congruence(0.3 * jnp.cos(A3 @ x + t), jnp.sin(x)),
        normal(4, 3, 3),
    ),
    "LowRankSkew": (lambda t, x: cfjax.LowRankSkew(jnp.cos(t) * A6 @ x), FRAMES),
    "BorderedSkew": (lambda t, x: cfjax.BorderedSkew(jnp.cos(t) * A6 @ x), FRAMES),
    "SphereRotation": (lambda t, x: cfjax.SphereRotation(jnp.cos(t) * A6 @ x), FRAMES[..., 0]),
    "elementwise": (lambda t, x: Written(jnp.sin(A3 @ x + t)), normal(5, 3)),
    "elementwise of a pair": (lambda t, x: Pair(jnp.sin(A3 @ x["q"] + t)), None),
}


class Pair(cfjax.AbstractFrozenField):
    """One that acts on a subtree: a rotation of q, and p goes along."""

    acts_on_subtree = True
    w: jax.Array

    def flow(self, point):
        return {"q": cfjax.Rotation(self.w).flow(point["q"]), "p": point["p"] + self.w}

    def tangent(self, point):
        return {"q": jnp.cross(self.w, point["q"]), "p": self.w}


def points(name):
    if name == "elementwise of a pair":
        return {"q": normal(5, 3), "p": jnp.zeros((5, 3))}
    return jnp.asarray(FIELDS[name][1])


def of_all(name, num_axes=1):
    """The field of all elements at once."""
    one = FIELDS[name][0]

    def field(t, y, args):
        mapped = lambda y: one(t, y)  # noqa: E731
        for _ in range(num_axes):
            mapped = jax.vmap(mapped)
        made = mapped(y)
        return cfjax.elementwise(made, num_axes) if name.startswith("elementwise") else made

    return field


SOLVERS = {
    "CF2": cfjax.CF2(),
    "CF4": cfjax.CF4(),
    "CF54": cfjax.CF54(),
    "RKMK4": cfjax.RKMK4(),
    "CayleyRK4": cfjax.CayleyRK4(),
    "Richardson": cfjax.Richardson(cfjax.CF4()),
}
CASES = [
    ("Rotation", "CF2"),
    *((name, "CF4") for name in FIELDS),
    ("Rotation", "Richardson"),
    ("LowRankSkew", "CayleyRK4"),
    ("LowRankSkew", "CF54"),
    ("BorderedSkew", "RKMK4"),
    ("elementwise", "RKMK4"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "solver"), CASES)
def test_every_element_moves_as_it_does_alone(name, solver):
    y0 = points(name)

    @eqx.filter_jit
    def solve(y0, field):
        saveat = diffrax.SaveAt(ts=jnp.array([0.13, 0.7, 1.0]))
        terms = cfjax.LieTerm(field)
        return diffrax.diffeqsolve(terms, SOLVERS[solver], 0, 1, 0.1, y0, saveat=saveat).ys

    together = solve(y0, of_all(name))
    one = lambda t, y, args: FIELDS[name][0](t, y)  # noqa: E731
    for k in range(len(jax.tree.leaves(y0)[0])):
        found = jax.tree.map(itemgetter((slice(None), k)), together)
        alone = solve(jax.tree.map(itemgetter(k), y0), one)
        # The same operations, in another order at most: some roundings in each of ten steps.
        jax.tree.map(partial(np.testing.assert_allclose, rtol=0, atol=1e-13), found, alone)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["elementwise", "LowRankSkew", "LeftMatrix of vectors"])
def test_fields_keep_their_promises_on_two_leading_axes(name):
    y = points(name)
    y = jnp.stack([y, y[::-1]])
    fields = [of_all(name, 2)(t, y, None) for t in (0.0, 0.4, 1.1)]
    cfjax.check_field(fields, y)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["elementwise", "LowRankSkew", "LeftMatrix"])
def test_gradients(name):
    y0 = points(name)

    def end(field):
        def of(y0, scale):
            scaled = lambda t, y, args: cfjax.combine((scale,), (field(t, y, args),))  # noqa: E731
            term = cfjax.LieTerm(scaled)
            ys = cfjax.integrate(term, cfjax.LieEuler(), 0.0, 0.5, y0, num_steps=5).ys
            return jnp.sum(jnp.sin(ys[-1]))

        return jax.jit(jax.grad(of, argnums=(0, 1)))

    together = end(of_all(name))(y0, 1.0)
    one = end(lambda t, y, args: FIELDS[name][0](t, y))
    by_start, by_scale = zip(*(one(y, 1.0) for y in y0), strict=True)
    np.testing.assert_allclose(together[0], jnp.stack(by_start), rtol=0, atol=1e-12)
    np.testing.assert_allclose(together[1], sum(by_scale), rtol=1e-11)


# Batches without members: whatever is asked of them is an empty array.

EMPTY = (*FIELDS, "translation")


def empty(name):
    """The field of all members of an empty batch, and their states."""
    if name == "translation":
        return lambda t, y, args: jnp.cos(t) * y, jnp.zeros((0, 3))
    return of_all(name), jax.tree.map(lambda x: x[:0], points(name))


def assert_empty_like(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b, strict=True), found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", EMPTY)
def test_solves_of_an_empty_batch(name):
    """In steps that are given, controlled steps, and each member alone by `jax.vmap`."""
    field, y0 = empty(name)
    steps: Any = dict(t0=0.0, t1=1.0, num_steps=4, save_every=2)
    solve = partial(cfjax.integrate, solver=cfjax.LieEuler(), **steps)
    adaptive: Any = dict(stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-6))
    adaptive |= dict(saveat=diffrax.SaveAt(ts=jnp.asarray([0.3, 1.0])))

    def alone(y):
        one = FIELDS[name][0] if name in FIELDS else lambda t, x: jnp.cos(t) * x
        made = lambda t, y, args: one(t, y)  # noqa: E731
        return solve(cfjax.LieTerm(made), y0=y).ys

    def ends(y0):
        term = cfjax.LieTerm(field)
        controlled = diffrax.diffeqsolve(term, cfjax.CF3(), 0.0, 1.0, 0.25, y0, **adaptive)
        ends = [solve(term, y0=y0).ys, controlled.ys]
        if not name.startswith("elementwise"):
            ends.append(jnp.swapaxes(jax.vmap(alone)(y0), 0, 1))
        return ends

    saved = jax.tree.map(lambda y: jnp.zeros((2, *y.shape)), y0)
    for ys in jax.jit(ends)(y0):
        assert_empty_like(ys, saved)
    # Arrays without entries have no values but their shapes.
    total = lambda y0: sum(map(jnp.sum, jax.tree.leaves(ends(y0))))  # noqa: E731
    by_start = jax.eval_shape(jax.grad(total), y0)
    jax.tree.map(lambda a, b: np.testing.assert_equal(a.shape, b.shape), by_start, y0)


# LeftMatrix needs a maximum over the batch.
@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("name", "solver"), [("LeftMatrix", "RKMK4"), ("Rotation", "Richardson"), ("Rotation", "CF54")]
)
def test_an_empty_batch_by_other_methods(name, solver):
    field, y0 = empty(name)
    ys = cfjax.integrate(cfjax.LieTerm(field), SOLVERS[solver], 0.0, 1.0, y0, num_steps=2).ys
    assert_empty_like(ys, y0[None])


# Leading axes of the coordinates say how many there are; those of 1 are broadcast.


def test_the_coordinates_say_how_many_leading_axes_there_are():
    x, w = normal(3, 3), normal(3)
    columns = cfjax.Rotation(w).flow(x)
    rows = cfjax.Rotation(w[None]).flow(x)
    # One is a matrix whose columns turn, the other three vectors.
    np.testing.assert_allclose(rows, cfjax.Rotation(w).flow(x.T).T, rtol=0, atol=1e-15)
    assert jnp.max(jnp.abs(rows - columns)) > 0.1


def test_broadcasting():
    sides, x = [(1, 4), (3, 1), (1, 1), (3, 4)], normal(3, 4, 3)
    vectors = [normal(*side, 3) for side in sides]
    # Of norm 1, so that rounding does not grow.
    matrices = [normal(*side, 3, 3) for side in sides[:2]]
    matrices = [a / jnp.linalg.norm(a, axis=(-2, -1), keepdims=True) for a in matrices]

    @jax.jit
    def motions(vectors, matrices):
        turns = [cfjax.Rotation(w) for w in vectors]
        full = cfjax.Rotation(vectors[-1])
        brackets = [(a.bracket(full).omega, full.bracket(a).omega) for a in turns]
        return brackets, [w.flow(x) for w in (*turns, *map(cfjax.LeftMatrix, matrices))]

    brackets, flows = motions(vectors, matrices)
    for w, (there, back) in zip(vectors, brackets, strict=True):
        np.testing.assert_allclose(there, np.cross(w, vectors[-1]), rtol=0, atol=1e-15)
        np.testing.assert_array_equal(back, -there)
    angles = [np.linalg.norm(w, axis=-1, keepdims=True) for w in vectors]
    # By Rodrigues' formula.
    wants = [
        np.cos(r) * x
        + np.sin(r) / r * np.cross(w, x)
        + (1 - np.cos(r)) / r**2 * np.sum(w * x, -1, keepdims=True) * w
        for w, r in zip(vectors, angles, strict=True)
    ]
    wants += [(scipy.linalg.expm(a) @ np.asarray(x)[..., None])[..., 0] for a in matrices]
    for found, want in zip(flows, wants, strict=True):
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


def test_elementwise_has_the_closed_form_of_its_field():
    """Whatever the degree: of a turn by 3 the series to degree 2 is far off."""
    u, v = normal(2, 3), normal(2, 3)
    u = 3 * u / jnp.linalg.norm(u, axis=1, keepdims=True)
    a, b = (cfjax.elementwise(cfjax.Rotation(x)) for x in (u, v))
    assert isinstance(a, cfjax.AbstractAlgebraElement)
    found: Any = a.dexpinv(b, 2)
    want: Any = cfjax.Rotation(u).dexpinv(cfjax.Rotation(v), 2)
    np.testing.assert_allclose(found.field.omega, want.omega, rtol=0, atol=1e-15)
    assert a.has_dexpinv() and not cfjax.combine((3.0,), (a,)).has_dexpinv()


def test_what_is_broadcast_is_computed_once():
    a, x = jnp.ones((1, 5, 5)), jnp.ones((7, 5, 5))
    jaxpr = str(jax.make_jaxpr(lambda a, x: cfjax.LeftMatrix(a).flow(x))(a, x))
    # The squarings and polynomials of the exponential have no leading axis.
    products = [line for line in jaxpr.splitlines() if "dot_general" in line]
    assert sum("f64[7,5,5]" in line for line in products) < 4 < len(products)


def test_the_program_does_not_grow_with_the_batch():
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.sin(y + t)))

    def lines(n):
        def run(y0):
            return cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, y0, num_steps=5).ys

        return len(jax.jit(run).lower(jnp.ones((n, 3))).as_text().splitlines())

    # Few vectors are left as they are, many are scalarised.
    assert lines(7) == lines(20)
    assert lines(1000) == lines(2000)


def test_a_stiefel_step_keeps_one_span_for_its_stages():
    # Two equal blocks in it would be a sign that an array was taken for two.
    def numbers(y):
        start, entered = y, []
        for t in (0.0, 0.4, 1.1):
            field, start = cfjax.LowRankSkew(jnp.cos(t) * A6 @ y).to_chart(start, entered)
            entered.append(field)
        total: Any = cfjax.combine((1.0, 1.0, 1.0), entered)
        found.extend(len(x.field.span.blocks) for x in (entered[-1], total))

    found = []
    jax.eval_shape(numbers, FRAMES)
    assert found == [4, 4]


# What is refused, at trace time.
WRONG = [
    (
        lambda: cfjax.Rotation(np.ones((5, 3))),
        (4, 3),
        r"Rotation with omega of shape \(5, 3\) acts on shapes \(5, 3\) and \(5, 3, k\), got "
        r"\(4, 3\)",
    ),
    (
        lambda: cfjax.Rotation(np.ones((1, 4, 3))),
        (4, 3),
        r"acts on shapes \(l0, 4, 3\) and \(l0, 4, 3, k\), got \(4, 3\)",
    ),
    (
        lambda: cfjax.Rotation(np.ones(3)),
        (100, 3),
        r"got \(100, 3\). For one motion of each point give the coordinates leading axes: "
        r"omega of shape \(100, 3\), or \(1, 3\) for equal motions",
    ),
    (
        lambda: cfjax.LeftMatrix(np.ones((16, 3, 3))),
        (3, 3),
        r"a of shape \(16, 3, 3\) acts on shapes \(16, 3\) and \(16, 3, k\), got \(3, 3\)",
    ),
    (
        lambda: cfjax.LowRankSkew(np.ones((2, 6, 2))),
        (3, 6, 2),
        r"g of shape \(2, 6, 2\) acts on shapes \(2, 6, 2\), got \(3, 6, 2\)",
    ),
    (
        lambda: cfjax.elementwise(Written(jnp.ones((5, 3)))),
        (4, 3),
        r"leading axes must agree or be 1, got lengths \[4, 5\]",
    ),
]


def test_refuses(no_shape_hook, subtests):
    for field, shape, text in WRONG:
        term = cfjax.LieTerm(lambda t, y, args, field=field: field())
        with subtests.test(case=text), pytest.raises(ValueError, match=text):
            cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, np.ones(shape), num_steps=1)
    wrong: Any = np.ones(3)
    for call, error, text in [
        (lambda: cfjax.elementwise(wrong), TypeError, "field must be a frozen vector field, got"),
        (
            lambda: cfjax.elementwise(Written(jnp.ones((5, 3))), 0),
            TypeError,
            "num_axes must be a positive int, got 0",
        ),
        (
            lambda: cfjax.elementwise(Written(jnp.ones(5)), 2),
            ValueError,
            r"must have 2 leading axes, got shape \(5,\) for Written.w",
        ),
    ]:
        with subtests.test(case=text), pytest.raises(error, match=text):
            call()


def test_a_start_off_the_manifold_is_refused():
    y0 = FRAMES.at[2].multiply(1.001)
    term = cfjax.LieTerm(of_all("LowRankSkew"))
    with pytest.raises(RuntimeError, match="orthonormal columns"):
        cfjax.integrate(term, cfjax.LieEuler(), 0.0, 1.0, y0, num_steps=1)


def test_elementwise_of_elementwise_has_the_axes_of_both():
    field = cfjax.elementwise(cfjax.elementwise(Written(jnp.ones((5, 4, 3)))))
    x = normal(5, 4, 3)
    np.testing.assert_array_equal(field.flow(x), cfjax.Rotation(jnp.ones((1, 1, 3))).flow(x))
