"""The fixed-step loop: agreement with diffrax, output, tracing, memory, and what it refuses."""

import re
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
TERM = cfjax.LieTerm(problems.driven_body)


def close(found, expected, atol=1e-14):
    """Equal to rounding: some 16 steps of a few roundings of entries below 1."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def ode(t, y, args):
    return jnp.sin(y * t) - y[::-1] / args


# The same steps as diffeqsolve


LIE: Any = [cfjax.CF4(), cfjax.RKMK4()]
LINEAR: Any = [
    diffrax.Tsit5(),
    diffrax.Dopri5(),
    diffrax.Midpoint(),
    diffrax.Heun(),
    diffrax.Kvaerno3(root_finder=optx.Newton(rtol=1e-10, atol=1e-12)),
    cfjax.CF4(),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "term, solver",
    [(TERM, s) for s in LIE] + [(diffrax.ODETerm(ode), s) for s in LINEAR],
    ids=lambda x: type(x).__name__,
)
@pytest.mark.parametrize("t1", [2.0, -2.0])
def test_it_takes_the_steps_of_diffeqsolve(term, solver, t1):
    # Steps of 1/8, so that both add up the same times without rounding.
    found = cfjax.integrate(term, solver, 0.0, t1, Y0, ARGS, num_steps=16, save_every=1)
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
    assert found.ts is not None and expected.ts is not None
    assert found.ts.tolist() == expected.ts.tolist()
    # The root finder stops within 1e-10, and starts from elsewhere in the last bits.
    close(found.ys, expected.ys, atol=1e-9 if isinstance(solver, diffrax.Kvaerno3) else 1e-14)
    assert found.result == diffrax.RESULTS.successful


def test_a_wrapped_solver():
    """Both go on from two half steps. For diffrax they are instances of what they wrap."""
    wrapped: Any = [diffrax.HalfSolver(cfjax.CF2()), cfjax.Richardson(cfjax.CF2())]
    expected = cfjax.integrate(TERM, cfjax.CF2(), 0.0, 1.0, Y0, ARGS, num_steps=8)
    for solver in wrapped:
        found = cfjax.integrate(TERM, solver, 0.0, 1.0, Y0, ARGS, num_steps=4)
        close(found.ys, expected.ys)
        assert found.result == diffrax.RESULTS.successful


# Output


@pytest.mark.representatives(3)
@pytest.mark.parametrize("t0, t1", [(0.0, 1.0), (0.1, 0.7), (0.3, -2.6), (1e9, 1e9 + 1)])
@pytest.mark.parametrize("save_every", [None, 1, 3, 12])
def test_the_shape_and_the_times_of_the_output(t0, t1, save_every):
    def field(t, y, args):
        return {"a": cfjax.Rotation(y["a"]), "b": -y["b"]}

    y0 = {"a": Y0, "b": jnp.ones((2, 2))}
    sol = cfjax.integrate(
        cfjax.LieTerm(field), cfjax.CF4(), t0, t1, y0, num_steps=12, save_every=save_every
    )
    n = 12 // (save_every or 12)
    assert sol.ts is not None and sol.ys is not None
    assert sol.ts.shape == (n,)
    assert {k: v.shape for k, v in sol.ys.items()} == {"a": (n, 3), "b": (n, 2, 2)}
    # The last time is t1 to the bit, the others to two units in the last place.
    assert sol.ts[-1] == t1
    exact = t0 + (t1 - t0) * np.arange(1, n + 1) / n
    close(sol.ts, exact, atol=2 * np.spacing(max(abs(t0), abs(t1))))
    assert (sol.t0, sol.t1) == (t0, t1)
    assert sol.stats["num_steps"] == 12


def test_what_is_saved_is_every_nth_state():
    def solve(save_every):
        return cfjax.integrate(
            TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=12, save_every=save_every
        )

    every, third, last = solve(1), solve(3), solve(None)
    # One step is one program in all of them, but fusion may differ in the last bits.
    close(third.ys, every.ys[2::3], atol=1e-15 * 12)
    close(last.ys, every.ys[-1:], atol=1e-15 * 12)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("save_every", [3, None])
def test_the_initial_state_is_saved_on_request(save_every):
    """As by diffrax, with its derivative, and in a batch."""
    options = {"num_steps": 12, "save_every": save_every}

    def solve(y0, t0, **more):
        sol = cfjax.integrate(TERM, cfjax.CF4(), t0, 1.0, y0, ARGS, **options, **more)
        return sol.ts, sol.ys

    def loss(y0, **more):
        ys = solve(y0, 0.25, **more)[1]
        assert ys is not None
        return ys @ jnp.arange(1.0, 4.0)

    ts, ys = jax.jit(lambda y0: solve(y0, 0.25, save_initial=True))(Y0)
    without = jax.jit(lambda y0: solve(y0, 0.25))(Y0)
    assert ts[0] == 0.25
    np.testing.assert_array_equal(ys[0], Y0)
    np.testing.assert_array_equal(ts[1:], without[0])
    # One step is one program in both, but fusion may differ in the last bits.
    close(ys[1:], without[1], atol=1e-15 * 12)
    # Its derivative is the identity, and those of the others are as before.
    jacobian = jax.jit(jax.jacrev(lambda y0: loss(y0, save_initial=True)))(Y0)
    np.testing.assert_array_equal(jacobian[0], jnp.arange(1.0, 4.0))
    close(jacobian[1:], jax.jit(jax.jacrev(loss))(Y0), atol=1e-14)
    # A batch of starts and of initial times.
    y0s, t0s = jnp.stack([Y0, -Y0]), jnp.asarray([0.25, 0.5])
    many = jax.vmap(lambda y0, t0: solve(y0, t0, save_initial=True))(y0s, t0s)
    np.testing.assert_array_equal(many[0][:, 0], t0s)
    np.testing.assert_array_equal(many[1][:, 0], y0s)
    close(many[1][0], ys, atol=1e-14)


@pytest.mark.parametrize("save_initial", [None, 1, "yes"])
def test_a_mistaken_wish_for_the_initial_state(save_initial, no_shape_hook):
    with pytest.raises(TypeError, match="save_initial must be a bool, got"):
        cfjax.integrate(
            TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=2, save_initial=save_initial
        )


def test_many_steps_reach_the_end_of_the_time():
    """Times come from the number of the step, so their rounding does not add up.

    y' = 3 t^2, which the classical method integrates exactly: y(1) = 1 at the sum of 10^5 steps.
    """
    term = diffrax.ODETerm(lambda t, y, args: 3 * t**2)
    sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, jnp.asarray(0.0), num_steps=100_000)
    assert sol.ys is not None
    # A random walk of roundings of y: sqrt(1e5) * 1e-16 = 3e-14. An added-up time errs by 1e-12.
    close(sol.ys[-1], 1.0, atol=2e-13)


def test_one_step_is_one_step():
    @jax.jit
    def step(y):
        time = jnp.asarray(0.2), jnp.asarray(0.5)
        return problems.first_step(cfjax.CF4(), TERM, *time, y, ARGS)[0]

    sol = cfjax.integrate(TERM, cfjax.CF4(), 0.2, 0.5, Y0, ARGS, num_steps=1)
    assert sol.ys is not None
    close(sol.ys[0], step(Y0), atol=2e-16)


def test_there_and_back():
    there = cfjax.integrate(TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=1000)
    assert there.ys is not None
    back = cfjax.integrate(TERM, cfjax.CF4(), 1.0, 0.0, there.ys[-1], ARGS, num_steps=1000)
    assert back.ys is not None
    # The error of CF4 is 1e-8 at 32 steps (see the order tests), so 1e-14 here, twice.
    close(back.ys[-1], Y0, atol=1e-13)


# Precision


@pytest.mark.representatives(3)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("time", [float, np.float64, jnp.float32, int])
def test_the_state_decides_the_precision(dtype, time):
    y0, args = Y0.astype(dtype), ARGS.astype(dtype)
    sol = cfjax.integrate(TERM, cfjax.CF4(), time(0), time(1), y0, args, num_steps=4)
    assert sol.ts is not None and sol.ys is not None
    assert sol.ys.dtype == sol.ts.dtype == dtype


def test_a_complex_state_has_real_times():
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LeftMatrix(jnp.asarray([[1j]])))
    sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, jnp.asarray([1.0 + 0j]), num_steps=4)
    assert sol.ts is not None and sol.ys is not None
    assert sol.ts.dtype == np.float64 and sol.ys.dtype == np.complex128
    close(sol.ys[0], [np.exp(1j)], atol=1e-15)


def test_python_numbers_in_the_state_and_args():
    """As `diffeqsolve` takes them. y' = -2 y in one step of the classical method."""
    term = diffrax.ODETerm(lambda t, y, args: -args * y)
    sol = cfjax.integrate(term, cfjax.CF4(), 0, 1, 1.0, 2.0, num_steps=1)
    close(sol.ys, [1 - 2 + 2 - 8 / 6 + 16 / 24], atol=1e-15)


