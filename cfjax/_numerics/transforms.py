"""Fast transforms that diagonalise difference operators, on a line and on grids."""

import abc
from collections.abc import Callable, Sequence
from math import sqrt
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Inexact

from .matmul import matmul

DTYPES = ("float32", "float64", "complex64", "complex128")

# Up to here a product with the dense matrix is faster than a fast transform, on a CPU.
_MAX_DENSE = 160


class AbstractTransform(eqx.Module):
    """An invertible linear map between points and the coefficients in which M is diagonal.

    A transform of your own provides the methods `forward` and `inverse`, each the inverse of the
    other, for every dtype with which it is used. Further axes are columns. For grids use
    `cfjax.TensorTransform`, which applies transforms axis by axis, and for batches `jax.vmap`.
    """

    # The order of transforms on a grid: 0 if it keeps real points real, 1 if it takes real points
    # to complex coefficients, 2 if it takes complex points.
    _rank: ClassVar[int] = 0

    @abc.abstractmethod
    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "m *k"]:
        """The coefficients of `point`."""

    @abc.abstractmethod
    def inverse(self, coefficients: Inexact[Array, "m *k"]) -> Inexact[Array, "n *k"]:
        """The point with these coefficients."""


class SineTransform(AbstractTransform):
    """The orthonormal discrete sine transform (DST-I), which is its own inverse.

    It is for zero boundary values, at the points `x_j = j dx`, `j = 1..n`, with `(n + 1) dx` the
    length of the interval. It diagonalises the second difference `u_{j-1} - 2 u_j + u_{j+1}`:
    coefficient `k = 1..n` has the eigenvalue `-4 sin(k pi / (2 (n + 1)))^2`.

    Costs a real FFT of length `n + 1`, twice that for even n, or a product with a dense matrix for
    n up to 160. Fast lengths `n + 1` are products of small primes.
    """

    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return _real_transform(sine_matrix, _sine, checked(self, point))

    def inverse(self, coefficients: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return self.forward(coefficients)

    def second_difference(self, n: int | np.integer) -> Float[np.ndarray, " n"]:
        """The eigenvalues of the second difference of n points."""
        n = _positive(n)
        return -4 * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1))) ** 2


