"""The free rigid body: its reference, its field, and the order of a method."""

import jax
import jax.numpy as jnp
import numpy as np
import problems

import cfjax
from cfjax.scenes import rigid_body

TIMES = np.linspace(rigid_body.t0, rigid_body.t1, 1001)


def test_the_reference():
    for t, row in rigid_body.tabulated.items():
        # The table has 13 decimals and DOP853's own error.
        np.testing.assert_allclose(rigid_body.reference(t), row, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rigid_body.reference(0.0), rigid_body.y0, rtol=0, atol=1e-15)
    # Central differences of fourth order: truncation 1e-11, rounding 1e-15 / h = 1e-12.
    h = 1e-3
    y = {k: rigid_body.reference(TIMES + k * h) for k in (-2, -1, 0, 1, 2)}
    slope = (8 * (y[1] - y[-1]) - (y[2] - y[-2])) / (12 * h)
    np.testing.assert_allclose(slope, np.cross(y[0], y[0] / rigid_body.inertia), rtol=0, atol=1e-10)
    energy = rigid_body.energy(y[0], rigid_body.inertia)
    # By hand: (64/81 * 8/7 + 16/81 * 8/5 + 1/81 * 4) / 2.
    np.testing.assert_allclose(energy, (64 * 8 / 7 + 16 * 8 / 5 + 4) / 162, rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(y[0], axis=-1), np.ones(len(TIMES)), rtol=1e-14)


def test_frozen_field_is_the_equation():
    y = jnp.asarray(rigid_body.y0)
    velocity = jax.jit(lambda y: rigid_body.field(0.0, y, rigid_body.inertia).tangent(y))(y)
    want = np.cross(rigid_body.y0, rigid_body.y0 / rigid_body.inertia)
    np.testing.assert_allclose(velocity, want, rtol=1e-15)


def test_order():
    """The slope of the error at t = 1 over h = 1/16 to 1/128, far above 128 steps of rounding."""
    counts, exact = (16, 32, 64, 128), rigid_body.reference(1.0)
    given = rigid_body.field, cfjax.CF4(), 1.0, rigid_body.y0, rigid_body.inertia, exact
    errors = problems.errors(*given, counts)
    assert np.all(errors > 1e-12)
    assert abs(problems.slope(counts, errors) - 4) < 0.15