# Tracing


class Scaled(eqx.Module):
    scale: Any

    def __call__(self, t, y, args):
        return cfjax.Rotation(-self.scale * y / args)


def count_traces(calls) -> list[int]:
    """How often the field was called in each of the `calls`, functions of a field."""
    calls_of_field, counts = 0, []

    class Counting(eqx.Module):
        scale: Any = 1.0

        def __call__(self, t, y, args):
            nonlocal calls_of_field
            calls_of_field += 1
            return Scaled(self.scale)(t, y, args)

    for call in calls:
        before = calls_of_field
        call(Counting)
        counts.append(calls_of_field - before)
    return counts


def test_new_values_do_not_trace_again():
    def call(t0=0.0, t1=1.0, y0=Y0, args=ARGS, scale=1.0, **kwargs):
        kwargs = {"num_steps": 4, "solver": cfjax.CF4()} | kwargs
        solver = kwargs.pop("solver")
        return lambda field: cfjax.integrate(
            cfjax.LieTerm(field(jnp.asarray(scale))), solver, t0, t1, y0, args, **kwargs
        )

    first, *same = count_traces(
        [
            call(),
            call(t0=0.5),
            call(t1=-3.0),
            call(t0=1, t1=2),
            call(t0=jnp.asarray(0.1), t1=np.float32(0.3)),
            call(y0=2 * Y0),
            call(y0=np.asarray(Y0)),
            call(args=2 * ARGS),
            call(scale=2.0),
        ]
    )
    assert first > 0
    assert same == [0] * 8
    single = {"y0": Y0.astype(jnp.float32), "args": ARGS.astype(jnp.float32)}
    others = count_traces(
        [
            call(),
            call(num_steps=5),
            call(save_every=2),
            call(solver=cfjax.CF3()),
            call(**single, scale=np.float32(1)),
        ]
    )
    assert min(others) > 0


