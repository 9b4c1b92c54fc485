"""Steps of Munthe-Kaas methods that turn by a full turn or more, where dexp has no inverse."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

Q = jnp.asarray([1.0, 0.0, 0.0, 0.0])
POINT = jnp.asarray([0.6, 0.0, 0.8])


def tumbling(t, q, args):
    """About 6 radians in a unit of time, about an axis that follows the state."""
    omega = jnp.asarray([6.0, 0.0, 0.0]) + args * q[1:]
    return cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")


def reference(t1, args):
    def rate(t, q):
        w, v, omega = q[0], q[1:], np.array([6.0, 0.0, 0.0]) + args * q[1:]
        return np.array([-v @ omega, *(w * omega + np.cross(v, omega))]) / 2

    return problems.reference(rate, 0.0, t1, np.asarray(Q))


def test_a_step_of_three_turns_has_no_value_and_no_derivative_that_counts():
    """As where it is rejected. The derivative of a short step is that of its values."""
    times = problems.arrays((0.0, 3.0, 0.3))

    def end(args, t1):
        y1, error, *_ = problems.first_step(
            cfjax.RKMK5(), cfjax.LieTerm(tumbling), times[0], t1, Q, args
        )
        return jnp.where(jnp.isfinite(error).all(), y1, Q)[1], error

    slope = jax.jit(jax.value_and_grad(end, has_aux=True), compiler_options=problems.QUICK)
    args = jnp.asarray(0.3)
    (value, error), found = slope(args, times[1])
    assert not np.isfinite(error).any()
    assert value == found == 0
    found = slope(args, times[2])[1]
    expected = problems.central_difference(lambda x: slope(x, times[2])[0][0], args, 1.0, 1e-3)
    # 1e-12 over 30 times a fifth derivative, and 1e-16 / 1e-3 of rounding.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("estimate", ["algebra", "group"])
def test_a_controlled_step_of_a_full_turn_is_taken_again(estimate):
    def solve(args):
        # Three turns in the first step.
        sol = diffrax.diffeqsolve(
            *(cfjax.LieTerm(tumbling), cfjax.RKMK5(estimate=estimate), 0.0, 4.0, 3.0, Q, args),
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        )
        return sol.ys[-1, 1], sol.stats["num_rejected_steps"]

    (end, num_rejected), slope = jax.jit(jax.value_and_grad(solve, has_aux=True))(0.3)
    assert num_rejected > 0
    # Each of 60 steps may be off by the tolerance.
    np.testing.assert_allclose(end, reference(4.0, 0.3)[1], rtol=0, atol=60e-8)
    # What a rejected step is made of has no derivative that counts.
    ends = [reference(4.0, 0.3 + h)[1] for h in (1e-4, -1e-4)]
    # The difference quotient is off by 1e-8, and the solve as its values are, times a time of 4.
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=0, atol=4 * 60e-8)


FIELDS = {
    "QuaternionRotation": (lambda w: cfjax.QuaternionRotation(w, frame="fixed", layout="wxyz"), Q),
    # Whatever the velocity is.
    "RigidMotion": (
        lambda w: cfjax.RigidMotion(omega=w, v=1e3 * jnp.ones(3), frame="fixed"),
        jnp.eye(4),
    ),
    "PlanarMotion": (
        lambda w: cfjax.PlanarMotion(omega=w[2], v=1e3 * jnp.ones(2), frame="body"),
        jnp.eye(3),
    ),
    "a lattice": (
        lambda w: cfjax.Rotation(jnp.stack([w, 0 * w])),
        jnp.stack([POINT, jnp.eye(3)[0]]),
    ),
    "array": (lambda w: jnp.ones(2), jnp.zeros(2)),
}


def test_the_bound_of_dexpinv_in_closed_form(subtests):
    """Equal steps of a constant field: right below 2 pi, an error from there on, of any part."""
    axis = jnp.asarray([0.0, 0.0, 1.0])
    term = cfjax.LieTerm(
        lambda t, y, angles: {x: make(angles[x] * axis) for x, (make, _) in FIELDS.items()}
    )
    y0 = {name: start for name, (_, start) in FIELDS.items()}

    # The last stage of Heun's method leads to the end of the step.
    def solve(term, y0, angles, throw=False):
        solver = cfjax.RKMK(diffrax.Heun.tableau)
        return cfjax.integrate(term, solver, 0.0, 1.0, y0, angles, num_steps=1, throw=throw)

    below, above = (jnp.asarray(2 * np.pi * (1 + x)) for x in (-1e-12, 1e-12))
    angles = dict.fromkeys(FIELDS, below)
    all_below = solve(term, y0, angles)
    assert all_below.result == diffrax.RESULTS.successful
    expected = jax.jit(lambda: cfjax.flow(term.field(0.0, y0, angles), y0))()
    for name in FIELDS:
        with subtests.test(name=name):
            size = np.abs(expected[name]).max()
            # Roundings of coefficients of up to 7, relative to velocities of 1e3.
            atol = 1e-13 * max(1e3, size)
            np.testing.assert_allclose(all_below.ys[name][-1], expected[name], rtol=0, atol=atol)
            if name != "array":
                assert solve(term, y0, angles | {name: above}).result == diffrax.RESULTS.nonfinite
    with pytest.raises(eqx.EquinoxRuntimeError, match="turn by less than 2 pi"):
        alone = cfjax.LieTerm(lambda t, y, angle: cfjax.Rotation(angle * axis))
        solve(alone, POINT, above, throw=True)


def test_a_full_turn_in_rolled_stages():
    """A stage beyond the bound is found where the stages are one loop, too."""
    for t1, result in [(2.2, diffrax.RESULTS.nonfinite), (2.0, diffrax.RESULTS.successful)]:
        sol = cfjax.integrate(
            *(cfjax.LieTerm(tumbling), cfjax.RKMK5(unroll=False), 0.0, t1, Q, 0.3),
            num_steps=2,
            throw=False,
        )
        assert sol.result == result


def test_output_after_a_full_turn_in_a_stage_for_output_alone_is_nan():
    solver = cfjax.RKMK8(unroll=False)
    # The stages after it start with this turn.
    time = solver._extension.times[-2]
    assert 0 < time < 1
    assert time not in solver.c

    def field(t, y, time):
        speed = jnp.where(jnp.abs(t - time) < 1e-9, 1e3, 1.0)
        return cfjax.Rotation(speed * jnp.asarray([0.6, 0.0, 0.8]))

    @functools.partial(jax.jit, compiler_options=problems.QUICK)
    def output(time):
        options = {"saveat": diffrax.SaveAt(ts=jnp.asarray([0.3, 0.6]))}
        term, y0 = cfjax.LieTerm(field), jnp.eye(3)
        return diffrax.diffeqsolve(term, solver, 0.0, 1.0, 1.0, y0, time, **options).ys

    assert np.isfinite(output(-1.0)).all()
    assert np.isnan(output(time)).all()
