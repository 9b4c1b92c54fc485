"""The velocity that a solver tells diffrax, and events, which are found by it and by the state."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
import problems
import pytest
from scipy.integrate import solve_ivp

import cfjax

# Fields that come to rest, with their velocity as a plain function in NumPy and the start. The
# velocity of each kind of field is checked in fields/test_contract.py.

SCALES = np.array([1.0, 2.0, 3.0, 4.0])
AIM = np.array([0.6, 0.0, 0.8])
FRAME = np.linalg.qr(np.arange(8.0).reshape(4, 2) ** 2 - 9.0)[0]


def rotation(t, y, args):
    """To AIM, and at any time around y as well, which does not move it."""
    return cfjax.Rotation(jnp.cross(y, AIM) + 3.0 * y)


def rotation_ode(t, y):
    return np.cross(np.cross(y, AIM), y)


def matrix_ode(t, y):
    return SCALES * y - y * (y @ (SCALES * y))


def low_rank(t, y, args):
    return cfjax.LowRankSkew(SCALES[:, None] * y)


def low_rank_ode(t, y):
    q = y.reshape(4, 2)
    g = SCALES[:, None] * q
    return (g @ (q.T @ q) - q @ (g.T @ q)).ravel()


def product(t, y, args):
    return {"on": cfjax.SphereRotation(SCALES * y["on"]), "x": 1.0 - 2.0 * y["x"]}


def product_ode(t, y):
    return np.append(matrix_ode(t, y[:4]), 1.0 - 2.0 * y[4:])


UNIT = np.array([0.7, 0.5, 0.1, 0.5])
CASES: dict[str, Any] = {
    "Rotation": (rotation, rotation_ode, np.array([0.48, 0.6, -0.64])),
    "LowRankSkew": (low_rank, low_rank_ode, FRAME),
    "a pytree": (product, product_ode, {"on": UNIT, "x": np.array([0.2, 0.0])}),
}
cases = pytest.mark.parametrize("name", CASES)


# The velocity

SOLVERS = {
    "CF4": cfjax.CF4(),
    "RKMK4": cfjax.RKMK4(),
    "Magnus4": cfjax.Magnus4(),
    "Richardson": cfjax.Richardson(cfjax.CF4()),
    "HalfSolver": diffrax.HalfSolver(cfjax.RKMK3()),
}


def test_func_is_the_velocity():
    """As diffrax means it: what an event calls steady, and a first step is chosen by."""
    pairs = [("CF4", name) for name in CASES] + [(solver, "a pytree") for solver in SOLVERS]
    for solver, name in pairs:
        field, ode, y0 = CASES[name]
        y = problems.arrays(y0)
        found = SOLVERS[solver].func(cfjax.LieTerm(field), jnp.asarray(0.3), y, None)
        assert jtu.tree_structure(found) == jtu.tree_structure(y)
        # Some ten products of numbers below 10.
        expected = ode(0.3, problems.flat(y0))
        np.testing.assert_allclose(problems.flat(found), expected, rtol=0, atol=1e-14)


def test_func_of_a_sum_of_terms():
    def rest(t, y, args):
        return {"on": cfjax.SphereRotation(t * y["on"][::-1]), "x": -y["x"]}

    y = problems.arrays(CASES["a pytree"][2])
    terms = diffrax.MultiTerm(cfjax.LieTerm(product), cfjax.LieTerm(rest))
    found = cfjax.CF4().func(terms, jnp.asarray(0.5), y, None)
    u = 0.5 * UNIT[::-1]
    more = np.append(u - UNIT * (u @ UNIT), -np.asarray(y["x"]))
    expected = product_ode(0.5, problems.flat(y)) + more
    np.testing.assert_allclose(problems.flat(found), expected, rtol=0, atol=1e-14)


def test_func_of_a_sum_of_translations():
    """Shaped like the state it is their sum. What takes another control than time is diffrax's."""
    plain = diffrax.ODETerm(lambda t, y, args: -y)
    terms = diffrax.MultiTerm(plain, cfjax.LieTerm(lambda t, y, args: jnp.ones_like(y)))
    y = jnp.asarray([1.0, 3.0])
    found = cfjax.CF4().func(terms, jnp.asarray(0.0), y, None)
    np.testing.assert_array_equal(found, [0.0, -2.0])
    driven = diffrax.ControlTerm(
        lambda t, y, args: jnp.eye(2), lambda t0, t1: jnp.ones(2) * (t1 - t0)
    )
    found = cfjax.CF4().func(diffrax.MultiTerm(plain, driven), jnp.asarray(0.0), y, None)
    expected = diffrax.Euler().func(diffrax.MultiTerm(plain, driven), jnp.asarray(0.0), y, None)
    assert eqx.tree_equal(found, expected)


