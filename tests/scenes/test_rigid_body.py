from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax.scenes import rigid_body

TIMES = np.linspace(rigid_body.t0, rigid_body.t1, 1001)
TERM = cfjax.LieTerm(rigid_body.field)
METHODS = [
    (cfjax.LieEuler(), 1),
    (cfjax.CF2(), 2),
    (cfjax.CF3(), 3),
    (cfjax.CF4(), 4),
    (cfjax.CG3(), 3),
    (cfjax.CG4(), 4),
    (cfjax.CG5(), 5),
    (cfjax.RKMK3(), 3),
    (cfjax.RKMK4(), 4),
]


def test_constants_are_numpy_arrays():
    # A JAX array made at import would be in float32 if x64 comes on later.
    for constant in (rigid_body.y0, rigid_body.inertia, *rigid_body.tabulated.values()):
        assert type(constant) is np.ndarray
        assert constant.dtype == np.float64


@pytest.mark.parametrize("t", rigid_body.tabulated)
def test_reference_agrees_with_the_table(t):
    # The table has 13 decimals and DOP853's own error.
    np.testing.assert_allclose(rigid_body.reference(t), rigid_body.tabulated[t], rtol=0, atol=1e-12)


def test_reference_starts_at_the_initial_value():
    np.testing.assert_allclose(rigid_body.reference(0.0), rigid_body.y0, rtol=0, atol=1e-15)


def test_reference_solves_the_equation():
    # Central differences of fourth order: truncation 1e-11, rounding 1e-15 / h = 1e-12.
    h = 1e-3
    y = {k: rigid_body.reference(TIMES + k * h) for k in (-2, -1, 0, 1, 2)}
    slope = (8 * (y[1] - y[-1]) - (y[2] - y[-2])) / (12 * h)
    np.testing.assert_allclose(slope, np.cross(y[0], y[0] / rigid_body.inertia), rtol=0, atol=1e-10)


def test_exact_solution_keeps_norm_and_energy():
    y = rigid_body.reference(TIMES)
    energy = rigid_body.energy(y, rigid_body.inertia)
    start = rigid_body.energy(rigid_body.y0, rigid_body.inertia)
    np.testing.assert_allclose(energy, np.full(len(TIMES), start), rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(y, axis=-1), np.ones(len(TIMES)), rtol=1e-14)


def test_energy_of_the_initial_value():
    # By hand: (64/81 * 8/7 + 16/81 * 8/5 + 1/81 * 4) / 2.
    expected = (64 * 8 / 7 + 16 * 8 / 5 + 4) / 162
    np.testing.assert_allclose(rigid_body.energy(rigid_body.y0, rigid_body.inertia), expected)


def test_frozen_field_is_the_equation():
    y = jnp.asarray(rigid_body.y0)
    velocity = rigid_body.field(0.0, y, rigid_body.inertia).tangent(y)
    np.testing.assert_allclose(
        velocity, np.cross(rigid_body.y0, rigid_body.y0 / rigid_body.inertia), rtol=1e-15
    )


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_precision_follows_the_state(dtype):
    y, inertia = jnp.asarray(rigid_body.y0, dtype), jnp.asarray(rigid_body.inertia, dtype)
    assert rigid_body.field(0.0, y, inertia).omega.dtype == dtype
    assert rigid_body.energy(y, inertia).dtype == dtype


@pytest.mark.representatives(1)
@pytest.mark.parametrize("method", [cfjax.CF4(), cfjax.RKMK4()])
def test_integration_keeps_the_norm(method):
    solution = cfjax.integrate(
        TERM, method, 0.0, 100.0, rigid_body.y0, rigid_body.inertia, num_steps=1000, save_every=100
    )
    np.testing.assert_allclose(
        np.linalg.norm(np.asarray(solution.ys), axis=-1), np.ones(10), rtol=1e-14
    )


@pytest.mark.representatives(3)
@pytest.mark.parametrize("method, order", METHODS, ids=lambda x: type(x).__name__)
def test_order(method, order):
    """The slope of the error at t = 1 over h = 1/16 to 1/128.

    Noise floor: the reference and 128 steps of rounding leave 1e-14, and CG5's smallest error is
    1.4e-11.
    """
    counts = np.array([16, 32, 64, 128])
    errors = np.array([error_at_one(method, n) for n in counts])
    assert np.all(errors > 1e-12)
    slope = np.polyfit(np.log(1 / counts), np.log(errors), 1)[0]
    assert abs(slope - order) < 0.15
    assert method.order(TERM) == order


@pytest.mark.slow
@pytest.mark.parametrize("tableau", [diffrax.Dopri5.tableau, diffrax.Tsit5.tableau])
def test_order_of_munthe_kaas_methods_of_order_five(tableau):
    """As above, at t = 10: at t = 1 they meet the reference's error before their order shows."""
    counts = np.array([200, 400, 800])
    y0, inertia = jnp.asarray(rigid_body.y0), jnp.asarray(rigid_body.inertia)
    ends = [
        cfjax.integrate(TERM, cfjax.RKMK(tableau), 0.0, 10.0, y0, inertia, num_steps=n).ys
        for n in counts
    ]
    errors = [np.linalg.norm(np.asarray(y)[-1] - rigid_body.reference(10.0)) for y in ends]
    # The reference and 800 steps of rounding leave some 1e-13.
    assert min(errors) > 1e-12
    slope = np.polyfit(np.log(1 / counts), np.log(errors), 1)[0]
    assert abs(slope - 5) < 0.15


def error_at_one(method, num_steps):
    # In pieces of 16 steps, so that a method compiles once for every number of steps.
    nodes = np.linspace(0, 1, num_steps // 16 + 1)
    y: jax.Array = jnp.asarray(rigid_body.y0)
    inertia = jnp.asarray(rigid_body.inertia)
    for t0, t1 in pairwise(nodes):
        solution = cfjax.integrate(TERM, method, t0, t1, y, inertia, num_steps=16)
        y = jnp.asarray(solution.ys)[-1]
    return np.linalg.norm(y - rigid_body.reference(1.0))


def test_the_picture():
    assert len(rigid_body.picture().axes) == 2
