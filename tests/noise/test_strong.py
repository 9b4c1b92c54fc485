"""Strong orders: the distance from the solution along the same Brownian path.

A path is drawn on a fine grid with its exact increments and areas, so steps of all lengths see one
Brownian motion. The reference is `ShiftedNoise` at the fine steps: one that knew W alone would hide
order 3/2.
"""

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
    cfjax.CF4(),
    cfjax.WeakOrder2(),
    cfjax.ShiftedNoise(),
    cfjax.CFEES25(),
    cfjax.CF2(),
    cfjax.RKMK4(),
    cfjax.CF3(),
    cfjax.CF54(),
    cfjax.CG4(),
    cfjax.Luscher3(),
]
stratonovich = pytest.mark.parametrize("solver", STRATONOVICH, ids=lambda x: type(x).__name__)


@pytest.fixture(scope="module")
def references():
    """For each number of channels the paths and the ends of the solution."""
    found = {}
    for channels in (1, 2):
        path = paths.drawn(channels, NUMBER, (channels,), FINE)
        fine = jnp.asarray(FINE)
        end = paths.ends(paths.terms, cfjax.ShiftedNoise(), path, paths.SPHERE_START, fine)
        found[channels] = path, end
    return found


@pytest.mark.representatives(4)
@stratonovich
def test_noise_that_does_not_commute_has_order_half(references, solver):
    path, end = references[2]
    errors = paths.strong_errors(paths.terms, solver, path, paths.SPHERE_START, STEPS, end)
    # The order is 1/2 with increments and areas in time, whatever the method (Clark & Cameron).
    assert 0.45 < slope(STEPS, errors) < 0.65
    assert errors[-1] < 0.08


@pytest.mark.representatives(3)
@stratonovich
def test_one_channel_has_order_1_or_3_over_2(references, solver):
    path, end = references[1]
    errors = paths.strong_errors(paths.terms, solver, path, paths.SPHERE_START, STEPS, end)
    is_better = isinstance(solver, cfjax.ShiftedNoise)
    least, most = (1.4, 1.75) if is_better else (0.85, 1.2)
    assert least < slope(STEPS, errors) < most
    assert errors[-1] < (5e-4 if is_better else 5e-3)


def stratonovich_drift(t, y, args):
    """The drift of the equation that is `drift` and `noise` in the sense of Itô in the frame."""

    def correction(channel):
        return jax.jvp(
            lambda y: paths.noise_of(y, channel),
            (y["y"],),
            (jnp.cross(paths.noise_of(y["y"], channel), y["y"]),),
        )[1]

    total = sum(map(correction, jnp.eye(2)), start=jnp.zeros(3))
    return {"y": cfjax.Rotation(paths.drift_of(y["y"]) - total / 2)}


def corrected(path):
    return diffrax.MultiTerm(
        cfjax.LieTerm(stratonovich_drift), cfjax.LieControlTerm(paths.noise, path)
    )


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF4(), cfjax.WeakOrder2()], ids=["CF4", "WeakOrder2"])
def test_lie_euler_takes_noise_in_the_sense_of_ito_in_the_frame(references, solver):
    path, stratonovich_end = references[2]
    fine = jnp.asarray(FINE)
    end = paths.ends(corrected, solver, path, paths.SPHERE_START, fine)
    euler: Any = cfjax.LieEuler()
    errors = paths.strong_errors(paths.terms, euler, path, paths.SPHERE_START, STEPS, end)
    assert 0.45 < slope(STEPS, errors) < 0.65
    # From the Stratonovich equation of the same fields it stays away: its error at the finest steps
    # is the distance of both equations, which the error of order 1/2 has long fallen below.
    gap = paths.rms(end, stratonovich_end)
    away = paths.strong_errors(
        paths.terms, euler, path, paths.SPHERE_START, [256, FINE], stratonovich_end
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


@pytest.fixture(scope="module")
def body_reference():
    """Paths, and the ends of the solution."""
    path = paths.drawn(3, 200, (3,), FINE)
    fine = jnp.asarray(FINE)
    return path, paths.ends(body_terms, cfjax.ShiftedNoise(), path, BODY_START, fine)


@pytest.mark.parametrize(
    "solver, least, most",
    [
        (cfjax.ShiftedNoise(cfjax.CF3()), 1.4, 1.8),
        pytest.param(cfjax.CF3(), 0.85, 1.2, marks=pytest.mark.slow),
        pytest.param(cfjax.WeakOrder2(cfjax.CF3()), 0.85, 1.2, marks=pytest.mark.slow),
        pytest.param(cfjax.CF2(), 0.85, 1.2, marks=pytest.mark.slow),
    ],
    ids=["ShiftedNoise(CF3)", "CF3", "WeakOrder2(CF3)", "CF2"],
)
def test_additive_noise(body_reference, solver, least, most):
    path, end = body_reference
    errors = paths.strong_errors(body_terms, solver, path, BODY_START, STEPS, end)
    assert least < slope(STEPS, errors) < most


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, channels, least, most",
    [
        (cfjax.CF4(), 2, 0.4, 0.7),
        (cfjax.WeakOrder2(), 2, 0.4, 0.7),
        (cfjax.CF4(), 1, 0.85, 1.2),
        (cfjax.ShiftedNoise(), 1, 1.4, 1.75),
    ],
    ids=["CF4-2", "WeakOrder2-2", "CF4-1", "ShiftedNoise-1"],
)
def test_the_same_on_the_tree_of_diffrax(solver, channels, least, most):
    """Fewer paths, so the slopes are rougher: 5 % in each error."""
    shape = jax.ShapeDtypeStruct((channels,), jnp.result_type(float))

    def end(key, solver, num_steps):
        tree = diffrax.VirtualBrownianTree(
            0.0, 1.0, 2.0**-12, shape, key, levy_area=diffrax.SpaceTimeLevyArea
        )
        return diffrax.diffeqsolve(
            paths.terms(tree),
            solver,
            0.0,
            1.0,
            1 / num_steps,
            paths.SPHERE_START,
            max_steps=num_steps,
            adjoint=diffrax.ForwardMode(),
        ).ys["y"][-1]

    def all_ends(solver, num_steps):
        keys = jax.random.split(jax.random.key(4), 200)
        return {"y": jax.jit(jax.vmap(lambda key: end(key, solver, num_steps)))(keys)}

    steps = [4, 16, 64]
    reference = all_ends(cfjax.ShiftedNoise(), 512)
    errors = np.array([paths.rms(all_ends(solver, n), reference) for n in steps])
    assert least < slope(steps, errors) < most
