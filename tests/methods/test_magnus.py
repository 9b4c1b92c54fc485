"""Coefficients of commutator-free Magnus methods: every word, the nodes, symmetry."""

from math import factorial, prod

import numpy as np
import pytest
from solver_table import solvers

METHODS = solvers("Magnus")
TABLEAUS = {name: row.make().tableau for name, row in METHODS.items()}
# Rounded coefficients in products of floats: sums of some hundred terms, less than one in all.
ROUNDING = 1e-15


def words(degree):
    """All words up to a degree. Letter d stands for `theta^(d-1)`, and has the degree d."""
    found = {0: [()]}
    for n in range(1, degree + 1):
        found[n] = [(d, *word) for d in range(1, n + 1) for word in found[n - d]]
    return [word for n in range(degree + 1) for word in found[n]]


def weights(nodes, rows, degree):
    """The weight of every word in the product of exponentials, of which the first row is first.

    A word's first letter is the factor that is applied last.
    """
    total = {(): 1.0}
    for row in rows:
        moments = [float(np.dot(row, np.power(nodes, m))) for m in range(degree)]
        factor = {
            word: prod(moments[d - 1] for d in word) / factorial(len(word))
            for word in words(degree)
        }
        total = {
            word: sum(factor[word[:i]] * total.get(word[i:], 0.0) for i in range(len(word) + 1))
            for word in factor
        }
    return total


def exact_weight(word):
    """The integral over `1 > t_1 > t_2 > ... > 0` of the letters at these times."""
    weight, degree = 1.0, 0
    for d in reversed(word):
        degree += d
        weight /= degree
    return weight


def defects(nodes, rows, degree, theta=1.0):
    """By degree, the largest defect of a word, at the time theta of the step."""
    found = np.zeros(degree + 1)
    for word, weight in weights(nodes, rows, degree).items():
        off = abs(weight - exact_weight(word) * theta ** sum(word))
        found[sum(word)] = max(found[sum(word)], off)
    return found


def rows_at(tableau, theta):
    powers = theta ** np.arange(1, 1 + len(tableau.nodes))
    return [powers @ np.array(flow) for flow in tableau.continuous_extension]


@pytest.mark.parametrize("name", TABLEAUS)
def test_the_order_and_that_within_a_step_by_every_word(name):
    tableau, row = TABLEAUS[name], METHODS[name]
    found = defects(tableau.nodes, tableau.rows, row.order + 1)
    assert found[: row.order + 1].max() < ROUNDING
    assert found[row.order + 1] > 1e-8
    assert tableau.order == row.order
    for theta in (0.25, 0.9):
        found = defects(tableau.nodes, rows_at(tableau, theta), row.output + 1, theta)
        # The coefficients are up to 3000, of both signs.
        assert found[: row.output + 1].max() < 1e-12
        assert found[row.output + 1] > 1e-9


@pytest.mark.parametrize("name", [name for name, row in METHODS.items() if row.embedded])
def test_the_order_of_the_embedded_method_by_every_word(name):
    tableau, order = TABLEAUS[name], METHODS[name].embedded
    found = defects(tableau.nodes, tableau.embedded, order + 1)
    assert found[: order + 1].max() < ROUNDING
    assert found[order + 1] > 1e-4
    assert tableau.embedded_order == order
    # It sees what quadrature on all nodes does not: a single letter of that degree, or the nodes'
    # own weights would be those of every method.
    other = weights(tableau.nodes, tableau.embedded, order + 1)
    assert abs(other[order + 1,] - exact_weight((order + 1,))) > 1e-4
    # Nor do fields that are linear in time go unseen, as they would if one row alone were another.
    linear = [w for w in words(order + 1) if sum(w) == order + 1 and max(w) == 2]
    ours = weights(tableau.nodes, tableau.rows, order + 1)
    assert max(abs(ours[w] - other[w]) for w in linear) > 1e-7


def test_ends_symmetry_and_sums_of_rows(subtests):
    """How far each flow goes: forwards alone up to order 4, and in embedded methods of those."""
    # As their docstrings say.
    back = {"Magnus6": -0.0936518, "Magnus8": -0.435723, "Magnus10": -0.312166}
    for name, tableau in TABLEAUS.items():
        rows = np.array(tableau.rows)
        with subtests.test(name=name):
            # The continuous extension ends where the step does, and steps back undo steps.
            np.testing.assert_allclose(rows_at(tableau, 1.0), rows, rtol=0, atol=1e-12)
            np.testing.assert_allclose(rows, rows[::-1, ::-1], rtol=0, atol=1e-16)
            nodes = np.add(tableau.nodes, tableau.nodes[::-1])
            np.testing.assert_allclose(nodes, 1, rtol=0, atol=1e-16)
            least = rows.sum(axis=1).min()
            assert least == pytest.approx(back[name], abs=1e-6) if name in back else least > 0
            for some in (tableau.rows, tableau.embedded) if tableau.embedded else (tableau.rows,):
                assert np.sum(some) == pytest.approx(1, abs=ROUNDING)


def test_nodes_of_lobatto():
    for size, name in {3: "Magnus4Lobatto", 5: "Magnus6", 7: "Magnus8", 9: "Magnus10"}.items():
        inner = np.polynomial.Legendre.basis(size - 1).deriv().roots()
        expected = (1 + np.concatenate([[-1.0], np.sort(inner.real), [1.0]])) / 2
        np.testing.assert_allclose(TABLEAUS[name].nodes, expected, rtol=0, atol=1e-14)
        assert TABLEAUS[name].shares_ends


def test_nodes_of_gauss():
    expected = (1 + np.polynomial.legendre.leggauss(3)[0]) / 2
    np.testing.assert_allclose(TABLEAUS["Magnus4"].nodes, expected, rtol=0, atol=1e-15)
    assert TABLEAUS["Magnus2"].nodes == (0.5,)
    assert not TABLEAUS["Magnus4"].shares_ends


def test_rows_that_are_known():
    """Order 4, as their sources print them."""
    third, quarter, twelfth = 1 / 3, 1 / 4, 1 / 12
    lobatto = [[quarter, third, -twelfth], [-twelfth, third, quarter]]
    np.testing.assert_allclose(TABLEAUS["Magnus4Lobatto"].rows, lobatto, rtol=0, atol=1e-16)
    a, b = 37 / 240, 10 * 15**0.5 / 261
    gauss = [
        [a + b, -1 / 30, a - b],
        [-11 / 360, 23 / 45, -11 / 360],
        [a - b, -1 / 30, a + b],
    ]
    np.testing.assert_allclose(TABLEAUS["Magnus4"].rows, gauss, rtol=0, atol=1e-16)
