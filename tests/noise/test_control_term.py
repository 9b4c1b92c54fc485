"""`LieControlTerm`: what a field of an increment may be, and every way to solve with it."""

import re
from functools import partial
from itertools import pairwise
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import problems
import pytest
from brownian_paths import GivenStep
from brownian_paths import noise_of as omega_of
from solver_table import solvers

import cfjax

Y0 = jnp.asarray(problems.MOMENTUM)
W = jnp.asarray([0.4, -0.3])
H = jnp.asarray([0.05, 0.12])
GIVEN = GivenStep(W, H)
PIECES: Any = [row.make() for row in solvers("noise").values()]
SOLVERS: Any = [cfjax.CF4(), *PIECES, cfjax.RKMK4()]


def close(found, expected, atol=1e-14):
    """Equal to rounding: a step, or a few, of flows of entries below 1."""
    for a, b in zip(jtu.tree_leaves(found), jtu.tree_leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def drift(t, y, args):
    return cfjax.Rotation(jnp.sin(y[::-1]) + t)


def noise(t, y, args, dw):
    return cfjax.Rotation(omega_of(y, dw) * (1 + t))


def channel(k):
    return lambda t, y, args, dw: noise(t, y, args, jnp.zeros(2).at[k].set(dw[0]))


def terms(*noises: Any) -> diffrax.MultiTerm:
    return diffrax.MultiTerm(cfjax.LieTerm(drift), *noises)


def term_of(path: Any) -> diffrax.MultiTerm:
    return terms(cfjax.LieControlTerm(noise, path))


def step_of(solver, term, y0, args=None, h: Any = 0.25):
    return problems.first_step(solver, term, 0 * h, h, y0, args)[0]


def step(solver, term, y0=Y0, args=None, h: Any = 0.25):
    with cfjax.rewriting(False):
        return problems.op_by_op(lambda h, args: step_of(solver, term, y0, args, h), h, args)


def unsafe(shape, seed=0):
    key = jax.random.key(seed) if isinstance(seed, int) else seed
    return diffrax.UnsafeBrownianPath(shape, key, levy_area=diffrax.SpaceTimeLevyArea)


# Sums


def test_noise_terms_add_up(subtests):
    """Two terms of one channel are one term of two, also in a sum within the sum."""
    parts = [
        cfjax.LieControlTerm(channel(k), GivenStep(W[k : k + 1], H[k : k + 1])) for k in (0, 1)
    ]
    for solver in PIECES:
        with subtests.test(solver=repr(solver)):
            expected = step(solver, term_of(GIVEN))
            close(step(solver, terms(*parts)), expected)
            assert np.linalg.norm(expected - Y0) > 0.3
            if isinstance(solver, cfjax.WeakOrder2):
                close(step(solver, terms(diffrax.MultiTerm(*parts))), expected)


def test_the_sum_of_two_affine_fields_keeps_their_operator():
    """diffrax's own sum would add all arrays, and double the spectrum."""
    spectrum = jnp.asarray([-1.0, -2.0, -4.0])
    directions = np.array([[1.0, -0.5, 0.3], [0.2, 0.8, -1.0]])

    def kick(k):
        return lambda t, y, args, dw: cfjax.Affine(directions[k] * dw[k], spectrum, alpha=dw[k])

    both = [cfjax.LieControlTerm(kick(k), GIVEN) for k in (0, 1)]

    def joined(t, y, args, dw):
        return cfjax.Affine(dw @ jnp.asarray(directions), spectrum, alpha=dw[0] + dw[1])

    solver = cfjax.WeakOrder2(cfjax.CF3())
    expected = step(solver, cfjax.LieControlTerm(joined, GIVEN))
    close(step(solver, diffrax.MultiTerm(*both)), expected)
    assert np.linalg.norm(expected - Y0) > 0.1


def test_fields_of_several_kinds_in_a_sum():
    def push(t, y, args, dw):
        return dw[0] * jnp.ones(3)

    with pytest.raises(TypeError, match="Only fields of one kind can be added, got Rotation and a"):
        step(cfjax.CF4(), terms(cfjax.LieControlTerm(push, GIVEN)))


# Parts of the state


def test_a_part_at_rest_in_one_term_is_moved_by_the_others():
    def product_drift(t, y, args):
        return {"spin": drift(t, y["spin"], args), "at": None, "out": -y["out"], "still": None}

    def product_noise(t, y, args, dw):
        return {
            "spin": noise(t, y["spin"], args, dw),
            "at": cfjax.Rotation(jnp.ones(3) * dw[0]),
            "out": None,
            "still": None,
        }

    y0 = {"spin": Y0, "at": Y0, "out": jnp.asarray(1.0), "still": Y0}
    term = diffrax.MultiTerm(
        cfjax.LieTerm(product_drift), cfjax.LieControlTerm(product_noise, GIVEN)
    )
    solver = cfjax.WeakOrder2()
    y = step(solver, term, y0)
    close(y["spin"], step(solver, term_of(GIVEN)))
    close(y["at"], cfjax.Rotation(jnp.ones(3) * W[0]).flow(Y0))
    # Order 4 in steps of 1/8: less than h^5 / 120.
    close(y["out"], np.exp(-0.25), atol=1e-5)
    np.testing.assert_array_equal(y["still"], Y0)


def test_leading_axes_are_single_solves():
    rng = np.random.default_rng(0)
    n = 3
    w, h = jnp.asarray(rng.standard_normal((2, n, 2)) * 0.3)
    y0 = jnp.asarray(rng.standard_normal((n, 3)))

    def many_drift(t, y, args):
        return cfjax.Rotation(jax.vmap(lambda y: drift(t, y, args).omega)(y))

    def many_noise(t, y, args, dw):
        return cfjax.Rotation(jax.vmap(lambda y, dw: noise(t, y, args, dw).omega)(y, dw))

    def single(solver, w, h, y0):
        return step_of(solver, term_of(GivenStep(w, h)), y0)

    term = diffrax.MultiTerm(
        cfjax.LieTerm(many_drift), cfjax.LieControlTerm(many_noise, GivenStep(w, h))
    )
    solver = cfjax.WeakOrder2()

    @jax.jit
    def both(w, h, y0):
        return step_of(solver, term, y0), jax.vmap(partial(single, solver))(w, h, y0)

    found, alone = both(w, h, y0)
    close(found, alone, atol=1e-13)


def test_an_increment_may_be_a_pytree():
    parts = [{"a": x, "b": x[0]} for x in (W, H)]

    class Given(GivenStep):
        def evaluate(self, t0, t1=None, left=True, use_levy=False):
            dt = {"a": jnp.asarray(t1 - t0), "b": jnp.asarray(t1 - t0)}
            return self.w if not use_levy else diffrax.SpaceTimeLevyArea(dt=dt, W=self.w, H=self.h)

    def field(t, y, args, dw):
        return noise(t, y, args, jnp.stack([dw["b"], dw["a"][1]]))

    solver = cfjax.WeakOrder2()
    found = step(solver, terms(cfjax.LieControlTerm(field, Given(*parts))))
    close(found, step(solver, term_of(GIVEN)))


def test_a_field_of_the_noise_may_call_the_host():
    """What the host makes of the state counts as dependent on it."""

    def on_host(t, y, args, dw):
        axis = jax.pure_callback(np.flip, jax.ShapeDtypeStruct((3,), y.dtype), y)
        return cfjax.Rotation(axis * dw[0])

    def plain(t, y, args, dw):
        return cfjax.Rotation(y[::-1] * dw[0])

    found, expected = (
        step(cfjax.WeakOrder2(), terms(cfjax.LieControlTerm(field, GIVEN)))
        for field in (on_host, plain)
    )
    close(found, expected)
    with pytest.raises(TypeError, match="needs a solver of order 4 where the noise's fields depe"):
        step(cfjax.WeakOrder2(cfjax.CF3()), terms(cfjax.LieControlTerm(on_host, GIVEN)))


# Linear spaces


def test_noise_of_plain_numbers():
    """The same as an array, and as a matrix that diffrax's own term multiplies."""
    matrix = jnp.asarray(np.random.default_rng(1).standard_normal((3, 2)))
    drift = diffrax.ODETerm(lambda t, y, args: jnp.sin(y[::-1]))
    by_field = cfjax.LieControlTerm(lambda t, y, args, dw: matrix @ dw, GIVEN)
    by_matrix = diffrax.ControlTerm(lambda t, y, args: lx.MatrixLinearOperator(matrix), GIVEN)
    for solver in SOLVERS:
        found = [step(solver, diffrax.MultiTerm(drift, term)) for term in (by_field, by_matrix)]
        close(*found)
        assert np.linalg.norm(found[0] - Y0 - matrix @ W) < 0.4


# Times


def test_noise_there_and_back():
    """With fields that do not depend on the state, the way back undoes every piece."""
    solver = cfjax.WeakOrder2()

    def constant(t, y, args):
        return cfjax.Rotation(jnp.asarray([0.3, -0.2, 0.5]))

    def constant_noise(t, y, args, dw):
        return cfjax.Rotation(jnp.stack([dw[0], 0.7 * dw[1], dw[0] - dw[1]]))

    path = unsafe((2,))
    term = diffrax.MultiTerm(cfjax.LieTerm(constant), cfjax.LieControlTerm(constant_noise, path))

    @jax.jit
    def solve(t0, t1, y0):
        return cfjax.integrate(term, solver, t0, t1, y0, num_steps=16).ys[-1]

    there = solve(0.0, 1.0, Y0)
    assert np.linalg.norm(there - Y0) > 0.3
    # All times are exact with steps of 1/16, so what is left is the rounding of 64 flows.
    close(solve(1.0, 0.0, there), Y0, atol=1e-14)


def test_the_increment_and_the_area_of_a_path_followed_backwards():
    class Forwards(GivenStep):
        def evaluate(self, t0, t1=None, left=True, use_levy=False):
            assert t0 == 0.25 and t1 == 0.5
            return super().evaluate(t0, t1, left, use_levy)

    term = cfjax.LieControlTerm(noise, Forwards(W, H))
    there, back = (term.contr(*times, use_levy=True) for times in [(0.25, 0.5), (0.5, 0.25)])
    close((there.dt, there.W, there.H), (0.25, W, H), atol=0)
    close((back.dt, back.W, back.H), (-0.25, -W, -H), atol=0)
    close(term.contr(0.5, 0.25), -W, atol=0)


def test_a_smooth_path():
    """A controlled equation: on straight pieces between steps CF4 has its own order."""
    times = jnp.linspace(0.0, 1.0, 9)
    values = jnp.stack([jnp.sin(3 * times), times**2], 1)
    path = diffrax.LinearInterpolation(times, values)

    @jax.jit
    def sixteen_steps(t0, t1, y0):
        term = cfjax.LieControlTerm(noise, path)
        return cfjax.integrate(term, cfjax.CF4(), t0, t1, y0, num_steps=16).ys[-1]

    def solve(y0, *times):
        for t0, t1 in pairwise(times):
            y0 = sixteen_steps(t0, t1, y0)
        return y0

    def ode(t, y):
        dx = np.asarray(values[1:] - values[:-1])[min(int(t * 8), 7)] * 8
        return np.cross(np.asarray(omega_of(y, dx)) * (1 + t), y)

    answer = np.asarray(Y0)
    for k in range(8):
        answer = problems.reference(ode, k / 8, (k + 1) / 8 - 1e-15, answer)
    steps = [16, 32]
    ends = [solve(Y0, 0.0, 1.0), solve(Y0, 0.0, 0.5, 1.0)]
    errors = np.array([np.linalg.norm(end - answer) for end in ends])
    assert 3.7 < problems.slope(steps, errors) < 4.3
    # Backwards it is the same curve.
    close(solve(ends[-1], 1.0, 0.5, 0.0), Y0, atol=10 * errors[-1])


def test_a_smooth_path_of_several_parts():
    """diffrax subtracts values of its interpolations as if each were one array."""
    times = jnp.linspace(0.0, 1.0, 5)
    values = jnp.stack([jnp.sin(3 * times), times**2], 1)

    def of_parts(t, y, args, dx):
        return noise(t, y, args, jnp.stack([dx["a"], dx["b"]]))

    parts, whole = (
        diffrax.LinearInterpolation(times, x)
        for x in ({"a": values[:, 0], "b": values[:, 1]}, values)
    )
    # The path moves by up to 0.9 in a step, and so do the points.
    expected = step(cfjax.CF4(), cfjax.LieControlTerm(noise, whole))
    close(step(cfjax.CF4(), cfjax.LieControlTerm(of_parts, parts)), expected)
    assert np.linalg.norm(expected - Y0) > 0.1


# Precision and transformations


def test_float32():
    def field(t, y, args, dw):
        return cfjax.Rotation(omega_of(y, dw))

    def end(dtype):
        drift = cfjax.LieTerm(lambda t, y, args: cfjax.Rotation(jnp.sin(y[::-1])))
        path = GivenStep(W.astype(dtype), H.astype(dtype))
        term = diffrax.MultiTerm(drift, cfjax.LieControlTerm(field, path))
        return step(cfjax.WeakOrder2(), term, Y0.astype(dtype), h=np.asarray(0.25, dtype))

    found = end(jnp.float32)
    assert found.dtype == jnp.float32
    # Ten flows of a few roundings of 6e-8.
    close(found, end(jnp.float64), atol=2e-6)


def test_a_batch_of_keys():
    """Every key is a path of its own, whether in a batch or alone."""
    keys = jax.random.split(jax.random.key(3), 3)

    def end(key):
        term = term_of(unsafe((2,), key))
        return cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, Y0, num_steps=5).ys[-1]

    alone = jnp.stack(list(map(jax.jit(end), keys)))
    assert np.linalg.norm(alone[0] - alone[1]) > 0.1
    # Five steps; XLA may fuse otherwise in a batch.
    result = cfjax.map_batch(end, keys, chunk_size=2, progress=False)
    close(result.values, alone, atol=1e-13)
    assert len(result.failed) == 0