def test_python_numbers_in_args_do_not_trace_again():
    traces = 0

    def field(t, y, args):
        nonlocal traces
        traces += 1
        return -args["rate"] * y

    counts = []
    for rate in (1.0, 2.0, 3.0):
        cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0, 1, Y0, {"rate": rate}, num_steps=2)
        counts.append(traces)
    assert counts == 3 * counts[:1] and traces > 0


# Transformations


def end(t0, t1, y0, args):
    sol = cfjax.integrate(TERM, cfjax.CF4(), t0, t1, y0, args, num_steps=8)
    assert sol.ys is not None
    return sol.ys[-1]


POINT = (jnp.asarray(0.2), jnp.asarray(0.9), Y0, ARGS)


@pytest.mark.slow
def test_inside_jit_and_vmap():
    expected = end(*POINT)
    close(jax.jit(end)(*POINT), expected, atol=1e-15)
    batch = jtu.tree_map(lambda x: jnp.stack([x, 0.9 * x, 1.1 * x]), POINT)
    one_by_one = jnp.stack([end(*(x[i] for x in batch)) for i in range(3)])
    close(jax.vmap(end)(*batch), one_by_one, atol=2e-15)
    # A batch in one argument alone, with the others shared.
    for k in range(4):
        point = [*POINT[:k], batch[k], *POINT[k + 1 :]]
        found = jax.vmap(end, [0 if i == k else None for i in range(4)])(*point)
        close(found[0], expected, atol=2e-15)


# Differences of order 4: step^4 = 1e-12 times a fifth derivative of at most 2e4 over 30 (the field
# divides by args, so 5! comes in), and rounding 1e-15 / 1e-3.
STEP, DIFFERENCE_ERROR = 1e-3, 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("k", range(4), ids=["t0", "t1", "y0", "args"])
def test_gradients_in_every_argument(k):
    weights = jnp.asarray([1.0, -2.0, 3.0])

    def fun(x):
        return end(*POINT[:k], x, *POINT[k + 1 :]) @ weights

    direction = problems.random_like(POINT[k], k)
    expected = problems.central_difference(jax.jit(fun), POINT[k], direction, STEP)
    assert abs(expected) > 0.01
    _, forward = jax.jit(lambda x, v: jax.jvp(fun, (x,), (v,)))(POINT[k], direction)
    reverse = problems.inner(jax.jit(jax.grad(fun))(POINT[k]), direction)
    close(forward, expected, atol=DIFFERENCE_ERROR)
    # Both differentiate one program: sums of some 1000 products in another order.
    close(reverse, forward, atol=1e-13)


def test_the_derivative_in_the_end_time_is_the_velocity():
    """d y(t1) / d t1 = f(t1, y(t1)), and d y(t1) / d t0 = -dy/dy0 f(t0, y0), up to the method."""
    t0, t1, y0, args = POINT

    def fine(t0, t1, y0):
        sol = cfjax.integrate(TERM, cfjax.CF4(), t0, t1, y0, args, num_steps=200)
        assert sol.ys is not None
        return sol.ys[-1]

    velocity = lambda t, y: cfjax.tangent(problems.driven_body(t, y, args), y)  # noqa: E731
    d_t0, d_t1, d_y0 = jax.jit(jax.jacfwd(fine, (0, 1, 2)))(t0, t1, y0)
    # The derivative of the method's error: 1e-8 at 32 steps, so 1e-11 at 200.
    close(d_t1, velocity(t1, fine(t0, t1, y0)), atol=1e-10)
    close(d_t0, -d_y0 @ velocity(t0, y0), atol=1e-10)


@pytest.mark.slow
def test_a_hessian():
    def fun(y):
        return jnp.sum(jnp.sin(end(*POINT[:2], y, ARGS)))

    hessian = jax.jit(jax.hessian(fun), compiler_options=problems.QUICK)(Y0)
    assert np.abs(hessian).max() > 0.1
    close(hessian, hessian.T, atol=1e-13)
    gradient = jax.jit(jax.grad(fun))
    for k in range(3):
        expected = problems.central_difference(gradient, Y0, jnp.eye(3)[k], STEP)
        close(hessian[k], expected, atol=DIFFERENCE_ERROR)


# What the compiler makes of it


@pytest.mark.usefixtures("rewritten")
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the loops of XLA on CPU")
def test_a_step_of_a_small_system_is_few_operations_also_backwards():
    """XLA runs a loop of few operations as one function, and every operation apart otherwise."""

    def fun(y0, inertia):
        sol = cfjax.integrate(
            cfjax.LieTerm(problems.rigid_body), cfjax.CF4(), 0.0, 1.0, y0, inertia, num_steps=100
        )
        assert sol.ys is not None
        return jnp.sum(sol.ys)

    def fusions(fun):
        return jax.jit(fun).lower(Y0, ARGS).compile().as_text().count(" fusion(")

    # 16 and 36 as measured. A derivative that XLA breaks into pieces has more than 80.
    assert fusions(fun) < 25
    assert fusions(jax.grad(fun, (0, 1))) < 50


# Memory, as the compiler plans it


BIG = 8  # The state is a matrix of this size.


