"""The error of a batch whose program raises one: which member failed, and why."""

import contextlib
import logging
import re
from collections.abc import Callable, Iterator, Sequence

import equinox as eqx
import jax
import numpy as np

from .program import Program

# The message of a check of equinox in an error of a compiled program, before its advice.
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
    raised the error, and nothing is compiled.
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
    low, high = start, stop
    # Processes solve a chunk together, and may not all know that it failed.
    if jax.process_count() == 1:
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if _fails(program, low, middle) else (middle, high)
        # A chunk may also fail by chance, or only with all of its members.
        if _fails(program, low, high):
            return f"member {low}"
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
    """Drops the traceback that jax logs of a check's error before it raises the error."""
    logger = logging.getLogger("jax._src.callback")
    logger.addFilter(_is_unrelated)
    try:
        yield
    finally:
        logger.removeFilter(_is_unrelated)


def _is_unrelated(record: logging.LogRecord) -> bool:
    kind = record.exc_info[0] if record.exc_info else None
    return kind is None or kind.__name__ != "_EquinoxRuntimeError"
