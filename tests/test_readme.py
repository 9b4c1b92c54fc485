import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_examples_run(capsys):
    """With the settings of a reader, and a method whose program is short."""
    jax.config.update("jax_enable_x64", False)
    try:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            for example in EXAMPLES:
                exec(example.replace("RKMK8", "LieEuler"), {})
                out = capsys.readouterr().out
                assert out and "nan" not in out
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda e: e.strip().splitlines()[-1])
def test_examples_run_when_pasted(example):
    # A new process: what a reader has, without the settings of these tests.
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", example], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout and "nan" not in done.stdout


def test_there_are_examples():
    assert EXAMPLES
