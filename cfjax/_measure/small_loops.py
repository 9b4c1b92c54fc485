"""An option of XLA: small loops as one function, which jaxlib 0.12 does by itself."""

import os
from collections.abc import MutableMapping

import jax

_OPTION = "xla_cpu_small_while_loop_byte_threshold"


def compile_small_loops(environ: MutableMapping[str, str] = os.environ) -> None:
    """Lets XLA on CPU compile a loop that needs at most 1 MiB of memory as one function.

    For jaxlib below 0.12, where the limit is 1 KiB. It has an effect before JAX has used its first
    device. Options of the user stay as they are.
    """
    flags = environ.get("XLA_FLAGS", "")
    if jax.__version_info__ < (0, 12) and "xla_backend_extra_options" not in flags:
        environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options={_OPTION}={2**20}".strip()
