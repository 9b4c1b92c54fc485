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

from .._field import combine, flow, from_chart
from .._methods.tableau import ContinuousExtension
from .compiled import scalarised
from .stacked import can_roll, rolled_flows


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
    """The solution within a step, for dense output."""

    @abc.abstractmethod
    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""


class Substeps(AbstractPath):
    """The path of a step of several substeps, each of which has the same part of its time."""

    interpolations: Sequence[diffrax.AbstractLocalInterpolation]

    def point(self, theta: Any) -> PyTree:
        theta = theta * len(self.interpolations)
        current = jnp.clip(jnp.ceil(theta) - 1, 0, len(self.interpolations) - 1)
        # Output takes longer to compile than its operands to select: once for all of one structure.
        groups: dict[Any, list[int]] = {}
        for k, interpolation in enumerate(self.interpolations):
            groups.setdefault(jtu.tree_structure(interpolation), []).append(k)
        points = [self._nearest(indices, theta, current) for indices in groups.values()]
        point, _ = points[0]
        for candidate, is_current in points[1:]:
            point = jtu.tree_map(lambda a, b: jnp.where(is_current, b, a), point, candidate)  # noqa: B023
        return point

    def _nearest(self, indices: list[int], theta: Any, current: Any) -> tuple[PyTree, Any]:
        """The output of the substep `current`, and whether it is one of `indices`."""
        candidates = jnp.asarray(indices, theta.dtype)
        nearest = jnp.argmin(jnp.abs(candidates - current))
        arrays, static = zip(
            *(eqx.partition(self.interpolations[k], eqx.is_array) for k in indices), strict=True
        )
        arrays = jtu.tree_map(lambda *xs: jnp.stack(xs)[nearest], *arrays)
        interpolation, index = eqx.combine(arrays, static[0]), candidates[nearest]
        is_current, c = index == current, theta - index
        # The others are evaluated at a time of their own, as another may be an error there.
        c = jnp.where(is_current, c, jnp.clip(c, 0, 1))
        # Not `time_at`, which jumps to the end of a step, so its derivative is zero there.
        time = interpolation.t0 + c * (interpolation.t1 - interpolation.t0)
        return interpolation.evaluate(time), is_current


class Path(AbstractPath):
    """The start and the fields of a step, and the continuous extension that combines them.

    An array that occurs several times is stored once: fields on a common span share their blocks of
    columns. Equal arrays are recognised as equal objects: within one trace the same object is the
    same value, and a copy that is missed costs memory only. `unflatten` puts one object in
    all places of an array, so the fields share their span again.
    """

    arrays: tuple[Array | np.ndarray, ...]
    indices: tuple[int, ...] = eqx.field(static=True)
    treedef: Any = eqx.field(static=True)
    continuous_extension: ContinuousExtension = eqx.field(static=True)
    # `apply_flow(field, point)` is the end of the flow of a combination of the fields.
    apply_flow: Callable[[PyTree, PyTree], PyTree] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        continuous_extension: ContinuousExtension,
        start: PyTree,
        fields: list[PyTree],
        apply_flow: Callable[[PyTree, PyTree], PyTree] = flow,
    ) -> "Path":
        leaves, treedef = jtu.tree_flatten((start, fields))
        arrays = {id(leaf): leaf for leaf in leaves}
        positions = {key: i for i, key in enumerate(arrays)}
        indices = tuple(positions[id(leaf)] for leaf in leaves)
        return cls(tuple(arrays.values()), indices, treedef, continuous_extension, apply_flow)

    def unflatten(self, arrays: tuple[Array | np.ndarray, ...]) -> tuple[PyTree, list[PyTree]]:
        """The start and the fields with these arrays as leaves."""
        return jtu.tree_unflatten(self.treedef, [arrays[i] for i in self.indices])

    def point(self, theta: Any) -> PyTree:
        """The solution at a part `theta` of the step."""
        powers, theta = _by_power(self.continuous_extension), jnp.asarray(theta)
        num_flows = powers.shape[1]
        point, fields = self.unflatten(self.arrays)
        # For small states too: an event's root finder differentiates this, and in batches a loop of
        # flows on short vectors is as fast.
        if self.apply_flow is flow and num_flows > 1 and can_roll(None, fields[0], point):
            # There may be no field at the end of the step, where it has no weight.
            rows = powers.swapaxes(0, 1)[..., : len(fields)].astype(theta.dtype)
            weights = functools.partial(_polynomials, theta=theta)
            return rolled_flows(rows, fields, point, flow, weights)

        weights = _polynomials(powers, theta)

        def evaluate(arrays: tuple[Array | np.ndarray, ...]) -> PyTree:
            point, fields = self.unflatten(arrays)
            for j in range(num_flows):
                nonzero = np.flatnonzero(powers[:, j].any(axis=0))
                row = [(weights[j, k], fields[k]) for k in nonzero]
                point = self.apply_flow(combine(*zip(*row, strict=True)), point)
            return from_chart(fields[0], point)

        return scalarised(evaluate, self.arrays)


@functools.lru_cache
def _by_power(extension: ContinuousExtension) -> Float[np.ndarray, "powers flows stages"]:
    """The coefficients as one array, with zeros where a flow has fewer powers than another."""
    shape = max(map(len, extension)), len(extension), len(extension[0][0])
    padded = np.zeros(shape)
    for j, powers in enumerate(extension):
        padded[: len(powers), j] = np.array(powers, float)
    return padded


def _polynomials(
    powers: Real[np.ndarray | Array, "powers *shape"], theta: Real[Array, ""]
) -> Real[Array, "*shape"]:
    """The weights of fields, `sum_i powers[i] theta^(i+1)`.

    One array: number by number they would be most of the program of output within a step.
    """
    *lower, total = powers.astype(theta.dtype)
    total = total * theta
    for coefficients in reversed(lower):
        total = (total + coefficients) * theta
    return total
