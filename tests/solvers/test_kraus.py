"""`Kraus4`: order, positivity, its estimate, output and derivatives. References are SciPy's."""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

import cfjax

SOLVER = cfjax.Kraus4()

# Three levels. No part commutes with another, and the jump is complex and not normal: a real or
# normal one would hide a missing conjugate.
H0 = np.array([[1, 0.3j, 0], [-0.3j, 2, 0.5], [0, 0.5, -1]])
H1 = np.array([[0, 1, 0.2j], [1, 0, 0], [-0.2j, 0, 0.7]])
JUMP = np.array([[0.5, 1j, 0], [0, -0.2, 0.3 + 0.4j], [0.1, 0, 1]])
LOWER = np.diag(np.sqrt(np.arange(1.0, 4)), 1)
SX, SZ, DECAY = np.array([[0.0, 1], [1, 0]]), np.diag([1.0, -1]), np.array([[0.0, 1], [0, 0]])


# Each is h, the jumps and their rates at a time, for NumPy and jax.numpy.


def general(xp, t, strength=1.0):
    rates = xp.stack([1 + 0.8 * xp.sin(3 * t), 0.3 + 0 * t])
    return strength * (H0 + xp.sin(2 * t) * H1), [JUMP, LOWER[:3, :3]], rates


def touching_zero(xp, t):
    h = np.diag([0, 1.0, 2.1, 3.3]) + xp.cos(3 * t) * (LOWER + LOWER.T)
    return h, [LOWER], xp.stack([0.3 * (1 + xp.sin(3 * t))])


def turning(xp, t):
    h, _, _ = touching_zero(xp, t)
    return h, [xp.cos(t) * LOWER + xp.sin(t) * LOWER.T], np.array([0.3])


def decay(xp, t):
    """Nothing comes back from where the jump leads."""
    return 0 * SX, [DECAY], xp.stack([1 + 0.5 * xp.sin(3 * t)])


def drive(xp, t):
    """Landau and Zener's crossing, with no rates."""
    return t * SZ + SX, [DECAY], np.zeros(1)


def commuting_drive(xp, t):
    return xp.cos(3 * t) * SX, [DECAY], np.zeros(1)


def fast_dephasing(xp, t):
    """The jump keeps the trace of whatever it acts on."""
    return 5 * SX + 0 * t, [SZ], np.array([0.1])


B20 = np.diag(np.sqrt(np.arange(1.0, 20)), 1)
LOSS = np.linalg.matrix_power(B20, 3) - 1.2**3 * np.eye(20)


def stiff(xp, t):
    """Loss of three quanta at a time: the rates of the levels reach 5e3."""
    return 0.3 * xp.cos(t) * (B20 + B20.T), [LOSS, B20], np.array([1.0, 0.2])


PROBLEMS = [general, touching_zero, turning]
BLIND = [decay, drive, commuting_drive, fast_dephasing]


@functools.cache
def term(problem):
    def field(t, y, args):
        return cfjax.Lindblad(*at(problem, t, *() if args is None else (args,)))

    return cfjax.LieTerm(field)


def at(problem, t, *args):
    # Products of real and complex numbers.
    with jax.numpy_dtype_promotion("standard"):
        return problem(jnp, t, *args)


def levels(problem):
    return len(problem(np, 0.0)[0])


def pure(n):
    v = np.exp(1j * np.arange(n) - np.arange(n) / 2)
    return np.outer(v, v.conj()) / np.vdot(v, v).real


def velocity(problem, t, rho):
    h, jumps, rates = problem(np, t)
    total = -1j * (h @ rho - rho @ h)
    for rate, a in zip(rates, jumps, strict=True):
        loss = a.conj().T @ a
        total = total + rate * (a @ rho @ a.conj().T - (loss @ rho + rho @ loss) / 2)
    return total


