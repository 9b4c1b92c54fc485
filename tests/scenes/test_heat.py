"""The heat scene: its equations, its reference, orders, derivatives, and what a step costs."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems

import cfjax
from cfjax.scenes import heat

COEFFICIENTS = cfjax.LieTerm(heat.field)
GRID = cfjax.LieTerm(heat.grid_field)


def arguments(num_intervals) -> heat.Diffusivity:
    return problems.arrays(heat.diffusivity(num_intervals))


def matrix(mu):
    """The semidiscrete operator, written down from the paper's formula."""
    n = len(mu)
    below = np.diag(mu[1:-1], -1)
    return (below + below.T - np.diag(mu[:-1] + mu[1:])) * (n / 2) ** 2


def end(solution) -> jax.Array:
    return solution.ys[-1]


# The problem


def test_fields_are_the_equation():
    mu, constant = heat.diffusivity()
    x = -1 + 0.02 * np.arange(101)
    np.testing.assert_allclose(mu, 1 - ((x[1:] + x[:-1]) / 2) ** 2, rtol=1e-13)
    # By hand: the mean of 1 - x^2 over N midpoints is 2/3 + 1/(3 N^2).
    np.testing.assert_allclose(constant, 2 / 3 + 1 / 30000, rtol=1e-14)

    @jax.jit
    def parts(u, args):
        y = heat.from_grid(u)
        field = heat.field(0.0, y, args)
        start = jnp.asarray(heat.y0(len(u) + 1))
        linear = (field.b, field.tangent(y), field.spectrum * y, y, start)
        return heat.grid_field(0.0, u, args), *map(heat.to_grid, linear)

    for n in (10, 99):
        mu, constant = heat.diffusivity(n)
        a, m = matrix(np.asarray(mu)), matrix(np.full(n, constant))
        u = np.random.default_rng(0).standard_normal(n - 1)
        # The operator has norm n^2, points have norm sqrt(n), and a transform and its inverse add
        # rounding of 4 sqrt(n) units of the largest entry each, as its own tests bound it.
        atol = 2.0**-52 * n**2 * 8 * np.sqrt(n)
        grid, b, tangent, linear, same, start = parts(jnp.asarray(u), arguments(n))
        np.testing.assert_allclose(grid, a @ u, rtol=0, atol=atol)
        np.testing.assert_allclose(b, (a - m) @ u, rtol=0, atol=atol)
        np.testing.assert_allclose(tangent, a @ u, rtol=0, atol=2 * atol)
        np.testing.assert_allclose(linear, m @ u, rtol=0, atol=2 * atol)
        np.testing.assert_allclose(same, u, rtol=0, atol=1e-13)
        x = np.linspace(-1, 1, n + 1)[1:-1]
        np.testing.assert_allclose(start, 1 - np.abs(x), rtol=0, atol=1e-13)


def test_reference():
    mu = np.asarray(heat.diffusivity(8).mu)
    with mpmath.workdps(30):
        u0 = mpmath.matrix((1 - np.abs(np.linspace(-1, 1, 9)[1:-1])).tolist())
        for t in (0.0, 0.1, 0.5):
            exact = mpmath.expm(mpmath.matrix(matrix(mu).tolist()) * t) * u0
            exact = np.array(exact.tolist(), float)[:, 0]
            np.testing.assert_allclose(heat.reference(t, mu), exact, rtol=0, atol=1e-14)
    times = np.array([[0.0, 0.1, 0.5]])
    assert heat.reference(times, mu).shape == (1, 3, 7)
    one = heat.reference(0.1, mu)
    np.testing.assert_allclose(heat.reference(times, mu)[0, 1], one, rtol=0, atol=1e-15)


def test_reference_solves_the_large_system():
    # Differences of order 4 in time with steps of 1e-3 at t = 0.3, where rates up to 20 are left.
    mu = np.asarray(heat.diffusivity(100).mu)
    u = heat.reference(0.3 + 1e-3 * np.arange(-2, 3), mu)
    slope = (u[0] - u[4] - 8 * (u[1] - u[3])) / 0.012
    np.testing.assert_allclose(slope, matrix(mu) @ u[2], rtol=0, atol=1e-8)
    # For mu = 1 - x^2 the fast rates are -k (k + 1), as in Legendre's equation.
    k = np.arange(99, 59, -1)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(matrix(mu))[:40], -k * (k + 1.0), rtol=0, atol=1e-10
    )


# Methods


def test_order_where_the_system_is_not_stiff():
    """With N = 6 the eigenvalues are up to 30, and steps of 1/100 resolve them all."""
    exact = heat.reference(0.5, np.asarray(heat.diffusivity(6).mu))
    answer = np.asarray(heat.from_grid(jnp.asarray(exact)))
    steps = [64, 128, 256]
    errors = problems.errors(heat.field, cfjax.CF4(), 0.5, heat.y0(6), arguments(6), answer, steps)
    assert errors.min() > 1e-13
    assert abs(problems.slope(steps, errors) - 4) < 0.15


def test_translations_make_the_classical_runge_kutta_method():
    a, h = matrix(np.asarray(heat.diffusivity(20).mu)), 5e-3
    u = wanted = 1 - np.abs(np.linspace(-1, 1, 21)[1:-1])
    for _ in range(20):
        k1 = a @ wanted
        k2 = a @ (wanted + h / 2 * k1)
        k3 = a @ (wanted + h / 2 * k2)
        k4 = a @ (wanted + h * k3)
        wanted = wanted + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    found = cfjax.integrate(GRID, cfjax.CF4(), 0.0, 20 * h, u, arguments(20), num_steps=20)
    np.testing.assert_allclose(end(found), wanted, rtol=0, atol=1e-14)


def test_a_step_costs_eight_transforms():
    y0, args = jnp.asarray(heat.y0(300)), arguments(300)

    def step(y):
        return problems.first_step(cfjax.CF4(), COEFFICIENTS, 0.0, 0.01, y, args)[0]

    text = jax.jit(step).lower(y0).compile().as_text()
    assert text is not None and text.count(" fft(") == 8


# Derivatives of whole solutions
