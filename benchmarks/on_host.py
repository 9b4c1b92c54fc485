"""Solves by SciPy, most of them references."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

# The least relative tolerance that SciPy takes.
LEAST = 2.3e-14


def solve(
    velocity: Callable[[float, np.ndarray], Any],
    t1: float,
    y0: np.ndarray,
    *,
    method: Any = "DOP853",
    rtol: float = LEAST,
    atol: float | None = None,
) -> np.ndarray:
    """The state at `t1`, from `y0` at 0. By default the tolerances are equal."""

    def ode(t: float, y: np.ndarray) -> np.ndarray:
        return np.asarray(velocity(t, y.reshape(y0.shape))).ravel()

    atol = rtol if atol is None else atol
    solution = solve_ivp(ode, (0.0, t1), y0.ravel(), method, rtol=rtol, atol=atol)
    return solution.y[:, -1].reshape(y0.shape)