@functools.cache
def exact(problem, t0, t1):
    n = levels(problem)
    options: Any = dict(method="DOP853", rtol=1e-13, atol=1e-15)
    ode = lambda t, y: velocity(problem, t, y.reshape(n, n)).ravel()  # noqa: E731
    return solve_ivp(ode, (t0, t1), pure(n).ravel(), **options).y[:, -1].reshape(n, n)


@functools.cache
def stepper(problem, has_output=False):
    """One step from any Hermitian matrix: its end and estimate, or output at a part of it."""
    start = jnp.eye(levels(problem), dtype=complex) / levels(problem)

    @jax.jit
    def step(t, h, rho, *theta):
        state = SOLVER.init(term(problem), t, t + h, start, None)
        end, error, info, *_ = SOLVER.step(
            term(problem), t, t + h, rho, None, state, made_jump=False
        )
        if not has_output:
            return end, error
        path = SOLVER.interpolation_cls(t0=t, t1=t + h, **info)
        return path.evaluate(t + theta[0] * h)

    return lambda *args: step(*map(jnp.asarray, args))


def one_step(field, y0, args=None, solver=SOLVER):
    """The end of a step and its estimate."""
    term = field if isinstance(field, diffrax.AbstractTerm) else cfjax.LieTerm(field)
    return problems.first_step(solver, term, jnp.asarray(0.3), jnp.asarray(0.5), y0, args)[:2]


def matrices(n):
    """Each matrix with one entry, by two Hermitian ones: `E = x + i y`."""
    unit = np.eye(n * n).reshape(n, n, n, n)
    swapped = unit.swapaxes(2, 3)
    return (unit + swapped) / 2 + 0j, (unit - swapped) / 2j


def choi(step, n):
    """The least eigenvalue of Choi's matrix of a map, and how much it may change a trace."""
    x, y = (jax.vmap(jax.vmap(step))(jnp.asarray(part)) for part in matrices(n))
    images = np.asarray(x) + 1j * np.asarray(y)
    matrix = images.transpose(0, 2, 1, 3).reshape(n * n, n * n)
    traces = np.trace(images, axis1=2, axis2=3) - np.eye(n)
    return np.linalg.eigvalsh((matrix + matrix.conj().T) / 2)[0], np.abs(traces).max()


# Order


@pytest.mark.parametrize("problem", PROBLEMS)
def test_order(problem):
    steps, answer = (16, 32, 64), problems.flat(exact(problem, 0.0, 2.0))
    field, y0 = term(problem).field, pure(levels(problem))
    errors = problems.errors(field, SOLVER, 2.0, y0, None, answer, steps)
    # A thousand times the error of the reference.
    assert errors[-1] > 1e-10
    assert 3.8 < problems.slope(steps, errors) < 4.3
    assert SOLVER.order(None) == 4


def test_constant_coefficients():
    """Against the exponential of the superoperator."""
    h, jumps, rates = general(np, 0.4)
    eye = np.eye(3)
    superoperator = -1j * (np.kron(h, eye) - np.kron(eye, h.T))
    for rate, a in zip(rates, jumps, strict=True):
        loss = a.conj().T @ a
        superoperator = superoperator + rate * (
            np.kron(a, a.conj()) - (np.kron(loss, eye) + np.kron(eye, loss.T)) / 2
        )
    expected = (scipy.linalg.expm(superoperator) @ pure(3).ravel()).reshape(3, 3)
    field = cfjax.LieTerm(lambda t, y, args: cfjax.Lindblad(h, jumps, rates))
    ys = cfjax.integrate(field, SOLVER, 0.0, 1.0, jnp.asarray(pure(3)), num_steps=400).ys
    # Steps of 1/400 with rates up to 3, so less than 400 (3 / 400)^5 / 120.
    np.testing.assert_allclose(ys[-1], expected, rtol=0, atol=2e-10)


# Positivity


