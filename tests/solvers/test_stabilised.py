"""Stabilised methods: their polynomials, orders, stages, control and exact answers."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems
import pytest
from solver_table import solvers

import cfjax

SOLVERS = {name: getattr(cfjax, name) for name in solvers("stabilised")}
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


def exact_growth(name, s, z):
    """What a step with s stages multiplies the state by, where `h lambda` is z."""
    l = INDEX[name]  # noqa: E741
    with mpmath.workdps(50):
        z = mpmath.mpmathify(z)
        value = polynomial(s, l, z)
        if name == "RKL3":
            m = stages_for(reach(s, l) / 2, l)
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
    size = np.geomspace(0.1, 1000, 400)
    found = growth(SOLVERS[name](spectral_radius=radius_of_args), -size, size)
    assert (np.abs(found) < 1).all()
    # Below one also away from the origin: what a step leaves of stiff parts.
    assert np.abs(found[size > 4]).max() < {"RKL2": 0.75, "RKG2": 0.5, "RKL3": 0.95}[name]
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
    rates k (k + 1). In two dimensions, along both axes.
    """
    k = np.arange(1, n) * (n - np.arange(1, n))

    def along(y, axis):
        flux = jnp.asarray(k, float)[:, None] * jnp.diff(jnp.moveaxis(y, axis, 0), axis=0)
        return jnp.moveaxis(jnp.diff(jnp.pad(flux, ((1, 1), (0, 0))), axis=0), 0, axis)

    return lambda t, y, args: along(y, 0) + along(y, 1)


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


def solve(field, solver, t1, y0, args=None, tolerance=1e-5, **options):
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
        return np.abs(np.asarray(y).conj().T @ y - np.eye(len(y))).max()
    return 0.0


@pytest.mark.parametrize("name", ["RKL2", "RKL3", pytest.param("RKG2", marks=pytest.mark.slow)])
@pytest.mark.parametrize("problem", PROBLEMS)
def test_error_over_tolerance_by_exact_answers(problem, name):
    field, y0, args, t1, answer = PROBLEMS[problem]()
    low, high = (0.01, 20) if name == "RKL3" else (1e-3, 100)

    @jax.jit
    def run(tolerance):
        sol = solve(field, SOLVERS[name](), t1, jnp.asarray(y0), args, tolerance)
        return sol.ys[-1], sol.stats["num_steps"]

    errors = []
    for tolerance in (1e-3, 1e-4, 1e-5):
        y, steps = run(jnp.asarray(tolerance))
        errors.append(np.abs(np.asarray(y) - answer).max())
        print(problem, name, tolerance, errors[-1] / tolerance, steps)
        assert low < errors[-1] / tolerance < high
        # As rounding adds up over the steps.
        assert distance_from_manifold(problem, y) < 1e-14 * (10 + steps)
    assert errors[0] > errors[1] > errors[2]
