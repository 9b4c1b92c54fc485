"""Work and precision: counts by hand, errors against a known solution, failures, files."""

import csv
import io
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.console import Console
from rich.progress import Progress

import cfjax

Y0, ARGS = problems.MOMENTUM, problems.INERTIA
TERM = cfjax.LieTerm(problems.driven_body)
SPACE = diffrax.ODETerm(lambda t, y, args: cfjax.tangent(problems.driven_body(t, y, args), y))
DECAY = diffrax.ODETerm(lambda t, y, args: -y)


def measure(term, methods, reference, y0=Y0, args=ARGS, t0=0.0, t1=1.0, **settings):
    settings = dict(repeats=2, budget=5.0) | settings
    return cfjax.work_precision(
        term, t0, t1, y0, args, methods=methods, reference=reference, **settings
    )


def measure_decay(methods, **settings):
    return measure(DECAY, methods, np.full(2, np.exp(-1.0)), jnp.ones(2), None, **settings)


@pytest.fixture(scope="module", autouse=True)
def as_written():
    """What is measured is compiled as it is written, which takes half as long."""
    with cfjax.rewriting(False):
        yield


@pytest.fixture(scope="module")
def answer():
    return problems.reference(lambda t, y: problems.driven_body_ode(t, y, ARGS), 0.0, 1.0, Y0)


@pytest.fixture(scope="module")
def equal(answer):
    methods = {
        "CF4": cfjax.CF4(),
        "RKMK4": cfjax.RKMK4(),
        "Bosh3": (SPACE, diffrax.Bosh3()),
    }
    return measure(TERM, methods, answer, num_steps=[8, 16, 32])


@pytest.fixture(scope="module")
def adaptive(answer):
    methods = {"CF2": diffrax.HalfSolver(cfjax.CF2()), "Bosh3": (SPACE, diffrax.Bosh3())}
    return measure(TERM, methods, answer, tolerances=[1e-4, 1e-8])


# Numbers


def test_rows_are_methods_by_settings(equal, adaptive):
    assert equal.method == ("CF4",) * 3 + ("RKMK4",) * 3 + ("Bosh3",) * 3
    np.testing.assert_array_equal(equal.num_steps, [8, 16, 32] * 3)
    np.testing.assert_array_equal(equal.num_rejected, 0)
    assert np.all(np.isnan(equal.tolerance))
    np.testing.assert_array_equal(adaptive.tolerance, [1e-4, 1e-8] * 2)
    for work in (equal, adaptive):
        assert not any(work.note)
        assert work.seconds.shape == (len(work.method), 2)
        assert np.all(work.seconds > 0) and np.all(work.compile_seconds > 0)
    # One program for all numbers of steps.
    assert len(set(equal.compile_seconds)) == 3
    with pytest.raises(KeyError, match=r"CF4.*'CF5'"):
        equal.select("CF5")


def test_errors_are_those_of_a_loop_of_its_own_and_fall_by_the_order(equal, answer):
    expected = problems.errors(problems.driven_body, cfjax.CF4(), 1.0, Y0, ARGS, answer, [8, 16])
    # The same steps in another program: a unit of rounding of the state for each of 16.
    np.testing.assert_allclose(
        equal.select("CF4").error[:2], expected, rtol=0, atol=16 * np.finfo(float).eps
    )
    for name in ("CF4", "RKMK4"):
        first, _, last = equal.select(name).slopes()
        assert np.isnan(first)
        # The term of the next order is some h = 1/32 of the first.
        assert abs(last - 4) < 0.15


def made_up(method, error, num_steps, num_rejected=0.0, tolerance=np.nan):
    """A result with these errors and steps."""
    rows = len(method)
    columns = {name: np.full(rows, np.nan) for name in cfjax.WorkPrecision._fields[1:9]}
    columns |= dict(error=np.array(error), num_steps=np.array(num_steps, float))
    columns |= dict(
        num_rejected=np.zeros(rows) + num_rejected, tolerance=tolerance + np.zeros(rows)
    )
    return cfjax.WorkPrecision(
        method=tuple(method), **columns, seconds=np.ones((rows, 2)), note=("",) * rows
    )


