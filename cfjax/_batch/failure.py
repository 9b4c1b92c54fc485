"""What is said where the program of a chunk raises an error: which member failed, and why."""

import contextlib
import logging
import re
from collections.abc import Callable, Iterator, Sequence

import equinox as eqx
import jax
import numpy as np

from .program import Program

# What a check of equinox says in an error of a compiled program, before its advice.
_MESSAGE = re.compile(r"_EquinoxRuntimeError: (.*?)\n\n\n-", re.DOTALL)


def solved(
    program: Program,
    inputs: Sequence[np.ndarray],
    start: int,
    stop: int,
    update: Callable[..., None],
) -> list[np.ndarray]:
    """The outputs of the members from start to stop.

    **Raises** `eqx.EquinoxRuntimeError` with the member that failed, in place of the long error of
    a check. The member is found by bisection, with the same program: so it is found whatever
    raised, and nothing is compiled.
    """
    try:
        with _unlogged():
            return program(inputs)
    except (RuntimeError, ValueError) as error:
        message = _MESSAGE.search(str(error))
        if message is None:
            error.add_note(f"cfjax.map_batch was solving the members {start} to {stop - 1}.")
            raise
    update(description="Looking for the member that failed")
    raise eqx.EquinoxRuntimeError(
        f"solve failed for {_failing(program, start, stop)}: {message[1]}\n"
        "This stops the batch. If a solver raised it, use throw=False in cfjax.integrate or "
        "diffrax.diffeqsolve, and return the solution: then the other members are solved, and "
        "failed has the indices of those that failed."
    )


def _failing(program: Program, start: int, stop: int) -> str:
    first, last = start, stop
    # Processes solve a chunk together, and may not all know that it failed.
    if jax.process_count() == 1:
        while last - first > 1:
            middle = (first + last) // 2
            first, last = (first, middle) if _fails(program, first, middle) else (middle, last)
        # What fails by chance, or with others alone, is not blamed on the last one looked at.
        if _fails(program, first, last):
            return f"member {first}"
    return f"one of the members {start} to {stop - 1}"


def _fails(program: Program, start: int, stop: int) -> bool:
    try:
        with _unlogged():
            program(program.inputs(start, stop))
    except (RuntimeError, ValueError):
        return True
    return False


@contextlib.contextmanager
def _unlogged() -> Iterator[None]:
    """Without the traceback that jax logs of a check's error before it raises it."""
    logger = logging.getLogger("jax._src.callback")
    logger.addFilter(_is_other)
    try:
        yield
    finally:
        logger.removeFilter(_is_other)


def _is_other(record: logging.LogRecord) -> bool:
    kind = record.exc_info[0] if record.exc_info else None
    return kind is None or kind.__name__ != "_EquinoxRuntimeError"