def test_functions_in_args():
    """They stay out of what loops carry. Arrays beside them may be traced."""

    def field(t, y, args, dw):
        return cfjax.Rotation(args["shape"](y) * args["size"] * dw[0])

    def plain(t, y, args, dw):
        return cfjax.Rotation(jnp.sin(y) * 0.5 * dw[0])

    def end(solver, size):
        term = terms(cfjax.LieControlTerm(field, GIVEN))
        return step_of(solver, term, Y0, {"shape": jnp.sin, "size": size})

    solver = cfjax.WeakOrder2()
    with cfjax.rewriting(False):
        found = problems.op_by_op(partial(end, solver), 0.5)
    close(found, step(solver, terms(cfjax.LieControlTerm(plain, GIVEN))))


# Derivatives


@pytest.mark.parametrize(
    "solver, options",
    [
        (cfjax.CF2(), {"num_steps": 6, "checkpoint_every": 2}),
        pytest.param(cfjax.WeakOrder2(), {"num_steps": 4}, marks=pytest.mark.slow),
    ],
    ids=["checkpoints", "WeakOrder2"],
)
def test_the_gradient_of_a_path(solver, options):
    """With a path that is drawn again in the way back: the steps have the same times to the bit."""

    def loss(x):
        size, y0 = x

        def field(t, y, args, dw):
            return cfjax.Rotation(size * omega_of(y, dw))

        term = terms(cfjax.LieControlTerm(field, unsafe((2,), 5)))
        y = cfjax.integrate(term, solver, 0.0, 1.0, y0, **options).ys[-1]
        return y @ jnp.asarray([1.0, -2.0, 0.5])

    x = jnp.asarray(0.8), Y0
    both = jax.jit(jax.value_and_grad(loss), compiler_options=problems.QUICK)
    direction = problems.random_like(x, 1)
    difference = problems.central_difference(lambda x: both(x)[0], x, direction, 1e-3)
    # The difference has order 4: a fifth derivative of some 1e4 times 1e-12 / 30, and rounding of
    # 1e-16 / 1e-3.
    close(problems.inner(both(x)[1], direction), difference, atol=1e-9)


