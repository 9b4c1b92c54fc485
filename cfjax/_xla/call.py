"""Functions that XLA compiles on their own."""

from collections.abc import Callable
from typing import Any

import jax
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata


def call(fun: Callable[..., Any]) -> Callable[..., Any]:
    """`fun` of arrays as a function of its own in the program, on CPU.

    Otherwise XLA fuses it with what follows, and computes it anew for every entry of that.
    For functions of large arrays: what goes in and comes out goes through memory.
    """
    compiled = jax.jit(fun)

    def called(*args: Any) -> Any:
        with set_xla_metadata(inlineable="false"):
            return compiled(*args)

    # Only there the calls are known to work.
    return lambda *args: lax.platform_dependent(*args, cpu=called, default=fun)
