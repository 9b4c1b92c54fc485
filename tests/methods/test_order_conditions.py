"""The order conditions, and what they decide: orders, constants, coefficients within a step."""

import math
import random
from fractions import Fraction
from functools import lru_cache

import diffrax
import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from solver_table import COMMUTATOR_FREE, MUNTHE_KAAS
from solver_table import named as named_solvers

import cfjax
from cfjax import Tableau, error_constant, order, third_order_a, third_order_b
from cfjax._methods.continuous_extension import continuous_extension, runge_kutta_extension
from cfjax._methods.order_conditions import (
    exact_tree_weight,
    exact_weight,
    runge_kutta_order,
    trees,
    words,
)
from cfjax._methods.tableau import crouch_grossman

HALF = Fraction(1, 2)
THIRD = Fraction(1, 3)
LIE_EULER, CF2, CF3, CF4, CG3, CG4, CG5 = (
    getattr(cfjax, name)().tableau
    for name in ("LieEuler", "CF2", "CF3", "CF4", "CG3", "CG4", "CG5")
)

ORDERS = {
    name: (row.make().tableau, row.order) for name, row in named_solvers("commutator-free").items()
}
CK54, YRK135 = cfjax.CK54().tableau, cfjax.YRK135().tableau


def as_floats(tableau):
    alpha = [[list(map(float, row)) for row in rows] for rows in tableau.alpha]
    return Tableau(alpha, [list(map(float, row)) for row in tableau.beta])


def reversed_composition(tableau):
    return Tableau([rows[::-1] for rows in tableau.alpha], tableau.beta[::-1])


def row_sums(tableau):
    """The Runge-Kutta method that the tableau becomes in a linear space."""

    def collapse(rows, length):
        return [sum(row[k] for row in rows) for k in range(length)]

    a = [collapse(rows, r) for r, rows in enumerate(tableau.alpha)][1:]
    return a, collapse(tableau.beta, tableau.num_stages)


def nonzero_places(tableau):
    for r, rows in enumerate((*tableau.alpha, tableau.beta)):
        for j, row in enumerate(rows):
            yield from ((r, j, k) for k, entry in enumerate(row) if entry)


def changed(tableau, place, amount):
    """With one coefficient changed; in beta another makes up for it, to remain consistent."""
    products = [[list(row) for row in rows] for rows in (*tableau.alpha, tableau.beta)]
    r, j, k = place
    products[r][j][k] += amount
    if r == tableau.num_stages:
        j, k = next((j, k) for q, j, k in nonzero_places(tableau) if q == r and (r, j, k) != place)
        products[r][j][k] -= amount
    return Tableau(products[:-1], products[-1])


# The conditions themselves


def test_number_of_words_and_trees():
    assert [len(words(n)) for n in range(8)] == [1, 1, 2, 5, 14, 42, 132, 429]
    assert [len(trees(n)) for n in range(1, 10)] == [1, 1, 2, 4, 9, 20, 48, 115, 286]
    for n in range(7):
        assert len(set(words(n))) == len(words(n))


def test_words_of_order_three():
    dot, line = (), ((),)
    assert set(words(3)) == {
        (dot, dot, dot),
        (dot, line),
        (line, dot),
        ((dot, dot),),
        ((line,),),
    }


def test_exact_weights():
    dot, line = (), ((),)
    assert exact_weight((dot, dot, dot)) == Fraction(1, 6)
    assert exact_weight((line,)) == HALF
    # They differ: this is what a reversed composition gets wrong.
    assert exact_weight((dot, line)) == THIRD
    assert exact_weight((line, dot)) == Fraction(1, 6)
    assert exact_tree_weight((dot, dot)) == THIRD
    assert exact_tree_weight((line,)) == Fraction(1, 6)


def test_exact_tree_weights_follow_from_the_words():
    # A tree in a linear space gathers the ordered trees that are equal to it.
    def unordered(tree):
        return tuple(sorted(map(unordered, tree)))

    def symmetry(tree):
        repeats = [tree.count(child) for child in set(tree)]
        return math.prod(map(math.factorial, repeats)) * math.prod(map(symmetry, tree))

    for n in range(1, 6):
        total = dict.fromkeys(trees(n), Fraction(0))
        for word in words(n - 1):
            total[unordered(word)] += exact_weight((word,))
        assert total == {tree: exact_tree_weight(tree) / symmetry(tree) for tree in trees(n)}


# The order of commutator-free methods


