"""Lindblad's equation: flows, positivity, exact answers, derivatives, what is refused."""

import functools
import itertools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from matrices import exact_expm, random, to_numpy
from problems import (
    QUICK,
    arrays,
    central_difference,
    errors,
    first_step,
    inner,
    random_like,
    reference,
    slope,
)

import cfjax
from cfjax import Lindblad
from cfjax._fields import lindblad

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
# A jump that is complex and not normal: a real one would hide a missing conjugate.
L2 = np.array([[0.5, 1j, 0], [0, -0.2, 0.3 + 0.4j], [0.1, 0, 1]])


def lower(n):
    return np.diag(np.sqrt(np.arange(1.0, n)), 1)


def hermitian(n, seed=0):
    """A Hermitian matrix of 2-norm 1."""
    x = random((n, n), seed, complex)
    x = x + x.conj().T
    return x / max(np.linalg.norm(x, 2), 1e-300)


def density(n, seed=0, dtype=complex):
    x = random((n, n), seed, complex)
    x = (x @ x.conj().T / np.vdot(x, x)).astype(dtype)
    # Hermitian to the last bit.
    return jnp.asarray((x + x.conj().T) / 2)


def superoperator(h, jumps, rates):
    """The matrix of the equation for the entries of rho, row by row."""
    one = np.eye(len(h))
    total = -1j * (np.kron(h, one) - np.kron(one, h.T))
    for rate, a in zip(rates, jumps, strict=True):
        loss = a.conj().T @ a / 2
        jump = np.kron(a, a.conj()) - np.kron(loss, one) - np.kron(one, loss.T)
        total = total + rate * jump
    return total


def long_expm(a):
    """In 64 bits of mantissa, by Taylor's polynomial of degree 24 and squarings."""
    squarings = max(0, int(np.ceil(np.log2(np.linalg.norm(a, 1) + 1e-9))) + 2)
    a = a.astype(np.clongdouble) / 2**squarings
    total = term = np.eye(len(a), dtype=np.clongdouble)
    for k in range(1, 25):
        term = term @ a / k
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total.astype(complex)


def exact(h, jumps, rates, x):
    n = len(h)
    a = superoperator(h, jumps, rates)
    e = to_numpy(exact_expm(a)) if n < 4 else long_expm(a)
    return (e @ np.ravel(x)).reshape(n, n)


# What takes the place of the exponential of the superoperator from some number of levels on.
WAYS = pytest.mark.parametrize("way", ["matrix", "series"])


@pytest.fixture
def in_way(monkeypatch):
    """Chooses one of the ways to compute a flow, whatever the number of levels is."""

    def choose(way):
        most = {"matrix": 100, "series": 0}[way]
        monkeypatch.setattr(lindblad, "_MOST_LEVELS_OF_MATRIX", most)

    return choose


def jitted(method):
    """A method of a field, whose arrays are known in the program."""
    return jax.jit(lambda x: method(x))


def case(n, norm, damping, dtype=complex):
    """A Hamiltonian, two jumps, and rates, of about this norm in all."""
    h = hermitian(n)
    jumps = np.stack([random((n, n), 1, complex), lower(n) + 0j])
    jumps = jumps / (np.linalg.norm(jumps, 2, axis=(1, 2))[:, None, None] + 1e-300)
    if damping == "strong":
        h, rates = norm / 4 * h, norm / 4 * np.array([0.8, 0.2])
    else:
        h, rates = norm / 2 * h, min(0.2, norm / 4) * np.array([0.8, 0.2])
    return h.astype(dtype), jumps.astype(dtype), rates.astype(np.finfo(dtype).dtype)


# The flow itself


@pytest.mark.representatives(7)
@pytest.mark.parametrize("dtype", [np.complex128, np.complex64])
@WAYS
@pytest.mark.parametrize("n", [2, 3, 4, 5, 8])
def test_flow_and_increment_against_the_superoperator(n, way, dtype, in_way):
    in_way(way)

    @jax.jit
    def found(h, jumps, rates, x):
        field = Lindblad(h, list(jumps), rates)
        return field.flow(x), field.increment(x)

    x = density(n, 3, dtype)
    eps = EPS[np.finfo(dtype).dtype.name]
    for damping in ("strong", "weak"):
        for norm in (0.05, 1.0, 10.0, 300.0):
            h, jumps, rates = case(n, norm, damping, dtype)
            end, change = found(h, jumps, rates, x)
            assert end.dtype == change.dtype == dtype
            want = exact(*(np.asarray(z, complex) for z in (h, jumps, rates, x)))
            # Some units of rounding, and some for each of the norm: both of a long series and of
            # squarings.
            atol = 4 * eps * (1 + norm)
            text = f"{damping} {norm}"
            np.testing.assert_allclose(end, want, rtol=0, atol=atol, err_msg=text)
            # A small change has a rounding error as small.
            atol = 4 * eps * min(4 * norm, 1 + norm)
            np.testing.assert_allclose(
                change, want - np.asarray(x), rtol=0, atol=atol, err_msg=text
            )
            np.testing.assert_array_equal(end, end.conj().T)
            np.testing.assert_array_equal(change, change.conj().T)
            assert abs(np.trace(change)) <= 2 * n * eps


@pytest.mark.parametrize("damping", ["strong", "weak"])
def test_a_large_flow_against_scipy(damping):
    """By diagonals and with a dense jump."""
    n = 40
    h, jumps, rates = case(n, 10.0, damping)
    jumps = [jumps[0], np.diag(np.sqrt(np.arange(1, n) / n), 1)]
    x = density(n, 3)
    one = scipy.sparse.identity(n)
    total: Any = -1j * (scipy.sparse.kron(h, one) - scipy.sparse.kron(one, h.T))
    for rate, a in zip(rates, map(scipy.sparse.csr_array, jumps), strict=True):
        loss = a.conj().T @ a / 2
        total = total + rate * (
            scipy.sparse.kron(a, a.conj())
            - scipy.sparse.kron(loss, one)
            - scipy.sparse.kron(one, loss.T)
        )
    trace = complex(total.diagonal().sum())
    want = scipy.sparse.linalg.expm_multiply(total.tocsr(), x.ravel(), traceA=trace)
    found = jax.jit(lambda h, rates, x: Lindblad(h, jumps, rates).flow(x))(h, rates, x)
    # SciPy's series is of the whole norm too.
    np.testing.assert_allclose(found, want.reshape(n, n), rtol=0, atol=16 * EPS["float64"] * 11)


