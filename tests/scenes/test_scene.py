"""The protocol of scenes, and what many of them use."""

import importlib
import inspect
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
from cfjax import scenes
from cfjax.scenes import rigid_body
from cfjax.scenes._scene import Scene, by_dop853, by_name, in_plain_space, solve

NAMES = sorted(
    path.stem for path in Path(scenes.__file__).parent.glob("*.py") if path.stem[0] != "_"
)
WITH_NOISE = {"imu", "macrospin", "rotational_diffusion"}


def test_every_file_is_a_scene_of_the_package():
    public = {name for name, value in vars(scenes).items() if isinstance(value, Scene)}
    assert public == {*NAMES}
    assert len(NAMES) == 30


def test_scenes_follow_the_protocol(subtests):
    for name in NAMES:
        with subtests.test(name=name):
            follows_the_protocol(name)


def follows_the_protocol(name):
    module = importlib.import_module(f"cfjax.scenes.{name}")
    assert isinstance(module, Scene)
    assert isinstance(module.solver, diffrax.AbstractSolver)
    # Without arguments, as the command calls them.
    inspect.signature(module.picture).bind()
    problem: dict[str, Any] = {"args": None} | module.problem()
    assert problem.keys() == {"term", "t0", "t1", "y0", "args"}
    assert problem["t0"] < problem["t1"]
    y0, args = (jax.tree.map(jnp.asarray, problem[key]) for key in ("y0", "args"))
    invariants = jax.eval_shape(module.invariants, y0, args)
    assert invariants and all(hasattr(value, "shape") for value in invariants.values())
    charts = [value for key, value in vars(module).items() if key.split("_")[0] == "chart"]
    assert bool(charts) == (name not in WITH_NOISE)
    for chart in charts:
        inspect.signature(chart).bind(budget=1.0, progress=False)
    # The command prints their first lines.
    for documented in (module, module.picture, *charts):
        assert len((documented.__doc__ or "").splitlines()[0]) > 10, documented
    assert module.reference.__doc__


def test_methods_have_the_names_of_their_classes():
    methods = by_name(cfjax.CF4(), cfjax.RKMK5(), cfjax.RKMK5(coordinates="projected"))
    assert {name: type(solver) for name, solver in methods.items()} == {
        "CF4": cfjax.CF4,
        "RKMK5": cfjax.RKMK5,
        "RKMK5, projected": cfjax.RKMK5,
    }
    ((name, (term, solver)),) = in_plain_space(rigid_body.velocity, diffrax.Tsit5()).items()
    assert (name, type(term), type(solver)) == ("Tsit5", diffrax.ODETerm, diffrax.Tsit5)
    y = jnp.asarray(rigid_body.y0)
    want = cfjax.tangent(rigid_body.field(0.0, y, rigid_body.inertia), y)
    np.testing.assert_allclose(term.vf(0.0, y, rigid_body.inertia), want, rtol=1e-15)


def test_a_solve_takes_arguments_in_place_of_those_of_the_problem():
    times, ys = solve(
        rigid_body.problem(), cfjax.CF4(), t1=1.0, num_steps=20, save_every=10, save_initial=True
    )
    assert type(ys) is np.ndarray
    np.testing.assert_allclose(times, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(ys, rigid_body.reference(times), rtol=0, atol=1e-6)


def test_dop853_of_a_pytree_with_complex_leaves():
    start = {"turns": np.array([[1.0, 2.0j]]), "decays": np.array([[3.0], [4.0]])}

    def rate(t, y):
        return {"turns": 2j * t * y["turns"], "decays": -y["decays"]}

    end = by_dop853(rate, start, 1.5)
    assert end["turns"].dtype == complex and end["decays"].dtype == float
    # A few dozen steps of a tolerance of 1e-13.
    for name, factor in (("turns", np.exp(2.25j)), ("decays", np.exp(-1.5))):
        np.testing.assert_allclose(end[name], factor * start[name], rtol=0, atol=1e-11)
    # In no time it returns the start.
    np.testing.assert_array_equal(by_dop853(lambda t, y: y, start["decays"], 0.0), start["decays"])
