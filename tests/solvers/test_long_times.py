"""Symplectic methods against motions that are known: their errors over long times, and invariants.

A symplectic method of order p solves a system near by, with a period that is off by h^p. So the
error grows as t h^p, where that of other methods grows as its square, with their energy.
"""

import itertools
from functools import partial
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import problems
import pytest
from scipy.special import ellipj

import cfjax

EPS = 2.0**-52
PAGE = Path(__file__).parents[2] / "docs" / "recipes" / "hmc.md"


def all_terms(*fields: Any) -> Any:
    return diffrax.MultiTerm(*map(cfjax.LieTerm, fields))


def of_the_page(name: str) -> Any:
    """A method of which the page shows the coefficients."""
    (block,) = (b for b in PAGE.read_text().split("```") if "def symmetric" in b)
    names: dict[str, Any] = {"cfjax": cfjax}
    exec(block.removeprefix("python"), names)
    return names[name]


def twice(term, solver, t1, y0, num_steps, save_every=1, args=None) -> list[Any]:
    """Times and states to t1, and with half the step to t1 / 2: the same number, so one program."""
    y0 = problems.arrays(y0)
    found = []
    for end in (t1, t1 / 2):
        solution = cfjax.integrate(
            term, solver, 0.0, end, y0, args, num_steps=num_steps, save_every=save_every
        )
        found.append((np.asarray(solution.ts), jax.tree.map(np.asarray, solution.ys)))
    return found


def growth(runs, error) -> tuple[float, float]:
    """The observed order at t1 / 2, and how much larger the error is at t1.

    The errors are the largest of a tenth of the time to t1, which has a period or more.
    """
    (ts, ys), (fine_ts, fine_ys) = runs
    coarse, fine, t1 = error(ts, ys), error(fine_ts, fine_ys), ts[-1]
    is_early = (ts > 0.4 * t1) & (ts <= 0.5 * t1 * (1 + EPS))
    early, late = coarse[is_early].max(), coarse[ts > 0.9 * t1].max()
    return np.log2(early / fine[fine_ts > 0.4 * t1].max()), late / early


def assert_linear(runs, error, order):
    slope, factor = growth(runs, error)
    # The next terms of the error are smaller by the square of the step.
    assert order - 0.1 < slope < order + 0.1
    # 2, but for the part of the error that only goes to and fro.
    assert 1.8 < factor < 2.2


# A free rigid body: m' = m x w, in Jacobi's elliptic functions.

BODY = np.array([0.5, 0.0, 1.0])


def spin(axis):
    return lambda t, m, inertia: cfjax.Rotation(-jnp.eye(3)[axis] * m / inertia)


AXES = all_terms(spin(0), spin(1), spin(2))
WHOLE = cfjax.LieTerm(problems.rigid_body)


def body_at(t):
    """Landau & Lifshitz, Mechanics, section 37, for a start in the plane of the axes 1 and 3."""
    (a, b, c), energy, square = (
        problems.INERTIA,
        np.sum(BODY**2 / problems.INERTIA),
        np.sum(BODY**2),
    )
    # It goes round the third axis.
    assert square > energy * b
    rate = np.sqrt((c - b) * (square - energy * a) / (a * b * c))
    parameter = (b - a) * (energy * c - square) / ((c - b) * (square - energy * a))
    middle = np.sqrt(b * (energy * c - square) / (c - b))
    sn, cn, dn, _ = ellipj(rate * t, parameter)
    return np.stack([BODY[0] * cn, middle * sn, BODY[2] * dn], axis=-1)


def off_body(ts, ys):
    return np.abs(ys - body_at(ts)).max(axis=1)


@pytest.mark.parametrize(
    "term, solver, order",
    [
        (WHOLE, cfjax.ImplicitMidpoint(), 2),
        pytest.param(AXES, cfjax.Strang(), 2, marks=pytest.mark.slow),
        pytest.param(AXES, cfjax.BlanesMoan6(), 6, marks=pytest.mark.slow),
        pytest.param(
            WHOLE, cfjax.Composition(cfjax.ImplicitMidpoint(), 4), 4, marks=pytest.mark.slow
        ),
    ],
    ids=["midpoint", "Strang", "BlanesMoan6", "Composition"],
)
def test_a_free_body_for_fifty_periods(term, solver, order):
    runs = twice(term, solver, 1000.0, BODY, 4000, 4, problems.arrays(problems.INERTIA))
    assert_linear(runs, off_body, order)
    for _, ys in runs:
        # The increments of the steps are summed with compensation.
        np.testing.assert_allclose(np.sum(ys**2, axis=1), 1.25, rtol=8 * EPS)


