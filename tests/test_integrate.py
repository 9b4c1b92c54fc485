"""The fixed-step loop: agreement with diffrax, output, tracing, memory, and what it refuses."""

import re
from functools import cache
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
import problems
import pytest

import cfjax

Y0 = jnp.asarray(problems.MOMENTUM)
ARGS = jnp.asarray(problems.INERTIA)
Y0_SINGLE, ARGS_SINGLE = Y0.astype(np.float32), ARGS.astype(np.float32)


def close(found, expected, atol=1e-14):
    """Equal to rounding: some 16 steps of a few roundings of entries below 1."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def ode(t, y, args):
    return jnp.sin(y * t) - y[::-1] / args


# The shortest programs; what the loop does depends on neither.
TERM, EULER = cfjax.LieTerm(ode), cfjax.LieEuler()
BODY = cfjax.LieTerm(problems.driven_body)


def solve(
    term=TERM, solver=EULER, t0=0.0, t1=1.0, y0=Y0, args=ARGS, num_steps=16, **options
) -> Any:
    """Tests that leave the static arguments as they are share one program."""
    return cfjax.integrate(term, solver, t0, t1, y0, args, num_steps=num_steps, **options)


# The same steps as diffeqsolve


def newton():
    return diffrax.Kvaerno3(root_finder=optx.Newton(rtol=1e-10, atol=1e-12))


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "term, solver, t1",
    [
        (TERM, cfjax.CF2(), -2.0),
        (BODY, cfjax.RKMK4(), 2.0),
        (diffrax.ODETerm(ode), diffrax.Tsit5(), 2.0),
        (diffrax.ODETerm(ode), newton(), 2.0),
    ],
    ids=lambda x: type(x).__name__,
)
def test_it_takes_the_steps_of_diffeqsolve(term, solver, t1):
    # Steps of 1/8, so that both add up the same times without rounding.
    found = solve(term, solver, t1=t1, save_every=1)
    # The solvers that need no gradient here, in a loop that costs less to compile.
    expected = diffrax.diffeqsolve(
        term,
        solver,
        0.0,
        t1,
        t1 / 16,
        Y0,
        ARGS,
        saveat=diffrax.SaveAt(steps=True),
        max_steps=16,
        adjoint=diffrax.ForwardMode(),
    )
    assert found.ts.tolist() == expected.ts.tolist()
    # The root finder stops within 1e-10, and starts from elsewhere in the last bits.
    close(found.ys, expected.ys, atol=1e-9 if isinstance(solver, diffrax.Kvaerno3) else 1e-14)
    assert found.result == diffrax.RESULTS.successful


def test_a_wrapped_solver():
    """Both go on from two half steps. For diffrax they are instances of what they wrap."""
    wrapped: Any = [diffrax.HalfSolver(EULER), cfjax.Richardson(EULER)]
    expected = solve()
    for solver in wrapped:
        found = solve(solver=solver, num_steps=8)
        close(found.ys, expected.ys)
        assert found.result == diffrax.RESULTS.successful


# Output


def test_times_and_states_of_the_output():
    for save_every in (None, 1, 4):
        for t0, t1 in [(0.0, 1.0), (0.1, 0.7), (0.3, -2.6), (1e9, 1e9 + 1)]:
            sol = solve(t0=t0, t1=t1, save_every=save_every)
            n = 16 // (save_every or 16)
            assert sol.ts.shape == (n,) and sol.ys.shape == (n, 3)
            # The last time is t1 to the bit, the others to two units in the last place.
            assert sol.ts[-1] == t1
            exact = t0 + (t1 - t0) * np.arange(1, n + 1) / n
            close(sol.ts, exact, atol=2 * np.spacing(max(abs(t0), abs(t1))))
            assert (sol.t0, sol.t1) == (t0, t1)
            assert sol.stats["num_steps"] == 16
            # One step is one program in all of them, but fusion may differ in the last bits.
            every = solve(t0=t0, t1=t1, save_every=1).ys
            close(sol.ys, every[16 // n - 1 :: 16 // n], atol=1e-15 * 16)


@pytest.mark.parametrize(
    "checkpoint_every",
    # One that leaves steps behind the last checkpoint, and one that leaves nothing else.
    [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 30))],
)
def test_the_initial_state_on_request_and_fewer_checkpoints(checkpoint_every):
    """Neither changes a number of the others, nor of a derivative."""

    def loss(y0, **options):
        sol = solve(t0=0.25, y0=y0, save_every=8, **options)
        return jnp.sum(jnp.sin(sol.ys)), (sol.ts, sol.ys)

    def gradient(**options):
        return jax.jit(jax.grad(lambda y0: loss(y0, **options), has_aux=True))(Y0)

    by_start, (ts, ys) = gradient(save_initial=True, checkpoint_every=checkpoint_every)
    expected, (times, states) = gradient()
    assert ts[0] == 0.25
    np.testing.assert_array_equal(ys[0], Y0)
    np.testing.assert_array_equal(ts[1:], times)
    # One step is one program in both, but fusion may differ in the last bits.
    close(ys[1:], states, atol=1e-15 * 16)
    # The derivative of the start is the identity, and those of the others are as before.
    close(by_start - np.cos(Y0), expected)


def test_many_steps_reach_the_end_of_the_time():
    """Times come from the number of the step, so their rounding does not add up.

    y' = 3 t^2, which the classical method integrates exactly: y(1) = 1 at the sum of 10^5 steps.
    """
    term = diffrax.ODETerm(lambda t, y, args: 3 * t**2)
    sol = solve(term, cfjax.CF4(), y0=jnp.asarray(0.0), num_steps=100_000)
    # A random walk of roundings of y: sqrt(1e5) * 1e-16 = 3e-14. An added-up time errs by 1e-12.
    close(sol.ys[-1], 1.0, atol=2e-13)


# Precision


def test_the_state_decides_the_precision():
    for dtype in (np.float32, np.float64):
        for time in (float, np.float64, jnp.float32, int):
            sol = solve(t0=time(0), t1=time(1), y0=Y0.astype(dtype), args=ARGS.astype(dtype))
            assert sol.ys.dtype == sol.ts.dtype == dtype


def test_integers_and_half_precision_become_the_default_dtype():
    for dtype in (bool, np.int32, np.float16, jnp.bfloat16):
        found = solve(y0=jnp.ones(3, dtype)).ys
        np.testing.assert_array_equal(found, solve(y0=jnp.ones(3)).ys, strict=True)


def test_a_complex_state_has_real_times():
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(jnp.asarray([[1j]])))
    sol = solve(term, y0=jnp.asarray([1.0 + 0j]), num_steps=4)
    assert sol.ts.dtype == np.float64 and sol.ys.dtype == np.complex128
    close(sol.ys[0], [np.exp(1j)], atol=1e-15)


def test_python_numbers_in_the_state_and_args():
    """As `diffeqsolve` takes them. y' = -2 y in one step of the midpoint rule."""
    term = diffrax.ODETerm(lambda t, y, args: -args * y)
    sol = solve(term, cfjax.CF2(), t0=0, t1=1, y0=1.0, args=2.0, num_steps=1)
    close(sol.ys, [1 - 2 + 2], atol=1e-15)


