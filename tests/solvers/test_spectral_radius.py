"""The spectral radius of a field by power iteration, against eigenvalues of dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax

# The growth in the last of 30 iterations is too small by a few hundredths at most, on spectra that
# are dense at their end.
LOW, HIGH = 0.95, 1 + 1e-12


def radius_of(field):
    """As a program of the state, the parameters and the time."""
    return jax.jit(
        lambda y, args=None, t=0.0: cfjax.spectral_radius(cfjax.LieTerm(field), t, y, args)
    )


def conductivity(t, y, args):
    """Between n cells with conductivity i (n - i): the radius is n (n - 1) exactly."""
    i = jnp.arange(1.0, len(y))
    return jnp.diff(jnp.pad(i * (len(y) - i) * jnp.diff(y), 1))


def test_spectral_radius_of_diffusion_with_a_known_spectrum():
    """Also where fields are symmetric, as the state is, and the stiffest mode antisymmetric."""
    n, found = 16, radius_of(conductivity)
    assert LOW < found(jnp.zeros(n)) / (n * (n - 1)) < HIGH
    y = (jnp.arange(float(n)) - (n - 1) / 2) ** 2
    first = conductivity(0.0, y, None)
    np.testing.assert_allclose(first, first[::-1], rtol=0, atol=1e-12)
    # The stiffest of the symmetric modes has (n - 2)(n - 1), which is 0.875 of it.
    assert LOW < found(y) / (n * (n - 1)) < HIGH


def test_spectral_radius_of_a_nonlinear_field_depends_on_time_state_and_args():
    n = 12

    def field(t, y, args):
        w = y**2 * args * (1 + t)
        return jnp.roll(w, 1) - 2 * w + jnp.roll(w, -1)

    y, found = 1 + np.random.default_rng(0).random(n), radius_of(field)
    # The derivative by hand.
    difference = np.roll(np.eye(n), 1, 0) - 2 * np.eye(n) + np.roll(np.eye(n), -1, 0)
    expected = np.abs(np.linalg.eigvals(difference * (2 * y * 3.0 * 2.0))).max()
    assert LOW < found(y, 3.0, 1.0) / expected < HIGH
    assert LOW < found(10 * y, 3.0, 1.0) / (10 * expected) < HIGH


def test_spectral_radius_of_a_complex_state():
    rng = np.random.default_rng(1)
    d = -np.geomspace(1, 30, 6) + 0j
    v = np.linalg.qr(rng.normal(size=(6, 6)) + 1j * rng.normal(size=(6, 6)))[0]
    matrix = jnp.asarray(v @ np.diag(d) @ v.conj().T)
    value = radius_of(lambda t, y, args: matrix @ y)(jnp.ones(6, complex))
    np.testing.assert_allclose(value, 30, rtol=1e-6)


def test_spectral_radius_of_a_product():
    """Spins on a square lattice that turn towards their neighbours, and diffusion. Aligned spins
    have a Laplacian, whose radius is 8; the frame has more coordinates.
    """

    def field(t, y, args):
        spins = y["spins"]
        near = sum(jnp.roll(spins, shift, axis) for axis in (0, 1) for shift in (1, -1))
        turn = cfjax.Rotation(args * jnp.cross(spins, near))
        return {"spins": turn, "heat": conductivity(t, y["heat"], None)}

    found = radius_of(field)
    y = {"spins": jnp.zeros((4, 4, 3)).at[..., 2].set(1.0), "heat": jnp.arange(8.0)}
    assert LOW < found(y, 1.0) / 56 < HIGH
    assert LOW < found(y, 50.0) / 400 < HIGH


def test_spectral_radius_in_single_precision_and_of_nothing():
    """Also where its square is no number: zero or infinite."""
    found = radius_of(lambda t, y, args: -args * y)
    rates = np.arange(1, 9, dtype=np.float32)
    for scale in (1.0, 1e-30, 1e30):
        value = found(jnp.zeros(8, np.float32), np.float32(scale) * rates, jnp.zeros((), "f4"))
        assert value.dtype == np.float32
        np.testing.assert_allclose(value, 8 * scale, rtol=1e-3)
    assert found(jnp.zeros(8, np.float32), 0 * rates, jnp.zeros((), "f4")) == 0


def test_spectral_radius_without_x64():
    """In JAX's default settings, in which integers have 32 bits."""
    term = cfjax.LieTerm(lambda t, y, args: -jnp.arange(1, 5, dtype=y.dtype) * y)
    jax.config.update("jax_enable_x64", False)
    try:
        radius = jax.jit(lambda y: cfjax.spectral_radius(term, 0.0, y))(np.ones(4, np.float32))
    finally:
        jax.config.update("jax_enable_x64", True)
    # The rates are 1 to 4, and 30 rounds leave (3/4)^60 of the others.
    np.testing.assert_allclose(radius, 4, rtol=1e-5)


def test_the_derivative_of_a_spectral_radius_is_zero():
    def radius(a):
        return cfjax.spectral_radius(cfjax.LieTerm(lambda t, y, args: -a * y), 0.0, jnp.ones(3))

    value, slope = jax.jit(jax.value_and_grad(radius))(2.0)
    assert value == pytest.approx(2) and slope == 0
