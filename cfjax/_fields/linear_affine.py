"""Affine fields with a dense matrix."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Inexact

from .._numerics.matmul import matmul, promoted
from .._numerics.phi import matrix_phis, phi_1_times
from .elementwise import check_other, check_point, each
from .matrix import AbstractMatrix, check_companion
from .semilinear import AbstractSemilinearField


class LinearAffine(AbstractMatrix, AbstractSemilinearField):
    """The affine field `x' = a x + b` with a dense matrix.

    Its flow is `x -> exp(a) x + phi_1(a) b` with `phi_1(z) = (exp(z) - 1) / z`, also if `a` has no
    inverse. It acts on a vector, shape `(n,)`. Examples are Bloch's equations with relaxation,
    linear systems with a control, and chemical kinetics. (`cfjax.Affine` is for one fixed operator
    that a fast transform makes diagonal.)

    With leading axes, `a` of shape `(*batch, n, n)` and `b` of shape `(*batch, n)`, it acts on
    shape `(*batch, n)`: each element moves on its own. An axis of 1 is broadcast.

    A flow costs 12 to 25 products with a vector up to a 1-norm of 2.4, and one dense exponential
    beyond.

    **Arguments:**

    - `a`: shape `(*batch, n, n)`, float32, float64, complex64 or complex128. A real `a` may act on
      a complex point of the same precision.
    - `b`: shape `(*batch, n)`, real or complex of the same precision.

    **Raises** `ValueError` for a shape that is not square or does not match, `TypeError` for
    another dtype.
    """

    b: Inexact[Array, "*#batch n"] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        super().__check_init__()  # First, as its errors name the cause.
        check_companion("b", self.b, self.a, self.a.shape[-1:])

    def flow(self, point: Inexact[Array, "*batch n"]) -> Inexact[Array, "*batch n"]:
        return point + self.increment(point)

    def increment(self, point: Inexact[Array, "*batch n"]) -> Inexact[Array, "*batch n"]:
        # phi_1(a) (a x + b), which is as small as the velocity.
        return each(phi_1_times, self._num_axes)(self.a, self.tangent(point))

    def tangent(self, point: Inexact[Array, "*batch n"]) -> Inexact[Array, "*batch n"]:
        n = self.a.shape[-1]
        for name in ("a", "b"):
            check_point(self, name, self._num_axes, [(n,)], point)
        return jnp.add(*promoted(self._times(self.a, point), self.b))

    def functions(self, pairs: Sequence[tuple[float, int]]) -> list[Array]:
        nodes = sorted({c for c, _ in pairs})
        max_order = max(k for _, k in pairs)
        values = each(lambda a: matrix_phis(a, nodes, max_order), self._num_axes)(self.a)
        return [values[nodes.index(c)][k] for c, k in pairs]

    def times(
        self, function: Inexact[Array, "*batch n n"], x: Inexact[Array, "*batch n"]
    ) -> Inexact[Array, "*batch n"]:
        return self._times(function, x)

    def rest(self, first: Any, point: Inexact[Array, "*batch n"]) -> Inexact[Array, "*batch n"]:
        check_other(first, self)
        return jnp.add(*promoted(self._times(self.a - first.a, point), self.b))

    def bracket(self, other: Any) -> "LinearAffine":
        check_other(self, other)
        # The commutator of the matrices [[a, b], [0, 0]].
        a = self._times(self.a, other.a) - self._times(other.a, self.a)
        return LinearAffine(a, self._times(self.a, other.b) - self._times(other.a, self.b))

    def _times(self, a: Array, x: Array) -> Array:
        return each(lambda a, x: matmul(*promoted(a, x)), self._num_axes)(a, x)
