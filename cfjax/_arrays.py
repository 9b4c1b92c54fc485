"""Linear combinations of arrays, and descriptions of arrays for error messages."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Inexact, PyTree, Real

Weight = float | Real[Array, ""]


def linear_combination(
    weights: Sequence[Weight], arrays: Sequence[Inexact[Array | np.ndarray, "..."]]
) -> Inexact[Array, "..."]:
    total = _scale(weights[0], arrays[0])
    for weight, array in zip(weights[1:], arrays[1:], strict=True):
        total = total + _scale(weight, array)
    return total


def _scale(weight: Weight, array: Inexact[Array | np.ndarray, "..."]) -> Inexact[Array, "..."]:
    # Most tableaus have weights of one.
    if isinstance(weight, float) and weight == 1:
        return jnp.asarray(array)
    return jnp.asarray(weight, array.dtype) * array


def check_coordinates(name: str, x: Any) -> None:
    # A weight in an integer dtype would be rounded to zero.
    if not jnp.issubdtype(getattr(x, "dtype", object), jnp.inexact):
        raise TypeError(
            f"{name} must be a floating or complex array to be combined linearly, got "
            f"{describe(x)}. Put what is not a coordinate into a static field, "
            "`eqx.field(static=True)`, or override `combine`."
        )


def struct(x: PyTree) -> PyTree:
    """The shapes and dtypes of the arrays of `x`."""
    return jtu.tree_map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), x)


def describe(x: PyTree) -> str:
    """`x` in one line, with the dtypes and shapes of its arrays."""
    return eqx.tree_pformat(x, struct_as_array=True, width=10_000)