@pytest.mark.parametrize("problem", [touching_zero, turning])
def test_a_step_of_any_length_is_completely_positive_and_keeps_the_trace(problem):
    """One jump of rank n - 1: a jump of full rank would hide a loss of positivity."""
    step = stepper(problem)
    for h in (0.02, 0.1, 0.5, 1.0, 2.0, 6.0):
        least, trace = choi(lambda rho: step(0.3, h, rho)[0], 4)  # noqa: B023
        # Rounding of a matrix whose trace is 4.
        assert least > -1e-14
        assert trace < 1e-14


def test_that_test_sees_a_method_that_is_not_positive():
    def step(h, rho):
        """The classical Runge-Kutta method."""
        k1 = velocity(touching_zero, 0.3, rho)
        k2 = velocity(touching_zero, 0.3 + h / 2, rho + h / 2 * k1)
        k3 = velocity(touching_zero, 0.3 + h / 2, rho + h / 2 * k2)
        k4 = velocity(touching_zero, 0.3 + h, rho + h * k3)
        return rho + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    with jax.numpy_dtype_promotion("standard"):
        for h in (0.1, 0.5, 1.0):
            assert choi(functools.partial(step, h), 4)[0] < -1e-8


@pytest.mark.parametrize("problem", [touching_zero, turning])
def test_output_within_a_step_is_completely_positive_and_keeps_the_trace(problem):
    step = stepper(problem, has_output=True)
    for h, theta in [(0.5, 0.3), (2.0, 0.7), (6.0, 0.1)]:
        least, trace = choi(lambda rho: step(0.3, h, rho, theta), 4)  # noqa: B023
        assert least > -1e-14
        assert trace < 1e-14


@pytest.mark.slow
def test_stiff_dissipation():
    """Steps far longer than 1 over the largest rate, 5e3: Cholesky meets numbers that underflow."""
    y0 = jnp.asarray(pure(20))
    for num_steps, bound in [(5, 2e-2), (40, 6e-4)]:
        rho = problems.many_steps(
            *(term(stiff).field, SOLVER, 0.0, 1.0, y0, None, jnp.asarray(num_steps))
        )
        # As measured, times 3 or more.
        np.testing.assert_allclose(rho, exact(stiff, 0.0, 1.0), rtol=0, atol=bound)
        assert np.linalg.eigvalsh(rho)[0] > -1e-14


def test_trace_and_symmetry_after_many_steps():
    y0 = jnp.asarray(pure(3))
    y0 = (y0 + y0.conj().T) / 2
    rho = cfjax.integrate(term(general), SOLVER, 0.0, 50.0, y0, num_steps=1000).ys[-1]
    # Without its correction the trace is off by 2e-16 a step.
    assert abs(np.trace(rho) - 1) < 2e-15
    np.testing.assert_array_equal(rho, rho.conj().T)


# Estimate


@pytest.mark.parametrize("problem", [*PROBLEMS, *BLIND])
def test_the_estimate_sees_the_error(problem):
    """It is more than the error, but not by far: of order 4, or 5 where nothing jumps."""
    step, rho = stepper(problem), pure(levels(problem))
    errors, estimates = [], []
    for h in (0.1, 0.05, 0.025):
        end, estimate = step(0.0, h, rho)
        errors.append(np.abs(end - exact(problem, 0.0, h)).max())
        estimates.append(np.abs(estimate).max())
        assert errors[-1] < estimates[-1] < 2000 * errors[-1]
    slope = problems.slope((10, 20, 40), np.array(estimates))
    if problem in (drive, commuting_drive):
        assert 4.7 < slope < 5.3
    else:
        assert SOLVER.error_order(None) == 4
        assert 3.6 < slope < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, 0.5])
def test_the_estimate_sees_the_error_of_stiff_steps(start):
    """Also where the fast levels are at rest: there it is the error itself, but for a tenth."""
    step, rho = stepper(stiff), exact(stiff, 0.0, start) if start else pure(20)
    for h in (0.2, 0.05):
        end, estimate = step(start, h, rho)
        error = np.abs(end - exact(stiff, 0.0, start + h)).max()
        assert 0.8 * error < np.abs(estimate).max() < 20 * error


