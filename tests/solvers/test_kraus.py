"""`Kraus4`: order, positivity, its estimate, output and derivatives. References are SciPy's."""

import functools
import itertools
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp

import cfjax

SOLVER = cfjax.Kraus4()
quick = functools.partial(jax.jit, compiler_options=problems.QUICK)

# Five levels, as products of smaller matrices make longer programs. No part commutes with another,
# and the jump is complex and not normal: a real or normal one would hide a missing conjugate.
_RNG = np.random.default_rng(4)
H0, H1, JUMP = (_RNG.normal(size=(2, 3, 5, 5)) / 4).transpose(1, 2, 3, 0) @ [1, 1j]
H0, H1 = ((h + h.conj().T) / 2 for h in (H0, H1))
LOWER = np.diag(np.sqrt(np.arange(1.0, 5)), 1)
# Of the same rank, with no zeros: a known jump that stays as it is in output within steps.
_Q = np.linalg.qr(_RNG.normal(size=(5, 5)))[0]
LOSS = _Q @ LOWER @ _Q.T
# Of two levels, beside the others.
DECAY, SZ = np.diag([1.0, 0, 0, 0], 1), np.diag([1.0, -1, 0, 0, 0])
SX = DECAY + DECAY.T


class Problem(NamedTuple):
    """An h and two jumps, of which the second is `LOSS`. Values, so that all have one program."""

    # The weights of 1, sin(2t), cos(3t) and t.
    h: tuple[Any, ...] = ()
    # Those of 1, cos(t) and sin(t).
    jump: tuple[Any, ...] = ()
    # For each jump those of 1 and sin(3t).
    rates: tuple[Any, ...] = ((0.0, 0.0), (0.0, 0.0))

    def values(self):
        h, jump = np.zeros((2, 4, 5, 5), complex)
        h[: len(self.h)], jump[: len(self.jump)] = self.h or h[:0], self.jump or jump[:0]
        return h, jump[:3], np.array(self.rates)


LADDER = (np.diag([0, 1.0, 2.1, 3.3, 4.6]), 0 * H0, LOWER + LOWER.T)
PROBLEMS = {
    "general": Problem((H0, H1), (JUMP,), ((1.0, 0.8), (0.3, 0.0))),
    "touching zero": Problem(LADDER, (), ((0.0, 0.0), (0.3, 0.3))),
    "turning": Problem(LADDER, (0 * H0, LOWER, LOWER.T), ((0.3, 0.0), (0.0, 0.0))),
}
BLIND = {
    # Nothing comes back from where the jump leads.
    "decay": Problem((), (DECAY,), ((1.0, 0.5), (0.0, 0.0))),
    # Landau and Zener's crossing, with no rates.
    "drive": Problem((SX, 0 * SX, 0 * SX, SZ)),
    "commuting drive": Problem((0 * SX, 0 * SX, SX)),
    # The jump keeps the trace of whatever it acts on.
    "fast dephasing": Problem((5 * SX,), (np.diag([1.0, -1, 1, 1, 1]),), ((0.1, 0.0), (0.0, 0.0))),
}


def parts(xp, t, values):
    """h, the jumps and their rates at a time, for NumPy and jax.numpy."""
    h, jump, rates = values
    one = 1 + 0 * t
    # Products of real and complex numbers.
    with jax.numpy_dtype_promotion("standard"):
        h = xp.tensordot(xp.stack([one, xp.sin(2 * t), xp.cos(3 * t), t]), h, 1)
        jump = xp.tensordot(xp.stack([one, xp.cos(t), xp.sin(t)]), jump, 1)
        return h, [jump, LOSS], rates @ xp.stack([one, xp.sin(3 * t)])


def field(t, y, values):
    return cfjax.Lindblad(*parts(jnp, t, values))


def pure(n):
    v = np.exp(1j * np.arange(n) - np.arange(n) / 2)
    return np.outer(v, v.conj()) / np.vdot(v, v).real


START = (pure(5) + pure(5).conj().T) / 2


def exact(parts_at, t0, t1, start=START):
    """By SciPy, in the space of all matrices."""

    def velocity(t, y):
        rho = y.reshape(start.shape)
        h, jumps, rates = parts_at(t)
        total = -1j * (h @ rho - rho @ h)
        for rate, a in zip(rates, jumps, strict=True):
            loss = a.conj().T @ a
            total = total + rate * (a @ rho @ a.conj().T - (loss @ rho + rho @ loss) / 2)
        return total.ravel()

    options: Any = dict(method="DOP853", rtol=1e-13, atol=1e-15)
    return solve_ivp(velocity, (t0, t1), start.ravel(), **options).y[:, -1].reshape(start.shape)


