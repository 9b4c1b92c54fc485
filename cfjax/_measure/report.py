"""The output of the commands: tables, figures and data."""

import inspect
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from rich import box
from rich.console import Console, RenderableType
from rich.progress import Progress
from rich.table import Table

from .._batch.progress import on_terminal, progress_bar
from .._integrate import integrate
from .._signals import busy
from .._solvers.projected import Projected
from .style import about_times, new_figure
from .work_precision import WorkPrecision, compiled, take_turns


class Report(NamedTuple):
    """The printed output of an experiment, in order, and its figures and data by file name."""

    printed: Sequence[RenderableType]
    figures: Mapping[str, Figure]
    data: Mapping[str, WorkPrecision] = {}


def run(output: Path, experiments: Sequence[Callable[[Progress], Report]], patience: str) -> None:
    """Prints tables and writes figures as PNG and PDF, and data as CSV, to the folder `output`.

    Prints `patience`, which says how long the work takes, before it begins.

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
        for renderable in report.printed:
            console.print(renderable)
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
    caption = f"{_first_line(measure, name)} Time: {about_times(work.seconds)}"
    if np.any(np.isfinite(work.flops)):
        caption += " Flops: operations of one step as traced, times the steps."
    figure = new_figure((7.0, 4.8), caption)
    figures = {name: work.plot(figure)}
    if picture is not None:
        figures[f"{name}_picture"] = picture()
    return Report([work.table()], figures, {name: work})


def scene(
    name: str,
    module: ModuleType,
    progress: Progress,
    *,
    num_steps: int = 1000,
    num_saves: int = 100,
    budget: float = 2.0,
) -> Report:
    """One solve of a scene by its solver: its invariants, its time, and its picture.

    The scene has a `solver`, and functions `problem`, `invariants` and `picture`. Invariants are
    evaluated in `num_saves` states, and times measured for `budget` seconds. The picture may be of
    another run: the first line of its docstring is printed.
    """
    problem = {"args": None} | module.problem()
    names = "t0", "t1", "y0", "args"
    arrays = tuple(jtu.tree_map(jnp.asarray, problem[name]) for name in names)

    def solve(*arrays: Any) -> diffrax.Solution:
        term, save_every = problem["term"], num_steps // num_saves
        return integrate(term, module.solver, *arrays, num_steps=num_steps, save_every=save_every)

    y0, args = arrays[2:]
    with progress_bar(progress, "Compiling", 2) as update:
        program, compile_seconds = compiled(solve, *arrays)
        update(advance=1, description="Running")
        ys = jax.block_until_ready(program(arrays).ys)  # type: ignore
        update(advance=1)
    (seconds,) = take_turns(
        [lambda: program(arrays)], repeats=100, budget=budget, progress=progress
    )
    with progress_bar(progress, "Drawing", 1) as update:
        figure = module.picture()
        update(advance=1)

    method = type(module.solver).__name__
    if isinstance(module.solver, Projected):
        method = f"{method} ({module.solver.name})"
    title = f"{num_steps} equal steps of {method}, t = {float(arrays[0]):g} to {float(arrays[1]):g}"
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), title=title, title_justify="left")
    table.add_column("", no_wrap=True)
    # In a narrow terminal values take several lines, so that names and changes stay whole.
    for heading in ("start", "end"):
        table.add_column(heading, justify="right")
    table.add_column("largest\nchange", justify="right", no_wrap=True)
    initial = module.invariants(y0, args)
    saved = jax.vmap(lambda y: module.invariants(y, args))(ys)
    for label, value in initial.items():
        change = np.max(np.abs(np.asarray(saved[label]) - np.asarray(value)))
        table.add_row(label, _span(value), _span(saved[label][-1]), f"{change:.1e}")
    fastest = float(np.min(seconds))
    show = EngFormatter("s", places=1)
    times = (
        f"Compiled in {show(compile_seconds)}. Ran in {show(fastest)}, {show(fastest / num_steps)} "
        f"a step: the fastest of {len(seconds)} runs on one {jax.default_backend().upper()}."
    )
    picture = f"The picture: {_first_line(module.picture, name)}"
    printed = [_first_line(module, name), table, times, picture]
    return Report(printed, {f"{name}_picture": figure})


def _first_line(documented: object, name: str) -> str:
    return (inspect.getdoc(documented) or name).splitlines()[0]


def _span(values: Float[Array, "..."]) -> str:
    """Up to three numbers, or the smallest and the largest of more."""
    if np.size(values) <= 3:
        return ", ".join(f"{float(x):.5g}" for x in np.ravel(values))
    low, high = (f"{float(x):.5g}" for x in (np.min(values), np.max(values)))
    return low if low == high else f"{low} to {high}"
