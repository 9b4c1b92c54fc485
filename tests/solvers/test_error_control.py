"""Error control in every frame: norms, first steps, and what a pair costs."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.spatial.transform import Rotation as ScipyRotation

import cfjax
from cfjax.scenes import rigid_body, stiefel

TURN = jnp.asarray(ScipyRotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix())
INERTIA, Y0 = jnp.asarray(problems.INERTIA), jnp.asarray(problems.MOMENTUM)


def turned_body(t, y, args):
    """The driven body, seen from a turned frame."""
    field = problems.driven_body(t, TURN.T @ y, args)
    return cfjax.Rotation(TURN @ field.omega)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF3(), cfjax.CF4()], ids=["CF3", "CF4"])
def test_a_turned_copy_takes_the_same_steps(solver):
    @jax.jit
    def solve(turned, rtol):
        def field(t, y, args):
            plain, turned_ = problems.driven_body(t, y, args), turned_body(t, y, args)
            return cfjax.Rotation(jnp.where(turned, turned_.omega, plain.omega))

        y0 = jnp.where(turned, TURN @ Y0, Y0)
        controller = diffrax.PIDController(rtol=rtol, atol=jnp.asarray(1e-6))
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            solver,
            0.0,
            10.0,
            0.01,
            y0,
            INERTIA,
            stepsize_controller=controller,
            max_steps=10_000,
        )
        return sol.ys[-1], sol.stats["num_steps"]

    (y, plain), (turned, steps) = solve(False, 0.0), solve(True, 0.0)
    assert steps == plain
    np.testing.assert_allclose(turned, TURN @ y, rtol=0, atol=1e-10)
    # With a relative tolerance, entry by entry, it depends on the frame: the test can fail.
    assert solve(True, 1e-6)[1] != solve(False, 1e-6)[1]


def test_the_norm_of_a_product():
    norm = cfjax.ErrorNorm({"a": 2.0, "b": 0.5})
    y = {"a": jnp.asarray([3.0, 4.0]), "b": {"c": jnp.full((2, 2), 1.0), "d": jnp.asarray(3.0)}}
    # Means of squares 12.5 and 13 / 5, by scale 3.125 and 10.4.
    assert float(norm(y)) == pytest.approx(np.sqrt((12.5 / 4 + 13 / 5 / 0.25) / 2), rel=1e-15)
    assert float(norm({"a": jnp.asarray([3j, 4.0]), "b": jnp.zeros(1)})) == pytest.approx(1.25)
    single = cfjax.ErrorNorm(2.0)(jnp.ones(3, jnp.float32))
    assert single.dtype == jnp.float32 and float(single) == 0.5
    assert float(cfjax.ErrorNorm(2.0)(y["a"])) == pytest.approx(np.sqrt(12.5) / 2)


def test_a_part_of_small_scale_is_controlled_at_its_scale():
    """Two oscillations of equal frequency, one of them a million times smaller."""
    size = 1e-6

    def field(t, y, args):
        turn = lambda x: jnp.stack([x[1], -x[0]])  # noqa: E731
        return {"large": turn(y["large"]), "small": turn(y["small"]) * (1 + 2 * jnp.sin(9 * t))}

    y0 = {"large": jnp.asarray([1.0, 0.0]), "small": jnp.asarray([size, 0.0])}
    # The small one's angle is the integral of its speed.
    angle = 3 + 2 * (1 - np.cos(27.0)) / 9
    exact = size * np.array([np.cos(angle), -np.sin(angle)])
    errors = []
    for scales in ({"large": 1.0, "small": 1.0}, {"large": 1.0, "small": size}):
        controller = diffrax.PIDController(rtol=0.0, atol=1e-5, norm=cfjax.ErrorNorm(scales))
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            cfjax.CF43(),
            0.0,
            3.0,
            0.01,
            y0,
            stepsize_controller=controller,
            max_steps=10_000,
        )
        errors.append(np.linalg.norm(sol.ys["small"][-1] - exact) / size)
    assert errors[1] < 1e-4 < errors[0]


def test_mistaken_scales():
    with pytest.raises(ValueError, match=r"scales\['a'\] must be a scalar, got shape \(3,\)"):
        cfjax.ErrorNorm({"a": jnp.ones(3)})
    # An infinite scale would accept every step.
    for scale in (-1.0, np.inf):
        with pytest.raises(Exception, match="scales must be positive and finite"):
            cfjax.ErrorNorm(scale)
    for scale in (2j, jnp.asarray(1 + 0j), "1", True):
        with pytest.raises(TypeError, match=r"scales\['a'\] must be a real number, got"):
            cfjax.ErrorNorm({"a": scale, "b": 1.0})
    with pytest.raises(TypeError, match=r"scales must be a real number, got 2j"):
        cfjax.ErrorNorm(2j)
    with pytest.raises(ValueError):
        cfjax.ErrorNorm({"a": 1.0})((jnp.ones(3),))


# The first step


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_first_step_is_accepted_and_not_far_too_short(speed, direction):
    """It follows the time scale of the problem over eight orders of magnitude."""

    def field(t, y, args):
        return cfjax.Rotation(-speed * y / args)

    term, solver, t1 = cfjax.LieTerm(field), cfjax.CF4(), direction * 10 / speed
    dt0 = cfjax.starting_step(term, solver, 0.0, t1, Y0, INERTIA, atol=1e-8)
    assert np.sign(dt0) == direction
    solution = diffrax.diffeqsolve(
        term,
        solver,
        0.0,
        t1,
        dt0,
        Y0,
        INERTIA,
        max_steps=10_000,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-8),
        saveat=diffrax.SaveAt(steps=True),
    )
    steps = np.abs(np.diff(solution.ts[np.isfinite(solution.ts)], prepend=0))
    assert steps[0] == pytest.approx(abs(float(dt0)), rel=1e-12)
    # Hairer, Norsett & Wanner aim at an error 100 times smaller than is allowed.
    assert 1 / 30 < abs(float(dt0)) / np.median(steps) < 2


BLOCH = jnp.asarray([[-0.1, 1.0, 0.0], [-1.0, -0.1, 0.5], [0.0, -0.5, -0.05]])
# Each has the unit of time as its own, and starts at zero, near zero or at rest.
FROM_NOTHING = {
    "translation": (lambda t, y: jnp.cos(t) * jnp.ones(1), jnp.zeros(1)),
    "near zero": (lambda t, y: jnp.cos(t) * jnp.ones(1), jnp.full(1, 1e-12)),
    "at rest": (lambda t, y: jnp.sin(t) * jnp.ones(1), jnp.ones(1)),
    "at zero and at rest": (lambda t, y: jnp.sin(t) * jnp.ones(1), jnp.zeros(1)),
    "LinearAffine": (
        lambda t, y: cfjax.LinearAffine(BLOCH, jnp.asarray([0.0, jnp.sin(1.0), 1.0])),
        jnp.zeros(3),
    ),
    "Affine": (lambda t, y: cfjax.Affine(jnp.cos(y), -jnp.ones(3)), jnp.zeros(3)),
    "Congruence": (
        lambda t, y: cfjax.Congruence(BLOCH, jnp.eye(3)),
        jnp.zeros((3, 3)),
    ),
    "PlanarMotion": (
        lambda t, y: cfjax.PlanarMotion(omega=jnp.cos(t), v=jnp.asarray([1.0, 0.0]), frame="fixed"),
        jnp.zeros(2),
    ),
    "a pendulum at rest": (
        lambda t, y: {"angle": y["rate"], "rate": -jnp.sin(y["angle"])},
        {"angle": jnp.asarray(1.0), "rate": jnp.asarray(0.0)},
    ),
}


@pytest.mark.parametrize("interval", [1.0, -20 * np.pi, 1e3])
@pytest.mark.parametrize("name", FROM_NOTHING)
def test_a_first_step_from_a_state_at_zero_or_at_rest(name, interval):
    """Such a state says nothing of how fast it changes."""
    field, y0 = FROM_NOTHING[name]
    term = cfjax.LieTerm(lambda t, y, args: field(t, y))
    step = cfjax.starting_step(term, cfjax.CF4(), 0.0, interval, y0, atol=1e-6)
    assert np.sign(step) == np.sign(interval)
    # In its unit of time a method of order 4 makes an error of h^5, which is to be 1e-8: h = 0.025.
    # The way to it is a guess, which may be off by 30: a controller makes up for that in two steps.
    assert 0.025 / 30 < abs(float(step)) < 0.025 * 30


@pytest.mark.parametrize("name", ["translation", "at rest", "LinearAffine"])
def test_a_first_step_does_not_depend_on_units(name):
    field, y0 = FROM_NOTHING[name]

    def step(time, length):
        def in_units(t, y, args):
            part = cfjax.tangent(field(t / time, y / length), y / length)
            return part * (length / time)

        term = cfjax.LieTerm(in_units)
        found = cfjax.starting_step(
            term, cfjax.CF4(), 0.0, 60.0 * time, y0 * length, atol=1e-6 * length
        )
        return float(found) / time

    # Rounding of a difference of velocities: 1e-16 of a velocity over one of 1e-5.
    assert step(1e4, 1.0) == pytest.approx(step(1.0, 1.0), rel=1e-10)
    assert step(1e-4, 1e-3) == pytest.approx(step(1.0, 1.0), rel=1e-10)


def test_a_first_step_of_an_endless_solve():
    """As one that ends with an event."""
    for y0 in (jnp.zeros(1), jnp.ones(1)):
        term = cfjax.LieTerm(lambda t, y, args: jnp.cos(y))
        step = cfjax.starting_step(term, cfjax.CF4(), 0.0, jnp.inf, y0, atol=1e-6)
        # From zero the only scale is atol: the cap is the time in which the state moves by it.
        assert 0.9e-6 < float(step) < 0.1


@pytest.mark.parametrize("atol", [0.0, -1e-6, np.nan, np.inf, jnp.asarray(-1.0)])
def test_a_first_step_needs_a_positive_tolerance(atol):
    term = cfjax.LieTerm(problems.rigid_body)
    with pytest.raises(Exception, match="atol must be positive"):
        cfjax.starting_step(term, cfjax.CF4(), 0.0, 1.0, Y0, INERTIA, atol=atol)


@pytest.mark.parametrize(
    ("t0", "t1", "rate", "message"),
    [
        (-np.inf, 0.0, 1.0, "t0 must be finite"),
        (np.nan, 1.0, 1.0, "t0 must be finite"),
        (0.0, np.nan, 1.0, "t1 must be a number, got NaN"),
        (0.0, np.inf, 0.0, "t1 must be finite, as y0 is at rest"),
    ],
)
def test_a_first_step_is_a_finite_number(t0, t1, rate, message):
    term = cfjax.LieTerm(lambda t, y, args: rate * y)
    with pytest.raises(Exception, match=message):
        cfjax.starting_step(term, cfjax.CF4(), t0, t1, jnp.ones(1), atol=1e-6)


def test_a_first_step_needs_a_solver_and_real_scalars(no_shape_hook):
    term = cfjax.LieTerm(problems.rigid_body)
    for solver in (cfjax.CF4, None, 4):
        with pytest.raises(TypeError, match=r"solver must be a diffrax solver.*got"):
            cfjax.starting_step(term, solver, 0.0, 1.0, Y0, INERTIA, atol=1e-6)
    for name in ("t0", "t1", "atol"):
        for value in (None, 1j, jnp.ones(3), "1"):
            options = {"t0": 0.0, "t1": 1.0, "atol": 1e-6, name: value}
            with pytest.raises(TypeError, match=f"{name} must be a real scalar, got"):
                cfjax.starting_step(term, cfjax.CF4(), y0=Y0, args=INERTIA, **options)


def test_a_first_step_where_nothing_moves_and_in_other_precision():
    def field(t, y, args):
        return cfjax.Rotation(0 * y)

    term = cfjax.LieTerm(field)
    step = cfjax.starting_step(term, cfjax.CF4(), 0.0, 1.0, Y0, atol=1e-6)
    assert 0 < float(step) <= 1
    assert float(cfjax.starting_step(term, cfjax.CF4(), 0.0, 0.0, Y0, atol=1e-6)) == 0
    single = cfjax.starting_step(
        cfjax.LieTerm(problems.rigid_body),
        cfjax.CF4(),
        0.0,
        1.0,
        jnp.ones(3, jnp.float32),
        jnp.asarray(INERTIA, jnp.float32),
        atol=1e-3,
    )
    assert single.dtype == jnp.float32 and 0 < single <= 1


def test_a_first_step_needs_a_term_of_an_ordinary_equation():
    term = diffrax.ControlTerm(lambda t, y, args: y, lambda t0, t1: t1 - t0)
    with pytest.raises(TypeError, match=r"term must be a cfjax\.LieTerm or a diffrax\.ODETerm"):
        cfjax.starting_step(term, cfjax.CF4(), 0.0, 1.0, Y0, atol=1e-3)


# What a pair costs, against step doubling


def rigid_body_problem():
    answer = problems.reference(
        lambda t, y: np.cross(y, y / rigid_body.inertia), 0.0, 10.0, np.asarray(rigid_body.y0)
    )
    return rigid_body.field, 10.0, rigid_body.y0, rigid_body.inertia, answer


def stiefel_problem():
    n, p = 20, 2
    answer = stiefel.reference("first", n, p)
    return stiefel.first, 1.0, stiefel.y0(n, p), stiefel.diagonals(n, p), answer


@pytest.mark.slow
@pytest.mark.parametrize(
    "problem, estimate",
    [
        (rigid_body_problem, "group"),
        (rigid_body_problem, "algebra"),
        (stiefel_problem, "algebra"),
    ],
)
def test_a_pair_needs_fewer_flows_than_step_doubling(problem, estimate):
    """Flows at equal error, read off on logarithmic scales, and the error for each tolerance.

    Step doubling goes on from two steps of half the length, with a third for the estimate. So two
    steps of the pair should need two thirds of its flows, or 0.8 with a flow for the estimate.
    """
    field, t1, y0, args, answer = problem()
    y0, args = jnp.asarray(y0), jax.tree.map(jnp.asarray, args)
    tolerances = np.array([1e-4, 1e-6, 1e-8, 1e-10])

    def curve(solver, flows_per_step):
        flows, errors = [], []
        for atol in tolerances:
            sol = diffrax.diffeqsolve(
                cfjax.LieTerm(field),
                solver,
                0.0,
                t1,
                0.01,
                y0,
                args,
                stepsize_controller=diffrax.PIDController(rtol=0.0, atol=jnp.asarray(atol)),
                max_steps=None,
            )
            flows.append(flows_per_step * int(sol.stats["num_steps"]))
            errors.append(np.linalg.norm(sol.ys[-1] - answer))
        return np.log(flows), np.log(errors)

    tableau = cfjax.CF4().tableau
    embedded_flows = tableau.num_embedded_flows if estimate == "group" else 0
    pair = curve(cfjax.CF4(estimate=estimate), tableau.num_flows + embedded_flows)
    plain = cfjax.CommutatorFree(cfjax.Tableau(tableau.alpha, tableau.beta))
    doubling = curve(cfjax.Richardson(plain), 3 * tableau.num_flows)
    # Where both curves have errors to compare.
    low = max(c[1].min() for c in (pair, doubling))
    high = min(c[1].max() for c in (pair, doubling))
    at = np.linspace(low, high, 9)
    flows = [np.interp(at, c[1][::-1], c[0][::-1]) for c in (pair, doubling)]
    ratio = np.exp(flows[0] - flows[1])
    expected = 2 * (tableau.num_flows + embedded_flows) / (3 * tableau.num_flows)
    # Where the error is large the two have other steps.
    assert ratio.max() <= 1.05 * expected, ratio
    error_per_tolerance = pair[1] - np.log(tolerances)
    assert np.ptp(error_per_tolerance) <= np.log(10)
