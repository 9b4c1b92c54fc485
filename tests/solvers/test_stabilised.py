"""Stabilised methods: their polynomials, orders, stages, control and exact answers."""

import functools
import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems
import pytest
import scipy.integrate
from solver_table import solvers

import cfjax

SOLVERS = {name: getattr(cfjax, name) for name in solvers("stabilised")}
names = pytest.mark.parametrize("name", SOLVERS)
# RKG2 is RKL2 with other polynomials, so it has tests of those and of its order.
both = pytest.mark.parametrize("name", ["RKL2", "RKL3"])
slow = pytest.mark.slow
either = pytest.mark.parametrize("name", ["RKL3", pytest.param("RKL2", marks=slow)])
# Twice the index of the Gegenbauer polynomials.
INDEX = {"RKL2": 1, "RKG2": 3, "RKL3": 1}


def reach(s, l):  # noqa: E741
    """The range of s stages on the negative axis."""
    return 2 * (s - 1) * (s + l + 1) / (l + 3)


def stages_for(z, l):  # noqa: E741
    """The least odd number whose range has z in it."""
    return next(s for s in range(3, 1000, 2) if reach(s, l) >= z)


# Stability polynomials


@functools.cache
def gegenbauer(n, a):
    """By its finite sum, so from another formula than the recursion of the methods."""
    coefficients = [mpmath.mpf(0)] * (n + 1)
    for k in range(n // 2 + 1):
        factorials = mpmath.factorial(k) * mpmath.factorial(n - 2 * k)
        coefficients[2 * k] = (-1) ** k * mpmath.rf(a, n - k) * 2 ** (n - 2 * k) / factorials
    return coefficients


def at(coefficients, x):
    return functools.reduce(lambda value, c: value * x + c, coefficients)


def polynomial(s, l, z):  # noqa: E741
    b = mpmath.mpf((l + 1) * (s - 1) * (s + l + 1)) / ((l + 3) * s * (s + l))
    w = mpmath.mpf(l + 3) / ((s - 1) * (s + l + 1))
    coefficients = gegenbauer(s, mpmath.mpf(l) / 2)
    return 1 - b + b * at(coefficients, 1 + w * z) / mpmath.fsum(coefficients)


@functools.cache
def third_derivative(s):
    return mpmath.diff(lambda z: polynomial(s, 1, z), 0, 3) - 1


def exact_growth(name, s, z, m=None):
    """What a step with s stages multiplies the state by, where `h lambda` is z. RKL3 has m in its
    halves: as many as reach half as far.
    """
    l = INDEX[name]  # noqa: E741
    with mpmath.workdps(50):
        z = mpmath.mpmathify(z)
        value = polynomial(s, l, z)
        if name == "RKL3":
            m = m or stages_for(reach(s, l) / 2, l)
            # Of the constants of the error: the third derivatives of the polynomials at 0, less 1.
            r = third_derivative(m) / third_derivative(s)
            value = (4 * polynomial(m, l, z / 2) ** 2 - r * value) / (4 - r)
        return complex(value)


def points_of_stability(s, l):  # noqa: E741
    """Along the negative axis to the end of the range, and in a wedge about it."""
    axis = -reach(s, l) * np.array([1e-3, 0.03, 0.2, 0.5, 0.8, 0.97])
    wedge = -(reach(s, l) ** 0.5) * np.exp(1j * np.array([0.1, 0.5, -1.0]))
    return np.concatenate([axis, wedge])


def growth(solver, z, radius=None, dtype=complex):
    """Of one step, for numbers z, all in one program."""

    def step(z, radius):
        term = cfjax.LieTerm(lambda t, y, args: args[0] * y)
        t = jnp.zeros((), jnp.finfo(dtype).dtype)
        return problems.first_step(solver, term, t, t + 1, jnp.ones((), dtype), (z, radius))[0]

    # Within the range in the rounding of float32 too.
    z, radius = jnp.asarray(z, dtype), jnp.asarray(radius, jnp.finfo(dtype).dtype)
    return np.asarray(jax.jit(jax.vmap(step))(z, radius))


def radius_of_args(t, y, args):
    return args[1]


@functools.cache
def points_of_chosen_stages(name):
    """Points for 3 to 31 stages, each with a radius for which so many are chosen."""
    cases = [(s, z) for s in range(3, 32, 2) for z in points_of_stability(s, INDEX[name])]
    # Between the range of two stages fewer and that of s.
    radius = [reach(s, INDEX[name]) * (1 - 1e-3) for s, _ in cases]
    return [z for _, z in cases], radius, [exact_growth(name, s, z) for s, z in cases]


@names
def test_stability_on_the_whole_range_and_damping_at_its_end(name):
    """Odd stages damp what is stiffest to a third or less; even ones would leave it as it is."""
    l = INDEX[name]  # noqa: E741
    points, radius_of_points, polynomials = points_of_chosen_stages(name)
    size = np.geomspace(0.1, 1000, 200)
    ends = np.array([reach(s, l) for s in range(3, 32, 2)])
    # All in one program, at last from just beyond the range for the radius.
    parts = [(points, radius_of_points), (-size, size), (-ends, ends), (-1.1 * ends, ends)]
    z, radius = map(np.concatenate, zip(*parts, strict=True))
    found = growth(SOLVERS[name](spectral_radius=radius_of_args), z, radius * (1 - 1e-9))
    bounds = np.cumsum([len(part) for part, _ in parts])[:-1]
    at_points, on_range, at_ends, beyond = np.split(found, bounds)
    # Internal errors grow like the square of the stages, up to 31.
    np.testing.assert_allclose(at_points, polynomials, rtol=2e-13, atol=2e-13)
    stages = [(stages_for(z, l), stages_for(z / 2, l)) for z in size]
    expected = [exact_growth(name, s, -z, m).real for z, (s, m) in zip(size, stages, strict=True)]
    expected = np.array(expected)
    # As above, up to 45 stages.
    np.testing.assert_allclose(on_range, expected, rtol=0, atol=5e-13)
    assert (np.abs(expected) < 1).all()
    # Below one also away from the origin: what a step leaves of stiff parts. The largest values of
    # the polynomials beyond z = -4 are 11/15, of RKL2 with 3 stages, at its end; 0.49338, of RKG2
    # with 5; and 0.64769, of RKL3 with 5 stages and 3.
    largest = {"RKL2": 11 / 15, "RKG2": 0.4934, "RKL3": 0.6477}[name]
    assert 0.98 * largest < np.abs(expected[size > 4]).max() <= largest
    if name != "RKL3":
        # There the polynomial is 1 - 2 b.
        expected = [float(exact_growth(name, s, -reach(s, l)).real) for s in range(3, 32, 2)]
        np.testing.assert_allclose(at_ends, expected, rtol=0, atol=2e-13)
        assert np.abs(at_ends).max() < 0.34
        even = [abs(exact_growth(name, s, -reach(s, l)) - 1) for s in (4, 10, 30)]
        assert max(even) < 1e-12
        # Beyond it grows at once.
        assert (np.abs(beyond[5:]) > 10).all()


def test_stability_polynomials_in_single_precision():
    points, radius, expected = points_of_chosen_stages("RKL3")
    solver = cfjax.RKL3(spectral_radius=radius_of_args)
    found = growth(solver, points, radius, np.complex64)
    assert found.dtype == np.complex64
    # As above.
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(
    "name, stages",
    [
        ("RKL2", 4),
        ("RKL3", 9),
        *(pytest.param(*case, marks=slow) for case in [("RKG2", 3), ("RKL2", 31), ("RKL3", 16)]),
    ],
)
def test_stability_polynomials_of_given_stages(name, stages):
    z = points_of_stability(stages, INDEX[name])
    found = growth(SOLVERS[name](stages), z, np.zeros(len(z)))
    expected = [exact_growth(name, stages, x) for x in z]
    # As above.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-13)


# Times of stages


def clocked(t, y):
    """Depends on time, and on a state that is the time."""
    return jnp.stack([jnp.sin(7 * t) - 3 * y[0] * jnp.cos(2 * t), 1 + 0 * t])


@pytest.mark.parametrize("stages", [5, None])
def test_the_times_of_stages(stages):
    """To rounding those of the autonomous equation, whose state has the time. By time alone
    u' = 3 t^2 is exact. A step of `RKL3` has one of `RKL2` as a part.
    """

    def field(t, y, args):
        by_state = clocked(y["by state"][1], y["by state"])
        return {"by time": clocked(t, y["by time"]), "by state": by_state, "power": 3 * t**2}

    solver = cfjax.RKL3(stages, spectral_radius=None if stages else lambda t, y, args: args)
    t0, y0 = jnp.asarray(0.3), jnp.array([0.7, 0.3])

    @jax.jit
    def step(radius):
        start = {"by time": y0, "by state": y0, "power": jnp.zeros(())}
        return problems.first_step(solver, cfjax.LieTerm(field), t0, t0 + 1, start, radius)[0]

    for number in (stages,) if stages else (3, 9, 31):
        found = step(jnp.asarray(reach(number, 1) * 0.999))
        np.testing.assert_allclose(found["by time"], found["by state"], rtol=0, atol=1e-13)
        assert found["by time"][1] == pytest.approx(1.3, abs=1e-13)
        np.testing.assert_allclose(found["power"], 1.3**3 - 0.3**3, rtol=0, atol=1e-13)


# Orders

SLOPES = {"RKL2": (1.85, 2.2), "RKG2": (1.85, 2.2), "RKL3": (2.8, 3.15)}
STEPS = (16, 24, 32, 48, 64)


def spin(xp, t, y):
    """An angular velocity that depends on time and attitude, and commutes at no two times."""
    return xp.stack([xp.sin(2 * t) + y[0, 1], xp.cos(t) - y[1, 2] + y[2, 0], t + y[2, 2]])


def attitude(t, y, args):
    return cfjax.Rotation(spin(jnp, t, y))


def attitude_ode(t, y):
    y = y.reshape(3, 3)
    return np.cross(spin(np, t, y), y.T).T.ravel()


@pytest.fixture(scope="module")
def attitude_answer():
    return problems.reference(attitude_ode, 0.0, 1.0, np.eye(3).ravel())


def assert_order(name, solver, field, y0, args, answer):
    found = problems.errors(field, solver, 1.0, y0, args, answer, STEPS)
    low, high = SLOPES[name]
    assert found.max() < 0.1
    assert found.min() > 100 * problems.REFERENCE_ERROR
    assert low < problems.slope(STEPS, found) < high


# From 31 stages to 15 as steps become shorter: the error has no other order for that.
CHANGING = dict(spectral_radius=5000.0)


@pytest.mark.parametrize(
    "name, options",
    [
        *[("RKL2", dict(stages=9)), ("RKG2", CHANGING), ("RKL3", CHANGING)],
        *(
            pytest.param(name, options, marks=slow)
            for name, options in [
                *[("RKL2", CHANGING), ("RKL2", dict(stages=30)), ("RKG2", {})],
                *[("RKL3", dict(stages=9)), ("RKL3", dict(stages=3))],
            ]
        ),
    ],
)
def test_order_on_an_attitude(attitude_answer, name, options):
    """Where the commutators count, which commuting problems hide."""
    solver = SOLVERS[name](**options)
    assert_order(name, solver, attitude, np.eye(3), None, attitude_answer)


@either
def test_order_on_a_dictionary_of_rotations_and_an_array(flight_problem, name):
    """With an estimated radius."""
    assert_order(name, SOLVERS[name](), *flight_problem)


# Exact answers, with control of the error


def link(t, y, args):
    """A link that moves to the unit: minus the traceless skew part."""
    skew = (jnp.conj(y.T) - y) / 2
    trace = jnp.trace(skew) / len(y)
    return cfjax.LeftMatrix(skew - trace * jnp.eye(len(y), dtype=y.dtype))


def su3_problem(t=1.5):
    start, rng = np.array([2.0, -0.5, -1.5]), np.random.default_rng(3)
    end = problems.reference(lambda t, p: np.mean(np.sin(p)) - np.sin(p), 0.0, t, start)
    v = np.linalg.qr(rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3)))[0]
    y0, y1 = (v @ np.diag(np.exp(1j * p)) @ v.conj().T for p in (start, end))
    return link, y0, None, t, y1