def temporary_bytes(num_steps, reverse=False, y0=jnp.eye(BIG), **options) -> int:  # noqa: B008
    def run(y0):
        def field(t, y, args):
            return (
                cfjax.LeftMatrix((y - y.T) / 2) if y.ndim == 2 else problems.rigid_body(t, y, args)
            )

        term = cfjax.LieTerm(field)
        sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, ARGS, num_steps=num_steps, **options)
        assert sol.ys is not None
        return jnp.sum(sol.ys)

    fun = jax.grad(run) if reverse else run
    memory = jax.jit(fun).lower(y0).compile().memory_analysis()
    assert memory is not None
    return memory.temp_size_in_bytes


def test_the_memory_forwards_does_not_grow_with_the_steps():
    assert temporary_bytes(100) == temporary_bytes(100_000)


@pytest.mark.slow
def test_the_memory_forwards_grows_by_what_is_saved():
    few, many = temporary_bytes(1000, save_every=100), temporary_bytes(1000, save_every=1)
    saved = 990 * (BIG**2 + 1) * 8
    # Up to a copy of the output, for its sum.
    assert 0.9 * saved < many - few < 2.1 * saved


@pytest.mark.slow
def test_the_memory_backwards_is_one_state_for_each_step():
    few, many = temporary_bytes(100, reverse=True), temporary_bytes(1100, reverse=True)
    a_step = (many - few) / 1000
    # The state, and at most four numbers more: the count, the result, and their padding.
    assert BIG**2 * 8 <= a_step <= (BIG**2 + 4) * 8


@pytest.mark.slow
def test_the_memory_backwards_of_a_small_system_is_its_state_and_a_count_for_each_step():
    few, many = (temporary_bytes(n, reverse=True, y0=Y0) for n in (100, 10_100))
    assert (many - few) / 10_000 <= 3 * 8 + 4


@pytest.mark.slow
def test_the_memory_backwards_grows_with_the_root_of_the_steps_on_request():
    """A block keeps the state and what the last sum lost; within one block a step keeps a state."""

    def states(root):
        return temporary_bytes(root**2, reverse=True, checkpoint_every=root) / (BIG**2 * 8)

    assert 3 * 90 <= states(100) - states(10) <= 3.1 * 90


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "checkpoint_every, save_every",
    # One that leaves steps behind the last checkpoint.
    [(5, None), *(pytest.param(*x, marks=pytest.mark.slow) for x in [(1, None), (4, 6), (30, 6)])],
)
def test_fewer_checkpoints_give_the_same_numbers(checkpoint_every, save_every):
    def run(y0, **options):
        sol = cfjax.integrate(
            TERM, cfjax.CF4(), 0.0, 1.0, y0, ARGS, num_steps=12, save_every=save_every, **options
        )
        assert sol.ys is not None
        return jnp.sum(jnp.sin(sol.ys)), sol.ys

    want = jax.jit(jax.value_and_grad(run, has_aux=True))(Y0)
    found = jax.jit(
        jax.value_and_grad(lambda y: run(y, checkpoint_every=checkpoint_every), has_aux=True)
    )(Y0)
    # The same steps, in which fusion may differ in the last bits.
    jax.tree.map(lambda a, b: close(a, b, atol=1e-14), found, want)


# What it refuses


@pytest.mark.parametrize("num_steps", [0, -1, 1.0, 10.5, True, False, None, "3", np.float64(4)])
def test_a_mistaken_number_of_steps(num_steps):
    with pytest.raises((ValueError, TypeError), match="num_steps"):
        cfjax.integrate(TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=num_steps)


def test_a_number_of_steps_that_is_traced(no_shape_hook):
    def last(n):
        return cfjax.integrate(TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=n).ys[-1]

    with pytest.raises(TypeError, match="num_steps must be known when the program is traced"):
        jax.jit(last)(3)
    assert jax.jit(last, static_argnums=0)(3).shape == Y0.shape


TIMES = [None, "1", True, 1j, np.ones(1), jnp.arange(3.0), jnp.asarray(1 + 0j)]


@pytest.mark.parametrize("time", TIMES, ids=str)
def test_a_mistaken_time(time):
    # An array would broadcast, and every entry of the state get an end of its own.
    for name in ("t0", "t1"):
        with pytest.raises(TypeError, match=f"{name} must be a real scalar, got"):
            cfjax.integrate(
                TERM, cfjax.CF4(), **{"t0": 0.0, "t1": 1.0, name: time}, y0=Y0, num_steps=2
            )


# Steps shorter than the rounding of a time would have length zero or twice their own.
Y0_SINGLE, ARGS_SINGLE = Y0.astype(np.float32), ARGS.astype(np.float32)


@pytest.mark.parametrize("num_steps", [2**24 + 1, 10**9])
def test_more_steps_than_can_be_counted_in_the_dtype_of_the_times(num_steps):
    with pytest.raises(ValueError, match=rf"num_steps must be at most 16777216 .*got {num_steps}"):
        cfjax.integrate(TERM, cfjax.CF4(), -1, 1, Y0_SINGLE, ARGS_SINGLE, num_steps=num_steps)