@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
@pytest.mark.parametrize("problem", [general, decay])
def test_controlled_steps(problem):
    y0 = jnp.asarray(pure(levels(problem)))

    @jax.jit
    def solve(rtol):
        sol = diffrax.diffeqsolve(
            *(term(problem), SOLVER, 0.0, 2.0, 0.1, y0),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        )
        return sol.ys[-1], sol.stats["num_steps"]

    for rtol in (1e-4, 1e-7):
        rho, num_steps = solve(rtol)
        # The estimate is far above the error of short steps.
        assert np.abs(rho - exact(problem, 0.0, 2.0)).max() < rtol
        assert num_steps < 200


def test_constant_steps_compute_no_estimate():
    def step(solver):
        y0 = jnp.asarray(pure(3))
        return lambda t: problems.first_step(solver, term(general), t, t + 0.1, y0, None)[:2]

    solvers = SOLVER, SOLVER.without_estimate()
    (full, (_, error)), (plain, (_, none)) = (
        jax.make_jaxpr(step(solver), return_shape=True)(0.0) for solver in solvers
    )
    assert error is not None and none is None
    assert problems.num_operations(plain.jaxpr) < 0.8 * problems.num_operations(full.jaxpr)


# Output


@pytest.mark.parametrize("problem", PROBLEMS)
def test_order_within_a_step(problem):
    step, rho, theta = stepper(problem, has_output=True), pure(levels(problem)), 0.6
    errors = []
    for h in (0.2, 0.1):
        errors.append(np.abs(step(0.0, h, rho, theta) - exact(problem, 0.0, theta * h)).max())
    # The error of one step is of one order more than its method.
    assert 4.6 < np.log2(errors[0] / errors[1]) < 5.6


@pytest.mark.parametrize("problem", PROBLEMS)
def test_the_ends_of_a_step_are_those_of_its_output(problem):
    rho, output = pure(levels(problem)), stepper(problem, has_output=True)
    end, _ = stepper(problem)(0.3, 0.5, rho)
    np.testing.assert_allclose(output(0.3, 0.5, rho, 1.0), end, rtol=0, atol=2e-15)
    np.testing.assert_allclose(output(0.3, 0.5, rho, 0.0), rho, rtol=0, atol=2e-15)


# Derivatives


def loss(args):
    """A function of h, a jump, the rates and the start, after a step."""

    def field(t, y, args):
        h, jump, rates, _ = args
        with jax.numpy_dtype_promotion("standard"):
            h = (h + h.conj().T) / 2 + jnp.sin(2 * t) * H1
        return cfjax.Lindblad(
            h,
            [jump, LOWER[:3, :3]],
            rates * (1 + jnp.sin(t) / 2),
        )

    a = args[3]
    y0 = a @ a.conj().T
    y0 = y0 / jnp.trace(y0)
    y0 = (y0 + y0.conj().T) / 2
    end = one_step(field, y0, args, SOLVER.without_estimate())[0]
    return jnp.sum(jnp.real(end * WEIGHTS))


WEIGHTS = np.array([[1, 2 - 1j, 0.5j], [0.3, -1, 1], [2j, 0.7, 0.4]])
ARGS = (H0, JUMP, np.array([0.7, 0.4]), np.eye(3) + 0.5 * JUMP)
ZERO = (0 * H0, 0 * JUMP, np.array([0.7, 0.4]), np.eye(3) + 0.5 * JUMP)


quick = functools.partial(jax.jit, compiler_options=problems.QUICK)
VALUE, GRADIENT = quick(loss), quick(jax.grad(loss))
TANGENT = quick(lambda args, direction: jax.jvp(loss, (args,), (direction,))[1])


