"""Larger systems: a chain of bodies, each coupled to its neighbours.

Every body is an attitude in SO(3) with its angular momentum, each a separate part of the state.
Springs align neighbours, and friction and a motor act on the first body. It measures seconds and
memory to compile, and seconds to run, for a solve and its gradient: CF4, and Tsit5 with and without
a projection to the manifold. Each case runs in its own process, with a time limit: a program that
exceeds the limit does not run for larger chains. The picture shows the time to compile.
"""

import argparse
import itertools
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

import cfjax
import results
from cfjax._measure import style as _style

BODIES = (2, 5, 10, 20, 30)
STEP, STEPS = 0.01, 100
LIMIT = 120.0  # seconds of a process
INERTIA = np.array([1.0, 1.2, 0.4])
PROGRAMS: dict[str, dict[str, Any]] = {
    "cfjax.integrate, CF4": dict(color="#0072B2", linestyle="-", marker="o"),
    "cfjax.integrate, Projected(Tsit5)": dict(color="#56B4E9", linestyle="-", marker="D"),
    "diffrax, CF4": dict(color="#D55E00", linestyle="--", marker="s"),
    "diffrax, Tsit5": dict(color="#000000", linestyle=":", marker="^"),
}
WHAT = ("solve", "gradient")

State = list[dict[str, Array]]


def rates(t: Any, state: State) -> list[tuple[Array, Array]]:
    """The angular velocity and the torque of every body, in the fixed frame."""
    torques = [-0.1 * body["momentum"] for body in state]
    torques[0] = torques[0] + jnp.stack([jnp.sin(t), jnp.cos(t), 0.5 * jnp.cos(2 * t)])
    for k, (body, following) in enumerate(itertools.pairwise(state)):
        spring = sum(
            jnp.cross(body["attitude"][:, j], following["attitude"][:, j]) for j in range(3)
        )
        torques[k] += spring
        torques[k + 1] -= spring
    turns = [body["attitude"] for body in state]
    omegas = [
        r @ ((r.T @ body["momentum"]) / INERTIA) for r, body in zip(turns, state, strict=True)
    ]
    return list(zip(omegas, torques, strict=True))


def field(t: Any, state: State, args: Any) -> Any:
    return [
        {"attitude": cfjax.Rotation(omega), "momentum": torque} for omega, torque in rates(t, state)
    ]


def velocity(t: Any, state: State, args: Any) -> State:
    return [
        {"attitude": jnp.cross(omega, body["attitude"], axisb=0, axisc=0), "momentum": torque}
        for (omega, torque), body in zip(rates(t, state), state, strict=True)
    ]


def initial_state(bodies: int) -> State:
    momenta = np.random.default_rng(0).normal(size=(bodies, 3))
    return [{"attitude": jnp.eye(3), "momentum": jnp.asarray(m)} for m in momenta]


def final_state(program: str, state: State) -> State:
    t1 = STEP * STEPS
    if program.startswith("cfjax"):
        solver = cfjax.CF4() if "CF4" in program else cfjax.Projected(diffrax.Tsit5())
        sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, t1, state, num_steps=STEPS)
    else:
        lie = cfjax.LieTerm(field), cfjax.CF4()
        method = lie if "CF4" in program else (diffrax.ODETerm(velocity), diffrax.Tsit5())
        sol = diffrax.diffeqsolve(*method, 0.0, t1, STEP, state, max_steps=STEPS + 1)
    return jax.tree.map(lambda ys: ys[-1], sol.ys)


def loss(program: str, state: State) -> Float[Array, ""]:
    leaves = jax.tree.leaves(final_state(program, state))
    return jnp.sum(jnp.stack([jnp.sum(jnp.sin(x)) for x in leaves]))


def case(program: str, task: str, bodies: int, repeats: int) -> results.Row:
    """Compiles and runs one program, in this process."""
    jax.config.update("jax_enable_x64", True)
    state = initial_state(bodies)
    function = {"solve": final_state, "gradient": jax.grad(loss, argnums=1)}[task]
    before, begin, begin_cpu = _peak(), time.perf_counter(), time.process_time()
    executable = jax.jit(lambda state: function(program, state)).lower(state).compile()
    compiling, compiling_cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    peak, plan = _peak(), executable.memory_analysis()
    assert plan is not None
    seconds = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        jax.block_until_ready(executable(state))
        seconds.append(time.perf_counter() - begin)
    return {
        "compile seconds": results.digits(compiling),
        "compile CPU seconds": results.digits(compiling_cpu),
        "compile MiB": results.digits((peak - before) / 2**10),
        "run MiB": results.digits(plan.temp_size_in_bytes / 2**20),
        "run seconds": results.spread(seconds[1:]),
    }


def _peak() -> int:
    """KiB of memory that this process has had at once."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure(quick: bool) -> Iterator[results.Row]:
    for task in WHAT[: 1 if quick else None]:
        for program in PROGRAMS:
            for bodies in BODIES[: 2 if quick else None]:
                row = {"program": program, "what": task, "bodies": bodies}
                measured = _in_process(program, task, bodies, 3 if quick else 20)
                yield row | measured
                if "ended" in measured:
                    break


def _in_process(program: str, task: str, bodies: int, repeats: int) -> results.Row:
    arguments = json.dumps([program, task, bodies, repeats])
    try:
        process = subprocess.run(
            [sys.executable, __file__, "--case", arguments],
            stdout=subprocess.PIPE,
            timeout=LIMIT,
            check=True,
        )
    except subprocess.TimeoutExpired:
        return {"ended": f"{LIMIT:g} s"}
    except subprocess.CalledProcessError as error:
        return {"ended": f"exit status {error.returncode}"}
    return json.loads(process.stdout)


def draw() -> dict[str, Figure]:
    rows = results.load("chain")["rows"]
    figure = _style.new_figure(
        (7.0, 3.8),
        f"A chain of coupled rigid bodies, {STEPS} steps in float64, each program in a process of "
        f"its own. A line ends where the next chain took more than {LIMIT:g} seconds.",
    )
    tasks = list(dict.fromkeys(row["what"] for row in rows))
    panels = figure.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for axes, task in zip(panels, tasks, strict=True):
        for program, style in PROGRAMS.items():
            curve = [r for r in results.pick(rows, program=program, what=task) if "ended" not in r]
            label = program if task == "solve" else None
            bodies, seconds = ([r[key] for r in curve] for key in ("bodies", "compile CPU seconds"))
            axes.plot(bodies, seconds, label=label, markersize=5, **style)
        axes.set(xlabel="bodies", yscale="log", title=task, xticks=BODIES, xlim=(0, 32))
    figure.axes[0].set(ylabel="processor seconds to compile")
    _style.finish(figure, columns=2)
    return {"chain": figure}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--case", type=json.loads)
    chosen = parser.parse_known_args()[0].case
    if chosen:
        print(json.dumps(case(*chosen)))
    else:
        results.run(Path(__file__).name, __doc__, measure)
