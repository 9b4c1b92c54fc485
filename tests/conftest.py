import gc
import os
from collections import defaultdict
from pathlib import Path

import jax
import jaxlib.version
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Programs are compiled to run once. This leaves out what LLVM does, and not what XLA does before,
# and has XLA's older emitters write what LLVM compiles, in one piece.
# `XLA_FLAGS= make test` compiles with the emitters that users' programs are compiled with.
jax.config.update("jax_disable_most_optimizations", True)
# From 0.12 on XLA ignores this.
if jaxlib.version.__version_info__ < (0, 12):
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters "
        "--xla_cpu_parallel_codegen_split_count=1",
    )
# Tests raise on purpose, and do not show what they raise.
jax.config.update("jax_traceback_filtering", "off")
# Tracing makes many objects that stay, and little that only the garbage collector can free.
gc.set_threshold(50_000, 20, 100)

# Calls are checked against the annotations of what they call, shapes of arrays among them. What
# rewrites programs handles variables of programs, few arrays, and calls its functions so often
# that checks took a fifth of the time of tests: only its modules that give shapes are checked.
PACKAGE = Path(__file__).parents[1] / "cfjax"
CHECKED = [path for path in PACKAGE.iterdir() if path.stem not in ("_xla", "__init__")] + [
    path for path in (PACKAGE / "_xla").glob("*.py") if '[Array, "' in path.read_text()
]
jaxtyping.install_import_hook(
    [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in CHECKED],
    "signatures.checked",
)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """A program keeps memory maps; past the 65 530 of a process on Linux, compiling crashes."""
    yield
    jax.clear_caches()


@pytest.fixture
def rewritten():
    """Programs are rewritten as users' are, whatever is set for other tests."""
    import cfjax  # Not before the import hook.

    with cfjax.rewriting(True):
        yield


@pytest.fixture
def no_shape_hook():
    """Wrong input meets our own checks, as it does for users, and not jaxtyping's import hook."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Makes all but n sets of parameters of a test marked `representatives(n)` slow.

    Those that stay quick have as many values of single parameters as n sets can have: in a product
    the first, then one that differs in all parameters.
    """
    cases = defaultdict(list)
    for item in items:
        if item.get_closest_marker("representatives") and not item.get_closest_marker("slow"):
            cases[item.path, item.originalname].append(item)
    for rest in cases.values():
        (number,) = rest[0].get_closest_marker("representatives").args
        seen = set()
        for _ in range(min(number, len(rest))):
            chosen = max(rest, key=lambda item: len(values(item) - seen))
            seen |= values(chosen)
            rest.remove(chosen)
        for item in rest:
            item.add_marker(pytest.mark.slow)


def values(item):
    """Which value each parameter has: the same objects make all sets of a product."""
    return {(name, id(value)) for name, value in item.callspec.params.items()}


def pytest_terminal_summary(terminalreporter):
    """What to make quicker first."""
    seconds = defaultdict(float)
    for reports in terminalreporter.stats.values():
        for report in reports:
            # A report on a part of a test is of a class of its own.
            if type(report) is pytest.TestReport:
                seconds[report.nodeid.partition("::")[0]] += report.duration
    slowest = sorted(seconds, key=lambda file: -seconds[file])[:10]
    terminalreporter.section(f"slowest files of {sum(seconds.values()):.0f} s")
    for file in slowest:
        terminalreporter.write_line(f"{seconds[file]:7.1f} s  {file}")