@WAYS
def test_the_zero_field_rests(way, in_way):
    in_way(way)
    x, field = density(5), Lindblad(np.zeros((5, 5)), [L2_of(5)], [0.0])
    np.testing.assert_array_equal(field.tangent(x), 0 * x)
    np.testing.assert_allclose(jitted(field.flow)(x), x, rtol=0, atol=1e-17)
    np.testing.assert_allclose(jitted(field.increment)(x), 0 * x, rtol=0, atol=1e-17)


def L2_of(n):
    """The jump of three levels among n."""
    return scipy.linalg.block_diag(L2, np.zeros((n - 3, n - 3))) if n > 3 else L2


@pytest.mark.parametrize("n", [3, 6])
def test_tangent_is_the_equation_as_it_is_written(n):
    h, jumps, rates = hermitian(n), [L2_of(n), lower(n)], np.array([0.7, 0.3])
    x = np.asarray(density(n, 3))
    want = -1j * (h @ x - x @ h)
    for g, a in zip(rates, jumps, strict=True):
        b = a.conj().T
        want = want + g * (a @ x @ b - (b @ a @ x + x @ b @ a) / 2)
    found = Lindblad(h, jumps, rates).tangent(jnp.asarray(x))
    np.testing.assert_allclose(found, want, rtol=0, atol=20 * n * EPS["float64"])
    # Not corrected, as that of a flow is: so a wrong factor would show.
    assert abs(np.trace(found)) <= 20 * n * EPS["float64"]


def test_the_parts_with_and_without_jumps_make_the_equation():
    h, jumps, rates = hermitian(3) + 2 * np.eye(3), [L2, lower(3)], np.array([0.7, 0.3])
    field, x = Lindblad(h, jumps, rates), density(3, 3)
    k = field.no_jump()
    # Without the trace of h, which has no effect.
    assert np.trace(k).imag == pytest.approx(0, abs=1e-15)
    found = k @ x + x @ k.conj().T + field.jump(x)
    np.testing.assert_allclose(found, field.tangent(x), rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [3, 6])
def test_check_field(n):
    fields = [
        Lindblad(hermitian(n, k), [L2_of(n), lower(n)], [0.2 + k, 0.1 / (1 + k)]) for k in range(3)
    ]
    cfjax.check_field(fields, density(n, 7))


def test_combine_adds_hamiltonians_and_rates():
    a, b = (Lindblad(hermitian(3, k), [L2, lower(3)], [0.2 + k, 0.1]) for k in range(2))
    total = cfjax.combine((2.0, -0.5), (a, b))
    np.testing.assert_allclose(total.h, 2 * hermitian(3, 0) - hermitian(3, 1) / 2, atol=1e-15)
    # A negative one stays as it is.
    np.testing.assert_allclose(total.rates, [0.4 - 0.6, 0.2 - 0.05], atol=1e-15)


@WAYS
def test_a_negative_rate_is_computed_as_it_is(way, in_way):
    in_way(way)
    jumps, x = [L2, lower(3)], density(3, 3)
    a = Lindblad(hermitian(3), jumps, [0.6, 0.1])
    found = jitted(cfjax.combine((-1.0,), (a,)).flow)(x)
    # Growth of e^2 at most.
    want = exact(-hermitian(3), jumps, [-0.6, -0.1], x)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", ["coherent", "damped", "pumped"])
def test_the_bounds_of_the_numerical_range(kind):
    """The operator acts on Hermitian and other matrices, with the Hilbert-Schmidt product."""
    n = 4
    for seed in range(20):
        h = hermitian(n, seed) * (3.0 if kind == "coherent" else 0.1) + 5 * np.eye(n)
        jumps = [random((n, n), 10 + seed, complex), np.outer(np.eye(n)[0], np.ones(n))]
        rates = np.array([0.1, 0.3] if kind != "pumped" else [0.1, 2.0])
        norm, strip = Lindblad(h, jumps, rates)._bounds()
        a = superoperator(h, jumps, rates)
        real = np.linalg.eigvalsh((a + a.conj().T) / 2)
        imaginary = np.linalg.eigvalsh((a - a.conj().T) / 2j)
        assert np.linalg.norm(a, 2) <= norm
        assert -strip.decay <= real.min() and real.max() <= strip.growth
        assert np.abs(imaginary).max() <= strip.imaginary


def test_a_constant_energy_costs_nothing_and_has_no_effect():
    h, x = hermitian(6), density(6, 3)
    fields = [Lindblad(h + e * np.eye(6), [lower(6)], [0.1]) for e in (0.0, 1e4)]
    # 1e4 rounds the entries of h.
    found, want = (jitted(field.flow)(x) for field in fields)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e4 * 8 * EPS["float64"])
    np.testing.assert_allclose(fields[1]._bounds()[0], fields[0]._bounds()[0], rtol=1e-10)


def test_what_is_not_hermitian_in_a_point_is_lost():
    x, skew = density(5, 3), jnp.asarray(1j * hermitian(5, 4))
    field = Lindblad(hermitian(5), [lower(5)], [0.1])
    flow, increment = jitted(field.flow), jitted(field.increment)
    want = flow(x)
    np.testing.assert_allclose(flow(x + skew), want, rtol=0, atol=1e-15)
    np.testing.assert_allclose(x + skew + increment(x + skew), want, rtol=0, atol=1e-15)


