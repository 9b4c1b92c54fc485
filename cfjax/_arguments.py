"""Checks of the arguments of a solve, before anything is traced."""

import typing
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.stages import Traced
from jaxtyping import Array, PyTree, Real


def time_dtype(y0: PyTree) -> Any:
    """The floating dtype of the state. Times of another dtype would promote it."""
    leaves = jtu.tree_leaves(y0)
    with jax.numpy_dtype_promotion("standard"):
        return jnp.finfo(jnp.result_type(*leaves) if leaves else float).dtype


def time_scalar(name: str, t: Any, dtype: Any) -> Real[Array, ""]:
    is_number = isinstance(t, jax.Array | np.ndarray | np.generic | int | float)
    kinds = jnp.integer, jnp.floating
    is_real = is_number and any(jnp.issubdtype(jnp.result_type(t), kind) for kind in kinds)
    if not is_real or jnp.shape(t):
        raise TypeError(f"{name} must be a real scalar, got {eqx.tree_pformat(t)}.")
    return jnp.asarray(t, dtype)


def check_term_and_solver(term: Any, solver: Any) -> None:
    is_term = lambda x: isinstance(x, diffrax.AbstractTerm)  # noqa: E731
    terms, treedef = jtu.tree_flatten(term, is_leaf=is_term)
    if not terms or not all(map(is_term, terms)):
        raise TypeError(f"term must be a diffrax term, such as cfjax.LieTerm(field), got {term!r}.")
    if not isinstance(solver, diffrax.AbstractSolver):
        raise TypeError(f"solver must be a diffrax solver, such as cfjax.CF4(), got {solver!r}.")
    # As `diffrax.diffeqsolve`, but for the types within a generic one.
    expected, expected_treedef = jtu.tree_flatten(solver.term_structure)
    classes = [typing.get_origin(c) or c for c in expected]
    if treedef != expected_treedef or not all(map(isinstance, terms, classes)):
        raise TypeError(
            f"{type(solver).__name__} takes a term of the form {solver.term_structure}, got "
            f"{eqx.tree_pformat(term)}."
        )


def check_own_tolerances(solver: Any) -> None:
    """Refuses an implicit solver without tolerances: equal steps have no controller with any."""
    while isinstance(solver, diffrax.AbstractWrappedSolver):
        solver = solver.solver
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        root_finder = solver.root_finder
        # The default is a marker: take those of the step size controller.
        tolerances = [getattr(root_finder, name, None) for name in ("rtol", "atol")]
        if not all(map(eqx.is_inexact_array_like, tolerances)):
            name = type(solver).__name__
            module = "diffrax." if getattr(diffrax, name, None) is type(solver) else ""
            raise ValueError(
                "solver must have tolerances of its own, as equal steps do not provide any, got "
                f"{name} without. Write {module}{name}(root_finder=diffrax.VeryChord(rtol=1e-8, "
                "atol=1e-8, norm=optimistix.rms_norm))."
            )


def as_state(y0: PyTree) -> PyTree:
    """The state as arrays, in a precision in which one can integrate.

    **Raises** `TypeError` for leaves that are not numbers.
    """

    def as_array(path: Any, leaf: Any) -> Array:
        is_number = isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float | complex)
        if not is_number or not _is_numeric(getattr(leaf, "dtype", None) or np.result_type(leaf)):
            raise TypeError(
                f"y0{jtu.keystr(path)} must be an array of numbers, got {eqx.tree_pformat(leaf)}."
            )
        array = jnp.asarray(leaf)
        # As diffrax promotes them. In half precision no error estimate is worth its name.
        is_precise = jnp.issubdtype(array.dtype, jnp.inexact) and array.dtype.itemsize >= 4
        return array if is_precise else array.astype(float)

    return jtu.tree_map_with_path(as_array, y0)


def _is_numeric(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.number) or jnp.issubdtype(dtype, jnp.bool_)


def count(name: str, value: Any) -> int:
    if isinstance(value, Tracer):
        raise TypeError(
            f"{name} must be known when the program is traced, got {value!r}. Close over it, or "
            f'write jax.jit(..., static_argnames="{name}").'
        )
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}.")
    return int(value)


def captures_traced(program: Traced, inputs: PyTree) -> bool:
    """Whether a program captures values that are traced elsewhere: jax makes these inputs too."""
    return len(program.jaxpr.in_avals) != len(jtu.tree_leaves(inputs))
