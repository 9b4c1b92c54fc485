"""Results of benchmarks: rows in files, with the machine, the versions and the time it took.

A row is a dict of words and numbers. A measured time or ratio is stored as its spread: the minimum,
the quartiles and the maximum. `python benchmarks/results.py` lists the results, and how long it
takes to measure all of them again.
"""

import argparse
import ctypes
import datetime
import importlib.metadata
import json
import math
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax

from cfjax._measure.small_loops import compile_small_loops

FOLDER = Path(__file__).with_name("results")
PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "numpy", "scipy", "cfjax")
# Of the machine, as other work changes what is measured. The load is a mean of a minute.
MOST_LOAD, MINUTES = 2.0, 3

# Before a benchmark uses JAX.
compile_small_loops()

Row = dict[str, Any]
Measure = Callable[..., Iterable[Row]]


def run(
    file: str,
    doc: str | None,
    measure: Measure,
    parts: Iterable[str] = (),
    key: str = "problem",
) -> None:
    """The command of a benchmark: measures its rows, saves and prints them.

    `measure` is told whether to be quick, which is for trying it; the file says so too. `parts` are
    what may be measured alone, such as problems, and `key` is the column that names them. Then
    `measure` is also given their names, and their rows replace those in the file, which says when.
    """
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--quick", action="store_true", help="little time, rough numbers")
    parts = list(parts)
    if parts:
        parser.add_argument("--only", nargs="+", choices=parts, default=[], help="these alone")
    arguments = parser.parse_args()
    quick, only = arguments.quick, tuple(getattr(arguments, "only", ()))
    if not quick:
        wait_for_idle()
    if quick and only:
        parser.error("--only is for the stored file, where rows of --quick do not belong")

    # Not at import: rendering the pages does not need it.
    from rich.progress import track

    jax.config.update("jax_enable_x64", True)
    name, environment, begin = Path(file).stem, machine(), time.perf_counter()
    measured = measure(quick, only) if only else measure(quick)
    rows = [_json(row) for row in track(measured, description=name, total=None)]
    minutes = round((time.perf_counter() - begin) / 60, 1)
    if only:
        stored = load(name)
        older_rows = stored.pop("rows")
        order = list(dict.fromkeys([row.get(key) for row in older_rows] + parts))
        kept = [row for row in older_rows if row.get(key) not in only]
        rows = sorted(kept + rows, key=lambda row: order.index(row.get(key)))
        since = {"only": only, "minutes": minutes, "machine": environment}
        older = [part for part in stored.get("since", []) if not set(part["only"]) <= set(only)]
        save(name, **stored | {"since": [*older, since]}, rows=rows)
    else:
        save(name, machine=environment, quick=quick, minutes=minutes, rows=rows)
    show(name)


def wait_for_idle() -> None:
    """Waits until the load of what ran before has gone, and exits if it does not."""
    for _ in range(60 * MINUTES):
        if os.getloadavg()[0] <= MOST_LOAD:
            return
        time.sleep(1)
    load = os.getloadavg()[0]
    raise SystemExit(f"The load of the machine is {load:.1f}; measure at {MOST_LOAD} or less.")


