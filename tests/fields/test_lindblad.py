"""Lindblad's equation: flows, positivity, exact answers, derivatives, what is refused."""

import functools
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from matrices import random
from problems import (
    QUICK,
    central_difference,
    errors,
    first_step,
    reference,
    slope,
)

import cfjax
from cfjax import Lindblad

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
# A jump that is complex and not normal: a real one would hide a missing conjugate.
L2 = np.array([[0.5, 1j, 0], [0, -0.2, 0.3 + 0.4j], [0.1, 0, 1]])


def lower(n):
    return np.diag(np.sqrt(np.arange(1.0, n)), 1)


def L2_of(n):
    """The jump of three levels among n."""
    return scipy.linalg.block_diag(L2, np.zeros((n - 3, n - 3))) if n > 3 else L2


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
    return total


def exact(h, jumps, rates, x):
    h, x = np.asarray(h), np.asarray(x)
    return (long_expm(superoperator(h, jumps, rates)) @ x.ravel()).reshape(x.shape).astype(complex)


def case(n, norm, damping, dtype=complex):
    """A Hamiltonian, two jumps, and rates, of about this norm in all."""
    h = hermitian(n)
    jumps = np.stack([random((n, n), 1, complex), lower(n) + 0j])
    jumps = jumps / (np.linalg.norm(jumps, 2, axis=(1, 2))[:, None, None] + 1e-300)
    if damping == "strong":
        h, rates = norm / 4 * h, norm / 4 * np.array([0.8, 0.2])
    else:
        h, rates = norm / 2 * h, min(0.2, norm / 4) * np.array([0.8, 0.2])
        # Growth, of e^2 at most.
        rates = rates if damping == "weak" else -3 * rates
    return h.astype(dtype), jumps.astype(dtype), rates.astype(np.finfo(dtype).dtype)


# The flow itself. Up to 5 levels it is by the exponential of a matrix, which test_contract.py has,
# beyond by a series.

CASES = [("strong", 0.0), ("strong", 1.0), ("strong", 300.0)]
CASES += [("weak", 0.05), ("weak", 10.0), ("growing", 1.0)]
traces = []


@functools.partial(jax.jit, static_argnames="in_reverse", compiler_options=QUICK)
def everything(coordinates, x, way, w, in_reverse):
    """What a field does, and the derivative of its flow along a way, also as paired with w."""
    traces.append(len(x))

    def flow(coordinates, x):
        h, jumps, rates = coordinates
        return Lindblad(h, list(jumps), rates).flow(x)

    h, jumps, rates = coordinates
    field = Lindblad(h, list(jumps), rates)
    end, slope = jax.jvp(flow, (coordinates, x), way)
    pulled = (
        jax.vjp(flow, coordinates, x)[1](w) if in_reverse else jax.tree.map(jnp.zeros_like, way)
    )
    # JAX pairs without conjugation.
    pairs = zip(jax.tree.leaves(pulled), jax.tree.leaves(way), strict=True)
    paired = sum(jnp.sum(a * b).real for a, b in pairs)
    k = field.no_jump()
    parts = k @ x + x @ k.conj().T + field.jump(x)
    return end, field.tangent(x), slope, paired, parts, jnp.trace(k), field._bounds()[0]


def along(n):
    """A way for the coordinates and a state, and what is paired with it."""
    jumps = random((2, n, n), 4, complex) / (2 * n**0.5)
    way = (hermitian(n, 2), jumps, np.array([0.4, 0.3])), density(n, 5) - density(n, 6)
    return way, random((n, n), 7, complex)


