"""The spectral radius of a field by power iteration, against eigenvalues of dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax

# The growth in the last of 30 iterations is too small by a few hundredths at most, on spectra that
# are dense at their end.
LOW, HIGH = 0.95, 1 + 1e-12


def found(field, y, args=None, t=0.0):
    return np.asarray(cfjax.spectral_radius(cfjax.LieTerm(field), t, y, args))


def of_dense(field, y):
    jacobian = jax.jacobian(field)(y).reshape(y.size, y.size)
    return np.abs(np.linalg.eigvals(np.asarray(jacobian))).max()


def conductivity(n):
    """Between cells with conductivity i (n - i): the radius is n (n - 1) exactly."""
    k = jnp.asarray([i * (n - i) for i in range(1, n)], float)

    def field(t, y, args):
        flux = jnp.pad(k * jnp.diff(y), 1)
        return jnp.diff(flux)

    return field


@pytest.mark.parametrize("n", [8, 32])
def test_spectral_radius_of_diffusion_with_a_known_spectrum(n):
    y = jnp.zeros(n)
    assert LOW < found(conductivity(n), y) / (n * (n - 1)) < HIGH


def test_power_iteration_finds_a_mode_that_the_first_field_has_no_part_in():
    """From a symmetric state all fields are symmetric, and the stiffest mode is antisymmetric."""
    n = 16
    field = conductivity(n)
    y = (jnp.arange(float(n)) - (n - 1) / 2) ** 2
    first = field(0.0, y, None)
    np.testing.assert_allclose(first, first[::-1], rtol=0, atol=1e-12)
    # The stiffest of the symmetric modes has (n - 2)(n - 1), which is 0.875 of it.
    assert LOW < found(field, y) / (n * (n - 1)) < HIGH


def test_spectral_radius_of_a_nonlinear_field_depends_on_time_state_and_args():
    n = 12

    def field(t, y, args):
        w = y**2 * args * (1 + t)
        return jnp.roll(w, 1) - 2 * w + jnp.roll(w, -1)

    y = jnp.asarray(1 + np.random.default_rng(0).random(n))
    expected = of_dense(lambda y: field(1.0, y, 3.0), y)
    assert LOW < found(field, y, 3.0, 1.0) / expected < HIGH
    assert LOW < found(field, 10 * y, 3.0, 1.0) / (10 * expected) < HIGH


def test_spectral_radius_of_a_complex_state():
    rng = np.random.default_rng(1)
    d = -np.geomspace(1, 30, 6) + 0j
    v = np.linalg.qr(rng.normal(size=(6, 6)) + 1j * rng.normal(size=(6, 6)))[0]
    matrix = jnp.asarray(v @ np.diag(d) @ v.conj().T)
    value = found(lambda t, y, args: matrix @ y, jnp.ones(6, complex))
    np.testing.assert_allclose(value, 30, rtol=1e-6)


def spins(t, y, args):
    """Spins on a square lattice that turn towards their neighbours."""
    near = sum(jnp.roll(y, shift, axis) for axis in (0, 1) for shift in (1, -1))
    return cfjax.Rotation(args * jnp.cross(y, near))


def test_spectral_radius_on_a_manifold():
    """Aligned spins have a Laplacian, whose radius is 8; the frame has more coordinates."""
    up = jnp.zeros((6, 6, 3)).at[..., 2].set(1.0)
    assert LOW < found(spins, up, jnp.asarray(1.0)) / 8 < HIGH


def test_spectral_radius_of_a_product():
    def field(t, y, args):
        return {"spins": spins(t, y["spins"], args), "heat": conductivity(8)(t, y["heat"], args)}

    up = jnp.zeros((4, 4, 3)).at[..., 2].set(1.0)
    y = {"spins": up, "heat": jnp.arange(8.0)}
    assert LOW < found(field, y, jnp.asarray(1.0)) / 56 < HIGH
    assert LOW < found(field, y, jnp.asarray(50.0)) / 400 < HIGH


def test_spectral_radius_in_single_precision_and_of_nothing():
    y = jnp.zeros(8, np.float32)
    value = found(lambda t, y, args: -jnp.arange(8, dtype=np.float32) * y, y, t=jnp.zeros((), "f4"))
    assert value.dtype == np.float32
    np.testing.assert_allclose(value, 7, rtol=1e-3)
    assert found(lambda t, y, args: 0 * y, y) == 0
    # The same start each time.
    assert value == found(lambda t, y, args: -jnp.arange(8, dtype=np.float32) * y, y)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_a_radius_whose_square_is_no_number_in_single_precision(scale):
    """Which is zero or infinite."""
    rates = scale * np.arange(1, 9, dtype=np.float32)
    y = jnp.zeros(8, np.float32)
    value = found(lambda t, y, args: -rates * y, y, t=jnp.zeros((), "f4"))
    np.testing.assert_allclose(value, 8 * scale, rtol=1e-3)


def test_spectral_radius_without_x64():
    """In JAX's default settings, in which integers have 32 bits."""
    term = cfjax.LieTerm(lambda t, y, args: -jnp.arange(1, 5, dtype=y.dtype) * y)
    jax.config.update("jax_enable_x64", False)
    try:
        radius = cfjax.spectral_radius(term, 0.0, jnp.ones(4))
    finally:
        jax.config.update("jax_enable_x64", True)
    # The rates are 1 to 4, and 30 rounds leave (3/4)^60 of the others.
    np.testing.assert_allclose(radius, 4, rtol=1e-5)


def test_the_derivative_of_a_spectral_radius_is_zero():
    def radius(a):
        return cfjax.spectral_radius(cfjax.LieTerm(lambda t, y, args: -a * y), 0.0, jnp.ones(3))

    assert radius(2.0) == pytest.approx(2)
    assert jax.grad(radius)(2.0) == 0
