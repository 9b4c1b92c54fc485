"""Error against time, flops, evaluations and flows, measured."""

import contextlib
import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from .._arguments import (
    as_state,
    captures_traced,
    check_own_tolerances,
    check_term_and_solver,
    count,
    time_dtype,
    time_scalar,
)
from .._batch.progress import progress_bar
from .._integrate import solve_steps
from .._numerics.checks import needing
from .._solvers.solver import as_own
from .._times import EqualTimes
from .cost import Problem, cost_of_steps
from .result import WorkPrecision

if TYPE_CHECKING:
    import rich.progress

_TRACED = (
    "What is measured must not be traced, in arguments or captured by a field: call work_precision "
    "outside of jax.jit, jax.vmap and jax.grad."
)

Method = diffrax.AbstractSolver | tuple[PyTree, diffrax.AbstractSolver]


def absolute_tolerance(tolerance: Float[Array, ""]) -> diffrax.AbstractStepSizeController:
    """Control of the absolute error alone, as a relative error depends on the frame."""
    return diffrax.PIDController(rtol=0.0, atol=tolerance)


def distance(y: PyTree, reference: PyTree) -> float:
    """The 2-norm of the difference, all parts of the state together."""
    differences = jtu.tree_map(lambda a, b: np.ravel(np.asarray(a) - np.asarray(b)), y, reference)
    with np.errstate(over="ignore"):
        return float(np.linalg.norm(np.concatenate(jtu.tree_leaves(differences))))


