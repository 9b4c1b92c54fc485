"""Exponentials of 2 x 2 and 3 x 3 matrices: accuracy, units, meeting eigenvalues, unitarity."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from matrices import DTYPES, POSE, backward_error, exact_expm, random, small, to_numpy
from xla.interpreter import run

from cfjax import LeftMatrix, expm
from cfjax._numerics import cayley_hamilton

mapped = jax.jit(jax.vmap(expm))

KINDS = ["skew", "meet", "phase", "cycle", "negative", "nilpotent", "double", "general"]
NORMS = [0.0, 1e-8, 1e-3, 0.3, 0.8, 1.0, 1.3, 1.7, 2.5, 30.0, 1e3]
CASES = [
    (kind, norm, seed)
    for kind in KINDS
    for norm in NORMS
    for seed in range(2)
    # What grows overflows beyond.
    if norm < 31 or kind in ("skew", "negative")
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [2, 3])
def test_accuracy(n, dtype):
    a = np.stack([small(kind, n, norm, seed, dtype) for kind, norm, seed in CASES])
    wide = np.promote_types(dtype, np.float64)
    for case, x, e in zip(CASES, a, np.asarray(mapped(a)), strict=True):
        kind, norm, _ = case
        # SciPy's double precision is exact enough for single.
        is_single = np.finfo(dtype).bits == 32
        exact = scipy.linalg.expm(x.astype(wide)) if is_single else to_numpy(exact_expm(x))
        condition = 1.0
        if kind not in ("skew", "negative"):
            condition = scipy.linalg.expm_cond(x.astype(wide)) if norm else 1.0
        # The polynomial and the product: up to 1.4 units were seen. Every squaring doubles it. What
        # is not normal may lose its condition number.
        bound = n * np.finfo(dtype).eps * max(1.0, norm, condition)
        error = np.linalg.norm(e - exact, 2) / np.linalg.norm(exact, 2)
        assert e.dtype == dtype
        assert error <= bound, (case, error / bound)


def test_a_change_of_units_changes_no_digit():
    """Powers of two are exact. A norm would ask for 40 squarings."""
    for n in (2, 3):
        a = np.stack([small(kind, n, 0.5) for kind in KINDS if kind != "nilpotent"])
        units = 2.0 ** np.array([40, 0, -7])[:n]
        e, moved = run(mapped, a), run(mapped, a * units[:, None] / units)
        np.testing.assert_array_equal(moved, e * units[:, None] / units)


def test_the_motion_of_a_pose_far_away():
    found = run(expm, POSE)
    np.testing.assert_allclose(found, to_numpy(exact_expm(POSE)), rtol=4 * 2.0**-52)
    assert np.array_equal(found[2], [0, 0, 1])


def test_members_have_their_own_scaling():
    norms = [1e-8, 0.5, 3.0, 2e4, 0.0]
    batch = np.stack([small("skew", 3, norm, k) for k, norm in enumerate(norms)])
    for e, a, norm in zip(run(mapped, batch), batch, norms, strict=True):
        # As in test_accuracy. With the scaling of the largest this would be 2e4 times as much.
        error = np.linalg.norm(e - to_numpy(exact_expm(a)), 2)
        assert error <= 4 * 3 * 2.0**-52 * max(1.0, norm)


@jax.jit
@jax.vmap
def derivatives(a, d, w):
    """Forwards, backwards, and the second along d."""
    pushed = jax.jvp(expm, (a,), (d,))[1]
    pulled = jax.vjp(expm, a)[1](w)[0]

    def slope(t):
        value = lambda t: jnp.sum(jnp.real(w * expm(a + t * d)))  # noqa: E731
        return jax.grad(value)(t)

    return pushed, pulled, jax.grad(slope)(0.0)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.float64, np.complex128])
@pytest.mark.parametrize("n", [2, 3])
def test_derivatives(n, dtype):
    cases = [(kind, norm) for kind in ("skew", "meet") for norm in (0.0, 1e-9, 0.5, 1.3, 30.0)]
    cases += [("phase", 1.0), ("double", 1.0), ("nilpotent", 2.0), ("general", 1.5)]
    a = np.stack([small(kind, n, norm, k, dtype) for k, (kind, norm) in enumerate(cases)])
    if not np.issubdtype(dtype, np.complexfloating):
        # The exponential of symmetric ones with a large norm grows.
        keep = [k for k, (kind, norm) in enumerate(cases) if not (kind == "meet" and norm > 2)]
        cases, a = [cases[k] for k in keep], a[keep]
    d, w = (random((len(a), n, n), seed, dtype) / n for seed in (8, 9))
    found = run(derivatives, a, d, w)
    h = mpmath.mpf(10) ** -15
    for case, x, direction, weights, *got in zip(cases, a, d, w, *found, strict=True):
        growth = np.exp(np.linalg.norm((x + x.conj().T) / 2, 2))
        # Each factor exp of a derivative is off as in test_accuracy: two of them, or three.
        bound = 2 * 4 * n * 2.0**-52 * max(1.0, case[1]) * growth**2
        exact = scipy.linalg.expm_frechet(x, direction, compute_expm=False)
        assert np.linalg.norm(got[0] - exact, 2) <= 2 * bound, case
        # The transpose of L(a, .) is L(a^T, .), for complex matrices as well.
        exact = scipy.linalg.expm_frechet(x.T, weights, compute_expm=False)
        assert np.linalg.norm(got[1] - exact, 2) <= 2 * bound, case
        # Differences in 60 digits: an error of 1e-30.
        with mpmath.workdps(60):
            m, step = (mpmath.matrix(y.tolist()) for y in (x, direction))
            ends = [exact_expm(m + t * step) for t in (h, 0, -h)]
            second = to_numpy((ends[0] - 2 * ends[1] + ends[2]) / h**2)
        exact = np.sum(np.real(weights * second))
        assert abs(got[2] - exact) <= 3 * n * bound * growth, case


@pytest.mark.slow
def test_derivatives_are_finite_beside_large_members():
    """One member of the batch needs squaring."""
    a = np.stack([small("skew", 3, norm) for norm in (1e3, 0.0, 1e-200, 1.0, 1e6)])
    d = random(a.shape, 3, complex)
    assert all(np.isfinite(x).all() for x in derivatives(a, d, d))


@jax.jit
def after_many(a, b):
    """The product of a million exponentials, no two alike."""
    n = a.shape[0]

    def step(k, y):
        return LeftMatrix(a * jnp.cos(1.0 * k) + b * jnp.sin(1.7 * k)).flow(y)

    return jax.lax.fori_loop(0, 1_000_000, step, jnp.eye(n, dtype=a.dtype))


@pytest.mark.slow
@pytest.mark.parametrize("norm", [0.03, 1.0])
def test_a_million_products_stay_unitary(norm):
    a, b = (small("skew", 3, norm, seed) for seed in (1, 2))
    a, b = (x - np.trace(x) / 3 * np.eye(3) for x in (a, b))
    y = np.asarray(after_many(a, b))
    # Random units of rounding, in each of 18 numbers: 2^-53 (18 10^6)^½ = 4.7e-13.
    assert np.linalg.norm(y.conj().T @ y - np.eye(3)) <= 5e-13


def test_degrees_of_sizes_2_and_3_are_enough():
    for precision, norm, unit in (("float32", 1.7, 2.0**-24), ("float64", 1.8, 2.0**-53)):
        degree = cayley_hamilton._DEGREE[precision]
        log = backward_error([0] * (degree + 1), degree)
        assert sum(c * norm ** (k - 1) for k, c in enumerate(log)) <= unit
