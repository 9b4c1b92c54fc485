"""Output within a step, on the manifold."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from .._field import combine, flow, leave
from .._methods.tableau import ContinuousExtension
from .._xla import by_components
from .stages import along, can_loop


class Interpolation(diffrax.AbstractLocalInterpolation):
    """The solution within a step, by the maps of the step itself, so it stays on the manifold.

    The time may lie outside the step: then it extrapolates.
    """

    t0: Any
    t1: Any
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
    """The fields of a step, where it starts, and the continuous extension that they go into.

    Arrays that occur several times are kept once: of fields on a common span, every block of
    columns is in all that came after it. Which are the same is seen from the objects: within one
    trace, the same object is the same value, and a copy that is not seen costs memory only. What is
    kept is put back in all its places, so fields on a common span know it as one again.
    """

    arrays: tuple[Array | np.ndarray, ...]
    places: tuple[int, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)
    continuous_extension: ContinuousExtension = eqx.field(static=True)
    # Where a combination of the fields leads from a point.
    move: Callable[[PyTree, PyTree], PyTree] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        continuous_extension: ContinuousExtension,
        start: PyTree,
        fields: list[PyTree],
        move: Callable[[PyTree, PyTree], PyTree] = flow,
    ) -> "Path":
        leaves, structure = jtu.tree_flatten((start, fields))
        arrays = {id(leaf): leaf for leaf in leaves}
        index = {key: i for i, key in enumerate(arrays)}
        places = tuple(index[id(leaf)] for leaf in leaves)
        return cls(tuple(arrays.values()), places, structure, continuous_extension, move)

    def parts(self, arrays: tuple[Array | np.ndarray, ...]) -> tuple[PyTree, list[PyTree]]:
        """The start and the fields that are made of these arrays."""
        return jtu.tree_unflatten(self.structure, [arrays[i] for i in self.places])

    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""

        def end(arrays: tuple[Array | np.ndarray, ...]) -> PyTree:
            point, fields = self.parts(arrays)
            rows = [_polynomials(powers, theta) for powers in self.continuous_extension]
            if self.move is flow and len(rows) > 1 and can_loop(fields[0], point):
                return along(rows, fields, point)
            for weights in rows:
                used = [(w, f) for w, f in zip(weights, fields, strict=False) if w is not None]
                point = self.move(combine(*zip(*used, strict=True)), point)
            return leave(fields[0], point)

        return by_components(end, self.arrays)


def _polynomials(powers: Any, theta: Any) -> list[Any]:
    """The weight of each stage, `sum_i powers[i] theta^(i+1)`; None if it is zero throughout."""
    weights = []
    for coefficients in zip(*powers, strict=True):
        total = 0.0
        for a in reversed(coefficients):
            total = (total + float(a)) * theta
        weights.append(total if any(coefficients) else None)
    return weights
