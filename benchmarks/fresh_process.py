"""Times of a fresh process, from its start until it has done what a benchmark asks for.

A benchmark's file is its own command for one of them, `python FILE --one ...`. At the top neither
imports what the process is to import itself.
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


def seconds(file: str, *what: str) -> tuple[float, float]:
    """Of the processor, and of the clock."""
    begin = time.monotonic()
    command = [sys.executable, file, "--one", *what]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    processor, end = json.loads(done.stdout)
    return processor, end - begin


def run(file: str, doc: str | None, measure: "results.Measure", one: Callable[..., None]) -> None:
    """The command of a benchmark, and within it that of one of its processes, which calls `one`."""
    if sys.argv[1:2] == ["--one"]:
        one(*sys.argv[2:])
        usage = resource.getrusage(resource.RUSAGE_SELF)
        # This clock is the same for all processes.
        print(json.dumps([usage.ru_utime + usage.ru_stime, time.monotonic()]))
        return
    import results

    results.run(file, doc, measure)
