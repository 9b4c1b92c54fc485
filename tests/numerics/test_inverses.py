"""Inverses and inverse roots by products alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpmath import mp, mpf
from xla.interpreter import run

from cfjax._numerics.inverses import inverse_root, reciprocal

EXACT = {reciprocal: lambda x: 1 / x, inverse_root: lambda x: 1 / mp.sqrt(x)}


@pytest.mark.parametrize("dtype", ["float32", "float64", "bfloat16"])
@pytest.mark.parametrize("fun", EXACT)
def test_values(fun, dtype):
    """Over four powers of two, as all others differ in the exponent alone, and far from one."""
    x = np.concatenate([np.linspace(0.5, 8, 1001), [1e-30, 3e-12, 7e20]])
    x = np.asarray(jnp.asarray(x, dtype))
    found = np.asarray(run(fun, x)).astype(float)
    with mp.workdps(40):
        exact = [EXACT[fun](mpf(float(value))) for value in x]
        off = [abs(mpf(a) / b - 1) for a, b in zip(found.tolist(), exact, strict=True)]
    # Three roundings of about half a unit each, where units are eps or eps / 2.
    assert max(off) < 2 * float(jnp.finfo(dtype).eps)


@pytest.mark.parametrize("fun", EXACT)
def test_derivatives(fun):
    power = {reciprocal: -1, inverse_root: -0.5}[fun]
    for x in (0.3, 1.0, 5.0):
        first = run(jax.grad(fun), jnp.asarray(x))
        second = run(jax.grad(jax.grad(fun)), jnp.asarray(x))
        np.testing.assert_allclose(first, power * x ** (power - 1), rtol=1e-15)
        exact = power * (power - 1) * x ** (power - 2)
        np.testing.assert_allclose(second, exact, rtol=2e-15)
