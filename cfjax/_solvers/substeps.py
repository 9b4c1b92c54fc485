"""Several steps of another solver in the place of one."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax.numpy as jnp
from jaxtyping import PyTree

from .base import time_at
from .compiled import scan_list

# The state, the state of the solver, and the first failure.
Progress = tuple[PyTree, PyTree, Any]


def substeps(
    solver: Any,
    terms_of: Callable[[Any], PyTree],
    intervals: Sequence[Any],
    t0: Any,
    t1: Any,
    args: PyTree,
    progress: Progress,
) -> tuple[Progress, list[diffrax.AbstractLocalInterpolation]]:
    """Steps of a solver of this package, and the output of each, for times from 0 to 1.

    An interval has a `start` and an `end`, as parts of the whole step; `terms_of(interval)` are the
    terms in it.
    """

    def substep(progress: Progress, interval: Any) -> tuple[Progress, Any]:
        y, state, result = progress
        start, end = (time_at(c, t0, t1) for c in (interval.start, interval.end))
        terms = terms_of(interval)
        y, _, dense_info, state, step_result = solver.step(terms, start, end, y, args, state, False)
        if not solver.shows_failure:
            result = first_failure(result, step_result)
        # Arrays, as diffrax stores them.
        zero = jnp.zeros((), jnp.result_type(t0))
        interpolation = solver.interpolation_cls(t0=zero, t1=zero + 1, **dense_info)
        return (y, state, result), interpolation

    return scan_list(substep, progress, intervals)


def first_failure(*results: Any) -> Any:
    """The first of some results that is a failure, or success."""
    first, *later = results
    for result in later:
        # Left out where no step can fail: every operation slows a loop of small steps.
        if result is not diffrax.RESULTS.successful:
            is_first = first == diffrax.RESULTS.successful
            first = diffrax.RESULTS.where(is_first, result, first)
    return first
