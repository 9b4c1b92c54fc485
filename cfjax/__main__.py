"""The command line: `python -m cfjax`."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from . import scenes

_SCENES = {name: scene.chart for name, scene in vars(scenes).items() if hasattr(scene, "chart")}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # One line, without argparse's usage in front.
        self.exit(2, f"{self.prog}: error: {message}\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit status. Bad arguments exit with status 2."""
    parser = _Parser(prog="cfjax", description="Commutator-free Lie group integrators for JAX.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    paper = commands.add_parser(
        "paper",
        help="repeat the paper's rigid body experiment",
        description=(
            "Repeats the rigid body experiment of Celledoni, Marthinsen & Owren (2003), Section "
            "3.1: prints the errors of CF3, CF4, RKMK3 and RKMK4 and draws Figures 1 and 2 as PNG "
            "and PDF. Takes about half a minute in float64."
        ),
    )
    chart = commands.add_parser(
        "chart",
        help="chart speed against accuracy for a scene",
        description=(
            "Measures what an error costs with each method, prints the table, and draws the chart "
            "as PNG and PDF. The table is written as CSV, too. In float64."
        ),
    )
    chart.add_argument("scene", metavar="SCENE", choices=_SCENES, help=", ".join(_SCENES))
    chart.add_argument(
        "--budget",
        metavar="SECONDS",
        type=_seconds,
        default=20.0,
        help="how long to measure, compilation not included (default: %(default)g)",
    )
    for command in (paper, chart):
        command.add_argument(
            "--output",
            metavar="DIR",
            type=Path,
            default=Path("figures"),
            help="folder for the files, made if it is missing (default: %(default)s)",
        )
    arguments = parser.parse_args(argv)
    if arguments.command is None:
        parser.print_help()
        return 0
    import jax

    command = {"paper": paper, "chart": chart}[arguments.command]
    try:
        from . import _paper, _report
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("matplotlib", "rich"):
            raise
        command.error(f"{missing} is missing: pip install cfjax[paper]")
    jax.config.update("jax_enable_x64", True)
    if command is paper:
        experiments = _paper.EXPERIMENTS
    else:
        scene, budget = arguments.scene, arguments.budget
        experiments = [lambda progress: _report.chart(scene, _SCENES[scene], budget, progress)]
    try:
        _report.run(arguments.output, experiments)
    except OSError as error:
        command.error(f"cannot write to {arguments.output}: {error.strerror or error}")
    return 0


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"must be a positive number of seconds, got {text!r}")
    return seconds


if __name__ == "__main__":
    sys.exit(main())
