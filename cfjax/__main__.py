"""The command line: `python -m cfjax`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn


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
    paper.add_argument(
        "--output",
        metavar="DIR",
        type=Path,
        default=Path("figures"),
        help="folder for the figures, made if it is missing (default: %(default)s)",
    )
    arguments = parser.parse_args(argv)
    if arguments.command is None:
        parser.print_help()
        return 0
    return _run_paper(paper, arguments.output)


def _run_paper(parser: argparse.ArgumentParser, output: Path) -> int:
    import jax

    try:
        from . import _paper
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in ("matplotlib", "rich"):
            raise
        parser.error(f"{missing} is missing: pip install cfjax[paper]")
    jax.config.update("jax_enable_x64", True)
    try:
        _paper.run(output)
    except OSError as error:
        parser.error(f"cannot write the figures to {output}: {error.strerror or error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
