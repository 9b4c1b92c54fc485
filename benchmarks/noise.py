"""Noise: errors on a path and in the mean, steps that are too large, and costs.

A unit vector turns with random angular velocities. The methods of cfjax turn it. Those of diffrax
step in plain space, with and without a projection to the sphere after each step. The Brownian paths
are made on a fine grid, so that every method with every step sees the same path. Errors in the mean
need no random numbers: the mean of a step is a matrix on Legendre polynomials. `LieEuler`, which
takes noise in the sense of Itô, is compared with the solution in that sense.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax import lax
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

import cfjax
import results
from cfjax._measure import style as _style
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import spins


class Projected(diffrax.AbstractWrappedSolver):
    """A solver in plain space that goes to the nearest point of the sphere after each step."""

    solver: Any
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation

    @property
    def term_structure(self):
        return self.solver.term_structure

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1, *remainder = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        return y1 / jnp.linalg.norm(y1), *remainder

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


ON_SPHERE: dict[str, Any] = {
    "LieEuler": cfjax.LieEuler(),
    "CF2": cfjax.CF2(),
    "CF4": cfjax.CF4(),
    "WeakOrder2": cfjax.WeakOrder2(),
    "ShiftedNoise": cfjax.ShiftedNoise(),
}
IN_SPACE: dict[str, Any] = {
    "EulerHeun": diffrax.EulerHeun(),
    "Heun": diffrax.Heun(),
    "SPaRK": diffrax.SPaRK(),
}
PROJECTED = {f"{name}, projected": Projected(solver) for name, solver in IN_SPACE.items()}
SOLVERS = ON_SPHERE | IN_SPACE | PROJECTED
# Solvers that use the space-time area of the path.
WITH_AREA = ("WeakOrder2", "ShiftedNoise", "SPaRK", "SPaRK, projected")
BLOCK = 8  # steps of a loop, in a program for any number of them


class Equation(NamedTuple):
    """y' = w x y, where w is the first row of `turns(y)` and noise times each of the others."""

    channels: int
    turns: Callable[[Array], Array]

    def terms(self, name: str, path: diffrax.AbstractPath) -> diffrax.MultiTerm:
        """As the method of that name takes them."""
        if name in ON_SPHERE:
            return diffrax.MultiTerm(
                cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(self.turns(y)[0])),
                cfjax.LieControlTerm(
                    lambda t, y, args, dw: cfjax.Rotation(dw @ self.turns(y)[1:]), path
                ),
            )
        return diffrax.MultiTerm(
            diffrax.ODETerm(lambda t, y, args: jnp.cross(self.turns(y)[0], y)),
            diffrax.ControlTerm(lambda t, y, args: jnp.cross(self.turns(y)[1:], y).T, path),
        )

    def from_ito(self) -> "Equation":
        """The equation whose solution is that of this one in the sense of Itô."""

        def turns(y: Array) -> Array:
            drift, *noise = self.turns(y)
            for k, turn in enumerate(noise, 1):
                along = jnp.cross(turn, y)
                drift -= jax.jvp(lambda y: self.turns(y)[k], (y,), (along,))[1] / 2  # noqa: B023
            return jnp.stack([drift, *noise])

        return Equation(self.channels, turns)


class Grid(diffrax.AbstractBrownianPath):
    """Brownian motion from 0 to 1 with its exact areas between times on a grid."""

    values: Float[Array, "times channels"]
    integrals: Float[Array, "times channels"]
    levy_area: ClassVar[Any] = diffrax.SpaceTimeLevyArea

    @classmethod
    def draw(cls, key: Any, intervals: int, channels: int) -> "Grid":
        h = 1 / intervals
        w, area = np.sqrt([[[h]], [[h / 12]]]) * jax.random.normal(key, (2, intervals, channels))
        before = jnp.zeros((1, channels))
        values = jnp.concatenate([before, jnp.cumsum(w, axis=0)])
        integrals = jnp.cumsum(h * (values[:-1] + w / 2 + area), axis=0)
        return cls(values, jnp.concatenate([before, integrals]))

    @property
    def t0(self):
        return 0.0

    @property
    def t1(self):
        return 1.0

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True, use_levy: bool = False) -> Any:
        at_t0, at_t1 = self._at(t0), self._at(t1)
        w = at_t1[0] - at_t0[0]
        if not use_levy:
            return w
        h = t1 - t0
        area = (at_t1[1] - at_t0[1]) / h - at_t0[0] - w / 2
        return diffrax.SpaceTimeLevyArea(dt=h, W=w, H=area)

    def _at(self, t: Any) -> tuple[Array, Array]:
        k = jnp.round(t * (len(self.values) - 1)).astype(int)
        return self.values[k], self.integrals[k]