@pytest.mark.parametrize("args", [ARGS, ZERO], ids=["general", "zero"])
def test_derivatives(args):
    args = problems.arrays(args)
    real, imag = problems.random_like(args, 1), problems.random_like(args, 2)
    direction = jax.tree.map(
        lambda x, a, b: jax.lax.complex(a, b) if jnp.iscomplexobj(x) else a, args, real, imag
    )
    expected = problems.central_difference(VALUE, args, direction, 1e-3)
    gradient = GRADIENT(args)
    pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    found = sum(jnp.sum(g * d).real for g, d in pairs)
    # 1e-12 times a fifth derivative, and rounding over 1e-3.
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)
    tangent = TANGENT(args, direction)
    np.testing.assert_allclose(tangent, expected, rtol=1e-8, atol=1e-10)


def test_a_derivative_of_output_at_a_rate_of_zero():
    """Output takes rates from a polynomial, and those of the wrong sign as zero."""

    def output(rate):
        field = cfjax.LieTerm(lambda t, y, _: cfjax.Lindblad(0 * SX, [DECAY], rate[None]))
        t0, t1, y0 = jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray(np.diag([0.0, 1]) + 0j)
        made = problems.first_step(SOLVER, field, t0, t1, y0, None)
        return SOLVER.interpolation_cls(t0=t0, t1=t1, **made[2]).evaluate(0.5)[1, 1].real

    found = jax.jit(jax.jacfwd(output))(jnp.asarray(0.0))
    np.testing.assert_allclose(found, -0.5, rtol=1e-12)


# Precision, batches, pytrees, directions


def test_single_precision():
    def field(t, y, args):
        h, jumps, rates = at(general, t)
        return cfjax.Lindblad(
            h.astype(jnp.complex64),
            [a.astype(np.complex64) for a in jumps],
            rates.astype(jnp.float32),
        )

    y0 = jnp.asarray(pure(3), jnp.complex64)
    times = jnp.float32(0.3), jnp.float32(0.5)
    rho, _ = jax.jit(
        lambda y0: problems.first_step(SOLVER, cfjax.LieTerm(field), *times, y0, None)[:2]
    )(y0)
    assert rho.dtype == jnp.complex64
    # A step of some ten roundings of 6e-8.
    np.testing.assert_allclose(rho, stepper(general)(0.3, 0.2, pure(3))[0], rtol=0, atol=1e-6)
    assert abs(np.trace(rho) - 1) < 1e-6


def test_leading_axes():
    """A motion for each element, some of whose jumps are common to all."""
    strengths = jnp.array([0.5, 1.0])

    def field(t, y, args):
        h, (jump, lower), rates = at(general, t)
        h = strengths[:, None, None].astype(complex) * h[None]
        jumps = [strengths[:, None, None].astype(complex) * jump[None], lower]
        return cfjax.Lindblad(h, jumps, rates[None])

    def alone(strength):
        strength = strength.astype(complex)

        def field(t, y, args):
            h, (jump, lower), rates = at(general, t)
            return cfjax.Lindblad(strength * h, [strength * jump, lower], rates)

        return one_step(field, jnp.asarray(pure(3)))

    y0 = jnp.broadcast_to(jnp.asarray(pure(3)), (2, 3, 3))
    found, expected = jax.jit(lambda y0: one_step(field, y0))(y0), jax.jit(alone)
    for k, strength in enumerate(strengths):
        for batch, value in zip(found, expected(strength), strict=True):
            np.testing.assert_allclose(batch[k], value, rtol=0, atol=1e-14)


def test_a_batch():
    strengths, y0 = jnp.array([0.0, 0.5, 1.0]), jnp.asarray(pure(3))
    end = lambda strength: one_step(term(general), y0, strength)  # noqa: E731
    found, alone = jax.jit(jax.vmap(end))(strengths), jax.jit(end)
    for k, strength in enumerate(strengths):
        for batch, expected in zip(found, alone(strength), strict=True):
            np.testing.assert_allclose(batch[k], expected, rtol=0, atol=1e-14)


