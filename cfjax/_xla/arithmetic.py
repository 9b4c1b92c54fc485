"""Operations that compute something of numbers: elementwise ones, sums and products."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import JaxprEqn

from .jaxprs import is_inexact
from .limits import MAX_PRODUCT
from .numbers import array_of, numbers, of_jax, static_value


def elementwise(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    aval: Any = eqn.outvars[0].aval
    which = static_value(values[0])
    if eqn.primitive.name == "select_n" and which is not None:
        # As of the weights of a stage that are zero.
        cases = [list(numbers(x).flat) for x in values[1:]]
        chosen = np.broadcast_to(which, aval.shape).astype(int)
        return array_of([cases[n][k] for k, n in enumerate(chosen.flat)], aval.shape)
    if not aval.shape:
        return None  # Of numbers.
    # An axis may have length 1 in some operands, and others are one number.
    columns = [np.broadcast_to(numbers(x), aval.shape).flat for x in values]
    compute = functools.partial(eqn.primitive.bind, **eqn.params)
    return array_of(list(map(compute, *columns)), aval.shape)


def reduced(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    x, axes, name = numbers(values[0]), eqn.params["axes"], eqn.primitive.name
    aval: Any = eqn.outvars[0].aval
    if name in _EXTREMES and jnp.issubdtype(aval.dtype, jnp.complexfloating):
        return None  # In the order of a dictionary.
    free = [k for k in range(x.ndim) if k not in axes]
    rows = x.transpose(*free, *axes).reshape(math.prod(aval.shape), -1)
    if name in _EXTREMES and is_inexact(aval):
        combine = functools.partial(_extreme, _EXTREMES[name])
    else:
        combine = functools.partial(functools.reduce, _COMBINED[name])
    return array_of([combine(list(map(of_jax, row))) for row in rows], aval.shape)


_EXTREMES: dict[str, Callable[[Any, Any], Any]] = {"reduce_max": lax.max, "reduce_min": lax.min}
_COMBINED = _EXTREMES | {
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
    "reduce_prod": lax.mul,
    "reduce_sum": lax.add,
}


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _extreme(combine: Callable[[Any, Any], Any], entries: Sequence[Any]) -> Any:
    """The largest or smallest; the derivative is shared evenly by all that are, as in JAX."""
    return functools.reduce(combine, entries)


@_extreme.defjvp
def _(combine, primals, tangents):
    (entries,), (moving,) = primals, tangents
    extreme = _extreme(combine, entries)
    shares = [lax.convert_element_type(lax.eq(x, extreme), extreme.dtype) for x in entries]
    total = functools.reduce(lax.add, map(lax.mul, moving, shares))
    return extreme, total / functools.reduce(lax.add, shares)


def product(eqn: JaxprEqn, values: Sequence[Any]) -> np.ndarray | None:
    """`dot_general` of two small arrays."""
    sums, batches = eqn.params["dimension_numbers"]
    avals: list[Any] = [v.aval for v in (*eqn.invars, *eqn.outvars)]
    # Of numbers there is no product of truth values.
    if len({aval.dtype for aval in avals}) != 1 or avals[0].dtype == bool:
        return None
    left, right = map(_factor, map(numbers, values), batches, sums)
    if left.size * right.shape[1] > MAX_PRODUCT:
        return None
    pairs = zip(left, right, strict=True)
    outs = [_dot(row, column) for xs, ys in pairs for row in xs for column in ys]
    return array_of(outs, avals[-1].shape)


def _factor(x: np.ndarray, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """One side of a product: by batch, by row, by what is summed."""
    free = [k for k in range(x.ndim) if k not in (*batch, *summed)]
    sides = [math.prod(x.shape[k] for k in axes) for axes in (batch, free, summed)]
    return x.transpose(*batch, *free, *summed).reshape(sides)


def _dot(row: np.ndarray, column: np.ndarray) -> Any:
    return functools.reduce(lax.add, map(lax.mul, row, column))
