"""Where methods fail on the heat problem, against linear theory, and that a failure is seen."""

import diffrax
import equinox as eqx
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


@pytest.mark.slow
def test_rk4_at_its_limit():
    """Stable to h = 2.785 / 9900 = 2.81e-4. Beyond, the fastest mode grows as R(z) = sum z^k/k!."""
    args = problems.arrays(heat.diffusivity())
    matrix = jax.jacfwd(lambda u: heat.grid_field(0.0, u, args))(jnp.zeros(99))
    rates, modes = np.linalg.eigh(matrix)
    assert rates[0] == pytest.approx(-9900, abs=1e-8)
    limit = 2.785293563405282 / 9900
    u0 = jnp.asarray(heat.to_grid(jnp.asarray(heat.y0())))
    for h, stable in [(0.999 * limit, True), (1.01 * limit, False)]:
        steps = 2000
        found = cfjax.integrate(GRID, CF4, 0.0, h * steps, u0, args, num_steps=steps).ys
        found = np.asarray(found)[-1]
        if stable:
            assert np.abs(found).max() < np.abs(u0).max()
        else:
            z = h * rates[0]
            factor = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
            amplitude = float(modes[:, 0] @ u0) * factor**steps
            assert abs(amplitude) > 1e15
            # 2000 powers of a factor known to 1e-13 (the eigenvalue), and a mode to 1e-12.
            assert float(modes[:, 0] @ found) == pytest.approx(amplitude, rel=1e-6)


# CF4's own limit: the part of the diffusivity that is not in the flow


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF4(), cfjax.LieEuler(), cfjax.CF2(), cfjax.CF3()])
def test_linear_theory_is_a_real_step(solver):
    """The diffusivity is constant, `ratio * mu_c`, where every mode has `w = (ratio - 1) z`."""
    n, constant, y0 = 20, 0.7, jnp.ones(19)
    ratios, h = np.meshgrid([0.0, 0.5, 1.0, 1.5, 2.0, 2.5], [1e-3, 0.1, 10.0])

    @jax.jit
    @jax.vmap
    def step(ratio, h):
        args = heat.Diffusivity(jnp.full(n, ratio * constant), jnp.asarray(constant))
        return problems.first_step(solver, COEFFICIENTS, jnp.zeros(()), h, y0, args)[0]

    found = step(*problems.arrays((ratios.ravel(), h.ravel())))
    args = heat.Diffusivity(jnp.full(n, constant), jnp.asarray(constant))
    spectrum = np.asarray(heat.field(0.0, y0, args).spectrum)
    for ratio, length, end in zip(ratios.ravel(), h.ravel(), found, strict=True):
        z = length * spectrum
        wanted = growth(solver.tableau, z, (ratio - 1) * z)
        # The frozen part rounds in grid values, which mixes the modes: relative to the largest,
        # after stages whose intermediate values may be larger than the end.
        assert np.abs(end - wanted).max() < 1e-12 * max(1, np.abs(wanted).max()) * 10


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


@pytest.mark.slow
def test_failures_are_results():
    u0, args = heat.to_grid(jnp.asarray(heat.y0())), problems.arrays(heat.diffusivity())
    # The factor of the fastest mode is 2e5 a step.
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        diffrax.diffeqsolve(GRID, CF4, 0.0, 0.5, 5e-3, u0, args)
    # On translations CF4 is the classical Runge-Kutta method, which needs 1800 steps.
    solution = diffrax.diffeqsolve(
        GRID,
        cfjax.Richardson(CF4),
        0.0,
        0.5,
        5e-3,
        u0,
        args,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-3),
        max_steps=100,
        throw=False,
    )
    assert solution.result == diffrax.RESULTS.max_steps_reached
