"""The pages' tables, measured numbers and pictures, from the stored results of benchmarks.

Nothing is measured. In a page of `docs/` a table or a number is between `<!-- table: NAME -->` or
`<!-- number: NAME -->` and `<!-- end -->`, where NAME is the name of a function below, with
hyphens. `<!-- decisions: NAME -->` is for the tables of fields and methods, which are in
`docs/decisions.toml` (`decisions.py`).
"""

import argparse
import itertools
import math
import re
import statistics
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import decisions
import results
from results import Row, cell, in_units, load, one, pick, two_digits

HERE = Path(__file__).parent
PAGES = [HERE.parent / "README.md", *sorted((HERE.parent / "docs").rglob("*.md"))]
MARKED = re.compile(
    r"(<!-- (table|number|decisions): ([\w-]+) -->)(.*?)(<!-- end -->)", flags=re.DOTALL
)
# Methods that the results have by their tableaus.
SHORT = {"RKMK(Tsit5)": "RKMK5", "RKMK(Dopri8)": "RKMK8"}
# Names of ways to solve in the pages.
WAYS = {
    "controlled steps": "adaptive steps",
    "a scan by hand": "`jax.lax.scan` by hand",
    "diffeqsolve": "`diffeqsolve`, `UnsafeBrownianPath`",
    "diffeqsolve, tree": "`diffeqsolve`, `VirtualBrownianTree`",
}
# Benchmarks with pictures, and dots per inch.
PICTURES = {
    "batch": 120,
    "chain": 120,
    "charts": 200,
    "energy": 120,
    "frozen_field": 110,
    "noise": 120,
    "peers": 120,
    "stabilised": 100,
    "stability": 100,
    "stiff": 100,
    "tolerances": 120,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="only list the pages that would change"
    )
    parser.add_argument("--text", action="store_true", help="write no pictures")
    options = parser.parse_args()
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    rendered = {page: render(text, page) for page, text in texts.items()}
    new = {page: text for page, text in rendered.items() if text != texts[page]}
    if options.check:
        names = ", ".join(str(page.relative_to(HERE.parent)) for page in new)
        what = f"Not from the stored results or docs/decisions.toml: {names}. Run `make pages`."
        sys.exit(what if new else 0)
    for page, text in new.items():
        page.write_text(text, encoding="utf-8")
    for path in () if options.text else draw():
        print(f"Wrote {path.relative_to(HERE.parent)}")


def render(text: str, page: Path) -> str:
    def renewed(match: re.Match[str]) -> str:
        opening, kind, name, _, closing = match.groups()
        if kind == "number":
            return opening + RENDERED[kind, name]() + closing
        if kind == "table":
            lines = RENDERED[kind, name]()
        else:
            folder = page.parent.relative_to(HERE.parent).as_posix()
            lines = decisions.relocated(_lines(decisions.rows(name)), folder)
        return f"{opening}\n\n{lines}\n\n{closing}"

    return MARKED.sub(renewed, text)


def draw() -> Iterable[Path]:
    # Not at import: rendering the text needs no matplotlib and no jax.
    import importlib

    import jax

    jax.config.update("jax_enable_x64", True)
    for module, dpi in PICTURES.items():
        for name, figure in importlib.import_module(module).draw().items():
            path = HERE / f"{name}.png"
            figure.savefig(path, dpi=dpi)
            yield path


RENDERED: dict[tuple[str, str], Callable[[], str]] = {}


def table(function: Callable[[], list[list[str]]]) -> None:
    """Registers a table: the heading and the rows, as cells."""

    RENDERED["table", _name(function)] = lambda: _lines(function())


def _lines(rows: list[list[str]]) -> str:
    head, *rest = rows
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rest))


def number(function: Callable[[], str]) -> None:
    RENDERED["number", _name(function)] = function


def _name(function: Callable[..., object]) -> str:
    return function.__name__.replace("_", "-")


def between(values: Iterable[float]) -> str:
    """The smallest and the largest."""
    values = list(values)
    ends = dict.fromkeys(two_digits(value) for value in (min(values), max(values)))
    return " to ".join(ends)


def power(value: float) -> str:
    return f"{value:.0e}".replace("e-0", "e-")


def systems(count: int) -> str:
    return "one system" if count == 1 else f"each of {two_digits(count)}"


def values(rows: Iterable[Row], key: str) -> list:
    """The distinct entries of the rows for `key`."""
    return list(dict.fromkeys(row[key] for row in rows if key in row))


def code(program: str) -> str:
    """The name of a program with its code marked up: `"diffrax, CF4"` has two words of code."""
    for measured, name in SHORT.items():
        program = program.replace(measured, name)
    return re.sub(
        r"cfjax\.integrate|C[FG]\d+(\([\w=]+\))?|ETD\d+|(Magnus|RKMK)\d+|(Richardson|RKMK|Projected)\(\w+\)",
        r"`\g<0>`",
        program,
    )


# Numbers that guides keep of a table.


def _medians(spreads: Iterable[list[float]]) -> str:
    """The smallest and the largest median."""
    return between(spread[2] for spread in spreads)


@number
def scenes_magnus() -> str:
    rows = pick(load("scenes")["rows"], method="Magnus6", tolerance=1e-6)
    return _medians(row["over Tsit5"] for row in rows if "over Tsit5" in row)


def _equal_error(kind: str) -> str:
    """Of `Projected(Dopri8())` for attitudes and poses, which README recommends there."""
    rows = pick(load("equal_error")["rows"], method="Projected, Dopri8", kind=kind, to=1e-8)
    scenes = ("rigid body", "spacecraft", "given rate", "pose", "heavy top")
    return _medians(row[_OVER_PLAIN] for row in rows if row["scene"] in scenes)


@number
def equal_error_one() -> str:
    return _equal_error("one")


@number
def equal_error_gradient() -> str:
    return _equal_error("gradient")


@number
def equal_error_many() -> str:
    return _equal_error("many")


@number
def stiff_gain() -> str:
    rows = pick(_stiff("to"), program="ETD54", to=1e-6)
    return _medians(row["over CF4"] for row in rows if row.get("over CF4"))


@number
def stiff_adaptive() -> str:
    rows = pick(_stiff("step over an equal one"), program="ETD54 controlled", to=1e-6)
    return _medians(row["step over an equal one"] for row in rows)


@number
def stiff_largest() -> str:
    rows = pick(_stiff("in M"), program="ETD54", steps=200, **{"in M": "largest"})
    return _short(rows[0]["error"])


@number
def quantum_gain() -> str:
    rows = [row for rows in _quantum().values() for row in rows]
    return between(1 / row[_OVER_OTHERS][2] for row in pick(rows, method="cfjax, Magnus6"))


@number
def lindblad_gain() -> str:
    rows = pick(load("lindblad")["rows"], method="cfjax, Kraus4", problem="transmon and cavity")
    return _medians(row["over best of others"] for row in rows)


@number
def batch_end() -> str:
    rows = pick(load("batch")["rows"], method="Projected(Dopri8)", what="end alone")
    return _medians(row["over Tsit5"] for row in rows)


@number
def gpu_gain() -> str:
    rows = pick(load("gpu")["rows"], method="CF4", members=100_000, dtype="float64")
    rows = [row for row in rows if row["problem"] == "rigid bodies, equal steps"]
    seconds = {row["device"] == "cpu": row["seconds"][2] for row in rows}
    return two_digits(seconds[True] / seconds[False])


@number
def gradient_over_solve() -> str:
    rows = pick(load("gradients")["rows"], program="cfjax.integrate, CF4")
    return _medians(row["gradient over solve"] for row in rows)


@number
def diffusion_gain() -> str:
    rows = pick(load("stabilised")["rows"], problem="heat, 64 x 64", to=2e-3)
    counts = {row["program"]: row["evaluations"] for row in rows if row.get("evaluations")}
    return two_digits(counts["RKL2"] / counts["CF43"])


