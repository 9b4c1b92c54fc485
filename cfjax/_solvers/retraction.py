"""Runge-Kutta methods on the tangent space, by a retraction: for the Stiefel manifold."""

from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from .._field import Rest, combine, is_field, tangent
from .._fields.elementwise import each
from .._fields.low_rank import BorderedSkew, LowRankSkew
from .._fields.sphere import SphereRotation
from .._methods.continuous_extension import runge_kutta_extension
from .._numerics.matmul import matmul
from .dense import Path
from .step import AbstractChartSolver, Step

_EXTENSION = runge_kutta_extension(
    ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), (1 / 6, 1 / 3, 1 / 3, 1 / 6), 4
).weights


class CayleyRK4(AbstractChartSolver, diffrax.AbstractStratonovichSolver):
    """The classical Runge-Kutta method on the tangent space, by the Cayley retraction.

    Order 4, 4 evaluations. Dense output of order 3. The step from Q solves for the tangent vector V
    at Q, from V = 0, with `Y = cay(a) Q`, `a = [g, -Q] [Q, g]^T`, `g = V - Q (Q^T V) / 2` and
    `cay(a) = (I - a / 2)^-1 (I + a / 2)`. It uses only the velocity of the field at a point. If the
    state is in a linear space, this is the classical Runge-Kutta method.

    **Cost:** solves of sizes 2p and p, and products of size `n p^2`. No n x n matrix is formed.

    **Raises** `TypeError` for frozen fields other than `cfjax.LowRankSkew`, `cfjax.BorderedSkew`
    and `cfjax.SphereRotation`, whose points have orthonormal columns. A step so long that an
    eigenvalue of `Q^T Y` is -1 has no coordinates, and ends in large or non-finite numbers.

    Source: Celledoni & Owren, On the implementation of Lie group methods on the Stiefel manifold,
    Numer. Algorithms 32 (2003); RKR-C in Celledoni, Marthinsen & Owren, FGCS 19 (2003).
    """

    def order(self, terms) -> int:
        return 4

    def step_in(self, chart):
        # The retraction has coordinates of its own, and takes states.
        y0, first = chart.sums.y0, chart.product(chart.first_value)
        num_axes = jtu.tree_map(_num_axes, first, is_leaf=is_field)
        retract = _Retraction(tuple(jtu.tree_leaves(num_axes)))

        def rate(c: float, v: PyTree) -> PyTree:
            y = retract(v, y0)
            return jtu.tree_map(
                lambda n, q, v, f: each(_rate, q.ndim - n)(q, v, f) if n else f,
                num_axes,
                y0,
                v,
                tangent(chart.product(chart.value(c, y)), y),
            )

        k1 = tangent(first, y0)
        k2 = rate(0.5, combine((1 / 2,), (k1,)))
        k3 = rate(0.5, combine((1 / 2,), (k2,)))
        k4 = rate(1.0, k3)
        rates = [k1, k2, k3, k4]
        y1 = retract(combine((1 / 6, 1 / 3, 1 / 3, 1 / 6), rates), y0)
        # A part at rest may be a sum.
        y1 = chart.sums.map(lambda c, y, z: z if c is None else z - y, y1)
        return Step(y1, Path.of(_EXTENSION, y0, rates, retract))


class _Retraction(NamedTuple):
    """The point with the tangent vector v at q as coordinates. A tuple, so it is hashable."""

    num_axes: tuple[int, ...]

    def __call__(self, v: PyTree, q: PyTree) -> PyTree:
        num_axes = jtu.tree_unflatten(jtu.tree_structure(q), self.num_axes)
        return jtu.tree_map(
            lambda n, q, v: each(_retract, q.ndim - n)(q, v) if n else q + v, num_axes, q, v
        )


def _num_axes(field: Any) -> int:
    """How many axes a point has without leading ones; 0 for a linear space."""
    if not is_field(field) or isinstance(field, Rest):
        return 0
    if isinstance(field, SphereRotation):
        return 1
    if isinstance(field, LowRankSkew | BorderedSkew):
        return 2
    raise TypeError(
        "CayleyRK4 works on points with orthonormal columns: the frozen fields must be "
        "cfjax.LowRankSkew, cfjax.BorderedSkew or cfjax.SphereRotation, got "
        f"{type(field).__name__}. Use a commutator-free method, for example cfjax.CF4()."
    )


def _retract(q: Array, v: Array) -> Array:
    return _Cayley(*map(_columns, (q, v))).end().reshape(q.shape)


def _rate(q: Array, v: Array, velocity: Array) -> Array:
    return _Cayley(*map(_columns, (q, v))).rate(_columns(velocity)).reshape(q.shape)


def _columns(x: Array) -> Float[Array, "n p"]:
    """A unit vector as one column."""
    return x.reshape(len(x), -1)


class _Cayley:
    """The point `Y = cay(a) Q` with the tangent vector v at Q as its coordinates."""

    def __init__(self, q: Float[Array, "n p"], v: Float[Array, "n p"]):
        p = q.shape[1]
        g = v - matmul(q, matmul(q.T, v)) / 2
        self.q = q
        # a = left right^T, of rank 2 p.
        self.left = jnp.concatenate([g, -q], axis=1)
        self.right = jnp.concatenate([q, g], axis=1)
        capacitance = jnp.eye(2 * p, dtype=q.dtype) - matmul(self.right.T, self.left) / 2
        # Halfway between Q and Y: (I - a / 2)^-1 Q, by the Sherman-Morrison-Woodbury formula.
        solution = jnp.linalg.solve(capacitance, matmul(self.right.T, q))
        self.middle = q + matmul(self.left, solution) / 2

    def end(self) -> Float[Array, "n p"]:
        return 2 * self.middle - self.q

    def rate(self, velocity: Float[Array, "n p"]) -> Float[Array, "n p"]:
        """How v changes when Y does with `velocity`.

        `Y' = (I - a/2)^-1 a' (I - a/2)^-1 Q`, so that `a' middle = (I - a/2) Y'`, where
        `a' = Q w Q^T + x Q^T - Q x^T` for `v' = Q w + x` with `Q^T x = 0`.
        """
        q = self.q
        target = velocity - matmul(self.left, matmul(self.right.T, velocity)) / 2
        projection = matmul(q.T, target)
        inverse = jnp.linalg.inv(matmul(q.T, self.middle))
        x = matmul(target - matmul(q, projection), inverse)
        w = matmul(projection + matmul(x.T, self.middle), inverse)
        return x + matmul(q, w)
