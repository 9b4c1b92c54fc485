"""Point vortices on the sphere: their velocities, the rounds of pairs, and what they keep."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax
from cfjax.scenes import vortices

ROUNDS = vortices.rounds()
T = 20.0

# Eight vortices in no order, all of different strengths.
OTHERS = np.random.default_rng(3).normal(size=(8, 3))
OTHERS = jnp.asarray(OTHERS / np.linalg.norm(OTHERS, axis=1, keepdims=True))
UNEQUAL = jnp.asarray(np.random.default_rng(4).normal(size=8))


def test_the_velocity_is_that_of_the_fluid():
    # Around a vortex of strength G the fluid goes with G / (4 pi tan(angle / 2)).
    want = np.zeros((8, 3))
    for i, x in enumerate(np.asarray(OTHERS)):
        for j, (g, z) in enumerate(zip(UNEQUAL, np.asarray(OTHERS), strict=True)):
            if i != j:
                across = np.cross(z, x) / np.linalg.norm(np.cross(z, x))
                want[i] += g / (4 * np.pi * np.tan(np.arccos(z @ x) / 2)) * across

    def both(y, args):
        parts = [cfjax.tangent(term.field(0.0, y, args), y) for term in ROUNDS.terms]
        assert len(parts) == 7
        return vortices.velocity(0.0, y, args), sum(parts)

    for found in jax.jit(both)(OTHERS, UNEQUAL):
        # The velocities are of size one, with the rounding of an arc cosine.
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


def test_the_flow_of_a_round_is_exact():
    cfjax.check_terms(ROUNDS, 0.0, OTHERS, UNEQUAL)


def test_energy_and_momentum_are_constant():
    def value(y):
        return vortices.energy(y, UNEQUAL), vortices.momentum(y, UNEQUAL)

    def both(y):
        return jax.jvp(value, (y,), (vortices.velocity(0.0, y, UNEQUAL),))

    (energy, _), rates = jax.jit(both)(OTHERS)
    # Some 28 terms of size one cancel.
    for rate in rates:
        assert np.max(np.abs(rate)) < 1e-15 * 28
    y, g = np.asarray(OTHERS), np.asarray(UNEQUAL)
    pairs = [(i, j) for i in range(8) for j in range(i)]
    want = sum(g[i] * g[j] * np.log(np.sum((y[i] - y[j]) ** 2) / 2) for i, j in pairs)
    np.testing.assert_allclose(energy, -want / (4 * np.pi), rtol=0, atol=1e-14)


def test_a_street_turns_as_a_whole():
    y = vortices.y0(5, 0.3, shift=0.0)
    rate = np.asarray(jax.jit(vortices.velocity)(0.0, y, vortices.strengths(5)))
    across = np.stack([-y[:, 1], y[:, 0], 0 * y[:, 0]], axis=-1)
    speed = np.sum(rate * across, axis=1) / np.sum(across**2, axis=1)
    np.testing.assert_allclose(rate, np.mean(speed) * across, rtol=0, atol=1e-15)
    assert abs(np.mean(speed)) > 0.1
    np.testing.assert_array_equal(np.sign(y[:, 2]), vortices.strengths(5))


def test_order_and_what_is_kept():
    start, strengths = jnp.asarray(vortices.y0(2, shift=0.2)), jnp.asarray(vortices.strengths(2))
    answer = vortices.reference(T, np.asarray(start), np.asarray(strengths))
    first, errors = moving(start, strengths), []
    for pieces in (1, 2):
        k = 30 * pieces
        given = vortices.rounds(4), cfjax.BlanesMoan4(), 0.0, T, start, strengths, 30
        y = problems.in_pieces(*given, pieces)
        errors.append(np.linalg.norm(y - answer))
        energy, momentum = (
            abs(a - b).max() for a, b in zip(moving(y, strengths), first, strict=True)
        )
        # Rounding of a few numbers of size one in each step.
        np.testing.assert_allclose(np.linalg.norm(y, axis=1), 1, rtol=0, atol=1e-16 * k)
        assert momentum < 1e-16 * k
        assert 1e-13 < energy < errors[-1]
    # Far above the error of the reference.
    assert errors[1] > 1e-9
    assert 0.8 * 2**4 < errors[0] / errors[1] < 1.3 * 2**4


@jax.jit
def moving(y, strengths):
    return vortices.energy(y, strengths), vortices.momentum(y, strengths)


@pytest.mark.slow
def test_the_error_of_the_reference():
    given = vortices.problem()
    found = cfjax.integrate(solver=cfjax.RKMK8(), **given, num_steps=1000).ys[-1]
    answer = vortices.reference(vortices.t1, given["y0"], given["args"])
    assert np.linalg.norm(found - answer) < 3e-11
