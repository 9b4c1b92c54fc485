"""`integrate` to given times: steps of a log, and logs of several lengths."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import cfjax

Y0, ARGS = jnp.asarray(problems.MOMENTUM), jnp.asarray(problems.INERTIA)
# Unequal steps, one of them a tenth of the others.
TS = jnp.asarray([0.1, 0.25, 0.265, 0.4, 0.7, 1.0])
INFINITE = jnp.full(3, jnp.inf)
BODY = cfjax.LieTerm(problems.driven_body)


def solve(ts=TS, y0=Y0, args=ARGS, term=BODY, solver=cfjax.CF2(), t0=0.0, **options):  # noqa: B008
    return cfjax.integrate(term, solver, t0, None, y0, args, ts=ts, **options)


def by_diffrax(ts=TS, term=BODY, solver=cfjax.CF2(), y0=Y0, args=ARGS, t0=0.0):  # noqa: B008
    times = jnp.concatenate([jnp.asarray([t0]), ts])
    return diffrax.diffeqsolve(
        *(term, solver, t0, ts[-1], None, y0, args),
        stepsize_controller=diffrax.StepTo(times),
        saveat=diffrax.SaveAt(ts=ts),
        # Also noise without a tree.
        adjoint=diffrax.ForwardMode(),
    ).ys


def close(found, expected, atol=3e-14):
    """Equal to rounding: up to a hundred stages, each with roundings of entries of about one."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver",
    [cfjax.CF54(), cfjax.RKMK8(), cfjax.Projected(diffrax.Tsit5()), cfjax.Magnus4(), cfjax.CK54()],
    ids=lambda solver: type(solver).__name__,
)
def test_the_steps_of_diffrax_to_the_same_times(solver):
    """A method that keeps its last field, and one that keeps none."""
    term = cfjax.LieTerm(problems.driven_body)
    if isinstance(solver, cfjax.Magnus4):
        term = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.sin(t + jnp.arange(3.0))))
    found = solve(term=term, solver=solver, save_every=1)
    np.testing.assert_array_equal(found.ts, TS)
    close(found.ys, by_diffrax(term=term, solver=solver))
    assert found.t1 == 1.0 and found.stats["num_steps"] == len(TS)


def test_a_stiff_method_whose_coefficients_depend_on_the_step():
    rates = jnp.asarray([1.0, 300.0, 2000.0])
    term = cfjax.LieTerm(lambda t, y, args: cfjax.LinearAffine(-jnp.diag(rates), jnp.cos(y)))
    options = {"term": term, "solver": cfjax.ETDRK4(), "y0": jnp.ones(3)}
    close(solve(**options).ys[-1], by_diffrax(**options)[-1])


def test_equal_times_are_equal_steps():
    equal = cfjax.integrate(BODY, cfjax.CF2(), 0.0, 1.0, Y0, ARGS, num_steps=8, save_every=2)
    found = solve(jnp.linspace(0, 1, 9)[1:], save_every=2)
    np.testing.assert_array_equal(found.ts, equal.ts)
    close(found.ys, equal.ys)


def test_backwards_and_from_an_own_start():
    ts = 3.0 - TS
    close(solve(ts, t0=3.0).ys[-1], by_diffrax(ts, t0=3.0)[-1])


@pytest.mark.parametrize("solver", [cfjax.CF2(), cfjax.Projected(diffrax.Heun())])
def test_infinity_is_no_step(solver):
    """It leaves the state as it is to the last bit, and its time, and derivatives too."""
    ts = jnp.concatenate([TS, INFINITE])
    padded, whole = (solve(x, solver=solver, save_every=3, save_initial=True) for x in (ts, TS))
    np.testing.assert_array_equal(padded.ys, jnp.concatenate([whole.ys, whole.ys[-1:]]))
    np.testing.assert_array_equal(padded.ts, jnp.concatenate([whole.ts, whole.ts[-1:]]))
    assert padded.t1 == 1.0

    def loss(y0, args, ts):
        return solve(ts, y0, args, solver=solver).ys[-1] @ jnp.asarray([0.3, -0.7, 0.4])

    gradients = [jax.grad(loss, (0, 1))(Y0, ARGS, x) for x in (ts, TS)]
    for found, expected in zip(*gradients, strict=True):
        close(found, expected)
    none = solve(INFINITE, solver=solver)
    np.testing.assert_array_equal(none.ys[-1], Y0)
    assert none.t1 == 0.0


