"""phi_1 of a matrix times a vector, as `cfjax.LinearAffine` moves the origin by it: every norm."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import DTYPES, exact_expm, of_norm, random, to_numpy
from xla.interpreter import run

import cfjax


def phi_1_times(a, v):
    """Where the flow of `x' = a x + v` leads zero."""
    return cfjax.LinearAffine(a, v).flow(jnp.zeros_like(v))


mapped = jax.jit(jax.vmap(phi_1_times))


def block(a, v):
    n = len(a)
    return np.block([[a, v[:, None]], [np.zeros((1, n + 1))]])


def exact(a, v):
    with mpmath.workdps(60):
        return to_numpy(exact_expm(block(a, v))[: len(a), len(a)])[:, 0]


# On both sides of every bound of the series, and far beyond; 1-norms are up to sqrt(n) larger.
CASES = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.05, 0.2, 0.6, 1.2, 1.8, 3.0, 10.0, 100.0)),
    *((kind, norm) for kind in ("general", "nilpotent", "double") for norm in (0.5, 3.0)),
    *(("negative", norm) for norm in (1.0, 10.0, 1e3)),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [3, 6, 1])
def test_accuracy(n, dtype):
    a = np.stack([of_norm(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(CASES)])
    v = random((len(CASES), n), 7, dtype)
    found = mapped(a, v)
    assert found.dtype == dtype
    wide = np.promote_types(dtype, np.float64)
    for case, a1, v1, got in zip(CASES, a, v, found, strict=True):
        kind, norm = case
        # In a squaring exp doubles its error, and its product with what there is adds to that of
        # the vector, which is no less than that of exp: n units for each of log2(norm). What is
        # not normal may lose its growth.
        growth = 1.0 if kind in ("skew", "negative") else np.exp(2 * norm)
        bound = (n + 1) * np.finfo(dtype).eps * (4 + np.log2(1 + norm)) * growth
        a1, v1 = a1.astype(wide), v1.astype(wide)
        atol = bound * np.linalg.norm(v1)
        np.testing.assert_allclose(got, exact(a1, v1), rtol=0, atol=atol, err_msg=str(case))


alone = jax.jit(phi_1_times)


def test_alone_and_in_a_batch():
    """A branch of its own for each, and the branch of the largest."""
    norms = [0.0, 0.1, 1.0, 2.0, 30.0]
    a = np.stack([of_norm("skew", 3, norm) for norm in norms])
    v = random((5, 3))
    together = run(mapped, a, v)
    np.testing.assert_array_equal(together[0], v[0])
    for norm, a1, v1, found in zip(norms, a, v, together, strict=True):
        atol = 20 * 2.0**-52 * (1 + norm)
        np.testing.assert_allclose(run(alone, a1, v1), found, rtol=0, atol=atol)
    # What is not finite stays with its member.
    a[0, 0, 1], a[1, 0, 1] = np.nan, np.inf
    found = run(mapped, a, v)
    assert np.isnan(found[:2]).any(axis=1).all()
    np.testing.assert_array_equal(found[2:], together[2:])


def test_a_real_matrix_and_a_complex_vector():
    a, v = of_norm("general", 3, 1.0), random((3,), 1, complex)
    for scale in (1, 5):
        want = exact(scale * a, v)
        np.testing.assert_allclose(run(alone, scale * a, v), want, rtol=1e-14 * np.exp(2 * scale))


def test_against_scipy():
    a, v = of_norm("general", 20, 2.0), random((20,))
    want = scipy.linalg.expm(block(a, v))[:20, 20]
    # Growth e^2 for each, and 20 units for the sums.
    np.testing.assert_allclose(run(alone, a, v), want, rtol=0, atol=1e-13 * 8)
