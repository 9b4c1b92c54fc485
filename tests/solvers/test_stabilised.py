"""Stabilised methods: their polynomials, orders, stages, control and exact answers."""

import functools
import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import optimistix as optx
import problems
import pytest
import scipy.integrate
from solver_table import solvers

import cfjax
from cfjax.scenes import wilson_flow

SOLVERS = {name: getattr(cfjax, name) for name in solvers("stabilised")}
SOLVERS_ROWS = solvers("stabilised")
names = pytest.mark.parametrize("name", SOLVERS)
# Twice the index of the Gegenbauer polynomials.
INDEX = {"RKL2": 1, "RKG2": 3, "RKL3": 1}


def reach(s, l):  # noqa: E741
    """The range of s stages on the negative axis."""
    return 2 * (s - 1) * (s + l + 1) / (l + 3)


def stages_for(z, l):  # noqa: E741
    """The least odd number whose range has z in it."""
    return next(s for s in range(3, 1000, 2) if reach(s, l) >= z)


# Stability polynomials


def gegenbauer(n, a, x):
    """By its finite sum, so from another formula than the recursion of the methods."""
    return mpmath.fsum(
        (-1) ** k * mpmath.rf(a, n - k) / mpmath.factorial(k) / mpmath.factorial(n - 2 * k)
        * (2 * x) ** (n - 2 * k)
        for k in range(n // 2 + 1)
    )  # fmt: skip


def polynomial(s, l, z):  # noqa: E741
    a = mpmath.mpf(l) / 2
    b = mpmath.mpf((l + 1) * (s - 1) * (s + l + 1)) / ((l + 3) * s * (s + l))
    w = mpmath.mpf(l + 3) / ((s - 1) * (s + l + 1))
    return 1 - b + b * gegenbauer(s, a, 1 + w * z) / gegenbauer(s, a, 1)


@functools.lru_cache
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


@pytest.mark.parametrize("dtype", [complex, np.complex64])
@names
def test_stability_polynomials_of_chosen_stages(name, dtype):
    """3 to 31 stages by the radius, in one program."""
    cases = [(s, z) for s in range(3, 32, 2) for z in points_of_stability(s, INDEX[name])]
    # Between the range of two stages fewer and that of s.
    radius = [reach(s, INDEX[name]) * (1 - 1e-3) for s, _ in cases]
    solver = SOLVERS[name](spectral_radius=radius_of_args)
    found = growth(solver, [z for _, z in cases], radius, dtype)
    expected = np.array([exact_growth(name, s, z) for s, z in cases])
    # Internal errors grow like the square of the stages.
    tolerance = 2e-13 if dtype is complex else 2e-4
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("stages", [3, 4, 5, 9, 16, 31])
@names
def test_stability_polynomials_of_given_stages(name, stages):
    z = points_of_stability(stages, INDEX[name])
    found = growth(SOLVERS[name](stages), z, np.zeros(len(z)))
    expected = [exact_growth(name, stages, x) for x in z]
    # As above.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-13)


@names
def test_stability_on_the_whole_range_and_damping_at_its_end(name):
    """Odd stages damp what is stiffest to a third or less; even ones would leave it as it is."""
    l = INDEX[name]  # noqa: E741
    size = np.geomspace(0.1, 1000, 200)
    found = growth(SOLVERS[name](spectral_radius=radius_of_args), -size, size)
    stages = [(stages_for(z, l), stages_for(z / 2, l)) for z in size]
    expected = [exact_growth(name, s, -z, m).real for z, (s, m) in zip(size, stages, strict=True)]
    expected = np.array(expected)
    # Up to 45 stages: internal errors grow like their square.
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-13)
    assert (np.abs(expected) < 1).all()
    # Below one also away from the origin: what a step leaves of stiff parts. The largest values of
    # the polynomials beyond z = -4 are 11/15, of RKL2 with 3 stages, at its end; 0.49338, of RKG2
    # with 5; and 0.64769, of RKL3 with 5 stages and 3.
    largest = {"RKL2": 11 / 15, "RKG2": 0.4934, "RKL3": 0.6477}[name]
    assert 0.98 * largest < np.abs(expected[size > 4]).max() <= largest
    if name != "RKL3":
        ends = np.array([reach(s, l) for s in range(3, 32, 2)])
        found = growth(SOLVERS[name](spectral_radius=radius_of_args), -ends, ends * (1 - 1e-9))
        # There the polynomial is 1 - 2 b.
        expected = [float(exact_growth(name, s, -reach(s, l)).real) for s in range(3, 32, 2)]
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-13)
        assert np.abs(found).max() < 0.34
        even = [abs(exact_growth(name, s, -reach(s, l)) - 1) for s in (4, 10, 30)]
        assert max(even) < 1e-12
        # Beyond it grows at once.
        found = growth(
            SOLVERS[name](spectral_radius=radius_of_args), -1.1 * ends, ends * (1 - 1e-9)
        )
        assert (np.abs(found[5:]) > 10).all()


def test_a_real_plane_is_a_complex_number():
    def field(t, y, args):
        return jnp.stack([-3 * y[0] - 40 * y[1], 40 * y[0] - 3 * y[1]])

    solver = cfjax.RKG2(9)
    y0, term, t = jnp.array([1.0, 0.0]), cfjax.LieTerm(field), jnp.zeros(())
    y = jax.jit(lambda y0: problems.first_step(solver, term, t, t + 0.1, y0, None)[0])(y0)
    expected = exact_growth("RKG2", 9, -0.3 + 4j)
    np.testing.assert_allclose(y, [expected.real, expected.imag], rtol=0, atol=1e-13)


# Times of stages


@names
def test_the_times_of_stages_by_an_equation_that_depends_on_time_alone(name):
    """u' = 2 t, exactly, and u' = 3 t^2 where the order is 3."""
    t0, h = jnp.asarray(0.3), 0.5
    power = 2 if name == "RKL3" else 1
    term = cfjax.LieTerm(lambda t, y, args: (power + 1) * t**power)

    @jax.jit
    def step(solver_radius):
        solver = SOLVERS[name](spectral_radius=lambda t, y, args: args)
        return problems.first_step(solver, term, t0, t0 + h, jnp.zeros(()), solver_radius)[0]

    exact = 0.8 ** (power + 1) - 0.3 ** (power + 1)
    for stages in (3, 9, 31):
        found = step(jnp.asarray(reach(stages, INDEX[name]) / h * 0.999))
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13)


