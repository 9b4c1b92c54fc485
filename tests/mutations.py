"""Whether the tests see mistakes: plants small ones in cfjax, one at a time, and runs the tests.

    python tests/mutations.py [--count N] [--seed S] [PATH ...]

Draws mutants of all the source, or of these files or folders, and plants each in a copy of the
repository, as many at once as there are cores. There the tests of its file run, up to the first
failure. With `--matrix FOLDER` the quick tests that execute the changed line run, the quickest
first, up to five failures or ten minutes for each mutant. All is kept in the folder, so that a run
that was stopped goes on.
"""

import argparse
import ast
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, suppress
from functools import cache
from itertools import accumulate, pairwise
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

from kill_matrix import KillMatrix, cover

ROOT = Path(__file__).parents[1]
PACKAGE, TESTS = ROOT / "cfjax", ROOT / "tests"
# Operators of which each may stand for the other, by their names in `ast`.
PAIRS = "Add-Sub Mult-Div BitAnd-BitOr Eq-NotEq Is-IsNot In-NotIn Lt-LtE Gt-GtE Lt-GtE Gt-LtE"
# Calls of which the first argument decides between the next two.
CHOICES = {"where", "select", "cond", "chosen"}
# The order of the arguments says nothing, or a wrong one cannot run.
UNORDERED = {"max", "min", "maximum", "minimum", "dot", "isinstance", "issubclass", "getattr"}
# Nodes that need no parentheses.
CLOSED = ast.stmt | ast.Name | ast.Attribute | ast.Call | ast.Subscript | ast.Constant

TIME_LIMIT = "the time limit"
# Of one mutant in a matrix.
MOST_SECONDS = 600.0


class Mutant(NamedTuple):
    """The bytes from `start` to `end`, which begin on `line`, are replaced by `new`."""

    line: int
    start: int
    end: int
    new: str

    def plant(self, text: str) -> str:
        code = text.encode()
        return (code[: self.start] + self.new.encode() + code[self.end :]).decode()


def mutants(text: str) -> list[Mutant]:
    """All mutants of a source, in the order of its syntax tree."""
    starts = [0, *accumulate(map(len, text.encode().splitlines(keepends=True)))]
    found = []
    for old, new in (change for node in visited(ast.parse(text)) for change in changes(node)):
        start = starts[old.lineno - 1] + old.col_offset
        end = starts[old.end_lineno - 1] + old.end_col_offset
        code = ast.unparse(new) if isinstance(new, CLOSED) else f"({ast.unparse(new)})"
        if ast.dump(new) != ast.dump(old):
            found.append(Mutant(old.lineno, start, end, code))
    return found


def visited(node: ast.AST) -> Iterator[ast.AST]:
    """A node and all below it, but for annotations and what is said of errors."""
    yield node
    annotations = getattr(node, "annotation", None), getattr(node, "returns", None)
    for child in ast.iter_child_nodes(node):
        match child:
            case ast.Raise() | ast.Assert() | ast.JoinedStr() | ast.FunctionDef(name="__repr__"):
                pass
            case ast.keyword(arg="strict") | ast.If(ast.Name("TYPE_CHECKING")):
                pass
            case _ if child not in annotations:
                yield from visited(child)


