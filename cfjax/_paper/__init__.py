"""The experiments of the paper: its tables and figures, each beside the printed numbers.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.
"""

import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from . import rigid_body, stiefel
from .figures import Report

EXPERIMENTS: Sequence[Callable[[Progress], Report]] = (rigid_body.report, stiefel.report)


def run(output: Path, experiments: Sequence[Callable[[Progress], Report]] = EXPERIMENTS) -> None:
    """Prints the tables and writes the figures as PNG and PDF to the folder `output`.

    Needs float64.

    **Raises** `OSError` if the folder cannot be made or written to.
    """
    output.mkdir(parents=True, exist_ok=True)
    # On the folder's own disk, so that each figure arrives whole by a rename. Made first, so that
    # a folder without permission fails before the work.
    with tempfile.TemporaryDirectory(dir=output, prefix=".paper-") as folder:
        bar, console = Console(stderr=True), Console()
        for experiment in experiments:
            with Progress(console=bar, transient=True, disable=not bar.is_terminal) as progress:
                report = experiment(progress)
            for part in report.printed:
                console.print(part)
            for name, figure in report.figures.items():
                for path in (f"{name}.png", f"{name}.pdf"):
                    figure.savefig(Path(folder, path), dpi=200)
                    os.replace(Path(folder, path), output / path)
                    console.print(f"Wrote {output / path}", soft_wrap=True)