def test_more_traced_steps_than_can_be_counted():
    """`work_precision` traces the number of steps. It does not run those that are too many."""
    work = cfjax.work_precision(
        TERM,
        -1.0,
        1.0,
        Y0_SINGLE,
        ARGS_SINGLE,
        methods={"LieEuler": cfjax.LieEuler()},
        reference=Y0_SINGLE,
        num_steps=[3, 2**24 + 2],
        repeats=1,
    )
    assert np.isfinite(work.error[0]) and not work.note[0]
    assert work.note[1].startswith("num_steps must leave each step longer")
    assert np.isnan(work.error[1])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_steps_shorter_than_the_rounding_of_the_times(dtype):
    y0, args = Y0.astype(dtype), ARGS.astype(dtype)
    t0 = 1000.0
    # The distance of neighbours just below t1, of which there are 4 in the interval.
    length = 4 * np.spacing(dtype(t0))

    @eqx.filter_jit
    def times(t0, t1, num_steps, sign=1):
        return cfjax.integrate(
            TERM, cfjax.LieEuler(), t0, t1, y0, args, num_steps=num_steps, save_every=1
        ).ts

    for a, b in [(t0, t0 + length), (t0 + length, t0), (-t0, -t0 - length)]:
        steps = np.diff(np.asarray(times(a, b, 4)), prepend=dtype(a))
        np.testing.assert_array_equal(steps, (b - a) / 4)
        with pytest.raises(eqx.EquinoxRuntimeError, match="num_steps must leave each step longer"):
            jax.block_until_ready(times(a, b, 5))
    # Without any time every step has length zero, and nothing moves.
    np.testing.assert_array_equal(times(t0, t0, 5), np.full(5, t0))


@pytest.mark.parametrize("save_every", [0, -1, 5, 24, 1.0, True, False])
def test_a_mistaken_number_of_steps_between_saves(save_every):
    with pytest.raises((ValueError, TypeError), match="save_every"):
        cfjax.integrate(TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=12, save_every=save_every)


@pytest.mark.parametrize("checkpoint_every", [0, -1, 1.0, True])
def test_a_mistaken_number_of_steps_between_checkpoints(checkpoint_every):
    with pytest.raises((ValueError, TypeError), match="checkpoint_every"):
        cfjax.integrate(
            TERM,
            cfjax.CF4(),
            0.0,
            1.0,
            Y0,
            ARGS,
            num_steps=12,
            checkpoint_every=checkpoint_every,
        )


@pytest.mark.parametrize("y0", ["y", np.array(["y"]), jax.random.key(0), object()])
def test_a_state_of_no_numbers(y0, no_shape_hook):
    term = diffrax.ODETerm(lambda t, y, args: y)
    with pytest.raises(TypeError, match="y0 must be an array of numbers"):
        cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=2)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [bool, np.int32, np.float16, jnp.bfloat16])
def test_integers_and_half_precision_become_the_default_dtype(dtype):
    """In both loops."""
    y0 = {"a": jnp.ones(3, dtype), "b": jnp.ones(3)}

    def field(t, y, args):
        return {"a": cfjax.Rotation(y["b"]), "b": -y["b"]}

    term = cfjax.LieTerm(field)
    ours = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=4).ys
    theirs = diffrax.diffeqsolve(term, cfjax.CF4(), 0.0, 1.0, 0.25, y0).ys
    assert {x.dtype.name for x in jtu.tree_leaves((ours, theirs))} == {"float64"}
    # One step computed in another order: a few units of rounding.
    problems.assert_close(ours, theirs, atol=1e-14)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("y0", [None, {}, {"a": None, "b": jnp.ones(2)}, {"b": jnp.zeros((0, 3))}])
@pytest.mark.parametrize(
    "solver",
    [cfjax.CF4(), cfjax.CF54(), cfjax.RKMK4(), cfjax.CK34(), cfjax.Richardson(cfjax.CF3())],
)
def test_a_state_without_arrays_or_with_empty_parts(y0, solver):
    term = cfjax.LieTerm(lambda t, y, args: jtu.tree_map(jnp.ones_like, y))
    ours = cfjax.integrate(term, solver, 0.0, 1.0, y0, num_steps=2)
    fixed = diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.5, y0)
    controller = diffrax.PIDController(rtol=0.0, atol=1e-3)
    controlled = diffrax.diffeqsolve(
        term, cfjax.Richardson(cfjax.CF3()), 0.0, 1.0, 0.5, y0, stepsize_controller=controller
    )
    expected = jtu.tree_map(lambda y: y[None] + 1, y0)
    for sol in (ours, fixed, controlled):
        assert sol.result == diffrax.RESULTS.successful
        problems.assert_close(sol.ys, expected, atol=1e-15)


def test_the_place_of_a_mistake_in_the_state():
    y0 = {"a": 1.0, "b": (jnp.ones(3), jax.random.key(0))}
    with pytest.raises(TypeError, match=r"y0\['b'\]\[1\] must be an array of numbers"):
        cfjax.integrate(diffrax.ODETerm(ode), cfjax.CF4(), 0.0, 1.0, y0, num_steps=2)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("save_every", [None, 1])
def test_a_state_that_is_not_finite(value, save_every):
    y0 = {"a": Y0, "b": Y0.at[1].set(value)}
    term = cfjax.LieTerm(lambda t, y, args: jtu.tree_map(jnp.negative, y))
    with pytest.raises(eqx.EquinoxRuntimeError, match="y0 must be finite"):
        sol = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=4, save_every=save_every)
        jax.block_until_ready(sol.ys)