def oscillation_problem():
    def field(t, y, args):
        return jnp.stack([-3 * y[0] - 40 * y[1], 40 * y[0] - 3 * y[1]])

    y = np.exp(-3 + 40j)
    return field, np.array([1.0, 0.0]), None, 1.0, np.array([y.real, y.imag])


PROBLEMS = {
    "SU(3) link": su3_problem,
    "oscillation": oscillation_problem,
}
# One for each method; the others are slow.
QUICK = [("oscillation", "RKL3")]


# Of the error at the end over the tolerance of a step. The errors of all steps add up, and stiff
# parts are damped.
RATIOS = {"RKL2": (1e-3, 100), "RKG2": (1e-3, 100), "RKL3": (0.01, 20)}


def solve(field, solver, t1, y0, args=None, tolerance=1e-5, **options):
    # diffrax's control of complex states asks for it.
    with jax.numpy_dtype_promotion("standard"):
        return diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            solver,
            *(0.0, t1, t1 / 1000, y0, args),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
            adjoint=diffrax.ForwardMode(),
            **{"max_steps": 10_000, **options},
        )


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize(
    "problem, name",
    [
        pytest.param(*case, marks=() if case in QUICK else slow)
        for case in itertools.product(PROBLEMS, SOLVERS)
    ],
)
def test_error_over_tolerance_by_exact_answers(problem, name):
    field, y0, args, t1, answer = PROBLEMS[problem]()
    low, high = RATIOS[name]

    @jax.jit
    def run(tolerance):
        sol = solve(field, SOLVERS[name](), t1, jnp.asarray(y0), args, tolerance)
        return sol.ys[-1], sol.stats["num_steps"]

    errors = []
    for tolerance in (1e-3, 1e-4, 1e-5):
        y, steps = run(jnp.asarray(tolerance))
        errors.append(np.abs(np.asarray(y) - answer).max())
        assert low < errors[-1] / tolerance < high
        if "link" in problem:
            # As rounding adds up over the steps.
            defect = np.abs(np.asarray(y).conj().T @ np.asarray(y) - np.eye(3)).max()
            assert defect < 1e-14 * (10 + steps)
    # The parts of an error may cancel at one tolerance.
    assert errors[2] < min(errors[:2])