def clocked(t, y, args):
    """Depends on time, and on a state that is the time."""
    return jnp.stack([jnp.sin(7 * t) - 3 * y[0] * jnp.cos(2 * t), 1 + 0 * t])


def without_time(t, y, args):
    return clocked(y[1], y, args)


@pytest.mark.parametrize("stages", [5, None])
@names
def test_the_times_of_stages_are_those_of_the_autonomous_equation(name, stages):
    """Whose stages have the time in the state: of all powers of the times, to rounding."""
    solver = SOLVERS[name](stages, spectral_radius=None if stages else 100.0)
    t0, y0 = jnp.asarray(0.3), jnp.array([0.7, 0.3])
    found, expected = (
        jax.jit(lambda y, f=f: problems.first_step(solver, cfjax.LieTerm(f), t0, t0 + 1, y, None))(
            y0
        )[0]
        for f in (clocked, without_time)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    assert found[1] == pytest.approx(1.3, abs=1e-13)


# Orders

SLOPES = {"RKL2": (1.85, 2.2), "RKG2": (1.85, 2.2), "RKL3": (2.8, 3.15)}
STEPS = (16, 24, 32, 48, 64)


def spin(xp, t, y):
    """An angular velocity that depends on time and attitude, and commutes at no two times."""
    return xp.stack([xp.sin(2 * t) + y[0, 1], xp.cos(t) - y[1, 2] + y[2, 0], t + y[2, 2]])


def attitude(t, y, args):
    return cfjax.Rotation(spin(jnp, t, y))


@pytest.fixture(scope="module")
def attitude_answer():
    def ode(t, y):
        y = y.reshape(3, 3)
        return np.cross(spin(np, t, y), y.T).T.ravel()

    return problems.reference(ode, 0.0, 1.0, np.eye(3).ravel())


def assert_order(name, solver, field, y0, args, answer):
    found = problems.errors(field, solver, 1.0, y0, args, answer, STEPS)
    low, high = SLOPES[name]
    assert found.max() < 0.1
    assert found.min() > 100 * problems.REFERENCE_ERROR
    assert low < problems.slope(STEPS, found) < high


@pytest.mark.parametrize(
    "stages",
    [9, None, pytest.param(3, marks=pytest.mark.slow), pytest.param(30, marks=pytest.mark.slow)],
)
@names
def test_order_on_an_attitude(attitude_answer, name, stages):
    """Where the commutators count, which commuting problems hide."""
    solver = SOLVERS[name](stages)
    assert_order(name, solver, attitude, np.eye(3), None, attitude_answer)


@names
def test_order_of_a_chosen_number_of_stages_that_changes_with_the_step(attitude_answer, name):
    """From 31 stages to 15 as steps become shorter: the error has no other order for that."""
    solver = SOLVERS[name](spectral_radius=5000.0)
    assert_order(name, solver, attitude, np.eye(3), None, attitude_answer)


def pose(t, y, args):
    w = spin(jnp, t, y[:3, :3])
    v = jnp.stack([jnp.cos(t), y[0, 3], y[1, 0]])
    return cfjax.RigidMotion(omega=w, v=v, frame="fixed")


@pytest.mark.representatives(2)
@pytest.mark.parametrize("stages", [7, None])
@names
def test_order_on_poses(name, stages):
    def ode(t, y):
        y = y.reshape(4, 4)
        rate, v = np.zeros((4, 4)), np.array([np.cos(t), y[0, 3], y[1, 0]])
        rate[:3] = np.cross(spin(np, t, y[:3, :3]), y[:3].T).T
        rate[:3, 3] += v
        return rate.ravel()

    start = np.eye(4)
    start[:3, 3] = [0.3, -0.2, 0.5]
    answer = problems.reference(ode, 0.0, 1.0, start.ravel())
    assert_order(name, SOLVERS[name](stages), pose, start, None, answer)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("stages", [7, None])
@names
def test_order_on_a_dictionary_of_rotations_and_an_array(flight_problem, name, stages):
    assert_order(name, SOLVERS[name](stages), *flight_problem)


# Exact answers, with control of the error


def diffusion(n):
    """Between cells with conductivity i (n - i): the modes are discrete Legendre polynomials, with
    rates k (k + 1). Along all axes, each of n cells.
    """
    k = np.arange(1, n) * (n - np.arange(1, n))

    def along(y, axis):
        flux = jnp.asarray(k, float).reshape([1] * (y.ndim - 1) + [-1]) * jnp.diff(
            jnp.moveaxis(y, axis, -1)
        )
        zeros = [(0, 0)] * (y.ndim - 1)
        return jnp.moveaxis(jnp.diff(jnp.pad(flux, [*zeros, (1, 1)])), -1, axis)

    return lambda t, y, args: sum(along(y, axis) for axis in range(y.ndim))


def legendre_mode(n, k):
    """The sum 3F2(-k, k + 1, -x; 1, 1 - n; 1)."""
    terms = [np.ones(n)]
    x = np.arange(n)
    for i in range(k):
        ratio = (i - k) * (k + 1 + i) * (i - x) / ((1 + i) * (1 - n + i) * (i + 1))
        terms.append(terms[-1] * ratio)
    return sum(terms)


def heat_problem():
    n = 10

    def at(t):
        modes = {(0, 0): 1.0, (1, 0): 0.5, (1, 2): -0.4, (n - 1, n - 1): 1e-3}
        return sum(
            c * np.exp(-(j * (j + 1) + k * (k + 1)) * t)
            * np.outer(legendre_mode(n, j), legendre_mode(n, k))
            for (j, k), c in modes.items()
        )  # fmt: skip

    return diffusion(n), at(0.0), None, 0.3, at(0.3)


def porous_problem():
    """u' = (u^2)'' from X with (X^2)'' = -X, by Newton's method: u = X / (1 + t)."""
    n = 15
    laplacian = (n + 1) ** 2 * (np.eye(n, k=1) - 2 * np.eye(n) + np.eye(n, k=-1))
    w = 0.005 * np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
    for _ in range(30):
        jacobian = laplacian + np.diag(0.5 / np.sqrt(w))
        w = np.maximum(w - np.linalg.solve(jacobian, laplacian @ w + np.sqrt(w)), 1e-6)
    x = np.sqrt(w)
    assert np.abs(laplacian @ x**2 + x).max() < 1e-14

    def field(t, y, args):
        w = jnp.pad(y**2, 1)
        return (n + 1) ** 2 * (w[2:] - 2 * y**2 + w[:-2])

    return field, 50 * x, None, 0.2, 50 * x / (1 + 50 * 0.2)


def neighbours(y):
    return sum(jnp.roll(y, shift, axis) for axis in (0, 1) for shift in (1, -1))


def spins(t, y, args):
    """Spins on a square lattice that turn towards their neighbours."""
    return cfjax.Rotation(jnp.cross(y, neighbours(y)))


def sublattices(a):
    """Two sublattices of spins, with an angle a between neighbours."""
    sign = jnp.asarray(1.0 - 2 * (np.indices((4, 4)).sum(0) % 2))
    return jnp.stack([jnp.sin(sign * a / 2), 0 * sign, jnp.cos(sign * a / 2)], axis=-1)


def sublattices_problem():
    """The stiffest mode, nonlinear: tan(a / 2) falls as exp(-8 t)."""
    a = 2 * np.arctan(np.exp(-8 * 0.25) * np.tan(1.2))
    return spins, np.asarray(sublattices(2.4)), None, 0.25, np.asarray(sublattices(a))


def damped_spin_problem(b=30.0, alpha=0.5, t=0.2, theta=2.0):
    def field(t, y, args):
        up = jnp.array([0.0, 0.0, b])
        return cfjax.Rotation((up + alpha * jnp.cross(y, up)) / (1 + alpha**2))

    def at(t):
        rate = b / (1 + alpha**2)
        angle = 2 * np.arctan(np.exp(-alpha * rate * t) * np.tan(theta / 2))
        p = rate * t
        return np.array([np.sin(angle) * np.cos(p), np.sin(angle) * np.sin(p), np.cos(angle)])

    return field, at(0.0), None, t, at(t)


def link(t, y, args):
    """A link that moves to the unit: minus the traceless skew part."""
    skew = (jnp.conj(y.T) - y) / 2
    trace = jnp.trace(skew) / len(y)
    return cfjax.LeftMatrix(skew - trace * jnp.eye(len(y), dtype=y.dtype))


def link_problem(angles, ends, t=1.5):
    rng = np.random.default_rng(3)
    n = len(angles)
    v = np.linalg.qr(rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n)))[0]
    start, end = (v @ np.diag(np.exp(1j * np.asarray(p))) @ v.conj().T for p in (angles, ends))
    return link, start, None, t, end


