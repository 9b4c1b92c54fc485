"""The Allen-Cahn equation: an exact solution, the energy that it descends, and drops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import allen_cahn

TERM = cfjax.LieTerm(allen_cahn.field)
WIDTH = allen_cahn.WIDTH


def end(start, t, num_steps, width=WIDTH):
    found = cfjax.integrate(TERM, cfjax.CF4(), 0.0, t, start, width, num_steps=num_steps)
    return np.asarray(found.ys[-1])


def test_the_exact_solution_solves_the_equation():
    n, t, h = 2000, 2.7, 1e-3
    u = allen_cahn.reference(t, n)
    before, after = allen_cahn.reference(t - h, n), allen_cahn.reference(t + h, n)
    curvature = np.diff(u, 2) * n**2
    want = WIDTH**2 * curvature + (u - u**3)[1:-1]
    # Second differences, of steps of 1/32 of a width and of 1e-3: squares of these over 12 and 6.
    np.testing.assert_allclose((after - before)[1:-1] / (2 * h), want, rtol=0, atol=2e-4)
    # They meet at 3, and stand still later on.
    z = ((np.arange(n) + 0.5) / n - 0.5) / (2**0.5 * WIDTH)
    np.testing.assert_allclose(allen_cahn.reference(40.0, n), np.tanh(z), rtol=0, atol=1e-15)
    np.testing.assert_allclose(allen_cahn.reference(3.0, n), np.tanh(z / 2), rtol=0, atol=1e-15)


def test_the_field_descends_the_energy_and_is_the_equation():
    @jax.jit
    def parts(y, width):
        energy, slope = jax.value_and_grad(allen_cahn.energy)(y, width)
        return allen_cahn.velocity(0.0, y, width), energy, slope

    # The energy is a mean. Eigenvalues up to 17.
    y = jnp.asarray(np.random.default_rng(0).normal(size=(12, 10)))
    velocity, _, slope = parts(y, 0.1)
    np.testing.assert_allclose(-slope * y.size, velocity, rtol=0, atol=1e-12)
    x, y = (np.arange(12) + 0.5) / 12, (np.arange(10) + 0.5) / 10
    wave = np.cos(2 * np.pi * x)[:, None] * np.cos(3 * np.pi * y)
    square = (0.1 * np.pi) ** 2 * 13
    u = 0.3 * wave
    velocity, energy, _ = parts(jnp.asarray(u), 0.1)
    np.testing.assert_allclose(velocity, -square * u + u - u**3, rtol=0, atol=1e-14)
    # The means of the wave's square and fourth power are 1/4 and 9/64.
    want = 0.09 * square / 8 + (1 - 0.09 / 2 + 0.0081 * 9 / 64) / 4
    assert float(energy) == pytest.approx(want, rel=1e-14)
    # Of a front, to the resolution of the cells, as of the exact solution.
    front = jnp.asarray(allen_cahn.reference(40.0))
    _, energy, _ = parts(front, WIDTH)
    assert float(energy) == pytest.approx(WIDTH * 8**0.5 / 3, rel=1e-10)


def test_order_on_the_exact_solution():
    start, want = allen_cahn.y0(), allen_cahn.reference(6.0)
    # 40 and 80 steps by one program: nothing depends on time.
    ends = end(start, 6.0, 40), end(end(start, 3.0, 40), 3.0, 40)
    errors = [np.abs(found - want).max() for found in ends]
    assert 14 < errors[0] / errors[1] < 20
    # Far above the error of the cells.
    assert errors[1] > 1e-10


def test_every_axis_is_like_the_line():
    @jax.jit
    def flow(y):
        field = allen_cahn.field(0.0, y, 0.1)
        return field.flow(y), field.tangent(y)

    start = jnp.asarray(allen_cahn.reference(0.0, 32, 0.1))
    want = np.stack(flow(start))[:, None] + np.zeros((32, 1))
    along = flow(jnp.broadcast_to(start, (32, 32)))
    across = flow(jnp.broadcast_to(start[:, None], (32, 32)))
    # Rounding of products with dense matrices.
    np.testing.assert_allclose(along, want, rtol=0, atol=1e-13)
    np.testing.assert_allclose(across, np.swapaxes(want, 1, 2), rtol=0, atol=1e-13)


@pytest.mark.slow
def test_the_error_of_the_reference():
    found = end(allen_cahn.y0(), 6.0, 1280)
    assert np.abs(found - allen_cahn.reference(6.0)).max() < 1e-11


@pytest.mark.slow
def test_the_area_of_a_drop():
    width, t, n = 0.02, 40.0, 128
    ys = cfjax.integrate(
        TERM, cfjax.CF4(), 0.0, t, allen_cahn.drop(n), width, num_steps=160, save_every=4
    ).ys
    area = np.mean((1 + np.asarray(ys)) / 2, axis=(1, 2))
    slopes = np.diff(area)
    # To leading order in the width over the radius of curvature, 0.02 / 0.2 here.
    np.testing.assert_allclose(slopes, -2 * np.pi * width**2, rtol=0.1)
    energies = jax.vmap(lambda y: allen_cahn.energy(y, width))(ys)
    assert np.all(np.diff(energies) < 0)
    # By then it is nearly round: as far out along an axis as along a diagonal.
    u = np.asarray(ys[-1])
    middle = n // 2
    axis = np.sum((1 + u[middle:, middle]) / 2)
    diagonal = np.sum((1 + np.diag(u)[middle:]) / 2) * 2**0.5
    assert diagonal == pytest.approx(axis, rel=0.1)