# Control and the spectral radius


def matrix_of_diffusion(n):
    """Between cells with conductivity i (n - i): the rates of the modes are k (k + 1)."""
    k = np.arange(1, n) * (n - np.arange(1, n))
    gradient = np.diff(np.eye(n), axis=0)
    return -gradient.T @ np.diag(k) @ gradient


def rough_heat(amplitude):
    """In 30 cells: a smooth mode, and the stiffest one with an amplitude; its radius."""
    matrix = matrix_of_diffusion(30)
    modes = np.linalg.eigh(matrix)[1]
    smooth, stiffest = (modes[:, k] / np.abs(modes[:, k]).max() for k in (-2, 0))
    field = lambda t, y, args: matrix @ y  # noqa: E731
    return field, jnp.asarray(smooth + amplitude * stiffest), 30 * 29


# How much larger than its estimate an unstable part may be at the end of a step. Odd numbers of
# stages make P_s negative beyond their range. The estimate of RKL3 is (a - 1)(P_m^2 - P_s) times
# the part before, so larger than either share of the growth a P_m^2 - (a - 1) P_s but for a factor
# of a / (a - 1) = 4 / r, at most 4. That of RKL2 is z times as large as the part.
UNSEEN = {"RKL2": 0.1, "RKL3": 4.0}


