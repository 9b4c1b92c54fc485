"""Orders of exponential Runge-Kutta methods: those in print, ours, and what a wrong digit does."""

from fractions import Fraction as F
from typing import Any

import diffrax
import pytest

import cfjax

HALF = F(1, 2)
# Hochbruck & Ostermann (2005), equation (5.19): the last row but for its column 4.
_ROW = {2: HALF, 3: -HALF, (2, 1): F(1, 4), (3, 1): -1}
PUBLISHED = {
    # Cox & Matthews (2002).
    "Cox-Matthews": (
        cfjax.ExponentialTableau(
            c=[0, HALF, HALF, 1],
            a={3: {2: {1: HALF}}, 4: {3: {(1, HALF): 1}}},
            b={2: {2: 2, 3: -4}, 3: {2: 2, 3: -4}, 4: {2: -1, 3: 4}},
        ),
        (2, 4),
    ),
    # Krogstad (2005).
    "Krogstad": (
        cfjax.ExponentialTableau(
            c=[0, HALF, HALF, 1],
            a={3: {2: {2: 1}}, 4: {3: {2: 2}}},
            b={2: {2: 2, 3: -4}, 3: {2: 2, 3: -4}, 4: {2: -1, 3: 4}},
        ),
        (3, 4),
    ),
    "Hochbruck-Ostermann": (
        cfjax.ExponentialTableau(
            c=[0, HALF, HALF, 1, HALF],
            a={
                3: {2: {2: 1}},
                4: {2: {2: 1}, 3: {2: 1}},
                5: {2: _ROW, 3: _ROW, 4: {2: -F(1, 4), 3: HALF, (2, 1): -F(1, 4), (3, 1): 1}},
            },
            b={4: {2: -1, 3: 4}, 5: {2: 4, 3: -8}},
        ),
        (4, 4),
    ),
    # The exponential midpoint rule in this form, of stiff order 2.
    "two stages": (cfjax.ExponentialTableau([0, HALF], {}, {2: {2: 2}}), (2, 2)),
    # Radau's nodes with a line through stages 1 and 2; and the same quadrature for z = 0 alone.
    "three stages": (
        cfjax.ExponentialTableau([0, F(1, 3), F(2, 3)], {3: {2: {2: F(4, 3)}}}, {3: {2: F(3, 2)}}),
        (3, 3),
    ),
    "three stages, weakly": (
        cfjax.ExponentialTableau([0, F(1, 3), F(2, 3)], {3: {2: {2: F(4, 3)}}}, {3: {3: F(9, 2)}}),
        (2, 2),
    ),
    "Euler": (cfjax.ExponentialTableau([0], {}, {}), (1, 1)),
}


def orders(tableau):
    return cfjax.stiff_order(tableau), cfjax.order(tableau)


def test_orders_of_known_and_of_named_methods(subtests):
    for name, (tableau, expected) in PUBLISHED.items():
        with subtests.test(name=name):
            assert orders(tableau) == expected
    for solver, expected, embedded in (
        (cfjax.ETDRK4(), (2, 4), None),
        (cfjax.ETD43(), (4, 4), (3, 3)),
        (cfjax.ETD54(), (5, 5), (4, 4)),
    ):
        with subtests.test(name=type(solver).__name__):
            assert orders(solver.tableau) == expected
            # What a solve takes from a table.
            assert solver.order(None) == expected[1]
            if embedded is not None:
                assert orders(solver.tableau.embedded_method) == embedded
                assert solver.error_order(None) == embedded[1] + 1


@pytest.mark.parametrize("solver", [cfjax.ETD43(), cfjax.ETD54()])
def test_every_coefficient_counts(solver):
    """A coefficient that is wrong by a billionth costs an order."""
    tableau = solver.tableau
    rows = {i: dict(row) for i, row in enumerate(tableau.a, 1) if row}
    for place, row in [*rows.items(), ("b", dict(tableau.b))]:
        for j, terms in row.items():
            for n, (k, c, weight) in enumerate(terms):
                changed = {(k, c): w for k, c, w in terms}
                changed[k, c] = weight + F(1, 10**9)
                new = {
                    i: {m: {(k, c): w for k, c, w in t} for m, t in r.items()}
                    for i, r in rows.items()
                }
                end = {m: {(k, c): w for k, c, w in t} for m, t in tableau.b}
                (end if place == "b" else new[place])[j] = changed
                wrong = cfjax.ExponentialTableau(tableau.c, new, end)
                assert cfjax.stiff_order(wrong) < cfjax.stiff_order(tableau), (place, j, n)


def test_output_is_of_order_one_less():
    """Its polynomial reproduces powers of the time, as far as that order asks."""
    for solver, order in ((cfjax.ETDRK4(), 3), (cfjax.ETD43(), 3), (cfjax.ETD54(), 4)):
        tableau = solver.tableau
        for power in range(1, order):
            for m, weights in enumerate(tableau.powers, 1):
                found = sum(w * tableau.c[j - 1] ** power for j, w in weights)
                assert found == (m == power), (solver, power, m)


def test_tableaus_that_are_none_and_coefficients_that_are_not_exact(no_shape_hook, subtests):
    api: Any = cfjax
    exponential = r"tableau must be a cfjax\.ExponentialTableau"
    others = cfjax.CF4.tableau, diffrax.Dopri5.tableau
    values = (
        ((HALF,), {}, {}, "c must begin with the node 0"),
        ((0, 1), {2: {2: {1: 1}}}, {}, r"a\[2\] must have columns 2 to 1, got column"),
        ((0, 1), {3: {}}, {}, "a must have rows of stages 2 to 2, got row 3"),
        ((0, 1), {}, {2: {6: 1}}, r"b\[2\] must be made of phi_1 to phi_5, got phi_6"),
        ((0, 1), {}, {2: {(2, HALF): 1}}, "b must be made only of phi_2"),
        ((0, 1), {}, {2: {1: 1}}, "b must be made only of phi_2"),
        ((0, 1), {}, {3: {2: 1}}, "b must have columns 2 to 2, got column 3"),
    )
    types = (
        (
            r"b\[2\]\[2\] must be an int or a Fraction, got 0.5",
            api.ExponentialTableau,
            [0, 1],
            {},
            {2: {2: 0.5}},
        ),
        *((exponential, api.stiff_order, other) for other in others),
        (r"tableau must be a cfjax\.Tableau", api.order, "CF4"),
        (exponential, api.ExponentialRungeKutta, others[0]),
    )
    for c, a, b, text in values:
        with subtests.test(case=text), pytest.raises(ValueError, match=text):
            api.ExponentialTableau(c, a, b)
    for text, call, *arguments in types:
        with subtests.test(case=text), pytest.raises(TypeError, match=text):
            call(*arguments)
