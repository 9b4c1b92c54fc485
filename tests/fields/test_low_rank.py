"""Low-rank skew fields: flows, brackets, the coordinates of a step, and what they refuse."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from matrices import rkmk3_step

import cfjax
from cfjax import BorderedSkew, LowRankSkew

BOTH = pytest.mark.parametrize("cls", [LowRankSkew, BorderedSkew])
EPS = 2.0**-52


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


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("cls", "shape"),
    [(BorderedSkew, (4, 4)), (LowRankSkew, (4, 4)), (LowRankSkew, (1, 1)), (BorderedSkew, (5, 1))],
)
def test_flow_of_edge_shapes(cls, shape):
    """test_contract.py has others."""
    y, flow = frame(*shape), jax.jit(lambda field, y: field.flow(y))
    for norm in (0.0, 1e-9, 0.4, 1.2, 30.0):
        field = cls(factor(*shape) * norm)
        found = np.asarray(flow(field, y))
        # The start is moved to the manifold by one unit. The angle is rounded, 20 units for the
        # sums, and doubled by squarings where there are.
        atol = 40 * EPS * (1 + 2 * norm)
        np.testing.assert_allclose(found, scipy.linalg.expm(dense(field, y)) @ y, 0, atol)
        np.testing.assert_allclose(found.T @ found, np.eye(shape[1]), 0, atol)


# The bracket of the bordered form, and fields on a span


def commutator(a, b):
    return a @ b - b @ a


def test_brackets_are_commutators():
    factors, x = [factor(10, 2, seed=seed) for seed in range(3)], jnp.asarray(frame(10, 2))

    @jax.jit
    def moved(factors):
        a, b, c = map(BorderedSkew, factors)
        found = a.bracket(b)
        nested = c.bracket(found)
        # The rank grows by p for every field, and only for a new one.
        assert (len(found.k), len(nested.k), len(a.bracket(nested).k)) == (6, 8, 8)
        jacobi = [u.bracket(v.bracket(w)) for u, v, w in [(a, b, c), (b, c, a), (c, a, b)]]
        # Sums keep the form, and brackets leave it.
        assert isinstance(cfjax.combine((0.5, -2.0), (a, b)), BorderedSkew)
        sums = [cfjax.combine((1.0, 0.3), pair) for pair in ((c, found), (found, c))]
        fields = [found, nested, cfjax.combine((1.0, 1.0, 1.0), jacobi), *sums]
        return [field.tangent(x) for field in fields], sums[0]

    a, b, c = (dense(BorderedSkew(g)) for g in factors)
    found = commutator(a, b)
    matrices = [found, commutator(c, found), 0 * a, c + 0.3 * found, found + 0.3 * c]
    tangents, total = moved(factors)
    for tangent, matrix in zip(tangents, matrices, strict=True):
        np.testing.assert_allclose(tangent, matrix @ x, rtol=0, atol=1e-14)
    flow = jax.jit(lambda weight: cfjax.combine((weight,), (total,)).flow(x))
    for norm in (0.0, 0.5, 20.0):
        want = scipy.linalg.expm(norm * matrices[3]) @ x
        # As for the other flows, for norms up to 40.
        np.testing.assert_allclose(flow(norm), want, rtol=0, atol=1e-14 * (1 + 4 * norm))


def test_low_rank_fields_have_brackets_in_a_step_only():
    with pytest.raises(TypeError, match="LowRankSkew has none"):
        cfjax.bracket(LowRankSkew(factor(5, 2)), LowRankSkew(factor(5, 2)))


# A step in coordinates against the same step with n x n matrices

A, B = factor(8, 8, seed=3), factor(8, 2, seed=4)


def g_of(xp, t, y):
    """A g that depends on time and state, of norm about 2, and is not tangent."""
    return xp.cos(t) * (A @ y) + B * (1 + t)


@pytest.mark.representatives(1)
@BOTH
def test_a_step_is_the_step_with_full_matrices(cls):
    """Forwards, or backwards."""
    h, y0 = 0.3 if cls is LowRankSkew else -0.3, frame(8, 2)
    term = cfjax.LieTerm(lambda t, y, args: cls(g_of(jnp, t, y)))
    step = lambda y: problems.first_step(cfjax.RKMK3(), term, 0.2, 0.2 + h, y, None)[0]  # noqa: E731
    found = jax.jit(step)(y0)
    want = rkmk3_step(lambda t, y: dense(cls(g_of(np, t, y)), y), 0.2, h, y0)
    # Both round each of three flows by some units.
    np.testing.assert_allclose(found, want, rtol=0, atol=2e-14)
    assert np.abs(found - y0).max() > 0.05


@pytest.mark.representatives(1)
@BOTH
def test_gradient_of_a_flow(cls):
    """In field and point, which may be off the manifold, where the start is corrected."""
    weight, y = factor(6, 2, seed=7), jnp.asarray(frame(6, 2))
    found = jax.jit(
        jax.value_and_grad(lambda x: jnp.vdot(weight, cls(x[0]).flow(x[1]))),
        compiler_options=problems.QUICK,
    )
    for norm in (0.0, 0.5, 6.0):
        x = jnp.asarray(factor(6, 2) * norm), y
        v = problems.random_like(x, 2)
        expected = problems.central_difference(lambda x: found(x)[0], x, v, 1e-3)
        # Fifth derivatives up to 1e4, and rounding of 1e-15 over the step of 1e-3.
        np.testing.assert_allclose(problems.inner(found(x)[1], v), expected, rtol=0, atol=2e-9)


# Long runs and large n


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "n, dtype, limit",
    [
        (5, np.float64, 2e-15),
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
        cfjax.CF2(),
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


# What they refuse


@BOTH
def test_wrong_arguments(cls, subtests, no_shape_hook):
    name = "g" if cls is LowRankSkew else "gamma"
    for shape in [(), (3,), (2, 3), (3, 0), (2, 2, 3)]:
        text = rf"{name} must have shape \(n, p\) or .* >= 1, got"
        with subtests.test(shape=str(shape)), pytest.raises(ValueError, match=text):
            cls(jnp.ones(shape))
    for dtype in ("int32", "float16", "complex128"):
        text = "must be float32 or float64, got"
        with subtests.test(dtype=dtype), pytest.raises(TypeError, match=text):
            cls(jnp.ones((3, 2), dtype))
    field = cls(np.ones((3, 2)))
    term = cfjax.LieTerm(lambda t, y, args: field)
    for point in (np.ones((4, 2)), np.ones(3), np.ones((3, 2), np.float32)):
        with subtests.test(point=f"{point.dtype}{point.shape}"):
            with pytest.raises(ValueError, match=rf"{cls.__name__} for y.*(\(3, 2\)|float64)"):
                cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, point, num_steps=1)
            with pytest.raises(ValueError, match=rf"{cls.__name__} (with|of type)"):
                field.flow(jnp.asarray(point))


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize(
    "solver",
    [cfjax.CF4(estimate=None), cfjax.CayleyRK4(), cfjax.Richardson(cfjax.RKMK4())],
    ids=["CF4", "CayleyRK4", "Richardson"],
)
def test_a_start_off_the_manifold_is_refused(cls, solver):
    """It would become another start, of which the caller knows nothing."""
    term = cfjax.LieTerm(lambda t, y, args: {"q": cls(y["q"]), "x": y["x"]})

    def end(y):
        y0 = {"q": jnp.asarray(y), "x": jnp.ones(2)}
        ys = diffrax.diffeqsolve(term, solver, 0.0, 0.1, 0.1, y0).ys
        return ys["q"][-1]  # pyright: ignore

    y = frame(6, 2)
    expected = r"y0\['q'\] must have orthonormal columns .* and is off by more than "
    for stretch, off in ((1.025, "0.01"), (1.41, "0.1"), (1 + 1e-7, "1e-07")):
        with pytest.raises(eqx.EquinoxRuntimeError, match=expected + off):
            end(stretch * y)
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"off by more than 0\.1"):
        # One of a batch.
        jax.vmap(end)(jnp.stack([y, 1.1 * y]))
    # Within the root of a unit of rounding the correction, of second order, leads to the manifold.
    # CayleyRK4 has none, and keeps the start as it is.
    y = end((1 + 5e-9) * y)
    limit = 2e-8 if isinstance(solver, cfjax.CayleyRK4) else 1e-14
    np.testing.assert_allclose(y.T @ y, np.eye(2), rtol=0, atol=limit)


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
