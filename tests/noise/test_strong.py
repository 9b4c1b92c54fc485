"""Strong orders: the distance from the solution along the same Brownian path.

A path is drawn on a fine grid with its exact increments and areas, so steps of all lengths see one
Brownian motion. The reference is `ShiftedNoise` at the fine steps: one that knew W alone would hide
order 3/2.
"""

import functools
from typing import Any

import brownian_paths as paths
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import slope

import cfjax

# The errors of 300 paths have a standard error of some 4 %, and those of the reference, at steps 8
# times as short as the shortest, are a third of theirs where the order is 1/2. Both together change
# a slope by less than 0.05.
NUMBER = 300
FINE = 1024
STEPS = [8, 16, 32, 64]

STRATONOVICH: Any = [
    *(cfjax.CF4(), cfjax.WeakOrder2(), cfjax.ShiftedNoise(), cfjax.CFEES25()),
    *(cfjax.CF2(), cfjax.RKMK4(), cfjax.CF54(), cfjax.Luscher3()),
]


def but_slow(*quick):
    """All solvers, of which a few are quick."""
    cases = [pytest.param(x, marks=() if x in quick else pytest.mark.slow) for x in STRATONOVICH]
    return pytest.mark.parametrize("solver", cases, ids=lambda x: type(x).__name__)


@functools.cache
def reference(channels):
    """Paths of so many channels, and the ends of the solution."""
    path = paths.drawn(channels, NUMBER, (channels,), FINE)
    fine = jnp.asarray(FINE)
    return path, paths.ends(paths.terms, cfjax.ShiftedNoise(), path, paths.SPHERE_START, fine)


@but_slow()
def test_noise_that_does_not_commute_has_order_half(solver):
    path, end = reference(2)
    errors = paths.strong_errors(paths.terms, solver, path, paths.SPHERE_START, STEPS, end)
    # The order is 1/2 with increments and areas in time, whatever the method (Clark & Cameron).
    assert 0.45 < slope(STEPS, errors) < 0.65
    assert errors[-1] < 0.08


@but_slow(cfjax.CF4(), cfjax.ShiftedNoise())
def test_one_channel_has_order_1_or_3_over_2(solver):
    path, end = reference(1)
    errors = paths.strong_errors(paths.terms, solver, path, paths.SPHERE_START, STEPS, end)
    is_better = isinstance(solver, cfjax.ShiftedNoise)
    least, most = (1.4, 1.75) if is_better else (0.85, 1.2)
    assert least < slope(STEPS, errors) < most
    assert errors[-1] < (5e-4 if is_better else 5e-3)


def drift_of_both_senses(t, y, args):
    """With a part of the state that says whether `drift` and `noise` are meant as Itô's."""

    def correction(channel):
        return jax.jvp(
            lambda y: paths.noise_of(y, channel),
            (y["y"],),
            (jnp.cross(paths.noise_of(y["y"], channel), y["y"]),),
        )[1]

    total = sum(map(correction, jnp.eye(2)), start=jnp.zeros(3))
    return {"y": cfjax.Rotation(paths.drift_of(y["y"]) - y["is_ito"] * total / 2), "is_ito": None}


def terms_of_both_senses(path):
    noise = lambda t, y, args, dw: paths.noise(t, y, args, dw) | {"is_ito": None}  # noqa: E731
    return diffrax.MultiTerm(cfjax.LieTerm(drift_of_both_senses), cfjax.LieControlTerm(noise, path))


def test_lie_euler_takes_noise_in_the_sense_of_ito_in_the_frame():
    path = paths.drawn(2, NUMBER, (2,), FINE)

    def end(is_ito):
        start = paths.SPHERE_START | {"is_ito": jnp.asarray(is_ito)}
        found = paths.ends(terms_of_both_senses, cfjax.CF4(), path, start, jnp.asarray(FINE))
        return {"y": found["y"]}

    ito, stratonovich = end(1.0), end(0.0)
    euler: Any = cfjax.LieEuler()
    errors = paths.strong_errors(paths.terms, euler, path, paths.SPHERE_START, STEPS, ito)
    assert 0.45 < slope(STEPS, errors) < 0.65
    # From the Stratonovich equation of the same fields it stays away: its error at the finest steps
    # is the distance of both equations, which the error of order 1/2 has long fallen below.
    gap = paths.rms(ito, stratonovich)
    away = paths.strong_errors(
        paths.terms, euler, path, paths.SPHERE_START, [256, FINE], stratonovich
    )
    assert gap > 0.1
    np.testing.assert_allclose(away, gap, rtol=0.1)


# Additive noise: a body with friction in a field of force, which random torques move.

INERTIA = np.array([1.0, 2.0, 3.0])


def body(t, y, args):
    spin = y["m"] / INERTIA
    frame = cfjax.quaternion_to_matrix(y["q"], layout="wxyz")
    torque = 2 * jnp.cross(frame[2], jnp.asarray([0.0, 0.6, 0.8]))
    return {
        "q": cfjax.QuaternionRotation(spin, frame="body", layout="wxyz"),
        "m": jnp.cross(y["m"], spin) - y["m"] + torque,
    }


def kicks(t, y, args, dw):
    return {"q": None, "m": np.sqrt(2 * INERTIA) * dw}


def body_terms(path):
    return diffrax.MultiTerm(cfjax.LieTerm(body), cfjax.LieControlTerm(kicks, path))


BODY_START = {"q": jnp.asarray([1.0, 0.0, 0.0, 0.0]), "m": jnp.asarray([0.5, -1.0, 0.8])}


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, least, most",
    [
        (cfjax.ShiftedNoise(cfjax.CF3()), 1.4, 1.8),
        (cfjax.CF3(), 0.85, 1.2),
        (cfjax.WeakOrder2(cfjax.CF3()), 0.85, 1.2),
    ],
    ids=["ShiftedNoise(CF3)", "CF3", "WeakOrder2(CF3)"],
)
def test_additive_noise(solver, least, most):
    path = paths.drawn(3, 200, (3,), FINE)
    end = paths.ends(body_terms, cfjax.ShiftedNoise(), path, BODY_START, jnp.asarray(FINE))
    errors = paths.strong_errors(body_terms, solver, path, BODY_START, STEPS, end)
    assert least < slope(STEPS, errors) < most
