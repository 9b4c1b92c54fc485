"""The site: its code runs when pasted, it names everything public, and its numbers are measured."""

import ast
import inspect
import json
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import diffrax
import jax
import numpy as np
import optimistix
import pytest
from messages import FOLDERS, messages, template
from scipy.linalg import expm
from test_public import PUBLIC

import cfjax

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))

# Each page on its own, in the settings of a reader; a traceback has the page and its line.
PROGRAM = """
import json, sys, jax

for page, text in json.load(sys.stdin).items():
    jax.config.update("jax_enable_x64", False)
    exec(compile(text, page, "exec"), {"__name__": page})
    jax.clear_caches()
"""


def code(page):
    """The blocks of a page, at their lines."""
    kept, inside = [], False
    for line in page.read_text().splitlines():
        if line == "```":
            inside = False
        kept.append(line if inside else "")
        if line == "```python":
            inside = True
    return "\n".join(kept)


# One process for many pages: most of the time is imports and compilation.
START = [ROOT / "docs" / "getting_started.md"]
STATES = [page for page in PAGES if page.parent.name == "state"]
RECIPES = [page for page in PAGES if page.parent.name == "recipes"]
OTHERS = [page for page in PAGES if page not in START + STATES + RECIPES]


@pytest.mark.slow
@pytest.mark.parametrize(
    "pages",
    [
        pytest.param(START, id="start"),
        pytest.param(STATES, id="states"),
        pytest.param(RECIPES, id="recipes"),
        pytest.param(OTHERS, id="others"),
    ],
)
def test_code_runs_when_pasted(pages):
    texts = {str(page.relative_to(ROOT)): code(page) for page in pages}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM],
        input=json.dumps(texts),
        capture_output=True,
        text=True,
        cwd=ROOT,
        # As in these tests: programs are compiled to run once.
        env={**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert "nan" not in done.stdout


def section(page, heading):
    """The text below a heading, up to the next one of that level."""
    text = (ROOT / "docs" / page).read_text()
    return text.split(f"\n## {heading}\n")[1].split("\n## ")[0]


def blocks(text):
    return "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE))


@pytest.mark.slow
def test_correlation_functions_move_any_operator():
    text = (ROOT / "docs" / "state" / "density.md").read_text()
    parts = [
        blocks(text).partition("\n\n\ndef driven")[0],
        "vacuum = jnp.zeros((12, 12), complex).at[0, 0].set(1.0)",
        blocks(section("state/density.md", "A bath at a temperature")),
        blocks(section("state/density.md", "Correlation functions")),
    ]
    # As NumPy and users' programs promote.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        scope = {}
        exec("\n".join(parts), scope)
        lower, one = np.diag(np.sqrt(np.arange(1.0, 12.0)), 1), np.eye(12)
        b = lower + 0.3j * lower.T @ lower + 0.2 * lower.T
        moved = scope["after"](b, scope["steady"])
    # The equation on a vector of 144 entries.
    generator = -1j * (np.kron(lower.T @ lower, one) - np.kron(one, lower.T @ lower))
    for jump, rate in ((lower, 0.5 * 1.3), (lower.T, 0.5 * 0.3)):
        loss = rate * jump.T @ jump / 2
        generator += rate * np.kron(jump, jump) - np.kron(loss, one) - np.kron(one, loss)
    start = (b @ np.asarray(scope["steady"])).ravel()
    want = [(expm(t * generator) @ start).reshape(12, 12) for t in (0.4, 4.0)]
    # Steps of 1/10 have errors of 1e-6; with another sign in the sum they are of order one.
    np.testing.assert_allclose(moved[jax.numpy.array([0, -1])], want, rtol=0, atol=1e-5)
    # 12 levels lack 1e-7 of the bath.
    np.testing.assert_allclose(scope["correlation"], scope["exact"], rtol=0, atol=1e-5)


def test_every_block_of_code_is_seen():
    # An indented block, or one with options, would be run by nobody.
    for page in PAGES:
        fences = re.findall(r"^.*```.*py.*$", page.read_text(), flags=re.MULTILINE)
        assert set(fences) <= {"```python"}, page


def test_every_public_name_is_in_the_api():
    pages = "\n".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    named = re.findall(r"^::: cfjax\.(.+)$", pages, flags=re.MULTILINE)
    modules = [module.name for module in pkgutil.iter_modules(cfjax.scenes.__path__)]
    scenes = {f"scenes.{name}" for name in modules if not name.startswith("_")}
    assert len(named) == len(set(named))
    assert set(named) == {*PUBLIC, *scenes}


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    listed = re.findall(r"[\w/]+\.md", navigation)
    for page in PAGES:
        assert str(page.relative_to(ROOT / "docs")) in listed


def test_math_is_what_the_converter_knows():
    # It would show the signs of an environment as they are.
    for page in PAGES:
        assert "\\begin{" not in page.read_text()


def test_measured_tables_and_numbers_are_those_stored():
    command = [sys.executable, "benchmarks/pages.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_methods_are_recommended_in_one_place():
    copies = {
        "README.md": ["fields", "reasons"],
        "docs/index.md": ["first"],
        "docs/getting_started.md": ["first"],
        "docs/state/index.md": ["states"],
        "docs/methods.md": ["methods"],
    }
    marks = {
        name: re.findall("<!-- decisions: (.*?) -->", (ROOT / name).read_text()) for name in copies
    }
    assert marks == copies
    source = (ROOT / "docs" / "decisions.toml").read_text()
    # What `docs/methods.md` has in bold is what is recommended.
    table = section("methods.md", "All methods")
    bold = re.findall(r"\*\*`(\w+)`\*\*", table)
    assert len(bold) >= 8
    assert [name for name in bold if f"`{name}`" not in source] == []


def test_every_field_is_in_the_table_of_fields():
    rows = tomllib.loads((ROOT / "docs" / "decisions.toml").read_text())["field"]
    calls = {row["call"].strip("`").partition("(")[0] for row in rows}
    fields = {
        name
        for name in PUBLIC
        if inspect.isclass(value := getattr(cfjax, name))
        and issubclass(value, cfjax.AbstractFrozenField)
        and not inspect.isabstract(value)
    } - {"Nearest"}  # What a field is in plain space.
    assert calls == {"an array", *fields}


def test_no_measured_table_is_typed_in():
    text = (ROOT / "docs" / "benchmarks" / "speed.md").read_text()
    assert text.count("<!-- table: ") >= 5
    typed = re.sub(r"<!-- table: .*?<!-- end -->", "", text, flags=re.DOTALL)
    assert "| --- |" not in typed


def test_guides_are_short_and_their_measurements_elsewhere():
    def count(text):
        return len(re.findall(r"\w[\w.]*", text))

    for page in PAGES:
        if page.parent.name not in ("api", "benchmarks"):
            text = page.read_text()
            measured = "".join(re.findall(r"<!-- table: .*?<!-- end -->", text, re.DOTALL))
            assert text.count("\n") <= 250, page
            assert count(measured) <= 0.15 * count(text), page


def test_every_benchmark_has_stored_results():
    (names,) = re.findall(r"^BENCHMARKS := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    stored = {path.stem for path in (ROOT / "benchmarks" / "results").glob("*.json")}
    # These run where there is a GPU, and on older JAX, and not with the others.
    assert stored == {*names.split(), "gpu", "older_jax"}
    assert all((ROOT / "benchmarks" / f"{name}.py").exists() for name in stored)


def strings(paths):
    """All that these files may say; a word that is inserted is an ellipsis."""
    trees = (ast.parse(path.read_text()) for path in paths)
    nodes = (node for tree in trees for node in ast.walk(tree))
    literal = (ast.JoinedStr, ast.Constant)
    return "\n".join(template(node) for node in nodes if isinstance(node, literal))


def test_messages_that_are_explained_are_those_that_are_raised():
    folders = [ROOT / "cfjax", *(Path(m.__file__).parent for m in (diffrax, optimistix))]
    paths = [path for folder in folders for path in folder.rglob("*.py")]
    # Messages of JAX and of Python.
    others = {
        "can't apply forward-mode autodiff (jvp) to a custom_vjp function",
        "missing 2 required keyword-only arguments: 'frame' and 'layout'",
        "is not found in mesh: ()",
    }
    page = (ROOT / "docs" / "errors.md").read_text()
    rows = re.findall(r"^\| (.*?) \|", page, flags=re.MULTILINE)[2:]
    explained = re.findall("`(.*?)`", "\n".join(rows))
    raised = strings(paths).replace("`", "")  # a cell of a table has its own
    assert len(explained) > 15
    assert [text for text in explained if text not in raised and text not in others] == []


def test_messages_are_listed():
    listed = [text for paths in FOLDERS for text, _ in messages(paths)]
    sources = "\n".join(path.read_text() for path in (ROOT / "cfjax").rglob("*.py"))
    # Less what is raised in several places, and what stands in no folder that a user meets.
    assert len(listed) > 0.8 * sources.count("raise ")
    assert all(any(map(str.isalpha, text)) for text in listed)
