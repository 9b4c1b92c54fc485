"""The paper's Stiefel experiments: what the tables and the figure say."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.progress import Progress

from cfjax import WorkPrecision
from cfjax._paper import stiefel


@pytest.mark.slow
@pytest.mark.parametrize("problem, part", [("first", 0.25), ("second", 0.5)])
@pytest.mark.parametrize("n", [100, 1000])
def test_flops_of_cf4_are_a_part_of_the_papers(problem, n, part):
    printed = dict(zip(stiefel.METHODS, stiefel.PRINTED[problem, n], strict=True))["CF4"]
    for num_steps in stiefel.STEP_COUNTS:
        assert stiefel.flops_of_step("CF4", problem, n, num_steps) <= part * printed


@pytest.mark.slow
def test_rankings_of_the_findings():
    flops = {
        (problem, name): stiefel.flops_of_step(name, problem, 1000, 16)
        for problem in stiefel.PROBLEMS
        for name in stiefel.METHODS
    }
    # In the first experiment brackets cost little, in the second they cost most of the step.
    for name in ("RKMK4", "RKMK4, full series"):
        assert flops["first", "CF4"] < flops["first", name] < 1.2 * flops["first", "CF4"]
        assert flops["second", name] > 1.5 * flops["second", "CF4"]
    for problem in stiefel.PROBLEMS:
        assert flops[problem, "RKR-C4"] == max(flops[problem, name] for name in stiefel.METHODS)


def test_sums_keep_the_rank_and_brackets_do_not():
    ranks = {name: stiefel.rank_of_step(name, "second") for name in stiefel.METHODS}
    assert ranks == {"RKMK4, full series": 24, "RKMK4": 20, "CF4": 8, "RKR-C4": 8}
    # In the first experiment all brackets stay in the span of five blocks of p columns.
    assert stiefel.rank_of_step("RKMK4, full series", "first") == 20


@pytest.mark.slow
def test_errors_fall_with_order_4():
    with Progress(disable=True) as progress:
        work = stiefel.efficiencies("second", (8, 16), 2, progress)
    for name in stiefel.METHODS:
        cost = work.select(name)
        assert 3.5 < np.log2(cost.error[0] / cost.error[1]) < 4.5
        assert cost.seconds.shape == (2, 2) and np.all(cost.seconds > 0)
        np.testing.assert_array_equal(cost.flops > 0, True)


def test_text_in_the_figure_is_neither_cut_nor_covered():
    counts = np.array(stiefel.STEP_COUNTS)
    names = tuple(name for name in stiefel.METHODS for _ in counts)
    rows = np.tile(counts, len(stiefel.METHODS)).astype(float)
    unknown = np.full(len(rows), np.nan)
    made_up = WorkPrecision(
        method=names,
        tolerance=unknown,
        error=0.1 / rows**4,
        num_steps=rows,
        num_rejected=unknown,
        num_evaluations=unknown,
        num_flows=unknown,
        flops=1e6 * rows,
        compile_seconds=unknown,
        seconds=1e-4 * rows[:, None] * [1, 2],
        note=("",) * len(rows),
    )
    figure = stiefel.figure_3({problem: made_up for problem in stiefel.PROBLEMS})
    FigureCanvasAgg(figure).draw()
    (caption,) = (text.get_window_extent() for text in figure.texts)
    panels = [box for axes in figure.axes if (box := axes.get_tightbbox()) is not None]
    assert len(panels) == 4
    for box in (caption, *panels):
        assert 0 <= box.x0 < box.x1 <= figure.bbox.width
        assert 0 <= box.y0 < box.y1 <= figure.bbox.height
    assert caption.y1 < min(box.y0 for box in panels)
