"""`Kraus4`: order, positivity, its estimate, output and derivatives. References are SciPy's."""

import functools
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
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


def general(xp, t):
    rates = xp.stack([1 + 0.8 * xp.sin(3 * t), 0.3 + 0 * t])
    return H0 + xp.sin(2 * t) * H1, [JUMP, LOWER[:3, :3]], rates


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
# Those of a family have one program.
quick = functools.partial(jax.jit, compiler_options=problems.QUICK)
FAMILIES = (general,), (touching_zero, turning), tuple(BLIND), (stiff,)


def at(problem, t):
    # Products of real and complex numbers.
    with jax.numpy_dtype_promotion("standard"):
        return problem(jnp, t)


GENERAL = cfjax.LieTerm(lambda t, y, args: cfjax.Lindblad(*at(general, t)))


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
def program(family):
    """One step from any Hermitian matrix: its end, estimate and output at a part of it."""
    n = levels(family[0])
    start = jnp.eye(n, dtype=complex) / n

    def field(t, y, k):
        parts = [at(problem, t) for problem in family]
        if len(parts) == 1:
            return cfjax.Lindblad(*parts[0])
        with jax.numpy_dtype_promotion("standard"):
            return cfjax.Lindblad(*jax.tree.map(lambda *xs: jnp.stack(xs)[k], *parts))

    term = cfjax.LieTerm(field)

    @quick
    def step(k, t, h, rho, theta):
        state = SOLVER.init(term, t, t + h, start, k)
        end, error, info, *_ = SOLVER.step(term, t, t + h, rho, k, state, made_jump=False)
        path = SOLVER.interpolation_cls(t0=t, t1=t + h, **info)
        return end, error, path.evaluate(t + theta * h)

    return step


def stepper(problem):
    family = next(x for x in FAMILIES if problem in x)
    k = family.index(problem)
    return lambda t, h, rho, theta=0.5: program(family)(*map(jnp.asarray, (k, t, h, rho, theta)))


def one_step(term, y0, args=None):
    """The end of a step and its estimate."""
    return problems.first_step(SOLVER, term, jnp.asarray(0.3), jnp.asarray(0.5), y0, args)[:2]


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
def test_orders_of_steps_and_of_output_within_them(problem):
    step, start = stepper(problem), pure(levels(problem))
    steps, errors = (16, 32, 64), []
    for n in steps:
        rho = start
        for k in range(n):
            rho = step(k * 2 / n, 2 / n, rho)[0]
        errors.append(np.linalg.norm(rho - exact(problem, 0.0, 2.0)))
    # A thousand times the error of the reference.
    assert errors[-1] > 1e-10
    assert 3.8 < problems.slope(steps, np.array(errors)) < 4.3
    errors = [
        np.abs(step(0.0, h, start, 0.6)[2] - exact(problem, 0.0, 0.6 * h)).max() for h in (0.2, 0.1)
    ]
    # The error of one step is of one order more than its method.
    assert 4.6 < np.log2(errors[0] / errors[1]) < 5.6
    end, _, output = step(0.3, 0.5, start, 1.0)
    np.testing.assert_allclose(output, end, rtol=0, atol=2e-15)
    np.testing.assert_allclose(step(0.3, 0.5, start, 0.0)[2], start, rtol=0, atol=2e-15)


def test_many_steps_and_steps_back():
    """A step back has order 4 and keeps the trace. Like the equation, it is not positive."""
    go = functools.partial(problems.many_steps, GENERAL.field, SOLVER)
    start = jnp.asarray(pure(3))
    start = (start + start.conj().T) / 2
    rho = go(*map(jnp.asarray, (0.0, 50.0, start)), None, jnp.asarray(1000))
    # Without its correction the trace is off by 2e-16 a step.
    assert abs(np.trace(rho) - 1) < 2e-15
    np.testing.assert_array_equal(rho, rho.conj().T)
    there = exact(general, 0.0, 1.0)
    ends = [go(*map(jnp.asarray, (1.0, 0.0, there)), None, jnp.asarray(n)) for n in (64, 128)]
    errors = [np.abs(rho - pure(3)).max() for rho in ends]
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.4
    assert abs(np.trace(ends[-1]) - 1) < 1e-14


# Positivity


@pytest.mark.parametrize("problem", [touching_zero, turning])
def test_a_step_of_any_length_is_completely_positive_and_keeps_the_trace(problem):
    """One jump of rank n - 1: a jump of full rank would hide a loss of positivity."""
    step = stepper(problem)
    cases = [(h, 0, 0.5) for h in (0.02, 0.1, 0.5, 1.0, 2.0, 6.0)]
    # And output within a step.
    cases += [(0.5, 2, 0.3), (2.0, 2, 0.7), (6.0, 2, 0.1)]
    for h, which, theta in cases:
        least, trace = choi(lambda rho: step(0.3, h, rho, theta)[which], 4)  # noqa: B023
        # Rounding of a matrix whose trace is 4.
        assert least > -1e-14
        assert trace < 1e-14


# Estimate


