"""Fields on leading axes: every element moves as it does alone, whatever the method."""

from functools import partial
from operator import itemgetter

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


def of_matrices(cls, x, t):
    return cls(0.3 * jnp.cos(t) * A3 @ x)


# The field of one element at x, how its coordinates become those of many, and many points.
FIELDS = {
    "Rotation": (lambda t, x: cfjax.Rotation(jnp.sin(A3 @ x + t)), normal(5, 3)),
    "Rotation of matrices": (
        lambda t, x: cfjax.Rotation(jnp.sin(A3 @ x[:, 0] + t)),
        normal(5, 3, 2),
    ),
    "LeftMatrix": (
        lambda t, x: of_matrices(cfjax.LeftMatrix, x, t),
        normal(4, 3, 3),
    ),
    "RightMatrix": (
        lambda t, x: of_matrices(cfjax.RightMatrix, x, t),
        normal(4, 3, 3),
    ),
    "LeftMatrix of vectors": (
        lambda t, x: cfjax.LeftMatrix(0.1 * jnp.outer(x, jnp.cos(x + t))),
        normal(2, 12),
    ),
    "Conjugation": (
        lambda t, x: of_matrices(cfjax.Conjugation, x, t),
        normal(4, 3, 3),
    ),
    "Congruence": (
        lambda t, x: cfjax.Congruence(0.3 * jnp.cos(A3 @ x + t), jnp.sin(x)),
        normal(4, 3, 3),
    ),
    "LinearAffine": (
        lambda t, x: cfjax.LinearAffine(0.3 * jnp.outer(x, jnp.cos(x + t)), jnp.sin(x)),
        normal(4, 3),
    ),
    "Scaling": (lambda t, x: cfjax.Scaling(jnp.cos(A3 @ x + t)), normal(4, 3)),
    "LowRankSkew": (lambda t, x: cfjax.LowRankSkew(jnp.cos(t) * A6 @ x), FRAMES),
    "BorderedSkew": (lambda t, x: cfjax.BorderedSkew(jnp.cos(t) * A6 @ x), FRAMES),
    "SphereRotation": (
        lambda t, x: cfjax.SphereRotation(jnp.cos(t) * A6 @ x),
        jnp.asarray(FRAMES[..., 0]),
    ),
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
    "CF4": cfjax.CF4(),
    "CF54": cfjax.CF54(),
    "RKMK4": cfjax.RKMK4(),
    "Williamson3": cfjax.Williamson3(),
    "CayleyRK4": cfjax.CayleyRK4(),
    "Richardson": cfjax.Richardson(cfjax.CF4()),
}
CASES = [
    *((name, "CF4") for name in FIELDS),
    *(("Rotation", solver) for solver in SOLVERS if solver not in ("CF4", "CayleyRK4")),
    ("LowRankSkew", "CayleyRK4"),
    ("LowRankSkew", "CF54"),
    ("LowRankSkew", "RKMK4"),
    ("BorderedSkew", "RKMK4"),
    ("LeftMatrix", "Richardson"),
    ("elementwise", "RKMK4"),
]


@pytest.mark.representatives(1)
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
@pytest.mark.parametrize("name", [name for name in reversed(FIELDS) if "pair" not in name])
def test_fields_keep_their_promises_on_two_leading_axes(name):
    y = points(name)
    y = jnp.stack([y, y[::-1]])
    fields = [of_all(name, 2)(t, y, None) for t in (0.0, 0.4, 1.1)]
    cfjax.check_field(fields, y)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["Rotation", "LowRankSkew", "LeftMatrix", "elementwise"])
def test_gradients(name):
    y0 = points(name)

    def end(field):
        def of(y0, scale):
            scaled = lambda t, y, args: cfjax.combine((scale,), (field(t, y, args),))  # noqa: E731
            term = cfjax.LieTerm(scaled)
            ys = cfjax.integrate(term, cfjax.CF4(), 0.0, 0.5, y0, num_steps=5).ys
            return jnp.sum(jnp.sin(ys[-1]))

        return jax.jit(jax.grad(of, argnums=(0, 1)))

    together = end(of_all(name))(y0, 1.0)
    one = end(lambda t, y, args: FIELDS[name][0](t, y))
    by_start, by_scale = zip(*(one(y, 1.0) for y in y0), strict=True)
    np.testing.assert_allclose(together[0], jnp.stack(by_start), rtol=0, atol=1e-12)
    np.testing.assert_allclose(together[1], sum(by_scale), rtol=1e-11)