class OneStepPath(diffrax.AbstractBrownianPath):
    """A path for one step, with this increment and this area."""

    w: Float[Array, " channels"]
    area: Float[Array, " channels"]
    levy_area: ClassVar[Any] = diffrax.SpaceTimeLevyArea

    @property
    def t0(self):
        return 0.0

    @property
    def t1(self):
        return jnp.inf

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True, use_levy: bool = False) -> Any:
        if not use_levy:
            return self.w
        return diffrax.SpaceTimeLevyArea(dt=t1 - t0, W=self.w, H=self.area)


def measure(quick: bool) -> Iterator[results.Row]:
    for noise, equation in STRONG.items():
        yield from strong(noise, equation, quick)
    yield from weak()
    for problem, equation in (STRONG | {IN_THE_MEAN: AXISYMMETRIC}).items():
        yield from times_of_steps(problem, equation, quick)
    yield from too_large(quick)
    yield from cost(quick)
    yield from gradients(quick)


def unsafe(name: str, shape: tuple[int, ...], key: Any) -> diffrax.UnsafeBrownianPath:
    area = diffrax.SpaceTimeLevyArea if name in WITH_AREA else diffrax.BrownianIncrement
    return diffrax.UnsafeBrownianPath(shape, key, levy_area=area)


def states(name: str, terms: Any, t0: Any, t1: Any, y0: Any, steps: int) -> Array:
    """The states after each step. A state that overflows is not finite, and no error."""
    sol = cfjax.integrate(
        terms, SOLVERS[name], t0, t1, y0, num_steps=steps, save_every=1, throw=False
    )
    return jnp.asarray(sol.ys)


# On the path: errors at t = 1.

RNG = np.random.default_rng(0)
CONSTANT, LINEAR = 0.6 * RNG.normal(size=(3, 3)), 0.3 * RNG.normal(size=(3, 3, 3))
# A single channel commutes with itself.
STRONG = {
    noise: Equation(channels, lambda y, n=channels + 1: jnp.asarray(CONSTANT + LINEAR @ y)[:n])
    for channels, noise in ((2, "two channels"), (1, "one channel"))
}
Y0 = np.array([0.48, 0.6, 0.64])


def strong(noise: str, equation: Equation, quick: bool) -> Iterator[results.Row]:
    paths, intervals = (100, 2**11) if quick else (500, 2**13)
    counts = (8, 32, 128) if quick else (8, 16, 32, 64, 128, 256)
    keys = jax.random.split(jax.random.key(1), paths)
    grids = jax.vmap(lambda key: Grid.draw(key, intervals, equation.channels))(keys)
    # A reference that reads the increments alone would share the error of the methods that do.
    exact = ends("ShiftedNoise", equation)(grids, intervals)
    ito = ends("ShiftedNoise", equation.from_ito())(grids, intervals)
    for name in SOLVERS:
        program = ends(name, equation)
        for count in counts:
            y = program(grids, count)
            distance = jnp.linalg.norm(y - (ito if name == "LieEuler" else exact), axis=1)
            off = jnp.abs(jnp.linalg.norm(y, axis=1) - 1)
            yield {
                "problem": noise,
                "method": name,
                "steps": count,
                "error": results.digits(root_mean_square(distance)),
                "off the sphere": results.digits(root_mean_square(off)),
            }


