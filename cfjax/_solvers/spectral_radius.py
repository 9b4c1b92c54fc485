"""The spectral radius of a field on a manifold, by power iteration."""

import math
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._term import velocity

# An iteration from a random start reaches some 9 tenths of the radius in so many rounds.
FIRST_ITERATIONS = 30


def spectral_radius(
    term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree = None
) -> Real[Array, ""]:
    """The spectral radius of the field at a point: the largest modulus of an eigenvalue.

    The eigenvalues are those of the derivative of the field's coordinates with respect to the
    state, with the frame of the point: what a step must be short against in an explicit method, and
    how many stages `cfjax.RKL2` takes. It is found by 30 power iterations from a random start,
    which is always the same. The result is too small rather than too large, usually by a few
    hundredths.

    **Arguments:** as in `cfjax.integrate`, at a time `t` and a state `y`.

    **Cost:** 30 evaluations of the field and its derivative in one direction.
    """
    return iterated(term, t, y, args, start_vector(y), FIRST_ITERATIONS)[0]


def start_vector(y: PyTree) -> PyTree:
    """A vector of length one, shaped like the state, with a part in every direction."""
    leaves, treedef = jtu.tree_flatten(y)
    random = []
    for k, x in enumerate(leaves):
        shape, dtype = jnp.shape(x), jnp.finfo(x.dtype).dtype
        real = _noise(shape, dtype, 2 * k)
        is_complex = jnp.iscomplexobj(x)
        random.append(lax.complex(real, _noise(shape, dtype, 2 * k + 1)) if is_complex else real)
    return _normalised(treedef.unflatten(random))[1]


def _noise(shape: tuple[int, ...], dtype: Any, seed: int) -> Array:
    """Numbers between -1 and 1, by the last rounds of MurmurHash3: its program is a short one."""
    n = math.prod(shape)
    x = lax.iota(jnp.uint32, n).reshape(shape) + np.uint32((seed + 1) * 0x9E3779B9 % 2**32)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    # A float: without x64 the integer would not fit.
    return x.astype(dtype) / 2.0**31 - 1


def iterated(
    term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree, vector: PyTree, number: int
) -> tuple[Real[Array, ""], PyTree]:
    """The growth in the last of so many iterations, and the vector after it."""

    def velocity_at(z: PyTree) -> PyTree:
        # Along the frame of the point y: that is DF T, with the eigenvalues of T DF.
        return velocity(term, term.vf(t, z, args), y)

    # Without a derivative of its own, which would make programs of derivatives longer.
    velocity_at, constants = jax.closure_convert(velocity_at, y)
    y, constants = lax.stop_gradient((y, constants))

    def iteration(vector: PyTree) -> tuple[Real[Array, ""], PyTree]:
        return _normalised(jax.jvp(lambda z: velocity_at(z, *constants), (y,), (vector,))[1])

    if number == 1:
        return iteration(vector)
    zero = jnp.zeros((), _dtype(vector))
    return lax.scan(lambda carry, _: (iteration(carry[1]), None), (zero, vector), length=number)[0]


def _normalised(x: PyTree) -> tuple[Real[Array, ""], PyTree]:
    """The length, and the vector of length one in its direction, or zero."""
    dtype = _dtype(x)
    squares = [jnp.sum(jnp.real(a * jnp.conj(a))).astype(dtype) for a in jtu.tree_leaves(x)]
    length = jnp.sqrt(sum(squares, start=jnp.zeros((), dtype)))
    factor = 1 / jnp.where(length > 0, length, 1)
    return length, jtu.tree_map(lambda a: a * factor.astype(a.dtype), x)


def _dtype(x: PyTree) -> Any:
    """The highest precision in it."""
    dtypes = [jnp.finfo(a.dtype).dtype for a in jtu.tree_leaves(x)]
    return max(dtypes, key=lambda dtype: dtype.itemsize, default=jnp.result_type(float))