# Batches without members: whatever is asked of them is an empty array.

# The first needs a maximum over the batch.
EMPTY = {name: FIELDS[name][0] for name in ("LeftMatrix", *FIELDS)} | {
    "SphereRotation of space": lambda t, x: cfjax.SphereRotation(jnp.cos(t) * x),
    "Congruence without source": lambda t, x: of_matrices(cfjax.Congruence, x, t),
    "RightMatrix of long vectors": lambda t, x: cfjax.RightMatrix(jnp.outer(x, jnp.cos(x + t))),
    "QuaternionRotation": lambda t, x: cfjax.QuaternionRotation(
        jnp.cos(t) * x[:3], frame="body", layout="wxyz"
    ),
    "RigidMotion": lambda t, x: cfjax.RigidMotion(
        omega=jnp.cos(t) * x[:3], v=x[4:], frame="body", layout="wxyz_xyz"
    ),
    "RigidMotion of matrices": lambda t, x: cfjax.RigidMotion(
        omega=jnp.cos(t) * x[0, :3], v=x[:3, 3], frame="fixed"
    ),
    "PlanarMotion": lambda t, x: cfjax.PlanarMotion(
        omega=jnp.cos(t) * x[0], v=x[2:], frame="fixed", layout="unit_complex_xy"
    ),
    "translation": lambda t, x: jnp.cos(t) * x,
}
SHAPES = {
    "SphereRotation of space": (3,),
    "Congruence without source": (3, 3),
    "RightMatrix of long vectors": (20,),
    "QuaternionRotation": (4,),
    "RigidMotion": (7,),
    "RigidMotion of matrices": (4, 4),
    "PlanarMotion": (4,),
    "translation": (3,),
}


def empty(name):
    """The field of all members of an empty batch, and their states."""
    if name in FIELDS:
        return of_all(name), jax.tree.map(lambda x: x[:0], points(name))
    return lambda t, y, args: jax.vmap(lambda x: EMPTY[name](t, x))(y), jnp.zeros(
        (0, *SHAPES[name])
    )


def assert_empty_like(found, expected):
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b, strict=True), found, expected)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", EMPTY)
def test_the_motions_of_an_empty_batch(name):
    field, y = empty(name)
    a, b = field(0.0, y, None), field(0.4, y, None)
    assert_empty_like(cfjax.flow(a, y), y)
    assert_empty_like(cfjax.tangent(a, y), y)
    if isinstance(a, cfjax.AbstractAlgebraElement):
        for made in (cfjax.bracket(a, b), a.dexpinv(b, 4)):
            assert_empty_like(cfjax.tangent(made, y), y)
            assert_empty_like(cfjax.flow(made, y), y)

    def total(y, weight):
        moved = cfjax.flow(cfjax.combine((weight,), (field(0.0, y, None),)), y)
        return sum(map(jnp.sum, jax.tree.leaves(moved)))

    by_start, by_weight = jax.grad(total, argnums=(0, 1))(y, 1.0)
    assert_empty_like(by_start, y)
    assert by_weight == 0


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", EMPTY)
def test_solves_of_an_empty_batch(name):
    field, y0 = empty(name)
    term = cfjax.LieTerm(field)
    saved = jax.tree.map(lambda y: jnp.zeros((2, *y.shape)), y0)

    @eqx.filter_jit
    def solve(y0, controller=None):
        if controller is None:
            return cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=4, save_every=2).ys
        return diffrax.diffeqsolve(
            term,
            cfjax.CF4(),
            0.0,
            1.0,
            0.25,
            y0,
            stepsize_controller=controller,
            saveat=diffrax.SaveAt(ts=jnp.asarray([0.3, 1.0])),
        ).ys

    controllers = [
        None,
        diffrax.ConstantStepSize(),
        diffrax.PIDController(rtol=0.0, atol=1e-6),
    ]
    for controller in controllers:

        def total(y0, controller=controller):
            ys = solve(y0, controller)
            return sum(map(jnp.sum, jax.tree.leaves(ys))), ys

        by_start, ys = jax.grad(total, has_aux=True)(y0)
        assert_empty_like(ys, saved)
        assert_empty_like(by_start, y0)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("solver", [x for x in SOLVERS if x not in ("CF4", "CayleyRK4")])
