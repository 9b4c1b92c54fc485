"""Table 4 and Figure 4 against a program of their own in NumPy, and the steps that it makes."""

from itertools import pairwise

import diffrax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.console import Console

import cfjax
from cfjax._paper import heat

# The paper's problem and methods in NumPy, in the eigenvectors of M.

N = 100
MIDPOINTS = (2 * np.arange(N) + 1) / N - 1
MU = 1 - MIDPOINTS**2
U0 = 1 - np.abs(np.linspace(-1, 1, N + 1)[1:-1])


def operator(mu):
    off = np.diag(mu[1:-1], 1)
    return (off + off.T - np.diag(mu[1:] + mu[:-1])) * (N / 2) ** 2


LAMBDA, V = np.linalg.eigh(operator(np.full(N, MU.mean())))
L = V.T @ operator(MU) @ V
B = L - np.diag(LAMBDA)


def flow(alpha, b, u):
    z = alpha * LAMBDA
    return np.exp(z) * u + np.expm1(z) / z * b


def cf4(h, u):
    f1 = h * (B @ u)
    y2 = flow(h / 2, f1 / 2, u)
    f2 = h * (B @ y2)
    y3 = flow(h / 2, f2 / 2, u)
    f3 = h * (B @ y3)
    f4 = h * (B @ flow(h / 2, f3 - f1 / 2, y2))
    y = flow(h / 2, f1 / 4 + f2 / 6 + f3 / 6 - f4 / 12, u)
    return flow(h / 2, -f1 / 12 + f2 / 6 + f3 / 6 + f4 / 4, y)


def rkmk4(h, u):
    def bracket(b, c):
        return h * LAMBDA * (c - b)

    f1 = h * (B @ u)
    f2 = h * (B @ flow(h / 2, f1 / 2, u))
    f3 = h * (B @ flow(h / 2, f2 / 2 - bracket(f1, f2) / 8, u))
    f4 = h * (B @ flow(h, f3, u))
    return flow(h, f1 / 6 + f2 / 3 + f3 / 3 + f4 / 6 - bracket(f1, f4) / 12, u)


def rk4(h, u):
    k1 = L @ u
    k2 = L @ (u + h / 2 * k1)
    k3 = L @ (u + h / 2 * k2)
    k4 = L @ (u + h * k3)
    return u + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


PROGRAMS = {"CF4": cf4, "RKMK4": rkmk4, "RK4": rk4}


def program(step, tol, shrink_kept=True):
    """Ends of the kept steps, attempted and rejected steps, and the end, by the paper's rule.

    Without `shrink_kept` by that of `diffrax.PIDController`.
    """
    t, h, u = 0.0, 5e-3, V.T @ U0
    ends, attempted, rejected = [], 0, 0
    while t < 0.5:
        is_last = t + h >= 0.5
        h = 0.5 - t if is_last else h
        one, two = step(h, u), step(h / 2, step(h / 2, u))
        error = np.abs(V @ (one - two)).max() / 15
        factor = 0.9 * (tol / error) ** (1 / 5)
        attempted += 1
        if error <= tol:
            t, u = 0.5 if is_last else t + h, one
            ends.append(t)
            factor = factor if shrink_kept else max(factor, 1.0)
        else:
            rejected += 1
        h *= factor
    return np.array(ends), attempted, rejected, V @ u


# Attempted steps of the independent program whose numbers `scenes.md` has, by tolerance.
EXPECTED = {
    "CF4": (8, 17, 57, 179, 408, 791),
    "RKMK4": (260, 260, 269, 262, 311, 629),
    "RK4": (1779, 1779, 1780, 1781, 1783, 1788),
}
ALLOWED = {"CF4": 0.05, "RKMK4": 0.1, "RK4": 0.01}
names = pytest.mark.parametrize("name", EXPECTED)


@pytest.fixture(scope="module")
def runs():
    return {
        (name, tol): heat.adaptive(heat.METHODS[name], tol)
        for name in heat.METHODS
        for tol in heat.TOLERANCES
    }


@pytest.mark.slow
@names
def test_steps_are_those_expected(name, runs):
    for tol, expected in zip(heat.TOLERANCES, EXPECTED[name], strict=True):
        slack = max(ALLOWED[name] * expected, 2 if name == "CF4" else 0)
        assert abs(runs[name, tol].num_steps - expected) <= slack, tol