def test_order_of_named_tableaus_which_rounding_keeps(subtests):
    for name, (tableau, q) in ORDERS.items():
        rounded = as_floats(tableau)
        with subtests.test(name=name):
            assert order(tableau) == order(rounded) == q
            assert not rounded.is_exact
            if rounded != tableau:
                assert error_constant(rounded) == pytest.approx(error_constant(tableau), rel=1e-10)
            # In a linear space the order is at least the same.
            assert runge_kutta_order(*row_sums(tableau)) >= q


def test_error_constants():
    for tableau, constant, atol in (
        *((CF3, 0.0618, 5e-5), (CF4, 0.0225, 5e-5), (CG4, 0.0782, 5e-5), (CG5, 0.0966, 5e-5)),
        (CK54, 0.00637, 5e-6),
    ):
        assert error_constant(tableau) == pytest.approx(constant, abs=atol)
    # Both words of order 2 have the exact weight 1/2; Euler gives 1/2 and 0.
    assert error_constant(LIE_EULER) == HALF


@pytest.mark.slow
def test_the_error_constant_of_thirteen_stages():
    assert error_constant(YRK135) == pytest.approx(0.00061, abs=5e-6)


def test_reversed_composition_has_order_two():
    for name in ("CF3", "CF4", "CG3", "CG4", "CG5"):
        tableau, q = ORDERS[name]
        wrong = reversed_composition(tableau)
        assert order(wrong) == 2 < q
        # The two words of one dot and one line swap their weights, 1/3 and 1/6.
        assert error_constant(wrong) == pytest.approx(math.sqrt(2) / 6)
    # In a linear space the order may be higher.
    assert runge_kutta_order(*row_sums(reversed_composition(CG4))) == 4


def test_one_flow_is_not_enough_for_order_three():
    # Kutta's methods: of orders 3 and 4 in a linear space.
    sixths = [Fraction(n, 6) for n in (1, 4, 1)]
    assert order(Tableau([[], [[HALF]], [[-1, 2]]], [sixths])) == 2
    sixths = [Fraction(n, 6) for n in (1, 2, 2, 1)]
    assert order(Tableau([[], [[HALF]], [[0, HALF]], [[0, 0, 1]]], [sixths])) == 2


parameters = st.fractions(min_value=-20, max_value=20, max_denominator=1000)
FAMILIES = [(third_order_a, (0, THIRD)), (third_order_b, (1, THIRD))]


@hypothesis.given(alpha=parameters, rounded=st.floats(min_value=-20, max_value=20))
@hypothesis.settings(deadline=None, max_examples=50)
def test_families_have_order_three_and_cost_three_flows(alpha, rounded):
    for family, excluded in FAMILIES:
        if alpha not in excluded:
            tableau = family(alpha)
            second = THIRD if excluded[0] == 0 else second_node(alpha)
            assert order(tableau) == tableau.num_flows == 3
            assert tableau.is_exact and tableau.c == (0, second, alpha)
        if all(abs(rounded - float(value)) > 1e-9 for value in excluded):
            assert order(family(rounded)) == 3


def second_node(alpha):
    """That of the second family."""
    return 2 * (3 * alpha**2 - 3 * alpha + 1) / (3 * (1 - alpha))


def test_families_close_to_singular_have_order_three():
    for family, excluded in FAMILIES:
        for value in excluded:
            for distance in (1e-3, -1e-6, 1e-9, -1e-12):
                assert order(family(float(value) + distance)) == 3, (value, distance)


def test_changing_any_coefficient_lowers_the_order(subtests):
    for tableau in (CF3, CF4, CG3):
        for place in nonzero_places(tableau):
            wrong = changed(tableau, place, Fraction(1, 1000))
            with subtests.test(place=str(place)):
                assert order(wrong) < order(tableau)
                assert order(as_floats(wrong)) == order(wrong)
    for tableau in (CG4, CK54):
        for place in nonzero_places(tableau):
            with subtests.test(place=str(place)):
                assert order(changed(tableau, place, 1e-10)) < order(tableau)
    for place in random.Random(0).sample(list(nonzero_places(CG5)), 5):
        assert order(changed(CG5, place, 1e-10)) < 5, place
    assert order(changed(YRK135, (13, 12, 12), 1e-10)) < 5


STORED = [
    solver
    for name in dir(cfjax)
    if isinstance(solver := getattr(cfjax, name), type) and getattr(solver, "orders", None)
]


