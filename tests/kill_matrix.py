"""Which tests execute which lines, which of them kill a mutant there, and which tests are enough.

`python tests/mutations.py --matrix FOLDER` makes such a matrix.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Collection, Mapping
from pathlib import Path

from coverage import CoverageData


class KillMatrix:
    """What a folder keeps of the quick tests of a repository.

    `seconds.json` has the seconds of each, `coverage` the lines that it executes, and `matrix.json`
    the tests that kill each mutant that a seed draws. The first two are made by running the tests,
    which must pass.
    """

    def __init__(self, folder: Path, root: Path, seed: int):
        self._file = folder / "matrix.json"
        seconds, coverage = folder / "seconds.json", folder / "coverage"
        if not seconds.exists():
            folder.mkdir(parents=True, exist_ok=True)
            # How much is reached is the affair of `make coverage`.
            options = "-n auto --cov --cov-fail-under=0 --cov-context=test --cov-report="
            options += " --durations=0 -vv"
            done = subprocess.run(
                [sys.executable, "-m", "pytest", *options.split()],
                cwd=root,
                env=os.environ | {"COVERAGE_FILE": str(coverage), "PYTHONPATH": str(root)},
                check=False,
                stdout=subprocess.PIPE,
                text=True,
            )
            if done.returncode:
                raise SystemExit(f"Without a mutant, tests fail:\n{done.stdout[-5000:]}")
            seconds.write_text(json.dumps(seconds_of(done.stdout), indent=0))
        self.seconds: dict[str, float] = json.loads(seconds.read_text())
        self._of_seeds: dict[str, dict[str, list[str]]] = {}
        if self._file.exists():
            self._of_seeds = json.loads(self._file.read_text())
        self.killers = self._of_seeds.setdefault(str(seed), {})
        self._lines = CoverageData(str(coverage))
        self._lines.read()

    def keep(self, mutant: str, killers: list[str]):
        self.killers[mutant] = killers
        self._file.write_text(json.dumps(self._of_seeds, indent=0))

    def tests_of_line(self, path: Path, line: int) -> list[str]:
        """The tests that execute a line, the quickest first.

        What the import makes of a line may be used by any test. Those that execute some line of its
        file come first.
        """
        lines = self._lines.contexts_by_lineno(str(path))
        contexts, rest = set(lines.get(line, [])), set()
        if not contexts - {""}:
            contexts = {context for found in lines.values() for context in found}
            rest = set(self.seconds)
        # A context is a test and its phase: setup, run or teardown.
        tests = {context.rpartition("|")[0] for context in contexts} & self.seconds.keys()
        return [
            *sorted(tests, key=lambda test: (self.seconds[test], test)),
            *sorted(rest - tests, key=lambda test: (self.seconds[test], test)),
        ]


def seconds_of(output: str) -> dict[str, float]:
    """The seconds of each test, from what pytest prints with `--durations=0 -vv`."""
    found = re.findall(r"^\s*([\d.]+)s call +(.*)$", output, re.MULTILINE)
    # Parts of a test have lines of its name, too, and take less.
    return {test: seconds for seconds, test in sorted((float(x), test) for x, test in found)}


def cover(killers: Collection[Collection[str]], seconds: Mapping[str, float]) -> list[str]:
    """Tests that kill all mutants which any test kills.

    Again and again the one that kills most of those that are left in its time, and at the end
    without those that are not needed beside the others.
    """
    # An import that fails, or a signal, is no test.
    killed = [tests for found in killers if (tests := set(found) & seconds.keys())]
    left, chosen = killed, []
    while left:

        def kills_in_a_second(test: str, left: list[set[str]] = left) -> float:
            # A test of no time is still read.
            return sum(test in tests for tests in left) / (0.01 + seconds[test])

        best = max(sorted(set().union(*left)), key=kills_in_a_second)
        chosen.append(best)
        left = [tests for tests in left if best not in tests]
    for test in list(chosen):
        others = set(chosen) - {test}
        if all(tests & others for tests in killed):
            chosen.remove(test)
    return chosen
