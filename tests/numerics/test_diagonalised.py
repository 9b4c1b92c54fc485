"""`diagonalised`: solves against scipy's exponential, the kinds of points, and what is refused."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from xla.interpreter import run

import cfjax

EPS = 2.0**-52


def heat(n=19):
    """`(mu u_x)_x` and `mu u_xx` on n points, with `mu = 1 - x^2`: the second is not symmetric."""
    dx = 2 / (n + 1)
    x = np.linspace(-1, 1, n + 2)
    mu = 1 - (x[:-1] + dx / 2) ** 2
    flux = np.diag(-mu[:-1] - mu[1:]) + np.diag(mu[1:-1], 1) + np.diag(mu[1:-1], -1)
    plain = np.diag(np.full(n, -2.0)) + np.eye(n, k=1) + np.eye(n, k=-1)
    return flux / dx**2, (1 - x[1:-1, None] ** 2) * plain / dx**2


def advection(n=12):
    """Diffusion and upwind advection on a line with an inflow, far from normal."""
    return 3 * (np.eye(n, k=1) - 2 * np.eye(n) + np.eye(n, k=-1)) - 8 * (
        np.eye(n, k=1) - np.eye(n, k=-1)
    )


def hermitian(n=6):
    a = np.random.default_rng(0).standard_normal((2, n, n))
    a = a[0] + 1j * a[1]
    return a + a.conj().T


MATRICES: dict[str, tuple[np.ndarray, str]] = {
    "symmetric": (heat()[0], "real"),
    "symmetrisable": (heat()[1], "real"),
    "real eigenvalues": (np.triu(np.ones((4, 4))) + np.diag(np.arange(4.0)), "real"),
    "complex eigenvalues": (advection(), "real to complex"),
    # Three pairs, and a real eigenvalue.
    "odd": (np.random.default_rng(1).standard_normal((7, 7)), "real to complex"),
    "Hermitian": (hermitian(), "complex"),
    "complex": (np.random.default_rng(2).standard_normal((5, 5)) * (1 + 1j) + np.eye(5), "complex"),
    "real as complex": (advection().astype(complex), "complex"),
    "one": (np.array([[-3.0]]), "real"),
}
matrices = pytest.mark.parametrize("name", MATRICES)


def points(shape, is_complex, seed=0):
    x = np.random.default_rng(seed).standard_normal((2, *shape))
    return x[0] + 1j * x[1] if is_complex else x[0]


@matrices
def test_the_operator_is_diagonal(name):
    """For points alone and in columns; and the flow, where the matrix is not normal."""
    a, kind = MATRICES[name]
    n = len(a)
    spectrum, transform = cfjax.diagonalised(a)
    assert np.iscomplexobj(spectrum) == (kind != "real" and name != "Hermitian")
    shapes = [(n,), (n, 2, 2)] if n > 1 else [(n, 3)]
    for is_complex in {"real": (False, True), "complex": (True,)}.get(kind, (False,)):
        given = [jnp.asarray(points(shape, is_complex)) for shape in shapes]

        def everything(xs):
            return [(c := transform.forward(x), transform.inverse(c), scaled(c)) for x in xs]

        def scaled(c):
            factor = jnp.asarray(spectrum).reshape(-1, *[1] * (c.ndim - 1))
            return transform.inverse(factor.astype(c.dtype) * c)

        for x, (c, back, found) in zip(given, run(everything, given), strict=True):
            assert c.shape == (len(spectrum), *x.shape[1:])
            assert jnp.iscomplexobj(c) == (is_complex or kind != "real")
            assert found.dtype == x.dtype
            # Sums of n products, in vectors of a condition up to 1e3.
            atol = n * EPS * 1e3
            np.testing.assert_allclose(back, x, rtol=0, atol=atol)
            atol *= np.abs(a).max()
            np.testing.assert_allclose(found, np.tensordot(a, x, 1), rtol=0, atol=atol)
    if name in ("complex eigenvalues", "odd", "complex", "real eigenvalues"):
        b, u = (points((n,), kind == "complex", seed) for seed in (1, 2))
        field = cfjax.Affine(b, spectrum, transform, alpha=0.3)
        wanted = exact_flow(0.3 * a, b, u)
        # The condition of the eigenvectors, up to 400, times some units of norms up to 7.
        atol = 400 * 20 * EPS * np.abs(wanted).max()
        end, velocity = run(lambda u: (field.flow(u), field.tangent(u)), u)
        np.testing.assert_allclose(end, wanted, rtol=0, atol=atol)
        np.testing.assert_allclose(velocity, 0.3 * a @ u + b, rtol=0, atol=10 * atol)


def exact_flow(a, b, u):
    """Where `x' = a x + b` leads u in unit time."""
    n = len(a)
    whole = np.zeros((n + 1, n + 1), np.result_type(a, b))
    whole[:n, :n], whole[:n, n] = a, b
    return (scipy.linalg.expm(whole) @ np.append(u, 1))[:n]


def test_half_of_the_conjugate_eigenvalues():
    a, _ = MATRICES["odd"]
    spectrum, _ = cfjax.diagonalised(a)
    every: Any = np.linalg.eigvals(a)
    assert len(spectrum) == np.sum(every.imag >= 0) < 7
    np.testing.assert_allclose(np.sort(np.real(spectrum)), np.sort(every[every.imag >= 0].real))


def test_heat_with_a_variable_coefficient_is_exact_in_one_step():
    a = heat(49)[1]
    n, b = len(a), np.linspace(1, 2, len(a))
    spectrum, transform = cfjax.diagonalised(a)
    assert spectrum.dtype == np.float64 and spectrum.max() < 0
    term = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.asarray(b), args, transform))
    u0 = 1 - np.abs(np.linspace(-1, 1, n + 2)[1:-1])
    given = term, cfjax.CF4(), 0.0, 0.5, jnp.asarray(u0), spectrum
    found = cfjax.integrate(*given, num_steps=1).ys[-1]
    wanted = exact_flow(0.5 * a, 0.5 * b, u0)
    # Eigenvalues are known to some units of the largest, 0.5 * 2500 here. The scaling that makes
    # `mu u_xx` symmetric has a condition of 4, and the squarings of expm lose as much again.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=8 * 1250 * EPS)


GRIDS: dict[str, Any] = {
    # The matrix, the transform of the other axis, and which axis the matrix is on.
    "sine": (heat(6)[1], cfjax.SineTransform(), 0),
    "after sine": (advection(4), cfjax.SineTransform(), 1),
    "real Fourier": (heat(6)[1], cfjax.RealFourierTransform(4), 0),
    "complex and real Fourier": (advection(5).astype(complex), cfjax.RealFourierTransform(4), 0),
    "complex eigenvalues and Fourier": (advection(5), cfjax.FourierTransform(), 1),
}


@pytest.mark.parametrize("name", GRIDS)
def test_one_axis_of_a_grid(name):
    a, other, axis = GRIDS[name]
    spectrum, transform = cfjax.diagonalised(a)
    n = 4
    eye = np.eye(n)
    line = np.roll(eye, 1, axis=0) + np.roll(eye, -1, axis=0) - 2 * eye
    if isinstance(other, cfjax.SineTransform):
        line[0, -1] = line[-1, 0] = 0
    pair = [(a.real, spectrum, transform), (line, other.second_difference(n), other)]
    (m1, s1, t1), (m2, s2, t2) = pair if axis == 0 else pair[::-1]
    operator = np.kron(m1, np.eye(len(m2))) + np.kron(np.eye(len(m1)), m2)
    b, u = (points((len(m1), len(m2)), False, seed) for seed in (1, 2))
    grid = cfjax.TensorTransform((t1, t2))
    field = cfjax.Affine(b, np.add.outer(s1, s2), grid, alpha=0.1)
    wanted = exact_flow(0.1 * operator, b.ravel(), u.ravel()).reshape(u.shape)
    found = run(field.flow, u)
    assert found.dtype == u.dtype
    # The condition of the eigenvectors, up to 60, times some units of norms up to 5.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=60 * 20 * EPS * np.abs(wanted).max())


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["complex eigenvalues", "symmetrisable", "complex"])
def test_float32(name):
    a, kind = MATRICES[name]
    wide, transform = cfjax.diagonalised(a)
    single = np.complex64 if np.iscomplexobj(a) else np.float32
    spectrum, own = cfjax.diagonalised(a.astype(single))
    assert spectrum.dtype == wide.astype(np.complex64 if kind != "real" else np.float32).dtype
    x = jnp.asarray(points((len(a),), kind == "complex"))
    for t in (transform, own):
        # One transform serves points of both precisions.
        c, back = run(lambda x, t=t: (c := t.forward(x), t.inverse(c)), x.astype(single))
        assert c.dtype == spectrum.dtype
        assert back.dtype == single
        # Sums of n products, in vectors of a condition up to 400.
        np.testing.assert_allclose(back, x, rtol=0, atol=len(a) * 2.0**-23 * 100)
    b = jnp.ones(len(a), single)
    term = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(b, args, transform))
    times = (np.float32(0), np.float32(0.1))
    end = cfjax.integrate(
        term, cfjax.CF4(), *times, x.astype(single), jnp.asarray(spectrum), num_steps=2
    )
    assert end.ys.dtype == single and np.isfinite(end.ys).all()


def test_batches_without_another_trace():
    a = heat(6)[1]
    traces = 0

    @eqx.filter_jit
    def flows(transform, spectrum, points):
        nonlocal traces
        traces += 1
        field = cfjax.Affine(jnp.ones(6), spectrum, transform, alpha=0.1)
        return jax.vmap(field.flow)(points)

    u = jnp.asarray(points((3, 6), False))
    spectrum, transform = cfjax.diagonalised(a)
    found = flows(transform, spectrum, u)
    # Made anew it is the same.
    again, same = cfjax.diagonalised(a)
    np.testing.assert_array_equal(flows(same, again, u), found)
    assert traces == 1
    field = cfjax.Affine(jnp.ones(6), spectrum, transform, alpha=0.1)
    for x, y in zip(u, found, strict=True):
        np.testing.assert_allclose(run(field.flow, x), y, rtol=0, atol=20 * EPS)
    other = cfjax.diagonalised(a.T)[1]
    assert other != transform and hash(other) != hash(transform)
    with pytest.raises(ValueError, match="must have one operator"):
        cfjax.combine((1.0, 1.0), (field, cfjax.Affine(jnp.ones(6), spectrum, other, alpha=0.1)))


def test_a_program_has_each_matrix_once():
    transform = cfjax.diagonalised(heat(6)[0])[1]
    program = jax.make_jaxpr(lambda x: transform.forward(transform.forward(x)))(jnp.ones(6))
    assert len(program.consts) == 1


def test_no_symmetry_is_made_up():
    """Products of opposite entries are positive, but not consistent around a triangle."""
    a = np.array([[0.0, 4, 1], [1, 0, 1], [1, 1, 0]])
    spectrum, transform = cfjax.diagonalised(a)
    found = run(lambda x: transform.inverse(spectrum * transform.forward(x)), jnp.arange(3.0))
    np.testing.assert_allclose(found, a @ np.arange(3.0), rtol=0, atol=100 * EPS)


# What is refused.


def test_a_defective_matrix():
    with pytest.raises(ValueError, match=r"condition number .* 1e\+06, got .*cfjax.LinearAffine"):
        cfjax.diagonalised(np.eye(50) + np.eye(50, k=1))
    # Symmetrisable, but only by a scaling of condition 1e12.
    a = np.eye(13, k=1) + 100 * np.eye(13, k=-1)
    with pytest.raises(ValueError, match="condition number"):
        cfjax.diagonalised(a)


def sheared(n, spread):
    """Eigenvalues from 0 to -spread, and eigenvectors that are the closer the smaller that is."""
    return np.eye(n, k=1) - np.diag(np.linspace(0.0, spread, n))


def flow_of(spectrum, transform, dtype):
    """The matrix of the flow, with points of this dtype."""
    field = cfjax.Affine(jnp.zeros(10, dtype), spectrum.astype(dtype), transform)
    return run(jax.vmap(field.flow), np.eye(10, dtype=dtype)).T


def test_the_bound_on_the_condition_belongs_to_the_precision():
    # Condition numbers of 700, and of 4e5, where float32 would be off by 3e-3 and more.
    fair, poor = (sheared(10, spread).astype(np.float32) for spread in (3.0, 1.5))
    exact = scipy.linalg.expm(fair.astype(float))
    # A tenth of the condition number times a unit, twice for chance.
    np.testing.assert_allclose(
        flow_of(*cfjax.diagonalised(fair), np.float32), exact, rtol=0, atol=140 * 2.0**-23
    )
    with pytest.raises(ValueError, match=r"condition number below 3e\+03, got .* float32.*LinearA"):
        cfjax.diagonalised(poor)
    # float64 takes it, for points in float64 alone.
    spectrum, transform = cfjax.diagonalised(poor.astype(float))
    exact = scipy.linalg.expm(poor.astype(float))
    np.testing.assert_allclose(
        flow_of(spectrum, transform, np.float64), exact, rtol=0, atol=1e5 * EPS
    )
    with pytest.raises(ValueError, match=r"The matrix of .* below 3e\+03, got .* in float32"):
        flow_of(spectrum, transform, np.float32)
    # So of one that a diagonal scaling of condition 1e4 makes symmetric.
    with pytest.raises(ValueError, match=r"condition number below 3e\+03, got .* in float32"):
        cfjax.diagonalised((np.eye(5, k=1) + 100 * np.eye(5, k=-1)).astype(np.float32))


def test_wrong_matrices_and_points(no_shape_hook, subtests):
    made = cfjax.diagonalised
    _, three = made(np.eye(3))
    _, twelve = made(advection())
    ones, shape = jnp.ones, r"matrix must have the shape"
    values = (
        (lambda: made(np.ones((2, 3))), rf"{shape} \(n, n\) with n >= 1, got \(2, 3\)"),
        (lambda: made(np.ones((0, 0))), rf"{shape} .* got \(0, 0\)"),
        (lambda: made(np.ones(3)), rf"{shape} .* got \(3,\)"),
        (
            lambda: made(np.diag([1.0, np.nan, np.inf])),
            "matrix must be finite, got 2 entries that are not",
        ),
        (
            lambda: three.forward(ones(4)),
            "cfjax.diagonalised, .* got length 4 along its axis, expected 3",
        ),
        (lambda: twelve.inverse(ones(7, complex)), "got 7 coefficients along its axis, expected 6"),
        (
            lambda: cfjax.TensorTransform([twelve] * 2),
            r"at most one RealFourierTransform, or .* diagonalised\(matrix.astype\(complex\)\)",
        ),
    )
    types = (
        (lambda: made(np.eye(3, dtype=int)), "matrix must be one of float32, .*, got int64"),
        (
            lambda: jax.jit(lambda a: made(a)[0])(jnp.eye(3)),
            r"matrix must be known before .* got a traced array, float64 of shape \(3, 3\)",
        ),
        (
            lambda: twelve.forward(ones(12, complex)),
            "takes real points, got complex128. For complex points take",
        ),
        (
            lambda: made(hermitian())[1].forward(ones(6)),
            "of a complex matrix takes complex points, got float64",
        ),
        (lambda: three.forward(jnp.arange(3)), "takes arrays of float32, .*, got int64"),
    )
    for error, cases in ((ValueError, values), (TypeError, types)):
        for call, message in cases:
            with subtests.test(case=message), pytest.raises(error, match=message):
                call()