def test_slopes_are_between_rows_of_one_method():
    n = np.array([10, 20, 50])
    work = made_up("aaabbb", [*(3.0 * n**-2.0), *(7.0 * n**-5.0)], [*n, *n])
    # Rounding of logarithms.
    np.testing.assert_allclose(work.slopes(), [np.nan, 2, 2, np.nan, 5, 5], rtol=1e-13)
    # In any order of the rows.
    np.testing.assert_allclose(
        made_up("aaa", 3.0 / n[::-1] ** 2.0, n[::-1]).slopes(), [np.nan, 2, 2], rtol=1e-13
    )
    # Not known without two errors.
    work = made_up("aaaaa", [1e-2, np.nan, 1e-4, 0.0, 1e-6], [10, 20, 40, 80, 160])
    assert np.all(np.isnan(work.slopes()))
    assert np.all(np.isnan(made_up("aa", [1e-2, 1e-3], [10, 10]).slopes()))
    # What does not fall is seen, as at rounding.
    np.testing.assert_allclose(made_up("aa", [1e-9, 2e-9], [10, 20]).slopes()[1], -1, rtol=1e-13)


def test_slopes_of_adaptive_runs_are_of_the_steps_taken():
    tolerances = np.array([1e-2, 1e-4, 1e-6])
    # The first two limited by stability, as RKMK4 is in the paper's Table 4.
    errors, steps = [2e-1, 2.9e-3, 2.9e-3 / 4**4], [240, 241, 4 * 240 + 4]
    work = made_up("aaa", errors, np.array(steps) + 7, 7.0, tolerances)
    np.testing.assert_allclose(work.slopes(), [np.nan, np.nan, 4], rtol=1e-13)
    backwards = made_up("aaa", errors[::-1], np.array(steps[::-1]) + 7, 7.0, tolerances[::-1])
    np.testing.assert_allclose(backwards.slopes(), [np.nan, 4, np.nan], rtol=1e-13)


@pytest.mark.slow
def test_the_body_of_the_guide_has_the_slopes_that_it_says():
    """The term of order 4 nearly cancels at t = 7, and not at t = 3 (docs/methods.md)."""
    y0, inertia = np.array([8 / 9, 4 / 9, 1 / 9]), np.array([1.0, 2.5, 0.5])
    term = cfjax.LieTerm(problems.rigid_body)
    for t1, slope in [(3.0, 3.9), (7.0, 5.0)]:
        answer = problems.reference(lambda t, y: np.cross(y, y / inertia), 0.0, t1, y0)
        steps = [round(t1 / h) for h in (0.2, 0.1, 0.05)]
        work = measure(term, {"CF4": cfjax.CF4()}, answer, y0, inertia, t1=t1, num_steps=steps)
        # As many digits as the guide gives.
        np.testing.assert_allclose(work.slopes()[1:], slope, rtol=0, atol=0.05)


def test_evaluations_and_flows_of_equal_steps(equal):
    steps = np.array([8, 16, 32])
    # The tableau's own numbers, and those of Munthe-Kaas & Owren's method.
    for name, evaluations, flows in [("CF4", 4, 5), ("RKMK4", 4, 4)]:
        rows = equal.select(name)
        np.testing.assert_array_equal(rows.num_evaluations, evaluations * steps)
        np.testing.assert_array_equal(rows.num_flows, flows * steps)
    # First same as last: three evaluations a step, and one more for the first.
    np.testing.assert_array_equal(equal.select("Bosh3").num_evaluations, 3 * steps + 1)
    np.testing.assert_array_equal(equal.select("Bosh3").num_flows, 0)


@pytest.mark.slow
def test_evaluations_are_those_that_happen():
    """Counted by a callback in the field of whole solves, adaptive with rejected steps."""
    happened = 0

    def count():
        nonlocal happened
        happened += 1

    def field(t, y, args):
        jax.debug.callback(count)
        return jnp.cross(y, y / args) + jnp.sin(20 * t)

    term = diffrax.ODETerm(field)
    for solver in (diffrax.Bosh3(), diffrax.HalfSolver(diffrax.Heun())):
        work = measure(term, {"m": solver}, Y0, tolerances=[1e-4], repeats=1)
        assert work.num_rejected[0] > 0
        jax.effects_barrier()
        happened = 0
        diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            1.0,
            0.01,
            jnp.asarray(Y0),
            jnp.asarray(ARGS),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-4),
        )
        jax.effects_barrier()
        assert work.num_evaluations[0] == happened


