"""Exponential Runge-Kutta methods: one step against an interpreter of their tableaus, stiff orders.

Orders are proved in methods/test_stiff_order.py.
"""

import functools
from fractions import Fraction
from math import factorial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from jax.extend.core import jaxprs_in_params
from problems import QUICK, arrays, central_difference, inner, many_steps
from solver_table import named

import cfjax

KROGSTAD = cfjax.ExponentialTableau(
    c=[0, Fraction(1, 2), Fraction(1, 2), 1],
    a={3: {2: {2: 1}}, 4: {3: {2: 2}}},
    b={2: {2: 2, 3: -4}, 3: {2: 2, 3: -4}, 4: {2: -1, 3: 4}},
)
SECOND_ORDER = cfjax.ExponentialTableau(c=[0, 1], a={}, b={2: {2: 1}})
METHODS = named("exponential")
SOLVERS: dict[str, Any] = {name: row.make() for name, row in METHODS.items()}
SOLVERS["Krogstad"] = cfjax.ExponentialRungeKutta(KROGSTAD)
T0, H, THETA = 0.3, 0.25, 0.4


# One step, of a state of all kinds of parts.


N = 5
DENSE = np.random.default_rng(0).normal(size=(N, N)) - 4 * np.eye(N)
SINE = cfjax.SineTransform()
SPECTRUM = 6.0**2 * SINE.second_difference(N)
SECOND = 36.0 * (np.eye(N, k=1) - 2 * np.eye(N) + np.eye(N, k=-1))


def coefficients(xp, t, y):
    """Matrices that vary in time and state, and what else there is in the velocity."""
    mixed = xp.sum(y["dense"]) * xp.sin(y["grid"]) + xp.cos(3 * t)
    return (
        (1 + 0.2 * xp.sin(t) + 0.1 * y["plain"][0]) * DENSE,
        xp.cos(t + y["dense"]) + y["plain"],
        1 + 0.3 * xp.cos(t) * y["dense"][0],
        mixed,
        -(y["plain"] ** 2) + y["grid"],
    )


def mixed_field(t, y, args):
    del args
    a, b, alpha, g, velocity = coefficients(jnp, t, y)
    return {
        "dense": cfjax.LinearAffine(a, b),
        "grid": cfjax.Affine(g, SPECTRUM, SINE, alpha=alpha),
        "plain": velocity,
        "rest": None,
    }


START = {
    "dense": np.linspace(-1.0, 1.0, N),
    "grid": np.sin(np.arange(1.0, N + 1)),
    "plain": np.cos(np.arange(N)),
    "rest": np.ones(2),
}


def phi(k, a):
    """From the exponential of a block matrix (Sidje 1998)."""
    n = len(a)
    blocks = np.eye((k + 1) * n, k=n)
    blocks[:n] = 0
    blocks[:n, :n] = a
    if k:
        blocks[:n, n : 2 * n] = np.eye(n)
    return scipy.linalg.expm(blocks)[:n, k * n :]


def interpreted(tableau, theta=THETA):
    """The end of a step in NumPy, its estimate, and the point at a part of it."""
    names = ["dense", "grid", "plain"]

    def parts(u):
        return dict(zip(names, np.split(u, 3), strict=True)) | {"rest": START["rest"]}

    def linear(t, u):
        a, _, alpha, *_ = coefficients(np, t, parts(u))
        return scipy.linalg.block_diag(a, alpha * SECOND, np.zeros((N, N)))

    def velocity(t, u):
        y = parts(u)
        a, b, alpha, g, plain = coefficients(np, t, y)
        return np.concatenate([a @ y["dense"] + b, alpha * SECOND @ y["grid"] + g, plain])

    u = np.concatenate([START[name] for name in names])
    first = linear(T0, u)

    def function(terms, scale=1.0):
        return sum(float(w) * phi(k, float(c) * scale * H * first) for k, c, w in terms)

    def g(t, u):
        return velocity(t, u) - first @ u

    stages = [g(T0, u)]

    def changes(columns):
        return sum(
            (H * function(terms) @ (stages[j - 1] - stages[0]) for j, terms in columns),
            np.zeros_like(u),
        )

    def flow(c):
        """The flow of the first g alone."""
        return phi(0, c * H * first) @ u + c * H * phi(1, c * H * first) @ stages[0]

    for c, columns in list(zip(map(float, tableau.c), tableau.a, strict=True))[1:]:
        stages.append(g(T0 + c * H, flow(c) + changes(columns)))
    end = flow(1.0) + changes(tableau.b)
    stages.append(g(T0 + H, end))
    error = changes(tableau.error or ())
    within = flow(theta)
    for m, weights in enumerate(tableau.powers, 1):
        power = sum(float(w) * (stages[j - 1] - stages[0]) for j, w in weights)
        kernel = theta ** (m + 1) * factorial(m) * H * phi(m + 1, theta * H * first)
        within = within + kernel @ power
    return tuple(map(parts, (end, error, within)))


