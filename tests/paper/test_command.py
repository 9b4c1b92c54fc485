"""The command `cfjax paper`: its files, what it prints, and bad arguments."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cfjax.__main__ import main

FILES = sorted(
    f"{name}.{kind}"
    for name in ("figure1", "figure2", "figure3", "figure4", "heat_stiffness")
    for kind in ("pdf", "png")
)


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


def command_line(*arguments, code="from cfjax.__main__ import main; raise SystemExit(main())"):
    # Without the settings of this test suite, as a user has it.
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)


@pytest.mark.slow
def test_command_as_a_user(tmp_path):
    command = [sys.executable, "-m", "cfjax", "paper"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert "minutes" in done.stderr
    check_files(tmp_path / "figures")
    assert "Table 3" in done.stdout
    check_text(done.stdout)
    check_page(done.stdout.splitlines()[-1])


def check_page(line):
    """The section that a line names is there."""
    page, heading = re.search(r'(docs/\S+\.md), section "(.+)"', line).groups()
    assert f"\n## {heading}\n" in (Path(__file__).parents[2] / page).read_text()


def test_the_end_says_where_to_measure_your_own(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("cfjax._paper.EXPERIMENTS", ())
    assert main(["paper", "--output", str(tmp_path)]) == 0
    check_page(capsys.readouterr().out.splitlines()[-1])


def check_text(printed):
    for text in ("RKMK3", "RKMK4", "5.1e-04", "0.970252535114", "The paper finds"):
        assert text in printed


@pytest.mark.slow
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


def test_help(capsys):
    assert main([]) == 0
    assert "paper" in capsys.readouterr().out
    for arguments in (["--help"], ["paper", "--help"]):
        with pytest.raises(SystemExit) as exit_:
            main(arguments)
        assert exit_.value.code == 0
        assert "usage: cfjax" in capsys.readouterr().out


def test_bad_arguments(capsys):
    for arguments in (["chess"], ["paper", "--output"], ["paper", "x"], ["paper", "--step=3"]):
        error = check_one_line_error(arguments, capsys)
        assert "'chess'" in error or arguments[0] == "paper"


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
