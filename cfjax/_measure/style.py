"""The one style of all figures."""

import itertools
import textwrap
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

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
# The styles of all other methods, in turn.
_OTHER_STYLES = [
    dict(color="#56B4E9", linestyle="-", marker="D"),
    dict(color="#E69F00", linestyle="--", marker="P"),
    dict(color="#000000", linestyle="-.", marker="X"),
    dict(color="#999999", linestyle=":", marker="*"),
    dict(color="#D55E00", linestyle="-", marker="<"),
    dict(color="#CC79A7", linestyle="--", marker=">"),
    dict(color="#009E73", linestyle=":", marker="h"),
]


def styles(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """A style for each method. The methods of the paper always have the same."""
    other_styles = itertools.cycle(_OTHER_STYLES)
    return {name: STYLES.get(name) or next(other_styles) for name in methods}


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
    """Makes the x axis of a finished plot logarithmic, with ticks such as 20 µs."""
    axes.set(xscale="log", xlabel=label)
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 50 * low else (1,)))
    axes.xaxis.set_major_formatter(EngFormatter(unit))
    axes.xaxis.set_minor_formatter(NullFormatter())


def times(axes: Axes, seconds: np.ndarray, error: np.ndarray, **style: Any) -> None:
    """Error against the fastest of the runs, with a bar to the upper quartile."""
    best, upper = np.percentile(seconds, (0, 75), axis=-1)
    # Lists: matplotlib before 3.11 takes an array of one entry for a number.
    bars = np.zeros_like(best).tolist(), (upper - best).tolist()
    axes.errorbar(best, error, xerr=bars, capsize=3, **style)


def about_times(seconds: np.ndarray) -> str:
    """The sentence of a caption about these."""
    return (
        f"the fastest of {seconds.shape[-1]} runs in turns on one {jax.default_backend().upper()}; "
        "bars reach to the upper quartile."
    )


def finish(figure: Figure, columns: int) -> None:
    """Adds a grid to every panel, and one legend of so many columns above them all."""
    for axes in figure.axes:
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=columns, frameon=False, handlelength=3.5)
