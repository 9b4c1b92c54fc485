"""Runge-Kutta methods on the tangent space, by a retraction: for the Stiefel manifold."""

from typing import NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from .._field import combine, is_field, tangent
from .._fields.elementwise import each
from .._fields.low_rank import BorderedSkew, LowRankSkew
from .._methods.continuous_extension import runge_kutta_extension
from .._numerics.matmul import matmul
from .base import AbstractLieSolver, Move
from .dense import Path

_EXTENSION = runge_kutta_extension(
    ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6)
)


class CayleyRK4(AbstractLieSolver):
    """The classical Runge-Kutta method on the tangent space, by the Cayley retraction.

    Order 4, 4 evaluations. Dense output of order 3. The step from Q solves for the tangent vector V
    at Q, from V = 0, with `Y = cay(a) Q`, `a = [g, -Q] [Q, g]^T`, `g = V - Q (Q^T V) / 2` and
    `cay(a) = (I - a / 2)^-1 (I + a / 2)`. Of the field it takes only the velocity at a point. Where
    the state is in a linear space, this is the classical Runge-Kutta method.

    **Cost:** solves of sizes 2p and p, and products of size `n p^2`. Nothing of size n x n.

    **Raises** `TypeError` for frozen fields other than `cfjax.LowRankSkew` and
    `cfjax.BorderedSkew`, whose points have orthonormal columns. A step so long that an eigenvalue
    of `Q^T Y` is -1 has no coordinates, and ends in large or non-finite numbers.

    Source: Celledoni & Owren, On the implementation of Lie group methods on the Stiefel manifold,
    Numer. Algorithms 32 (2003); RKR-C in Celledoni, Marthinsen & Owren, FGCS 19 (2003).
    """

    def order(self, terms) -> int:
        return 4

    def move(self, field, y0):
        first = field(0.0, y0)
        _check(first)
        curved = jtu.tree_map(is_field, first, is_leaf=is_field)

        end = _End(tuple(jtu.tree_leaves(curved)))

        def rate(c: float, v: PyTree) -> PyTree:
            y = end(v, y0)
            return jtu.tree_map(
                lambda c, q, v, f: each(_rate, q.ndim - 2)(q, v, f) if c else f,
                curved,
                y0,
                v,
                tangent(field(c, y), y),
            )

        k1 = tangent(first, y0)
        k2 = rate(0.5, combine((1 / 2,), (k1,)))
        k3 = rate(0.5, combine((1 / 2,), (k2,)))
        k4 = rate(1.0, k3)
        rates = [k1, k2, k3, k4]
        y1 = end(combine((1 / 6, 1 / 3, 1 / 3, 1 / 6), rates), y0)
        return Move(y1, Path.of(_EXTENSION, y0, rates, end))


class _End(NamedTuple):
    """The point with tangent vector v at q as its coordinates. Equal to itself and hashable."""

    curved: tuple[bool, ...]

    def __call__(self, v: PyTree, q: PyTree) -> PyTree:
        curved = jtu.tree_unflatten(jtu.tree_structure(q), self.curved)
        return jtu.tree_map(
            lambda c, q, v: each(_end, q.ndim - 2)(q, v) if c else q + v, curved, q, v
        )


def _check(field: PyTree) -> None:
    for part in jtu.tree_leaves(field, is_leaf=is_field):
        if is_field(part) and not isinstance(part, LowRankSkew | BorderedSkew):
            raise TypeError(
                "CayleyRK4 works on points with orthonormal columns: the frozen fields must be "
                f"cfjax.LowRankSkew or cfjax.BorderedSkew, got {type(part).__name__}. Use a "
                "commutator-free method, for example cfjax.CF4()."
            )


def _end(q: Array, v: Array) -> Array:
    return _Cayley(q, v).end()


def _rate(q: Array, v: Array, velocity: Array) -> Array:
    return _Cayley(q, v).rate(velocity)


class _Cayley:
    """The point `Y = cay(a) Q` with the tangent vector v at Q as its coordinates."""

    def __init__(self, q: Float[Array, "n p"], v: Float[Array, "n p"]):
        p = q.shape[1]
        g = v - matmul(q, matmul(q.T, v)) / 2
        self.q = q
        # a = left right^T, of rank 2 p.
        self.left = jnp.concatenate([g, -q], axis=1)
        self.right = jnp.concatenate([q, g], axis=1)
        small = jnp.eye(2 * p, dtype=q.dtype) - matmul(self.right.T, self.left) / 2
        # Halfway between Q and Y: (I - a / 2)^-1 Q, by the Sherman-Morrison-Woodbury formula.
        self.middle = q + matmul(self.left, jnp.linalg.solve(small, matmul(self.right.T, q))) / 2

    def end(self) -> Float[Array, "n p"]:
        return 2 * self.middle - self.q

    def rate(self, velocity: Float[Array, "n p"]) -> Float[Array, "n p"]:
        """How v changes when Y does with `velocity`.

        `Y' = (I - a/2)^-1 a' (I - a/2)^-1 Q`, so that `a' middle = (I - a/2) Y'`, where
        `a' = Q w Q^T + x Q^T - Q x^T` for `v' = Q w + x` with `Q^T x = 0`.
        """
        q = self.q
        target = velocity - matmul(self.left, matmul(self.right.T, velocity)) / 2
        along = matmul(q.T, target)
        inverse = jnp.linalg.inv(matmul(q.T, self.middle))
        x = matmul(target - matmul(q, along), inverse)
        w = matmul(along + matmul(x.T, self.middle), inverse)
        return x + matmul(q, w)
