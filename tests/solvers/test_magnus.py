"""Commutator-free Magnus methods on every algebra; fields that depend on y are refused."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from solver_table import solvers

import cfjax

METHODS = solvers("Magnus")
MAGNUS = {name: row.make() for name, row in METHODS.items()}
PAIRS = [name for name, row in METHODS.items() if row.embedded]

# A field that turns with the frame: seen from there it is constant. `args` are how fast the frame
# turns about the third axis, and the field at the start.
NU = 2.0
B = np.array([0.8, -0.3, 0.5])
START = np.array([0.6, 0.0, 0.8])
# A frame: its flows are one loop, so that a program has the flow once.
FRAME = np.linalg.qr(np.arange(9.0).reshape(3, 3) ** 2 + np.eye(3))[0]


def hat(w):
    return np.cross(w, np.eye(3)).T


def turning(t, args):
    nu, b = args
    c, s = jnp.cos(nu * t), jnp.sin(nu * t)
    return jnp.stack([c * b[0] - s * b[1], s * b[0] + c * b[1], b[2]])


def rotation(t, y, args):
    return cfjax.Rotation(turning(t, args))


def exact_matrix(t, nu=NU, b=B):
    axis = nu * np.array([0.0, 0.0, 1.0])
    return scipy.linalg.expm(t * hat(axis)) @ scipy.linalg.expm(t * hat(b - axis))


ARGS = (NU, B)


# Order: steps where the error is above rounding and the slope is seen.
STEPS = {
    "Magnus2": (32, 64, 128),
    "Magnus4": (16, 32, 64),
    "Magnus4Lobatto": (16, 32, 64),
    "Magnus6": (8, 16, 32),
    "Magnus8": (6, 10, 16),
    "Magnus10": (5, 7, 9),
}


@pytest.mark.parametrize("name", MAGNUS)
def test_order(name):
    solver = MAGNUS[name]
    exact = np.ravel(exact_matrix(4.0) @ FRAME)
    errors = problems.errors(rotation, solver, 4.0, FRAME, ARGS, exact, STEPS[name])
    assert errors[-1] > 2e-13  # A hundred roundings.
    order = METHODS[name].order
    assert int(name.removeprefix("Magnus").removesuffix("Lobatto")) == order == solver.order(None)
    assert order - 0.3 < problems.slope(STEPS[name], errors) < order + 0.4


@pytest.mark.representatives(4)
@pytest.mark.parametrize("name", MAGNUS)
def test_order_within_a_step(name):
    """From the exact start, where an error of the step itself does not hide that of the output."""
    solver, theta = MAGNUS[name], 0.6
    term = cfjax.LieTerm(rotation)
    size = 1.6 if name in ("Magnus8", "Magnus10") else 0.4

    @jax.jit
    def within(h):
        args = problems.arrays(ARGS)
        made = problems.first_step(solver, term, 0.0 * h, h, jnp.asarray(FRAME), args)
        step = solver.interpolation_cls(t0=0.0 * h, t1=h, **made[2])
        return step.evaluate(theta * h), step.evaluate(h) - made[0]

    errors = []
    for h in (size, size / 1.5):
        found, gap = within(jnp.asarray(h))
        # Each of 16 flows has coefficients up to 3000, of both signs, for nine fields.
        np.testing.assert_allclose(gap, 0, rtol=0, atol=5e-12)
        errors.append(np.abs(found - exact_matrix(theta * h) @ FRAME).max())
    order = np.log(errors[0] / errors[1]) / np.log(1.5)
    # The error of one step of a method of this order is of one more.
    expected = METHODS[name].output + 1
    # From above in the long steps which orders 8 and 10 need to be seen over rounding.
    assert expected - 0.5 < order < expected + 0.9


@pytest.mark.parametrize("name", MAGNUS)
def test_one_step_in_numpy(name):
    """Dense exponentials, one after the other, for complex matrices."""
    solver, (t, h) = MAGNUS[name], (0.3, 0.25)
    rng = np.random.default_rng(0)
    parts = rng.normal(size=(3, 3, 3)) + 1j * rng.normal(size=(3, 3, 3))
    y0 = rng.normal(size=3) + 1j * rng.normal(size=3)

    def generator(xp, t):
        return parts[0] + xp.cos(t) * parts[1] + xp.sin(3 * t) * parts[2]

    def step(y0):
        field = cfjax.LieTerm(lambda t, y, _: cfjax.LeftMatrix(generator(jnp, t) + 0j))
        made = problems.first_step(solver, field, jnp.asarray(t), jnp.asarray(t + h), y0, None)
        return made[0], made[1]

    def product(rows):
        values = [h * generator(np, t + c * h) for c in solver.tableau.nodes]
        y = y0
        for row in rows:
            along = sum(a * value for a, value in zip(row, values, strict=True))
            y = scipy.linalg.expm(along) @ y
        return y

    found, error = jax.jit(step)(jnp.asarray(y0))
    expected = product(solver.tableau.rows)
    # Up to 16 exponentials of a few roundings each.
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-14)
    if name in PAIRS:
        other = product(solver.tableau.embedded)
        np.testing.assert_allclose(error, expected - other, rtol=0, atol=4e-14)
    else:
        assert error is None


# Every algebra


def wave(t, shape, phase=0.0):
    size = int(np.prod(shape))
    numbers = jnp.asarray(np.arange(1.0, size + 1).reshape(shape))
    return jnp.sin(numbers * t / size + numbers + phase)


FIELDS = {
    "array": (lambda t, y, _: wave(t, (3,)), START),
    "Rotation": (lambda t, y, _: cfjax.Rotation(wave(t, (3,))), START),
    "QuaternionRotation": (
        lambda t, y, _: cfjax.QuaternionRotation(wave(t, (3,)), frame="body", layout="wxyz"),
        np.array([0.5, 0.5, -0.5, 0.5]),
    ),
    "RigidMotion": (
        lambda t, y, _: cfjax.RigidMotion(
            omega=wave(t, (3,)), v=wave(t, (3,), 1.0), frame="body", layout="wxyz_xyz"
        ),
        np.array([0.6, 0.0, 0.8, 0.0, 0.3, -0.4, 0.5]),
    ),
    "PlanarMotion": (
        lambda t, y, _: cfjax.PlanarMotion(
            omega=wave(t, ()), v=wave(t, (2,)), frame="fixed", layout="unit_complex_xy"
        ),
        np.array([0.6, 0.8, 0.3, -0.4]),
    ),
    "LeftMatrix": (lambda t, y, _: cfjax.LeftMatrix(wave(t, (4, 4))), np.eye(4)[:, :2]),
    "RightMatrix": (lambda t, y, _: cfjax.RightMatrix(wave(t, (3, 3))), START),
    "Conjugation": (lambda t, y, _: cfjax.Conjugation(wave(t, (2, 2))), np.diag([1.0, 2.0])),
    "Congruence": (
        lambda t, y, _: cfjax.Congruence(wave(t, (2, 2)), jnp.diag(wave(t, (2,)))),
        np.diag([1.0, 2.0]),
    ),
    "LinearAffine": (
        lambda t, y, _: cfjax.LinearAffine(wave(t, (3, 3)), wave(t, (3,))),
        START,
    ),
    "BorderedSkew": (
        lambda t, y, _: cfjax.BorderedSkew(wave(t, (4, 2))),
        np.linalg.qr(np.arange(8.0).reshape(4, 2) ** 2 + np.eye(4)[:, :2])[0],
    ),
    "Affine": (
        lambda t, y, _: cfjax.Affine(
            wave(t, (3,)),
            -jnp.arange(1.0, 4.0),
            cfjax.SineTransform(),
            alpha=1.0 + 0.5 * jnp.sin(t),
        ),
        START,
    ),
    "elementwise": (
        lambda t, y, _: cfjax.Rotation(wave(t, (2, 3))),
        np.stack([START, START[::-1]]),
    ),
    "pytree": (
        lambda t, y, _: {"R": cfjax.Rotation(wave(t, (3,))), "v": wave(t, (2,))},
        {"R": np.eye(3), "v": np.ones(2)},
    ),
}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", FIELDS)
def test_every_algebra(name):
    """Against the ambient velocity by SciPy, and `CF4` with two flows instead of five."""
    field, y0 = FIELDS[name]
    y0 = problems.arrays(y0)
    leaves, structure = jax.tree_util.tree_flatten(y0)
    sizes = np.cumsum([leaf.size for leaf in leaves])[:-1]

    @jax.jit
    def rate(t, flat):
        parts = jnp.split(flat, sizes)
        y = [p.reshape(leaf.shape) for p, leaf in zip(parts, leaves, strict=True)]
        y = structure.unflatten(y)
        velocity = cfjax.tangent(field(t, y, None), y)
        return jnp.concatenate([jnp.ravel(v) for v in jax.tree_util.tree_leaves(velocity)])

    exact = problems.reference(lambda t, y: np.asarray(rate(t, y)), 0.0, 1.0, problems.flat(y0))

    def end(solver, num_steps):
        sol = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, y0, num_steps=num_steps)
        return problems.flat(jax.tree_util.tree_map(lambda y: y[-1], sol.ys))

    # Steps of an eighth with an error constant of 2e-6, rates up to about 3: as measured, times 20.
    np.testing.assert_allclose(end(MAGNUS["Magnus6"], 8), exact, rtol=0, atol=2e-8)
    coarse, fine = end(cfjax.CF4(), 2), end(MAGNUS["Magnus4Lobatto"], 2)
    # The same numbers, up to roundings of sums in another order.
    np.testing.assert_allclose(coarse, fine, rtol=0, atol=1e-14)
    assert np.abs(fine - exact).max() > 1e-8


def test_output_within_a_step_is_that_of_cf4():
    def within(solver):
        sol = diffrax.diffeqsolve(
            cfjax.LieTerm(rotation),
            solver,
            0.0,
            1.0,
            0.5,
            jnp.asarray(FRAME),
            problems.arrays(ARGS),
            saveat=diffrax.SaveAt(ts=jnp.array([0.1, 0.35, 0.77])),
        )
        return sol.ys

    found = within(MAGNUS["Magnus4Lobatto"])
    np.testing.assert_allclose(found, within(cfjax.CF4()), rtol=0, atol=1e-14)


# Precision, directions, derivatives


def end_of(solver, args, num_steps=6, t0=0.0, t1=2.0, y0=FRAME, field=rotation):
    y0 = jnp.asarray(y0)
    sol = cfjax.integrate(cfjax.LieTerm(field), solver, t0, t1, y0, args, num_steps=num_steps)
    return sol.ys[-1]


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", MAGNUS)
def test_single_precision(name):
    args = jax.tree_util.tree_map(lambda x: jnp.asarray(x, jnp.float32), ARGS)
    found = end_of(MAGNUS[name], args, y0=FRAME.astype(np.float32))
    assert found.dtype == jnp.float32
    double = end_of(MAGNUS[name], problems.arrays(ARGS))
    # Six steps of up to 16 flows, of 1e-7 each.
    np.testing.assert_allclose(found, double, rtol=0, atol=5e-6)


@pytest.mark.parametrize("name", ["Magnus4", "Magnus6"])
def test_back_in_time(name):
    """The methods are symmetric: steps back lead to where they came from, to rounding."""
    args = problems.arrays(ARGS)
    there = end_of(MAGNUS[name], args)
    back = end_of(MAGNUS[name], args, t0=2.0, t1=0.0, y0=there)
    np.testing.assert_allclose(back, FRAME, rtol=0, atol=4e-15)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", ["Magnus6", "Magnus2"])
def test_derivatives(name):
    weights = jnp.arange(9.0).reshape(3, 3)

    def loss(args):
        return jnp.sum(end_of(MAGNUS[name], args) * weights)

    args, direction = problems.arrays(ARGS), problems.arrays((0.3, np.array([0.5, -0.4, 0.7])))
    expected = problems.central_difference(jax.jit(loss), args, direction, 1e-3)
    gradient = jax.jit(jax.grad(loss))(args)
    # 1e-12 times a fifth derivative, and rounding over 1e-3.
    np.testing.assert_allclose(problems.inner(gradient, direction), expected, rtol=1e-9)
    tangent = jax.jit(lambda a, d: jax.jvp(loss, (a,), (d,))[1])(args, direction)
    np.testing.assert_allclose(tangent, expected, rtol=1e-9)


def test_the_derivative_at_a_field_of_zero():
    """With the field at zero the derivative in it is the integral of what it is multiplied with."""

    def end(scale):
        field = lambda t, y, scale: cfjax.Rotation(scale * turning(t, ARGS))  # noqa: E731
        return end_of(MAGNUS["Magnus6"], scale, field=field)

    integral = np.array(
        [
            (B[0] * np.sin(NU * 2) - B[1] * (1 - np.cos(NU * 2))) / NU,
            (B[0] * (1 - np.cos(NU * 2)) + B[1] * np.sin(NU * 2)) / NU,
            2 * B[2],
        ]
    )
    found = jax.jacfwd(end)(jnp.asarray(0.0))
    # Quadrature of order 8 in six steps.
    np.testing.assert_allclose(found, hat(integral) @ FRAME, rtol=0, atol=1e-9)


def test_a_batch():
    nus = jnp.array([0.5, 1.0, 2.0])
    found = jax.jit(jax.vmap(lambda nu: end_of(MAGNUS["Magnus6"], (nu, jnp.asarray(B)), 20)))(nus)
    for nu, y in zip(nus, found, strict=True):
        # Steps of a tenth: an error of 1e-6 times that to the power of 6, with rates up to 2.
        np.testing.assert_allclose(y, exact_matrix(2.0, float(nu)) @ FRAME, rtol=0, atol=1e-9)


# Error control


@pytest.mark.representatives(2)
@pytest.mark.parametrize("name", PAIRS)
def test_controlled_steps(name):
    solver, term, args = MAGNUS[name], cfjax.LieTerm(rotation), problems.arrays(ARGS)
    y0 = jnp.asarray(FRAME)

    @jax.jit
    def solve(atol):
        dt0 = cfjax.starting_step(term, solver, 0.0, 6.0, y0, args, atol=atol)
        return diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            6.0,
            dt0,
            y0,
            args,
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=atol),
        )

    tolerances = np.array([1e-5, 1e-7])
    solutions = [solve(jnp.asarray(atol)) for atol in tolerances]
    exact = exact_matrix(6.0) @ FRAME
    for atol, sol in zip(tolerances, solutions, strict=True):
        # The tolerance is that of every step; the steps are fewer than 600, and most are far
        # better.
        assert np.abs(sol.ys[-1] - exact).max() < 3 * atol
    steps = [int(sol.stats["num_accepted_steps"]) for sol in solutions]
    # As many as an estimate of order q + 1 asks for.
    expected = 100 ** (1 / (solver.tableau.embedded_order + 1))
    assert 0.7 * expected < steps[1] / steps[0] < 1.4 * expected


# Fields that commute, that are linear in time, that turn.
KINDS = np.eye(3)


@pytest.mark.parametrize("name", PAIRS)
def test_the_estimate_sees_the_error_of_every_kind_of_field(name):
    solver = MAGNUS[name]

    def generator(t, kind):
        commuting = jnp.stack([0 * t, 0 * t, jnp.exp(3 * t)])
        linear = jnp.stack([1 + 0 * t, 3 * t, 0 * t])
        return kind @ jnp.stack([commuting, linear, turning(t, (5.0, jnp.asarray(B)))])

    term = cfjax.LieTerm(lambda t, y, kind: cfjax.Rotation(generator(t, kind)))

    @jax.jit
    def step(kind):
        times = jnp.asarray(0.1), jnp.asarray(0.5)
        return problems.first_step(solver, term, *times, jnp.asarray(FRAME), kind)[:2]

    omega = jax.jit(generator)
    for kind in map(jnp.asarray, KINDS):

        def rate(t, y, kind=kind):
            return np.ravel(hat(np.asarray(omega(t, kind))) @ y.reshape(3, 3))

        y1, error = step(kind)
        off = np.ravel(y1) - problems.reference(rate, 0.1, 0.5, np.ravel(FRAME))
        assert np.linalg.norm(error) > max(np.linalg.norm(off), 1e-9)


def test_a_step_that_is_rejected_leaves_what_the_next_one_starts_with():
    term, args, y0 = cfjax.LieTerm(rotation), problems.arrays(ARGS), jnp.asarray(FRAME)
    controller = diffrax.PIDController(rtol=0.0, atol=1e-7)
    sol = diffrax.diffeqsolve(
        term, cfjax.Magnus6(), 0.0, 6.0, 6.0, y0, args, stepsize_controller=controller
    )
    assert sol.stats["num_rejected_steps"] > 0
    np.testing.assert_allclose(sol.ys[-1], exact_matrix(6.0) @ FRAME, rtol=0, atol=3e-7)


def test_a_field_that_jumps():
    """What is kept from the step before is evaluated anew after a jump."""

    def field(t, y, args):
        return cfjax.Rotation(jnp.where(t < 0.7, 1.0, -2.0) * jnp.asarray(B))

    controller = diffrax.ClipStepSizeController(
        diffrax.PIDController(rtol=0.0, atol=1e-9), jump_ts=jnp.array([0.7])
    )
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        cfjax.Magnus6(),
        0.0,
        1.5,
        0.3,
        jnp.asarray(FRAME),
        stepsize_controller=controller,
    )
    expected = scipy.linalg.expm((0.7 - 2 * 0.8) * hat(B)) @ FRAME
    # diffrax ends a step just before the jump: off by a rounding of the time.
    np.testing.assert_allclose(sol.ys[-1], expected, rtol=0, atol=1e-13)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", MAGNUS)
def test_step_doubling(name):
    solver, args = cfjax.Richardson(MAGNUS[name]), problems.arrays(ARGS)
    atol = 1e-4 if name == "Magnus2" else 1e-6
    sol = diffrax.diffeqsolve(
        cfjax.LieTerm(rotation),
        solver,
        0.0,
        3.0,
        0.3,
        jnp.asarray(FRAME),
        args,
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=atol),
    )
    # As its docstring says.
    np.testing.assert_allclose(sol.ys[-1], exact_matrix(3.0) @ FRAME, rtol=0, atol=6 * atol)


# Cost


@pytest.mark.parametrize(
    ("name", "flows", "more"),
    [
        ("Magnus2", 1, 0),
        ("Magnus4", 3, 1),
        ("Magnus4Lobatto", 2, 1),
        ("Magnus6", 5, 2),
        ("Magnus8", 8, 5),
        ("Magnus10", 16, 5),
    ],
)
@pytest.mark.parametrize("estimate", [False, True])
def test_a_step_costs_what_is_promised(name, flows, more, estimate):
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

    solver = (MAGNUS[name] if estimate else MAGNUS[name].without_estimate()).unrolled()

    def step(y):
        term, times = cfjax.LieTerm(field), (jnp.asarray(0.0), jnp.asarray(0.1))
        state = solver.init(term, *times, y, None)
        counts.update(flows=0, evaluations=0)
        return solver.step(term, *times, y, None, state, made_jump=False)[0]

    # A long step that is rewritten is traced as it is, too.
    with cfjax.rewriting(False):
        jax.eval_shape(step, jnp.ones(3))
    evaluations = METHODS[name].evaluations
    assert counts == {"evaluations": evaluations, "flows": flows + estimate * more}


def test_another_estimate_is_refused(no_shape_hook):
    with pytest.raises(ValueError, match="estimate must be 'group' or None, got 'algebra'"):
        cfjax.Magnus6(estimate="algebra")
