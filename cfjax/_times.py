"""The times of the steps of `integrate`: equal steps, or steps to given times."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, Real

from ._numerics.checks import Fault


class Grid(NamedTuple):
    """Steps by their numbers, from `first` on: step n is from `time(n)` to `time(n + 1)`."""

    first: Int[Array, ""]
    time: Callable[[Int[Array, "*n"]], Real[Array, "*n"]]
    end: Real[Array, ""]
    fault: Fault
    # The length of all steps, if they are equal.
    length: Real[Array, ""] | None = None
    # Whether the step from `time(n)` to `time(m)` is one; None if all are.
    is_step: Callable[[Int[Array, ""], Int[Array, ""]], Bool[Array, ""]] | None = None


class EqualTimes(eqx.Module):
    """Equal steps from t0 to t1. Their number may be traced."""

    t0: Real[Array, ""]
    t1: Real[Array, ""]
    num_steps: int | Int[Array, ""]

    def grid(self) -> Grid:
        t1, num_steps = self.t1, self.num_steps
        if isinstance(num_steps, int):
            first, intervals = jnp.asarray(0, jnp.int32 if num_steps < 2**31 else int), num_steps
        else:
            first, intervals = jnp.zeros_like(num_steps), num_steps.astype(t1.dtype)
        length = (t1 - self.t0) / intervals
        # Not as a number that is known: next to zero the compiler rounds the times within a step
        # once less than those at its ends, and the lengths of steps would not add up to the
        # interval.
        t0 = lax.optimization_barrier(self.t0)

        def time(n: Int[Array, "*n"]) -> Real[Array, "*n"]:
            # From the step's number, so that rounding does not add up, and t1 is met exactly.
            return jnp.where(n == num_steps, t1, t0 + n.astype(t0.dtype) * length)

        fault = Fault.none().with_case(
            self._is_short(intervals),
            "num_steps must leave each step longer than the rounding of t0 and t1, and the times "
            f"of so many steps coincide in {t0.dtype}. Take fewer steps, shift the times towards "
            "zero, or make y0 float64.",
        )
        for name, t in (("t0", t0), ("t1", t1)):
            fault = fault.with_case(
                jnp.isinf(t), f"{name} must be finite, got infinity (in {t.dtype}, that of y0)."
            )
        return Grid(first, time, t1, fault, length)

    def _is_short(self, intervals: int | Real[Array, ""]) -> Bool[Array, ""]:
        """Whether a step is shorter than a unit of rounding of the times.

        Of such steps some would have length zero and others twice the length or more.
        """
        start, end = lax.stop_gradient((self.t0, self.t1))
        largest = jnp.maximum(jnp.abs(start), jnp.abs(end))
        spacing = largest - jnp.nextafter(largest, jnp.zeros_like(largest))
        is_short = (start != end) & (jnp.abs(end - start) / intervals < spacing)
        return is_short | (intervals > max_steps(start.dtype))


class GivenTimes(eqx.Module):
    """Steps from t0 to each of the times `ts`. Infinity at their end is no step."""

    t0: Real[Array, ""]
    ts: Real[Array, " n"]

    @property
    def num_steps(self) -> int:
        return self.ts.size

    def grid(self) -> Grid:
        given = jnp.concatenate([self.t0[None], self.ts])
        is_given = ~jnp.isinf(given)
        steps = jnp.sum(is_given[1:], dtype=jnp.int32)
        # What is no step has the length zero, so that all of its numbers are finite.
        times = jnp.where(is_given, given, given[steps])
        start, stop = times[:-1], times[1:]
        is_forward = times[1] > times[0]
        follows = jnp.where(is_forward, stop > start, stop < start)
        is_last_infinite = jnp.all(is_given[:-1] | ~is_given[1:])
        fault = Fault.none().with_case(
            ~(jnp.all(follows | ~is_given[1:]) & is_last_infinite),
            "ts must increase from t0 on, or decrease, in the precision of y0, "
            f"{times.dtype}, and may have infinity only after all other times.",
        )
        fault = fault.with_case(
            jnp.isinf(self.t0), f"t0 must be finite, got infinity (in {times.dtype}, that of y0)."
        )
        return Grid(
            jnp.asarray(0, jnp.int32),
            lambda n: times[n],
            times[-1],
            fault,
            is_step=lambda n, m: jnp.maximum(n, m) <= steps,
        )


def max_steps(dtype) -> int:
    """How many equal steps can be counted in the dtype of the times."""
    return 2 ** (jnp.finfo(dtype).nmant + 1)
