"""What is rewritten: the switch, the place within a program, and short vectors."""

import contextlib
import os
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

# Of vectors that are taken apart. A pose is a quaternion and a position.
_MAX_LENGTH = 7

# JAX compiles anew where it changes.
_is_on = jax.make_user_context(os.environ.get("CFJAX_REWRITE", "1") != "0")


def rewriting(on: bool) -> contextlib.AbstractContextManager:
    """Within, steps of small systems are rewritten for XLA, or not.

    They are by default, which makes them several times faster on CPU. Without, XLA gets every
    program as it was traced: to debug one, or where the rewriting does not pay. The values agree to
    rounding. The environment variable `CFJAX_REWRITE=0` does the same for a whole process.

    ```python
    with cfjax.rewriting(False):
        sol = cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=100)
    ```

    **Raises** `TypeError` if `on` is not a bool.
    """
    if not isinstance(on, bool):
        raise TypeError(f"on must be True or False, got {on!r}.")
    return _is_on(on)


def is_on() -> bool:
    return _is_on.value


def unread(error: Exception) -> None:
    """Says that a program runs as it is, because it could not be read."""
    warnings.warn(
        "cfjax could not rewrite a program for XLA, so it runs as it is, and slower: "
        f"{type(error).__name__}: {error}. With cfjax.rewriting(False) it does not try.",
        RuntimeWarning,
        stacklevel=2,
    )


Place = Literal["step", "loop"]
_place: ContextVar[Place | None] = ContextVar("place", default=None)


@contextlib.contextmanager
def within(place: Place) -> Iterator[None]:
    """The time in which a program is traced that is to be taken apart as a whole."""
    token = _place.set(place)
    try:
        yield
    finally:
        _place.reset(token)


def where() -> Place | None:
    """What is taken apart around here: one step, or a loop of many."""
    return _place.get()


def is_rewritten() -> bool:
    """Whether this is part of a program that is taken apart."""
    return _place.get() is not None


def is_short(x: Any) -> bool:
    """Whether this is a vector that is taken apart."""
    return np.ndim(x) == 1 and 1 <= np.size(x) <= _MAX_LENGTH and is_numeric(x)


def is_numeric(x: Any) -> bool:
    return any(jnp.issubdtype(jnp.result_type(x), kind) for kind in (np.number, np.bool_))