@pytest.mark.parametrize("n", [3, 6])
def test_the_trace_and_hermiticity_over_1000_steps(n):
    def field(t, rho, args):
        h = args[0] + jnp.cos(3 * t).astype(complex) * args[1]
        return Lindblad(h, [L2_of(n), lower(n)], [0.05, 0.1])

    args = hermitian(n, 1), hermitian(n, 2)
    y = cfjax.integrate(
        cfjax.LieTerm(field), cfjax.CF2(), 0.0, 30.0, density(n), args, num_steps=1000
    ).ys[-1]
    # Sums over the steps are compensated: each adds some units of its own change of 0.03, as
    # often up as down.
    assert abs(np.trace(y) - 1) <= 4 * EPS["float64"]
    np.testing.assert_array_equal(y, y.conj().T)
    assert np.linalg.eigvalsh(y).min() > -1e-15


# Complete positivity

LEVELS = 4
ENERGIES = np.diag([0.0, 1.0, 2.1, 3.3])
STEPS = (0.02, 0.1, 0.4, 1.0, 2.0, 6.0)


def decaying(t, rho, args):
    """A driven oscillator of a few levels which loses quanta: one jump, of rank n - 1."""
    h = ENERGIES + jnp.cos(3 * t) * (lower(LEVELS) + lower(LEVELS).T)
    return Lindblad(h, [lower(LEVELS)], [0.3])


def touching(t, rho, args):
    """The same with a rate that touches zero."""
    h = ENERGIES + jnp.cos(3 * t) * (lower(LEVELS) + lower(LEVELS).T)
    return Lindblad(h, [lower(LEVELS)], 0.3 * (1 + jnp.sin(3 * t))[None])


def pure_states(n):
    """Pure states that span all matrices."""
    e = np.eye(n, dtype=complex)
    vectors = [*e]
    vectors += [(e[i] + z * e[j]) / 2**0.5 for i in range(n) for j in range(i) for z in (1, 1j)]
    return np.stack([np.outer(v, v.conj()) for v in vectors])


def choi(images):
    """Choi's matrix `sum_ij E_ij (x) map(E_ij)` from the images of the pure states."""
    n = images.shape[-1]
    image = {(i, i): images[i] for i in range(n)}
    rest = iter(images[n:])
    for i in range(n):
        for j in range(i):
            real, imaginary = next(rest), next(rest)
            image[i, j] = real + 1j * imaginary - (1 + 1j) / 2 * (images[i] + images[j])
            image[j, i] = image[i, j].conj().T
    return np.block([[image[i, j] for j in range(n)] for i in range(n)])


def least_of_choi(images):
    return np.linalg.eigvalsh(choi(np.asarray(images))).min()


@functools.cache
def one_step(solver, field, thetas=()):
    """Where a step leads pure states: by the method, by its embedded method, and within it."""

    @jax.jit
    def step(t0, t1):
        def of_one(rho):
            term = cfjax.LieTerm(field)
            end, estimate, dense, *_ = first_step(solver, term, t0, t1, rho, None)
            if not thetas:
                return [end]
            path = solver.interpolation_cls(t0=t0, t1=t1, **dense)
            # In a loop, for a program that compiles faster.
            within = jax.lax.map(path.evaluate, t0 + jnp.asarray(thetas) * (t1 - t0))
            return [end, end - estimate, *within]

        return jax.vmap(of_one)(pure_states(LEVELS))

    return step


def assert_completely_positive(maps):
    for images in maps:
        # Sums of a few rounded numbers.
        assert least_of_choi(images) >= -1e-14
        np.testing.assert_allclose(np.trace(images, axis1=1, axis2=2), 1, rtol=0, atol=1e-14)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF4(), cfjax.CF43(), cfjax.Magnus4()], ids=repr)
def test_steps_estimates_and_outputs_are_completely_positive_with_constant_rates(solver):
    step = one_step(solver, decaying, (0.1, 0.5, 0.9))
    for h in STEPS:
        end, embedded, *within = step(0.0, h)
        # The estimate of CF4 is in part another number: see the test below.
        is_embedded = not isinstance(solver, cfjax.CF4)
        assert_completely_positive([end, *within, *([embedded] if is_embedded else [])])


@pytest.mark.parametrize("solver", [cfjax.CF4, cfjax.CF43], ids=lambda x: x.__name__)
def test_the_flows_of_a_step_with_constant_rates_have_positive_times(solver):
    tableau = solver.tableau
    for product in (tableau.beta, tableau.embedded):
        assert all(float(sum(row)) > 0 for row in product)


def test_the_same_test_finds_methods_that_are_not_positive():
    step = one_step(cfjax.CF54(), decaying)
    assert_completely_positive(step(0.0, 0.02)[:1])
    # One of its flows has a negative rate.
    assert min(least_of_choi(step(0.0, h)[0]) for h in STEPS) < -1e-3


def test_the_same_test_finds_a_truncated_series():
    """The fourth-order Runge-Kutta method, in a small step."""

    def velocity(t, rho):
        return decaying(t, rho, None).tangent(rho)

    @jax.jit
    @jax.vmap
    def step(rho):
        h = 0.02
        k1 = velocity(0.0, rho)
        k2 = velocity(h / 2, rho + h / 2 * k1)
        k3 = velocity(h / 2, rho + h / 2 * k2)
        return rho + h / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(h, rho + h * k3))

    assert least_of_choi(step(pure_states(LEVELS))) < -1e-9


@pytest.mark.parametrize("solver", [cfjax.CF2(), cfjax.Magnus2()], ids=repr)
def test_order_2_is_completely_positive_with_every_rate(solver):
    step = one_step(solver, touching)
    for t0, h in [(0.0, 0.1), (1.4, 0.4), (0.3, 2.0)]:
        assert_completely_positive(step(t0, t0 + h)[:1])


