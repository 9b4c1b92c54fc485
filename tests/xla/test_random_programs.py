"""Random programs: what is rewritten computes what the program does, and so do its derivatives."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from xla import random_programs
from xla.interpreter import num_rewritten, run

import cfjax


@pytest.fixture(autouse=True)
def as_users_write():
    """Arrays of different ranks and types together, as JAX allows by default."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def check(seeds):
    """Prints the programs that fail, and counts those that are rewritten."""
    failures, before = [], num_rewritten()
    for seed in seeds:
        program = random_programs.make(seed)
        for kind in random_programs.kinds_of(program):
            message = random_programs.failure(program, kind)
            if message:
                failures.append(f"# seed {seed}, {kind}: {message}\n{program.text()}")
    assert not failures, "\n".join(failures)
    # Half of them at least, so that it is not always the program itself that is compared.
    assert num_rewritten() - before >= len(seeds) / 2


# Every tenth operation or so at the end: some 0.15 s a program, of which NumPy evaluates most.
@pytest.mark.parametrize(
    "first", [0, *(pytest.param(x, marks=pytest.mark.slow) for x in (150, 300, 450))]
)
def test_small_states(first):
    check(range(first, first + 150, 10))


@pytest.mark.slow
@pytest.mark.parametrize("first", range(1000, 4000, 200))
def test_many(first):
    """Each operation some five times."""
    check(range(first, first + 200))


def test_the_same_seed_makes_the_same_program():
    for seed in range(5):
        assert random_programs.make(seed).text() == random_programs.make(seed).text()


def test_a_program_can_be_pasted():
    program = random_programs.make(7)
    namespace = dict(vars(random_programs))
    exec(program.text(), namespace)
    found = namespace["fun"](namespace["y"], namespace["p"])
    want = program.function()(program.state, program.parameters)
    assert random_programs.difference(found, want, None) is None


def _program(line, y, exact=True):
    y = jnp.asarray(y)
    return random_programs.Program(0, [f"x0 = {line}"], [exact], "(x0,)", y, [], "")


WRONG = {
    # What a rewritten program might compute instead: by a reciprocal, of another one of equals.
    "quotient": ("jnp.floor(y / y)", "value", lambda y: jnp.floor(y * (1 / (y + 1e-15)))),
    "tie": ("jnp.argmax(y)", "value", lambda y: len(y) - 1 - jnp.argmax(y[::-1])),
    "infinity": ("1 / (y - y[0])", "value", lambda y: 1 / (y - y[0] + 1e-9)),
    "number": ("jnp.sin(y)", "value", lambda y: jnp.sin(y) + 1e-13),
    "dtype": ("y > 0", "value", lambda y: (y > 0) * 1),
    "shape": ("y[:1]", "value", lambda y: y[0]),
    "gradient": ("jnp.max(y)", "grad", lambda y: y[1]),
}


def test_what_is_wrong_is_seen(monkeypatch, subtests):
    for name, (line, kind, wrong) in WRONG.items():
        program = _program(line, [3.0, 5.0, 5.0])
        with subtests.test(name=name), monkeypatch.context() as patch:
            assert random_programs.failure(program, "value") is None
            patch.setattr(random_programs, "scalarised", lambda fun, y, w=wrong: (w(y),))
            assert random_programs.failure(program, kind) is not None
            # The value of a lost gradient is right.
            assert (random_programs.failure(program, "value") is None) == (kind == "grad")


def test_a_warning_is_seen(monkeypatch):
    def warns(fun, y):
        warnings.warn("cfjax could not rewrite a program", RuntimeWarning, stacklevel=1)
        return fun(y)

    monkeypatch.setattr(random_programs, "scalarised", warns)
    message = random_programs.failure(_program("jnp.sin(y)", [1.0]), "value")
    assert message is not None and message.startswith("RuntimeWarning")


def test_rounding_is_allowed(monkeypatch):
    # A sum in another order, which cancels: off by some units of rounding of its terms.
    y = np.array([1e8, 0.1, -1e8, 0.3])
    program = _program("jnp.sum(y)", y, exact=False)
    monkeypatch.setattr(
        random_programs, "scalarised", lambda fun, y: (y[0] + (y[2] + (y[3] + y[1])),)
    )
    assert random_programs.failure(program, "value") is None


NUMPY = {
    "moves": lambda y: lax_pad(jnp.roll(y.reshape(2, 3).T, 1, 0)),
    "gather": lambda y: y.at[jnp.array([1, 9, -2])].get(mode="fill"),
    "scatter": lambda y: y.at[jnp.array([1, 9, 1])].add(y[:3], mode="drop"),
    "sort": lambda y: (jnp.argsort(y), jnp.sort(-y), jnp.cumsum(y[::-1])),
    "products": lambda y: jnp.einsum("ij,kj->ki", y.reshape(2, 3), jnp.sin(y).reshape(2, 3)),
    "loops": lambda y: jax.lax.scan(lambda c, a: (c * a, c + 1), y[0], y, reverse=True),
    "integers": lambda y: (y.astype(int) // 2, y.astype(int) % 3, (y > 0).sum()),
}


def lax_pad(x):
    return jax.lax.pad(x, 7.0, ((-1, 2, 1), (1, 0, 0)))


def test_numpy_computes_what_jax_does(subtests):
    y = jnp.array([2.0, -1.5, 3.0, 2.0, 0.5, -7.0])
    for name, fun in NUMPY.items():
        with subtests.test(name=name), cfjax.rewriting(False):
            assert random_programs.difference(run(fun, y), jax.jit(fun)(y), None) is None