def su2_problem():
    end = 2 * np.arctan(np.exp(-1.5) * np.tan(1.0))
    return link_problem([2.0, -2.0], [end, -end])


def su3_problem():
    start = np.array([2.0, -0.5, -1.5])
    end = problems.reference(lambda t, p: np.mean(np.sin(p)) - np.sin(p), 0.0, 1.5, start)
    return link_problem(start, end)


def oscillation_problem():
    def field(t, y, args):
        return jnp.stack([-3 * y[0] - 40 * y[1], 40 * y[0] - 3 * y[1]])

    y = np.exp(-3 + 40j)
    return field, np.array([1.0, 0.0]), None, 1.0, np.array([y.real, y.imag])


PROBLEMS = {
    "heat": heat_problem,
    "porous medium": porous_problem,
    "two sublattices": sublattices_problem,
    "damped spin": damped_spin_problem,
    "SU(2) link": su2_problem,
    "SU(3) link": su3_problem,
    "oscillation": oscillation_problem,
}


# Of the error at the end over the tolerance of a step. The errors of all steps add up, and stiff
# parts are damped.
RATIOS = {"RKL2": (1e-3, 100), "RKG2": (1e-3, 100), "RKL3": (0.01, 20)}


def solve(field, solver, t1, y0, args=None, tolerance=1e-5, **options):
    # diffrax's control of complex states asks for it.
    with jax.numpy_dtype_promotion("standard"):
        return diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            solver,
            0.0,
            t1,
            t1 / 1000,
            y0,
            args,
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
            **{"max_steps": 10_000, **options},
        )


def distance_from_manifold(name, y):
    if "spin" in name or "sublattices" in name:
        return np.abs(np.sum(np.asarray(y) ** 2, axis=-1) - 1).max()
    if "link" in name:
        return np.abs(np.asarray(y).conj().T @ np.asarray(y) - np.eye(len(y))).max()
    return 0.0


