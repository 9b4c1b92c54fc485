"""Where methods fail on the heat problem, against linear theory, and that a failure is seen."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax
from cfjax.scenes import heat

COEFFICIENTS = cfjax.LieTerm(heat.field)
GRID = cfjax.LieTerm(heat.grid_field)
CF4 = cfjax.CF4()


def growth(tableau, z, w):
    """The factor of one step for `u' = (z + w) u` with z in the flow and w in the frozen part.

    From the tableau: a row of weights a over stages b_k = w Y_k is the flow of z with weight
    sum(a) and of the constant sum(a_k b_k).
    """

    def flow(row, point):
        weights = [float(a) for a in row]
        total = sum(weights) * z
        safe = np.where(total == 0, 1, total)
        phi = np.where(total == 0, 1, np.expm1(safe) / safe)
        b = sum(a * f for a, f in zip(weights, stages, strict=False))
        return np.exp(total) * point + phi * b

    stages: list = []
    point = np.ones_like(z)
    for rows in (*tableau.alpha, tableau.beta):
        point = np.ones_like(z)
        for row in rows:
            point = flow(row, point)
        stages.append(w * point)
    return point


# RK4


# CF4's own limit: the part of the diffusivity that is not in the flow


def limit_of(tableau):
    """The largest ratio mu / mu_c for which no z <= 0 grows."""
    z = -np.geomspace(1e-3, 1e8, 400)
    # Coarsely at first, and close to where it fails.
    ratios = np.concatenate([np.arange(1.0, 2.0, 0.1), np.arange(2.0, 2.3, 1e-3)])
    stable = [np.abs(growth(tableau, z, (r - 1) * z)).max() <= 1 + 1e-12 for r in ratios]
    assert stable[0]
    return ratios[np.argmin(stable)] - 1e-3


def test_the_limit_of_cf4():
    """CF4 is stable without bound on h for 0 <= mu <= 2.099 mu_c.

    As z goes to minus infinity the factor is r/6 - r^2/6 - r^3/3 + r^4, with r = mu / mu_c - 1:
    one at r = 1.0995 and at r = -1.
    """
    real = np.roots([1, -1 / 3, -1 / 6, 1 / 6, -1])
    (root,) = real[(abs(real.imag) < 1e-12) & (real.real > 0)].real
    assert limit_of(CF4.tableau) == pytest.approx(1 + root, abs=2e-3)
    z = -np.geomspace(1e-3, 1e8, 400)
    for ratio in np.linspace(0, 1, 21):
        assert np.abs(growth(CF4.tableau, z, (ratio - 1) * z)).max() <= 1 + 1e-12


@jax.jit
def step_matrix(args, h):
    def step(y):
        return problems.first_step(CF4, COEFFICIENTS, jnp.zeros(()), h, y, args)[0]

    return jax.vmap(step)(jnp.eye(len(args.mu) - 1))


def variable(power, fraction):
    """`mu = (1 - x^2)^power` at N = 100, and `fraction` of its mean for the flow."""
    mu = np.asarray(heat.diffusivity(100).mu) ** power
    return mu.max() / (fraction * mu.mean()), problems.arrays(
        heat.Diffusivity(mu, np.asarray(fraction * mu.mean()))
    )


def test_variable_diffusivity_fails_where_linear_theory_says():
    """The bound holds for the largest value of mu: fast modes sit where it is."""
    for power, fraction in [(1, 1), (1, 0.72), (2, 1), (1, 0.68), (1, 0.5), (3, 1), (8, 1)]:
        ratio, args = variable(power, fraction)
        r = ratio - 1
        limit = abs(r / 6 - r**2 / 6 - r**3 / 3 + r**4)
        for h in (1e-2, 0.1, 1.0):
            radius = np.abs(np.linalg.eigvals(np.asarray(step_matrix(args, jnp.asarray(h))))).max()
            if ratio < 2.099:
                # Slow modes decay as they should; rounding of a matrix of norm one.
                assert radius < 1 + 1e-10
            else:
                # The fastest mode is not quite at the maximum of mu.
                assert limit * 0.98 < radius < limit * (1 + 1e-9)
                assert radius > 1


# Failure is visible
