"""`LieControlTerm`: frozen fields that are driven by a path, such as Brownian motion."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from ._field import tangent
from ._term import checked

_INTERPOLATIONS = diffrax.AbstractGlobalInterpolation, diffrax.AbstractLocalInterpolation


class LieControlTerm(diffrax.AbstractTerm):
    """The term `g(t, y, args) dx(t)` of an equation on a manifold that is driven by a path x.

    `field(t, y, args, increment)` returns the frozen field that this increment of the path causes
    at `y`. It must be linear in `increment`, which is shaped like the path's value. Its structure
    is that of a `cfjax.LieTerm`'s field, with None for each part of the state at rest.

    ```python
    noise = diffrax.UnsafeBrownianPath((3,), key)

    def thermal(t, y, args, increment):
        return cfjax.Rotation(args["strength"] * increment)

    term = diffrax.MultiTerm(cfjax.LieTerm(drift), cfjax.LieControlTerm(thermal, noise))
    ```

    With Brownian motion this is noise in the sense of Stratonovich, but with `cfjax.LieEuler`,
    which takes it in the sense of Itô. The noise of n sites with m channels each is one field of an
    increment of shape (n, m): one evaluation, whatever the numbers. The path's value is read once
    a step.

    **Arguments:** `field`, a function; `control`, a `diffrax.AbstractPath`.

    **Raises** `TypeError` for arguments of other types. What `field` returns is checked as that of
    a `cfjax.LieTerm`.
    """

    field: Callable[[Any, Any, Any, Any], PyTree]
    control: diffrax.AbstractPath

    def __check_init__(self):
        if not callable(self.field):
            raise TypeError(
                f"field must be a function of t, y, args and increment, got {self.field!r}."
            )
        if not isinstance(self.control, diffrax.AbstractPath):
            raise TypeError(
                "control must be a diffrax.AbstractPath, such as diffrax.UnsafeBrownianPath, got "
                f"{self.control!r}."
            )

    def vf(self, t: Any, y: PyTree, args: PyTree) -> "_Place":
        return _Place.of(t, y, args)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> PyTree:
        if isinstance(self.control, _INTERPOLATIONS):
            # diffrax subtracts their values as if each were one array.
            start, end = self.control.evaluate(t0), self.control.evaluate(t1)
            return jtu.tree_map(jnp.subtract, end, start)
        if not isinstance(self.control, diffrax.AbstractBrownianPath):
            return self.control.evaluate(t0, t1)
        # Brownian motion is drawn forwards in time.
        is_back = t1 < t0
        start, end = jnp.minimum(t0, t1), jnp.maximum(t0, t1)
        value = self.control.evaluate(start, end, **kwargs)
        return jtu.tree_map(lambda x: jnp.where(is_back, -x, x), value)

    def prod(self, vf: "_Place", control: PyTree) -> PyTree:
        t, y, args = vf.all()
        return checked(self.field(t, y, args, control), y)

    def vf_prod(self, t: Any, y: PyTree, args: PyTree, control: PyTree) -> PyTree:
        return tangent(self.prod(self.vf(t, y, args), control), y)


class _Place(eqx.Module):
    """Where the field is to be evaluated once the increment is known. Its leaves are arrays."""

    arrays: PyTree
    others: tuple[Any, ...] = eqx.field(static=True)
    structure: Any = eqx.field(static=True)

    @classmethod
    def of(cls, *values: Any) -> "_Place":
        arrays, others = eqx.partition(values, eqx.is_array)
        leaves, structure = jtu.tree_flatten(others)
        return cls(arrays, tuple(leaves), structure)

    def all(self) -> Any:
        return eqx.combine(self.arrays, jtu.tree_unflatten(self.structure, self.others))


def paths(terms: PyTree[diffrax.AbstractTerm]) -> list[diffrax.AbstractPath]:
    """The paths that drive these terms."""
    is_path = lambda x: isinstance(x, diffrax.AbstractPath)  # noqa: E731
    return list(filter(is_path, jtu.tree_leaves(terms, is_leaf=is_path)))


def is_driven(terms: PyTree[diffrax.AbstractTerm]) -> bool:
    """Whether a path drives one of these terms, be it noise or not."""
    return bool(paths(terms))