# Tracing


def test_new_values_do_not_trace_again():
    calls = 0

    class Counting(eqx.Module):
        scale: Any

        def __call__(self, t, y, args):
            nonlocal calls
            calls += 1
            inertia, rate = args
            return -self.scale * rate * y / inertia

    def traces(scale=1.0, args=ARGS, rate=1.0, **options):
        before = calls
        term = cfjax.LieTerm(Counting(jnp.asarray(scale)))
        solve(term, args=(args, rate), **options)
        return calls - before

    assert traces() > 0
    for options in (
        {"t0": 0.5},
        {"t1": -3.0},
        {"t0": 1, "t1": 2},
        {"t0": jnp.asarray(0.1), "t1": np.float32(0.3)},
        {"y0": 2 * Y0},
        {"y0": np.asarray(Y0)},
        {"args": 2 * ARGS},
        {"scale": 2.0},
        # Python numbers too.
        {"rate": 2.0},
    ):
        assert traces(**options) == 0, options
    assert traces(num_steps=5) > 0


# Transformations


def test_the_derivative_in_the_end_time_is_the_velocity():
    """d y(t1) / d t1 = f(t1, y(t1)), and d y(t1) / d t0 = -dy/dy0 f(t0, y0), up to the method."""
    t0, t1, y0 = jnp.asarray(0.2), jnp.asarray(0.9), Y0

    def fine(t0, t1, y0):
        end = solve(BODY, cfjax.CF3(), t0, t1, y0, num_steps=2000).ys[-1]
        return end, end

    velocity = lambda t, y: problems.driven_body_ode(t, np.asarray(y), problems.INERTIA)  # noqa: E731
    program = jax.jit(jax.jacfwd(fine, (0, 1, 2), has_aux=True))
    (d_t0, d_t1, d_y0), y1 = program(t0, t1, y0)
    # The derivative of the method's error: 1e-7 at 40 steps, so 1e-12 at 2000.
    close(d_t1, velocity(t1, y1), atol=1e-10)
    close(d_t0, -np.asarray(d_y0) @ velocity(t0, y0), atol=1e-10)


