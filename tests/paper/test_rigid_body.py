import functools
import os
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.progress import Progress

from cfjax.__main__ import main
from cfjax._measure import report as _report
from cfjax._paper import heat, rigid_body

FILES = sorted(
    f"{name}.{kind}"
    for name in ("figure1", "figure2", "figure3", "figure4", "heat_stiffness")
    for kind in ("pdf", "png")
)


@pytest.fixture(scope="module")
def trajectories():
    methods = rigid_body.METHODS | rigid_body.series_in_full()
    return {name: rigid_body.trajectory(method) for name, method in methods.items()}


@pytest.fixture(scope="module")
def work():
    with Progress(disable=True) as progress:
        return rigid_body.efficiencies((1000, 2000, 4000), 3, progress)


# What the paper finds, and what it does not find here.


@pytest.mark.slow
def test_fourth_order_is_far_better_than_third(trajectories):
    for quantity in ("error", "energy_error"):
        last = {name: getattr(run, quantity)[-1] for name, run in trajectories.items()}
        assert 100 * max(last["CF4"], last["RKMK4"]) < min(last["CF3"], last["RKMK3"])


@pytest.mark.slow
def test_cf4_and_rkmk4_are_close(trajectories, work):
    # At h = 0.1 and t = 100 the factor is 2.03; at h = 0.05 and h = 0.025 it is 1.3 at most.
    ratio = trajectories["RKMK4"].error[-1] / trajectories["CF4"].error[-1]
    assert 1 < ratio < 2.1
    ratios = work.select("RKMK4").error[1:] / work.select("CF4").error[1:]
    assert np.all((ratios > 1 / 1.5) & (ratios < 1.5))


def test_third_order_ranking_is_not_the_papers(trajectories):
    # The paper has RKMK3 better than CF3 in energy. The captions and the table say this.
    assert trajectories["CF3"].energy_error[-1] < trajectories["RKMK3"].energy_error[-1]
    assert trajectories["CF3"].error[-1] < trajectories["RKMK3"].error[-1]


def test_ranking_with_every_commutator_is_the_papers(trajectories):
    last = {name: run.energy_error[-1] for name, run in trajectories.items()}
    assert last["RKMK3, full series"] < last["CF3"]
    last = {name: run.error[-1] for name, run in trajectories.items()}
    assert 0.9 * last["CF4"] < last["RKMK4, full series"] < last["CF4"]


@pytest.mark.skipif(
    os.environ.get("CFJAX_REWRITE") == "0", reason="another program has other flops"
)
def test_flops_of_a_step(work):
    flops = {name: rigid_body.flops_of_step(method) for name, method in rigid_body.METHODS.items()}
    assert flops["CF3"] < flops["RKMK3"] < flops["RKMK4"] < flops["CF4"] < 1.25 * flops["RKMK4"]
    for name in flops:
        np.testing.assert_array_equal(
            work.select(name).flops, flops[name] * np.array([1000, 2000, 4000])
        )


def test_efficiency_has_the_errors_of_the_trajectories(trajectories, work):
    for name in rigid_body.METHODS:
        cost = work.select(name)
        np.testing.assert_allclose(cost.error[0], trajectories[name].error[-1], rtol=1e-9)
        assert cost.seconds.shape == (3, 3)
        assert np.all(cost.seconds > 0)


# Figures and files.


def test_text_in_figures_is_neither_cut_nor_covered(trajectories, work):
    for figure in (rigid_body.figure_1(trajectories), rigid_body.figure_2(work)):
        FigureCanvasAgg(figure).draw()
        (caption,) = (text.get_window_extent() for text in figure.texts)
        panels = [box for axes in figure.axes if (box := axes.get_tightbbox()) is not None]
        assert len(panels) == 2
        for box in (caption, *panels):
            assert 0 <= box.x0 < box.x1 <= figure.bbox.width
            assert 0 <= box.y0 < box.y1 <= figure.bbox.height
        assert caption.y1 < min(box.y0 for box in panels)