@pytest.mark.usefixtures("rewritten")
def test_logs_of_several_lengths_in_one_batch():
    """Rewritten too, as a batch is by default."""
    ts = jnp.stack([jnp.concatenate([TS, INFINITE]), jnp.linspace(0, 2, 10)[1:]])
    y0 = jnp.stack([Y0, Y0[::-1]])
    loss = lambda ts, y0: jnp.sum(jnp.sin(solve(ts, y0).ys[-1]))  # noqa: E731
    found = jax.jit(jax.vmap(jax.value_and_grad(loss, 1)))(ts, y0)
    each = [jax.value_and_grad(loss, 1)(*some) for some in ((TS, y0[0]), (ts[1], y0[1]))]
    for k, (value, gradient) in enumerate(each):
        close(found[0][k], value)
        close(found[1][k], gradient)


@pytest.mark.parametrize("options", [{}, {"checkpoint_every": 4}, {"step_back": True}])
def test_derivatives_by_times_and_parameters(options):
    """Beside differences, in reverse mode with all that it may keep."""
    frozen = lambda t, y, args: cfjax.Rotation(jnp.sin(args * t + jnp.arange(3.0)))  # noqa: E731
    ts = jnp.concatenate([TS, INFINITE])

    def loss(t0, args, shift):
        given = {"term": cfjax.LieTerm(frozen), "solver": cfjax.Magnus4(), "t0": t0, "args": args}
        return solve(ts + shift, **given, **options).ys[-1] @ jnp.asarray([0.3, -0.7, 0.4])

    point = (jnp.asarray(-0.2), jnp.asarray(1.5), jnp.asarray(0.05))
    gradient = jax.grad(loss, (0, 1, 2))(*point)
    h = 1e-5
    for k, found in enumerate(gradient):
        ends = [loss(*(x + s * h * (i == k) for i, x in enumerate(point))) for s in (1, -1)]
        # The error of the difference is h^2 times a third derivative of a few units.
        close(found, (ends[0] - ends[1]) / (2 * h), 1e-8)


def test_noise_along_the_times():
    path = diffrax.UnsafeBrownianPath((3,), jax.random.key(0))
    noise = cfjax.LieControlTerm(lambda t, y, args, dw: cfjax.Rotation(0.3 * dw), path)
    term = diffrax.MultiTerm(BODY, noise)
    close(solve(term=term).ys[-1], by_diffrax(term=term)[-1])


def test_new_times_do_not_trace_again():
    traces = []

    def field(t, y, args):
        traces.append(t)
        return cfjax.Rotation(-y / args)

    term = cfjax.LieTerm(field)
    solve(term=term)
    count = len(traces)
    solve(TS / 2, term=term)
    assert len(traces) == count


WRONG = [
    (ValueError, "t1 must be None with ts", {"t1": 1.0}),
    (ValueError, "num_steps must be None with ts", {"num_steps": 6}),
    (ValueError, "give num_steps, or ts for steps", {"ts": None, "t1": 1.0}),
    *(
        (ValueError, r"ts must be real times of shape \(n,\), n at least 1, got", {"ts": ts})
        for ts in (1.0, jnp.ones((2, 2)), jnp.zeros(0), jnp.ones(2, complex), np.array([True]))
    ),
    (ValueError, "save_every must divide the 6 steps, got 4", {"save_every": 4}),
    *(
        (
            eqx.EquinoxRuntimeError,
            "^ts must increase from t0 on, or decrease",
            {"ts": jnp.asarray(x)},
        )
        for x in (
            [0.1, 0.3, 0.2],
            [0.1, 0.1, 0.2],
            [0.0, 0.1],
            [0.1, -0.1],
            [0.1, np.nan, 0.2],
            [np.inf, 0.1],
            [0.1, np.inf, 0.2],
        )
    ),
    (eqx.EquinoxRuntimeError, "^t0 must be finite, got infinity", {"t0": -np.inf}),
]


def test_wrong_times(no_shape_hook, subtests):
    for error, message, options in WRONG:
        options = {"t0": 0.0, "t1": None, "ts": TS} | options
        with subtests.test(options=str(options)), pytest.raises(error, match=message):
            t0, t1 = options.pop("t0"), options.pop("t1")
            cfjax.integrate(BODY, cfjax.CF2(), t0, t1, Y0, ARGS, **options)
    # Within a program, and without an error.
    failed = solve(jnp.asarray([0.2, 0.1]), throw=False)
    assert np.isnan(failed.ys).all() and failed.result != diffrax.RESULTS.successful
    with pytest.raises(eqx.EquinoxRuntimeError, match="ts must increase"):
        jax.block_until_ready(eqx.filter_jit(lambda ts: solve(ts).ys)(jnp.asarray([0.2, 0.1])))