def machine() -> dict[str, Any]:
    """The processor, its load, and the versions, on which the numbers depend."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    facts = {key.strip(): value.strip() for key, _, value in (x.partition(":") for x in lines)}
    has_avx512 = "avx512f" in facts.get("flags", "").split()
    return {
        "processor": facts.get("model name") or platform.processor(),
        "instructions": platform.machine() + " with AVX-512" * has_avx512,
        # Those that this process may use.
        "cores": getattr(os, "process_cpu_count", os.cpu_count)(),
        "load": round(os.getloadavg()[0], 2),
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
        "platform": platform.platform(),
        "python": platform.python_version(),
        **{package: importlib.metadata.version(package) for package in PACKAGES},
        "date": datetime.date.today().isoformat(),
    }


def save(name: str, *, rows: list[Row], **header: Any) -> None:
    """Writes a file for `load`, with one row in a line."""
    lines = [f'"{key}": {json.dumps(value)}' for key, value in header.items()]
    body = ",\n".join(json.dumps(row, ensure_ascii=False, allow_nan=False) for row in rows)
    FOLDER.mkdir(exist_ok=True)
    text = "{\n" + ",\n".join([*lines, f'"rows": [\n{body}\n]']) + "\n}\n"
    (FOLDER / f"{name}.json").write_text(text, encoding="utf-8")


def load(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))


def names() -> list[str]:
    """The names of the benchmarks with stored results."""
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def pick(rows: Iterable[Row], **where: Any) -> list[Row]:
    """The rows that have these entries."""
    return [row for row in rows if all(row.get(key) == value for key, value in where.items())]


def one(rows: Iterable[Row], **where: Any) -> Row:
    (row,) = pick(rows, **where)
    return row


def compiled(program: Callable[..., Any], *args: Any, repeats: int = 1) -> Callable[[], Any]:
    """The compiled program, warm; it runs more than once where it is too short for the clock."""
    import jax

    executable = jax.jit(program).lower(*args).compile()

    def run() -> Any:
        for _ in range(repeats - 1):
            jax.block_until_ready(executable(*args))
        return executable(*args)

    jax.block_until_ready(run())
    return run


def in_turns(programs: Mapping[str, Callable[[], Any]], **options: Any) -> dict[str, Any]:
    """Seconds of each program in each round, by name. Options as of `take_turns`."""
    from cfjax._measure.work_precision import take_turns

    return dict(zip(programs, take_turns(list(programs.values()), **options), strict=True))


def compile_c(source: str, folder: Path, *flags: str) -> ctypes.CDLL | None:
    """The library of a C file in this folder, built in `folder`; None without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    path, target = Path(__file__).with_name(source), folder / f"{Path(source).stem}.so"
    flags = ("-O3", "-march=native", "-shared", "-fPIC", *flags)
    subprocess.run([compiler, *flags, str(path), "-o", str(target), "-lm"], check=True)
    return ctypes.CDLL(str(target))


def spread(values: Iterable[float]) -> list[float]:
    """The minimum, the quartiles and the maximum."""
    import numpy as np

    return [digits(q) for q in np.quantile(list(values), (0, 0.25, 0.5, 0.75, 1))]


def ratios(seconds: Iterable[float], base: Iterable[float]) -> list[float]:
    """The spread of the ratios turn by turn, which a busy machine disturbs least."""
    return spread(s / b for s, b in zip(seconds, base, strict=True))


def digits(value: Any) -> float:
    """The value with five digits."""
    return float(f"{value:.5g}")


def cell(spread: list[float]) -> str:
    """The median, and the middle half if that is wider than the two digits shown."""
    _, low, middle, high, _ = (two_digits(value) for value in spread)
    return middle if low == high else f"{middle} ({low} to {high})"


def in_units(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{two_digits(seconds / size)} {unit}"
    return f"{two_digits(seconds / 1e-9)} ns"


def show(name: str) -> None:
    """Prints the rows of a file in a table for every kind of row."""
    from rich.console import Console
    from rich.table import Table

    rows = load(name)["rows"]
    console = Console()
    # In a log nothing wraps.
    console = console if console.is_terminal else Console(width=200)
    for kind in dict.fromkeys(tuple(row) for row in rows):
        table = Table(title=name, title_justify="left")
        for heading in kind:
            table.add_column(heading)
        for row in rows:
            if tuple(row) == kind:
                table.add_row(*(_text(key, value) for key, value in row.items()))
        console.print(table)


def _json(value: Any) -> Any:
    """With None for numbers that are not finite, which JSON lacks."""
    if isinstance(value, dict):
        return {key: _json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_json(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _text(key: str, value: Any) -> str:
    if isinstance(value, list) and len(value) != 5:
        return f"{len(value)} numbers"
    if isinstance(value, list):
        return in_units(value[2]) if key.startswith("seconds") else cell(value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def two_digits(value: float) -> str:
    """`value` with two digits, or as an integer from 10 on."""
    rounded = float(f"{value:.2g}")
    if rounded >= 10:
        return f"{value:,.0f}".replace(",", " ") if value >= 10_000 else f"{value:.0f}"
    return (
        f"{rounded:.2g}" if rounded < 1e-3 else f"{rounded:.{1 - math.floor(math.log10(rounded))}f}"
    )


def _minutes(stored: dict[str, Any]) -> float:
    """Of the last whole run, and of problems measured alone since."""
    return stored["minutes"] + sum(part["minutes"] for part in stored.get("since", []))


def main() -> None:
    for name in names():
        stored = load(name)
        quick = " (quick)" * stored["quick"]
        print(f"{name}: {stored['machine']['date']}, {_minutes(stored):.1f} minutes{quick}")
    minutes = sum(_minutes(load(name)) for name in names())
    print(f"The last measurements took {minutes:.0f} minutes in all.")


if __name__ == "__main__":
    main()
