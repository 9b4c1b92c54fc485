"""The public face of the package: names, docstrings, and what an import does not do."""

import ast
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import diffrax
import pytest
from solver_table import SOLVERS

import cfjax

PROMISED = [
    "LieTerm",
    "Rotation",
    "QuaternionRotation",
    "quaternion_to_matrix",
    "quaternion_from_matrix",
    "quaternion_rotate",
    "RigidMotion",
    "PlanarMotion",
    "ExtendedMotion",
    "InertialMotion",
    "LeftMatrix",
    "RightMatrix",
    "Conjugation",
    "Congruence",
    "LinearAffine",
    "OperatorSum",
    "LowRankSkew",
    "BorderedSkew",
    "SphereRotation",
    "Scaling",
    "Tableau",
    *SOLVERS,
    "LieControlTerm",
    "integrate",
    "ErrorNorm",
    "starting_step",
    "check_field",
    "check_terms",
    "expm",
    "stumpff",
    "phi",
    "diagonalised",
    "stiff_order",
    "ExponentialTableau",
    "AbstractSemilinearField",
    "AbstractSolver",
]
PUBLIC = [
    name
    for name in dir(cfjax)
    if not name.startswith("_")
    and name not in ("Any", "TYPE_CHECKING")
    and not inspect.ismodule(getattr(cfjax, name))
]


def test_promised_names_exist():
    assert set(PROMISED) <= set(PUBLIC)


def test_type_checkers_see_the_names_that_are_imported_later():
    """They do not read a table, and Python does not read what is written for them."""
    tree = ast.parse(Path(cfjax.__file__).read_text())
    (block,) = [x for x in tree.body if isinstance(x, ast.If) and "TYPE" in ast.unparse(x.test)]
    seen = {
        alias.asname: "." + (node.module or alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == cfjax._LATER


def test_every_public_name_has_its_own_docstring():
    def has_one(name):
        value = getattr(cfjax, name)
        # `__dict__`: a docstring that a class inherits says nothing of the class.
        text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
        # A dataclass without a docstring gets its own signature as one.
        return text and text.strip() and not text.startswith(f"{name}(")

    assert [name for name in PUBLIC if not has_one(name)] == []


def test_public_methods_have_docstrings():
    classes = {name: value for name in PUBLIC if inspect.isclass(value := getattr(cfjax, name))}
    methods = [
        (name, method)
        for name, value in classes.items()
        for method, member in vars(value).items()
        if not method.startswith("_") and inspect.isfunction(member)
    ]
    assert len(methods) > 100
    # `getdoc` takes it from the abstract class or from diffrax where it is overridden.
    without = [(c, m) for c, m in methods if not inspect.getdoc(getattr(classes[c], m))]
    assert without == []


def test_solvers_explain_their_arguments():
    def explained(solver):
        return set(re.findall(r"`([a-z_]+)`", solver.__doc__))

    solvers = {name: getattr(cfjax, name.partition("(")[0]) for name in SOLVERS}
    missing = {
        name: set(inspect.signature(solver).parameters) - explained(solver)
        for name, solver in solvers.items()
    }
    assert {name: names for name, names in missing.items() if names} == {}


def test_nothing_but_the_package_is_public():
    for name in PUBLIC:
        assert getattr(cfjax, name).__module__.startswith("cfjax"), name


def test_solvers_are_hashable_values_of_diffrax(subtests):
    for name, row in SOLVERS.items():
        with subtests.test(name=name):
            assert isinstance(row.make(), diffrax.AbstractSolver)
            assert row.make() == row.make()
            assert hash(row.make()) == hash(row.make())


@pytest.fixture(scope="module")
def fresh():
    """What a fresh interpreter says after the import alone."""
    program = """
import json, os, sys, warnings
warnings.simplefilter("error")
for name in ("JAX_ENABLE_X64", "JAX_NUMPY_DTYPE_PROMOTION"):
    os.environ.pop(name, None)
import diffrax, jax
settings = {k: str(v) for k, v in jax.config.values.items()}
before = set(sys.modules)
import cfjax

from jax._src import xla_bridge
print(json.dumps({
    "changed": [k for k, v in jax.config.values.items() if settings.get(k) != str(v)],
    "x64": bool(jax.config.jax_enable_x64),
    "backends": len(xla_bridge._backends),
    "modules": sorted(sys.modules),
    "loaded": sorted(set(sys.modules) - before),
}))
import numpy as np
print(str(cfjax.Rotation(np.ones(3)).omega.dtype))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    facts, dtype = done.stdout.splitlines()
    return {**json.loads(facts), "dtype": dtype}


def test_import_changes_no_setting(fresh):
    assert fresh["x64"] is False
    assert fresh["changed"] == []
    assert fresh["dtype"] == "float32"


def test_import_starts_no_backend(fresh):
    assert fresh["backends"] == 0


def test_import_loads_what_solves_and_nothing_else(fresh):
    # The classes and coefficients of methods take longer to make than the rest of the import.
    late = {f"cfjax{module}" for module in cfjax._LATER.values()}
    extras = {"matplotlib", "rich", "pytest", "hypothesis"}
    assert not (late | extras) & set(fresh["modules"])
    foreign = [name for name in fresh["loaded"] if name.partition(".")[0] != "cfjax"]
    others = {"scipy", "pandas", "IPython", "optax"}
    assert not others & {name.partition(".")[0] for name in foreign}
    # Time is what it is about, and a test cannot tell time. Ours are 45 small files. Modules of
    # jax, for batches over hosts and for attributes of calls; of Python, for fractions.
    assert len(foreign) <= 10, foreign
    rooms = {name.partition(".")[2].partition(".")[0] for name in fresh["loaded"]}
    assert not rooms & {"_measure", "scenes", "_paper"}