@pytest.mark.slow
def test_a_product_of_manifolds_moves_in_one_flow():
    start, args = problems.FLIGHT_START, problems.FLIGHT_ARGS
    term, methods = cfjax.LieTerm(problems.body_in_flight), {"CF4": cfjax.CF4()}
    work = measure(term, methods, start, start, args, t1=0.5, num_steps=[3])
    assert (work.num_evaluations[0], work.num_flows[0]) == (12, 15)


def test_flops_and_counts_that_are_not_known(equal):
    """Translations are no flows; implicit steps differ; diffrax's loops have no rule."""
    for name in ("CF4", "RKMK4"):
        flops = equal.select(name).flops
        assert flops[0] > 8 * 4 * 20
        np.testing.assert_array_equal(flops, flops[0] * np.array([1, 2, 4]))
    assert np.all(np.isnan(equal.select("Bosh3").flops))
    implicit = diffrax.ImplicitEuler(root_finder=diffrax.VeryChord(1e-6, 1e-8))
    work = measure_decay({"CF4": cfjax.CF4(), "implicit": implicit}, num_steps=[8])
    np.testing.assert_array_equal(work.num_flows, [0, np.nan])
    np.testing.assert_array_equal(work.num_evaluations, [32, np.nan])
    # For each entry: 4 products with h, 11 with weights other than 1, of which the rows of the end
    # point share 2, 7 sums of terms and 5 translations. And the step h itself.
    assert work.flops[0] == 8 * (2 * (4 + 11 - 2 + 7 + 5) + 1)
    assert np.isnan(work.flops[1])
    assert np.all(np.isfinite(work.error))


def test_adaptive_steps_are_diffraxs(adaptive, answer):
    solution = diffrax.diffeqsolve(
        SPACE,
        diffrax.Bosh3(),
        0.0,
        1.0,
        0.01,
        jnp.asarray(Y0),
        jnp.asarray(ARGS),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-8),
    )
    rows = adaptive.select("Bosh3")
    assert rows.num_steps[1] == solution.stats["num_steps"]
    assert rows.num_rejected[1] == solution.stats["num_rejected_steps"]
    error = np.linalg.norm(np.asarray(solution.ys[-1]) - answer)
    # Up to rounding of programs that are compiled apart.
    np.testing.assert_allclose(rows.error[1], error, rtol=1e-3)
    assert rows.error[1] < 1e-6 < rows.error[0]


def test_turns_are_taken_in_order_and_within_the_budget():
    runs = []

    def method(i):
        def field(t, y, args):
            jax.debug.callback(lambda: runs.append(i))
            return -y

        return diffrax.ODETerm(field), diffrax.Euler()

    def rounds(budget):
        methods = {str(i): method(i) for i in range(3)}
        work = measure_decay(methods, num_steps=[1], repeats=4, budget=budget)
        jax.effects_barrier()
        return work.seconds.shape

    assert rounds(np.inf) == (3, 4)
    assert runs[-12:] == [0, 1, 2] * 4
    # No round more: before them each ran alone, to be counted and to warm up.
    assert runs[-15:-12] != [0, 1, 2]
    # A budget that is spent at once leaves one round.
    assert rounds(1e-9) == (3, 1)


@pytest.mark.slow
def test_backwards_in_time_and_in_single_precision(answer):
    back = dict(y0=np.float32(answer), args=np.float32(ARGS), t0=1.0, t1=0.0)
    # Roundings of 6e-8 in some hundred flows, and the tolerance in a few steps.
    work = measure(TERM, {"CF4": cfjax.CF4()}, Y0, **back, num_steps=[32])
    assert work.error[0] < 1e-5
    work = measure(TERM, {"m": (SPACE, diffrax.Bosh3())}, Y0, **back, tolerances=[1e-4])
    assert work.error[0] < 1e-3