def changes(node: Any) -> Iterator[tuple[Any, ast.AST]]:
    """Mistakes at a node: what is replaced, and what takes its place."""
    match node:
        case ast.BinOp(a, ast.MatMult(), b):
            yield node, changed(node, left=b, right=a)
        case ast.BinOp() | ast.AugAssign():
            yield from ((node, changed(node, op=other)) for other in others(node.op))
        case ast.Compare(_, [op, *rest]):
            yield from ((node, changed(node, ops=[other, *rest])) for other in others(op))
        case ast.BoolOp(_, values):
            for x in values:
                yield node, changed(node, values=[value for value in values if value is not x])
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert()):
            yield node, node.operand
        case ast.IfExp(_, a, b):
            yield node, changed(node, body=b, orelse=a)
        case ast.If(ast.Name() | ast.Attribute() | ast.Call()):
            yield node.test, ast.UnaryOp(ast.Not(), node.test)
        case ast.Constant(int() | float() | complex() as x):
            other = type(x)(1 - x) if x in (0, 1) else x + 1 if isinstance(x, int) else x / 2
            yield node, ast.Constant(other)
        case ast.Call(function, args, keywords):
            name = ast.unparse(function).rpartition(".")[2]
            for k, (a, b) in enumerate(pairwise(args)):
                # Others look too different to be mistaken for each other.
                if k == 1 if name in CHOICES else type(a) is type(b) and name not in UNORDERED:
                    yield node, changed(node, args=[*args[:k], b, a, *args[k + 2 :]])
            for x in keywords:
                if x.arg != "strict":  # With or without it, the lengths are equal.
                    yield node, changed(node, keywords=[word for word in keywords if word is not x])
        case ast.Return(ast.BinOp() as value) | ast.Assign(value=ast.BinOp() as value):
            yield value, value.left
    match node:
        case ast.Expr(ast.Call()) | ast.AugAssign():
            yield node, ast.Pass()
        # What is set has a value without it.
        case ast.Assign([x], value) if names(x, ast.Store) <= names(value, ast.Load):
            yield node, ast.Pass()


def changed(node: ast.AST, **fields: Any) -> ast.AST:
    return type(node)(**(dict(ast.iter_fields(node)) | fields))


def names(node: ast.AST, context: type[ast.expr_context]) -> set[str]:
    return {x.id for x in ast.walk(node) if isinstance(x, ast.Name) and type(x.ctx) is context}


def others(op: ast.AST) -> list[ast.AST]:
    name, pairs = type(op).__name__, [pair.split("-") for pair in PAIRS.split()]
    return [getattr(ast, b if name == a else a)() for a, b in pairs if name in (a, b)]