def test_a_state_of_several_density_matrices():
    pair = {"a": general, "b": turning}

    def field(t, y, args):
        return {name: term(f).field(t, y[name], None) for name, f in pair.items()}

    y0 = {name: jnp.asarray(pure(levels(f))) for name, f in pair.items()}
    end, error = jax.jit(lambda y0: one_step(field, y0))(y0)
    for name, f in pair.items():
        expected = stepper(f)(0.3, 0.2, y0[name])
        for found, value in zip((end[name], error[name]), expected, strict=True):
            np.testing.assert_allclose(found, value, rtol=0, atol=1e-14)


def test_a_sum_of_terms():
    drives = [lambda t: H0, lambda t: jnp.sin(2 * t).astype(complex) * H1]

    def moved_by(h, rates):
        return cfjax.LieTerm(lambda t, y, _: cfjax.Lindblad(h(t), [JUMP, LOWER[:3, :3]], rates))

    rates = np.array([1.0, 0.3])
    terms = [moved_by(h, rates / 2) for h in drives]
    whole = moved_by(lambda t: drives[0](t) + drives[1](t), rates)
    y0 = jnp.asarray(pure(3))
    found, expected = (
        jax.jit(lambda y0, x=x: one_step(x, y0)[0])(y0) for x in (diffrax.MultiTerm(*terms), whole)
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_back_in_time():
    """A step back has order 4 and keeps the trace. Like the equation, it is not positive."""
    there = jnp.asarray(exact(general, 0.0, 1.0))
    back = functools.partial(problems.many_steps, term(general).field, SOLVER)
    ends = [back(*map(jnp.asarray, (1.0, 0.0, there)), None, jnp.asarray(n)) for n in (64, 128)]
    errors = [np.abs(rho - pure(3)).max() for rho in ends]
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.4
    assert abs(np.trace(ends[-1]) - 1) < 1e-14


# Errors


def solve(field, y0):
    cfjax.integrate(cfjax.LieTerm(field), SOLVER, 0.0, 1.0, y0, num_steps=1)


def test_a_field_of_the_state_is_refused():
    def field(t, y, args):
        return cfjax.Lindblad(y + y.conj().T, [JUMP])

    with pytest.raises(
        TypeError, match=r"depend on t but not on y.*Lindblad, depends on the state"
    ):
        solve(field, jnp.asarray(pure(3)))


@pytest.mark.parametrize(
    ("part", "got"),
    [
        (cfjax.Congruence(-1j * H0), "Congruence"),
        (jnp.asarray(H0), "a translation"),
        (None, "None"),
    ],
)
def test_other_fields_are_refused(part, got):
    def field(t, y, args):
        return {"a": cfjax.Lindblad(H0, [JUMP]), "b": part}

    y0 = {name: jnp.asarray(pure(3)) for name in "ab"}
    with pytest.raises(TypeError, match=rf"must be cfjax.Lindblad, and for y\['b'\] it is {got}"):
        solve(field, y0)


def test_a_path_is_refused():
    path = diffrax.LinearInterpolation(jnp.arange(3.0), jnp.arange(3.0))
    driven = cfjax.LieControlTerm(
        lambda t, y, args, dx: cfjax.Lindblad(dx.astype(complex) * H0, [JUMP]), path
    )
    with pytest.raises(TypeError, match="Kraus4 takes fields at several times"):
        cfjax.integrate(driven, SOLVER, 0.0, 1.0, jnp.asarray(pure(3)), num_steps=1)


def test_another_estimate_is_refused(no_shape_hook):
    with pytest.raises(ValueError, match="estimate must be 'group' or None, got 'algebra'"):
        cfjax.Kraus4(estimate="algebra")  # pyright: ignore[reportArgumentType]
