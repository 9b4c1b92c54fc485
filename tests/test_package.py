"""What is released: wheel and sdist, the conda recipe, the workflow that publishes, the version."""

import os
import re
import subprocess
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

import cfjax

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RECIPE = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
VERSION = cfjax.__version__


def test_one_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == RECIPE["context"]["version"] == VERSION
    first = re.search(r"^## (\S+) - (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert first[1] == VERSION
    assert first[2] == "unreleased" or re.fullmatch(r"\d{4}-\d\d-\d\d", first[2])


def test_the_recipe_asks_for_what_the_project_asks_for():
    requirements = RECIPE["requirements"]
    python, *others = requirements["run"]
    lowest = PROJECT["requires-python"].removeprefix(">=")
    assert RECIPE["context"]["python_min"] == lowest
    assert python == "python >=${{ python_min }}"
    assert [each.replace(" ", "") for each in others] == PROJECT["dependencies"]
    backend = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert requirements["host"] == ["python ${{ python_min }}.*", "pip", *backend]
    assert RECIPE["package"]["name"] == PROJECT["name"]
    (name,) = PROJECT["scripts"]
    assert RECIPE["build"]["python"]["entry_points"] == [f"{name} = {PROJECT['scripts'][name]}"]
    assert RECIPE["about"]["license"] == PROJECT["license"]
    assert RECIPE["about"]["summary"] == PROJECT["description"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_need_no_secret(path):
    text = path.read_text()
    assert "secrets." not in text
    workflow = yaml.safe_load(text)
    # Whatever a job may do beyond reading is said in the job.
    assert workflow["permissions"] == {"contents": "read"}
    assert all({"runs-on", "steps"} <= job.keys() for job in workflow["jobs"].values())


def test_publishing_waits_for_the_tests():
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "publish.yml").read_text())["jobs"]
    trusted = [name for name, job in jobs.items() if "id-token" in job.get("permissions", {})]
    assert trusted == ["publish"]
    assert set(jobs["publish"]["needs"]) == jobs.keys() - {"publish"}


# What follows takes a minute or two, most of it to install.


def run(*command, cwd):
    """Without the sources on the path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def make_environment(folder):
    venv.create(folder, with_pip=True)
    return folder / "bin" / "python"


def contents(wheel):
    """The files of a wheel but for the list of them, which has them in another order."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if "RECORD" not in name}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with an sdist, and the wheel made from it, not from the checkout."""
    folder = tmp_path_factory.mktemp("built")
    python = make_environment(folder / "tools")
    run(python, "-m", "pip", "install", "--quiet", "build", cwd=folder)
    run(python, "-m", "build", "--outdir", folder / "dist", ROOT, cwd=folder)
    run(python, "-m", "build", "--wheel", "--outdir", folder / "direct", ROOT, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(built):
    (path,) = (built / "dist").glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Python of an environment with the wheel and what it depends on, and no extra."""
    folder = tmp_path_factory.mktemp("installed")
    python = make_environment(folder / "environment")
    run(python, "-m", "pip", "install", "--quiet", wheel, cwd=folder)
    return python


@pytest.mark.slow
def test_the_wheel_has_the_package_alone(wheel):
    assert wheel.name == f"cfjax-{VERSION}-py3-none-any.whl"
    found = contents(wheel)
    sources = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "cfjax").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert "cfjax/py.typed" in sources
    about = f"cfjax-{VERSION}.dist-info"
    assert found.keys() - sources == {
        f"{about}/{name}" for name in ("METADATA", "WHEEL", "entry_points.txt", "licenses/LICENSE")
    }
    assert sources <= found.keys()
    assert found[f"{about}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()


@pytest.mark.slow
def test_the_sdist_makes_the_same_wheel(built, wheel):
    (direct,) = (built / "direct").glob("*.whl")
    assert contents(wheel) == contents(direct)
    with tarfile.open(built / "dist" / f"cfjax-{VERSION}.tar.gz") as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "README.md", "tests/test_package.py"} <= names


@pytest.mark.slow
def test_the_readme_runs_where_only_the_wheel_is(installed, tmp_path):
    example = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    where = "import cfjax; print(cfjax.__version__); print(cfjax.__file__)"
    version, file = run(installed, "-c", where, cwd=tmp_path).splitlines()
    assert version == VERSION and installed.parents[1] in Path(file).parents
    assert run(installed, "-W", "error", "-c", example, cwd=tmp_path)
    # The extras are extras.
    missing = "import importlib.util as u; print(u.find_spec('rich'), u.find_spec('pytest'))"
    assert run(installed, "-c", missing, cwd=tmp_path).split() == ["None", "None"]
    assert run(installed, "-m", "pip", "check", cwd=tmp_path).startswith("No broken")


@pytest.mark.slow
def test_the_command_runs_where_only_the_wheel_is(installed, tmp_path):
    command = installed.parent / "cfjax"
    for arguments in ([], ["--help"], ["scene", "--help"]):
        assert "rigid_body" in run(command, *arguments, cwd=tmp_path)
    done = subprocess.run(
        [command, "scene", "rigid_body"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.endswith("is missing: pip install 'cfjax[paper]'\n")
    assert done.stderr.count("\n") == 1 and not any(tmp_path.iterdir())
