"""The commands `cfjax chart` and `cfjax scene`. `cfjax paper` is tested with the paper."""

import csv
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
import pytest
from matplotlib.figure import Figure

import cfjax
from cfjax import scenes
from cfjax.__main__ import main

SCENES = {name: module for name, module in vars(scenes).items() if hasattr(module, "problem")}
# A scene may have several charts: `scenes.stiefel.chart_first` is that of stiefel_first.
CHARTS = {
    scene + name.removeprefix("chart"): function
    for scene, module in SCENES.items()
    for name, function in vars(module).items()
    if name == "chart" or name.startswith("chart_")
}


@pytest.fixture
def short(monkeypatch):
    """The same command with fewer programs."""

    def work_precision(*args, **options):
        methods = dict(list(options.pop("methods").items())[-1:])
        return original(*args, methods=methods, **(options | dict(num_steps=[500, 1000])))

    original = cfjax.work_precision
    monkeypatch.setattr(cfjax, "work_precision", work_precision)


@pytest.fixture
def blank(monkeypatch):
    """A picture that takes no time; those of the scenes have their own tests."""
    monkeypatch.setattr(scenes.rigid_body, "picture", Figure)


@pytest.fixture
def figures(monkeypatch):
    """By file, the figures that are written."""
    found = {}
    savefig = Figure.savefig

    def seen(self, path, dpi):
        found[Path(path).name] = self
        savefig(self, path, dpi=dpi / 10)

    monkeypatch.setattr(Figure, "savefig", seen)
    return found


def test_files_and_table(short, blank, figures, tmp_path, capsys):
    output = tmp_path / "new" / "folder"
    assert main(["chart", "rigid_body", "--output", str(output), "--budget", "0.1"]) == 0
    out, error = capsys.readouterr()
    # The flops of this method are not known.
    assert "nan" not in out and "flops" not in out
    # The picture is that of `cfjax scene`.
    pictures = ["rigid_body_picture.pdf", "rigid_body_picture.png"]
    files = ["rigid_body.csv", "rigid_body.pdf", "rigid_body.png", *pictures]
    assert sorted(os.listdir(output)) == files
    assert error.startswith("Compiles") and error.count("\n") == 1
    for name in files:
        assert f"Wrote {output / name}" in out
    assert (output / "rigid_body.png").read_bytes().startswith(b"\x89PNG")
    assert (output / "rigid_body.pdf").read_bytes().startswith(b"%PDF")
    with open(output / "rigid_body.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    found = [(row["method"], row["num_steps"]) for row in rows]
    assert found == [("Tsit5", "500"), ("Tsit5", "1000")]
    for row in rows:
        assert row["method"] in out
        assert 0 < float(row["error"]) < 1e-3
        assert float(row["seconds_min"]) <= float(row["seconds_median"])
    chart = figures["rigid_body.png"]
    (caption,) = (text.get_text() for text in chart.texts)
    assert "rigid body" in caption
    # Without flops of any method, evaluations take their place, and they are known.
    _, right = chart.axes
    assert right.get_xlabel() == "evaluations of the field"
    assert "flops" not in caption.lower()


def test_every_chart_says_what_it_shows(capsys):
    assert "rigid_body" in CHARTS
    with pytest.raises(SystemExit):
        main(["chart", "no such chart"])
    listed = capsys.readouterr().err.partition("choose from ")[2].rstrip(")\n")
    assert listed.replace("'", "").split(", ") == list(CHARTS)
    for name, chart in CHARTS.items():
        assert chart.__doc__ and len(chart.__doc__.splitlines()[0]) > 10, name


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CHARTS if name != "rigid_body"])
def test_charts_of_the_other_scenes(name, monkeypatch):
    original = cfjax.work_precision

    def work_precision(*args, methods, num_steps=None, tolerances=None, **options):
        some = {"CF4": methods["CF4"]}
        # Steps from the middle of the chart, where methods have their order and no rounding.
        num_steps, tolerances = num_steps and num_steps[3:5], tolerances and [1e-4, 1e-6]
        settings = dict(num_steps=num_steps, tolerances=tolerances)
        return original(*args, methods=some, **(options | settings))

    monkeypatch.setattr(cfjax, "work_precision", work_precision)
    work = CHARTS[name](budget=0.1)
    # One halving of the step divides the error by 16 at order 4. With tolerances the estimate is of
    # order 3, so the step goes with their third root and the error with their power 4/3: divided by
    # 464 for two powers of ten, and by less where the order is not reached.
    assert 8 < work.error[0] / work.error[1] < 464
    assert work.error[1] < 1e-3


