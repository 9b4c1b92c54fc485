"""Linear stability of commutator-free methods, from the tableau alone."""

from typing import Any

import numpy as np
from jaxtyping import Complex, Inexact

from .coefficients import Product
from .tableau import Tableau

Number = int | float | complex | Inexact[np.ndarray, "..."]


def stability_function(tableau: Tableau, z: Number, w: Number) -> Complex[np.ndarray, "..."]:
    """The factor by which a step multiplies the solution of `u' = (lambda + omega) u`.

    `lambda` is in the exact flow and `omega` is explicit, as in the paper's heat problem: the field
    frozen at p is the affine `u -> lambda u + omega p`. A step of size h is stable if the absolute
    value of the factor is at most 1. For `z = 0` this is the stability polynomial of the classical
    Runge-Kutta method, and for `w = 0` the exact `exp(z)`.

    **Arguments:** `z = h lambda` and `w = h omega`, complex numbers or arrays that broadcast.

    **Returns:** a NumPy array, complex128, of the broadcast shape; infinite or NaN where a step
    overflows, as it does for large negative `z` if rows of the tableau have a negative sum.

    **Raises** `TypeError` if `tableau` is not a `cfjax.Tableau`.
    """
    if not isinstance(tableau, Tableau):
        raise TypeError(f"tableau must be a cfjax.Tableau, got {tableau!r}.")
    z, w = np.broadcast_arrays(np.asarray(z, complex), np.asarray(w, complex))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(_step(tableau, z, w))


def _step(tableau: Tableau, z: Any, w: Any) -> Any:
    """The end of a step from 1."""
    stages: list[Any] = []
    points: dict[Product, Any] = {(): np.ones_like(z)}
    for rows in (*tableau.alpha, tableau.beta):
        for j, row in enumerate(rows):
            if rows[: j + 1] not in points:
                # The sum of the frozen fields is the affine field u -> a z u + b.
                a = float(sum(row))
                b = sum((float(c) * w * y for c, y in zip(row, stages, strict=False)), 0 * w)
                points[rows[: j + 1]] = np.exp(a * z) * points[rows[:j]] + _phi_1(a * z) * b
        stages.append(points[rows])
    return stages[-1]


def _phi_1(z: Any) -> Any:
    """`(exp(z) - 1) / z`, which is 1 at 0."""
    nonzero = np.where(z == 0, 1, z)
    return np.where(z == 0, 1, np.expm1(nonzero) / nonzero)