class CosineTransform(AbstractTransform):
    """The orthonormal discrete cosine transform (DCT-II), with its inverse (DCT-III).

    It is for zero boundary fluxes, at the centres of cells `x_j = (j + 1/2) dx`, `j = 0..n-1`, with
    `n dx` the length of the interval. It diagonalises the second difference whose first and last
    rows are `u_1 - u_0` and `u_{n-2} - u_{n-1}`: coefficient `k = 0..n-1` has the eigenvalue
    `-4 sin(k pi / (2 n))^2`.

    Costs a real FFT of length `2 n`, or a product with a dense matrix for n up to 160.
    """

    def forward(self, point: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        return _real_transform(cosine_matrix, _cosine, checked(self, point))

    def inverse(self, coefficients: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
        c = checked(self, coefficients)
        return _real_transform(lambda n: cosine_matrix(n).T, _inverse_cosine, c)

    def second_difference(self, n: int | np.integer) -> Float[np.ndarray, " n"]:
        """The eigenvalues of the second difference of n points."""
        n = _positive(n)
        return -4 * np.sin(np.arange(n) * np.pi / (2 * n)) ** 2


class FourierTransform(AbstractTransform):
    """The unitary discrete Fourier transform of complex points, for periodic problems.

    The points are `x_j = j dx`, `j = 0..n-1`, with `n dx` the period. It diagonalises every
    periodic difference operator with constant coefficients, and spectral derivatives: coefficient
    `k = 0..n-1` belongs to `exp(2 pi i j k / n)`. The second difference has the eigenvalues
    `-4 sin(k pi / n)^2`. Costs a complex FFT of length `n`.

    **Raises** `TypeError` for real arrays.
    """

    _rank: ClassVar[int] = 2

    def forward(self, point: Complex[Array, "n *k"]) -> Complex[Array, "n *k"]:
        return jnp.fft.fft(self._complex(point), axis=0, norm="ortho")

    def inverse(self, coefficients: Complex[Array, "n *k"]) -> Complex[Array, "n *k"]:
        return jnp.fft.ifft(self._complex(coefficients), axis=0, norm="ortho")

    def second_difference(self, n: int | np.integer) -> Float[np.ndarray, " n"]:
        """The eigenvalues of the periodic second difference of n points."""
        return -4 * np.sin(np.pi * np.fft.fftfreq(_positive(n))) ** 2

    def _complex(self, x: Array) -> Array:
        x = checked(self, x)
        if not jnp.iscomplexobj(x):
            raise TypeError(
                f"FourierTransform takes complex arrays, got {x.dtype}. Real points take a "
                "RealFourierTransform(n), along one axis of a grid."
            )
        return x


class RealFourierTransform(AbstractTransform):
    """The unitary discrete Fourier transform of real points: coefficients `k = 0..n//2` only.

    Otherwise it is like `FourierTransform`. Costs a real FFT of length `n`. A difference operator
    of odd order must have the eigenvalue zero at `k = n/2`, if n is even: for real points no other
    value is possible.

    **Arguments:** `n`, the number of points, which the coefficients do not determine.

    **Raises** `ValueError` if `n` is not a positive integer, or an array has another length,
    `TypeError` for complex points.
    """

    _rank: ClassVar[int] = 1
    n: int = eqx.field(static=True)

    def __init__(self, n: int | np.integer):
        self.n = _positive(n)

    def forward(self, point: Float[Array, "n *k"]) -> Complex[Array, "m *k"]:
        point = checked(self, point)
        self._check_length("a point", len(point), self.n)
        if jnp.iscomplexobj(point):
            raise TypeError(
                f"RealFourierTransform({self.n}) takes real points, got {point.dtype}. Complex "
                "points take a FourierTransform()."
            )
        return jnp.fft.rfft(point, axis=0, norm="ortho")

    def inverse(self, coefficients: Complex[Array, "m *k"]) -> Float[Array, "n *k"]:
        coefficients = checked(self, coefficients)
        self._check_length("coefficients", len(coefficients), self.n // 2 + 1)
        return jnp.fft.irfft(coefficients, self.n, axis=0, norm="ortho")

    def second_difference(self, n: int | np.integer) -> Float[np.ndarray, " m"]:
        """The eigenvalues of the periodic second difference of n points."""
        self._check_length("points", _positive(n), self.n)
        return -4 * np.sin(np.pi * np.fft.rfftfreq(self.n)) ** 2

    def _check_length(self, what: str, length: int, expected: int) -> None:
        if length != expected:
            raise ValueError(
                f"RealFourierTransform({self.n}) got {what} of length {length}, expected "
                f"{expected}."
            )


class TensorTransform(AbstractTransform):
    """The tensor product of transforms, the k-th along axis k, for problems on a grid.

    So `TensorTransform((SineTransform(), CosineTransform()))` is for points of shape `(nx, ny)`
    with zero boundary values in x and zero boundary fluxes in y. Further axes are columns. None in
    place of a transform leaves its axis as it is, for example the axis of the species of a
    reaction.

    If an operator is a sum of operators, one for each axis, its eigenvalues are the sums of their
    eigenvalues, in the shape of the coefficients. So the Laplacian in this example, by second
    differences, has

        np.add.outer(
            SineTransform().second_difference(nx) / dx**2,
            CosineTransform().second_difference(ny) / dy**2,
        )

    Periodic axes of real points take one `RealFourierTransform`, with `n//2 + 1` coefficients along
    its axis, and `FourierTransform` for the others. A difference of odd order must have the
    eigenvalue zero at `k = n/2` along each of them. Any axis may have any kind, as transforms of
    different axes commute: `forward` applies `RealFourierTransform` after those that keep real
    points real and before `FourierTransform`, and `inverse` reverses the order. That of
    `cfjax.diagonalised` counts as one of the three kinds, as its docstring says.

    Each axis costs its transform, with as many columns as there are other entries.

    **Arguments:** `transforms`, a sequence of `cfjax.AbstractTransform` or None, each of which
    transforms one axis.

    **Raises** `TypeError` if they are anything else, `ValueError` if more than one of them takes
    real points to complex coefficients, as `RealFourierTransform` does, or if an array has fewer
    axes.
    """

    transforms: tuple[AbstractTransform | None, ...]

    def __init__(self, transforms: Sequence[AbstractTransform | None]):
        if isinstance(transforms, AbstractTransform):
            raise TypeError(f"transforms must be a sequence of transforms, got {transforms!r}.")
        self.transforms = tuple(transforms)
        for transform in self.transforms:
            if transform is not None and not isinstance(transform, AbstractTransform):
                raise TypeError(
                    f"transforms must hold cfjax.AbstractTransform or None, got {transform!r}."
                )
            if isinstance(transform, TensorTransform):
                raise TypeError(
                    "transforms must be of one axis each, got a TensorTransform among them."
                )
        if sum(transform._rank == 1 for _, transform in self._in_order()) > 1:
            raise ValueError(
                "transforms must hold at most one RealFourierTransform, or cfjax.diagonalised of a "
                "real matrix with complex eigenvalues, as its coefficients are complex, got "
                f"{self.transforms!r}. Along the other axes take FourierTransform() or "
                "diagonalised(matrix.astype(complex))."
            )

    def forward(self, point: Inexact[Array, "*point"]) -> Inexact[Array, "*coefficients"]:
        self._check_axes(point)
        for axis, transform in self._in_order():
            point = _along(axis, transform.forward, point)
        return point

    def inverse(self, coefficients: Inexact[Array, "*coefficients"]) -> Inexact[Array, "*point"]:
        self._check_axes(coefficients)
        for axis, transform in reversed(self._in_order()):
            coefficients = _along(axis, transform.inverse, coefficients)
        return coefficients

    def _check_axes(self, x: Array) -> None:
        if jnp.ndim(x) < len(self.transforms):
            raise ValueError(
                f"TensorTransform of {len(self.transforms)} axes got an array of shape "
                f"{jnp.shape(x)}."
            )

    def _in_order(self) -> list[tuple[int, AbstractTransform]]:
        """Axes and their transforms: real ones, that from real to complex, complex ones."""
        pairs = [(axis, t) for axis, t in enumerate(self.transforms) if t is not None]
        return sorted(pairs, key=lambda pair: pair[1]._rank)


def sine_matrix(n: int) -> Float[np.ndarray, "n n"]:
    k = np.arange(1, n + 1)
    # Reduced in integers, so that large angles lose no digits.
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
    interleaved = jnp.stack([odd, even], axis=1).reshape(intervals, *x.shape[1:])
    return sqrt(2 / intervals) * interleaved[:-1]


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


def _real_transform(
    matrix: Callable[[int], Float[np.ndarray, "n n"]],
    fast: Callable[[Float[Array, "n *k"]], Float[Array, "n *k"]],
    x: Inexact[Array, "n *k"],
) -> Inexact[Array, "n *k"]:
    if jnp.iscomplexobj(x):
        # Also for the matrix: two real products take a third of the time of a complex one.
        parts = (_real_transform(matrix, fast, part) for part in (x.real, x.imag))
        return lax.complex(*parts)
    n = len(x)
    if n > _MAX_DENSE:
        return fast(x)
    return matmul(jnp.asarray(matrix(n), x.dtype), x.reshape(n, -1)).reshape(x.shape)


def _along(axis: int, fun: Callable[[Array], Array], x: Array) -> Array:
    # On matrices XLA takes these transpositions into the products with dense matrices.
    return jnp.moveaxis(fun(jnp.moveaxis(x, axis, 0)), 0, axis)


def checked(transform: AbstractTransform, x: Array) -> Array:
    x, name = jnp.asarray(x), type(transform).__name__
    # In an integer dtype the entries of a dense matrix would be rounded to zero.
    if x.dtype.name not in DTYPES:
        raise TypeError(f"{name} takes arrays of {', '.join(DTYPES)}, got {x.dtype}.")
    if x.ndim == 0 or len(x) == 0:
        raise ValueError(f"{name} needs points along the first axis, got shape {x.shape}.")
    return x


def _positive(n: int | np.integer) -> int:
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
        raise ValueError(f"n must be an integer of at least 1, got {n!r}.")
    return int(n)
