"""Energy over more than a million steps, of methods that evaluate the field equally often.

Five systems: a heavy top, spins, vortices, a fluid and a lattice of spins. A splitting has the
exact flow of each term; a fluid has no such terms. Each method has steps so long that the
evaluations in a unit of time are equally many. An evaluation of a part of the spins or vortices
counts as that part of one, and one of the top is one of its torque. Evaluations of the implicit
method are counted while it runs.

The energy drifts if the line of least squares rises or falls by more than the energy scatters about
it. Then the steps that are too large: for an oscillator, from the matrix of a step, and for the
top.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import cfjax
import results
from cfjax._measure import style as _style
from cfjax.scenes import hmc, zeitlin

Part = Callable[[PyTree], PyTree]

# Pairs of stages, as each has one evaluation of the first term.
SPLITTINGS: dict[str, Any] = {
    "Strang": (cfjax.Strang(), 1),
    "BlanesMoan4": (cfjax.BlanesMoan4(), 6),
    "BlanesMoan6": (cfjax.BlanesMoan6(), 10),
}
IMPLICIT: dict[str, Any] = {"ImplicitMidpoint": cfjax.ImplicitMidpoint()}
# With evaluations a step.
OTHERS: dict[str, Any] = {
    "CF4": (cfjax.CF4(), 4),
    "CF54": (cfjax.CF54(), 7),
    "CFEES27": (cfjax.CFEES27(), 4),
    "RKMK8": (cfjax.RKMK8(), 13),
    "Tsit5": (diffrax.Tsit5(), 6),
}
SYMPLECTIC = (*SPLITTINGS, *IMPLICIT)
SAVES = 1000


class System(NamedTuple):
    """A Hamiltonian system, with frozen fields of terms where it splits."""

    y0: PyTree
    energy: Callable[[PyTree], Array]
    field: Part
    # Evaluations in a unit of time, and the time of the last.
    rate: float
    t1: float
    terms: tuple[Part, ...] = ()
    # How much of an evaluation each of the terms takes.
    shares: tuple[float, ...] = ()


class Run(NamedTuple):
    """The energy, less the first one, at equal distances of time."""

    t: Float[np.ndarray, " times"]
    error: Float[np.ndarray, " times"]
    step: float
    steps: int


def measure(quick: bool) -> Iterator[results.Row]:
    for name in SYSTEMS:
        yield from equal_evaluations(name, quick)
    yield from top_with_large_steps(quick)
    yield from oscillator()


def equal_evaluations(name: str, quick: bool) -> Iterator[results.Row]:
    system, runs = SYSTEMS[name](), {}
    shorter = 50 if quick else 1
    for method in of_system(system):
        program = Program(system, method)
        runs[method] = program.run(system.rate, system.t1 / shorter)
        yield row(name, method, system.rate, runs[method]) | curve(runs[method])
        if name == "lattice" and method == "Strang":
            # A step of one unit of time, with one evaluation.
            long = program.run(1.0, 1e6 / shorter)
            yield row(name, method, 1.0, long) | curve(long)
    yield from break_even(name, system.rate, runs)


def of_system(system: System) -> tuple[str, ...]:
    return (*(SPLITTINGS if system.terms else IMPLICIT), *OTHERS)


class Program:
    """A compiled program for a method, with steps of any length."""

    def __init__(self, system: System, method: str):
        self.system = system
        field = cfjax.LieTerm(lambda t, y, args: system.field(y))
        term: Any = field
        if method in SPLITTINGS:
            solver, pairs = SPLITTINGS[method]
            term = terms_of(system)
            first_share, *middle_shares, last_share = system.shares
            cost = pairs * (first_share + 2 * sum(middle_shares) + last_share)
        elif method in IMPLICIT:
            solver = IMPLICIT[method]
            cost = evaluations(system, solver)
        else:
            solver, cost = OTHERS[method]
            if method == "Tsit5":
                term = diffrax.ODETerm(lambda t, y, args: cfjax.tangent(system.field(y), y))
        self.cost = cost
        # Energies at about every unit of time, and a thousand of them from a call.
        self.every = max(1, round(system.rate / cost))

        def piece(y: PyTree, step: Array) -> tuple[PyTree, Array]:
            count = SAVES * self.every
            options: Any = dict(num_steps=count, save_every=self.every, throw=False)
            ys = cfjax.integrate(term, solver, 0.0, count * step, y, **options).ys
            return jax.tree.map(lambda x: x[-1], ys), jax.vmap(system.energy)(ys)

        self.piece = jax.jit(piece)

    def run(self, rate: float, t1: float) -> Run:
        step = self.cost / rate
        energies, y = [], jax.tree.map(jnp.asarray, self.system.y0)
        for _ in range(math.ceil(t1 / (SAVES * self.every * step))):
            y, new = self.piece(y, jnp.asarray(step))
            energies.append(np.asarray(new))
        error = np.concatenate(energies) - float(self.system.energy(self.system.y0))
        t = step * self.every * np.arange(1, len(error) + 1)
        return Run(t, error, step, len(error) * self.every)


def terms_of(system: System) -> diffrax.MultiTerm:
    return diffrax.MultiTerm(
        *(cfjax.LieTerm(lambda t, y, args, term=term: term(y)) for term in system.terms)
    )


def evaluations(system: System, solver: Any) -> float:
    """In a step of an implicit method, as long as the rate of the system allows for that number."""
    count = 0

    def add() -> None:
        nonlocal count
        count += 1

    def field(t: Any, y: PyTree, args: Any) -> PyTree:
        jax.debug.callback(add)
        return system.field(y)

    steps, cost = 100, 10.0

    @jax.jit
    def program(t1: Array) -> PyTree:
        term = cfjax.LieTerm(field)
        options: Any = dict(num_steps=steps, throw=False)
        return cfjax.integrate(term, solver, 0.0, t1, system.y0, **options).ys

    for _ in range(4):
        count = 0
        jax.block_until_ready(program(jnp.asarray(steps * cost / system.rate)))
        jax.effects_barrier()
        cost = count / steps
    return cost


def row(name: str, method: str, rate: float, run: Run) -> results.Row:
    slope, scatter = trend(run.t, run.error)
    return {
        "system": name,
        "method": method,
        "evaluations a unit": rate,
        "step": results.digits(run.step),
        "steps": run.steps,
        "largest": results.digits(np.max(np.abs(run.error))),
        "slope": results.digits(slope),
        "scatter": results.digits(scatter),
        "drifts": drifts(run),
    }


def curve(run: Run) -> results.Row:
    """The largest error so far, at times in equal ratios."""
    largest = np.maximum.accumulate(np.abs(run.error))
    places = np.unique(np.geomspace(1, len(largest), 80).astype(int)) - 1
    return {
        "t": [results.digits(t) for t in run.t[places]],
        "largest so far": [results.digits(x) for x in largest[places]],
    }


def trend(t: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """The slope of the line of least squares, and the standard deviation from the line."""
    x, y = t - t.mean(), values - values.mean()
    slope = x @ y / (x @ x)
    return float(slope), float(np.std(y - slope * x))


def drifts(run: Run) -> bool:
    """Whether the line rises, or falls, by more than the energy scatters about it."""
    slope, scatter = trend(run.t, run.error)
    return bool(abs(slope) * (run.t[-1] - run.t[0]) > scatter)


def break_even(name: str, rate: float, runs: dict[str, Run]) -> Iterator[results.Row]:
    """When the error of each other method exceeds the largest error of the best symplectic one.

    If that is after the end, it is extrapolated along the slope of the energy.
    """
    bands = {m: np.max(np.abs(runs[m].error)) for m in SYMPLECTIC if m in runs}
    best = min(bands, key=lambda m: bands[m])
    for method in OTHERS:
        if method not in runs:
            continue
        run, after = runs[method], None
        # Errors that are not finite count as larger.
        larger = ~(np.abs(run.error) <= bands[best])
        t1 = run.t[-1]
        if np.any(larger):
            after = run.t[np.argmax(larger)]
        elif drifts(run):
            after = max(bands[best] / abs(trend(run.t, run.error)[0]), t1)
        yield {
            "system": name,
            "evaluations a unit": rate,
            "best": best,
            "other": method,
            "break-even": None if after is None else results.digits(after),
            "end": results.digits(t1),
        }


# Systems.


def top() -> System:
    """A heavy asymmetric top: attitude q, and momentum m in the body or in space."""
    inertia, center = jnp.asarray([1.0, 1.3, 2.0]), jnp.asarray([0.2, 0.3, 1.0])
    layout: Any = dict(layout="wxyz")
    body = lambda q, x: cfjax.quaternion_rotate(q * jnp.asarray([1.0, -1, -1, -1]), x, **layout)  # noqa: E731
    upwards = jnp.asarray([0.0, 0.0, 1.0])

    def kick(y: PyTree) -> PyTree:
        return {"q": None, "m": jnp.cross(body(y["q"], upwards), center)}

    def spin(axis: int) -> Part:
        def field(y: PyTree) -> PyTree:
            w = jnp.eye(3)[axis] * y["m"] / inertia
            q = cfjax.QuaternionRotation(w, frame="body", **layout)
            return {"q": q, "m": cfjax.Rotation(-w)}

        return field

    def field(y: PyTree) -> PyTree:
        w = y["m"] / inertia
        torque = jnp.cross(body(y["q"], upwards), center)
        q = cfjax.QuaternionRotation(w, frame="body", **layout)
        return {"q": q, "m": torque + jnp.cross(y["m"], w)}

    def energy(y: PyTree) -> Array:
        return jnp.sum(y["m"] ** 2 / inertia) / 2 + center @ body(y["q"], upwards)

    q = jnp.asarray([0.8, 0.6, 0.0, 0.0])
    y0 = {"q": q, "m": jnp.asarray([1.0, 0.5, 3.5])}
    terms = (kick, *map(spin, range(3)))
    return System(y0, energy, field, 40.0, 1e5, terms, (1.0, 0.0, 0.0, 0.0))


def directions(seed: int, *sides: int) -> Array:
    s = np.random.default_rng(seed).normal(size=(*sides, 3))
    return jnp.asarray(s / np.linalg.norm(s, axis=-1, keepdims=True))


def spins() -> System:
    """Six spins in a ring: neighbours, second neighbours, Dzyaloshinskii-Moriya, anisotropy.

    A term couples one component of each spin, which its own flow keeps: so the flow is symplectic.
    One colour of spins at a time has exact flows too, but is not: with anisotropy, which these
    flows do not keep, the energy then walks at random.
    """
    axes, applied = jnp.eye(3), jnp.asarray([[0.1, 0.0, 0.3]])
    nearest, next_nearest, chiral, anisotropy = 1.0, 0.4, 0.3, jnp.asarray([[0.0, 0.0, 0.5]])
    is_even = jnp.arange(6)[:, None] % 2 == 0

    def exchange(s: Array) -> Array:
        before, after = jnp.roll(s, 1, axis=0), jnp.roll(s, -1, axis=0)
        second = jnp.roll(before, 1, 0) + jnp.roll(after, -1, 0)
        return nearest * (before + after) + next_nearest * second

    def twist(s: Array) -> Array:
        return chiral * jnp.cross(jnp.roll(s, -1, axis=0) - jnp.roll(s, 1, axis=0), axes[2:])

    def along(axis: int) -> Part:
        unit = axes[axis : axis + 1]
        return lambda s: cfjax.Rotation(unit * (exchange(s) + anisotropy * s + applied))

    def twisted(even: int, odd: int) -> Part:
        """Couples component `even` of the even spins with component `odd` of the odd spins."""
        mask = jnp.where(is_even, axes[even : even + 1], axes[odd : odd + 1])
        return lambda s: cfjax.Rotation(mask * twist(s))

    def energy(s: Array) -> Array:
        return -jnp.sum(s * ((exchange(s) + twist(s) + anisotropy * s) / 2 + applied))

    return System(
        directions(0, 6),
        energy,
        lambda s: cfjax.Rotation(exchange(s) + twist(s) + anisotropy * s + applied),
        rate=80.0,
        t1=2e4,
        terms=(along(0), twisted(0, 1), along(1), twisted(1, 0), along(2)),
        # By the number of components of neighbours that they read.
        shares=(1 / 4, 1 / 8, 1 / 4, 1 / 8, 1 / 4),
    )


def vortices() -> System:
    """Six point vortices on the sphere, in five rounds of three pairs."""
    strength = (1.0, 0.8, 1.2, 0.9, 1.1, 1.0)
    # Round-robin: one stays, and the others move on.
    circles = [(0, *np.roll(range(1, 6), k).tolist()) for k in range(5)]
    rounds = [{i: circle[5 - n] for n, i in enumerate(circle)} for circle in circles]

    def velocity(x: tuple[Array, ...], i: int, k: int) -> Array:
        """Both of a pair turn about one axis, which stays where it is."""
        total = strength[i] * x[i] + strength[k] * x[k]
        return total / (4 * jnp.pi * (1 - x[i] @ x[k]))

    def pairs(partner: dict[int, int]) -> Part:
        return lambda x: tuple(cfjax.Rotation(velocity(x, i, partner[i])) for i in range(6))

    def field(x: tuple[Array, ...]) -> PyTree:
        sums = (sum(velocity(x, i, k) for k in range(6) if k != i) for i in range(6))
        return tuple(cfjax.Rotation(w) for w in sums)

    def energy(x: tuple[Array, ...]) -> Array:
        pair = lambda i, k: strength[i] * strength[k] * jnp.log(1 - x[i] @ x[k])  # noqa: E731
        total = sum(itertools.starmap(pair, itertools.combinations(range(6), 2)), jnp.zeros(()))
        return -total / (4 * jnp.pi)

    y0 = tuple(directions(5, 6))
    return System(y0, energy, field, 40.0, 5e4, tuple(map(pairs, rounds)), (1 / 5,) * 5)


def fluid() -> System:
    """Euler's equations on the sphere, as matrices of size 8."""
    inverse = jnp.asarray(zeitlin.inverse_laplacian(8))
    return System(
        jnp.asarray(zeitlin.y0(8)),
        lambda y: zeitlin.energy(y, inverse),
        lambda y: zeitlin.field(0.0, y, inverse),
        rate=60.0,
        t1=6.7e4,
    )