def answer(problem, t0, t1):
    values = problem.values()
    return exact(lambda t: parts(np, t, values), t0, t1)


@functools.cache
def program(field):
    """One step from any Hermitian matrix: its end, estimate and output at a part of it."""
    term = cfjax.LieTerm(field)

    @quick
    def step(values, t, h, rho, theta):
        # The start of a solve must be a density matrix.
        state = SOLVER.init(term, t, t + h, jnp.eye(len(rho), dtype=complex) / len(rho), values)
        end, error, info, *_ = SOLVER.step(term, t, t + h, rho, values, state, made_jump=False)
        path = SOLVER.interpolation_cls(t0=t, t1=t + h, **info)
        return end, error, path.evaluate(t + theta * h)

    return step


def step(problem, t, h, rho, theta=0.5):
    return program(field)(problem.values(), *map(jnp.asarray, (t, h, rho, theta)))


def many_steps(problem, t0, t1, rho, n):
    times = jnp.asarray(t0), jnp.asarray(t1)
    values = problems.arrays(problem.values())
    return problems.many_steps(field, SOLVER, *times, jnp.asarray(rho), values, jnp.asarray(n))


# Order


def test_orders_of_steps_and_of_output_within_them(subtests):
    for name, problem in PROBLEMS.items():
        with subtests.test(problem=name):
            steps = (16, 32, 64)
            ends = np.array([many_steps(problem, 0.0, 2.0, START, n) for n in steps])
            errors = np.linalg.norm(ends - answer(problem, 0.0, 2.0), axis=(1, 2))
            # A thousand times the error of the reference.
            assert errors[-1] > 1e-10
            assert 3.8 < problems.slope(steps, errors) < 4.3
            errors = [
                np.abs(step(problem, 0.0, h, START, 0.6)[2] - answer(problem, 0.0, 0.6 * h)).max()
                for h in (0.2, 0.1)
            ]
            # The error of one step is of one order more than its method.
            assert 4.6 < np.log2(errors[0] / errors[1]) < 5.6
            end, _, output = step(problem, 0.3, 0.5, START, 1.0)
            np.testing.assert_allclose(output, end, rtol=0, atol=2e-15)
            start = step(problem, 0.3, 0.5, START, 0.0)[2]
            np.testing.assert_allclose(start, START, rtol=0, atol=2e-15)


def test_many_steps_and_steps_back():
    """A step back has order 4 and keeps the trace. Like the equation, it is not positive."""
    general = PROBLEMS["general"]
    rho = many_steps(general, 0.0, 50.0, START, 1000)
    # Without its correction the trace is off by 2e-16 a step.
    assert abs(np.trace(rho) - 1) < 2e-15
    np.testing.assert_array_equal(rho, rho.conj().T)
    there = answer(general, 0.0, 1.0)
    ends = [many_steps(general, 1.0, 0.0, there, n) for n in (64, 128)]
    errors = [np.abs(rho - START).max() for rho in ends]
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.4
    assert abs(np.trace(ends[-1]) - 1) < 1e-14


# Positivity


def choi(step):
    """The least eigenvalue of Choi's matrix of a map, and how much it may change a trace."""
    # Each matrix with one entry, by two Hermitian ones: `E = x + i y`.
    unit = np.eye(25).reshape(5, 5, 5, 5)
    swapped = unit.swapaxes(2, 3)
    images = np.zeros((5, 5, 5, 5), complex)
    for at in np.ndindex(5, 5):
        x, y = (unit + swapped)[at] / 2 + 0j, (unit - swapped)[at] / 2j
        images[at] = np.asarray(step(x)) + 1j * np.asarray(step(y))
    matrix = images.transpose(0, 2, 1, 3).reshape(25, 25)
    traces = np.trace(images, axis1=2, axis2=3) - np.eye(5)
    return np.linalg.eigvalsh((matrix + matrix.conj().T) / 2)[0], np.abs(traces).max()


