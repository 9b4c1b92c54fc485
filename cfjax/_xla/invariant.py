"""What is the same in every turn of a loop, computed once, before it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.tree_util as jtu
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import PyTree

from .jaxprs import altered, narrowed, without_dead_code

_NAME = "cfjax_invariant"


def invariant(tree: PyTree) -> PyTree:
    """The same arrays, marked. Where they are the same in every turn of a loop, and
    `invariants_first` knows of it, they are computed before it.
    """
    return jtu.tree_map(lambda x: checkpoint_name(x, _NAME), tree)


def invariants_first(turn: Callable[[PyTree], PyTree], carry: PyTree) -> Callable[[PyTree], PyTree]:
    """`turn`, for a loop over carries like this one, with all that is marked computed here.

    That is, all of it that does not depend on the carry. XLA leaves such values in the loop, and
    reverse mode would store or compute them for each turn. No operation changes; only where it
    stands does.
    """
    leaves, structure = jtu.tree_flatten(carry)
    program, shapes = jax.make_jaxpr(turn, return_shape=True)(carry)
    jaxpr = program.jaxpr
    marks = [eqn for eqn in jaxpr.eqns if eqn.params.get("name") == _NAME]
    marked = [v for eqn in marks for v in eqn.outvars]

    def of_marks(vs: list[Any]) -> tuple[ClosedJaxpr, Any]:
        return narrowed(ClosedJaxpr(altered(jaxpr, outvars=vs), program.consts))

    fixed = [v for v in marked if not of_marks([v])[1]]
    if not fixed:
        return turn
    before, _ = of_marks(fixed)
    values = jaxpr_as_fun(before)()
    done = set(fixed)
    rest = altered(
        jaxpr,
        constvars=[*jaxpr.constvars, *fixed],
        eqns=[eqn for eqn in jaxpr.eqns if done.isdisjoint(eqn.outvars)],
    )
    run = jaxpr_as_fun(ClosedJaxpr(without_dead_code(rest), [*program.consts, *values]))
    ends = jtu.tree_structure(shapes)
    del leaves

    def turned(carry: PyTree) -> PyTree:
        return ends.unflatten(run(*structure.flatten_up_to(carry)))

    return turned