# Output within a step


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [*reversed(PIECES), cfjax.CF4()], ids=lambda x: type(x).__name__)
def test_output_within_a_step(solver):
    """It meets both ends and stays on the manifold."""

    @partial(jax.jit, compiler_options=problems.QUICK)
    def output(h):
        end, _, info, *_ = problems.first_step(solver, term_of(GIVEN), 0 * h, h, Y0, None)
        path = solver.interpolation_cls(t0=0 * h, t1=h, **info)
        return end, jax.vmap(path.evaluate)(jnp.linspace(0.0, h, 49))

    end, ys = output(0.5)
    close((ys[0], ys[-1]), (Y0, end), atol=1e-14)
    # A few flows of a few roundings each.
    close(jnp.linalg.norm(ys, axis=1), jnp.full(49, jnp.linalg.norm(Y0)), atol=2e-15)
    # Nowhere does it jump. The pieces of `ShiftedNoise` turn by up to 5 in a third of a step.
    gaps = jnp.linalg.norm(jnp.diff(ys, axis=0), axis=1)
    assert np.max(gaps) < 0.4


# Adaptive steps


def adaptive(solver, atol, path):
    return diffrax.diffeqsolve(
        *(term_of(path), solver, 0.0, 1.0, 0.1, Y0),
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol=0, atol=atol), store_rejected_steps=100
        ),
        max_steps=2048,
        adjoint=diffrax.ForwardMode(),
    )