@pytest.mark.slow
@pytest.mark.parametrize("in_reverse", [False, True])
def test_the_motion_and_its_derivatives(in_reverse):
    """By Hamiltonian, jumps, rates and state, against the superoperator."""
    n, eps = 6, EPS["float64"]
    x, (way, w) = density(n, 3), along(n)
    before = len(traces)
    for damping, norm in CASES:
        coordinates = case(n, norm, damping)
        end, velocity, slope, paired, parts, trace, _ = everything(
            coordinates, x, way, w, in_reverse
        )
        a = superoperator(*coordinates)
        # The difference is exact for polynomials of degree 3.
        b = central_difference(lambda c: superoperator(*c), coordinates, way[0], 1.0)
        block = np.block([[a, b], [np.zeros_like(a), a]])
        rate, rho = np.ravel(way[1]), np.ravel(x)
        moved = long_expm(block) @ np.concatenate([rate, rho])
        want_slope, want = moved.reshape(2, n, n)
        text, growth = f"{damping} {norm}", np.exp(2) if damping == "growing" else 1

        def close(found, want, atol, text=text):
            np.testing.assert_allclose(found, want.astype(complex), 0, atol, err_msg=text)

        # Some units of rounding, and some for each of the norm: both of a long series and of
        # squarings.
        close(end, want, 4 * growth * eps * (1 + norm))
        np.testing.assert_array_equal(end, end.conj().T)
        # Not corrected, as that of a flow is: so a wrong factor would show.
        for found in (velocity, parts):
            close(found, (a @ rho).reshape(n, n), 20 * n * eps * norm)
            assert abs(np.trace(found)) <= 20 * n * eps * norm
        # Without the trace of h, which has no effect.
        assert abs(trace.imag) <= 4 * eps * norm
        # As for the flow, times what it is linear in.
        atol = 4 * growth * eps * (1 + norm) * (1 + np.linalg.norm(b, 2))
        close(slope, want_slope, atol)
        if in_reverse:
            near = n * atol * np.linalg.norm(w, 2)
            assert paired == pytest.approx(np.sum(w * slope).real, abs=near)
    # New values need no new program.
    assert traces[before:] == [n]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("dtype", [np.complex64, np.complex128])
def test_flow_and_increment(dtype):
    n = 6

    @jax.jit
    def found(h, jumps, rates, x):
        field = Lindblad(h, list(jumps), rates)
        return field.flow(x), field.increment(x)

    x, eps = density(n, 3, dtype), float(np.finfo(dtype).eps)
    for damping, norm in CASES[:-1]:
        coordinates = case(n, norm, damping, dtype)
        end, change = found(*coordinates, x)
        assert end.dtype == change.dtype == dtype
        want = exact(*(np.asarray(z, complex) for z in (*coordinates, x)))
        np.testing.assert_allclose(end, want, rtol=0, atol=4 * eps * (1 + norm))
        # A small change has a rounding error as small.
        atol = 4 * eps * min(4 * norm, 1 + norm)
        np.testing.assert_allclose(change, want - np.asarray(x), rtol=0, atol=atol)
        np.testing.assert_array_equal(change, change.conj().T)
        assert abs(np.trace(change)) <= 2 * n * eps
    # What is not Hermitian in a point is lost.
    y, coordinates = x + (1j * hermitian(n, 4)).astype(dtype), case(n, 1.0, "weak", dtype)
    end, _ = found(*coordinates, x)
    same, change = found(*coordinates, y)
    np.testing.assert_allclose(same, end, rtol=0, atol=8 * eps)
    np.testing.assert_allclose(y + change, end, rtol=0, atol=8 * eps)


def test_what_has_no_effect_on_a_flow():
    n, x, (way, w) = 6, density(6, 3), along(6)
    h, jumps, rates = case(n, 1.0, "weak")
    end, *_, norm = everything((h, jumps, rates), x, way, w, False)
    # A constant energy, which rounds the entries of h, and costs nothing.
    found, *_, same = everything((h + 1e4 * np.eye(n), jumps, rates), x, way, w, False)
    np.testing.assert_allclose(found, end, rtol=0, atol=1e4 * 8 * EPS["float64"])
    np.testing.assert_allclose(same, norm, rtol=1e-10)
    # A norm that is too large gives NaN.
    assert np.isnan(everything((1e5 * h, jumps, rates), x, way, w, False)[0]).all()


def test_combine_adds_hamiltonians_and_rates():
    a, b = (Lindblad(hermitian(3, k), [L2, lower(3)], [0.2 + k, 0.1]) for k in range(2))
    total = cfjax.combine((2.0, -0.5), (a, b))
    np.testing.assert_allclose(total.h, 2 * hermitian(3, 0) - hermitian(3, 1) / 2, atol=1e-15)
    # A negative one stays as it is.
    np.testing.assert_allclose(total.rates, [0.4 - 0.6, 0.2 - 0.05], atol=1e-15)
    # Equal jumps of other objects are the same.
    total = cfjax.combine((1.0, 1.0), (Lindblad(H, [A]), Lindblad(H, [A + 0.0])))
    np.testing.assert_array_equal(total.rates, [2.0])


