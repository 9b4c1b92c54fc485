"""Affine: the flow against a dense exponential, derivatives, the algebra, and what is refused."""

from typing import Any

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
    "sine": (cfjax.SineTransform(), DIFFUSION, float),
    "sine, growth": (cfjax.SineTransform(), -DIFFUSION, float),
    "sine, rotation": (cfjax.SineTransform(), 1j * DIFFUSION, complex),
    "cosine": (cfjax.CosineTransform(), -8 * np.sin(K * np.pi / (2 * N)) ** 2, float),
    "Fourier": (cfjax.FourierTransform(), ADVECTION - 1, complex),
    "real Fourier": (cfjax.RealFourierTransform(N), (ADVECTION - 1)[: N // 2 + 1], float),
    "real Fourier, real": (cfjax.RealFourierTransform(N), DIFFUSION[: N // 2 + 1], float),
}
cases = pytest.mark.parametrize("case", CASES)


def data(case, shape=(N,), seed=0):
    """A field, a point, and the dense operator M, columns from the transform's own definition."""
    transform, spectrum, dtype = CASES[case]
    rng = np.random.default_rng(seed)
    b, point = rng.standard_normal((2, *shape)).astype(dtype)
    if dtype is complex:
        b, point = b + 1j * rng.standard_normal(shape), point - 1j * rng.standard_normal(shape)
    field = Affine(0.7, b, spectrum, transform)
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


@cases
@pytest.mark.parametrize("columns", [(), (3,), (2, 2)])
def test_flow_against_a_dense_exponential(case, columns):
    field, point, m = data(case, (N, *columns))
    wanted = exact(m, 0.7, field.b, point)
    # The dense M is known to rounding, which alpha M of norm 6 passes on to the exponential.
    atol = 30 * EPS * np.abs(wanted).max()
    found = field.flow(point)
    assert found.dtype == point.dtype
    np.testing.assert_allclose(found, wanted, rtol=0, atol=atol)


@cases
def test_tangent_is_the_velocity_of_the_flow(case):
    field, point, m = data(case)

    def path(t):
        return Affine.combine((t,), (field,)).flow(point)

    wanted = 0.7 * m @ point + field.b
    atol = 20 * EPS * 8 * np.abs(point).max()
    np.testing.assert_allclose(field.tangent(point), wanted, rtol=0, atol=atol)
    np.testing.assert_allclose(jax.jacfwd(path)(0.0), wanted, rtol=0, atol=atol)


def test_zero_field_and_translation():
    for case in CASES:
        field, point, _ = data(case)
        still = Affine.combine((0.0,), (field,)).flow(point)
        transform, spectrum, _ = CASES[case]
        moved = Affine(0.0, field.b, spectrum, transform).flow(point)
        if transform is None:
            np.testing.assert_array_equal(still, point)
            np.testing.assert_array_equal(moved, point + field.b)
        # There and back by a transform costs a few units.
        np.testing.assert_allclose(still, point, rtol=0, atol=10 * EPS)
        np.testing.assert_allclose(moved, point + field.b, rtol=0, atol=20 * EPS)


def test_infinitely_stiff():
    """exp(-z) underflows and the answer is the balance of both terms, -b / (alpha lambda)."""
    spectrum, b = -np.array([1e3, 1e8, 1e300]), np.array([1.0, 2.0, 3.0])
    found = Affine(2.0, b, spectrum).flow(jnp.ones(3))
    np.testing.assert_allclose(found, b / (-2 * spectrum), rtol=4 * EPS)


@cases
def test_bracket_is_the_commutator_of_the_fields(case):
    a, x, m = data(case, seed=1)
    b = Affine.combine((-1.3,), (data(case, seed=2)[0],))
    commutator = (
        jax.jvp(a.tangent, (x,), (b.tangent(x),))[1] - jax.jvp(b.tangent, (x,), (a.tangent(x),))[1]
    )
    found = a.bracket(b)
    assert float(found.alpha) == 0
    # Two products with alpha M, of norm up to 6.
    atol = 40 * EPS * 36
    np.testing.assert_allclose(found.tangent(x), commutator, rtol=0, atol=atol)
    wanted = m @ (float(a.alpha) * b.b - float(b.alpha) * a.b)
    np.testing.assert_allclose(found.b, wanted, rtol=0, atol=atol)
    np.testing.assert_allclose(b.bracket(a).b, -found.b, rtol=0, atol=1e-300)


def test_combine_is_linear_in_the_coordinates_and_keeps_the_rest():
    a, b = data("sine", seed=1)[0], data("sine", seed=2)[0]
    c = cfjax.combine((2.0, -0.5), (a, b))
    assert float(c.alpha) == pytest.approx(1.05)
    np.testing.assert_allclose(c.b, 2 * a.b - b.b / 2, rtol=1e-15)
    np.testing.assert_array_equal(c.spectrum, a.spectrum)
    assert c.transform == a.transform


class Plane(cfjax.AbstractTransform):
    """Sine transforms along both axes of a grid."""

    def forward(self, point):
        sine = cfjax.SineTransform()
        return sine.forward(sine.forward(point).T).T

    def inverse(self, coefficients):
        return self.forward(coefficients)


def test_a_transform_of_ones_own_in_two_dimensions():
    m = dense(cfjax.SineTransform(), DIFFUSION, float)
    both = np.kron(m, np.eye(N)) + np.kron(np.eye(N), m)
    rng = np.random.default_rng(0)
    b, u = rng.standard_normal((2, N, N))
    field = Affine(0.7, b, DIFFUSION[:, None] + DIFFUSION, Plane())
    a = np.zeros((N * N + 1, N * N + 1))
    a[:-1, :-1], a[:-1, -1] = 0.7 * both, b.ravel()
    wanted = (scipy.linalg.expm(a) @ np.append(u.ravel(), 1))[:-1].reshape(N, N)
    np.testing.assert_allclose(field.flow(jnp.asarray(u)), wanted, rtol=0, atol=100 * EPS)


# Derivatives.


def parts(field, point):
    """All that a flow depends on, as real arrays, and the flow as a function of them."""
    arrays = (field.alpha, field.b, field.spectrum, point)
    split = [(x.real, x.imag) if jnp.iscomplexobj(x) else (x,) for x in arrays]

    def flow(split):
        alpha, b, spectrum, point = (jax.lax.complex(*x) if len(x) == 2 else x[0] for x in split)
        end = Affine(alpha, b, spectrum, field.transform).flow(point)
        return jnp.concatenate([end.real, end.imag]) if jnp.iscomplexobj(end) else end

    return split, flow


@cases
@pytest.mark.parametrize("alpha", [0.7, 0.0])
def test_derivatives(case, alpha):
    field, point, _ = data(case)
    field = Affine(alpha, field.b, field.spectrum, field.transform)
    x, flow = parts(field, point)
    dx, weights = problems.random_like(x, 1), problems.random_like(flow(x), 2)
    size = float(np.abs(flow(x)).max()) + 1
    # With eigenvalues up to 8 the fifth derivative is below 8^5 of the flow, so a step of 1e-4
    # leaves 1e-13 of truncation; rounding adds 1.5e-16 / 1e-4 of the values, a few dozen times.
    forward = jax.jvp(flow, (x,), (dx,))[1]
    wanted = problems.central_difference(flow, x, dx, 1e-4)
    problems.assert_close(forward, wanted, 1e-10 * size)

    def value(x):
        return jnp.vdot(weights, flow(x))

    gradient = jax.grad(value)
    found = problems.inner(gradient(x), dx)
    # The same sums in another order.
    assert float(found) == pytest.approx(float(jnp.vdot(weights, forward)), rel=1e-12, abs=1e-12)
    second = jax.jvp(gradient, (x,), (dx,))[1]
    wanted = problems.central_difference(gradient, x, dx, 1e-4)
    problems.assert_close(second, wanted, 1e-9 * size)
    problems.assert_close(
        jax.grad(lambda x: problems.inner(gradient(x), dx))(x), second, 1e-12 * size
    )


# Dtypes, batches, and solutions.


def test_float32():
    for case in CASES:
        field, point, m = data(case)
        single = jnp.complex64 if jnp.iscomplexobj(point) else jnp.float32
        spectrum = np.asarray(field.spectrum)
        spectrum = spectrum.astype(np.complex64 if np.iscomplexobj(spectrum) else np.float32)
        small = Affine(0.7, field.b.astype(single), spectrum, field.transform)
        assert small.alpha.dtype == jnp.float32
        found = small.flow(point.astype(single))
        assert found.dtype == single
        wanted = exact(m, 0.7, field.b, point)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=50 * 2.0**-23 * np.abs(wanted).max())


def test_batch():
    field, point, _ = data("sine")
    points = jnp.stack([point, -point, 2 * point])
    found = jax.jit(jax.vmap(field.flow))(points)
    for x, y in zip(points, found, strict=True):
        np.testing.assert_allclose(field.flow(x), y, rtol=0, atol=10 * EPS)

    def build(b, spectrum):
        return Affine(0.7, b, spectrum, cfjax.SineTransform()).flow(point)

    found = jax.vmap(build, in_axes=(0, None))(points, field.spectrum)
    for b, y in zip(points, found, strict=True):
        np.testing.assert_allclose(build(b, field.spectrum), y, rtol=0, atol=20 * EPS)


def reaction(transform):
    """`u' = M u + sin(u) + cos t`, as a field of points or, without a transform, its own state."""

    def field(t, y, args):
        return Affine(1.0, jnp.sin(y) + jnp.cos(t), args, transform)

    return field


@pytest.mark.parametrize("solver, order", [(cfjax.CF3(), 3), (cfjax.CF4(), 4), (cfjax.RKMK4(), 4)])
@pytest.mark.parametrize("case", ["sine", "cosine", "real Fourier", "coefficients"])
def test_order_of_a_nonlinear_problem(solver, order, case):
    transform, spectrum, _ = CASES[case]
    m = dense(transform, spectrum, float)
    y0 = np.sin(1.0 + K)
    answer = problems.reference(lambda t, y: m @ y + np.sin(y) + np.cos(t), 0.0, 1.0, y0)
    # Steps of 1/32 and less resolve the eigenvalues, up to 8, so no order is lost to stiffness.
    steps = [32, 64, 128]
    errors = problems.errors(reaction(transform), solver, 1.0, y0, spectrum, answer, steps)
    assert errors.min() > 20 * problems.REFERENCE_ERROR
    assert abs(problems.slope(steps, errors) - order) < 0.15


# What is refused.


def ones(dtype: Any = float, shape=(4,)):
    return jnp.ones(shape, dtype)


@pytest.mark.parametrize(
    "arguments, error, message",
    [
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
        (
            (1.0, ones(), ones(complex), cfjax.SineTransform()),
            TypeError,
            "spectrum must be float64 .* got complex128",
        ),
    ],
)
def test_wrong_arguments(arguments, error, message, no_shape_hook):
    with pytest.raises(error, match=message):
        Affine(*arguments)


@pytest.mark.parametrize("point", [jnp.ones(5), jnp.ones((4, 1)), jnp.ones(4, jnp.float32)])
def test_wrong_point(point, no_shape_hook):
    term = cfjax.LieTerm(lambda t, y, args: Affine(1.0, ones(), ones()))
    with pytest.raises(ValueError, match="Affine acts on points like its b, float64 of shape"):
        term.vf(0.0, point, None)