def test_controller_error_first_step_and_progress_of_the_caller(answer):
    ends = []

    def controller(tolerance):
        return diffrax.PIDController(rtol=0.0, atol=tolerance, dtmax=0.05)

    def error(y, reference):
        ends.append(y)
        return float(np.max(np.abs(y - reference)))

    with Progress(disable=True) as progress:
        work = measure(
            SPACE,
            {"Heun": diffrax.Heun()},
            answer,
            tolerances=np.array([1e-2]),
            controller=controller,
            dt0=0.05,
            error=error,
            progress=progress,
        )
    # No step is longer than 0.05 and none is rejected at this tolerance. The last may be split by
    # rounding of the times.
    assert work.num_steps[0] in (20, 21)
    assert work.error[0] == np.abs(ends[0] - answer).max()
    compiling, measuring = progress.tasks
    assert compiling.description == "Running Heun"
    assert (compiling.total, compiling.completed) == (1, 1)
    assert measuring.completed >= 1


# Failures

BLOW_UP = diffrax.ODETerm(lambda t, y, args: y**2)  # From 1 it is infinite at t = 1.


def test_failures_have_reasons_and_other_runs_survive():
    def checked(t, y, args):
        return eqx.error_if(y, t > 0.5, "no field after one half")

    methods = {
        "blow-up": (BLOW_UP, diffrax.HalfSolver(cfjax.CF4())),
        "check": (diffrax.ODETerm(checked), cfjax.CF4()),
        "stiff": (diffrax.ODETerm(lambda t, y, args: -1000 * y), cfjax.CF4()),
        # To exp(460), whose square is no number.
        "large": (diffrax.ODETerm(lambda t, y, args: 230 * y), cfjax.CF4()),
    }
    small = np.full(2, 1e-12)
    work = measure(DECAY, methods, small, jnp.ones(2), None, t1=2.0, num_steps=[200, 2000])
    # Stable for steps up to 2.785 / 1000; at 10 / 1000 each step grows by 291.
    has_failed = [True] * 5 + [False] + [True] * 2
    np.testing.assert_array_equal(np.isnan(work.error), has_failed)
    np.testing.assert_array_equal(np.isnan(work.seconds).all(axis=1), has_failed)
    assert work.error[5] < 1e-10 and np.isfinite(work.seconds[5]).all()
    assert work.note[2:6] == 2 * ("no field after one half",) + (work.note[0], "")
    assert work.note[6:] == 2 * ("The error is not finite.",)
    assert "Nonfinite" in work.note[0] and "Nonfinite" in work.note[1]
    np.testing.assert_array_equal(work.num_steps, [200, 2000] * 4)
    np.testing.assert_array_equal(work.num_evaluations[2:], [800, 8000] * 3)
    assert "Nonfinite" in rendered(work.table())
    work.plot()


@pytest.mark.slow
def test_too_few_adaptive_steps_are_nan_with_their_reason():
    methods = {"m": diffrax.HalfSolver(cfjax.CF4())}
    work = measure(
        BLOW_UP, methods, np.zeros(2), jnp.ones(2), None, t1=2.0, tolerances=[1e-6], max_steps=300
    )
    assert np.isnan(work.error[0]) and np.all(np.isnan(work.seconds[0]))
    assert "maximum number of solver steps" in work.note[0]
    assert work.num_steps[0] == 300


# Output


def rendered(part) -> str:
    text = io.StringIO()
    Console(width=120, file=text).print(part)
    return text.getvalue()


def test_a_table_of_every_column_is_not_cut():
    """On a terminal of 80 columns, with numbers as long as those of heat conduction."""
    work = made_up(["Kvaerno5"] * 2, [1e-7, 1e-8], [1317, 1803], 390.0, np.array([1e-6, 1e-7]))
    work = work._replace(
        num_evaluations=np.full(2, 158004.0),
        num_flows=np.full(2, 23706.0),
        flops=np.full(2, 6.17e7),
        compile_seconds=np.full(2, 19.76),
        seconds=np.array([[0.0141, 0.023]] * 2),
    )
    text = io.StringIO()
    Console(width=80, file=text).print(work.table())
    assert "slope" in text.getvalue() and "…" not in text.getvalue()


