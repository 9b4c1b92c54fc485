"""Error against tolerance, and against flows, for every embedded pair: the rigid body.

Run as `python benchmarks/tolerances.py`. It writes `tolerances.png` next to itself. Every pair
runs with `diffrax.PIDController(rtol=0, atol=tolerance)`.
"""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.integrate import solve_ivp

import cfjax
from cfjax.scenes import rigid_body

END = 10.0
TOLERANCES = np.logspace(-4, -10, 7)
PAIRS = ["CF3", "CF4", "CF43", "CF54", "CG3", "BWRRK53", "CK34", "Luscher3"]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
    for name in PAIRS:
        solver = getattr(cfjax, name)()
        tableau = solver.tableau
        flows = tableau.num_flows + tableau.num_companion_flows
        errors, steps = zip(*(_solve(solver, tolerance) for tolerance in TOLERANCES), strict=True)
        axes[0].loglog(TOLERANCES, errors, "o-", markersize=3, label=name)
        axes[1].loglog(flows * np.array(steps), errors, "o-", markersize=3)
        per_tolerance = np.array(errors) / TOLERANCES
        print(f"{name:10} error / tolerance {per_tolerance.min():.2g} to {per_tolerance.max():.2g}")
    axes[0].loglog(TOLERANCES, TOLERANCES, "k:", label="error = tolerance")
    axes[0].set_xlabel("tolerance")
    axes[1].set_xlabel("flows")
    axes[0].set_ylabel(f"error at t = {END:g}")
    axes[0].legend(fontsize="small")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=120)


def _solve(solver: diffrax.AbstractSolver, tolerance: float) -> tuple[float, int]:
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(rigid_body.field),
        solver,
        0.0,
        END,
        0.01,
        jnp.asarray(rigid_body.y0),
        jnp.asarray(rigid_body.inertia),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=jnp.asarray(tolerance)),
        max_steps=None,
    )
    assert sol.ys is not None
    return float(jnp.linalg.norm(sol.ys[-1] - _reference())), int(sol.stats["num_steps"])


def _reference() -> np.ndarray:
    def ode(t: float, y: np.ndarray) -> np.ndarray:
        return np.cross(y, y / np.asarray(rigid_body.inertia))

    y0 = np.asarray(rigid_body.y0)
    return solve_ivp(ode, (0, END), y0, method="DOP853", rtol=2.3e-14, atol=1e-15).y[:, -1]


if __name__ == "__main__":
    main()