def check_files(output):
    assert sorted(os.listdir(output)) == FILES
    for name in FILES:
        content = (output / name).read_bytes()
        assert len(content) > 10_000
        assert content.startswith(b"\x89PNG" if name.endswith("png") else b"%PDF")
        if name.endswith("png"):
            width, height = (int.from_bytes(content[i : i + 4], "big") for i in (16, 20))
            assert width == 1400
            assert 900 < height < 1600


def test_a_failure_keeps_the_old_files(tmp_path):
    (tmp_path / "figure1.png").write_bytes(b"old")

    def fail(progress):
        raise RuntimeError("no errors today")

    with pytest.raises(RuntimeError, match="no errors today"):
        _report.run(tmp_path, [fail], "Wait.")
    assert os.listdir(tmp_path) == ["figure1.png"]
    assert (tmp_path / "figure1.png").read_bytes() == b"old"


# The command line.


def command_line(*arguments, code="from cfjax.__main__ import main; raise SystemExit(main())"):
    # Without the settings of this test suite, as a user has it.
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.slow
def test_command_as_a_user(tmp_path):
    command = [sys.executable, "-m", "cfjax", "paper"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert "minutes" in done.stderr
    check_files(tmp_path / "figures")
    assert "Table 3" in done.stdout
    check_text(done.stdout)


@pytest.mark.slow
def test_a_second_run(tmp_path, capsys):
    output = tmp_path / "figures"
    output.mkdir()
    for name in FILES:
        if name.startswith("figure3"):
            continue
        (output / name).write_bytes(b"old")
    short = functools.partial(rigid_body.report, step_counts=(500, 1000), repeats=2)
    short_heat = functools.partial(heat.report, tolerances=(1e-3, 1e-6), sizes=(30,))
    _report.run(output, [short, short_heat], "Wait.")
    for name in FILES:
        if not name.startswith("figure3"):
            assert (output / name).stat().st_size > 10_000
    check_text(capsys.readouterr().out)


def check_text(printed):
    for text in ("RKMK3", "RKMK4", "5.1e-04", "0.970252535114", "The paper finds"):
        assert text in printed


@pytest.mark.representatives(1)
@pytest.mark.parametrize("extra", ["matplotlib", "rich"])
def test_missing_extra(extra):
    code = f"""
import sys
sys.modules["{extra}"] = None
from cfjax.__main__ import main
main(["paper"])
"""
    done = command_line(code=code)
    assert done.returncode == 2
    assert done.stderr == f"cfjax paper: error: {extra} is missing: pip install 'cfjax[paper]'\n"


def test_no_command_prints_the_help(capsys):
    assert main([]) == 0
    assert "paper" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--help"], ["paper", "--help"]])
def test_help(arguments, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 0
    assert "usage: cfjax" in capsys.readouterr().out


def test_bad_command_has_status_2():
    done = command_line("chess")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "'chess'" in done.stderr


@pytest.mark.parametrize(
    "arguments", [["paper", "--output"], ["paper", "x"], ["paper", "--step=3"]]
)
def test_bad_arguments(arguments, capsys):
    check_one_line_error(arguments, capsys)


def test_output_that_is_a_file(tmp_path, capsys):
    path = tmp_path / "file"
    path.write_text("mine")
    for output in (path, path / "folder"):
        error = check_one_line_error(["paper", "--output", str(output)], capsys)
        assert str(output) in error
    assert path.read_text() == "mine"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write")
def test_output_without_permission(tmp_path, capsys):
    tmp_path.chmod(0o500)
    error = check_one_line_error(["paper", "--output", str(tmp_path)], capsys)
    assert "Permission denied" in error


def check_one_line_error(arguments, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    out, error = capsys.readouterr()
    assert exit_.value.code == 2
    assert out == ""
    assert error.startswith("cfjax")
    assert error.count("\n") == 1
    return error
