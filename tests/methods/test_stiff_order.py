"""Orders of exponential Runge-Kutta methods: those in print, ours, and what a wrong digit does."""

from fractions import Fraction as F

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


@pytest.mark.parametrize("name", PUBLISHED)
def test_orders_of_known_methods(name):
    tableau, expected = PUBLISHED[name]
    assert orders(tableau) == expected


@pytest.mark.parametrize(
    "solver, expected, embedded",
    [
        (cfjax.ETDRK4(), (2, 4), None),
        (cfjax.ETD43(), (4, 4), (3, 3)),
        (cfjax.ETD54(), (5, 5), (4, 4)),
    ],
)
def test_orders_of_named_methods(solver, expected, embedded):
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


@pytest.mark.parametrize("solver", [cfjax.ETDRK4(), cfjax.ETD43(), cfjax.ETD54()])
def test_output_is_of_order_one_less(solver):
    """Its polynomial reproduces powers of the time, as far as that order asks."""
    tableau = solver.tableau
    order = 4 if isinstance(solver, cfjax.ETD54) else 3
    for power in range(1, order):
        for m, weights in enumerate(tableau.powers, 1):
            found = sum(w * tableau.c[j - 1] ** power for j, w in weights)
            assert found == (m == power)


@pytest.mark.parametrize(
    "make, text",
    [
        (lambda T: T([HALF], {}, {}), "c must begin with the node 0"),
        (lambda T: T([0, 1], {2: {2: {1: 1}}}, {}), r"a\[2\] must have columns 2 to 1, got column"),
        (lambda T: T([0, 1], {3: {}}, {}), "a must have rows of stages 2 to 2, got row 3"),
        (lambda T: T([0, 1], {}, {2: {6: 1}}), r"b\[2\] must be made of phi_1 to phi_5, got phi_6"),
        (lambda T: T([0, 1], {}, {2: {(2, HALF): 1}}), "b must be made only of phi_2"),
        (lambda T: T([0, 1], {}, {2: {1: 1}}), "b must be made only of phi_2"),
        (lambda T: T([0, 1], {}, {3: {2: 1}}), "b must have columns 2 to 2, got column 3"),
    ],
)
def test_tableaus_that_are_none(make, text):
    with pytest.raises(ValueError, match=text):
        make(cfjax.ExponentialTableau)


def test_coefficients_are_exact(no_shape_hook):
    with pytest.raises(TypeError, match=r"b\[2\]\[2\] must be an int or a Fraction, got 0.5"):
        cfjax.ExponentialTableau([0, 1], {}, {2: {2: 0.5}})
    with pytest.raises(TypeError, match=r"tableau must be a cfjax\.ExponentialTableau"):
        cfjax.stiff_order(cfjax.CF4.tableau)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"tableau must be a cfjax\.ExponentialTableau"):
        cfjax.stiff_order(diffrax.Dopri5.tableau)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"tableau must be a cfjax\.Tableau"):
        cfjax.order("CF4")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"tableau must be a cfjax\.ExponentialTableau"):
        cfjax.ExponentialRungeKutta(cfjax.CF4.tableau)  # pyright: ignore[reportArgumentType]