@number
def machine() -> str:
    stored = [load(name) for name in results.names() if name != "older_jax"]
    kinds = dict.fromkeys(_machine(results["machine"]) for results in stored)
    days = [results["machine"]["date"] for results in stored]
    when = " to ".join(dict.fromkeys((min(days), max(days))))
    rough = any(results["quick"] for results in stored)
    return f"{'; '.join(kinds)}; {when}" + ", with `--quick`, so rough" * rough


def _machine(facts: dict[str, object]) -> str:
    cores = "one core" if facts["cores"] == 1 else f"{facts['cores']} cores"
    return cores + (
        " of {processor}, {instructions}, Python {python}, jax {jax}, diffrax {diffrax}, "
        "cfjax {cfjax}"
    ).format_map(facts)


@number
def older_gain() -> str:
    rows = pick(load("older_jax")["rows"], kind="one", to=1e-8)
    rows = [row for row in rows if row["method"].startswith("diffrax")]
    without, with_it = (pick(rows, option=option) for option in ("without", "with"))
    pairs = zip(without, with_it, strict=True)
    return between(a["seconds"][2] / b["seconds"][2] for a, b in pairs)


@number
def older_machine() -> str:
    return _machine(load("older_jax")["machine"])


@table
def tolerances() -> list[list[str]]:
    rows = pick(load("tolerances")["rows"], equal="tolerance", systems=1)
    tolerance = values(rows, "to")[0]
    return [["", f"steps at tolerance {power(tolerance)}", "error at the end"]] + [
        [code(row["method"]), str(row["steps"]), power(row["error"])]
        for row in pick(rows, to=tolerance)
    ]


@table
def errors() -> list[list[str]]:
    rows = pick(load("tolerances")["rows"], equal="error")
    counts = values(rows, "systems")
    columns = ("steps", "error", "time over Tsit5's")
    table = [["target error", "method", *(f"{c}, {systems(n)}" for n in counts for c in columns)]]
    for error, method in itertools.product(values(rows, "to"), values(rows, "method")):
        cells = [power(error), code(method)]
        for row in (one(rows, method=method, systems=n, to=error) for n in counts):
            cells += [str(row["steps"]), power(row["error"]), cell(row["over Tsit5"])]
        table.append(cells)
    return table


@number
def richardson() -> str:
    rows = pick(load("tolerances")["rows"], method="Richardson(CF4)")
    return between(row["error"] / row["tolerance"] for row in rows if "flows" in row)


@table
def scenes() -> list[list[str]]:
    rows = load("scenes")["rows"]
    at = (1e-6, 1e-8)
    table = [
        ["", "method", "error over tolerance", "steps over Tsit5's"]
        + [f"time over Tsit5's, at {power(tolerance)}" for tolerance in at]
    ]
    for scene, method in dict.fromkeys((row["scene"], row["method"]) for row in rows):
        of_method = pick(rows, scene=scene, method=method)
        same = [row for row in of_method if "Tsit5's steps" in row]
        timed = {row["tolerance"]: cell(row["over Tsit5"]) for row in same if "over Tsit5" in row}
        table.append(
            [
                scene,
                COORDINATES.get(method) or code(method),
                between(row["error"] / row["tolerance"] for row in of_method),
                between(row["steps"] / row["Tsit5's steps"] for row in same),
                *(timed.get(tolerance, "") for tolerance in at),
            ]
        )
    return table


_OVER_PLAIN = "over the better in plain space"
# Of programs of the benchmark of equal errors.
KINDS = {"one": "one system", "gradient": "its gradient", "many": "1000 systems"}


def _method(name: str) -> str:
    """As a user writes it."""
    kind, _, inner = name.partition(", ")
    match kind:
        case "Projected":
            return f"`Projected(diffrax.{inner}())`"
        case "diffrax":
            return f"`diffrax.{inner}`, in plain space"
    return f"`{kind}`" + (", Cayley's coordinates" if inner else "")


@table
def equal_errors() -> list[list[str]]:
    rows = load("equal_error")["rows"]
    columns = [f"1e-8, {label}" for label in KINDS.values()]
    table = [["", "method", "1e-5, one system", "steps to 1e-8", *columns]]
    for row in pick(rows, to=1e-8, kind="one"):
        if not row["method"].startswith("diffrax"):
            same = pick(rows, scene=row["scene"], method=row["method"])
            loose = one(same, to=1e-5)
            found = {other["kind"]: cell(other[_OVER_PLAIN]) for other in pick(same, to=1e-8)}
            times = [cell(loose[_OVER_PLAIN]), str(row["steps"]), *map(found.get, KINDS)]
            table.append([row["scene"], _method(row["method"]), *(x or "" for x in times)])
    return table


@table
def older_jax() -> list[list[str]]:
    rows = pick(load("older_jax")["rows"], to=1e-8)
    options = values(rows, "option")
    columns = [f"{label}, {option}" for label in KINDS.values() for option in options]
    table = [["", "method", *columns]]
    for scene in values(rows, "scene"):
        for method in values(pick(rows, scene=scene), "method"):
            same = pick(rows, scene=scene, method=method)
            times = [
                in_units(one(same, kind=kind, option=option)["seconds"][2])
                for kind in KINDS
                for option in options
            ]
            table.append([scene, _method(method), *times])
    return table


@table
def noise_in_equal_steps() -> list[list[str]]:
    rows = load("noise_steps")["rows"]
    kinds = values(rows, "kind")
    table = [["method", "by", *kinds]]
    for method in values(rows, "method"):
        for way in values(pick(rows, method=method), "way"):
            found = {row["kind"]: row for row in pick(rows, method=method, way=way)}
            times = [in_units(found[k]["seconds"][2]) if k in found else "" for k in kinds]
            table.append([f"`{method}`", WAYS.get(way) or code(way), *times])
    return table


@table
def unit_quaternion() -> list[list[str]]:
    """From the peers of the spacecraft: what leads to the same error, with equal steps."""
    rows = [row for row in pick(load("peers")["rows"], scene="spacecraft") if "to" in row]
    counts = values(rows, "systems")
    names = {
        "diffrax, Tsit5": "neither: `Tsit5` in plain space",
        "diffrax, Tsit5, projected": "divide by the norm: `Tsit5`, after each step",
        "Projected(Dopri8)": "`QuaternionRotation` with `Projected(Dopri8())`",
        "RKMK(Dopri8)": "`QuaternionRotation` with `RKMK8`",
        "CF4": "`QuaternionRotation` with `CF4`",
    }
    columns = ("steps", "error of the solution", "error of the length")
    table = [["", *columns, *(f"time, {systems(n)}" for n in counts)]]
    for program, name in names.items():
        found = [one(rows, program=program, systems=n) for n in counts]
        row = found[0]
        length = power(row["distance"]) if row["distance"] else "0"
        times = [in_units(row["seconds"][2]) for row in found]
        table.append([name, str(row["steps"]), power(row["error"]), length, *times])
    return table


@table
def million_steps() -> list[list[str]]:
    rows = load("million_steps")["rows"]
    counts = values(rows, "steps")
    names = {
        "Euler": "first order, `q + h * q_dot`",
        "Euler, normalised": "the same, divided by the norm",
        "exponential": "exponentials of readings, multiplied",
        "exponential, normalised": "the same, divided by the norm",
        "cfjax.flow": "`cfjax.flow` of readings",
        "classical Runge-Kutta": "the classical method of Runge and Kutta",
        "classical Runge-Kutta, normalised": "the same, divided by the norm",
        "CF4": "`cfjax.integrate`, `CF4`",
        "RKMK5": "`cfjax.integrate`, `RKMK5`",
    }
    columns = [f"{two_digits(n)} steps" for n in counts]
    table = [["", *(f"length off by, {c}" for c in columns), *(f"angle, {c}" for c in columns)]]
    for program, name in names.items():
        found = [one(rows, program=program, steps=n) for n in counts]
        lengths = [_short(abs(row["length less one"])) for row in found]
        table.append([name, *lengths, *(_short(row["angle"]) for row in found)])
    return table


@table
def gradients() -> list[list[str]]:
    rows = load("gradients")["rows"]
    cases = list(itertools.product(values(rows, "state"), values(rows, "systems")))
    head = ["", *(f"{state}, {systems(count)}" for state, count in cases)]
    return [head] + [
        [code(program)]
        + [
            cell(one(rows, program=program, state=state, systems=count)["gradient over solve"])
            for state, count in cases
        ]
        for program in values(rows, "program")
    ]


