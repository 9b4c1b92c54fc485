"""Errors at run time, of values in a compiled program."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.sharding import use_abstract_mesh
from jaxtyping import Array, Bool, Int, PyTree, Real

from .squaring import max_over_batch


class Fault(eqx.Module):
    """An error to raise at run time: that of `messages[number - 1]`, or none if `number` is 0."""

    number: Int[Array, ""]
    messages: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def none(cls) -> "Fault":
        return cls(jnp.zeros((), jnp.int32), ())

    def with_case(self, holds: Bool[Array, ""], message: str) -> "Fault":
        """This fault, or the new one where the case holds. So the worst case comes last."""
        messages = *self.messages, message
        return Fault(jnp.where(holds, jnp.int32(len(messages)), self.number), messages)

    def with_cases_of(self, other: "Fault") -> "Fault":
        """This fault, or the other one if there is one."""
        number = jnp.where(other.number > 0, other.number + len(self.messages), self.number)
        return Fault(number, self.messages + other.messages)

    def error(self, zero: Real[Array, ""]) -> Real[Array, ""]:
        """The zero, or the error, if there is one: in a batch the one with the largest number.

        It is raised at once where it is known, without a program that calls the host.
        """
        if not self.messages:
            return zero
        if not isinstance(self.number, Tracer):
            if number := int(self.number):
                raise eqx.EquinoxRuntimeError(self.messages[number - 1])
            return zero
        index = max_over_batch(jnp.maximum(self.number - 1, 0))
        return eqxi.branched_error_if(zero, self.number > 0, index, self.messages)

    def nan(self, zero: Real[Array, ""]) -> Real[Array, ""]:
        """The zero, or NaN if there is an error."""
        return jnp.where(self.number == 0, zero, jnp.nan)


def error_if(tree: PyTree, is_wrong: Callable[[PyTree], Bool[Array, ""]], message: str) -> PyTree:
    """The same floating and complex arrays, or an error with this message if `is_wrong` of them.

    It is one primitive, so that it is linear for `jax.linear_transpose`, and so that its results
    vary over the axes of a mesh as the arrays do for `jax.shard_map`, which those of an error do
    not. `is_wrong` must close over nothing traced.
    """
    leaves, treedef = jtu.tree_flatten(tree)

    def zero(*leaves: Array) -> Real[Array, ""]:
        return eqx.error_if(jnp.zeros(()), is_wrong(treedef.unflatten(leaves)), message)

    return treedef.unflatten(checked_p.bind(*leaves, zero=zero))


def needing(zero: Real[Array, ""], tree: PyTree) -> PyTree:
    """The same arrays, made to depend on the zero, so that the program computes it."""
    return jtu.tree_map(lambda x: jnp.where(zero == 0, x, zero.astype(x.dtype)), tree)


def error_where(x: Array, is_wrong: Bool[Array, ""], message: str) -> Array:
    """The array x, or an error with this message if `is_wrong`, which need not depend on x."""
    return needing(eqx.error_if(jnp.zeros(()), is_wrong, message), x)


def differ(a: Array | np.ndarray, b: Array | np.ndarray) -> Bool[Array, ""]:
    """Whether arrays differ. NaN equals NaN here, as a result computed from it is NaN anyway."""
    return ~jnp.all((a == b) | ((a != a) & (b != b)))


checked_p = Primitive("cfjax_checked")
checked_p.multiple_results = True


@checked_p.def_impl
def _impl(*leaves, zero):
    mesh = jax.typeof(leaves[0]).sharding.mesh
    with use_abstract_mesh(mesh):
        value = zero(*leaves)
        # With errors off the arrays are NaN instead, as in equinox.
        return [lax.select(value == 0, x, lax.full_like(x, jnp.nan)) for x in leaves]


@checked_p.def_abstract_eval
def _(*leaves, zero):
    return list(leaves)


def _jvp(leaves, tangents, *, zero):
    return checked_p.bind(*leaves, zero=zero), list(tangents)


def _transpose(cotangents, *leaves, zero):
    return list(cotangents)


def _batch(leaves, dims, *, zero):
    # As in equinox, an error of one element is one of the batch.
    zeros: Any = jax.vmap(zero, dims)
    return checked_p.bind(*leaves, zero=lambda *leaves: jnp.sum(zeros(*leaves))), dims


ad.primitive_jvps[checked_p] = _jvp
ad.primitive_transposes[checked_p] = _transpose
batching.primitive_batchers[checked_p] = _batch
mlir.register_lowering(checked_p, mlir.lower_fun(_impl, multiple_results=True))
