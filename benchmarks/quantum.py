"""A batch of pulses on a transmon: time to an error, beside diffrax in plain space and dynamiqs.

Each method takes the steps, or the tolerance, with which its propagators are as near as the goal:
the root of the mean square, over the pulses, of the largest entry. They were found by trial, and
the error is measured again. What they are compared with is Magnus10 with 1600 steps, and how near
DOP853 of SciPy is to it is a row. All take turns. dynamiqs is left out where it is not installed.
"""

import functools
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax._measure.work_precision import take_turns
from cfjax.scenes import transmon

LEVELS, DURATION = 4, 8.0
PULSES = {1: 9, 1000: 3}  # how often they take turns
QUICK = {1: 3, 200: 1}

# Of a pulse, and how fine.
Program = Callable[[Any, Any], Any]


def pulses(number: int) -> transmon.Pulse:
    """Stronger and weaker ones, with quadratures of both signs."""
    rng = np.random.default_rng(0)
    best = transmon.corrected(DURATION)
    factor = rng.uniform([0.7, -1.0], [1.3, 1.0], size=(number, 2))
    return best._replace(
        in_phase=jnp.asarray(factor[:, :1] * best.in_phase),
        quadrature=jnp.asarray(factor[:, 1:] * best.quadrature),
    )


def by_cfjax(solver: Any) -> Program:
    def run(pulse, num_steps):
        y0 = transmon.y0(LEVELS)
        term = cfjax.LieTerm(transmon.field)
        return cfjax.integrate(term, solver, 0.0, DURATION, y0, pulse, num_steps=num_steps).ys[-1]

    return run


def by_diffrax(solver: Any) -> Program:
    def run(pulse, num_steps):
        y0 = jnp.asarray(transmon.y0(LEVELS))
        term = diffrax.ODETerm(transmon.velocity)
        dt = DURATION / num_steps
        return diffrax.diffeqsolve(term, solver, 0.0, DURATION, dt, y0, pulse, max_steps=None).ys[
            -1
        ]

    return run


def by_dynamiqs(method: str) -> Program:
    import dynamiqs as dq

    dq.set_precision("double")
    dq.set_progress_meter(False)
    number = np.arange(LEVELS)
    lowering = np.diag(np.sqrt(number[1:]), 1) + 0j

    def run(pulse, tolerance):
        energies = pulse.frequency * number + pulse.anharmonicity * number * (number - 1) / 2
        h = dq.constant(jnp.diag(energies + 0j)) + dq.modulated(
            lambda t: transmon.drive(t, pulse), lowering + lowering.T
        )
        solver = getattr(dq.method, method)(rtol=tolerance, atol=tolerance, max_steps=1_000_000)
        return dq.sepropagator(
            h, jnp.array([0.0, DURATION]), method=solver
        ).final_propagator.to_jax()

    return run


# Steps or tolerances for errors below 1e-6, and below 1e-9 where that takes less than 10 000 steps.
SETTINGS: dict[str, tuple[Callable[[], Program], dict[float, Any]]] = {
    "CF4": (functools.partial(by_cfjax, cfjax.CF4()), {1e-6: 2000}),
    "CF54": (functools.partial(by_cfjax, cfjax.CF54()), {1e-6: 476, 1e-9: 1900}),
    "Magnus4": (functools.partial(by_cfjax, cfjax.Magnus4()), {1e-6: 600, 1e-9: 3400}),
    "Magnus6": (functools.partial(by_cfjax, cfjax.Magnus6()), {1e-6: 150, 1e-9: 610}),
    "Magnus8": (functools.partial(by_cfjax, cfjax.Magnus8()), {1e-6: 190, 1e-9: 420}),
    "diffrax, Tsit5": (
        functools.partial(by_diffrax, diffrax.Tsit5()),
        {1e-6: 5800},
    ),
    "diffrax, Dopri8": (
        functools.partial(by_diffrax, diffrax.Dopri8()),
        {1e-6: 1010, 1e-9: 2190},
    ),
    "dynamiqs, Tsit5": (functools.partial(by_dynamiqs, "Tsit5"), {1e-6: 2e-9}),
    "dynamiqs, Dopri8": (functools.partial(by_dynamiqs, "Dopri8"), {1e-6: 4e-9, 1e-9: 4e-12}),
}


def measure(quick: bool) -> Iterator[results.Row]:
    best = jax.jit(batched(functools.partial(by_cfjax(cfjax.Magnus10()), num_steps=1600)))
    some = pulses(4)
    near = np.asarray(best(some))
    members = [some._replace(in_phase=x, quadrature=y) for x, y in zip(*some[:2], strict=True)]
    exact = np.stack([transmon.reference(member, LEVELS) for member in members])
    yield {"DOP853 less Magnus10": float(np.abs(exact - near).max())}

    has_dynamiqs = importlib.util.find_spec("dynamiqs") is not None
    for number, repeats in (QUICK if quick else PULSES).items():
        data = pulses(number)
        target = best(data)
        for goal in (1e-6, 1e-9):
            programs = {}
            for name, (build, sizes) in SETTINGS.items():
                if goal in sizes and (has_dynamiqs or "dynamiqs" not in name):
                    run, size = build(), sizes[goal]
                    program = batched(lambda pulse, run=run, size=size: run(pulse, size))
                    programs[name] = results.compiled(program, data)
            ends = {name: np.asarray(program()) for name, program in programs.items()}
            rounds = take_turns(list(programs.values()), repeats=repeats)
            times = dict(zip(programs, rounds, strict=True))
            others = [name for name in times if ", " in name]
            fastest = min(others, key=lambda name: np.median(times[name]))
            for name, seconds in times.items():
                y = ends[name]
                worst = np.max(np.abs(y - target), axis=(1, 2))
                gram = np.einsum("nki,nkj->nij", y.conj(), y)
                yield {
                    "method": name,
                    "goal": goal,
                    "pulses": number,
                    "steps or tolerance": SETTINGS[name][1][goal],
                    "error": results.digits(np.sqrt(np.mean(worst**2))),
                    "off unitary": results.digits(np.abs(gram - np.eye(LEVELS)).max()),
                    "seconds each": results.spread(seconds / number),
                    "over the fastest of others": results.ratios(seconds, times[fastest]),
                }


def batched(run: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Of a batch of one, alone: a batch would not be as fast."""
    axes = transmon.Pulse(0, 0, None, None, None)

    def solve(pulse):
        if len(pulse.in_phase) > 1:
            return jax.vmap(run, in_axes=(axes,))(pulse)
        one = pulse._replace(in_phase=pulse.in_phase[0], quadrature=pulse.quadrature[0])
        return run(one)[None]

    return solve


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