# Steady states

STEP = 0.05


def root_mean_square(y):
    return np.sqrt(np.mean(np.square(y)))


def crossing(ode, y0, condition, end=30.0):
    """When `condition(t, y)` of the state as a vector is zero first, and the state."""
    condition.terminal = True
    found = solve_ivp(
        ode, (0.0, end), problems.flat(y0), "DOP853", events=condition, rtol=1e-12, atol=1e-13
    )
    return float(found.t_events[0][0]), found.y_events[0][0]


@pytest.mark.slow
@cases
def test_a_steady_state_ends_a_solve(name):
    field, ode, y0 = CASES[name]
    atol = 1e-3
    time, _ = crossing(ode, y0, lambda t, y: root_mean_square(ode(t, y)) - atol)
    condition = diffrax.steady_state_event(rtol=0.0, atol=atol, norm=optx.rms_norm)
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        cfjax.CF4(estimate=None),
        *(0.0, 100.0, STEP, problems.arrays(y0)),
        event=diffrax.Event(condition),
    )
    assert sol.result == diffrax.RESULTS.event_occurred
    # At the end of the first step behind that time, which is none of the nodes: by more than what
    # the error of the method, below 1e-4 of a velocity that falls by a factor e in a unit of time,
    # makes of it.
    nodes = time / STEP
    assert abs(nodes - round(nodes)) * STEP > 1e-4
    np.testing.assert_allclose(sol.ts[-1], np.ceil(nodes) * STEP, rtol=0, atol=1e-12)


# Other events


@pytest.mark.representatives(1)
@cases
def test_events_of_every_kind_at_once(name):
    """Numbers with directions, a bool, and a root: the first that happens ends the solve."""
    field, ode, y0 = CASES[name]
    start = problems.flat(y0)
    far = solve_ivp(ode, (0.0, 1.0), start, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    # The entry that goes farthest, and where it is on its way.
    k = int(np.argmax(np.abs(far - start)))
    level = (start[k] + far[k]) / 2
    rises = bool(far[k] > start[k])
    time, at = crossing(ode, y0, lambda t, y: y[k] - level)

    def passes(t, y, args, **kwargs):
        return jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(y)])[k] - level

    conditions = {
        "bool": lambda t, y, args, **kwargs: t > 3.0,
        "right": passes,
        "wrong": lambda *args, **kwargs: passes(*args, **kwargs),
    }
    directions = {"bool": None, "right": rises, "wrong": not rises}

    def solve(root_finder):
        event = diffrax.Event(conditions, root_finder, directions)
        return diffrax.diffeqsolve(
            cfjax.LieTerm(field),
            cfjax.CF4(),
            *(0.0, 4.0, 0.1, problems.arrays(y0)),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-9),
            event=event,
            max_steps=512,
        )

    found = solve(optx.Newton(1e-12, 1e-12, optx.rms_norm))
    assert found.result == diffrax.RESULTS.event_occurred
    assert jtu.tree_map(bool, found.event_mask) == {"bool": False, "right": True, "wrong": False}
    # Some tens of steps, each with an error of 1e-9 at most, add up to 1e-7. Of order 4, as these
    # steps of 0.05 or less are, the output within a step may be as far off again. The entry moves
    # by 0.05 or more in a unit of time.
    np.testing.assert_allclose(problems.flat(found.ys)[: start.size], at, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.ts[-1], time, rtol=0, atol=1e-5)
