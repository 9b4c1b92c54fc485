"""Transforms: against scipy, the operators they make diagonal, derivatives, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.fft

import cfjax
from cfjax._functions.transforms import _MAX_DENSE

# The dense path, both sides of the switch, and a prime number of intervals, 251.
SIZES = [1, 2, 8, 99, _MAX_DENSE, _MAX_DENSE + 1, 250, 1023, 1024]


def transform(kind, n):
    return {
        "sine": cfjax.SineTransform,
        "cosine": cfjax.CosineTransform,
        "Fourier": cfjax.FourierTransform,
        "real Fourier": lambda: cfjax.RealFourierTransform(n),
    }[kind]()


SCIPY = {
    "sine": lambda x: np.asarray(scipy.fft.dst(x, type=1, norm="ortho", axis=0)),
    "cosine": lambda x: np.asarray(scipy.fft.dct(x, type=2, norm="ortho", axis=0)),
    "Fourier": lambda x: np.asarray(scipy.fft.fft(x, norm="ortho", axis=0)),
    "real Fourier": lambda x: np.asarray(scipy.fft.rfft(x, norm="ortho", axis=0)),
}
kinds = pytest.mark.parametrize("kind", SCIPY)


def point(kind, shape, seed=1):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(shape)
    return x + 1j * rng.standard_normal(shape) if kind == "Fourier" else x


def close(found, wanted, n):
    """A dense product adds n terms and a fast one log n, of entries of size one."""
    eps = np.finfo(np.asarray(found).dtype).eps
    np.testing.assert_allclose(found, wanted, rtol=0, atol=4 * eps * np.sqrt(n) * np.log2(n + 2))


@kinds
@pytest.mark.parametrize("n", SIZES)
def test_against_scipy_and_back(kind, n):
    t, x = transform(kind, n), point(kind, (n,))
    c = t.forward(jnp.asarray(x))
    close(c, SCIPY[kind](x), n)
    close(t.inverse(c), x, n)


@kinds
@pytest.mark.parametrize("n", [5, 255])
def test_columns_and_batches(kind, n):
    t, x = transform(kind, n), jnp.asarray(point(kind, (n, 3, 2)))
    found = t.forward(x)
    close(found, SCIPY[kind](np.asarray(x)), n)
    close(t.inverse(found), x, n)
    batch = jax.vmap(jax.vmap(t.forward))(x.transpose(1, 2, 0))
    close(batch.transpose(2, 0, 1), found, n)


@kinds
@pytest.mark.parametrize("n", [6, 200])
def test_float32(kind, n):
    t, x = transform(kind, n), point(kind, (n,))
    single = jnp.asarray(x, jnp.complex64 if kind == "Fourier" else jnp.float32)
    c = t.forward(single)
    assert c.dtype == (jnp.complex64 if "Fourier" in kind else jnp.float32)
    close(c, SCIPY[kind](x), n)
    assert t.inverse(c).dtype == single.dtype


@pytest.mark.parametrize("kind", ["sine", "cosine"])
@pytest.mark.parametrize("n", [7, 180])
def test_complex_points(kind, n):
    t, x = transform(kind, n), point("Fourier", (n,))
    c = t.forward(jnp.asarray(x))
    close(c, SCIPY[kind](x.real) + 1j * SCIPY[kind](x.imag), n)
    close(t.inverse(c), x, n)


def operator(kind, n):
    """The operator that the docstring says is diagonal, dense, and its eigenvalues."""
    a = np.diag(np.full(n, -2.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    k = np.arange(n)
    if kind == "sine":
        return a, -4 * np.sin((k + 1) * np.pi / (2 * (n + 1))) ** 2
    if kind == "cosine":
        a[0, 0] = a[-1, -1] = -1
        return a, -4 * np.sin(k * np.pi / (2 * n)) ** 2
    # An upwind difference: complex eigenvalues.
    a = np.eye(n) - np.roll(np.eye(n), 1, axis=0)
    eigenvalues = 1 - np.exp(-2j * np.pi * k / n)
    return a, eigenvalues if kind == "Fourier" else eigenvalues[: n // 2 + 1]


@kinds
@pytest.mark.parametrize("n", [3, 16, 201])
def test_the_operator_is_diagonal(kind, n):
    t, x = transform(kind, n), point(kind, (n,))
    a, eigenvalues = operator(kind, n)
    found = t.inverse(jnp.asarray(eigenvalues) * t.forward(jnp.asarray(x)))
    close(found, a @ x, n)


@kinds
@pytest.mark.parametrize("n", [4, 5, 170])
def test_transpose_and_derivative(kind, n):
    """The transpose of a map L by its definition, and its derivative, which is L itself."""
    t, x, dx = transform(kind, n), point(kind, (n,), 1), point(kind, (n,), 2)
    x, dx = jnp.asarray(x), jnp.asarray(dx)
    c, dc = jax.jvp(t.forward, (x,), (dx,))
    close(dc, t.forward(dx), n)
    g = t.forward(jnp.asarray(point(kind, (n,), 3)))
    (pulled,) = jax.vjp(t.forward, x)[1](g)
    # JAX pairs complex numbers by the real part of their product, without a conjugate.
    close(np.sum(g * dc).real, np.sum(pulled * dx).real, n)
    (pulled,) = jax.vjp(t.inverse, c)[1](x)
    close(np.sum(x * dx).real, np.sum(pulled * dc).real, n)


def test_norm_is_kept():
    for kind in ("sine", "cosine", "Fourier"):
        for n in (10, 300):
            x = point(kind, (n,))
            norm = np.linalg.norm(transform(kind, n).forward(jnp.asarray(x)))
            assert norm == pytest.approx(np.linalg.norm(x), rel=1e-13)


@pytest.mark.parametrize("n", [0, -1, 2.0, True, None])
def test_wrong_number_of_points(n, no_shape_hook):
    with pytest.raises(ValueError, match="n must be an integer of at least 1, got"):
        cfjax.RealFourierTransform(n)


def test_wrong_length():
    with pytest.raises(ValueError, match=r"RealFourierTransform\(4\) got a point of length 5"):
        cfjax.RealFourierTransform(4).forward(jnp.ones(5))
