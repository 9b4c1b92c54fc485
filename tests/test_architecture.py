"""The direction of imports: what a user calls stands on what it is made of, never the reverse."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import cfjax

PACKAGE = Path(cfjax.__file__).parent
# What `import cfjax` gives.
FACE = "cfjax"
# From the ground up. A file may import from its own row's folder and from the rows above it here.
ROWS = [
    # Programs as XLA wants them, and the command's signals: none of ours.
    {"_xla", "_signals"},
    # Linear combinations of arrays, and what errors say of them.
    {"_arrays"},
    # The contract of a field.
    {"_field"},
    # Its term for diffrax; functions of arrays; arguments of solves.
    {"_term", "_numerics", "_arguments"},
    # A term that a path drives.
    {"_control_term"},
    # Fields, and coefficients of methods.
    {"_fields", "_methods"},
    # Steps; and terms of variations.
    {"_solvers", "_variation"},
    {"_step_back", "_times"},
    {"_integrate"},
    {"_batch", "_testing"},
    {"_measure"},
    {FACE},
    # These use the public names, as a user would.
    {"scenes"},
    {"_paper"},
    {"__main__"},
]
AGAINST_THE_DIRECTION = {
    (
        "_batch.fingerprint",
        FACE,
    ): "the version is part of a fingerprint; it is read when one is made, not at import"
}
# Beyond the public names.
PRIVATE = {
    ("scenes.rigid_body", "_numerics.matmul"): "a rotation of a start, in full precision",
    ("scenes.wilson_flow", "_numerics.matmul"): "products of links, in full precision",
    ("scenes.wilson_flow", "_xla"): "its field in the form that XLA vectorises",
    ("_paper", "_measure"): "reports, charts and flops are what it shows",
    ("_paper", "scenes"): "its problems",
}

# Tests beyond the public names, so that few change when code moves. One of the name of a module may
# use that module, with which it moves.
TESTS = Path(__file__).parent
PRIVATE_IN_TESTS = {
    "methods/derive.py": "the tool that derives what is stored",
    "methods/test_derive.py": "what is stored, and what is derived",
    "methods/test_order_conditions.py": "words, trees and their weights",
    "numerics/test_expm_source.py": "the norms that another exponential has polynomials for",
    "paper/test_command.py": "the command without its experiments, which take minutes",
    "paper/test_experiments.py": "numbers and figures that the command shows as text and pictures",
    "solver_table.py": "coefficients within a step, for interpreters of them",
    "test_canary.py": "tables of the names that other libraries have",
    "xla/random_programs.py": "programs rewritten, which no solve is",
    "xla/test_materialise.py": "calls that keep XLA from fusing",
    "xla/test_scalars.py": "programs on single numbers, equation by equation",
    "xla/test_understood.py": "which equations are understood, and with which parameters",
}


def modules():
    for path in sorted(PACKAGE.rglob("*.py")):
        yield (
            path,
            ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
            .removesuffix(".__init__")
            .replace("__init__", FACE),
        )


def is_module(name):
    path = PACKAGE.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def imports(node, is_lazy=False):
    """The imports of a file, but those for type checkers, each with whether a call makes it."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.ImportFrom | ast.Import):
            yield child, is_lazy
        yield from imports(child, is_lazy or isinstance(child, ast.FunctionDef | ast.Lambda))