def test_the_bounds_of_the_numerical_range():
    """The operator acts on Hermitian and other matrices, with the Hilbert-Schmidt product."""
    n = 4
    bounds = jax.jit(lambda h, jumps, rates: Lindblad(h, list(jumps), rates)._bounds())
    for kind, seed in itertools.product(("coherent", "damped", "pumped"), range(20)):
        h = hermitian(n, seed) * (3.0 if kind == "coherent" else 0.1) + 5 * np.eye(n)
        jumps = [random((n, n), 10 + seed, complex), np.outer(np.eye(n)[0], np.ones(n)) + 0j]
        rates = np.array([0.1, 0.3] if kind != "pumped" else [0.1, 2.0])
        norm, strip = bounds(h, np.stack(jumps), rates)
        a = superoperator(h, jumps, rates)
        real = np.linalg.eigvalsh((a + a.conj().T) / 2)
        imaginary = np.linalg.eigvalsh((a - a.conj().T) / 2j)
        assert np.linalg.norm(a, 2) <= norm
        assert -strip.decay <= real.min() and real.max() <= strip.growth
        assert np.abs(imaginary).max() <= strip.imaginary


@pytest.mark.slow
@pytest.mark.parametrize("n", [6, 3])
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


def decaying(t, rho, swing):
    """A driven oscillator of a few levels which loses quanta: one jump, of rank n - 1.

    With a swing of 1 the rate touches zero.
    """
    h = ENERGIES + jnp.cos(3 * t) * (lower(LEVELS) + lower(LEVELS).T)
    return Lindblad(h, [lower(LEVELS)], 0.3 * (1 + swing * jnp.sin(3 * t))[None])


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
def one_step(solver, thetas=()):
    """Where a step leads pure states: by the method, by its embedded method, and within it."""

    @functools.partial(jax.jit, compiler_options=QUICK)
    def step(t0, t1, swing):
        def of_one(rho):
            term = cfjax.LieTerm(decaying)
            end, estimate, dense, *_ = first_step(solver, term, t0, t1, rho, swing)
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


