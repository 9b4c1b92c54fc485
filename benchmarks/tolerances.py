"""What error control costs: error against tolerance and against flows, and time to an error.

Run as `python benchmarks/tolerances.py`. The problem is the rigid body to t = 10, and every method
runs with `diffrax.PIDController(rtol=0, atol=tolerance)`. It draws `tolerances.png`, with every
embedded pair, next to itself, and prints steps, errors and times at equal tolerance and at equal
error, beside diffrax's solvers in plain space. All programs of a table take turns in one run, so
that the ratios mean something on a busy machine.
"""

import argparse
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jaxtyping import Array
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import cfjax
from cfjax._measure.cost import Problem, calls_of_steps
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import rigid_body

END = 10.0
TOLERANCES = np.logspace(-4, -10, 7)
PAIRS = ["CF3", "CF4", "CF43", "CF54", "CG3", "BWRRK53", "CK34", "Luscher3"]

TARGETS = (1e-6, 1e-9)
BATCH = 1000
LIE = cfjax.LieTerm(rigid_body.field)
SPACE = diffrax.ODETerm(lambda t, y, inertia: jnp.cross(y, y / inertia))
METHODS: dict[str, tuple[Any, diffrax.AbstractSolver]] = {
    "Tsit5 in space": (SPACE, diffrax.Tsit5()),
    "Dopri8 in space": (SPACE, diffrax.Dopri8()),
    "CF4": (LIE, cfjax.CF4()),
    "CF43": (LIE, cfjax.CF43()),
    "CF54": (LIE, cfjax.CF54()),
    "Richardson(CF4)": (LIE, cfjax.Richardson(cfjax.CF4(estimate=None))),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=25, help="turns of every program")
    rounds = parser.parse_args().rounds
    jax.config.update("jax_enable_x64", True)
    _draw()
    console = Console()
    console.print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {rounds} rounds")
    for y0 in (np.asarray(rigid_body.y0), _batch()):
        programs = {name: Program(*method, y0) for name, method in METHODS.items()}
        for target in TARGETS:
            for table in _tables(programs, target, rounds):
                console.print(table)


class Program:
    """A method for one system or a batch, compiled once for all tolerances."""

    def __init__(self, term: Any, solver: diffrax.AbstractSolver, y0: np.ndarray):
        def solve(y0: Array, tolerance: Array) -> tuple[Array, Array]:
            sol = diffrax.diffeqsolve(
                term,
                solver,
                0.0,
                END,
                0.01,
                y0,
                jnp.asarray(rigid_body.inertia),
                stepsize_controller=diffrax.PIDController(rtol=0.0, atol=tolerance),
                max_steps=None,
            )
            assert sol.ys is not None
            return sol.ys[-1], sol.stats["num_steps"]

        if y0.ndim == 2:
            solve = jax.vmap(solve, in_axes=(0, None))
        self.y0, self.exact = jnp.asarray(y0), _reference(y0)
        self.solve = jax.jit(solve).lower(self.y0, jnp.asarray(1.0)).compile()

    def run(self, tolerance: float) -> "Run":
        y, num_steps = self.solve(self.y0, jnp.asarray(tolerance))
        errors = np.linalg.norm(y - self.exact, axis=-1)
        # Of a batch the root mean square of the errors, and the steps of the median member.
        return Run(tolerance, float(np.sqrt(np.mean(errors**2))), int(np.median(num_steps)))

    def to_error(self, target: float) -> "Run":
        """At the tolerance that leads to an error of about `target`."""
        run = self.run(target)
        for _ in range(10):
            if 0.9 < run.error / target < 1.1:
                break
            run = self.run(run.tolerance * target / run.error)
        return run

    def timed(self, tolerance: float) -> Callable[[], object]:
        atol = jnp.asarray(tolerance)
        return lambda: self.solve(self.y0, atol)


class Run(NamedTuple):
    tolerance: float
    error: float
    num_steps: int


def _tables(programs: dict[str, Program], target: float, rounds: int) -> Iterator[Table]:
    """The time is that of the fastest round, which other work on the machine disturbs least.

    Ratios are taken round by round to the first program.
    """
    runs = [[p.run(target) for p in programs.values()]]
    runs.append([p.to_error(target) for p in programs.values()])
    # One kind after the other, so that no program follows itself and finds its own caches.
    timed = [
        p.timed(run.tolerance)
        for row in runs
        for p, run in zip(programs.values(), row, strict=True)
    ]
    members = next(iter(programs.values())).exact.size // 3
    # A single system takes a tenth of a millisecond, a batch a tenth of a second.
    repeats = rounds if members > 1 else 20 * rounds
    seconds = take_turns(timed, repeats=repeats).reshape(2, len(programs), -1)
    what = "one system" if members == 1 else f"{members} systems, each"
    for same, row, measured in zip(("tolerance", "error"), runs, seconds, strict=True):
        table = Table(title=f"Equal {same}, {target:g}: {what}", title_justify="left")
        table.add_column("method")
        for column in ("steps", "error", "µs", "over Tsit5", "middle half"):
            table.add_column(column, justify="right")
        for name, run, times in zip(programs, row, measured, strict=True):
            low, middle, high = statistics.quantiles(times / measured[0], n=4)
            table.add_row(
                name,
                f"{run.num_steps}",
                f"{run.error:.1e}",
                f"{1e6 * np.min(times) / members:.3g}",
                f"{middle:.2f}",
                f"{low:.2f} to {high:.2f}",
            )
        yield table


def _batch() -> np.ndarray:
    y0 = np.random.default_rng(0).normal(size=(BATCH, 3))
    return y0 / np.linalg.norm(y0, axis=1, keepdims=True)


def _reference(y0: np.ndarray) -> np.ndarray:
    def ode(t: float, y: np.ndarray) -> np.ndarray:
        y = y.reshape(y0.shape)
        return np.cross(y, y / rigid_body.inertia).ravel()

    answer = solve_ivp(ode, (0, END), y0.ravel(), method="DOP853", rtol=2.3e-14, atol=1e-15)
    return answer.y[:, -1].reshape(y0.shape)


def _draw() -> None:
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
    solvers = {name: getattr(cfjax, name)() for name in PAIRS}
    solvers["Richardson(CF4)"] = METHODS["Richardson(CF4)"][1]
    for name, solver in solvers.items():
        program = Program(LIE, solver, np.asarray(rigid_body.y0))
        runs = [program.run(tolerance) for tolerance in TOLERANCES]
        errors, steps = (np.array(column) for column in list(zip(*runs, strict=True))[1:])
        axes[0].loglog(TOLERANCES, errors, "o-", markersize=3, label=name)
        axes[1].loglog(_flows(solver) * steps, errors, "o-", markersize=3)
        per_tolerance = errors / TOLERANCES
        print(f"{name:16} error / tolerance {per_tolerance.min():.2g} to {per_tolerance.max():.2g}")
    axes[0].loglog(TOLERANCES, TOLERANCES, "k:", label="error = tolerance")
    axes[0].set_xlabel("tolerance")
    axes[1].set_xlabel("flows")
    axes[0].set_ylabel(f"error at t = {END:g}")
    axes[0].legend(fontsize="small")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=120)


def _flows(solver: Any) -> float:
    """Flows in a step, with those of the estimate."""
    y0, inertia = np.asarray(rigid_body.y0), np.asarray(rigid_body.inertia)
    t0, t1, h = (jnp.asarray(t) for t in (0.0, END, 0.1))
    return calls_of_steps(Problem(LIE, solver, t0, t1, h, y0, inertia))[1].flows


if __name__ == "__main__":
    main()
