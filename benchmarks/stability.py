"""Where methods fail: regions of stability, and errors of steps that are too large or too close.

The picture has a panel for each. A second one has the regions of stabilised methods.
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import cfjax
import results
from cfjax._paper import heat as paper_heat
from cfjax.scenes import heat, rigid_body

BLUE, RED, GREEN, PINK, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#777777"
TERM = cfjax.LieTerm(rigid_body.field)
# The same field in space, for methods that know nothing of the sphere.
SPACE = diffrax.ODETerm(lambda t, y, args: jnp.cross(y, y / args))

Curves = Iterator[tuple[Any, ...]]  # a label, a list of places, and lists of values over it


def measure(quick: bool) -> Iterator[results.Row]:
    for name, panel in MEASURED.items():
        for label, x, *values in panel():
            lists = [[results.digits(v) for v in row] for row in (x, *values)]
            yield {"panel": name, "curve": label, "x": lists[0], "y": lists[1:]}


def draw() -> dict[str, Figure]:
    figure = Figure(figsize=(14, 12.5), layout="constrained")
    grid = figure.subplots(3, 3)
    for panel, axes in zip(PANELS, grid.flat, strict=True):
        panel(axes)
        axes.title.set_fontsize(10)
        axes.grid(color="0.9", linewidth=0.6)
        axes.set_axisbelow(True)
    return {"stability": figure, "regions": stabilised_regions()}


def stabilised_regions(s: int = 11) -> Figure:
    """Where a step does not grow, on the same axes, with as many stages."""
    z = np.linspace(-85, 5, 1800) + 1j * np.linspace(-13, 13, 520)[:, None]
    # The halves of a step need as many stages as reach half as far.
    half = next(m for m in range(3, s + 1, 2) if _reach(m, 1) >= _reach(s, 1) / 2)
    of_halves = _stabilised(half, 1, z / 2) ** 2
    growths = {
        f"RKL2, {s} evaluations": _stabilised(s, 1, z),
        f"RKG2, {s} evaluations": _stabilised(s, 3, z),
        f"RKL3, {s + 2 * half - 1} evaluations": (4 * of_halves - _stabilised(s, 1, z)) / 3,
        f"RKC, {s} evaluations, not in cfjax": _chebyshev(s, z),
        "CF4, 4 evaluations": sum(z**k / math.factorial(k) for k in range(5)),
    }
    figure = Figure(figsize=(10, 9), layout="constrained")
    colors = (BLUE, GREEN, RED, PINK, GREY)
    panels = figure.subplots(len(growths), 1, sharex=True)
    for axes, color, (name, growth) in zip(panels, colors, growths.items(), strict=True):
        axes.contourf(z.real, z.imag, np.abs(growth), levels=[0, 1], colors=[color], alpha=0.25)
        axes.contour(z.real, z.imag, np.abs(growth), levels=[1], colors=[color], linewidths=1.2)
        for sign in (-1, 1):
            wedge = np.array([0, -85]), np.array([0, sign * 85 * np.tan(np.radians(5))])
            axes.plot(*wedge, ":", color="0.5", linewidth=0.8)
        axes.set(aspect="equal", ylabel="Im z")
        axes.set_title(name, fontsize=10)
    panels[-1].set(xlabel="Re z, where z is an eigenvalue times the step; dotted: a wedge of 5°")
    return figure


def _reach(s: int, l: int) -> float:  # noqa: E741
    """How far s stages are stable on the negative axis, with twice the index of the polynomials."""
    return (s - 1) * (s + l + 1) * 2 / (l + 3)


def _stabilised(s: int, l: int, z: np.ndarray) -> np.ndarray:  # noqa: E741
    """The growth of a step of RKL2, for which l is 1, or RKG2, for which it is 3."""
    b = (l + 1) * (s - 1) * (s + l + 1) / ((l + 3) * s * (s + l))
    x = 1 + 2 * z / _reach(s, l)
    # The polynomials of Gegenbauer that are 1 at 1.
    before, now = np.ones_like(x), x
    for j in range(2, s + 1):
        before, now = now, ((2 * j + l - 2) * x * now - (j - 1) * before) / (j + l - 1)
    return 1 - b + b * now


def _chebyshev(s: int, z: np.ndarray) -> np.ndarray:
    """The growth of a step of RKC, with the damping 2/13 of its authors."""
    shift = 1 + 2 / 13 / s**2
    t = np.polynomial.Chebyshev.basis(s)
    first, second = t.deriv()(shift), t.deriv(2)(shift)
    b = second / first**2
    return 1 - b * t(shift) + b * t(shift + first / second * z)


def curves(panel: str) -> Curves:
    for row in results.pick(results.load("stability")["rows"], panel=panel):
        # None in the file stands for numbers that are not finite.
        yield row["curve"], row["x"], *(np.array(y, float) for y in row["y"])


def regions_of_cf3(axes: Axes) -> None:
    _regions(axes, cfjax.CF3(), "CF3")


def regions_of_cf4(axes: Axes) -> None:
    _regions(axes, cfjax.CF4(), "CF4")


def _regions(axes: Axes, solver: Any, name: str) -> None:
    """Where a step with the exact part z does not grow, in the plane of the explicit part w."""
    w = np.linspace(-13, 19, 700) + 1j * np.linspace(-13, 13, 700)[:, None]
    for z, color in zip((0, -2, -5, -10), (GREY, BLUE, GREEN, RED), strict=True):
        growth = np.abs(cfjax.stability_function(solver.tableau, z, w))
        axes.contour(w.real, w.imag, growth, levels=[1], colors=[color], linewidths=1.6)
        axes.plot(
            [], [], color=color, label=f"z = {z}" + (" (RK4)" if z == 0 and name == "CF4" else "")
        )
        if z == 0:
            axes.contourf(w.real, w.imag, growth, levels=[0, 1], colors=[color], alpha=0.25)
    axes.set(
        title=f"{name} for u' = (λ + ω) u: stable inside\nz = hλ in the flow, w = hω explicit",
        xlabel="Re w",
        ylabel="Im w",
        aspect="equal",
    )
    axes.legend(fontsize=8, loc="upper right")


def rotations() -> Curves:
    """Error and distance from the sphere after t = 100, in ever larger steps."""
    counts = np.unique(np.geomspace(2, 20_000, 24).astype(int))
    exact, radius = rigid_body.reference(100.0), np.linalg.norm(rigid_body.y0)
    methods = {
        "CF3": (TERM, cfjax.CF3()),
        "CF4": (TERM, cfjax.CF4()),
        "RKMK4": (TERM, cfjax.RKMK4()),
        "RK4 in space": (SPACE, cfjax.CF4()),
    }
    for name, (term, solver) in methods.items():
        ends = np.array([_rigid_body_end(term, solver, 100.0, n) for n in counts])
        # In space the largest steps overflow.
        ends[np.abs(ends).max(axis=1) > 1e10] = np.nan
        error = np.linalg.norm(ends - exact, axis=1)
        off = np.abs(np.linalg.norm(ends, axis=1) - radius)
        yield name, 100 / counts, error, off


def large_rotations(axes: Axes) -> None:
    colors = (GREEN, BLUE, RED, GREY)
    for (name, h, error, off), color in zip(curves("rotations"), colors, strict=True):
        axes.loglog(h, error, color=color, label=name)
        # Zero has no place on a logarithmic axis.
        axes.loglog(h, np.maximum(off, 1e-16), color=color, linestyle=":")
    axes.axhline(2 * float(np.linalg.norm(rigid_body.y0)), color="0.6", linewidth=0.8)
    axes.plot([], [], color="0.3", linestyle=":", label="distance from the sphere")
    axes.set(
        title="Rigid body at t = 100: on the sphere at every step,\n"
        "but never accurate above one radian",
        xlabel="step h (about the angle of a step)",
        ylabel="error",
        ylim=(1e-17, 1e2),
    )
    axes.legend(fontsize=8, loc="center right")


def families() -> Curves:
    """The error of 32 steps of the third-order families close to excluded parameters."""
    distances = np.geomspace(0.1, 1e-9, 17)
    for label, family, singular, side in (
        ("first family at 1/3 + d", cfjax.third_order_a, 1 / 3, 1),
        ("second family at 1 - d", cfjax.third_order_b, 1.0, -1),
    ):
        solvers = [cfjax.CommutatorFree(family(singular + side * d)) for d in distances]
        for dtype in (np.float64, np.float32):
            errors = [_driven_error(solver, 32, dtype) for solver in solvers]
            yield f"{label}, {np.dtype(dtype).name}", distances, errors


def near_singular_parameters(axes: Axes) -> None:
    looks = itertools.product((BLUE, RED), ("-", "--"))
    for (name, distances, errors), (color, style) in zip(curves("families"), looks, strict=True):
        axes.loglog(distances, errors, color=color, linestyle=style, label=name)
    distances = np.array([0.1, 1e-9])
    for eps in (2.0**-24, 2.0**-53):
        walk = eps / (2 * distances) / np.sqrt(32)
        axes.loglog(distances, walk, color="0.6", linewidth=0.8, linestyle=":")
    axes.plot([], [], color="0.6", linestyle=":", label="rounding / 2d, as a random walk")
    axes.invert_xaxis()
    axes.set(
        title="Families of order 3 near excluded parameters:\n"
        "close stages magnify rounding, a far one errs",
        xlabel="distance d from the excluded parameter",
        ylabel="error",
        ylim=(1e-10, 1e5),
    )
    axes.legend(fontsize=8, loc="upper left")


def precisions() -> Curves:
    """The error at t = 10 in both precisions."""
    counts = np.geomspace(20, 100_000, 18).astype(int)
    exact = rigid_body.reference(10.0)
    for dtype in (np.float32, np.float64):
        ends = np.array([_rigid_body_end(TERM, cfjax.CF4(), 10.0, n, dtype) for n in counts])
        yield np.dtype(dtype).name, 10 / counts, np.linalg.norm(ends - exact, axis=1)


def single_precision(axes: Axes) -> None:
    for (dtype, h, error), color in zip(curves("precisions"), (RED, BLUE), strict=True):
        axes.loglog(h, error, color=color, label=f"CF4, {dtype}")
        walk = 3 * np.finfo(dtype).eps / 2 * np.sqrt(10 / np.array(h))
        axes.loglog(h, walk, color=color, linestyle=":", linewidth=1)
    axes.plot(
        [],
        [],
        color="0.3",
        linestyle=":",
        label="3 units of rounding · √steps",
    )
    axes.set(
        title="Rigid body at t = 10: a smaller step gains\nnothing where rounding takes over",
        xlabel="step h",
        ylabel="error",
    )
    axes.legend(fontsize=8, loc="upper left")


def stiffness() -> Curves:
    """Steps that the heat problem needs at tolerance 1e-3, against the number of intervals."""
    sizes = (30, 100, 300, 1000)
    for name in ("RK4", "RKMK4", "CF4"):
        steps = [paper_heat.adaptive(paper_heat.METHODS[name], 1e-3, n).num_steps for n in sizes]
        yield name, sizes, steps


def heat_steps(axes: Axes) -> None:
    for (name, sizes, steps), color in zip(curves("stiffness"), (GREY, RED, BLUE), strict=True):
        axes.loglog(sizes, steps, color=color, marker="o", label=name)
    axes.set(
        title="Heat, tolerance 1e-3: explicit methods\nand commutators pay for stiffness",
        xlabel="intervals N",
        ylabel="attempted steps to t = 1/2",
    )
    axes.legend(fontsize=8)


def contrast() -> Curves:
    """The heat problem with less and less of the diffusivity in the exact part."""
    full = heat.diffusivity()
    ratios = np.linspace(0.4, 3.0, 66)
    exact = heat.reference(heat.t1, np.asarray(full.mu))
    for name, solver in (("RKMK4", cfjax.RKMK4()), ("CF4", cfjax.CF4())):

        def error(constant, solver=solver):
            sol = cfjax.integrate(
                cfjax.LieTerm(heat.field),
                solver,
                heat.t0,
                heat.t1,
                jnp.asarray(heat.y0()),
                heat.Diffusivity(jnp.asarray(full.mu), constant),
                num_steps=200,
                throw=False,
            )
            final_state = jax.tree.map(lambda ys: ys[-1], sol.ys)
            return jnp.linalg.norm(heat.to_grid(final_state) - exact)

        yield name, ratios, jax.vmap(error)(np.max(full.mu) / ratios)


def heat_contrast(axes: Axes) -> None:
    for (name, ratios, errors), color in zip(curves("contrast"), (RED, BLUE), strict=True):
        axes.semilogy(ratios, errors, color=color, label=f"{name}, h = 1/400")
    axes.axvline(2.0995, color="0.5", linewidth=1, linestyle=":", label="linear theory of CF4")
    axes.set(
        title="Heat: the flow must hold half of the stiffness,\nor CF4 fails as well",
        xlabel="largest diffusivity over that in the exact part",
        ylabel="error",
        ylim=(1e-5, 1e9),
    )
    axes.legend(fontsize=8)


SEMILINEAR = {
    name: getattr(cfjax, name)()
    for name in ("CF4", "ETDRK4", "ETD43", "ETD54")
    if hasattr(cfjax, name)
}


def damping() -> Curves:
    """The largest growth of a step, over |z| from 1 to 1e4, of `u' = -|z| u + r |z| u`."""
    ratios = np.linspace(-1.5, 1.0, 51)
    z, r = (x.ravel() for x in np.meshgrid(np.geomspace(1, 1e4, 200), ratios))
    for name, solver in SEMILINEAR.items():
        growth = _growth(solver, -z, r * z).reshape(len(ratios), -1)
        yield name, ratios, growth.max(axis=1)


def oscillation() -> Curves:
    """The growth of a step of `u' = -0.3 y u + i y u`."""
    y = np.linspace(0, 6, 121)
    for name, solver in SEMILINEAR.items():
        yield name, y, _growth(solver, -0.3 * y, 1j * y)


def _growth(solver: Any, exact: np.ndarray, explicit: np.ndarray) -> np.ndarray:
    """The growth of one step of length 1 from u = 1, computed with the solver."""

    def field(t, u, explicit):
        return cfjax.Affine(explicit * u, exact)

    w = jnp.asarray(explicit)
    u0 = jnp.ones_like(w)
    sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, u0, w, num_steps=1)
    return np.abs(np.asarray(jax.tree.leaves(sol.ys)[0][-1]))


def stiff_explicit_part(axes: Axes) -> None:
    for (name, r, growth), color in zip(curves("damping"), (BLUE, GREY, PINK, RED), strict=False):
        axes.semilogy(r, growth, color=color, label=name)
    axes.axhline(1, color="0.5", linewidth=1, linestyle=":")
    axes.set(
        title="u' = (z + w) u, z < 0 exact and w = r |z| explicit:\nlargest growth of a step",
        xlabel="r: the explicit part over |z|, damping where negative",
        ylabel="largest |R| for |z| from 1 to 10 000",
        ylim=(1e-2, 1e4),
    )
    axes.legend(fontsize=8)


def oscillating_explicit_part(axes: Axes) -> None:
    for (name, y, growth), color in zip(
        curves("oscillation"), (BLUE, GREY, PINK, RED), strict=False
    ):
        axes.plot(y, growth, color=color, label=name)
    axes.axhline(1, color="0.5", linewidth=1, linestyle=":")
    axes.set(
        title="u' = (-0.3 y + i y) u, the damping exact,\nthe oscillation explicit",
        xlabel="y",
        ylabel="growth |R| of a step",
        ylim=(0, 3),
    )
    axes.legend(fontsize=8)


MEASURED = {
    f.__name__: f
    for f in (rotations, families, precisions, stiffness, contrast, damping, oscillation)
}
PANELS = (
    regions_of_cf3,
    regions_of_cf4,
    large_rotations,
    near_singular_parameters,
    single_precision,
    heat_steps,
    heat_contrast,
    stiff_explicit_part,
    oscillating_explicit_part,
)


def _rigid_body_end(
    term: Any, solver: Any, t1: float, num_steps: int, dtype: Any = np.float64
) -> np.ndarray:
    y0, inertia = jnp.asarray(rigid_body.y0, dtype), jnp.asarray(rigid_body.inertia, dtype)
    n = int(num_steps)
    sol = cfjax.integrate(term, solver, 0.0, t1, y0, inertia, num_steps=n, throw=False)
    return np.asarray(jax.tree.leaves(sol.ys)[0][-1], float)


def _driven_body(t, y, args):
    """A rigid body with a turning torque, so that the field depends on time and state."""
    torque = jnp.stack([jnp.sin(2 * t), jnp.cos(t), t])
    return cfjax.Rotation(torque - y / args)


def _driven_error(solver: Any, num_steps: int, dtype: Any) -> float:
    def final_state(solver: Any, num_steps: int, dtype: Any) -> np.ndarray:
        y0, inertia = (jnp.asarray(x, dtype) for x in ([0.48, 0.6, 0.64], [1.0, 2.0, 3.5]))
        term = cfjax.LieTerm(_driven_body)
        sol = cfjax.integrate(term, solver, 0.0, 1.0, y0, inertia, num_steps=num_steps, throw=False)
        return np.asarray(jax.tree.leaves(sol.ys)[0][-1], float)

    exact = final_state(cfjax.CG5(), 512, np.float64)
    return float(np.linalg.norm(final_state(solver, num_steps, dtype) - exact))


if __name__ == "__main__":
    results.run(__file__, __doc__, measure)