# Memory, as the compiler plans it


BIG = 8  # The state is a matrix of this size.


def temporary_bytes(num_steps, reverse=False, y0=jnp.eye(BIG), **options) -> int:  # noqa: B008
    def field(t, y, args):
        return cfjax.LeftMatrix((y - y.T) / 2) if y.ndim == 2 else problems.rigid_body(t, y, args)

    def run(y0):
        return jnp.sum(solve(cfjax.LieTerm(field), y0=y0, num_steps=num_steps, **options).ys)

    fun = jax.grad(run) if reverse else run
    return jax.jit(fun).lower(y0).compile().memory_analysis().temp_size_in_bytes


def test_the_memory_forwards_does_not_grow_with_the_steps():
    few, many = (temporary_bytes(n, y0=Y0) for n in (100, 100_000))
    assert few == many


@pytest.mark.slow
def test_the_memory_backwards_is_one_state_for_each_step():
    def at(num_steps, **options):
        return temporary_bytes(num_steps, reverse=True, solver=cfjax.CF4(), **options)

    few, many = at(100), at(1100)
    # The state, and at most four numbers more: the count, the result, and their padding.
    assert BIG**2 * 8 <= (many - few) / 1000 <= (BIG**2 + 4) * 8
    # Of a small system, its state and a count.
    few, many = (at(n, y0=Y0) for n in (100, 10_100))
    assert (many - few) / 10_000 <= 3 * 8 + 4


@pytest.mark.slow
def test_the_memory_backwards_grows_with_the_root_of_the_steps_on_request():
    """A block keeps the state and what the last sum lost; within one block a step keeps a state."""

    def states(root):
        options = dict(reverse=True, solver=cfjax.CF4(), checkpoint_every=root)
        return temporary_bytes(root**2, **options) / (BIG**2 * 8)

    assert 3 * 90 <= states(100) - states(10) <= 3.1 * 90


# What it refuses


def at_least_1(name, values):
    message = f"{name} must be an integer of at least 1, got"
    return [(message, {name: value}) for value in values]


