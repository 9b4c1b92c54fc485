"""Error control in every frame: norms and first steps."""

import itertools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.spatial.transform import Rotation as ScipyRotation

import cfjax

TURN = jnp.asarray(ScipyRotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix())
INERTIA, Y0 = jnp.asarray(problems.INERTIA), jnp.asarray(problems.MOMENTUM)


def turned_body(t, y, args):
    """The driven body, seen from a turned frame."""
    field = problems.driven_body(t, TURN.T @ y, args)
    return cfjax.Rotation(TURN @ field.omega)


def test_a_turned_copy_takes_the_same_steps():
    @jax.jit
    def solve(turned, rtol):
        def field(t, y, args):
            plain, turned_ = problems.driven_body(t, y, args), turned_body(t, y, args)
            return cfjax.Rotation(jnp.where(turned, turned_.omega, plain.omega))

        y0 = jnp.where(turned, TURN @ Y0, Y0)
        controller = diffrax.PIDController(rtol=rtol, atol=jnp.asarray(1e-6))
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            cfjax.CF2(),
            *(0.0, 10.0, 0.01, y0, INERTIA),
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
    y = {"a": jnp.asarray([3.0, 4.0]), "b": {"c": jnp.full((2, 2), 1.0), "d": jnp.asarray(3.0)}}

    @jax.jit
    def norms(y):
        norm, plain = cfjax.ErrorNorm({"a": 2.0, "b": 0.5}), cfjax.ErrorNorm(2.0)
        other = {"a": jnp.asarray([3j, 4.0]), "b": jnp.zeros(1)}
        return norm(y), norm(other), plain(y["a"]), plain(jnp.ones(3, jnp.float32))

    *found, single = norms(y)
    # Means of squares 12.5 and 13 / 5, by scale 3.125 and 10.4.
    expected = [np.sqrt((12.5 / 4 + 13 / 5 / 0.25) / 2), 1.25, np.sqrt(12.5) / 2]
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    assert single.dtype == jnp.float32 and float(single) == 0.5


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

    @jax.jit
    def end(scale):
        norm = cfjax.ErrorNorm({"large": 1.0, "small": scale})
        return diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            cfjax.CF43(),
            *(0.0, 3.0, 0.01, y0),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-5, norm=norm),
            max_steps=10_000,
        ).ys["small"][-1]

    errors = [np.linalg.norm(end(scale) - exact) / size for scale in (1.0, size)]
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
def test_a_first_step_is_accepted_and_not_far_too_short():
    """It follows the time scale of the problem over eight orders of magnitude."""

    @jax.jit
    def solve(speed, direction):
        term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(-speed * y / args))
        solver, t1 = cfjax.CF4(), direction * 10 / speed
        dt0 = cfjax.starting_step(term, solver, 0.0, t1, Y0, INERTIA, atol=1e-8)
        ts = diffrax.diffeqsolve(
            term,
            solver,
            *(0.0, t1, dt0, Y0, INERTIA),
            max_steps=10_000,
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-8),
            saveat=diffrax.SaveAt(steps=True),
        ).ts
        return dt0, ts

    for speed, direction in itertools.product((1e-4, 1.0, 1e4), (1.0, -1.0)):
        dt0, ts = solve(speed, direction)
        assert np.sign(dt0) == direction
        steps = np.abs(np.diff(ts[np.isfinite(ts)], prepend=0))
        assert steps[0] == pytest.approx(abs(float(dt0)), rel=1e-12)
        # Hairer, Norsett & Wanner aim at an error 100 times smaller than is allowed.
        assert 1 / 30 < abs(float(dt0)) / np.median(steps) < 2


def step_of(field):
    """As a program of the interval, the start, the parameters and the tolerance."""

    @eqx.filter_jit
    def step(t0, t1, y0, args=None, atol=1e-6):
        return cfjax.starting_step(cfjax.LieTerm(field), cfjax.CF4(), t0, t1, y0, args, atol=atol)

    return step


def translation(t, y, phase):
    return jnp.cos(t + phase) * jnp.ones(1)


def motion(t, y, v):
    return cfjax.PlanarMotion(omega=jnp.cos(t), v=v, frame="fixed")


def pendulum(t, y, args):
    return {"angle": y["rate"], "rate": -jnp.sin(y["angle"])}


