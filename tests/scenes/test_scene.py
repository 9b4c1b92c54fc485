"""The protocol of scenes, their fields in plain space and their pictures, and what many use."""

import importlib
import inspect
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cfjax
from cfjax import scenes
from cfjax.scenes import (
    cat,
    damped_qubit,
    heavy_top,
    preintegration,
    rigid_body,
    spacecraft,
    spins,
    transition,
    transmon,
    wilson_flow,
    zeitlin,
)
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
    # By shapes alone, but for a start that is NumPy's of what JAX computes.
    given = module.problem() if name == "preintegration" else eqx.filter_eval_shape(module.problem)
    problem: dict[str, Any] = {"args": None} | given
    assert problem.keys() == {"term", "t0", "t1", "y0", "args"}
    assert problem["t0"] < problem["t1"]
    t0, y0, args = (jax.tree.map(as_shape, problem[key]) for key in ("t0", "y0", "args"))
    invariants = jax.eval_shape(module.invariants, y0, args)
    assert invariants and all(hasattr(value, "shape") for value in invariants.values())
    # The precision is that of the state.
    t0, y0, args = jax.tree.map(single, (t0, y0, args))
    invariants = jax.eval_shape(module.invariants, y0, args)
    state = y0.state if isinstance(y0, cfjax.Variation) else y0
    field = getattr(module, "field", None)
    # The readings of a drone are in float64.
    frozen = field and name != "preintegration" and jax.eval_shape(field, t0, state, args)
    for part in jax.tree.leaves((invariants, frozen or None)):
        assert part.dtype in (np.float32, np.complex64)
    # A JAX array made at import would be in float32 if x64 comes on later.
    assert not any(isinstance(x, jax.Array) for x in jax.tree.leaves(vars(module)))
    charts = [value for key, value in vars(module).items() if key.split("_")[0] == "chart"]
    assert bool(charts) == (name not in WITH_NOISE)
    for chart in charts:
        inspect.signature(chart).bind(budget=1.0, progress=False)
    # The command prints their first lines.
    for documented in (module, module.picture, *charts):
        assert len((documented.__doc__ or "").splitlines()[0]) > 10, documented
    assert module.reference.__doc__


def as_shape(x):
    return jax.ShapeDtypeStruct(np.shape(x), jnp.result_type(x))


def single(x):
    dtype = np.complex64 if np.issubdtype(x.dtype, np.complexfloating) else np.float32
    return jax.ShapeDtypeStruct(x.shape, dtype)


