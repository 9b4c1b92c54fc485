"""What the commands print and write: tables, figures and data."""

import inspect
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
from matplotlib.figure import Figure
from rich.console import Console, RenderableType
from rich.progress import Progress

from .._integrate.progress import on_terminal
from .._signals import busy
from .style import new_figure
from .work_precision import WorkPrecision


class Report(NamedTuple):
    """What one experiment prints, in this order, and its figures and data by file name."""

    printed: Sequence[RenderableType]
    figures: Mapping[str, Figure]
    data: Mapping[str, WorkPrecision] = {}


def run(output: Path, experiments: Sequence[Callable[[Progress], Report]], patience: str) -> None:
    """Prints tables and writes figures as PNG and PDF, and data as CSV, to the folder `output`.

    Says before the work how long it takes: `patience`.

    **Raises** `OSError` if the folder cannot be made or written to.
    """
    output.mkdir(parents=True, exist_ok=True)
    # A folder without permission fails before the work.
    tempfile.TemporaryFile(dir=output).close()
    Console(stderr=True).print(patience, soft_wrap=True)
    console = Console()
    for experiment in experiments:
        with on_terminal(transient=True) as progress:
            report = experiment(progress)
        for part in report.printed:
            console.print(part)
        for name in _write(report, output):
            console.print(f"Wrote {output / name}", soft_wrap=True)


def _write(report: Report, output: Path) -> list[str]:
    """Writes the files of a report and returns their names."""
    # On the folder's own disk, so that each file arrives whole by a rename.
    with busy, tempfile.TemporaryDirectory(dir=output, prefix=".cfjax-") as folder:
        for name, figure in report.figures.items():
            for path in (f"{name}.png", f"{name}.pdf"):
                figure.savefig(Path(folder, path), dpi=200)
        for name, work in report.data.items():
            work.to_csv(Path(folder, f"{name}.csv"))
        names = sorted(os.listdir(folder))
        for name in names:
            os.replace(Path(folder, name), output / name)
    return names


def chart(
    name: str,
    measure: Callable[..., WorkPrecision],
    budget: float,
    progress: Progress,
    picture: Callable[[], Figure] | None = None,
) -> Report:
    """The chart of a scene, and its picture if it has one.

    The first line of the docstring of `measure` is in the chart's caption.
    """
    work = measure(budget=budget, progress=progress)
    subject = (inspect.getdoc(measure) or name).splitlines()[0]
    figure = new_figure(
        (7.0, 4.8),
        f"{subject} Time: the fastest of {work.seconds.shape[1]} runs in turns on one "
        f"{jax.default_backend().upper()}; bars reach to the upper quartile. Flops: operations of "
        "one step as traced, times the steps.",
    )
    figures = {name: work.plot(figure)}
    if picture is not None:
        figures[f"{name}_picture"] = picture()
    return Report([work.table()], figures, {name: work})
