"""Speed against accuracy: the charts of the scenes, and the paper's Figure 2."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import results
from cfjax import WorkPrecision
from cfjax._batch.progress import on_terminal
from cfjax._measure import report as _report
from cfjax._paper import rigid_body as paper
from cfjax.scenes import heat, rigid_body, stiefel

CHARTS: dict[str, Callable[..., WorkPrecision]] = {
    "charts/rigid_body": rigid_body.chart,
    "charts/stiefel_first": stiefel.chart_first,
    "charts/stiefel_second": stiefel.chart_second,
    "charts/heat": heat.chart,
}
FIGURE_2 = "rigid_body"


def measure(quick: bool, only: tuple[str, ...] = ()) -> Iterator[results.Row]:
    budget = 3.0 if quick else 20.0
    for name, chart in CHARTS.items():
        if not only or name in only:
            yield from _rows(name, chart(budget=budget, progress=False))
    if only and FIGURE_2 not in only:
        return
    repeats = 10 if quick else paper.REPEATS
    with on_terminal(transient=True) as progress:
        yield from _rows(FIGURE_2, paper.efficiencies(paper.STEP_COUNTS, repeats, progress))


def _rows(name: str, work: WorkPrecision) -> Iterator[results.Row]:
    for values in zip(*work, strict=True):
        row = dict(zip(work._fields, values, strict=True))
        seconds = [results.digits(x) for x in row.pop("seconds")]
        numbers = {k: x if isinstance(x, str) else float(x) for k, x in row.items()}
        yield {"chart": name, **numbers, "seconds": seconds}


def work(name: str) -> WorkPrecision:
    """The stored measurements of a chart."""
    rows = results.pick(results.load("charts")["rows"], chart=name)
    columns = {field: [row[field] for row in rows] for field in WorkPrecision._fields}
    words = ("method", "note")
    tuples: dict[str, Any] = {k: tuple(columns.pop(k)) for k in words}
    arrays: dict[str, Any] = {k: np.array(v, float) for k, v in columns.items()}
    return WorkPrecision(**tuples, **arrays)


def draw() -> dict[str, Figure]:
    figures: dict[str, Figure] = {FIGURE_2: paper.figure_2(work(FIGURE_2))}
    for name, chart in CHARTS.items():

        @functools.wraps(chart)  # Its docstring is in the caption.
        def stored(name: str = name, **_: Any) -> WorkPrecision:
            return work(name)

        with on_terminal(transient=True) as progress:
            figures |= _report.chart(name, stored, 0.0, progress).figures
    return figures


if __name__ == "__main__":
    results.run(__file__, __doc__, measure, [*CHARTS, FIGURE_2], key="chart")