def test_the_table_has_every_row_and_leaves_out_what_is_not_known(equal, adaptive):
    text = rendered(equal.table())
    assert [text.count(name) for name in ("CF4", "RKMK4", "Bosh3")] == [3] * 3
    # diffrax's solver takes no flows, and its operations are not counted.
    assert "flops" in text and "nan" not in text
    text = rendered(adaptive.table())
    assert "jected" in text and text.count("Bosh3") == 2
    unknown = equal.select("Bosh3")
    assert "flops" not in rendered(unknown.table())
    failed = unknown._replace(
        error=np.full(3, np.nan), seconds=np.full((3, 2), np.nan), note=3 * ("it blew up",)
    )
    text = rendered(failed.table())
    assert "nan" not in text
    # One note for all runs of a method that failed alike.
    assert text.count("it blew up") == 1
    assert f"Bosh3, {', '.join(f'{n:g}' for n in equal.num_steps[:3])}: it blew up" in text
    # The slopes.
    n = np.array([10, 20])
    text = rendered(made_up("aabb", [*n**-2.0, *n**-5.0], [*n, *n]).table())
    assert "slope" in text
    rows = [line.split() for line in text.splitlines() if line.split()[:1] in (["a"], ["b"])]
    # Method, error, slope where there is one, and steps.
    assert [row[2] for row in rows] == ["10", "2.00", "10", "5.00"]
    # No row has one.
    assert "slope" not in rendered(made_up("a", [1e-2], [10]).table())


def test_csv_keeps_every_digit(equal, tmp_path):
    path = tmp_path / "work.csv"
    equal.to_csv(path)
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == list(equal.method)
    for name in ("error", "num_steps", "flops", "compile_seconds"):
        np.testing.assert_array_equal([float(row[name]) for row in rows], getattr(equal, name))
    best = [float(row["seconds_min"]) for row in rows]
    np.testing.assert_array_equal(best, equal.seconds.min(axis=1))


def test_the_chart_shows_every_method_in_both_panels(equal):
    figure = equal.plot()
    FigureCanvasAgg(figure).draw()
    left, right = figure.axes
    _, labels = left.get_legend_handles_labels()
    assert labels == ["CF4", "RKMK4", "Bosh3"]
    cf4 = equal.select("CF4")
    line = left.containers[0].lines[0]
    np.testing.assert_array_equal(line.get_xdata(), cf4.seconds.min(axis=1))
    np.testing.assert_array_equal(line.get_ydata(), cf4.error)
    np.testing.assert_array_equal(right.lines[0].get_xdata(), cf4.flops)
    assert right.get_xlabel() == "flops (not known: Bosh3)"
    figure = equal.select("Bosh3").plot()
    assert figure.axes[1].get_xlabel() == "evaluations of the field"


def test_the_order_plot_shows_every_method_against_its_steps(equal, adaptive):
    for work in (equal, adaptive):
        figure = work.plot(against="steps")
        FigureCanvasAgg(figure).draw()
        (axes,) = figure.axes
        names = list(dict.fromkeys(work.method))
        assert [line.get_label() for line in axes.lines] == names
        for name, line in zip(names, axes.lines, strict=True):
            rows = work.select(name)
            np.testing.assert_array_equal(line.get_xdata(), rows.num_steps - rows.num_rejected)
            np.testing.assert_array_equal(line.get_ydata(), rows.error)
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
        assert axes.get_xlabel() == "steps taken"


# What it refuses