def lattice() -> System:
    """Heisenberg's model on 8 x 8 sites, in two colours; energy for each of the spins."""

    def neighbours(s: Array) -> Array:
        return sum((jnp.roll(s, k, axis) for axis in (0, 1) for k in (1, -1)), jnp.zeros_like(s))

    i, k = np.indices((8, 8))

    def colour(parity: int) -> Part:
        mask = jnp.asarray((i + k) % 2 == parity)[..., None]
        return lambda s: cfjax.Rotation(jnp.where(mask, neighbours(s), 0.0))

    return System(
        directions(0, 8, 8),
        lambda s: -jnp.sum(s * neighbours(s)) / 128,
        lambda s: cfjax.Rotation(neighbours(s)),
        rate=40.0,
        t1=2.6e4,
        terms=(colour(0), colour(1)),
        shares=(1 / 2, 1 / 2),
    )


SYSTEMS: dict[str, Callable[[], System]] = {
    "top": top,
    "spins": spins,
    "vortices": vortices,
    "fluid": fluid,
    "lattice": lattice,
}


# Steps that are too large.


def top_with_large_steps(quick: bool) -> Iterator[results.Row]:
    system, name, rates = top(), "top, large steps", (10.0, 20.0, 40.0, 80.0)
    runs: dict[float, dict[str, Run]] = {rate: {} for rate in rates}
    for method in (*SPLITTINGS, "CF4", "RKMK8"):
        program = Program(system, method)
        for rate in rates:
            runs[rate][method] = program.run(rate, 1e3 if quick else 1e4)
            yield row(name, method, rate, runs[rate][method])
    for rate in rates:
        yield from break_even(name, rate, runs[rate])


