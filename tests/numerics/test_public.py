"""The kernels that fields of one's own need, as they are exported."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [0, 1, 3])
def test_stumpff_takes_arrays_of_numpy_and_a_batch(n):
    s = np.array([[0.0, 0.25], [1.0, 4.0]], np.float32)
    x = np.sqrt(s.astype(float))
    expected = {0: np.cos(x), 1: np.sinc(x / np.pi), 3: None}[n]
    if expected is None:
        expected = np.where(x > 0, (x - np.sin(x)) / np.where(x > 0, x, 1) ** 3, 1 / 6)
    found = cfjax.stumpff(n, s)
    assert found.dtype == s.dtype
    # Some units of rounding of numbers of order one.
    np.testing.assert_allclose(found, expected, rtol=0, atol=8 * 2.0**-24)
    batch = jax.vmap(lambda s: cfjax.stumpff(n, s))(jnp.asarray(s))
    np.testing.assert_allclose(batch, found, rtol=0, atol=8 * 2.0**-24)


def test_stumpff_of_a_negative_number_is_nan():
    s = jnp.array([-1.0, -1e-300, 0.0])
    np.testing.assert_array_equal(np.isnan(cfjax.stumpff(1, s)), [True, True, False])
    # And it does not spread: the derivatives at zero are those of the series.
    slope = jax.grad(lambda s: jnp.nansum(cfjax.stumpff(1, s)))(s)
    np.testing.assert_allclose(slope[2], -1 / 6, rtol=2.0**-50)


@pytest.mark.parametrize(
    "n, s, error, message",
    [
        (1.0, np.ones(2), TypeError, "n must be an int, got 1.0 of type float"),
        (True, np.ones(2), TypeError, "n must be an int, got True of type bool"),
        (-1, np.ones(2), ValueError, "n must be at least 0, got -1"),
        (1, np.ones(2, int), TypeError, "s must be float32 or float64, got int64"),
        (1, np.ones(2, complex), TypeError, "s must be float32 or float64, got complex128"),
    ],
)
def test_stumpff_refuses(no_shape_hook, n, s, error, message):
    with pytest.raises(error, match=message):
        cfjax.stumpff(n, s)


def test_expm(no_shape_hook):
    a = np.array([[0.0, -0.5], [0.5, 0.0]])
    expected = [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    np.testing.assert_allclose(cfjax.expm(a), expected, rtol=0, atol=1e-15)
    slope = jax.jvp(lambda t: cfjax.expm(t * a), (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, a, rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match=r"`a` must be a square matrix, shape \(n, n\), got"):
        cfjax.expm(np.ones((2, 3)))