# Of methods of order 4, the worst step from 0 to 4 for a rate that touches zero: measured.
LOSSES = {
    "CF4": (cfjax.CF4(), {10: -1.4e-7, 20: -1.4e-8, 40: -3.4e-10}),
    "CF43": (cfjax.CF43(), {10: -2.1e-9, 20: -2.5e-10}),
    "Magnus4": (cfjax.Magnus4(), {10: -2.9e-9, 20: -2.3e-12}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LOSSES)
def test_order_4_is_completely_positive_with_constant_rates(name):
    """Steps, estimates and output; and how much of it a rate that touches zero costs."""
    solver, losses = LOSSES[name]
    step = one_step(solver, (0.1, 0.5, 0.9))
    for h in (0.02, 0.1, 0.4, 1.0, 2.0, 6.0):
        end, embedded, *within = step(0.0, h, 0.0)
        # The estimate of CF4 is in part another number.
        assert_completely_positive([end, *within, *([embedded] if name != "CF4" else [])])
    for number, loss in losses.items():
        times = np.linspace(0, 4, number + 1)
        found = min(least_of_choi(step(*ts, 1.0)[0]) for ts in itertools.pairwise(times))
        assert 2 * loss < found < loss / 2


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", [cfjax.CF2(), cfjax.Magnus2()], ids=repr)
def test_order_2_is_completely_positive_with_every_rate(solver):
    for t0, h in [(0.0, 0.1), (1.4, 0.4), (0.3, 2.0)]:
        assert_completely_positive(one_step(solver)(t0, t0 + h, 1.0)[:1])


def test_the_flows_of_a_step_with_constant_rates_have_positive_times():
    for tableau in (cfjax.CF4.tableau, cfjax.CF43.tableau):
        for product in (tableau.beta, tableau.embedded):
            assert all(sum(row) > 0 for row in product)
    # One flow of this method has a negative rate.
    assert any(sum(row) < 0 for row in cfjax.CF54.tableau.beta)


# The order

SIGMA = np.array([[0, 1], [1, 0]]), np.array([[0, -1j], [1j, 0]]), np.diag([1.0, -1.0])
PARTS = np.stack([hermitian(3, k) for k in (1, 2, 3)])
WATCHED = np.stack([hermitian(3, k) for k in (5, 6, 7)])


def drive(xp, t, rho, spin):
    """Hamiltonian and rates of an atom, which a spin drives; and how the atom turns the spin."""
    turns = xp.stack([xp.ones_like(t), xp.cos(2 * t), spin[0]]).astype(complex)
    rates = xp.stack([xp.full_like(t, 0.4), 0.2 + xp.sin(3 * t) / 10])
    return xp.tensordot(turns, PARTS, 1), rates, xp.einsum("kij,ji->k", WATCHED, rho).real


def test_order_on_a_product_of_manifolds():
    def field(t, y, args):
        h, rates, mean = drive(jnp, t, y["rho"], y["spin"])
        return {"rho": Lindblad(h, [L2, lower(3)], rates), "spin": cfjax.Rotation(mean)}

    def ode(t, y):
        h, rates, mean = drive(np, np.asarray(t), y[:9].reshape(3, 3), y[9:].real)
        there = superoperator(h, [L2, lower(3)], rates) @ y[:9]
        return np.concatenate([there, np.cross(mean, y[9:].real)])

    start, steps = {"rho": density(3), "spin": np.array([1.0, 0.5, -0.3])}, (16, 32, 64)
    want = reference(ode, 0, 2, np.concatenate([np.ravel(start["rho"]), start["spin"]]))
    found = errors(field, cfjax.CF2(), 2.0, start, None, want, steps)
    assert 1.9 < slope(steps, found) < 2.1


# Exact answers


def flow_for(t, h, jumps, rates, rho):
    """The point after the time t, in one flow."""
    field = Lindblad(t * np.asarray(h), jumps, t * np.asarray(rates))
    return np.asarray(jax.jit(lambda rho: field.flow(rho))(jnp.asarray(rho, complex)))


def test_bloch_equations():
    """`r' = w x r - (g/2 + 2 f) (x, y, 0) + g (0, 0, 1 - z)`."""
    w, g, f, t = np.array([1.3, -0.4, 0.7]), 0.5, 0.2, 1.7
    r = np.array([0.3, -0.5, 0.2])
    m = np.zeros((4, 4))
    m[:3, :3] = np.cross(w, np.eye(3)).T - np.diag([g / 2 + 2 * f, g / 2 + 2 * f, g])
    m[2, 3] = g
    want = (scipy.linalg.expm(t * m) @ [*r, 1])[:3]
    rho = (np.eye(2) + np.tensordot(r, SIGMA, 1)) / 2
    end = flow_for(t, np.tensordot(w, SIGMA, 1) / 2, [lower(2), SIGMA[2]], [g, f], rho)
    found = [np.trace(s @ end).real for s in SIGMA]
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)


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


# Forms of the arguments


def test_leading_axes():
    """Jumps have them or not; those that `jax.vmap` makes have, and are known by diagonals."""
    n = 6
    h = np.stack([hermitian(n, k) for k in range(3)])
    jumps = np.stack([L2_of(n) * s for s in (1, 0.5, 1j)]), lower(n)
    rates = np.array([[0.3, 0.1], [0.2, 0.4], [0.0, 0.1]])
    x = jnp.stack([density(n, k) for k in range(3)])

    @jax.jit
    def motions(x):
        made = jax.vmap(lambda rates: Lindblad(h[0], [L2_of(n), lower(n)], rates))(rates)
        first, single = Lindblad(h, jumps, rates), Lindblad(h[:1], [jumps[0][:1]], rates[:, :1])
        many = cfjax.elementwise(made)
        fields = first, single, made, many
        return [f.tangent(x) for f in fields], [holds for holds, _ in many.faults()]

    tangents, faults = motions(x)
    assert not any(faults)
    for k in range(3):
        alone = [
            (h[k], [jumps[0][k], jumps[1]], rates[k]),
            (h[0], [jumps[0][0]], rates[k, :1]),
            *[(h[0], [L2_of(n), lower(n)], rates[k])] * 2,
        ]
        for parts, tangent in zip(alone, tangents, strict=True):
            want = (superoperator(*parts) @ np.ravel(x[k])).reshape(n, n)
            np.testing.assert_allclose(tangent[k], want, rtol=0, atol=1e-14)


