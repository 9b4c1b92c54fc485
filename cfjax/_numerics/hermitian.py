"""Hermitian matrices as real vectors, in an orthonormal basis whose first is the identity."""

import functools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Complex, Float, Inexact

from .vectors import pack

_ROOT = 0.5**0.5


def coordinates(x: Inexact[Array, "n n"]) -> Float[Array, " d"]:
    """The coordinates of the Hermitian part of x. The first is the trace over sqrt(n)."""
    n = x.shape[0]
    diagonal = [x[i, i].real for i in range(n)]
    mixed = [_weighted(row, diagonal) for row in _diagonal(n)]
    above = [_ROOT * (x[i, j] + x[j, i].conj()) for i, j in _pairs(n)]
    return pack([*mixed, *(z.real for z in above), *(z.imag for z in above)])


def matrix(r: Float[Array, " d"]) -> Complex[Array, "n n"]:
    """The matrix with these coordinates, Hermitian to the last bit."""
    n = math.isqrt(len(r))
    pairs = _pairs(n)
    real, imag = _ROOT * r[n : n + len(pairs)], _ROOT * r[n + len(pairs) :]
    entries = {}
    for i, row in enumerate(_diagonal(n).T):
        d = _weighted(row, [r[k] for k in range(n)])
        entries[i, i] = lax.complex(d, jnp.zeros_like(d))
    for k, (i, j) in enumerate(pairs):
        entries[i, j] = lax.complex(real[k], imag[k])
        entries[j, i] = lax.complex(real[k], -imag[k])
    return pack([pack([entries[i, j] for j in range(n)]) for i in range(n)])


@functools.cache
def basis(n: int) -> Complex[np.ndarray, "d n n"]:
    """The basis."""
    pairs = _pairs(n)
    matrices = np.zeros((n * n, n, n), complex)
    matrices[:n, range(n), range(n)] = _diagonal(n)
    for k, (i, j) in enumerate(pairs, n):
        matrices[k, [i, j], [j, i]] = _ROOT
        matrices[k + len(pairs), [i, j], [j, i]] = 1j * _ROOT, -1j * _ROOT
    return matrices


@functools.cache
def commutators(n: int) -> Float[np.ndarray, "d d d"]:
    """For each matrix b of the basis that of `x -> -i [b, x]` in coordinates."""
    b = basis(n)
    images = np.einsum("aij,cjk->acik", b, b) - np.einsum("cij,ajk->acik", b, b)
    return np.einsum("bki,acik->abc", b, -1j * images).real


def dissipator(a: Inexact[Array | np.ndarray, "n n"]) -> Float[Array | np.ndarray, "d d"]:
    """The matrix of `x -> a x a^H - (a^H a x + x a^H a) / 2` in coordinates."""
    # A matrix that is known is made once.
    numpy: Any = jnp if isinstance(a, Tracer) else np
    dtype = np.promote_types(a.dtype, np.complex64)
    a, b = numpy.asarray(a, dtype), numpy.asarray(basis(a.shape[-1]), dtype)
    loss = a.conj().T @ a / 2
    images = a @ b @ a.conj().T - loss @ b - b @ loss
    return numpy.einsum("bki,cik->bc", b, images).real


def _weighted(weights: np.ndarray, x: list[Array]) -> Array:
    total = float(weights[0]) * x[0]
    for w, term in zip(weights[1:], x[1:], strict=True):
        if w != 0:
            total = total + float(w) * term
    return total


@functools.cache
def _pairs(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


@functools.cache
def _diagonal(n: int) -> Float[np.ndarray, "n n"]:
    """Orthonormal diagonals: the identity, then those without a trace."""
    rows = [np.ones(n) / np.sqrt(n)]
    for k in range(1, n):
        row = np.zeros(n)
        row[:k], row[k] = 1, -k
        rows.append(row / np.sqrt(k * (k + 1)))
    return np.array(rows)