@table
def fits() -> list[list[str]]:
    rows = load("fits")["rows"]
    problems, forms = values(rows, "problem"), values(rows, "saved")
    table = [["", "saved", *(f"{p}, {c}" for p in problems for c in ("compile", "gradient"))]]
    for solver, form in itertools.product(values(rows, "solver"), forms):
        of_solver = [one(rows, problem=p, solver=solver, saved=form) for p in problems]
        cells = [
            (f"{two_digits(row['compile, seconds'])} s", in_units(row["gradient, seconds"][2]))
            for row in of_solver
        ]
        table.append([code(solver), form, *itertools.chain(*cells)])
    return table


@table
def batch() -> list[list[str]]:
    rows = load("batch")["rows"]
    programs = {"chunks of 10000": "chunks of 10 000", "one jax.vmap": "one `jax.vmap`"}
    columns = ("a trajectory", "memory")
    table = [["members", *(f"{name}, {c}" for name in programs.values() for c in columns)]]
    for size in values(pick(rows, program="chunks of 10000"), "members"):
        cells = [two_digits(size)]
        for row in (one(rows, program=program, members=size) for program in programs):
            cells += [in_units(row["seconds a trajectory"][2]), f"{row['MiB']:.3g} MiB"]
        table.append(cells)
    return table


@number
def batch_compile() -> str:
    rows = pick(load("batch")["rows"], program="chunks of 10000")
    return between(row["compile seconds"] for row in rows)


@table
def batch_adaptive() -> list[list[str]]:
    rows = [row for row in load("batch")["rows"] if "what" in row]

    def text(row: Row) -> str:
        time = in_units(row["seconds"][2])
        return time if row["method"] == "Tsit5" else f"{time}; {cell(row['over Tsit5'])}"

    return [["", *values(rows, "what")]] + [
        [f"`{method}`", *map(text, pick(rows, method=method))] for method in values(rows, "method")
    ]


@table
def batch_compile_adaptive() -> list[list[str]]:
    rows = [row for row in load("batch")["rows"] if "what" in row]
    return [["", *values(rows, "what")]] + [
        [f"`{m}`", *(f"{two_digits(r['compile CPU seconds'])} s" for r in pick(rows, method=m))]
        for m in values(rows, "method")
    ]


@table
def gpu() -> list[list[str]]:
    rows = [{**row, "is processor": row["device"] == "cpu"} for row in load("gpu")["rows"]]

    def text(case: dict, is_processor: bool, dtype: str) -> str:
        case = {**case, "is processor": is_processor, "dtype": dtype}
        return in_units(one(rows, **case)["seconds"][2])

    table = [["", "method", "GPU, float64", "GPU, float32", "processor, float64"]]
    for row in pick(rows, **{"is processor": False}, dtype="float64"):
        case = {key: row[key] for key in ("problem", "members", "method")}
        problem, members = row["problem"], row["members"]
        count = f"{two_digits(members)} rigid bodies" if members > 1 else "one rigid body"
        problem = problem.replace("rigid bodies", count)
        solver, comma, variant = row["method"].partition(",")
        table.append(
            [
                problem,
                f"`{solver}`{comma}{variant}",
                text(case, False, "float64"),
                text(case, False, "float32"),
                text(case, True, "float64"),
            ]
        )
    return table


@number
def gpu_name() -> str:
    """The GPU of most rows."""
    names = [row["device"] for row in load("gpu")["rows"] if row["device"] != "cpu"]
    return max(names, key=names.count)


@number
def gpu_cores() -> str:
    return str(load("gpu")["machine"]["cores"])


@number
def chart_compile() -> str:
    rows = [row for row in load("charts")["rows"] if "/" in row["chart"]]
    # One program for all settings of a method.
    programs = {(row["chart"], row["method"]): row["compile_seconds"] for row in rows}
    return between(
        sum(seconds for (name, _), seconds in programs.items() if name == chart)
        for chart in values(rows, "chart")
    )


@table
def speed() -> list[list[str]]:
    rows = load("rigid_body")["rows"]
    counts = values(rows, "systems")

    def text(program: str, count: int) -> str:
        matching = pick(rows, program=program, systems=count)
        if not matching:  # Chunks are of a batch only.
            return ""
        (row,) = matching
        key = next(key for key in row if key.startswith("over"))
        is_base = key == f"over {program}"
        return f"1 ({in_units(row['seconds a step'][2])})" if is_base else cell(row[key])

    return [["", *map(systems, counts)]] + [
        ["C by hand" if program == "C" else code(program), *(text(program, n) for n in counts)]
        for program in values(rows, "program")
    ]


@table
def exponentials() -> list[list[str]]:
    rows = load("expm")["rows"]
    names = {
        "rotate": "a rotation in closed form",
        "expm": "the dense exponential, n = {n}",
        "flow": "`LeftMatrix(a)` on a vector, n = {n}",
    }
    counts = (1, max(values(rows, "batch")))
    cases = list(itertools.product((False, True), counts))
    head = ["", *("gradient, " * gradient + systems(count) for gradient, count in cases)]
    table = [head]
    for program, n in dict.fromkeys((row["program"], row["n"]) for row in rows):
        cells = [names[program].format(n=n)]
        for gradient, count in cases:
            matching = pick(rows, program=program, n=n, batch=count, gradient=gradient)
            cells.append(between(row["times faster"][2] for row in matching))
        table.append(cells)
    return table


@table
def operators() -> list[list[str]]:
    rows = pick(load("operators")["rows"], problem="dense")
    alternatives = ("LeftMatrix", "dense exponential", "Lanczos", "six products")
    names, norms = ("`OperatorSum`", "`LeftMatrix`", *alternatives[1:]), (5.0, 50.0)
    table = [["n", *(f"{name}, {norm:.0f}" for norm in norms for name in names)]]
    for n in values(rows, "n"):
        cells = [str(n)]
        for norm in norms:
            cases = pick(rows, n=n, norm=norm)
            cells.append(in_units(cases[0]["seconds"][2]))
            cells += [_over(cases, name) for name in alternatives]
        table.append(cells)
    return table


@table
def krylov() -> list[list[str]]:
    rows = [row for row in load("operators")["rows"] if row["problem"] != "dense"]
    columns = ("`OperatorSum`", "other / `OperatorSum`")
    head = ["", "2-norm", "other", *columns, *(f"gradient, {column}" for column in columns)]
    table = [head]
    for problem, norm in dict.fromkeys((row["problem"], row["norm"]) for row in rows):
        cases = pick(rows, problem=problem, norm=norm)
        (method,) = {row["program"] for row in cases if row["program"] != "OperatorSum"}
        cells = [problem, f"{norm:g}", method]
        for gradient in (False, True):
            ours = one(cases, program="OperatorSum", gradient=gradient)
            ratio = one(cases, program=method, gradient=gradient)["over OperatorSum"]
            cells += [in_units(ours["seconds"][2]), two_digits(ratio[2])]
        table.append(cells)
    return table


def _over(rows: list[Row], name: str) -> str:
    matching = [row for row in rows if row["program"].startswith(name)]
    # The medians alone: the table is wide.
    return two_digits(matching[0]["over OperatorSum"][2]) if matching else ""


@table
def heat() -> list[list[str]]:
    rows = pick(load("heat")["rows"], program="cfjax, coefficients")
    keys = [key for key in rows[0] if key.startswith("over")]
    return [["N", "a step", *(f"over NumPy and SciPy, {key[5:]}" for key in keys)]] + [
        [
            two_digits(row["N"]),
            in_units(row["seconds a step"][2]),
            *(cell(row[key]) for key in keys),
        ]
        for row in rows
    ]


