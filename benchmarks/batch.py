"""Time and memory of many solves at once: the rigid body, 100 steps of CF4; and adaptive steps.

`cfjax.map_batch` with several chunk sizes and one plain `jax.vmap` over the whole batch take turns
in one run, from NumPy arrays to NumPy arrays. The picture shows trajectories per second.

Then 1000 solves with adaptive steps of a tolerance of 1e-7: the end alone, the state at 21 times,
and the gradient of a sum over these with respect to the start. diffrax's Tsit5 in plain space takes
turns.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple
from unittest import mock

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

import cfjax
import results
from cfjax._batch import batch as _batch
from cfjax._measure import style as _style
from cfjax.scenes import rigid_body

STEPS, END = 100, 10.0
SIZES = (1000, 10_000, 100_000, 1_000_000)
CHUNKS = (1000, 10_000, 100_000)
TERM = cfjax.LieTerm(rigid_body.field)
STYLES: dict[str, dict[str, Any]] = {
    "chunks of 1000": dict(color="#D55E00", linestyle="--", marker="s"),
    "chunks of 10000": dict(color="#0072B2", linestyle="-", marker="o"),
    "chunks of 100000": dict(color="#009E73", linestyle="-.", marker="^"),
    "one jax.vmap": dict(color="#000000", linestyle=":", marker="D"),
}
ADAPTIVE, TIMES, TOLERANCE = 1000, 21, 1e-7
METHODS = {
    "CF54": cfjax.CF54(),
    "RKMK8": cfjax.RKMK8(),
    "Projected(Dopri8)": cfjax.Projected(diffrax.Dopri8()),
    "Tsit5": diffrax.Tsit5(),
}
Member = Any  # Angular momentum and principal moments.


class Program(NamedTuple):
    run: Callable[[], np.ndarray]
    memory: int  # bytes on the device, as the compiler plans them
    compile_seconds: float


def measure(quick: bool) -> Iterator[results.Row]:
    rounds, budget = (3, 10.0) if quick else (9, 120.0)
    for size in SIZES:
        members = _members(size)
        programs = {f"chunks of {n}": _in_chunks(members, n) for n in CHUNKS if n <= size}
        programs["one jax.vmap"] = _one_vmap(members)
        for name, seconds in _times(programs, rounds, budget).items():
            yield {
                "members": size,
                "program": name,
                "seconds a trajectory": results.spread(seconds / size),
                "MiB": results.digits(programs[name].memory / 2**20),
                "compile seconds": results.digits(programs[name].compile_seconds),
            }
    members = _members(ADAPTIVE)
    for output, make in PROGRAMS.items():
        runs, compile_seconds = {}, {}
        for method, solver in METHODS.items():
            begin = time.process_time()
            runs[method] = results.compiled(jax.vmap(make(solver)), *members)
            compile_seconds[method] = time.process_time() - begin
        times = results.in_turns(runs, repeats=3 if quick else 15)
        for method, seconds in times.items():
            yield {
                "what": output,
                "method": method,
                "members": ADAPTIVE,
                "compile CPU seconds": results.digits(compile_seconds[method]),
                "seconds": results.spread(seconds),
                "over Tsit5": results.ratios(seconds, times["Tsit5"]),
            }


def _adaptive(solver: Any, num_times: int) -> Callable[[Any, Any], Any]:
    space = diffrax.ODETerm(lambda t, y, args: jnp.cross(y, y / args))
    term = space if isinstance(solver, diffrax.Tsit5) else TERM
    times = jnp.linspace(0.0, END, num_times) if num_times > 1 else None

    def solve(y0: Any, inertia: Any) -> Any:
        return diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            END,
            None,
            y0,
            inertia,
            saveat=diffrax.SaveAt(ts=times, t1=times is None),
            stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=256,
            throw=False,
        ).ys

    return solve


def _gradient(solver: Any) -> Callable[[Any, Any], Any]:
    solve = _adaptive(solver, TIMES)
    return jax.grad(lambda y0, inertia: jnp.sum(solve(y0, inertia) ** 3))


PROGRAMS: dict[str, Callable[[Any], Callable[[Any, Any], Any]]] = {
    "end alone": lambda solver: _adaptive(solver, 1),
    f"{TIMES} times": lambda solver: _adaptive(solver, TIMES),
    "gradient": _gradient,
}


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
    begin = time.perf_counter()
    program = _batch.Program(_solve, members, chunk_size, mesh)
    executable = program.run
    compile_seconds = time.perf_counter() - begin

    def run():
        # Compiled already: it takes as long as the first ten thousand trajectories or more.
        with mock.patch.object(_batch, "Program", lambda *_: program):
            return cfjax.map_batch(_solve, members, chunk_size=chunk_size, mesh=mesh).values

    return Program(run, _memory(executable), compile_seconds)


def _one_vmap(members: Member) -> Program:
    begin = time.perf_counter()
    executable = jax.jit(jax.vmap(_solve)).lower(members).compile()
    compile_seconds = time.perf_counter() - begin
    run = lambda: np.asarray(executable(members))  # noqa: E731
    return Program(run, _memory(executable), compile_seconds)


def _memory(executable: jax.stages.Compiled) -> int:
    plan = executable.memory_analysis()
    assert plan is not None
    return plan.temp_size_in_bytes + plan.argument_size_in_bytes + plan.output_size_in_bytes


def _times(programs: dict[str, Program], rounds: int, budget: float) -> dict[str, np.ndarray]:
    runs = {name: program.run for name, program in programs.items()}
    expected, *ends = (run() for run in runs.values())
    # The steps are the same. They differ by rounding, which the flow lets grow with time.
    if not all(np.allclose(expected, end, atol=1e-9, rtol=1e-9) for end in ends):
        raise RuntimeError("Programs disagree.")
    return results.in_turns(runs, repeats=rounds, budget=budget)


def draw() -> dict[str, Figure]:
    stored = results.load("batch")
    cores = stored["machine"]["cores"]
    figure = _style.new_figure(
        (6.5, 4.2),
        f"The rigid body, {STEPS} steps of CF4 a trajectory, in float64 on "
        f"{cores} cores. Median of runs in turns; bars reach from the lower to the upper quartile. "
        "Without compilation.",
    )
    axes = figure.subplots()
    for name, style in STYLES.items():
        rows = results.pick(stored["rows"], program=name)
        # The quickest quarter of the runs has the largest rates.
        rates = np.array([1 / np.array(row["seconds a trajectory"])[3:0:-1] for row in rows])
        spread = np.abs(rates[:, ::2] - rates[:, 1:2]).T
        sizes = [row["members"] for row in rows]
        axes.errorbar(sizes, rates[:, 1], spread, label=name, capsize=2, markersize=5, **style)
    axes.set(ylabel="trajectories per second", ylim=(0, None))
    axes.yaxis.set_major_formatter(EngFormatter())
    _style.logarithmic(axes, "members of the batch")
    _style.finish(figure, columns=2)
    return {"batch": figure}


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
