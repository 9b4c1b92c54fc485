"""Output between the steps."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ._frozen_field import combine, flow, leave
from ._tableau import Extension


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


class FlowInterpolation(diffrax.AbstractLocalInterpolation):
    """The solution within a step, by flows as the step itself, so it stays on the manifold.

    The time may lie outside the step: then it extrapolates.
    """

    t0: Any
    t1: Any
    y0: PyTree
    y1: PyTree
    path: "Path"

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree:
        """The solution at time `t0`, or what is added to it from `t0` to `t1`."""
        del left
        if t1 is not None:
            start, end = self.evaluate(t0), self.evaluate(t1)
            return jtu.tree_map(jnp.subtract, end, start)
        with jax.numpy_dtype_promotion("standard"):
            length = jnp.asarray(self.t1 - self.t0)
            # A solve from a time to the same time makes no step, and asks for its end.
            theta = (t0 - self.t0) / jnp.where(length == 0, 1, length)
        return self.path.point(theta)


class Path(eqx.Module):
    """The fields of a step and where it starts, with the extension that they are to go into.

    Arrays that occur several times are kept once: in fields on a common span most do. And the
    fields stay on a common span only if its arrays are still the same.
    """

    arrays: tuple[Array, ...]
    places: tuple[int, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)
    extension: Extension = eqx.field(static=True)

    @classmethod
    def of(cls, extension: Extension, start: PyTree, fields: list[PyTree]) -> "Path":
        leaves, structure = jtu.tree_flatten((start, fields))
        arrays = {id(leaf): leaf for leaf in leaves}
        index = {key: i for i, key in enumerate(arrays)}
        places = tuple(index[id(leaf)] for leaf in leaves)
        return cls(tuple(arrays.values()), places, structure, extension)

    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""
        leaves = [self.arrays[i] for i in self.places]
        point, fields = jtu.tree_unflatten(self.structure, leaves)
        for powers in self.extension:
            weights = _polynomials(powers, theta)
            used = [(w, f) for w, f in zip(weights, fields, strict=False) if w is not None]
            point = flow(combine(*zip(*used, strict=True)), point)
        return leave(fields[0], point)


def _polynomials(powers: Any, theta: Any) -> list[Any]:
    """The weight of each stage, `sum_i powers[i] theta^(i+1)`; None if it is zero throughout."""
    weights = []
    for coefficients in zip(*powers, strict=True):
        total = 0.0
        for a in reversed(coefficients):
            total = (total + float(a)) * theta
        weights.append(total if any(coefficients) else None)
    return weights
