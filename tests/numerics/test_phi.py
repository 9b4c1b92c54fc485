"""phi_1, as `cfjax.Affine` moves the origin by it: every argument, derivatives, not finite ones.

Then all of phi_0 to phi_5.
"""

import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from xla.interpreter import run

import cfjax

ORDERS = 3
# On both sides of every switch between the formulas, which are at 1/1024, 1, 2 and 3.
SWITCHES = [k * d for k in (2**-10, 1, 2, 3) for d in (1 - 1e-9, 1, 1 + 1e-9)]
MAGNITUDES = np.array([1e-300, 1e-20, 1e-9, 1e-3, 0.3, 0.999, *SWITCHES, 1.5, 2.5, 5, 20, 80])
LARGE = np.array([-1e4, -1e8, -1e30])
DIRECTIONS = {
    "negative": -1,
    "positive": 1,
    "imaginary": 1j,
    "left": -0.8 + 0.6j,
    "right": 0.8 - 0.6j,
}
REAL = {"negative": -1, "positive": 1}


def phi_1(z):
    """Where the flow of `x' = z x + 1` leads zero, entry by entry."""
    return cfjax.Affine(jnp.ones_like(z), z).flow(jnp.zeros_like(z))


def exact(z, order):
    """The integral of s^order exp(s z) over s from 0 to 1, by its series or its recursion."""
    with mpmath.workdps(60):
        z = mpmath.mpmathify(z)
        if abs(z) < 4:
            terms, power, j = [], mpmath.mpf(1), 0
            while j < 80:
                terms.append(power / (mpmath.factorial(j) * (order + j + 1)))
                power, j = power * z, j + 1
            return complex(mpmath.fsum(terms))
        value = (mpmath.exp(z) - 1) / z
        for m in range(1, order + 1):
            value = (mpmath.exp(z) - m * value) / z
        return complex(value)


def derivatives(z):
    """The value and three derivatives, from one nest of forward modes."""

    def deeper(f):
        return lambda z: jax.jvp(f, (z,), (jnp.ones_like(z),))

    ((value, first), (_, second)), (_, (_, third)) = deeper(deeper(deeper(phi_1)))(z)
    return jnp.stack([value, first, second, third])


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.complex64, np.complex128])
def test_value_and_three_derivatives(dtype):
    directions = DIRECTIONS if np.issubdtype(dtype, np.complexfloating) else REAL
    z = np.concatenate([[0], *(d * MAGNITUDES for d in directions.values()), LARGE])
    eps = np.finfo(dtype).eps
    z = z.astype(dtype)
    found = np.asarray(jax.jit(derivatives)(z)).astype(complex)
    assert not np.any(np.isnan(found))
    for order in range(ORDERS + 1):
        wanted = np.array([exact(complex(x), order) for x in z])
        # A few units of rounding. On the imaginary axis the integrand turns and the integral is
        # smaller than what is added up, which is exp(z) / z; XLA's own exponential of a complex
        # number has the error of its angle.
        size = np.maximum(
            np.abs(wanted), np.abs(np.exp(z.astype(complex)) / np.maximum(np.abs(z), 1))
        )
        limit = np.where(np.imag(z) == 0, 4, 12) * eps * size
        # Below the smallest normal number XLA on a CPU gives zero.
        limit = limit + np.finfo(dtype).tiny
        worst = np.argmax(np.abs(found[order] - wanted) / limit)
        assert abs(found[order] - wanted)[worst] <= limit[worst], (order, z[worst])


def test_forward_and_reverse_mode_agree():
    """And in reverse at zero the series gives `phi_1^(k)(0) = 1 / (k + 1)`."""
    z = jnp.asarray(np.concatenate([[0.0], -MAGNITUDES, MAGNITUDES[:-1]]))
    slope = jax.grad(phi_1)

    @jax.vmap
    def everything(z):
        forward = jax.jvp(phi_1, (z,), (jnp.ones_like(z),))[1]
        return phi_1(z), forward, slope(z), jax.grad(slope)(z), jax.jacfwd(slope)(z)

    value, forward, reverse, twice, mixed = run(everything, z)
    # The same formula in both.
    np.testing.assert_allclose(forward, reverse, rtol=1e-15)
    np.testing.assert_allclose(twice, mixed, rtol=1e-15)
    for k, found in enumerate((value, reverse, twice)):
        # To the rounding of one division.
        assert float(found[0]) == pytest.approx(1 / (k + 1), rel=2.0**-52)