@pytest.mark.parametrize("name", ["Rotation", "LeftMatrix", "QuaternionRotation"])
def test_an_empty_batch_by_other_methods(name, solver):
    field, y0 = empty(name)
    ys = cfjax.integrate(cfjax.LieTerm(field), SOLVERS[solver], 0.0, 1.0, y0, num_steps=2).ys
    assert_empty_like(ys, y0[None])


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", [name for name in EMPTY if not name.startswith("elementwise")])
def test_an_empty_batch_of_solves(name):
    """By `jax.vmap`, each solve with its checks of the start and of the end."""
    _, y0 = empty(name)
    term = cfjax.LieTerm(lambda t, y, args: EMPTY[name](t, y))

    def total(y0):
        ys = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=2).ys
        return jnp.sum(ys), ys

    by_start, ys = jax.vmap(jax.grad(total, has_aux=True))(y0)
    assert_empty_like(by_start, y0)
    assert_empty_like(ys, y0[:, None])


# Leading axes of the coordinates say how many there are; those of 1 are broadcast.


def test_the_coordinates_say_how_many_leading_axes_there_are():
    x, w = normal(3, 3), normal(3)
    columns = cfjax.Rotation(w).flow(x)
    rows = cfjax.Rotation(w[None]).flow(x)
    # One is a matrix whose columns turn, the other three vectors.
    np.testing.assert_allclose(rows, cfjax.Rotation(w).flow(x.T).T, rtol=0, atol=1e-15)
    assert jnp.max(jnp.abs(rows - columns)) > 0.1


@pytest.mark.parametrize("sides", [(1, 4), (3, 1), (1, 1), (3, 4)])
def test_broadcasting(sides):
    x, w = normal(3, 4, 3), normal(*sides, 3)
    full = jnp.broadcast_to(w, x.shape)
    for a, b in [(w, full), (full, w)]:
        found = cfjax.Rotation(a).bracket(cfjax.Rotation(b)).omega
        np.testing.assert_array_equal(found, jnp.cross(a, b))
    flow = cfjax.Rotation(w).flow(x)
    np.testing.assert_array_equal(flow, cfjax.Rotation(full).flow(x))
    matrices = normal(*sides, 3, 3)
    found = cfjax.LeftMatrix(matrices).flow(x)
    full = jnp.broadcast_to(matrices, (3, 4, 3, 3))
    np.testing.assert_allclose(found, cfjax.LeftMatrix(full).flow(x), rtol=0, atol=1e-14)


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
            return cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=5).ys

        return len(jax.jit(run).lower(jnp.ones((n, 3))).as_text().splitlines())

    # Few vectors are left as they are, many are scalarised.
    assert lines(7) == lines(20)
    assert lines(100) == lines(1000)


def test_a_stiefel_step_keeps_one_span_for_its_stages():
    # Two equal blocks in it would be a sign that an array was taken for two.
    y = FRAMES
    start = y
    entered = []
    for t in (0.0, 0.4, 1.1):
        field, start = cfjax.LowRankSkew(jnp.cos(t) * A6 @ y).to_chart(start, entered)
        entered.append(field)
    assert len(entered[-1].field.span.blocks) == 4
    total = cfjax.combine((1.0, 1.0, 1.0), entered)
    assert len(total.field.span.blocks) == 4


# What is refused, at trace time


@pytest.mark.parametrize(
    ("field", "shape", "text"),
    [
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
    ],
)
def test_axes_that_do_not_fit(field, shape, text, no_shape_hook):
    term = cfjax.LieTerm(lambda t, y, args: field())
    with pytest.raises(ValueError, match=text):
        cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, np.ones(shape), num_steps=1)


def test_a_start_off_the_manifold_is_refused():
    y0 = FRAMES.at[2].multiply(1.001)
    term = cfjax.LieTerm(of_all("LowRankSkew"))
    with pytest.raises(RuntimeError, match="orthonormal columns"):
        cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=1)


def test_elementwise_refuses_what_it_cannot_map(no_shape_hook):
    with pytest.raises(TypeError, match="field must be a frozen vector field, got"):
        cfjax.elementwise(np.ones(3))  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="num_axes must be a positive int, got 0"):
        cfjax.elementwise(Written(jnp.ones((5, 3))), 0)
    with pytest.raises(
        ValueError, match=r"must have 2 leading axes, got shape \(5,\) for Written.w"
    ):
        cfjax.elementwise(Written(jnp.ones(5)), 2)


def test_elementwise_of_elementwise_has_the_axes_of_both():
    field = cfjax.elementwise(cfjax.elementwise(Written(jnp.ones((5, 4, 3)))))
    x = normal(5, 4, 3)
    np.testing.assert_array_equal(field.flow(x), cfjax.Rotation(jnp.ones((1, 1, 3))).flow(x))
