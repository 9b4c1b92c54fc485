"""The spacecraft: its exact motion, what it keeps, and thrusters that switch."""

from itertools import pairwise

import jax
import numpy as np
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import spacecraft

TERM = cfjax.LieTerm(spacecraft.field)
FREE = spacecraft.Craft()


def rate(t, y):
    """The equations once more, in NumPy."""
    q, m = y[:4], y[4:]
    w = m / spacecraft.inertia
    q_rate = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
    return np.concatenate([q_rate, np.cross(m, w)])


def test_the_reference_against_dop853():
    # Two steps of growth by e^(0.29 t) off the middle axis, of a tolerance of 1e-13.
    start = np.concatenate([spacecraft.y0()["q"], spacecraft.y0()["m"]])
    y = solve_ivp(rate, (0.0, 8.0), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    want = {"q": y[:4], "m": y[4:]}
    assert spacecraft.error(want, spacecraft.reference(8.0)) < 1e-11
    times = np.array([0.0, 3.0, 17.5])
    together = spacecraft.reference(times)
    for k, t in enumerate(times):
        one = {name: x[k] for name, x in together.items()}
        # The panels of the integral are others, which are exact to rounding.
        assert spacecraft.error(one, spacecraft.reference(t)) < 1e-13
    assert spacecraft.error(spacecraft.y0(), spacecraft.reference(0.0)) < 1e-15
    # An attitude has two quaternions.
    y = spacecraft.reference(3.0)
    assert spacecraft.error({"q": -y["q"], "m": y["m"]}, y) == 0.0


def steps(times):
    """400 steps of CF4 from each time to the next one, by one program; every fortieth state."""
    y, parts = spacecraft.y0(), []
    for start, end in pairwise(times):
        given = TERM, cfjax.CF4(), start, end, y, FREE
        parts.append(cfjax.integrate(*given, num_steps=400, save_every=40).ys)
        y = jax.tree.map(lambda y: y[-1], parts[-1])
    return jax.tree.map(lambda *y: np.concatenate(y), *parts)


def test_order():
    exact = spacecraft.reference(10.0)
    ends = [jax.tree.map(lambda y: y[-1], steps(times)) for times in ((0, 10), (0, 5, 10))]
    errors = [spacecraft.error(end, exact) for end in ends]
    assert 0.7 * 2**4 < errors[0] / errors[1] < 1.5 * 2**4


def test_what_is_kept():
    ys = steps(np.linspace(0, 40, 11))
    # To rounding: the lengths, whatever the steps.
    for part, length in (("q", 1.0), ("m", np.hypot(0.05, 1.0))):
        np.testing.assert_allclose(np.linalg.norm(ys[part], axis=-1), length, rtol=1e-15 * 4)
    # To the method's error: energy, and the momentum in the fixed frame.
    energies = spacecraft.energy(ys, FREE)
    np.testing.assert_allclose(energies, spacecraft.energy(spacecraft.y0(), FREE), rtol=1e-8)
    momenta = spacecraft.fixed_momentum(ys)
    start = np.broadcast_to(spacecraft.y0()["m"], momenta.shape)
    np.testing.assert_allclose(momenta, start, rtol=0, atol=1e-8)
    # It tumbles.
    assert ys["m"][:, 1].min() < -0.99 and ys["m"][:, 1].max() > 0.99
