import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.representatives(2)
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda e: e.strip().splitlines()[-1])
def test_examples_run_when_pasted(example):
    # A new process: what a reader has, without the settings of these tests.
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", example], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout and "nan" not in done.stdout


def test_there_are_examples():
    assert len(EXAMPLES) >= 2


def test_pictures_exist():
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).stat().st_size > 0


def test_measured_tables_and_numbers_are_those_stored():
    command = [sys.executable, "benchmarks/readme.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_no_measured_table_is_typed_in():
    typed = re.sub(r"<!-- table: .*?<!-- end -->", "", README, flags=re.DOTALL)
    # What a field returns, and which method: facts.
    assert re.findall(r"^\| ?(.*?) ?\|.*\n\| -", typed, flags=re.MULTILINE) == ["return", "solver"]


def test_every_benchmark_has_stored_results():
    (names,) = re.findall(r"^BENCHMARKS := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    stored = {path.stem for path in (ROOT / "benchmarks" / "results").glob("*.json")}
    assert stored == set(names.split())
    assert all((ROOT / "benchmarks" / f"{name}.py").exists() for name in stored)
