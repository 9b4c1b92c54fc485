"""Time to an error, beside the better of diffrax's Tsit5 and Dopri8 in plain space.

Each scene is solved in equal steps, as many as a method needs for the error: one system, its
gradient with respect to the start and the parameters, and many systems at once.
`cfjax.integrate` runs cfjax's methods, and `diffrax.diffeqsolve` diffrax's methods with the
velocities of the same fields, so the state leaves the manifold by their errors. The solution is
that of Dopri8 in plain space, with a hundredth of the step. All programs of a scene take turns.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import heavy_top

TARGETS = (1e-5, 1e-8)
REPEATS = 10  # of a program for one system in one turn
INERTIA = np.array([3.0, 2.0, 1.0])
BODY: dict[str, Any] = {"frame": "body", "layout": "wxyz"}
RNG = np.random.default_rng(0)


def rigid_body(t: Any, y: Any, inertia: Any) -> Any:
    return cfjax.Rotation(-y / inertia)


def spacecraft(t: Any, y: Any, inertia: Any) -> Any:
    omega = y["m"] / inertia
    return {"q": cfjax.QuaternionRotation(omega, **BODY), "m": cfjax.Rotation(-omega)}


def rate(t: Any, scale: Any) -> Any:
    return scale * jnp.stack([jnp.cos(2 * t), jnp.sin(3 * t), 1 + jnp.cos(t)])


def given_rate(t: Any, q: Any, scale: Any) -> Any:
    return cfjax.QuaternionRotation(rate(t, scale), **BODY)


def pose(t: Any, y: Any, scale: Any) -> Any:
    v = jnp.stack([jnp.cos(t), y[1], jnp.sin(t)])
    return cfjax.RigidMotion(
        omega=rate(t, scale) * (1 + y[4]), v=v, frame="body", layout="wxyz_xyz"
    )


def top(t: Any, y: Any, args: Any) -> Any:
    return heavy_top.field(t, y, heavy_top.Top(args, *heavy_top.benchmark[1:]))


def rotation(t: Any, y: Any, coupling: Any) -> Any:
    """Of four dimensions."""
    z = jnp.sin(t) * y + coupling @ y @ coupling
    return cfjax.LeftMatrix(z - z.T)


def link(t: Any, y: Any, coupling: Any) -> Any:
    z = jnp.cos(t) * y + coupling @ y @ coupling
    z = z - z.conj().T
    return cfjax.LeftMatrix(z - jnp.trace(z) / 3 * jnp.eye(3))


def lattice(t: Any, y: Any, coupling: Any) -> Any:
    """Spins of a ring in a field that turns."""
    drive = jnp.stack([jnp.cos(t), jnp.sin(t), jnp.ones_like(t)])
    return cfjax.Rotation(coupling * (jnp.roll(y, 1, 0) + jnp.roll(y, -1, 0)) + drive)


def oja(t: Any, y: Any, spectrum: Any) -> Any:
    """The flow to the first principal components."""
    return cfjax.LowRankSkew(spectrum[:, None] * y)


class Scene(NamedTuple):
    field: Callable[[Any, Any, Any], Any]
    y0: Any
    args: Any
    t1: float
    # Beside `Projected`, `CF4` and `CF54`.
    methods: dict[str, Any]
    # Of the batch; None where one system is large.
    systems: int | None = 1000


MUNTHE_KAAS = {"RKMK8": cfjax.RKMK8()}
CAYLEY = {"RKMK8, Cayley": cfjax.RKMK8(coordinates="cayley")}
_COLUMNS = np.linalg.qr(RNG.normal(size=(100, 5)))[0]
_LINK = np.linalg.qr(RNG.normal(size=(3, 3)) + 1j * RNG.normal(size=(3, 3)))[0]
_SPINS = RNG.normal(size=(256, 3))
SCENES = {
    "rigid body": Scene(
        rigid_body, np.array([8, 4, 1]) / 9, np.array([7 / 8, 5 / 8, 1 / 4]), 20.0, MUNTHE_KAAS
    ),
    "spacecraft": Scene(
        spacecraft,
        {"q": np.array([1.0, 0, 0, 0]), "m": np.array([1.0, 2.0, 0.5])},
        INERTIA,
        20.0,
        MUNTHE_KAAS,
    ),
    "given rate": Scene(
        given_rate,
        np.array([1.0, 0, 0, 0]),
        np.ones(3),
        20.0,
        MUNTHE_KAAS | {"Magnus6": cfjax.Magnus6()},
    ),
    "pose": Scene(pose, np.array([1.0, 0, 0, 0, 0.1, 0.2, 0.3]), np.ones(3), 10.0, MUNTHE_KAAS),
    "heavy top": Scene(top, heavy_top.y0(), np.array(15.0), 0.2, MUNTHE_KAAS),
    "SO(4)": Scene(rotation, np.eye(4), RNG.normal(size=(4, 4)) / 2, 3.0, CAYLEY),
    "SU(3)": Scene(
        link,
        _LINK / np.linalg.det(_LINK) ** (1 / 3),
        (RNG.normal(size=(3, 3)) + 1j * RNG.normal(size=(3, 3))) / 3,
        3.0,
        CAYLEY,
    ),
    "256 spins": Scene(
        lattice,
        _SPINS / np.linalg.norm(_SPINS, axis=1, keepdims=True),
        np.array(0.7),
        5.0,
        MUNTHE_KAAS,
        None,
    ),
    "Oja's flow": Scene(oja, _COLUMNS, np.linspace(0.0, 2.0, 100), 5.0, {}, None),
}
PLAIN: dict[str, Any] = {"diffrax, Tsit5": diffrax.Tsit5(), "diffrax, Dopri8": diffrax.Dopri8()}
METHODS: dict[str, Any] = {
    "Projected, Tsit5": cfjax.Projected(diffrax.Tsit5()),
    "Projected, Dopri8": cfjax.Projected(diffrax.Dopri8()),
    "CF4": cfjax.CF4(),
    "CF54": cfjax.CF54(),
}


def solve(scene: Scene, name: str, y0: Any, args: Any, num_steps: Any) -> Any:
    """The final state. If `num_steps` is traced, diffrax solves for every method."""
    solver = (PLAIN | METHODS | scene.methods)[name]
    is_plain, is_static = name in PLAIN, isinstance(num_steps, int)
    term = cfjax.LieTerm(scene.field)
    if is_plain:
        term = diffrax.ODETerm(lambda t, y, args: cfjax.tangent(scene.field(t, y, args), y))
    if is_plain or not is_static:
        # Rounding of the times may make a step more.
        max_steps = num_steps + 1 if is_static else None
        step = scene.t1 / num_steps
        sol = diffrax.diffeqsolve(
            term, solver, 0.0, scene.t1, step, y0, args, max_steps=max_steps, throw=False
        )
    else:
        sol = cfjax.integrate(
            term, solver, 0.0, scene.t1, y0, args, num_steps=num_steps, throw=False
        )
    return jax.tree.map(lambda y: y[-1], sol.ys)


def steps_to(scene: Scene, name: str, exact: np.ndarray) -> dict[float, tuple[int, float]]:
    """For each target a number of equal steps that suffices, and their error, where a twentieth
    fewer do not.
    """
    y0, args = arrays(scene)
    # One program for all numbers of steps.
    program = jax.jit(lambda n: solve(scene, name, y0, args, n))
    found = {}
    n = 2
    for target in TARGETS:
        most_failing, fewest = n, (0, np.inf)
        while not fewest[0] or fewest[0] > max(most_failing + 1, 1.05 * most_failing):
            n = 2 * most_failing
            if fewest[0]:
                n = max(most_failing + 1, round(np.sqrt(most_failing * fewest[0])))
            error = float(np.abs(flat(program(jnp.asarray(n))) - exact).max())
            if error <= target:
                fewest = n, error
            else:
                most_failing = n
        found[target] = fewest
        n = most_failing
    return found


def arrays(scene: Scene) -> tuple[Any, Any]:
    return jax.tree.map(jnp.asarray, (scene.y0, scene.args))


def flat(y: Any) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(x)) for x in jax.tree.leaves(y)])


def measure(quick: bool, only: tuple[str, ...] = ()) -> Iterator[results.Row]:
    for label, scene in SCENES.items():
        if not only or label in only:
            yield from of_scene(label, scene, quick)


def of_scene(label: str, scene: Scene, quick: bool) -> Iterator[results.Row]:
    y0, args = arrays(scene)
    name = "diffrax, Dopri8"
    few = steps_to(scene, name, flat(solve(scene, name, y0, args, 4000)))[TARGETS[-1]][0]
    exact = flat(solve(scene, name, y0, args, 100 * few))
    names = [*PLAIN, *METHODS, *scene.methods]
    fewest = {name: steps_to(scene, name, exact) for name in names}
    for target in TARGETS:
        kinds: dict[str, list[Any]] = {}
        for name in names:
            for kind, run in programs(scene, name, fewest[name][target][0]):
                if kind == "one" or target == TARGETS[-1]:
                    kinds.setdefault(kind, []).append(run())
        for kind, runs in kinds.items():
            is_one = kind in ("one", "gradient")
            rounds = (3 if quick else 25) if is_one else (1 if quick else 7)
            seconds = take_turns(runs, repeats=rounds, budget=60) / (REPEATS if is_one else 1)
            best = seconds[int(np.argmin(np.median(seconds[: len(PLAIN)], axis=-1)))]
            for name, times in zip(names, seconds, strict=True):
                num_steps, error = fewest[name][target]
                yield {
                    "scene": label,
                    "to": target,
                    "method": name,
                    "kind": kind,
                    "steps": num_steps,
                    "error": results.digits(error),
                    "seconds": results.spread(times),
                    "over the better in plain space": results.ratios(times, best),
                }


def programs(
    scene: Scene, name: str, num_steps: int
) -> Iterator[tuple[str, Callable[[], Callable[[], Any]]]]:
    """The name of each program, and a function that compiles it."""
    y0, args = arrays(scene)

    def end(y0: Any, args: Any) -> Any:
        return solve(scene, name, y0, args, num_steps)

    def value(y0: Any, args: Any) -> Any:
        return sum(jnp.sum(jnp.sin(jnp.real(x))) for x in jax.tree.leaves(end(y0, args)))

    gradient = jax.grad(value, argnums=(0, 1))
    yield "one", lambda: results.compiled(end, y0, args, repeats=REPEATS)
    yield "gradient", lambda: results.compiled(gradient, y0, args, repeats=REPEATS)
    if scene.systems is not None:
        size = scene.systems
        many = jax.tree.map(lambda y: jnp.broadcast_to(y, (size, *y.shape)), y0)
        batch = jax.vmap(end, in_axes=(0, None))
        yield "many", lambda: results.compiled(batch, many, args)


if __name__ == "__main__":
    results.run(__file__, __doc__, measure, SCENES, key="scene")
