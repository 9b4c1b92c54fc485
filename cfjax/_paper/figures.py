"""What the paper's figures have in common."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from rich.console import RenderableType

# Colours of Okabe & Ito that colour-blind readers tell apart; the line styles serve all others.
STYLES: dict[str, dict[str, Any]] = {
    "CF3": dict(color="#009E73", linestyle="-.", marker="^"),
    "RKMK3": dict(color="#CC79A7", linestyle=":", marker="v", linewidth=1.9),
    "CF4": dict(color="#0072B2", linestyle="-", marker="o"),
    "RKMK4": dict(color="#D55E00", linestyle="--", marker="s"),
    "RKMK4, full series": dict(color="#E69F00", linestyle=":", marker="D", linewidth=1.9),
    "RKR-C4": dict(color="#56B4E9", linestyle="-.", marker="v"),
}


class Report(NamedTuple):
    """What one experiment prints, in this order, and its figures by file name."""

    printed: Sequence[RenderableType]
    figures: Mapping[str, Figure]


def number(x: float) -> str:
    """`x` with two digits and a power of ten, for captions."""
    mantissa, exponent = f"{x:.1e}".split("e")
    superscript = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa} · 10{superscript}"


def new_figure(size: tuple[float, float], caption: str) -> Figure:
    """An empty figure of `size` inches with a caption below."""
    text = textwrap.fill(caption, 112)
    width, height = size
    below = (0.16 * (text.count("\n") + 1) + 0.15) / height
    layout = ConstrainedLayoutEngine(rect=(0, below, 1, 1 - below))
    figure = Figure(figsize=(width, height), layout=layout)
    figure.text(0.12 / width, 0.08 / height, text, fontsize=8, linespacing=1.3, va="bottom")
    return figure


def finish(figure: Figure, columns: int) -> None:
    """A grid in every panel, and one legend of so many columns above them all."""
    for axes in figure.axes:
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=columns, frameon=False, handlelength=3.5)
