"""Densities on the sphere and on rotations: closed forms, order, and a fit by likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import cfjax
from cfjax.scenes import flow_on_spheres
from cfjax.scenes.flow_on_spheres import Peaks


def by_dop853(t, k, start):
    """State and growth of the log-density: the divergences are 2 k z and k (1 + 2 cos angle)."""

    def rate(t, flat):
        y, r = flat[:3], flat[3:12].reshape(3, 3)
        # The trace of a rotation is 1 + 2 cos angle.
        growth = 2 * k * y[2] + k * np.trace(r)
        turned = -k * (r - r.T) / 2 @ r
        return np.concatenate([k * (np.eye(3)[2] - y[2] * y), turned.ravel(), [growth]])

    flat = np.concatenate([start["vector"], start["rotation"].ravel(), [0.0]])
    return solve_ivp(rate, (0, t), flat, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


def test_the_closed_form_against_dop853():
    start, k = flow_on_spheres.y0(), 0.7
    want = by_dop853(1.4, k, start)
    found = flow_on_spheres.reference(1.4, k)
    # Some ten tolerances.
    np.testing.assert_allclose(found.state["vector"], want[:3], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.state["rotation"].ravel(), want[3:12], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.log_density, want[12], rtol=0, atol=1e-10)
    turn = expm(2.0 * np.array([[0, -2, -1], [2, 0, -2], [1, 2, 0]]) / 3)
    np.testing.assert_allclose(start["rotation"], turn, rtol=0, atol=1e-14)


def test_densities_have_integral_one():
    x, weights = np.polynomial.legendre.leggauss(200)
    total = weights @ flow_on_spheres.density_of_heights(0.8, x, 1.2) / 2
    np.testing.assert_allclose(total, 1.0, rtol=0, atol=1e-12)
    angle = np.pi * (1 + x) / 2
    # Haar's measure of angles has the density (1 - cos angle) / pi.
    density = flow_on_spheres.density_of_angles(0.8, angle, 1.2) * (1 - np.cos(angle)) / np.pi
    np.testing.assert_allclose(np.pi / 2 * weights @ density, 1.0, rtol=0, atol=1e-12)


def test_rkmk8_against_the_reference():
    problem = flow_on_spheres.problem()
    with cfjax.rewriting(False):
        ys = cfjax.integrate(**problem, solver=flow_on_spheres.solver, num_steps=10).ys
    end = jax.tree.map(lambda x: np.asarray(x[-1]), ys)
    exact = flow_on_spheres.reference(flow_on_spheres.t1)
    # Ten steps, of entries of 1.
    assert flow_on_spheres.error(end, exact) < 2e-14
    # And the density of the vector from the height at its end.
    height = exact.state["vector"][2]
    angle = np.arccos((np.trace(exact.state["rotation"]) - 1) / 2)
    density = flow_on_spheres.density_of_heights(1.0, height)
    density *= flow_on_spheres.density_of_angles(1.0, angle)
    np.testing.assert_allclose(end.log_density, np.log(density), rtol=0, atol=1e-13)


def grid_and_weights(n, m):
    """Over the sphere, by a product of Gauss's rule and a sum."""
    x, weights = np.polynomial.legendre.leggauss(n)
    longitude = 2 * np.pi * np.arange(m) / m
    ring = np.sqrt(1 - x**2)[:, None]
    points = ring * np.cos(longitude), ring * np.sin(longitude), x[:, None] + 0 * longitude
    return np.stack(points, axis=-1), weights


def test_peaks():
    args = Peaks()
    grid, weights = grid_and_weights(60, 80)
    density = np.exp(flow_on_spheres.log_density_of(args, grid.reshape(-1, 3))).reshape(60, 80)
    np.testing.assert_allclose(weights @ density.mean(axis=1) / 2, 1.0, rtol=0, atol=1e-10)
    y = flow_on_spheres.samples_of(args, 20_000)
    np.testing.assert_allclose(np.linalg.norm(y, axis=1), 1.0, rtol=0, atol=1e-14)
    mean = np.einsum("i,ij,ijk->k", weights, density, grid) / 160
    # Five standard errors of a mean of entries of at most 1.
    np.testing.assert_allclose(y.mean(axis=0), mean, rtol=0, atol=5 / np.sqrt(20_000))


def test_the_density_of_a_network_has_integral_one():
    args = flow_on_spheres.network(jax.random.key(1), 4)
    args = args._replace(outer=10 * args.outer)
    grid, weights = grid_and_weights(12, 24)
    with cfjax.rewriting(False):
        logs = jax.jit(flow_on_spheres.log_likelihood)(args, grid.reshape(-1, 3))
    density = np.exp(np.asarray(logs)).reshape(12, 24)
    total = weights @ density.mean(axis=1) / 2
    # Far from uniform, with four steps of order 4 and few nodes.
    assert density.max() > 1.5
    np.testing.assert_allclose(total, 1.0, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_fit_is_nearly_as_likely_as_the_truth():
    args = Peaks()
    found, values = flow_on_spheres.fit(flow_on_spheres.samples_of(args, 1500))
    assert abs(values[0]) < 0.1 and values[-1] > 0.9
    new = jnp.asarray(flow_on_spheres.samples_of(args, 5000, seed=1))
    truth = np.mean(flow_on_spheres.log_density_of(args, new))
    # By Gibbs' inequality no density has a greater mean, up to four standard errors of 0.02.
    assert -0.04 < float(jnp.mean(flow_on_spheres.log_likelihood(found, new))) - truth < 0.02
