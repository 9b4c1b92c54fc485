"""`LieControlTerm`: frozen fields that are driven by a path, such as Brownian motion."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ._arrays import describe
from ._field import flow, has_default_combine, is_field, tangent
from ._numerics.checks import Fault
from ._numerics.linearity import Linearity, linearity
from ._term import checked

_HAS_DRIFT = (
    "The field of a cfjax.LieControlTerm must be linear in increment, and it is not zero where the "
    "increment is zero. Return from it only what the increment causes, and move the rest, such as "
    "a drift, to a term of its own: diffrax.MultiTerm(cfjax.LieTerm(drift), "
    "cfjax.LieControlTerm(field, control))."
)
_IS_NOT_LINEAR = (
    "The field of a cfjax.LieControlTerm must be linear in increment, and that of a sum of two "
    "increments is not the sum of their fields. Coefficients may depend only on t, y and args."
)
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

    cfjax interprets Brownian motion as Stratonovich noise. With `cfjax.LieEuler` it is Itô noise.
    The noise of n sites with m channels each is one field of an
    increment of shape (n, m): one evaluation, whatever the numbers. The path's value is read once
    a step.

    What the field causes without an increment, such as `-y` in `-y + increment`, belongs to a
    `cfjax.LieTerm` beside this term, in a `diffrax.MultiTerm`.

    **Arguments:** `field`, a function; `control`, a `diffrax.AbstractPath`.

    **Raises** `TypeError` for arguments of other types. What `field` returns is checked as that of
    a `cfjax.LieTerm`. `ValueError` when the program is traced if it shows a field that is not zero
    where the increment is, or has products of the increment with itself. If a program does not show
    whether the field is linear, a method of cfjax compares its values at the start of a solve: a
    runtime error if it is not.
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

    def vf(self, t: Any, y: PyTree, args: PyTree) -> "_Unevaluated":
        return _Unevaluated.of(t, y, args)

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

    def prod(self, vf: "_Unevaluated", control: PyTree) -> PyTree:
        t, y, args = vf.values()
        field = checked(self.field(t, y, args, control), y)
        self._linearity(vf, control)
        return field

    def vf_prod(self, t: Any, y: PyTree, args: PyTree, control: PyTree) -> PyTree:
        return tangent(self.prod(self.vf(t, y, args), control), y)

    def fault(self, fault: Fault, t: Any, y: PyTree, args: PyTree, control: PyTree) -> Fault:
        """`fault`, with a case for values that are not linear, if the program does not show it.

        The values are at a state to which the field leads, as a start is often special. `control`
        is an increment, or its shapes and dtypes.

        **Raises** `ValueError` if the program says that it is not linear, or reads an entry that
        the increment does not have.
        """
        dependences = self._linearity(_Unevaluated.of(t, y, args), control)
        self._check_indices(t, y, args, control)
        if all(d.power <= 1 and d.constant == "zero" for d in dependences):
            return fault
        rng = np.random.default_rng(0)
        normal_like = lambda x: jnp.asarray(rng.normal(size=x.shape), x.dtype)  # noqa: E731

        def increment(sign: float) -> PyTree:
            # The two on either side of zero, and far from it: neither rectified nor rounded alike.
            scaled = lambda x: jnp.asarray(sign * rng.uniform(1, 2, x.shape), x.dtype)  # noqa: E731
            return jtu.tree_map(scaled, control)

        a, b = increment(1.0), increment(-1.0)

        def field_at(y: PyTree, increment: PyTree) -> PyTree:
            return checked(self.field(t, y, args, increment), y)

        def state_after(y: PyTree, increment: PyTree) -> PyTree:
            # For a translation, which is the same everywhere, any point will do.
            field = field_at(y, increment)
            end = flow(field, y)
            return jtu.tree_map(
                lambda f, y: y if is_field(f) else y + normal_like(y), field, end, is_leaf=is_field
            )

        # Both away from the start: the field is frozen at y1, and its velocity taken at y2.
        y1 = state_after(y, a)
        y2 = state_after(y1, b)

        def arrays(k: float, n: float) -> list[Array]:
            combination = jtu.tree_map(lambda a, b: k * a + n * b, a, b)
            return _linear_arrays(field_at(y1, combination), y2)

        is_nonlinear, has_drift = jnp.zeros((), bool), jnp.zeros((), bool)
        for x0, xa, xb, x in zip(
            *map(arrays, (0.0, 1.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.3)), strict=True
        ):
            max_abs = lambda x: jnp.max(jnp.abs(x), initial=0)  # noqa: E731
            eps, size = float(jnp.finfo(x.dtype).eps), max_abs(xa) + max_abs(xb)
            # Half of the digits. A zero may be the rounding of terms that cancel.
            is_nonlinear |= max_abs(x - (xa + 0.3 * xb)) > np.sqrt(eps) * size
            has_drift |= max_abs(x0) > 100 * eps * size
        return fault.with_case(is_nonlinear, _IS_NOT_LINEAR).with_case(has_drift, _HAS_DRIFT)

    def _check_indices(self, t: Any, y: PyTree, args: PyTree, control: PyTree) -> None:
        """JAX would clamp an index that is out of bounds. NumPy raises an error."""
        zeros = jtu.tree_map(lambda x: np.broadcast_to(np.zeros((), x.dtype), x.shape), control)
        try:
            eqx.filter_eval_shape(lambda: self.field(t, y, args, zeros))
        except IndexError as error:
            raise ValueError(
                "The field reads an entry that its increment does not have, which is "
                f"{describe(control)}: {error}."
            ) from error
        except Exception:
            # What JAX traces above need not take arrays of NumPy.
            return

    def _linearity(self, vf: "_Unevaluated", control: PyTree) -> list[Linearity]:
        """How the arrays of the field depend on the increment, as far as its program shows."""

        def arrays(control: PyTree, state: PyTree, args: PyTree) -> list[Array]:
            t, y, point = state
            t, y, args = eqx.tree_at(lambda vf: vf.arrays, vf, (t, y, args)).values()
            return _linear_arrays(self.field(t, y, args, control), point)

        t, y, args = vf.arrays
        dependences = linearity(arrays, control, (t, y, y), args)
        for dependence in dependences:
            if dependence.constant == "some":
                raise ValueError(_HAS_DRIFT)
            if dependence.power == 2:
                raise ValueError(_IS_NOT_LINEAR)
        return dependences


def _linear_arrays(field: PyTree, point: PyTree) -> list[Array]:
    """Arrays that are linear in a field: its leaves, or its velocity at a point.

    The leaves are linear if the class has the default `combine`.
    """
    parts, treedef = jtu.tree_flatten(field, is_leaf=lambda x: x is None or is_field(x))
    arrays = []
    for part, y in zip(parts, treedef.flatten_up_to(point), strict=True):
        has_velocity = is_field(part) and not has_default_combine(type(part))
        linear = tangent(part, y) if has_velocity else part
        arrays += [x for x in map(jnp.asarray, jtu.tree_leaves(linear)) if eqx.is_inexact_array(x)]
    return arrays


def fault_of_increments(
    fault: Fault,
    terms: PyTree[diffrax.AbstractTerm],
    t0: Any,
    t1: Any,
    y0: PyTree,
    args: PyTree,
) -> Fault:
    """`fault`, with a case for each term driven by a path that is not linear in the increment."""
    is_control_term = lambda x: isinstance(x, LieControlTerm)  # noqa: E731
    for term in filter(is_control_term, jtu.tree_leaves(terms, is_leaf=is_control_term)):
        control = eqx.filter_eval_shape(term.contr, t0, t1)
        fault = term.fault(fault, t0, y0, args, control)
    return fault


class _Unevaluated(eqx.Module):
    """The arguments of a field that is evaluated once the increment is known.

    diffrax takes it for the value of the vector field, so its leaves are arrays.
    """

    arrays: PyTree
    static: tuple[Any, ...] = eqx.field(static=True)
    treedef: Any = eqx.field(static=True)

    @classmethod
    def of(cls, *values: Any) -> "_Unevaluated":
        arrays, static = eqx.partition(values, eqx.is_array)
        leaves, treedef = jtu.tree_flatten(static)
        return cls(arrays, tuple(leaves), treedef)

    def values(self) -> Any:
        return eqx.combine(self.arrays, jtu.tree_unflatten(self.treedef, self.static))


def paths(terms: PyTree[diffrax.AbstractTerm]) -> list[diffrax.AbstractPath]:
    """The paths that drive these terms."""
    is_path = lambda x: isinstance(x, diffrax.AbstractPath)  # noqa: E731
    return list(filter(is_path, jtu.tree_leaves(terms, is_leaf=is_path)))


def is_driven(terms: PyTree[diffrax.AbstractTerm]) -> bool:
    """Whether a path drives one of these terms, be it noise or not."""
    return bool(paths(terms))
