"""Sums of operators: every kind of them, derivatives, solves, and what is refused."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.linalg
from jax.experimental.sparse import BCOO
from problems import QUICK

import cfjax
from cfjax import OperatorSum

N = 6
RNG = np.random.default_rng(0)
EPS = 2.0**-52


def symmetric():
    a = RNG.normal(size=(N, N))
    return (a + a.T) / np.linalg.norm(a + a.T, 2)


def operator_of(function, dtype=float):
    return lx.FunctionLinearOperator(function, jax.ShapeDtypeStruct((N,), dtype))


MATRICES = [symmetric() for _ in range(4)]
DIAGONALS = RNG.normal(size=(3, N))
REVERSE = operator_of(lambda x: x[::-1])
SPARSE = BCOO.fromdense(jnp.asarray(np.triu(MATRICES[1])))
KINDS = {
    "array": (MATRICES[0], MATRICES[0]),
    "diagonal": (DIAGONALS[0], np.diag(DIAGONALS[0])),
    "sparse": ((operator_of(lambda x: SPARSE @ x), 2.0), np.triu(MATRICES[1])),
    "lineax matrix": (lx.MatrixLinearOperator(jnp.asarray(MATRICES[2])), MATRICES[2]),
    "lineax diagonal": (
        lx.DiagonalLinearOperator(jnp.asarray(DIAGONALS[1])),
        np.diag(DIAGONALS[1]),
    ),
    "lineax sum": (
        (
            lx.MatrixLinearOperator(jnp.asarray(MATRICES[3]))
            + lx.DiagonalLinearOperator(jnp.asarray(DIAGONALS[2])),
            10.0,
        ),
        MATRICES[3] + np.diag(DIAGONALS[2]),
    ),
    "function": ((REVERSE, 1), np.eye(N)[::-1]),
}
OPERATORS = [operator for operator, _ in KINDS.values()]
DENSE = np.stack([matrix for _, matrix in KINDS.values()])
K = len(OPERATORS)
C = RNG.normal(size=K) / 2
X = RNG.normal(size=N) + 1j * RNG.normal(size=N)


@eqx.filter_jit
def flow(field, x):
    return field.flow(x)


@eqx.filter_jit
def moved(field, x):
    return field.flow(x), field.increment(x), field.tangent(x)


def test_every_kind_of_operator():
    """On columns: test_contract.py has vectors."""
    total, x = np.tensordot(C, DENSE, 1), np.stack([X.real, X.imag], 1)
    found, change, tangent = moved(OperatorSum(C, OPERATORS), x)
    # Some units of rounding of terms that are as large as the norms say.
    norms = np.linalg.norm(DENSE, 2, axis=(1, 2))
    scale = np.exp(np.abs(C) @ norms) * np.abs(x).sum() * EPS
    np.testing.assert_allclose(tangent, total @ x, rtol=0, atol=10 * scale)
    want = scipy.linalg.expm(total) @ x
    np.testing.assert_allclose(found, want, rtol=0, atol=20 * scale)
    np.testing.assert_allclose(change, want - x, rtol=0, atol=20 * scale)


def test_complex_numbers_and_single_precision():
    h, single = np.tensordot(C[:2], DENSE[:2], 1), [a.astype(np.float32) for a in OPERATORS[:2]]
    field = OperatorSum((-1j * C[:2]).astype(np.complex64), single, is_skew=True)
    found = flow(field, X.astype(np.complex64))
    assert found.dtype == np.complex64
    np.testing.assert_allclose(found, scipy.linalg.expm(-1j * h) @ X, rtol=0, atol=20 * 2.0**-23)
    # A function may be complex.
    operator = operator_of(lambda x: 1j * x[::-1], complex), 1.0
    field = OperatorSum([0.7, 0.2], [operator, 1j * DIAGONALS[0]], is_skew=True)
    total = 0.7j * np.eye(N)[::-1] + np.diag(0.2j * DIAGONALS[0])
    expected = scipy.linalg.expm(total) @ X
    np.testing.assert_allclose(flow(field, X), expected, rtol=0, atol=20 * EPS)


def test_doubles_of_numpy_where_jax_has_none():
    jax.config.update("jax_enable_x64", False)
    try:
        field = OperatorSum([-1j, -1j * jnp.sin(0.3)], [a + 0j for a in OPERATORS[:2]])
        assert field.tangent(jnp.asarray(X)).dtype == np.complex64
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("is_skew", [False, True])
@pytest.mark.parametrize("n", [3, 16, 40])
def test_matrices_of_every_size_and_norm(n, is_skew):
    rng = np.random.default_rng(n)
    h, k = (a + a.conj().T for a in rng.normal(size=(2, n, n)) + 1j * rng.normal(size=(2, n, n)))
    d, x = rng.normal(size=n), rng.normal(size=n) + 0j
    # By products with vectors, and by dense exponentials.
    for norm in (0.0, 0.3, 4.0, 40.0):
        total = h - 0.5 * k + np.diag(d)
        c = -1j * norm / np.linalg.norm(total, 2)
        field = OperatorSum(c * np.array([1, -0.5, 1]), [h, k, d], is_skew=is_skew)
        values, vectors = np.linalg.eigh(total)
        expected = vectors @ (np.exp(c * values) * (vectors.conj().T @ x))
        # Units of rounding for the norm, and for sums of n products. Rows are longer than the norm,
        # by n^(1/2) at most, and squarings double what they round.
        atol = 8 * EPS * (n + n**0.5 * norm) * np.linalg.norm(x)
        found, change, tangent = moved(field, x)
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
        np.testing.assert_allclose(change, expected - x, rtol=0, atol=atol)
        np.testing.assert_allclose(tangent, c * total @ x, rtol=0, atol=atol)


def test_the_bound_on_the_norm_is_sharp():
    matrices = [A, 1j * MATRICES[1] + A, RNG.normal(size=(N, N)), DIAGONALS[0]]
    for a in matrices:
        norm = np.linalg.norm(np.diag(a) if a.ndim == 1 else a, 2)
        bound = OperatorSum([2.0], [a])._summed()[-1]
        assert 2 * norm <= bound <= 2 * norm * (1 + 2e-6)
    # A declared one is taken; where none is known, and where matrices cancel, that of the rows.
    assert OperatorSum([2.0], [(A, 1.5)])._summed()[-1] == 3
    rows = np.abs(A).sum(axis=1).max()
    found = jax.jit(lambda a: OperatorSum([2.0], [a])._summed()[-1])(A)
    assert found == pytest.approx(2 * rows)
    assert OperatorSum([1.0, -1.0], [A, A + 0.0])._summed()[-1] == 0
    assert np.isnan(OperatorSum([1.0], [A * np.nan])._summed()[-1])


def test_derivatives_in_coefficients_operators_and_state():
    def flow(c, a, x):
        return OperatorSum(c, [a, function]).flow(x)

    matrix = jnp.asarray(MATRICES[1])
    function = operator_of(lambda x: matrix @ x), 1.0
    a, x, w, d = MATRICES[0], X.real, X.imag, MATRICES[2]
    c = C[:2]
    total = c[0] * a + c[1] * MATRICES[1]
    pulled = jax.jit(lambda *x: jax.vjp(flow, *x)[1](w), compiler_options=QUICK)
    in_c, in_a, in_x = pulled(c, a, x)

    def along(direction):
        return w @ scipy.linalg.expm_frechet(total, direction, compute_expm=False) @ x

    # Some units for numbers of size 10.
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-13)
    close(in_c, [along(a), along(MATRICES[1])])
    close(np.vdot(in_a, d), c[0] * along(d))
    close(in_x, scipy.linalg.expm(total).T @ w)


def test_fields_with_other_operators_are_not_added():
    field = OperatorSum([1.0], [MATRICES[0]])
    for other in (
        OperatorSum([1.0], [DIAGONALS[0]]),
        OperatorSum([1.0], [(REVERSE, 1.0)]),
        OperatorSum([1.0], [MATRICES[0] - MATRICES[0].T], is_skew=True),
    ):
        with pytest.raises(ValueError, match="must have the same operators"):
            cfjax.combine((1.0, 1.0), (field, other))
    with pytest.raises(eqx.EquinoxRuntimeError, match="must have the same operators"):
        cfjax.combine((1.0, 1.0), (field, OperatorSum([1.0], [MATRICES[1]])))
    total = cfjax.combine((1.0, 2.0), (field, OperatorSum([1.0], [MATRICES[0] + 0.0])))
    np.testing.assert_array_equal(total.coefficients, [3.0])


A = MATRICES[0]
IDENTITY = lx.IdentityLinearOperator(jax.ShapeDtypeStruct((3,), float))


def test_wrong_arguments(subtests, no_shape_hook):
    single = A.astype(np.float32)
    cases = [
        (([1.0, 2.0], [A]), ValueError, r"coefficients .* 1 operators, shape \(1,\), got \(2,\)"),
        (([np.ones(2)], [A]), ValueError, r"coefficients must be an array .* shapes \[\(2,\)\]"),
        (([1], []), TypeError, "operators must be a sequence of at least one"),
        (([1, 1], [A, A[:2, :2]]), ValueError, r"one size, got 6 for .*\[0\] and 2 for .*\[1\]"),
        (([1], [A[:2]]), ValueError, r"operators\[0\] must have shape \(n, n\).* got \(2, 6\)"),
        (
            ([1, 1], [A, single]),
            TypeError,
            r"one precision, got float64 for operators\[0\] and float32 for operators\[1\]",
        ),
        (([1], [np.eye(2, dtype=int)]), TypeError, r"operators\[0\] must be one of float32.*int64"),
        ((np.ones(1, np.float32), [A]), TypeError, "coefficients must .* float64, got float32"),
        (([np.float32(1)], [A]), TypeError, "coefficients must have the precision float64"),
        (([1], ["H"]), TypeError, r"operators\[0\] must be an array, .* got 'H'"),
        (([1], [abs]), TypeError, r"\[0\] must be an array, .* as a lineax.FunctionLinearOperator"),
        (([1, 1], [A, REVERSE]), ValueError, r"needs a bound .* for operators\[1\]"),
        (([1], [IDENTITY]), ValueError, "IdentityLinearOperator needs a bound on its norm"),
        (([1, 1], [A, (REVERSE, "1")]), TypeError, r"norm of operators\[1\] must be a real"),
        (([1, 1], [A, (REVERSE, -1)]), ValueError, r"norm of operators\[1\] must be finite and >="),
    ]
    for arguments, error, text in cases:
        with subtests.test(text=text), pytest.raises(error, match=text):
            OperatorSum(*arguments)
    with pytest.raises(ValueError, match=r"operators\[0\] must be skew-Hermitian"):
        OperatorSum([1.0], [A], is_skew=True)
    with pytest.raises(TypeError, match="is_skew must be True or False"):
        OperatorSum([1.0], [A], is_skew=1)
    with pytest.raises(ValueError, match=r"acts on shapes \(6,\) and \(6, k\), got \(5,\)"):
        OperatorSum([1.0], [A]).flow(jnp.ones(5))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("operator", [(REVERSE, 0.1), (operator_of(lambda x: x * x), 9.0)])
def test_check_field_finds_what_a_declaration_hides(operator):
    """A norm that is too small, and an operator that is not linear."""
    fields = [OperatorSum([c], [operator]) for c in (8.0, 4.0)]
    with pytest.raises(ValueError, match="OperatorSum"):
        cfjax.check_field(fields, X.real)