def test_mistakes(no_shape_hook, subtests):
    is_adaptive = dict(num_steps=None, tolerances=[1e-3])
    for number, (change, message) in enumerate(
        [
            (dict(num_steps=None), "either num_steps or tolerances"),
            (dict(tolerances=[1e-3]), "either num_steps or tolerances"),
            (dict(num_steps=[]), "at least one entry"),
            (dict(num_steps=[0]), "num_steps must be an integer of at least 1"),
            (dict(num_steps=None, tolerances=[0.0]), "tolerances must be positive"),
            (
                dict(**is_adaptive, methods={"m": cfjax.CG4()}),
                "CG4 has none: use diffrax.HalfSolver",
            ),
            (dict(num_steps=8), "num_steps must be a sequence of numbers, got 8"),
            (dict(num_steps=None, tolerances="1e-3"), "tolerances must be a sequence of numbers"),
            (dict(num_steps=None, tolerances=["1e-3"]), "tolerances must be positive"),
            (dict(methods={}), "at least one solver"),
            (dict(methods=[cfjax.CF4()]), "methods must be a dict of solvers by name"),
            (dict(methods={4: cfjax.CF4()}), "methods must be a dict of solvers by name"),
            (dict(methods={"m": "CF4"}), "solver must be a diffrax solver"),
            (dict(methods={"m": (1, cfjax.CF4())}), "term must be a diffrax term"),
            (dict(reference=np.ones(4)), "reference must be shaped like y0"),
            (dict(reference={"y": Y0}), "reference must be shaped like y0"),
            (dict(t1=0.0), "t0 and t1 must be finite and differ, got 0.0 and 0.0"),
            (dict(t1=np.nan), "t0 and t1 must be finite"),
            (dict(t1="1"), "t1 must be a real scalar"),
            (dict(dt0=-0.1), "dt0 must be a step from t0=0.0 towards t1=1.0, got -0.1"),
            (dict(dt0="0.1"), "dt0 must be a real scalar"),
            (dict(controller=diffrax.PIDController(0.0, 1e-3)), "controller must be a function"),
            (
                dict(**is_adaptive, controller=lambda tolerance: tolerance),
                "controller must return a diffrax step size controller",
            ),
            (dict(error=1e-3), "error must be a function, got 0.001"),
            (dict(progress=None), "progress must be a bool or a rich.progress.Progress, got None"),
            (dict(budget=0.0), "budget must be a positive number"),
            (dict(budget="20"), "budget must be a positive number"),
            (dict(repeats=0), "repeats must be an integer of at least 1"),
            (dict(max_steps=0), "max_steps must be an integer of at least 1"),
            (
                dict(methods={"implicit": diffrax.Kvaerno3()}),
                "solver must have tolerances of its own",
            ),
        ]
    ):
        arguments: dict = dict(methods={"m": cfjax.CF4()}, reference=Y0, num_steps=[2])
        with (
            subtests.test(case=f"{number}: {message}"),
            pytest.raises((TypeError, ValueError), match=message),
        ):
            measure(TERM, **(arguments | change))


def test_mistakes_name_their_method():
    methods = {"fine": cfjax.CF4(), "wrong": cfjax.RKMK4()}
    growth = cfjax.LieTerm(lambda t, y, args: problems.Growth(-y))
    with pytest.raises(TypeError, match="needs brackets") as info:
        measure(growth, methods, np.ones(2), jnp.ones(2), None, num_steps=[2])
    assert info.value.__notes__[-1] == "This is about methods['wrong']."


def test_what_is_no_error():
    for value, text in (
        (np.ones(3), r"a real number, got f64\[3\]"),
        (None, "a"),
        ("1", "a"),
        (1j, "a"),
        (-1.0, "a number of at least 0"),
    ):
        with pytest.raises((TypeError, ValueError), match=f"error must return {text}") as info:
            measure_decay({"m": diffrax.Euler()}, num_steps=[1], error=lambda y, reference: value)  # noqa: B023
        assert info.value.__notes__[-1] == "This is about methods['m']."


def test_a_missing_extra(equal, monkeypatch):
    for package, part in (("matplotlib", "plot"), ("rich", "table")):
        with monkeypatch.context() as patch:
            for name in [name for name in sys.modules if name.partition(".")[0] == package]:
                patch.setitem(sys.modules, name, None)
            with pytest.raises(
                ModuleNotFoundError, match=rf"{package} is missing.*'cfjax\[paper\]'"
            ):
                getattr(equal, part)()


def test_what_is_traced_is_not_measured():
    def measured(a, is_captured):
        args, captured = (None, a) if is_captured else (a, None)

        def field(t, y, args):
            return cfjax.Rotation(-y / (captured if is_captured else args))

        methods, y0 = {"Euler": cfjax.LieEuler()}, jnp.ones(3)
        measure(cfjax.LieTerm(field), methods, np.ones(3), y0, args, num_steps=[1])
        return jnp.sum(a)

    for is_captured in (True, False):
        with pytest.raises(
            TypeError, match=r"must not be traced, .* call work_precision outside of"
        ):
            jax.grad(measured)(jnp.ones(3), is_captured)


def test_what_is_no_figure_or_axis(equal, no_shape_hook):
    with pytest.raises(TypeError, match=r"figure must be a matplotlib figure, got 'work\.png'"):
        equal.plot("work.png")
    with pytest.raises(ValueError, match=r"against must be 'work' or 'steps', got 'flops'"):
        made_up("a", [1e-2], [10]).plot(against="flops")


def test_an_implicit_solver_takes_the_tolerances_that_there_are():
    assert measure_decay({"m": diffrax.Kvaerno3()}, tolerances=[1e-6]).error[0] < 1e-5