# The methods differ in their coefficients, which methods/test_stiff_order.py proves.
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "ETD43")) for name in SOLVERS],
)
def test_one_step(name):
    solver = SOLVERS[name]
    term, y0 = cfjax.LieTerm(mixed_field), jax.tree.map(jnp.asarray, START)

    def step(y0):
        state = solver.init(term, T0, T0 + H, y0, None)
        y1, error, dense, *_ = solver.step(term, T0, T0 + H, y0, None, state, False)
        within = solver.interpolation_cls(t0=T0, t1=T0 + H, **dense).evaluate(T0 + THETA * H)
        return y1, error, within

    found = jax.jit(step).lower(y0).compile(QUICK)(y0)
    for got, expected in zip(found, interpreted(solver.tableau), strict=True):
        if got is None:
            continue
        for part in ("dense", "grid", "plain"):
            # Coefficients of up to 274 with alternating signs, of functions right to rounding.
            np.testing.assert_allclose(got[part], expected[part], rtol=0, atol=2e-13)
    np.testing.assert_array_equal(found[0]["rest"], START["rest"])


# Stiff orders, where g does not vanish at the boundary. The exact solution is a parabola in x, for
# which differences are exact (Hochbruck & Ostermann 2005, Section 6).


POINTS = 199
X = np.arange(1, POINTS + 1) / (POINTS + 1)
STIFF = (POINTS + 1) ** 2 * SINE.second_difference(POINTS)
PARABOLA = X * (1 - X)


def local(t, u, xp=jnp):
    exact = PARABOLA * xp.exp(t)
    return 1 / (1 + u**2) + exact + 2 * xp.exp(t) - 1 / (1 + exact**2)


def integral(t, u):
    mean = np.mean(PARABOLA) * POINTS / (POINTS + 1)
    return jnp.sum(u) / (POINTS + 1) + (PARABOLA + 2 - mean) * jnp.exp(t)


PROBLEMS = {"local": local, "integral": integral}


def term_of(g):
    return cfjax.LieTerm(lambda t, u, args: cfjax.Affine(g(t, u), STIFF, SINE))


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver, name, least, most",
    [
        (cfjax.ETD54(), "local", 4.4, 5.6),
        (cfjax.ETD43(), "integral", 3.6, 4.5),
        (cfjax.ETD54(), "integral", 4.4, 5.6),
        (cfjax.ETD43(), "local", 3.6, 4.5),
        # Between its stiff order and the 3 of stages whose errors are smooth.
        (cfjax.ETDRK4(), "local", 1.7, 2.9),
        (cfjax.CF4(), "local", 1.8, 2.2),
    ],
)
def test_stiff_order(solver, name, least, most):
    """From both sides. The largest eigenvalue times a step is 16 000 at first, and 2000 at last."""

    field, times = term_of(PROBLEMS[name]).field, arrays((0.0, 1.0))

    def error(num_steps):
        end = many_steps(field, solver, *times, jnp.asarray(PARABOLA), None, jnp.asarray(num_steps))
        return np.max(np.abs(end - PARABOLA * np.exp(1)))

    assert least < np.log2(error(10) / error(80)) / 3 < most


# What equal steps compute once.


def loop_operations(term, y0, num_steps=10):
    """The operations in the body of the loop."""
    program = jax.make_jaxpr(
        lambda y0: cfjax.integrate(term, cfjax.ETD43(), 0.0, 1.0, y0, num_steps=num_steps).ys
    )(y0)
    found = set()

    def visit(jaxpr, is_inside):
        for eqn in jaxpr.eqns:
            if is_inside:
                found.add(eqn.primitive.name)
            for part in jaxprs_in_params(eqn.params):
                is_loop = eqn.primitive.name == "scan" and eqn.params["length"] == num_steps
                visit(part, is_inside or is_loop)

    visit(program.jaxpr, False)
    return found


def test_equal_steps_compute_phi_functions_once():
    y0 = jnp.asarray(PARABOLA)
    # The field itself has an exponential, of the time.
    term = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(u - u**3 + t, STIFF, SINE))
    found = loop_operations(term, y0)
    assert "mul" in found
    assert not {"exp", "expm1"} & found
    varying = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(u - u**3, STIFF, SINE, alpha=1.0 + t))
    assert "exp" in loop_operations(varying, y0)