@pytest.mark.parametrize("name", ["RKL2", "RKL3", pytest.param("RKG2", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize("problem", PROBLEMS)
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
        # As rounding adds up over the steps.
        assert distance_from_manifold(problem, y) < 1e-14 * (10 + steps)
    # The parts of an error may cancel at one tolerance, as those of RKG2 for the damped spin do at
    # 1e-3.
    assert errors[2] < min(errors[:2])


@pytest.mark.slow
def test_the_derivative_of_two_sublattices_with_respect_to_their_angle():
    def angle(a, solver):
        sol = solve(spins, solver, 0.25, sublattices(a), tolerance=1e-6)
        y = sol.ys[-1]
        return jnp.arccos(jnp.sum(y[0, 0] * y[0, 1]))

    found = jax.jit(jax.grad(angle), static_argnums=1)(2.4, cfjax.RKL3(spectral_radius=8.0))
    shrink = np.exp(-8 * 0.25)
    u = shrink * np.tan(1.2)
    expected = shrink / np.cos(1.2) ** 2 / (1 + u**2)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@names
def test_wilson_flow_of_links(name):
    """Of 3^4 links, by SciPy's DOP853. 4 d is a bound of the radius."""
    y0 = wilson_flow.y0(3)
    end = wilson_flow.reference(1.0, y0)
    solver = SOLVERS[name](spectral_radius=16.0)
    low, high = RATIOS[name]

    @jax.jit
    def run(y0, tolerance):
        return solve(wilson_flow.field, solver, 1.0, y0, tolerance=tolerance).ys[-1]

    errors = []
    for tolerance in (1e-4, 1e-5):
        found = np.asarray(run(jnp.asarray(y0), jnp.asarray(tolerance)))
        errors.append(np.abs(found - end).max())
        assert low < errors[-1] / tolerance < high
        defect = np.einsum("...ji,...jk", found.conj(), found) - np.eye(3)
        assert np.abs(defect).max() < 1e-13
    # The error of a step is that of the tolerance, so the ends differ as it to the power of 2/3, or
    # 1: by 4.6 and 10.
    assert errors[0] > (6 if name == "RKL3" else 3) * errors[1]
    actions = [float(wilson_flow.action(jnp.asarray(y))) for y in (found, end)]
    np.testing.assert_allclose(actions[0], actions[1], rtol=1e-4)


@names
def test_on_the_manifold_for_any_length_of_a_step(name):
    field, y0, _, _, _ = damped_spin_problem()
    solver = SOLVERS[name](spectral_radius=60.0)

    @jax.jit
    def end(t1):
        return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, t1, y0, num_steps=3).ys[-1]

    for t1 in (0.1, 1.0, 10.0, 100.0):
        # Flows correct the length up to rounding, of angles of up to some 1000.
        assert abs(np.linalg.norm(end(t1)) - 1) < 1e-13


# Control and the spectral radius


def rough_heat(n, amplitude):
    """Along one axis: a smooth mode, and the stiffest one with an amplitude; its radius."""
    field = diffusion(n)
    smooth, stiffest = legendre_mode(n, 1), legendre_mode(n, n - 1)
    y = smooth + amplitude * stiffest / np.abs(stiffest).max()
    return field, jnp.asarray(y), n * (n - 1)


# How much larger than its estimate an unstable part may be at the end of a step. Odd numbers of
# stages make P_s negative beyond their range. The estimate of RKL3 is (a - 1)(P_m^2 - P_s) times
# the part before, so larger than either share of the growth a P_m^2 - (a - 1) P_s but for a factor
# of a / (a - 1) = 4 / r, at most 4. That of RKL2 is z times as large as the part.
UNSEEN = {"RKL2": 0.1, "RKL3": 4.0}


@pytest.mark.parametrize("stages", [11, 13, 21, 41])
@pytest.mark.parametrize("name", UNSEEN)
def test_the_estimate_sees_all_that_a_radius_that_is_too_small_makes(name, stages):
    """0.9 of the radius, and a step at the end of the range for that."""
    amplitude = 1e-6
    field, y0, radius = rough_heat(30, amplitude)
    h = reach(stages, 1) / (0.9 * radius) * (1 - 1e-6)

    @jax.jit
    def step(y0):
        solver = SOLVERS[name](spectral_radius=0.9 * radius)
        term, t = cfjax.LieTerm(field), jnp.zeros(())
        return problems.first_step(solver, term, t, t + h, y0, None)[:2]

    # A linear problem: the rest of the step and of its estimate is that of a smooth start.
    smooth = rough_heat(30, 0.0)[1]
    end, error = (np.abs(a - b).max() for a, b in zip(step(y0), step(smooth), strict=True))
    growth = abs(exact_growth(name, stages, -h * radius))
    assert growth > 10
    # Rounding of the smooth part is of the stiffest mode too.
    assert end == pytest.approx(growth * amplitude, rel=1e-6)
    assert end < UNSEEN[name] * error


@pytest.mark.parametrize("name", UNSEEN)
def test_a_radius_that_is_too_small_costs_steps_and_not_accuracy(name):
    """For any amplitude of the stiffest mode, at any tolerance, over many steps."""
    solver, t1 = SOLVERS[name](spectral_radius=lambda t, y, args: args), 5.0
    field, smooth, radius = rough_heat(30, 0.0)
    exact = smooth * np.exp(-2 * t1)
    run = jax.jit(lambda y0, r, tolerance: solve(field, solver, t1, y0, r, tolerance))
    rejected = {1.0: 0, 0.9: 0}
    for amplitude, tolerance in itertools.product((1e-8, 1e-5, 1e-2), (1e-2, 1e-4, 1e-6)):
        y0, errors = rough_heat(30, amplitude)[1], {}
        for factor in rejected:
            sol = run(y0, jnp.asarray(factor * radius), jnp.asarray(tolerance))
            # In the norm of the controller.
            errors[factor] = np.sqrt(np.mean((sol.ys[-1] - exact) ** 2))
            rejected[factor] += int(sol.stats["num_rejected_steps"])
        # As much as an accepted step leaves of the stiffest mode, beside the error of the others.
        assert errors[0.9] < 2 * errors[1.0] + UNSEEN[name] * tolerance
    # An unstable mode grows in smooth solutions too, from rounding.
    assert rejected[0.9] > 2 * rejected[1.0]


@names
def test_spectral_radius_as_a_number_a_function_and_an_estimate(name):
    field, y0, radius = rough_heat(12, 0.1)
    exact = legendre_mode(12, 1) * np.exp(-0.4) + 0.0
    for value in (float(radius), np.float64(radius), lambda t, y, args: 1.0 * radius, None):
        sol = solve(field, SOLVERS[name](spectral_radius=value), 0.2, y0, tolerance=1e-5)
        assert np.abs(sol.ys[-1] - exact).max() < 1e-3


@pytest.mark.parametrize("name", ["RKL2", "RKL3"])
def test_a_step_with_an_estimated_radius_is_stable(name):
    """Beyond the range of 21 stages, where too small an estimate would leave it at 21. The power
    iteration is short of the radius, as the spectrum is dense at its end.
    """
    term = cfjax.LieTerm(lambda t, y, args: jnp.roll(y, 1) - 2 * y + jnp.roll(y, -1))
    # The stiffest mode, with the rate 4.
    y0, t = jnp.asarray(1.0 - 2 * (np.arange(32) % 2)), jnp.zeros(())
    assert cfjax.spectral_radius(term, 0.0, y0) < 0.98 * 4

    @jax.jit
    def end(h):
        return problems.first_step(SOLVERS[name](), term, t, t + h, y0, None)[0]

    for beyond in (1.01, 1.02, 1.05, 1.1):
        z = beyond * reach(21, 1)
        assert abs(exact_growth(name, 21, -z)) > 2
        assert np.abs(end(jnp.asarray(z / 4))).max() < 1


def test_the_estimated_radius_follows_the_state():
    """Stages follow a radius that grows a hundredfold within the solve."""

    def field(t, y, args):
        return {"rate": y["rate"], "y": -y["rate"] * (y["y"] - 1)}

    start = {"rate": jnp.asarray(10.0), "y": jnp.zeros(3)}
    sol = solve(field, cfjax.RKL2(), np.log(100), start, tolerance=1e-4)
    np.testing.assert_allclose(sol.ys["rate"][-1], 1000, rtol=1e-3)
    np.testing.assert_allclose(sol.ys["y"][-1], 1, rtol=1e-3)
    assert sol.stats["num_rejected_steps"] < 0.2 * sol.stats["num_steps"]


# A spectral radius that grows

N_CELLS = 64


def matrix_of_diffusion(n):
    k = np.arange(1, n) * (n - np.arange(1, n))
    gradient = np.diff(np.eye(n), axis=0)
    return -gradient.T @ np.diag(k) @ gradient


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
    "name, dtype", [(name, float) for name in SOLVERS] + [("RKL2", np.float32)]
)
def test_equal_steps_of_a_diffusion_that_is_switched_on(name, dtype):
    """The radius is zero at the start: of a state at zero, or of a diffusivity that is."""

    @jax.jit
    def end(y0, p):
        term = cfjax.LieTerm(switched)
        return cfjax.integrate(term, SOLVERS[name](), 0.0, 1.0, y0, p, num_steps=80).ys[-1]

    for p, y0, exact in switched_problems().values():
        found = end(jnp.asarray(y0, dtype), jnp.asarray(p, dtype))
        # The error of the methods, of second order: some (1/80)^2 times 2. An unstable step leaves
        # 1e20.
        np.testing.assert_allclose(found, exact, rtol=0, atol=3e-4)


def test_controlled_steps_of_a_diffusion_that_is_switched_on_are_as_with_the_radius():
    def counts(solver):
        @jax.jit
        def run(y0, p):
            sol = solve(switched, solver, 1.0, y0, p, 1e-3, max_steps=2000)
            return sol.ys[-1], sol.stats["num_steps"]

        for name in ("sine", "ramp", "from zero"):
            p, y0, exact = switched_problems()[name]
            y, number = run(jnp.asarray(y0), jnp.asarray(p))
            # A few times the tolerance, as errors of steps add up.
            np.testing.assert_allclose(y, exact, rtol=0, atol=1e-2)
            yield int(number)

    estimated, given = counts(cfjax.RKL2()), counts(cfjax.RKL2(spectral_radius=exact_radius))
    for found, expected in zip(estimated, given, strict=True):
        assert found < 1.25 * expected


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
    by = diffusion(N_CELLS)
    is_on = jnp.where(t >= start, 1.0, 0.0)
    return {"a": slow * by(t, y["a"], None), "b": fast * is_on * by(t, y["b"], None)}


def test_a_batch_in_which_parts_are_switched_on_later_is_as_its_members():
    """3 and 10 times as stiff as what is on from the start, at the end of a step and within one."""
    rough = np.random.default_rng(1).normal(size=(2, N_CELLS))
    y0 = {"a": jnp.asarray(rough[0]), "b": jnp.asarray(rough[1])}
    # Slow, fast, start.
    members = jnp.array([[0.33, 1.0, 0.5], [0.1, 1.0, 0.613], [0.1, 1.0, 2.0], [0.1, 0.0, 0.0]])

    @jax.jit
    def end(p):
        sol = cfjax.integrate(cfjax.LieTerm(beside), cfjax.RKL2(), 0.0, 1.0, y0, p, num_steps=100)
        return sol.ys["a"][-1], sol.ys["b"][-1]

    found = jax.jit(jax.vmap(end))(members)
    for k, (slow, fast, start) in enumerate(np.asarray(members)):
        a, b = (leaf[k] for leaf in found)
        np.testing.assert_allclose(a, end(members[k])[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(b, end(members[k])[1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(a, diffused(N_CELLS, rough[0], slow), rtol=0, atol=1e-3)
        exact = diffused(N_CELLS, rough[1], fast * max(1 - start, 0))
        # A start within a step is off by part of a step, with rates of 2 of what is left.
        np.testing.assert_allclose(b, exact, rtol=0, atol=1e-3 if start != 0.613 else 2e-2)


def test_reverse_mode_of_a_diffusion_that_is_switched_on():
    rough = np.random.default_rng(2).normal(size=(2, N_CELLS))

    def value(rate):
        term = cfjax.LieTerm(lambda t, y, rate: rate * t * diffusion(N_CELLS)(t, y, None))
        y0 = jnp.asarray(rough[0])
        y = cfjax.integrate(term, cfjax.RKL2(), 0.0, 1.0, y0, rate, num_steps=60).ys[-1]
        return jnp.vdot(rough[1], y)

    slope = matrix_of_diffusion(N_CELLS) @ diffused(N_CELLS, rough[0], 0.5) / 2
    expected = np.vdot(rough[1], slope)
    # As accurate as the solution.
    np.testing.assert_allclose(jax.jit(jax.grad(value))(1.0), expected, rtol=1e-2)


def with_rate(t, y, args):
    """The diffusivity is part of the state, and grows from zero: a step does not foresee it."""
    by = diffusion(N_CELLS)
    return {"rate": args + 0 * y["rate"], "y": y["rate"] * by(t, y["y"], None)}


@names
def test_a_step_that_is_unstable_as_the_radius_grew_is_an_error(name):
    rough = np.random.default_rng(3).normal(size=N_CELLS)
    start = {"rate": jnp.zeros(()), "y": jnp.asarray(rough)}

    def run(rate, throw):
        return cfjax.integrate(
            cfjax.LieTerm(with_rate), SOLVERS[name](), 0.0, 1.0, start, rate, num_steps=20,
            throw=throw,
        )  # fmt: skip

    with pytest.raises(RuntimeError, match=r"unstable.*more steps.*spectral_radius.*stages"):
        run(jnp.asarray(20.0), True)
    sol = run(jnp.asarray(20.0), False)
    assert sol.result != diffrax.RESULTS.successful
    assert np.isnan(sol.ys["y"]).all()
    # What so many steps do resolve.
    y = run(jnp.asarray(0.5), True).ys["y"][-1]
    np.testing.assert_allclose(y, diffused(N_CELLS, rough, 0.25), rtol=0, atol=1e-2)


def test_a_step_that_is_unstable_as_the_radius_grew_is_taken_again():
    """Whatever the tolerance: any error is below this one."""
    rough = np.random.default_rng(3).normal(size=N_CELLS)
    start = {"rate": jnp.zeros(()), "y": jnp.asarray(rough)}
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(with_rate), cfjax.RKL2(), 0.0, 1.0, 0.25, start, jnp.asarray(5.0),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e30),
    )  # fmt: skip
    assert sol.stats["num_rejected_steps"] > 0
    # Nothing grows in a stable step.
    assert np.abs(sol.ys["y"]).max() < np.abs(rough).max()


# More stages than there may be


def stiff(t, y, args):
    return -args * (y - jnp.cos(t))


def test_max_stages_too_small_is_an_error_that_says_how_many():
    with pytest.raises(RuntimeError, match=r"max_stages=10 is too small.* than 20 stages"):
        cfjax.integrate(
            cfjax.LieTerm(stiff), cfjax.RKL2(max_stages=10), 0.0, 1.0, jnp.ones(2), 1000.0,
            num_steps=4,
        )  # fmt: skip
    sol = cfjax.integrate(
        cfjax.LieTerm(stiff), cfjax.RKL2(max_stages=10), 0.0, 1.0, jnp.ones(2), 1000.0,
        num_steps=4, throw=False,
    )  # fmt: skip
    assert np.isnan(sol.ys).all()
    # Only later steps take as many.
    grow = cfjax.LieTerm(lambda t, y, args: -args * jnp.exp(5 * t) * y)

    def end(rate):
        solver = cfjax.RKL2(spectral_radius=lambda t, y, args: args * jnp.exp(5 * t), max_stages=15)
        return cfjax.integrate(grow, solver, 0.0, 1.0, jnp.ones(2), rate, num_steps=4).ys

    # At the end of the last step exp(5) * 3 / 4 = 111, of 119 that 15 stages have, and 186.
    assert np.isfinite(end(3.0)).all()
    for run in (end, eqx.filter_jit(end)):
        with pytest.raises(RuntimeError, match=r"max_stages=15 is too small.* than 15 stages"):
            run(5.0)
    with pytest.raises(RuntimeError, match=r"(?i)nonfinite"):
        diffrax.diffeqsolve(
            cfjax.LieTerm(stiff), cfjax.RKL3(max_stages=10), 0.0, 1.0, 0.25, jnp.ones(2), 1000.0
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["RKL2", "RKL3"])
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


@pytest.mark.parametrize("name", ["RKL2", "RKL3"])
def test_an_impossible_step_evaluates_no_stage(name):
    calls = []

    def field(t, y, args):
        jax.debug.callback(lambda t: calls.append(float(t)), t)
        return -y

    solver = SOLVERS[name](spectral_radius=lambda t, y, args: args, max_stages=9)
    term, y0 = cfjax.LieTerm(field), jnp.ones(1)
    for radius, evaluations in ((100.0, "few"), (10.0, "all")):
        radius, t = jnp.asarray(radius), jnp.zeros(())
        state = solver.init(term, t, t + 1, y0, radius)
        calls.clear()
        y, error, *_ = solver.step(term, t, t + 1, y0, radius, state, made_jump=False)
        jax.block_until_ready(y)
        jax.effects_barrier()
        assert np.isnan(y).all() == np.isnan(error).all() == (evaluations == "few")
        # That of the end, and the one in the middle.
        stages = stages_for(10.0, 1)
        expected = (
            {"few": 1, "all": stages}
            if name == "RKL2"
            else {"few": 2, "all": stages + 2 * stages_for(5.0, 1) - 1}
        )
        assert len(calls) == expected[evaluations]


# With diffrax


@names
def test_the_first_evaluation_is_the_last_of_the_step_before(name):
    times = []

    def field(t, y, args):
        jax.debug.callback(lambda t: times.append(float(t)), t)
        return -y

    y = cfjax.integrate(
        cfjax.LieTerm(field), SOLVERS[name](5), 0.0, 1.0, jnp.ones(1), num_steps=4
    ).ys
    jax.block_until_ready(y)
    jax.effects_barrier()
    assert len(times) == 1 + 4 * SOLVERS_ROWS[name].evaluations
    # From within the step, by some units of rounding.
    assert 1 - 1e-14 < max(times) < 1


@names
def test_a_jump_is_seen_by_the_step_after_it(name):
    def field(t, y, args):
        return jnp.where(t < 0.5, 1.0, -3.0) * jnp.ones(1) + 0 * y

    controller = diffrax.ClipStepSizeController(
        diffrax.PIDController(rtol=0.0, atol=1e-6), jump_ts=jnp.array([0.5])
    )
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(field), SOLVERS[name](5), 0.0, 1.0, 0.1, jnp.zeros(1),
        stepsize_controller=controller,
    )  # fmt: skip
    # Otherwise the first field after the jump would be that before it. diffrax steps over it by a
    # rounding of time.
    np.testing.assert_allclose(sol.ys[-1], 0.5 - 1.5, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["RKL2", "RKL3"])
def test_output_within_a_step_has_order_two_stays_on_the_manifold_and_meets_the_end(
    attitude_answer, name
):
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
            problems.many_steps(
                attitude, cfjax.CF4(), jnp.zeros(()), x * h, y0, None, jnp.asarray(100)
            )
            for x in theta[1:3]
        ]
        errors.append(np.abs(np.stack(fine) - ys[1:3]).max())
    # Of one step: h^3.
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (slopes > 2.6).all()


@pytest.mark.parametrize("name", ["RKL2", "RKL3"])
def test_saved_times_within_controlled_steps(name):
    field, y0, _, t1, _ = damped_spin_problem()
    ts = jnp.linspace(0, t1, 7)
    sol = solve(field, SOLVERS[name](), t1, jnp.asarray(y0), saveat=diffrax.SaveAt(ts=ts))
    exact = np.stack([damped_spin_problem(t=float(t))[4] for t in ts])
    assert np.abs(sol.ys - exact).max() < 1e-3
    assert np.abs(np.linalg.norm(sol.ys, axis=-1) - 1).max() < 1e-13


def test_an_event_within_a_step():
    field, y0, _, t1, _ = damped_spin_problem()
    event = diffrax.Event(
        lambda t, y, args, **kwargs: y[2], optx.Newton(rtol=1e-8, atol=1e-8), direction=None
    )
    sol = solve(field, cfjax.RKL3(), 10 * t1, jnp.asarray(y0), tolerance=1e-7, event=event)
    # tan(theta / 2) = 1.
    rate = 30.0 / 1.25
    assert sol.ts[-1] == pytest.approx(np.log(np.tan(1.0)) / (0.5 * rate), abs=1e-5)


@names
def test_a_product_of_spins_and_heat_is_as_each_alone(name):
    heat, u0, radius = rough_heat(12, 0.1)
    spin_field, s0, _, _, _ = damped_spin_problem()

    def field(t, y, args):
        return {"s": spin_field(t, y["s"], None), "u": heat(t, y["u"], None)}

    def end(field, y0):
        solver = SOLVERS[name](spectral_radius=float(radius))
        return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 0.2, y0, num_steps=20).ys

    both = end(field, {"s": jnp.asarray(s0), "u": u0})
    # One recursion, whose weights do not depend on the state.
    np.testing.assert_allclose(both["s"], end(spin_field, jnp.asarray(s0)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(both["u"], end(heat, u0), rtol=0, atol=1e-13)


def test_sums_are_compensated():
    """Of 1e5 steps in single precision, which would round to a hundred units otherwise."""

    def field(t, y, args):
        return cfjax.Rotation(jnp.array([0.0, 0.0, 1.0], np.float32))

    y0, n = jnp.array([1.0, 0.0, 0.0], np.float32), 100_000
    y = cfjax.integrate(cfjax.LieTerm(field), cfjax.RKL2(3), 0.0, 1.0, y0, num_steps=n).ys[-1]
    np.testing.assert_allclose(y, [np.cos(1), np.sin(1), 0], rtol=0, atol=3e-6)


@names
def test_leading_axes_are_states_of_their_own(name):
    y0 = np.random.default_rng(0).normal(size=(5, 3))
    y0 = jnp.asarray(y0 / np.linalg.norm(y0, axis=-1, keepdims=True))

    def field(t, y, args):
        up = jnp.array([0.0, 0.0, 1.0])
        return cfjax.Rotation(jnp.cos(t) * jnp.cross(y, jnp.broadcast_to(up, y.shape)) + y * y)

    def end(y0):
        return cfjax.integrate(
            cfjax.LieTerm(field), SOLVERS[name](5), 0.0, 1.0, y0, num_steps=5
        ).ys[-1]

    np.testing.assert_allclose(end(y0), jnp.stack([end(y) for y in y0]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("radius", [None, "args"])
@pytest.mark.parametrize("name", ["RKL2", "RKL3"])
def test_a_batch_of_different_stiffness_is_as_its_members(name, radius):
    """3 to 11 stages side by side; the loop runs on for those that have most."""
    rates = jnp.array([1.0, 100.0, 3000.0])
    solver = SOLVERS[name](spectral_radius=radius and (lambda t, y, args: args))

    @jax.jit
    def end(rate):
        term, y0 = cfjax.LieTerm(stiff), jnp.zeros(2)
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, rate, num_steps=50).ys[-1]

    found = jax.jit(jax.vmap(end))(rates)
    np.testing.assert_allclose(found, jnp.stack([end(r) for r in rates]), rtol=0, atol=1e-13)


@pytest.mark.parametrize("radius", [None, "args"])
def test_a_batch_of_controlled_solves_is_as_its_members(radius):
    """As many steps, and ends that differ as those of starts that differ by a rounding."""
    rates = jnp.array([1.0, 100.0, 3000.0])
    solver = cfjax.RKL2(spectral_radius=radius and (lambda t, y, args: args))

    @jax.jit
    def end(rate, start):
        sol = solve(stiff, solver, 1.0, jnp.zeros(2) + start, rate, 1e-4)
        return sol.ys[-1], sol.stats["num_steps"], sol.stats["num_rejected_steps"]

    found, *numbers = jax.vmap(end, (0, None))(rates, 0.0)
    for k, rate in enumerate(rates):
        expected, *expected_numbers = end(rate, 0.0)
        assert [int(n[k]) for n in numbers] == [int(n) for n in expected_numbers]
        # The length of a step follows from the estimate, in which the rounding of stiff parts
        # counts z times, and the step has an error of the tolerance.
        moved = [jnp.abs(end(rate, x)[0] - expected).max() for x in (1e-16, -1e-16, 1e-15, -1e-15)]
        assert jnp.abs(found[k] - expected).max() <= 1e-13 + 4 * max(moved)
        # Far less than an error that anything else would make.
        assert max(moved) < 1e-8


def test_backwards_in_time_what_decayed_grows():
    def run(t0, t1, y0):
        term = cfjax.LieTerm(lambda t, y, args: -3 * y)
        return cfjax.integrate(term, cfjax.RKL3(), t0, t1, y0, num_steps=200).ys[-1]

    end = run(0.0, 1.0, jnp.ones(2))
    np.testing.assert_allclose(end, np.exp(-3), rtol=1e-6)
    np.testing.assert_allclose(run(1.0, 0.0, end), 1, rtol=1e-5)


@pytest.mark.parametrize("stages", [5, None])
def test_richardson_takes_them(attitude_answer, stages):
    """Though a method without an estimate needs it more."""
    solver = cfjax.Richardson(cfjax.RKL2(stages))
    sol = solve(attitude, solver, 1.0, jnp.eye(3), tolerance=1e-5)
    error = np.abs(sol.ys[-1].ravel() - attitude_answer).max()
    assert 1e-8 < error < 1e-4


# Derivatives


def end_of_stiff(solver):
    def end(rate):
        sol = cfjax.integrate(
            cfjax.LieTerm(lambda t, y, args: -args * jnp.sin(y)), solver, 0.0, 1.0,
            jnp.array([1.0, 2.0]), rate, num_steps=10,
        )  # fmt: skip
        return jnp.sum(sol.ys[-1])

    return end


@names
def test_reverse_mode_through_chosen_stages(name):
    end = end_of_stiff(SOLVERS[name](spectral_radius=50.0))
    expected = problems.central_difference(jax.jit(end), 5.0, 1.0, 1e-2)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(5.0), expected, rtol=1e-7)


@names
def test_both_modes_through_given_stages(name):
    end = end_of_stiff(SOLVERS[name](5))
    expected = problems.central_difference(jax.jit(end), 5.0, 1.0, 1e-2)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(5.0), expected, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(end, (5.0,), (1.0,))[1], expected, rtol=1e-7)


@pytest.mark.parametrize("radius", [None, 50.0])
def test_forward_mode_through_chosen_stages_names_what_has_it(radius):
    end = end_of_stiff(cfjax.RKL2(spectral_radius=radius))

    def slope(rate):
        return jax.jvp(end, (rate,), (1.0,))[1]

    for run in (slope, jax.jit(slope)):
        with pytest.raises(TypeError, match=r"Forward mode needs .*RKL2\(stages=9\)"):
            run(5.0)
    # JAX's own words come first in a batch of directions.
    with pytest.raises(TypeError, match=r"(?i)forward.mode"):
        jax.jacfwd(end)(5.0)
    # Batches of reverse mode have nothing to do with that.
    rates = jnp.array([3.0, 5.0])
    found = jax.jit(jax.grad(lambda rates: jnp.sum(jax.vmap(end)(rates))))(rates)
    np.testing.assert_allclose(found, jax.jit(jax.vmap(jax.grad(end)))(rates), rtol=1e-12)


# Errors in words


@pytest.mark.parametrize(
    "error, match, kwargs",
    [
        (ValueError, "stages must be at least 3, got 2", dict(stages=2)),
        (ValueError, "max_stages must be at least 3, got 1", dict(max_stages=1)),
        (TypeError, "stages must be an int", dict(stages=5.0)),
        (TypeError, "stages must be an int", dict(stages=True)),
        (TypeError, "max_stages must be an int", dict(max_stages=None)),
        (ValueError, "spectral_radius must not be negative", dict(spectral_radius=-1.0)),
        (ValueError, "spectral_radius must not be negative", dict(spectral_radius=np.nan)),
        (
            ValueError,
            "spectral_radius must not be .* infinite, got inf",
            dict(spectral_radius=np.inf),
        ),
        (TypeError, "spectral_radius must be .*, got True", dict(spectral_radius=True)),
        (ValueError, "not be given together", dict(stages=5, spectral_radius=1.0)),
        (TypeError, "spectral_radius must be", dict(spectral_radius="large")),
    ],
)
@names
@pytest.mark.usefixtures("no_shape_hook")
def test_arguments_that_are_refused(name, error, match, kwargs):
    with pytest.raises(error, match=match):
        SOLVERS[name](**kwargs)


@pytest.mark.parametrize("radius", [-1.0, np.nan])
def test_a_radius_of_a_function_that_is_negative_or_nan_is_an_error(radius):
    solver = cfjax.RKL2(spectral_radius=lambda t, y, args: radius * args)
    with pytest.raises(RuntimeError, match="spectral_radius must not be negative"):
        cfjax.integrate(cfjax.LieTerm(stiff), solver, 0.0, 1.0, jnp.ones(2), 1.0, num_steps=2)
    with pytest.raises(RuntimeError, match="spectral_radius must not be negative"):
        solve(stiff, solver, 1.0, jnp.ones(2), 1.0)


A = np.random.default_rng(0).normal(size=(6, 6))
COLUMNS = np.linalg.qr(A[:, :2])[0]
UNIT = COLUMNS[:, 0]
INSTEAD = "LeftMatrix.*BorderedSkew"
REFUSED = {
    "LowRankSkew": (lambda t, y, args: cfjax.LowRankSkew(A @ y), COLUMNS, INSTEAD),
    "SphereRotation": (lambda t, y, args: cfjax.SphereRotation(A @ y), UNIT, INSTEAD),
    "Affine": (lambda t, y, args: cfjax.Affine(0 * y, np.ones(6), alpha=-1.0), UNIT, "ETD54"),
    "LinearAffine": (
        lambda t, y, args: cfjax.LinearAffine(-jnp.eye(6), 0 * y), UNIT, "ETD54",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
@names
@pytest.mark.usefixtures("no_shape_hook")
def test_fields_whose_sums_grow_are_refused(name, kind):
    field, y0, match = REFUSED[kind]
    for solver in (SOLVERS[name](), SOLVERS[name](5)):
        with pytest.raises(TypeError, match=rf"(?s){name}.*{kind}.*{match}"):
            jax.eval_shape(
                lambda y, s=solver: (
                    cfjax.integrate(
                        cfjax.LieTerm(field), s, 0.0, 1.0, y, num_steps=2, throw=False
                    ).ys
                ),
                jnp.asarray(y0),
            )


def test_what_they_do_take():
    """Rotations by SphereRotation in three dimensions, frames by BorderedSkew."""
    y0 = jnp.array([0.6, 0.0, 0.8])
    for field, y in [
        (lambda t, y, args: cfjax.SphereRotation(A[:3, :3] @ y), y0),
        (lambda t, y, args: cfjax.BorderedSkew(A @ y), jnp.asarray(COLUMNS)),
    ]:
        end = cfjax.integrate(cfjax.LieTerm(field), cfjax.RKL2(), 0.0, 0.1, y, num_steps=4).ys[-1]
        fine = cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0.0, 0.1, y, num_steps=50).ys[-1]
        np.testing.assert_allclose(end, fine, rtol=0, atol=3e-3)


def test_terms_that_a_path_drives_are_refused():
    path = diffrax.VirtualBrownianTree(0.0, 1.0, 1e-3, (), jax.random.key(0))
    noise = cfjax.LieControlTerm(lambda t, y, args, dw: y * dw, path)
    terms = diffrax.MultiTerm(cfjax.LieTerm(lambda t, y, args: -y), noise)
    with pytest.raises(TypeError, match=r"ordinary differential equations.*CF4"):
        cfjax.integrate(terms, cfjax.RKL2(5), 0.0, 1.0, jnp.ones(2), num_steps=2)


# Precision and memory


@pytest.mark.parametrize("stages", [5, None])
@names
def test_single_precision(name, stages):
    _, y0, _, t1, answer = damped_spin_problem()

    def field(t, y, args):
        up = jnp.array([0.0, 0.0, 30.0], np.float32)
        return cfjax.Rotation((up + jnp.float32(0.5) * jnp.cross(y, up)) / np.float32(1.25))

    y0 = jnp.asarray(y0, np.float32)
    y = cfjax.integrate(cfjax.LieTerm(field), SOLVERS[name](stages), 0.0, t1, y0, num_steps=400).ys[
        -1
    ]
    assert y.dtype == np.float32
    # The error of the methods, and of some 400 roundings.
    np.testing.assert_allclose(y, answer, rtol=0, atol=1e-4)


@names
def test_memory_does_not_depend_on_the_stages(name):
    """As the compiler plans it, in states: y, the first field, two elements, a point."""
    n = 100_000

    def field(t, y, args):
        # Not entry by entry, so the stages cannot be computed one entry after another.
        return jnp.cumsum(y) / n - y

    def used(solver):
        def end(y0):
            return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=10).ys

        compiled = jax.jit(end, donate_argnums=0).lower(jnp.zeros(n)).compile()
        return compiled.memory_analysis().temp_size_in_bytes / (8 * n)

    few, many, chosen = (
        used(SOLVERS[name](*args, **kwargs))
        for args, kwargs in [((9,), {}), ((41,), {}), ((), dict(spectral_radius=100.0))]
    )
    assert many < few + 0.1
    # RKL3: the element of a half, a point and a field in the middle, and where stages are chosen
    # the elements of all parts. The sums of sixteen entries each in the field take 2/15 of a state.
    assert few < (8 if name == "RKL3" else 5) + 0.2
    assert chosen < (10 if name == "RKL3" else 5) + 0.2
    # The vector of the power iteration, and what tells whether a step was stable.
    assert used(SOLVERS[name]()) < chosen + (3 if name == "RKL3" else 2) + 0.1