# The worst step from 0 to 4, for a rate that touches zero: measured.
LOSSES = {
    "CF4": (cfjax.CF4(), {10: -1.4e-7, 20: -1.4e-8, 40: -3.4e-10}),
    "CF43": (cfjax.CF43(), {10: -2.1e-9, 20: -2.5e-10}),
    "Magnus4": (cfjax.Magnus4(), {10: -2.9e-9, 20: -2.3e-12}),
}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("name", LOSSES)
def test_how_much_positivity_order_4_loses_to_a_rate_that_touches_zero(name):
    solver, losses = LOSSES[name]
    step = one_step(solver, touching)
    for number, loss in losses.items():
        times = np.linspace(0, 4, number + 1)
        found = min(least_of_choi(step(*ts)[0]) for ts in itertools.pairwise(times))
        assert 2 * loss < found < loss / 2


# Orders


DRIVE = hermitian(3, 5)


def drive(xp, t, mean):
    """Hamiltonian and rates; `mean` is that of an observable."""
    turns = xp.stack([xp.ones_like(t), xp.cos(2 * t), mean]).astype(complex)
    h = xp.tensordot(turns, np.stack([hermitian(3, k) for k in (1, 2, 3)]), 1)
    return h, xp.stack([xp.full_like(t, 0.4), 0.2 + 0.1 * xp.sin(3 * t)])


def driven(t, rho, args):
    h, rates = drive(jnp, t, args * jnp.trace(DRIVE @ rho).real)
    return Lindblad(h, [L2, lower(3)], rates)


def driven_by_time(t, rho, args):
    h, rates = drive(jnp, t, jnp.zeros_like(t))
    return Lindblad(h, [L2, lower(3)], rates)


@functools.cache
def answer(mean):
    def ode(t, y):
        of_state = mean * np.trace(DRIVE @ y.reshape(3, 3)).real
        h, rates = drive(np, np.asarray(t), of_state)
        return superoperator(h, [L2, lower(3)], rates) @ y

    return reference(ode, 0, 2, np.ravel(density(3)))


def observed(field, solver, t1, y0, args, want, steps):
    found = errors(field, solver, t1, y0, args, want, steps)
    # Above the rounding of the reference.
    assert found[-1] > 1e-12
    return slope(steps, found)


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("solver", "order"),
    [
        (cfjax.CF4(), 4),
        (cfjax.CF2(), 2),
        (cfjax.CF3(), 3),
        (cfjax.CF43(), 4),
    ],
    ids=repr,
)
def test_the_order_with_a_mean_field(solver, order):
    found = observed(driven, solver, 2.0, density(3), 1.0, answer(1.0), (16, 32, 64))
    assert order - 0.2 < found < order + 0.35


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("solver", "order"), [(cfjax.Magnus4(), 4), (cfjax.Magnus2(), 2)], ids=repr
)
def test_the_order_with_a_drive(solver, order):
    found = observed(driven_by_time, solver, 2.0, density(3), None, answer(0.0), (16, 32, 64))
    assert order - 0.2 < found < order + 0.35


def test_a_rate_that_touches_zero_keeps_order_4():
    def ode(t, y):
        h = ENERGIES + np.cos(3 * t) * (lower(4) + lower(4).T)
        return superoperator(h, [lower(4)], [0.3 * (1 + np.sin(3 * t))]) @ y

    want = reference(ode, 0, 4, np.ravel(density(4)))
    found = observed(touching, cfjax.CF4(), 4.0, density(4), None, want, (40, 80, 160))
    assert 3.8 < found < 4.3


# Exact answers


def flow_for(t, h, jumps, rates, rho):
    """The point after the time t, in one flow."""
    field = Lindblad(t * np.asarray(h), jumps, t * np.asarray(rates))
    return np.asarray(jax.jit(lambda rho: field.flow(rho))(jnp.asarray(rho, complex)))


X, Y, Z = np.array([[0, 1], [1, 0]]), np.array([[0, -1j], [1j, 0]]), np.diag([1.0, -1.0])


def test_bloch_equations():
    """`r' = w x r - (g/2 + 2 f) (x, y, 0) + g (0, 0, 1 - z)`."""
    w, g, f, t = np.array([1.3, -0.4, 0.7]), 0.5, 0.2, 1.7
    r = np.array([0.3, -0.5, 0.2])
    m = np.zeros((4, 4))
    m[:3, :3] = np.cross(w, np.eye(3)).T - np.diag([g / 2 + 2 * f, g / 2 + 2 * f, g])
    m[2, 3] = g
    want = (scipy.linalg.expm(t * m) @ [*r, 1])[:3]
    sigma = X, Y, Z
    rho = (np.eye(2) + np.tensordot(r, sigma, 1)) / 2
    end = flow_for(t, np.tensordot(w, sigma, 1) / 2, [lower(2), Z], [g, f], rho)
    found = [np.trace(s @ end).real for s in sigma]
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


def test_the_steady_population_of_a_driven_atom():
    omega, delta, g = 0.9, 0.6, 0.4
    h = np.array([[0, omega / 2], [omega / 2, -delta]])
    end = flow_for(200.0, h, [lower(2)], [g], np.diag([1.0, 0.0]))
    want = omega**2 / 4 / (delta**2 + g**2 / 4 + omega**2 / 2)
    # exp(-200 g/2) is left, and rounding of the norm.
    assert end[1, 1].real == pytest.approx(want, abs=2e-13)


def coherent(alpha, n):
    v = np.ones(n, complex)
    for k in range(1, n):
        v[k] = v[k - 1] * alpha / np.sqrt(k)
    v *= np.exp(-(abs(alpha) ** 2) / 2)
    return np.outer(v, v.conj())


def test_a_coherent_state_stays_coherent_under_loss():
    """`alpha' = -(i w + kappa/2) alpha - i e`."""
    n, w, kappa, e, t, start = 32, 1.1, 0.8, 0.5, 1.5, 1.2 - 0.3j
    a = lower(n)
    h = w * np.diag(np.arange(n)) + e * (a + a.T)
    rate = 1j * w + kappa / 2
    steady = -1j * e / rate
    alpha = steady + (start - steady) * np.exp(-rate * t)
    found = flow_for(t, h, [a], [kappa], coherent(start, n))
    # The norm is some 200.
    np.testing.assert_allclose(found, coherent(alpha, n), rtol=0, atol=2e-14)