def work_precision(
    term: PyTree,
    t0: Any,
    t1: Any,
    y0: PyTree,
    args: PyTree = None,
    *,
    methods: Mapping[str, Method],
    reference: PyTree,
    num_steps: Sequence[int] | Int[Array | np.ndarray, " settings"] | None = None,
    tolerances: Sequence[float] | Float[Array | np.ndarray, " settings"] | None = None,
    controller: Callable[[Any], diffrax.AbstractStepSizeController] = absolute_tolerance,
    dt0: Any = None,
    max_steps: int = 100_000,
    error: Callable[[PyTree, PyTree], float] = distance,
    repeats: int = 100,
    budget: int | float = 20,
    progress: "bool | rich.progress.Progress" = True,
) -> WorkPrecision:
    """Measures what an error costs with each method.

    It measures either equal steps, by `cfjax.integrate` for each of `num_steps`, or adaptive steps,
    by `diffrax.diffeqsolve` for each of `tolerances`. It compiles a program for each method, which
    takes seconds, then runs the programs in turns, so that other work on the machine affects all of
    them alike.

    **Arguments:**

    - `term`, `t0`, `t1`, `y0`, `args`: the problem, as for `cfjax.integrate`.
    - `methods`: a dict by name of diffrax solvers, or of pairs of a term and a solver: diffrax's
      own solvers take `diffrax.ODETerm` of the ambient field.
    - `reference`: the state at `t1` that counts as exact; shaped like `y0`.
    - `num_steps`, `tolerances`: give one of the two.
    - `controller`: a function that makes the step size controller from a tolerance, which is a
      traced array. By default it controls the absolute error, with `rtol=0`, as a relative error
      depends on the frame.
    - `dt0`: the first of the adaptive steps; by default a hundredth of the interval.
    - `max_steps`: a run that takes more adaptive steps has failed.
    - `error`: a function of a final state and the reference that returns the error; by default the
      2-norm of the difference.
    - `repeats`, `budget`: the number of times that each run is measured, or the number of seconds
      until measuring stops. Every program runs at least once, and once more to warm up.
    - `progress`: whether to show what is being compiled and measured in progress bars, on a
      terminal. Without `rich` there are none. Or a `rich.progress.Progress` that gets the bars.

    **Returns:** a `cfjax.WorkPrecision`. A run that fails (infinity or NaN, or too many steps) has
    its own row, with NaN as its error and the reason as its note.

    **Raises:** `TypeError` or `ValueError` for arguments of wrong type or value, for example a
    solver without an error estimate if there are tolerances, or a traced value. An error that a
    method raises when it is traced is raised again, with the name of the method added.
    """
    if any(isinstance(x, Tracer) for x in jtu.tree_leaves((term, methods, t0, t1, y0, args))):
        raise TypeError(_TRACED)
    settings = _checked_settings(num_steps, tolerances)
    is_adaptive = tolerances is not None
    solvers = _checked_methods(methods, term, is_adaptive)
    repeats, max_steps = count("repeats", repeats), count("max_steps", max_steps)
    if not isinstance(budget, int | float | np.number) or not budget > 0:
        raise ValueError(f"budget must be a positive number of seconds, got {budget!r}.")
    for name, function in (("controller", controller), ("error", error)):
        if not callable(function):
            raise TypeError(f"{name} must be a function, got {function!r}.")
    y0 = as_state(y0)
    shape, expected_shape = (jtu.tree_map(jnp.shape, y) for y in (reference, y0))
    if shape != expected_shape:
        raise ValueError(f"reference must be shaped like y0, {expected_shape}, got {shape}.")
    dtype = time_dtype(y0)
    t0, t1 = time_scalar("t0", t0, dtype), time_scalar("t1", t1, dtype)
    if dt0 is None:
        dt0 = (t1 - t0) / (100 if is_adaptive else max(settings))
    dt0 = time_scalar("dt0", dt0, dtype)
    if not 0 < abs(t1 - t0) < np.inf:
        raise ValueError(f"t0 and t1 must be finite and differ, got {t0} and {t1}.")
    if not 0 < dt0 / (t1 - t0) < np.inf:
        raise ValueError(f"dt0 must be a step from t0={t0} towards t1={t1}, got {dt0}.")
    args = jtu.tree_map(lambda x: jnp.asarray(x) if eqx.is_inexact_array_like(x) else x, args)
    # Arrays, so that one program serves them all.
    counter = jnp.int32 if max(settings) < 2**31 else int
    values = [jnp.asarray(x, dtype if is_adaptive else counter) for x in settings]
    if is_adaptive:
        _check_controller(controller, values[0])
    solve = _adaptive_steps(controller, max_steps) if is_adaptive else _equal_steps

    names, rows, notes, programs = [], [], [], []
    with progress_bar(progress, "Compiling", len(solvers)) as update:
        for name, (own_term, solver) in solvers.items():
            update(description=f"Compiling {name}")
            with _naming_method(name):
                solver = solver if is_adaptive else as_own(solver).without_estimate()
                problem = Problem(own_term, solver, t0, t1, dt0, y0, args)
                cost = cost_of_steps(problem, is_adaptive)
                executable, seconds = compiled(solve, problem, values[0])
            update(description=f"Running {name}")
            for setting, value in zip(settings, values, strict=True):
                program = functools.partial(executable, eqx.filter((problem, value), eqx.is_array))
                # The first run also warms up.
                y, attempted, rejected, note = _first_run(program)
                with _naming_method(name):
                    final_error = np.nan if note else _checked_error(error(y, reference))
                if not note and not np.isfinite(final_error):
                    final_error, note = np.nan, "The error is not finite."
                tolerance = setting if is_adaptive else np.nan
                if not is_adaptive:
                    # A run that failed returns no numbers.
                    attempted, rejected = float(setting), 0.0
                rows.append(
                    (tolerance, final_error, attempted, rejected, *cost.of(attempted), seconds)
                )
                names.append(name)
                notes.append(note)
                programs.append(program)
            update(advance=1)
    runs = [i for i, note in enumerate(notes) if not note]
    # Methods with one setting run one after the other: these are compared, and take about as long.
    runs.sort(key=lambda i: i % len(settings))
    measured = take_turns(
        [programs[i] for i in runs], repeats=repeats, budget=budget, progress=progress
    )
    seconds = np.full((len(rows), measured.shape[1]), np.nan)
    seconds[runs] = measured
    columns = dict(zip(WorkPrecision._fields[1:9], np.array(rows).T, strict=True))
    return WorkPrecision(method=tuple(names), **columns, seconds=seconds, note=tuple(notes))


def compiled(fun: Callable[..., PyTree], *args: PyTree) -> tuple[Callable[[PyTree], PyTree], float]:
    """`fun(*args)` as a program of the arrays in `args`, and the seconds to trace and compile it.

    A program that takes nothing but arrays starts in microseconds.
    """
    arrays, static = eqx.partition(args, eqx.is_array)
    start = time.perf_counter()
    # A new function each time, or jax would use its cached program.
    traced = jax.jit(lambda arrays: fun(*eqx.combine(arrays, static))).trace(arrays)
    if captures_traced(traced, arrays):
        raise TypeError(_TRACED)
    return traced.lower().compile(), time.perf_counter() - start


def take_turns(
    programs: Sequence[Callable[[], PyTree]],
    *,
    repeats: int,
    budget: int | float = np.inf,
    progress: "bool | rich.progress.Progress" = False,
) -> Float[np.ndarray, "programs rounds"]:
    """Seconds of each program in each round; in a round each runs once, in this order.

    So other work on the machine affects all programs alike. There are `repeats` rounds, or as many
    as begin within `budget` seconds, but at least one.
    """
    rounds: list[list[float]] = []
    begin = time.perf_counter()
    fraction = 0.0
    with progress_bar(progress, "Measuring time", 1.0) as update:
        while fraction < 1:
            rounds.append([])
            for program in programs:
                start = time.perf_counter()
                jax.block_until_ready(program())
                rounds[-1].append(time.perf_counter() - start)
            fraction = max(len(rounds) / repeats, (time.perf_counter() - begin) / budget)
            update(completed=fraction)
    return np.array(rounds).T