@both
def test_the_estimate_sees_all_that_a_radius_that_is_too_small_makes(name):
    """0.9 of the radius, and steps at the end of the range for that."""
    amplitude = 1e-6
    field, y0, radius = rough_heat(amplitude)
    smooth = rough_heat(0.0)[1]

    @jax.jit
    def step(y0, h):
        solver = SOLVERS[name](spectral_radius=0.9 * radius)
        term, t = cfjax.LieTerm(field), jnp.zeros(())
        return problems.first_step(solver, term, t, t + h, y0, None)[:2]

    for stages in (11, 13, 21, 41):
        h = reach(stages, 1) / (0.9 * radius) * (1 - 1e-6)
        # A linear problem: the rest of the step and of its estimate is that of a smooth start.
        pairs = zip(step(y0, h), step(smooth, h), strict=True)
        end, error = (np.abs(a - b).max() for a, b in pairs)
        growth = abs(exact_growth(name, stages, -h * radius))
        assert growth > 10
        # Rounding of the smooth part is of the stiffest mode too.
        assert end == pytest.approx(growth * amplitude, rel=1e-6)
        assert end < UNSEEN[name] * error


@either
def test_a_radius_that_is_too_small_costs_steps_and_not_accuracy(name):
    """For any amplitude of the stiffest mode, at any tolerance, over many steps."""
    solver, t1 = SOLVERS[name](spectral_radius=lambda t, y, args: args), 5.0
    field, smooth, radius = rough_heat(0.0)
    exact = smooth * np.exp(-2 * t1)
    run = jax.jit(lambda y0, r, tolerance: solve(field, solver, t1, y0, r, tolerance))
    rejected = {1.0: 0, 0.9: 0}
    for amplitude, tolerance in itertools.product((1e-8, 1e-5, 1e-2), (1e-2, 1e-4, 1e-6)):
        y0, errors = rough_heat(amplitude)[1], {}
        for factor in rejected:
            sol = run(y0, jnp.asarray(factor * radius), jnp.asarray(tolerance))
            # In the norm of the controller.
            errors[factor] = np.sqrt(np.mean((sol.ys[-1] - exact) ** 2))
            rejected[factor] += int(sol.stats["num_rejected_steps"])
        # As much as an accepted step leaves of the stiffest mode, beside the error of the others.
        assert errors[0.9] < 2 * errors[1.0] + UNSEEN[name] * tolerance
    # An unstable mode grows in smooth solutions too, from rounding.
    assert rejected[0.9] > 2 * rejected[1.0]


@pytest.mark.parametrize("name", ["RKL2", pytest.param("RKL3", marks=slow)])
def test_a_step_with_an_estimated_radius_is_stable(name):
    """Beyond the range of 21 stages, where too small an estimate would leave it at 21. The power
    iteration is short of the radius, as the spectrum is dense at its end.
    """
    term = cfjax.LieTerm(lambda t, y, args: jnp.roll(y, 1) - 2 * y + jnp.roll(y, -1))
    # The stiffest mode, with the rate 4.
    y0, t = jnp.asarray(1.0 - 2 * (np.arange(32) % 2)), jnp.zeros(())

    @jax.jit
    def run(h):
        end = problems.first_step(SOLVERS[name](), term, t, t + h, y0, None)[0]
        return end, cfjax.spectral_radius(term, t, y0)

    for beyond in (1.01, 1.02, 1.05, 1.1):
        z = beyond * reach(21, 1)
        assert abs(exact_growth(name, 21, -z)) > 2
        end, radius = run(jnp.asarray(z / 4))
        assert np.abs(end).max() < 1
        assert radius < 0.98 * 4


# A spectral radius that grows

N_CELLS = 64


def pulse(t):
    """On for a fifth of the time at both ends."""
    is_on = (t < 0.2) | (t > 0.8)
    return jnp.where(is_on, jnp.sin(np.pi * t / 0.2) ** 2, 0.0)


def switched(t, y, p):
    """Diffusion that is switched on, in three ways, and nonlinear diffusion with a source."""
    kappa = p[0] * jnp.sin(10 * t) ** 2 + p[1] * t + p[2] * pulse(t)
    matrix = jnp.asarray(matrix_of_diffusion(N_CELLS), y.dtype)
    w = jnp.pad(y**2, 1)
    wave = np.sin(np.pi * np.arange(1, N_CELLS + 1) / (N_CELLS + 1))
    nonlinear = (N_CELLS + 1) ** 2 * (w[2:] - 2 * w[1:-1] + w[:-2])
    return kappa * (matrix @ y) + p[3] * (nonlinear + jnp.asarray(10 * wave, y.dtype))


def exact_radius(t, y, p):
    """Or a bound, for the nonlinear one."""
    kappa = p[0] * jnp.sin(10 * t) ** 2 + p[1] * t + p[2] * pulse(t)
    of_square = 8 * (N_CELLS + 1) ** 2 * p[3] * jnp.max(jnp.abs(y))
    return N_CELLS * (N_CELLS - 1) * kappa + of_square


def diffused(n, y0, integral):
    """By the modes, from the integral of the diffusivity."""
    rates, modes = np.linalg.eigh(matrix_of_diffusion(n))
    return modes @ (np.exp(rates * integral) * (modes.T @ y0))


