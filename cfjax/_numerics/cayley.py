"""Cayley's transform `cay(u) = (I - u/2)^-1 (I + u/2)`, and small linear systems.

It maps the algebra of every group of matrices with `y^H J y = J` to the group, whatever J is.
"""

import functools
import operator
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Inexact, Real

from .matmul import matmul, plus_identity, promoted, small_product
from .squaring import magnitude, max_over_batch
from .vectors import computed_once, pack, unpack

# Larger ones are written out at length: with 8 equations a step has 42 000 instructions.
_WRITTEN_OUT = 4
# Derivatives of so few numbers are as short as products with the inverse, and a step on single
# numbers with these takes half as long again.
_DIFFERENTIATED = 2
# Above, a sweep takes longer than LU, as measured.
_SWEPT, _SWEPT_COMPLEX = 16, 8


def solve(m: Inexact[Array, "n n"], z: Inexact[Array, "n *k"]) -> Inexact[Array, "n *k"]:
    """`m^-1 z`, whose derivatives are products with m^-1.

    By the adjugate up to n = 4, by a sweep up to n = 16 where m is near enough to the identity for
    it, and otherwise by elimination with pivots.
    """
    m, z = promoted(m, z)
    (inverse,) = _constant_inverses(m)
    return _solve(m, inverse, z)


def solve_from_right(z: Inexact[Array, "*k n"], m: Inexact[Array, "n n"]) -> Inexact[Array, "*k n"]:
    """`z m^-1`, in the same way."""
    m, z = promoted(m, z)
    (inverse,) = _constant_inverses(m)
    return _solve_from_right(z, m, inverse)


def solve_from_both(
    left: Inexact[Array, "n n"], z: Inexact[Array, "n n"], right: Inexact[Array, "n n"]
) -> Inexact[Array, "n n"]:
    """`left^-1 z right^-1`, in the same way, for matrices of one dtype."""
    of_left, of_right = _constant_inverses(left, right)
    return _solve_from_right(_solve(left, of_left, z), right, of_right)


def congruence_by_inverse(
    m: Inexact[Array, "n n"], z: Inexact[Array, "n n"]
) -> Inexact[Array, "n n"]:
    """`m^-1 z m^-H`, in the same way, for matrices of one dtype."""
    (inverse,) = _constant_inverses(m)
    left = _solve(m, inverse, z)
    return _solve(m, inverse, left.conj().T).conj().T


def _solve(m: Array, inverse: Array | None, z: Array) -> Array:
    if inverse is None:
        return small_product(_inverse(m), z) if _is_tiny(m) else jnp.linalg.solve(m, z)
    return lax.custom_linear_solve(
        lambda z: small_product(m, z),
        z,
        lambda _, z: small_product(inverse, z),
        lambda _, z: small_product(inverse.T, z),
    )


def _solve_from_right(z: Array, m: Array, inverse: Array | None) -> Array:
    if inverse is None:
        return small_product(z, _inverse(m)) if _is_tiny(m) else jnp.linalg.solve(m.T, z.T).T
    return lax.custom_linear_solve(
        lambda z: small_product(z, m),
        z,
        lambda _, z: small_product(z, inverse),
        lambda _, z: small_product(z, inverse.T),
    )


def _is_tiny(m: Array) -> bool:
    return len(m) <= _DIFFERENTIATED


def _constant_inverses(*matrices: Inexact[Array, "n n"]) -> Sequence[Inexact[Array, "n n"] | None]:
    """The inverses without derivatives; or None for each where another way is faster."""
    n, swept = len(matrices[0]), _SWEPT_COMPLEX if jnp.iscomplexobj(matrices[0]) else _SWEPT
    if n <= _DIFFERENTIATED or n > swept:
        return [None] * len(matrices)
    matrices = lax.stop_gradient(matrices)
    if n <= _WRITTEN_OUT:
        return [_inverse(m) for m in matrices]
    # One branch for all keeps the program short.
    return lax.cond(
        functools.reduce(operator.and_, map(_is_safe_without_pivots, matrices)),
        lambda: [_swept(m) for m in matrices],
        lambda: list(jnp.linalg.inv(jnp.stack(matrices))),
    )


