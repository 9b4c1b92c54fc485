"""cfjax and its peers, on scenes of both: error, time, and distance from the group.

Each program runs with several numbers of steps, or tolerances, and with the number or tolerance
that it needs for one error common to all. At this error the programs are compared: time, and the
distance of the end from the group. The spacecraft also runs 1000 times at once. All programs of a
scene take turns.

A peer that is not installed is left out, and so are its rows in the stored results: run
`pip install '.[peers]'` before `make benchmarks`.
"""

import importlib.metadata
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import results
from cfjax._measure import style as _style
from cfjax._measure.work_precision import take_turns
from peer_scenes import SCENES, Scene

BATCH = 1000


def prepared(scene: Scene, name: str, y0: Any, setting: float) -> Callable[[], Any]:
    program = scene.programs[name]
    if program.package == "scipy":
        y0_on_host = jax.tree.map(np.asarray, y0)
        return lambda: program.solve(y0_on_host, setting)

    def solve(y0: Any) -> Any:
        return program.solve(y0, setting)

    is_batch = jax.tree.map(jnp.shape, y0) != jax.tree.map(jnp.shape, scene.y0)
    return results.compiled(jax.vmap(solve) if is_batch else solve, y0, repeats=scene.repeats)


def to_target(scene: Scene, name: str, runs: dict[float, Callable]) -> float:
    """The setting for the scene's error, by the slope between those in `runs`; adds its runs."""
    errors = {setting: scene.error(run()) for setting, run in runs.items()}
    for _ in range(5):
        met = {s: e for s, e in errors.items() if e <= scene.target}
        missed = {s: e for s, e in errors.items() if scene.target < e}
        if not missed or (met and max(met.values()) > 0.8 * scene.target):
            break
        nearest = min(missed, key=missed.__getitem__)
        second = max(met or {s: missed[s] for s in missed if s != nearest}, key=errors.__getitem__)
        slope = math.log(second / nearest) / math.log(errors[second] / errors[nearest])
        setting = nearest * (0.9 * scene.target / errors[nearest]) ** slope
        is_tolerance = scene.programs[name].package == "scipy"
        setting = results.digits(setting) if is_tolerance else math.ceil(setting)
        runs[setting] = prepared(scene, name, scene.y0, setting)
        errors[setting] = scene.error(runs[setting]())
    # The least exact run that meets the target is the cheapest.
    met = {s: e for s, e in errors.items() if e <= scene.target}
    return max(met, key=met.__getitem__)


def measure(quick: bool) -> Iterator[results.Row]:
    for label, make in SCENES.items():
        scene = make()
        runs, chosen = {}, {}
        for name, program in scene.programs.items():
            settings = program.settings
            settings = (settings[0], settings[-1]) if quick else settings
            tried = {s: prepared(scene, name, scene.y0, s) for s in settings}
            chosen[name] = to_target(scene, name, tried)
            runs |= {(name, s): tried[s] for s in (*settings, chosen[name])}
        yield from _rows(label, scene, runs, chosen, 1, quick)
        if label == "spacecraft":
            many = jax.tree.map(lambda y: jnp.broadcast_to(y, (BATCH, *y.shape)), scene.y0)
            scene = scene._replace(repeats=1)
            runs = {(name, s): prepared(scene, name, many, s) for name, s in chosen.items()}
            yield from _rows(label, scene, runs, chosen, BATCH, quick)


def _rows(
    label: str,
    scene: Scene,
    runs: dict[tuple[str, float], Callable],
    chosen: dict[str, float],
    systems: int,
    quick: bool,
) -> Iterator[results.Row]:
    """Each program at each setting; where it is the chosen one, over the fastest of cfjax."""
    rounds, budget = (3, 5.0) if quick else (25, 40.0)
    programs = list(runs.values())
    # The first of a turn would pay for cold caches, after a slow one: it runs before, for nothing.
    seconds = take_turns([programs[0], *programs], repeats=rounds, budget=budget)[1:]
    packages = {name: scene.programs[name].package for name in chosen}
    spent = {
        (name, setting): times / (1 if packages[name] == "scipy" else scene.repeats)
        for (name, setting), times in zip(runs, seconds, strict=True)
    }
    ours = [spent[name, s] for name, s in chosen.items() if packages[name] == "cfjax"]
    best = min(ours, key=np.median)
    for (name, setting), run in runs.items():
        y = run()
        if systems > 1:
            y = jax.tree.map(lambda x: x[0], y)
        row = {
            "scene": label,
            "program": name,
            "package": f"{packages[name]} {importlib.metadata.version(packages[name])}",
            "systems": systems,
            "tolerance" if packages[name] == "scipy" else "steps": setting,
            "error": results.digits(scene.error(y)),
            "seconds": results.spread(spent[name, setting] / systems),
        }
        if scene.distance is not None:
            row["distance"] = results.digits(scene.distance(y))
        if chosen[name] == setting:
            row |= {"to": scene.target, "over cfjax": results.ratios(spent[name, setting], best)}
        yield row


# A colour for each package, a marker for each of its programs.
COLORS = {
    "cfjax": "#0072B2",
    "diffrax": "#D55E00",
    "jaxlie": "#009E73",
    "exponax": "#E69F00",
    "scipy": "#CC79A7",
}
MARKERS = "os^vDPX*<>hp"


def draw() -> dict[str, Figure]:
    rows = results.pick(results.load("peers")["rows"], systems=1)
    figure = _style.new_figure((11, 5.5))
    panels = dict(zip(SCENES, figure.subplots(1, len(SCENES)), strict=True))
    for package, color in COLORS.items():
        package_rows = [row for row in rows if row["package"].startswith(package)]
        names = dict.fromkeys(row["program"] for row in package_rows)
        for name, marker in zip(names, MARKERS[: len(names)], strict=True):
            for scene, axes in panels.items():
                curve = results.pick(package_rows, program=name, scene=scene)
                curve = sorted(curve, key=lambda row: -row["error"])
                # The fastest run, which other programs of the machine disturb least.
                times = [row["seconds"][0] for row in curve]
                # The first panel has them all in the legend, with or without a curve.
                label = name if axes is figure.axes[0] else None
                style = dict(color=color, marker=marker, markersize=4.5, linewidth=1)
                axes.plot(times, [row["error"] for row in curve], label=label, **style)
    for scene, axes in panels.items():
        axes.set(title=scene, yscale="log")
        _style.logarithmic(axes, "time", unit="s")
    figure.axes[0].set(ylabel="error at the end")
    _style.finish(figure, columns=4)
    return {"peers": figure}


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