def test_a_missing_extra(monkeypatch, capsys):
    main([])
    for name in [name for name in sys.modules if re.match(r"cfjax\..*\breport$", name)]:
        module = sys.modules[name.rpartition(".")[0]]
        monkeypatch.delitem(sys.modules, name)
        monkeypatch.delattr(module, "report", raising=False)
    monkeypatch.setitem(sys.modules, "rich", None)
    monkeypatch.setattr(sys, "argv", ["cfjax"])
    with pytest.raises(SystemExit) as exit_:
        main(["chart", "rigid_body"])
    assert exit_.value.code == 2
    error = "cfjax chart: error: rich is missing: pip install 'cfjax[paper]'\n"
    assert capsys.readouterr().err == error


def test_the_list_of_scenes(capsys):
    assert main([]) == 0
    listed = capsys.readouterr().out.partition("scenes:\n")[2].splitlines()
    assert [line.split()[0] for line in listed] == list(SCENES)
    for line, module in zip(listed, SCENES.values(), strict=True):
        assert module.__doc__.startswith(" ".join(line.split()[1:]) + "\n")


def test_a_scene(blank, monkeypatch, tmp_path, capsys):
    # Beside its own invariants, the longest names and values of the scenes.
    names = "distance of each link from unitary", "momentum in the fixed frame"
    original = scenes.rigid_body.invariants

    def invariants(y, args):
        still = 0 * y + np.arange(1.0, 4.0) / 7
        values = jax.numpy.concatenate([1e-16 * still, -1e-16 * still]), -1e-5 * still
        return original(y, args) | dict(zip(names, values, strict=True))

    monkeypatch.setattr(scenes.rigid_body, "invariants", invariants)
    monkeypatch.setattr(scenes.rigid_body, "solver", cfjax.CF4())
    monkeypatch.setenv("COLUMNS", "80")
    # It is replaced.
    picture = tmp_path / "rigid_body_picture.png"
    picture.write_bytes(b"old")
    assert main(["scene", "rigid_body", "--output", str(tmp_path)]) == 0
    out, error = capsys.readouterr()
    assert sorted(os.listdir(tmp_path)) == ["rigid_body_picture.pdf", "rigid_body_picture.png"]
    assert picture.read_bytes() != b"old"
    assert error.startswith("Takes") and error.count("\n") == 1
    # Lines are as wide as the terminal.
    text = " ".join(out.split())
    assert text.startswith(scenes.rigid_body.__doc__.partition("\n")[0])
    (row,) = (line.split() for line in out.splitlines() if line.split()[:1] == ["energy"])
    # (8/9)^2 / (7/8) / 2 + (4/9)^2 / (5/8) / 2 + (1/9)^2 / (1/4) / 2 = 1798 / 2835, to five digits.
    assert row[1] == "0.63422"
    assert 0 < float(row[3]) < 1e-3
    assert "Compiled in" in text and "s a step: the fastest of" in text
    assert "1000 equal steps of CF4, t = 0 to 100" in text
    assert max(map(len, out.splitlines())) <= 80 + len(str(tmp_path))
    for name in (*names, "length of the momentum"):
        assert any(name in line for line in out.splitlines()), name
    # Values may take several lines, but are whole.
    for value in ("-4.2857e-17", "4.2857e-17", "-1.4286e-06", "-4.2857e-06"):
        assert len(re.findall(rf"(?<![\w.-]){value}", out)) == 2, value


# What README's table says of fields, where a scene has a reason for another method.
WITH_REASONS = {
    "flow_on_spheres": "RKMK8",
    "harmonic_maps": "RKL2",
    "heat": "CF4",
    "porous_medium": "RKL2",
    "spins": "CF4",
}


def test_scenes_solve_with_the_method_that_readme_recommends():
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    rows = re.findall(r"^\| `(\w+)\(.*\| (.*?) \|$", readme, re.MULTILINE)
    methods = {name: text for name, text in rows if hasattr(cfjax, name)}
    assert len(methods) > 10
    projected = "Projected(diffrax.Dopri8())"
    seen = set()

    def start_and_field(make):
        problem = {"args": None} | make()
        if isinstance(problem["term"], cfjax.VariationTerm):
            # With variations by the method for the state.
            problem |= {"term": problem["term"].term, "y0": problem["y0"].state}
        if isinstance(problem["term"], cfjax.LieTerm):
            arrays = problem["t0"], problem["y0"], problem["args"]
            arrays = jtu.tree_map(jax.numpy.asarray, arrays)
            return arrays[1], problem["term"].vf(*arrays)
        return None

    for name, module in SCENES.items():
        make = module.problem
        if name == "preintegration":
            # Its start is NumPy's of what JAX computes.
            problem = make()
            make = lambda problem=problem: problem  # noqa: E731
        # Of shapes: some problems take a while to make.
        found = eqx.filter_eval_shape(start_and_field, make)
        chosen = type(module.solver).__name__
        if chosen == "Projected":
            chosen = f"Projected(diffrax.{module.solver.name}())"
        if found is None:
            # The pages on splittings and on noise recommend these.
            assert chosen in ("BlanesMoan4", "Strang", "WeakOrder2"), name
            continue
        y0, fields = found
        parts = jtu.tree_leaves(fields, is_leaf=lambda x: type(x).__name__ in methods)
        kinds = {methods.get(type(part).__name__) for part in parts}
        if name in WITH_REASONS:
            assert chosen == WITH_REASONS[name]
        elif any(str(kind).startswith("`ETD54`") for kind in kinds):
            assert chosen == "ETD54", name
        elif any("`Kraus4`" in str(kind) for kind in kinds):
            levels = jtu.tree_leaves(y0)[0].shape[-1]
            assert chosen == ("Magnus4" if levels <= 4 else "Kraus4"), name
        else:
            # A translation is for any method.
            kinds -= {None}
            assert all(f"`{chosen}`" in str(kind) for kind in kinds), (name, kinds)
            # A Magnus method refuses fields that depend on the state.
            assert chosen in ("CF4", "Magnus6", projected), name
        seen.add(chosen)
    assert seen == {"CF4", "ETD54", "Kraus4", "Magnus4", "Magnus6", "RKL2", "RKMK8", projected}


