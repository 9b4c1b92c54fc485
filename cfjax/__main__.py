"""The command line: `python -m cfjax`."""

import argparse
import inspect
import math
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import jax

from . import scenes
from ._measure.extra import paper_extra
from ._measure.small_loops import compile_small_loops
from .scenes._scene import Scene

_SCENES = {
    name: module
    for name, module in vars(scenes).items()
    if isinstance(module, Scene) and isinstance(module, types.ModuleType)
}
# A scene may have several charts: `scenes.stiefel.chart_first` is that of stiefel_first.
_CHARTS = {
    scene + name.removeprefix("chart"): function
    for scene, module in _SCENES.items()
    for name, function in vars(module).items()
    if name == "chart" or name.startswith("chart_")
}
# Noise has no work-precision chart: errors of a mean are mostly those of the sample.
_WITHOUT_CHART = {
    name
    for name, module in _SCENES.items()
    if not any(function.startswith("chart") for function in vars(module))
}

# On two cores with nothing else to do.
_PAPER_TIME = "Takes some minutes."
_CHART_TIME = "Compiles for some seconds."
_SCENE_TIME = "Takes up to some minutes."

_YOUR_OWN = 'Your own inertia and step sizes: docs/methods.md, section "Measure your own".'


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        # One line, without argparse's usage in front.
        self.exit(2, f"{self.prog}: error: {message}\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit status. Bad arguments exit with status 2."""
    if argv is None:
        compile_small_loops()
    parser = _Parser(
        prog="cfjax",
        description="Commutator-free Lie group integrators for JAX.",
        epilog=_list_of_scenes(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    paper = commands.add_parser(
        "paper",
        help="repeat the paper's experiments",
        description=(
            "Repeats the experiments of Celledoni, Marthinsen & Owren (2003): prints Tables 1 to 4 "
            "beside the printed numbers and draws Figures 1 to 4 as PNG and PDF. In float64. "
            + _PAPER_TIME
        ),
    )
    chart = commands.add_parser(
        "chart",
        help="chart speed against accuracy for a scene",
        description=(
            "Measures what an error costs with each method, prints the table, and draws the chart "
            "as PNG and PDF, and a picture of the scene if it has one. The table is written as "
            "CSV, too. In float64. " + _CHART_TIME
        ),
    )
    names = ", ".join(_CHARTS)
    chart.add_argument("scene", metavar="SCENE", type=_chart, choices=_CHARTS, help=names)
    chart.add_argument(
        "--budget",
        metavar="SECONDS",
        type=_seconds,
        default=20.0,
        help="how long to measure, compilation not included (default: %(default)g)",
    )
    scene = commands.add_parser(
        "scene",
        help="run a scene",
        description=(
            "Solves a scene with 1000 steps of the method for it, prints what the solution keeps "
            "and how long it takes, and draws a picture as PNG and PDF. In float64. " + _SCENE_TIME
        ),
    )
    scene.add_argument("scene", metavar="SCENE", choices=_SCENES, help=", ".join(_SCENES))
    for command in (paper, chart, scene):
        command.add_argument(
            "--output",
            metavar="DIR",
            type=_folder,
            default=Path("figures"),
            help="folder for the files, made if it is missing (default: %(default)s)",
        )
    arguments = parser.parse_args(argv)
    if arguments.command is None:
        parser.print_help()
        return 0
    command = {"paper": paper, "chart": chart, "scene": scene}[arguments.command]
    try:
        with paper_extra():
            from . import _paper
            from ._measure import report as _report
    except ModuleNotFoundError as error:
        command.error(str(error))
    jax.config.update("jax_enable_x64", True)
    if command is paper:
        experiments, patience = _paper.EXPERIMENTS, _PAPER_TIME
    elif command is scene:
        name, patience = arguments.scene, _SCENE_TIME
        experiments = [lambda progress: _report.scene(name, _SCENES[name], progress)]
    else:
        name, budget = arguments.scene, arguments.budget
        picture = getattr(_SCENES.get(name), "picture", None)
        measure = _CHARTS[name]
        experiments = [lambda progress: _report.chart(name, measure, budget, progress, picture)]
        patience = f"{_CHART_TIME} Then measures for {budget:g} seconds."
    try:
        _report.run(arguments.output, experiments, patience)
    except OSError as error:
        command.error(f"cannot write to {arguments.output}: {error.strerror or error}")
    if command is paper:
        print(_YOUR_OWN)
    return 0


def _list_of_scenes() -> str:
    width = max(map(len, _SCENES))
    lines = (
        f"  {name:<{width}}  {(inspect.getdoc(module) or '').splitlines()[0]}"
        for name, module in _SCENES.items()
    )
    return "\n".join(["scenes:", *lines])


def _chart(text: str) -> str:
    if text in _WITHOUT_CHART:
        raise argparse.ArgumentTypeError(
            f"{text} has no chart, as it has noise; cfjax scene {text} draws it"
        )
    return text


def _folder(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("must name a folder, got ''")
    return Path(text)


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
