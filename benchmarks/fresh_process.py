"""Times of a fresh process, from its start until it has finished the task of a benchmark.

A benchmark's file is the command of such a process, `python FILE --one ...`. Its imports are part
of the measured time, so neither file imports jax or cfjax at the top.
"""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import results


def seconds(file: str, *arguments: str) -> tuple[float, float]:
    """Seconds of the processor, and of the clock."""
    begin = time.monotonic()
    command = [sys.executable, file, "--one", *arguments]
    process = subprocess.run(command, check=True, capture_output=True, text=True)
    processor, end = json.loads(process.stdout)
    return processor, end - begin


def run(file: str, doc: str | None, measure: "results.Measure", task: Callable[..., None]) -> None:
    """The command of a benchmark, and with `--one` that of a process, which calls `task`."""
    if sys.argv[1:2] == ["--one"]:
        task(*sys.argv[2:])
        usage = resource.getrusage(resource.RUSAGE_SELF)
        # This clock is the same for all processes.
        print(json.dumps([usage.ru_utime + usage.ru_stime, time.monotonic()]))
        return
    import results

    results.run(file, doc, measure)
