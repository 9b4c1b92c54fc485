"""Output within a step, on the manifold."""

import abc
import functools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree, Real

from .._field import combine, from_chart
from .._methods.tableau import ContinuousExtension
from .base import time_at
from .compiled import scalarised
from .stacked import can_roll, rolled_flows
from .sums import flow_once


class Interpolation(diffrax.AbstractLocalInterpolation):
    """The solution within a step, by the maps of the step itself, so it stays on the manifold.

    The time may lie outside the step: then it extrapolates.
    """

    t0: Any
    t1: Any
    path: "AbstractPath"

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> PyTree:
        """The solution at time `t0`, or what is added to it from `t0` to `t1`."""
        del left
        if t1 is not None:
            start, end = self.evaluate(t0), self.evaluate(t1)
            return jtu.tree_map(jnp.subtract, end, start)
        with jax.numpy_dtype_promotion("standard"):
            length = jnp.asarray(self.t1 - self.t0)
            # A solve from a time to the same time makes no step, and asks for its end.
            return self.path.point((t0 - self.t0) / jnp.where(length == 0, 1, length))


class AbstractPath(eqx.Module):
    """The way of a step, for output within it."""

    @abc.abstractmethod
    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""


class Substeps(AbstractPath):
    """The way of a step that is made of several, of which each has the same part of its time."""

    parts: Sequence[diffrax.AbstractLocalInterpolation]

    def point(self, theta: Any) -> PyTree:
        theta = theta * len(self.parts)
        now = jnp.clip(jnp.ceil(theta) - 1, 0, len(self.parts) - 1)
        # Output takes longer to compile than to choose what it is made of: once for all alike.
        kinds: dict[Any, list[int]] = {}
        for k, part in enumerate(self.parts):
            kinds.setdefault(jtu.tree_structure(part), []).append(k)
        points = [self._chosen(places, theta, now) for places in kinds.values()]
        point, _ = points[0]
        for other, is_now in points[1:]:
            point = jtu.tree_map(lambda a, b: jnp.where(is_now, b, a), point, other)  # noqa: B023
        return point

    def _chosen(self, places: list[int], theta: Any, now: Any) -> tuple[PyTree, Any]:
        """The output of the part at `now`, and whether it is one of these."""
        here = jnp.asarray(places, theta.dtype)
        nearest = jnp.argmin(jnp.abs(here - now))
        arrays, rest = zip(
            *(eqx.partition(self.parts[k], eqx.is_array) for k in places), strict=True
        )
        arrays = jtu.tree_map(lambda *xs: jnp.stack(xs)[nearest], *arrays)
        part, place = eqx.combine(arrays, rest[0]), here[nearest]
        is_now, c = place == now, theta - place
        # Other parts are asked at a time of their own: another may be an error there.
        c = jnp.where(is_now, c, jnp.clip(c, 0, 1))
        return part.evaluate(time_at(c, part.t0, part.t1)), is_now


class Path(AbstractPath):
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
    apply_flow: Callable[[PyTree, PyTree], PyTree] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        continuous_extension: ContinuousExtension,
        start: PyTree,
        fields: list[PyTree],
        apply_flow: Callable[[PyTree, PyTree], PyTree] = flow_once,
    ) -> "Path":
        leaves, structure = jtu.tree_flatten((start, fields))
        arrays = {id(leaf): leaf for leaf in leaves}
        index = {key: i for i, key in enumerate(arrays)}
        places = tuple(index[id(leaf)] for leaf in leaves)
        return cls(tuple(arrays.values()), places, structure, continuous_extension, apply_flow)

    def parts(self, arrays: tuple[Array | np.ndarray, ...]) -> tuple[PyTree, list[PyTree]]:
        """The start and the fields that are made of these arrays."""
        return jtu.tree_unflatten(self.structure, [arrays[i] for i in self.places])

    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""
        powers, theta = _by_power(self.continuous_extension), jnp.asarray(theta)
        num_flows = powers.shape[1]
        point, fields = self.parts(self.arrays)
        # Of small states too: an event's root finder differentiates it, and a loop of flows on
        # short vectors is as fast in batches.
        if self.apply_flow is flow_once and num_flows > 1 and can_roll(None, fields[0], point):
            # There may be no field at the end of the step, where it has no weight.
            rows = powers.swapaxes(0, 1)[..., : len(fields)].astype(theta.dtype)
            weights = functools.partial(_polynomials, theta=theta)
            return rolled_flows(rows, fields, point, flow_once, weights)

        weights = _polynomials(powers, theta)

        def end(arrays: tuple[Array | np.ndarray, ...]) -> PyTree:
            point, fields = self.parts(arrays)
            for j in range(num_flows):
                used = np.flatnonzero(powers[:, j].any(axis=0))
                row = [(weights[j, k], fields[k]) for k in used]
                point = self.apply_flow(combine(*zip(*row, strict=True)), point)
            return from_chart(fields[0], point)

        return scalarised(end, self.arrays)


@functools.lru_cache
def _by_power(extension: ContinuousExtension) -> Float[np.ndarray, "powers flows stages"]:
    """Its coefficients; flows may have different numbers of powers."""
    size = max(map(len, extension)), len(extension), len(extension[0][0])
    found = np.zeros(size)
    for j, powers in enumerate(extension):
        found[: len(powers), j] = np.array(powers, float)
    return found


def _polynomials(
    powers: Real[np.ndarray | Array, "powers *rest"], theta: Real[Array, ""]
) -> Real[Array, "*rest"]:
    """The weights of fields, `sum_i powers[i] theta^(i+1)`.

    One array: number by number they would be most of the program of output within a step.
    """
    *rest, total = powers.astype(theta.dtype)
    total = total * theta
    for coefficients in reversed(rest):
        total = (total + coefficients) * theta
    return total