@WAYS
@pytest.mark.parametrize("n", [3, 6])
def test_diagonal_jumps(n, way, in_way):
    in_way(way)
    (el,), energies = random((1, n), 1, complex), random((n,), 2)
    g, t, rho = 0.4, 1.3, density(n)
    size = np.abs(el) ** 2 / 2
    factor = g * (np.outer(el, el.conj()) - size[:, None] - size)
    phase = -1j * (energies[:, None] - energies)
    found = flow_for(t, np.diag(energies), [np.diag(el)], [g], rho)
    np.testing.assert_allclose(found, rho * np.exp(t * (factor + phase)), rtol=0, atol=1e-14)


def test_two_levels_in_a_thermal_bath():
    g, nbar, w, t, rho = 0.7, 0.6, 2.0, 1.4, density(2)
    rates = [g * (nbar + 1), g * nbar]
    end = flow_for(t, np.diag([0, w]), [lower(2), lower(2).T], rates, rho)
    fall, steady = g * (2 * nbar + 1), nbar / (2 * nbar + 1)
    want = steady + (float(rho[1, 1].real) - steady) * np.exp(-fall * t)
    assert end[1, 1].real == pytest.approx(want, abs=1e-14)
    want = complex(rho[0, 1]) * np.exp((1j * w - fall / 2) * t)
    assert end[0, 1] == pytest.approx(want, abs=1e-14)


def test_an_oscillator_in_a_thermal_bath_keeps_a_geometric_distribution():
    n, kappa, nbar, start, t = 40, 0.7, 0.3, 0.1, 0.9

    def geometric(mean):
        return (mean / (1 + mean)) ** np.arange(n) / (1 + mean)

    a = lower(n)
    rates = [kappa * (nbar + 1), kappa * nbar]
    end = flow_for(t, np.diag(np.arange(n)), [a, a.T], rates, np.diag(geometric(start)))
    mean = nbar + (start - nbar) * np.exp(-kappa * t)
    # The first level that is cut off has a population of 0.24^40.
    np.testing.assert_allclose(end, np.diag(geometric(mean)), rtol=0, atol=1e-14)


def test_superradiance_of_two_atoms():
    """The generator has no basis of eigenvectors."""
    s, one, t = lower(2), np.eye(2), 0.8
    collective = np.kron(s, one) + np.kron(one, s)
    end = flow_for(t, np.zeros((4, 4)), [collective], [1.0], np.diag([0.0, 0, 0, 1]))
    bright = np.array([0, 1, 1, 0]) / np.sqrt(2)
    assert end[3, 3].real == pytest.approx(np.exp(-2 * t), abs=1e-14)
    assert (bright @ end @ bright).real == pytest.approx(2 * t * np.exp(-2 * t), abs=1e-14)


def test_loss_of_photons_in_pairs():
    t, a = 0.3, lower(5)
    end = flow_for(t, np.zeros((5, 5)), [a @ a], [1.0], np.diag([0.0, 0, 0, 0, 1]))
    four = np.exp(-12 * t)
    two = 12 / (12 - 2) * (np.exp(-2 * t) - four)
    want = [1 - two - four, 0, two, 0, four]
    np.testing.assert_allclose(end, np.diag(want), rtol=0, atol=1e-14)


# Derivatives


def parameters(n):
    """In real numbers: a Hamiltonian, a jump, a rate and a state."""
    rho = np.linalg.cholesky(np.asarray(density(n, 6)))
    halves = lambda x: {"re": x.real, "im": x.imag}  # noqa: E731
    jump = L2_of(n) + 0.1 * random((n, n), 4, complex)
    return arrays(
        {
            "h": halves(hermitian(n, 1)),
            "jump": halves(jump),
            "rates": np.array([0.3, 0.2]),
            "rho": halves(rho),
        }
    )


def whole(x):
    return jax.lax.complex(x["re"], x["im"])


def state_of(p):
    x = whole(p["rho"])
    x = x @ x.conj().T
    return x / jnp.trace(x)


def end_point(p, n):
    def field(t, rho, p):
        x = whole(p["h"])
        h = (x + x.conj().T) / 2 * jnp.cos(2 * t).astype(complex) + DRIVES[n]
        return Lindblad(h, [whole(p["jump"]), lower(n)], p["rates"] * (1 + 0.5 * jnp.sin(t)))

    term, rho = cfjax.LieTerm(field), state_of(p)
    ys = cfjax.integrate(term, cfjax.CF2(), 0.0, 1.0, rho, p, num_steps=3).ys
    return jnp.sum(OBSERVED[n] * ys[-1]).real


DRIVES = {n: hermitian(n, 8) for n in (3, 6)}
OBSERVED = {n: hermitian(n, 9) for n in (3, 6)}


@pytest.mark.representatives(1)
@pytest.mark.parametrize("n", [6, 3])
def test_derivatives_through_a_solve(n):
    """By Hamiltonian, jump, rates and start, both modes."""
    p = parameters(n)
    way = random_like(p, 1)
    value = functools.partial(end_point, n=n)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def found(p, way):
        slope = jax.jvp(value, (p,), (way,))[1]
        return slope, jax.grad(value)(p)

    forward, pulled = found(p, way)
    # The direction has a length of 10 and more: truncation (10 h)^4 and rounding eps / h.
    compiled = jax.jit(value)
    want = float(central_difference(compiled, p, way, 2e-4))
    assert forward == pytest.approx(want, rel=1e-9, abs=1e-9)
    assert inner(pulled, way) == pytest.approx(float(forward), rel=1e-12)
    for name in p:
        part = {k: way[k] if k == name else jax.tree.map(jnp.zeros_like, way[k]) for k in way}
        want = float(central_difference(compiled, p, part, 2e-4))
        assert inner(pulled[name], way[name]) == pytest.approx(want, rel=1e-9, abs=1e-9)