def test_a_time_that_is_infinite():
    """It is no blow-up, and no NaN, whatever comes of it within the program."""
    for name, times in (("t0", (-np.inf, 1.0)), ("t1", (0.0, np.inf)), ("t1", (np.inf, -np.inf))):
        with pytest.raises(eqx.EquinoxRuntimeError, match=f"^{name} must be finite, got infinity"):
            cfjax.integrate(TERM, cfjax.CF4(), *times, Y0, ARGS, num_steps=4)
    # 1e39 is none in single precision.
    still = cfjax.LieTerm(lambda t, y, args: 0 * y)
    y0 = jnp.ones(1, jnp.float32)
    end = jax.jit(lambda t1: cfjax.integrate(still, cfjax.CF4(), 0.0, t1, y0, num_steps=2))
    with pytest.raises(RuntimeError, match=r"t1 must be finite, got infinity \(in float32"):
        jax.block_until_ready(end(1e39).ys)


@pytest.mark.parametrize("throw", [None, 0, "no"])
def test_throw_is_a_bool(throw, no_shape_hook):
    with pytest.raises(TypeError, match="throw must be a bool, got"):
        cfjax.integrate(TERM, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=2, throw=throw)


@pytest.mark.parametrize("term", [None, problems.driven_body, [TERM, 1]])
def test_a_term_that_is_none(term):
    # The import hook of the test suite may answer first, with the name of the argument.
    with pytest.raises(TypeError, match="term"):
        cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=2)


@pytest.mark.parametrize(
    ("term", "solver", "form"),
    [
        ((TERM, TERM), cfjax.CF4(), "CF4 takes a term of the form"),
        (TERM, diffrax.SemiImplicitEuler(), "SemiImplicitEuler takes a term of the form"),
        (TERM, diffrax.KenCarp4(), "KenCarp4 takes a term of the form .*MultiTerm"),
    ],
)
def test_terms_of_another_form(term, solver, form):
    with pytest.raises(TypeError, match=form):
        cfjax.integrate(term, solver, 0.0, 1.0, Y0, ARGS, num_steps=2)


IMPLICIT = [
    *("ImplicitEuler", "Kvaerno3", "Kvaerno4", "Kvaerno5"),
    *("KenCarp3", "KenCarp4", "KenCarp5", "Sil3"),
]


def test_these_are_the_implicit_solvers_of_diffrax():
    found = [
        name
        for name, cls in vars(diffrax).items()
        if isinstance(cls, type)
        and issubclass(cls, diffrax.AbstractImplicitSolver)
        and not name.startswith("Abstract")
    ]
    assert sorted(found) == sorted(IMPLICIT)


@pytest.mark.representatives(3)
@pytest.mark.parametrize("name", IMPLICIT)
def test_what_is_said_of_an_implicit_solver_without_tolerances_can_be_pasted(name):
    is_split = name in ("KenCarp3", "KenCarp4", "KenCarp5", "Sil3")
    term = diffrax.ODETerm(lambda t, y, args: -y)
    if is_split:
        term = diffrax.MultiTerm(diffrax.ODETerm(lambda t, y, args: 0 * y), term)
    solver = getattr(diffrax, name)()

    def solve(solver):
        return cfjax.integrate(term, solver, 0.0, 0.1, Y0, num_steps=2)

    with pytest.raises(ValueError, match=f"tolerances of its own.*got {name} without") as raised:
        solve(solver)
    advice = re.search(r"Write (.*)\.$", str(raised.value))
    assert advice is not None
    pasted = eval(advice[1], {"diffrax": diffrax, "optimistix": optx})
    assert type(pasted) is type(solver)
    # The first order method: 2 steps of error (h^2 / 2) exp(-0.1).
    np.testing.assert_allclose(solve(pasted).ys[-1], Y0 * np.exp(-0.1), rtol=3e-3)


@pytest.mark.parametrize("wrap", [diffrax.HalfSolver, cfjax.Richardson])
def test_a_wrapped_implicit_solver_needs_tolerances_too(wrap):
    term = diffrax.ODETerm(lambda t, y, args: -y)
    with pytest.raises(ValueError, match=r"got Kvaerno3 without. Write diffrax\.Kvaerno3\("):
        cfjax.integrate(term, wrap(diffrax.Kvaerno3()), 0.0, 1.0, Y0, num_steps=2)


@pytest.mark.parametrize("solver", [None, cfjax.CF4, cfjax.CF4.tableau, "CF4"])
def test_a_solver_that_is_none(solver):
    with pytest.raises(TypeError, match="solver"):
        cfjax.integrate(TERM, solver, 0.0, 1.0, Y0, ARGS, num_steps=2)


@pytest.mark.parametrize(
    "field, message",
    [
        (lambda t, y, args: y[:2], r"translation of type f64\[2\] for y.*f64\[3\]"),
        (lambda t, y, args: y.astype(jnp.float32), r"f32\[3\].*f64\[3\]"),
        (lambda t, y, args: {"a": y}, "prefix of the state"),
        (lambda t, y, args: cfjax.LeftMatrix(jnp.eye(4)), r"LeftMatrix.*f64\[3\]"),
        (lambda t, y, args: None, "got None"),
        (lambda t, y, args: "y", "frozen field"),
    ],
)
def test_a_field_that_does_not_fit(field, message):
    with pytest.raises((TypeError, ValueError), match=message):
        cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0.0, 1.0, Y0, ARGS, num_steps=2)


def test_a_failure_of_the_solver_is_an_error():
    """An implicit solver whose root finder may not move."""
    solver: Any = diffrax.ImplicitEuler(
        root_finder=diffrax.VeryChord(rtol=1e-12, atol=1e-12), root_find_max_steps=1
    )
    term = diffrax.ODETerm(lambda t, y, args: -(y**3) * 100)
    with pytest.raises(eqx.EquinoxRuntimeError):
        sol = cfjax.integrate(term, solver, 0.0, 10.0, jnp.ones(2), num_steps=4)
        jax.block_until_ready(sol.ys)