@pytest.mark.slow
@names
def test_steps_are_those_of_the_program(name, runs):
    exact = cfjax.scenes.heat.reference(0.5, MU)
    for tol in heat.TOLERANCES:
        run = runs[name, tol]
        ends, attempted, rejected, u = program(PROGRAMS[name], tol)
        assert len(run.t) == run.num_steps - run.num_rejected
        if name == "CF4":
            # Step by step. The estimate is a difference of numbers of size one, so a step is
            # known to 1e-16 / tol, and the sizes of later ones follow from it.
            assert (run.num_steps, run.num_rejected) == (attempted, rejected)
            np.testing.assert_allclose(run.t, ends, rtol=0, atol=1e-12 / tol)
            error = np.linalg.norm(u - exact)
            assert run.error == pytest.approx(error, rel=1e-3)
        else:
            # At the limit of stability rounding decides which of two steps is rejected.
            slack = ALLOWED[name] * attempted
            assert abs(run.num_steps - attempted) <= slack
            assert abs(run.num_rejected - rejected) <= 5


@pytest.mark.slow
def test_what_the_paper_finds(runs):
    loose, strict = heat.TOLERANCES[0], heat.TOLERANCES[-1]
    # RK4 makes as many steps at every tolerance, RKMK4 down to 1e-5, and CF4 never.
    assert runs["RK4", strict].num_steps < 1.01 * runs["RK4", loose].num_steps
    assert runs["RKMK4", 1e-5].num_steps < 1.1 * runs["RKMK4", loose].num_steps
    assert runs["RKMK4", strict].num_steps > 2 * runs["RKMK4", loose].num_steps
    steps = [runs["CF4", tol].num_steps for tol in heat.TOLERANCES]
    assert all(b > 1.9 * a for a, b in pairwise(steps))


@pytest.mark.slow
@pytest.mark.parametrize("tol", [1e-4, 1e-6])
def test_what_diffrax_makes_of_it(tol):
    """The setting that the docstring of Richardson gives, and how it differs."""

    def max_norm(error):
        return jnp.max(jnp.abs(cfjax.scenes.heat.to_grid(error)))

    solution = diffrax.diffeqsolve(
        cfjax.LieTerm(cfjax.scenes.heat.field),
        cfjax.Richardson(cfjax.CF4(), as_in_paper=True),
        0.0,
        0.5,
        5e-3,
        jnp.asarray(cfjax.scenes.heat.y0()),
        problems.arrays(cfjax.scenes.heat.diffusivity()),
        stepsize_controller=diffrax.PIDController(
            rtol=0, atol=jnp.asarray(tol), norm=max_norm, safety=0.9, factormin=1e-3, factormax=1e3
        ),
    )
    _, attempted, rejected, _ = program(cf4, tol, shrink_kept=False)
    assert solution.stats["num_steps"] == attempted
    assert solution.stats["num_rejected_steps"] == rejected
    assert attempted != program(cf4, tol)[1]


# The report


@pytest.mark.slow
def test_table_has_every_number(runs):
    console = Console(width=80, record=True, file=None, quiet=False)
    with console.capture() as capture:
        console.print(heat.table_4(runs))
    text = capture.get()
    assert text.count("paper") == text.count("here") == 6
    for name in heat.METHODS:
        for tol, (error, steps, rejected) in zip(heat.TOLERANCES, heat.PRINTED[name], strict=True):
            run = runs[name, tol]
            for row in ((error, steps, rejected), (run.error, run.num_steps, run.num_rejected)):
                assert f"{row[0]:.1e} {row[1]:>5} {f'({row[2]})':>4}" in text


@pytest.mark.slow
def test_text_in_figures_is_neither_cut_nor_covered(runs):
    stiff = {(name, n): runs[name, 1e-3] for name in heat.METHODS for n in heat.SIZES}
    for figure, count in ((heat.figure_4(runs), 2), (heat.figure_stiffness(stiff), 1)):
        FigureCanvasAgg(figure).draw()
        (caption,) = (text.get_window_extent() for text in figure.texts)
        panels = [box for axes in figure.axes if (box := axes.get_tightbbox()) is not None]
        assert len(panels) == count
        for box in (caption, *panels):
            assert 0 <= box.x0 < box.x1 <= figure.bbox.width
            assert 0 <= box.y0 < box.y1 <= figure.bbox.height
        assert caption.y1 < min(box.y0 for box in panels)
        (legend,) = figure.legends
        assert [text.get_text() for text in legend.get_texts()] == list(heat.METHODS)