AN_ODE = diffrax.ODETerm(lambda t, y, args: y)
SINGLE: dict[str, Any] = {"t0": -1, "y0": Y0_SINGLE, "args": ARGS_SINGLE}
TIMES = None, "1", True, 1j, np.ones(1), jnp.arange(3.0), jnp.asarray(1 + 0j)
WRONG_VALUES: list[tuple[str, dict[str, Any]]] = [
    *at_least_1("num_steps", [0, -1, 1.0, 10.5, True, False, None, "3", np.float64(4)]),
    *at_least_1("save_every", [0, -1, 1.0, True, False]),
    *at_least_1("checkpoint_every", [0, -1, 1.0, True]),
    *((f"save_every must divide the 16 steps, got {n}", {"save_every": n}) for n in (5, 32)),
    # Steps shorter than the rounding of a time would have length zero or twice their own.
    *(
        (f"num_steps must be at most 16777216 .* got {n}", SINGLE | {"num_steps": n})
        for n in (2**24 + 1, 10**9)
    ),
]
WRONG_TYPES: list[tuple[str, dict[str, Any]]] = [
    *(
        (f"{name} must be a bool, got", {name: value})
        for name in ("save_initial", "throw", "step_back")
        for value in (None, 1, "yes")
    ),
    # An array would broadcast, and every entry of the state get an end of its own.
    *((f"{t} must be a real scalar, got", {t: time}) for t in ("t0", "t1") for time in TIMES),
    *(
        (r"y0 must be an array of numbers", {"term": AN_ODE, "y0": y0})
        for y0 in ("y", np.array(["y"]), jax.random.key(0), object())
    ),
    (
        r"y0\['b'\]\[1\] must be an array of numbers",
        {"term": AN_ODE, "y0": {"a": 1.0, "b": (jnp.ones(3), jax.random.key(0))}},
    ),
    *(
        ("term must be a diffrax term", {"term": term})
        for term in (None, problems.driven_body, [TERM, 1])
    ),
    *(
        ("solver must be a diffrax solver", {"solver": solver})
        for solver in (None, cfjax.CF4, cfjax.CF4.tableau, "CF4")
    ),
    ("LieEuler takes a term of the form", {"term": (TERM, TERM)}),
    ("SemiImplicitEuler takes a term of the form", {"solver": diffrax.SemiImplicitEuler()}),
    ("KenCarp4 takes a term of the form .*MultiTerm", {"solver": diffrax.KenCarp4()}),
]
FIELDS = [
    (lambda t, y, args: y[:2], r"translation of type f64\[2\] for y.*f64\[3\]"),
    (lambda t, y, args: y.astype(jnp.float32), r"f32\[3\].*f64\[3\]"),
    (lambda t, y, args: {"a": y}, "prefix of the state"),
    (lambda t, y, args: cfjax.LeftMatrix(jnp.eye(4)), r"LeftMatrix.*f64\[3\]"),
    (lambda t, y, args: None, "got None"),
    (lambda t, y, args: "y", "frozen field"),
]


def test_wrong_arguments(no_shape_hook, subtests):
    for error, cases in ((ValueError, WRONG_VALUES), (TypeError, WRONG_TYPES)):
        for message, options in cases:
            given = str(options)
            with subtests.test(given=given), pytest.raises(error, match=message):
                solve(**options)


def test_fields_that_do_not_fit(subtests):
    for field, message in FIELDS:
        with subtests.test(message=message), pytest.raises((TypeError, ValueError), match=message):
            solve(cfjax.LieTerm(field))


def test_a_number_of_steps_that_is_traced(no_shape_hook):
    def last(n):
        return solve(num_steps=n).ys[-1]

    with pytest.raises(TypeError, match="num_steps must be known when the program is traced"):
        jax.jit(last)(3)


