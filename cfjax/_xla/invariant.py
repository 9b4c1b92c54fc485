"""What is the same in every turn of a loop, computed once, before it."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import PyTree

from .jaxprs import altered, narrowed, variables, without_dead_code
from .understood import INVARIANT, is_invariant


def invariant(tree: PyTree) -> PyTree:
    """The same tree, its arrays marked. Where they are the same in every turn of a loop, and
    `invariants_first` knows of it, they are computed before it.

    A program with marks is not scalarised: these are arrays that much is made of, such as functions
    of an operator, and it would be long.
    """
    return jtu.tree_map(
        lambda x: checkpoint_name(x, INVARIANT) if isinstance(x, jax.Array) else x, tree
    )


def invariants_first(turn: Callable[[PyTree], PyTree], carry: PyTree) -> Callable[[PyTree], PyTree]:
    """`turn`, for a loop over carries like this one, with all that is marked computed here.

    That is, all of it that does not depend on the carry. XLA leaves such values in the loop, and
    reverse mode would store them for each turn. No operation changes; only where it stands does.
    """
    _, structure = jtu.tree_flatten(carry)
    program, shapes = jax.make_jaxpr(turn, return_shape=True)(carry)
    jaxpr = program.jaxpr
    marked = variables(eqn.invars[0] for eqn in jaxpr.eqns if is_invariant(eqn))

    def computing(vs: list[Any]) -> tuple[ClosedJaxpr, Sequence[int]]:
        return narrowed(ClosedJaxpr(altered(jaxpr, outvars=vs), program.consts))

    # Those that need nothing of the carry. An operation with more results stays where it is.
    single = {eqn.outvars[0] for eqn in jaxpr.eqns if len(eqn.outvars) == 1}
    fixed = [v for v in dict.fromkeys(marked) if v in single and not computing([v])[1]]
    if not fixed:
        return turn
    before, _ = computing(fixed)
    # As one program, where nothing else is one.
    values = jax.jit(jaxpr_as_fun(before))()
    done = set(fixed)
    rest = altered(
        jaxpr,
        constvars=[*jaxpr.constvars, *fixed],
        eqns=[eqn for eqn in jaxpr.eqns if done.isdisjoint(eqn.outvars)],
    )
    run = jaxpr_as_fun(ClosedJaxpr(without_dead_code(rest), [*program.consts, *values]))
    end = jtu.tree_structure(shapes)
    return lambda carry: end.unflatten(run(*structure.flatten_up_to(carry)))