def ends(name: str, equation: Equation) -> Callable[[Grid, int], Array]:
    """The program for the states at t = 1 on many paths, after any number of steps."""

    def solve_path(path: Grid, count: Any) -> Array:
        terms, h = equation.terms(name, path), BLOCK / count

        def block(k: Any, y: Array) -> Array:
            return states(name, terms, k * h, (k + 1) * h, y, BLOCK)[-1]

        return lax.fori_loop(0, count // BLOCK, block, jnp.asarray(Y0))

    return jax.jit(jax.vmap(solve_path, in_axes=(0, None)))


def root_mean_square(values: Array) -> Array:
    return jnp.sqrt(jnp.mean(values**2))


# In the mean: of the height z at t = 2.

IN_THE_MEAN = "in the mean"
END, DRIFT, STRENGTH = 2.0, 0.5, 0.8
DEGREE, NODES = 24, 10  # more of either change no digit that is shown
Z, WEIGHTS = np.polynomial.legendre.leggauss(DEGREE + 1)
# A row for each polynomial: products with it, over its square.
PROJECTION = (np.arange(DEGREE + 1) + 0.5)[:, None] * (
    WEIGHTS * np.polynomial.legendre.legvander(Z, DEGREE).T
)


def strength(z: Any) -> Any:
    """The strength of the noise, which depends on the state."""
    return STRENGTH * (1 + z / 2)


def axisymmetric_turns(y: Array) -> Array:
    x_axis, y_axis, z_axis = jnp.eye(3)
    noise = strength(y[2])
    return jnp.stack([z_axis + DRIFT * jnp.cross(y, z_axis), noise * x_axis, noise * y_axis])


AXISYMMETRIC = Equation(2, axisymmetric_turns)


def weak() -> Iterator[results.Row]:
    for name in ON_SPHERE | PROJECTED:
        exact = expected_height(scipy.linalg.expm(END * generator(is_ito=name == "LieEuler")))
        program = mean_of_step(name)
        for count in (4, 8, 16, 32, 64):
            matrix = PROJECTION @ np.asarray(program(END / count))
            error = expected_height(np.linalg.matrix_power(matrix, count)) - exact
            # Over all starts on the sphere.
            mean = np.sqrt(WEIGHTS @ error**2 / 2)
            yield {
                "problem": IN_THE_MEAN,
                "method": name,
                "steps": count,
                "error": results.digits(mean),
            }


def expected_height(matrix: np.ndarray) -> np.ndarray:
    """The mean of z at the end, for the starts Z."""
    return np.polynomial.legendre.legvander(Z, DEGREE) @ matrix[:, 1]


def mean_of_step(name: str) -> Callable[[Any], Array]:
    """The mean of each Legendre polynomial after a step from each of the heights Z."""
    # Two increments and two areas, by the Gauss-Hermite rule.
    counts = [NODES] * 4 if name in WITH_AREA else [2 * NODES] * 2 + [1] * 2
    rules = [np.polynomial.hermite_e.hermegauss(n) for n in counts]
    nodes, weights = (
        np.stack([x.ravel() for x in np.meshgrid(*rule_axes, indexing="ij")])
        for rule_axes in zip(*rules, strict=True)
    )
    weight = weights.prod(axis=0) / np.sqrt(2 * np.pi) ** 4
    initial = np.stack([np.sqrt(1 - Z**2), np.zeros_like(Z), Z], axis=1)

    def program(h: Any) -> Array:
        def step(y: Array, w: Any, area: Any) -> Array:
            path = OneStepPath(jnp.sqrt(h) * w, jnp.sqrt(h / 12) * area)
            return states(name, AXISYMMETRIC.terms(name, path), 0.0, h, y, 1)[-1]

        def mean(y: Array) -> Array:
            z = jax.vmap(step, in_axes=(None, 1, 1))(y, nodes[:2], nodes[2:])[:, 2]
            return weight @ legendre(z)

        return lax.map(mean, initial)

    return jax.jit(program)


def legendre(z: Array) -> Array:
    """All polynomials, one in a column."""
    polynomials = [jnp.ones_like(z), z]
    for n in range(1, DEGREE):
        polynomials.append(((2 * n + 1) * z * polynomials[n] - n * polynomials[n - 1]) / (n + 1))
    return jnp.stack(polynomials, axis=1)


def generator(*, is_ito: bool) -> np.ndarray:
    """The generator of the heights of the equation, as a matrix on Legendre polynomials."""
    polynomial = np.polynomial.Polynomial
    columns, g, round_z = [], strength(polynomial([0, 1])), polynomial([1, 0, -1])
    for n in range(DEGREE + 1):
        slope = np.polynomial.Legendre.basis(n).convert(kind=polynomial).deriv()
        noise = g * g * (round_z * slope).deriv() if is_ito else g * (round_z * g * slope).deriv()
        columns.append((noise / 2 + DRIFT * round_z * slope)(Z))
    return PROJECTION @ np.stack(columns, axis=1)


# The cost of a step in a batch.

SYSTEMS, TIMED_STEPS = 1000, 32


def times_of_steps(problem: str, equation: Equation, quick: bool) -> Iterator[results.Row]:
    runs = {name: results.compiled(batch(name, equation)) for name in SOLVERS}
    times = results.in_turns(runs, repeats=5 if quick else 50)
    for name, values in times.items():
        yield {
            "problem": problem,
            "method": name,
            "systems": SYSTEMS,
            "seconds a step": results.spread(values / (SYSTEMS * TIMED_STEPS)),
            "over CF2": results.ratios(values, times["CF2"]),
        }


def batch(name: str, equation: Equation) -> Callable[[], Array]:
    def solve_path(key: Any) -> Array:
        terms = equation.terms(name, unsafe(name, (equation.channels,), key))
        sol = cfjax.integrate(terms, SOLVERS[name], 0.0, 1.0, Y0, num_steps=TIMED_STEPS)
        return jnp.asarray(sol.ys)[-1]

    return lambda: jax.vmap(solve_path)(jax.random.split(jax.random.key(2), SYSTEMS))


# Steps that are too large: a spin at a temperature, whose mean is known.

TOO_LARGE = "steps too large"
FIELD, TEMPERATURE, DAMPING = 1.0, 0.25, 0.5
MEAN = 1 / np.tanh(FIELD / TEMPERATURE) - TEMPERATURE / FIELD


def spin_turns(y: Array) -> Array:
    axes = jnp.eye(3)
    noise = np.sqrt(2 * DAMPING * TEMPERATURE) * axes
    rates = jnp.concatenate([FIELD * axes[2:], noise])
    return (rates + DAMPING * jnp.cross(y, rates)) / (1 + DAMPING**2)


SPIN = Equation(3, spin_turns)


def too_large(quick: bool) -> Iterator[results.Row]:
    copies, duration = (500, 20.0) if quick else (4000, 100.0)
    keys = jax.random.split(jax.random.key(3), copies)
    for name in SOLVERS:
        program = equilibrium(name)
        for h in np.geomspace(0.02, 50, 8 if quick else 15):
            # Some time is for forgetting the start.
            forget, keep = (max(4, round(x / (BLOCK * h))) for x in (10.0, duration))
            heights, off = (np.asarray(x) for x in program(keys, h, forget, keep))
            yield {
                "problem": TOO_LARGE,
                "method": name,
                "step": results.digits(h),
                "mean": results.digits(np.mean(heights)),
                "standard error": results.digits(np.std(heights) / np.sqrt(copies)),
                "off the sphere": results.digits(np.sqrt(np.mean(off**2))),
            }


def equilibrium(name: str) -> Callable[..., tuple[Array, Array]]:
    """The mean height of each copy of the spin, and its distance from the sphere at the end."""

    def simulate(key: Any, h: Any, forget: Any, keep: Any) -> tuple[Array, Array]:
        def block(k: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            y, mean = carry
            path = unsafe(name, (3,), jax.random.fold_in(key, k))
            ys = states(name, SPIN.terms(name, path), 0.0, BLOCK * h, y, BLOCK)
            return ys[-1], mean + jnp.where(k < forget, 0, jnp.mean(ys[:, 2]) / keep)

        initial = jnp.asarray(Y0), jnp.zeros(())
        y, mean = lax.fori_loop(0, forget + keep, block, initial)
        return mean, jnp.abs(jnp.linalg.norm(y) - 1)

    return jax.jit(jax.vmap(simulate, in_axes=(0, None, None, None)))


# The cost of a step: one spin, and a ring of many.

SPINS = (1, 4096)
MAGNET = spins.Magnet()
BASE = "CF4, no noise"
PATHS = {
    "increments alone": diffrax.BrownianIncrement,
    "increments and areas alone": diffrax.SpaceTimeLevyArea,
}
OF_TREE = ("CF2", "WeakOrder2")


def thermal(t: Any, y: Array, args: spins.Magnet, dw: Array) -> cfjax.Rotation:
    noise = jnp.sqrt(2 * args.damping * TEMPERATURE) * dw
    return cfjax.Rotation((noise + args.damping * jnp.cross(y, noise)) / (1 + args.damping**2))


def cost(quick: bool) -> Iterator[results.Row]:
    for count in SPINS:
        steps = 2000 if count == 1 else 20
        programs = {BASE: of_spins(count, steps, "CF4", None)}
        programs |= {name: of_spins(count, steps, name, unsafe) for name in ON_SPHERE}
        programs |= {f"{name}, tree": of_spins(count, steps, name, tree) for name in OF_TREE}
        programs |= {name: numbers_alone(count, steps, area) for name, area in PATHS.items()}
        compiling, runs = [], ()
        for _ in range(1 if quick else 5):
            runs, seconds = zip(*(timed_compile(make()) for make in programs.values()), strict=True)
            compiling.append(seconds)
        running = take_turns(runs, repeats=5 if quick else 25)
        times = dict(zip(programs, zip(running, np.transpose(compiling), strict=True), strict=True))
        for name, (run, to_compile) in times.items():
            yield {
                "spins": count,
                "program": name,
                "seconds a step": results.spread(run / steps),
                f"over {BASE}": results.ratios(run, times[BASE][0]),
                "CPU seconds to compile": results.spread(to_compile),
                f"to compile, over {BASE}": results.ratios(to_compile, times[BASE][1]),
            }


def tree(name: str, shape: tuple[int, ...], key: Any) -> diffrax.VirtualBrownianTree:
    area = diffrax.SpaceTimeLevyArea if name in WITH_AREA else diffrax.BrownianIncrement
    return diffrax.VirtualBrownianTree(0.0, 1.0, 2.0**-12, shape, key, levy_area=area)


def of_spins(count: int, steps: int, name: str, path: Any) -> Callable[[], Callable[[], Array]]:
    """A function that makes the program of so many steps of a method."""
    y0 = jnp.asarray(spins.y0(count)[0] if count == 1 else spins.y0(count))

    def make() -> Callable[[], Array]:
        def program() -> Array:
            terms: Any = cfjax.LieTerm(spins.field)
            if path is not None:
                noise = path(name, y0.shape, jax.random.key(4))
                terms = diffrax.MultiTerm(terms, cfjax.LieControlTerm(thermal, noise))
            sol = cfjax.integrate(terms, SOLVERS[name], 0.0, 1.0, y0, MAGNET, num_steps=steps)
            return jnp.asarray(sol.ys)

        return program

    return make


def numbers_alone(count: int, steps: int, area: Any) -> Callable[[], Callable[[], Array]]:
    """The sums of the random numbers that the steps draw."""
    shape = (3,) if count == 1 else (count, 3)

    def make() -> Callable[[], Array]:
        def program() -> Array:
            path = diffrax.UnsafeBrownianPath(shape, jax.random.key(4), levy_area=area)

            def add(k: Any, total: Any) -> Any:
                drawn = path.evaluate(k / steps, (k + 1) / steps, use_levy=True)
                return jax.tree.map(jnp.add, total, drawn)

            zeros = jax.tree.map(jnp.zeros_like, path.evaluate(0.0, 1.0, use_levy=True))
            return lax.fori_loop(0, steps, add, zeros)

        return program

    return make


def timed_compile(program: Callable[[], Array]) -> tuple[Callable[[], Array], float]:
    """The program, compiled and warm, and the seconds of the processor that this took."""
    begin = time.process_time()
    executable = jax.jit(program).lower().compile()
    seconds = time.process_time() - begin
    jax.block_until_ready(executable())
    return executable, seconds


# The cost of a gradient, with a checkpoint at every step or at every few steps.

GRADIENT_SPINS = 256


def gradients(quick: bool) -> Iterator[results.Row]:
    y0 = jnp.asarray(spins.y0(GRADIENT_SPINS))
    for steps in (200, 2000):
        groups = {None: "every step", round(np.sqrt(steps) / 5) * 5: "every {} steps"}
        programs = {"": jax.jit(loss(steps, None)).lower(y0).compile()}
        for interval, label in groups.items():
            gradient = jax.jit(jax.grad(loss(steps, interval)))
            programs[label.format(interval)] = gradient.lower(y0).compile()
        runs = [lambda program=program: program(y0) for program in programs.values()]
        for run in runs:
            jax.block_until_ready(run())
        seconds = take_turns(runs, repeats=3 if quick else 15)
        for (label, program), values in zip(programs.items(), seconds, strict=True):
            plan = program.memory_analysis()
            assert plan is not None
            if label:
                yield {
                    "gradient of steps": steps,
                    "keeps a state": label,
                    "MiB": results.digits(plan.temp_size_in_bytes / 2**20),
                    "seconds": results.spread(values),
                    "over the solve": results.ratios(values, seconds[0]),
                }


def loss(steps: int, interval: int | None) -> Callable[[Array], Array]:
    def height(y0: Array) -> Array:
        noise = unsafe("CF2", y0.shape, jax.random.key(5))
        terms = diffrax.MultiTerm(cfjax.LieTerm(spins.field), cfjax.LieControlTerm(thermal, noise))
        sol = cfjax.integrate(
            terms, cfjax.CF2(), 0.0, 1.0, y0, MAGNET, num_steps=steps, checkpoint_every=interval
        )
        return jnp.mean(jnp.asarray(sol.ys)[-1, :, 2])

    return height


# The picture.

STYLES: dict[str, dict[str, Any]] = {
    "LieEuler": dict(color="#CC79A7", linestyle="-", marker="v"),
    "CF2": dict(color="#56B4E9", linestyle="-", marker="s"),
    "CF4": dict(color="#0072B2", linestyle="-", marker="o"),
    "WeakOrder2": dict(color="#D55E00", linestyle="-", marker="D"),
    "ShiftedNoise": dict(color="#009E73", linestyle="-", marker="^"),
    "EulerHeun": dict(color="#999999", linestyle="--", marker="v"),
    "Heun": dict(color="#000000", linestyle="--", marker="s"),
    "SPaRK": dict(color="#E69F00", linestyle="--", marker="P"),
}
# The same colour, with hollow markers.
STYLES |= {
    f"{name}, projected": STYLES[name] | dict(linestyle=":", markerfacecolor="white")
    for name in IN_SPACE
}


def draw() -> dict[str, Figure]:
    stored = results.load("noise")
    cores = stored["machine"]["cores"]
    figure = _style.new_figure(
        (10.5, 9.6),
        "Full lines: cfjax, on the sphere. Dashed: diffrax in plain space. Dotted: the same with a "
        "projection to the sphere after each step. Grey: orders. LieEuler is compared with the "
        "solution in the sense of Itô, all others with that in the sense of Stratonovich. Errors "
        "of a mean are an rms over all starts. Times "
        f"are those of a path in a batch of {SYSTEMS}, random numbers included, in float64 on "
        f"{cores} cores. Last panel: thin lines are distances from the sphere, "
        "and the grey area is twice the standard error; a line ends where a state overflows.",
    )
    panels = figure.subplots(2, 2)
    for axes, (problem, panel) in zip(panels.flat, PANELS.items(), strict=False):
        _errors(axes, results.pick(stored["rows"], problem=problem), panel)
    _too_large(panels[1, 1], results.pick(stored["rows"], problem=TOO_LARGE))
    for axes in panels.flat:
        axes.title.set_fontsize(10)
    _style.finish(figure, columns=4)
    return {"noise": figure}


ORDERS = {0.5: "1/2", 1: "1", 1.5: "3/2", 2: "2"}


class Panel(NamedTuple):
    """Lines of the orders begin at `origin`, in parts of the width and the height."""

    title: str
    error: str
    orders: tuple[float, ...]
    origin: tuple[float, float]
    bottom: float | None = None


PANELS = {
    "two channels": Panel(
        "General noise of two channels: all have order 1/2",
        "error of a path at t = 1 (rms)",
        (0.5,),
        (0.06, 0.4),
        bottom=7e-3,
    ),
    "one channel": Panel(
        "One channel, so that noise commutes:\nthe area gives ShiftedNoise order 3/2",
        "error of a path at t = 1 (rms)",
        (0.5, 1, 1.5),
        (0.62, 0.97),
    ),
    IN_THE_MEAN: Panel(
        "Error of the mean, without random numbers:\nWeakOrder2 has order 2",
        "error of the mean height at t = 2",
        (1, 2),
        (0.06, 0.45),
    ),
}


def _errors(axes: Axes, rows: list[results.Row], panel: Panel) -> None:
    for name, style in STYLES.items():
        points = [row for row in results.pick(rows, method=name) if "error" in row]
        if points:
            (timed,) = (row for row in results.pick(rows, method=name) if "systems" in row)
            seconds = [row["steps"] * timed["seconds a step"][2] for row in points]
            axes.plot(seconds, [row["error"] for row in points], markersize=5, **style)
    axes.set(yscale="log", title=panel.title, ylabel=panel.error)
    axes.set_ylim(bottom=panel.bottom)
    axes.yaxis.set_minor_formatter(NullFormatter())
    _style.logarithmic(axes, "time of a path", "s")
    (x_min, x_max), (y_min, y_max) = np.log([axes.get_xlim(), axes.get_ylim()])
    x0, y0 = x_min + panel.origin[0] * (x_max - x_min), y_min + panel.origin[1] * (y_max - y_min)
    for order in panel.orders:
        x1 = x0 + min(0.25 * (x_max - x_min), 0.25 * (y_max - y_min) / order)
        y1 = y0 - order * (x1 - x0)
        axes.plot(np.exp([x0, x1]), np.exp([y0, y1]), color="0.6", linewidth=1)
        axes.text(np.exp(x1), np.exp(y1), f" {ORDERS[order]}", color="0.4", fontsize=8, va="center")


def _too_large(axes: Axes, rows: list[results.Row]) -> None:
    for name, style in STYLES.items():
        points = results.pick(rows, method=name)
        keys = ("step", "mean", "standard error", "off the sphere")
        step, mean, uncertain, off = (np.array([row[k] for row in points], float) for k in keys)
        axes.loglog(step, np.abs(mean - MEAN), label=name, markersize=5, **style)
        if name == [*ON_SPHERE][-1]:
            # The methods of diffrax begin a column of the legend.
            axes.plot([], [], " ", label=" ")
        if name in IN_SPACE:
            axes.loglog(step, off, color=style["color"], linewidth=0.8)
        if name == "CF4":
            axes.fill_between(step, 1e-9, 2 * uncertain, color="0.9", linewidth=0)
    axes.set(
        title="Spin at a temperature: methods on the sphere stay there,\n"
        "but are wrong if a step is a large angle",
        xlabel="step h (about the angle of a step)",
        ylabel="error of the mean height in equilibrium",
        ylim=(2e-4, 3),
    )


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