@cache
def edges():
    """Pairs of our modules, the one that imports and the other, with whether a call does it."""
    found = {}
    for path, module in modules():
        for node, is_lazy in imports(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                ours = [alias.name for alias in node.names if room(alias.name) == "cfjax"]
                # Scenes import what a user imports.
                assert not ours or (room(module) == "scenes" and ours == ["cfjax"]), module
                if ours:
                    found[module, FACE] = found.get((module, FACE), True) and is_lazy
                continue
            if not node.level:
                assert not (node.module or "").startswith("cfjax"), module
                continue
            folder = path.relative_to(PACKAGE).parts[:-1]
            base = folder[: len(folder) - node.level + 1]
            for alias in node.names:
                parts = [*base, *(node.module or "").split("."), alias.name]
                whole = ".".join(filter(None, parts))
                target = whole if is_module(whole) else whole.rpartition(".")[0] or FACE
                if target != module:
                    found[module, target] = found.get((module, target), True) and is_lazy
    return found


def room(module):
    return module.partition(".")[0]


def row(module):
    return next(n for n, rooms in enumerate(ROWS) if room(module) in rooms)


def test_every_folder_has_its_place():
    rooms = [name for rooms in ROWS for name in rooms]
    assert sorted(rooms) == sorted({room(module) for _, module in modules()})


def test_imports_go_one_way():
    against = {
        (module, target)
        for module, target in edges()
        if room(module) != room(target) and row(target) >= row(module)
    }
    assert against == AGAINST_THE_DIRECTION.keys()


def test_scenes_and_the_paper_use_the_public_names():
    def reason(module, target):
        return [
            key
            for key in PRIVATE
            if (module == key[0] or room(module) == key[0])
            and (target == key[1] or room(target) == key[1])
        ]

    used = set()
    for module, target in edges():
        if room(module) in ("scenes", "_paper") and target != FACE:
            if room(module) != room(target):
                assert reason(module, target), f"{module} imports {target}, which is private."
                used.update(reason(module, target))
    # The table has no line too many.
    assert used == PRIVATE.keys()
    for path, module in modules():
        if room(module) == "scenes":
            assert not re.search(r"\bcfjax\._", path.read_text()), module


def test_methods_and_fields_do_not_know_xla():
    """What a method or a field says to the compiler, it says through its chart or short vectors."""
    users = {module for module, target in edges() if room(target) == "_xla" != room(module)}
    assert users == {
        # What steps, loops of them, and short vectors need of it.
        "_solvers.compiled",
        "_integrate",
        "_numerics.vectors",
        # The switch, which is public; a reader of programs; and a scene (`PRIVATE`).
        FACE,
        "_measure.flops",
        "scenes.wilson_flow",
    }


def test_there_is_no_circular_import():
    after = {}
    for (module, target), is_lazy in edges().items():
        if not is_lazy:
            after.setdefault(module, []).append(target)
    done, path = set(), []

    def visit(module):
        assert module not in path, " imports ".join([*path[path.index(module) :], module])
        if module not in done:
            path.append(module)
            for target in after.get(module, []):
                visit(target)
            path.pop()
            done.add(module)

    for _, module in modules():
        visit(module)


def test_the_imports_are_found():
    found = edges()
    assert found["_fields.rotation", "_field"] is False
    assert found["_batch.fingerprint", FACE] is True
    assert (FACE, "scenes") not in found
    assert ("scenes.heat", FACE) in found


def test_few_tests_import_what_is_private():
    def private(path):
        # Also in the text of programs for other processes.
        imports = r"cfjax(?:\.| import )_[a-z][a-z_.]*(?: import [a-z_0-9, ]+)?"
        folder, name = path.parent.name, path.stem.removeprefix("test_")
        own = rf"cfjax\._{folder}(\.| import ){name}( import .*)?$"
        return [x for x in re.findall(imports, path.read_text()) if not re.match(own, x)]

    found = {path.relative_to(TESTS).as_posix() for path in TESTS.rglob("*.py") if private(path)}
    assert found == PRIVATE_IN_TESTS.keys()
    assert sum(Path(path).name.startswith("test_") for path in found) <= 12


@pytest.mark.parametrize("folder", ["solvers", "numerics"])
def test_each_module_has_a_test_file_of_its_name(folder):
    modules = {path.stem for path in (PACKAGE / f"_{folder}").glob("*.py")} - {"__init__"}
    tests = {path.stem.removeprefix("test_") for path in (TESTS / folder).glob("test_*.py")}
    assert modules <= tests
