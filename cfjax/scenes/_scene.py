"""The protocol of a scene, and what many scenes use: methods of charts, solves, and a reference."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import diffrax
import jax
import numpy as np
from jaxtyping import Array

import cfjax

from ._figures import Figure


@runtime_checkable
class Scene(Protocol):
    """What every scene has. A scene is a module, and these are names in it.

    Three names are optional:

    - `chart(**options)`: the work-precision data, by `cfjax.work_precision`, which takes the
      options. A scene of several problems has one `chart_NAME` for each. A scene with noise has
      none, as errors of a mean are mostly those of the sample.
    - `error(y, exact)`: the error of a state, if it is not the 2-norm of the difference.
    - `velocity(t, y, args)`: the same field in plain space, for `diffrax.ODETerm`.

    All others, such as `y0`, `field` and `energy`, are those of the problem.
    """

    @property
    def solver(self) -> diffrax.AbstractSolver:
        """The method that README recommends for the field, or another one with the reason."""
        ...

    @property
    def reference(self) -> Callable[..., Any]:
        """The exact state at a time, or with noise its mean. The docstring says how exact it is."""
        ...

    def problem(self) -> dict[str, Any]:
        """What is solved, as arguments of `cfjax.integrate` and `cfjax.work_precision`."""
        ...

    def invariants(self, y: Any, args: Any) -> dict[str, Array]:
        """What stays, or goes one way, as its name says."""
        ...

    def picture(self) -> Figure:
        """A figure of the solution. The first line says to which time, if that is not `t1`."""
        ...


# Methods of a chart, with stages in plain space.
PROJECTED = cfjax.Projected(diffrax.Tsit5()), cfjax.Projected(diffrax.Dopri8())


def by_name(*solvers: diffrax.AbstractSolver, term: Any = None) -> dict[str, Any]:
    """Methods of a chart, each by the name of its class, with what it projects, or coordinates of
    its steps that are not exponential. They solve `term`, if it is given.
    """

    def name(solver: diffrax.AbstractSolver) -> str:
        detail = getattr(solver, "coordinates", "exponential")
        if isinstance(solver, cfjax.Projected):
            detail = solver.name
        return type(solver).__name__ + ("" if detail == "exponential" else f", {detail}")

    methods = {name(solver): solver for solver in solvers}
    return methods if term is None else {name: (term, s) for name, s in methods.items()}


def in_plain_space(
    velocity: Callable[..., Any], *solvers: diffrax.AbstractSolver
) -> dict[str, Any]:
    """Methods of diffrax for the same chart, which do not stay on the manifold."""
    return by_name(*solvers, term=diffrax.ODETerm(velocity))


def solve(
    problem: dict[str, Any], solver: diffrax.AbstractSolver, **options: Any
) -> tuple[np.ndarray, Any]:
    """Times and states in NumPy, by `cfjax.integrate`.

    `options` are arguments of it too, and replace those of `problem`.
    """
    sol = cfjax.integrate(**problem | options, solver=solver)
    return np.asarray(sol.ts), jax.tree.map(np.asarray, sol.ys)


def by_dop853(
    rate: Callable[[float, Any], Any],
    start: Any,
    t: float,
    *,
    rtol: float = 1e-13,
    atol: float = 1e-13,
) -> Any:
    """The solution of `y' = rate(t, y)` at time `t`, from `start` at time zero, by SciPy's DOP853.

    `start`, and what `rate` takes and returns, is an array in NumPy's float64 or complex128, or a
    pytree of them.
    """
    # Not at import: few who import the package need it.
    from scipy.integrate import solve_ivp

    leaves, treedef = jax.tree.flatten(start)
    ends = np.cumsum([_numbers(leaf).size for leaf in leaves])[:-1]

    def flatten(y: Any) -> np.ndarray:
        return np.concatenate([_numbers(leaf) for leaf in treedef.flatten_up_to(y)])

    def unflatten(flat: np.ndarray) -> Any:
        parts = zip(np.split(flat, ends), leaves, strict=True)
        return treedef.unflatten(part.view(x.dtype).reshape(x.shape) for part, x in parts)

    solution = solve_ivp(
        lambda t, flat: flatten(rate(t, unflatten(flat))),
        (0.0, t),
        flatten(start),
        "DOP853",
        rtol=rtol,
        atol=atol,
    )
    return unflatten(np.ascontiguousarray(solution.y[:, -1]))


def _numbers(leaf: np.ndarray) -> np.ndarray:
    """Its entries in one row, complex ones as two."""
    return np.ascontiguousarray(leaf).ravel().view(float)
