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


@pytest.mark.parametrize("name", PROMISED)
def test_promised_names_exist(name):
    assert name in PUBLIC


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


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_its_own_docstring(name):
    value = getattr(cfjax, name)
    # `__dict__`: a docstring that a class inherits says nothing of the class.
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    assert text and text.strip()
    # A dataclass without a docstring gets its own signature as one.
    assert not text.startswith(f"{name}(")


@pytest.mark.parametrize("name", PUBLIC)
def test_public_methods_have_docstrings(name):
    value = getattr(cfjax, name)
    if inspect.isclass(value):
        for attribute, member in vars(value).items():
            if not attribute.startswith("_") and inspect.isfunction(member):
                # `getdoc` takes it from the abstract class or from diffrax where it is overridden.
                assert inspect.getdoc(getattr(value, attribute)), attribute


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_explain_their_arguments_and_no_others(name):
    solver = getattr(cfjax, name.partition("(")[0])
    named = set(re.findall(r"`([a-z_]+)`", solver.__doc__))
    assert set(inspect.signature(solver).parameters) <= named


def test_nothing_but_the_package_is_public():
    for name in PUBLIC:
        assert getattr(cfjax, name).__module__.startswith("cfjax"), name


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_are_hashable_values_of_diffrax(name):
    make = SOLVERS[name].make
    assert isinstance(make(), diffrax.AbstractSolver)
    assert make() == make()
    assert hash(make()) == hash(make())


@pytest.fixture(scope="module")
def fresh():
    """What a fresh interpreter says after the import alone."""
    program = """
import json, os, sys, warnings
warnings.simplefilter("error")
for name in ("JAX_ENABLE_X64", "JAX_NUMPY_DTYPE_PROMOTION"):
    os.environ.pop(name, None)
import jax
settings = {k: str(v) for k, v in jax.config.values.items()}
import cfjax

from jax._src import xla_bridge
print(json.dumps({
    "changed": [k for k, v in jax.config.values.items() if settings.get(k) != str(v)],
    "x64": bool(jax.config.jax_enable_x64),
    "backends": len(xla_bridge._backends),
    "modules": sorted(sys.modules),
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


def test_import_makes_few_of_the_methods(fresh):
    """Their classes and coefficients take longer to make than the rest of the import."""
    later = {f"cfjax{module}" for module in cfjax._LATER.values()}
    assert not later & set(fresh["modules"])


def test_import_loads_no_extra(fresh):
    assert not {"matplotlib", "rich", "pytest", "hypothesis"} & set(fresh["modules"])
