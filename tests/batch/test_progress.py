"""The progress bar: on a terminal, elsewhere, in the caller's bars, and without rich."""

import sys

import pytest
from rich.progress import Progress

from cfjax._batch.progress import progress_bar


def work(progress):
    with progress_bar(progress, "Compiling", 4) as update:
        update(description="Compiling CF4", advance=1)


def test_on_a_terminal(monkeypatch, capsys):
    # What rich takes for a terminal.
    monkeypatch.setenv("FORCE_COLOR", "1")
    work(True)
    out, error = capsys.readouterr()
    assert out == ""
    assert "Compiling CF4" in error and "25%" in error


def test_silence_elsewhere(monkeypatch, capsys):
    work(True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    work(False)
    monkeypatch.setitem(sys.modules, "rich", None)
    work(True)
    assert capsys.readouterr() == ("", "")


def test_in_the_bars_of_the_caller():
    with Progress(disable=True) as progress:
        work(progress)
    (task,) = progress.tasks
    assert (task.description, task.completed, task.total) == ("Compiling CF4", 1, 4)


def test_what_is_no_progress():
    with pytest.raises(TypeError, match=r"progress must be a bool or a rich\.progress\.Progress"):
        work("yes")