@WAYS
def test_derivatives_at_the_zero_field(way, in_way):
    """There the flow is the identity, and its derivative the field of the direction."""
    in_way(way)
    n = 3
    x, dh, dr, w = density(n), hermitian(n, 2), np.array([0.4, 0.3]), hermitian(n, 3)

    def flow(h, rates):
        return Lindblad(h, [L2, lower(n)], rates).flow(x)

    @jax.jit
    def found(h, rates):
        forward = jax.jvp(flow, (h, rates), (dh, dr))[1]
        return forward, jax.vjp(flow, h, rates)[1](jnp.asarray(w))

    forward, (in_h, in_r) = found(np.zeros((n, n), complex), np.zeros(2))
    want = np.asarray(Lindblad(dh, [L2, lower(n)], dr).tangent(x))
    np.testing.assert_allclose(forward, want, rtol=0, atol=1e-15 * 4)
    # JAX pairs without conjugation.
    found_ = np.sum(in_h * dh).real + in_r @ dr
    assert found_ == pytest.approx(np.sum(w * want).real, abs=1e-14)


def saved(solver, ts, args):
    def field(t, rho, args):
        h = hermitian(3, 1) + (args * jnp.cos(2 * t)).astype(complex) * hermitian(3, 2)
        return Lindblad(h, [L2, lower(3)], [0.3, 0.2])

    return field, diffrax.diffeqsolve(
        cfjax.LieTerm(field),
        solver,
        0.0,
        1.0,
        0.05,
        jnp.asarray(density(3)),
        args,
        saveat=diffrax.SaveAt(ts=ts),
    ).ys


# The warning is that of `diffrax`.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Complex dtype support")
@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    ("solver", "error"), [(cfjax.CF2(), 5e-3), (cfjax.CF43(), 1e-5)], ids=["CF2", "CF43"]
)
def test_derivatives_by_times_of_output(solver, error):
    ts, args, w = jnp.asarray([0.23, 0.61]), jnp.asarray(1.0), random((2, 3, 3), 4, complex)

    def value(ts, args):
        ys: Any = saved(solver, ts, args)[1]
        return jnp.sum(w * ys).real

    @functools.partial(jax.jit, compiler_options=QUICK)
    def found(ts, args):
        field, ys = saved(solver, ts, args)
        velocities = jnp.stack(
            [field(t, y, args).tangent(y) for t, y in zip(ts, ys, strict=True)]  # pyright: ignore
        )
        return jax.grad(value, argnums=(0, 1))(ts, args), velocities

    (in_ts, in_args), velocities = found(ts, args)
    # The same as the velocity, up to the slope of the error of the continuous extension, of the
    # order of the method less one.
    np.testing.assert_allclose(in_ts, np.sum(w * velocities, axis=(1, 2)).real, rtol=0, atol=error)
    compiled = jax.jit(value)
    for way in ((np.array([1.0, 0.3]), 0.0), (np.zeros(2), 1.0)):
        # Times within one step, where the extension is smooth.
        want = central_difference(lambda p: compiled(*p), (ts, args), arrays(way), 1e-3)
        assert inner((in_ts, in_args), way) == pytest.approx(float(want), rel=1e-9)


# Forms of the arguments


def solve(field, rho, args=None, solver: Any = None, num_steps=5):
    solver = solver or cfjax.CF4()
    ys = cfjax.integrate(cfjax.LieTerm(field), solver, 0.0, 1.0, rho, args, num_steps=num_steps).ys
    return ys[-1]


@pytest.mark.parametrize("n", [3, 6])
def test_leading_axes(n):
    """Everything has leading axes, jumps too or not; axes of 1 are broadcast."""
    h = np.stack([hermitian(n, k) for k in range(3)])
    jumps = np.stack([L2_of(n) * s for s in (1, 0.5, 1j)]), lower(n)
    rates = np.array([[0.3, 0.1], [0.2, 0.4], [0.0, 0.1]])
    x = jnp.stack([density(n, k) for k in range(3)])
    fields = [
        Lindblad(h, jumps, rates),
        Lindblad(h[0], [jumps[1]], rates[:, 1:]),
        Lindblad(h[:1], [jumps[0][:1]], rates[:, :1]),
    ]
    found = jax.jit(lambda x: [(f.flow(x), f.increment(x), f.tangent(x)) for f in fields])(x)
    for k in range(3):
        alone = [
            (h[k], [jumps[0][k], jumps[1]], rates[k]),
            (h[0], [jumps[1]], rates[k, 1:]),
            (h[0], [jumps[0][0]], rates[k, :1]),
        ]
        for parts, (flow, increment, tangent) in zip(alone, found, strict=True):
            y = np.asarray(x[k])
            want = exact(*parts, y)
            np.testing.assert_allclose(flow[k], want, rtol=0, atol=1e-14)
            np.testing.assert_allclose(increment[k], want - y, rtol=0, atol=1e-14)
            want = (superoperator(*parts) @ y.ravel()).reshape(n, n)
            np.testing.assert_allclose(tangent[k], want, rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [3, 6])
def test_vmap_of_a_function_that_returns_a_field(n):
    """And `cfjax.elementwise` of it: jumps known by diagonals get axes as well."""
    rates, x = np.array([[0.3, 0.1], [0.2, 0.4]]), jnp.stack([density(n, k) for k in range(2)])
    jumps = [L2_of(n), lower(n)]
    made = jax.vmap(lambda rates: Lindblad(hermitian(n), jumps, rates))(rates)
    many = cfjax.elementwise(made)
    want = [exact(hermitian(n), jumps, r, y) for r, y in zip(rates, x, strict=True)]
    for found in jax.jit(lambda x: (made.flow(x), many.flow(x)))(x):
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)
    assert not any(holds for holds, _ in many.faults())