def test_a_method_has_no_estimate_where_a_path_drives():
    """An embedded method would see an error of the chord alone, and let long steps pass."""
    with pytest.raises(RuntimeError, match="a solver that does not provide error estimates"):
        adaptive(cfjax.CF43(), 1e-2, GIVEN)


def test_a_step_with_noise_returns_none_for_its_error(subtests):
    """diffrax has arrays there, or None, which controllers that use no estimate pass on."""
    bath = cfjax.LieControlTerm(lambda t, y, args, dw: noise(0.0, y, args, dw), GIVEN)
    splitting = diffrax.MultiTerm(cfjax.LieTerm(drift), bath)
    for solver, term in (
        (cfjax.Strang(), splitting),
        *(
            (x, term_of(GIVEN))
            for x in (cfjax.LieEuler(), cfjax.CF43(), cfjax.CK34(), *PIECES, cfjax.RKMK5())
        ),
    ):
        error = lambda y0, s=solver, x=term: problems.first_step(s, x, 0.0, 0.5, y0, None)[1]  # noqa: E731
        with subtests.test(solver=repr(solver)):
            assert eqx.filter_eval_shape(error, Y0) is None


@pytest.mark.slow
def test_step_doubling_controls_the_error():
    @jax.jit
    @jax.vmap
    def solve(key, atol):
        path = diffrax.VirtualBrownianTree(
            0.0, 1.0, 2.0**-10, (2,), key, levy_area=diffrax.SpaceTimeLevyArea
        )
        sol = adaptive(diffrax.HalfSolver(cfjax.CF2()), atol, path)
        return sol.ys[-1], sol.stats["num_steps"]

    keys = jax.random.split(jax.random.key(7), 20)
    found = [solve(keys, jnp.full(20, atol)) for atol in (3e-1, 3e-2, 3e-3)]
    ends, steps = zip(*found, strict=True)
    loose, tight = (jnp.sqrt(jnp.mean(jnp.sum((y - ends[-1]) ** 2, 1))) for y in ends[:2])
    few, many, _ = map(jnp.mean, steps)
    # A tolerance ten times as tight: the error of 20 paths falls like its root or faster.
    assert many > 3 * few
    assert tight < loose / 1.8


