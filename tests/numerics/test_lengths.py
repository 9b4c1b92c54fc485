"""The nearest vector of given length, against NumPy and the closed form of its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfjax._numerics.lengths import vector_of_length

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_the_end_has_the_length_of_the_start(n, subtests):
    def of(y, v):
        return jax.jit(vector_of_length, static_argnums=2)(jnp.asarray(y), jnp.asarray(v), False)

    for size in (1e-8, 1e-3, 0.3):
        y, v = RNG.normal(size=(2, n))
        v *= size * np.linalg.norm(y) / np.linalg.norm(v)
        found, is_there = of(y, v)
        z = y + v
        expected = z * np.linalg.norm(y) / np.linalg.norm(z) - y
        with subtests.test(size=size):
            assert is_there
            # The expected one has roundings of y, the found one of the size of v.
            np.testing.assert_allclose(found, expected, rtol=0, atol=8e-16 * np.linalg.norm(y))
            assert abs((2 * y + found) @ found) < 1e-15 * (y @ y) * size + 1e-30
    found, is_there = of(y, 0 * y)
    np.testing.assert_array_equal(found, 0 * y)
    found, is_there = of(0 * y, 0 * y)
    assert is_there
    np.testing.assert_array_equal(found, 0 * y)


def test_it_leads_to_length_one():
    y = RNG.normal(size=4)
    y /= np.linalg.norm(y) * (1 + 1e-9)
    v = 0.1 * RNG.normal(size=4)
    found, _ = vector_of_length(jnp.asarray(y), jnp.asarray(v), True)
    assert abs(np.linalg.norm(y + found) - 1) < 3e-16


@pytest.mark.parametrize("n", [3, 6])
def test_a_length_of_before_is_restored(n):
    start, v = jnp.asarray(RNG.normal(size=(2, n)))
    y = start * (1 + 1e-9)
    found, _ = vector_of_length(y, 0.1 * v, False, start @ start)
    # Two roundings of the length.
    assert abs(np.linalg.norm(y + found) / np.linalg.norm(start) - 1) < 5e-16


def test_there_is_none_more_than_half_of_the_length_away():
    y = jnp.asarray([0.0, 2.0, 0.0])
    for factor, expected in [(0.66, False), (0.67, True), (1.99, True), (2.01, False)]:
        found, is_there = vector_of_length(y, (factor - 1) * y, False)
        assert is_there == expected
        assert np.isfinite(found).all()
    assert not vector_of_length(y, jnp.nan * y, False)[1]


def test_the_derivative_is_the_part_along_the_sphere():
    y = jnp.asarray([0.0, 2.0, 0.0])
    of_v = jax.jacobian(lambda v: vector_of_length(y, v, False)[0])(jnp.zeros(3))
    np.testing.assert_allclose(of_v, np.diag([1.0, 0.0, 1.0]), rtol=0, atol=1e-15)
    far = jax.jacobian(lambda v: vector_of_length(y, v, False)[0])(-y)
    assert np.isfinite(far).all()
