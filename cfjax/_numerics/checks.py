"""Errors of values, which a compiled program finds."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.sharding import use_abstract_mesh
from jaxtyping import Array, Bool, Int, PyTree, Real

from .squaring import max_over_batch


class Fault(eqx.Module):
    """What is wrong, if anything: a number from 1 on is that of a message, 0 is nothing."""

    number: Int[Array, ""]
    messages: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def none(cls) -> "Fault":
        return cls(jnp.zeros((), jnp.int32), ())

    def with_case(self, holds: Bool[Array, ""], message: str) -> "Fault":
        """This, or where the case holds that. So what is worse comes later."""
        messages = *self.messages, message
        return Fault(jnp.where(holds, jnp.int32(len(messages)), self.number), messages)

    def error(self, zero: Real[Array, ""]) -> Real[Array, ""]:
        """The zero, or an error where something is wrong: in a batch the last case of all."""
        if not self.messages:
            return zero
        index = max_over_batch(jnp.maximum(self.number - 1, 0))
        return eqxi.branched_error_if(zero, self.number > 0, index, self.messages)

    def nan(self, zero: Real[Array, ""]) -> Real[Array, ""]:
        """The zero, or NaN where something is wrong."""
        return jnp.where(self.number == 0, zero, jnp.nan)


def error_if(tree: PyTree, is_wrong: Callable[[PyTree], Bool[Array, ""]], message: str) -> PyTree:
    """The same arrays, or an error with this message where `is_wrong` says so of them."""

    def zero(tree: PyTree) -> Real[Array, ""]:
        return eqx.error_if(jnp.zeros(()), is_wrong(tree), message)

    return checked(tree, zero)


def checked(tree: PyTree, zero: Callable[[PyTree], Real[Array, ""]]) -> PyTree:
    """The same floating and complex arrays, or the error that is raised by `zero` of them.

    One primitive, so that `jax.linear_transpose` sees nothing in it that is not linear, and
    `jax.shard_map` nothing that varies otherwise than the arrays: what an error gives back varies
    along no axis of a mesh. `zero` must close over nothing traced.
    """
    leaves, structure = jtu.tree_flatten(tree)
    return structure.unflatten(
        checked_p.bind(*leaves, zero=lambda *leaves: zero(structure.unflatten(leaves)))
    )


def needing(zero: Real[Array, ""], tree: PyTree) -> PyTree:
    """The same arrays, which the program cannot have without the zero."""
    return jtu.tree_map(lambda x: jnp.where(zero == 0, x, zero.astype(x.dtype)), tree)


def differ(a: Array | np.ndarray, b: Array | np.ndarray) -> Bool[Array, ""]:
    """Whether arrays differ. NaN is as good as NaN: what is made of it says so itself."""
    return ~jnp.all((a == b) | ((a != a) & (b != b)))


checked_p = Primitive("cfjax_checked")
checked_p.multiple_results = True


@checked_p.def_impl
def _impl(*leaves, zero):
    mesh = jax.typeof(leaves[0]).sharding.mesh
    with use_abstract_mesh(mesh):
        value = zero(*leaves)
        # With errors off it is NaN instead, as equinox has it.
        return [lax.select(value == 0, x, lax.full_like(x, jnp.nan)) for x in leaves]


@checked_p.def_abstract_eval
def _(*leaves, zero):
    return list(leaves)


def _jvp(leaves, tangents, *, zero):
    return checked_p.bind(*leaves, zero=zero), list(tangents)


def _transpose(cotangents, *leaves, zero):
    return list(cotangents)


def _batch(leaves, dims, *, zero):
    # As in equinox, an error of one member is one of the batch.
    each: Any = jax.vmap(zero, dims)
    return checked_p.bind(*leaves, zero=lambda *leaves: jnp.sum(each(*leaves))), dims


ad.primitive_jvps[checked_p] = _jvp
ad.primitive_transposes[checked_p] = _transpose
batching.primitive_batchers[checked_p] = _batch
mlir.register_lowering(checked_p, mlir.lower_fun(_impl, multiple_results=True))
