"""The Stiefel scenes: the numbers of an independent program, orders, flops and gradients."""

import jax
import numpy as np
import problems
import pytest

import cfjax
from cfjax.scenes import stiefel

FIELDS = {"first": stiefel.first, "second": stiefel.second}


def arguments(problem, n, p=4):
    return stiefel.diagonals(n, p) if problem == "first" else None


def test_initial_value():
    # The first row for n = 100 from the independent program, with 13 decimals.
    row = (0.0766161898476, -0.0581921942222, -0.1406749262004, -0.0937863007163)
    y = stiefel.y0(100)
    np.testing.assert_allclose(y[0], row, rtol=0, atol=1e-13)
    np.testing.assert_allclose(y.T @ y, np.eye(4), rtol=0, atol=1e-14)


@jax.jit
def velocities(y, args):
    return stiefel.first(0.0, y, args).tangent(y), stiefel.second(0.0, y).tangent(y)


@pytest.mark.parametrize("n, p", [(5, 4), (9, 2)])
def test_frozen_fields_are_the_equations(n, p):
    """The matrices as the paper has them, entry by entry."""
    y = np.linalg.qr(np.random.default_rng(0).standard_normal((n, p)))[0]
    d, c = np.diag(1 + np.arange(n) / n), np.diag(-3 - np.arange(p) / p)
    np.testing.assert_allclose(np.diag(d), stiefel.diagonals(n, p)[0])
    np.testing.assert_allclose(np.diag(c), stiefel.diagonals(n, p)[1])
    g = d @ y @ c
    first, second = velocities(y, stiefel.diagonals(n, p))
    np.testing.assert_allclose(first, (g @ y.T - y @ g.T) @ y, rtol=0, atol=1e-13)

    big = np.zeros((n, n))
    for i in range(n - 1):
        big[i, i + 1] = (1 + sum(y[j, j] for j in range(p))) * (i + 1)
        big[i + 1, i] = -big[i, i + 1]
    lower = np.tril((big @ y)[:p], -1)
    s = np.zeros((n, n))
    s[:p, :p] = lower - lower.T
    s[p:, :p] = y[: n - p]
    s[:p, p:] = -y[: n - p].T
    np.testing.assert_allclose(second, s @ y, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("problem", FIELDS)
def test_reference_and_method_give_the_tabulated_numbers(problem):
    rows, total = stiefel.tabulated[problem]
    term, args = cfjax.LieTerm(FIELDS[problem]), arguments(problem, 100)
    solved = cfjax.integrate(term, cfjax.CF4(), 0.0, 1.0, stiefel.y0(100), args, num_steps=1024)
    # The table has 13 decimals. CF4's error is 3e-9 with 64 steps, of order 4: 4e-14 with 1024.
    for y in (stiefel.reference(problem, 100), np.asarray(solved.ys[-1])):
        np.testing.assert_allclose(y[:2], rows, rtol=0, atol=5e-13)
        np.testing.assert_allclose(y.sum(), total, rtol=0, atol=2e-12)


@pytest.mark.representatives(1)
@pytest.mark.parametrize("problem", FIELDS)
def test_order(problem):
    """The slope over h = 1/16 to 1/128, with the smallest error far above the reference's."""
    n, p = 12, 3
    steps = (16, 32, 64, 128)
    found = problems.errors(
        FIELDS[problem],
        cfjax.CF3(),
        1.0,
        stiefel.y0(n, p),
        arguments(problem, n, p),
        stiefel.reference(problem, n, p).ravel(),
        steps,
    )
    assert found.min() > 1e-12
    assert abs(problems.slope(steps, found) - 3) < 0.15
