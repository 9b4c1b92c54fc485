"""Preintegration: exact readings, schemes and their orders, and a covariance by quadrature."""

import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np
import problems
import pytest
from problems import hat
from scipy.spatial.transform import Rotation

import cfjax
from cfjax.scenes import preintegration
from cfjax.scenes.preintegration import SCHEMES, Sensor


def rotations(poses):
    return Rotation.from_quat(np.roll(poses[..., :4], -1, axis=-1))


@pytest.fixture(scope="module", autouse=True)
def remembered():
    """Each call of the reference compiles a program, so times that come again are remembered."""
    reference = preintegration.reference
    at_one_time = functools.cache(reference)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            preintegration, "reference", lambda t: (reference if np.ndim(t) else at_one_time)(t)
        )
        yield


def test_readings_are_differences_of_the_path():
    """Angles between attitudes, and positions, give the readings by differences."""
    t, h = 3.3, 1e-3
    before, now, after = preintegration.reference(np.array([t - h, t, t + h]))
    omega, force = jax.jit(preintegration.readings)(t)
    turn = (rotations(before).inv() * rotations(after)).as_rotvec() / (2 * h)
    # Second derivatives of the readings, of some ten, times h^2 / 6, and rounding over h.
    np.testing.assert_allclose(omega, turn, rtol=0, atol=1e-5)
    np.testing.assert_allclose(now[4:7], (after[7:] - before[7:]) / (2 * h), rtol=0, atol=1e-5)
    acceleration = (after[4:7] - before[4:7]) / (2 * h)
    thrust = rotations(now).inv().apply(acceleration - preintegration.gravity)
    np.testing.assert_allclose(force, thrust, rtol=0, atol=1e-5)
    # A drone is pushed along its own axis, and pays for gravity.
    np.testing.assert_allclose(force[:2], 0, rtol=0, atol=1e-14)
    assert 8 < force[2] < 12


def test_a_flight_against_the_reference():
    given: dict[str, Any] = {"args": None} | preintegration.problem()
    ends = [
        problems.in_pieces(**given, solver=cfjax.CF4(), num_steps=160, pieces=n) for n in (1, 2)
    ]
    exact = preintegration.reference(preintegration.t1)
    errors = [preintegration.error(np.asarray(y), exact) for y in ends]
    assert abs(np.log2(errors[0] / errors[1]) - 4) < 0.3
    assert errors[1] < 1e-4


ORDERS = {
    "on the manifold, held": (1, 1, 1),
    "on the tangent space, held": (1, 1, 1),
    "on the manifold, mean of two": (2, 1, 1),
    "exact flow, held": (1, 1, 1),
    "exact flow, mean of two": (2, 2, 2),
    "CF4, linear interpolation": (2, 2, 2),
    "CF4, cubic interpolation": (4, 4, 4),
}


QUICK = "CF4, cubic interpolation"


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x != QUICK)) for x in SCHEMES]
)
def test_orders_of_the_schemes(name):
    scheme = SCHEMES[name]
    coarse, fine = (np.array(preintegration.errors(scheme, rate)) for rate in (50, 100))
    # Errors of the next order are a tenth of these.
    np.testing.assert_allclose(np.log2(coarse / fine), ORDERS[name], rtol=0, atol=0.3)


def test_schemes_agree_where_readings_are_constant():
    """With no turn even the simplest is exact."""
    seen = preintegration.Samples(np.zeros((11, 3)), np.tile([1.0, -2.0, 9.0], (11, 1)), 0.1)
    y = preintegration.y0(2.0)
    turned = rotations(y).apply([1.0, -2.0, 9.0]) + preintegration.gravity
    want = np.r_[y[:4], y[4:7] + turned, y[7:] + y[4:7] + turned / 2]
    ends = jax.jit(lambda *given: {name: scheme(*given) for name, scheme in SCHEMES.items()})
    for name, end in ends(seen, y).items():
        # Ten steps of numbers of ten.
        np.testing.assert_allclose(end, want, rtol=0, atol=1e-13, err_msg=name)


def covariance_by_quadrature(t1, args):
    """P in the body's frame, by Gauss's rule: errors of turned attitudes stay, others add up."""
    x, weights = np.polynomial.legendre.leggauss(60)
    t, weights = t1 * (1 + x) / 2, t1 * weights / 2
    end = preintegration.reference(t1)
    p = np.zeros((9, 9))
    for s, weight in zip(t, weights, strict=True):
        now, left = preintegration.reference(s), t1 - s
        # What the force alone has made since s: velocity and position without gravity.
        v = end[4:7] - now[4:7] - left * preintegration.gravity
        r = end[7:] - now[7:] - left * now[4:7] - left**2 / 2 * preintegration.gravity
        m = np.eye(9)
        m[3:6, :3], m[6:, :3], m[6:, 3:6] = -hat(v), -hat(r), left * np.eye(3)
        turn = np.kron(np.eye(3), rotations(now).as_matrix())
        g = m @ turn @ np.diag([args.gyro_noise] * 3 + [args.force_noise] * 3 + [0] * 3)
        p += weight * g @ g.T
    back = np.kron(np.eye(3), rotations(end).as_matrix().T)
    return back @ p @ back.T


@pytest.mark.slow
def test_the_covariance_against_quadrature():
    args = Sensor()
    times, ys = preintegration.covariances(args, num_steps=320)
    for k in (80, 320):
        want = covariance_by_quadrature(times[k], args)
        scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
        # The error of a method of order 4 with steps of 1/20, in units of the standard deviations.
        np.testing.assert_allclose(ys.covariance[k] / scale, want / scale, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_the_table_of_the_page():
    text = (Path(__file__).parents[2] / "docs" / "state" / "pose.md").read_text()
    table = text.split("| scheme |")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in table.splitlines()[2:]]
    assert [", ".join(row[:2]) for row in rows] == list(SCHEMES)
    for row, scheme in zip(rows, SCHEMES.values(), strict=True):
        found = preintegration.errors(scheme, 100)
        # Two digits are written.
        np.testing.assert_allclose([float(x) for x in row[2:5]], found, rtol=0.05)