@functools.lru_cache
def switched_problems():
    """The weights, the start and the exact end at t = 1, of each."""
    rough = np.random.default_rng(0).normal(size=N_CELLS)

    def nonlinear(t, y):
        w = np.pad(y**2, 1)
        source = 10 * np.sin(np.pi * np.arange(1, N_CELLS + 1) / (N_CELLS + 1))
        return (N_CELLS + 1) ** 2 * (w[2:] - 2 * w[1:-1] + w[:-2]) + source

    zero = np.zeros(N_CELLS)
    steady = scipy.integrate.solve_ivp(
        nonlinear, (0, 1), zero, method="LSODA", rtol=1e-9, atol=1e-10
    ).y[:, -1]
    return {
        "sine": ([1.0, 0, 0, 0], rough, diffused(N_CELLS, rough, 0.5 - np.sin(20) / 40)),
        "ramp": ([0, 1.0, 0, 0], rough, diffused(N_CELLS, rough, 0.5)),
        "pulses": ([0, 0, 1.0, 0], rough, diffused(N_CELLS, rough, 0.2)),
        "from zero": ([0, 0, 0, 1.0], zero, steady),
    }


@pytest.mark.parametrize(
    "name, dtype",
    [
        ("RKL2", np.float32),
        *(pytest.param(name, float, marks=slow) for name in ("RKL3", "RKL2", "RKG2")),
    ],
)
def test_equal_steps_of_a_diffusion_that_is_switched_on(name, dtype):
    """The radius is zero at the start: of a state at zero, or of a diffusivity that is."""

    @jax.jit
    def end(y0, p):
        term = cfjax.LieTerm(switched)
        return cfjax.integrate(term, SOLVERS[name](), 0.0, 1.0, y0, p, num_steps=80).ys[-1]

    for p, y0, exact in switched_problems().values():
        found = end(jnp.asarray(y0, dtype), jnp.asarray(p, dtype))
        assert found.dtype == dtype
        # The error of the methods, of second order: some (1/80)^2 times 2. An unstable step leaves
        # 1e20.
        np.testing.assert_allclose(found, exact, rtol=0, atol=3e-4)


def test_a_radius_of_a_function_is_that_of_both_ends_of_a_step():
    """At t = 0 it is zero, and 20 steps of a sine with a period of 0.3 are few."""
    p, y0, exact = switched_problems()["sine"]
    solver = cfjax.RKL2(spectral_radius=exact_radius)
    found = cfjax.integrate(
        cfjax.LieTerm(switched), solver, 0.0, 1.0, jnp.asarray(y0), jnp.asarray(p), num_steps=20
    ).ys[-1]
    # Of second order: some 16 times that of 80 steps.
    np.testing.assert_allclose(found, exact, rtol=0, atol=5e-3)


def beside(t, y, p):
    """A diffusion, and one beside it that is switched on at a time."""
    slow, fast, start = p
    matrix, is_on = matrix_of_diffusion(N_CELLS), jnp.where(t >= start, 1.0, 0.0)
    return {"a": slow * (matrix @ y["a"]), "b": fast * is_on * (matrix @ y["b"])}


def test_a_batch_in_which_parts_are_switched_on_later():
    """3 and 10 times as stiff as what is on from the start, at the end of a step and within one."""
    rough = np.random.default_rng(1).normal(size=(2, N_CELLS))
    y0 = {"a": jnp.asarray(rough[0]), "b": jnp.asarray(rough[1])}
    # Slow, fast, start.
    members = jnp.array([[0.33, 1.0, 0.5], [0.1, 1.0, 0.613], [0.1, 1.0, 2.0], [0.1, 0.0, 0.0]])

    @jax.jit
    @jax.vmap
    def end(p):
        sol = cfjax.integrate(cfjax.LieTerm(beside), cfjax.RKL2(), 0.0, 1.0, y0, p, num_steps=100)
        return sol.ys["a"][-1], sol.ys["b"][-1]

    found = end(members)
    for k, (slow, fast, start) in enumerate(np.asarray(members)):
        a, b = (leaf[k] for leaf in found)
        np.testing.assert_allclose(a, diffused(N_CELLS, rough[0], slow), rtol=0, atol=1e-3)
        exact = diffused(N_CELLS, rough[1], fast * max(1 - start, 0))
        # A start within a step is off by part of a step, with rates of 2 of what is left.
        np.testing.assert_allclose(b, exact, rtol=0, atol=1e-3 if start != 0.613 else 2e-2)


def with_rate(t, y, args):
    """The diffusivity is part of the state, and grows from zero: a step does not foresee it."""
    return {"rate": args + 0 * y["rate"], "y": y["rate"] * (matrix_of_diffusion(N_CELLS) @ y["y"])}