# A blow-up is never a number. Here y' = y^2, infinite at t = 1 / y0.


def explosion(y0=1.0, **options):
    # With a rotation and a matrix beside it: part of the state stays finite, and so does its field.
    def field(t, y, args):
        return {"a": y["a"] ** 2, "b": cfjax.Rotation(jnp.ones(3)), "c": -y["c"]}

    y0 = {"a": jnp.asarray([0.1, y0]), "b": Y0, "c": jnp.eye(2)}
    return cfjax.integrate(
        cfjax.LieTerm(field), cfjax.CF4(), 0.0, 2.0, y0, num_steps=100, **options
    )


@pytest.mark.representatives(1)
@pytest.mark.parametrize("save_every", [None, 1, 25])
def test_a_blow_up_is_an_error(save_every):
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        jax.block_until_ready(explosion(save_every=save_every).ys)


def test_a_blow_up_inside_jit_is_an_error():
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        jax.block_until_ready(eqx.filter_jit(explosion)().ys)


def test_the_result_tells_of_a_blow_up_where_nothing_is_thrown():
    sol = explosion(throw=False, save_every=25)
    assert sol.result == diffrax.RESULTS.nonfinite
    # Saved at t = 1/2, 1, 3/2 and 2.
    finite = np.isfinite(np.asarray(sol.ys["a"][:, 1]))
    assert finite[0] and not finite[-2:].any()
    assert np.isfinite(np.asarray(sol.ys["b"])).all()
    calm = explosion(0.4, throw=False)
    assert calm.result == diffrax.RESULTS.successful
    # y(2) = y0 / (1 - 2 y0), to the error of 100 steps of order 4.
    close(calm.ys["a"][-1], [0.1 / 0.8, 0.4 / 0.2], atol=1e-6)


@pytest.mark.slow
def test_in_a_batch_the_result_tells_which_blew_up():
    starts = jnp.asarray([0.4, 1.0, 0.2])
    sol = jax.vmap(lambda y: explosion(y, throw=False))(starts)
    failed = jax.vmap(lambda r: r != diffrax.RESULTS.successful)(sol.result)
    assert failed.tolist() == [False, True, False]
    with pytest.raises(eqx.EquinoxRuntimeError, match="Nonfinite"):
        jax.block_until_ready(eqx.filter_vmap(explosion)(starts).ys)


def linear(t, y, args):
    """An array and a matrix: linear in the state, and not symmetric."""
    a = jnp.asarray([[0.1, 1.0, -0.3], [-2.0, 0.2, 0.5], [0.4, 0.7, -0.1]])
    return {"x": cfjax.LeftMatrix(a * jnp.cos(t)), "y": y["x"][:, 0] - 2.0 * y["y"]}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("rewrite", [False, True], ids=["as it is", "rewritten"])
@pytest.mark.parametrize("throw", [True, False], ids=["throw", "result"])
@pytest.mark.parametrize("solver", [cfjax.CF4(), cfjax.Magnus4()], ids=["CF4", "Magnus4"])
def test_the_transpose_of_a_solve_that_is_linear_in_its_start(solver, throw, rewrite):
    """The checks are of the values of what is linear, and in the way of it they are not."""
    field = linear if isinstance(solver, cfjax.CF4) else lambda t, y, args: linear(t, Y, args)["x"]
    Y = {"x": jnp.ones((3, 2)), "y": jnp.ones(3)}
    start = Y if isinstance(solver, cfjax.CF4) else Y["x"]

    def end(y0):
        sol = cfjax.integrate(
            cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=4, save_every=2, throw=throw
        )
        return jtu.tree_map(lambda y: y[-1], sol.ys)

    y, w = problems.random_like(start, 1), problems.random_like(start, 2)
    with cfjax.rewriting(rewrite):
        (back,) = jax.linear_transpose(end, start)(w)
        # What a transpose is. Some thousand products of numbers below 10.
        expected = problems.inner(w, end(y))
        assert abs(expected) > 0.1
        np.testing.assert_allclose(problems.inner(back, y), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("solver", [cfjax.CF2(), cfjax.CF54(), cfjax.RKMK8()])
def test_the_transpose_of_a_small_solve_that_is_rewritten(rewritten, solver):
    """The numbers of its steps, on which the field depends through the time, are known to it."""
    a = jnp.asarray([[0.2, -1.0, 0.5], [0.7, 0.3, -0.4], [-0.6, 0.9, 1.2]])

    def field(t, y, args):
        return (
            cfjax.Rotation(jnp.sin(t) * a[0])
            if isinstance(solver, cfjax.RKMK8)
            else jnp.sin(t) * (a @ y)
        )

    def end(y0):
        return cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=12).ys[-1]

    (back,) = jax.linear_transpose(end, jnp.ones(3))(jnp.arange(3.0))
    # The matrix of the solve, column by column; a hundred products of numbers below 10.
    matrix = jnp.stack([end(e) for e in jnp.eye(3)], axis=1)
    np.testing.assert_allclose(back, jnp.arange(3.0) @ matrix, rtol=0, atol=1e-13)