# Marks and orders


def test_ito_and_stratonovich_marks_and_strong_orders():
    term, ode = term_of(GIVEN), cfjax.LieTerm(drift)
    kinds = "commutator-free", "low-storage", "Munthe-Kaas", "splitting", "noise"
    of_stratonovich = [row.make() for row in solvers(*kinds).values()]
    of_stratonovich.remove(cfjax.LieEuler())
    for solver in of_stratonovich:
        assert isinstance(solver, diffrax.AbstractStratonovichSolver)
        assert not isinstance(solver, diffrax.AbstractItoSolver)
        assert solver.strong_order(term) == 0.5
        # What diffrax takes for the power of h in an estimate.
        assert solver.error_order(term) == 1
    assert isinstance(cfjax.LieEuler(), diffrax.AbstractItoSolver)
    assert not isinstance(cfjax.LieEuler(), diffrax.AbstractStratonovichSolver)
    assert not isinstance(cfjax.Magnus4(), diffrax.AbstractStratonovichSolver)
    # Ordinary equations have the same orders as ever.
    assert cfjax.CF43().error_order(ode) == 4
    assert cfjax.CF4().order(ode) == 4
    assert cfjax.WeakOrder2(cfjax.RKMK8()).order(term) == 8


def test_diffrax_does_not_warn():
    """It warns of solvers without a mark where it traces, and a warning is an error here."""

    def solve(y0):
        adjoint = diffrax.ForwardMode()
        return diffrax.diffeqsolve(
            term_of(GIVEN), cfjax.LieEuler(), 0.0, 0.5, 0.5, y0, max_steps=1, adjoint=adjoint
        ).ys

    eqx.filter_eval_shape(solve, Y0)