@pytest.mark.parametrize("name, throw", [("RKL2", True), ("RKL3", False)])
def test_a_step_that_is_unstable_as_the_radius_grew_is_an_error(name, throw):
    rough = np.random.default_rng(3).normal(size=N_CELLS)
    start = {"rate": jnp.zeros(()), "y": jnp.asarray(rough)}

    @eqx.filter_jit
    def run(rate):
        term, solver = cfjax.LieTerm(with_rate), SOLVERS[name]()
        return cfjax.integrate(term, solver, 0.0, 1.0, start, rate, num_steps=20, throw=throw)

    if throw:
        with pytest.raises(RuntimeError, match=r"unstable.*more steps.*spectral_radius.*stages"):
            run(jnp.asarray(20.0))
    else:
        sol = run(jnp.asarray(20.0))
        assert sol.result != diffrax.RESULTS.successful
        assert np.isnan(sol.ys["y"]).all()
    # What so many steps do resolve.
    y = run(jnp.asarray(0.5)).ys["y"][-1]
    np.testing.assert_allclose(y, diffused(N_CELLS, rough, 0.25), rtol=0, atol=1e-2)


def test_a_step_that_is_unstable_as_the_radius_grew_is_taken_again():
    """Whatever the tolerance: any error is below this one."""
    rough = np.random.default_rng(3).normal(size=N_CELLS)
    start = {"rate": jnp.zeros(()), "y": jnp.asarray(rough)}
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(with_rate), cfjax.RKL2(), 0.0, 1.0, 0.25, start, jnp.asarray(5.0),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e30),
        adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    assert sol.stats["num_rejected_steps"] > 0
    # Nothing grows in a stable step.
    assert np.abs(sol.ys["y"]).max() < np.abs(rough).max()


# More stages than there may be


def stiff(t, y, args):
    return -args * (y - jnp.cos(t))


def test_max_stages_too_small_is_an_error_that_says_how_many():
    """Only later steps take as many."""

    @eqx.filter_jit
    def end(rate):
        grow = cfjax.LieTerm(lambda t, y, args: -args * jnp.exp(5 * t) * y)
        solver = cfjax.RKL2(spectral_radius=lambda t, y, args: args * jnp.exp(5 * t), max_stages=15)
        return cfjax.integrate(grow, solver, 0.0, 1.0, jnp.ones(2), rate, num_steps=4).ys

    # At the end of the last step exp(5) / 4 = 37 times the rate: 111, of 119 that 15 stages have;
    # 186; and 1850, for 61 stages.
    assert np.isfinite(end(jnp.asarray(3.0))).all()
    for rate, number in ((5.0, 15), (50.0, 30)):
        with pytest.raises(RuntimeError, match=rf"max_stages=15 is too small.* {number} stages"):
            end(jnp.asarray(rate))


@slow
@both
def test_max_stages_too_small_shortens_controlled_steps_and_has_a_derivative(name):
    """Rejected steps move nothing and evaluate no stage, so their derivative is finite."""
    solver = SOLVERS[name](spectral_radius=lambda t, y, args: args, max_stages=5)

    def end(rate):
        controller = diffrax.PIDController(rtol=0.0, atol=1e-3)
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(stiff), solver, 0.0, 1.0, 0.5, jnp.zeros(1), rate,
            stepsize_controller=controller, max_steps=200,
        )  # fmt: skip
        return sol.ys[-1, 0], sol.stats

    (y, stats), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(500.0)
    assert stats["num_rejected_steps"] > 0
    # Of the forced solution, up to what decays.
    exact = lambda k: (k**2 * np.cos(1.0) + k * np.sin(1.0)) / (1 + k**2)  # noqa: E731
    assert y == pytest.approx(exact(500.0), abs=1e-3)
    assert np.isfinite(slope)
    assert slope == pytest.approx((exact(501.0) - exact(499.0)) / 2, abs=1e-4)


@either
def test_an_impossible_step_evaluates_no_stage(name):
    calls = []

    def field(t, y, args):
        jax.debug.callback(lambda t: calls.append(float(t)), t)
        return -y

    solver = SOLVERS[name](spectral_radius=lambda t, y, args: args, max_stages=9)
    term, y0, t = cfjax.LieTerm(field), jnp.ones(1), jnp.zeros(())
    start, step = map(
        jax.jit,
        (
            lambda radius: solver.init(term, t, t + 1, y0, radius),
            lambda radius, state: solver.step(term, t, t + 1, y0, radius, state, made_jump=False),
        ),
    )
    for radius, evaluations in ((100.0, "few"), (10.0, "all")):
        state = start(radius)
        jax.effects_barrier()
        calls.clear()
        y, error, _, _, result = step(radius, state)
        jax.effects_barrier()
        assert np.isnan(y).all() == np.isnan(error).all() == (evaluations == "few")
        assert (result == diffrax.RESULTS.nonfinite) == (evaluations == "few")
        # That of the end, and the one in the middle.
        stages = stages_for(10.0, 1)
        expected = (
            {"few": 1, "all": stages}
            if name == "RKL2"
            else {"few": 2, "all": stages + 2 * stages_for(5.0, 1) - 1}
        )
        assert len(calls) == expected[evaluations]


# With diffrax


