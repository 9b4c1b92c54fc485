"""Hermitian matrices as real vectors, in an orthonormal basis whose first is the identity."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Complex, Float, Inexact

from .vectors import pack


def coordinates(x: Inexact[Array, "n n"]) -> Float[Array, " n*n"]:
    """The coordinates of the Hermitian part of x. The first is the trace over sqrt(n)."""
    n = x.shape[0]
    diagonal = [x[i, i].real for i in range(n)]
    mixed = [sum(float(w) * d for w, d in zip(row, diagonal, strict=True)) for row in _diagonal(n)]
    above = [(x[i, j] + x[j, i].conj()) / 2**0.5 for i, j in _pairs(n)]
    return pack([*mixed, *(z.real for z in above), *(z.imag for z in above)])


def matrix(r: Float[Array, " n2"]) -> Complex[Array, "n n"]:
    """The matrix with these coordinates, Hermitian to the last bit."""
    n = int(np.sqrt(len(r)))
    pairs = _pairs(n)
    real, imag = 0.5**0.5 * r[n : n + len(pairs)], 0.5**0.5 * r[n + len(pairs) :]
    columns = _diagonal(n).T
    entries = {}
    for i, row in enumerate(columns):
        d = sum(float(w) * r[k] for k, w in enumerate(row))
        entries[i, i] = lax.complex(d, jnp.zeros_like(d))
    for k, (i, j) in enumerate(pairs):
        entries[i, j] = lax.complex(real[k], imag[k])
        entries[j, i] = lax.complex(real[k], -imag[k])
    return pack([pack([entries[i, j] for j in range(n)]) for i in range(n)])


@functools.cache
def basis(n: int) -> Complex[np.ndarray, "n2 n n"]:
    """The basis."""
    pairs, root = _pairs(n), np.sqrt(0.5)
    matrices = np.zeros((n * n, n, n), complex)
    matrices[:n, range(n), range(n)] = _diagonal(n)
    for k, (i, j) in enumerate(pairs, n):
        matrices[k, [i, j], [j, i]] = root
        matrices[k + len(pairs), [i, j], [j, i]] = 1j * root, -1j * root
    return matrices


@functools.cache
def commutators(n: int) -> Float[np.ndarray, "n2 n2 n2"]:
    """For each matrix b of the basis that of `x -> -i [b, x]` in coordinates."""
    b = basis(n)
    images = np.einsum("aij,cjk->acik", b, b) - np.einsum("cij,ajk->acik", b, b)
    return np.einsum("bki,acik->abc", b, -1j * images).real


def dissipator(a: Inexact[Array | np.ndarray, "n n"]) -> Float[Array | np.ndarray, "n*n n*n"]:
    """The matrix of `x -> a x a^H - (a^H a x + x a^H a) / 2` in coordinates."""
    # A matrix that is known is made once.
    numpy: Any = jnp if isinstance(a, Tracer) else np
    b = numpy.asarray(basis(a.shape[-1]), np.promote_types(a.dtype, np.complex64))
    a = numpy.asarray(a, b.dtype)
    loss = a.conj().T @ a / 2
    images = a @ b @ a.conj().T - loss @ b - b @ loss
    return numpy.einsum("bki,cik->bc", b, images).real


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