def _is_safe_without_pivots(m: Inexact[Array, "n n"]) -> Bool[Array, ""]:
    """Whether `m - I` is small or nearly skew-Hermitian, for all matrices of a batch.

    Then the eigenvalues of `m + m^H` are at least 1, by Gershgorin's circles. So are those of each
    Schur complement, so the real part of a pivot is at least 1/2. No entry of m is above 4.
    """
    # The largest over the batch is of one matrix for all: a condition on it stays a branch. To sum
    # rows of each member would take as long as a product.
    defect = max_over_batch(magnitude(m + m.conj().T - 2 * jnp.eye(len(m), dtype=m.dtype)))
    size = max_over_batch(magnitude(m))
    # NaN stays NaN by each way.
    return (jnp.max(jnp.sum(defect, axis=1)) <= 1) & (jnp.max(size) <= 4)


def _swept(m: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """The inverse, by Gauss and Jordan's elimination without pivots.

    The first equation and the first unknown change places in `m x = y`, and go last. After n turns
    it is `x = m^-1 y`, in the order of the start.
    """

    def turn(_: Any, m: Array) -> Array:
        factor = 1 / m[0, 0]
        row, column = factor * m[0, 1:], m[1:, 0]
        rest = m[1:, 1:] - column[:, None] * row[None, :]
        left = jnp.concatenate([rest, row[None, :]])
        right = jnp.append(-factor * column, factor)
        return jnp.concatenate([left, right[:, None]], axis=1)

    return lax.fori_loop(0, len(m), turn, m)


def dcayinv(u: Inexact[Array, "n n"], a: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """`u' = (I - u/2) a (I + u/2)`, so that cay(u) has the derivative `a cay(u)`."""
    u, a = promoted(u, a)
    left, right = small_product(u, a), small_product(a, u)
    # Both sum the same numbers if u and a are skew-Hermitian: then so is their difference, to the
    # last bit, and the square of u is small. By two products, one after the other, 100 000 steps
    # leave an orthogonal matrix off by 1e-12.
    return a - (left - right) / 2 - small_product(left, u) / 4


def _inverse(m: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
    """The adjugate over the determinant, for n up to 4. Units of coordinates have no effect."""
    n = len(m)
    if n == 4:
        return _inverse_of_four(m)
    x = unpack(m.reshape(n * n))
    if n == 1:
        adjugate, det = [jnp.ones_like(x[0])], x[0]
    elif n == 2:
        adjugate, det = [x[3], -x[1], -x[2], x[0]], x[0] * x[3] - x[1] * x[2]
    else:
        # Rows and columns in cyclic order give the signs.
        adjugate = [
            x[3 * ((j + 1) % 3) + (i + 1) % 3] * x[3 * ((j + 2) % 3) + (i + 2) % 3]
            - x[3 * ((j + 1) % 3) + (i + 2) % 3] * x[3 * ((j + 2) % 3) + (i + 1) % 3]
            for i in range(3)
            for j in range(3)
        ]
        det = _sum(x[j] * adjugate[3 * j] for j in range(3))
    factor = 1 / det
    return pack([factor * entry for entry in adjugate]).reshape(n, n)


def _inverse_of_four(m: Inexact[Array, "4 4"]) -> Inexact[Array, "4 4"]:
    """By Laplace's expansion: minors of the first two rows, and of the last two.

    As arrays, with columns in cyclic order, they are a third of the instructions of entries.
    """
    cyclic = jnp.concatenate([m, m[:, :3]], axis=1)
    first, second = ([rows[:, j : j + 4] for j in range(4)] for rows in (cyclic[::2], cyclic[1::2]))
    pairs = [(2, 3), (1, 3), (1, 2)]
    # Twelve cofactors would compute each minor anew.
    minors = computed_once(
        jnp.stack([first[i] * second[j] - first[j] * second[i] for i, j in pairs])
    )
    # The other row of a pair goes with the minors of the other pair.
    a, b, c = minors[:, ::-1]
    of_first, of_second = (x[1] * a - x[2] * b + x[3] * c for x in (second, first))
    cofactors = jnp.stack([of_first, of_second], axis=1).reshape(4, 4)
    cofactors = jnp.where(np.indices((4, 4)).sum(axis=0) % 2 == 0, cofactors, -cofactors)
    return (1 / jnp.sum(m[0] * cofactors[0])) * cofactors.T


def log_determinant(u: Inexact[Array, "3 3"]) -> Inexact[Array, ""]:
    """`log det cay(u)` of a complex 3 x 3 matrix u, with a rounding error as small as the result.

    With the characteristic numbers t, m and d of u/2, trace, minors and determinant, it is
    `log((p + q) / (p - q))` for `p = 1 + m` and `q = t + d`. The imaginary part is between -pi and
    pi, where that of eigenvalues adds up to 3 pi: it says the logarithm up to whole turns.
    """
    x = unpack((u / 2).reshape(9))
    trace = x[0] + x[4] + x[8]
    pairs = [(0, 4, 1, 3), (0, 8, 2, 6), (4, 8, 5, 7)]
    minors = _sum(x[i] * x[j] - x[k] * x[m] for i, j, k, m in pairs)
    det = _sum(
        x[i] * (x[3 + j] * x[6 + k] - x[3 + k] * x[6 + j])
        for i, j, k in [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
    )
    p, q = 1 + minors, trace + det
    # Not q / p: p is zero where the determinant is -1. Steps that fail have large numbers.
    scale = (1 / lax.stop_gradient(magnitude(p) + magnitude(q))).astype(p.dtype)
    p, q = scale * p, scale * q
    product = q * p.conj()
    real = jnp.log1p(4 * product.real / _square(p - q)) / 2
    return lax.complex(real, jnp.arctan2(2 * product.imag, _square(p) - _square(q)))


def without_turns(x: Complex[Array, "*shape"]) -> Complex[Array, "*shape"]:
    """x less the multiples of 2 pi i that leave imaginary parts between -pi and pi."""
    turns = jnp.round(lax.stop_gradient(x.imag) / (2 * np.pi))
    return lax.complex(x.real, x.imag - 2 * np.pi * turns)


def is_within_half_a_turn(u: Inexact[Array, "n n"]) -> Bool[Array, ""]:
    """Whether cay(u) is no step by nearly half a turn, where these coordinates end.

    Where all angles of cay(u) are below 1 it is true. If u is skew-Hermitian it is false where a
    pair of angles is above 2.5, for n = 3, to 2.75, for n = 100; without a partner, above 2.7. The
    size of u is `sum_ij |u_ij u_ji|`: then this is the sum of the squares of its entries, and units
    of coordinates have no effect on it.
    """
    u = lax.stop_gradient(u)
    return jnp.sum(magnitude(u * u.T)) <= _bound(len(u))


def _bound(num_angles: int) -> float:
    return 72 + 1.2 * num_angles


def _sum(terms: Iterable[Array]) -> Array:
    return functools.reduce(operator.add, terms)


def _square(x: Array) -> Array:
    """`|x|^2`, without a root."""
    return x.real * x.real + x.imag * x.imag


class TangentCoordinates:
    """The point `cay(a) q` with the tangent vector v at orthonormal columns q as its coordinates.

    Here `a = [g, -q] [q, g]^T` with `g = v - q (q^T v) / 2`, so that v is the velocity of
    `cay(s a) q` at s = 0.

    Source: Celledoni & Owren, On the implementation of Lie group methods on the Stiefel manifold,
    Numer. Algorithms 32 (2003).
    """

    def __init__(self, q: Real[Array, "n p"], v: Real[Array, "n p"]):
        self.q, self.w = q, matmul(q.T, v) / 2
        self.g = v - matmul(q, self.w)
        # a = left right^T, of rank 2 p.
        self.left = jnp.concatenate([self.g, -q], axis=1)
        self.right = jnp.concatenate([q, self.g], axis=1)
        capacitance = plus_identity(-matmul(self.right.T, self.left) / 2)
        # By the formula of Sherman, Morrison and Woodbury, (I - a / 2)^-1 q is q and half of this.
        self.increment = matmul(self.left, solve(capacitance, matmul(self.right.T, q)))

    def rate(self, velocity: Real[Array, "n p"]) -> Real[Array, "n p"]:
        """How v changes where the point does with `velocity`.

        With `middle = (I - a/2)^-1 q` it has `a' middle = (I - a/2) velocity`, where
        `a' = q w q^T + x q^T - q x^T` for `v' = q w + x` with `q^T x = 0`.
        """
        q, middle = self.q, self.q + self.increment / 2
        target = velocity - matmul(self.left, matmul(self.right.T, velocity)) / 2
        projection, factor = matmul(q.T, target), matmul(q.T, middle)
        x = solve_from_right(target - matmul(q, projection), factor)
        w = solve_from_right(projection + matmul(x.T, middle), factor)
        return x + matmul(q, w)

    def is_within_half_a_turn(self) -> Bool[Array, ""]:
        """As of the matrix a."""
        g, w = lax.stop_gradient((self.g, self.w))
        # The sum of the squares of the entries of a, as v is a tangent vector.
        size = 2 * (jnp.sum(g * g) + jnp.sum(w * w))
        return size <= _bound(min(len(g), 2 * g.shape[1]))