# What solvers keep to their order alone: relative to the start, to 1e-3 with the steps below, of
# which the rigid body's are the longest, h = 1/8.
TO_ITS_ORDER = {
    "rigid_body": ["energy"],
    "heavy_top": ["energy (J)"],
    "spacecraft": ["energy"],
    "tennis_racket": ["energy", "vertical momentum"],
    "vortices": ["energy", "momentum"],
    "zeitlin": ["energy", "angular momentum"],
    "hmc": ["energy of each chain"],
    "spin_waves": ["energy"],
}


# One with the quickest program.
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "spin_waves")) for name in SCENES],
)
def test_every_scene_keeps_its_invariants(name):
    module = SCENES[name]
    problem = module.problem()
    args = problem.get("args")
    n = 1600 if name == "heavy_top" else 800 if name == "rigid_body" else 200
    if name == "wilson_flow":
        problem, n = problem | {"y0": module.y0(2)}, 20
    elif name == "zeitlin":
        problem["y0"], args = module.y0(12), module.inverse_laplacian(12)
        problem["args"] = args
    ys = cfjax.integrate(solver=module.solver, **problem, num_steps=n, save_every=n // 10).ys
    start = module.invariants(jtu.tree_map(jax.numpy.asarray, problem["y0"]), args)
    found = jax.vmap(lambda y: module.invariants(y, args))(ys)
    assert start.keys() == found.keys()
    for label, value in start.items():
        values = np.concatenate([np.asarray(value)[None], found[label]])
        assert np.all(np.isfinite(values)), label
        if label.endswith("(falls)"):
            assert np.all(np.diff(values) < 0), label
        elif label.endswith("(stays positive)"):
            assert np.all(values > 0), label
        else:
            # Every step rounds a few times; states are of length about one, or these are relative.
            # Entries and eigenvalues feel rounding by the norm of all, up to 10.
            scale = max(1.0, np.max(np.abs(value)))
            bound = 1e-3 if label in TO_ITS_ORDER.get(name, []) else 1e-15 * n
            assert np.max(np.abs(values - values[0])) < bound * scale, label


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_every_scene_can_be_run(name, monkeypatch, tmp_path, capsys):
    """With its own numbers, but no picture."""
    module = SCENES[name]
    assert callable(module.picture)
    monkeypatch.setattr(module, "picture", Figure)
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["scene", name, "--output", str(tmp_path)]) == 0
    assert sorted(os.listdir(tmp_path)) == [f"{name}_picture.pdf", f"{name}_picture.png"]
    table = capsys.readouterr().out.partition(" steps of ")[2].partition("Compiled in")[0]
    problem = module.problem()
    y0 = jtu.tree_map(jax.numpy.asarray, problem["y0"])
    assert [
        label for label in module.invariants(y0, problem.get("args")) if label not in table
    ] == []


NO_SECONDS = "positive number of seconds, got "
BAD = [
    ("chart", "SCENE"),
    ("chart chess", "invalid choice: 'chess' (choose from"),
    ("chart macrospin", "macrospin has no chart, as it has noise; cfjax scene macrospin draws it"),
    ("chart rigid_body extra", "extra"),
    ("chart rigid_body --budget", "--budget"),
    ("chart rigid_body --budget soon", NO_SECONDS + "'soon'"),
    ("chart rigid_body --budget 0", NO_SECONDS + "'0'"),
    ("chart rigid_body --budget=-1", NO_SECONDS + "'-1'"),
    ("chart rigid_body --budget nan", NO_SECONDS + "'nan'"),
    ("chart rigid_body --output", "--output"),
    ("chart rigid_body --output ''", "must name a folder, got ''"),
    ("scene", "SCENE"),
    ("scene stiefel_first", "invalid choice: 'stiefel_first' (choose from"),
    ("scene stiefel --budget 1", "--budget"),
    ("scene stiefel --output ''", "must name a folder, got ''"),
]


