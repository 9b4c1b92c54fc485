"""Time of the code of *Getting started* up to the first printed line.

Each run is a fresh process with nothing compiled before, imports included.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fresh_process

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


def measure(quick: bool) -> "Iterator[results.Row]":
    import results

    # Files come from the disk the first time.
    fresh_process.seconds(__file__)
    turns = [fresh_process.seconds(__file__) for _ in range(2 if quick else 7)]
    processor, clock = zip(*turns, strict=True)
    yield {"CPU seconds": results.spread(processor), "seconds": results.spread(clock)}


if __name__ == "__main__":
    fresh_process.run(__file__, __doc__, measure, read)