@pytest.mark.slow
def test_second_reverse_pass_through_a_checkpointed_loop():
    """A loop may lose the rule of the derivative, and then differentiates what is inside."""

    def f(z):
        step = jax.checkpoint(lambda x, _: (x * phi_1(z), None))
        return jax.lax.scan(step, 1.0, None, length=3)[0]

    for z in (0.0, 0.3, -0.99, -5.0):
        p, p1, p2 = (exact(z, k).real for k in range(3))
        wanted = 3 * p**2 * p2 + 6 * p * p1**2
        found = jax.grad(jax.grad(f))(z)
        assert float(found) == pytest.approx(wanted, rel=1e-13)


def test_phi_1_of_nan_infinity_and_what_overflows():
    for dtype in (np.float32, np.float64):
        found = run(phi_1, np.asarray([np.nan, -np.inf, np.inf, 1e4], dtype))
        assert np.isnan(found[0])
        assert found[1] == 0
        assert not np.any(np.isfinite(found[2:]))


def test_shapes():
    for shape in ((), (0,), (2, 3)):
        z = jax.ShapeDtypeStruct(shape, float)
        assert jax.eval_shape(phi_1, z).shape == shape


# phi_k, as exported.


def exact_phi(k, z):
    with mpmath.workdps(60):
        z = mpmath.mpmathify(complex(z))
        if abs(z) < 8:
            return mpmath.fsum(z**j / mpmath.factorial(j + k) for j in range(120))
        value = mpmath.exp(z)
        for m in range(k):
            value = (value - 1 / mpmath.factorial(m)) / z
        return value


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.complex64, np.complex128])
def test_phi_against_sixty_digits(dtype):
    """On both sides of the switch at 4, and to 1e5 in the left half plane and on its edge."""
    is_complex = np.issubdtype(dtype, np.complexfloating)
    rng = np.random.default_rng(0)
    sizes = np.concatenate([[0], 10 ** rng.uniform(-8, 5, 40), rng.uniform(0, 12, 40), [3.9999, 4]])
    z = [-sizes, sizes[sizes < 20]]
    if is_complex:
        z += [1j * sizes, sizes * np.exp(1j * rng.uniform(np.pi / 2, 3 * np.pi / 2, len(sizes)))]
    z = np.concatenate(z).astype(dtype)
    units = 5 if np.finfo(dtype).eps < 1e-10 else 10
    for k in range(6):
        found = np.asarray(cfjax.phi(k, z))
        assert found.dtype == dtype
        for value, x in zip(found, z, strict=True):
            wanted = exact_phi(k, x)
            # XLA's own exponential of a complex number has the error of its angle, which phi_0 has
            # whole, and phi_1 as much as is left near its zeros.
            size = abs(wanted)
            if k < 2:
                size = max(size, abs(mpmath.exp(complex(x))) / max(abs(complex(x)), 1) ** k)
            if k == 0 and is_complex:
                continue
            off = abs(mpmath.mpmathify(complex(value)) - wanted)
            limit = units * float(np.finfo(dtype).eps) * size + float(np.finfo(dtype).tiny)
            assert off <= limit, (k, x, float(off / size))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_derivatives_of_phi(mode):
    """At zero those of the series, and elsewhere `phi_k' = phi_k - k phi_(k+1)`."""

    @jax.vmap
    def everything(z):
        functions = [lambda z, k=k: cfjax.phi(k, z) for k in range(6)]
        return [(f(z), mode(f)(z), mode(mode(f))(z)) for f in functions]

    at = (0.0, -30.0, -4.0, -3.9, 2.5)
    for k, found in enumerate(run(everything, np.asarray(at))):
        wanted = [math.factorial(j) / math.factorial(k + j) for j in range(3)]
        # A few units of rounding: the powers of a series, and two doublings.
        np.testing.assert_allclose([x[0] for x in found], wanted, rtol=0, atol=4e-16)
        for z, slope in zip(at[1:], found[1][1:], strict=True):
            # d/dz of the integral of exp((1 - s) z) s^(k-1) / (k-1)!: phi_k - k phi_(k+1).
            wanted = float((exact_phi(k, z) - k * exact_phi(k + 1, z)).real)
            # Terms of order one that cancel.
            assert float(slope) == pytest.approx(wanted, rel=1e-13, abs=4e-16)


def test_phi_refuses(no_shape_hook, subtests):
    dtypes = "float32, complex64, float64, complex128"
    for k, z, error, text in (
        (6, 1.0, ValueError, "k must be an integer from 0 to 5, got 6"),
        (-1, 1.0, ValueError, "k must be an integer from 0 to 5, got -1"),
        (True, 1.0, ValueError, "k must be an integer from 0 to 5, got True"),
        (2, 1, TypeError, f"z must be one of {dtypes}, got int64"),
    ):
        with subtests.test(case=text), pytest.raises(error, match=text):
            cfjax.phi(k, z)
