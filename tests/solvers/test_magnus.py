"""Commutator-free Magnus methods: steps, orders, derivatives, error control and cost."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from problems import hat
from solver_table import solvers

import cfjax

METHODS = solvers("Magnus")
MAGNUS = {name: row.make() for name, row in METHODS.items()}
PAIRS = [name for name, row in METHODS.items() if row.embedded]

# A field that turns with the frame: seen from there it is constant. `args` are how fast the frame
# turns about the third axis, and the field at the start.
NU = 2.0
B = np.array([0.8, -0.3, 0.5])
# A matrix: its flows are one loop, so that a program has the flow once.
FRAME = np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2 + np.eye(3))[0]


def turning(t, args, xp=jnp):
    nu, b = args
    c, s = xp.cos(nu * t), xp.sin(nu * t)
    return xp.stack([c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]])


def rotation(t, y, args):
    return cfjax.Rotation(turning(t, args))


def exact_matrix(t, nu=NU, b=B):
    axis = nu * np.array([0.0, 0.0, 1.0])
    return scipy.linalg.expm(t * hat(axis)) @ scipy.linalg.expm(t * hat(b - axis))


ARGS = (NU, B)


# Order: steps where the error is above rounding and the slope is seen.
STEPS = {"Magnus2": (32, 64, 128), "Magnus4": (16, 32, 64)}
STEPS |= {"Magnus6": (8, 16, 32), "Magnus10": (5, 7, 9)}


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x != "Magnus6")) for x in STEPS]
)
def test_order_steps_back_and_single_precision(name):
    solver, order = MAGNUS[name], METHODS[name].order
    exact = np.ravel(exact_matrix(4.0) @ FRAME)
    errors = problems.errors(rotation, solver, 4.0, FRAME, ARGS, exact, STEPS[name])
    assert errors[-1] > 2e-13  # A hundred roundings.
    assert int(name.removeprefix("Magnus")) == order
    assert order - 0.3 < problems.slope(STEPS[name], errors) < order + 0.4
    end = functools.partial(problems.many_steps, rotation, solver)
    start, args, n = problems.arrays((FRAME, ARGS, 6))
    there = end(*map(jnp.asarray, (0.0, 2.0)), start, args, n)
    back = end(*map(jnp.asarray, (2.0, 0.0)), there, args, n)
    # The methods are symmetric. Steps of order 10 take flows far forwards and back.
    np.testing.assert_allclose(back, FRAME, rtol=0, atol=2e-14 if order == 10 else 4e-15)
    single = jax.tree.map(lambda x: x.astype(jnp.float32), (start, args))
    found = end(*map(jnp.float32, (0.0, 2.0)), *single, n)
    assert found.dtype == jnp.float32
    # Six steps of up to 16 flows, of 1e-7 each.
    np.testing.assert_allclose(found, there, rtol=0, atol=5e-6)


def product(rows, values, y):
    """Dense exponentials, one after the other."""
    for row in rows:
        along = sum(a * value for a, value in zip(row, values, strict=True))
        y = scipy.linalg.expm(along) @ y
    return y


def omega(xp, t):
    return xp.stack([xp.ones_like(t), xp.cos(t), xp.sin(3 * t)])


def check_step(name, field, parts, y0, run):
    """With its estimate and output within it; the field is the matrix `omega @ parts`."""
    solver, (t, h), theta = MAGNUS[name], (0.3, 0.25), 0.6

    def step(y0):
        times = jnp.asarray(t), jnp.asarray(t + h)
        end, error, info, *_ = problems.first_step(solver, cfjax.LieTerm(field), *times, y0, None)
        path = solver.interpolation_cls(t0=times[0], t1=times[1], **info)
        return end, error, path.evaluate(t + theta * h)

    tableau = solver.tableau
    values = [h * np.tensordot(omega(np, t + c * h), parts, 1) for c in tableau.nodes]
    found, error, within = run(step, jnp.asarray(y0))
    expected = product(tableau.rows, values, y0)
    # Up to 16 exponentials of a few roundings each.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)
    powers = theta ** np.arange(1, 1 + len(tableau.nodes))
    rows = [powers @ np.array(flow) for flow in tableau.continuous_extension]
    # Coefficients of orders 8 and 10 are up to 3000, of both signs, for nine fields.
    atol = 5e-12 if METHODS[name].order > 6 else 1e-13
    np.testing.assert_allclose(within, product(rows, values, y0), rtol=0, atol=atol)
    if name in PAIRS:
        other = product(tableau.embedded, values, y0)
        np.testing.assert_allclose(error, expected - other, rtol=0, atol=4e-14)
    else:
        assert error is None


# Coefficients are taken from one place, and order conditions check them, in methods/.
@pytest.mark.parametrize(
    "names",
    [
        ("Magnus2", "Magnus4", "Magnus4Lobatto"),
        pytest.param(("Magnus6", "Magnus8", "Magnus10"), marks=pytest.mark.slow),
    ],
)
def test_a_step_of_every_method_in_numpy(names, subtests):
    parts = np.stack([hat(axis) for axis in np.eye(3)])
    field = lambda t, y, args: cfjax.Rotation(omega(jnp, t))  # noqa: E731
    for name in names:
        with subtests.test(name=name), cfjax.rewriting(False):
            check_step(name, field, parts, B, problems.op_by_op)


def test_a_step_of_complex_matrices_in_numpy():
    """Its flows are a loop."""
    rng = np.random.default_rng(0)
    parts = rng.normal(size=(3, 3, 3)) + 1j * rng.normal(size=(3, 3, 3))
    y0 = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))
    field = lambda t, y, _: cfjax.LeftMatrix(jnp.tensordot(omega(jnp, t) + 0j, parts, 1))  # noqa: E731
    run = lambda step, y0: jax.jit(step, compiler_options=problems.QUICK)(y0)  # noqa: E731
    check_step("Magnus6", field, parts, y0, run)


# Derivatives


@pytest.mark.slow
def test_derivatives_in_a_batch():
    """Of a general field, and at a field of zero, where they are an integral in closed form."""
    weights = jnp.arange(9.0).reshape(3, 3)

    def end(x):
        def field(t, y, x):
            scale, *args = x
            return cfjax.Rotation(scale * turning(t, args))

        term, y0 = cfjax.LieTerm(field), jnp.asarray(FRAME)
        solver = MAGNUS["Magnus4Lobatto"]
        return cfjax.integrate(term, solver, 0.0, 2.0, y0, x, num_steps=400).ys[-1]

    def derivatives(x, direction):
        gradient = jax.grad(lambda x: jnp.sum(end(x) * weights))(x)
        return *jax.jvp(end, (x,), (direction,)), gradient

    batch = jax.jit(jax.vmap(derivatives), compiler_options=problems.QUICK)
    at_zero, direction_there = problems.arrays(((0.0, *ARGS), (1.0, 0.0, 0 * B)))
    x, direction = problems.arrays(((1.0, *ARGS), (0.2, 0.3, np.array([0.5, -0.4, 0.7]))))

    def both(x):
        pair = lambda *xs: jnp.stack(xs)  # noqa: E731
        return batch(jax.tree.map(pair, x, at_zero), jax.tree.map(pair, direction, direction_there))

    ys, tangents, gradients = both(x)
    # Steps of 1/200: an error of that to the power of 4, with rates up to 2, over 2^4 5!.
    np.testing.assert_allclose(ys, [exact_matrix(2.0) @ FRAME, FRAME], rtol=0, atol=1e-9)
    quotient = problems.central_difference(lambda x: both(x)[0][0], x, direction, 1e-3)
    # 1e-12 times a fifth derivative, and rounding over 1e-3.
    np.testing.assert_allclose(tangents[0], quotient, rtol=0, atol=2e-11)
    rate = np.array([np.sin(NU * 2), 1 - np.cos(NU * 2)]) / NU
    integral = [B[0] * rate[0] - B[1] * rate[1], B[0] * rate[1] + B[1] * rate[0], 2 * B[2]]
    # Quadrature of order 4: at most twice the step of 1/200, to this power, over 2880.
    np.testing.assert_allclose(tangents[1], hat(integral) @ FRAME, rtol=0, atol=1e-9)
    for k, v in enumerate((direction, direction_there)):
        found = problems.inner(jax.tree.map(lambda g: g[k], gradients), v)  # noqa: B023
        # A sum of nine terms up to 8.
        np.testing.assert_allclose(found, jnp.sum(tangents[k] * weights), rtol=0, atol=1e-12)


# Error control


@pytest.mark.parametrize(
    "name", ["Magnus4", *(pytest.param(x, marks=pytest.mark.slow) for x in ("Magnus6", "Magnus8"))]
)
def test_controlled_steps(name):
    solver, term, args = MAGNUS[name], cfjax.LieTerm(rotation), problems.arrays(ARGS)
    y0 = jnp.asarray(FRAME)

    @jax.jit
    def solve(atol, dt0):
        controller = diffrax.PIDController(rtol=0.0, atol=atol)
        return diffrax.diffeqsolve(
            term, solver, 0.0, 6.0, dt0, y0, args, stepsize_controller=controller
        )

    tolerances = np.array([1e-5, 1e-7])
    solutions = [solve(*map(jnp.asarray, (atol, 0.02))) for atol in tolerances]
    # A step that is rejected leaves what the next one starts with.
    rejected = solve(*map(jnp.asarray, (1e-7, 6.0)))
    assert rejected.stats["num_rejected_steps"] > 0
    exact = exact_matrix(6.0) @ FRAME
    for atol, sol in zip((*tolerances, 1e-7), (*solutions, rejected), strict=True):
        # The tolerance is that of every step; the steps are fewer than 600, and most are far
        # better.
        assert np.abs(sol.ys[-1] - exact).max() < 3 * atol
    steps = [int(sol.stats["num_accepted_steps"]) for sol in solutions]
    # As many as an estimate of order q + 1 asks for.
    expected = 100 ** (1 / (solver.tableau.embedded_order + 1))
    assert 0.7 * expected < steps[1] / steps[0] < 1.4 * expected


def test_the_estimate_sees_the_error_of_every_kind_of_field(subtests):
    """In NumPy, as one step is what its tableau says."""
    t0, h = 0.1, 0.4
    kinds = {
        "commuting": lambda t: np.array([0, 0, np.exp(3 * t)]),
        "linear in time": lambda t: np.array([1, 3 * t, 0]),
        "turning": lambda t: turning(t, (5.0, B), np),
    }
    for kind, omega in kinds.items():

        def rate(t, y, omega=omega):
            return np.ravel(hat(omega(t)) @ y.reshape(3, 3))

        exact = problems.reference(rate, t0, t0 + h, np.ravel(FRAME)).reshape(3, 3)
        for name in PAIRS:
            tableau = MAGNUS[name].tableau
            values = [h * hat(omega(t0 + c * h)) for c in tableau.nodes]
            end, other = (product(x, values, FRAME) for x in (tableau.rows, tableau.embedded))
            with subtests.test(case=(kind, name)):
                off = np.linalg.norm(end - exact)
                assert np.linalg.norm(end - other) > max(off, 1e-9)


# Cost


def test_a_step_costs_what_is_promised(subtests):
    counts = {"flows": 0, "evaluations": 0}

    class Counting(cfjax.AbstractFrozenField):
        v: jax.Array

        def flow(self, point):
            counts["flows"] += 1
            return point + self.v

        def tangent(self, point):
            return self.v

    def field(t, y, args):
        counts["evaluations"] += 1
        return Counting(jnp.ones(3) * t)

    def step(solver, y):
        term, times = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        state = solver.init(term, *times, y, None)
        counts.update(flows=0, evaluations=0)
        return solver.step(term, *times, y, None, state, made_jump=False)[0]

    promised = {"Magnus2": (1, 0), "Magnus4": (3, 1), "Magnus4Lobatto": (2, 1)}
    promised |= {"Magnus6": (5, 2), "Magnus8": (8, 5), "Magnus10": (16, 5)}
    for name, (flows, more) in promised.items():
        for estimate in (False, True):
            solver = MAGNUS[name] if estimate else MAGNUS[name].without_estimate()
            # A long step that is rewritten is traced as it is, too.
            with cfjax.rewriting(False), subtests.test(name=name, estimate=str(estimate)):
                jax.eval_shape(functools.partial(step, solver.unrolled()), jnp.ones(3))
                evaluations = METHODS[name].evaluations
                assert counts == {"evaluations": evaluations, "flows": flows + estimate * more}


def test_another_estimate_is_refused(no_shape_hook):
    with pytest.raises(ValueError, match="estimate must be 'group' or None, got 'algebra'"):
        cfjax.Magnus6(estimate="algebra")
