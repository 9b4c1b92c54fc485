"""What the commands print and write: tables, figures and data, all in one style."""

import inspect
import itertools
import os
import tempfile
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter
from rich.console import Console, RenderableType
from rich.progress import Progress

from ._progress import on_terminal
from ._signals import busy
from ._work_precision import WorkPrecision

# Colours of Okabe & Ito that colour-blind readers tell apart; the line styles serve all others.
STYLES: dict[str, dict[str, Any]] = {
    "CF3": dict(color="#009E73", linestyle="-.", marker="^"),
    "RKMK3": dict(color="#CC79A7", linestyle=":", marker="v", linewidth=1.9),
    "CF4": dict(color="#0072B2", linestyle="-", marker="o"),
    "RKMK4": dict(color="#D55E00", linestyle="--", marker="s"),
    "RK4": dict(color="#000000", linestyle="-.", marker="D"),
    "RKMK4, full series": dict(color="#E69F00", linestyle=":", marker="D", linewidth=1.9),
    "RKR-C4": dict(color="#56B4E9", linestyle="-.", marker="v"),
}
# For all other methods, in turn.
_OTHER_STYLES = [
    dict(color="#56B4E9", linestyle="-", marker="D"),
    dict(color="#E69F00", linestyle="--", marker="P"),
    dict(color="#000000", linestyle="-.", marker="X"),
    dict(color="#999999", linestyle=":", marker="*"),
]


def styles(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """A style for each method: always the same for those of the paper."""
    others = itertools.cycle(_OTHER_STYLES)
    return {name: STYLES.get(name) or next(others) for name in methods}


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
    name: str, measure: Callable[..., WorkPrecision], budget: float, progress: Progress
) -> Report:
    """The chart of a scene. The first line of the docstring of `measure` is in its caption."""
    work = measure(budget=budget, progress=progress)
    subject = (inspect.getdoc(measure) or name).splitlines()[0]
    figure = new_figure(
        (7.0, 4.8),
        f"{subject} Time: the fastest of {work.seconds.shape[1]} runs in turns on one "
        f"{jax.default_backend().upper()}; bars reach to the upper quartile. Flops: operations of "
        "one step as traced, times the steps.",
    )
    return Report([work.table()], {name: work.plot(figure)}, {name: work})


def number(x: float) -> str:
    """`x` with two digits and a power of ten, for captions."""
    mantissa, exponent = f"{x:.1e}".split("e")
    superscript = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa} · 10{superscript}"


def new_figure(size: tuple[float, float], caption: str = "") -> Figure:
    """An empty figure of `size` inches with a caption below."""
    text = textwrap.fill(caption, 112)
    width, height = size
    below = (0.16 * (text.count("\n") + 1) + 0.15) / height if text else 0.0
    layout = ConstrainedLayoutEngine(rect=(0, below, 1, 1 - below))
    figure = Figure(figsize=(width, height), layout=layout)
    figure.text(0.12 / width, 0.08 / height, text, fontsize=8, linespacing=1.3, va="bottom")
    return figure


def logarithmic(axes: Axes, label: str, unit: str = "") -> None:
    """A logarithmic axis for what is drawn already, with ticks such as 20 µs."""
    axes.set(xscale="log", xlabel=label)
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 50 * low else (1,)))
    axes.xaxis.set_major_formatter(EngFormatter(unit))
    axes.xaxis.set_minor_formatter(NullFormatter())


def finish(figure: Figure, columns: int) -> None:
    """A grid in every panel, and one legend of so many columns above them all."""
    for axes in figure.axes:
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=columns, frameon=False, handlelength=3.5)
