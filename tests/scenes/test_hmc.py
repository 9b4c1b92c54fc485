"""Hybrid Monte Carlo: exact means, reversible trajectories, and the order of dH."""

import jax
import numpy as np
import pytest

import cfjax
from cfjax.scenes import hmc, wilson_flow

BETA = 4.0


@jax.jit
def energy(y):
    return hmc.energy(y, BETA)


def end_of(start, t0, t1, num_steps, solver):
    ys = cfjax.integrate(hmc.term, solver, t0, t1, start, BETA, num_steps=num_steps).ys
    return jax.tree.map(lambda y: y[-1], ys)


@pytest.fixture(scope="module")
def start():
    links = np.stack([wilson_flow.y0(2, seed=k, dimensions=2) for k in range(8)])
    return {"U": links, "P": np.asarray(hmc.momenta(jax.random.key(0), links.shape))}


def test_the_exact_plaquette():
    # Without neighbours, as on an infinite lattice: weight exp(beta cos) over the group's angles.
    nodes, weights = np.polynomial.legendre.leggauss(60)
    angle, weights = np.pi / 2 * (nodes + 1), np.pi / 2 * weights
    haar = weights * np.sin(angle) ** 2
    for beta in (0.7, 4.0):
        density = haar * np.exp(beta * np.cos(angle))
        alone = np.sum(density * np.cos(angle)) / np.sum(density)
        # Other characters have the power 400 of a number below 0.7.
        np.testing.assert_allclose(hmc.reference(beta, 20), alone, rtol=1e-13)
        # On a lattice of one point it is u v u^-1 v^-1, from two angles and the one of their axes.
        a, b, c = np.ix_(angle, angle, nodes)
        value = 1 - 2 * (np.sin(a) * np.sin(b)) ** 2 * (1 - c**2)
        volume = haar[:, None, None] * haar[:, None] * np.polynomial.legendre.leggauss(60)[1]
        density = volume * np.exp(beta * value)
        one = np.sum(density * value) / np.sum(density)
        np.testing.assert_allclose(hmc.reference(beta, 1), one, rtol=1e-12)
    np.testing.assert_allclose(hmc.reference(np.array([0.7, 4.0]))[1], hmc.reference(4.0))


def test_momenta_are_of_the_algebra_and_have_their_density():
    for n in (2, 3):
        p = np.asarray(hmc.momenta(jax.random.key(n), (4000, n, n)))
        np.testing.assert_allclose(p, -np.conj(np.swapaxes(p, 1, 2)), rtol=0, atol=1e-15)
        np.testing.assert_allclose(np.trace(p, axis1=1, axis2=2), 0, rtol=0, atol=2e-15)
        kinetic = np.sum(np.abs(p) ** 2, axis=(1, 2))
        # Half for each of n^2 - 1 directions, of which the variance is a half.
        error = np.sqrt((n * n - 1) / 2 / len(p))
        assert abs(kinetic.mean() - (n * n - 1) / 2) < 4 * error


def test_means_of_samples():
    """With steps so long that a tenth of the ends and more are refused."""
    start = hmc.y0(48, 2, beta=BETA)["U"]
    _, plaquettes, dh = hmc.samples(start, BETA, 120, cfjax.Strang(), num_steps=2)
    plaquettes, dh = np.asarray(plaquettes)[20:], np.asarray(dh)[20:]
    mean, error = hmc.estimate(plaquettes)
    assert abs(mean - hmc.reference(BETA, 2)) < 4 * error < 0.05
    # Trajectories keep volume, whatever the step.
    mean, error = hmc.estimate(np.exp(-dh))
    assert abs(mean - 1) < 4 * error < 0.1
    assert np.mean(np.minimum(1, np.exp(-dh))) < 0.9
    # A chain stays where it is if the end is refused.
    is_still = plaquettes[1:] == plaquettes[:-1]
    assert 0.02 < is_still.mean() < 0.3
    assert np.all(dh[1:][is_still] > 0)


def test_the_error_of_a_mean_is_that_of_independent_chains():
    values = np.array([[1.0, 3.0], [3.0, 7.0]])
    # Chains of means 2 and 5.
    np.testing.assert_allclose(hmc.estimate(values), (3.5, 1.5))


def test_a_trajectory_of_su3_goes_back_and_stays_in_the_group(start):
    end = end_of(start, 0.0, 1.0, 8, cfjax.Strang())
    u = np.asarray(end["U"])
    assert np.max(np.abs(u - start["U"])) > 0.1
    np.testing.assert_allclose(np.linalg.det(u), 1, rtol=0, atol=1e-14)
    np.testing.assert_allclose(u @ np.conj(np.swapaxes(u, -1, -2)) - np.eye(3), 0, atol=1e-14)
    back = end_of(end, 1.0, 0.0, 8, cfjax.Strang())
    for name in "UP":
        # Sixteen steps, each with a few units of rounding.
        np.testing.assert_allclose(back[name], start[name], rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    "name, num_steps",
    [
        ("Strang", 8),
        pytest.param("BlanesMoan4", 4, marks=pytest.mark.slow),
        pytest.param("Omelyan", 8, marks=pytest.mark.slow),
        pytest.param("BlanesMoan6", 6, marks=pytest.mark.slow),
        pytest.param("SRKN11b", 4, marks=pytest.mark.slow),
    ],
)
def test_the_order_of_dh(name, num_steps, start):
    solver, forces = hmc.METHODS[name]
    # The last force is the first one of the next step.
    assert len(solver.stages) == 2 * forces
    order = {"Strang": 2, "Omelyan": 2, "BlanesMoan4": 4}.get(name, 6)
    # The same program with half the step.
    middle = end_of(start, 0.0, 0.5, num_steps, solver)
    ends = end_of(start, 0.0, 1.0, num_steps, solver), end_of(middle, 0.5, 1.0, num_steps, solver)
    first, second = (np.sqrt(np.mean((energy(end) - energy(start)) ** 2)) for end in ends)
    # Energies are about 100, so this is above their rounding.
    assert second > 1e-11
    assert order - 0.2 < np.log2(first / second) < order + 0.3
