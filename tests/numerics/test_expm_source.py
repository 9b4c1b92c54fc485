"""What a constant source adds to a congruence, beside exp(a): accuracy, derivatives, batches."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import DTYPES, backward_error, coefficients, exact_expm, of_norm, random
from xla.interpreter import run

from cfjax._numerics.expm import TAYLOR_SCHEMES
from cfjax._numerics.expm_source import _SMALLER, expm_parts_with_source


def with_source(a, q):
    weight, rest, g = expm_parts_with_source(a, q)
    return weight * (jnp.eye(a.shape[0], dtype=a.dtype) + a) + rest, g


mapped_with_source = jax.jit(jax.vmap(with_source))


def block(a, q):
    """Van Loan's."""
    b = np.block([[a, q], [np.zeros(a.shape), -a.conj().T]])
    return mpmath.matrix(b.tolist())


def exact_source(m, n):
    """Its entries. The block loses exp(2 |a|): 60 digits are enough up to a norm of 50."""
    with mpmath.workdps(60):
        e = exact_expm(m)
        return list(e[:n, n:] * e[:n, :n].H)


def test_norms_are_where_the_error_in_the_source_reaches_the_unit_roundoff():
    for precision, unit in [("float32", 2.0**-24), ("float64", 2.0**-53)]:
        for scheme in TAYLOR_SCHEMES[precision]:
            degree = 15 if scheme.powers == 2 else 21
            c = backward_error(coefficients(scheme), degree)
            theta = _SMALLER * scheme.theta
            # The derivative of a^k has k terms. A tenth: the factor suits the worst scheme.
            assert 0.1 * unit < sum(k * y * theta ** (k - 1) for k, y in enumerate(c) if y) <= unit


WITH_SOURCE = [
    *(("skew", norm) for norm in (0.0, 1e-12, 0.1, 0.55, 0.57, 1.3, 1.5, 10.0, 40.0)),
    *((kind, 2.0) for kind in ("general", "nilpotent", "double")),
    *(("negative", norm) for norm in (0.5, 30.0)),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [3, 6, 1])
def test_accuracy_with_a_source(n, dtype):
    a = np.stack([of_norm(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(WITH_SOURCE)])
    q = random((len(WITH_SOURCE), n, n), 7, dtype)
    found = map(np.asarray, mapped_with_source(a, q))
    wide = np.promote_types(dtype, np.float64)
    for case, a1, q1, e, g in zip(WITH_SOURCE, a, q, *found, strict=True):
        kind, norm = case
        growth = 1.0 if kind in ("skew", "negative") else np.exp(2 * norm)
        # As for expm: n units of rounding, doubled by each squaring, and what is not normal may
        # lose its growth. Of one number exp(-theta) cancels.
        bound = 2 * (n + 3) * np.finfo(dtype).eps * max(1.0, norm) * growth
        a1, q1 = a1.astype(wide), q1.astype(wide)
        assert g.dtype == dtype
        np.testing.assert_allclose(e, scipy.linalg.expm(a1), rtol=0, atol=bound, err_msg=str(case))
        exact = np.array(exact_source(block(a1, q1), n), complex).reshape(n, n)
        atol = bound * np.linalg.norm(q1)
        np.testing.assert_allclose(g, exact, rtol=0, atol=atol, err_msg=str(case))


def test_exact_at_zero_with_a_source():
    a, d = np.zeros((3, 3), complex), random((3, 3), 1, complex)
    q = random((3, 3), 2, complex)
    along = lambda *given: jax.jvp(expm_parts_with_source, given, (d, q))  # noqa: E731
    (weight, rest, g), tangents = run(along, a, q)
    assert weight == 1
    np.testing.assert_array_equal(rest, np.zeros((3, 3)))
    np.testing.assert_array_equal(g, q)
    # d/da of the integral at zero, a unit of rounding of each of four terms.
    want = (d @ q + q @ d.conj().T) / 2 + q
    np.testing.assert_allclose(tangents[2], want, rtol=0, atol=4 * 2.0**-52 * 10)


def test_semidefinite_stays_semidefinite_and_what_is_not_finite_with_its_member():
    """A source of rank one, so that three eigenvalues of the integral are small or zero."""
    norms = [0.0, 1e-6, 0.1, 1.0, 5.0, 30.0]
    a = np.stack([of_norm("general" if norm < 3 else "negative", 4, norm) for norm in norms])
    v = random((4, 1), 3)
    q = np.stack([v @ v.T] * len(a))
    found = np.asarray(mapped_with_source(a, q)[1])
    for g in found:
        least = np.linalg.eigvalsh((g + g.T) / 2).min()
        # 20 units of rounding of the whole.
        assert least >= -20 * 2.0**-52 * max(np.linalg.norm(g), np.linalg.norm(q[0]))
    a[0, 0, 1], q[1, 1, 1] = np.nan, np.inf
    g = np.asarray(mapped_with_source(a, q)[1])
    assert np.isnan(g[0]).all() and not np.isfinite(g[1]).all()
    np.testing.assert_array_equal(g[2:], found[2:])