OSCILLATOR: dict[str, Any] = SPLITTINGS | {
    "Omelyan2": hmc.METHODS["Omelyan"],
    "Composition(Strang, 4)": (cfjax.Composition(cfjax.Strang(), 4), 5),
    "Composition(Strang, 6)": (cfjax.Composition(cfjax.Strang(), 6), 11),
    "Composition(Strang, 8)": (cfjax.Composition(cfjax.Strang(), 8), 17),
    "ImplicitMidpoint": (IMPLICIT["ImplicitMidpoint"], None),
}


def oscillator() -> Iterator[results.Row]:
    """The longest step of q'' = -q up to which steps neither grow nor fail."""
    kick = cfjax.LieTerm(lambda t, y, args: {"q": None, "p": -y["q"]})
    drift = cfjax.LieTerm(lambda t, y, args: {"q": y["p"], "p": None})
    both = cfjax.LieTerm(lambda t, y, args: {"q": y["p"], "p": -y["q"]})
    for name, (solver, forces) in OSCILLATOR.items():
        term = both if name in IMPLICIT else diffrax.MultiTerm(kick, drift)

        @jax.jit
        @jax.vmap
        def is_stable(h: Any, term: Any = term, solver: Any = solver) -> Array:
            def step(y: Array) -> Array:
                y0 = {"q": y[:1], "p": y[1:]}
                sol = cfjax.integrate(term, solver, 0.0, h, y0, num_steps=1, throw=False)
                y1 = jnp.concatenate([sol.ys["q"][-1], sol.ys["p"][-1]])  # pyright: ignore
                return jnp.where(diffrax.is_okay(sol.result), y1, jnp.nan)

            # The eigenvalues of a matrix of determinant one are on the unit circle.
            return jnp.abs(jnp.trace(jax.vmap(step)(jnp.eye(2)))) <= 2 + 1e-12

        low, high = 0.01, 4.0
        while high - low > 1e-9:
            steps = np.linspace(low, high, 400)
            first_unstable = int(np.argmin(is_stable(steps)))
            low, high = steps[first_unstable - 1], steps[first_unstable]
        yield {"oscillator": name, "forces": forces, "longest step": results.digits(low)}