def test_reverse_mode_does_not_keep_phi_functions():
    """A step more takes the room of a state, and not that of two functions."""
    num_steps, solver = 1000, cfjax.ExponentialRungeKutta(SECOND_ORDER)

    def loss(nu):
        term = cfjax.LieTerm(lambda t, u, nu: cfjax.Affine(u - u**3, nu * STIFF, SINE))
        y0 = jnp.asarray(PARABOLA)
        return jnp.sum(cfjax.integrate(term, solver, 0.0, 1.0, y0, nu, num_steps=num_steps).ys[-1])

    compiled = jax.jit(jax.grad(loss)).lower(1.0).compile(QUICK)
    # With time, number and result beside it, and the functions once.
    assert compiled.memory_analysis().temp_size_in_bytes / num_steps < 1.2 * 8 * POINTS


# Controlled steps.


@pytest.mark.slow
@pytest.mark.parametrize("solver", [cfjax.ETD43(), cfjax.ETD54()])
@pytest.mark.parametrize("name", PROBLEMS)
def test_error_over_tolerance(name, solver):
    exact = PARABOLA * np.exp(np.array([[0.37], [1.0]]))

    @jax.jit
    def solve(tol):
        return diffrax.diffeqsolve(
            term_of(PROBLEMS[name]),
            solver,
            *(0.0, 1.0, 0.01, jnp.asarray(PARABOLA)),
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            saveat=diffrax.SaveAt(ts=jnp.array([0.37, 1.0])),
        ).ys

    for tol in (1e-4, 1e-7):
        error = np.abs(np.asarray(solve(tol)) - exact).max(axis=1) / tol
        # Neither blind nor wasteful; output within a step is of an order less.
        assert 1e-3 < error[1] < 25
        assert error[0] < 25


# Derivatives.


