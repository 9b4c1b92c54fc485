"""Density matrices that lose coherence: Lindblad's equation."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Complex, Inexact, Real

from .._arrays import Weight, describe, struct
from .._field import AbstractFrozenField, combine
from .._numerics import hermitian
from .._numerics.checks import differ, error_where
from .._numerics.diagonals import Matrix, adjoint, compact, dense, gram, times, times_adjoint
from .._numerics.expm import expm_parts
from .._numerics.expm_multiply import Strip, expm_minus_one_multiply, row_norm
from .._numerics.matmul import small_product
from .._numerics.operators import added, scaled
from .._numerics.transforms import DTYPES
from .elementwise import check_point, each

# Up to so many levels the exponential of a matrix of n^2 x n^2 numbers is faster, as measured.
_MOST_LEVELS_OF_MATRIX = 5


class Lindblad(AbstractFrozenField):
    """The field `rho' = -i [h, rho] + sum_k rates_k (L_k rho L_k^H - {L_k^H L_k, rho} / 2)`.

    It moves a density matrix rho with the Hamiltonian h, and loss, decay and dephasing by the jumps
    L_k. The coordinates are h and the rates, which may depend on t, rho and `args`. **The jumps are
    not coordinates**: in one step they must be the same at every time and state. (`cfjax.Kraus4`
    takes jumps that depend on time.) They may depend on `args`, and have derivatives. There is no
    bracket, as the commutator of two such fields is not one, so use commutator-free methods.

    ```python
    def field(t, rho, args):
        return cfjax.Lindblad(h0 + jnp.cos(3 * t) * h1, [lower, lower.T], [0.2, 0.1])
    ```

    A flow with rates that are not negative is completely positive, and every flow keeps the trace,
    to rounding. So a step of `CF4`, `CF43` or `Magnus4` has these properties, however long it is,
    if the rates are constant, and one of `CF2` or `Magnus2` if they vary. In a step of another
    method, or if a rate changes much within a step, some flow may have a negative rate. It is
    computed as it is: with a rate set to zero the method would lose its order. rho stays Hermitian
    to the last bit.

    **Arguments:**

    - `h`: shape `(*batch, n, n)`, Hermitian. float32, float64, complex64 or complex128.
    - `jumps`: at least one matrix L_k of shape `(n, n)`, or with the leading axes of h, of its
      precision. (Without a jump use `cfjax.Congruence(-1j * h)`.)
    - `rates`: shape `(*batch, m)` for m jumps, real and not negative; or None, for ones.

    It acts on `(*batch, n, n)`, complex. An axis of 1 is broadcast.

    **Cost:** Up to n = 5 a flow takes one exponential of a matrix of size n^2. Otherwise it takes
    products of size n, `1 + 2 m` for each term of a series: 25 terms for a norm of 2.4 and 10 for
    each unit beyond, or 2.4 where damping is weak, less than some 0.5 for 28 of the norm. The norm
    is at most twice that of h and of `sum_k rates_k L_k^H L_k`. So stiff dissipation takes long:
    use `cfjax.Kraus4`. A jump with at most 3 diagonals, as that of a ladder operator, takes n^2
    operations instead of a product, if it is known when the program is traced. The flow is NaN
    beyond a norm of some 2500.

    **Raises** `TypeError` or `ValueError` for another shape, number or dtype, and, where values are
    known when the program is traced, if h is not Hermitian or a rate is negative. A solve checks
    the values at its start, and that rho starts as a density matrix.

    Source: Gorini, Kossakowski & Sudarshan, J. Math. Phys. 17 (1976), doi:10.1063/1.522979;
    Lindblad, Commun. Math. Phys. 48 (1976), doi:10.1007/BF01608499. The series is that of
    Al-Mohy & Higham, SIAM J. Sci. Comput. 33 (2011), doi:10.1137/100788860, or the Chebyshev series
    of Tal-Ezer & Kosloff, J. Chem. Phys. 81 (1984), doi:10.1063/1.448136, on a strip.
    """

    h: Inexact[Array, "*#batch n n"]
    rates: Real[Array, "*#batch m"]
    jumps: tuple[Any, ...]

    def __init__(self, h: Any, jumps: Sequence[Any], rates: Any = None):
        if not isinstance(jumps, Sequence) or len(jumps) == 0:
            raise TypeError(
                "jumps must be a sequence of at least one matrix, for one jump [a], got "
                f"{describe(jumps)}. Without jumps use cfjax.Congruence(-1j * h)."
            )
        h_, rates_ = jnp.asarray(h), None if rates is None else jnp.asarray(rates)
        num_axes = max(h_.ndim - 2, 0 if rates_ is None else rates_.ndim - 1)
        self.h = _hamiltonian(h, h_, num_axes)
        self.rates = _rates(rates, rates_, self.h, len(jumps))
        self.jumps = tuple(_jump(k, a, self.h) for k, a in enumerate(jumps))

    def flow(self, point: Complex[Array, "*batch n n"]) -> Complex[Array, "*batch n n"]:
        return self._each(lambda field, x: _hermitian_part(x) + field._change(x), point)

    def increment(self, point: Complex[Array, "*batch n n"]) -> Complex[Array, "*batch n n"]:
        # What is not Hermitian is lost, as in a flow.
        return self._each(lambda field, x: field._change(x) + (_hermitian_part(x) - x), point)

    def tangent(self, point: Complex[Array, "*batch n n"]) -> Complex[Array, "*batch n n"]:
        return self._each(lambda field, x: field._right_hand_side()(_hermitian_part(x)), point)

    def no_jump(self) -> Inexact[Array, "n n"]:
        """The matrix K of the motion without jumps, `rho' = K rho + rho K^H`.

        It is `-i h - sum_k rates_k L_k^H L_k / 2` without the trace of h, which has no effect. For
        a field without leading axes.
        """
        h = _traceless(self.h)
        turning = -1j * (h if jnp.iscomplexobj(h) else lax.complex(h, jnp.zeros_like(h)))
        return added([turning, -_gram(self.rates, self.jumps) / 2])

    def jump(self, x: Inexact[Array, "n n"]) -> Inexact[Array, "n n"]:
        """`sum_k rates_k L_k x L_k^H`, for a field without leading axes."""
        return _of_jumps(self.rates, self.jumps, x)

    @classmethod
    def combine(cls, weights: Sequence[Weight], fields: Sequence[Any]) -> "Lindblad":
        coordinates = [(f.h, _checked_rates(f, fields[0])) for f in fields]
        h, rates = combine(weights, coordinates)
        return eqx.tree_at(lambda f: (f.h, f.rates), fields[0], (h, rates))

    def defect(self, point: Complex[Array, "*batch n n"]) -> tuple[Real[Array, ""], str]:
        distances = [
            jnp.abs(point - _adjoint(point)),
            jnp.abs(jnp.trace(point, axis1=-2, axis2=-1) - 1),
            -jnp.linalg.eigvalsh(point),
        ]
        size = jnp.max(jnp.stack([jnp.max(x, initial=0) for x in distances]))
        return size, "the trace 1 and no negative eigenvalue, and be Hermitian"

    def faults(self) -> Sequence[tuple[Bool[Array, ""], str]]:
        size, skew = _sizes(self.h, jnp)
        return [
            (skew > _threshold(self.h.dtype) * size, "h must be Hermitian"),
            (jnp.any(self.rates < 0), "rates must not be negative"),
        ]

    def _each(self, fun: Callable[["Lindblad", Array], Array], point: Array) -> Array:
        num_axes = self.h.ndim - 2
        check_point(self, "h", num_axes, [self.h.shape[-2:]], point)
        # Jumps without leading axes may be known, and stay so.
        with_axes = [len(a.shape) > 2 for a in self.jumps]
        own = [a for a, holds in zip(self.jumps, with_axes, strict=True) if holds]

        def of_one(h: Array, rates: Array, own: list[Any], x: Array) -> Array:
            own = own[::-1]
            jumps = [
                own.pop() if holds else a for a, holds in zip(self.jumps, with_axes, strict=True)
            ]
            field = eqx.tree_at(lambda f: (f.h, f.rates, f.jumps), self, (h, rates, tuple(jumps)))
            return fun(field, x)

        return each(of_one, num_axes)(self.h, self.rates, own, point)

    def _right_hand_side(self) -> Callable[[Array], Array]:
        """The velocity at a Hermitian matrix."""
        k = self.no_jump()

        def velocity(x: Array) -> Array:
            y = added([times(k, x), self.jump(x) / 2])
            return y + _adjoint(y)

        return velocity

    def _change(self, x: Array) -> Array:
        """The flow of a point less the point."""
        n = x.shape[-1]
        if n <= _MOST_LEVELS_OF_MATRIX:
            a, r = self._matrix(), hermitian.coordinates(x)
            weight, remainder = expm_parts(a)
            change = (weight - 1) * r + weight * small_product(a, r) + small_product(remainder, r)
            return hermitian.matrix(change)
        norm, strip = self._bounds()
        product = self._right_hand_side()
        change = expm_minus_one_multiply(product, _hermitian_part(x), norm, strip=strip)
        # It has no trace but for rounding.
        return _traceless(change)

    def _matrix(self) -> Real[Array, "d d"]:
        """The matrix that moves the coordinates of a Hermitian matrix."""
        dtype = self.rates.dtype
        turning = jnp.asarray(hermitian.commutators(self.h.shape[-1]), dtype)
        a = jnp.tensordot(hermitian.coordinates(self.h), turning, 1)
        for rate, jump in zip(self.rates, self.jumps, strict=True):
            a = a + rate * jnp.asarray(hermitian.dissipator(dense(jump)), dtype)
        # The trace, the first coordinate, is constant.
        return jnp.pad(a[1:], ((1, 0), (0, 0)))

    def _bounds(self) -> tuple[Array, Strip]:
        """Bounds on the norm and the numerical range in the Hilbert-Schmidt product."""
        field = jtu.tree_map(lax.stop_gradient, self)
        rates = jnp.abs(field.rates)
        phases = 2 * _two_norm(_traceless(field.h))
        loss = _two_norm(_gram(rates, field.jumps))
        gain = _two_norm(_gram(rates, [adjoint(a) for a in field.jumps]))
        jump = jnp.sqrt(loss) * jnp.sqrt(gain)
        growth = jnp.where(jnp.all(field.rates >= 0), gain / 2, loss + jump)
        return phases + loss + jump, Strip(phases + jump, loss + jump, growth)


def _hamiltonian(h: Any, array: Array, num_axes: int) -> Array:
    if array.ndim < 2 or array.shape[-2] != array.shape[-1]:
        raise ValueError(f"h must have shape (n, n) or (*batch, n, n), got {array.shape}.")
    if array.dtype.name not in DTYPES:
        raise TypeError(f"h must be one of {', '.join(DTYPES)}, got {array.dtype}.")
    if _is_known(h):
        size, skew = _sizes(np.asarray(h), np)
        if skew > _threshold(array.dtype) * size:
            raise ValueError(
                f"h must be Hermitian, but h - h^H has an entry of size {skew:.2g}, and h of "
                f"{size:.2g}."
            )
    return array.reshape(*[1] * (num_axes + 2 - array.ndim), *array.shape)


def _rates(rates: Any, array: Array | None, h: Array, m: int) -> Array:
    num_axes, precision = h.ndim - 2, jnp.finfo(h.dtype).dtype
    if array is None:
        return jnp.ones((*[1] * num_axes, m), precision)
    if array.ndim == 0 or array.shape[-1] != m:
        raise ValueError(
            f"rates must be one for each of the {m} jumps, shape ({m},) or (*batch, {m}), got "
            f"{array.shape}."
        )
    if jnp.iscomplexobj(array):
        raise TypeError(f"rates must be real, got {array.dtype}.")
    # Python's numbers take the precision of h.
    for dtype in (jnp.result_type(x) for x in jtu.tree_leaves(rates) if hasattr(x, "dtype")):
        if jnp.issubdtype(dtype, jnp.inexact) and dtype != precision:
            raise TypeError(f"rates must have the precision of h, {precision}, got {dtype}.")
    if _is_known(rates) and np.min(np.asarray(rates), initial=0) < 0:
        raise ValueError(f"rates must not be negative, got {np.asarray(rates)}.")
    array = array.astype(precision)
    return array.reshape(*[1] * (num_axes + 1 - array.ndim), *array.shape)


def _is_known(x: Any) -> bool:
    """Whether the values of an array, or of lists of numbers, are known in a trace."""
    # As they were given: in a trace `jnp.asarray` returns a tracer for what is known.
    return not any(isinstance(leaf, Tracer) for leaf in jtu.tree_leaves(x))


def _jump(k: int, jump: Any, h: Array) -> Matrix:
    if not isinstance(jump, jax.Array | np.ndarray):
        raise TypeError(f"jumps[{k}] must be an array, got {describe(jump)}.")
    n, num_axes = h.shape[-1], h.ndim - 2
    if jump.shape[-2:] != (n, n) or jump.ndim not in (2, 2 + num_axes):
        raise ValueError(
            f"jumps[{k}] must have the shape ({n}, {n}), or the leading axes of h as well, got "
            f"{jump.shape} with h of shape {h.shape}."
        )
    dtype = jnp.result_type(jump)
    if dtype.name not in DTYPES or jnp.finfo(dtype).dtype != jnp.finfo(h.dtype).dtype:
        raise TypeError(
            f"jumps[{k}] must be real or complex of the precision of h, "
            f"{jnp.finfo(h.dtype).dtype}, got {dtype}."
        )
    return compact(jump)


def _checked_rates(field: Lindblad, first: Lindblad) -> Array:
    """The rates of a field, with an error if its jumps are not those of the first."""
    leaves = [jtu.tree_leaves(f.jumps) for f in (first, field)]
    kinds = [
        (jtu.tree_structure(f.jumps), struct(arrays))
        for f, arrays in zip((first, field), leaves, strict=True)
    ]
    message = (
        "Lindblad fields that are added must have the same jumps: these may not depend on time or "
        "state, except for cfjax.Kraus4, where they may depend on time."
    )
    if kinds[0] != kinds[1]:
        raise ValueError(f"{message} Got {describe(first.jumps)} and {describe(field.jumps)}.")
    different = []
    for a, b in zip(*leaves, strict=True):
        if a is b:
            continue
        if isinstance(a, Tracer) or isinstance(b, Tracer):
            different.append(differ(a, b))
        elif not np.array_equal(a, b, equal_nan=True):
            raise ValueError(message)
    return (
        error_where(field.rates, jnp.any(jnp.stack(different)), message)
        if different
        else field.rates
    )


def _of_jumps(rates: Array, jumps: Sequence[Matrix], x: Array) -> Array:
    return added(
        scaled(rate, times_adjoint(times(a, x), a)) for rate, a in zip(rates, jumps, strict=True)
    )


def _gram(rates: Array, jumps: Sequence[Matrix]) -> Array:
    """`sum_k rates_k L_k^H L_k`."""
    return added(scaled(rate, gram(a)) for rate, a in zip(rates, jumps, strict=True))


def _sizes(h: Any, numpy: Any) -> tuple[Any, Any]:
    """The largest moduli of an entry of h and of `h - h^H`."""
    return numpy.max(numpy.abs(h), initial=0), numpy.max(numpy.abs(h - _adjoint(h)), initial=0)


def _threshold(dtype: Any) -> float:
    # Half of the digits.
    return float(np.sqrt(jnp.finfo(dtype).eps))


def _two_norm(a: Array) -> Array:
    """A bound on the 2-norm of a matrix, for the price of a product."""
    return jnp.minimum(row_norm(a), jnp.sqrt(row_norm(small_product(a, _adjoint(a)))))


def _traceless(x: Array) -> Array:
    n = x.shape[-1]
    mean = jnp.trace(x).real / n
    return x - jnp.diag(jnp.full(n, mean.astype(x.dtype)))


def _hermitian_part(x: Array) -> Array:
    return (x + _adjoint(x)) / 2


def _adjoint(x: Any) -> Any:
    return x.swapaxes(-1, -2).conj()