def test_more_traced_steps_than_can_be_counted():
    """`work_precision` traces the number of steps. It does not run those that are too many."""
    y0 = np.ones(1, np.float32)
    work = cfjax.work_precision(
        cfjax.LieTerm(lambda t, y, args: -y),
        -1.0,
        1.0,
        y0,
        methods={"LieEuler": EULER},
        reference=y0,
        num_steps=[3, 2**24 + 2],
        repeats=1,
    )
    assert np.isfinite(work.error[0]) and not work.note[0]
    assert work.note[1].startswith("num_steps must leave each step longer")
    assert np.isnan(work.error[1])


def test_steps_shorter_than_the_rounding_of_the_times():
    still = cfjax.LieTerm(lambda t, y, args: 0 * y)
    for dtype in (np.float32, np.float64):
        y0, t0 = jnp.ones(1, dtype), 1000.0
        # The distance of neighbours around t0.
        unit = np.spacing(dtype(t0))

        @eqx.filter_jit
        def times(t0, t1, y0=y0):
            return solve(still, t0=t0, t1=t1, y0=y0, num_steps=4, save_every=1).ts

        for a, sign in [(t0, 1), (t0 + 4 * unit, -1), (-t0, -1)]:
            steps = np.diff(np.asarray(times(a, a + sign * 4 * unit)), prepend=dtype(a))
            np.testing.assert_array_equal(steps, sign * unit)
            with pytest.raises(eqx.EquinoxRuntimeError, match="num_steps must leave each step"):
                jax.block_until_ready(times(a, a + sign * 3 * unit))
        # Without any time every step has length zero, and nothing moves.
        np.testing.assert_array_equal(times(t0, t0), np.full(4, t0))


EMPTY = {"none": None, "without": {"a": None, "b": jnp.ones(2)}, "empty": {"b": jnp.zeros((0, 3))}}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", EMPTY)
@pytest.mark.parametrize("solver", [cfjax.CF2(), cfjax.RKMK4(), cfjax.CK34()])
def test_a_state_without_arrays_or_with_empty_parts(name, solver):
    y0 = EMPTY[name]
    term = cfjax.LieTerm(lambda t, y, args: jtu.tree_map(jnp.ones_like, y))
    controller = diffrax.PIDController(rtol=0.0, atol=1e-3)
    solutions = [
        solve(term, solver, y0=y0, num_steps=2),
        diffrax.diffeqsolve(
            term, cfjax.Richardson(solver), 0.0, 1.0, 0.5, y0, stepsize_controller=controller
        ),
    ]
    expected = jtu.tree_map(lambda y: y[None] + 1, y0)
    for sol in solutions:
        assert sol.result == diffrax.RESULTS.successful
        problems.assert_close(sol.ys, expected, atol=1e-15)


def test_a_time_that_is_infinite():
    """It is no blow-up, and no NaN, whatever comes of it within the program."""
    for name, t0, t1 in (("t0", -np.inf, 1.0), ("t1", 0.0, np.inf), ("t1", np.inf, -np.inf)):
        with pytest.raises(eqx.EquinoxRuntimeError, match=f"^{name} must be finite, got infinity"):
            solve(t0=t0, t1=t1)
    assert solve(t1=np.nan, throw=False).result == diffrax.RESULTS.nonfinite
    # 1e39 is none in single precision.
    still = cfjax.LieTerm(lambda t, y, args: 0 * y)
    y0 = jnp.ones(1, jnp.float32)
    end = jax.jit(lambda t1: solve(still, t1=t1, y0=y0).ys)
    with pytest.raises(RuntimeError, match=r"t1 must be finite, got infinity \(in float32"):
        jax.block_until_ready(end(1e39))


IMPLICIT = [
    *("ImplicitEuler", "Kvaerno3", "Kvaerno4", "Kvaerno5"),
    *("KenCarp3", "KenCarp4", "KenCarp5", "Sil3"),
]
# With args zero the second part rests. Where they are large, an implicit step has no solution.
DECAY = diffrax.ODETerm(lambda t, y, args: -y + args * (1 + y**2))


