"""The annealed chain: its operators, reference, norm, energy and fidelity."""

import functools
import itertools

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


@pytest.mark.parametrize("t", [0.0, 7.0, 20.0])
def test_the_field_is_the_hamiltonian(t):
    h = hamiltonian(np.sin(np.pi * t / 40) ** 2)
    rng = np.random.default_rng(0)
    y = jnp.asarray(rng.normal(size=2**N) + 1j * rng.normal(size=2**N))
    field, x = annealing.field(t, y), np.asarray(y)
    # Sums of some products of size 10.
    np.testing.assert_allclose(field.tangent(y), -1j * h @ x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(field.flow(y), scipy.linalg.expm(-1j * h) @ x, rtol=0, atol=1e-13)
    assert annealing.energy(t, y) == pytest.approx(np.vdot(x, h @ x).real, rel=1e-13)


def test_the_reference_against_short_exponentials():
    """The midpoint rule with dense exponentials, extrapolated: h^2, h^4 and h^6 are gone."""
    ends = []
    for num_steps in (100, 200, 400, 800):
        h, y = 3.0 / num_steps, annealing.y0(N)
        for k in range(num_steps):
            s = np.sin(np.pi * (k + 0.5) * h / 40) ** 2
            values, vectors = np.linalg.eigh(hamiltonian(s))
            y = vectors @ (np.exp(-1j * h * values) * (vectors.T @ y))
        ends.append(y)
    for factor in (4, 16, 64):
        ends = [(factor * b - a) / (factor - 1) for a, b in itertools.pairwise(ends)]
    # A tolerance of 1e-13 a step.
    np.testing.assert_allclose(annealing.reference(3.0, N), ends[0], rtol=0, atol=1e-11)


def test_order_and_norm_at_six_spins():
    exact = annealing.reference(annealing.t1, 6)
    errors = []
    for num_steps in (80, 160):
        sol = cfjax.integrate(
            TERM, cfjax.CF4(), 0.0, annealing.t1, annealing.y0(6), num_steps=num_steps
        )
        y = np.asarray(sol.ys[-1])
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
        sol = cfjax.integrate(TERM, cfjax.CF4(), 0.0, duration, start, duration, num_steps=150)
        y = sol.ys[-1]
        found.append(float(annealing.fidelity(y)))
        # Above the lowest by the gap, of at least 2, times what is not in it.
        left = float(annealing.energy(duration, y, duration)) - ground
        assert left >= 2 * (1 - found[-1])
    assert found[0] < 0.5 and found[1] > 0.99


def test_single_precision():
    y = annealing.y0(N).astype(np.complex64)
    found = annealing.field(np.float32(3), y).flow(jnp.asarray(y))
    assert found.dtype == np.complex64
    want = annealing.field(3.0, annealing.y0(N)).flow(jnp.asarray(annealing.y0(N)))
    np.testing.assert_allclose(found, want, rtol=0, atol=10 * 2.0**-23)