def draw(places: Sequence[str], count: int, seed: int) -> list[tuple[Path, Mutant]]:
    """No more than one mutant of a line, from all parts of the source alike."""
    found = {}
    for place in map(Path.resolve, map(Path, places)):
        for path in sorted(place.rglob("*.py")) or [place]:
            for mutant in mutants(path.read_text()):
                found.setdefault((path, mutant.line), []).append((path, mutant))
    drawn, lines = random.Random(seed), list(found.values())
    edges = [len(lines) * k // count for k in range(count + 1)]
    return [drawn.choice(drawn.choice(lines[a:b])) for a, b in pairwise(edges) if a < b]


def tests_of(path: Path) -> tuple[str, ...]:
    """The test file of a module, or else the tests of its folder."""
    *folders, name = path.relative_to(PACKAGE).with_suffix("").parts
    folder = TESTS.joinpath(*(folder.strip("_") for folder in folders))
    found = sorted(folder.rglob(f"test_{name.strip('_')}.py")) or [folder]
    return tuple(str(test.relative_to(ROOT)) for test in found)


def failures(
    copy: Path, tests: Sequence[str], number: int = 1, limit: float | None = None
) -> list[str]:
    """Up to `number` tests that fail, in the order given, and what else ends them."""
    # The copy and not what is installed, also in processes that the tests start.
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    # There may be more tests than a command can have.
    arguments = copy / "tests.txt"
    arguments.write_text("\n".join(tests))
    options = f"-v --tb=no --maxfail={number} -p no:cacheprovider".split()
    command = [sys.executable, "-u", "-m", "pytest", *options, f"@{arguments}"]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    output = end = ""
    with subprocess.Popen(
        command, cwd=copy, env=environment, start_new_session=True, **pipes
    ) as process:
        try:
            output, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            end = TIME_LIMIT
        finally:
            # With the processes that the tests have started.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        if end:
            output, _ = process.communicate()
    if not end and process.returncode < 0:
        end = f"signal {-process.returncode}"
    if "ImportError while loading conftest" in output:
        end = "the import of cfjax"
    # A test and FAILED or ERROR, or ERROR and a file that cannot be imported.
    failed = r"^(\S+::.*) (?:FAILED|ERROR)\b|^ERROR (\S+\.py)(?: |$)"
    found = re.findall(failed, output, re.MULTILINE)
    found = [*dict.fromkeys(test or file for test, file in found), *[end] * bool(end)]
    if process.returncode and not found:
        raise RuntimeError(f"{' '.join(command)}:\n{output}")
    return found


@cache
def limit_of(copy: Path, tests: tuple[str, ...]) -> float:
    """Seconds after which tests hang, from what they take without a mutant. They must pass."""
    begin = time.perf_counter()
    if found := failures(copy, tests):
        raise SystemExit(f"Without a mutant, {found[0]} fails.")
    return 30 + 3 * (time.perf_counter() - begin)


def said(path: Path, mutant: Mutant) -> str:
    """The place of a mutant, and the line before and after it."""
    text = path.read_text()
    pairs = zip(text.split("\n"), mutant.plant(text).split("\n"), strict=False)
    before, after = next((a.strip(), b.strip()) for a, b in pairs if a != b)
    return f"{path.relative_to(ROOT)}:{mutant.line}\n    - {before}\n    + {after}"


def killers_of(
    path: Path,
    mutant: Mutant,
    copies: SimpleQueue[Path],
    tests: Sequence[str],
    number: int,
    limit: float,
) -> tuple[list[str], float]:
    """Up to `number` tests that see a mutant, planted in one of the copies, and the seconds."""
    if not tests:
        return [], 0.0
    begin, copy, text = time.perf_counter(), copies.get(), path.read_text()
    planted = copy / path.relative_to(ROOT)
    try:
        planted.write_text(mutant.plant(text))
        found = failures(copy, tests, number, limit)
    finally:
        planted.write_text(text)
        copies.put(copy)
    # It is no fault of the mutant where so many tests take longer.
    found = [test for test in found if test != TIME_LIMIT or limit != MOST_SECONDS]
    return found, time.perf_counter() - begin


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("places", nargs="*", default=[str(PACKAGE)], metavar="PATH")
    parser.add_argument("--count", type=int, default=50, help="how many mutants (50)")
    parser.add_argument("--seed", type=int, default=0, help="which of them (0)")
    parser.add_argument("--tests", nargs="+", help="run these and not those of the file")
    parser.add_argument("--matrix", type=Path, metavar="FOLDER", help="record up to five killers")
    parser.add_argument("--need", type=float, default=0.0, help="share to kill for exit status 0")
    options = parser.parse_args()
    matrix = options.matrix and KillMatrix(options.matrix, ROOT, options.seed)
    drawn, killed = draw(options.places, options.count, options.seed), []
    made = ".git .venv* .*_cache .hypothesis .coverage* figures site __pycache__ *.egg-info"
    ignored = shutil.ignore_patterns(*made.split())
    number_at_once = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        pool = ThreadPoolExecutor(number_at_once)
        stack.callback(pool.shutdown, cancel_futures=True)
        unchanged, *others = (
            shutil.copytree(ROOT, Path(folder) / str(k), ignore=ignored)
            for k in range(1 + number_at_once)
        )
        copies = SimpleQueue[Path]()
        for copy in others:
            copies.put(copy)
        names = {}
        for path, mutant in drawn:
            name, number = said(path, mutant), 1
            if matrix is None:
                tests = tuple(options.tests or tests_of(path))
                limit = limit_of(unchanged, tests)
            else:
                tests = [] if name in matrix.killers else matrix.tests_of_line(path, mutant.line)
                seconds = sum(matrix.seconds[test] for test in tests)
                number, limit = 5, min(60 + 3 * seconds, MOST_SECONDS)
            names[pool.submit(killers_of, path, mutant, copies, tests, number, limit)] = name
        for future in as_completed(names):
            name, (killers, seconds) = names[future], future.result()
            if matrix is not None:
                killers = matrix.killers.get(name, killers)
                matrix.keep(name, killers)
            verdict = f"killed by {', '.join(killers)}" if killers else "SURVIVED"
            print(f"{name}\n    {verdict}, {seconds:.0f} s", flush=True)
            killed.append(killers)
    count = sum(map(bool, killed))
    print(f"{count} of {len(drawn)} mutants killed: {count / max(len(drawn), 1):.0%}")
    if matrix is not None:
        chosen = cover(killed, matrix.seconds)
        seconds = sum(matrix.seconds.get(test, 0.0) for test in chosen)
        print(f"{len(chosen)} tests of {seconds:.0f} seconds kill as many.")
    return int(count < options.need * len(drawn))


if __name__ == "__main__":
    sys.exit(main())