@table
def fields() -> list[list[str]]:
    rows = load("fields")["rows"]
    cases = list(itertools.product(values(rows, "program"), values(rows, "systems")))
    by_loop = {
        (loop, case): pick(rows, loop=loop, program=case[0], systems=case[1])
        for loop in values(rows, "loop")
        for case in cases
    }
    ours = {case: by_loop["cfjax.integrate", case] for case in cases}
    table = [["", *(f"{code(program)}, {systems(count)}" for program, count in cases)]]
    for k, way in enumerate(values(rows, "way")):
        table.append([way, *(cell(ours[case][k]["over the best"]) for case in cases)])
    best = [min(row["seconds a step"][2] for row in ours[case]) for case in cases]
    table.append(["the best, a step", *map(in_units, best)])
    slowest = [max(row["over the solve"][2] for row in ours[case]) for case in cases]
    is_gradient = ["gradient" in program for program, _ in cases]
    table.append(
        ["gradient over solve, at most"]
        + [two_digits(x) if g else "" for x, g in zip(slowest, is_gradient, strict=True)]
    )
    for loop in values(rows, "loop")[1:]:
        worst = [max(row["over the best"][2] for row in by_loop[loop, case]) for case in cases]
        table.append([f"`{loop}`, at most", *map(two_digits, worst)])
    return table