@pytest.mark.slow
def test_the_error_of_a_method_that_is_not_symplectic_grows_as_the_square():
    runs = twice(WHOLE, cfjax.CF4(), 1000.0, BODY, 4000, 4, problems.arrays(problems.INERTIA))
    assert 3.8 < growth(runs, off_body)[1] < 4.2


# Kovalevskaya's top, in the body's frame: inertia 1, 1, 1/2, and g is the upward direction, with a
# potential g1. With z = m1 + i m2 and c = g1 + i g2, (z^2 - 2 c)' = -2 i m3 (z^2 - 2 c).

INVERSE = np.array([1.0, 1.0, 2.0])


def pull(t, y, args):
    g = y["g"]
    return {"m": jnp.stack([jnp.zeros_like(g[0]), g[2], -g[1]]), "g": None}


def spherical_in_the_body(t, y, args):
    return {"m": None, "g": cfjax.Rotation(-y["m"])}


def axial_in_the_body(t, y, args):
    w = np.array([0.0, 0.0, 1.0]) * y["m"]
    return {"m": cfjax.Rotation(-w), "g": cfjax.Rotation(-w)}


def kovalevskaya(y):
    """The energy, and the square of the modulus of z^2 - 2 c."""
    m, g = y["m"], y["g"]
    z, c = m[..., 0] + 1j * m[..., 1], g[..., 0] + 1j * g[..., 1]
    return np.stack([np.sum(INVERSE * m**2, -1) / 2 + g[..., 0], np.abs(z**2 - 2 * c) ** 2], -1)


@pytest.mark.parametrize(
    "solver, order, step",
    [
        (cfjax.Strang(), 2, 0.1),
        pytest.param(cfjax.BlanesMoan4(), 4, 0.2, marks=pytest.mark.slow),
    ],
    ids=["Strang", "BlanesMoan4"],
)
def test_both_invariants_of_kovalevskaya_stay_in_a_band(solver, order, step):
    term = all_terms(pull, spherical_in_the_body, axial_in_the_body)
    start = {"m": np.array([0.6, 0.5, 0.4]), "g": np.array([0.48, 0.6, 0.64])}
    runs = twice(term, solver, 10_000 * step, start, 10_000, 2)
    bands = []
    for _, ys in runs:
        off = np.abs(kovalevskaya(ys) - kovalevskaya(start)).reshape(5, 1000, 2).max(axis=1)
        bands.append(off.max(axis=0))
        # A fifth of the time has hundreds of periods, so all maxima are of the same band; those of
        # CF4 are 1.6 to 5 times as large in the last fifth as in the first.
        assert np.all(off.max(axis=0) < 1.15 * off.min(axis=0))
        # The Casimirs: a random walk of the roundings of 10 000 steps, some 1e-14.
        np.testing.assert_allclose(np.sum(ys["g"] ** 2, axis=1), 1, rtol=0, atol=2e-14)
        product = np.sum(ys["m"] * ys["g"], axis=1)
        np.testing.assert_allclose(product, 0.6 * 0.48 + 0.5 * 0.6 + 0.4 * 0.64, rtol=0, atol=5e-14)
    slopes = np.log2(bands[0] / bands[1])
    # The next terms are smaller by the square of the step; a maximum has 3 per cent of scatter.
    assert np.all((order - 0.15 < slopes) & (slopes < order + 0.15))


# One step of an oscillator, q' = p and p' = -q, as a product of matrices of the published numbers.

