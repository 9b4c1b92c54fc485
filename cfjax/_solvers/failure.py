"""A step that ends in infinity or NaN is a failure."""

import diffrax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import PyTree


def result_of(y: PyTree) -> diffrax.RESULTS:
    """`nonfinite` if an entry of a state is, else `successful`; in a batch always `successful`.

    diffrax ends a solve where a step fails. In a batch that is another end for each member, and a
    select for every value that its loop carries: several times the cost of a small step.
    """
    leaves = jtu.tree_leaves(y)
    if not leaves:
        return diffrax.RESULTS.successful
    is_finite = is_finite_p.bind(*map(lax.stop_gradient, leaves))
    nonfinite: diffrax.RESULTS = diffrax.RESULTS.nonfinite  # pyright: ignore[reportAssignmentType]
    return diffrax.RESULTS.where(is_finite, diffrax.RESULTS.successful, nonfinite)


is_finite_p = Primitive("cfjax_is_finite")


@is_finite_p.def_impl
def _impl(*leaves):
    return jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]).all()


@is_finite_p.def_abstract_eval
def _(*leaves):
    return jax.core.ShapedArray((), bool)


def _batch(leaves, dims):
    # Of no dimension of the batch.
    return jnp.asarray(True), None


batching.primitive_batchers[is_finite_p] = _batch
mlir.register_lowering(is_finite_p, mlir.lower_fun(_impl, multiple_results=False))
