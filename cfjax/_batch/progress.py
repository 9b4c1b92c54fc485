"""Progress bars on a terminal."""

import contextlib
import functools
import importlib.util
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import rich.progress


@contextlib.contextmanager
def progress_bar(
    progress: "bool | rich.progress.Progress", description: str, total: int | float
) -> Iterator[Callable[..., None]]:
    """A new progress bar, or one more in the caller's `rich.progress.Progress`.

    Yields the function that changes it: `advance=`, `completed=` or `description=`. There is
    nothing to see if `progress` is false or rich is missing.
    """
    if not isinstance(progress, bool) and not hasattr(progress, "add_task"):
        raise TypeError(f"progress must be a bool or a rich.progress.Progress, got {progress!r}.")
    if not isinstance(progress, bool):
        yield functools.partial(progress.update, progress.add_task(description, total=total))
    elif not progress or importlib.util.find_spec("rich") is None:
        yield lambda **changes: None
    else:
        with on_terminal() as bars:
            yield functools.partial(bars.update, bars.add_task(description, total=total))


def on_terminal(transient: bool = False) -> "rich.progress.Progress":
    """Bars on stderr, if that is a terminal. Needs rich."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn

    console = Console(stderr=True)
    # A first program may compile for a minute, in which nothing else moves.
    columns = SpinnerColumn("line"), *Progress.get_default_columns()
    return Progress(*columns, console=console, transient=transient, disable=not console.is_terminal)
