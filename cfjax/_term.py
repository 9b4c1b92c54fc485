"""`LieTerm`: a field of frozen vector fields as a diffrax term."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree, Real

from ._arrays import describe, struct
from ._field import Rest, combine, is_field, tangent

_ARRAY_TYPES = jax.Array | np.ndarray | np.generic | int | float | complex


class LieTerm(diffrax.AbstractTerm):
    """The term `f(t, y, args) dt` of an ordinary differential equation on a manifold.

    `field(t, y, args)` returns the frozen vector field at `y`: a pytree whose structure is a
    prefix of the state's, with an `AbstractFrozenField`, an array (a translation) or None (a part
    at rest) for each part.

    ```python
    def field(t, y, args):
        return cfjax.Rotation(-y / args)

    term = cfjax.LieTerm(field)
    ```

    A step of cfjax calls it at times within the step, at its ends by a few units of rounding, so
    the field may jump where steps end.

    What the field returns is checked against the state once, when the program is traced. A part of
    wrong structure, shape or dtype raises a `TypeError` or `ValueError` that names its place in the
    state. A Python scalar takes the state's dtype.

    If every part is a translation, this is an ordinary term, and every diffrax solver accepts it.
    With frozen fields diffrax's own solvers either refuse the term (Tsit5, Dopri5 and most others)
    or make ordinary steps in the ambient space, which leave the manifold (Euler, Heun, Midpoint and
    others), as `vf_prod` is the tangent vector. So `diffrax.BacksolveAdjoint()` works: it
    integrates backwards in the ambient space, where a solver of cfjax is a Runge-Kutta method.
    """

    field: Callable[[Any, Any, Any], PyTree]

    def __check_init__(self):
        if not callable(self.field):
            raise TypeError(f"field must be a function of t, y and args, got {self.field!r}.")

    def vf(self, t: Any, y: PyTree, args: PyTree) -> PyTree:
        return checked(self.field(t, y, args), y)

    def contr(self, t0: Any, t1: Any, **kwargs: Any) -> Any:
        return t1 - t0

    def prod(self, vf: PyTree, control: float | Real[Array, ""]) -> PyTree:
        return combine((control,), (vf,))

    def vf_prod(self, t: Any, y: PyTree, args: PyTree, control: Any) -> PyTree:
        return tangent(self.prod(self.vf(t, y, args), control), y)


def product(terms: diffrax.AbstractTerm, value: PyTree, control: PyTree) -> PyTree:
    """The product of the value of a term's vector field and the control: a frozen field.

    `diffrax.MultiTerm` would add the arrays within the fields of its terms, whatever they are, a
    spectrum too.

    **Raises** `TypeError` for a term that cannot multiply a frozen field, or a sum of terms whose
    fields are of different kinds.
    """
    if isinstance(terms, diffrax.MultiTerm):
        products = [product(*each) for each in zip(terms.terms, value, control, strict=True)]
        return combine([1.0] * len(products), products)
    if not any(map(is_field, jtu.tree_leaves(value, is_leaf=is_field))):
        return terms.prod(value, control)
    if isinstance(value, tuple) and isinstance(control, tuple):
        raise TypeError(
            "A diffrax.MultiTerm of frozen fields must not be wrapped in another term, got "
            f"{type(terms).__name__}. Wrap its terms, or return the sum from one field."
        )
    try:
        return terms.prod(value, control)
    except ValueError as error:
        raise TypeError(
            "The term cannot multiply a frozen field by its control, "
            f"{describe(control)}: use cfjax.LieTerm(field). A diffrax.ControlTerm multiplies "
            "arrays only. To drive a field by x(t), multiply it by dx/dt in a LieTerm."
        ) from error


def velocity(terms: diffrax.AbstractTerm, value: PyTree, y: PyTree) -> PyTree:
    """The velocity at `y` of the value of a term's vector field there, shaped like the state.

    That of a `diffrax.MultiTerm` is the sum. Where a term has a control of another kind than time
    there is no velocity, and this is the value itself, as in diffrax's own solvers.
    """
    if isinstance(terms, diffrax.MultiTerm):
        velocities = [velocity(*each, y) for each in zip(terms.terms, value, strict=True)]
        if all(struct(v) == struct(y) for v in velocities):
            return combine([1.0] * len(velocities), velocities)
        return value
    if any(map(is_field, jtu.tree_leaves(value, is_leaf=is_field))):
        return tangent(value, y)
    return value


def checked(field: PyTree, y: PyTree) -> PyTree:
    """The field that a term's function returned, checked to act on `y`.

    **Raises** `TypeError` or `ValueError` that names the part of the state.
    """
    if field is None and y is not None:
        raise ValueError(
            "The field of a term must return one field for each part of the state, got None. Does "
            "the function have a return statement? For a part at rest return None if the state has "
            "several parts, and zeros otherwise."
        )
    is_part = lambda x: x is None or is_field(x)  # noqa: E731
    parts, treedef = jtu.tree_flatten_with_path(field, is_leaf=is_part)
    try:
        points = treedef.flatten_up_to(y)
    except ValueError as error:
        raise ValueError(
            "The field of a term must return a pytree whose structure is a prefix of the "
            f"state's. Got {eqx.tree_pformat(field)} for the state {describe(y)}: {error} Return "
            "one field for each part of the state; plain numbers take their velocity as an array."
        ) from error
    return treedef.unflatten(
        checked_part("y" + jtu.keystr(path), part, point)
        for (path, part), point in zip(parts, points, strict=True)
    )


def checked_part(place: str, part: Any, point: PyTree) -> Any:
    if part is None:
        return Rest()
    if is_field(part):
        name = type(part).__name__
        if not part.acts_on_subtree and not jtu.all_leaves([point]):
            raise TypeError(
                f"The field returned {name} for {place}. It acts on one array, but the state has "
                f"{describe(point)} there. Return one field for each array; or, if {name} acts on "
                f"all of them, write `acts_on_subtree = True` in the class."
            )
        try:
            velocity = eqx.filter_eval_shape(type(part).tangent, part, point)
        except (TypeError, ValueError) as error:
            # Not the error's own class: some of JAX's cannot be created from a text.
            error_type = TypeError if isinstance(error, TypeError) else ValueError
            raise error_type(
                f"The field returned {name} for {place}, where the state is {describe(point)}. "
                f"It does not act there: {error}"
            ) from error
        if struct(velocity) != struct(point):
            raise ValueError(
                f"The field returned {name} for {place}. Its tangent is {describe(velocity)}, but "
                f"the state is {describe(point)} there. Shape and dtype must agree."
                f"{_complex_advice(velocity, point)}"
            )
        _check_precision(place, part, point)
        return part
    if not isinstance(part, _ARRAY_TYPES) or not jtu.all_leaves([point]):
        raise TypeError(
            f"The field returned {describe(part)} for {place}, where the state is "
            f"{describe(point)}. Expected a frozen field, or an array of the state's shape and "
            "dtype (a translation)."
        )
    if _is_scalar_for(part, jnp.result_type(point)):
        part = jnp.asarray(part, jnp.result_type(point))
    if struct(part) != struct(point) or not jnp.issubdtype(jnp.result_type(part), jnp.inexact):
        raise ValueError(
            f"The field returned a translation of type {describe(part)} for {place}, where the "
            f"state is {describe(point)}. Shape and dtype must agree, and be floating or complex."
            f"{_complex_advice(part, point)}"
        )
    return jnp.asarray(part)


def _complex_advice(velocity: PyTree, point: PyTree) -> str:
    is_complex = [any(map(jnp.iscomplexobj, jtu.tree_leaves(x))) for x in (velocity, point)]
    advice = " The field is complex and the state is real: make y0 complex."
    return advice if is_complex == [True, False] else ""


def _check_precision(place: str, field: Any, point: PyTree) -> None:
    # Under JAX's standard promotion the tangent would hide it, and the field's rounding would
    # become the state's drift.
    precisions = {_precision(p) for p in jtu.tree_leaves(point)}
    for path, leaf in jtu.tree_leaves_with_path(field):
        if eqx.is_inexact_array(leaf) and _precision(leaf) not in precisions:
            raise TypeError(
                f"The field returned {type(field).__name__} for {place}, where the state is "
                f"{describe(point)}. Its {jtu.keystr(path)} is {describe(leaf)}. Both must have "
                "one precision: convert what the field is made of with jnp.asarray(x, y.dtype)."
            )


def _precision(x: Any) -> Any:
    dtype = jnp.result_type(x)
    return jnp.finfo(dtype).dtype if jnp.issubdtype(dtype, jnp.inexact) else dtype


def _is_scalar_for(part: Any, dtype: Any) -> bool:
    """Whether `part` is a Python number without a precision of its own that `dtype` can hold."""
    kind = jnp.complexfloating if type(part) is complex else jnp.inexact
    return type(part) in (int, float, complex) and jnp.issubdtype(dtype, kind)
