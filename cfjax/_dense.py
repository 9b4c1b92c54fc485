"""Output between the steps."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree


class NodeInterpolation(diffrax.AbstractLocalInterpolation):
    """The solution at the two ends of a step, and an error in between.

    A straight line between two points leaves the manifold and is of second order only. A solver
    without an interpolation on the manifold refuses instead.
    """

    t0: Any
    t1: Any
    y0: PyTree
    y1: PyTree

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree:
        """The solution at time `t0`, which must be an end of the step up to rounding.

        **Raises** a runtime error for any other time.
        """
        del left
        if t1 is not None:
            start, end = self.evaluate(t0), self.evaluate(t1)
            return jtu.tree_map(jnp.subtract, end, start)
        # A few units of rounding in the times themselves: they are sums of step sizes.
        eps = jnp.finfo(jnp.result_type(self.t1)).eps
        slack = 8 * eps * jnp.maximum(jnp.abs(self.t0), jnp.abs(self.t1))
        at_start = jnp.abs(t0 - self.t0) <= slack
        at_end = jnp.abs(t0 - self.t1) <= slack
        y = jtu.tree_map(lambda a, b: jnp.where(at_end, b, a), self.y0, self.y1)
        return eqx.error_if(
            y,
            ~(at_start | at_end),
            "This cfjax solver has no output between steps. Let the steps end at the times you "
            "save: use stepsize_controller=diffrax.StepTo(ts) with SaveAt(ts=ts), or "
            "SaveAt(steps=...). Events must not use a root finder.",
        )