def _equal_steps(problem: Problem, num_steps: Int[Array, ""]) -> tuple:
    term, solver, t0, t1, _, y0, args = problem
    times = EqualTimes(t0, t1, num_steps)
    solution, fault = solve_steps(term, as_own(solver), times, y0, args)
    y, *statistics = _outcome(solution, num_steps, 0)
    return needing(fault.error(jnp.zeros(())), y), *statistics


def _adaptive_steps(controller: Callable, max_steps: int) -> Callable[..., tuple]:
    def solve(problem, tolerance):
        solution = diffrax.diffeqsolve(
            *problem,
            stepsize_controller=controller(tolerance),
            max_steps=max_steps,
            throw=False,
        )
        stats = solution.stats
        return _outcome(solution, stats["num_steps"], stats["num_rejected_steps"])

    return solve


def _outcome(solution: diffrax.Solution, num_steps: Any, num_rejected: Any) -> tuple:
    return jtu.tree_map(lambda y: y[-1], solution.ys), solution.result, num_steps, num_rejected


def _first_run(program: Callable[[], tuple]) -> tuple[PyTree, float, float, str]:
    """The final state, the numbers of steps, and why it failed, which is empty if it did not."""
    try:
        y, result, num_steps, num_rejected = jax.block_until_ready(program())
    except jax.errors.JaxRuntimeError as failure:
        # A check within the program failed: its message is among many lines of Python's.
        _, _, message = str(failure).rpartition("RuntimeError: ")
        return None, np.nan, np.nan, message.partition("\n")[0]
    if result != diffrax.RESULTS.successful:
        note = diffrax.RESULTS[result]
    elif not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jtu.tree_leaves(y)):
        note = diffrax.RESULTS[diffrax.RESULTS.nonfinite]
    else:
        note = ""
    return y, float(num_steps), float(num_rejected), note


# Checks of arguments.


def _checked_settings(num_steps: Any, tolerances: Any) -> list[Any]:
    if (num_steps is None) == (tolerances is None):
        raise ValueError("Give either num_steps or tolerances, not both.")
    name, value = ("num_steps", num_steps) if tolerances is None else ("tolerances", tolerances)
    if isinstance(value, np.ndarray | jax.Array) and value.ndim == 1:
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise TypeError(f"{name} must be a sequence of numbers, got {value!r}.")
    settings = list(value)
    if not settings:
        raise ValueError(f"{name} must have at least one entry, got none.")
    if tolerances is None:
        return [count("num_steps", n) for n in settings]
    is_number = [isinstance(x, int | float | np.number) for x in settings]
    if not all(is_number) or not all(0 < x < np.inf for x in settings):
        raise ValueError(f"tolerances must be positive and finite, got {settings}.")
    return [float(x) for x in settings]


def _checked_methods(
    methods: Any, term: PyTree, is_adaptive: bool
) -> dict[str, tuple[PyTree, Any]]:
    """A term and a solver for each name."""
    if not isinstance(methods, Mapping) or not all(isinstance(name, str) for name in methods):
        raise TypeError(f"methods must be a dict of solvers by name, got {methods!r}.")
    if not methods:
        raise ValueError("methods must have at least one solver, got none.")
    pairs = {}
    for name, method in methods.items():
        is_pair = isinstance(method, tuple) and len(method) == 2
        pairs[name] = method if is_pair else (term, method)
        with _naming_method(name):
            check_term_and_solver(*pairs[name])
            if not is_adaptive:
                check_own_tolerances(pairs[name][1])
    return pairs


def _check_controller(controller: Callable, tolerance: Float[Array, ""]) -> None:
    result = eqx.filter_eval_shape(controller, tolerance)
    if not isinstance(result, diffrax.AbstractStepSizeController):
        raise TypeError(f"controller must return a diffrax step size controller, got {result!r}.")


def _checked_error(result: Any) -> float:
    is_real = isinstance(result, jax.Array | np.ndarray | np.generic | int | float)
    if not is_real or np.ndim(result) or np.iscomplexobj(result):
        raise TypeError(f"error must return a real number, got {eqx.tree_pformat(result)}.")
    value = float(result)
    if value < 0:
        raise ValueError(f"error must return a number of at least 0, got {value}.")
    return value


@contextlib.contextmanager
def _naming_method(name: str) -> Iterator[None]:
    try:
        yield
    except Exception as exception:
        exception.add_note(f"This is about methods[{name!r}].")
        raise