def test_methods_have_the_names_of_their_classes():
    methods = by_name(cfjax.CF4(), cfjax.RKMK5(), cfjax.Projected(diffrax.Tsit5()))
    assert {name: type(solver) for name, solver in methods.items()} == {
        "CF4": cfjax.CF4,
        "RKMK5": cfjax.RKMK5,
        "Projected, Tsit5": cfjax.Projected,
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


# A time, a state in no special place and arguments, and how far apart the two may be.
IN_PLAIN_SPACE: dict[str, tuple[Any, float]] = {
    # Entries up to 1, and jumps of norm up to 70.
    "cat": ((0.3, cat.coherent(0.5 + 0.3j, 10), cat.Oscillator(size=1.2, loss=0.3)), 1e-14),
    "damped_qubit": (
        (0.7, damped_qubit.density(np.array([0.6, -0.3, 0.2])), damped_qubit.Qubit()),
        1e-15,
    ),
    # The rate is 75.
    "heavy_top": ((0.0, heavy_top.reference(0.1), heavy_top.benchmark), 1e-12),
    "preintegration": ((2.0, preintegration.reference(2.0), None), 1e-14),
    "spacecraft": (
        (
            1.0,
            {"q": np.array([0.1, 0.5, -0.5, 0.7]), "m": np.array([0.3, -1.0, 0.7])},
            spacecraft.Craft(torque=(0.1, -0.2, 0.3), on=0.7, off=1.9),
        ),
        1e-15,
    ),
    "spins": ((0.0, spins.y0(3, 4), spins.Magnet()), 1e-15),
    "transition": (
        (
            0.7,
            {"q": np.array([0.8, 0.4, -0.4, 0.2]), "w": np.array([0.3, -0.5, 1.2])},
            transition.Craft(),
        ),
        1e-15,
    ),
    # Levels up to 90.
    "transmon": (
        (
            0.7,
            np.random.default_rng(0).normal(size=(4, 4)) + 0j,
            transmon.Pulse(np.array([0.3, -0.1]), np.array([0.05, 0.02]), 2.0),
        ),
        1e-13,
    ),
    "wilson_flow": ((0.0, wilson_flow.y0(3, dimensions=3), None), 1e-15),
    "zeitlin": ((0.0, zeitlin.y0(12, degree=3), zeitlin.inverse_laplacian(12)), 1e-15),
}


def test_the_velocity_is_that_of_the_field(subtests):
    for name, (given, atol) in IN_PLAIN_SPACE.items():
        module = importlib.import_module(f"cfjax.scenes.{name}")

        def both(t, y, args, module=module):
            return module.velocity(t, y, args), cfjax.tangent(module.field(t, y, args), y)

        program, (t, *rest) = jax.jit(both), given
        # A drive and a thruster are off at first.
        for time in (t, 0.0):
            found, want = map(jax.tree.leaves, program(time, *rest))
            with subtests.test(name=name, time=time):
                for a, b in zip(found, want, strict=True):
                    np.testing.assert_allclose(a, b, rtol=0, atol=atol)


# Panels, and arguments of a smaller picture.
PICTURES: dict[str, tuple[int, dict[str, Any]]] = {
    "allen_cahn": (6, dict(n=16)),
    "cat": (5, {}),
    "covariance": (2, {}),
    "damped_qubit": (2, {}),
    "flow_on_spheres": (5, {}),
    "gray_scott": (7, dict(n=16)),
    "harmonic_maps": (9, dict(side=8)),
    "heat": (4, dict(num_intervals=16)),
    "heavy_top": (3, {}),
    "hmc": (3, dict(num_trajectories=5, most_steps=1)),
    "imu": (2, dict(num_samples=100)),
    "kuramoto_sivashinsky": (3, dict(time=10.0)),
    "landau_zener": (3, {}),
    "macrospin": (3, dict(num_samples=20)),
    "porous_medium": (4, dict(n=16)),
    "preintegration": (2, {}),
    "rigid_body": (2, {}),
    "rotational_diffusion": (4, dict(num_samples=50)),
    "spacecraft": (2, {}),
    "spin_waves": (4, dict(side=4, time=5.0)),
    "spins": (6, dict(side=4)),
    "stiefel": (3, dict(n=8)),
    "tennis_racket": (2, dict(num_steps=1000)),
    "toda": (3, {}),
    "transition": (2, {}),
    "transmon": (4, {}),
    "vortices": (5, {}),
    "wilson_flow": (10, dict(side=2)),
    "zeitlin": (12, dict(n=8)),
}
# Those that are drawn have a sphere, an image or panels with logarithms.
DRAWN = {"cat", "damped_qubit", "transmon"}
QUICK = {
    *DRAWN,
    *("heat", "imu", "landau_zener", "macrospin", "rigid_body", "rotational_diffusion"),
    *("spacecraft", "spins", "stiefel", "toda"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_the_picture(name):
    panels, arguments = PICTURES[name]
    figure = importlib.import_module(f"cfjax.scenes.{name}").picture(**arguments)
    assert len(figure.axes) == panels
    figure.draw_without_rendering()


def stay(problem, solver, **options):
    """What `solve` returns if nothing moves."""
    given = dict(args=None, save_every=None, save_initial=False) | problem | options
    inspect.signature(cfjax.integrate).bind(**given, solver=solver)
    assert isinstance(solver, diffrax.AbstractSolver)
    jax.eval_shape(given["term"].vf, given["t0"], given["y0"], given["args"])
    times = np.linspace(given["t0"], given["t1"], given["num_steps"] + 1)
    times = times[:: given["save_every"]][not given["save_initial"] :]
    return times, jax.tree.map(lambda y: np.stack([np.asarray(y)] * len(times)), given["y0"])


@pytest.mark.parametrize("name", sorted(QUICK))
def test_the_picture_if_nothing_moves(name, monkeypatch):
    """Without solves, or with methods of one stage."""
    module = importlib.import_module(f"cfjax.scenes.{name}")
    panels, arguments = PICTURES[name]
    if hasattr(module, "solve"):
        monkeypatch.setattr(module, "solve", stay)
    if name == "rigid_body":
        monkeypatch.setattr(module, "solver", cfjax.LieEuler())
        for method in ("CF3", "CF4"):
            monkeypatch.setattr(cfjax, method, cfjax.LieEuler)
    if name == "cat":
        monkeypatch.setattr(cat, "y0", lambda: cat.coherent(0.0, 4))  # With fewer levels.
    if name == "damped_qubit":
        # Of one method for all, by one program.
        least, method = damped_qubit._least, (cfjax.LieTerm(damped_qubit.field), cfjax.LieEuler())
        found = []

        def of_one(_, *given):
            found.append(found[0] if found else least(method, *given))
            return found[0]

        monkeypatch.setattr(damped_qubit, "_least", of_one)
    if name in WITH_NOISE:
        signature = inspect.signature(module.samples)

        def samples(num_samples, *args, num_steps, **options):
            signature.bind(num_samples, *args, num_steps=num_steps, **options)
            return np.tile(module.y0(), (num_samples, num_steps, 1))

        monkeypatch.setattr(module, "samples", samples)
    figure = module.picture(**arguments)
    assert len(figure.axes) == panels
    if name in DRAWN:
        figure.draw_without_rendering()
    if name == "spacecraft":
        # To the time of the table that `cfjax scene` prints.
        assert [np.max(line.get_xdata()) for line in figure.axes[1].lines] == 3 * [spacecraft.t1]
