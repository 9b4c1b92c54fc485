"""Integration with a fixed number of steps, as one compiled loop."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, PyTree, Real

from ._arguments import (
    as_state,
    check_own_tolerances,
    check_term_and_solver,
    count,
    time_dtype,
    time_scalar,
)
from ._arrays import describe
from ._control_term import is_driven
from ._numerics.checks import Fault, error_if, needing
from ._numerics.squaring import max_over_batch
from ._solvers.base import is_finite, result_of
from ._solvers.solver import AbstractSolver, as_own
from ._step_back import repeat_and_undo
from ._times import EqualTimes, GivenTimes, max_steps
from ._xla import repeat

_NOT_FINITE = (
    "y0 must be finite, got NaN or infinity. Find the entries with jax.tree.map(jnp.isfinite, y0), "
    "and check how they were computed."
)
_BLOW_UP = (
    f"{diffrax.RESULTS[diffrax.RESULTS.nonfinite].rstrip('.')}: the solution grows without bound, "
    "or the steps are too long, which more num_steps cure. (A step of a Munthe-Kaas method, such "
    "as cfjax.RKMK8, must turn by less than 2 pi, or with coordinates='cayley' by less than pi. A "
    "step of cfjax.Projected must end near the manifold, its invariants must be independent, and "
    "matrices that act from one side must be skew-Hermitian, on columns or rows of full rank.)"
)


def integrate(
    term: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: Any,
    t1: Any,
    y0: PyTree,
    args: PyTree = None,
    *,
    num_steps: int | np.integer | None = None,
    ts: Any = None,
    save_every: int | np.integer | None = None,
    save_initial: bool = False,
    checkpoint_every: int | np.integer | None = None,
    step_back: bool = False,
    throw: bool = True,
) -> diffrax.Solution:
    """Integrates from `t0` to `t1` with `num_steps` equal steps of any diffrax solver, or to `ts`.

    This is a leaner loop than `diffrax.diffeqsolve`, for problems that need no more: one scan,
    constant memory, and one compilation for each shape of the arguments and each number of steps,
    none for new values. Reverse mode keeps one state a step and computes every step again.

    **Arguments:**

    - `term`, `solver`, `t0`, `t1`, `y0`, `args`: as for `diffrax.diffeqsolve`. `t1 < t0` integrates
      backwards. Times are real scalars and take the precision of `y0`. Integers, booleans and half
      precision in `y0` become the default floating dtype. (`diffeqsolve` promotes them to the dtype
      of the times.) Python floats in `args` are traced; a Python int or bool is part of the
      program, as in equinox.
    - `num_steps`: the number of steps, at least 1, and not so many that a step would be shorter
      than the rounding of a time: in float32 at most 2^24, and fewer for times far from zero.
    - `ts`: instead of `num_steps`, and with None for `t1`: the times at which the steps end, shape
      `(n,)`, such as the time stamps of a log. They increase from `t0` on, or decrease. Infinity
      after the last of them is no step, so that logs of several lengths fit in one array and one
      batch: the state and its time stay what they were. A derivative with respect to `ts` takes
      time proportional to n^2.
    - `save_every`: saves the state each time this many steps are done; must divide their number. By
      default only the final state is saved.
    - `save_initial`: whether `t0` and the initial state are saved too, before all others, as with
      `diffrax.SaveAt(t0=True)`.
    - `checkpoint_every`: for reverse mode with little memory. Reverse mode then keeps one state for
      each group of this many steps, and computes the steps between a second time. About
      `sqrt(num_steps)` is best, and makes the memory proportional to `sqrt(num_steps)` states. It
      should divide `save_every`, or `num_steps` without that: the steps that remain are a loop of
      their own, and the program takes up to twice as long to compile.
    - `step_back`: for reverse mode in constant memory. Reverse mode then stores only the saved
      states, and computes all others by stepping backwards. This works with symmetric solvers,
      which undo a step up to rounding: `cfjax.Strang` and other splittings,
      `cfjax.ImplicitMidpoint`, `cfjax.Composition` and Magnus methods. Stepping backwards amplifies
      whatever the equation damps, rounding included, so do not use it for strongly damped problems.
      It does not support forward mode or noise, and fields must have a derivative in time too.
    - `throw`: whether a failure is an error, as in diffrax. If not, `result` of the solution says
      what happened, and invalid values of the arguments give NaN. In a batch made by `jax.vmap` one
      failure is an error for the whole batch. An error check within a function that you compile is
      a call of the host, so JAX does not keep such a program on disk. It keeps programs with
      `throw=False`, and every call from Python, where the host checks the result; but a gradient
      with `step_back` checks in its program.

    **Returns:** a `diffrax.Solution`. Its `ts` has shape `(num_saves,)`, and each leaf of `ys` has
    one more axis of that length in front; the last entry is the state at `t1`. The initial state is
    included only with `save_initial`.

    **Raises:** `TypeError` or `ValueError` for arguments of wrong type or value. A runtime error if
    `y0` or a saved state has an entry that is not finite, if `y0` is off the manifold that a field
    acts on, if a time is NaN or infinite, if a step is shorter than the rounding of a time, if the
    solver reports a failure, or if the steps back miss an array of the start by more than half of
    its digits.
    """
    check_term_and_solver(term, solver)
    check_own_tolerances(solver)
    y0 = as_state(y0)
    solver_to_run = as_own(solver).without_estimate()
    dtype = time_dtype(y0)
    t0 = time_scalar("t0", t0, dtype)
    times = _equal_times(t0, t1, num_steps) if ts is None else _given_times(t0, t1, num_steps, ts)
    number: Any = times.num_steps
    save_every = None if save_every is None else count("save_every", save_every)
    if save_every is not None and number % save_every:
        raise ValueError(f"save_every must divide the {number} steps, got {save_every}.")
    if not isinstance(save_initial, bool):
        raise TypeError(f"save_initial must be a bool, got {save_initial!r}.")
    if checkpoint_every is not None:
        checkpoint_every = count("checkpoint_every", checkpoint_every)
    if not isinstance(throw, bool):
        raise TypeError(f"throw must be a bool, got {throw!r}.")
    if not isinstance(step_back, bool):
        raise TypeError(f"step_back must be a bool, got {step_back!r}.")
    if step_back and checkpoint_every is not None:
        raise ValueError(
            "step_back needs no checkpoints: give either step_back or checkpoint_every, got both."
        )
    if step_back and not solver_to_run.is_symmetric:
        raise ValueError(
            "step_back takes a symmetric solver, such as cfjax.Strang(), cfjax.ImplicitMidpoint() "
            f"or cfjax.Magnus4(), got {type(solver).__name__}. With others use checkpoint_every."
        )
    if step_back and is_driven(term):
        raise ValueError(
            "step_back does not support noise or other path-driven terms: use checkpoint_every."
        )
    args = jtu.tree_map(lambda x: jnp.asarray(x) if isinstance(x, float | complex) else x, args)
    # In a program that the caller compiles, the check of errors is part of it. Other traced values,
    # be they in `args` or in what a field closes over, show in the results.
    is_compiled = any(isinstance(x, Tracer) for x in (jnp.zeros(()), *jtu.tree_leaves((times, y0))))
    solution, fault = solve_steps(
        term,
        solver_to_run,
        times,
        y0,
        args,
        Saving(save_every, save_initial, checkpoint_every, step_back),
        throw=throw and is_compiled,
        throw_in_reverse=throw and step_back,
    )
    if throw and not is_compiled:
        solution = _checked_solution(solution, fault)
    return solution


class Saving(NamedTuple):
    """What is saved, and what reverse mode keeps: the arguments of `integrate` of these names."""

    save_every: int | None = None
    save_initial: bool = False
    checkpoint_every: int | None = None
    step_back: bool = False


END_ONLY = Saving()


@eqx.filter_jit
def solve_steps(
    term: PyTree[diffrax.AbstractTerm],
    solver: AbstractSolver,
    times: EqualTimes | GivenTimes,
    y0: PyTree,
    args: PyTree,
    saving: Saving = END_ONLY,
    throw: bool = False,
    throw_in_reverse: bool = False,
) -> tuple[diffrax.Solution, Fault]:
    """`integrate` of checked arguments, and what is wrong with them, which is an error if `throw`.

    What goes wrong in reverse mode is an error if `throw_in_reverse`: nobody sees it afterwards.

    If not, the program calls nothing on the host, so JAX can keep it on disk, and the states are
    NaN. The number of equal steps may be traced where only the final state is saved. Then one
    program serves all numbers of steps, forward only.
    """
    save_every, save_initial, checkpoint_every, step_back = saving
    # A state may have no arrays, and then nothing can go wrong.
    throw = throw and bool(jtu.tree_leaves(y0))
    if throw:
        y0 = error_if(y0, lambda y0: ~is_finite(y0), _NOT_FINITE)
    grid, num_steps = times.grid(), times.num_steps
    n, time = grid.first, grid.time
    t0 = time(n)

    def step(carry, direction=1):
        n, y, solver_state, result = carry
        y, _, _, solver_state, step_result = solver.step(
            term, time(n), time(n + direction), y, args, solver_state, made_jump=False
        )
        # A failure that shows in the last state need not be in the loop: every operation slows down
        # a loop of small steps.
        if not solver.shows_failure and step_result is not diffrax.RESULTS.successful:
            is_first = result == diffrax.RESULTS.successful
            result = diffrax.RESULTS.where(is_first, step_result, result)
        if grid.is_step is not None:
            is_step = grid.is_step(n, n + direction)
            choose = lambda new, old: jnp.where(is_step, new, old)  # noqa: E731
            y, solver_state, result = jtu.tree_map(choose, (y, solver_state, result), carry[1:])
        return (n + direction, y, solver_state, result)

    solver_state, fault = solver.start(term, t0, time(n + 1), y0, args)
    fault = fault.with_cases_of(grid.fault)
    is_static = isinstance(num_steps, int)
    valid_num_steps = num_steps if is_static else jnp.where(fault.number == 0, num_steps, 0)
    zero = (fault.error if throw else fault.nan)(jnp.zeros((), t0.dtype))
    # Not the times: if these are constants, CF54 on a heavy top takes less than half the time.
    start = needing(zero, y0)
    carry = (n, start, solver_state, diffrax.RESULTS.successful)
    if grid.length is not None:
        solver = solver.for_equal_steps(term, grid.length, t0, y0, args)

    def advance(carry, length):
        if step_back:
            backward = lambda carry: step(carry, -1)  # noqa: E731
            # What a function closes over becomes an argument, which has a derivative.
            forward = eqx.filter_closure_convert(step, carry)
            backward = eqx.filter_closure_convert(backward, carry)
            repeat_carry = lambda step, carry, length: repeat(step, carry, length)[0]  # noqa: E731
            return repeat_and_undo(repeat_carry, forward, backward, carry, length, throw_in_reverse)
        # XLA would scalarise a loop of one turn, and compute the step anew for each of its uses.
        if isinstance(length, int) and length == 1:
            return step(carry)
        if checkpoint_every is None:
            return repeat(step, carry, length)[0]
        block_length, remainder = checkpoint_every, length % checkpoint_every
        block = jax.checkpoint(lambda carry: repeat(step, carry, block_length)[0])
        carry, _ = lax.scan(lambda x, _: (block(x), None), carry, length=length // block_length)
        return repeat(step, carry, remainder)[0]

    def steps_and_save(carry, _):
        carry = advance(carry, valid_num_steps if save_every is None else save_every)
        return carry, carry[1]

    num_saves: Any = 1 if save_every is None else num_steps // save_every
    if save_every == 1 and num_saves > 1 and not step_back:
        carry, ys = repeat(step, carry, num_saves, lambda carry: carry[1])
    else:
        carry, ys = lax.scan(steps_and_save, carry, length=num_saves)
    ts = time(
        carry[0][None]
        if save_every is None
        else n + save_every * jnp.arange(1, num_saves + 1, dtype=n.dtype)
    )
    if save_initial:
        prepend = lambda initial, saved: jnp.concatenate([initial[None], saved])  # noqa: E731
        ts, ys = jtu.tree_map(prepend, (t0, start), (ts, ys))
    ts, end = needing(zero, (ts, grid.end))
    # Only the saved states are checked, outside the loop: sums and products keep infinity and NaN,
    # so a blow-up shows in what is saved after it.
    result = result_of(ys)
    ended = solver.ended(carry[2], fault)
    if throw and ended is not fault:
        ys = needing(ended.error(jnp.zeros((), t0.dtype)), ys)
    if solver.shows_failure:
        ys = error_if(ys, lambda ys: ~is_finite(ys), _BLOW_UP) if throw else ys
    else:
        has_failed = carry[3] != diffrax.RESULTS.successful
        result = diffrax.RESULTS.where(has_failed, carry[3], result)
        ys = needing(_zero_or_error(result), ys) if throw else ys
    solution = diffrax.Solution(
        t0=t0,
        t1=end,
        ts=ts,
        ys=ys,
        interpolation=None,
        stats={"num_steps": num_steps},
        result=result,
        solver_state=None,
        controller_state=None,
        made_jump=None,
        event_mask=None,
    )
    return solution, ended.with_case(~is_finite(y0), _NOT_FINITE)


def _equal_times(t0: Real[Array, ""], t1: Any, num_steps: Any) -> EqualTimes:
    if num_steps is None:
        raise ValueError(
            "num_steps must be an integer of at least 1, got None: give num_steps, or ts for steps "
            "of other lengths."
        )
    num_steps, dtype = count("num_steps", num_steps), t0.dtype
    if num_steps > max_steps(dtype):
        raise ValueError(
            f"num_steps must be at most {max_steps(dtype)} for times in {dtype}, as the times of "
            f"more steps would coincide, got {num_steps}. Make y0 float64."
        )
    return EqualTimes(t0, time_scalar("t1", t1, dtype), num_steps)


def _given_times(t0: Real[Array, ""], t1: Any, num_steps: Any, ts: Any) -> GivenTimes:
    for name, value in (("t1", t1), ("num_steps", num_steps)):
        if value is not None:
            raise ValueError(f"{name} must be None with ts, which has all times, got {value!r}.")
    ts = jnp.asarray(ts)
    is_real = any(jnp.issubdtype(ts.dtype, kind) for kind in (jnp.integer, jnp.floating))
    if ts.ndim != 1 or not ts.size or not is_real:
        raise ValueError(f"ts must be real times of shape (n,), n at least 1, got {describe(ts)}.")
    return GivenTimes(t0, ts.astype(t0.dtype))


def _checked_solution(solution: diffrax.Solution, fault: Fault) -> diffrax.Solution:
    """The solution; raises the error that `fault` or its result reports."""
    if any(isinstance(x, Tracer) for x in jtu.tree_leaves((fault, solution.result))):
        # `jax.vmap` or a derivative outside of a program.
        zero = fault.error(jnp.zeros(())) + _zero_or_error(solution.result)
        return eqx.tree_at(lambda s: s.ys, solution, needing(zero, solution.ys))
    if jtu.tree_leaves(solution.ys):
        if number := int(fault.number):
            raise eqx.EquinoxRuntimeError(fault.messages[number - 1])
        if solution.result != diffrax.RESULTS.successful:
            is_blow_up = solution.result == diffrax.RESULTS.nonfinite
            raise eqx.EquinoxRuntimeError(
                _BLOW_UP if is_blow_up else diffrax.RESULTS[solution.result]
            )
    return solution


def _zero_or_error(result: diffrax.RESULTS) -> Real[Array, ""]:
    """Zero, or a runtime error if the result is a failure."""
    # equinox takes the largest number of a result, and an empty batch has none.
    worst = jtu.tree_map(max_over_batch, result)
    return worst.error_if(jnp.zeros(()), result != diffrax.RESULTS.successful)
