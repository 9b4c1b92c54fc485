"""The annealed chain: its operators, reference, norm, energy and fidelity."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import cfjax
from cfjax.scenes import annealing

TERM = cfjax.LieTerm(annealing.field)
N = 4


def hamiltonian(s, n=N):
    """From Pauli matrices, spin by spin."""
    x, z, one = np.array([[0, 1], [1, 0]]), np.diag([1, -1]), np.eye(2)

    def product(**paulis):
        return functools.reduce(np.kron, [paulis.get(f"s{j}", one) for j in range(n)])

    flips = sum(product(**{f"s{j}": x}) for j in range(n))
    pairs = sum(product(**{f"s{j}": z, f"s{j + 1}": z}) for j in range(n - 1))
    single = sum(product(**{f"s{j}": z}) for j in range(n))
    return -(1 - s) * flips - s * (pairs + annealing.longitudinal * single)


def test_the_field_is_the_hamiltonian():
    @jax.jit
    def parts(t, y):
        field = annealing.field(t, y)
        return field.tangent(y), field.flow(y), annealing.energy(t, y)

    rng = np.random.default_rng(0)
    x = rng.normal(size=2**N) + 1j * rng.normal(size=2**N)
    for t in (0.0, 7.0, 20.0):
        h = hamiltonian(np.sin(np.pi * t / 40) ** 2)
        tangent, flow, energy = parts(jnp.asarray(t), jnp.asarray(x))
        # Sums of some products of size 10.
        np.testing.assert_allclose(tangent, -1j * h @ x, rtol=0, atol=1e-13)
        np.testing.assert_allclose(flow, scipy.linalg.expm(-1j * h) @ x, rtol=0, atol=1e-13)
        assert float(energy) == pytest.approx(np.vdot(x, h @ x).real, rel=1e-13)
    # The last time, in single precision: entries of up to 3.
    _, found, _ = parts(jnp.asarray(t, np.float32), jnp.asarray(x, np.complex64))
    assert found.dtype == np.complex64
    np.testing.assert_allclose(found, flow, rtol=0, atol=30 * 2.0**-23)


def test_the_reference_against_short_exponentials():
    """The midpoint rule with dense exponentials, extrapolated: h^2, h^4 and h^6 are gone."""
    ends, (first, last) = [], (hamiltonian(0.0), hamiltonian(1.0))
    for num_steps in (100, 200, 400, 800):
        h, y = 3.0 / num_steps, annealing.y0(N)
        for k in range(num_steps):
            s = np.sin(np.pi * (k + 0.5) * h / 40) ** 2
            values, vectors = np.linalg.eigh((1 - s) * first + s * last)
            y = vectors @ (np.exp(-1j * h * values) * (vectors.T @ y))
        ends.append(y)
    for factor in (4, 16, 64):
        ends = [(factor * b - a) / (factor - 1) for a, b in itertools.pairwise(ends)]
    # A tolerance of 1e-13 a step.
    np.testing.assert_allclose(annealing.reference(3.0, N), ends[0], rtol=0, atol=1e-11)


def solve(y, duration, *times):
    """80 steps of CF4 from each time to the next one, which are one program for six spins."""
    for start, end in itertools.pairwise(times):
        y = cfjax.integrate(TERM, cfjax.CF4(), start, end, y, duration, num_steps=80).ys[-1]
    return np.asarray(y)


def test_order_and_norm_at_six_spins():
    exact, t1 = annealing.reference(annealing.t1, 6), annealing.t1
    errors = []
    for times in ((0.0, t1), (0.0, t1 / 2, t1)):
        y = solve(annealing.y0(6), t1, *times)
        errors.append(np.linalg.norm(y - exact))
        # Compensated sums: no walk of roundings.
        assert abs(np.linalg.norm(y) - 1) < 1e-14
    # Order 4, from both sides, with a tenth for the next order.
    assert 14 < errors[0] / errors[1] < 18
    assert errors[1] < 1e-6


def test_a_slow_ramp_ends_in_the_ground_state():
    n, start = 6, annealing.y0(6)
    ground = np.linalg.eigvalsh(hamiltonian(1.0, n))[0]
    assert annealing.energy(0.0, start) == pytest.approx(-n, rel=1e-14)
    found = []
    for duration in (5.0, 80.0):
        y = solve(start, duration, 0.0, duration / 2, duration)
        found.append(float(annealing.fidelity(y)))
        # Above the lowest by the gap, of at least 2, times what is not in it.
        left = float(annealing.energy(duration, y, duration)) - ground
        assert left >= 2 * (1 - found[-1])
    assert found[0] < 0.5 and found[1] > 0.99