def with_implicit(solver, args=0.0, y0: Any = 1.0):
    is_split = type(solver).__name__ in ("KenCarp3", "KenCarp4", "KenCarp5", "Sil3")
    still = diffrax.ODETerm(lambda t, y, args: 0 * y)
    term = diffrax.MultiTerm(still, DECAY) if is_split else DECAY
    return solve(term, solver, t1=0.1, y0=y0, args=args, num_steps=2)


@cache
def advice(name):
    """The solver that an error says to write."""
    with pytest.raises(ValueError, match=f"tolerances of its own.*got {name} without") as raised:
        with_implicit(getattr(diffrax, name)())
    found = re.search(r"Write (.*)\.$", str(raised.value))
    assert found is not None
    pasted = eval(found[1], {"diffrax": diffrax, "optimistix": optx})
    assert type(pasted) is getattr(diffrax, name)
    return pasted


def test_implicit_solvers_without_tolerances_are_refused():
    found = [
        name
        for name, cls in vars(diffrax).items()
        if isinstance(cls, type)
        and issubclass(cls, diffrax.AbstractImplicitSolver)
        and not name.startswith("Abstract")
    ]
    assert sorted(found) == sorted(IMPLICIT)
    for name in IMPLICIT:
        advice(name)
    wrapped: Any
    for wrapped in (diffrax.HalfSolver, cfjax.Richardson):
        with pytest.raises(ValueError, match=r"got Kvaerno3 without. Write diffrax\.Kvaerno3\("):
            solve(DECAY, wrapped(diffrax.Kvaerno3()))


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", IMPLICIT)
def test_what_is_said_of_an_implicit_solver_without_tolerances_can_be_pasted(name):
    solver = advice(name)
    # The first order method: 2 steps of error (h^2 / 2) exp(-0.1).
    np.testing.assert_allclose(with_implicit(solver).ys[-1], np.exp(-0.1), rtol=3e-3)
    # A failure of the solver is an error: y = 1 + h (100 (1 + y^2) - y) has no solution.
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"(?i)nonlinear solve"):
        with_implicit(solver, args=100.0)


# A blow-up is never a number. Here y' = y^2, infinite at t = 1 / y0.


def exploding(t, y, args):
    """With a rotation and a matrix beside it: part of the state stays finite."""
    return {"a": y["a"] ** 2, "b": cfjax.Rotation(jnp.ones(3)), "c": -y["c"]}


STARTS = 0.1, 1.0


def explosion(y0=STARTS[1], **options):
    y0 = {"a": jnp.stack([STARTS[0], jnp.asarray(y0)]), "b": Y0, "c": jnp.eye(2)}
    term = cfjax.LieTerm(exploding)
    return solve(term, t1=2.0, y0=y0, args=None, num_steps=100, save_every=25, **options)


def test_the_result_tells_of_a_blow_up():
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        explosion()
    sol = explosion(throw=False)
    assert sol.result == diffrax.RESULTS.nonfinite
    # Saved at t = 1/2, 1, 3/2 and 2.
    finite = np.isfinite(np.asarray(sol.ys["a"][:, 1]))
    assert finite[0] and not finite[-2:].any()
    assert np.isfinite(np.asarray(sol.ys["b"])).all()
    calm = explosion(0.4, throw=False)
    assert calm.result == diffrax.RESULTS.successful
    expected = np.array([STARTS[0], 0.4])
    for _ in range(100):
        expected += 0.02 * expected**2
    # 100 roundings of numbers up to 2.
    close(calm.ys["a"][-1], expected, atol=1e-13)
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(eqx.EquinoxRuntimeError, match="y0 must be finite"):
            explosion(value)
        assert explosion(value, throw=False).result == diffrax.RESULTS.nonfinite


def test_a_blow_up_inside_jit_is_an_error():
    run = eqx.filter_jit(explosion)
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        jax.block_until_ready(run(jnp.asarray(1.0)).ys)
    with pytest.raises(eqx.EquinoxRuntimeError, match="y0 must be finite"):
        jax.block_until_ready(run(jnp.asarray(np.nan)).ys)