# The picture.

STYLES: dict[str, dict[str, Any]] = {
    "Strang": dict(color="#E69F00", linewidth=2.2),
    "BlanesMoan4": dict(color="#009E73", linewidth=2.2),
    "BlanesMoan6": dict(color="#000000", linewidth=2.2),
    "ImplicitMidpoint": dict(color="#8B4513", linewidth=2.2),
    "CF4": dict(color="#0072B2", linestyle="--"),
    "CF54": dict(color="#56B4E9", linestyle="--"),
    "CFEES27": dict(color="#CC79A7", linestyle="--"),
    "RKMK8": dict(color="#D55E00", linestyle="--"),
    "Tsit5": dict(color="#888888", linestyle="--"),
}
LABELS = {"RKMK8": "RKMK8, that is RKMK(Dopri8)", "Tsit5": "Tsit5, in plain space"}
TITLES = {
    "top": "heavy top",
    "spins": "six spins",
    "vortices": "six vortices",
    "fluid": "fluid on the sphere, N = 8",
    "lattice": "8 x 8 spins, energy a spin",
}


def draw() -> dict[str, Figure]:
    rows = [row for row in results.load("energy")["rows"] if "t" in row]
    figure = _style.new_figure(
        (10.5, 6.9),
        "The largest error of the energy so far, of methods with equally many evaluations of the "
        "field in a unit of time. Thick full lines: splittings, and the "
        "midpoint. Dashed: others. A drift is a line that rises with slope one.",
    )
    panels = figure.subplots(2, 3)
    for axes, name in zip(panels.flat, TITLES, strict=False):
        _panel(axes, name, results.pick(rows, system=name))
    legend_axes = panels[1, 2]
    legend_axes.set_axis_off()
    used = [method for method in STYLES if results.pick(rows, method=method)]
    for method in used:
        legend_axes.plot([], [], label=LABELS.get(method, method), **STYLES[method])
    for axes in panels[:, 0]:
        axes.set_ylabel("largest error of the energy until t")
    for axes in panels.flat[:-1]:
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
    legend_axes.legend(loc="center", frameon=False, handlelength=3.5, fontsize=10)
    return {"energy": figure}


def _panel(axes: Axes, name: str, rows: list[results.Row]) -> None:
    rate = rows[0]["evaluations a unit"]
    for row in rows:
        # Zero has no place on a logarithmic axis.
        largest = np.maximum(np.array(row["largest so far"], float), 1e-17)
        style = STYLES[row["method"]]
        is_extra = row["evaluations a unit"] != rate
        axes.loglog(row["t"], largest, **(style | dict(linestyle=":") if is_extra else style))
        if is_extra:
            axes.annotate(
                f"{row['method']}, h = {row['step']:g}",
                (row["t"][-1], largest[-1]),
                xytext=(0, 5),
                textcoords="offset points",
                ha="right",
                fontsize=8,
            )
    axes.set_title(f"{TITLES[name]}\n{rate:g} evaluations a unit of time", fontsize=10)
    axes.set(xlabel="time t")


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