@pytest.mark.slow
def test_gradients_by_differences():
    """By the diffusivity and the start, in both modes, and with adaptive steps too."""
    n = 15
    x = np.arange(1, n + 1) / (n + 1)
    spectrum = (n + 1) ** 2 * SINE.second_difference(n)

    def end(at, controlled):
        nu, y0 = at
        term = cfjax.LieTerm(
            lambda t, u, nu: cfjax.Affine(u - u**3 + np.cos(x) * t, nu * spectrum, SINE)
        )
        if not controlled:
            ys = cfjax.integrate(term, cfjax.ETD54(), 0.0, 1.0, y0, nu, num_steps=40).ys
        else:
            control = diffrax.PIDController(rtol=1e-9, atol=1e-10)
            ys = diffrax.diffeqsolve(
                term, cfjax.ETD54(), 0.0, 1.0, 0.01, y0, nu, stepsize_controller=control
            ).ys
        return jnp.arange(1.0, n + 1) @ ys[-1]

    at, direction = arrays(((0.05, np.sin(np.pi * x)), (1.0, np.cos(3 * x))))
    # The difference is off by 1e-12 / 30 times a fifth derivative, and by the rounding of sums of
    # up to 100 over 1e-3; the controlled steps are by their tolerance.
    expected = central_difference(jax.jit(lambda at: end(at, False)), at, direction, 1e-3)
    for controlled in (False, True):
        gradient = jax.jit(jax.grad(lambda at: end(at, controlled)))(at)  # noqa: B023
        assert float(inner(gradient, direction)) == pytest.approx(float(expected), rel=1e-6)
    forward = jax.jvp(lambda at: end(at, False), (at,), (direction,))[1]
    assert float(forward) == pytest.approx(float(expected), rel=1e-6)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_derivatives_of_a_step_of_length_zero_and_without_a_linear_part(mode):
    """There all arguments of phi are zero, where it is smooth."""

    def loss(args):
        length, scale = args
        term = cfjax.LieTerm(lambda t, u, scale: cfjax.Affine(jnp.sin(u), scale * SPECTRUM))
        sol = cfjax.integrate(
            term, SOLVERS["Krogstad"], 0.0, length, jnp.ones(N), scale, num_steps=1
        )
        return jnp.sum(sol.ys[-1])

    gradient = jax.jit(mode(loss), compiler_options=QUICK)
    of_length, of_scale = gradient(jnp.array([0.0, 1.0]))
    # By the time it is the velocity.
    expected = np.sum(np.sin(np.ones(N)) + SPECTRUM)
    np.testing.assert_allclose(of_length, expected, rtol=1e-14)
    assert of_scale == 0
    h, points = 1e-3, 401
    of_scale = gradient(jnp.array([h, 0.0]))[1]
    # d/ds of exp(h s z) u and of the flow of g, to first order in s: h z (u + h g / 2 + ...), with
    # g = sin(u) along the solution of u' = sin(u) from 1.
    s = np.linspace(0, h, points)
    path = 2 * np.arctan(np.tan(0.5) * np.exp(s))
    # The variational equation v' = cos(u) v + z u, v(0) = 0, by the rule of Simpson.
    growth = np.sin(path[-1]) / np.sin(path)
    simpson = np.array([1, *[4, 2] * (points // 2 - 1), 4, 1]) * h / (points - 1) / 3
    expected = np.sum(SPECTRUM) * np.sum(simpson * growth * path)
    # One step: its error is some h^5, relative to h.
    np.testing.assert_allclose(of_scale, expected, rtol=1e-10)


# Other kinds of states and fields.


class Decay(cfjax.AbstractSemilinearField):
    """A class of a user: `x' = rate x + b`, with rates that no transform makes."""

    rate: jax.Array
    b: jax.Array

    def flow(self, point):
        return jnp.exp(self.rate) * point + cfjax.phi(1, self.rate) * self.b

    def tangent(self, point):
        return self.rate * point + self.b

    def functions(self, pairs):
        return [cfjax.phi(k, c * self.rate) for c, k in pairs]

    def times(self, function, x):
        return function * x

    def rest(self, first, point):
        return (self.rate - first.rate) * point + self.b


@pytest.mark.slow
def test_a_semilinear_field_of_a_users_own_class():
    rates = -np.arange(1.0, N + 1)
    y0 = jnp.ones(N)
    ends = [
        cfjax.integrate(cfjax.LieTerm(field), cfjax.ETD54(), 0.0, 1.0, y0, num_steps=3).ys[-1]
        for field in (
            lambda t, u, args: Decay(rates + 0.1 * t, jnp.sin(u)),
            lambda t, u, args: cfjax.Affine(jnp.sin(u) + 0.1 * t * u, rates),
        )
    ]
    # Two ways to split one velocity, with an error of 1e-7 each.
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-6)


def test_a_sum_of_terms_with_linear_parts():
    """The sum of two terms is one field."""
    y0, solver = jnp.ones(N), cfjax.ExponentialRungeKutta(SECOND_ORDER)
    linear = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.zeros(N), SPECTRUM, SINE))
    rest = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.sin(u), SPECTRUM, SINE, alpha=0.0))
    both = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.sin(u), SPECTRUM, SINE))
    ends = [
        cfjax.integrate(term, solver, 0.0, 0.1, y0, num_steps=2).ys[-1]
        for term in (diffrax.MultiTerm(linear, rest), both)
    ]
    # A few units of rounding.
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_single_precision_and_batches():
    """To rounding of float32, in a batch over the start and a parameter."""

    def end(y0, nu, dtype):
        spectrum = nu * jnp.asarray(SPECTRUM, dtype)
        term = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.sin(u), spectrum, SINE))
        return cfjax.integrate(term, cfjax.ETD54(), 0.0, 1.0, y0, num_steps=10).ys[-1]

    starts, nus = np.linspace(0.5, 1.5, 3 * N).reshape(3, N), np.array([0.01, 0.1, 1.0])
    found, exact = (
        jax.vmap(functools.partial(end, dtype=dtype))(
            jnp.asarray(starts, dtype), jnp.asarray(nus, dtype)
        )
        for dtype in (jnp.float32, jnp.float64)
    )
    assert found.dtype == jnp.float32
    # Some units of each of ten steps.
    np.testing.assert_allclose(found, exact, rtol=0, atol=30 * 6e-8 * 1.5)
    for k in range(3):
        np.testing.assert_allclose(exact[k], end(jnp.asarray(starts[k]), nus[k], float), rtol=1e-13)


# Errors.


def test_what_is_refused(subtests, no_shape_hook):
    def field(t, y, args):
        grid = cfjax.Affine(y["grid"], SPECTRUM, SINE)
        return {"grid": grid, "attitude": cfjax.Rotation(y["attitude"])}

    y0 = {"grid": jnp.ones(N), "attitude": jnp.array([1.0, 0.0, 0.0])}
    path = diffrax.VirtualBrownianTree(0.0, 1.0, 0.05, (N,), jax.random.key(0))
    noise = cfjax.LieControlTerm(lambda t, y, args, dw: dw, path)
    drift = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.sin(u), SPECTRUM, SINE))
    refused = r"ETD43 takes fields .* For y\['attitude'\] the .*CF4"
    driven = "ETD43 does not support noise or other path-driven terms"
    for error, match, term, start, step_back in [
        (TypeError, refused, cfjax.LieTerm(field), y0, False),
        (TypeError, driven, diffrax.MultiTerm(drift, noise), y0["grid"], False),
        (ValueError, "step_back", drift, y0["grid"], True),
    ]:
        options = dict(num_steps=2, step_back=step_back)
        with subtests.test(case=match), pytest.raises(error, match=match):
            cfjax.integrate(term, cfjax.ETD43(), 0.0, 1.0, start, **options)
    with pytest.raises(ValueError, match="estimate must be 'group' or None, got 'algebra'"):
        cfjax.ETD43(estimate="algebra")  # pyright: ignore[reportArgumentType]