PUBLISHED = {
    # Blanes & Moan, J. Comput. Appl. Math. 142 (2002): S6 and S10 of Table 2, 11b of Table 3. Those
    # of the outer term, those of the inner one, and what follows from the sum 1 is the middle.
    "BlanesMoan4": (
        "0.0792036964311957 0.353172906049774 -0.0420650803577195",
        "0.209515106613362 -0.143851773179818",
    ),
    "BlanesMoan6": (
        "0.0502627644003922 0.413514300428344 0.0450798897943977 -0.188054853819569"
        " 0.541960678450780",
        "0.148816447901042 -0.132385865767784 0.067307604692185 0.432666402578175",
    ),
    "nystrom": (
        "0.0414649985182624 0.198128671918067 -0.0400061921041533 0.0752539843015807"
        " -0.0115113874206879",
        "0.123229775946271 0.290553797799558 -0.127049212625417 -0.246331761062075"
        " 0.357208872795928",
    ),
    # Omelyan, Mryglod & Folk, Comput. Phys. Commun. 151 (2003).
    "minimum_norm": ("0.1931833275037836", ""),
    # Steps of Strang's: Sofroniou & Spaletta (2005), and Kahan & Li (1997).
    "Sofroniou & Spaletta": (
        "0.21375583945878254555518066964857 0.18329381407425713911385974425217"
        " 0.17692819473098943794898811709929 -0.44329082681170215849622829626258"
        " 0.11728560432865935385403585669136",
    ),
    "Kahan & Li": (
        "0.13020248308889008088 0.56116298177510838456 -0.38947496264484728641"
        " 0.15884190655515560090 -0.39590389413323757734 0.18453964097831570709"
        " 0.25837438768632204729 0.29501172360931029887",
    ),
}
# So long that a step depends on each digit.
STEP = 4.0


def palindrome(half, ends_twice):
    """Numbers with sum 1 whose first half is given but for its last: one, or two that are equal."""
    last = [(mp.mpf(1) / 2 - sum(half))] if ends_twice else [1 - 2 * sum(half)]
    return [*half, *last, *(last if ends_twice else []), *reversed(half)]


def published_step(lists):
    """The matrix of a step, from lists of numbers."""
    if len(lists) == 1:
        parts = palindrome(lists[0], False)
        outer = [sum(pair) / 2 for pair in itertools.pairwise([0, *parts, 0])]
        inner = parts
    else:
        # One more of the outer ones; the middle of the step is of the longer half.
        is_inner = len(lists[0]) == len(lists[1])
        outer, inner = palindrome(lists[0], is_inner), palindrome(lists[1], not is_inner)
    step = mp.eye(2)
    for kick, drift in itertools.zip_longest(outer, inner, fillvalue=mp.mpf(0)):
        step = mp.matrix([[1, 0], [-STEP * kick, 1]]) * step
        step = mp.matrix([[1, STEP * drift], [0, 1]]) * step
    return step


OSCILLATOR = all_terms(
    lambda t, y, args: {"q": None, "p": -y["q"]}, lambda t, y, args: {"q": y["p"], "p": None}
)


SOLVERS = {
    "BlanesMoan4": cfjax.BlanesMoan4,
    "BlanesMoan6": cfjax.BlanesMoan6,
    "nystrom": partial(of_the_page, "nystrom"),
    "minimum_norm": partial(of_the_page, "minimum_norm"),
    "Sofroniou & Spaletta": lambda: cfjax.Composition(cfjax.Strang(), 6),
    "Kahan & Li": lambda: cfjax.Composition(cfjax.Strang(), 8),
}


def oscillate(solver, y0):
    return problems.first_step(solver, OSCILLATOR, 0.0, STEP, y0, None)[0]


def test_a_step_has_each_published_digit(subtests):
    start = {"q": jnp.array([1.0, 0.0]), "p": jnp.array([0.0, 1.0])}
    # Up to 35 products of matrices with entries of size ten, each with a rounding.
    atol = 50 * EPS
    for name, make in SOLVERS.items():
        with subtests.test(name=name), mp.workdps(40):
            end = problems.op_by_op(partial(oscillate, make()), start)
            lists = [list(map(mp.mpf, text.split())) for text in PUBLISHED[name]]
            step = published_step(lists)
            found, expected = np.stack([end["q"], end["p"]]), np.array(step.tolist(), float)
            np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
            # A digit that is wrong by 1e-13 is seen, whichever it is.
            for k, numbers in enumerate(lists):
                for j in range(len(numbers)):
                    wrong = [[*x] for x in lists]
                    wrong[k][j] += mp.mpf("1e-13")
                    assert mp.norm(published_step(wrong) - step, mp.inf) > 10 * atol
    # For any terms its order is lower.
    assert of_the_page("nystrom").order(OSCILLATOR) == 4