def test_one_level_stays():
    field = Lindblad(np.ones((1, 1)), [np.full((1, 1), 2.0)], [0.3])
    x = jnp.ones((1, 1), complex)
    end, velocity = jax.jit(lambda x: (field.flow(x), field.tangent(x)))(x)
    np.testing.assert_array_equal(end, x)
    np.testing.assert_array_equal(velocity, 0 * x)


def test_jumps_are_known_or_arguments_by_diagonals_or_dense():
    n, x = 6, density(6)
    jumps = [lower(n), 1j * lower(n).T + np.eye(n)]
    real = [lower(n) + lower(n).T @ lower(n).T]
    # Tiny entries: no diagonal is zero.
    full = [np.where(a == 0, 1e-300, a) for a in jumps]

    @jax.jit
    def velocities(traced):
        known = [jnp.asarray(a) for a in jumps]
        ways = [Lindblad(hermitian(n), a, [0.2, 0.1]) for a in (jumps, known, full, traced)]
        return [field.tangent(x) for field in (*ways, Lindblad(hermitian(n).real, real, [0.2]))]

    wants = 4 * [superoperator(hermitian(n), jumps, [0.2, 0.1])]
    wants.append(superoperator(hermitian(n).real, real, [0.2]))
    for found, want in zip(velocities(jumps), wants, strict=True):
        np.testing.assert_allclose(np.ravel(found), want @ np.ravel(x), rtol=0, atol=1e-14)


def test_rates_and_hamiltonians_in_lists():
    np.testing.assert_array_equal(Lindblad(hermitian(3), [L2, lower(3)]).rates, [1, 1])
    # Numbers of Python take the precision of the Hamiltonian.
    h = np.eye(2, dtype=np.complex64)
    assert Lindblad(h, [lower(2).astype(np.float32)], [0.1]).rates.dtype == np.float32

    @jax.jit
    def tangent(g):
        """With lists of traced numbers."""
        return Lindblad([[0, g], [g, 0.0]], [SIGMA[2], lower(2)], [g, 0.1]).tangent(density(2))

    want = superoperator(0.3 * SIGMA[0], [SIGMA[2], lower(2)], [0.3, 0.1]) @ np.ravel(density(2))
    np.testing.assert_allclose(np.ravel(tangent(0.3)), want, rtol=0, atol=1e-15)


# What is refused

H, A = np.diag([0.0, 1.0, 2.0]), lower(3)
BROKEN = H + 1e-3 * np.triu(np.ones((3, 3)), 1)
OTHER_PRECISION = "rates must have the precision of h, float64, got float32"