@both
def test_output_within_a_step_has_order_two_stays_on_the_manifold_and_meets_the_end(name):
    y0, solver = jnp.eye(3), SOLVERS[name](5)

    @jax.jit
    def output(h, theta):
        term, t = cfjax.LieTerm(attitude), jnp.zeros(())
        y1, _, info, _, _ = problems.first_step(solver, term, t, t + h, y0, None)
        interpolation = solver.interpolation_cls(t0=t, t1=t + h, **info)
        return y1, jax.vmap(lambda x: interpolation.evaluate(x * h))(theta)

    theta = jnp.array([0.0, 0.3, 0.7, 1.0])
    errors = []
    for h in (0.2, 0.1, 0.05):
        y1, ys = output(jnp.asarray(h), theta)
        np.testing.assert_allclose(ys[0], y0, rtol=0, atol=1e-15)
        np.testing.assert_allclose(ys[-1], y1, rtol=0, atol=1e-14)
        defect = np.einsum("kji,kjl->kil", ys, ys) - np.eye(3)
        assert np.abs(defect).max() < 1e-14
        fine = [
            problems.reference(attitude_ode, 0.0, float(x) * h, np.eye(3).ravel())
            for x in theta[1:3]
        ]
        errors.append(np.abs(np.reshape(fine, (2, 3, 3)) - ys[1:3]).max())
    for h in (10.0, 1000.0):
        # Flows correct the lengths up to rounding, however long a step is.
        _, ys = output(jnp.asarray(h), theta)
        assert np.abs(np.einsum("kji,kjl->kil", ys, ys) - np.eye(3)).max() < 1e-13
    # Of one step: h^3.
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (slopes > 2.6).all()


def test_sums_are_compensated():
    """Of 1e5 steps in single precision, which would round to a hundred units otherwise."""

    def field(t, y, args):
        return cfjax.Rotation(jnp.array([0.0, 0.0, 1.0], np.float32))

    y0, n = jnp.array([1.0, 0.0, 0.0], np.float32), 100_000
    y = cfjax.integrate(cfjax.LieTerm(field), cfjax.RKL2(3), 0.0, 1.0, y0, num_steps=n).ys[-1]
    np.testing.assert_allclose(y, [np.cos(1), np.sin(1), 0], rtol=0, atol=3e-6)


def test_backwards_in_time_what_decayed_grows():
    @jax.jit
    def run(t0, t1, y0):
        term = cfjax.LieTerm(lambda t, y, args: -3 * y)
        return cfjax.integrate(term, cfjax.RKL2(), t0, t1, y0, num_steps=5000).ys[-1]

    end = run(0.0, 1.0, jnp.ones(2))
    np.testing.assert_allclose(end, np.exp(-3), rtol=1e-6)
    np.testing.assert_allclose(run(1.0, 0.0, end), 1, rtol=1e-5)


# Derivatives


def end_of_stiff(solver):
    def end(rate):
        field = lambda t, y, args: -args * (jnp.sin(y) - jnp.cos(t) / 2)  # noqa: E731
        y0 = jnp.array([1.0, 2.0])
        sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, rate, num_steps=10)
        return jnp.sum(sol.ys[-1])

    return end


@pytest.mark.parametrize(
    "name, stages",
    [
        ("RKL3", None),
        *(pytest.param(*case, marks=slow) for case in [("RKL2", 5), ("RKL3", 5), ("RKL2", None)]),
    ],
)
def test_derivatives(name, stages):
    """Of a batch in reverse mode, and in forward mode if the stages are given.

    The radius is estimated, and not near one at which a step would have other stages.
    """
    end = end_of_stiff(SOLVERS[name](stages))

    @functools.partial(jax.jit, compiler_options=problems.QUICK)
    def run(rate):
        values, pull = jax.vjp(jax.vmap(end), jnp.stack([rate, 3.0]))
        (slopes,) = pull(jnp.ones(2))
        forward = jax.jvp(end, (rate,), (1.0,))[1] if stages else slopes[0]
        return values[0], slopes[0], forward

    expected = problems.central_difference(lambda rate: run(rate)[0], 60.0, 1.0, 1e-2)
    _, *found = run(60.0)
    np.testing.assert_allclose(found, [expected] * 2, rtol=1e-7)


def test_forward_mode_through_chosen_stages_names_what_has_it():
    end = end_of_stiff(cfjax.RKL2(spectral_radius=50.0))

    def slope(rate):
        return jax.jvp(end, (rate,), (1.0,))[1]

    with pytest.raises(TypeError, match=r"Forward mode needs .*RKL2\(stages=9\)"):
        slope(5.0)
    # JAX's own words come first in a batch of directions.
    with pytest.raises(TypeError, match=r"(?i)forward.mode"):
        jax.jacfwd(end)(5.0)


# Errors in words

A = np.random.default_rng(0).normal(size=(6, 6))
COLUMNS = np.linalg.qr(A[:, :2])[0]
ARGUMENTS = [
    (ValueError, "stages must be at least 3, got 2", dict(stages=2)),
    (ValueError, "max_stages must be at least 3, got 1", dict(max_stages=1)),
    (TypeError, "stages must be an int", dict(stages=5.0)),
    (TypeError, "stages must be an int", dict(stages=True)),
    (TypeError, "max_stages must be an int", dict(max_stages=None)),
    (ValueError, "spectral_radius must not be negative", dict(spectral_radius=-1.0)),
    (ValueError, "spectral_radius must not be negative", dict(spectral_radius=np.nan)),
    (ValueError, "spectral_radius must not be .* infinite, got inf", dict(spectral_radius=np.inf)),
    (TypeError, "spectral_radius must be .*, got True", dict(spectral_radius=True)),
    (ValueError, "not be given together", dict(stages=5, spectral_radius=1.0)),
    (TypeError, "spectral_radius must be", dict(spectral_radius="large")),
]
INSTEAD = "LeftMatrix.*BorderedSkew"
FIELDS = {
    "LowRankSkew": (lambda t, y, args: cfjax.LowRankSkew(A @ y), COLUMNS, INSTEAD),
    "SphereRotation": (lambda t, y, args: cfjax.SphereRotation(A @ y), COLUMNS[:, 0], INSTEAD),
    "Affine": (
        lambda t, y, args: cfjax.Affine(0 * y, np.ones(6), alpha=-1.0), COLUMNS[:, 0], "ETD54",
    ),
    "LinearAffine": (
        lambda t, y, args: cfjax.LinearAffine(-jnp.eye(6), 0 * y), COLUMNS[:, 0], "ETD54",
    ),
}  # fmt: skip


