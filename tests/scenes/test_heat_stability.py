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


@pytest.mark.representatives(6)
@pytest.mark.parametrize("ratio", [0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("solver", [cfjax.LieEuler(), cfjax.CF2(), cfjax.CF3(), cfjax.CF4()])
def test_linear_theory_is_a_real_step(solver, ratio):
    """The diffusivity is constant, `ratio * mu_c`, where every mode has `w = (ratio - 1) z`."""
    n, constant = 20, 0.7
    args = heat.Diffusivity(jnp.full(n, ratio * constant), jnp.asarray(constant))
    y0 = jnp.ones(n - 1)
    for h in (1e-3, 0.1, 10.0):
        found = problems.first_step(solver, COEFFICIENTS, 0.0, h, y0, args)[0]
        z = h * np.asarray(heat.field(0.0, y0, args).spectrum)
        wanted = growth(solver.tableau, z, (ratio - 1) * z)
        # The frozen part rounds in grid values, which mixes the modes: relative to the largest,
        # after stages whose intermediate values may be larger than the end.
        assert np.abs(found - wanted).max() < 1e-12 * max(1, np.abs(wanted).max()) * 10


def limit_of(tableau):
    """The largest ratio mu / mu_c for which no z <= 0 grows."""
    z = -np.geomspace(1e-3, 1e8, 2000)
    ratios = np.arange(1.0, 4.0, 1e-3)
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
    z = -np.geomspace(1e-3, 1e8, 2000)
    for ratio in np.linspace(0, 1, 21):
        assert np.abs(growth(CF4.tableau, z, (ratio - 1) * z)).max() <= 1 + 1e-12


def spectral_radius(args, h):
    eye = jnp.eye(len(args.mu) - 1)
    step = jax.vmap(lambda y: problems.first_step(CF4, COEFFICIENTS, 0.0, h, y, args)[0])
    return np.abs(np.linalg.eigvals(np.asarray(jax.jit(step)(eye)))).max()


def variable(power, fraction):
    """`mu = (1 - x^2)^power` at N = 100, and `fraction` of its mean for the flow."""
    mu = np.asarray(heat.diffusivity(100).mu) ** power
    return mu.max() / (fraction * mu.mean()), problems.arrays(
        heat.Diffusivity(mu, np.asarray(fraction * mu.mean()))
    )


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    "power, fraction", [(1, 1.0), (1, 0.72), (2, 1.0), (1, 0.68), (1, 0.5), (3, 1.0), (8, 1.0)]
)
def test_variable_diffusivity_fails_where_linear_theory_says(power, fraction):
    """The bound holds for the largest value of mu: fast modes sit where it is."""
    ratio, args = variable(power, fraction)
    r = ratio - 1
    limit = abs(r / 6 - r**2 / 6 - r**3 / 3 + r**4)
    for h in (1e-2, 0.1, 1.0):
        radius = spectral_radius(args, h)
        if ratio < 2.099:
            # Slow modes decay as they should; rounding of a matrix of norm one.
            assert radius < 1 + 1e-10
        else:
            # The fastest mode is not quite at the maximum of mu.
            assert limit * 0.98 < radius < limit * (1 + 1e-9)
            assert radius > 1


# Failure is visible


def test_blow_up_with_fixed_steps_is_a_result():
    u0, args = heat.to_grid(jnp.asarray(heat.y0())), problems.arrays(heat.diffusivity())
    # The factor of the fastest mode is 2e5 a step.
    solution = diffrax.diffeqsolve(GRID, CF4, 0.0, 0.5, 5e-3, u0, args, throw=False)
    assert solution.result == diffrax.RESULTS.nonfinite
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        diffrax.diffeqsolve(GRID, CF4, 0.0, 0.5, 5e-3, u0, args)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    # On translations CF4 is the classical Runge-Kutta method.
    "term, solver",
    [(GRID, CF4), (COEFFICIENTS, cfjax.RKMK4())],
    ids=["RK4", "RKMK4"],
)
def test_too_few_adaptive_steps_are_a_result(term, solver):
    u0, args = jnp.asarray(heat.y0()), problems.arrays(heat.diffusivity())
    solution = diffrax.diffeqsolve(
        term,
        cfjax.Richardson(solver),
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


@pytest.mark.slow
def test_adaptive_steps_see_what_fixed_ones_do_not():
    """With half of mu_c the steps of CF4 grow 13 times each, unless they are small."""
    _, args = variable(1, 0.5)
    y0 = jnp.asarray(heat.y0())
    exact = heat.reference(0.5, np.asarray(args.mu))
    fixed = cfjax.integrate(COEFFICIENTS, CF4, 0.0, 0.5, y0, args, num_steps=50).ys
    assert np.linalg.norm(np.asarray(fixed)[-1]) > 1e40
    solution = diffrax.diffeqsolve(
        COEFFICIENTS,
        cfjax.Richardson(CF4),
        0.0,
        0.5,
        5e-3,
        y0,
        args,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-5),
    )
    assert solution.ys is not None
    error = np.linalg.norm(heat.to_grid(solution.ys[-1]) - exact)
    # A root mean square over 99 entries of at most 1e-5 in the solution's unit of time; what is old
    # decays at a rate of 2 and more.
    assert error < np.sqrt(99) * 1e-5, error