def test_bad_arguments(capsys, subtests):
    for command, message in BAD:
        with subtests.test(command=command):
            check_one_line_error(shlex.split(command), message, capsys)


def test_output_that_is_a_file(tmp_path, capsys):
    path = tmp_path / "file"
    path.write_text("mine")
    check_one_line_error(["chart", "rigid_body", "--output", str(path)], str(path), capsys)
    assert path.read_text() == "mine"


def check_one_line_error(arguments, message, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    out, error = capsys.readouterr()
    assert exit_.value.code == 2
    assert out == ""
    assert error.startswith("cfjax") and error.count("\n") == 1
    assert message in error


def test_help(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["chart", "--help"])
    assert exit_.value.code == 0
    out = capsys.readouterr().out
    assert "rigid_body" in out and "--budget" in out and "--output" in out


# Ctrl-C and SIGTERM


@pytest.fixture
def start(tmp_path):
    """Starts Python with `arguments`, where Ctrl-C is not ignored, whatever started the tests."""
    running = []

    def started(*arguments, **options):
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        streams = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        process = subprocess.Popen([sys.executable, *arguments], text=True, **streams, **options)
        signal.signal(signal.SIGINT, before)
        running.append(process)
        return process

    yield started
    for process in running:
        process.kill()
        process.communicate()


def read_until(stream, text):
    for line in stream:
        if text in line:
            return
    raise AssertionError(f"{text!r} was not printed.")


@pytest.mark.slow
@pytest.mark.parametrize(
    "number, status, message",
    [(signal.SIGINT, 130, "cfjax: interrupted"), (signal.SIGTERM, 143, "cfjax: terminated")],
)
def test_a_signal_while_a_program_compiles(number, status, message, start, tmp_path):
    command = ["-m", "cfjax", "chart", "rigid_body", "--output", str(tmp_path)]
    process = start(*command, env=os.environ | {"JAX_LOG_COMPILES": "1"})
    # The step of CF3 that counts its flows; it takes longer to compile than a signal takes.
    read_until(process.stderr, "Compiling jit(step)")
    process.send_signal(number)
    out, error = process.communicate()
    assert process.returncode == status
    assert out == ""
    # Apart from what jax was asked to log.
    assert error.splitlines()[-1] == message and "Traceback" not in error
    assert os.listdir(tmp_path) == []


def test_ctrl_c_while_jax_is_imported(start):
    process = start("-X", "importtime", "-m", "cfjax", "paper")
    read_until(process.stderr, "jax._src")
    process.send_signal(signal.SIGINT)
    out, error = process.communicate()
    assert process.returncode == 130
    assert out == ""
    # The thread that imports may still report a module before the process has ended.
    assert error.splitlines().count("cfjax: interrupted") == 1 and "Traceback" not in error


def test_files_are_written_whole_or_not_at_all(start, tmp_path):
    code = """
import sys, time
from pathlib import Path
import numpy as np

class Figure:
    def savefig(self, path, dpi):
        Path(path).touch()
        print("writing", flush=True)
        time.sleep(0.5)

sys.argv[0] = "cfjax"
import cfjax
from cfjax import scenes
from cfjax.__main__ import main
def problem():
    return dict(term=cfjax.LieTerm(lambda t, y, args: y), t0=0.0, t1=1.0, y0=np.ones(1))

# The quickest program.
scenes.rigid_body.picture, scenes.rigid_body.solver = Figure, cfjax.LieEuler()
scenes.rigid_body.problem, scenes.rigid_body.invariants = problem, lambda y, args: {}
main(["scene", "rigid_body", "--output", sys.argv[1]])
time.sleep(60)
"""
    process = start("-c", code, str(tmp_path))
    read_until(process.stdout, "writing")
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 143
    waits, end = process.stderr.read().splitlines()
    assert waits.startswith("Takes") and end == "cfjax: terminated"
    assert sorted(os.listdir(tmp_path)) == ["rigid_body_picture.pdf", "rigid_body_picture.png"]


def test_a_failure_keeps_the_old_files(tmp_path, monkeypatch):
    (tmp_path / "rigid_body_picture.png").write_bytes(b"old")

    def fail():
        raise RuntimeError("no problem today")

    monkeypatch.setattr(scenes.rigid_body, "problem", fail)
    with pytest.raises(RuntimeError, match="no problem today"):
        main(["scene", "rigid_body", "--output", str(tmp_path)])
    assert os.listdir(tmp_path) == ["rigid_body_picture.png"]
    assert (tmp_path / "rigid_body_picture.png").read_bytes() == b"old"
