"""Compensated sums over the steps: what a million of them keep, and steps too small to see."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

Y0 = jnp.asarray(problems.MOMENTUM)
ARGS = jnp.asarray(problems.INERTIA)

# Long runs keep what they should. The sums over the steps are compensated, whatever the shape of
# the state. What is left are the flows' own roundings: a unit times the angle of a step, which adds
# up as a random walk where the field changes. Where it does not, the rounding of the coefficients
# is the same in every step, and adds up in proportion to their number.


def test_the_length_of_the_momentum_over_a_million_steps():
    sol = cfjax.integrate(
        cfjax.LieTerm(problems.rigid_body),
        cfjax.CF2(),
        0.0,
        1e5,
        Y0,
        ARGS,
        num_steps=1_000_000,
        save_every=1000,
    )
    length = np.linalg.norm(np.asarray(sol.ys), axis=1)
    # 2^-53 * 0.1 * 10^3 = 1.1e-14. Without compensation: 5e-14.
    assert np.abs(length - np.linalg.norm(problems.MOMENTUM)).max() < 1.2e-14


def doubled(a):
    """Two copies of a matrix, as one of twice the size."""
    return np.kron(np.eye(2), a)


AXIS = np.array([0.36, 0.48, 0.8])
FRAME = np.linalg.qr(np.random.default_rng(4).standard_normal((3, 3)))[0]
# The angle of a step is h |omega|, h = 0.1: one of half a step, twice a step, for CF4. A rotation's
# coefficients round by a unit times the fourth power of the angle, over 3: 10^6 * 2^-53 * 2 *
# 0.05^4 / 3 = 5e-16, below the random walk of 10^3 * 2^-53 * 0.1 = 1.1e-14. A matrix exponential's
# entries by a unit times its square: 10^6 * 2^-53 * 2 * 0.05^2 = 5.6e-13.
STEADY = {
    "(3,)": (cfjax.Rotation(AXIS), FRAME[0], 3e-14),
    "left (3, 3)": (cfjax.LeftMatrix(problems.hat(AXIS)), FRAME, 5.6e-13),
    "right (3, 3)": (cfjax.RightMatrix(problems.hat(AXIS)), FRAME, 5.6e-13),
    "left (3,)": (cfjax.LeftMatrix(problems.hat(AXIS)), FRAME[0], 5.6e-13),
    "left (6,)": (cfjax.LeftMatrix(doubled(problems.hat(AXIS))), doubled(FRAME)[0], 5.6e-13),
}


@pytest.mark.slow
@pytest.mark.parametrize("shape", STEADY)
def test_a_steady_rotation_over_a_million_steps(shape):
    field, y0, most = STEADY[shape]
    sol = cfjax.integrate(
        cfjax.LieTerm(lambda t, y, args: args),
        cfjax.CF4(),
        0.0,
        1e5,
        jnp.asarray(y0),
        field,
        num_steps=1_000_000,
    )
    y = np.asarray(sol.ys[-1], np.longdouble)
    change = y.T @ y - np.asarray(y0, np.longdouble).T @ np.asarray(y0, np.longdouble)
    assert np.abs(change).max() < most


@pytest.mark.slow
def test_compensation_serves_every_part_whose_field_offers_an_increment():
    y0 = {
        "vector": jnp.arange(1.0, 4.0),
        "long": jnp.ones(9),
        "rotated": jnp.eye(3),
        "left": jnp.eye(4),
        "right": jnp.eye(4, dtype=jnp.float32),
        "shift": jnp.eye(2),
    }

    def field(t, y, args):
        return {
            "vector": cfjax.Rotation(jnp.roll(y["vector"], 1)),
            "long": cfjax.LeftMatrix(jnp.outer(y["long"], jnp.arange(9.0)) / 100),
            "rotated": cfjax.Rotation(y["vector"]),
            "left": cfjax.LeftMatrix(y["left"]),
            "right": cfjax.RightMatrix(y["right"]),
            "shift": y["shift"],
        }

    for solver in (cfjax.CF4(estimate=None), cfjax.RKMK4()):
        term = cfjax.LieTerm(field)
        state = solver.init(term, 0.0, 0.1, y0, None)
        step = eqx.filter_jit(solver.step)
        assert state.compensation["shift"] is None
        for _ in range(2):
            y1, _, _, state, _ = step(term, 0.0, 0.1, y0, None, state, made_jump=False)
            for name in ("vector", "long", "rotated", "left", "right"):
                assert state.compensation[name].dtype == y1[name].dtype == y0[name].dtype
                # What a sum loses is at most half a unit in the last place.
                lost = np.abs(state.compensation[name]) / np.spacing(np.abs(np.asarray(y1[name])))
                assert 0 < lost.max() <= 0.5


def test_compensation_catches_what_steps_too_small_to_see_add_up_to():
    # A turn of 1e-17 a step is less than half a unit, so plain sums would stand still.
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(args))
    a = jnp.array([[1.0, 0.0], [0.0, -1.0]])
    sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1e-14, jnp.eye(2), a, num_steps=1000)
    np.testing.assert_allclose(sol.ys[-1], np.diag(np.exp([1e-14, -1e-14])), rtol=0, atol=2e-16)
