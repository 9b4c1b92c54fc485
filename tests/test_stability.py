"""Where methods fail: linear stability, large rotations, near-singular tableaus, float32."""

from fractions import Fraction
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import problems
import pytest
from solver_table import named

import cfjax
from cfjax.scenes import rigid_body

RNG = np.random.default_rng(5)


# Linear stability


class Affine(cfjax.AbstractFrozenField):
    """The field `u -> a rate u + b`, entry by entry; `rate` is structure."""

    a: jax.Array
    b: jax.Array
    rate: jax.Array

    def flow(self, point):
        z = self.a.astype(self.rate.dtype) * self.rate
        safe = jnp.where(z == 0, 1, z)
        phi = jnp.where(z == 0, 1, (jnp.exp(safe) - 1) / safe)
        return jnp.exp(z) * point + phi * self.b

    def tangent(self, point):
        return self.a.astype(self.rate.dtype) * self.rate * point + self.b

    @classmethod
    def combine(cls, weights, fields):
        a, b = (
            cfjax.combine(weights, part) for part in zip(*((f.a, f.b) for f in fields), strict=True)
        )
        return cls(a, b, fields[0].rate)


@eqx.filter_jit
def one_step(solver, z, w):
    """A step of size 1 of `u' = z u + w u` from 1 with z in the flow, for arrays of z and w."""

    def field(t, u, args):
        return Affine(jnp.ones(()), args[1] * u, args[0])

    t0, t1 = jnp.zeros(()), jnp.ones(())
    term = cfjax.LieTerm(field)
    return problems.first_step(solver, term, t0, t1, jnp.ones_like(z), (z, w))[0]


def random_tableau():
    alpha = [[], [RNG.normal(size=1)], [RNG.normal(size=2), RNG.normal(size=1)]]
    beta = RNG.normal(size=(3, 3))
    return cfjax.Tableau(alpha, beta / beta.sum())


SOLVERS = [
    cfjax.LieEuler(),
    cfjax.CF4(),
    cfjax.CG5(),
    cfjax.CommutatorFree(cfjax.third_order_b(0.9)),
    cfjax.CommutatorFree(random_tableau()),
]


@pytest.mark.representatives(1)
@pytest.mark.parametrize("solver", SOLVERS[::-1], ids=lambda s: type(s).__name__)
def test_the_tableau_says_what_a_real_step_does(solver):
    z, w = RNG.normal(size=(2, 200)) + 1j * RNG.normal(size=(2, 200))
    z[:2] = 0
    found = cfjax.stability_function(solver.tableau, z, w)
    expected = one_step(solver, jnp.asarray(z), jnp.asarray(w))
    # One polynomial in products of up to 9 numbers of size 3, summed in another order. Where z is
    # small the step's own (exp z - 1) / z loses up to 1 / |z| units.
    scale = np.abs(found).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * scale)


def test_without_an_explicit_part_a_step_is_exact():
    z = np.array([0, -1e-9, -1, -50, 3j, -2 + 5j])
    for solver in SOLVERS:
        found = cfjax.stability_function(solver.tableau, z, 0)
        # At most 43 exponentials, whose exponents of up to 50 are off by a unit of rounding each.
        np.testing.assert_allclose(found, np.exp(z), rtol=43 * 50 * 2.0**-52)


def test_methods_with_flows_backwards_in_time_say_so():
    for row in named("commutator-free", "low-storage").values():
        solver: Any = row.make()
        tableau = solver.tableau
        products = (*tableau.alpha, tableau.beta, tableau.embedded or ())
        sums = [float(sum(row)) for rows in products for row in rows]
        # A sum of zero is rounded.
        backwards = min(sums) < -1e-12
        assert backwards == ("backwards in time" in solver.__doc__), solver
        # exp(1e6) would overflow, and exp(-1e6) is 0.
        assert backwards == (not np.isfinite(cfjax.stability_function(tableau, -1e6, 1.0))), solver


