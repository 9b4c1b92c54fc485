"""Which mistakes `make mutations` plants, and what it reads of the tests that see them."""

import ast
import shutil

import kill_matrix
import mutations
import pytest
from mutations import PACKAGE, ROOT

FILES = [PACKAGE / "_solvers/stages.py", PACKAGE / "_numerics/rotate.py"]


@pytest.mark.parametrize(
    "text, expected",
    [
        ("a + b * c", {"(a - b * c)", "a + (b / c)"}),
        ("a - b", {"(a + b)"}),
        ("a & b", {"(a | b)"}),
        ("a @ (b + c)", {"((b + c) @ a)", "a @ ((b - c))"}),
        ("x += y", {"x -= y", "pass"}),
        ("a < b", {"(a <= b)", "(a >= b)"}),
        ("a < b == c", {"(a <= b == c)", "(a >= b == c)"}),
        ("a == b", {"(a != b)"}),
        ("a is not None", {"(a is None)"}),
        ("a not in b", {"(a in b)"}),
        ("a and not b", {"(a)", "(not b)", "a and b"}),
        ("-a", {"a"}),
        ("0, 1, 2", {"1, 1, 2", "0, 0, 2", "0, 1, 3"}),
        ("0.0, 1.0, 3.0", {"1.0, 1.0, 3.0", "0.0, 0.0, 3.0", "0.0, 1.0, 1.5"}),
        ("True, False", {"False, False", "True, True"}),
        ("a if c else b", {"(b if c else a)"}),
        ("if a:\n    b", {"if (not a):\n    b"}),
        ("x = jnp.where(c, a, b)", {"x = jnp.where(c, b, a)"}),
        ("x = f(a, b, c[i])", {"x = f(b, a, c[i])"}),
        ("x = f(a, a) + max(a, b)", {"x = f(a, a)", "x = (f(a, a) - max(a, b))"}),
        ("x = f(a, k=b, strict=True)", {"x = f(a, strict=True)"}),
        ("f(a)", {"pass"}),
        ("x.a = f(b)", {"pass"}),
        ("x, y = f(x, y)", {"x, y = f(y, x)", "pass"}),
        ("x = f(y)", set()),
        ("return a * b", {"return a", "return (a / b)"}),
        # Columns count bytes, and the rest of a file stays as it is.
        ("é = b\nc  =  'é' + -é  # é", {"é = b\nc  =  'é' + é  # é"}),
    ],
)
def test_mistakes(text, expected):
    planted = {mutant.plant(text) for mutant in mutations.mutants(text)}
    assert planted == expected if "é" not in text else planted > expected


def test_no_mistakes_in_what_is_said():
    text = '''
"""1 + 2"""
if TYPE_CHECKING:
    f(1)

def f(a: Literal[1]) -> "Literal[1]":
    x: Array[1]
    assert a == 1
    raise E(f"{a + 1}", 1 + 2)

class A:
    def __repr__(self):
        return 1 + 2
'''
    assert not mutations.mutants(text)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_mutants_of_a_file_are_programs_and_differ(path):
    text = path.read_text()
    before, mutants = ast.dump(ast.parse(text)), mutations.mutants(text)
    assert len(mutants) >= 20
    for mutant in mutants:
        planted = mutant.plant(text)
        assert ast.dump(ast.parse(planted)) != before
        assert planted.split("\n")[: mutant.line - 1] == text.split("\n")[: mutant.line - 1]


def test_a_seed_draws_the_same_mutants_of_different_lines():
    places = [str(path) for path in FILES]
    drawn = mutations.draw(places, 20, 3)
    assert drawn == mutations.draw(places, 20, 3) != mutations.draw(places, 20, 4)
    assert len({(path, mutant.line) for path, mutant in drawn}) == len(drawn) == 20
    # A folder, of which all lines with mutants are fewer than asked for.
    all_of_it = mutations.draw([str(PACKAGE / "_measure")], 9999, 0)
    assert {path.parent for path, _ in all_of_it} == {PACKAGE / "_measure"}


def test_the_tests_of_a_file():
    assert all((ROOT / x).exists() for p in PACKAGE.rglob("*.py") for x in mutations.tests_of(p))
    for file, tests in {
        "_solvers/stages.py": "tests/solvers/test_stages.py",
        "_fields/elementwise.py": "tests/fields",
        "_xla/over_stages.py": "tests/xla/test_over_stages.py",
        "_control_term.py": "tests/noise/test_control_term.py",
        "__main__.py": "tests/test_main.py",
    }.items():
        assert mutations.tests_of(PACKAGE / file) == (tests,)