def test_stored_orders_are_those_that_the_conditions_prove(subtests):
    for solver in STORED:
        method, embedded = solver(), solver.tableau.embedded_method
        lower = None if embedded is None else order(embedded)
        with subtests.test(solver=solver.__name__):
            assert solver.orders == (order(solver.tableau), lower)
            assert method.order(None) == solver.orders[0]
            assert method.error_order(None) == (None if lower is None else lower + 1)
    # Orders are stored where a proof takes long. Those of others are proved.
    assert {cfjax.CG5, cfjax.YRK135, cfjax.CF54, cfjax.ETD54} <= set(STORED)
    assert cfjax.CommutatorFree(changed(CG5, (4, 0, 2), 1e-10)).order(None) < 5
    made = cfjax.RKMK(diffrax.Dopri8.tableau)
    assert (made.order(None), made.error_order(None)) == (8, 8)
    assert (runge_kutta_order(*made._end), runge_kutta_order(*made._embedded)) == (8, 7)


def test_order_is_at_most_the_number_of_stages():
    assert order(LIE_EULER) == LIE_EULER.num_stages
    assert runge_kutta_order([], [1]) == 1


# The classical order


def test_order_of_the_tableaus_in_diffrax():
    solvers = {"Heun": 2, "Midpoint": 2, "Ralston": 2, "Bosh3": 3, "Tsit5": 5, "Dopri5": 5}
    for name, q in (solvers | {"Dopri8": 8}).items():
        tableau = getattr(diffrax, name).tableau
        assert runge_kutta_order(tableau.a_lower, tableau.b_sol) == q, name
        if name in ("Tsit5", "Dopri8"):
            # A small mistake is seen.
            rows = [np.array(row) for row in tableau.a_lower]
            rows[3][2] += 1e-10
            assert runge_kutta_order(rows, tableau.b_sol) < q


def test_classical_order_of_exact_tableaus():
    assert runge_kutta_order([[1]], [HALF, HALF]) == 2
    assert runge_kutta_order([[1]], [1, 0]) == 1
    kutta = [[HALF], [0, HALF], [0, 0, 1]]
    sixths = [Fraction(n, 6) for n in (1, 2, 2, 1)]
    assert runge_kutta_order(kutta, sixths) == 4
    kutta[2] = [Fraction(1, 10**20), 0, 1 - Fraction(1, 10**20)]
    assert runge_kutta_order(kutta, sixths) < 4


def test_classical_order_names_a_bad_coefficient():
    with pytest.raises(ValueError, match=r"alpha\[1\]\[0\]\[1\] is 1, .* explicit"):
        runge_kutta_order([[0, 1]], [0, 1])
    with pytest.raises(ValueError, match=r"beta must sum to 1"):
        runge_kutta_order([[1]], [1, 1])
    with pytest.raises(ValueError, match=r"beta\[0\] must have at most 2 entries"):
        runge_kutta_order([[1]], [0, 0, 1])


def test_order_is_of_a_tableau(no_shape_hook):
    # The method instead of its tableau is an easy mistake.
    with pytest.raises(TypeError, match=r"tableau must be a cfjax.Tableau, got CF4\(\)"):
        order(cfjax.CF4())  # pyright: ignore[reportArgumentType]
    # It has arrays, so no hash.
    with pytest.raises(TypeError, match=r"order: tableau must be a cfjax.Tableau, got Butcher"):
        order(diffrax.Dopri5.tableau)
    for other in cfjax.CF4(), cfjax.ETD54().tableau, diffrax.Dopri5.tableau:
        with pytest.raises(TypeError, match=r"error_constant: tableau must be a cfjax.Tableau"):
            error_constant(other)  # pyright: ignore[reportArgumentType]


# Continuous extensions. Their conditions are evaluated on their own: words, weights by recursion.


@lru_cache
def all_words(n):
    if n == 0:
        return [()]
    return [(t, *w) for k in range(1, n + 1) for t in all_words(k - 1) for w in all_words(n - k)]


def order_of_word(word):
    return sum(1 + order_of_word(tree) for tree in word)


def weight_of(word):
    if not word:
        return Fraction(1)
    return weight_of(word[:-1]) * weight_of(word[-1]) / order_of_word(word)


def weights_at(continuous_extension, theta):
    return [
        [sum(a * theta ** (i + 1) for i, a in enumerate(column)) for column in zip(*p, strict=True)]
        for p in continuous_extension
    ]


FLOWS = named_solvers("commutator-free", "low-storage") | {
    name: COMMUTATOR_FREE[name] for name in ("family A, 1/2", "family B, 2/3")
}