def test_a_batch_of_solves_by_vmap():
    rates, x, jumps = np.array([[0.3, 0.1], [0.2, 0.4]]), density(3), [L2, lower(3)]
    field = lambda t, y, args: Lindblad(hermitian(3), jumps, args)  # noqa: E731
    found = jax.jit(jax.vmap(lambda r: solve(field, x, r, cfjax.CF2())))(rates)
    # A constant field: the method is exact.
    want = [exact(hermitian(3), jumps, r, x) for r in rates]
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


def test_a_product_state_with_a_rotation():
    """A spin that turns an atom's field, and an atom whose mean turns the spin."""

    def field(t, y, args):
        h = jnp.tensordot((y["spin"] / 2).astype(complex), jnp.asarray(np.stack([X, Y, Z])), 1)
        mean = jnp.stack([jnp.trace(s @ y["rho"]).real for s in (X + 0j, Y, Z + 0j)])
        return {"rho": Lindblad(h, [lower(2)], [0.2]), "spin": cfjax.Rotation(mean)}

    def ode(t, y):
        rho, spin = y[:4].reshape(2, 2), y[4:].real
        h = np.tensordot(spin, [X, Y, Z], 1) / 2
        mean = [np.trace(s @ rho).real for s in (X, Y, Z)]
        there = superoperator(h, [lower(2)], [0.2]) @ rho.ravel()
        return np.concatenate([there, np.cross(mean, spin)])

    start = {"rho": density(2), "spin": jnp.array([1.0, 0.5, -0.3])}
    want = reference(ode, 0, 1, np.concatenate([np.ravel(start["rho"]), start["spin"]]))
    found = cfjax.integrate(cfjax.LieTerm(field), cfjax.CF4(), 0.0, 1.0, start, num_steps=40).ys
    # The error is of order 4, (1/40)^4.
    np.testing.assert_allclose(np.ravel(found["rho"][-1]), want[:4], rtol=0, atol=1e-7)
    np.testing.assert_allclose(found["spin"][-1], np.real(want[4:]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("n", [3, 6])
def test_a_solve_in_single_precision(n):
    def field(t, y, args):
        return Lindblad(hermitian(n).astype(np.complex64), [lower(n).astype(np.float32)], [0.1])

    found = solve(field, density(n, dtype=np.complex64), solver=cfjax.CF2())
    assert found.dtype == np.complex64
    want = exact(hermitian(n), [lower(n)], [0.1], density(n))
    np.testing.assert_allclose(found, want, rtol=0, atol=4 * EPS["float32"])


def test_one_level_stays():
    field = Lindblad(np.ones((1, 1)), [np.full((1, 1), 2.0)], [0.3])
    x = jnp.ones((1, 1), complex)
    np.testing.assert_array_equal(field.flow(x), x)
    np.testing.assert_array_equal(field.tangent(x), 0 * x)


@pytest.mark.parametrize("n", [3, 6])
def test_real_hamiltonians_and_jumps(n):
    h, a, x = hermitian(n).real, lower(n) + lower(n).T @ lower(n).T, density(n)
    found = jitted(Lindblad(h, [a], [0.2]).flow)(x)
    np.testing.assert_allclose(found, exact(h, [a], [0.2], x), rtol=0, atol=1e-14)


@pytest.mark.parametrize("n", [3, 6])
def test_jumps_are_known_or_arguments_by_diagonals_or_dense(n):
    h, x = hermitian(n), density(n)
    jumps = [lower(n), 1j * lower(n).T + np.eye(n)]

    def flow(jumps):
        return Lindblad(h, jumps, [0.2, 0.1]).flow(x)

    # Tiny entries: no diagonal is zero.
    full = [np.where(a == 0, 1e-300, a) for a in jumps]
    want = exact(h, jumps, [0.2, 0.1], x)
    for found in (
        jax.jit(lambda: flow(jumps))(),
        jax.jit(lambda: flow([jnp.asarray(a) for a in jumps]))(),
        jax.jit(lambda: flow(full))(),
        jax.jit(flow)(jumps),
    ):
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


def test_rates_are_ones_by_default():
    field = Lindblad(hermitian(3), [L2, lower(3)])
    np.testing.assert_array_equal(field.rates, [1, 1])


def test_lists_of_traced_numbers():
    """As rates and as the Hamiltonian."""

    @jax.jit
    def tangent(g):
        return Lindblad([[0, g], [g, 0.0]], [Z, lower(2)], [g, 0.1]).tangent(density(2))

    want = superoperator(0.3 * X, [Z, lower(2)], [0.3, 0.1]) @ np.ravel(density(2))
    np.testing.assert_allclose(np.ravel(tangent(0.3)), want, rtol=0, atol=1e-15)


def test_numbers_of_python_take_the_precision_of_the_hamiltonian():
    h = np.eye(2, dtype=np.complex64)
    field = Lindblad(h, [lower(2).astype(np.float32)], [0.1])
    assert field.rates.dtype == np.float32


def test_new_values_need_no_new_program():
    traces = 0

    @jax.jit
    def run(h, jump, rates, rho):
        nonlocal traces
        traces += 1
        return Lindblad(h, [jump, lower(6)], rates).flow(rho)

    for k in range(3):
        h, rates = hermitian(6, k) * 10.0**k, np.array([0.1, 0.2]) * k
        run(h, L2_of(6) * (k + 1), rates, density(6, k))
    assert traces == 1


# What is refused

H, A = np.diag([0.0, 1.0, 2.0]), lower(3)
BROKEN = H + 1e-3 * np.triu(np.ones((3, 3)), 1)


@pytest.mark.usefixtures("no_shape_hook")
@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (lambda: Lindblad(np.ones(3), [A]), ValueError, r"h must have shape \(n, n\) or .* \(3,\)"),
        (lambda: Lindblad(np.ones((2, 3)), [A]), ValueError, r"h must have shape .* \(2, 3\)"),
        (lambda: Lindblad(np.ones((3, 3), int), [A]), TypeError, "h must be one of .* got int64"),
        (lambda: Lindblad(BROKEN, [A]), ValueError, r"h must be Hermitian, .* size 0.001, .* 2"),
        (lambda: Lindblad(1j * H, [A]), ValueError, "h must be Hermitian"),
        (lambda: Lindblad(H, [A], [-0.1]), ValueError, r"rates must not be negative, got \[-0.1\]"),
        (lambda: Lindblad(H, [A], [0.1, 0.2]), ValueError, r"each of the 1 jumps, .* got \(2,\)"),
        (lambda: Lindblad(H, [A], 0.1), ValueError, r"each of the 1 jumps, .* got \(\)"),
        (lambda: Lindblad(H, [A], [1j]), TypeError, "rates must be real, got complex128"),
        (
            lambda: Lindblad(H, [A], np.ones(1, np.float32)),
            TypeError,
            "rates must have the precision of h, float64, got float32",
        ),
        (
            lambda: Lindblad(H, [A], [np.float32(1)]),
            TypeError,
            "rates must have the precision of h, float64, got float32",
        ),
        (
            lambda: Lindblad(H, [A, np.eye(2)]),
            ValueError,
            r"jumps\[1\] must have the shape \(3, 3\), .* got \(2, 2\)",
        ),
        (
            lambda: Lindblad(H, [np.ones((2, 3, 3))]),
            ValueError,
            r"jumps\[0\] .* got \(2, 3, 3\) with h of shape \(3, 3\)",
        ),
        (lambda: Lindblad(H, ["a"]), TypeError, r"jumps\[0\] must be an array, got 'a'"),
        (lambda: Lindblad(H, [[[1.0]]]), TypeError, r"jumps\[0\] must be an array"),
        (
            lambda: Lindblad(H, [A.astype(np.float32)]),
            TypeError,
            r"jumps\[0\] must be real or complex of the precision of h, float64, got float32",
        ),
        (lambda: Lindblad(H, [A.astype(int)]), TypeError, r"jumps\[0\] must .* got int64"),
        (
            lambda: Lindblad(H, []),
            TypeError,
            r"at least one matrix, .* cfjax.Congruence\(-1j \* h\)",
        ),
        (
            lambda: Lindblad(H, A),
            TypeError,
            r"a sequence of at least one matrix, for one jump \[a\]",
        ),
        (
            lambda: Lindblad(H, [A]).flow(jnp.ones(3, complex)),
            ValueError,
            r"Lindblad with h of shape \(3, 3\) acts on shapes \(3, 3\), got \(3,\)",
        ),
        (
            lambda: Lindblad(H, [A]).flow(jnp.ones((5, 3, 3), complex)),
            ValueError,
            r"give the coordinates leading axes: h of shape \(5, 3, 3\)",
        ),
        (
            lambda: cfjax.combine((1.0, 1.0), (Lindblad(H, [A]), Lindblad(H, [A + 1]))),
            ValueError,
            "must have the same jumps: these may not depend on time",
        ),
        (
            lambda: cfjax.combine((1.0, 1.0), (Lindblad(H, [A]), Lindblad(H, [A, A]))),
            ValueError,
            "must have the same jumps",
        ),
    ],
)
def test_refuses(make, error, text):
    with pytest.raises(error, match=text):
        make()