# Each has the unit of time as its own, and starts at zero, near zero or at rest, with parameters.
FROM_ZERO, AT_REST = (jnp.zeros(1), 0.0), (jnp.ones(1), -np.pi / 2)
NEAR_ZERO, AT_ZERO_AND_AT_REST = (jnp.full(1, 1e-12), 0.0), (jnp.zeros(1), -np.pi / 2)
FROM_NOTHING: dict[Any, list[Any]] = {
    translation: [FROM_ZERO, NEAR_ZERO, AT_REST, AT_ZERO_AND_AT_REST],
    motion: [(jnp.zeros(2), jnp.asarray([1.0, 0.0]))],
    pendulum: [({"angle": jnp.asarray(1.0), "rate": jnp.asarray(0.0)}, None)],
}


@pytest.mark.parametrize("field", FROM_NOTHING)
def test_a_first_step_from_a_state_at_zero_or_at_rest(field):
    """Such a state says nothing of how fast it changes."""
    step_from = step_of(field)
    starts = FROM_NOTHING[field]
    for (y0, args), interval in itertools.product(starts, (1.0, -20 * np.pi, 1e3)):
        step = step_from(0.0, jnp.asarray(interval), y0, args)
        assert np.sign(step) == np.sign(interval)
        # In its unit of time a method of order 4 makes an error of h^5, which is to be 1e-8:
        # h = 0.025. The way to it is a guess, which may be off by 30: a controller makes up for
        # that in two steps.
        assert 0.025 / 30 < abs(float(step)) < 0.025 * 30


def test_a_first_step_does_not_depend_on_units():
    """From zero, and from rest."""

    def in_units(t, y, args):
        time, length, phase = args
        return translation(t / time, y / length, phase) * (length / time)

    step_from = step_of(in_units)

    def step(y0, phase, time, length):
        units = jnp.asarray([time, length, phase])
        end, tolerance = 60 * units[0], 1e-6 * units[1]
        return float(step_from(0.0, end, y0 * length, units, tolerance)) / time

    for y0, phase in (FROM_ZERO, AT_REST):
        # Rounding of a difference of velocities: 1e-16 of a velocity over one of 1e-5.
        for units in ((1e4, 1.0), (1e-4, 1e-3)):
            expected = step(y0, phase, 1.0, 1.0)
            assert step(y0, phase, *units) == pytest.approx(expected, rel=1e-10)


def test_a_first_step_of_an_endless_solve():
    """As one that ends with an event."""
    step_from = step_of(lambda t, y, args: jnp.cos(y))
    for y0 in (jnp.zeros(1), jnp.ones(1)):
        # From zero the only scale is atol: the cap is the time in which the state moves by it.
        assert 0.9e-6 < step_from(0.0, jnp.inf, y0) < 0.1


def test_a_first_step_is_a_finite_number_and_needs_a_positive_tolerance(subtests):
    step_from = step_of(lambda t, y, rate: rate * y)
    tolerances = 0.0, -1e-6, np.nan, np.inf
    cases = [(0.0, 1.0, 1.0, atol, "atol must be positive") for atol in tolerances] + [
        (-np.inf, 0.0, 1.0, 1e-6, "t0 must be finite"),
        (np.nan, 1.0, 1.0, 1e-6, "t0 must be finite"),
        (0.0, np.nan, 1.0, 1e-6, "t1 must be a number, got NaN"),
        (0.0, np.inf, 0.0, 1e-6, "t1 must be finite, as y0 is at rest"),
    ]
    for t0, t1, rate, atol, message in cases:
        case = str((t0, t1, rate, atol))
        t0, t1, rate, atol = map(jnp.asarray, (t0, t1, rate, atol))
        with subtests.test(case=case), pytest.raises(Exception, match=message):
            step_from(t0, t1, jnp.ones(1), rate, atol)


def test_a_first_step_needs_a_term_of_an_equation_a_solver_and_real_scalars(no_shape_hook):
    driven = diffrax.ControlTerm(lambda t, y, args: y, lambda t0, t1: t1 - t0)
    with pytest.raises(TypeError, match=r"term must be a cfjax\.LieTerm or a diffrax\.ODETerm"):
        cfjax.starting_step(driven, cfjax.CF4(), 0.0, 1.0, Y0, atol=1e-3)
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
    step_from = step_of(lambda t, y, rate: cfjax.Rotation(rate * y))
    assert 0 < float(step_from(0.0, jnp.asarray(1.0), Y0, 0 * Y0)) <= 1
    assert float(step_from(0.0, jnp.asarray(0.0), Y0, 0 * Y0)) == 0
    single = step_from(0.0, 1.0, jnp.ones(3, jnp.float32), jnp.float32([1, 2, 3]), 1e-3)
    assert single.dtype == jnp.float32 and 0 < single <= 1
