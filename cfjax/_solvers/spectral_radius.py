"""The spectral radius of a field on a manifold, by power iteration."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, PyTree, Real

from .._term import velocity
from .base import size

# An iteration from a random start reaches some 9 tenths of the radius in so many rounds.
_FIRST_ITERATIONS = 30
# A growth that rises by less has settled. A mode beside the vector that is twice as stiff shows in
# it from some 5 % on.
_RISE = 1.001
# How much of other directions is mixed into the vector. With 0.1 the growth settles at 0.97 of the
# radius, as far as 30 iterations lead from a random start.
_OTHERS = 0.1


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
    return first_iteration(term, t, y, args).growth


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


class Iteration(NamedTuple):
    """The growth in a power iteration, and the vector after it, of length one or zero."""

    growth: Real[Array, ""]
    vector: PyTree


def first_iteration(term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree) -> Iteration:
    """The last of 30 from a random start."""
    iterate = _iteration(term, t, y, args)
    vector = start_vector(y)
    start = Iteration(jnp.zeros((), _dtype(vector)), vector)
    return lax.scan(lambda x, _: (iterate(x.vector), None), start, length=_FIRST_ITERATIONS)[0]


def next_iteration(
    term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree, last: Iteration, direction: PyTree
) -> Iteration:
    """One at another time and state, or as many as the growth rises for.

    A vector has no part in modes that were not there in the iterations before, such as those of a
    diffusion that is switched on, and is zero where there were none. So the random start is mixed
    into it, and a direction in which stiff modes of the state stand out, such as the velocity.
    """
    iterate = _iteration(term, t, y, args)
    others = jtu.tree_map(jnp.add, start_vector(y), _normalised(lax.stop_gradient(direction))[1])

    def rises(carry: tuple[Any, Any, Iteration]) -> Any:
        k, before, now = carry
        return (k == 0) | ((now.growth > _RISE * before) & (k < _FIRST_ITERATIONS))

    def again(carry: tuple[Any, Any, Iteration]) -> tuple[Any, Any, Iteration]:
        k, _, now = carry
        mixed = jtu.tree_map(lambda a, b: a + _OTHERS * b, now.vector, others)
        return k + 1, now.growth, iterate(_normalised(mixed)[1])

    # A batch takes as many as the member that needs most, and no more where none needs more.
    return lax.while_loop(rises, again, (jnp.zeros((), jnp.int32), last.growth, last))[2]


def rate_along(
    term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree, direction: PyTree
) -> Real[Array, ""]:
    """How fast the velocity changes in a direction: a mean of the rates of the modes in it."""
    return _iteration(term, t, y, args)(_normalised(direction)[1]).growth


def _iteration(
    term: diffrax.AbstractTerm, t: Any, y: PyTree, args: PyTree
) -> Callable[[PyTree], Iteration]:
    """An iteration at a point, of a vector of length one."""

    def velocity_at(z: PyTree) -> PyTree:
        # Along the frame of the point y: that is DF T, with the eigenvalues of T DF.
        return velocity(term, term.vf(t, z, args), y)

    # Without a derivative of its own, which would make programs of derivatives longer.
    velocity_at, constants = jax.closure_convert(velocity_at, y)
    y, constants = lax.stop_gradient((y, constants))

    def iterate(vector: PyTree) -> Iteration:
        image = jax.jvp(lambda z: velocity_at(z, *constants), (y,), (vector,))[1]
        return Iteration(*_normalised(image))

    return iterate


def largest(x: PyTree) -> Real[Array, ""]:
    """The largest modulus of an entry."""
    dtype = _dtype(x)
    sizes = [size(a).astype(dtype) for a in jtu.tree_leaves(x)]
    return functools.reduce(jnp.maximum, sizes, jnp.zeros((), dtype))


def _normalised(x: PyTree) -> tuple[Real[Array, ""], PyTree]:
    """The length, and the vector of length one in its direction, or zero."""
    dtype, most = _dtype(x), largest(x)
    # Squares of entries above 1e-19 alone are not zero in single precision.
    is_zero = most < jnp.finfo(dtype).tiny
    scale = jnp.where(is_zero, 1, most)
    x = jtu.tree_map(lambda a: jnp.where(is_zero, 0, a / scale.astype(a.dtype)), x)
    squares = [jnp.sum(jnp.real(a * jnp.conj(a))).astype(dtype) for a in jtu.tree_leaves(x)]
    length = jnp.sqrt(sum(squares, start=jnp.zeros((), dtype)))
    factor = 1 / jnp.where(is_zero, 1, length)
    return scale * length, jtu.tree_map(lambda a: a * factor.astype(a.dtype), x)


def _dtype(x: PyTree) -> Any:
    """The highest precision in it."""
    dtypes = [jnp.finfo(a.dtype).dtype for a in jtu.tree_leaves(x)]
    return max(dtypes, key=lambda dtype: dtype.itemsize, default=jnp.result_type(float))
