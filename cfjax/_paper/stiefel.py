"""The Stiefel manifold experiments of the paper: its Tables 2 and 3 and its Figure 3.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.2.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from rich.progress import Progress
from rich.table import Table

from .. import CF4, RKMK, RKMK4, CayleyRK4, WorkPrecision, combine, work_precision
from .._measure.flops import count_flops
from .._measure.report import Report
from .._measure.style import STYLES, about_times, finish, new_figure, times
from ..scenes import stiefel
from .rigid_body import cost_at_equal_error, series_in_full

METHODS: dict[str, diffrax.AbstractSolver] = {
    "RKMK4, full series": series_in_full()["RKMK4, full series"],
    "RKMK4": RKMK4(),
    "CF4": CF4(),
    "RKR-C4": CayleyRK4(),
}
PROBLEMS = ("first", "second")
# Flops of one step by problem and n, in the order of METHODS: Tables 2 and 3 of the paper.
PRINTED = {
    ("first", 100): (3325345, 1040361, 991389, 769353),
    ("first", 1000): (15291745, 7289961, 4623789, 5784113),
    ("second", 100): (3272009, 967321, 165819, 1703161),
    ("second", 1000): (14759609, 6565321, 1479819, 101524077),
}
FINDINGS = """\
The paper finds: in the first experiment CF4 needs far fewer flops than RKMK4 with the full series \
and moderately fewer than the other two; in the second its advantage is much more evident, as \
brackets leave the form of the field, and RKR-C4, which does not use that form, does badly.
Here: the ranking is the same in the second experiment. In the first the fields and all their \
brackets stay in the span of 5p columns, whatever the method, so both RKMK4 cost about as much as \
CF4."""
N, P = 1000, 4  # p is the scene's
STEP_COUNTS = (2, 4, 8, 16)  # h = 2^-1 .. 2^-4
REPEATS = 50


def report(
    progress: Progress, *, step_counts: Sequence[int] = STEP_COUNTS, repeats: int = REPEATS
) -> Report:
    """Tables 2 and 3, and Figure 3. `step_counts` and `repeats` are the figure's."""
    tables = [
        flops_table(problem) for problem in progress.track(PROBLEMS, description="Stiefel manifold")
    ]
    work = {problem: efficiencies(problem, step_counts, repeats, progress) for problem in PROBLEMS}
    return Report(printed=[*tables, FINDINGS], figures={"figure3": figure_3(work)})


@functools.cache
def flops_of_step(method: str, problem: str, n: int, num_steps: int) -> int:
    """Floating-point operations of the first of so many steps from 0 to 1, evaluations included."""
    scene = stiefel.problem(problem, n)
    term, y0, args = scene["term"], jnp.asarray(scene["y0"]), scene["args"]
    t0, t1 = jnp.asarray(0.0), jnp.asarray(1 / num_steps)
    # Unrolled: in a loop a stage could not be counted by itself.
    solver = cast(Any, METHODS[method]).without_estimate().unrolled()
    # Outside of the step: the checks of the start are not counted.
    state, _ = solver.start(term, t0, t1, y0, args)

    def step(t0, t1, y, args):
        return solver.step(term, t0, t1, y, args, state, made_jump=False)[0]

    return count_flops(step, t0, t1, y0, args)


def rank_of_step(method: str, problem: str) -> int:
    """The largest rank of a matrix whose exponential the step takes."""
    solver, scene = METHODS[method], stiefel.problem(problem, 10 * P)

    def field(c, y):
        return combine((0.5,), (scene["term"].field(0.0, y, scene["args"]),))

    if isinstance(solver, RKMK | RKMK4):
        return len(jax.eval_shape(lambda y: solver.logarithm(field, y), scene["y0"]).k)
    if isinstance(solver, CF4):
        # The span of all columns, or the form of the field.
        return 5 * P if problem == "first" else 2 * P
    return 2 * P


def efficiencies(
    problem: str, step_counts: Sequence[int], repeats: int, progress: Progress
) -> WorkPrecision:
    """The cost and error at t = 1 of every method for n = 1000 and every number of steps."""
    work = work_precision(
        **stiefel.problem(problem, N),
        methods=METHODS,
        reference=stiefel.reference(problem, N),
        num_steps=step_counts,
        repeats=repeats,
        budget=np.inf,
        progress=progress,
    )
    # The series of an exponential is as long as the step size asks.
    rows = zip(work.method, work.num_steps, strict=True)
    flops = [n * flops_of_step(name, problem, N, int(n)) for name, n in rows]
    return work._replace(flops=np.array(flops))


def flops_table(problem: str) -> Table:
    number = {"first": 2, "second": 3}[problem]
    table = Table(
        title=f"Table {number}: flops of one step on the Stiefel manifold, {problem} experiment",
        caption="Counted from the traced program, field included. The series of the exponentials "
        "are longer for longer steps. Rank: of the largest matrix whose exponential is taken.",
    )
    table.add_column("n", justify="right")
    table.add_column("method")
    for heading in ("paper", "h = 1/2", "h = 1/16", "of the paper's", "rank"):
        table.add_column(heading, justify="right")
    for n in (100, 1000):
        for name, printed in zip(METHODS, PRINTED[problem, n], strict=True):
            long, short = (flops_of_step(name, problem, n, k) for k in (2, 16))
            ratios = f"{short / printed:.2f} to {long / printed:.2f}"
            rank = rank_of_step(name, problem)
            row = n, name, printed, long, short, ratios, rank
            table.add_row(*map(str, row), end_section=name == list(METHODS)[-1])
    return table


def figure_3(work: Mapping[str, WorkPrecision]) -> Figure:
    """Global error against flops and against time, for both experiments."""

    def ratios(costs: WorkPrecision) -> str:
        pairs = {n: cost_at_equal_error(costs, "CF4", n, order=4) for n in METHODS if n != "CF4"}
        return ", ".join(f"{flops:.2f} and {t:.2f} ({n})" for n, (flops, t) in pairs.items())

    steps = work["first"].num_steps
    figure = new_figure(
        (7.0, 7.8),
        f"Global error at t = 1 for h = 1/{min(steps):g} to 1/{max(steps):g}, n = {N}, p = {P}, "
        "after Figure 3 of Celledoni, Marthinsen & Owren (2003); above the first experiment (a), "
        "below the second (b). Flops: operations of the first step as traced, times the steps. "
        f"Times: {about_times(work['first'].seconds)} The paper finds CF4 "
        "far ahead of RKMK4 with the full series and moderately ahead of the others in (a), and "
        "far ahead of all in (b). Here, for equal error at the smallest step, CF4 takes these "
        f"parts of the flops and the time of the others. (a): {ratios(work['first'])}. (b): "
        f"{ratios(work['second'])}. In (a) the step lives in a span of 5p columns, brackets "
        "included, so they cost little.",
    )
    panels = figure.subplots(2, 2, sharey="row")
    for (left, right), label, costs in zip(panels, "ab", work.values(), strict=True):
        for name in METHODS:
            cost, style = costs.select(name), STYLES[name] | dict(markersize=4)
            left.loglog(cost.flops / 1e6, cost.error, label=name if label == "a" else None, **style)
            times(right, 1e3 * cost.seconds, cost.error, **style)
        right.set_xscale("log")
        for axes in (left, right):
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        left.set_ylabel(f"({label}) global error at t = 1")
    panels[1, 0].set_xlabel("flops (millions)")
    panels[1, 1].set_xlabel("time (ms)")
    finish(figure, len(METHODS))
    return figure