# Errors


def test_wrong_arguments_of_the_control_term(no_shape_hook):
    with pytest.raises(TypeError, match="field must be a function of t, y, args and increment"):
        cfjax.LieControlTerm(1.0, GIVEN)
    with pytest.raises(TypeError, match=r"control must be a diffrax.AbstractPath, such as"):
        cfjax.LieControlTerm(noise, lambda t: t)
    with pytest.raises(TypeError, match=r"control must be a diffrax.AbstractPath, such as"):
        cfjax.LieControlTerm(noise, jax.random.key(0))


def test_fields_that_do_not_fit_the_state(no_shape_hook, subtests):
    cases: Any = (
        (lambda dw: {"a": cfjax.Rotation(jnp.zeros(3))}, "structure is a prefix of the state's"),
        (lambda dw: None, "got None"),
        (lambda dw: dw, r"translation of type f64\[2\] for y"),
        (lambda dw: cfjax.LeftMatrix(1j * jnp.eye(3, dtype=complex)), "make y0 complex"),
        (lambda dw: cfjax.LeftMatrix(jnp.zeros((2, 2))), "does not act there"),
        # JAX reads the second entry in the place of a third one.
        (
            lambda dw: cfjax.Rotation(jnp.stack([dw[0], dw[1], dw[2]])),
            r"reads an entry that its increment does not have, .* f64\[2\]: index 2 is out of",
        ),
    )
    for field, message in cases:
        term = terms(cfjax.LieControlTerm(lambda t, y, args, dw, f=field: f(dw), GIVEN))
        with (
            subtests.test(message=message),
            pytest.raises((TypeError, ValueError), match=message),
        ):
            cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, Y0, num_steps=2)


def test_methods_that_refuse_noise():
    def of_time(t, y, args):
        return cfjax.Rotation(jnp.stack([t, jnp.cos(t), jnp.ones_like(t)]))

    def constant(t, y, args, dw):
        return cfjax.Rotation(jnp.concatenate([dw, dw[:1]]))

    term = diffrax.MultiTerm(cfjax.LieTerm(of_time), cfjax.LieControlTerm(constant, GIVEN))
    with pytest.raises(TypeError, match=re.escape("or cfjax.WeakOrder2()")):
        cfjax.integrate(term, cfjax.Magnus4(), 0.0, 1.0, Y0, num_steps=2)
    with pytest.raises(TypeError, match=re.escape("use diffrax.HalfSolver(solver)")):
        cfjax.integrate(term, cfjax.Richardson(cfjax.CF4()), 0.0, 1.0, Y0, num_steps=2)


def test_a_tableau_of_order_one_takes_no_noise(no_shape_hook):
    term = term_of(GIVEN)
    with pytest.raises(TypeError, match="must have order 2 or more"):
        cfjax.CommutatorFree(cfjax.LieEuler().tableau).for_terms(term)
    assert cfjax.CommutatorFree(cfjax.CF2().tableau).for_terms(term).order(term) == 2
