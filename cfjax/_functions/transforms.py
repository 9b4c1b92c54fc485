"""Fast transforms that diagonalise difference operators on a line."""

import abc
from collections.abc import Callable
from math import sqrt

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Inexact

from .matmul import matmul

# Up to here a product with the dense matrix is faster than a fast transform, on a CPU.
_MAX_DENSE = 160


class AbstractTransform(eqx.Module):
    """An invertible linear map between points and the coefficients in which M is diagonal.

    Both methods transform along the first axis; further axes are columns. Use `jax.vmap` for
    batches. A subclass of your own may transform several axes, for problems in more dimensions.
    """

    @abc.abstractmethod
    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "m *k"]:
        """The coefficients of `point`."""

    @abc.abstractmethod
    def inverse(self, coefficients: Inexact[Array, "m *k"]) -> Inexact[Array, "n *k"]:
        """The point with these coefficients."""


class SineTransform(AbstractTransform):
    """The orthonormal discrete sine transform (DST-I), which is its own inverse.

    For zero boundary values, at the points `x_j = j dx`, `j = 1..n`, `(n + 1) dx` the length of
    the interval. It diagonalises the second difference `u_{j-1} - 2 u_j + u_{j+1}`: coefficient
    `k = 1..n` has the eigenvalue `-4 sin(k pi / (2 (n + 1)))^2`.

    Costs a real FFT of length `n + 1`, twice that for even n, or a product with a dense matrix for
    n up to 160. Fast lengths `n + 1` are products of small primes.
    """

    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        if len(point) <= _MAX_DENSE:
            return _product(sine_matrix(len(point)), point)
        return _by_parts(_sine, point)

    def inverse(self, coefficients: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self.forward(coefficients)


class CosineTransform(AbstractTransform):
    """The orthonormal discrete cosine transform (DCT-II), with its inverse (DCT-III).

    For zero boundary fluxes, at the centres of cells `x_j = (j + 1/2) dx`, `j = 0..n-1`, `n dx`
    the length of the interval. It diagonalises the second difference whose first and last rows are
    `u_1 - u_0` and `u_{n-2} - u_{n-1}`: coefficient `k = 0..n-1` has the eigenvalue
    `-4 sin(k pi / (2 n))^2`.

    Costs a real FFT of length `2 n`, or a product with a dense matrix for n up to 160.
    """

    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        if len(point) <= _MAX_DENSE:
            return _product(cosine_matrix(len(point)), point)
        return _by_parts(_cosine, point)

    def inverse(self, coefficients: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        if len(coefficients) <= _MAX_DENSE:
            return _product(cosine_matrix(len(coefficients)).T, coefficients)
        return _by_parts(_inverse_cosine, coefficients)


class FourierTransform(AbstractTransform):
    """The unitary discrete Fourier transform of complex points, for periodic problems.

    At the points `x_j = j dx`, `j = 0..n-1`, `n dx` the period. It diagonalises every periodic
    difference operator with constant coefficients, and spectral derivatives: coefficient
    `k = 0..n-1` belongs to `exp(2 pi i j k / n)`. Costs a complex FFT of length `n`.
    """

    def forward(self, point: Complex[Array, "n *k"]) -> Complex[Array, "n *k"]:
        return jnp.fft.fft(point, axis=0, norm="ortho")

    def inverse(self, coefficients: Complex[Array, "n *k"]) -> Complex[Array, "n *k"]:
        return jnp.fft.ifft(coefficients, axis=0, norm="ortho")


class RealFourierTransform(AbstractTransform):
    """The unitary discrete Fourier transform of real points: coefficients `k = 0..n//2` alone.

    All else as for `FourierTransform`. Costs a real FFT of length `n`. A difference operator of
    odd order must have the eigenvalue zero at `k = n/2`, n even: no real point has another.

    **Arguments:** `n`, the number of points, which the coefficients do not tell.

    **Raises** `ValueError` if `n` is not a positive integer, or a point has another length.
    """

    n: int = eqx.field(static=True)

    def __check_init__(self):
        if isinstance(self.n, bool) or not isinstance(self.n, int) or self.n < 1:
            raise ValueError(f"n must be an integer of at least 1, got {self.n!r}.")

    def forward(self, point: Float[Array, "n *k"]) -> Complex[Array, "m *k"]:
        if len(point) != self.n:
            raise ValueError(f"RealFourierTransform({self.n}) got a point of length {len(point)}.")
        return jnp.fft.rfft(point, axis=0, norm="ortho")

    def inverse(self, coefficients: Complex[Array, "m *k"]) -> Float[Array, "n *k"]:
        return jnp.fft.irfft(coefficients, self.n, axis=0, norm="ortho")


def sine_matrix(n: int) -> Float[np.ndarray, "n n"]:
    k = np.arange(1, n + 1)
    # Reduced in integers, so that no digit of a large angle is lost.
    turns = np.outer(k, k) % (2 * (n + 1)) / (n + 1)
    return np.sqrt(2 / (n + 1)) * np.sin(np.pi * turns)


def cosine_matrix(n: int) -> Float[np.ndarray, "n n"]:
    turns = np.outer(np.arange(n), 2 * np.arange(n) + 1) % (4 * n) / (2 * n)
    return _cosine_scale(n)[:, None] * np.cos(np.pi * turns)


def _cosine_scale(n: int) -> Float[np.ndarray, " n"]:
    return np.where(np.arange(n) == 0, np.sqrt(1 / n), np.sqrt(2 / n))


def _sine(x: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    intervals = len(x) + 1
    # Not a concatenation: XLA would compute x inside it, one entry at a time.
    padded = lax.dynamic_update_slice_in_dim(
        jnp.zeros((intervals, *x.shape[1:]), x.dtype), x, 1, axis=0
    )
    if intervals % 2:
        transformed = jnp.fft.rfft(padded, 2 * intervals, axis=0)[1:intervals]
        return -sqrt(2 / intervals) * transformed.imag
    # An FFT of half the length. Its imaginary parts are the coefficients of even number, its real
    # parts the differences of those of odd number (Press et al., Numerical Recipes, Section 12.3).
    sines = np.sin(np.arange(intervals) * np.pi / intervals)
    sines = jnp.asarray(sines, x.dtype).reshape(-1, *(1,) * (x.ndim - 1))
    mirrored = jnp.roll(padded[::-1], 1, axis=0)
    folded = sines * (padded + mirrored) + (padded - mirrored) / 2
    transformed = jnp.fft.rfft(folded, axis=0)[:-1]
    steps = jnp.concatenate([transformed[:1].real / 2, transformed[1:].real])
    odd, even = jnp.cumsum(steps, axis=0), -jnp.roll(transformed.imag, -1, axis=0)
    mixed = jnp.stack([odd, even], axis=1).reshape(intervals, *x.shape[1:])
    return sqrt(2 / intervals) * mixed[:-1]


def _cosine(x: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    n = len(x)
    return (jnp.fft.rfft(x, 2 * n, axis=0)[:n] * _cosine_shift(x, _cosine_scale(n))).real


def _inverse_cosine(c: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    n = len(c)
    # A real FFT counts every coefficient but the first twice, once for its conjugate.
    weights = n * _cosine_scale(n) * np.where(np.arange(n) == 0, 2, 1)
    shifted = lax.complex(c, jnp.zeros_like(c)) * _cosine_shift(c, weights).conj()
    return jnp.fft.irfft(shifted, 2 * n, axis=0)[:n]


def _cosine_shift(like: Float[Array, "n *k"], weights: np.ndarray) -> Complex[Array, "n *k"]:
    """Weights times the factors that move the first point half a cell into the interval."""
    n = len(like)
    shift = weights * np.exp(-0.5j * np.pi * np.arange(n) / n)
    shape = (n,) + (1,) * (like.ndim - 1)
    dtype = np.result_type(like.dtype, np.complex64)
    return jnp.broadcast_to(jnp.asarray(shift, dtype).reshape(shape), like.shape)


def _by_parts(
    transform: Callable[[Float[Array, "n *k"]], Float[Array, "n *k"]], x: Inexact[Array, "n *k"]
) -> Inexact[Array, "n *k"]:
    if jnp.iscomplexobj(x):
        return lax.complex(transform(x.real), transform(x.imag))
    return transform(x)


def _product(matrix: Float[np.ndarray, "n n"], x: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
    return matmul(jnp.asarray(matrix, x.dtype), x.reshape(len(x), -1)).reshape(x.shape)
