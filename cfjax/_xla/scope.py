"""What is rewritten: the switch, the place within a program, and short vectors."""

import contextlib
import os
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .limits import MAX_LENGTH, MAX_SIZE

# JAX compiles anew where it changes.
_on = jax.make_user_context({"0": False, "1": True}.get(os.environ.get("CFJAX_REWRITE", "")))


def rewriting(on: bool | None) -> contextlib.AbstractContextManager:
    """Switches the rewriting of small systems for XLA on or off within a `with` block.

    Rewriting makes steps of many systems several times faster on CPU and GPU, and takes time to
    compile. The values agree to rounding.

    - None, the default: rewrites batches, and short vectors along leading axes. Before jax 0.12
      also short programs of one system.
    - True: rewrites one system too. Gradients of long solves may then take half the time, and up to
      7 times as long to compile. Values and Jacobians rarely gain.
    - False: XLA gets every program as it was traced, for debugging and for programs that run a few
      times.

    The environment variable `CFJAX_REWRITE`, 0 or 1, sets the default of a process.

    ```python
    with cfjax.rewriting(False):
        sol = cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=100)
    ```

    **Raises** `TypeError` if `on` is neither a bool nor None.
    """
    if not (on is None or isinstance(on, bool)):
        raise TypeError(f"on must be True, False or None, got {on!r}.")
    return _on(on)


def is_on() -> bool:
    # Values that say how they are spread over a mesh: nothing here hands that on.
    axes = jax.sharding.get_abstract_mesh().axis_types or ()
    return _on.value is not False and all(kind == jax.sharding.AxisType.Auto for kind in axes)


def is_everywhere() -> bool:
    """Whether one system is scalarised as many are."""
    return _on.value is True


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


def is_rows(x: Any) -> bool:
    """Whether these are many short vectors along leading axes, more than are taken one by one."""
    length = np.shape(x)[-1] if np.ndim(x) > 1 else 0
    return 1 < length <= MAX_LENGTH and np.size(x) > length * MAX_SIZE and is_numeric(x)


def is_numeric(x: Any) -> bool:
    # `jnp.result_type` knows no PRNG keys.
    dtype = x.dtype if hasattr(x, "dtype") else jnp.result_type(x)
    return any(jnp.issubdtype(dtype, kind) for kind in (np.number, np.bool_))
