"""Several steps of another solver in the place of one."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import PyTree

from .base import time_at
from .compiled import by_turns

# The state, that of the solver, and the first failure.
Progress = tuple[PyTree, PyTree, Any]


def substeps(
    solver: Any,
    terms_of: Callable[[Any], PyTree],
    turns: Sequence[Any],
    t0: Any,
    t1: Any,
    args: PyTree,
    progress: Progress,
) -> tuple[Progress, list[diffrax.AbstractLocalInterpolation]]:
    """Steps of a solver of this package, and the output of each, for times from 0 to 1.

    A turn has a `start` and an `end`, as parts of the whole step, and `terms_of` it are the terms
    in it.
    """

    def follow(progress: Progress, turn: Any) -> tuple[Progress, Any]:
        y, state, result = progress
        start, end = (time_at(c, t0, t1) for c in (turn.start, turn.end))
        terms = terms_of(turn)
        y, _, dense_info, state, new = solver.step(terms, start, end, y, args, state, False)
        if not solver.shows_failure:
            result = first_failure(result, new)
        # Arrays, as diffrax stores them.
        zero = jnp.zeros((), jnp.result_type(t0))
        part = solver.interpolation_cls(t0=zero, t1=zero + 1, **dense_info)
        return (y, state, result), part

    return by_turns(follow, progress, turns)


def first_failure(*results: Any) -> Any:
    """The first of some results that is one."""
    first, *rest = results
    for result in rest:
        # Left out where no step can fail: a loop of small steps feels every operation.
        if result is not diffrax.RESULTS.successful:
            is_first = first == diffrax.RESULTS.successful
            first = diffrax.RESULTS.where(is_first, result, first)
    return first
