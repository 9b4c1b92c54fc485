"""Low-rank skew fields: flows, brackets, the coordinates of a step, and what they refuse."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg

import cfjax
from cfjax import BorderedSkew, LeftMatrix, LowRankSkew

BOTH = pytest.mark.parametrize("cls", [LowRankSkew, BorderedSkew])
EPS = {np.float32: 2.0**-23, np.float64: 2.0**-52}
SHAPES = [(9, 3), (4, 4), (5, 1), (1, 1)]


def factor(n, p, norm=1.0, seed=0):
    g = np.random.default_rng(seed).standard_normal((n, p))
    return g / np.linalg.norm(g, 2) * norm


def frame(n, p, seed=1):
    return np.linalg.qr(factor(n, p, seed=seed))[0]


def dense(field, y=None):
    """The skew n x n matrix."""
    (g,) = jax.tree.leaves(field)
    g = np.asarray(g, float)
    y = np.eye(*g.shape) if isinstance(field, BorderedSkew) else np.asarray(y, float)
    return g @ y.T - y @ g.T


@jax.jit
def flow(field, point):
    return field.flow(point)


@pytest.mark.representatives(5)
@BOTH
@pytest.mark.parametrize(
    "shape, dtype", [*((shape, np.float64) for shape in SHAPES), (SHAPES[0], np.float32)]
)
@pytest.mark.parametrize("norm", [0.0, 1e-9, 0.4, 1.2, 30.0])
def test_flow(cls, dtype, shape, norm):
    # The reference starts where rounding put the point.
    y = frame(*shape).astype(dtype)
    field = cls((factor(*shape) * norm).astype(dtype))
    matrix = dense(field, y)
    got = flow(field, y)
    assert got.dtype == dtype
    # The start is moved to the manifold by one unit. The angle is rounded, 20 units for the sums,
    # and doubled by squarings where there are.
    atol = 40 * EPS[dtype] * (1 + 2 * norm)
    np.testing.assert_allclose(got, scipy.linalg.expm(matrix) @ y, rtol=0, atol=atol)
    np.testing.assert_allclose(np.asarray(got).T @ got, np.eye(shape[1]), rtol=0, atol=atol)


@pytest.mark.representatives(1)
@BOTH
@pytest.mark.parametrize("shape", SHAPES)
def test_tangent_is_the_velocity_of_the_flow(cls, shape):
    y, g = frame(*shape), factor(*shape)
    expected = dense(cls(g), y) @ y
    np.testing.assert_allclose(cls(g).tangent(jnp.asarray(y)), expected, rtol=0, atol=1e-15 * 20)
    velocity = jax.jvp(lambda t: cls(t * g).flow(jnp.asarray(y)), (0.0,), (1.0,))[1]
    np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-15 * 20)


# The bracket of the bordered form, and fields on a span


def bordered(seed, n=10, p=2):
    return BorderedSkew(factor(n, p, seed=seed))


def commutator(a, b):
    return a @ b - b @ a


def test_bracket_is_the_commutator():
    a, b, c = (bordered(seed) for seed in range(3))
    x = jnp.asarray(frame(10, 2))
    found = a.bracket(b)
    expected = commutator(dense(a), dense(b))
    np.testing.assert_allclose(found.tangent(x), expected @ x, rtol=0, atol=1e-14)
    nested = c.bracket(found)
    expected = commutator(dense(c), expected)
    np.testing.assert_allclose(nested.tangent(x), expected @ x, rtol=0, atol=1e-14)
    # The rank grows by p for every field, and only for a new one.
    assert (len(found.k), len(nested.k), len(a.bracket(nested).k)) == (6, 8, 8)
    jacobi = [u.bracket(v.bracket(w)) for u, v, w in [(a, b, c), (b, c, a), (c, a, b)]]
    zero = cfjax.combine((1.0, 1.0, 1.0), jacobi)
    np.testing.assert_allclose(zero.tangent(x), np.zeros((10, 2)), rtol=0, atol=1e-14)


def test_sums_keep_the_form_and_brackets_leave_it():
    a, b, c = (bordered(seed) for seed in range(3))
    x = jnp.asarray(frame(10, 2))
    total = cfjax.combine((0.5, -2.0), (a, b))
    assert isinstance(total, BorderedSkew)
    bracket = a.bracket(b)
    for fields in [(c, bracket), (bracket, c)]:
        mixed = cfjax.combine((1.0, 0.3), fields)
        parts = [dense(f) if f is c else commutator(dense(a), dense(b)) for f in fields]
        np.testing.assert_allclose(
            mixed.tangent(x), (parts[0] + 0.3 * parts[1]) @ x, rtol=0, atol=1e-14
        )


@pytest.mark.parametrize("norm", [0.0, 0.5, 20.0])
def test_flow_of_a_bracket(norm):
    a, b, c = (bordered(seed) for seed in range(3))
    field = cfjax.combine((norm, norm), (a.bracket(b), c))
    matrix = norm * (commutator(dense(a), dense(b)) + dense(c))
    y = frame(10, 2)
    # As in test_flow, for norms up to 40.
    np.testing.assert_allclose(
        flow(field, y), scipy.linalg.expm(matrix) @ y, rtol=0, atol=1e-14 * (1 + 4 * norm)
    )


def test_low_rank_fields_have_brackets_in_a_step_only():
    with pytest.raises(TypeError, match="LowRankSkew has none"):
        cfjax.bracket(LowRankSkew(factor(5, 2)), LowRankSkew(factor(5, 2)))


# A step in coordinates against the same step with n x n matrices

METHODS: dict[str, Any] = {
    "RKMK3": cfjax.RKMK3(),
    "CF4": cfjax.CF4(),
    "family B": cfjax.CommutatorFree(cfjax.third_order_b(2 / 3)),
    "Euler": cfjax.LieEuler(),
    "CG3": cfjax.CG3(),
    "RKMK4": cfjax.RKMK4(),
    "Bosh3": cfjax.RKMK(diffrax.Bosh3.tableau),
}


def g_of(t, y, args):
    """A g that depends on time and state, of norm about 2, and is not tangent."""
    a, b = args
    return jnp.cos(t) * a @ y + b * (1 + t)


def low_rank(t, y, args):
    return LowRankSkew(g_of(t, y, args))


def low_rank_dense(t, y, args):
    g = g_of(t, y, args)
    return LeftMatrix(g @ y.T - y @ g.T)


def border(t, y, args):
    return BorderedSkew(g_of(t, y, args))


def border_dense(t, y, args):
    g, e = g_of(t, y, args), jnp.eye(*y.shape)
    return LeftMatrix(g @ e.T - e @ g.T)


ARGS = (jnp.asarray(factor(8, 8, seed=3)), jnp.asarray(factor(8, 2, seed=4)))
Y0 = jnp.asarray(frame(8, 2))


def one_step(solver, field, y0, t0=0.2, h=0.3):
    term = cfjax.LieTerm(field)
    step = lambda y, args: problems.first_step(solver, term, t0, t0 + h, y, args)[0]  # noqa: E731
    return jax.jit(step)(y0, ARGS)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("pair", [(low_rank, low_rank_dense), (border, border_dense)])
def test_a_step_is_the_step_with_full_matrices(pair, name):
    found, expected = (one_step(METHODS[name], field, Y0) for field in pair)
    # Both round each of up to six flows by some units.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)
    assert np.abs(found - Y0).max() > 0.05


@pytest.mark.slow
def test_backwards_is_the_step_with_full_matrices():
    for pair in [(low_rank, low_rank_dense), (border, border_dense)]:
        found, expected = (one_step(cfjax.CF2(), f, Y0, h=-0.3) for f in pair)
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)


@pytest.mark.slow
def test_a_product_of_manifolds():
    """A frame, a position in a linear space and a rotation, each driven by the others."""

    def field(frame_field, t, y, args):
        pull = jnp.sum(y["frame"], axis=1)[:3]
        return {
            "frame": cfjax.combine((1 + y["place"][0],), (frame_field(t, y["frame"], args),)),
            "place": pull - y["place"],
            "spin": cfjax.Rotation(pull + y["place"]),
        }

    start = {"frame": Y0, "place": jnp.ones(3), "spin": jnp.eye(3)}
    for solver in (cfjax.CF2(), cfjax.RKMK3()):
        found, expected = (
            one_step(solver, lambda t, y, args, f=f: field(f, t, y, args), start)
            for f in (low_rank, low_rank_dense)
        )
        problems.assert_close(found, expected, atol=2e-14)


@pytest.mark.slow
def test_solvers_loops_and_terms_of_diffrax():
    """integrate, diffeqsolve, and the sum of a term in time and one in a control: one answer."""
    solver, steps = cfjax.CF2(), 8
    whole = cfjax.LieTerm(low_rank)
    half = lambda t, y, args: cfjax.combine((0.5,), (low_rank(t, y, args),))  # noqa: E731
    # A control has the structure of the field.
    control = lambda t0, t1: jax.tree.map(lambda _: t1 - t0, half(0.0, Y0, ARGS))  # noqa: E731
    parts = diffrax.MultiTerm(cfjax.LieTerm(half), diffrax.ControlTerm(half, control))
    expected = cfjax.integrate(
        cfjax.LieTerm(low_rank_dense), solver, 0.0, 1.0, Y0, ARGS, num_steps=8
    )
    ends = [
        cfjax.integrate(whole, solver, 0.0, 1.0, Y0, ARGS, num_steps=steps).ys,
        cfjax.integrate(parts, solver, 0.0, 1.0, Y0, ARGS, num_steps=steps).ys,
        diffrax.diffeqsolve(whole, solver, 0.0, 1.0, 1 / steps, Y0, ARGS).ys,
    ]
    for end in ends:
        np.testing.assert_allclose(end, expected.ys, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_the_adjoint_of_diffrax():
    term, solver = cfjax.LieTerm(low_rank), cfjax.CF2()

    def loss(x, loop):
        y0, args = x
        if loop is cfjax.integrate:
            ys = loop(term, solver, 0.0, 1.0, y0, args, num_steps=4).ys
        else:
            adjoint = diffrax.RecursiveCheckpointAdjoint()
            ys = loop(term, solver, 0.0, 1.0, 1 / 4, y0, args, adjoint=adjoint, max_steps=4).ys
        return jnp.sum(jnp.sin(ys))

    found, expected = (
        jax.jit(jax.grad(lambda x, loop=loop: loss(x, loop)))((Y0, ARGS))
        for loop in (diffrax.diffeqsolve, cfjax.integrate)
    )
    # The same steps of 1/4. The gradient of integrate is tested against finite differences.
    problems.assert_close(found, expected, atol=1e-13)


def test_a_batch_with_a_field_that_needs_more_than_the_series():
    y = jnp.stack([jnp.asarray(frame(8, 2, seed=s)) for s in range(3)])
    for cls in (LowRankSkew, BorderedSkew):
        g = jnp.stack([jnp.asarray(factor(8, 2, norm, seed=5)) for norm in (0.0, 0.1, 40.0)])
        got = jax.jit(jax.vmap(lambda g, y, cls=cls: cls(g).flow(y)))(g, y)
        for found, a, x in zip(got, g, y, strict=True):
            expected = scipy.linalg.expm(dense(cls(a), x)) @ x
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


# Derivatives


@pytest.mark.representatives(1)
@BOTH
@pytest.mark.parametrize("norm", [0.0, 0.5, 6.0])
def test_gradients_of_a_flow(cls, norm):
    """Reverse and forward mode and finite differences; at zero the second order too."""
    x = (jnp.asarray(factor(6, 2) * norm), jnp.asarray(frame(6, 2)))
    weight = factor(6, 2, seed=7)
    fun = jax.jit(lambda x: jnp.vdot(weight, cls(x[0]).flow(x[1])))
    v = problems.random_like(x, 2)
    gradient = jax.jit(jax.grad(fun))
    # Fifth derivatives up to 1e4, and rounding of 1e-15 over the step of 1e-3. Off the manifold
    # too, where the start is corrected.
    expected = problems.central_difference(fun, x, v, 1e-3)
    np.testing.assert_allclose(problems.inner(gradient(x), v), expected, rtol=0, atol=2e-9)
    forward = jax.jit(lambda x, v: jax.jvp(fun, (x,), (v,))[1])(x, v)
    np.testing.assert_allclose(forward, problems.inner(gradient(x), v), rtol=0, atol=1e-12)
    second = None
    if norm == 0:
        second = jax.jit(lambda x, v: jax.jvp(gradient, (x,), (v,))[1])(x, v)
        expected = problems.central_difference(gradient, x, v, 1e-3)
        problems.assert_close(second, expected, atol=1e-8)
    if norm == 0 and cls is BorderedSkew:
        reverse = jax.jit(jax.grad(lambda x: problems.inner(gradient(x), v)))(x)
        problems.assert_close(reverse, second, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("field", [low_rank, border])
def test_gradients_at_a_zero_step(field):
    """t1 = t0: the derivative in t1 is the velocity, that in y0 along the manifold the identity."""

    def end(t1, y0):
        solution = cfjax.integrate(
            cfjax.LieTerm(field), cfjax.CF4(), 0.0, t1, y0, ARGS, num_steps=2
        )
        return solution.ys[-1]

    velocity = field(0.0, Y0, ARGS).tangent(Y0)
    found = jax.jvp(end, (0.0, Y0), (1.0, 0 * Y0))[1]
    np.testing.assert_allclose(found, velocity, rtol=0, atol=1e-14)
    along = jax.jvp(end, (0.0, Y0), (0.0, velocity))[1]
    np.testing.assert_allclose(along, velocity, rtol=0, atol=1e-14)


# Long runs and large n


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "n, dtype, limit",
    [
        (5, np.float64, 2e-15),
        (100, np.float64, 2e-15),
        (1000, np.float64, 2e-15),
        (1000, np.float32, 1e-6),
    ],
)
@pytest.mark.parametrize("problem", ["first", "second"])
def test_orthonormality_after_2000_steps(problem, n, dtype, limit):
    scene = cfjax.scenes.stiefel
    field = {"first": scene.first, "second": scene.second}[problem]
    args = tuple(x.astype(dtype) for x in scene.diagonals(n)) if problem == "first" else None
    ys = cfjax.integrate(
        cfjax.LieTerm(field),
        cfjax.CF4(),
        0.0,
        20.0,
        scene.y0(n).astype(dtype),
        args,
        num_steps=2000,
        save_every=200,
    ).ys
    # In more digits, so that this product does not round.
    wide = np.asarray(ys).astype(np.longdouble)
    defect = np.swapaxes(wide, 1, 2) @ wide - np.eye(4)
    assert np.abs(defect).max() <= limit
    # The problem moves all the while.
    assert np.abs(wide[-1] - wide[0]).max() > 1e-2


@pytest.mark.slow
def test_n_of_a_hundred_thousand():
    """A matrix of n x n would take 80 GB."""
    scene, n = cfjax.scenes.stiefel, 100_000
    start = scene.y0(n)
    for field, args, solver in [
        (scene.first, scene.diagonals(n), cfjax.CF4()),
        (scene.second, None, cfjax.CF4()),
        (scene.second, None, cfjax.RKMK4()),
    ]:
        term = cfjax.LieTerm(field)
        y = np.asarray(cfjax.integrate(term, solver, 0.0, 0.2, start, args, num_steps=2).ys[-1])
        # Sums of 1e5 squares.
        np.testing.assert_allclose(y.T @ y, np.eye(4), rtol=0, atol=1e-13)


# What they refuse


@BOTH
@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (3, 0), (2, 2, 3)])
def test_wrong_shape_of_the_factor(cls, shape, no_shape_hook):
    name = "g" if cls is LowRankSkew else "gamma"
    with pytest.raises(ValueError, match=rf"{name} must have shape \(n, p\) or .* >= 1, got"):
        cls(jnp.ones(shape))


@BOTH
@pytest.mark.parametrize("dtype", [np.int32, np.float16, np.complex128])
def test_wrong_dtype_of_the_factor(cls, dtype, no_shape_hook):
    with pytest.raises(TypeError, match="must be float32 or float64, got"):
        cls(jnp.ones((3, 2), dtype))


@BOTH
@pytest.mark.parametrize("point", [np.ones((4, 2)), np.ones(3), np.ones((3, 2), np.float32)])
def test_wrong_point(cls, point, no_shape_hook):
    field = lambda t, y, args: cls(np.ones((3, 2)))  # noqa: E731
    with pytest.raises(ValueError, match=rf"{cls.__name__} for y.*(\(3, 2\)|float64)"):
        cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0.0, 1.0, point, num_steps=1)
    with pytest.raises(ValueError, match=rf"{cls.__name__} (with|of type)"):
        cls(np.ones((3, 2))).flow(jnp.asarray(point))


def start(cls, y, way, solver):
    """A short solve from `y`, as a part of a state."""
    term = cfjax.LieTerm(lambda t, y, args: {"q": cls(y["q"]), "x": y["x"]})
    y0 = {"q": jnp.asarray(y), "x": jnp.ones(2)}
    if way == "integrate":
        ys = cfjax.integrate(term, solver, 0.0, 0.1, y0, num_steps=1).ys
    else:
        ys = diffrax.diffeqsolve(term, solver, 0.0, 0.1, 0.1, y0).ys
    return np.asarray(ys["q"][-1])


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize(
    ("way", "solver"),
    [
        ("integrate", cfjax.CF4()),
        ("diffeqsolve", cfjax.CF4(estimate=None)),
        ("diffeqsolve", cfjax.CayleyRK4()),
        ("diffeqsolve", cfjax.Richardson(cfjax.RKMK4())),
    ],
    ids=["integrate", "CF4", "CayleyRK4", "Richardson"],
)
def test_a_start_off_the_manifold_is_refused(cls, way, solver):
    """It would become another start, of which the caller knows nothing."""
    y = frame(6, 2)
    expected = r"y0\['q'\] must have orthonormal columns .* and is off by more than "
    for stretch, off in ((1.025, "0.01"), (1.41, "0.1"), (1 + 1e-7, "1e-07")):
        with pytest.raises(eqx.EquinoxRuntimeError, match=expected + off):
            start(cls, stretch * y, way, solver)
    # Within the root of a unit of rounding the correction, of second order, leads to the manifold.
    # CayleyRK4 has none, and keeps the start as it is.
    end = start(cls, (1 + 5e-9) * y, way, solver)
    limit = 2e-8 if isinstance(solver, cfjax.CayleyRK4) else 1e-14
    np.testing.assert_allclose(end.T @ end, np.eye(2), rtol=0, atol=limit)


@pytest.mark.representatives(1)
@BOTH
def test_in_a_batch_one_start_off_the_manifold_is_an_error(cls):
    ys = jnp.stack([frame(6, 2), 1.1 * frame(6, 2)])
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"off by more than 0\.1"):
        term = cfjax.LieTerm(lambda t, y, args: cls(y))
        jax.vmap(lambda y: diffrax.diffeqsolve(term, cfjax.CF4(), 0.0, 0.1, 0.1, y).ys)(ys)


@pytest.mark.slow
@BOTH
def test_a_point_off_the_manifold_gives_nan(cls):
    """Behind the solver's check of the start."""
    term, solver = cfjax.LieTerm(lambda t, y, args: cls(y)), cfjax.CF4()
    state = solver.init(term, 0.0, 0.1, jnp.asarray(frame(6, 2)), None)

    def step(y):
        return solver.step(term, 0.0, 0.1, jnp.asarray(y), None, state, made_jump=False)[0]

    # Rounded to two digits it is moved to the nearest point, up to second order of 1e-2.
    near = step(np.round(frame(6, 2), 2))
    np.testing.assert_allclose(np.asarray(near).T @ near, np.eye(2), rtol=0, atol=1e-3)
    assert np.all(np.isnan(step(1.2 * frame(6, 2))))
