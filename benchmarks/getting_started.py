"""What a reader waits for who pastes *Getting started*, up to the first line that is printed.

Each time in a fresh process with nothing compiled before, imports included.
"""

import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import results

PAGE = Path(__file__).parents[1] / "docs" / "getting_started.md"


def read() -> None:
    """The blocks of code of the page, up to the first that prints."""
    # Standard output is for the times.
    variables: dict[str, Any] = {"print": lambda *values: repr(values)}
    for text in PAGE.read_text(encoding="utf-8").split("```python\n")[1:]:
        block = text.partition("```")[0]
        exec(block, variables)
        if "print(" in block:
            return
    raise ValueError(f"No block of {PAGE} prints.")


def seconds() -> tuple[float, float]:
    """Of the processor, and of the clock, in a process of their own."""
    begin = time.monotonic()
    command = [sys.executable, __file__, "--one"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    processor, end = json.loads(done.stdout)
    return processor, end - begin


def measure(quick: bool) -> "Iterator[results.Row]":
    import results

    # Files come from the disk the first time.
    seconds()
    processor, clock = zip(*(seconds() for _ in range(2 if quick else 7)), strict=True)
    yield {"CPU seconds": results.spread(processor), "seconds": results.spread(clock)}


def main() -> None:
    if sys.argv[1:] == ["--one"]:
        read()
        usage = resource.getrusage(resource.RUSAGE_SELF)
        # This clock is the same for all processes.
        print(json.dumps([usage.ru_utime + usage.ru_stime, time.monotonic()]))
        return
    import results

    results.run(__file__, __doc__, measure)


if __name__ == "__main__":
    main()