@pytest.mark.slow
@pytest.mark.parametrize("dtype, limit", [("float64", 3000), ("float32", 370)])
def test_how_long_a_step_of_cf54_may_be(dtype, limit):
    """Up to what its docstring says. Behind, error control rejects; CF43 has no such limit."""

    def step(solver, length):
        spectrum = jnp.asarray([-1.0, -100.0], dtype)
        term = cfjax.LieTerm(lambda t, u, args: cfjax.Affine(jnp.cos(u), spectrum))
        times = jnp.zeros((), dtype), jnp.asarray(length / 100, dtype)
        return problems.first_step(solver, term, *times, jnp.ones(2, dtype), None)[:2]

    assert np.isfinite(step(cfjax.CF54(), limit)).all()
    assert np.isnan(step(cfjax.CF54(), 1.03 * limit)[0][1])
    assert np.isnan(step(cfjax.CF54(), 1.03 * limit)[1][1])
    assert np.isfinite(step(cfjax.CF43(), 100 * limit)).all()


def test_without_an_exact_part_it_is_the_classical_polynomial():
    """A method of as many stages as its order has the truncated series of the exponential."""
    w = 3 * (RNG.normal(size=50) + 1j * RNG.normal(size=50))
    for solver, order in [(cfjax.CF2(), 2), (cfjax.CF3(), 3), (cfjax.CF4(), 4)]:
        series = sum(w**k / float(mpmath.factorial(k)) for k in range(order + 1))
        found = cfjax.stability_function(solver.tableau, 0, w)
        np.testing.assert_allclose(found, series, rtol=1e-13)


def test_known_intervals_of_stability():
    """Hairer & Wanner, Solving Ordinary Differential Equations II, Section IV.2."""
    for solver, direction, limit in [
        (cfjax.CF4(), -1, 2.785293563405282),
        (cfjax.CF4(), 1j, np.sqrt(8)),
        (cfjax.CF3(), -1, 2.512745326618329),
        (cfjax.CF3(), 1j, np.sqrt(3)),
    ]:

        def growth(x, solver=solver, direction=direction):
            return np.abs(cfjax.stability_function(solver.tableau, 0, direction * x))

        inside = np.linspace(0, limit * (1 - 1e-9), 1000)
        assert np.all(growth(inside) <= 1 + 1e-15)
        assert np.all(growth(limit * np.array([1 + 1e-9, 1.01, 2])) > 1)


def test_phi_at_small_and_large_arguments():
    """A step of the exponential Euler method is exp(z) + w (exp(z) - 1) / z."""
    z = np.array([1e-300, 1e-17, -1e-9, 1e-5j, 1e-3 + 1e-4j, -1.0, 700j, -1e3, -1e10])
    found = cfjax.stability_function(cfjax.LieEuler.tableau, z, 1.0)
    with mpmath.workdps(40):
        expected = [complex(mpmath.exp(x) + mpmath.expm1(x) / x) for x in map(mpmath.mpc, z)]
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_shapes_and_mistakes():
    tableau = cfjax.CF4.tableau
    assert cfjax.stability_function(tableau, 0, 0).shape == ()
    assert cfjax.stability_function(tableau, np.zeros((3, 1)), np.zeros(4)).shape == (3, 4)
    wrong: Any = cfjax.CF4()
    with pytest.raises(TypeError, match="tableau"):
        cfjax.stability_function(wrong, 0, 0)


# Large rotations


TERM = cfjax.LieTerm(rigid_body.field)
START, INERTIA = jnp.asarray(rigid_body.y0), jnp.asarray(rigid_body.inertia)
LENGTH = np.linalg.norm(rigid_body.y0)


