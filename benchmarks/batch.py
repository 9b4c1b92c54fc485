"""Time and memory of many solves at once: the rigid body, 100 steps of CF4.

Run as `python benchmarks/batch.py`. It writes `batch.png` next to itself. `cfjax.map_batch` with
several chunk sizes and one plain `jax.vmap` over the whole batch take turns in one run, from NumPy
arrays to NumPy arrays. Then come gradients of a batch, over the time of its values.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
from matplotlib.ticker import EngFormatter
from rich.console import Console
from rich.table import Table

import cfjax
from cfjax._integrate import batch as _batch
from cfjax._measure import style as _style
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import rigid_body

STEPS, END = 100, 10.0
SIZES = (1000, 10_000, 100_000, 1_000_000)
CHUNKS = (1000, 10_000, 100_000)
GRADIENTS = 10_000
TERM = cfjax.LieTerm(rigid_body.field)
STYLES: dict[str, dict[str, Any]] = {
    "chunks of 1000": dict(color="#D55E00", linestyle="--", marker="s"),
    "chunks of 10000": dict(color="#0072B2", linestyle="-", marker="o"),
    "chunks of 100000": dict(color="#009E73", linestyle="-.", marker="^"),
    "one jax.vmap": dict(color="#000000", linestyle=":", marker="D"),
}
Member = Any  # Angular momentum and principal moments.


class Program(NamedTuple):
    run: Callable[[], np.ndarray]
    memory: int  # bytes on the device, as the compiler plans them
    compile_seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9, help="turns of every program")
    parser.add_argument("--budget", type=float, default=120.0, help="seconds for each batch")
    parser.add_argument("--largest", type=int, default=SIZES[-1], help="batch, up to 10000000")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    console = Console(width=110)
    device = f"{jax.device_count()} x {jax.devices()[0].device_kind}"
    console.print(f"{device}, jax {jax.__version__}")

    table = _table("Values", "members")
    found: dict[str, dict[int, np.ndarray]] = {name: {} for name in STYLES}
    for size in (n for n in (*SIZES, 10 * SIZES[-1]) if n <= options.largest):
        members = _members(size)
        programs = {f"chunks of {n}": _in_chunks(members, n) for n in CHUNKS if n <= size}
        programs["one jax.vmap"] = _whole(jax.vmap(_solve), members)
        for name, times in _measure(programs, options).items():
            found[name][size] = times / size
            _add_row(table, f"{size}", name, times / size, programs[name])
        table.add_section()
    console.print(table)
    console.print(_gradients(options))
    _chart(found, device).savefig(Path(__file__).with_suffix(".png"), dpi=120)


def _members(size: int) -> Member:
    rng = np.random.default_rng(0)
    y0 = rng.normal(size=(size, 3))
    inertia = rigid_body.inertia * rng.uniform(0.9, 1.1, size=(size, 3))
    return y0 / np.linalg.norm(y0, axis=1, keepdims=True), inertia


def _solve(member: Member) -> jax.Array:
    sol = cfjax.integrate(TERM, cfjax.CF4(), 0.0, END, *member, num_steps=STEPS)
    return jnp.asarray(sol.ys)[-1]


def _in_chunks(members: Member, chunk_size: int) -> Program:
    """`cfjax.map_batch`, over all devices."""
    mesh = jax.make_mesh((jax.device_count(),), ("batch",)) if jax.device_count() > 1 else None
    start = time.perf_counter()
    program = _batch._Program(_solve, members, chunk_size, mesh)
    executable = program.run
    compile_seconds = time.perf_counter() - start

    def run():
        # Compiled already: it takes as long as the first ten thousand trajectories or more.
        with mock.patch.object(_batch, "_Program", lambda *_: program):
            return cfjax.map_batch(_solve, members, chunk_size=chunk_size, mesh=mesh).values

    return Program(run, _memory(executable), compile_seconds)


def _whole(function: Callable[[Member], Any], members: Member) -> Program:
    start = time.perf_counter()
    executable = jax.jit(function).lower(members).compile()
    compile_seconds = time.perf_counter() - start
    run = lambda: jax.tree.map(np.asarray, executable(members))  # noqa: E731
    return Program(run, _memory(executable), compile_seconds)


def _memory(executable: jax.stages.Compiled) -> int:
    plan = executable.memory_analysis()
    assert plan is not None
    return plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes


def _measure(programs: dict[str, Program], options: argparse.Namespace) -> dict[str, np.ndarray]:
    runs = [program.run for program in programs.values()]
    first, *others = (run() for run in runs)
    # The same steps; what differs is rounding, which the flow lets grow with time.
    if not all(jax.tree.all(jax.tree.map(_is_close, first, other)) for other in others):
        raise RuntimeError("Programs disagree.")
    times = take_turns(runs, repeats=options.rounds, budget=options.budget)
    return dict(zip(programs, times, strict=True))


def _is_close(a: np.ndarray, b: np.ndarray) -> bool:
    return np.allclose(a, b, atol=1e-9, rtol=1e-9)


def _gradients(options: argparse.Namespace) -> Table:
    """In the initial value and the moments of inertia, of one number for each trajectory."""
    space = diffrax.ODETerm(lambda t, y, inertia: jnp.cross(y, y / inertia))

    def by_diffrax(term, solver):
        def solve(member):
            sol = diffrax.diffeqsolve(
                term,
                solver,
                0.0,
                END,
                END / STEPS,
                *member,
                max_steps=STEPS + 1,  # rounding of the times may make a step more
                adjoint=diffrax.RecursiveCheckpointAdjoint(),
            )
            return jnp.asarray(sol.ys)[-1]

        return solve

    solves = {
        "cfjax.integrate, CF4": _solve,
        "diffrax, CF4": by_diffrax(TERM, cfjax.CF4()),
        "diffrax, CF4, no estimate": by_diffrax(TERM, cfjax.CF4(estimate=None)),
        "diffrax, Tsit5": by_diffrax(space, diffrax.Tsit5()),
    }
    table = _table(f"Gradients of {GRADIENTS} trajectories", "gradient / values")
    members = _members(GRADIENTS)
    for name, solve in solves.items():
        value = lambda member, solve=solve: jnp.sum(jnp.sin(solve(member)))  # noqa: E731
        values = _whole(jax.vmap(value), members)
        gradients = _whole(jax.vmap(jax.grad(value)), members)
        # In turns, so that the ratio means something on a busy machine.
        times = take_turns(
            [values.run, gradients.run], repeats=options.rounds, budget=options.budget
        )
        ratio = f"{statistics.median(times[1] / times[0]):.1f}"
        _add_row(table, "", f"{name}, values", times[0] / GRADIENTS, values)
        _add_row(table, ratio, f"{name}, gradients", times[1] / GRADIENTS, gradients)
        table.add_section()
    return table


def _table(title: str, first: str) -> Table:
    table = Table(title=title, title_justify="left")
    for heading in (first, "program", "µs a trajectory", "middle half", "memory", "compile"):
        table.add_column(heading, justify="left" if heading == "program" else "right")
    return table


def _add_row(table: Table, first: str, name: str, times: np.ndarray, program: Program) -> None:
    low, middle, high = np.quantile(1e6 * times, (0.25, 0.5, 0.75))
    table.add_row(
        first,
        name,
        f"{middle:.3g}",
        f"{low:.3g} to {high:.3g}",
        f"{program.memory / 2**20:.1f} MiB",
        f"{program.compile_seconds:.1f} s",
    )


def _chart(found: dict[str, dict[int, np.ndarray]], device: str) -> matplotlib.figure.Figure:
    figure = _style.new_figure(
        (6.5, 4.2),
        f"The rigid body, {STEPS} steps of CF4 a trajectory, in float64 on {device}. Median of "
        "runs in turns; bars reach from the lower to the upper quartile. Without compilation.",
    )
    axes = figure.subplots()
    for name, style in STYLES.items():
        rows = found[name]
        rates = np.array([np.quantile(1 / times, (0.25, 0.5, 0.75)) for times in rows.values()])
        spread = np.abs(rates[:, ::2] - rates[:, 1:2]).T
        axes.errorbar(list(rows), rates[:, 1], spread, label=name, capsize=2, markersize=5, **style)
    axes.set(ylabel="trajectories per second", ylim=(0, None))
    axes.yaxis.set_major_formatter(EngFormatter())
    _style.logarithmic(axes, "members of the batch")
    _style.finish(figure, columns=2)
    return figure


if __name__ == "__main__":
    main()
