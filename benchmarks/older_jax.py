"""Equal errors on jaxlib below 0.12, with and without XLA's option for small loops.

Each runs in a process of its own, as XLA reads its options once.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator

import jax

import equal_error
import results

SCENES = ("rigid body", "spacecraft", "given rate", "pose")
# The limit of XLA itself, in bytes, and the one that cfjax's own programs set.
LIMITS = {"without": 2**10, "with": 2**20}


def measure(quick: bool) -> Iterator[results.Row]:
    for option, limit in LIMITS.items():
        flags = f"--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={limit}"
        command = [sys.executable, __file__, "--rows", "--quick" if quick else ""]
        environment = {**os.environ, "XLA_FLAGS": flags}
        process = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=environment
        )
        for line in process.stdout.splitlines():
            yield {"option": option, **json.loads(line)}


def main() -> None:
    if sys.argv[1:2] != ["--rows"]:
        results.run(__file__, __doc__, measure)
        return
    jax.config.update("jax_enable_x64", True)
    for scene in SCENES:
        for row in equal_error.of_scene(scene, equal_error.SCENES[scene], "--quick" in sys.argv):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
