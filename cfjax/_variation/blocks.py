"""Matrices by blocks, one for each pair of parts of the state, without those that are zero."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import Literal
from jaxtyping import Array, PyTree, Real

from .._numerics.linearity import CALLS
from .._numerics.matmul import matmul


def dependences(
    fun: Callable[[list[PyTree]], Sequence[PyTree]], inputs: list[PyTree]
) -> list[set[int]]:
    """For each value that `fun` returns the indices of the inputs that its program needs for it."""
    closed, out = jax.make_jaxpr(fun, return_shape=True)(inputs)
    groups = [{k} for k, x in enumerate(inputs) for _ in jtu.tree_leaves(x)]
    found = iter(_through(closed.jaxpr, groups))
    return [set().union(*[next(found) for _ in jtu.tree_leaves(x)]) for x in out]


def _through(jaxpr: Any, inputs: Sequence[set[int]]) -> list[set[int]]:
    known = dict(zip(jaxpr.invars, inputs, strict=True))
    needs = lambda x: set() if isinstance(x, Literal) else known.get(x, set())  # noqa: E731
    for eqn in jaxpr.eqns:
        of_operands = [needs(x) for x in eqn.invars]
        inner = eqn.params.get(CALLS.get(eqn.primitive.name, ""))
        inner = getattr(inner, "jaxpr", inner)
        if len(getattr(inner, "invars", ())) == len(eqn.invars) and hasattr(inner, "eqns"):
            results = _through(inner, of_operands)
        else:
            results = [set().union(*of_operands)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, results, strict=True))
    return [needs(x) for x in jaxpr.outvars]


class Blocks:
    """A square matrix of blocks. `blocks[p, q]` is missing where it is zero."""

    def __init__(self, slices: Sequence[slice], blocks: dict[tuple[int, int], Real[Array, "..."]]):
        self.slices, self.blocks = slices, blocks

    def __matmul__(self, x: Real[Array, "n k"]) -> Real[Array, "n k"]:
        rows = []
        for p, s in enumerate(self.slices):
            terms = [
                matmul(block, x[self.slices[q]]) for (i, q), block in self.blocks.items() if i == p
            ]
            rows.append(sum(terms[1:], terms[0]) if terms else jnp.zeros_like(x[s]))
        return jnp.concatenate(rows)

    def dense(self, dtype: Any) -> Real[Array, "n n"]:
        sizes = [s.stop - s.start for s in self.slices]
        rows = [
            [self.blocks.get((p, q), jnp.zeros((m, k), dtype)) for q, k in enumerate(sizes)]
            for p, m in enumerate(sizes)
        ]
        return jnp.block(rows)

    def trace(self, dtype: Any) -> Real[Array, ""]:
        diagonal = [jnp.trace(block) for (p, q), block in self.blocks.items() if p == q]
        return sum(diagonal, jnp.zeros((), dtype))
