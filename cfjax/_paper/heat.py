"""The heat conduction experiment of the paper: its Table 4 and Figure 4, and steps against N.

Source: Celledoni, Marthinsen & Owren, Commutator-free Lie group methods, FGCS 19 (2003),
Section 3.3.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from rich.progress import Progress
from rich.table import Table

from .. import CF4, RKMK4, LieTerm, Richardson
from .._measure.report import Report
from .._measure.style import STYLES, finish, new_figure
from ..scenes import heat

TOLERANCES = tuple(10.0**-k for k in range(2, 8))
# The paper does not state the first step, the interval, and the maximum norm for the estimate. With
# these the numbers of steps are the paper's.
FIRST_STEP = 5e-3
INTERVALS = 100
FIGURE_TOLERANCES = (1e-3, 1e-6)
SIZES = (30, 100, 300, 1000)
STIFFNESS_TOLERANCE = 1e-3
FINDINGS = """\
The paper finds: RK4 is at its stability limit at every tolerance, RKMK4 is stiff down to about \
1e-5, and CF4 has no stability limitation at all.
Here: the same. At 1e-6 RKMK4 is stiff in the last third of the time only, and before that takes \
longer steps than CF4."""

# Table 4 as printed: global error, attempted steps, rejected steps.
PRINTED = {
    "CF4": (
        (6.1e-2, 8, 0),
        (2.8e-2, 17, 0),
        (4.5e-3, 57, 0),
        (7.5e-4, 168, 8),
        (8.8e-5, 399, 8),
        (1.4e-5, 784, 6),
    ),
    "RKMK4": (
        (2.0e-1, 235, 19),
        (2.1e-2, 237, 17),
        (2.9e-3, 237, 26),
        (3.6e-4, 236, 23),
        (9.4e-5, 296, 10),
        (1.4e-5, 623, 4),
    ),
    "RK4": (
        (1.3e-1, 1776, 3),
        (1.4e-2, 1777, 2),
        (1.4e-3, 1778, 2),
        (1.2e-4, 1779, 2),
        (1.3e-5, 1781, 2),
        (2.0e-6, 1785, 3),
    ),
}


class Method(NamedTuple):
    """A solver, and the form of the problem that it works on."""

    solver: diffrax.AbstractSolver
    term: LieTerm
    to_grid: Callable[[Array], Array]  # the grid values of a state


class Run(NamedTuple):
    """One integration with adaptive steps."""

    t: Float[np.ndarray, " steps"]  # the ends of accepted steps
    num_steps: int  # attempted
    num_rejected: int
    error: float  # of the grid values at the end, in the 2-norm


METHODS = {
    "CF4": Method(CF4(), LieTerm(heat.field), heat.to_grid),
    "RKMK4": Method(RKMK4(), LieTerm(heat.field), heat.to_grid),
    # On translations CF4 is the classical Runge-Kutta method.
    "RK4": Method(CF4(), LieTerm(heat.grid_field), lambda u: u),
}


class Controller(diffrax.AbstractAdaptiveStepSizeController):
    """The paper's step sizes: `h_new = 0.9 (atol / err)^(1/(p+1)) h`, accepted if `err <= atol`.

    `diffrax.PIDController` has the same rule, but never shrinks the step after an accepted one. So
    at the limit of stability it rejects every eighth step, unlike the paper.
    """

    atol: Any
    norm: Callable[[Any], Any]
    rtol: Any = 0.0

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return t0 + dt0, ()

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        error = self.norm(y_error)
        accepted = error <= self.atol
        # Bounds for estimates of zero and infinity only.
        factor = jnp.clip(0.9 * (self.atol / error) ** (1 / error_order), 1e-3, 1e3)
        next_t0 = jnp.where(accepted, t1, t0)
        next_t1 = next_t0 + (t1 - t0) * factor
        return accepted, next_t0, next_t1, False, controller_state, diffrax.RESULTS.successful


def report(
    progress: Progress,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    sizes: Sequence[int] = SIZES,
) -> Report:
    """Table 4, Figure 4, and a figure of the steps needed against the number of intervals."""
    cases = [(name, tol) for name in METHODS for tol in tolerances]
    runs = {
        (name, tol): adaptive(METHODS[name], tol)
        for name, tol in progress.track(cases, description="Heat, tolerances")
    }
    cases = [(name, size) for name in METHODS for size in sizes]
    stiff = {
        (name, size): adaptive(METHODS[name], STIFFNESS_TOLERANCE, size)
        for name, size in progress.track(cases, description="Heat, intervals")
    }
    return Report(
        printed=[table_4(runs), FINDINGS],
        figures={"figure4": figure_4(runs), "heat_stiffness": figure_stiffness(stiff)},
    )


def adaptive(method: Method, tolerance: float, num_intervals: int = INTERVALS) -> Run:
    """The integration to t = 1/2 with the paper's error estimate and step sizes."""
    diffusivity = heat.diffusivity(num_intervals)
    args = jax.tree.map(jnp.asarray, diffusivity)
    y0 = jnp.asarray(heat.y0(num_intervals))
    t, u, stats = _solve(method, jnp.asarray(tolerance), y0, args)
    exact = heat.reference(heat.t1, np.asarray(diffusivity.mu))
    return Run(
        t=np.asarray(t)[np.isfinite(t)],
        num_steps=int(stats["num_steps"]),
        num_rejected=int(stats["num_rejected_steps"]),
        error=float(np.linalg.norm(u - exact)),
    )