def test_a_step_of_any_length_is_completely_positive_and_keeps_the_trace(subtests):
    """One jump of rank n - 1: a jump of full rank would hide a loss of positivity."""
    cases = [(h, 0, 0.5) for h in (0.02, 0.1, 0.5, 1.0, 2.0, 6.0)]
    # And output within a step.
    cases += [(0.5, 2, 0.3), (2.0, 2, 0.7), (6.0, 2, 0.1)]
    for name, (h, which, theta) in itertools.product(("touching zero", "turning"), cases):
        with subtests.test(problem=name, h=h, theta=theta):
            least, trace = choi(lambda rho: step(PROBLEMS[name], 0.3, h, rho, theta)[which])  # noqa: B023
            # Rounding of a matrix whose trace is 5.
            assert least > -1e-14
            assert trace < 1e-14


# Estimate


def test_the_estimate_sees_the_error(subtests):
    """It is more than the error, but not by far: of order 4, or 5 where nothing jumps."""
    assert SOLVER.error_order(None) == 4
    for name, problem in (PROBLEMS | BLIND).items():
        with subtests.test(problem=name):
            estimates = []
            for h in (0.1, 0.05, 0.025):
                end, estimate, _ = step(problem, 0.0, h, START)
                error = np.abs(end - answer(problem, 0.0, h)).max()
                estimates.append(np.abs(estimate).max())
                assert error < estimates[-1] < 2000 * error
            slope = problems.slope((10, 20, 40), np.array(estimates))
            if "drive" in name:
                assert 4.7 < slope < 5.3
            else:
                assert 3.6 < slope < 4.5


@pytest.mark.slow
def test_stiff_dissipation():
    """Steps far longer than 1 over the largest rate, 5e3: Cholesky meets numbers that underflow."""
    lower = np.diag(np.sqrt(np.arange(1.0, 20)), 1)
    # Three quanta at a time are lost.
    jumps = [np.linalg.matrix_power(lower, 3) - 1.2**3 * np.eye(20), lower]

    def stiff(t, xp=np):
        return 0.3 * xp.cos(t) * (lower + lower.T), jumps, np.array([1.0, 0.2])

    def field(t, y, args):
        return cfjax.Lindblad(*stiff(t, jnp))

    y0, one = pure(20), program(field)
    for num_steps, bound in [(5, 2e-2), (40, 6e-4)]:
        rho = problems.many_steps(
            field, SOLVER, 0.0, 1.0, jnp.asarray(y0), None, jnp.asarray(num_steps)
        )
        # As measured, times 3 or more.
        np.testing.assert_allclose(rho, exact(stiff, 0.0, 1.0, y0), rtol=0, atol=bound)
        assert np.linalg.eigvalsh(rho)[0] > -1e-14
    # Also where the fast levels are at rest: there the estimate is the error, but for a tenth.
    for start, rho in [(0.0, y0), (0.5, exact(stiff, 0.0, 0.5, y0))]:
        for h in (0.2, 0.05):
            end, estimate, _ = one(None, *map(jnp.asarray, (start, h, rho, 0.5)))
            error = np.abs(end - exact(stiff, 0.0, start + h, y0)).max()
            assert 0.8 * error < np.abs(estimate).max() < 20 * error


def test_constant_steps_compute_no_estimate():
    def operations(solver):
        def step(t):
            term = cfjax.LieTerm(lambda t, y, args: cfjax.Lindblad(H0, [JUMP]))
            return problems.first_step(solver, term, t, t + 0.1, jnp.asarray(START), None)[:2]

        program, (_, error) = jax.make_jaxpr(step, return_shape=True)(0.0)
        return problems.num_operations(program.jaxpr), error

    (full, error), (plain, none) = map(operations, (SOLVER, SOLVER.without_estimate()))
    assert error is not None and none is None
    assert plain < 0.8 * full


# Derivatives


WEIGHTS = (_RNG.normal(size=(5, 5, 2)) @ [1, 1j]).round(2)
ARGS = (H0, JUMP, np.array([0.7]), np.eye(5) + 0.5 * JUMP)


@quick
@jax.value_and_grad
def derivatives(args, theta):
    """Of a function of h, a jump, its rate and the start, within a step or at its end."""

    def field(t, y, args):
        h, jump, rates, _ = args
        with jax.numpy_dtype_promotion("standard"):
            h = (h + h.conj().T) / 2 + jnp.sin(2 * t) * H1
        return cfjax.Lindblad(h, [jump], rates * (1 + jnp.sin(t) / 2))

    y0 = args[3] @ args[3].conj().T
    y0 = y0 / jnp.trace(y0)
    y0 = (y0 + y0.conj().T) / 2
    solver, (t0, t1) = SOLVER.without_estimate(), map(jnp.asarray, (0.3, 0.5))
    info: Any = problems.first_step(solver, cfjax.LieTerm(field), t0, t1, y0, args)[2]
    path = solver.interpolation_cls(t0=t0, t1=t1, **info)
    return jnp.sum(jnp.real(path.evaluate(t0 + theta * (t1 - t0)) * WEIGHTS))


