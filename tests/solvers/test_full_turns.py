"""Steps of Munthe-Kaas methods that turn by a full turn or more, where dexp has no inverse."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax

Q = jnp.asarray([1.0, 0.0, 0.0, 0.0])


def tumbling(t, q, args):
    """About 6 radians in a unit of time, about an axis that follows the state."""
    omega = jnp.asarray([6.0, 0.0, 0.0]) + args * q[1:]
    return cfjax.QuaternionRotation(omega, frame="body", layout="wxyz")


def reference(t1, args):
    # 4e-14 by halving the steps, of a method that takes no inverse of dexp.
    sol = cfjax.integrate(cfjax.LieTerm(tumbling), cfjax.CF54(), 0.0, t1, Q, args, num_steps=20_000)
    return sol.ys[-1]


@pytest.mark.parametrize("estimate", ["algebra", pytest.param("group", marks=pytest.mark.slow)])
def test_a_controlled_step_of_a_full_turn_is_taken_again(estimate):
    def solve(args):
        return diffrax.diffeqsolve(
            cfjax.LieTerm(tumbling),
            cfjax.RKMK5(estimate=estimate),
            t0=0.0,
            t1=4.0,
            # Three turns in the first step.
            dt0=3.0,
            y0=Q,
            args=args,
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
        )

    sol = solve(0.3)
    assert sol.stats["num_rejected_steps"] > 0
    # Each of 60 steps may be off by the tolerance.
    np.testing.assert_allclose(sol.ys[-1], reference(4.0, 0.3), rtol=0, atol=60e-8)
    # What a rejected step is made of has no derivative that counts.
    slope = jax.grad(lambda args: solve(args).ys[-1, 1])(0.3)
    ends = [reference(4.0, 0.3 + h)[1] for h in (1e-4, -1e-4)]
    # The difference quotient is off by 1e-8, and the solve as its values are, times a time of 4.
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=0, atol=4 * 60e-8)


FIELDS = {
    "Rotation": (lambda w: cfjax.Rotation(w), jnp.asarray([0.6, 0.0, 0.8])),
    "QuaternionRotation": (
        lambda w: cfjax.QuaternionRotation(w, frame="fixed", layout="wxyz"),
        Q,
    ),
    "RigidMotion": (
        # Whatever the velocity is.
        lambda w: cfjax.RigidMotion(omega=w, v=1e3 * jnp.ones(3), frame="fixed"),
        jnp.eye(4),
    ),
    "PlanarMotion": (
        lambda w: cfjax.PlanarMotion(omega=w[2], v=1e3 * jnp.ones(2), frame="body"),
        jnp.eye(3),
    ),
    "a lattice": (
        lambda w: cfjax.Rotation(jnp.stack([w, 0 * w])),
        jnp.asarray([[0.6, 0.0, 0.8], [1.0, 0.0, 0.0]]),
    ),
    "a product": (
        lambda w: {"x": cfjax.Rotation(w), "v": jnp.ones(2)},
        {"x": jnp.asarray([0.6, 0.0, 0.8]), "v": jnp.zeros(2)},
    ),
}


@pytest.mark.representatives(3)
@pytest.mark.parametrize("name", FIELDS)
def test_the_bound_of_dexpinv_in_closed_form(name):
    """Equal steps of a constant field: right below 2 pi, an error from there on."""
    make, y0 = FIELDS[name]
    term = cfjax.LieTerm(lambda t, y, angle: make(angle * jnp.asarray([0.0, 0.0, 1.0])))

    # The last stages of Tsitouras' method lead to the end of the step.
    @eqx.filter_jit
    def solve(angle):
        return cfjax.integrate(term, cfjax.RKMK5(), 0.0, 1.0, y0, angle, num_steps=1, throw=False)

    below, above = 2 * np.pi * (1 - 1e-12), 2 * np.pi * (1 + 1e-12)
    found = solve(below)
    assert found.result == diffrax.RESULTS.successful
    expected = cfjax.flow(make(below * jnp.asarray([0.0, 0.0, 1.0])), y0)
    size = max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(expected))
    for a, b in zip(jax.tree.leaves(found.ys), jax.tree.leaves(expected), strict=True):
        # Roundings of coefficients of up to 7, relative to velocities of 1e3.
        np.testing.assert_allclose(a[-1], b, rtol=0, atol=1e-13 * max(1e3, size))
    assert solve(above).result == diffrax.RESULTS.nonfinite
    with pytest.raises(eqx.EquinoxRuntimeError, match="turn by less than 2 pi"):
        cfjax.integrate(term, cfjax.RKMK5(), 0.0, 1.0, y0, above, num_steps=1)


def test_a_full_turn_in_rolled_stages():
    """A stage beyond the bound is found where the stages are one loop, too."""
    term = cfjax.LieTerm(tumbling)
    for unroll in (False, True):
        sol = cfjax.integrate(
            term, cfjax.RKMK5(unroll=unroll), 0.0, 2.2, Q, 0.3, num_steps=2, throw=False
        )
        assert sol.result == diffrax.RESULTS.nonfinite
        sol = cfjax.integrate(
            term, cfjax.RKMK5(unroll=unroll), 0.0, 2.0, Q, 0.3, num_steps=2, throw=False
        )
        assert sol.result == diffrax.RESULTS.successful


def test_output_after_a_full_turn_in_a_stage_for_output_alone_is_nan():
    solver = cfjax.RKMK8()
    # The stages after it start with this turn.
    time = solver._extension.times[-2]
    assert 0 < time < 1
    assert time not in solver.c

    def field(t, y, time):
        speed = jnp.where(jnp.abs(t - time) < 1e-9, 1e3, 1.0)
        return cfjax.Rotation(speed * jnp.asarray([0.6, 0.0, 0.8]))

    @jax.jit
    def output(time):
        options = {"saveat": diffrax.SaveAt(ts=jnp.asarray([0.3, 0.6]))}
        term, y0 = cfjax.LieTerm(field), jnp.eye(3)
        return diffrax.diffeqsolve(term, solver, 0.0, 1.0, 1.0, y0, time, **options).ys

    assert np.isfinite(output(-1.0)).all()
    assert np.isnan(output(time)).all()
