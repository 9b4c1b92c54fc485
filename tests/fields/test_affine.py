"""Affine: flows by transforms against dense exponentials, solves, and what is refused."""

import functools
import re
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems
import pytest
import scipy.linalg

import cfjax
from cfjax import Affine

EPS = 2.0**-52
N = 7
K = np.arange(N)
# Diffusion, advection and a state of coefficients; eigenvalues up to 30 in modulus.
DIFFUSION = -8.0 * np.sin((K + 1) * np.pi / (2 * (N + 1))) ** 2
ADVECTION = 5j * np.sin(2 * np.pi * K / N)
CASES: dict[str, tuple[cfjax.AbstractTransform | None, np.ndarray, type]] = {
    "coefficients": (None, DIFFUSION, float),
    "complex coefficients": (None, DIFFUSION + ADVECTION, complex),
    "sine, growth": (cfjax.SineTransform(), -DIFFUSION, float),
    "sine, rotation": (cfjax.SineTransform(), 1j * DIFFUSION, complex),
    "cosine": (cfjax.CosineTransform(), -8 * np.sin(K * np.pi / (2 * N)) ** 2, float),
    "Fourier": (cfjax.FourierTransform(), ADVECTION - 1, complex),
    "real Fourier": (cfjax.RealFourierTransform(N), (ADVECTION - 1)[: N // 2 + 1], float),
}


def data(case, shape=(N,), seed=0):
    """A field, a point, and the dense operator M, columns from the transform's own definition."""
    transform, spectrum, dtype = CASES[case]
    rng = np.random.default_rng(seed)
    b, point = rng.standard_normal((2, *shape)).astype(dtype)
    if dtype is complex:
        b, point = b + 1j * rng.standard_normal(shape), point - 1j * rng.standard_normal(shape)
    field = Affine(b, spectrum, transform, alpha=0.7)
    return field, jnp.asarray(point), dense(transform, spectrum, dtype)


def dense(transform, spectrum, dtype):
    eye = jnp.eye(N, dtype=dtype)
    if transform is None:
        return np.diag(spectrum)
    c = transform.forward(eye)
    return np.asarray(transform.inverse(jnp.asarray(spectrum, c.dtype)[:, None] * c))


def exact(m, alpha, b, point):
    """The flow by the exponential of [[alpha M, b], [0, 0]], column by column, in 30 digits."""
    columns = []
    for u, f in zip(np.reshape(point, (N, -1)).T, np.reshape(b, (N, -1)).T, strict=True):
        a = np.zeros((N + 1, N + 1), np.result_type(m, np.asarray(f)))
        a[:N, :N], a[:N, N] = alpha * m, f
        with mpmath.workdps(30):
            end = mpmath.expm(mpmath.matrix(a.tolist())) * mpmath.matrix([*u.tolist(), 1])
        columns.append(np.array(end.tolist(), a.dtype)[:N, 0])
    return np.stack(columns, axis=1).reshape(np.shape(point))


def test_flow_and_tangent_against_dense_matrices():
    made = {case: data(case) for case in CASES}

    @jax.jit
    def motions(arrays):
        found = []
        for (b, spectrum, point), (field, _, _) in zip(arrays, made.values(), strict=True):

            @jax.vmap
            def flows(alpha, b, field=field, spectrum=spectrum, point=point):
                return Affine(b, spectrum, field.transform, alpha=alpha).flow(point)

            one = Affine(b, spectrum, field.transform, alpha=0.7)
            ends = flows(jnp.array([0.7, 0.0, 0.0]), jnp.stack([b, 0 * b, b]))
            found.append((*ends, one.tangent(point)))
        return found

    arrays = [(f.b, f.spectrum, x) for f, x, _ in made.values()]
    for (case, (field, point, m)), found in zip(made.items(), motions(arrays), strict=True):
        end, still, moved, tangent = found
        wanted = exact(m, 0.7, field.b, point)
        assert end.dtype == point.dtype
        # The dense M is known to rounding, which alpha M of norm 6 passes on to the exponential.
        atol = 30 * EPS * np.abs(wanted).max()
        np.testing.assert_allclose(end, wanted, rtol=0, atol=atol, err_msg=case)
        if field.transform is None:
            np.testing.assert_array_equal(still, point)
            np.testing.assert_array_equal(moved, point + field.b)
        # There and back by a transform costs a few units.
        np.testing.assert_allclose(still, point, rtol=0, atol=10 * EPS, err_msg=case)
        np.testing.assert_allclose(moved, point + field.b, rtol=0, atol=20 * EPS, err_msg=case)
        wanted = 0.7 * m @ point + field.b
        atol = 20 * EPS * 8 * np.abs(point).max()
        np.testing.assert_allclose(tangent, wanted, rtol=0, atol=atol, err_msg=case)


def test_infinitely_stiff_and_a_state_that_is_a_number():
    spectrum, b = -np.array([1e3, 1e8, 1e300]), np.array([1.0, 2.0, 3.0])

    @jax.jit
    def flows(b, spectrum):
        stiff = Affine(b, spectrum, alpha=2.0).flow(jnp.ones(3))
        # A number has no axes, so its spectrum has none either.
        return stiff, cfjax.flow(Affine(b[2], spectrum[0] * 5e-4, alpha=2.0), jnp.asarray(1.0))

    stiff, number = flows(b, spectrum)
    # exp(-z) underflows and the answer is the balance of both terms, -b / (alpha lambda).
    np.testing.assert_allclose(stiff, b / (-2 * spectrum), rtol=4 * EPS)
    np.testing.assert_allclose(number, np.exp(-1) + 3 * (1 - np.exp(-1)), rtol=4 * EPS)


class Eigenvectors(cfjax.AbstractTransform):
    """A transform of one's own: all that `Affine` needs of it."""

    vectors: jax.Array

    def forward(self, point):
        return self.vectors.T @ point

    def inverse(self, coefficients):
        return self.vectors @ coefficients


def test_a_transform_of_ones_own():
    """And along one axis of a grid, with a transform of ours along the other."""
    m = np.random.default_rng(0).standard_normal((N, N))
    m = m + m.T
    eigenvalues, vectors = np.linalg.eigh(m)
    own = Eigenvectors(jnp.asarray(vectors))
    grid = cfjax.TensorTransform((own, cfjax.SineTransform()))
    both = np.kron(m, np.eye(3)) + np.kron(np.eye(N), second_difference("sine", 3))
    spectrum = np.add.outer(eigenvalues, cfjax.SineTransform().second_difference(3))
    line, plane = (np.random.default_rng(1).standard_normal((2, N, *k)) for k in [(), (3,)])

    @jax.jit
    def flows(line, plane):
        one = Affine(line[0], eigenvalues, own, alpha=0.7)
        return one.flow(line[1]), Affine(plane[0], spectrum, grid, alpha=0.7).flow(plane[1])

    found = flows(line, plane)
    wants = exact(m, 0.7, *line), exact_on_grid(both, 0.7, *plane)
    for end, wanted in zip(found, wants, strict=True):
        # The eigenvalues are known to some units of their largest, 5, as are their exponentials.
        np.testing.assert_allclose(end, wanted, rtol=0, atol=100 * EPS * np.abs(wanted).max())


# Grids: tensor products of transforms, against Kronecker sums of second differences.


def second_difference(kind, n):
    a = np.diag(np.full(n, -2.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    if kind == "cosine":
        a[0, 0] = a[-1, -1] = -1
    if "Fourier" in kind:
        a[0, -1] += 1
        a[-1, 0] += 1
    return a


def on_grid(kinds, shape):
    """The product of transforms, the spectrum of the Laplacian and its dense matrix.

    Axis k has the squared spacing 1 / (k + 1), so no two axes are alike.
    """
    transforms, spectra, matrix = [], [], np.zeros((1, 1))
    for axis, (kind, n) in enumerate(zip(kinds, shape, strict=True)):
        transform = {
            "sine": cfjax.SineTransform(),
            "cosine": cfjax.CosineTransform(),
            "Fourier": cfjax.FourierTransform(),
            "real Fourier": cfjax.RealFourierTransform(n),
        }[kind]
        transforms.append(transform)
        spectra.append((axis + 1) * transform.second_difference(n))
        one = (axis + 1) * second_difference(kind, n)
        matrix = np.kron(matrix, np.eye(n)) + np.kron(np.eye(len(matrix)), one)
    is_complex = "Fourier" in kinds and "real Fourier" not in kinds
    dtype = complex if is_complex else float
    return cfjax.TensorTransform(transforms), functools.reduce(np.add.outer, spectra), matrix, dtype


def exact_on_grid(m, alpha, b, u):
    """The flow by SciPy's exponential, for every column of the grid."""
    n = len(m)
    ends = []
    for f, p in zip(b.reshape(n, -1).T, u.reshape(n, -1).T, strict=True):
        a = np.zeros((n + 1, n + 1), b.dtype)
        a[:-1, :-1], a[:-1, -1] = alpha * m, f
        ends.append((scipy.linalg.expm(a) @ np.append(p, 1))[:-1])
    return np.stack(ends, axis=1).reshape(u.shape)


def random_points(dtype, shape):
    b, u = np.random.default_rng(0).standard_normal((2, *shape)).astype(dtype)
    return (b + 1j * u[::-1], u - 1j * b) if dtype is complex else (b, u)


PAIRS = [
    ("sine", "real Fourier"),
    ("Fourier", "cosine"),
    ("real Fourier", "Fourier"),
]


def test_flows_on_grids():
    """Pairs of transforms, also in single precision, more axes, columns, and advection."""
    fields, wants, velocities = {}, {}, {}

    def add(name, spectrum, transform, m, b, u, unit=EPS):
        fields[name] = Affine(b, spectrum, transform, alpha=0.7), jnp.asarray(u)
        b, u = (x.astype(np.result_type(x, float)) for x in (b, u))
        # The dense exponential of norm 0.7 * 12 is itself a hundred units off.
        wants[name] = exact_on_grid(m, 0.7, b, u), (100 if unit == EPS else 50) * unit
        n = len(m)
        velocities[name] = (0.7 * m @ u.reshape(n, -1)).reshape(u.shape) + b

    for pair in PAIRS:
        transform, spectrum, m, dtype = on_grid(pair, (4, 5))
        add(pair, spectrum, transform, m, *random_points(dtype, (4, 5)))
    transform, spectrum, m, _ = on_grid(("sine", "cosine"), (4, 5))
    single = [x.astype(np.float32) for x in (spectrum, *random_points(float, (4, 5)))]
    add("float32", single[0], transform, m, *single[1:], unit=2.0**-23)
    # Columns come first where an axis has no transform.
    both = cfjax.TensorTransform((None, *transform.transforms))
    m = np.kron(np.diag([1.0, 0.5]), m)
    spectrum = np.multiply.outer([1.0, 0.5], spectrum)
    add("columns first", spectrum, both, m, *random_points(float, (2, 4, 5)))
    # Central differences have no eigenvalue at `k = n / 2`.
    transform, spectrum, m, _ = on_grid(("Fourier", "real Fourier"), (4, 5))
    central = (np.roll(np.eye(4), 1, axis=1) - np.roll(np.eye(4), -1, axis=1)) / 2
    spectrum = spectrum + 2j * np.sin(2 * np.pi * np.fft.fftfreq(4))[:, None]
    m = m + 2 * np.kron(central, np.eye(5))
    add("advection", spectrum, transform, m, *random_points(float, (4, 5)))
    # A diffusivity for each column.
    transform, spectrum, m, _ = on_grid(("cosine", "real Fourier", "sine"), (3, 4, 2))
    m = np.kron(m, np.diag([1.0, 0.5]))
    b, u = random_points(float, (3, 4, 2, 2))
    add("three axes", np.multiply.outer(spectrum, [1.0, 0.5]), transform, m, b, u)
    motions = eqx.filter_jit(lambda xs: [(field.flow(u), field.tangent(u)) for field, u in xs])
    found = motions(list(fields.values()))
    for name, (end, tangent) in zip(fields, found, strict=True):
        assert end.dtype == tangent.dtype == fields[name][1].dtype
        wanted, atol = wants[name]
        np.testing.assert_allclose(end, wanted, rtol=0, atol=atol, err_msg=str(name))
        np.testing.assert_allclose(tangent, velocities[name], rtol=0, atol=atol, err_msg=str(name))


def test_boundary_values_by_lifting():
    """Reaction and diffusion with boundary values that vary, whose exact solution is known.

    `u = 1 + (c - 1) x + x^2 sin t` with `c = cos(t) cos(pi y)`: second differences are exact for
    its polynomials in x, and `cos(pi y)` is a vector of the cosine transform.
    """
    nx, ny = 3, 4
    sine, cosine = cfjax.SineTransform(), cfjax.CosineTransform()
    transform = cfjax.TensorTransform((sine, cosine))
    in_y = ny**2 * cosine.second_difference(ny)
    laplacian = np.add.outer((nx + 1) ** 2 * sine.second_difference(nx), in_y)
    x = jnp.arange(1.0, nx + 1)[:, None] / (nx + 1)
    wave = jnp.cos(jnp.pi * jnp.arange(0.5, ny)[None, :] / ny)

    def solution(t):
        return 1 - x + x * wave * jnp.cos(t) + x**2 * jnp.sin(t)

    def lift(t):
        """Linear in x between the boundary values 1 and `u(x = 1)`."""
        return 1 - x + x * (wave * jnp.cos(t) + jnp.sin(t))

    def rate(fun, t):
        return jax.jvp(fun, (t,), (jnp.ones_like(t),))[1]

    def forcing(t):
        """What makes it a solution of `u' = L u + u - u^3 + forcing`."""
        u = solution(t)
        diffused = in_y[1] * x * wave * jnp.cos(t) + 2 * jnp.sin(t)
        return rate(solution, t) - diffused - u + u**3

    def field(t, v, laplacian):
        u = v + lift(t)
        lifted = in_y[1] * x * wave * jnp.cos(t) - rate(lift, t)
        return Affine(u - u**3 + forcing(t) + lifted, laplacian, transform)

    steps, start, end = [32, 64, 128], solution(0.0) - lift(0.0), solution(1.0) - lift(1.0)
    errors = problems.errors(field, cfjax.CF4(), 1.0, start, laplacian, np.ravel(end), steps)
    # Rounding of a hundred steps is below 1e-14. Eigenvalues reach 110 and are resolved.
    assert errors.min() > 1e-12
    assert abs(problems.slope(steps, errors) - 4) < 0.15


# Derivatives.


def parts(field, point):
    """All that a flow depends on, as real arrays, and the flow as a function of them."""
    arrays = (field.alpha, field.b, field.spectrum, point)
    split = [(x.real, x.imag) if jnp.iscomplexobj(x) else (x,) for x in arrays]

    def flow(split):
        alpha, b, spectrum, point = (jax.lax.complex(*x) if len(x) == 2 else x[0] for x in split)
        end = Affine(b, spectrum, field.transform, alpha=alpha).flow(point)
        return jnp.concatenate([end.real, end.imag]) if jnp.iscomplexobj(end) else end

    return split, flow


def test_derivatives():
    """By all coordinates, the spectrum and the point, where alpha is zero: a second derivative by
    the coordinates is in test_contract.py.
    """
    field, point, _ = data("real Fourier")
    x, flow = parts(Affine(field.b, field.spectrum, field.transform, alpha=0.0), point)
    dx, weights = problems.random_like(x, 1), problems.random_like(flow(x), 2)

    @jax.jit
    def everything(x, dx, weights):
        end, push = jax.linearize(flow, x)
        return end, push(dx), *jax.linear_transpose(push, x)(weights)

    end, forward, gradient = everything(x, dx, weights)
    # With eigenvalues up to 8 the fifth derivative is below 8^5 of the flow, so a step of 1e-4
    # leaves 1e-13 of truncation; rounding adds 1.5e-16 / 1e-4 of the values, a few dozen times.
    size = float(np.abs(end).max()) + 1
    expected = problems.central_difference(lambda x: everything(x, dx, weights)[0], x, dx, 1e-4)
    problems.assert_close(forward, expected, 1e-10 * size)
    # The same sums in another order.
    found = float(problems.inner(gradient, dx))
    assert found == pytest.approx(float(jnp.vdot(weights, forward)), rel=1e-12, abs=1e-12)


# Within a step: coefficients.


def solved(field, solver, transform, y0, args, **kwargs):
    """A solve on the grid, its output within a step and its end, and the same by coefficients.

    The second has the coefficients as its state, and transforms in its field alone.
    """

    def in_coefficients(t, c, args):
        f = field(t, transform.inverse(c), args)
        return Affine(transform.forward(f.b), f.spectrum, alpha=f.alpha)

    for fun, start, back in (
        (field, y0, lambda y: y),
        (in_coefficients, transform.forward(y0), jax.vmap(transform.inverse)),
    ):
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(fun),
            solver,
            0.0,
            0.5,
            0.125,
            start,
            args,
            saveat=diffrax.SaveAt(ts=jnp.asarray([0.05, 0.3, 0.5])),
            **kwargs,
        )
        yield back(sol.ys)


SOLVERS = {
    "CF3": cfjax.CF3(),
    # The velocity within its steps is its first field.
    "CF43, algebra": cfjax.CF43(estimate="algebra"),
    "RKMK4": cfjax.RKMK4(),
    "CK54": cfjax.CK54(),
    "CF54": cfjax.CF54(),
    "RKMK5": cfjax.RKMK5(),
    "CK54, rolled": cfjax.CK54(unroll=False),
    "ImplicitMidpoint": cfjax.ImplicitMidpoint(),
    "Richardson": cfjax.Richardson(cfjax.CF3()),
}


def test_points_that_are_computed_once(rewritten, subtests):
    """Where the field is evaluated and flows go on: back from there flows would be repeated."""
    term = cfjax.LieTerm(
        lambda t, y, args: Affine(jnp.sin(y), -jnp.arange(200.0), cfjax.SineTransform())
    )
    for solver, points in [
        (cfjax.CF4(), 1),
        (cfjax.CF43(), 4),
        (cfjax.CK54(), 4),
        (cfjax.RKMK4(), 0),
    ]:

        def run(y0, solver=solver):
            return cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=2).ys

        with subtests.test(solver=type(solver).__name__):
            program = str(jax.make_jaxpr(run)(jnp.ones(200)))
            barriers = re.findall(r"f64\[200\] = optimization_barrier", program)
            assert len(barriers) == points


@pytest.mark.filterwarnings("ignore:Complex dtype support")
@pytest.mark.parametrize(
    ("solver", "pair"),
    [
        pytest.param(
            solver,
            [("sine", "real Fourier"), ("Fourier", "cosine")][k % 2],
            marks=[pytest.mark.slow] * (k > 0),
        )
        for k, solver in enumerate(SOLVERS)
    ],
)
def test_a_solve_is_that_of_the_coefficients(solver, pair):
    transform, spectrum, _, dtype = on_grid(pair, (3, 4))

    def field(t, y, args):
        return Affine(y - y**3 + jnp.cos(3 * t).astype(y.dtype), args, transform)

    y0 = jnp.asarray(random_points(dtype, (3, 4))[1]) / 2
    ends = solved(field, SOLVERS[solver], transform, y0, spectrum)
    # Some transforms a step, each with a few units; the implicit method stops at rounding too.
    np.testing.assert_allclose(*ends, rtol=0, atol=200 * EPS)


def test_controlled_steps_of_a_state_of_parts():
    """A grid with another operator beside it, and a part of its own; with two terms on one part."""
    transform, spectrum, _, _ = on_grid(("sine", "real Fourier"), (3, 4))
    line = cfjax.SineTransform()
    rates = line.second_difference(5)

    def first(t, y, args):
        mean = jnp.mean(y["grid"])
        grid = Affine(jnp.sin(y["grid"]) + y["time"], args, transform)
        return {"grid": grid, "line": Affine(mean * y["line"], rates, line, alpha=0.5), "time": 1.0}

    def second(t, y, args):
        return {"grid": Affine(-(y["grid"] ** 3), args, transform), "line": None, "time": None}

    def both(t, y, args):
        sum_ = Affine(first(t, y, args)["grid"].b - y["grid"] ** 3, args, transform, alpha=2.0)
        return {**first(t, y, args), "grid": sum_}

    _, u = random_points(float, (3, 4))
    y0 = {"grid": jnp.asarray(u), "line": jnp.arange(5.0), "time": jnp.asarray(0.0)}
    norm = cfjax.ErrorNorm({"grid": 1.0, "line": 2.0, "time": 1.0})
    ends = [
        diffrax.diffeqsolve(
            term,
            cfjax.CF3(),
            0.0,
            1.0,
            0.05,
            y0,
            spectrum,
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-5, norm=norm),
        )
        for term in (
            diffrax.MultiTerm(cfjax.LieTerm(first), cfjax.LieTerm(second)),
            cfjax.LieTerm(both),
        )
    ]
    # Sums in another order, over some 40 steps.
    problems.assert_close(ends[0].ys, ends[1].ys, 1e-13)
    assert ends[0].stats["num_steps"] == ends[1].stats["num_steps"]


def test_derivatives_of_a_solve():
    """With respect to the spectrum and the start, by reverse mode, against central differences."""
    transform, spectrum, _, _ = on_grid(("real Fourier", "sine"), (4, 3))
    u = jnp.asarray(random_points(float, (4, 3))[1])

    def loss(x):
        def field(t, y, args):
            return Affine(jnp.sin(y) + t, args * spectrum, transform)

        end = cfjax.integrate(
            cfjax.LieTerm(field), cfjax.CF2(), 0.0, 0.5, x["u"], x["d"], num_steps=3
        ).ys[-1]
        return jnp.sum(end**2)

    x = {"u": u, "d": jnp.asarray(0.3)}
    dx = problems.random_like(x, 3)
    found = problems.inner(jax.jit(jax.grad(loss))(x), dx)
    wanted = problems.central_difference(jax.jit(loss), x, dx, 1e-4)
    # Differences leave 1e-4^4 of the fifth derivative, and of rounding some units over 1e-4.
    np.testing.assert_allclose(found, wanted, rtol=1e-8)


# What is refused.


def ones(dtype: Any = float, shape=(4,)):
    return jnp.ones(shape, dtype)


def plane():
    return cfjax.TensorTransform([cfjax.SineTransform()] * 2)


WRONG = [
    ((1.0, ones(int), ones()), TypeError, "b must be one of .*, got int64"),
    ((1.0, ones(jnp.float16), ones()), TypeError, "b must be one of .*, got float16"),
    ((1.0, ones(), ones(int)), TypeError, "spectrum must be float64 .* got int64"),
    ((1.0, ones(), ones(complex)), TypeError, "spectrum must be float64 .* got complex128"),
    ((1.0, ones(), ones(jnp.float32)), TypeError, "spectrum must be float64 .* got float32"),
    ((1.0, ones(), ones(shape=(5,))), ValueError, r"spectrum .* \(4,\) .* got \(5,\)"),
    ((1.0, ones(), ones(shape=())), ValueError, r"spectrum .* \(4,\) .* got \(\)"),
    ((1.0, ones(), ones(shape=(4, 1))), ValueError, r"spectrum .* got \(4, 1\)"),
    ((ones(shape=(1,)), ones(), ones()), ValueError, r"alpha must be .* of shape \(1,\)"),
    ((jnp.float32(1), ones(), ones()), ValueError, "alpha must be .*float64, got float32"),
    ((1j, ones(), ones()), ValueError, "alpha must be a real scalar .* got complex128"),
    ((1.0, ones(), ones(), "sine"), TypeError, "transform must be .* got 'sine'"),
    (
        (1.0, ones(), ones(), cfjax.RealFourierTransform(4)),
        ValueError,
        r"spectrum .* \(3,\) .* got \(4,\)",
    ),
    ((1.0, ones(), ones(), cfjax.RealFourierTransform(5)), ValueError, "length 4"),
    ((1.0, ones(), ones(), cfjax.FourierTransform()), TypeError, "complex arrays, got float64"),
    (
        (1.0, ones(shape=()), ones(), cfjax.SineTransform()),
        ValueError,
        r"SineTransform needs points along the first axis, got shape \(\)",
    ),
    # Diffusion along one axis of a square, where its spectrum would fit.
    (
        (1.0, ones(shape=(4, 4, 2)), ones(), plane()),
        ValueError,
        r"spectrum .* shape \(4, 4, 2\) or \(4, 4\) .* got \(4,\)",
    ),
    (
        (1.0, ones(shape=(4, 4)), ones(shape=(4, 1)), plane()),
        ValueError,
        r"spectrum .* shape \(4, 4\) .* got \(4, 1\)",
    ),
    ((1.0, ones(), ones(), plane()), ValueError, r"TensorTransform of 2 axes .* \(4,\)"),
    (
        (1.0, ones(), ones(complex), cfjax.SineTransform()),
        TypeError,
        "spectrum must be float64 .* got complex128",
    ),
]


def test_wrong_arguments_and_points(no_shape_hook, subtests):
    for arguments, error, message in WRONG:
        with subtests.test(case=message), pytest.raises(error, match=message):
            alpha, *rest = arguments
            Affine(*rest, alpha=alpha)
    term = cfjax.LieTerm(lambda t, y, args: Affine(ones(), ones()))
    for point in (ones(shape=(5,)), ones(shape=(4, 1)), ones(jnp.float32)):
        with subtests.test(case=str(point.aval)):
            text = "Affine acts on points like its b, float64 of shape"
            with pytest.raises(ValueError, match=text):
                term.vf(0.0, point, None)
    # b along the rows of a square would pass as one for its columns.
    with pytest.raises(ValueError, match=r"Affine acts on points like its b.* got .* \(4, 4\)"):
        cfjax.flow(Affine(ones(), ones()), ones(shape=(4, 4)))


def test_fields_with_different_operators_are_not_added():
    """The sum would have the operator of the first."""
    b = jnp.ones(4)
    field = Affine(b, -jnp.arange(4.0))
    for other in (
        Affine(b, -jnp.arange(4.0), cfjax.SineTransform()),
        Affine(b[:3], -jnp.arange(3.0)),
    ):
        with pytest.raises(ValueError, match="must have one operator, got the spectra"):
            cfjax.combine((1.0, 1.0), (field, other))
    with pytest.raises(eqx.EquinoxRuntimeError, match="must have one spectrum"):
        cfjax.combine((1.0, 1.0), (field, Affine(b, -2 * jnp.arange(4.0))))
    total = cfjax.combine((1.0, 2.0), (field, Affine(b, -jnp.arange(4.0) - 0.0)))
    np.testing.assert_array_equal(total.alpha, 3.0)


def test_a_spectrum_that_changes_with_time_is_an_error():
    def field(t, y, args):
        return Affine(y, -(1 + t) * jnp.arange(4.0), cfjax.SineTransform())

    with pytest.raises(eqx.EquinoxRuntimeError, match="must have one spectrum"):
        cfjax.integrate(cfjax.LieTerm(field), cfjax.CF3(), 0.0, 1.0, jnp.ones(4), num_steps=2)


def test_nan_in_an_operator_is_nan_of_that_member():
    """Neither an error about an operator that changes, nor another result of the others."""
    fields: Any = (
        lambda a, y: Affine(jnp.sin(y), -a * jnp.arange(3.0)),
        lambda a, y: cfjax.OperatorSum(a[None], [(a * jnp.diag(jnp.arange(3.0)), 2.5)]),
        # Its series has as many terms as the largest norm of the batch needs.
        lambda a, y: cfjax.LinearAffine(-a * jnp.diag(jnp.arange(3.0)), jnp.sin(y)),
    )

    @jax.jit
    @jax.vmap
    def ends(a):
        terms = [cfjax.LieTerm(lambda t, y, args, make=make: make(args, y)) for make in fields]
        solve = lambda term: cfjax.integrate(  # noqa: E731
            term, cfjax.CF3(), 0.0, 1.0, jnp.ones(3), a, num_steps=2, throw=False
        )
        return [solve(term).ys[-1] for term in terms]

    found, wants = (ends(jnp.asarray([1.0, x, 0.5])) for x in (jnp.nan, 1.0))
    for end, want in zip(found, wants, strict=True):
        assert np.isnan(end[1]).all()
        np.testing.assert_array_equal(end[::2], want[::2])
