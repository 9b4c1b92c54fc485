"""The heavy top: its references, what it keeps, and Kovalevskaya's integral."""

from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj, ellipk

import cfjax
from cfjax.scenes import heavy_top

TERM = cfjax.LieTerm(heavy_top.field)
TOP = heavy_top.benchmark
T = 0.25


def steps(solver, num_steps, *times, term=TERM):
    """Every tenth state between the last two times, by one program for all."""
    y, ys = heavy_top.y0(), None
    for t0, t1 in pairwise(times):
        options = dict(num_steps=num_steps, save_every=10)
        ys = cfjax.integrate(term, solver, t0, t1, y, TOP, **options).ys
        y = jax.tree.map(lambda y: y[-1], ys)
    return ys


def end(*given):
    return jax.tree.map(lambda y: np.asarray(y[-1]), steps(*given))


@pytest.fixture(scope="module")
def reference():
    return heavy_top.reference(T)


def test_the_start_is_the_benchmarks():
    y = heavy_top.y0()
    np.testing.assert_array_equal(y["pose"], [1, 0, 0, 0, 0, 1, 0])
    # The inertia about the centre of mass, the angular velocity, and the angular momentum of a mass
    # of 15 at (0, 1, 0), which moves with 4.61538 in the first direction.
    about_center = np.array([0.234375, 0.46875, 0.234375]) * [0, 150, -4.61538]
    np.testing.assert_allclose(y["m"], about_center + np.array([0, 0, -15 * 4.61538]), rtol=1e-15)
    tilted = heavy_top.y0(0.3, 7.0, 2.0)
    # Twice the spin about the vertical, seen from the body, has the tilt in it.
    np.testing.assert_allclose(tilted["pose"][4:], [0, np.sin(0.3), np.cos(0.3)], atol=1e-15)
    omega = jax.jit(heavy_top.angular_velocity)(tilted, TOP)
    np.testing.assert_allclose(omega[1], 7 + 2 * np.cos(0.3), rtol=1e-14)


def test_the_reference_against_the_closed_form(reference):
    # The cosine u of the angle from the vertical: u'^2 is a cubic with three roots, and u swings
    # between the lower two. The start is at rest at one of these. Landau & Lifshitz, Section 35.
    y = heavy_top.y0()
    across, along = TOP.inertia[0], TOP.inertia[1]
    weight = TOP.mass * TOP.gravity
    spin, vertical = y["m"][1] / along, y["m"][2]
    rest = float(heavy_top.energy(jax.tree.map(jnp.asarray, y), TOP)) - along * spin**2 / 2
    u = np.polynomial.Polynomial([0.0, 1.0])
    rate = 2 / across * (rest - weight * u) * (1 - u**2)
    rate = rate - ((vertical - along * spin * u) / across) ** 2
    low, high, above = np.sort(rate.roots().real)
    k = (high - low) / (above - low)
    assert min(abs(low), abs(high)) < 1e-14
    start = ellipk(k) if abs(high) < abs(low) else 0.0
    argument = np.sqrt(weight / across * (above - low) / 2) * T + start
    want = low + (high - low) * ellipj(argument, k)[0] ** 2
    # Some thousand steps of a tolerance of 1e-13.
    np.testing.assert_allclose(reference["pose"][6], want, rtol=0, atol=1e-11)
    # The spin about its axis is constant.
    axis = reference["pose"][4:]
    np.testing.assert_allclose(reference["m"] @ axis, along * spin, rtol=1e-11)


@pytest.mark.slow
def test_a_richardson_extrapolated_reference(reference):
    # CF54 with half the steps twice: order 6, 18 turns of the body.
    found = end(cfjax.Richardson(cfjax.CF54()), 1000, 0.0, T)
    assert heavy_top.error(found, reference) < 1e-9


def test_order(reference):
    # 250 and 500 steps by one program.
    ends = (end(cfjax.CF4(), 250, *times) for times in ((0.0, T), (0.0, T / 2, T)))
    errors = [heavy_top.error(y, reference) for y in ends]
    assert 0.75 * 2**4 < errors[0] / errors[1] < 1.35 * 2**4


def test_what_is_kept_and_what_plain_space_loses():
    start = jax.tree.map(jnp.asarray, heavy_top.y0())
    ys = steps(cfjax.CF4(), 250, 0.0, 1.0)
    off = steps(diffrax.Tsit5(), 250, 0.0, 1.0, term=diffrax.ODETerm(heavy_top.velocity))
    # To rounding of an entry, whatever the steps: sums over them are compensated.
    length = lambda ys: np.linalg.norm(ys["pose"][:, :4], axis=-1) - 1  # noqa: E731
    drift = lambda ys: np.abs(ys["pose"][:, 4:] - turned(ys)).max()  # noqa: E731
    assert np.abs(length(ys)).max() < 1e-15
    assert np.abs(length(off)).max() > 1e-6
    assert np.abs(heavy_top.pivot(ys, TOP)).max() < 2e-15
    assert drift(off) > 1e-6
    # No torque about the vertical, not even of rounding.
    assert np.all(heavy_top.vertical_momentum(ys) == start["m"][2])
    # To the method's error: steps turn the body by 0.6.
    energies = [heavy_top.energy(y, TOP) for y in (ys, start)]
    np.testing.assert_allclose(*np.broadcast_arrays(*energies), rtol=1e-3)


def turned(ys):
    """The centre of mass where the attitude alone has it."""
    q = ys["pose"][:, :4] / np.linalg.norm(ys["pose"][:, :4], axis=-1, keepdims=True)
    center = np.broadcast_to(np.array(TOP.center), (len(q), 3))
    return cfjax.quaternion_rotate(q, center, layout="wxyz")


def test_kovalevskayas_integral_does_not_change():
    # Her top, with inertia 2 : 2 : 1 and its centre of mass across the third axis, has it, and no
    # other does: it sees the signs of all that turns the body.
    args = heavy_top.Top(1.5, (1.4, 1.4, 0.7), (0.3, 0.0, 0.0), 9.81)
    mu = 1.5 * 9.81 * 0.3 / 0.7

    def integral(y):
        omega = heavy_top.angular_velocity(y, args)
        q = y["pose"][:4] * np.array([1.0, -1.0, -1.0, -1.0])
        up = cfjax.quaternion_rotate(q, jnp.array([0.0, 0.0, 1.0]), layout="wxyz")
        real = omega[0] ** 2 - omega[1] ** 2 - mu * up[0]
        return real**2 + (2 * omega[0] * omega[1] - mu * up[1]) ** 2

    q = jnp.array([0.1, 0.5, -0.5, 0.7])
    x = cfjax.quaternion_rotate(q, jnp.array(args.center), layout="wxyz")
    y = {"pose": jnp.concatenate([q, x]), "m": jnp.array([0.3, -1.0, 0.7])}

    @jax.jit
    def slopes(y):
        rates = cfjax.tangent(heavy_top.field(0.0, y, args), y), heavy_top.velocity(0.0, y, args)
        return [jax.jvp(integral, (y,), (rate,)) for rate in rates]

    for value, slope in slopes(y):
        # Terms of some hundred cancel.
        assert abs(value) > 1 and abs(slope) < 1e-12


def test_an_attitude_has_two_quaternions(reference):
    other = reference["pose"] * np.array([-1, -1, -1, -1, 1, 1, 1])
    assert heavy_top.error({"pose": other, "m": reference["m"]}, reference) == 0.0
