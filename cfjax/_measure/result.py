"""The result of `work_precision`, with its table and chart."""

import csv
import os
import textwrap
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from .extra import paper_extra

if TYPE_CHECKING:
    import matplotlib.figure
    import rich.table


class WorkPrecision(NamedTuple):
    """The cost and the error of each method: one row for each method and setting.

    NaN stands for unknown values. Rows of runs that failed have NaN as `error` and `seconds`.

    **Fields:**

    - `method`: the method's name.
    - `tolerance`: the tolerance of an adaptive run, otherwise NaN.
    - `error`: the distance of the final state from the reference.
    - `num_steps`, `num_rejected`: attempted steps, and those among them that were rejected.
    - `num_evaluations`: evaluations of the field, in all attempted steps. NaN for implicit methods,
      whose steps differ.
    - `num_flows`: flows of frozen fields in all attempted steps. A state of several parts moves in
      one flow; a translation does not count.
    - `flops`: floating-point operations of all attempted steps, as traced, without those of the
      step size controller. NaN if a step has an operation without a rule.
    - `compile_seconds`: time to trace and compile the solve. One program serves all settings of a
      method.
    - `seconds`: the time of every repeated run, without the first. Its minimum is the figure to
      compare.
    - `note`: why a run failed, otherwise empty.
    """

    method: tuple[str, ...]
    tolerance: Float[np.ndarray, " rows"]
    error: Float[np.ndarray, " rows"]
    num_steps: Float[np.ndarray, " rows"]
    num_rejected: Float[np.ndarray, " rows"]
    num_evaluations: Float[np.ndarray, " rows"]
    num_flows: Float[np.ndarray, " rows"]
    flops: Float[np.ndarray, " rows"]
    compile_seconds: Float[np.ndarray, " rows"]
    seconds: Float[np.ndarray, "rows repeats"]
    note: tuple[str, ...]

    def select(self, method: str) -> "WorkPrecision":
        """The rows of one method.

        **Raises** `KeyError` if there are none.
        """
        if method not in self.method:
            raise KeyError(f"method must be one of {list(dict.fromkeys(self.method))}: {method!r}")
        rows = [i for i, name in enumerate(self.method) if name == method]
        columns = self._asdict()
        for name, column in columns.items():
            is_array = isinstance(column, np.ndarray)
            columns[name] = column[rows] if is_array else tuple(column[i] for i in rows)
        return WorkPrecision(**columns)

    def slopes(self) -> Float[np.ndarray, " rows"]:
        """The observed orders: how fast the error falls, from the row before to each row.

        `log(e_1 / e_2) / log(n_2 / n_1)` of the errors e and the steps taken n, without rejected
        ones, of one method. NaN in the first row of a method, and where an error is zero or not
        known. Also where a method takes about as many adaptive steps for a smaller tolerance, so
        that something else limits them, such as stability.
        """
        is_same = np.array(self.method[1:]) == np.array(self.method[:-1])
        columns = self.error, self._steps_taken(), self.tolerance
        with np.errstate(divide="ignore", invalid="ignore"):
            errors, steps, tolerances = (np.diff(np.log(column)) for column in columns)
            slopes = -errors / steps
            # Accuracy takes tolerance^(-1 / (p + 1)) steps, and no method has an order p above 10.
            is_limited = -steps / tolerances < 1 / 12
        slopes[~is_same | is_limited | ~np.isfinite(slopes)] = np.nan
        return np.concatenate([[np.nan], slopes])

    def _steps_taken(self) -> Float[np.ndarray, " rows"]:
        return self.num_steps - np.nan_to_num(self.num_rejected)

    def plot(
        self,
        figure: "matplotlib.figure.Figure | None" = None,
        *,
        against: Literal["work", "steps"] = "work",
    ) -> "matplotlib.figure.Figure":
        """The chart of the error. Needs `cfjax[paper]`.

        Against `"work"`: against time, and beside it against flops. A mark is the fastest run; its
        bar reaches to the upper quartile. If the flops of no method are known, the second panel
        shows evaluations of the field.

        Against `"steps"`: against the number of steps taken, without rejected ones. The lines fall
        with the orders of the methods (`slopes`).

        Draws into `figure` if it is given.

        **Raises** `ModuleNotFoundError` without matplotlib and rich, `TypeError` if `figure` is not
        a matplotlib figure, and `ValueError` if `against` is neither of the two.
        """
        with paper_extra():
            from matplotlib.figure import FigureBase

            from . import style as _style
        if figure is not None and not isinstance(figure, FigureBase):
            raise TypeError(f"figure must be a matplotlib figure, got {figure!r}.")
        if against not in ("work", "steps"):
            raise ValueError(f"against must be 'work' or 'steps', got {against!r}.")
        figure = _style.new_figure((7.0, 4.2)) if figure is None else figure
        (self._draw_steps if against == "steps" else self._draw_work)(figure)
        _style.finish(figure, 4)
        return figure

    def _draw_steps(self, figure: "matplotlib.figure.Figure") -> None:
        from . import style as _style

        axes, steps = figure.subplots(), self._steps_taken()
        for name, style in _style.styles(dict.fromkeys(self.method)).items():
            rows = np.array(self.method) == name
            axes.plot(steps[rows], self.error[rows], label=name, **style)
        axes.set(yscale="log", ylabel="error of the final state")
        _style.logarithmic(axes, "steps taken")

    def _draw_work(self, figure: "matplotlib.figure.Figure") -> None:
        from . import style as _style

        time_axes, work_axes = figure.subplots(1, 2, sharey=True)
        counts_flops = bool(np.any(np.isfinite(self.flops)))
        work = self.flops if counts_flops else self.num_evaluations
        unknown = []
        for name, style in _style.styles(dict.fromkeys(self.method)).items():
            rows = np.array(self.method) == name
            _style.times(time_axes, self.seconds[rows], self.error[rows], label=name, **style)
            work_axes.plot(work[rows], self.error[rows], **style)
            if not np.any(np.isfinite(work[rows])):
                unknown.append(name)
        time_axes.set(yscale="log", ylabel="error of the final state")
        _style.logarithmic(time_axes, "time", unit="s")
        label = "flops" if counts_flops else "evaluations of the field"
        label += f" (not known: {', '.join(unknown)})" * bool(unknown)
        _style.logarithmic(work_axes, textwrap.fill(label, 50))
        figure.align_xlabels()

    def table(self) -> "rich.table.Table":
        """The table for a terminal, with the notes below. Needs `cfjax[paper]`.

        The table shows the fastest run, and beside it how much longer the upper quartile took. The
        slope is the observed order, from the row before (`slopes`). A number that is not known is
        an empty cell, and one that is known for no row has no column.

        **Raises** `ModuleNotFoundError` without rich.
        """
        with paper_extra():
            from rich import box
            from rich.table import Table

        is_adaptive = bool(np.any(np.isfinite(self.tolerance)))
        best, upper = np.percentile(self.seconds, (0, 75), axis=-1)
        spread = [f" +{excess:.0%}" for excess in upper / best - 1]
        times = [f"{1e3 * x:.3g}{excess}" for x, excess in zip(best, spread, strict=True)]
        # Short headings, so that adaptive runs with all columns fit into 80 characters.
        columns = {
            "tol": [f"{x:.0e}" for x in self.tolerance],
            "error": [f"{x:.1e}" for x in self.error],
            "slope": [f"{x:.2f}" for x in self.slopes()],
            "steps": [f"{x:.0f}" for x in self.num_steps],
            "re-\njected": [f"{x:.0f}" for x in self.num_rejected] if is_adaptive else [],
            "evals": [f"{x:.6g}" for x in self.num_evaluations],
            "flows": [f"{x:.6g}" for x in self.num_flows],
            "flops": [f"{x:.2e}" for x in self.flops],
            "com-\npile\n(s)": [f"{x:.1f}" for x in self.compile_seconds],
            "time\n(ms)": times,
        }
        for heading, cells in columns.items():
            columns[heading] = ["" if cell.startswith("nan") else cell for cell in cells]
        columns = {heading: cells for heading, cells in columns.items() if any(cells)}

        settings = self.tolerance if is_adaptive else self.num_steps
        failures: dict[tuple[str, str], list[str]] = {}
        for name, setting, note in zip(self.method, settings, self.note, strict=True):
            if note:
                failures.setdefault((name, note), []).append(f"{setting:g}")
        notes = [
            f"{name}, {', '.join(failed)}: {note}" for (name, note), failed in failures.items()
        ]
        caption = "\n".join(notes) or None
        table = Table(box=box.SIMPLE_HEAD, padding=0, caption=caption, caption_justify="left")
        table.add_column("method", no_wrap=True)
        for heading in columns:
            table.add_column(heading, justify="right", no_wrap=True)
        for i, name in enumerate(self.method):
            is_last = i + 1 == len(self.method) or self.method[i + 1] != name
            table.add_row(name, *(cells[i] for cells in columns.values()), end_section=is_last)
        return table

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Writes the table as CSV. The times are the minimum and the three quartiles."""
        names = [name for name in self._fields if name not in ("seconds", "note")]
        times = np.percentile(self.seconds, (0, 25, 50, 75), axis=-1).T
        quartiles = [f"seconds_{name}" for name in ("min", "quartile_1", "median", "quartile_3")]
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([*names, *quartiles, "note"])
            for i, note in enumerate(self.note):
                values = [getattr(self, name)[i] for name in names[1:]]
                cells = [f"{value:.17g}" for value in (*values, *times[i])]
                writer.writerow([self.method[i], *cells, note])