def test_the_estimate_sees_the_error(subtests):
    """It is more than the error, but not by far: of order 4, or 5 where nothing jumps."""
    assert SOLVER.error_order(None) == 4
    for problem in (*PROBLEMS, *BLIND):
        step, rho = stepper(problem), pure(levels(problem))
        with subtests.test(problem=problem.__name__):
            estimates = []
            for h in (0.1, 0.05, 0.025):
                end, estimate, _ = step(0.0, h, rho)
                error = np.abs(end - exact(problem, 0.0, h)).max()
                estimates.append(np.abs(estimate).max())
                assert error < estimates[-1] < 2000 * error
            slope = problems.slope((10, 20, 40), np.array(estimates))
            if problem in (drive, commuting_drive):
                assert 4.7 < slope < 5.3
            else:
                assert 3.6 < slope < 4.5


@pytest.mark.slow
def test_stiff_dissipation():
    """Steps far longer than 1 over the largest rate, 5e3: Cholesky meets numbers that underflow."""
    step, y0 = stepper(stiff), jnp.asarray(pure(20))
    field = lambda t, y, args: cfjax.Lindblad(*at(stiff, t))  # noqa: E731
    for num_steps, bound in [(5, 2e-2), (40, 6e-4)]:
        rho = problems.many_steps(field, SOLVER, 0.0, 1.0, y0, None, jnp.asarray(num_steps))
        # As measured, times 3 or more.
        np.testing.assert_allclose(rho, exact(stiff, 0.0, 1.0), rtol=0, atol=bound)
        assert np.linalg.eigvalsh(rho)[0] > -1e-14
    # Also where the fast levels are at rest: there the estimate is the error, but for a tenth.
    for start, rho in [(0.0, pure(20)), (0.5, exact(stiff, 0.0, 0.5))]:
        for h in (0.2, 0.05):
            end, estimate, _ = step(start, h, rho)
            error = np.abs(end - exact(stiff, 0.0, start + h)).max()
            assert 0.8 * error < np.abs(estimate).max() < 20 * error


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Complex dtype support in Diffrax")
def test_controlled_steps():
    y0 = jnp.asarray(pure(3))

    @jax.jit
    def solve(rtol):
        sol = diffrax.diffeqsolve(
            *(GENERAL, SOLVER, 0.0, 2.0, 0.1, y0),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        )
        return sol.ys[-1], sol.stats["num_steps"]

    for rtol in (1e-4, 1e-7):
        rho, num_steps = solve(rtol)
        # The estimate is far above the error of short steps.
        assert np.abs(rho - exact(general, 0.0, 2.0)).max() < rtol
        assert num_steps < 200


def test_constant_steps_compute_no_estimate():
    def step(solver):
        y0 = jnp.asarray(pure(3))
        return lambda t: problems.first_step(solver, GENERAL, t, t + 0.1, y0, None)[:2]

    solvers = SOLVER, SOLVER.without_estimate()
    (full, (_, error)), (plain, (_, none)) = (
        jax.make_jaxpr(step(solver), return_shape=True)(0.0) for solver in solvers
    )
    assert error is not None and none is None
    assert problems.num_operations(plain.jaxpr) < 0.8 * problems.num_operations(full.jaxpr)


# Derivatives


WEIGHTS = np.array([[1, 2 - 1j, 0.5j], [0.3, -1, 1], [2j, 0.7, 0.4]])
ARGS = (H0, JUMP, np.array([0.7, 0.4]), np.eye(3) + 0.5 * JUMP)
ZERO = (0 * H0, 0 * JUMP, *ARGS[2:])


@quick
@jax.value_and_grad
def derivatives(args, theta):
    """Of a function of h, a jump, the rates and the start, within a step or at its end."""

    def field(t, y, args):
        h, jump, rates, _ = args
        with jax.numpy_dtype_promotion("standard"):
            h = (h + h.conj().T) / 2 + jnp.sin(2 * t) * H1
        return cfjax.Lindblad(h, [jump, LOWER[:3, :3]], rates * (1 + jnp.sin(t) / 2))

    y0 = args[3] @ args[3].conj().T
    y0 = y0 / jnp.trace(y0)
    y0 = (y0 + y0.conj().T) / 2
    solver, (t0, t1) = SOLVER.without_estimate(), map(jnp.asarray, (0.3, 0.5))
    info: Any = problems.first_step(solver, cfjax.LieTerm(field), t0, t1, y0, args)[2]
    path = solver.interpolation_cls(t0=t0, t1=t1, **info)
    return jnp.sum(jnp.real(path.evaluate(t0 + theta * (t1 - t0)) * WEIGHTS))