def test_equal_jumps_of_other_objects_are_the_same():
    total = cfjax.combine((1.0, 1.0), (Lindblad(H, [A]), Lindblad(H, [A + 0.0])))
    np.testing.assert_array_equal(total.rates, [2.0])


@pytest.mark.usefixtures("no_shape_hook")
@pytest.mark.parametrize(
    ("args", "text"),
    [
        ((BROKEN, np.ones(1)), "Lindblad for y at the start: h must be Hermitian"),
        ((H, -np.ones(1)), "Lindblad for y at the start: rates must not be negative"),
    ],
)
def test_a_solve_refuses_values_that_are_not_known_before(args, text):
    field = lambda t, y, args: Lindblad(args[0], [A], args[1])  # noqa: E731
    for run in (solve, eqx.filter_jit(solve)):
        with pytest.raises((ValueError, eqx.EquinoxRuntimeError), match=text):
            run(field, density(3), args, cfjax.CF2())


@pytest.mark.parametrize(
    "rho",
    [
        np.asarray(density(3)) + 1e-3 * np.eye(3, k=1),
        density(3) * 1.001,
        np.diag([1.1, -0.1, 0.0]) + 0j,
    ],
    ids=["not Hermitian", "another trace", "a negative eigenvalue"],
)
def test_a_solve_refuses_a_start_that_is_no_density_matrix(rho):
    with pytest.raises((ValueError, eqx.EquinoxRuntimeError), match="trace 1 and no negative eig"):
        solve(lambda t, y, args: Lindblad(H, [A]), rho)


@pytest.mark.usefixtures("no_shape_hook")
def test_a_real_state_is_refused():
    with pytest.raises(ValueError, match="make y0 complex"):
        solve(lambda t, y, args: Lindblad(H, [A]), np.eye(3) / 3)


def test_jumps_that_depend_on_time_are_refused():
    def field(t, y, args):
        return Lindblad(H, [jnp.cos(t) * A])

    with pytest.raises(eqx.EquinoxRuntimeError, match="must have the same jumps"):
        jax.block_until_ready(solve(field, density(3)))


def test_methods_with_brackets_are_refused():
    with pytest.raises(TypeError, match=r"Lindblad has none: .* Use a commutator-free method"):
        solve(lambda t, y, args: Lindblad(H, [A]), density(3), solver=cfjax.RKMK4())


def test_a_norm_that_is_too_large_gives_nan():
    x = density(6)
    assert np.isnan(jitted(Lindblad(1e5 * hermitian(6), [lower(6)], [0.1]).flow)(x)).all()
