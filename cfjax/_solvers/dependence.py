"""Which fields depend on the state or on time, which some methods exclude."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._field import is_field, to_chart


def state_dependent(field: Callable[[PyTree], PyTree], y0: PyTree) -> list[tuple[str, Any]]:
    """The parts of `field(y)` that depend on y or on being frozen there, each with its place."""
    return _dependent_parts(lambda y: (field(y), y), y0)


def time_dependent(field: Callable[[Any], PyTree], t: Any, y: PyTree) -> list[tuple[str, Any]]:
    """The parts of `field(t)` that depend on t, each with its place; y is any state."""
    return _dependent_parts(lambda t: (field(t), y), t)


def _dependent_parts(
    fun: Callable[[PyTree], tuple[PyTree, PyTree]], x: PyTree
) -> list[tuple[str, Any]]:
    """The parts of a field that depend on x, where `fun(x)` is the field and its state."""

    def parts(x: PyTree) -> list[tuple[Any, PyTree]]:
        frozen, y = fun(x)
        parts, treedef = jtu.tree_flatten_with_path(frozen, is_leaf=is_field)
        charted = treedef.flatten_up_to(to_chart(frozen, y, ())[0])
        names = [(jtu.keystr(path), part) for path, part in parts]
        return list(zip(names, charted, strict=True))

    dependent = dependents(parts, x)
    return [("", None)] if dependent is None else dependent


def dependents(fun: Callable[[PyTree], list[tuple[Any, PyTree]]], x: PyTree) -> list[Any] | None:
    """The names of those values of `fun(x)`, pairs of a name and a value, that depend on x.

    Under `jax.vmap` over x alone, what does not depend on it has no axis of the batch. That sees
    through every operation, and takes shapes and dtypes of x for what they are. (A derivative would
    not see comparisons.) None where something has no rule for batches, such as a function of the
    host: it may depend on all that it gets.

    **Raises** what `fun(x)` itself raises.
    """
    dependent: list[Any] = []

    def probe_values(x: PyTree) -> PyTree:
        for name, value in fun(x):

            def rule(size, is_mapped, leaves, name=name):
                dependent.append(name)
                return leaves, is_mapped[0]

            probe = jax.custom_batching.custom_vmap(lambda leaves: leaves)
            probe.def_vmap(rule)
            probe(jtu.tree_leaves(value))
        return x

    if jtu.tree_leaves(x):
        batched = jtu.tree_map(
            lambda x: jax.ShapeDtypeStruct((1, *jnp.shape(x)), jnp.result_type(x)), x
        )
        try:
            jax.eval_shape(jax.vmap(probe_values), batched)
        except Exception:
            # If the field itself is wrong, this raises its own error.
            eqx.filter_eval_shape(fun, x)
            return None
    return dependent


def unknown_dependence(name: str) -> str:
    """The cause of a dependence on `name` for which no part is known, for an error message."""
    return (
        f"The field gives {name} to a function of the host (jax.pure_callback without vmap_method, "
        "or jax.experimental.io_callback), or to another operation that JAX has no rule for in a "
        f"batch. What that returns counts as dependent on {name}"
    )
