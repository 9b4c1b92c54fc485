"""The ferromagnet: lengths, energy, and its references."""

import jax
import jax.numpy as jnp
import numpy as np
import problems

import cfjax
from cfjax.scenes import spins

TERM = cfjax.LieTerm(spins.field)
ARGS = spins.Magnet()
FIELD_ALONE = spins.Magnet(anisotropy=0.0, applied=(0.0, 0.0, 1.3), damping=0.2)


def ends(t, start, args, *num_steps):
    given = problems.arrays((0.0, t, start, args))
    return [
        np.asarray(problems.many_steps(spins.field, cfjax.CF4(), *given, jnp.asarray(n)))
        for n in num_steps
    ]


def test_the_macrospin_against_its_closed_form():
    for z in (0.8, -0.8):
        start = np.array([0.6, 0.0, z])
        for t in (1.0, 5.0):
            want = spins.macrospin(t, start, FIELD_ALONE)
            found = ends(t, start, FIELD_ALONE, int(10 * t), int(20 * t))
            errors = [np.abs(y - want).max() for y in found]
            # Order 4 gives 16, and more where the next order has not gone yet.
            assert 14 < errors[0] / errors[1] < 20
            assert errors[1] < 1e-6


def test_the_closed_form_starts_and_moves_as_the_equation_says():
    start = np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(spins.macrospin(0.0, start, FIELD_ALONE), start, rtol=0, atol=1e-15)
    # Truncation h^2 / 6 and rounding eps / h.
    h = 1e-5
    t = np.linspace(0.0, 9.0, 10)
    slope = spins.macrospin(t + h, start, FIELD_ALONE) - spins.macrospin(t - h, start, FIELD_ALONE)
    s = spins.macrospin(t, start, FIELD_ALONE)
    b = np.array([0.0, 0.0, 1.3])
    precession = np.cross(s, b)
    want = -(precession + 0.2 * np.cross(s, precession)) / 1.04
    np.testing.assert_allclose(slope / (2 * h), want, rtol=0, atol=1e-10)


def test_the_lattice_against_dop853_and_its_energy_without_damping():
    start = spins.y0(3, 4)
    reference = spins.reference(2.0, start, ARGS)
    errors = [np.abs(y - reference).max() for y in ends(2.0, start, ARGS, 40, 80)]
    assert 14 < errors[0] / errors[1] < 19
    assert errors[1] < 1e-6
    args = ARGS._replace(damping=0.0)
    energy = jax.jit(spins.energy)
    kept = energy(start, args)
    off = [abs(energy(y, args) - kept) for y in ends(5.0, start, args, 100, 200)]
    assert 10 < off[0] / off[1]
    assert off[1] < 1e-5


def test_lengths_are_kept_and_energy_falls():
    start = spins.y0(3, 4)
    ys = cfjax.integrate(TERM, cfjax.CF4(), 0, 40, start, ARGS, num_steps=400, save_every=1).ys
    # Sums over the steps are compensated. What is left is rounding of the entries and the norm.
    np.testing.assert_allclose(np.linalg.norm(ys, axis=-1), 1, rtol=0, atol=8e-16)
    energies = jax.jit(jax.vmap(spins.energy, in_axes=(0, None)))(ys, ARGS)
    assert np.all(np.diff(energies) <= 0)
    # All spins end up: -2 for the bonds of each, and its own part.
    assert energies[-1] < 0.9 * 12 * (-2 - 0.1 - 0.1)


def test_the_effective_field_is_minus_the_derivative_of_the_energy():
    def both(y):
        return spins.effective_field(y, ARGS), -jax.grad(spins.energy)(y, ARGS)

    # Some sums of a handful of terms.
    np.testing.assert_allclose(*jax.jit(both)(spins.y0(3, 4)), rtol=0, atol=1e-14)