def turning(y0, rate=1.0, **options):
    term = cfjax.LieTerm(
        lambda t, y, args: cfjax.QuaternionRotation(rate * jnp.ones(3), frame="body", layout="wxyz")
    )
    return cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, y0, num_steps=12, **options)


FAR, NEAR = jnp.array([1.1, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0])
OFF = r"y must start on the manifold that QuaternionRotation acts on: y0 must have length 1 "


@pytest.mark.parametrize(
    "y0, options, message",
    [
        (FAR, {}, OFF + r"\(in y0 @ y0\), and is off by more than 0.1\.$"),
        (
            NEAR.at[1].set(np.nan),
            {},
            r"y0 must be finite, got NaN or infinity\. .* how they were computed\.$",
        ),
        (NEAR, {"rate": np.inf}, "Nonfinite"),
    ],
    ids=["off the manifold", "not finite", "blow-up"],
)
def test_an_error_of_a_call_from_python_is_its_message_alone(y0, options, message):
    with pytest.raises(eqx.EquinoxRuntimeError) as caught:
        turning(y0, **options)
    assert re.match(message, str(caught.value))
    # Nothing raised it but this package, and no error led to it.
    assert caught.value.__cause__ is None and caught.value.__context__ is None
    assert str(caught.traceback[-1].path).endswith("_integrate.py")


@pytest.mark.parametrize("transform", ["grad", "jit", "vmap", "closure"])
def test_a_start_off_the_manifold_is_an_error_within_every_transformation(transform):
    run = {
        "grad": jax.grad(lambda y0: turning(y0).ys.sum()),
        "jit": eqx.filter_jit(lambda y0: turning(y0).ys),
        "vmap": lambda y0: jax.vmap(lambda y0: turning(y0).ys)(jnp.stack([NEAR, y0])),
        # No argument of the solve is traced.
        "closure": lambda y0: jax.vmap(lambda rate: turning(y0, rate).ys)(jnp.ones(2)),
    }[transform]
    assert np.isfinite(run(NEAR)).all()
    with pytest.raises(RuntimeError, match=OFF):
        jax.block_until_ready(run(FAR))


def test_a_start_off_the_manifold_is_in_the_result():
    sol = turning(FAR, throw=False, save_initial=True)
    assert sol.result == diffrax.RESULTS.nonfinite
    assert np.isnan(sol.ys).all()
    sol = cfjax.integrate(TERM, cfjax.CF4(), 0.0, np.nan, Y0, ARGS, num_steps=4, throw=False)
    assert sol.result == diffrax.RESULTS.nonfinite


def test_a_start_that_is_not_finite_is_in_the_result():
    assert explosion(np.nan, throw=False).result == diffrax.RESULTS.nonfinite


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "field, y0",
    [
        (cfjax.Rotation, jnp.ones(3)),
        (lambda w: cfjax.LeftMatrix(jnp.diag(w)), jnp.ones(3)),
        (lambda w: cfjax.RightMatrix(jnp.diag(w)), jnp.ones((2, 3))),
        (lambda w: w, jnp.ones(3)),
    ],
    ids=["Rotation", "LeftMatrix", "RightMatrix", "translation"],
)
@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_no_flow_leads_back_from_infinity(field, y0, bad):
    """So what is not finite at one step is not finite at a later one, where it is looked for."""
    lost = y0.at[..., 0].set(bad)
    ways = [(jnp.ones(3), lost), (jnp.ones(3).at[0].set(bad), lost), (jnp.zeros(3), lost)]
    for velocity, start in ways:
        assert not np.isfinite(np.asarray(cfjax.flow(field(velocity), start))).all()
    # And a field that is lost takes the state with it.
    end = cfjax.flow(field(jnp.ones(3).at[0].set(bad)), y0)
    assert not np.isfinite(np.asarray(end)).all()


@pytest.mark.slow
def test_what_diffrax_says_of_a_blow_up():
    """diffrax leaves NaN in the state, which is visible; a controller runs out of steps."""
    term = cfjax.LieTerm(lambda t, y, args: y**2)
    y0 = jnp.ones(2)
    options: Any = dict(adjoint=diffrax.ForwardMode(), throw=False)
    fixed = diffrax.diffeqsolve(term, cfjax.CF4(), 0.0, 2.0, 0.01, y0, **options)
    assert np.isnan(np.asarray(fixed.ys)).all()
    adaptive = diffrax.diffeqsolve(
        term,
        diffrax.HalfSolver(cfjax.CF4()),
        0.0,
        2.0,
        0.01,
        y0,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-6),
        max_steps=500,
        **options,
    )
    assert adaptive.result == diffrax.RESULTS.max_steps_reached


def test_lengths_of_steps_add_up_where_the_times_are_known():
    """Compiled as users' programs are: other tests leave out what would round times otherwise."""
    term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.array([0.0, 0.0, 1.0], y.dtype)))
    end, y0 = 1e3, np.array([1, 0, 0], np.float32)

    def solve():
        return cfjax.integrate(term, cfjax.CF4(), 0.0, end, y0, num_steps=100_000).ys[-1]

    jax.config.update("jax_disable_most_optimizations", False)
    try:
        y = np.asarray(jax.jit(solve)(), float)
    finally:
        jax.config.update("jax_disable_most_optimizations", True)
    error = np.angle((y[0] + 1j * y[1]) * np.exp(-1j * end))
    # The angle rounds as a number of its size does. Lengths that do not add up are off by 8e-4.
    assert abs(error) < 2 * np.spacing(np.float32(end))
