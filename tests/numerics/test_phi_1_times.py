"""phi_1 of a matrix times a vector, as `cfjax.LinearAffine` moves the origin by it: every norm."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import DTYPES, exact_expm, of_norm, random, to_numpy

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


def test_alone_and_in_a_batch():
    # A branch of its own for each, and the branch of the largest.
    norms = [0.0, 0.1, 1.0, 2.0, 30.0]
    a = np.stack([of_norm("skew", 3, norm) for norm in norms])
    v = random((5, 3))
    alone = jax.jit(phi_1_times)
    for norm, a1, v1, together in zip(norms, a, v, mapped(a, v), strict=True):
        atol = 20 * 2.0**-52 * (1 + norm)
        np.testing.assert_allclose(alone(a1, v1), together, rtol=0, atol=atol)


def test_a_real_matrix_and_a_complex_vector():
    a, v = of_norm("general", 3, 1.0), random((3,), 1, complex)
    for scale in (1, 5):
        got = jax.jit(phi_1_times)(scale * a, v)
        want = exact(scale * a, v)
        np.testing.assert_allclose(got, want, rtol=1e-14 * np.exp(2 * scale))


def test_exact_at_zero():
    v = random((3,))
    np.testing.assert_array_equal(mapped(np.zeros((1, 3, 3)), v[None])[0], v)


@pytest.mark.slow
def test_derivatives():
    d, v, r, w = random((3, 3), 1), *random((3, 3), 2)

    @jax.jit
    @jax.vmap
    def found(a):
        def value(t, s):
            return jnp.sum(w * phi_1_times(a + t * d, jnp.asarray(v + s * r)))

        slope = lambda t: jax.jvp(lambda t: value(t, t), (t,), (1.0,))[1]  # noqa: E731
        return *jax.jvp(slope, (0.0,), (1.0,)), jax.grad(value)(0.0, 0.0)

    norms = [0.0, 1e-12, 1.0, 10.0]
    a = np.stack([of_norm("skew", 3, norm) for norm in norms])
    h = mpmath.mpf(10) ** -15
    for norm, a1, first, second, pulled in zip(norms, a, *found(a), strict=True):
        with mpmath.workdps(60):
            w_row = mpmath.matrix([w.tolist()])

            # Differences in 60 digits: an error of 1e-30.
            def value(t, with_v=True, a1=a1, w_row=w_row):
                m = mpmath.matrix(block(a1, v).tolist())
                m += t * mpmath.matrix(block(d, r if with_v else 0 * r).tolist())
                return (w_row * exact_expm(m)[:3, 3])[0]

            ends = value(h), value(0), value(-h)
            want = (ends[0] - ends[2]) / (2 * h), (ends[0] - 2 * ends[1] + ends[2]) / h**2
            want_pulled = (value(h, False) - value(-h, False)) / (2 * h)
        # As for the value, with three factors of the size of exp.
        atol = 100 * 2.0**-52 * (1 + norm) * 10
        assert abs(first - float(want[0])) <= atol
        assert abs(second - float(want[1])) <= 10 * atol
        assert abs(pulled - float(want_pulled)) <= atol


def test_against_scipy():
    a, v = of_norm("general", 20, 2.0), random((20,))
    want = scipy.linalg.expm(block(a, v))[:20, 20]
    # Growth e^2 for each, and 20 units for the sums.
    np.testing.assert_allclose(jax.jit(phi_1_times)(a, v), want, rtol=0, atol=1e-13 * 8)


def test_not_finite_stays_with_its_member():
    a, v = random((4, 3, 3)), random((4, 3), 1)
    a[0, 0, 1], a[1, 0, 1] = np.nan, np.inf
    found = np.asarray(mapped(a, v))
    assert np.isnan(found[:2]).any(axis=1).all() and np.isfinite(found[2:]).all()