@pytest.mark.parametrize(
    "script, killers",
    [
        ("echo '2 passed'", []),
        (
            "echo 'tests/a.py::test_b[c - d] FAILED [ 3%]'; echo 'tests/a.py::test_b[e] PASSED'; "
            "echo 'tests/a.py::test_c ERROR'; echo 'ERROR tests/a.py::test_c - e'; exit 1",
            ["tests/a.py::test_b[c - d]", "tests/a.py::test_c"],
        ),
        ("echo 'ERROR tests/a.py - TypeError'; exit 2", ["tests/a.py"]),
        ("echo 'ImportError while loading conftest' >&2; exit 4", ["the import of cfjax"]),
        ("sleep 600 & wait", ["the time limit"]),
        ("echo 'tests/a.py::test_b FAILED'; kill -9 $$", ["tests/a.py::test_b", "signal 9"]),
    ],
    # Of their texts a matrix would read that they fail.
    ids=["passed", "failed", "not imported", "not collected", "hangs", "killed"],
)
def test_what_pytest_says(script, killers, tmp_path, monkeypatch):
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\n{script}\n")
    python.chmod(0o755)
    monkeypatch.setattr(mutations.sys, "executable", str(python))
    limit = 0.5 if "sleep" in script else None
    assert mutations.failures(tmp_path, [], 2, limit) == killers


def test_where_no_test_has_run(tmp_path, monkeypatch):
    monkeypatch.setattr(mutations.sys, "executable", "false")
    with pytest.raises(RuntimeError, match="pytest"):
        mutations.failures(tmp_path, [])


def test_the_seconds_of_tests():
    printed = """
tests/a.py::test_b PASSED
1.25s setup    tests/a.py::test_b
2.50s call     tests/a.py::test_b
12.00s call     tests/a.py::test_b[c - d]
1.50s call     tests/a.py::test_b
"""
    found = kill_matrix.seconds_of(printed)
    assert found == {"tests/a.py::test_b": 2.5, "tests/a.py::test_b[c - d]": 12.0}


def test_tests_that_kill_all_mutants():
    seconds = {"a": 1.0, "b": 1.0, "c": 5.0, "d": 0.1}
    # No test has killed the first two. Nothing but c kills the last one, and it kills all others.
    assert kill_matrix.cover([[], ["signal 9"], ["a", "c"], ["b", "c"], ["c"]], seconds) == ["c"]
    assert kill_matrix.cover([["a", "d"], ["a", "b"], ["a", "b"]], seconds) == ["a"]
    assert kill_matrix.cover([["c", "d"], ["a", "c"], ["b"]], seconds) == ["d", "a", "b"]
    assert kill_matrix.cover([], seconds) == []


@pytest.mark.slow
def test_a_matrix_of_a_small_repository(tmp_path):
    root = tmp_path / "root"
    (root / "tests").mkdir(parents=True)
    (root / "cfjax").mkdir()
    # It reaches less than it demands.
    (root / "pyproject.toml").write_text(
        "[tool.coverage]\nrun.source = ['cfjax']\nreport.fail_under = 95\n"
    )
    source = "LIMIT = 3\n\n\ndef f(x):\n    if x < 0:\n        return -x\n    return x\n"
    source += "\n\ndef g(x):\n    return x\n"
    (root / "cfjax" / "__init__.py").write_text(source)
    tests = "import cfjax\n\n\ndef test_a():\n    cfjax.f(-1)\n\n\ndef test_b():\n    cfjax.f(1)\n"
    (root / "tests" / "test_f.py").write_text(tests)
    matrix = kill_matrix.KillMatrix(tmp_path / "matrix", root, 3)
    path, (a, b) = root / "cfjax" / "__init__.py", [f"tests/test_f.py::test_{x}" for x in "ab"]
    assert set(matrix.seconds) == {a, b}
    assert [set(matrix.tests_of_line(path, n)) for n in (1, 5, 6, 7)] == [{a, b}, {a, b}, {a}, {b}]
    matrix.keep("cfjax/__init__.py:6: return x", [a])
    # A second one runs nothing, and knows it.
    shutil.rmtree(root)
    again, other = (kill_matrix.KillMatrix(tmp_path / "matrix", root, seed) for seed in (3, 4))
    assert again.killers == {"cfjax/__init__.py:6: return x": [a]}
    assert other.killers == {}
