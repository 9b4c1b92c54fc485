"""Time of one CF4 step of the rigid body against diffrax and against C written by hand.

All programs take turns in one run, so that the ratios mean something on a busy machine. Without a C
compiler the ratios are to diffrax's Tsit5.
"""

import ctypes
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import cfjax
import results
from cfjax.scenes import rigid_body

STEP = 0.1
STEPS = 20_000
BATCH = 10_000
BATCH_STEPS = 50
# With its estimate CF4 carries a field from step to step, which costs time in a batch.
FIXED = cfjax.CF4(estimate=None)


def measure(quick: bool) -> Iterator[results.Row]:
    single, batch = _single_programs(), _batch_programs()
    with tempfile.TemporaryDirectory() as folder:
        library = results.compile_c("rigid_body.c", Path(folder))
        if library is not None:
            pointer = ctypes.POINTER(ctypes.c_double)
            library.cf4.argtypes = [pointer, pointer, ctypes.c_double, ctypes.c_long]
            library.cf4_batch.argtypes = [pointer, ctypes.c_long, *library.cf4.argtypes[1:]]
            single = {"C": _c_single(library), **single}
            batch = {"C": _c_batch(library), **batch}
        for systems, programs, steps in ((1, single, STEPS), (BATCH, batch, BATCH * BATCH_STEPS)):
            base = "C" if library is not None else "diffrax, Tsit5"
            times = results.in_turns(programs, repeats=3 if quick else 25)
            for name, seconds in times.items():
                yield {
                    "program": name,
                    "systems": systems,
                    "seconds a step": results.spread(seconds / steps),
                    f"over {base}": results.ratios(seconds, times[base]),
                }


def _term() -> cfjax.LieTerm:
    return cfjax.LieTerm(rigid_body.field)


def _ode(t, y, inertia):
    return jnp.cross(y, y / inertia)


def _solve(term, solver, y0, inertia, num_steps):
    """diffrax's loop; `max_steps=None` is its fastest, as it keeps nothing for a gradient."""
    t1 = num_steps * STEP
    return diffrax.diffeqsolve(term, solver, 0.0, t1, STEP, y0, inertia, max_steps=None).ys


def _integrate(y0, inertia, num_steps):
    t1 = num_steps * STEP
    sol = cfjax.integrate(_term(), cfjax.CF4(), 0.0, t1, y0, inertia, num_steps=num_steps)
    return jax.tree.map(lambda ys: ys[-1], sol.ys)


def _initial(batch: int | None = None):
    inertia = jnp.asarray(rigid_body.inertia)
    if batch is None:
        return jnp.asarray(rigid_body.y0), inertia
    y0 = np.random.default_rng(0).normal(size=(batch, 3))
    return jnp.asarray(y0 / np.linalg.norm(y0, axis=1, keepdims=True)), inertia


def _single_programs() -> dict[str, Callable[[], object]]:
    ode = diffrax.ODETerm(_ode)
    y0, inertia = _initial()
    programs = {
        "cfjax.integrate, CF4": lambda y, i: _integrate(y, i, STEPS),
        "diffrax, CF4(estimate=None)": lambda y, i: _solve(_term(), FIXED, y, i, STEPS),
        "diffrax, CF4": lambda y, i: _solve(_term(), cfjax.CF4(), y, i, STEPS),
        "diffrax, Tsit5": lambda y, i: _solve(ode, diffrax.Tsit5(), y, i, STEPS),
        "diffrax, Dopri5": lambda y, i: _solve(ode, diffrax.Dopri5(), y, i, STEPS),
    }
    return {name: results.compiled(program, y0, inertia) for name, program in programs.items()}


def _batch_programs() -> dict[str, Callable[[], object]]:
    ode = diffrax.ODETerm(_ode)
    n = BATCH_STEPS
    y0, inertia = _initial(BATCH)

    def chunks(y, i):
        return jax.lax.map(lambda y: _integrate(y, i, n), y, batch_size=1000)

    def vmap(program):
        return jax.vmap(program, in_axes=(0, None))

    programs = {
        "cfjax.integrate, CF4": vmap(lambda y, i: _integrate(y, i, n)),
        "cfjax.integrate, CF4, chunks of 1000": chunks,
        "diffrax, CF4(estimate=None)": vmap(lambda y, i: _solve(_term(), FIXED, y, i, n)),
        "diffrax, CF4": vmap(lambda y, i: _solve(_term(), cfjax.CF4(), y, i, n)),
        "diffrax, Tsit5": vmap(lambda y, i: _solve(ode, diffrax.Tsit5(), y, i, n)),
        "diffrax, Dopri5": vmap(lambda y, i: _solve(ode, diffrax.Dopri5(), y, i, n)),
    }
    return {name: results.compiled(program, y0, inertia) for name, program in programs.items()}


def _pointer(array: np.ndarray):
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def _c_single(library: ctypes.CDLL) -> Callable[[], object]:
    y0, inertia = map(np.array, _initial())

    def run():
        y = y0.copy()
        library.cf4(_pointer(y), _pointer(inertia), STEP, STEPS)
        return y

    _check(run(), _integrate(*_initial(), STEPS))
    return run


def _c_batch(library: ctypes.CDLL) -> Callable[[], object]:
    y0, inertia = map(np.array, _initial(BATCH))

    def run():
        y = y0.copy()
        library.cf4_batch(_pointer(y), BATCH, _pointer(inertia), STEP, BATCH_STEPS)
        return y

    members = jnp.asarray(y0[:3])
    _check(run()[:3], jax.vmap(lambda y: _integrate(y, inertia, BATCH_STEPS))(members))
    return run


def _check(c, ours) -> None:
    # The steps are the same. They differ by rounding, which the flow lets grow with time.
    if not np.allclose(c, ours, atol=1e-9, rtol=0):
        raise RuntimeError(f"C and cfjax disagree: {c} and {ours}.")


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
