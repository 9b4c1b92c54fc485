"""The progress bar: on a terminal, elsewhere, in the caller's bars, and without rich."""

import sys

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.progress import Progress

import cfjax


def decay(t, y, args):
    return -y


def mistaken(t, y, args):
    raise ArithmeticError("a mistake")


def work(progress):
    """Compiles one of four methods, and ends with the next, which cannot be traced."""
    fine, wrong = ((diffrax.ODETerm(field), diffrax.Euler()) for field in (decay, mistaken))
    with pytest.raises(ArithmeticError, match="a mistake"):
        cfjax.work_precision(
            cfjax.LieTerm(decay),
            0.0,
            1.0,
            jnp.ones(2),
            methods={"Euler": fine, "CF4": wrong, "CF3": fine, "CF2": fine},
            reference=np.zeros(2),
            num_steps=[1],
            progress=progress,
        )


def test_on_a_terminal(monkeypatch, capsys):
    # What rich takes for a terminal.
    monkeypatch.setenv("FORCE_COLOR", "1")
    work(True)
    out, error = capsys.readouterr()
    assert out == ""
    assert "Compiling CF4" in error and "25%" in error
    cfjax.map_batch(lambda x: 2 * x, np.arange(4), chunk_size=1)
    out, error = capsys.readouterr()
    assert out == ""
    assert "Solving" in error and "100%" in error


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