@pytest.mark.slow
def test_in_a_batch_the_result_tells_which_blew_up():
    starts = jnp.asarray([0.4, 1.0, 0.2])
    sol = jax.vmap(lambda y: explosion(y, throw=False))(starts)
    failed = jax.vmap(lambda r: r != diffrax.RESULTS.successful)(sol.result)
    assert failed.tolist() == [False, True, False]
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        jax.block_until_ready(eqx.filter_vmap(explosion)(starts).ys)


# Transposes


def linear(t, y, args):
    """An array and a matrix: linear in the state, and not symmetric."""
    a = jnp.asarray([[0.1, 1.0], [-2.0, 0.2]])
    return {"x": cfjax.LeftMatrix(a * jnp.cos(t)), "y": y["x"][:, 0] - 2.0 * y["y"]}


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver, throw, rewrite",
    [
        (EULER, True, False),
        (cfjax.CF2(), False, True),
        (cfjax.Magnus4(), True, True),
        (cfjax.Magnus4(), False, False),
    ],
)
def test_the_transpose_of_a_solve_that_is_linear_in_its_start(solver, throw, rewrite):
    """The checks are of the values of what is linear, and in the way of it they are not."""
    Y = {"x": jnp.ones((2, 1)), "y": jnp.ones(2)}
    is_magnus = isinstance(solver, cfjax.Magnus4)
    field = linear if not is_magnus else lambda t, y, args: linear(t, Y, args)["x"]
    start = Y["x"] if is_magnus else Y

    def end(y0):
        term = cfjax.LieTerm(field)
        ys = solve(term, solver, y0=y0, num_steps=4, save_every=2, throw=throw).ys
        return jtu.tree_map(lambda y: y[-1], ys)

    y, w = problems.random_like(start, 2), problems.random_like(start, 3)
    with cfjax.rewriting(rewrite):
        found, expected = jax.jit(
            lambda y, w: (
                problems.inner(jax.linear_transpose(end, start)(w)[0], y),
                problems.inner(w, end(y)),
            )
        )(y, w)
        # What a transpose is. Some thousand products of numbers below 10.
        assert abs(expected) > 0.1
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [EULER, cfjax.CF54(), cfjax.RKMK8()])
def test_the_transpose_of_a_small_solve_that_is_rewritten(rewritten, solver):
    """The numbers of its steps, on which the field depends through the time, are known to it."""
    a = jnp.asarray([[0.2, -1.0, 0.5], [0.7, 0.3, -0.4], [-0.6, 0.9, 1.2]])

    def field(t, y, args):
        is_turn = isinstance(solver, cfjax.RKMK8)
        return cfjax.Rotation(jnp.sin(t) * a[0]) if is_turn else jnp.sin(t) * (a @ y)

    def end(y0):
        return solve(cfjax.LieTerm(field), solver, y0=y0).ys[-1]

    (back,) = jax.jit(jax.linear_transpose(end, jnp.ones(3)))(np.arange(3.0))
    # The matrix of the solve, column by column; a hundred products of numbers below 10.
    matrix = np.stack([end(e) for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(back, np.arange(3.0) @ matrix, rtol=0, atol=1e-13)


# Starts off the manifold


TURN = cfjax.LieTerm(
    lambda t, y, rate: cfjax.QuaternionRotation(rate * jnp.ones(3), frame="body", layout="wxyz")
)


def turning(y0, rate: Any = 1.0, term=TURN, **options):
    return solve(term, y0=y0, args=rate, save_initial=True, **options)


FAR, NEAR = jnp.array([1.1, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0])
OFF = r"y must start on the manifold that QuaternionRotation acts on: y0 must have length 1 "


def test_an_error_of_a_call_from_python_is_its_message_alone(subtests):
    not_finite = r"y0 must be finite, got NaN or infinity\. .* how they were computed\.$"
    for name, y0, rate, message in [
        ("off the manifold", FAR, 1.0, OFF + r"\(in y0 @ y0\), and is off by more than 0.1\.$"),
        ("not finite", NEAR.at[1].set(np.nan), 1.0, not_finite),
        ("blow-up", NEAR, np.inf, "Nonfinite"),
    ]:
        with subtests.test(case=name):
            with pytest.raises(eqx.EquinoxRuntimeError) as caught:
                turning(y0, rate)
            assert re.match(message, str(caught.value))
            # Nothing raised it but this package, and no error led to it.
            assert caught.value.__cause__ is None and caught.value.__context__ is None
            assert str(caught.traceback[-1].path).endswith("_integrate.py")
    sol = turning(FAR, throw=False)
    assert sol.result == diffrax.RESULTS.nonfinite
    assert np.isnan(sol.ys).all()


@pytest.mark.parametrize("transform", ["closure", "vmap"])
def test_a_start_off_the_manifold_is_an_error_within_every_transformation(transform):
    def closed_over(rate):
        return cfjax.LieTerm(lambda t, y, args: TURN.field(t, y, rate))

    run = {
        "vmap": lambda y0: jax.vmap(lambda y0: turning(y0).ys)(jnp.stack([NEAR, y0])),
        # No argument of the solve is traced.
        "closure": lambda y0: jax.vmap(lambda r: turning(y0, None, closed_over(r)).ys)(jnp.ones(2)),
    }[transform]
    assert np.isfinite(run(NEAR)).all()
    with pytest.raises(RuntimeError, match=OFF):
        jax.block_until_ready(run(FAR))


def test_no_flow_leads_back_from_infinity(subtests):
    """So what is not finite at one step is not finite at a later one, where it is looked for."""
    for name, field, y0 in [
        ("Rotation", cfjax.Rotation, jnp.ones(3)),
        ("LeftMatrix", lambda w: cfjax.LeftMatrix(jnp.diag(w)), jnp.ones(3)),
        ("RightMatrix", lambda w: cfjax.RightMatrix(jnp.diag(w)), jnp.ones((2, 3))),
        ("translation", lambda w: w, jnp.ones(3)),
    ]:
        # A field that is lost takes the state with it, too.
        pairs = [
            (velocity, start)
            for bad in (np.inf, -np.inf, np.nan)
            for lost, lost_velocity in [(y0.at[..., 0].set(bad), jnp.ones(3).at[0].set(bad))]
            for velocity, start in [
                (jnp.ones(3), lost),
                (lost_velocity, lost),
                (jnp.zeros(3), lost),
                (lost_velocity, y0),
            ]
        ]
        velocities, starts = (jnp.stack(x) for x in zip(*pairs, strict=True))

        def end_of(pair, field=field):
            return cfjax.flow(field(pair[0]), pair[1])

        ends = np.asarray(jax.lax.map(end_of, (velocities, starts))).reshape(len(pairs), -1)
        found = np.isfinite(ends).all(axis=1)
        with subtests.test(field=name):
            assert not found.any(), found


def test_lengths_of_steps_add_up_where_the_times_are_known():
    """Compiled as users' programs are: other tests leave out what would round times otherwise."""
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.array([0.0, 0.0, 1.0], y.dtype)))
    end, y0 = 1e3, np.array([1, 0, 0], np.float32)
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        y = np.asarray(
            jax.jit(lambda: solve(term, t1=end, y0=y0, num_steps=100_000).ys[-1])(), float
        )
    finally:
        jax.config.update("jax_disable_most_optimizations", True)
    error = np.angle((y[0] + 1j * y[1]) * np.exp(-1j * end))
    # The angle rounds as a number of its size does. Lengths that do not add up are off by 8e-4.
    assert abs(error) < 2 * np.spacing(np.float32(end))