@pytest.mark.representatives(1)
@pytest.mark.parametrize(
    "solver, dtype",
    [(cfjax.CF2(), np.float32), (cfjax.RKMK4(), np.float32), (cfjax.CF4(), np.float64)],
)
def test_large_steps_stay_on_the_sphere(solver, dtype):
    """However large the angle, a rotation is one.

    The commutators of RKMK4 make angles of h^2 / 12, which single precision still resolves for
    h = 100.
    """
    eps = np.finfo(dtype).eps
    y0, args = START.astype(dtype), INERTIA.astype(dtype)
    for h in (0.5, 4.0, 100.0, 1e4)[: 3 if dtype is np.float32 else 4]:
        options = dict(num_steps=64, save_every=1)
        ys = cfjax.integrate(TERM, solver, 0.0, 64 * h, y0, args, **options).ys
        length = np.linalg.norm(np.asarray(ys, float), axis=1)
        # 64 steps of two flows, each with a few roundings: a random walk of 5 sqrt(128) halves.
        assert np.abs(length - LENGTH).max() < 5 * np.sqrt(128) * eps / 2


# Near-singular parameters of the third-order families


# At these the stages 2 and 3, or 1 and 3, come together, and the weights are a difference quotient.
TOGETHER = [
    (cfjax.third_order_a, Fraction(1, 3), Fraction(1, 2)),
    (cfjax.third_order_a, Fraction(0), Fraction(1, 2)),
    (cfjax.third_order_b, Fraction(1, 3), Fraction(1, 3)),
]


def test_weights_grow_and_the_error_constant_does_not():
    for family, singular, residue in TOGETHER:
        constants = []
        for k in (3, 4, 5, 6):
            distance = Fraction(1, 10**k)
            tableau = family(singular + distance)
            assert cfjax.order(tableau) == 3
            largest = max(abs(x) for row in tableau.beta for x in row)
            # The weight is the residue over the distance, plus something bounded.
            assert abs(largest * distance - residue) < 2 * distance
            constants.append(cfjax.error_constant(tableau))
        np.testing.assert_allclose(constants, constants[-1], rtol=2e-3)


def test_a_far_stage_makes_the_error_constant_grow():
    """At alpha = 1 of family B the second stage goes to infinity."""
    for side in (-1, 1):
        constants = []
        for k in (3, 4, 5):
            distance = Fraction(1, 10**k)
            tableau = cfjax.third_order_b(1 + side * distance)
            assert cfjax.order(tableau) == 3
            # c2 = 2 (3 alpha^2 - 3 alpha + 1) / (3 (1 - alpha)), whose residue is 2/3.
            assert abs(abs(tableau.c[1]) * distance - Fraction(2, 3)) < 3 * distance
            constants.append(cfjax.error_constant(tableau) * float(distance))
        # b2 c2^3 is of size 1 / distance.
        np.testing.assert_allclose(constants, constants[-1], rtol=0.01)


# Splittings


KICK = cfjax.LieTerm(lambda t, y, args: {"q": None, "p": -y["q"]})
DRIFT = cfjax.LieTerm(lambda t, y, args: {"q": y["p"], "p": None})


def growth(solver, h):
    """How far 500 steps of q'' = -q come from two starts of length one."""
    term, start = diffrax.MultiTerm(KICK, DRIFT), {"q": jnp.eye(2)[0], "p": jnp.eye(2)[1]}
    options = dict(num_steps=500, save_every=10)
    ys = cfjax.integrate(term, solver, 0.0, jnp.asarray(500 * h), start, **options).ys
    return np.max(np.abs([ys["q"], ys["p"]]))


LAMBDA = 0.1931833275037836  # Omelyan, Mryglod & Folk, doi:10.1016/S0010-4655(02)00754-3


def test_the_longest_step_of_an_oscillator():
    """The trace of a step's matrix is 2 - h^2 + quartic h^4, and a step is stable up to -2."""
    quartic = LAMBDA * (0.5 - LAMBDA)
    limit = np.sqrt(8 / (1 + np.sqrt(1 - 16 * quartic)))
    solver = cfjax.Splitting((LAMBDA, 0.5 - LAMBDA, 0.5 - LAMBDA, LAMBDA))
    # Close to the limit the ellipse of a stable orbit is long, by the inverse root of the distance.
    assert growth(solver, 0.999 * limit) < 100
    # Beyond it a step grows by more than one in twenty.
    assert growth(solver, 1.001 * limit) > 1.05**500