@eqx.filter_jit
def _solve(method: Method, tolerance: Array, y0: Array, args: heat.Diffusivity):
    """Times of the steps, with infinity behind them, grid values at the end, and statistics."""
    if method.term.field is heat.grid_field:
        y0 = heat.to_grid(y0)
    solution = diffrax.diffeqsolve(
        method.term,
        Richardson(method.solver, as_in_paper=True),
        heat.t0,
        heat.t1,
        FIRST_STEP,
        y0,
        args,
        saveat=diffrax.SaveAt(
            subs=(
                diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: t),
                diffrax.SubSaveAt(t1=True),
            )
        ),
        stepsize_controller=Controller(
            atol=tolerance, norm=lambda error: jnp.max(jnp.abs(method.to_grid(error)))
        ),
        max_steps=2**18,
    )
    assert solution.ys is not None
    t, y = solution.ys
    return t, method.to_grid(y[-1]), solution.stats


def table_4(runs: Mapping[tuple[str, float], Run]) -> Table:
    table = Table(
        title="Table 4, heat conduction, N = 100: global error (2-norm), attempted steps "
        "(rejected ones)",
        caption=_differences(runs),
    )
    table.add_column("tol")
    table.add_column("")
    for name in METHODS:
        table.add_column(name, justify="right")
    for tol in sorted({tol for _, tol in runs}, reverse=True):
        printed = [PRINTED[name][TOLERANCES.index(tol)] for name in METHODS]
        table.add_row(f"{tol:.0e}", "paper", *(_cell(*row) for row in printed))
        measured = [runs[name, tol] for name in METHODS]
        cells = [_cell(run.error, run.num_steps, run.num_rejected) for run in measured]
        table.add_row("", "here", *cells, end_section=True)
    return table


def _differences(runs: Mapping[tuple[str, float], Run]) -> str:
    """Which errors are not those printed."""
    found: dict[str, list[str]] = {}
    for (name, tol), run in runs.items():
        ratio = run.error / PRINTED[name][TOLERANCES.index(tol)][0]
        if not 1 / 2 < ratio < 2:
            found.setdefault(name, []).append(f"{ratio:.2g} at {tol:.0e}")
    if not found:
        return ""
    ratios = "; ".join(f"{name} {', '.join(each)}" for name, each in found.items())
    return (
        f"Errors over the printed ones, if not within a factor of two: {ratios}. The reason is not "
        "known: no first step, norm or treatment of the last step that was tried gives the "
        "printed errors of CF4 in the printed numbers of steps."
    )


def _cell(error: float, num_steps: int, num_rejected: int) -> str:
    return f"{error:.1e} {num_steps:>5} {f'({num_rejected})':>4}"


def figure_4(runs: Mapping[tuple[str, float], Run]) -> Figure:
    """Step sizes against time."""
    loose, strict = FIGURE_TOLERANCES
    steps = {key: run.num_steps for key, run in runs.items()}
    limit = np.median(np.diff(runs["RK4", strict].t))
    figure = new_figure(
        (7.0, 7.2),
        "Heat conduction, N = 100: sizes of the steps that were kept, after Figure 4 of Celledoni, "
        "Marthinsen & Owren (2003). The paper finds RK4 stiff at both tolerances, RKMK4 at the "
        "loose one only, and CF4 at none. Here RK4 keeps to its limit of stability, "
        f"h = {limit:.2e}. RKMK4 at {strict:g} meets its own only towards the end, and until then "
        f"needs fewer steps than CF4. Attempted steps at {loose:g}: CF4 {steps['CF4', loose]}, "
        f"RKMK4 {steps['RKMK4', loose]}, RK4 {steps['RK4', loose]}; at {strict:g}: "
        f"{steps['CF4', strict]}, {steps['RKMK4', strict]}, {steps['RK4', strict]}.",
    )
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, tol in ((upper, loose), (lower, strict)):
        for name in METHODS:
            t = np.concatenate([[heat.t0], runs[name, tol].t])
            # Without the last step, which is cut to meet the end.
            label = name if axes is upper else None
            style = STYLES[name] | {"marker": ""}
            axes.semilogy(t[:-2], np.diff(t)[:-1], label=label, **style)
        axes.set_ylabel(f"step size, tolerance {tol:g}")
    lower.set_xlabel("time t (dimensionless)")
    lower.set_xlim(heat.t0, heat.t1)
    finish(figure, len(METHODS))
    return figure


def figure_stiffness(runs: Mapping[tuple[str, int], Run]) -> Figure:
    """Attempted steps against the number of intervals."""
    sizes = sorted({size for _, size in runs})
    counts = ", ".join(f"{name} {runs[name, sizes[-1]].num_steps}" for name in METHODS)
    figure = new_figure(
        (7.0, 4.8),
        f"Heat conduction: steps attempted to t = 1/2 at tolerance {STIFFNESS_TOLERANCE:g} against "
        "the number of intervals N. Stability bounds the steps of RK4, through the whole operator, "
        "and of RKMK4, through the commutator, which contains M undamped. So their number grows "
        f"like N². Attempted steps at N = {sizes[-1]}: {counts}.",
    )
    axes = figure.subplots()
    for name in METHODS:
        steps = [runs[name, size].num_steps for size in sizes]
        axes.loglog(sizes, steps, label=name, markersize=5, **STYLES[name])
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.set_xlabel("number of intervals N")
    axes.set_ylabel("attempted steps")
    finish(figure, len(METHODS))
    return figure