def test_derivatives(subtests):
    for name, args, theta in [("general", ARGS, 1.0), ("zero", ZERO, 0.6)]:
        args = problems.arrays(args)
        real, imag = problems.random_like(args, 1), problems.random_like(args, 2)
        direction = jax.tree.map(
            lambda x, a, b: jax.lax.complex(a, b) if jnp.iscomplexobj(x) else a, args, real, imag
        )
        value = lambda x, theta=theta: derivatives(x, theta)[0]  # noqa: E731
        expected = problems.central_difference(value, args, direction, 1e-3)
        _, gradient = derivatives(args, theta)
        pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
        found = sum(jnp.sum(g * d).real for g, d in pairs)
        with subtests.test(args=name):
            # 1e-12 times a fifth derivative, and rounding over 1e-3.
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)
    # Output takes rates from a polynomial, and those of the wrong sign as zero.
    at_zero, near = (
        derivatives(problems.arrays((*ARGS[:2], np.array([0.7, rate]), ARGS[3])), 0.6)[1]
        for rate in (0.0, 1e-9)
    )
    assert np.abs(at_zero[2]).min() > 1e-3
    # Second derivatives of up to 100.
    problems.assert_close(at_zero, near, 1e-7)


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
    step = lambda y0: problems.first_step(SOLVER, cfjax.LieTerm(field), *times, y0, None)[0]  # noqa: E731
    rho = quick(step)(y0)
    assert rho.dtype == jnp.complex64
    # A step of some ten roundings of 6e-8.
    np.testing.assert_allclose(rho, stepper(general)(0.3, 0.2, pure(3))[0], rtol=0, atol=1e-6)
    assert abs(np.trace(rho) - 1) < 1e-6


def test_leading_axes_and_vmap():
    """A motion for each element, some of whose jumps are common to all."""
    strengths = jnp.array([0.0, 0.5, 1.0])

    def field(t, y, strength):
        h, (jump, lower), rates = at(general, t)
        s = strength.astype(complex)
        if strength.ndim:
            s, h, jump, rates = s[:, None, None], h[None], jump[None], rates[None]
        return cfjax.Lindblad(s * h, [s * jump, lower], rates)

    y0 = jnp.asarray(pure(3))
    end = lambda strength, y0: one_step(cfjax.LieTerm(field), y0, strength)  # noqa: E731
    of_batch = quick(jax.vmap(end, (0, None)))(strengths, y0)
    of_axes = quick(end)(strengths, jnp.broadcast_to(y0, (3, 3, 3)))
    for found, batch, alone in zip(of_axes, of_batch, stepper(general)(0.3, 0.2, y0), strict=False):
        np.testing.assert_allclose(found, batch, rtol=0, atol=1e-14)
        np.testing.assert_allclose(found[-1], alone, rtol=0, atol=1e-14)


def test_a_state_of_several_density_matrices():
    """Whose fields are sums of two terms."""
    pair = {"a": general, "b": turning}

    def part(sign):
        def field(t, y, args):
            parts = {name: at(f, t) for name, f in pair.items()}
            # One term has less of the energy, and another part of the rates.
            return {
                name: cfjax.Lindblad(h * (0.5 + sign), jumps, rates * (0.5 - sign))
                for name, (h, jumps, rates) in parts.items()
            }

        return cfjax.LieTerm(field)

    term = diffrax.MultiTerm(part(0.25), part(-0.25))
    y0 = {name: jnp.asarray(pure(levels(f))) for name, f in pair.items()}
    end, error = quick(lambda y0: one_step(term, y0))(y0)
    for name, f in pair.items():
        expected = stepper(f)(0.3, 0.2, y0[name])[:2]
        for found, value in zip((end[name], error[name]), expected, strict=True):
            np.testing.assert_allclose(found, value, rtol=0, atol=1e-14)


def test_what_is_refused(subtests, no_shape_hook):
    y0 = jnp.asarray(pure(3))

    def beside(part):
        return lambda t, y, args: {"a": cfjax.Lindblad(H0, [JUMP]), "b": part}

    path = diffrax.LinearInterpolation(jnp.arange(3.0), jnp.arange(3.0))
    driven = cfjax.LieControlTerm(
        lambda t, y, args, dx: cfjax.Lindblad(dx.astype(complex) * H0, [JUMP]), path
    )
    of_state = cfjax.LieTerm(lambda t, y, args: cfjax.Lindblad(y + y.conj().T, [JUMP]))
    other = r"must be cfjax.Lindblad, and for y\['b'\] it is "
    cases = [
        (of_state, r"depend on t but not on y.*Lindblad, depends on the state"),
        (cfjax.LieTerm(beside(cfjax.Congruence(-1j * H0))), other + "Congruence"),
        (cfjax.LieTerm(beside(jnp.asarray(H0))), other + "a translation"),
        (cfjax.LieTerm(beside(None)), other + "None"),
        (driven, "Kraus4 takes fields at several times"),
    ]
    for term, message in cases:
        start = {name: y0 for name in "ab"} if message.startswith(other) else y0
        with subtests.test(message=message), pytest.raises(TypeError, match=message):
            cfjax.integrate(term, SOLVER, 0.0, 1.0, start, num_steps=1)
    with pytest.raises(ValueError, match="estimate must be 'group' or None, got 'algebra'"):
        cfjax.Kraus4(estimate="algebra")  # pyright: ignore[reportArgumentType]
