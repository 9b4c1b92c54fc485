"""What is rewritten: the switch, the place within a program, and what is small."""

import contextlib
import math
import os
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .limits import MAX_LENGTH, MAX_SIZE, MAX_STAGES

# JAX compiles anew where it changes.
_on = jax.make_user_context(os.environ.get("CFJAX_REWRITE", "") != "0")


def rewriting(on: bool) -> contextlib.AbstractContextManager:
    """Switches the rewriting of small systems for XLA off, or on again, within a `with` block.

    Rewriting makes steps of batches several times faster on CPU and GPU, and takes time to compile.
    The values agree to rounding. Without it XLA gets every program as it was traced, for debugging
    and for batches that run a few times. A single system is never rewritten.

    The environment variable `CFJAX_REWRITE`, 0 or 1, sets the default of a process.

    ```python
    with cfjax.rewriting(False):
        sol = cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=100)
    ```

    **Raises** `TypeError` if `on` is not a bool.
    """
    if not isinstance(on, bool):
        raise TypeError(f"on must be True or False, got {on!r}.")
    return _on(on)


def is_on() -> bool:
    # Values that say how they are spread over a mesh: nothing here hands that on.
    axes = jax.sharding.get_abstract_mesh().axis_types or ()
    return _on.value and all(kind == jax.sharding.AxisType.Auto for kind in axes)


def unread(error: Exception) -> None:
    """Says that a program runs as it is, because it could not be read."""
    warnings.warn(
        "cfjax could not rewrite a program for XLA, so it runs as it is, and slower: "
        f"{type(error).__name__}: {error}. With cfjax.rewriting(False) it does not try.",
        RuntimeWarning,
        stacklevel=2,
    )


# Whether a step is scalarised around a function that is being traced. JAX traces anew where it
# changes, so that a function that is jitted, or cached otherwise, is traced for the place in which
# it is called.
_is_around = jax.make_user_context(False)


def within() -> contextlib.AbstractContextManager:
    """The time in which the program of a step is traced that is to be scalarised."""
    return _is_around(True)


def is_rewritten() -> bool:
    """Whether this is part of a program that is scalarised."""
    return _is_around.value


def is_short(x: Any) -> bool:
    """Whether this is a vector that is scalarised."""
    return np.ndim(x) == 1 and 1 <= np.size(x) <= MAX_LENGTH and is_numeric(x)


def is_small_shape(shape: tuple[int, ...]) -> bool:
    """Whether arrays of this shape are of few entries, or of a short vector for each stage."""
    if math.prod(shape) <= MAX_SIZE:
        return True
    return len(shape) == 2 and shape[0] <= MAX_STAGES and shape[1] <= MAX_LENGTH


def is_numeric(x: Any) -> bool:
    # `jnp.result_type` knows no PRNG keys.
    dtype = x.dtype if hasattr(x, "dtype") else jnp.result_type(x)
    return any(jnp.issubdtype(dtype, kind) for kind in (np.number, np.bool_))