def test_wrong_arguments(subtests, no_shape_hook):
    x, one, single = np.ones((3, 3)), jnp.ones(3, complex), np.ones(1, np.float32)
    refused: dict[type[Exception], list[Any]] = {
        ValueError: [
            (lambda: Lindblad(np.ones(3), [A]), r"h must have shape \(n, n\) or .* \(3,\)"),
            (lambda: Lindblad(x[:2], [A]), r"h must have shape .* \(2, 3\)"),
            (lambda: Lindblad(BROKEN, [A]), r"h must be Hermitian, .* size 0.001, .* 2"),
            (lambda: Lindblad(1j * H, [A]), "h must be Hermitian"),
            (lambda: Lindblad(H, [A], [-0.1]), r"rates must not be negative, got \[-0.1\]"),
            (lambda: Lindblad(H, [A], [0.1, 0.2]), r"each of the 1 jumps, .* got \(2,\)"),
            (lambda: Lindblad(H, [A], 0.1), r"each of the 1 jumps, .* got \(\)"),
            (
                lambda: Lindblad(H, [A, np.eye(2)]),
                r"jumps\[1\] must have the shape \(3, 3\), .* got \(2, 2\)",
            ),
            (
                lambda: Lindblad(H, [x[None]]),
                r"jumps\[0\] .* got \(1, 3, 3\) with h of shape \(3, 3\)",
            ),
            (
                lambda: Lindblad(H, [A]).flow(one),
                r"Lindblad with h of shape \(3, 3\) acts on shapes \(3, 3\), got \(3,\)",
            ),
            (
                lambda: Lindblad(H, [A]).flow(jnp.ones((5, 3, 3), complex)),
                r"give the coordinates leading axes: h of shape \(5, 3, 3\)",
            ),
            (
                lambda: cfjax.combine((1.0, 1.0), (Lindblad(H, [A]), Lindblad(H, [A + 1]))),
                "must have the same jumps: these may not depend on time",
            ),
            (
                lambda: cfjax.combine((1.0, 1.0), (Lindblad(H, [A]), Lindblad(H, [A, A]))),
                "must have the same jumps",
            ),
        ],
        TypeError: [
            (lambda: Lindblad(x.astype(int), [A]), "h must be one of .* got int64"),
            (lambda: Lindblad(H, [A], [1j]), "rates must be real, got complex128"),
            (lambda: Lindblad(H, [A], single), OTHER_PRECISION),
            (lambda: Lindblad(H, [A], [single[0]]), OTHER_PRECISION),
            (lambda: Lindblad(H, ["a"]), r"jumps\[0\] must be an array, got 'a'"),
            (lambda: Lindblad(H, [[[1.0]]]), r"jumps\[0\] must be an array"),
            (
                lambda: Lindblad(H, [A.astype(np.float32)]),
                r"jumps\[0\] must be real or complex of the precision of h, float64, got float32",
            ),
            (lambda: Lindblad(H, [A.astype(int)]), r"jumps\[0\] must .* got int64"),
            (lambda: Lindblad(H, []), r"at least one matrix, .* cfjax.Congruence\(-1j \* h\)"),
            (lambda: Lindblad(H, A), r"a sequence of at least one matrix, for one jump \[a\]"),
        ],
    }
    for error, cases in refused.items():
        for k, (make, text) in enumerate(cases):
            with subtests.test(case=str(k), text=text), pytest.raises(error, match=text):
                make()


def solve(field, rho, args=None, solver: Any = None):
    term = cfjax.LieTerm(field)
    return cfjax.integrate(term, solver or cfjax.CF2(), 0.0, 1.0, rho, args, num_steps=1).ys[-1]


def of_args(t, y, args):
    return Lindblad(args[0], [A], args[1])


def test_wrong_values_at_the_start_of_a_solve(subtests, no_shape_hook):
    start, good = np.asarray(density(3)), (H, np.ones(1))
    trace = "trace 1 and no negative eig"
    cases: dict[str, Any] = {
        "h": ((BROKEN, good[1]), start, "Lindblad for y at the start: h must be Hermitian"),
        "rates": ((H, -good[1]), start, "Lindblad for y at the start: rates must not be negative"),
        "not Hermitian": (good, start + 1e-3 * np.eye(3, k=1), trace),
        "another trace": (good, start * 1.001, trace),
        "a negative eigenvalue": (good, np.diag([1.1, -0.1, 0.0]) + 0j, trace),
    }
    for name, (args, rho, text) in cases.items():
        with (
            subtests.test(case=name),
            pytest.raises((ValueError, eqx.EquinoxRuntimeError), match=text),
        ):
            jax.block_until_ready(solve(of_args, jnp.asarray(rho), args, cfjax.LieEuler()))


def test_wrong_solves(no_shape_hook):
    field = lambda t, y, args: Lindblad(H, [A])  # noqa: E731
    with pytest.raises(ValueError, match="make y0 complex"):
        solve(field, np.eye(3) / 3)
    with pytest.raises(TypeError, match=r"Lindblad has none: .* Use a commutator-free method"):
        solve(field, density(3), solver=cfjax.RKMK4())
    added = jax.jit(
        lambda a: cfjax.combine((1.0, 1.0), [Lindblad(H, [s * a]) for s in (1, 2)]).rates
    )
    with pytest.raises(RuntimeError, match="must have the same jumps"):
        jax.block_until_ready(added(A))