def test_derivatives(subtests):
    zero = (0 * H0, 0 * JUMP, *ARGS[2:])
    for name, args, theta in [("general", ARGS, 1.0), ("zero", zero, 0.6)]:
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
        derivatives(problems.arrays((*ARGS[:2], np.array([rate]), ARGS[3])), 0.6)[1]
        for rate in (0.0, 1e-9)
    )
    assert np.abs(at_zero[2]).min() > 1e-3
    # Second derivatives of up to 100.
    problems.assert_close(at_zero, near, 1e-7)


# Precision, batches, pytrees


def test_single_precision():
    single = lambda x: x.astype(jnp.complex64 if jnp.iscomplexobj(x) else jnp.float32)  # noqa: E731

    def of_single(t, y, values):
        h, jumps, rates = parts(jnp, t, values)
        return cfjax.Lindblad(single(h), list(map(single, jumps)), single(rates))

    general, term = PROBLEMS["general"], cfjax.LieTerm(of_single)
    times = jnp.float32(0.3), jnp.float32(0.5)
    y0, values = jax.tree.map(lambda x: single(jnp.asarray(x)), (START, general.values()))
    rho = quick(
        lambda *args: problems.first_step(SOLVER.without_estimate(), term, *times, *args)[0]
    )(y0, values)
    assert rho.dtype == jnp.complex64
    # A step of some ten roundings of 6e-8.
    np.testing.assert_allclose(rho, step(general, 0.3, 0.2, START)[0], rtol=0, atol=1e-6)
    assert abs(np.trace(rho) - 1) < 1e-6


def test_leading_axes_and_a_state_of_several_density_matrices():
    """Whose fields are sums of two terms. A jump may be common to all elements."""
    general, turning = PROBLEMS["general"], PROBLEMS["turning"]
    late = 0.4

    def part(sign):
        def of_parts(t, y, args):
            # One term has less of the energy, and another part of the rates.
            early, after, alone = (
                parts(jnp, t + shift, problem.values())
                for shift, problem in ((0.0, general), (late, general), (0.0, turning))
            )
            h, (jump, _), rates = jax.tree.map(lambda *x: jnp.stack(x), early, after)
            a = cfjax.Lindblad(h * (0.5 + sign), [jump, LOSS], rates * (0.5 - sign))
            h, jumps, rates = alone
            b = cfjax.Lindblad(h * (0.5 + sign), jumps, rates * (0.5 - sign))
            return {"a": a, "b": b}

        return cfjax.LieTerm(of_parts)

    term = diffrax.MultiTerm(part(0.25), part(-0.25))
    y0 = {"a": jnp.asarray(np.stack([START, np.eye(5) / 5])), "b": jnp.asarray(START)}
    times = jnp.asarray(0.3), jnp.asarray(0.5)
    found = quick(lambda y0: problems.first_step(SOLVER, term, *times, y0, None)[:2])(y0)
    alone = [
        step(general, 0.3, 0.2, y0["a"][0]),
        step(general, 0.3 + late, 0.2, y0["a"][1]),
        step(turning, 0.3, 0.2, y0["b"]),
    ]
    for values, expected in zip(found, zip(*alone, strict=True), strict=False):
        for x, y in zip([*values["a"], values["b"]], expected, strict=True):
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-14)


def test_what_is_refused(subtests, no_shape_hook):
    y0 = jnp.asarray(START)

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
        (driven, "Kraus4 does not support noise"),
    ]
    for term, message in cases:
        start = {name: y0 for name in "ab"} if message.startswith(other) else y0
        with subtests.test(message=message), pytest.raises(TypeError, match=message):
            cfjax.integrate(term, SOLVER, 0.0, 1.0, start, num_steps=1)
    with pytest.raises(ValueError, match="estimate must be 'group' or None, got 'algebra'"):
        cfjax.Kraus4(estimate="algebra")  # pyright: ignore[reportArgumentType]
