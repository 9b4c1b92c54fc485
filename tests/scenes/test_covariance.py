"""The covariance of a filter: its closed form, and that it stays positive definite."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import cfjax
from cfjax.scenes import covariance

TERM = cfjax.LieTerm(covariance.field)
PLAIN = cfjax.LieTerm(covariance.velocity)
SEEN = covariance.Track(lost=np.inf, found=np.inf)
HIDDEN = covariance.Track(lost=-np.inf, found=np.inf)


def matrices(t, args, sees):
    """A, Q and S once more, by the directions along and across, in NumPy."""
    across = np.array([np.cos(args.rate * t), np.sin(args.rate * t)])
    along = np.array([-across[1], across[0]])
    a, q, s = np.zeros((3, 4, 4))
    a[:2, 2:] = np.eye(2)
    a[2:, 2:] -= args.drag_across * np.outer(across, across)
    a[2:, 2:] -= args.drag_along * np.outer(along, along)
    q[2:, 2:] = args.noise * np.eye(2)
    if sees:
        s[:2, :2] = np.outer(across, across) / args.range + np.outer(along, along) / args.bearing
    return a, q, s


def by_dop853(start, args, *pieces):
    """From one end of a piece to the next, each with whether the radar sees the ship."""
    y = np.ravel(start)

    def rate(t, flat, sees):
        (a, q, s), p = matrices(t, args, sees), flat.reshape(4, 4)
        return np.ravel(a @ p + p @ a.T + q - p @ s @ p)

    for begin, end, sees in pieces:
        options = dict(method="DOP853", rtol=1e-13, atol=1e-15)
        y = solve_ivp(rate, (begin, end), y, args=(sees,), **options).y[:, -1]
    return y.reshape(4, 4)


def steps_of(term, solver):
    """The states after each step: one program for all starts, ends, steps and tracks."""
    step = jax.jit(lambda *given: problems.first_step(solver, term, *given)[0])

    def run(t1, num_steps, start, args):
        times, ys = np.linspace(0.0, t1, num_steps + 1), [np.asarray(start)]
        for t, end in pairwise(times):
            ys.append(np.asarray(step(t, end, ys[-1], args)))
        return np.stack(ys[1:])

    return run


# With its estimate it would carry a field from step to step, which takes longer to compile.
CF3 = steps_of(TERM, cfjax.CF3(estimate=None))
# On arrays CF3 is a Runge-Kutta method of order 3.
RK3 = steps_of(PLAIN, cfjax.CF3(estimate=None))


def test_the_closed_form_against_dop853():
    args = covariance.Track(lost=1.5, found=3.0)
    pieces = [(0.0, 1.5, True), (1.5, 3.0, False), (3.0, 4.0, True)]
    want = by_dop853(covariance.y0(), args, *pieces)
    # Hundreds of steps with a tolerance of 1e-13.
    found = covariance.reference(4.0, covariance.y0(), args)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-13)
    middle = by_dop853(covariance.y0(), args, *pieces[:1])
    found = covariance.reference(np.array([[0.0, 1.5], [4.0, 3.0]]), covariance.y0(), args)
    # In other pieces, which are exact to rounding.
    np.testing.assert_allclose(found[0, 1], middle, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found[1, 0], want, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(found[0, 0], covariance.y0())


def test_in_the_end_the_filter_solves_the_algebraic_riccati_equation():
    # In axes that turn with the ship. Of the start e^(-2 * 0.3 * 60) is left, 2e-16.
    a, q, s = matrices(0.0, SEEN, True)
    spin = np.kron(np.eye(2), [[0, -SEEN.rate], [SEEN.rate, 0]])
    root = np.sqrt(np.diag(s)[:2])
    c = np.eye(4)[:, :2] * root
    p = solve_continuous_are((a - spin).T, c, q, np.eye(2))
    # After one round the axes are where they were.
    found = covariance.reference(60.0, covariance.y0(2.0), SEEN)
    # SciPy's solution has lost some digits.
    np.testing.assert_allclose(found, p, rtol=0, atol=1e-12)


def test_order():
    start = covariance.y0()
    # Riccati's equation, and Lyapunov's.
    for args, t1, n in ((SEEN, 5.0, 80), (HIDDEN, 20.0, 80)):
        exact = covariance.reference(t1, start, args)
        errors = [np.abs(CF3(t1, k, start, args)[-1] - exact).max() for k in (n, 2 * n)]
        # Order 3 gives 8, but for terms of the next order, which have not gone yet.
        assert 6.5 < errors[0] / errors[1] < 9.5
        assert errors[1] < 1e-6


def test_definite_where_a_runge_kutta_method_in_plain_space_is_not():
    for args, t1, deviation in (
        (SEEN, 5.0, 2.0),
        (HIDDEN._replace(drag_across=10.0), 20.0, 0.5),
    ):
        start = covariance.y0(deviation)
        for n in (5, 20, 80):
            ys = CF3(t1, n, start, args)
            assert np.all(covariance.smallest(ys) > 0)
            np.testing.assert_array_equal(ys, np.swapaxes(ys, 1, 2))
            # What is indefinite runs away, in the end to NaN.
            assert np.any(covariance.smallest(RK3(t1, n, start, args)) < 0)
        # With short steps it is, so what fails is the method.
        assert np.all(covariance.smallest(RK3(t1 / 10, 200, start, args)) > 0)


@pytest.mark.slow
def test_josephs_form_is_safe_with_order_2_alone():
    def joseph(t, y, args):
        a, q, s = covariance._coefficients(t, y, args)
        return cfjax.Congruence(a - y @ s, q + y @ s @ y)

    y, term = jnp.asarray(covariance.y0(2.0)), cfjax.LieTerm(joseph)
    exact = covariance.reference(5.0, covariance.y0(2.0), SEEN)
    ours, joseph2 = steps_of(TERM, cfjax.CF2()), steps_of(term, cfjax.CF2())
    for n in (5, 20, 80):
        ys = joseph2(5.0, n, y, SEEN)
        assert np.all(covariance.smallest(ys) > 0)
        off = np.abs(ours(5.0, n, y, SEEN)[-1] - exact).max()
        assert np.abs(ys[-1] - exact).max() < off / 3
    assert not np.all(covariance.smallest(steps_of(term, cfjax.CF4())(5.0, 20, y, SEEN)) > 0)


def test_the_velocity_is_that_of_the_field():
    def both(t, y, args):
        return covariance.velocity(t, y, args), covariance.field(t, y, args).tangent(y)

    y, both = covariance.reference(1.0, covariance.y0(), SEEN), jax.jit(both)
    for t, args in ((1.0, SEEN), (2.0, HIDDEN)):
        a, q, s = matrices(t, args, args is SEEN)
        want = a @ y + y @ a.T + q - y @ s @ y
        for found in both(t, y, args):
            # Sums of a dozen terms of size 1.
            np.testing.assert_allclose(found, want, rtol=0, atol=1e-15)