@table
def chain() -> list[list[str]]:
    rows = load("chain")["rows"]
    counts = values(rows, "bodies")
    counts_shown = dict.fromkeys((counts[len(counts) // 2], counts[-1]))
    table = [["program", "what", "bodies", "to compile", "memory to compile", "100 steps"]]
    keys = itertools.product(values(rows, "what"), counts_shown, values(rows, "program"))
    for what, bodies, program in keys:
        matching = pick(rows, program=program, what=what, bodies=bodies)
        if not matching or "ended" in matching[0]:
            last_row = pick(rows, program=program, what=what)[-1]
            cells = [f"not in {last_row['ended']} for {last_row['bodies']} bodies", "", ""]
        else:
            (row,) = matching
            cells = [in_units(row["compile CPU seconds"]), f"{row['compile MiB']:.3g} MiB"]
            cells.append(in_units(row["run seconds"][2]))
        table.append([code(program), what, str(bodies), *cells])
    return table


# Scenes with the same methods.
_DETERMINISTIC = ("rigid body", "spacecraft", "4 x 4 matrices")


def _compiled() -> list[Row]:
    return [row for row in load("compile")["rows"] if "scene" in row]


@table
def compiling() -> list[list[str]]:
    rows = [row for row in _compiled() if row["scene"] in _DETERMINISTIC]
    base, *methods = values(rows, "method")
    table = [["", f"diffrax, {base}", *(f"`{method}`" for method in methods)]]
    for program in values(rows, "program"):
        seconds = between(r["CPU seconds"][2] for r in pick(rows, program=program, method=base))
        table.append([program, f"{seconds} s"])
        for method in methods:
            matching = pick(rows, program=program, method=method)
            sizes = between(row["instructions, ratio"] for row in matching)
            table[-1].append(f"{between(r['seconds, ratio'][2] for r in matching)} ({sizes})")
    return table


@table
def compiling_families() -> list[list[str]]:
    table = [["", "program", "diffrax", "cfjax"]]
    rows = [row for row in _compiled() if row["scene"] not in _DETERMINISTIC]
    for scene, program in dict.fromkeys((row["scene"], row["program"]) for row in rows):
        base, *compared = pick(rows, scene=scene, program=program)
        cells = [
            f"`{r['method']}` {two_digits(r['seconds, ratio'][2])} "
            f"({two_digits(r['instructions, ratio'])})"
            for r in compared
        ]
        seconds = two_digits(base["CPU seconds"][2])
        table.append([scene, program, f"`{base['method']}`, {seconds} s", ", ".join(cells)])
    return table


@number
def first_line() -> str:
    (row,) = load("getting_started")["rows"]
    return two_digits(row["CPU seconds"][2])


@table
def first_call() -> list[list[str]]:
    rows = load("first_call")["rows"]
    methods = values(rows, "method")
    names = (f"`{SHORT.get(method, method)}`" for method in methods[1:])
    table = [["", "", "diffrax, Tsit5", *names]]
    for problem, way in itertools.product(values(rows, "problem"), values(rows, "way")):
        base, *compared = (one(rows, problem=problem, way=way, method=m) for m in methods)
        cells = [f"1 ({cell(base['CPU seconds'])} s)"]
        cells += [f"{cell(r['over Tsit5'])}; {two_digits(r['CPU seconds'][2])} s" for r in compared]
        table.append([problem, str(WAYS.get(way, way)), *cells])
    return table


@table
def second_process() -> list[list[str]]:
    rows = load("second_process")["rows"]
    methods = values(rows, "method")
    table = [["", "diffrax, Tsit5", *(f"`{method}`" for method in methods[1:])]]
    for program in values(rows, "program"):
        base, *compared = pick(rows, program=program)
        cells = [f"1 ({cell(base['CPU seconds'])} s)"]
        cells += [f"{cell(r['over Tsit5'])}; {two_digits(r['CPU seconds'][2])} s" for r in compared]
        table.append([_SECOND[program], *cells])
    return table


_SECOND = {
    "integrate": "50 steps of `cfjax.integrate`",
    "its gradient": "their gradient",
    "diffeqsolve": "50 steps in `diffrax.diffeqsolve`",
}
_OVER_OTHERS = "over the fastest of others"


def _quantum() -> dict[tuple[str, int, float], list[Row]]:
    """The rows of each case: a problem, a number of systems and an error."""
    cases: dict[tuple[str, int, float], list[Row]] = {}
    for row in load("quantum")["rows"]:
        if "method" in row:
            cases.setdefault((row["problem"], row["systems"], row["goal"]), []).append(row)
    return cases


@table
def quantum() -> list[list[str]]:
    columns = ("fastest of the others", "speed-up", "fastest as given", "speed-up")
    norms = ("norm error, cfjax", "norm error, other")
    table = [["", "error", "cfjax", "time", *columns, *norms]]
    for (problem, count, goal), rows in _quantum().items():
        ours = [row for row in rows if row["method"].startswith("cfjax")]
        peers = [row for row in rows if row not in ours]
        in_lab_frame = [row for row in peers if not row["method"].endswith("frame")]
        groups = ours, peers, in_lab_frame
        best, *fastest = (min(group, key=lambda r: r[_OVER_OTHERS][2]) for group in groups)
        cells = [f"{problem}, {systems(count)}", power(goal)]
        cells += [code(best["method"].removeprefix("cfjax, ")), in_units(best["seconds each"][2])]
        for row in fastest:
            cells += [row["method"], two_digits(row[_OVER_OTHERS][2] / best[_OVER_OTHERS][2])]
        table.append([*cells, power(best["off norm"]), power(fastest[0]["off norm"])])
    return table


def _peers(scene: str) -> list[list[str]]:
    rows = [row for row in pick(load("peers")["rows"], scene=scene) if "to" in row]
    counts = values(rows, "systems")
    has_group = "distance" in rows[0]
    over = (f"over the fastest of cfjax, {systems(count)}" for count in counts)
    head = ["", "steps or tolerance", "error", *["off the group"] * has_group, "time", *over]
    table = [head]
    for program in values(rows, "program"):
        row, *in_batches = pick(rows, program=program)
        cells = [power(row["tolerance"]) if "tolerance" in row else two_digits(row["steps"])]
        cells.append(power(row["error"]))
        if has_group:
            cells.append(power(row["distance"]) if row["distance"] else "0")
        cells.append(in_units(row["seconds"][2]))
        table.append([code(program), *cells, *(cell(r["over cfjax"]) for r in (row, *in_batches))])
    return table


def _by_method(text: Callable[[Row], str]) -> list[list[str]]:
    """A row for each method, with `text` of its result in each case, if there is one."""
    cases = _quantum()
    methods = dict.fromkeys(row["method"] for rows in cases.values() for row in rows)
    head = ["", *(f"{problem}, {power(goal)}, {systems(n)}" for problem, n, goal in cases)]
    return [head] + [
        [code(method.removeprefix("cfjax, "))]
        + ["".join(map(text, pick(rows, method=method))) for rows in cases.values()]
        for method in methods
    ]


@table
def quantum_steps() -> list[list[str]]:
    def text(row: Row) -> str:
        size = row["steps or tolerance"]
        return str(size) if isinstance(size, int) else power(size)

    return _by_method(text)


@table
def quantum_times() -> list[list[str]]:
    return _by_method(lambda row: cell(row[_OVER_OTHERS]))


@number
def quantum_others() -> str:
    return load("quantum")["rows"][0]["others"]


@number
def quantum_norm() -> str:
    rows = [row for rows in _quantum().values() for row in rows]
    return two_digits(max(row["off norm"] for row in rows if row["method"].startswith("cfjax")))


@table
def lindblad() -> list[list[str]]:
    """The times are relative to the fastest of the others that are equally accurate."""
    ours = ("cfjax, Kraus4", "cfjax, Magnus4", "cfjax, CF4")
    methods = (*ours, "dynamiqs, Rouchon3")
    names = (code(name.removeprefix("cfjax, ")) for name in methods)
    least = "smallest eigenvalue: `Kraus4`, fastest other"
    table = [["", "error", *names, "fastest other", least]]
    rows = [row for row in load("lindblad")["rows"] if "method" in row]
    for problem in values(rows, "problem"):
        for goal in values(pick(rows, problem=problem), "goal"):
            found = {r["method"]: r for r in pick(rows, problem=problem, goal=goal)}
            others = [n for n in found if n not in methods and not n.startswith("cfjax")]
            best = min(others, key=lambda n: found[n]["over best of others"][2])
            cells = [
                cell(found[name]["over best of others"]) if name in found else ""
                for name in methods
            ]
            eigenvalues = (power(found[n]["least eigenvalue"]) for n in (ours[0], best))
            time = in_units(found[best]["seconds"][2])
            table.append([problem, power(goal), *cells, f"{best}, {time}", ", ".join(eigenvalues)])
    return table


@number
def lindblad_others() -> str:
    return load("lindblad")["rows"][0]["others"]


@table
def peers_spacecraft() -> list[list[str]]:
    return _peers("spacecraft")


@table
def peers_rotation() -> list[list[str]]:
    return _peers("given angular velocity")


@table
def peers_kuramoto() -> list[list[str]]:
    return _peers("Kuramoto-Sivashinsky")


@number
def peers_versions() -> str:
    return ", ".join(sorted(values(load("peers")["rows"], "package")))


def _noise(problem: str) -> dict[str, list[Row]]:
    """The rows of each method."""
    rows = pick(load("noise")["rows"], problem=problem)
    return {name: pick(rows, method=name) for name in values(rows, "method")}


def _noise_errors(problem: str) -> list[list[str]]:
    """The errors with some numbers of steps, the observed order, and the time of a step."""
    table = []
    for name, rows in _noise(problem).items():
        errors = {row["steps"]: row["error"] for row in rows if "error" in row}
        if not errors:
            continue
        counts = list(errors)
        counts_shown = (counts[0], counts[len(counts) // 2], counts[-1])
        if not table:
            table.append(["", *(f"{n} steps" for n in counts_shown), "order", "time over `CF2`"])
        logs = ([math.log(x) for x in values] for values in (errors, errors.values()))
        order = -statistics.linear_regression(*logs).slope
        (time,) = (row["over CF2"] for row in rows if "over CF2" in row)
        cells = [f"{errors[n]:.1e}".replace("e-0", "e-") for n in counts_shown]
        table.append([_noise_name(name), *cells, f"{order:.1f}", cell(time)])
    return table


def _noise_name(name: str) -> str:
    """With the name of the solver as code."""
    solver, *variants = name.split(", ")
    is_solver = solver[0].isupper()
    return ", ".join([f"`{solver}`" if is_solver else solver, *variants])


@table
def noise_two_channels() -> list[list[str]]:
    return _noise_errors("two channels")


@table
def noise_one_channel() -> list[list[str]]:
    return _noise_errors("one channel")


@table
def noise_in_the_mean() -> list[list[str]]:
    return _noise_errors("in the mean")


@table
def noise_steps() -> list[list[str]]:
    methods = _noise("steps too large")
    steps = values(next(iter(methods.values())), "step")
    steps_shown = [min(steps, key=lambda h: abs(math.log(h / x))) for x in (0.05, 0.5, 5.0, 50.0)]

    def text(row: Row) -> str:
        if row["mean"] is None:
            return "overflow"
        # On the sphere up to rounding.
        off = row["off the sphere"]
        return f"{row['mean']:.3f}" + (f", off by {two_digits(off)}" if off > 1e-9 else "")

    return [["", *(f"h = {two_digits(h)}" for h in steps_shown)]] + [
        [_noise_name(name), *(text(one(rows, step=h)) for h in steps_shown)]
        for name, rows in methods.items()
    ]


@number
def noise_mean() -> str:
    # Langevin's function at a field of four times the temperature.
    return f"{1 / math.tanh(4) - 1 / 4:.3f}"


@table
def noise_cost() -> list[list[str]]:
    rows = [row for row in load("noise")["rows"] if "spins" in row]
    counts = values(rows, "spins")
    names = {1: "one spin", 4096: "4096 spins"}
    table = [["", *(f"{c}, {names[n]}" for n in counts for c in ("a step", "to compile"))]]
    for program in values(rows, "program"):
        cells = []
        for row in (one(rows, spins=n, program=program) for n in counts):
            for unit, over in (("seconds a step", "over "), ("CPU seconds to compile", "to comp")):
                ratio = next(value for key, value in row.items() if key.startswith(over))
                base = in_units(row[unit][2])
                cells.append(f"1 ({base})" if program == "CF4, no noise" else cell(ratio))
        table.append([_noise_name(program), *cells])
    return table


@table
def noise_gradients() -> list[list[str]]:
    rows = [row for row in load("noise")["rows"] if "gradient of steps" in row]
    return [["steps", "keeps a state", "MiB", "time", "over the solve"]] + [
        [
            str(row["gradient of steps"]),
            row["keeps a state"],
            two_digits(row["MiB"]),
            in_units(row["seconds"][2]),
            cell(row["over the solve"]),
        ]
        for row in rows
    ]


# Names of the systems whose energy is measured, in the pages.
ENERGY_OF = {
    "top": "heavy top",
    "spins": "six spins",
    "vortices": "six vortices",
    "fluid": "fluid",
    "lattice": "lattice",
}


def _energies() -> dict[str, list[Row]]:
    """The rows of each system at equal numbers of evaluations."""
    rows = [row for row in load("energy")["rows"] if "t" in row]
    systems = {name: pick(rows, system=name) for name in ENERGY_OF}
    rate = "evaluations a unit"
    return {name: pick(few, **{rate: few[0][rate]}) for name, few in systems.items()}


def _long(t: float) -> str:
    return (
        two_digits(float(f"{t:.2g}"))
        if t < 1e7
        else f"{t:.0e}".replace("e+0", "e").replace("e+", "e")
    )


@table
def energy() -> list[list[str]]:
    systems = _energies()

    def text(row: Row) -> str:
        if row["largest"] < 1e-12:
            return f"{power(row['largest'])}, rounding"
        slope = f"{row['slope']:.0e}" if row["drifts"] else "flat"
        return f"{row['largest']:.1e}, {slope}".replace("e-0", "e-")

    durations = {name: rows[0]["step"] * rows[0]["steps"] for name, rows in systems.items()}
    head = ["", *(f"{ENERGY_OF[name]}, to t = {_long(t)}" for name, t in durations.items())]
    methods = values(itertools.chain(*systems.values()), "method")
    splittings, non_symplectic = methods[:3], [m for m in methods[3:] if m != "ImplicitMidpoint"]
    return [head] + [
        [f"`{method}`"]
        + ["".join(map(text, pick(rows, method=method))) for rows in systems.values()]
        for method in (*splittings, "ImplicitMidpoint", *non_symplectic)
    ]


def _break_even(row: Row) -> str:
    after = row["break-even"]
    if after is None:
        return f"after {_long(row['end'])}"
    if after < 2:
        return "at once"
    # Beyond the end it is from a slope, so one digit.
    return _long(after) if after < row["end"] else f"about {_long(float(f'{after:.1g}'))}"


@table
def energy_break_even() -> list[list[str]]:
    rows = [row for row in load("energy")["rows"] if "other" in row]
    cases = {name: pick(rows, system=name) for name in ENERGY_OF}
    head = ["", *(f"{ENERGY_OF[name]}, `{few[0]['best']}`" for name, few in cases.items())]
    return [head] + [
        [f"`{method}`", *(_break_even(one(few, other=method)) for few in cases.values())]
        for method in values(rows, "other")
    ]


@number
def energy_lattice() -> str:
    rows = [row for row in load("energy")["rows"] if row.get("system") == "lattice" and "t" in row]
    (row,) = pick(rows, **{"evaluations a unit": 1.0})
    return f"{power(row['largest'])} a spin until t = {_long(row['step'] * row['steps'])}"


@number
def energy_ahead() -> str:
    rows = pick(load("energy")["rows"], other="RKMK8")
    times = [f"{_break_even(one(rows, system=name))} for {ENERGY_OF[name]}" for name in ENERGY_OF]
    top, spins, vortices, *_ = times
    return f"{top.replace('for', 'units of time for a', 1)}, {spins} and {vortices}"


@number
def energy_midpoint() -> str:
    rows = pick(load("energy")["rows"], system="fluid")
    return f"{_break_even(one(rows, other='CF4'))} units of time"


# Names of the programs for stiff equations in the pages.
STIFF = {
    "CF4": "`CF4`",
    "CF43": "`CF43`",
    "ETDRK4": "`ETDRK4`",
    "ETD43": "`ETD43`",
    "ETD54": "`ETD54`",
    "ETD54 controlled": "`ETD54`, adaptive",
    "exponax": "exponax, ETDRK4",
    "Kvaerno5": "diffrax, Kvaerno5, adaptive",
    "Tsit5": "diffrax, Tsit5, adaptive",
}

# The evaluations of a step.
EVALUATIONS = {"CF4": 4, "ETDRK4": 4, "ETD43": 5, "ETD54": 8}


def _stiff(key: str) -> list[Row]:
    return [row for row in load("stiff")["rows"] if key in row]


def _stiff_table(text: Callable[[Row], str], targets: Iterable[float]) -> list[list[str]]:
    """A row for each problem and error, with `text` of the result of each program."""
    rows = _stiff("to")
    programs = [name for name in STIFF if pick(rows, program=name)]
    table = [["", "error", *(STIFF[name] for name in programs)]]
    for problem, target in itertools.product(values(rows, "problem"), targets):
        cases = pick(rows, problem=problem, to=target)
        cells = ["".join(map(text, pick(cases, program=name))) for name in programs]
        table.append([problem, power(target), *cells])
    return table


@table
def stiff_times() -> list[list[str]]:
    def text(row: Row) -> str:
        if "not in seconds" in row:
            return f"over {row['not in seconds']:.0f} s"
        over = row["over CF4"]
        # The medians alone: the table is wide.
        return two_digits(over[2]) if over else in_units(row["seconds"][2])

    return _stiff_table(text, values(_stiff("to"), "to"))


@table
def stiff_others() -> list[list[str]]:
    rows = pick(_stiff("to"), program="ETD54")
    headings = {"exponax": "exponax, ETDRK4", "Kvaerno5": "Kvaerno5", "Tsit5": "Tsit5"}
    table = [["", "error", *headings.values()]]
    for row in rows:
        spreads = [row.get(f"over {program}") for program in headings]
        if any(spreads):
            cells = [cell(over) if over else "" for over in spreads]
            table.append([row["problem"], power(row["to"]), *cells])
    return table


@table
def stiff_steps() -> list[list[str]]:
    return _stiff_table(lambda row: two_digits(row["steps"]) if "steps" in row else "", (1e-6,))


@table
def stiff_orders() -> list[list[str]]:
    rows = _stiff("slope")
    programs = values(rows, "program")
    table = [["", "steps", *(f"`{name}`" for name in programs)]]
    for problem in values(rows, "problem"):
        cases = pick(rows, problem=problem)
        cells = [
            "overflow"
            if row["slope"] is None
            else f"{power(row['error with many'])}, {row['slope']:.1f}"
            for row in cases
        ]
        table.append([problem, f"{cases[0]['few']}, {cases[0]['many']}", *cells])
    return table


def _short(error: float) -> str:
    """One digit, as 2e-4 or 9e23."""
    return f"{error:.0e}".replace("e+", "e").replace("e0", "e").replace("e-0", "e-")


@table
def stiff_parts() -> list[list[str]]:
    rows = _stiff("in M")
    counts = values(rows, "steps")
    table = [["in M", "", *(f"{n} steps" for n in counts)]]
    parts = ("mean", "0.8 of the largest", "largest")
    for part, program in itertools.product(parts, values(rows, "program")):
        errors = [one(rows, program=program, steps=n, **{"in M": part})["error"] for n in counts]
        cells = ["overflow" if e is None else _short(e) for e in errors]
        table.append([part, f"`{program}`", *cells])
    return table


@number
def stiff_whole_operator() -> str:
    row, *_ = _stiff("whole operator, steps")
    return f"an error of {power(row['error'])} in {in_units(row['seconds a solve'][2])}"


@table
def stiff_control() -> list[list[str]]:
    steps, errors = _stiff("step over an equal one"), _stiff("controlled to")
    programs = [name for name in ("ETD43", "ETD54") if pick(errors, program=name)]
    head = [f"`{name}`, {column}" for name in programs for column in ("a step", "error")]
    table = [["", *head]]
    for problem in values(errors, "problem"):
        cells = []
        for name in programs:
            matching = pick(steps, problem=problem, program=f"{name} controlled", to=1e-6)
            ratio = matching[0]["step over an equal one"] if matching else None
            cells.append(cell(ratio) if ratio else "")
            over = [r["error over tolerance"] for r in pick(errors, problem=problem, program=name)]
            cells.append("not finite" if None in over else between(over))
        table.append([problem, *cells])
    return table


@table
def stiff_damping() -> list[list[str]]:
    rows = load("stability")["rows"]
    ratios_shown = (-1.5, -1.0, -0.75, -0.5, -0.25)
    columns = ("stable from r =", "stable to y =", "the same over evaluations")
    table = [["", *(f"r = {r:g}" for r in ratios_shown), *columns]]
    for row in pick(rows, panel="damping"):
        r, (growth,) = row["x"], row["y"]
        waves = one(rows, panel="oscillation", curve=row["curve"])
        y, (of_y,) = waves["x"], waves["y"]
        # Rounding leaves one a little above one.
        unstable = max(x for x, size in zip(r, growth, strict=True) if x < 0 and size > 1 + 1e-9)
        stable = itertools.takewhile(lambda pair: pair[1] <= 1 + 1e-9, zip(y, of_y, strict=True))
        longest, _ = max(stable)
        table.append(
            [
                f"`{row['curve']}`",
                *(two_digits(dict(zip(r, growth, strict=True))[x]) for x in ratios_shown),
                f"{r[r.index(unstable) + 1]:.2f}",
                f"{longest:.2f}",
                f"{longest / EVALUATIONS[row['curve']]:.2f}",
            ]
        )
    return table


@table
def stiff_dispersion() -> list[list[str]]:
    rows = _stiff("dispersion, steps")
    counts = values(rows, "dispersion, steps")
    table = [["", *(f"{n} steps" for n in counts)]]
    for program in values(rows, "program"):
        errors = [row["error"] for row in pick(rows, program=program)]
        cells = ["overflow" if e is None else f"{e:.1e}".replace("e-0", "e-") for e in errors]
        table.append([STIFF[program], *(c.replace("e+00", "") for c in cells)])
    return table


STABILISED = {
    "RKL2": "`RKL2`",
    "RKL2, radius estimated": "`RKL2`, radius estimated",
    "RKL3": "`RKL3`",
    "RKG2": "`RKG2`",
    "CF43": "`CF43`",
    "Luscher3": "`Luscher3`",
    "ETD54": "`ETD54`",
    "Tsit5": "diffrax, Tsit5",
}


def _stabilised() -> dict[tuple[str, float], list[Row]]:
    """The rows of each problem and error."""
    rows = [row for row in load("stabilised")["rows"] if "to" in row]
    return {
        (problem, target): pick(rows, problem=problem, to=target)
        for problem in values(rows, "problem")
        for target in values(pick(rows, problem=problem), "to")
    }


@table
def diffusion_evaluations() -> list[list[str]]:
    def text(row: Row) -> str:
        return str(row.get("evaluations") or "not reached")

    table = [["", "error", *STABILISED.values()]]
    for (problem, target), rows in _stabilised().items():
        cells = ["".join(map(text, pick(rows, program=name))) for name in STABILISED]
        table.append([problem, _exact(target), *cells])
    return table


@table
def diffusion_times() -> list[list[str]]:
    bases = {
        "CF43": "over `CF43`",
        "Tsit5": "Tsit5",
        "Kvaerno5": "Kvaerno5",
        "Luscher3": "`Luscher3`",
        "ETD54": "`ETD54`",
    }
    table = [["", "error", "", "time", *bases.values()]]
    for (problem, target), rows in _stabilised().items():
        for row in (r for r in rows if r["program"] in ("RKL2", "RKL3") and r.get("seconds")):
            over = [row[f"over {base}"] for base in bases]
            table.append(
                [
                    problem,
                    _exact(target),
                    f"`{row['program']}`",
                    in_units(row["seconds"][2]),
                    *(cell(spread) if spread else "" for spread in over),
                ]
            )
    return table


@number
def diffusion_frames() -> str:
    """How much shorter the stable steps of RKL2 are without the part along the spin."""
    rows = pick(load("stabilised")["rows"], method="RKL2")
    along, across = (
        {row["damping"]: row["stable to"] for row in pick(rows, frame=frame)}
        for frame in values(rows, "frame")
    )
    return between(along[a] / across[a] for a in along if 0.5 <= a <= 2)


COORDINATES = {
    "CF4": "`CF4`",
    "CF54": "`CF54`",
    "Projected, Tsit5": "`Projected`, Tsit5",
    "Projected, Dopri8": "`Projected`, Dopri8",
    "RKMK5, Cayley": "`RKMK5`, Cayley",
    "RKMK8, Cayley": "`RKMK8`, Cayley",
    "Dopri8": "Dopri8, in plain space",
}


def _coordinates(steps: str, without: tuple[str, ...] = ()) -> list[list[str]]:
    rows = pick(load("coordinates")["rows"], steps=steps)
    targets = sorted(values(rows, "to"), reverse=True)
    methods = {name: title for name, title in COORDINATES.items() if name not in without}
    table = [["", *methods.values()]]
    for problem in values(rows, "problem"):
        table.append([problem])
        for name in methods:
            at = [pick(rows, problem=problem, method=name, to=x) for x in targets]
            texts = [two_digits(found[0]["over Tsit5"][2]) if found else "-" for found in at]
            table[-1].append(" / ".join(texts) if any(at) else "")
    return table


@table
def coordinates_equal() -> list[list[str]]:
    return _coordinates("equal")


@table
def coordinates_adaptive() -> list[list[str]]:
    return _coordinates("adaptive", without=("CF4",))


@number
def coordinates_gradient() -> str:
    """The time of a gradient over that of its solve, in Cayley's coordinates."""
    rows = [row for row in load("coordinates")["rows"] if "gradient over solve" in row]
    medians = {name: [] for name in ("CF4", "RKMK8, Cayley")}
    for name, found in medians.items():
        found += [row["gradient over solve"][2] for row in pick(rows, method=name)]
    own, other = (between(medians[name]) for name in ("RKMK8, Cayley", "CF4"))
    return f"{own} times as long as its solve, that of `CF4` {other} times"


@number
def coordinates_symplectic() -> str:
    """The time of CF54 over that of RKMK8 in Cayley's coordinates, in equal and adaptive steps."""
    rows = pick(load("coordinates")["rows"], problem="Sp(4)", to=1e-10)
    medians = [
        [one(rows, steps=steps, method=name)["over Tsit5"][2] for steps in ("equal", "adaptive")]
        for name in ("CF54", "RKMK8, Cayley")
    ]
    return f"{between(a / b for a, b in zip(*medians, strict=True))} times"


def _exact(error: float) -> str:
    """As 2e-3 or 1.5e-4."""
    return f"{error:.1e}".replace(".0e", "e").replace("e-0", "e-")


_TOO_LARGE = "top, large steps"


@table
def energy_steps() -> list[list[str]]:
    rows = pick(load("energy")["rows"], system=_TOO_LARGE)
    measured = [row for row in rows if "largest" in row]
    rates = values(measured, "evaluations a unit")

    def text(row: Row) -> str:
        largest = row["largest"]
        if largest is None:
            return "not finite"
        return two_digits(largest) if largest > 0.1 else f"{largest:.1e}".replace("e-0", "e-")

    def at(**where: str) -> list[Row]:
        return [one(rows, **{"evaluations a unit": rate}, **where) for rate in rates]

    return [
        ["", *(f"{rate:.0f} torques" for rate in rates)],
        *([f"`{m}`", *map(text, at(method=m))] for m in values(measured, "method")),
        ["`RKMK8` is ahead of the best until t =", *map(_break_even, at(other="RKMK8"))],
    ]


@table
def energy_longest() -> list[list[str]]:
    rows = [row for row in load("energy")["rows"] if "oscillator" in row]
    return [["", "forces", "longest step", "over the forces"]] + [
        [
            f"`{row['oscillator']}`",
            str(row["forces"] or "iterations"),
            f"{row['longest step']:.2f}",
            f"{row['longest step'] / row['forces']:.2f}" if row["forces"] else "",
        ]
        for row in rows
    ]


@number
def batch_output() -> str:
    """How much longer a batch takes with output at times."""
    rows = [row for row in load("batch")["rows"] if "what" in row and row["method"] != "Tsit5"]
    seconds = {(row["method"], row["what"]): row["seconds"][2] for row in rows}
    end, output = values(rows, "what")[:2]
    return between(seconds[m, output] / seconds[m, end] for m in values(rows, "method"))


def _gpu(**where: object) -> list[Row]:
    """The rows of compiled solves of cfjax on a GPU, in float64."""
    rows = pick(load("gpu")["rows"], dtype="float64", **where)
    return [row for row in rows if row["device"] != "cpu" and "as traced" not in row["method"]]


@number
def gpu_speed_up() -> str:
    """The gain over the processor, of batches of many members and of lattices."""
    rows = [row for row in _gpu() if row["method"] != "Tsit5"]
    large = [row for row in rows if row["members"] > 1000 or " x " in row["problem"]]
    keys = ("problem", "members", "method", "dtype")
    slow = pick(load("gpu")["rows"], device="cpu")
    return between(
        one(slow, **{key: row[key] for key in keys})["seconds"][2] / row["seconds"][2]
        for row in large
    )


def _gpu_step(method: str) -> str:
    (row,) = _gpu(problem="rigid bodies, equal steps", members=1, method=method)
    return in_units(row["seconds"][2] / 100)


@number
def gpu_step() -> str:
    return _gpu_step("CF4")


@number
def gpu_step_of_tsit5() -> str:
    return _gpu_step("Tsit5")


@number
def gpu_compile() -> str:
    rows = _gpu(problem="rigid bodies, equal steps", method="CF4")
    return between(row["compile seconds"] for row in rows)


@number
def gpu_compile_output() -> str:
    (row,) = _gpu(problem="rigid bodies, adaptive steps, 21 times", method="RKMK8")
    return two_digits(row["compile seconds"])


@number
def noise_gain() -> str:
    """The error and the time of 16 steps of WeakOrder2 over those of 64 of CF4."""
    rows = _noise("in the mean")

    def error_and_time(method: str, steps: int) -> tuple[float, float]:
        (time,) = (row["seconds a step"][2] for row in rows[method] if "seconds a step" in row)
        return one(rows[method], steps=steps)["error"], steps * time

    (error, time), (base_error, base_time) = (
        error_and_time("WeakOrder2", 16),
        error_and_time("CF4", 64),
    )
    return f"{two_digits(error / base_error)} of the error of `CF4` with 64 steps, in " + (
        f"{two_digits(time / base_time)} of the time"
    )


@number
def noise_weak_step() -> str:
    """The time of a step of WeakOrder2 over that of CF2."""
    rows = [row for row in load("noise")["rows"] if "spins" in row]
    seconds = {(row["program"], row["spins"]): row["seconds a step"][2] for row in rows}
    return between(seconds["WeakOrder2", n] / seconds["CF2", n] for n in values(rows, "spins"))


@table
def noise_lattice() -> list[list[str]]:
    rows = load("noise_lattice")["rows"]
    methods = values(rows, "method")
    table = [["kT", "h", *(f"`{method}`" for method in methods), "standard error"]]
    for kT, step in itertools.product(values(rows, "kT"), values(rows, "step")):
        of_step = [one(rows, kT=kT, step=step, method=method) for method in methods]
        cells = [f"{100 * row['off by']:.1f} %" for row in of_step]
        error = max(row["standard error"] for row in of_step)
        table.append([f"{kT:g}", f"{step:g}", *cells, f"{100 * error:.1f} %"])
    return table


@number
def noise_of_a_tree() -> str:
    """How much longer steps with a VirtualBrownianTree take."""
    rows = [row for row in load("noise")["rows"] if "spins" in row]
    seconds = {(row["program"], row["spins"]): row["seconds a step"][2] for row in rows}
    return between(
        time / seconds[program.removesuffix(", tree"), n]
        for (program, n), time in seconds.items()
        if program.endswith(", tree")
    )


@number
def noise_checkpoints() -> str:
    """How much longer a gradient takes with few states kept."""
    rows = [row for row in load("noise")["rows"] if "gradient of steps" in row]
    few = [row for row in rows if row["keeps a state"] != "every step"]
    return between(
        row["seconds"][2]
        / one(
            rows, **{"gradient of steps": row["gradient of steps"], "keeps a state": "every step"}
        )["seconds"][2]
        for row in few
    )


@number
def lindblad_over_rouchon() -> str:
    """How many times as fast Kraus4 is."""
    rows = pick(load("lindblad")["rows"], method="cfjax, Kraus4")
    return between(1 / row["over Rouchon3"][2] for row in rows if row["over Rouchon3"])


@number
def lindblad_smooth() -> str:
    """How much longer Kraus4 takes than the best in plain space on small smooth problems."""
    rows = pick(load("lindblad")["rows"], method="cfjax, Kraus4")
    smooth = [row for row in rows if row["problem"] in ("thermal oscillator", "Dicke ladder")]
    return _medians(row["over best of others"] for row in smooth)


def _fast_drive(goal: float) -> str:
    """How many times as fast Magnus6 is as the fastest of others."""
    rows = pick(load("quantum")["rows"], problem="transmon", goal=goal, method="cfjax, Magnus6")
    return between(1 / row[_OVER_OTHERS][2] for row in rows)


@number
def quantum_fast_drive() -> str:
    return _fast_drive(1e-6)


@number
def quantum_fast_drive_accurate() -> str:
    return _fast_drive(1e-9)


@number
def stiff_limit() -> str:
    (seconds,) = values(_stiff("not in seconds"), "not in seconds")
    return f"{seconds:.0f} s"


@number
def scenes_attitudes() -> str:
    rows = pick(load("scenes")["rows"], method="Projected, Dopri8")
    scenes = ("rigid body", "spacecraft", "heavy top", "spins")
    rows = [row for row in rows if row["scene"] in scenes and row["tolerance"] in (1e-6, 1e-8)]
    return _medians(row["over Tsit5"] for row in rows)


def _of_scenes(*methods: str) -> str:
    """The times over those of Tsit5, of scenes where a step takes more work than in plain space."""
    rows = [row for row in load("scenes")["rows"] if row["tolerance"] in (1e-6, 1e-8)]
    others = ("Wilson flow", "Stiefel, first", "Stiefel, second", "Toda", "Zeitlin", "covariance")
    rows = [row for row in rows if row["scene"] in others]
    rows = [row for row in rows if row["method"] in methods]
    return _medians(row["over Tsit5"] for row in rows if "over Tsit5" in row)


@number
def scenes_others() -> str:
    return _of_scenes("CF4", "CF54")


@number
def scenes_projected() -> str:
    return _of_scenes("Projected, Tsit5", "Projected, Dopri8")


# Programs of the benchmark of variations.
VARIATIONS = {
    "solve": "the state alone",
    "P and S": "`VariationTerm`: P and S",
    "unrolled, P and S": "`VariationTerm`: P and S, `CF4(unroll=True)`",
    "S": "`VariationTerm`: S",
    "jacfwd, S": "`jax.jacfwd` of the solve: S",
    "jacfwd of steps, P and S": "`jax.jacfwd` of each step: P and S",
    "inertial": "`InertialMotion`, the state alone",
    "inertial, P and S": "`InertialMotion` in a `VariationTerm`: P and S",
    "NumPy": "NumPy by hand, order 2: P and S",
    "C": "C by hand, order 2: P and S",
    "P": "`VariationTerm`: P",
    "jacfwd, transition": "`jax.jacfwd` of the solve: $`\\Phi`$",
}


def _variations(problem: str) -> list[list[str]]:
    rows = pick(load("variations")["rows"], problem=problem)
    counts = values(rows, "windows")

    def text(row: Row) -> str:
        time = in_units(row["seconds a window"][2])
        return f"1 ({time})" if row["program"] == "solve" else cell(row["over the solve"])

    table = [["", *("one" if n == 1 else f"each of {two_digits(n)}" for n in counts), "to compile"]]
    for program in values(rows, "program"):
        of_program = [one(rows, program=program, windows=n) for n in counts]
        compiling = of_program[0].get("compile over the solve")
        if program == "solve":
            to_compile = f"1 ({in_units(of_program[0]['compile CPU seconds'][2])})"
        else:
            to_compile = cell(compiling) if compiling else ""
        table.append([VARIATIONS[program], *map(text, of_program), to_compile])
    return table


@table
def variations_imu() -> list[list[str]]:
    return _variations("IMU")


@table
def variations_attitude() -> list[list[str]]:
    return _variations("attitude")


def _over_the_state(problem: str, program: str, windows: int) -> str:
    rows = load("variations")["rows"]
    row = one(rows, problem=problem, program=program, windows=windows)
    return two_digits(row["over the solve"][2])


@number
def variations_attitude_one() -> str:
    return _over_the_state("attitude", "P", 1)


@number
def variations_imu_one() -> str:
    return _over_the_state("IMU", "P and S", 1)


@number
def variations_imu_many() -> str:
    return _over_the_state("IMU", "P and S", 1000)


def _seconds_of(derivative: str) -> str:
    row = one(load("compile")["rows"], derivative=derivative)
    return two_digits(row["CPU seconds"][2])


def _first_derivative(program: str, method: str) -> str:
    """Processor seconds to compile one of a spacecraft, in `cfjax.integrate`."""
    where = {"scene": "spacecraft", "program": f"`integrate`, {program}", "method": method}
    return two_digits(one(load("compile")["rows"], **where)["CPU seconds"][2])


@number
def compile_reverse_tsit5() -> str:
    return _first_derivative("gradient", "Tsit5")


@number
def compile_reverse_cf4() -> str:
    return _first_derivative("gradient", "CF4")


@number
def compile_reverse_cf54() -> str:
    return _first_derivative("gradient", "CF54")


@number
def compile_reverse_projected() -> str:
    return _first_derivative("gradient", "Projected(Dopri8)")


@number
def compile_forward_cf54() -> str:
    return _first_derivative("Jacobian", "CF54")


@number
def compile_forward_projected() -> str:
    return _first_derivative("Jacobian", "Projected(Dopri8)")


@number
def compile_gradient() -> str:
    return _seconds_of("gradient")


@number
def compile_product() -> str:
    return _seconds_of("product")


@number
def compile_hessian() -> str:
    return _seconds_of("Hessian")


if __name__ == "__main__":
    main()