@pytest.mark.usefixtures("no_shape_hook")
def test_what_is_refused(subtests):
    for error, match, kwargs in ARGUMENTS:
        with subtests.test(case=str(kwargs)), pytest.raises(error, match=match):
            cfjax.RKL2(**kwargs)
    for radius in (5, 5.0, np.float32(5), np.int64(5), jnp.asarray(5.0)):
        cfjax.RKL3(spectral_radius=radius)

    def solve(term, solver, y0):
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=2, throw=False).ys

    # Those whose sums grow, or that have an exact stiff part.
    for kind, (field, y0, match) in FIELDS.items():
        for solver in (cfjax.RKL3(), cfjax.RKG2(5)):
            message = rf"(?s){type(solver).__name__}.*{kind}.*{match}"
            with subtests.test(case=kind), pytest.raises(TypeError, match=message):
                run = functools.partial(solve, cfjax.LieTerm(field), solver)
                jax.eval_shape(run, jnp.asarray(y0))
    path = diffrax.VirtualBrownianTree(0.0, 1.0, 1e-3, (), jax.random.key(0))
    noise = cfjax.LieControlTerm(lambda t, y, args, dw: y * dw, path)
    terms = diffrax.MultiTerm(cfjax.LieTerm(lambda t, y, args: -y), noise)
    with pytest.raises(TypeError, match=r"does not support noise.*CF4"):
        solve(terms, cfjax.RKL2(5), jnp.ones(2))


def test_a_radius_of_a_function_that_is_negative_or_nan_is_an_error():
    """Before the loop of `integrate`, and in what diffrax calls."""
    solver = cfjax.RKL2(spectral_radius=lambda t, y, args: args)
    term, y0 = cfjax.LieTerm(stiff), jnp.ones(2)
    integrate = eqx.filter_jit(
        lambda radius: cfjax.integrate(term, solver, 0.0, 1.0, y0, radius, num_steps=2).ys
    )
    init = eqx.filter_jit(lambda radius: solver.init(term, 0.0, 0.5, y0, radius))
    for run, radius in itertools.product((integrate, init), (-1.0, np.nan)):
        with pytest.raises(RuntimeError, match="spectral_radius must not be negative"):
            run(jnp.asarray(radius))


def test_what_they_do_take():
    """Rotations by SphereRotation in three dimensions, frames by BorderedSkew."""

    def field(t, y, args):
        return {"unit": cfjax.SphereRotation(A[:3, :3] @ y["unit"]),
                "frame": cfjax.BorderedSkew(A @ y["frame"])}  # fmt: skip

    def ode(t, x):
        u, q = x[12:], x[:12].reshape(6, 2)
        a, g = A[:3, :3] @ u, A @ q
        return np.concatenate([(g @ q[:2] - np.eye(6, 2) @ (g.T @ q)).ravel(), a - u * (a @ u)])

    y0 = {"unit": jnp.array([0.6, 0.0, 0.8]), "frame": jnp.asarray(COLUMNS)}
    answer = problems.reference(ode, 0.0, 0.1, problems.flat(y0))
    end = cfjax.integrate(cfjax.LieTerm(field), cfjax.RKL2(3), 0.0, 0.1, y0, num_steps=4).ys
    # Four steps of a fourth of a unit of time of these rates, of order 2.
    np.testing.assert_allclose(problems.flat(end), answer, rtol=0, atol=3e-3)


# Memory


@pytest.mark.parametrize("name", ["RKL2", pytest.param("RKL3", marks=slow)])
def test_memory_does_not_depend_on_the_stages(name):
    """As the compiler plans it, in states: y, the first field, two elements, a point."""
    n = 100_000

    def field(t, y, args):
        # Not entry by entry, so the stages cannot be computed one entry after another.
        return jnp.mean(y) - y

    def used(solver):
        def end(y0):
            return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=10).ys

        compiled = jax.jit(end, donate_argnums=0).lower(jnp.zeros(n)).compile()
        return compiled.memory_analysis().temp_size_in_bytes / (8 * n)

    # RKL3: the element of a half, a point and a field in the middle.
    assert used(SOLVERS[name](41)) < (8 if name == "RKL3" else 5) + 0.2
    # Where stages are chosen, the elements of all parts.
    chosen = used(SOLVERS[name](spectral_radius=100.0))
    assert chosen < (10 if name == "RKL3" else 5) + 0.2
    # The vector of the power iteration, and what tells whether a step was stable.
    assert used(SOLVERS[name]()) < chosen + (3 if name == "RKL3" else 2) + 0.1