@pytest.mark.representatives(8)
@pytest.mark.parametrize("name", FLOWS)
def test_the_order_conditions_of_the_continuous_extension(name):
    """Its weights must be `theta^n` times those of the exact solution, for words of order n."""
    tableau, order = FLOWS[name].make().tableau, FLOWS[name].output
    within = continuous_extension(tableau)
    # Exact where the tableau is; Fraction(2) / 3 and 2.0 / 3 are both right below.
    is_exact = tableau.is_exact and tableau.continuous_extension is not None
    number = Fraction if is_exact else float
    products = [[list(map(number, r)) for r in p] for p in (*tableau.alpha, tableau.beta)]

    @lru_cache(None)
    def stage(k, tree):
        return weigher(products[k])(tree, len(products[k]))

    def weigher(rows):
        @lru_cache(None)
        def weight(word, j):
            """Over all splits of the word's letters into one group for each of j flows."""
            if not word or not j:
                return number(not word)
            total = number(0)
            for i in range(len(word) + 1):
                term = weight(word[:i], j - 1)
                for m, tree in enumerate(word[i:], 1):
                    term *= sum(a * stage(k, tree) for k, a in enumerate(rows[j - 1]) if a) / m
                total += term
            return total

        return weight

    def defect(n, theta):
        rows = weights_at(within, theta)
        weight = weigher(rows)
        return max(
            abs(weight(w, len(rows)) - theta**n * number(weight_of(w))) for w in all_words(n)
        )

    # Coefficients up to 10 that are rounded, in products of up to four that are rarely all large;
    # or exact. In YRK135, up to 12, they grow and cancel: 12^4 units of rounding are 2e-12.
    tolerance = 0 if is_exact else 2e-14 if name != "YRK135" else 1e-12
    for theta in (number(1) / 7, number(1) / 2, number(1)):
        for n in range(1, order + 1):
            assert defect(n, theta) <= tolerance
    # And no more than that.
    assert defect(order + 1, number(1) / 2) > 1e-5
    # The end of the step is met.
    for row, end in zip(weights_at(within, number(1)), tableau.beta, strict=True):
        rest = [*end, *[0] * (len(row) - len(end))]
        np.testing.assert_allclose(np.array(row, float), np.array(rest, float), rtol=0, atol=1e-14)


def test_the_order_conditions_in_the_algebra(subtests):
    """The conditions of continuous Runge-Kutta methods, for each tree and stage by recursion."""
    for name, row in MUNTHE_KAAS.items():
        with subtests.test(name=name):
            fulfils_the_conditions_in_the_algebra(row.make(), row.output)


def fulfils_the_conditions_in_the_algebra(solver, order):
    a = solver.a[: len(solver.b)]
    (powers,), more, times = runge_kutta_extension(a, solver.b, solver.order(None))
    rows = (*a, *more)
    np.testing.assert_allclose([sum(row) for row in more], times, rtol=0, atol=1e-14)

    @lru_cache
    def stages(tree):
        product = np.ones(len(rows))
        for child in tree:
            product *= [np.dot(row, stages(child)[: len(row)]) for row in rows]
        return product

    def density(tree):
        return (1 + order_of_word(tree)) * np.prod([density(child) for child in tree])

    def defect(n, theta):
        (weights,) = weights_at((powers,), theta)
        return max(abs(weights @ stages(t) - theta**n / density(t)) for t in all_words(n - 1))

    for theta in (1 / 7, 1 / 2, 1.0):
        for n in range(1, order + 1):
            # Coefficients up to 6, Tsit5's up to 66, Dopri8's up to 707, and sums of products.
            assert defect(n, theta) < 1e-12
    assert defect(order + 1, 1 / 3) > 1e-6


def test_a_method_that_needs_the_field_at_the_end_of_the_step_evaluates_it():
    """The methods of order 5 whose stages reach order 3 only."""
    assert {
        name
        for name, row in FLOWS.items()
        if any(map((tableau := row.make().tableau).uses_last, continuous_extension(tableau)))
    } == {"CF54", "CG5"}


# Coefficients in the form of Crouch and Grossman


def test_crouch_grossman():
    tableau = crouch_grossman([[HALF], [0, HALF]], [0, 0, 1])
    assert tableau == Tableau([[], [[HALF]], [[0, HALF]]], [[0, 0, 1]])
    tableau = crouch_grossman([[1]], [HALF, HALF])
    assert tableau == Tableau([[], [[1]]], [[HALF], [0, HALF]])
    assert crouch_grossman([], [1]) == Tableau([[]], [[1]])
    tableau = crouch_grossman([[1]], [HALF, HALF], [1, 0], [[1, -HALF], [0, HALF]])
    assert tableau.embedded == ((1, 0, 0),)
    assert tableau.continuous_extension == (((1, 0, 0), (-HALF, 0, 0)), ((0, 0, 0), (0, HALF, 0)))
